"""The shipped vehicles: valid USD, real dimensions, faces outward, and hulls that contain everything visible."""

from __future__ import annotations

import importlib
import math
from dataclasses import replace
from pathlib import Path

import casadi as ca
import mujoco
import numpy as np
import pytest
import trimesh
from pxr import Gf, Usd, UsdGeom, UsdShade, UsdValidation
from scipy.spatial import ConvexHull, cKDTree

import vehsim
import vehsim.assets
from vehsim.assets.generate import _shapes
from vehsim.assets.generate._usd import write_asset
from vehsim.rig.parts import Part, add_to_spec, collision_hulls, read_parts
from vehsim.rig.rig import Rig
from vehsim.vehicles.library.library import available

VEHICLES = Path(vehsim.assets.__file__).parent / "vehicles"
LEG = {
    end: [
        f"wheel_{end[0]}l",
        f"wheel_{end[0]}r",
        f"leg_{end}",
        f"leg_{end}/shin_{end}",
        f"leg_{end}/shin_{end}/thigh_{end}",
    ]
    for end in ("front", "rear")
}
PARTS = {
    "helicopter": {"fuselage", "main_rotor", "tail_rotor", *(f"main_rotor/blade_{k}" for k in (1, 2, 3))},
    "car": {"body", "wheel_rl", "wheel_rr", "steer_fl", "steer_fr", "steer_fl/wheel_fl", "steer_fr/wheel_fr"},
    "boat": {"hull", "outboard", "outboard/propeller"},
    "two_wheeled": {"body", "wheel_left", "wheel_right"},
    "tumbler": {"handle"},
    "truck": {"tractor", "wheel_rl", "wheel_rr", "steer_fl", "steer_fr", "steer_fl/wheel_fl", "steer_fr/wheel_fr"}
    | {f"trailer_1{below}" for below in ("", "/wheel_t1_l", "/wheel_t1_r")},
    "hopper": {"body", "leg", "leg/shin", "leg/foot"},
    "snakeboard": {"board", "pelvis", "torso", "torso/head"}
    | {f"truck_{end}{below}" for end in ("front", "rear") for below in ("", *(f"/{part}" for part in LEG[end]))},
}
TRIANGLES = (8000, 33000)
"""Minimum and maximum number of triangles of a vehicle's look."""
CARRIED = ("main_rotor/blade_",)
"""Parts without hulls of their own, which those of the part that carries them contain."""
CONED = (0.0, 5.53)
"""Coning of the blades without load and at the most that the rotor gives, degrees."""
STEERED = {"car": {"steer_fl": 40, "steer_fr": 40}, "truck": {"steer_fl": 40, "steer_fr": 40}, "boat": {"outboard": 30}}
"""Part -> degrees to either side: hulls do not move, so they contain steered parts at every angle."""
LOWEST = {"boat": -0.8401, "tumbler": -0.0221, "hopper": -0.9}
"""The lowest point, m, of vehicles that do not stand on the ground."""
WHEELS = [
    ("car", "wheel_rl"),
    ("car", "steer_fr/wheel_fr"),
    ("truck", "wheel_rl"),
    ("truck", "steer_fr/wheel_fr"),
    ("two_wheeled", "wheel_left"),
    ("two_wheeled", "wheel_right"),
    ("snakeboard", "truck_front/wheel_fl"),
]
LIVERIES = ["car", "helicopter", "boat", "two_wheeled", "snakeboard", "tumbler"]
every = pytest.mark.parametrize("name", list(PARTS))


def asset(name: str) -> Path:
    return VEHICLES / name / f"{name}.usdc"


def meshes(stage: Usd.Stage, guides: bool) -> list[UsdGeom.Mesh]:
    every = [UsdGeom.Mesh(prim) for prim in stage.Traverse() if prim.IsA(UsdGeom.Mesh)]
    return [mesh for mesh in every if (mesh.ComputePurpose() == UsdGeom.Tokens.guide) == guides]


def part(name: str, path: str) -> Part:
    return next(p for p in read_parts(asset(name)) if p.path == path)


def in_root(p: Part) -> np.ndarray:
    return p.points @ p.T_rp[:3, :3].T + p.T_rp[:3, 3]


def physics(name: str) -> dict:
    return importlib.import_module("tomllib").loads((VEHICLES / name / "vehicle.toml").read_text())["physics"]


def coned(degrees: float) -> list[Part]:
    """The rotor's blades at a coning of so many degrees, in frames at their hinges."""
    up = rotation(0, math.radians(degrees) - physics("helicopter")["blades_up"])
    return [replace(p, points=p.points @ up.T) for p in read_parts(asset("helicopter")) if p.path.startswith(CARRIED)]


def steered(name: str) -> np.ndarray:
    """The points (n, 3) of the steered parts, at full lock to either side, and of coned blades, in the root's frame,
    also halfway between each other."""
    points = [np.zeros((0, 3))]
    if name == "helicopter":
        hub, between = part(name, "main_rotor").T_rp[:3, 3], rotation(2, math.pi / 3)
        blades = np.concatenate([in_root(p) for degrees in CONED for p in coned(degrees)])
        points += [blades, (blades - hub) @ between.T + hub]
    for path, limit in STEERED.get(name, {}).items():
        pivot = part(name, path).T_rp[:3, 3]
        riding = [in_root(p) for p in read_parts(asset(name)) if f"{p.path}/".startswith(f"{path}/")]
        for angle in np.radians([-limit, limit]):
            points.append((np.concatenate(riding) - pivot) @ rotation(2, angle).T + pivot)
    return np.concatenate(points)


def rig(name: str) -> Rig:
    found = vehsim.load_vehicle(name).rig
    assert found is not None
    return found


def outside(points: np.ndarray, hulls: list[np.ndarray]) -> np.ndarray:
    """How far each point (n, 3) is outside the union of convex hulls, m; not positive inside."""
    planes = [ConvexHull(hull).equations for hull in hulls]
    return np.min([(points @ p[:, :3].T + p[:, 3]).max(1) for p in planes], axis=0)


def rotation(axis: int, angle: float) -> np.ndarray:
    i, j = [(1, 2), (2, 0), (0, 1)][axis]
    turn = np.eye(3)
    turn[i, i] = turn[j, j] = math.cos(angle)
    turn[i, j], turn[j, i] = -math.sin(angle), math.sin(angle)
    return turn


@every
def test_no_usd_validator_finds_an_issue(name):
    validators = UsdValidation.ValidationRegistry().GetOrLoadAllValidators()
    assert len(validators) > 20
    found = UsdValidation.ValidationContext(validators).Validate(Usd.Stage.Open(str(asset(name))))
    assert [error.GetErrorAsString() for error in found] == []


@every
def test_stage_metadata_is_complete(name):
    stage = Usd.Stage.Open(str(asset(name)))
    root = stage.GetDefaultPrim()
    assert (UsdGeom.GetStageMetersPerUnit(stage), UsdGeom.GetStageUpAxis(stage)) == (1.0, "Z")
    assert stage.HasAuthoredMetadata("metersPerUnit") and stage.HasAuthoredMetadata("upAxis")
    assert (root.GetName(), Usd.ModelAPI(root).GetKind(), Usd.ModelAPI(root).GetAssetName()) == (
        name,
        "component",
        name,
    )
    assert asset(name).stat().st_size < 2e6


@every
def test_meshes_are_polygonal_with_unit_normals_that_agree_with_their_faces(name):
    stage = Usd.Stage.Open(str(asset(name)))
    for mesh in meshes(stage, guides=False):
        assert mesh.GetSubdivisionSchemeAttr().Get() == "none"
        points, normals = np.array(mesh.GetPointsAttr().Get(), float), np.array(mesh.GetNormalsAttr().Get(), float)
        faces = np.array(mesh.GetFaceVertexIndicesAttr().Get()).reshape(-1, 3)
        assert np.allclose(np.linalg.norm(normals, axis=1), 1, atol=1e-5)
        a, b, c = (points[faces[:, k]] for k in range(3))
        cross = np.cross(b - a, c - a)
        area = np.linalg.norm(cross, axis=1)
        along = np.einsum("ij,ij->i", cross, normals[faces].mean(1))
        assert area[along <= 0].sum() < 1e-4 * area.sum(), mesh.GetPath()
        assert np.allclose(mesh.GetExtentAttr().Get(), [points.min(0), points.max(0)])


@every
def test_mesh_names_are_unique_and_begin_with_their_part(name):
    stage = Usd.Stage.Open(str(asset(name)))
    prims = [mesh.GetPrim() for guides in (True, False) for mesh in meshes(stage, guides)]
    names = [prim.GetName() for prim in prims]
    assert len(set(names)) == len(names)
    assert all(prim.GetName().startswith(prim.GetParent().GetName()) for prim in prims)


@every
def test_parts_and_triangles(name):
    parts = read_parts(asset(name))
    assert {p.path for p in parts} == PARTS[name]
    assert TRIANGLES[0] <= sum(len(p.faces) for p in parts) <= TRIANGLES[1]
    assert all(p.collides for p in parts if len(p.faces) and not p.path.startswith(CARRIED))


@pytest.mark.parametrize("name", available())
def test_asset_becomes_a_mujoco_body(name):
    spec = mujoco.MjSpec()
    add_to_spec(spec, rig(name), name)
    model = spec.compile()
    hulls = collision_hulls(rig(name).asset)
    assert (model.nbody, model.ngeom) == (2, len(hulls))
    data = mujoco.MjData(model)
    data.qpos[:3] = [1.0, 2.0, 3.0]
    mujoco.mj_kinematics(model, data)
    for k, hull in enumerate(hulls):
        mesh = model.geom_dataid[k]
        first, count = model.mesh_vertadr[mesh], model.mesh_vertnum[mesh]
        points = model.mesh_vert[first : first + count] @ data.geom_xmat[k].reshape(3, 3).T + data.geom_xpos[k]
        moved = hull + data.qpos[:3]
        assert np.allclose([points.min(0), points.max(0)], [moved.min(0), moved.max(0)], atol=1e-5)


@every
def test_parts_face_outward(name):
    for p in read_parts(asset(name)):
        if len(p.faces):
            a, b, c = (p.points[p.faces[:, k]] for k in range(3))
            assert np.einsum("ij,ij->", a, np.cross(b, c)) > 0, p.path


@every
def test_hulls_contain_every_visible_triangle(name):
    hulls = collision_hulls(asset(name))
    for p in read_parts(asset(name)):
        corners = in_root(p)[p.faces]
        for sample in (corners.reshape(-1, 3), corners.mean(1), corners[:, :2].mean(1), corners[:, 1:].mean(1)):
            if len(sample):
                assert outside(sample, hulls).max() < 1e-3, p.path


@every
def test_hulls_are_at_most_a_hands_width_too_large(name):
    hulls = collision_hulls(asset(name))
    seen = np.concatenate([in_root(p) for p in read_parts(asset(name))] + [steered(name)])
    rng = np.random.default_rng(3)
    for direction in (d / np.linalg.norm(d) for d in rng.normal(size=(500, 3))):
        excess = max((hull @ direction).max() for hull in hulls) - (seen @ direction).max()
        assert -1e-3 < excess < 0.12
    assert min(hull[:, 2].min() for hull in hulls) == pytest.approx(LOWEST.get(name, 0.0), abs=2e-3)


@pytest.mark.parametrize(("path", "axis"), [("main_rotor", 2), ("tail_rotor", 1)])
def test_rotor_disc_holds_the_blades_at_every_angle_and_coning(path, axis):
    rotor = part("helicopter", path)
    shapes = [rotor.points]
    for degrees in np.linspace(*CONED, 9) if path == "main_rotor" else ():
        shapes += [p.points @ p.T_pr[:3, :3].T + p.T_pr[:3, 3] for p in coned(degrees)]
    for angle in np.linspace(0, 2 * np.pi, 17):
        assert outside(np.concatenate(shapes) @ rotation(axis, angle).T, list(rotor.hulls)).max() < 1e-6


def test_no_thrust_of_the_helicopter_cones_its_blades_further_than_their_hull():
    """Whatever its character: stunts have the whole range of the collective."""
    heli = vehsim.load_vehicle("helicopter")
    (collective,) = (control for control in heli.controls if control.name == "collective")
    c = ca.SX.sym("c", 4)
    law = ca.Function("law", [c], [heli.channels["coning_1"].value(0, c, c, c, c) + physics("helicopter")["blades_up"]])
    thrusts = np.linspace(collective.lower, collective.upper, 9)
    coned = np.degrees([float(law([thrust, 0, 0, 0])) for thrust in thrusts])
    assert coned.min() == pytest.approx(CONED[0], abs=1e-6) and coned.max() == pytest.approx(CONED[1], abs=5e-3)


@pytest.mark.parametrize(
    ("path", "spin", "axis", "thrust"),
    [("main_rotor/blade_1", [0, 0, 1], [0, 1, 0], 1), ("tail_rotor", [0, 1, 0], [0, 0, 1], -1)],
)
def test_blades_lead_with_their_nose_and_lift_the_right_way(path, spin, axis, thrust):
    stage = Usd.Stage.Open(str(asset("helicopter")))
    mesh = UsdGeom.Mesh(stage.GetPrimAtPath(f"/helicopter/{path}/{path.rpartition('/')[2]}_blade"))
    points = np.array(mesh.GetPointsAttr().Get(), float)
    forward = np.cross(spin, axis)  # the direction in which a point of this blade moves
    blade = points[(points @ axis > 0.4 * (points @ axis).max()) & (np.abs(points @ forward) < 0.4)]
    ahead = blade @ forward
    assert 2.5 < -ahead.min() / ahead.max() < 3.5  # the nose is a quarter chord ahead of the axis
    nose, tail = blade[ahead > 0.8 * ahead.max()] @ spin, blade[ahead < 0.8 * ahead.min()] @ spin
    assert thrust * (nose.mean() - tail.mean()) > 0.005


def test_wheel_hull_holds_the_wheel_at_every_steering_angle():
    vehicle = vehsim.load_vehicle("car")
    limit = math.atan2(0.7, 1 - 0.77 / 2.6 * 0.7)  # Ackermann: the inner wheel turns further
    assert vehicle.joint_limits["sigma"] == (-0.7, 0.7)
    wheel = part("car", "steer_fl/wheel_fl")
    for angle in np.linspace(-limit, limit, 9):
        assert outside(wheel.points @ rotation(2, angle).T, list(wheel.hulls)).max() < 1e-3


def test_helicopter_has_real_dimensions():
    blades, body = [part("helicopter", f"main_rotor/blade_{k}") for k in (1, 2, 3)], part("helicopter", "fuselage")
    assert all(2 * np.linalg.norm(in_root(p)[:, :2], axis=1).max() == pytest.approx(10.7, abs=0.02) for p in blades)
    assert np.ptp(in_root(body)[:, 0]) == pytest.approx(10.9, abs=0.15)
    assert in_root(body)[:, 2].min() == pytest.approx(0.0, abs=2e-3)
    assert np.ptp(part("helicopter", "tail_rotor").points[:, 2]) == pytest.approx(1.86, abs=0.01)


def test_helicopter_physics_matches_its_rig():
    hub, tail = part("helicopter", "main_rotor").T_rp[:3, 3], part("helicopter", "tail_rotor").T_rp[:3, 3]
    toml = importlib.import_module("tomllib").loads((VEHICLES / "helicopter" / "vehicle.toml").read_text())
    assert hub - rig("helicopter").origin == pytest.approx([0, 0, toml["physics"]["d_t"]])
    assert tail[0] == pytest.approx(-toml["physics"]["d_r"])
    flat = np.concatenate([p.points for p in coned(0.0)])
    outer = flat[(flat[:, 1] > 4.5) & (np.abs(flat[:, 0]) < 0.3)]
    assert (outer[:, 2].min() + outer[:, 2].max()) / 2 == pytest.approx(0.0, abs=0.01)
    assert toml["controls"]["collective"]["scale"] == pytest.approx(9.81 * toml["physics"]["mass"], rel=1e-3)


def test_car_has_real_dimensions_and_its_wheels_stand_where_the_physics_says():
    toml = importlib.import_module("tomllib").loads((VEHICLES / "car" / "vehicle.toml").read_text())["physics"]
    seen = np.concatenate([in_root(p) for p in read_parts(asset("car"))])
    assert np.ptp(seen, axis=0) == pytest.approx([4.3, 2.05, 1.38], abs=0.05)
    front, rear = part("car", "steer_fl"), part("car", "wheel_rl")
    assert front.T_rp[0, 3] - rear.T_rp[0, 3] == pytest.approx(toml["wheelbase"])
    assert rear.T_rp[1, 3] == pytest.approx(toml["half_track"])
    assert rear.T_rp[2, 3] == pytest.approx(toml["wheel_radius"])
    assert np.hypot(*rear.points[:, [0, 2]].T).max() == pytest.approx(toml["wheel_radius"], abs=1e-4)
    assert rig("car").origin[0] == pytest.approx(rear.T_rp[0, 3])


@every
def test_proxies_stand_for_the_look_with_far_fewer_triangles(name):
    """Their corners are corners of the look, with its material, and the look of a part is near its proxies."""
    import igl

    stage = Usd.Stage.Open(str(asset(name)))
    parts: dict = {}
    for mesh in meshes(stage, guides=False):
        points = np.array(mesh.GetPointsAttr().Get(), float)
        faces = np.array(mesh.GetFaceVertexIndicesAttr().Get(), np.int64).reshape(-1, 3)
        parts.setdefault(mesh.GetPrim().GetParent().GetPath(), {"render": [], "proxy": []})[
            mesh.ComputePurpose()
        ].append((points, faces))
        for target in mesh.GetProxyPrimRel().GetTargets():
            proxy = UsdGeom.Mesh(stage.GetPrimAtPath(target))
            one, other = (UsdShade.MaterialBindingAPI(m.GetPrim()).ComputeBoundMaterial()[0] for m in (mesh, proxy))
            assert one.GetPath() == other.GetPath() and proxy.ComputePurpose() == UsdGeom.Tokens.proxy
            assert cKDTree(points).query(np.array(proxy.GetPointsAttr().Get()))[0].max() < 1e-6
    count = {k: sum(len(faces) for part in parts.values() for _, faces in part[k]) for k in ("render", "proxy")}
    assert 0 < count["proxy"] < 0.37 * count["render"]
    for path, part in parts.items():
        ends = np.cumsum([0, *(len(points) for points, _ in part["proxy"])])
        skin = np.concatenate([points for points, _ in part["proxy"]])
        faces = np.concatenate([faces + end for (_, faces), end in zip(part["proxy"], ends, strict=False)])
        look = np.concatenate([points for points, _ in part["render"]])
        away = np.sqrt(igl.point_mesh_squared_distance(look, skin, faces)[0])
        assert away.max() < 0.08 and np.percentile(away, 95) < 0.04, path


@pytest.mark.parametrize("name", available())
def test_channels_drive_prims_that_exist(name):
    paths = {p.path for p in read_parts(rig(name).asset)}
    assert bool(rig(name).drives) == bool(vehsim.load_vehicle(name).channels)
    assert {drive.prim for drive in rig(name).drives.values()} <= paths


@every
def test_the_script_generates_the_committed_asset(name, tmp_path, monkeypatch):
    """With noise of 1e-15 in every surface: another CPU differs in these digits and must write the same asset."""
    rng = np.random.default_rng(0)

    def disturb(surface):
        for key in ("points", "normals"):
            exact = getattr(surface, key)
            noise = exact * 1e-15 * rng.normal(size=exact.shape) + 1e-17 * rng.normal(size=exact.shape)
            object.__setattr__(surface, key, exact + noise)

    monkeypatch.setattr(_shapes.Surface, "__post_init__", disturb, raising=False)
    script = importlib.import_module(f"vehsim.assets.generate.{name}")
    variants = [getattr(script, given, {}) for given in ("LIVERIES", "ABSENT")]
    write_asset(tmp_path / f"{name}.usdc", script.build(), script.MATERIALS, script.DOC, *variants)
    fresh, committed = read_parts(tmp_path / f"{name}.usdc"), read_parts(asset(name))
    assert [p.path for p in fresh] == [p.path for p in committed]
    for new, old in zip(fresh, committed, strict=True):
        assert np.array_equal(new.faces, old.faces), new.path
        assert np.allclose(new.points, old.points, rtol=0, atol=1e-6), new.path
        assert all(np.allclose(a, b, rtol=0, atol=1e-6) for a, b in zip(new.hulls, old.hulls, strict=True)), new.path


@pytest.mark.parametrize("name", LIVERIES)
def test_liveries_change_only_the_look(name):
    stage = Usd.Stage.Open(str(asset(name)))
    liveries = stage.GetDefaultPrim().GetVariantSet("livery")
    seen = {}
    for choice in liveries.GetVariantNames():
        liveries.SetVariantSelection(choice)
        materials = [p for p in stage.Traverse() if p.GetTypeName() == "Material"]
        assert all(prim.GetChildren()[0].GetAttribute("inputs:diffuseColor").Get() for prim in materials)
        seen[choice] = [tuple(mesh.GetDisplayColorAttr().Get()[0]) for mesh in meshes(stage, guides=False)]
    one, other = seen.values()
    changed = [a != b for a, b in zip(one, other, strict=True)]
    assert any(changed) and not all(changed)
    assert len(read_parts(asset(name))) == len(PARTS[name])


@pytest.mark.parametrize("name", ["boat", "car", "helicopter"])
def test_the_driver_can_be_left_out(name):
    """The variant set `driver`: `none` leaves out only the figure; collision meshes stay."""
    stage = Usd.Stage.Open(str(asset(name)))
    choice = stage.GetDefaultPrim().GetVariantSet("driver")
    assert choice.GetVariantSelection() == "aboard"
    seen = {}
    for variant in ("aboard", "none"):
        choice.SetVariantSelection(variant)
        seen[variant] = {mesh.GetPrim().GetName() for guides in (True, False) for mesh in meshes(stage, guides)}
    left_out = seen["aboard"] - seen["none"]
    assert seen["none"] < seen["aboard"] and len(left_out) > 8
    assert all("_driver_" in gone for gone in left_out) and not any("_driver_" in kept for kept in seen["none"])


@pytest.mark.parametrize(
    ("name", "eyes"),
    [
        ("car", [(6.0, 0.4, 1.5), (-0.1, 5.0, 1.3), (6.0, 1.6, 1.6)]),
        ("helicopter", [(8.0, -0.6, 2.0), (1.6, -6.0, 1.8)]),
    ],
)
def test_the_driver_is_visible_through_the_glass(name, eyes):
    """From in front and from the side, only glass is between the eye and the driver's face."""
    stage = Usd.Stage.Open(str(asset(name)))
    glass = stage.GetPrimAtPath(f"/{name}/materials/glass/surface")
    assert 0.1 < glass.GetAttribute("inputs:opacity").Get() < 0.5
    looks = [mesh for mesh in meshes(stage, guides=False) if mesh.ComputePurpose() == UsdGeom.Tokens.render]
    shown = {mesh.GetPrim().GetName(): mesh for mesh in looks}
    body = [
        mesh for key, mesh in shown.items() if key.startswith(("body_", "fuselage_")) and not key.endswith("_glass")
    ]
    of, triangles = [], []
    for mesh in body:
        points, faces = np.array(mesh.GetPointsAttr().Get(), float), np.array(mesh.GetFaceVertexIndicesAttr().Get())
        triangles.append(points[faces.reshape(-1, 3)])
        of += [mesh.GetPrim().GetName()] * len(triangles[-1])
    soup = np.concatenate(triangles)
    face = np.concatenate(
        [t.reshape(-1, 3) for t, m in zip(triangles, body, strict=True) if "goggles" in str(m.GetPath())]
    )
    for eye in np.array(eyes):
        assert "driver" in of[first_hit(soup, eye, face.mean(0) - eye)], eye


def first_hit(triangles: np.ndarray, eye: np.ndarray, way: np.ndarray) -> int:
    """The nearest of ``triangles`` (n, 3, 3) that a ray meets (Moeller and Trumbore, 1997)."""
    a, ab, ac = triangles[:, 0], triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0]
    across = np.cross(way, ac)
    volume = np.einsum("ij,ij->i", ab, across)
    volume = np.where(np.abs(volume) < 1e-12, np.inf, volume)
    u = np.einsum("ij,ij->i", eye - a, across) / volume
    turned = np.cross(eye - a, ab)
    v, distance = turned @ way / volume, np.einsum("ij,ij->i", ac, turned) / volume
    met = (u >= 0) & (v >= 0) & (u + v <= 1) & (distance > 0)
    return int(np.where(met, distance, np.inf).argmin())


def test_boat_hull_is_closed_and_displaces_the_boats_mass_where_its_centre_of_mass_is():
    toml = importlib.import_module("tomllib").loads((VEHICLES / "boat" / "vehicle.toml").read_text())
    stage = Usd.Stage.Open(str(asset("boat")))
    mesh = UsdGeom.Mesh(stage.GetPrimAtPath("/boat/hull/hull"))
    assert mesh.GetPurposeAttr().Get() == UsdGeom.Tokens.guide
    hull = trimesh.Trimesh(mesh.GetPointsAttr().Get(), np.reshape(mesh.GetFaceVertexIndicesAttr().Get(), (-1, 3)))
    assert hull.is_watertight and hull.is_winding_consistent and hull.volume > 0
    assert np.allclose(hull.center_mass[1], 0, atol=1e-6)
    # left open at z = 0, where a lid would add nothing to the integrals
    below = trimesh.intersections.slice_mesh_plane(hull, [0, 0, -1], [0, 0, 0])
    assert 1025 * below.volume == pytest.approx(toml["physics"]["mass"], rel=0.01)
    assert below.center_mass[0] == pytest.approx(toml["origin"][0], abs=0.01)


def test_boats_propeller_screws_ahead_when_it_turns_about_its_shaft():
    points, faces = part("boat", "outboard/propeller").points, part("boat", "outboard/propeller").faces
    centre = points[faces].mean(1)
    a, b, c = (points[faces[:, k]] for k in range(3))
    normal, radius = np.cross(b - a, c - a), np.hypot(centre[:, 1], centre[:, 2])
    aft = (normal[:, 0] < 0) & (radius > 0.08)  # the faces that push the water astern
    velocity = np.cross([1.0, 0.0, 0.0], centre)
    assert np.einsum("ij,ij->i", normal[aft], velocity[aft]).sum() > 0
    assert np.ptp(points, axis=0)[1:] == pytest.approx([0.38, 0.38], rel=0.15)


@pytest.mark.parametrize(("name", "path"), WHEELS)
def test_wheels_carry_a_mark_that_shows_rotation(name, path):
    stage = Usd.Stage.Open(str(asset(name)))
    mesh = UsdGeom.Mesh(stage.GetPrimAtPath(f"/{name}/{path}/{path.rpartition('/')[2]}_mark"))
    mark = np.array(mesh.GetPointsAttr().Get())
    assert np.hypot(*mark.mean(0)[[0, 2]]) > 0.1 * np.ptp(part(name, path).points[:, 0]) / 2


def test_robot_stands_on_wheels_where_its_physics_says():
    toml = importlib.import_module("tomllib").loads((VEHICLES / "two_wheeled" / "vehicle.toml").read_text())["physics"]
    for path, side in (("wheel_left", 1), ("wheel_right", -1)):
        wheel = part("two_wheeled", path)
        assert wheel.T_rp[:3, 3] == pytest.approx([0, side * toml["half_track"], toml["wheel_radius"]])
        assert np.hypot(*wheel.points[:, [0, 2]].T).max() == pytest.approx(toml["wheel_radius"], abs=1e-4)


def test_simple_car_borrows_the_cars_asset():
    assert rig("simple_car").asset.resolve() == asset("car").resolve()
    assert dict(rig("simple_car").drives) == dict(rig("car").drives)


@pytest.mark.parametrize("psi", [-1.1, 0.0, 0.7])
@pytest.mark.parametrize("phi", [-0.6, 0.0, 0.4])
def test_riders_legs_reach_from_the_turned_feet_to_the_turned_hips(psi, phi):
    """The rig as USD composes it: joints stay closed, and knees bend forwards."""
    board = vehsim.load_vehicle("snakeboard")
    law = {
        name: float(channel.value(0, [psi, phi], [0, 0], [0, 0, 0], [0, 0]))
        for name, channel in board.channels.items()
        if channel.value
    }
    stage = Usd.Stage.Open(str(rig("snakeboard").asset))
    for name, drive in rig("snakeboard").drives.items():
        if name in law:
            prim = UsdGeom.Xformable(stage.GetPrimAtPath(f"/snakeboard/{drive.prim}"))
            getattr(prim, f"AddR{drive.op[1:]}Op")(UsdGeom.XformOp.PrecisionDouble, "spin").Set(math.degrees(law[name]))
    cache = UsdGeom.XformCache()

    def place(path: str, point: list[float]) -> np.ndarray:
        return np.array(
            cache.GetLocalToWorldTransform(stage.GetPrimAtPath(f"/snakeboard/{path}")).Transform(Gf.Vec3d(*point))
        )

    for end, side in (("front", 1), ("rear", -1)):
        leg = f"truck_{end}/leg_{end}/shin_{end}"
        ankle, knee, hip = (place(path, [0, 0, z]) for path, z in ((leg, 0), (leg, 0.43), (f"{leg}/thigh_{end}", 0.43)))
        assert np.allclose(hip, place("pelvis", [side * 0.09, 0, 0]), atol=1e-9)
        assert np.allclose(ankle, [side * 0.27, 0, 0.195], atol=1e-9)
        toes = place(f"truck_{end}", [0, 1, 0]) - place(f"truck_{end}", [0, 0, 0])
        assert (knee - (ankle + hip) / 2) @ toes > 0.1


def test_tumbler_has_the_inertia_of_its_bars_and_floats_at_its_centre_of_mass():
    script = importlib.import_module("vehsim.assets.generate.tumbler")
    body = vehsim.load_vehicle("tumbler")
    assert np.diag(body.inertia)[:3] == pytest.approx(script.inertia(), rel=1e-3)
    assert np.diag(body.inertia)[3] == pytest.approx(sum(script.masses()), rel=1e-3)
    stem, bar, other = script.inertia()
    assert bar < stem < other  # about its stem it turns over
    clip = vehsim.simulate(body, None, start=vehsim.State(twist=[0, 0, 0, 0, 0, 0]), duration=0.5)
    assert not clip.positions.any()
