"""Wheels modelled in place, with pivots named by other software: they turn about their own centres, and forwards."""

from __future__ import annotations

from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest
from pxr import Gf, Usd, UsdGeom
from scipy.spatial.transform import Rotation

import vehsim
from vehsim.delivery.take import Take
from vehsim.exporters.usd.exporter import write_usd
from vehsim.exporters.usd.readback import world_matrices
from vehsim.rig.ops import rig_problems
from vehsim.vehicles import load_vehicle

HUBS = {"fl": (2.6, 0.8, 0.4), "fr": (2.6, -0.8, 0.4), "rl": (0.0, 0.8, 0.4), "rr": (0.0, -0.8, 0.4)}
TOML = """
schema = 1
name = "mine"
model = "car"
asset = "mine.usda"
origin = [0.0, 0.0, 0.0]
[physics]
mass = 900.0
yaw_inertia = 1500.0
wheel_inertia = 1.5
wheel_radius = 0.4
wheelbase = 2.6
half_track = 0.8
"""


def wheel(stage, path, hub):
    """A tyre (a prism of 24 sides, radius 0.4 m) about a point; its points (n, 3) m."""
    angle = np.arange(24) / 24 * 2 * np.pi
    ring = 0.4 * np.stack([np.cos(angle), 0 * angle, np.sin(angle)], axis=1)
    points = np.concatenate([ring + np.array([0, y, 0]) for y in (-0.12, 0.12)]) + hub
    mesh = UsdGeom.Mesh.Define(stage, path)
    mesh.CreatePointsAttr([Gf.Vec3f(*p) for p in points.tolist()])
    mesh.CreateFaceVertexCountsAttr([4] * 24)
    mesh.CreateFaceVertexIndicesAttr([i for k in range(24) for i in (k, (k + 1) % 24, 24 + (k + 1) % 24, 24 + k)])
    return mesh


def vehicle(folder: Path, pivots=("rotatePivotTranslate", "rotatePivot"), merged=False, mirrored=(), **more):
    """A car whose wheels are each a prim in place, which may be the mesh itself, or below a mirror."""
    stage = Usd.Stage.CreateNew(str(folder / "mine.usda"))
    UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.z)
    UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    stage.SetDefaultPrim(UsdGeom.Xform.Define(stage, "/mine").GetPrim())
    channels = ""
    for name, hub in HUBS.items():
        path = f"side_{name}/wheel"
        side = UsdGeom.Xform.Define(stage, f"/mine/side_{name}")
        place = np.array(hub) * [1, -1, 1] if name in mirrored else np.array(hub)
        if name in mirrored:
            side.AddScaleOp().Set((1, -1, 1))
            side.AddTranslateOp().Set((0, 0, 0))  # a mirror last in the order would be applied below the steering
        if not merged:
            UsdGeom.Xform.Define(stage, f"/mine/{path}")
        prim = UsdGeom.Xformable(wheel(stage, f"/mine/{path}{'' if merged else '/tyre'}", place).GetPrim())
        prim = prim if merged else UsdGeom.Xformable(stage.GetPrimAtPath(f"/mine/{path}"))
        for suffix in pivots[:-1]:
            prim.AddTranslateOp(opSuffix=suffix).Set((0, 0, 0))
        prim.AddTranslateOp(opSuffix=pivots[-1]).Set(tuple(place.tolist()))
        prim.AddRotateXYZOp().Set((0, 12, 0))
        prim.AddTranslateOp(opSuffix=pivots[-1], isInverseOp=True)
        for kind, op, carrier in (("roll", "rotateY", path), ("steer", "rotateZ", f"side_{name}")):
            if kind == "roll" or name in mirrored:
                turns = "".join(f"{key} = {value}\n" for key, value in more.get(f"{kind}_{name}", {}).items())
                channels += f'[channels.{kind}_{name}]\nprim = "{carrier}"\nop = "{op}"\n{turns}'
    stage.Save()
    (folder / "vehicle.toml").write_text(TOML + channels)
    return load_vehicle(folder)


@pytest.mark.parametrize("merged", [False, True])
@pytest.mark.parametrize("pivots", [("rotatePivotTranslate", "rotatePivot"), ("my_pivot",), ("hub",)])
def test_wheels_turn_about_their_pivot_with_any_name(pivots, merged, tmp_path):
    """Every point is at T_wr (hub + R_y(roll) (rest - hub)), computed here from the clip's numbers."""
    car = vehicle(tmp_path, pivots, merged)
    assert list(rig_problems(car.rig)) == []
    clip = vehsim.simulate(car, None, [0.0, 0.0], vehsim.State(twist=(0.0, 8.0, 0.0)), 0.5)
    take = Take("shot", {"it": clip}, vehsim.World(), (), Fraction(24), (1001, 1013))
    write_usd(take, tmp_path / "out", lambda what, done: None)
    stage, whole = Usd.Stage.Open(str(tmp_path / "out/shot.usda")), clip.resample()
    rest = Usd.Stage.Open(str(tmp_path / "mine.usda"))
    for name, hub in HUBS.items():
        path = f"side_{name}/wheel{'' if merged else '/tyre'}"
        mesh = UsdGeom.Mesh(rest.GetPrimAtPath(f"/mine/{path}"))
        points = np.array(mesh.GetPointsAttr().Get(), float)
        at_rest = world_matrices(mesh.GetPrim(), np.array([0.0]))[0]
        off = points @ at_rest[:3, :3].T + at_rest[:3, 3] - hub
        found = world_matrices(stage.GetPrimAtPath(f"/shot/vehicles/it/{path}"), whole.frames)
        for T_wr, roll, matrix in zip(whole.matrices(), whole.channels[f"roll_{name}"], found, strict=True):
            turned = off @ Rotation.from_rotvec([0.0, roll, 0.0]).as_matrix().T + hub
            expected = turned @ T_wr[:3, :3].T + T_wr[:3, 3]
            assert np.abs(points @ matrix[:3, :3].T + matrix[:3, 3] - expected).max() < 1e-9, name


@pytest.mark.parametrize("kind", ["rotateXYZ", "rotateY", "orient"])
def test_a_wheels_own_keys_are_replaced_with_a_warning(kind, tmp_path):
    """The wheel turns as in an asset whose wheel stands still at its first key."""
    car = vehicle(tmp_path)
    stage = Usd.Stage.Open(str(tmp_path / "mine.usda"))
    prim = UsdGeom.Xformable(stage.GetPrimAtPath("/mine/side_rl/wheel"))
    for set_time in (stage.SetFramesPerSecond, stage.SetTimeCodesPerSecond):
        set_time(24)
    stage.SetStartTimeCode(1001)
    stage.SetEndTimeCode(1013)
    own = prim.GetOrderedXformOps()
    if kind == "rotateXYZ":
        (op,) = [op for op in own if op.GetOpName() == "xformOp:rotateXYZ"]
        keys = [(0, 12, 0), (9, 200, 3), (0, 400, 0)]
    else:
        op = prim.AddRotateYOp() if kind == "rotateY" else prim.AddOrientOp()
        keys = [0.0, 200.0, 400.0]
        prim.SetXformOpOrder([own[0], op, *own[1:]])
    for frame, value in zip((1001, 1007, 1013), keys, strict=True):
        op.Set(value if kind != "orient" else Gf.Quatf(np.cos(value), 0, np.sin(value), 0), frame)
    stage.Save()
    (problem,) = rig_problems(car.rig)
    assert problem.severity == "warning" and f"animation of xformOp:{kind} is replaced" in problem.message

    clip = vehsim.simulate(car, None, [0.0, 0.0], vehsim.State(twist=(0.0, 8.0, 0.0)), 0.5)
    take = Take("shot", {"it": clip}, vehsim.World(), (), Fraction(24), (1001, 1013))
    write_usd(take, tmp_path / "keyed", lambda what, done: None)
    op.GetAttr().Clear()
    op.Set(keys[0] if kind != "orient" else Gf.Quatf(1, 0, 0, 0))
    stage.Save()
    write_usd(take, tmp_path / "still", lambda what, done: None)
    frames = clip.resample().frames
    keyed, still = (Usd.Stage.Open(str(tmp_path / name / "shot.usda")) for name in ("keyed", "still"))
    found, expected = (
        world_matrices(stage.GetPrimAtPath("/shot/vehicles/it/side_rl/wheel"), frames) for stage in (keyed, still)
    )
    assert np.abs(found - expected).max() < 1e-9


def test_a_mirror_above_a_wheel_reverses_its_steering_but_not_its_rolling(tmp_path):
    centre = {"pivot": '"centre"'}
    found = list(rig_problems(vehicle(tmp_path, mirrored=("fr",), steer_fr=centre).rig))
    assert [(problem.key, problem.remedy) for problem in found] == [("channels.steer_fr", "factor = -1")]
    assert "steering to the left is a rotation about the axis up" in found[0].message
    (again := tmp_path / "again").mkdir()
    assert not list(rig_problems(vehicle(again, mirrored=("fr",), steer_fr={"factor": -1} | centre).rig))


def test_a_wheel_that_would_roll_backwards_is_named(tmp_path):
    (problem,) = rig_problems(vehicle(tmp_path, roll_rl={"factor": -1}).rig)
    assert (problem.key, problem.remedy) == ("channels.roll_rl", "factor = 1")
    assert "acts along [0, -1, 0] of the vehicle" in problem.message


def test_a_deactivated_prim_is_named(tmp_path):
    car = vehicle(tmp_path)
    stage = Usd.Stage.Open(str(tmp_path / "mine.usda"))
    stage.GetPrimAtPath("/mine/side_rr/wheel").SetActive(False)
    stage.Save()
    (problem,) = rig_problems(car.rig)
    assert problem.key == "channels.roll_rr"
    assert "prim = 'side_rr/wheel': deactivated in the asset" in problem.message


@pytest.mark.parametrize("kind", ["rotateY", "rotateXYZ", "orient"])
def test_a_wheel_modelled_at_some_roll_steers_upright(kind, tmp_path):
    """Steering and rolling drive the same prim, which was placed at 30 degrees of roll: steering turns the axle in the
    ground's plane, as R_z(steer) R_y(30 + roll) says."""
    stage = Usd.Stage.CreateNew(str(tmp_path / "mine.usda"))
    UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.z)
    UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    stage.SetDefaultPrim(UsdGeom.Xform.Define(stage, "/mine").GetPrim())
    channels = ""
    for name, hub in HUBS.items():
        prim = UsdGeom.Xformable(UsdGeom.Xform.Define(stage, f"/mine/{name}"))
        wheel(stage, f"/mine/{name}/tyre", np.zeros(3))
        prim.AddTranslateOp().Set(hub)
        if kind == "orient":
            prim.AddOrientOp().Set(Gf.Quatf(Gf.Rotation((0, 1, 0), 30).GetQuat()))
        else:
            op = prim.AddRotateYOp() if kind == "rotateY" else prim.AddRotateXYZOp()
            op.Set(30.0 if kind == "rotateY" else (0.0, 30.0, 0.0))
        for channel, op in (("roll", "rotateY"), ("steer", "rotateZ")):
            if channel == "roll" or name.startswith("f"):
                channels += f'[channels.{channel}_{name}]\nprim = "{name}"\nop = "{op}"\n'
    stage.Save()
    (tmp_path / "vehicle.toml").write_text(TOML + channels)
    car = load_vehicle(tmp_path)
    assert list(rig_problems(car.rig)) == []
    clip = vehsim.simulate(car, None, [0.0, 0.2], vehsim.State(twist=(0.0, 8.0, 0.0)), 0.5)
    take = Take("shot", {"it": clip}, vehsim.World(), (), Fraction(24), (1001, 1013))
    write_usd(take, tmp_path / "out", lambda what, done: None)
    stage, whole = Usd.Stage.Open(str(tmp_path / "out/shot.usda")), clip.resample()
    assert np.abs(whole.channels["steer_fl"]).max() > 0.01
    for name in ("fl", "fr"):
        found = world_matrices(stage.GetPrimAtPath(f"/shot/vehicles/it/{name}"), whole.frames)
        for k, (T_wr, T_wp) in enumerate(zip(whole.matrices(), found, strict=True)):
            angles = [whole.channels[f"steer_{name}"][k], whole.channels[f"roll_{name}"][k] + np.radians(30)]
            expected = T_wr[:3, :3] @ Rotation.from_euler("ZY", angles).as_matrix()
            assert np.abs(T_wp[:3, :3] - expected).max() < 1e-6


def test_a_pre_roll_in_a_matrix_warns_of_a_tilted_axis(tmp_path):
    """The matrix has the wheel's place, too, so the steering cannot go before it."""
    vehicle(tmp_path, steer_fl={})
    stage = Usd.Stage.Open(str(tmp_path / "mine.usda"))
    side = UsdGeom.Xformable(stage.GetPrimAtPath("/mine/side_fl"))
    side.AddTransformOp().Set(Gf.Matrix4d(Gf.Rotation((0, 1, 0), 30), Gf.Vec3d(0, 0, 0)))
    stage.Save()
    text = (tmp_path / "vehicle.toml").read_text()
    (tmp_path / "vehicle.toml").write_text(
        text + '[channels.steer_fl]\nprim = "side_fl"\nop = "rotateZ"\npivot = "centre"\n'
    )
    problems = [p for p in rig_problems(load_vehicle(tmp_path).rig) if "steer_fl" in p.key]
    assert [p.severity for p in problems] == ["warning"] and "30 degrees from upright" in str(problems[0])


@pytest.mark.parametrize(("off", "given", "warned"), [(0.12, False, True), (0.12, True, True), (0.01, False, False)])
def test_a_pivot_beside_the_hub_of_a_wheel_warns(off, given, warned, tmp_path):
    """In the asset, or in vehicle.toml: the wheel would rise by twice the distance."""
    at = (2.6 + off, 0.8, 0.4)
    if given:
        car = vehicle(tmp_path, roll_fl={"pivot": list(at)})
    else:
        vehicle(tmp_path)
        stage = Usd.Stage.Open(str(tmp_path / "mine.usda"))
        stage.GetPrimAtPath("/mine/side_fl/wheel").GetAttribute("xformOp:translate:rotatePivot").Set(Gf.Vec3d(*at))
        stage.Save()
        car = load_vehicle(tmp_path)
    problems = list(rig_problems(car.rig))
    assert [problem.severity for problem in problems] == ["warning"] * warned
    if warned:
        assert "0.12 m from the middle of a wheel" in str(problems[0]) and "0.24 m" in str(problems[0])
