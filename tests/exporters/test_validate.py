"""Each possible fault of a stage is found, with its fix."""

from __future__ import annotations

import numpy as np
import pytest

from vehsim.exporters.checks.validate import Issue, issues_of, validate_stage
from vehsim.exporters.usd.exporter import write_usd

pytestmark = pytest.mark.broken_stages


@pytest.fixture
def shot(tmp_path, toys, make_take):
    toys.asset(tmp_path / "cm.usda", 0.01)
    write_usd(make_take(toys.clip(toys.asset(tmp_path / "in" / "toy.usda"))), tmp_path, toys.silent)
    return tmp_path / "shot.usda"


def broken(shot, edit):
    from pxr import Usd

    stage = Usd.Stage.Open(str(shot))
    edit(stage)
    stage.GetRootLayer().Save()
    return validate_stage(shot)


def test_an_exported_shot_has_no_issue(shot):
    assert [str(issue) for path in shot.parent.rglob("*.usd*") for issue in validate_stage(path)] == []


BREAKS = {
    "usdGeomValidators:StageMetadataChecker": lambda stage: stage.GetRootLayer().pseudoRoot.ClearInfo("metersPerUnit"),
    "usdValidation:StageMetadataChecker": lambda stage: stage.ClearDefaultPrim(),
    "time": lambda stage: stage.GetRootLayer().pseudoRoot.ClearInfo("timeCodesPerSecond"),
    "range": lambda stage: stage.SetEndTimeCode(1010),
    "finite": lambda stage: _camera(stage).GetAttribute("xformOp:translate").Set((float("nan"), 0, 0), 1001),
    "sign": lambda stage: _flip(_camera(stage).GetAttribute("xformOp:orient")),
    "units": lambda stage: stage.DefinePrim("/shot/env/prop", "Xform").GetReferences().AddReference("./cm.usda"),
    "dead over": lambda stage: stage.OverridePrim("/shot/vehicles/gone/wheel").CreateAttribute("a", _float()).Set(1.0),
    "scale": lambda stage: _op(stage, "Scale", (1, 0, 1)),
    "read": lambda stage: _order(stage, "xformOp:x"),
    "ops": lambda stage: _order(stage, "xformOp:rotateX:spin"),
    "usdValidation:CompositionErrorTest": lambda stage: (
        stage.OverridePrim("/shot/env").GetReferences().AddReference("./gone.usda")
    ),
}


def _float():
    from pxr import Sdf

    return Sdf.ValueTypeNames.Float


def _order(stage, op):
    from pxr import Sdf

    env = stage.GetPrimAtPath("/shot/env")
    env.CreateAttribute("xformOpOrder", Sdf.ValueTypeNames.TokenArray).Set([op])


def _op(stage, kind, value):
    from pxr import Gf, UsdGeom

    getattr(UsdGeom.Xformable(stage.GetPrimAtPath("/shot/env")), f"Add{kind}Op")().Set(Gf.Vec3f(value))


def _camera(stage):
    return stage.GetPrimAtPath("/shot/cameras/chase")


def _flip(quaternions):
    values = {time: quaternions.Get(time) for time in quaternions.GetTimeSamples()}
    for time, value in values.items():
        quaternions.Set(-value if time == 1005 else value, time)


@pytest.mark.parametrize("rule", BREAKS)
def test_broken_stages_are_found(shot, rule):
    issues = [issue for issue in broken(shot, BREAKS[rule]) if issue.rule == rule]
    assert issues, rule
    assert issues[0].remedy and issues[0].message and issues[0].site


def test_a_payload_in_other_units_is_found(shot):
    def add(stage):
        stage.DefinePrim("/shot/env/prop", "Xform").GetPayloads().AddPayload("./cm.usda")

    assert [issue.site for issue in broken(shot, add) if issue.rule == "units"] == ["/shot/env/prop"]


def test_a_file_that_is_no_stage_is_one_issue(tmp_path):
    (tmp_path / "bad.usda").write_text("not usd")
    (issue,) = validate_stage(tmp_path / "bad.usda")
    assert issue.severity == "error" and "bad.usda" in issue.site


def test_a_wrapped_angle_and_a_slerped_spin_are_found(tmp_path):
    from pxr import Gf, Usd, UsdGeom

    stage = Usd.Stage.CreateNew(str(tmp_path / "wheels.usda"))
    wrapped = UsdGeom.Xform.Define(stage, "/wrapped").AddRotateYOp()
    running = UsdGeom.Xform.Define(stage, "/running").AddRotateYOp()
    slerped = UsdGeom.Xform.Define(stage, "/slerped").AddOrientOp()
    for k in range(24):
        wrapped.Set(80.0 * k % 360.0, k)
        running.Set(700.0 * k, k)
        slerped.Set(Gf.Quatf(Gf.Rotation(Gf.Vec3d(0, 1, 0), 170.0 * k).GetQuat()), k)
    stage.Save()
    found = {issue.site.partition(".")[0] for issue in validate_stage(tmp_path / "wheels.usda") if issue.rule == "spin"}
    assert found == {"/wrapped", "/slerped"}


def turning(*rates):
    """Angles of a part that turns at each rate, degrees per frame, for a number of frames."""
    return np.cumsum(np.concatenate([np.full(frames, float(rate)) for rate, frames in rates]))


def wrapped(angles, low=0.0):
    return (angles - low) % 360.0 + low


@pytest.mark.parametrize(
    ("angles", "found"),
    [
        (wrapped(turning((0, 21), (250, 10))), True),  # it stands for most frames
        (wrapped(turning((0, 21), (-250, 10)), -180.0), True),
        (wrapped(turning((20, 9), (220, 6))), True),  # steps back of 140 degrees
        (wrapped(turning((200, 2), (190, 1), (170, 1), (140, 1), (100, 1), (60, 1), (10, 1), (0, 9)), -180.0), True),
        (turning((0, 21), (250, 10)), False),
        (20 + 60 * np.sin(1.3 * np.arange(60)), False),  # a flap that swings by up to 73 degrees per frame
        (np.tile([0.0, 100.0], 20), False),
        (35 * np.sin(0.2 * np.arange(60)), False),
        (np.array([0.0, 170.0, 0.0, 10.0, 20.0]), False),
    ],
)
def test_a_wheel_that_wraps_while_it_speeds_up_is_found(tmp_path, angles, found):
    from pxr import Usd, UsdGeom

    stage = Usd.Stage.CreateNew(str(tmp_path / "wheel.usda"))
    op = UsdGeom.Xform.Define(stage, "/wheel").AddRotateXOp()
    for time, angle in enumerate(angles.tolist()):
        op.Set(angle, time)
    stage.Save()
    assert ("spin" in {issue.rule for issue in validate_stage(tmp_path / "wheel.usda")}) is found


@pytest.mark.parametrize(
    ("rotate", "stop", "rules"),
    [
        ([0, 300, 20, 320], 4, {"spin"}),  # wrapped after 360 degrees
        ([0, 300, 600, 900], 4, set()),
        ([0, 300, 600, 900], 2, {"range"}),
    ],
)
def test_the_rules_apply_to_splines(tmp_path, rotate, stop, rules):
    from pxr import Ts, Usd, UsdGeom

    stage = Usd.Stage.CreateNew(str(tmp_path / "spline.usda"))
    stage.SetFramesPerSecond(24)
    stage.SetTimeCodesPerSecond(24)
    stage.SetStartTimeCode(1)
    stage.SetEndTimeCode(stop)
    spline = Ts.Spline("float")
    for time, value in enumerate(rotate, start=1):
        knot = Ts.Knot("float", time=float(time), value=float(value), nextInterp=Ts.InterpLinear)
        spline.SetKnot(knot)
    UsdGeom.Xform.Define(stage, "/wheel").AddRotateYOp().GetAttr().SetSpline(spline)
    stage.Save()
    found = {issue.rule for issue in validate_stage(tmp_path / "spline.usda")}
    assert found & {"time", "range", "finite", "sign", "spin"} == rules


def bezier(points: list[tuple[float, float]], slope: float, width: float = 1 / 3):
    """A spline through (time, value) whose tangents have one slope, and a width in shares of their segment."""
    from pxr import Ts

    spline = Ts.Spline("double")
    for k, (time, value) in enumerate(points):
        knot = Ts.Knot("double", time=time, value=value, nextInterp=Ts.InterpCurve)
        for side, other in (("Pre", k - 1), ("Post", k + 1)):
            if 0 <= other < len(points):
                getattr(knot, f"Set{side}TanWidth")(width * abs(points[other][0] - time))
                getattr(knot, f"Set{side}TanSlope")(slope)
        spline.SetKnot(knot)
    return spline


@pytest.mark.parametrize(
    ("values", "held", "where"),
    [
        ([1, 2, 1], False, None),
        ([1, 2, 0, 2], False, 21.0),  # at a key
        ([1, 3, -1, -2], False, 18.5),  # between two keys, three quarters of the way
        ([1, 3, -1, -2], True, None),  # mirrored at once
        ([0, 1], False, 1.0),
    ],
)
@pytest.mark.parametrize("spline", [True, False])
def test_a_scale_that_passes_through_zero_is_found(tmp_path, values, held, where, spline):
    from pxr import Ts, Usd, UsdGeom

    stage = Usd.Stage.CreateNew(str(tmp_path / "scale.usda"))
    stage.SetStartTimeCode(1)
    op = UsdGeom.Xform.Define(stage, "/ball").AddScaleXOp()
    if spline:
        curve = Ts.Spline("float")
        for k, value in enumerate(values):
            shape = Ts.InterpHeld if held else Ts.InterpLinear
            curve.SetKnot(Ts.Knot("float", time=1.0 + 10 * k, value=float(value), nextInterp=shape))
        op.GetAttr().SetSpline(curve)
    else:
        for k, value in enumerate(values):
            if held and k:
                op.Set(float(values[k - 1]), 10 * k + 1 - 1e-9)
            op.Set(float(value), 1.0 + 10 * k)
    stage.Save()
    found = [issue for issue in validate_stage(tmp_path / "scale.usda") if issue.rule == "scale"]
    if where is None:
        assert not found
    else:
        (issue,) = found
        later = f" at time code {where:g}" if where != 1 else ""
        assert issue.message == "its transform cannot be inverted" + later
        assert issue.severity == ("warning" if later else "error")  # animators hide things so


STEADY = [(1.0 + 10 * k, 300.0 * k) for k in range(5)]
PARKING = [(1, 0), (21, 500), (41, 200), (61, 700)]


@pytest.mark.parametrize(
    ("points", "slope", "message"),
    [
        (STEADY, 30.0, ""),
        (STEADY, 150.0, "between its keys at time codes 1 and 11"),  # the tangents are five times too steep
        (STEADY, -30.0, "between its keys at time codes 1 and 11"),
        (STEADY[:3], -30.0, "between its keys at time codes 1 and 11"),
        ([(1, 0), (21, -500), (41, -1000)], 40.0, "between its keys at time codes 1 and 21"),
        ([(1, 0), (21, 500), (41, 1000), (61, 1200)], 0.0, ""),
        (PARKING, 0.0, ""),  # a wheel that rolls forwards, back and forwards again
        ([(1 + 10 * k, (300 * k) % 360) for k in range(9)], 30.0, "degrees after time code"),
        ([(1.0 + 10 * k, 8.0 * k) for k in range(5)], 8.0, ""),  # steering that swings
    ],
)
def test_splines_may_not_turn_wheels_back_between_their_keys(tmp_path, points, slope, message):
    from pxr import Usd, UsdGeom

    stage = Usd.Stage.CreateNew(str(tmp_path / "spline.usda"))
    UsdGeom.Xform.Define(stage, "/wheel").AddRotateYOp(UsdGeom.XformOp.PrecisionDouble).GetAttr().SetSpline(
        bezier(points, slope)
    )
    stage.Save()
    found = [str(issue) for issue in validate_stage(tmp_path / "spline.usda") if issue.rule == "spin"]
    assert len(found) == bool(message) and message in "".join(found)


def test_splines_need_a_time_range_and_keep_to_it_in_a_layer_of_another_rate(tmp_path):
    """Keys 1 to 48 at 24 time codes per second are 1.04 to 50 in a stage with 25, whose range ends at 48."""
    from pxr import Sdf, Usd, UsdGeom

    layer = Usd.Stage.CreateNew(str(tmp_path / "anim.usda"))
    layer.SetTimeCodesPerSecond(24)
    steady = bezier([(1, 0), (24, 1), (48, 2)], 1 / 24)
    UsdGeom.Xform.Define(layer, "/box").AddTranslateXOp().GetAttr().SetSpline(steady)
    layer.Save()
    unstated = {str(issue) for issue in validate_stage(tmp_path / "anim.usda") if issue.rule == "time"}
    assert len(unstated) == 3 and any("startTimeCode is not authored" in text for text in unstated)

    shot = Sdf.Layer.CreateNew(str(tmp_path / "shot.usda"))
    shot.subLayerPaths.append("./anim.usda")
    shot.timeCodesPerSecond = shot.framesPerSecond = 25
    shot.startTimeCode, shot.endTimeCode = 1, 48
    shot.Save()
    (issue,) = [issue for issue in validate_stage(tmp_path / "shot.usda") if issue.rule in ("range", "time")]
    assert issue.rule == "range" and issue.site == "/box.xformOp:translateX"
    assert issue.message.startswith("keys 1.04167..50 of anim.usda leave the stage's 1..48: USD scales the layer's 24")


@pytest.mark.parametrize("kind", ["quatf xformOp:orient", "double3 xformOp:translate"])
def test_splines_of_quaternions_and_vectors_are_refused(tmp_path, kind):
    """USD has splines of numbers only, so that the rule of signs needs none."""
    text = '#usda 1.0\ndef Xform "box" {{\n    {}.spline = {{\n        1: 0; post linear,\n        5: 1,\n    }}\n}}\n'
    (tmp_path / "spline.usda").write_text(text.format(kind))
    (issue,) = validate_stage(tmp_path / "spline.usda")
    assert issue.rule == "open"
    (tmp_path / "spline.usda").write_text(text.format("double xformOp:rotateX"))
    assert "open" not in {issue.rule for issue in validate_stage(tmp_path / "spline.usda")}


@pytest.mark.parametrize(
    ("key", "theirs", "message"),
    [
        ("metersPerUnit", 1.0, "has metersPerUnit 1, the stage 0.01"),
        ("upAxis", "Z", "has upAxis Z, the stage Y"),
        ("timeCodesPerSecond", 24.0, "has timeCodesPerSecond 24, the stage 25: USD moves its keys to 1.04167 times"),
    ],
)
@pytest.mark.parametrize("deep", [False, True])
def test_a_sublayer_of_another_unit_axis_or_rate_is_named(tmp_path, key, theirs, message, deep):
    from pxr import Sdf, Usd, UsdGeom

    layer = Sdf.Layer.CreateNew(str(tmp_path / "anim.usda"))
    layer.pseudoRoot.SetInfo(key, theirs)
    layer.Save()
    if deep:
        between = Sdf.Layer.CreateNew(str(tmp_path / "between.usda"))
        between.subLayerPaths.append("./anim.usda")
        between.Save()
    stage = Usd.Stage.CreateNew(str(tmp_path / "shot.usda"))
    UsdGeom.SetStageMetersPerUnit(stage, 0.01)
    UsdGeom.SetStageUpAxis(stage, "Y")
    stage.SetTimeCodesPerSecond(25)
    stage.SetFramesPerSecond(25)
    stage.GetRootLayer().subLayerPaths.append("./between.usda" if deep else "./anim.usda")
    stage.GetRootLayer().Save()
    (issue,) = [issue for issue in validate_stage(tmp_path / "shot.usda") if issue.rule == "sublayer"]
    assert "anim.usda" in issue.message and message in issue.message


def test_a_layer_at_another_rate_explains_keys_outside_the_range(tmp_path):
    from pxr import Sdf, Usd, UsdGeom

    source = Usd.Stage.CreateNew(str(tmp_path / "anim.usda"))
    source.SetTimeCodesPerSecond(24)
    source.SetFramesPerSecond(24)
    op = UsdGeom.Xform.Define(source, "/car").AddTranslateOp()
    for frame in range(1001, 1101):
        op.Set((frame, 0.0, 0.0), frame)
    source.Save()
    stage = Usd.Stage.Open(Sdf.Layer.CreateNew(str(tmp_path / "shot.usda")))
    stage.SetTimeCodesPerSecond(25)
    stage.SetFramesPerSecond(25)
    stage.SetStartTimeCode(1001)
    stage.SetEndTimeCode(1100)
    stage.GetRootLayer().subLayerPaths.append("./anim.usda")
    stage.GetRootLayer().Save()
    (issue,) = [issue for issue in validate_stage(tmp_path / "shot.usda") if issue.rule == "range"]
    assert "24 time codes per second" in issue.message and "stage's 25" in issue.message
    assert "rate" in issue.remedy


def test_opinions_inside_an_instance_are_found(tmp_path, toys):
    from pxr import Usd, UsdGeom

    toys.asset(tmp_path / "toy.usda")
    stage = Usd.Stage.CreateNew(str(tmp_path / "shot.usda"))
    prim = UsdGeom.Xform.Define(stage, "/it").GetPrim()
    prim.GetReferences().AddReference("./toy.usda")
    prim.SetInstanceable(True)
    stage.Save()
    assert not [issue for issue in validate_stage(tmp_path / "shot.usda") if issue.rule == "dead over"]
    layer = stage.GetRootLayer()
    from pxr import Sdf

    Sdf.CreatePrimInLayer(layer, "/it/rotor")
    layer.Save()
    issues = [issue for issue in validate_stage(tmp_path / "shot.usda") if issue.rule == "dead over"]
    assert (
        "has an opinion on rotor inside an instance" in issues[0].message and "instanceable = false" in issues[0].remedy
    )


def test_a_layer_of_overs_only_is_valid(tmp_path):
    from pxr import Usd, UsdGeom

    stage = Usd.Stage.CreateNew(str(tmp_path / "over.usda"))
    UsdGeom.Xformable(stage.OverridePrim("/World/heli"))
    stage.GetRootLayer().Save()
    assert not [issue for issue in validate_stage(tmp_path / "over.usda") if issue.rule == "dead over"]


def test_a_model_in_the_wrong_unit_is_found(tmp_path, toys):
    from pxr import Usd, UsdGeom

    toys.asset(tmp_path / "toy.usda")
    stage = Usd.Stage.Open(str(tmp_path / "toy.usda"))
    UsdGeom.SetStageMetersPerUnit(stage, 1e-2)
    stage.GetRootLayer().Save()
    assert not [issue for issue in validate_stage(tmp_path / "toy.usda") if issue.rule == "scale"]
    UsdGeom.SetStageMetersPerUnit(stage, 1e-4)
    stage.GetRootLayer().Save()
    assert [issue.message for issue in validate_stage(tmp_path / "toy.usda") if issue.rule == "scale"]


def test_the_same_fault_at_many_places_is_reported_once(shot):
    def lengthen(stage):
        stage.SetStartTimeCode(1010)

    issues = [issue for issue in broken(shot, lengthen) if issue.rule == "range"]
    assert 1 <= len(issues) <= 3
    assert any("more" in issue.site for issue in issues)


def test_nvidias_validator_runs_when_it_is_installed(shot, monkeypatch):
    """A stand-in for the package, which is no dependency: its issues are reported with severity, place and remedy."""
    import sys
    from types import ModuleType
    from types import SimpleNamespace as Named

    from pxr import Usd, UsdGeom

    def unshaded(path):
        return Named(
            severity=Named(name="FAILURE"),
            rule=Named(__name__="NormalsExistChecker"),
            message="no normals ",
            at=Named(as_str=lambda: f"Prim <{path}>", path=path),
            suggestion=None,
        )

    stage = Usd.Stage.Open(str(shot))
    hull = UsdGeom.Mesh.Define(stage, "/shot/hull")  # a guide, which is never shaded
    hull.CreatePurposeAttr(UsdGeom.Tokens.guide)
    stage.Save()
    found_by_them = [unshaded("/shot"), unshaded("/shot/hull")]
    module = ModuleType("usd_validation_nvidia")
    module.__spec__ = Named(name="usd_validation_nvidia")
    module.ValidationEngine = lambda: Named(validate=lambda stage: Named(issues=lambda: found_by_them))
    monkeypatch.setitem(sys.modules, "usd_validation_nvidia", module)
    issues = [Issue(*row) for row in issues_of(shot)[0]]  # in this process, where the package is
    found = [str(issue) for issue in issues if issue.rule.startswith("nvidia")]
    assert found == ["error: Prim </shot>: no normals [nvidia:NormalsExistChecker]; see nvidia_usd_validate --explain"]
