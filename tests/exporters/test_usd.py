"""The usd exporter's files contain the clip's motion, in any asset's units, and can be moved."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest

from vehsim.errors import ExportError
from vehsim.exporters.usd.exporter import write_usd
from vehsim.exporters.usd.readback import world_matrices
from vehsim.rig.rig import Drive


def prim_matrices(stage, path):
    frames = np.arange(stage.GetStartTimeCode(), stage.GetEndTimeCode() + 1)
    return world_matrices(stage.GetPrimAtPath(path), frames if len(frames) > 1 else np.arange(1001.0, 1025.0))


def open_shot(folder):
    from pxr import Usd

    return Usd.Stage.Open(str(folder / "shot.usda"))


def spin(axis, angles):
    from scipy.spatial.transform import Rotation

    matrices = np.tile(np.eye(4), (len(angles), 1, 1))
    matrices[:, :3, :3] = Rotation.from_euler(axis, angles[:, None]).as_matrix()
    return matrices


def translation(x, y, z):
    matrix = np.eye(4)
    matrix[:3, 3] = x, y, z
    return matrix


def test_root_and_spinning_part_stand_where_the_clip_says(tmp_path, toys, make_take):
    clip = toys.clip(toys.asset(tmp_path / "in" / "toy.usdc"))
    write_usd(make_take(clip), tmp_path, toys.silent)
    stage = open_shot(tmp_path)
    assert np.abs(prim_matrices(stage, "/shot/vehicles/toy0") - clip.matrices()).max() < 1e-9
    rotor = clip.matrices() @ translation(0.2, 0, 1.2) @ spin("z", clip.channels["rotor"])
    assert np.abs(prim_matrices(stage, "/shot/vehicles/toy0/rotor") - rotor).max() < 1e-6


def test_rotation_between_frames_has_the_right_direction(tmp_path, toys, make_take):
    """At 400 rad/s, 955 degrees per frame, a quaternion would turn backwards between frames; a scalar does not."""
    clip = toys.clip(toys.asset(tmp_path / "in" / "toy.usdc"))
    clip.channels["rotor"][:] *= 10
    write_usd(make_take(clip), tmp_path, toys.silent)
    stage = open_shot(tmp_path)
    attribute = stage.GetPrimAtPath("/shot/vehicles/toy0/rotor").GetAttribute("xformOp:rotateZ:spin")
    assert attribute.GetTypeName() == "double"
    middle = attribute.Get(1010.5)
    assert middle == pytest.approx(np.degrees(400 * 9.5 / 24), abs=1e-9)


@pytest.mark.parametrize(
    ("metres", "up", "axis"), [(0.01, "Z", "Z"), (1.0, "Y", "Y"), (0.01, "Y", "Y"), (0.0254, "Y", "Y")]
)
def test_assets_in_other_units_arrive_in_metres_and_upright(tmp_path, toys, make_take, metres, up, axis):
    from pxr import Usd, UsdGeom

    clip = toys.clip(toys.asset(tmp_path / "in" / "toy.usda", metres, up), spin_axis=axis)
    write_usd(make_take(clip), tmp_path, toys.silent)
    stage = open_shot(tmp_path)
    rotor = prim_matrices(stage, "/shot/vehicles/toy0/rotor")
    hub = clip.matrices() @ np.array([0.2, 0.0, 1.2, 1.0])
    assert np.abs(rotor[:, :3, 3] - hub[:, :3]).max() < 1e-5
    box = UsdGeom.BBoxCache(Usd.TimeCode(toys.frames[0]), ["default"]).ComputeWorldBound(
        stage.GetPrimAtPath("/shot/vehicles/toy0")
    )
    assert np.allclose(box.ComputeAlignedRange().GetSize(), (4.8, 2.0, 1.35), atol=1e-4)


def test_sliding_channel_is_authored_in_the_assets_units(tmp_path, toys, make_take):
    clip = toys.clip(toys.asset(tmp_path / "in" / "toy.usda", 0.01), drives={"lift": Drive("body", "translateZ")})
    clip.channels["lift"][:] = np.linspace(0, 0.3, len(clip.times))
    write_usd(make_take(clip), tmp_path, toys.silent)
    stage = open_shot(tmp_path)
    origin = (
        clip.matrices() @ np.stack([np.zeros(24), np.zeros(24), 0.5 + clip.channels["lift"], np.ones(24)], 1)[..., None]
    )
    assert np.abs(prim_matrices(stage, "/shot/vehicles/toy0/body")[:, :3, 3] - origin[:, :3, 0]).max() < 1e-5


@pytest.mark.parametrize("axis", "XYZ")
def test_a_part_slides_by_an_op_that_every_usd_knows(tmp_path, toys, make_take, axis):
    """USD has translateX, Y and Z since 25.2; older versions lose the whole transform of a prim that uses them."""
    from pxr import UsdGeom

    clip = toys.clip(toys.asset(tmp_path / "in" / "toy.usda"), drives={"lift": Drive("body", f"translate{axis}")})
    clip.channels["lift"][:] = np.linspace(0, 0.3, len(clip.times))
    write_usd(make_take(clip), tmp_path, toys.silent)
    stage = open_shot(tmp_path)
    body = stage.GetPrimAtPath("/shot/vehicles/toy0/body")
    slide = np.array([body.GetAttribute(f"xformOp:translate:slide{axis}").Get(frame) for frame in range(1001, 1025)])
    np.testing.assert_allclose(slide, np.outer(clip.channels["lift"], np.eye(3)["XYZ".index(axis)]), atol=1e-12)
    ops = {
        op.split(":")[1]
        for prim in stage.Traverse()
        for op in UsdGeom.Xformable(prim).GetXformOpOrderAttr().Get() or ()
    }
    assert ops <= {"translate", "rotateX", "rotateY", "rotateZ", "rotateXYZ", "orient", "scale"}


def test_pivot_scale_and_reset_of_the_asset_are_kept(tmp_path, toys, make_take):
    from pxr import Gf, UsdGeom

    def rig(stage):
        rotor = UsdGeom.Xform(stage.GetPrimAtPath("/toy/rotor"))
        rotor.AddTranslateOp(opSuffix="pivot").Set(Gf.Vec3d(0.3, 0, 0))
        rotor.AddRotateXOp().Set(10.0)
        rotor.AddTranslateOp(opSuffix="pivot", isInverseOp=True)
        rotor.AddScaleOp().Set(Gf.Vec3f(1, 2, 1))

    clip = toys.clip(toys.asset(tmp_path / "in" / "toy.usda", edit=rig))
    write_usd(make_take(clip), tmp_path, toys.silent)
    stage = open_shot(tmp_path)
    prim = stage.GetPrimAtPath("/shot/vehicles/toy0/rotor")
    order = list(UsdGeom.Xformable(prim).GetXformOpOrderAttr().Get())
    assert [name for name in order if "spin" not in name] == [
        "xformOp:translate",
        "xformOp:translate:pivot",
        "xformOp:rotateX",
        "!invert!xformOp:translate:pivot",
        "xformOp:scale",
    ]
    # It turns rigidly about its pivot: the pivot's place is fixed and lengths along the blade do not change.
    pivot = np.linalg.inv(clip.matrices()) @ prim_matrices(stage, prim.GetPath())
    assert np.abs(np.ptp(pivot @ np.array([0.3, 0, 0, 1.0]), axis=0)).max() < 1e-9
    assert np.abs(np.ptp(np.linalg.norm(pivot[:, :3, :3], axis=1), axis=0)).max() < 1e-9


def test_reset_xform_stack_on_a_part_is_kept(tmp_path, toys, make_take):
    from pxr import UsdGeom

    def rig(stage):
        UsdGeom.Xform(stage.GetPrimAtPath("/toy/rotor")).SetResetXformStack(True)

    with pytest.warns(UserWarning, match="resetXformStack"):
        take = make_take(toys.clip(toys.asset(tmp_path / "in" / "toy.usda", edit=rig)))
    write_usd(take, tmp_path, toys.silent)
    stage = open_shot(tmp_path)
    prim = stage.GetPrimAtPath("/shot/vehicles/toy0/rotor")
    assert UsdGeom.Xformable(prim).GetXformOpOrderAttr().Get()[0] == "!resetXformStack!"


def test_ops_of_the_assets_root_are_kept(tmp_path, toys, make_take):
    from pxr import Gf, UsdGeom

    def rig(stage):
        root = UsdGeom.Xform(stage.GetPrimAtPath("/toy"))
        root.AddTranslateOp().Set(Gf.Vec3d(0, 0, 0.25))
        root.AddScaleOp().Set(Gf.Vec3f(2.0))

    clip = toys.clip(toys.asset(tmp_path / "in" / "toy.usda", edit=rig))
    write_usd(make_take(clip), tmp_path, toys.silent)
    own = translation(0, 0, 0.25) @ np.diag([2, 2, 2, 1])
    assert np.abs(prim_matrices(open_shot(tmp_path), "/shot/vehicles/toy0") - clip.matrices() @ own).max() < 1e-9


def instanced_rotor(tmp_path, toys):
    from pxr import Usd, UsdGeom

    inner = toys.asset(tmp_path / "in" / "inner.usda")
    outer = tmp_path / "in" / "outer.usda"
    stage = Usd.Stage.CreateNew(str(outer))
    UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    UsdGeom.SetStageUpAxis(stage, "Z")
    stage.SetDefaultPrim(UsdGeom.Xform.Define(stage, "/car").GetPrim())
    chassis = stage.DefinePrim("/car/chassis", "Xform")
    chassis.GetReferences().AddReference("./inner.usda")
    chassis.SetInstanceable(True)
    stage.GetRootLayer().Save()
    clip = toys.clip(outer, drives={"rotor": Drive("chassis/rotor", "rotateZ")})
    assert inner.is_file()
    return clip


def test_a_part_inside_an_instance_moves(tmp_path, toys, make_take):
    """USD ignores an over below an instance, so the layer makes the prim no longer an instance."""
    write_usd(make_take(instanced_rotor(tmp_path, toys)), tmp_path / "out", toys.silent)
    stage = open_shot(tmp_path / "out")
    assert not stage.GetPrimAtPath("/shot/vehicles/toy0/chassis").IsInstance()
    turned = prim_matrices(stage, "/shot/vehicles/toy0/chassis/rotor")
    assert np.abs(turned[0] - turned[5]).max() > 0.1


def test_a_hidden_opinion_is_an_error(tmp_path, toys, make_take, monkeypatch):
    """If it stayed an instance, the rotor would stand still in all other software."""
    monkeypatch.setattr("vehsim.exporters.usd.animation.instances_above", lambda root, prim: [])
    clip = instanced_rotor(tmp_path, toys)
    with pytest.raises(ExportError, match=r"/shot/vehicles/toy0/chassis/rotor: at frame 1002"):
        write_usd(make_take(clip), tmp_path / "out", toys.silent)
    shutil.rmtree(tmp_path / "out")


def test_only_moving_ops_are_sampled(tmp_path, toys, make_take):
    from pxr import Sdf

    clip = toys.clip(toys.asset(tmp_path / "in" / "toy.usda"), still=True)
    write_usd(make_take(clip), tmp_path, toys.silent)
    layer = Sdf.Layer.FindOrOpen(str(tmp_path / "layers" / "toy0.anim.usdc"))
    paths = []
    layer.Traverse("/", paths.append)
    assert not [path for path in paths if layer.GetNumTimeSamplesForPath(path)]
    assert layer.GetPrimAtPath("/toy0/rotor") is None


def test_animation_layer_works_sublayered_and_referenced(tmp_path, toys, make_take):
    from pxr import Usd, UsdGeom

    clip = toys.clip(toys.asset(tmp_path / "in" / "toy.usda"))
    write_usd(make_take(clip), tmp_path, toys.silent)
    anim = tmp_path / "layers" / "toy0.anim.usdc"
    sublayered = Usd.Stage.CreateInMemory()
    sublayered.GetRootLayer().subLayerPaths.append(str(anim))
    referenced = Usd.Stage.CreateInMemory()
    UsdGeom.Xform.Define(referenced, "/elsewhere/it").GetPrim().GetReferences().AddReference(str(anim))
    a = prim_matrices(sublayered, "/toy0/rotor")
    b = prim_matrices(referenced, "/elsewhere/it/rotor")
    assert np.abs(a - b).max() < 1e-12
    assert np.abs(a[:, :3, 3] - (clip.matrices() @ [0.2, 0, 1.2, 1])[:, :3]).max() < 1e-9


def test_the_delivery_can_be_moved(tmp_path, toys, make_take):
    from pxr import UsdUtils

    clip = toys.clip(toys.asset(tmp_path / "in" / "toy.usda"))
    write_usd(make_take(clip), tmp_path / "out", toys.silent)
    shutil.move(tmp_path / "out", tmp_path / "moved")
    shutil.rmtree(tmp_path / "in")
    layers, assets, missing = UsdUtils.ComputeAllDependencies(str(tmp_path / "moved" / "shot.usda"))
    assert not missing
    inside = [Path(layer.realPath) for layer in layers] + [Path(str(asset)) for asset in assets]
    assert len(inside) >= 5
    assert all(path.is_relative_to(tmp_path / "moved") for path in inside)


def test_the_same_take_gives_the_same_bytes(tmp_path, toys, make_take):
    clip = toys.clip(toys.asset(tmp_path / "in" / "toy.usda"))
    for folder in ("a", "b"):
        write_usd(make_take(clip), tmp_path / folder, toys.silent)
    files = sorted(path.relative_to(tmp_path / "a") for path in (tmp_path / "a").rglob("*") if path.is_file())
    assert files
    for file in files:
        assert (tmp_path / "a" / file).read_bytes() == (tmp_path / "b" / file).read_bytes(), file


def test_the_stage_has_model_metadata(tmp_path, toys, make_take):
    from pxr import Usd, UsdGeom, UsdLux

    clip = toys.clip(toys.asset(tmp_path / "in" / "toy.usda"))
    marks = {"toy0": [{"frame": 1001, "position": (0, 0, 6)}]}
    write_usd(make_take(clip, report={"marks": marks}), tmp_path, toys.silent)
    stage = open_shot(tmp_path)
    assert (UsdGeom.GetStageMetersPerUnit(stage), UsdGeom.GetStageUpAxis(stage)) == (1.0, "Z")
    assert (stage.GetStartTimeCode(), stage.GetEndTimeCode()) == toys.frames
    assert stage.GetTimeCodesPerSecond() == stage.GetFramesPerSecond() == 24
    assert stage.GetDefaultPrim().GetPath() == "/shot"
    assert Usd.ModelAPI(stage.GetPrimAtPath("/shot")).GetKind() == "assembly"
    assert stage.GetPrimAtPath("/shot/vehicles/toy0").IsModel()
    lens = UsdGeom.Camera(stage.GetPrimAtPath("/shot/cameras/chase"))
    assert lens.GetFocalLengthAttr().Get() == pytest.approx(0.35)
    assert lens.GetHorizontalApertureAttr().Get() == pytest.approx(0.36)
    for guide in ("toy0_path", "toy0_marks"):
        imageable = UsdGeom.Imageable(stage.GetPrimAtPath(f"/shot/guides/{guide}"))
        assert imageable.ComputePurpose() == "guide"
    assert stage.GetPrimAtPath("/shot/lights/sun").IsA(UsdLux.DistantLight)


def test_not_a_number_is_refused_with_prim_and_frame(tmp_path, toys, make_take):
    clip = toys.clip(toys.asset(tmp_path / "in" / "toy.usda"))
    take = make_take(clip)
    clip.channels["rotor"][7] = np.nan
    with pytest.raises(ExportError, match=r"toy0\.rotor: not a finite number at frame 1008"):
        write_usd(take, tmp_path / "out", toys.silent)


@pytest.mark.broken_stages
def test_a_channel_on_a_missing_prim_lists_the_existing_ones(tmp_path, toys, make_take):
    clip = toys.clip(toys.asset(tmp_path / "in" / "toy.usda"), drives={"rotor": Drive("propeller", "rotateZ")})
    with pytest.raises(ExportError, match=r"propeller.*choose one of body, rotor"):
        write_usd(make_take(clip), tmp_path / "out", toys.silent)
