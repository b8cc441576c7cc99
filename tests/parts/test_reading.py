"""Reading any asset: units, up axes, pivots, scale, mirrors, nesting, instances, polygons, and named errors."""

from __future__ import annotations

from pathlib import Path

import mujoco
import numpy as np
import pytest
from pxr import Gf, Usd, UsdGeom, UsdPhysics
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

import vehsim.assets
from vehsim.errors import InputError
from vehsim.intake.usd import triangulate
from vehsim.rig.parts import add_to_spec, collision_hulls, read_parts
from vehsim.rig.rig import Rig

VEHICLES = Path(vehsim.assets.__file__).parent / "vehicles"
CUBE = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], float)
QUADS = [[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]]


def new_stage(up: str = "Z", metres: float = 1.0) -> Usd.Stage:
    stage = Usd.Stage.CreateInMemory()
    UsdGeom.SetStageUpAxis(stage, up)
    UsdGeom.SetStageMetersPerUnit(stage, metres)
    stage.SetDefaultPrim(UsdGeom.Xform.Define(stage, "/rig").GetPrim())
    return stage


def add_cube(stage: Usd.Stage, path: str, collides: bool = True, size: float = 1.0) -> UsdGeom.Mesh:
    mesh = UsdGeom.Mesh.Define(stage, path)
    mesh.CreatePointsAttr([Gf.Vec3f(*p) for p in (size * CUBE).tolist()])
    mesh.CreateFaceVertexCountsAttr([4] * 6)
    mesh.CreateFaceVertexIndicesAttr([i for quad in QUADS for i in quad])
    if collides:
        UsdPhysics.CollisionAPI.Apply(mesh.GetPrim())
    return mesh


def saved(stage: Usd.Stage, tmp_path: Path) -> Path:
    stage.GetRootLayer().Export(str(tmp_path / "rig.usda"))
    return tmp_path / "rig.usda"


def world_points(stage: Usd.Stage, path: str) -> np.ndarray:
    """A mesh's points as USD itself computes them."""
    mesh = UsdGeom.Mesh(stage.GetPrimAtPath(path))
    matrix = UsdGeom.XformCache(Usd.TimeCode.EarliestTime()).GetLocalToWorldTransform(mesh.GetPrim())
    return np.array([matrix.Transform(Gf.Vec3d(p)) for p in mesh.GetPointsAttr().Get()])


def in_root(part) -> np.ndarray:
    return part.points @ part.T_rp[:3, :3].T + part.T_rp[:3, 3]


def volume(part) -> float:
    a, b, c = (part.points[part.faces[:, k]] for k in range(3))
    return float(np.einsum("ij,ij->", a, np.cross(b, c)) / 6)


def same_points(a: np.ndarray, b: np.ndarray, tolerance: float) -> bool:
    return bool(max(cKDTree(a).query(b)[0].max(), cKDTree(b).query(a)[0].max()) < tolerance)


@pytest.fixture
def intricate() -> Usd.Stage:
    """Nesting, pivots, non-uniform scale, a mirror, and a mesh with its own transform."""
    stage = new_stage()
    body = UsdGeom.Xform.Define(stage, "/rig/body")
    body.AddTranslateOp().Set((1, 2, 3))
    body.AddRotateXYZOp().Set((20, -35, 50))
    add_cube(stage, "/rig/body/skin").AddTranslateOp().Set((0, 0, 0.5))
    UsdGeom.Xform.Define(stage, "/rig/body/group").AddScaleOp().Set((2, 1, 0.5))
    arm = UsdGeom.Xform.Define(stage, "/rig/body/group/arm")
    arm.AddTranslateOp().Set((4, 0, 0))
    pivot = arm.AddTranslateOp(opSuffix="pivot")
    pivot.Set((0.5, 0.25, 0))
    arm.AddRotateZOp().Set(30)
    arm.AddScaleOp().Set((1, -1, 1))
    arm.AddTranslateOp(opSuffix="pivot", isInverseOp=True)
    add_cube(stage, "/rig/body/group/arm/mesh")
    return stage


def test_geometry_is_where_usd_says(intricate, tmp_path):
    parts = {part.path: part for part in read_parts(saved(intricate, tmp_path))}
    assert list(parts) == ["body", "body/skin", "body/group", "body/group/arm"]
    assert parts["body/group/arm"].parent == "body/group" and parts["body"].parent is None
    for path, mesh in (("body/skin", "/rig/body/skin"), ("body/group/arm", "/rig/body/group/arm/mesh")):
        assert np.allclose(in_root(parts[path]), world_points(intricate, mesh), atol=1e-6)


def test_part_frames_are_rigid_and_chain(intricate, tmp_path):
    parts = {part.path: part for part in read_parts(saved(intricate, tmp_path))}
    for part in parts.values():
        assert np.allclose(part.T_rp[:3, :3] @ part.T_rp[:3, :3].T, np.eye(3), atol=1e-12)
        assert np.linalg.det(part.T_rp[:3, :3]) == pytest.approx(1)
        above = parts[part.parent].T_rp if part.parent else np.eye(4)
        assert np.allclose(above @ part.T_pr, part.T_rp, atol=1e-12)


def test_frame_stands_at_the_pivot(intricate, tmp_path):
    arm = next(part for part in read_parts(saved(intricate, tmp_path)) if part.name == "arm")
    group = UsdGeom.XformCache().GetLocalToWorldTransform(intricate.GetPrimAtPath("/rig/body/group"))
    assert np.allclose(arm.T_rp[:3, 3], group.Transform(Gf.Vec3d(4.5, 0.25, 0)), atol=1e-9)


def test_mirrored_and_left_handed_meshes_face_outward(intricate, tmp_path):
    UsdGeom.Mesh(intricate.GetPrimAtPath("/rig/body/skin")).CreateOrientationAttr("leftHanded")
    indices = [i for quad in QUADS for i in quad[::-1]]
    UsdGeom.Mesh(intricate.GetPrimAtPath("/rig/body/skin")).CreateFaceVertexIndicesAttr(indices)
    volumes = {part.path: volume(part) for part in read_parts(saved(intricate, tmp_path)) if len(part.faces)}
    assert volumes == pytest.approx({"body/skin": 8.0, "body/group/arm": 8.0})


def test_units_and_up_axis_become_metres_z_up(tmp_path):
    stage = new_stage("Y", 0.01)
    UsdGeom.Xform.Define(stage, "/rig/part").AddTranslateOp().Set((100, 200, 300))
    add_cube(stage, "/rig/part/mesh", size=50)
    (part,) = read_parts(saved(stage, tmp_path))
    assert part.T_rp[:3, 3] == pytest.approx([1, -3, 2])
    assert np.ptp(part.points, axis=0) == pytest.approx([1, 1, 1])


def test_transform_of_the_root_prim_is_part_of_the_geometry(tmp_path):
    stage = new_stage()
    UsdGeom.Xform(stage.GetDefaultPrim()).AddScaleOp().Set((0.1, 0.1, 0.1))
    add_cube(stage, "/rig/mesh")
    (part,) = read_parts(saved(stage, tmp_path))
    assert (part.path, part.parent) == ("", None)
    assert np.ptp(in_root(part), axis=0) == pytest.approx([0.2, 0.2, 0.2])


def test_instances_are_read(tmp_path):
    stage = new_stage()
    stage.CreateClassPrim("/wheel")
    add_cube(stage, "/wheel/tyre")
    for k in range(2):
        wheel = UsdGeom.Xform.Define(stage, f"/rig/wheel_{k}")
        wheel.AddTranslateOp().Set((3.0 * k, 0, 0))
        wheel.GetPrim().GetReferences().AddInternalReference("/wheel")
        wheel.GetPrim().SetInstanceable(True)
    parts = read_parts(saved(stage, tmp_path))
    assert [part.path for part in parts] == ["wheel_0", "wheel_1"]
    assert in_root(parts[1])[:, 0].mean() == pytest.approx(3.0)


def test_polygons_become_fans_and_holes_are_left_out():
    counts, indices = np.array([3, 5, 4, 2]), np.arange(14)
    assert triangulate(counts, indices, np.array([2])).tolist() == [[0, 1, 2], [3, 4, 5], [3, 5, 6], [3, 6, 7]]


def test_guides_collide_invisibly_and_hidden_prims_are_left_out(tmp_path):
    stage = new_stage()
    UsdGeom.Xform.Define(stage, "/rig/part")
    add_cube(stage, "/rig/part/look", collides=False)
    add_cube(stage, "/rig/part/hull", size=2).CreatePurposeAttr("guide")
    UsdGeom.Imageable(add_cube(stage, "/rig/part/hidden", size=9)).MakeInvisible()
    off = add_cube(stage, "/rig/part/off", size=9)
    off.CreatePurposeAttr("guide")
    UsdPhysics.CollisionAPI(off.GetPrim()).CreateCollisionEnabledAttr(False)
    (part,) = read_parts(saved(stage, tmp_path))
    assert np.abs(part.points).max() == 1 and [np.abs(hull).max() for hull in part.hulls] == [2]


def test_reset_xform_stack_is_read_where_it_stands_with_a_warning(tmp_path):
    stage = new_stage()
    UsdGeom.Xform.Define(stage, "/rig/body").AddTranslateOp().Set((5, 0, 0))
    loose = UsdGeom.Xform.Define(stage, "/rig/body/loose")
    loose.SetResetXformStack(True)
    loose.AddTranslateOp().Set((0, 1, 0))
    add_cube(stage, "/rig/body/loose/mesh")
    with pytest.warns(UserWarning, match=r"/rig/body/loose: !resetXformStack!"):
        part = read_parts(saved(stage, tmp_path))[-1]
    assert np.allclose(in_root(part), world_points(stage, "/rig/body/loose/mesh"))


def test_simple_shapes_are_parts_as_meshes_are(tmp_path):
    stage = new_stage()
    UsdGeom.Cube.Define(stage, "/rig/body").AddTranslateOp().Set((0, 0, 2))
    wheel = UsdGeom.Xform.Define(stage, "/rig/wheel")
    wheel.AddTranslateOp().Set((1, 0, 0.5))
    tyre = UsdGeom.Cylinder.Define(stage, "/rig/wheel/tyre")
    tyre.CreateAxisAttr("Y")
    tyre.CreateRadiusAttr(0.5)
    tyre.CreateHeightAttr(0.25)
    tyre.CreateDisplayColorAttr([(0.1, 0.2, 0.3)])
    body, wheel = read_parts(saved(stage, tmp_path))
    assert body.path == "body" and np.abs(body.points).max() == 1.0 and np.allclose(body.T_rp[:3, 3], (0, 0, 2))
    assert wheel.path == "wheel" and np.ptp(wheel.points, axis=0) == pytest.approx([1.0, 0.25, 1.0])
    assert wheel.rgba == pytest.approx((0.1, 0.2, 0.3, 1.0))


def test_other_geometry_is_left_out_with_a_warning(tmp_path):
    stage = new_stage()
    add_cube(stage, "/rig/mesh")
    UsdGeom.BasisCurves.Define(stage, "/rig/hair")
    with pytest.warns(UserWarning, match=r"/rig/hair \(BasisCurves\)"):
        read_parts(saved(stage, tmp_path))


def test_without_collision_meshes_the_visible_meshes_are_used_with_a_warning(tmp_path):
    stage = new_stage()
    add_cube(stage, "/rig/mesh", collides=False)
    with pytest.warns(UserWarning, match="CollisionAPI"):
        (hull,) = collision_hulls(saved(stage, tmp_path))
    assert same_points(hull, CUBE, 1e-9)


def test_a_flat_collision_mesh_becomes_a_thin_solid(tmp_path):
    stage = new_stage()
    add_cube(stage, "/rig/mesh").AddScaleOp().Set((1, 1, 1))
    flat = UsdGeom.Mesh(stage.GetPrimAtPath("/rig/mesh"))
    flat.CreatePointsAttr([Gf.Vec3f(x, y, 0) for x, y, _ in CUBE.tolist()])
    (hull,) = collision_hulls(saved(stage, tmp_path))
    assert np.ptp(hull, axis=0) == pytest.approx([2.001, 2.001, 0.001])


def _no_mesh(stage):
    UsdGeom.Xform.Define(stage, "/rig/empty")


def _flat_scale(stage):
    UsdGeom.Xform.Define(stage, "/rig/squashed").AddScaleOp().Set((1, 0, 1))
    add_cube(stage, "/rig/squashed/mesh")


def _scales_that_overflow(stage):
    for path in ("/rig/huge", "/rig/huge/huger"):
        UsdGeom.Xform.Define(stage, path).AddScaleOp(UsdGeom.XformOp.PrecisionDouble).Set(Gf.Vec3d(1e200))
    add_cube(stage, "/rig/huge/huger/mesh")


def _broken_faces(stage):
    add_cube(stage, "/rig/mesh").CreateFaceVertexIndicesAttr([99] * 24)


def _not_finite(stage):
    add_cube(stage, "/rig/mesh").CreatePointsAttr([Gf.Vec3f(float("nan"), 0, 0)] * 8)


@pytest.mark.parametrize(
    ("break_it", "says"),
    [
        (_no_mesh, r"/rig: no mesh"),
        (_flat_scale, r"/rig/squashed: its transform cannot be inverted"),
        (
            _scales_that_overflow,
            r"/rig/huge/huger: its transform is not finite; fix its translation, rotation or scale",
        ),
        (_broken_faces, r"/rig/mesh: its faces do not fit its 8 points"),
        (_not_finite, r"/rig/mesh: points that are not finite"),
    ],
)
@pytest.mark.broken_stages
def test_broken_assets_are_named(break_it, says, tmp_path):
    stage = new_stage()
    break_it(stage)
    with pytest.raises(InputError, match=says) as error:
        read_parts(saved(stage, tmp_path))
    assert "rig.usda" in str(error.value)


@pytest.mark.broken_stages
def test_missing_files_and_prims_are_named(tmp_path):
    with pytest.raises(InputError, match="no such file"):
        read_parts(tmp_path / "nothing.usda")
    (tmp_path / "text.usda").write_text("not usd")
    with pytest.raises(InputError, match="asset: cannot be read"):
        read_parts(tmp_path / "text.usda")
    stage = new_stage()
    add_cube(stage, "/rig/mesh")
    for root in ("/other", "no path!"):
        with pytest.raises(InputError, match=r"no such prim; the file holds /rig"):
            read_parts(saved(stage, tmp_path), root)
    stage.ClearDefaultPrim()
    with pytest.raises(InputError, match="no defaultPrim"):
        read_parts(saved(stage, tmp_path))


@pytest.mark.parametrize("name", ["helicopter", "car"])
def test_mujoco_and_usd_agree_on_every_hull_vertex_through_random_poses(name):
    asset = VEHICLES / name / f"{name}.usdc"
    spec = mujoco.MjSpec()
    add_to_spec(spec, Rig(asset, ""), name)
    model = spec.compile()
    data = mujoco.MjData(model)
    stage = Usd.Stage.Open(str(asset))
    stage.SetEditTarget(stage.GetSessionLayer())  # the asset's own layer is shared within the process
    root = UsdGeom.Xform(stage.GetDefaultPrim())
    guides = [p for p in stage.Traverse() if p.IsA(UsdGeom.Mesh) and UsdGeom.Mesh(p).ComputePurpose() == "guide"]
    assert model.ngeom == len(guides) and (model.nq, model.body(name).mass[0]) == (7, 1.0)
    move, turn = root.AddTranslateOp(), root.AddOrientOp(UsdGeom.XformOp.PrecisionDouble)
    rng = np.random.default_rng(7)
    for _ in range(20):
        position, q = rng.uniform(-50, 50, 3), Rotation.random(random_state=rng).as_quat(scalar_first=True)
        move.Set(Gf.Vec3d(*position))
        turn.Set(Gf.Quatd(*q))
        data.qpos[:3], data.qpos[3:] = position, q
        mujoco.mj_kinematics(model, data)
        assert np.allclose(data.body(name).xpos, position)
        for geom, prim in enumerate(guides):
            first = model.mesh_vertadr[model.geom_dataid[geom]]
            local = model.mesh_vert[first : first + model.mesh_vertnum[model.geom_dataid[geom]]].astype(float)
            seen = data.geom_xpos[geom] + local @ data.geom_xmat[geom].reshape(3, 3).T
            assert same_points(seen, world_points(stage, str(prim.GetPath())), 1e-6), prim.GetPath()


def test_hulls_are_for_queries_only():
    spec = mujoco.MjSpec()
    spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_PLANE, size=[9, 9, 1], pos=[0, 0, 0.5])
    for name in ("a", "b"):
        add_to_spec(spec, Rig(VEHICLES / "car" / "car.usdc", ""), name)
    model = spec.compile()
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    assert data.ncon == 0 and set(model.geom_group[1:]) == {3}
    apart = data.qpos.copy()
    apart[:3] = [0, 0, 10]
    data.qpos[:] = apart
    mujoco.mj_kinematics(model, data)
    a, b = (next(g for g in range(model.ngeom) if model.geom(g).name.startswith(f"{n}/body")) for n in "ab")
    assert 8 < mujoco.mj_geomDistance(model, data, a, b, 100, None) < 10


def test_without_a_free_joint_the_vehicle_stands_still():
    spec = mujoco.MjSpec()
    add_to_spec(spec, Rig(VEHICLES / "car" / "car.usdc", ""), "car", free=False)
    assert spec.compile().nq == 0
