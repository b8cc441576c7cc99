"""Terrain with arches and caves: its sides, ground and distances, compared with other libraries and closed forms."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise
from types import SimpleNamespace

import numpy as np
import pytest
import trimesh
from elementary import ExactDistance
from scipy.spatial.transform import Rotation

from vehsim.errors import InputError
from vehsim.exporters.checks.audit import _Ground
from vehsim.vehicles import load_vehicle
from vehsim.world import obstacles
from vehsim.world.distance.field import distance_field
from vehsim.world.ground.rock import rock_met, rock_under_wheels
from vehsim.world.terrain.surface import LIFT, TerrainSurface, _spanned, looks_up, open_edges, surface_of
from vehsim.world.terrain.terrain import Terrain
from vehsim.world.world import World

RNG = np.random.default_rng(11)
GROUND = ((-40, -30, -5), (40, 30, 0))
LEGS = ((-4, -20, -1), (4, -12, 26)), ((-4, 12, -1), (4, 20, 26))
LINTEL = ((-4, -20, 22), (4, 20, 30))
"""Boxes of an arch along X: free between y = -12 and 12 up to z = 22."""
HILL, ROOM, TUNNEL = ((-20, -25, -1), (25, 25, 24)), ((-12, -12, 0), (12, 12, 15)), ((0, -5, 0), (30, 5, 11))
"""Boxes of a cave: a room in a hill, and its tunnel to the side of +X."""


def box(low, high):
    return trimesh.creation.box(bounds=[low, high])


@pytest.fixture(scope="module")
def meshes():
    cave = trimesh.boolean.difference([box(*HILL), box(*ROOM), box(*TUNNEL)])
    return {
        "arch": trimesh.boolean.union([box(*GROUND), *(box(*leg) for leg in LEGS), box(*LINTEL)]),
        "cave": trimesh.boolean.union([box(*GROUND), cave]),
    }


@pytest.fixture(scope="module")
def terrains(meshes, tmp_path_factory):
    folder = tmp_path_factory.mktemp("terrains")
    for name, mesh in meshes.items():
        mesh.export(folder / f"{name}.obj")
    return {name: Terrain.load(folder / f"{name}.obj") for name in meshes}


def in_boxes(points, *boxes):
    return np.any([((points > low) & (points < high)).all(axis=1) for low, high in boxes], axis=0)


def rock(name, points):
    """Whether points (n, 3) lie in the rock, by its boxes."""
    if name == "arch":
        return in_boxes(points, GROUND, *LEGS, LINTEL)
    return in_boxes(points, GROUND) | (in_boxes(points, HILL) & ~in_boxes(points, ROOM, TUNNEL))


def around(count=3000):
    return RNG.uniform((-39, -29, -4), (39, 29, 38), (count, 3))


# ---------------------------------------------------------------- sides and ground


@pytest.mark.parametrize("name", ["arch", "cave"])
def test_the_space_below_rock_is_free(terrains, name):
    points = around()
    assert 0.1 < rock(name, points).mean() < 0.9
    np.testing.assert_array_equal(terrains[name].below(points), rock(name, points))


def test_copies_of_faces_count_once(meshes, terrains, tmp_path):
    arch = meshes["arch"]
    mesh = trimesh.util.concatenate([arch] * 60)  # also as shells turned about their first corner
    mesh.faces[len(arch.faces) :: 2] = np.roll(mesh.faces[len(arch.faces) :: 2], 1, axis=1)
    mesh.export(tmp_path / "copies.obj")
    copied = Terrain.load(tmp_path / "copies.obj")
    assert len(copied.surface.faces) == len(terrains["arch"].surface.faces)
    np.testing.assert_array_equal(copied.below(points := around()), rock("arch", points))


def test_many_surfaces_over_each_other_are_refused(meshes, tmp_path):
    shells = [meshes["arch"].copy().apply_scale(1 - 1e-4 * k) for k in range(100)]
    trimesh.util.concatenate(shells).export(tmp_path / "shells.obj")
    with pytest.raises(InputError, match="times as large as the box around it"):
        Terrain.load(tmp_path / "shells.obj")


def test_the_ground_is_the_lowest_and_below_a_point_the_next_one(terrains):
    for name, top in (("arch", 30), ("cave", 24)):
        terrain = terrains[name]
        np.testing.assert_allclose(terrain.height([[0.3, 0.2], [35, 0]]), 0, atol=1e-9)
        np.testing.assert_allclose(
            terrain.height_below([[0.3, 0.2, 5], [0.3, 0.2, 50], [0.3, 0.2, top]]), [0, top, top]
        )


GATE = {"left": ((50, 60, 0), (52, 70, 7)), "right": ((60, 60, 0), (62, 70, 7)), "beam": ((50, 60, 6), (62, 70, 7))}


@pytest.mark.parametrize("names", [("left", "right"), ("left", "beam", "right")])
@pytest.mark.parametrize("thick", [True, False])
def test_pieces_on_a_plane_of_two_faces_stay_open(names, thick, tmp_path):
    """Modellers put boxes on a large plane: a gate stays open although the plane's faces reach far beyond it, and posts
    that hide nothing make no overhang. The ground is on top of what stands on the plane."""
    ground = box((0, 0, -2), (100, 100, 0))
    if not thick:
        ground.update_faces(ground.face_normals[:, 2] > 0.9)
    trimesh.util.concatenate([ground, *(box(*GATE[name]) for name in names)]).export(tmp_path / "gate.obj")
    terrain = Terrain.load(tmp_path / "gate.obj")
    assert (terrain.surface is not None) == ("beam" in names)
    np.testing.assert_allclose(terrain.height([[51, 65], [56, 65], [61, 65], [20, 30]]), [7, 0, 7, 0], atol=1e-6)
    if "beam" in names:
        np.testing.assert_array_equal(terrain.below(np.array([[56, 65, 3], [51, 65, 3], [56, 65, 6.5]])), [0, 1, 1])


def test_rock_on_the_middle_of_a_large_face_leaves_the_rest_of_it_ground(tmp_path):
    """Boxes stand on a plane of two faces, one of them on a face's middle: rock is what is in a box, and the lowest
    ground is the plane where it is free."""
    boxes = [((-80, -80, -4), (160, 80, 0)), ((70, -30, 0), (90, -5, 40))]
    boxes += [((30, -16, 0), (42, -10, 34)), ((30, 10, 0), (42, 16, 34)), ((30, -16, 26), (42, 16, 34))]
    trimesh.util.concatenate([box(*corners) for corners in boxes]).export(tmp_path / "gate.obj")
    terrain = Terrain.load(tmp_path / "gate.obj")
    points = np.random.default_rng(0).uniform((-79, -79, -3), (159, 79, 38), (20000, 3))
    np.testing.assert_array_equal(terrain.below(points), in_boxes(points, *boxes))
    through = [[36, 0], [36, -9], [36, 9], [60, -20], [100, -60]]
    np.testing.assert_allclose(terrain.height(through), 0, atol=1e-9)
    np.testing.assert_allclose(terrain.height([[80, -20], [36, -13]]), [40, 34], atol=1e-9)
    route = World(terrain).route((-40, 0, 12), (110, 14, 14), 3.0)
    assert np.abs(route[(route[:, 0] > 30) & (route[:, 0] < 42), 1]).max() < 7  # through the gate


@pytest.mark.parametrize("seed", range(12))
def test_faces_that_nothing_touches_are_ground_as_a_whole(seed, monkeypatch):
    """On slopes of large faces, with boxes on, in and above them and at their corners: as if each place were asked."""
    rng = np.random.default_rng(seed)
    x = np.linspace(-20, 20, rng.integers(2, 7))
    xy = np.stack(np.meshgrid(x, x, indexing="ij"), axis=-1).reshape(-1, 2)
    slope = rng.uniform(-0.3, 0.3, 2)
    at = np.arange(len(xy)).reshape(len(x), -1)
    a, b, c, d = at[:-1, :-1], at[1:, :-1], at[:-1, 1:], at[1:, 1:]
    faces = np.concatenate([np.stack(each, axis=-1).reshape(-1, 3) for each in ((a, b, d), (a, d, c))])
    meshes = [trimesh.Trimesh(np.column_stack([xy, xy @ slope]), faces, process=False)]
    for _ in range(seed % 6):
        size, place = rng.uniform(1, 8, 3), rng.choice(xy) if rng.random() < 0.4 else rng.uniform(-18, 18, 2)
        T_wb = np.eye(4)
        T_wb[:3, :3] = Rotation.from_rotvec(rng.choice([0, 1]) * rng.normal(size=3)).as_matrix()
        T_wb[:3, 3] = [*place, place @ slope + rng.choice([0, size[2] / 2, 6])]
        meshes.append(trimesh.creation.box(extents=size, transform=T_wb))
    mesh = trimesh.util.concatenate(meshes)
    surface = surface_of(np.asarray(mesh.vertices), np.asarray(mesh.faces))
    places = rng.uniform(-19.9, 19.9, (400, 2))
    found = surface.floor(places), surface.levels(places)
    assert seed % 6 or not surface._ground[1].any()
    monkeypatch.setattr("vehsim.world.terrain.surface.touched_from_above", lambda corners, those: those >= 0)
    each = TerrainSurface(surface.points, surface.faces)
    np.testing.assert_array_equal(found[0], each.floor(places))
    np.testing.assert_array_equal(found[1], each.levels(places))


@pytest.mark.parametrize("suffix", ["stl", "ply", "glb"])
def test_every_format_keeps_the_arch_open(meshes, tmp_path, suffix):
    mesh = meshes["arch"].copy()
    if suffix == "glb":
        mesh.apply_transform([[1, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0], [0, 0, 0, 1]])
    mesh.export(tmp_path / f"arch.{suffix}")
    points = around(500)
    np.testing.assert_array_equal(Terrain.load(tmp_path / f"arch.{suffix}").below(points), rock("arch", points))


def test_a_stage_keeps_the_arch_open_and_is_its_look(meshes, tmp_path):
    from pxr import Usd, UsdGeom

    stage = Usd.Stage.CreateNew(str(tmp_path / "arch.usda"))
    UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.z)
    mesh = UsdGeom.Mesh.Define(stage, "/arch")
    stage.SetDefaultPrim(mesh.GetPrim())
    mesh.CreatePointsAttr(meshes["arch"].vertices.tolist())
    mesh.CreateFaceVertexCountsAttr([3] * len(meshes["arch"].faces))
    mesh.CreateFaceVertexIndicesAttr(meshes["arch"].faces.ravel().tolist())
    stage.Save()
    terrain = Terrain.load(tmp_path / "arch.usda")
    assert terrain.look == tmp_path / "arch.usda"
    assert terrain.below([[0, 0, 10], [0, 0, 25]]).tolist() == [False, True]


def test_faces_that_look_the_wrong_way_are_turned(meshes, tmp_path):
    points = around(500)
    for name, wrong in (("flipped", np.ones), ("mixed", lambda n: RNG.uniform(size=n) < 0.3)):
        faces = meshes["cave"].faces.copy()
        turned = np.asarray(wrong(len(faces)), bool)
        faces[turned] = faces[turned, ::-1]
        trimesh.Trimesh(meshes["cave"].vertices, faces, process=False).export(tmp_path / f"{name}.ply")
        terrain = Terrain.load(tmp_path / f"{name}.ply")
        np.testing.assert_array_equal(terrain.below(points), rock("cave", points))
        audited = _Ground(*trimesh_of(tmp_path / f"{name}.ply"))
        np.testing.assert_array_equal(audited.away(points) < 0, rock("cave", points))


def trimesh_of(file):
    mesh = trimesh.load(file, process=False)
    return np.asarray(mesh.vertices, float), np.asarray(mesh.faces, np.int64)


def test_the_rock_below_an_open_sheet_with_an_overhang_is_closed(tmp_path):
    """A sheet without sides and bottom that folds over itself, as sculpting tools export it."""
    profile = np.array([(-20, 0), (5, 0), (3, 8), (-4, 9), (-4, 12), (8, 14), (20, 14)], float)
    y = np.array([-10.0, 10.0])
    vertices = np.array([(x, side, z) for x, z in profile for side in y])
    faces = [f for k in range(len(profile) - 1) for i in [2 * k] for f in ((i, i + 2, i + 3), (i, i + 3, i + 1))]
    trimesh.Trimesh(vertices, faces, process=False).export(tmp_path / "fold.ply")
    terrain = Terrain.load(tmp_path / "fold.ply")
    assert len(open_edges(terrain.surface.faces)) == 2 * (len(profile) - 1) + 2
    free = terrain.below([[-2, 0, 4], [-2, 0, 10.5], [-10, 0, -3], [10, 0, 5], [-10, 0, 5], [4.5, 9.9, 3]])
    assert free.tolist() == [False, True, True, True, False, True]
    assert terrain.height([[-2, 0]])[0] == pytest.approx(0)


def test_the_surface_is_part_of_the_content(terrains):
    arch = terrains["arch"]
    moved = replace(arch, surface=replace(arch.surface, points=arch.surface.points * (1 + 1e-9)))
    assert len({arch.content_hash, moved.content_hash, replace(arch, surface=None).content_hash}) == 3


def test_an_overhang_above_large_triangles_is_not_filled(tmp_path):
    """The ground is a box whose top has few triangles, and none of their middles is below the shelf."""
    ground, shelf = ((-30, -25, -5), (30, 25, 0)), ((-10, -4, 6), (10, 5, 8))
    cliff = ((-10, -15, -1), (10, -3, 8))
    parts = [trimesh.creation.box(bounds=bounds) for bounds in (ground, cliff, shelf)]
    trimesh.boolean.union(parts).export(tmp_path / "cliff.obj")
    terrain = Terrain.load(tmp_path / "cliff.obj")
    points = np.random.default_rng(5).uniform((-9, -2, 0.1), (9, 4, 5.9), (500, 3))
    assert not terrain.below(points).any()
    np.testing.assert_allclose(terrain.height(points[:, :2]), 0, atol=1e-9)  # the lowest ground


def test_an_arch_in_utm_coordinates_is_as_exact(terrains, meshes, vehicle, poses, tmp_path):
    away = np.array([500_000.0, 4_600_000.0, 0.0])
    meshes["arch"].copy().apply_translation(away).export(tmp_path / "far.obj")
    terrain, points = Terrain.load(tmp_path / "far.obj"), around(20_000)
    np.testing.assert_array_equal(terrain.below(points + away), rock("arch", points))
    near = World(terrains["arch"]).clearance(vehicle, poses[0][:40], poses[1][:40])
    far = World(terrain).clearance(vehicle, poses[0][:40] + away, poses[1][:40])
    np.testing.assert_allclose(far[near > 0], near[near > 0], atol=1e-6)


# ---------------------------------------------------------------- vehicles on the ground


def test_a_vehicle_that_drives_into_a_wall_or_roof_is_found(terrains, vehicle):
    def clip(x, vehicle=vehicle):
        positions = np.column_stack([x, np.zeros_like(x), np.zeros_like(x)])
        upright = np.tile([1.0, 0, 0, 0], (len(x), 1))
        return SimpleNamespace(
            vehicle=vehicle, positions=positions, orientations=upright, frames=1001 + np.arange(len(x))
        )

    world = World(terrains["cave"])  # 24 m long inside, and its tunnel opens at x = 25
    assert rock_met(clip(np.array([-5.0, 0.0, 5.0])), world) is None
    frame, place = rock_met(clip(np.array([-5.0, -6.0, -9.0])), world)
    assert frame == 1003 and place[0] < -12
    assert rock_met(clip(np.array([-9.0])), World()) is None
    driven = load_vehicle("car")
    sunk = [rock_under_wheels(clip(np.array([x]), driven), world) for x in (-9.0, -10.5, -16.0)]
    assert sunk == [False, False, True]  # its front wheels are 1.3 m from its middle, its bumper 2 m
    assert not rock_under_wheels(clip(np.array([-16.0]), driven), World())


# ---------------------------------------------------------------- distances


@pytest.fixture(scope="module")
def poses():
    """Random poses, half of them close to the arch, and none that reaches beyond the borders."""
    near = RNG.uniform((-12, -22, 3), (12, 22, 34), (200, 3))
    far = RNG.uniform((-33, -23, 0), (33, 23, 38), (200, 3))
    return np.vstack([near, far]), Rotation.random(400, rng=RNG).as_quat(scalar_first=True)


@pytest.mark.parametrize("name", ["arch", "cave"])
def test_clearance_is_exact_against_elementary_geometry(terrains, vehicle, hulls, poses, name):
    found = World(terrains[name]).clearance(vehicle, *poses)
    exact, free = ExactDistance(terrains[name]), np.flatnonzero(found > 0)
    assert len(free) > 80
    for k in free:
        placed = [Rotation.from_quat(poses[1][k], scalar_first=True).apply(hull) + poses[0][k] for hull in hulls]
        assert found[k] == pytest.approx(min(map(exact, placed)), abs=1e-6)


def test_clearance_agrees_with_mujoco_on_the_boxes_of_the_arch(terrains, vehicle, poses):
    boxes = [
        obstacles.box(f"box{k}", (*((np.add(low, high) / 2)[:2]), low[2]), np.subtract(high, low))
        for k, (low, high) in enumerate((GROUND, *LEGS, LINTEL))
    ]
    found = World(terrains["arch"]).clearance(vehicle, *poses)
    expected = World(obstacles=boxes).clearance(vehicle, *poses)
    np.testing.assert_array_equal(found > 0, expected > 0)
    np.testing.assert_allclose(found[found > 0], expected[found > 0], atol=1e-5)


@pytest.mark.parametrize("name", ["arch", "cave"])
def test_clearance_agrees_with_coal(terrains, vehicle, hulls, poses, name):
    coal = pytest.importorskip("coal")
    terrain = terrains[name]

    def model(points, faces):
        made = coal.BVHModelOBBRSS()
        made.beginModel(len(faces), len(points))
        corners, triangles = coal.StdVec_Vec3s(), coal.StdVec_Triangle()
        corners.extend(np.asarray(point, float) for point in points)
        triangles.extend(coal.Triangle(*map(int, face)) for face in faces)
        made.addSubModel(corners, triangles)
        made.endModel()
        return made

    from scipy.spatial import ConvexHull

    ground = model(terrain.vertices, terrain.faces)
    bodies = [model(hull, ConvexHull(hull).simplices) for hull in hulls]
    found = World(terrain).clearance(vehicle, *poses)
    for k in np.flatnonzero(found > 0):
        pose = coal.Transform3s(Rotation.from_quat(poses[1][k], scalar_first=True).as_matrix(), poses[0][k])
        gaps = [
            coal.distance(body, pose, ground, coal.Transform3s(), coal.DistanceRequest(), coal.DistanceResult())
            for body in bodies
        ]
        assert found[k] == pytest.approx(min(gaps), abs=1e-5)


def test_a_pose_around_a_small_floating_rock_is_inside(meshes, vehicle, tmp_path):
    pebble = trimesh.creation.icosphere(2, 0.2).apply_translation([20, 20, 12])
    trimesh.util.concatenate([meshes["arch"], pebble]).export(tmp_path / "pebble.ply")
    terrain = Terrain.load(tmp_path / "pebble.ply")
    assert World(terrain).clearance(vehicle, [[20, 20, 11]], [[1, 0, 0, 0]])[0] < 0


def test_beyond_the_borders_the_ground_continues(terrains, vehicle):
    found = World(terrains["arch"]).clearance(vehicle, [[60, 0, 2], [60, 0, -1], [43, 0, 2]], [[1, 0, 0, 0]] * 3)
    assert found[0] == pytest.approx(2) and found[1] < 0 and found[2] == pytest.approx(2)


@pytest.mark.parametrize("name", ["arch", "cave"])
def test_the_field_has_the_sign_and_the_distance_of_the_surface(terrains, name):
    terrain = terrains[name]
    field = distance_field(terrain, spacing=2.0)
    grid = np.stack(
        np.meshgrid(*(field.lower[k] + 2 * np.arange(0, field.distances.shape[k], 2) for k in range(3)), indexing="ij"),
        -1,
    )
    inner = (grid > terrain.lower + 1e-3).all(axis=-1) & (grid < terrain.upper - 1e-3).all(axis=-1)
    points = grid[inner]
    audited = _Ground(terrain.vertices, terrain.faces).away(points)
    found = field.distances[::2, ::2, ::2][inner]
    clear = np.abs(found) > 1e-3
    np.testing.assert_array_equal(found[clear] < 0, rock(name, points[clear]))
    free = clear & (found > 0) & (found < 16)
    np.testing.assert_allclose(found[free], audited[free], atol=1e-4)


def test_a_route_leads_through_the_arch_and_out_of_the_cave(terrains):
    through = World(terrains["arch"]).route((-30, 0, 10), (30, 0, 10), clearance=3.0)
    assert through[:, 2].max() < 22
    out = World(terrains["cave"]).route((-5, 0, 8), (35, 20, 8), clearance=2.0)
    assert not terrains["cave"].below(out).any() and np.abs(out[:, 1][(out[:, 0] > 12) & (out[:, 0] < 25)]).max() < 5


# ---------------------------------------------------------------- the audit of a stage


def test_a_look_without_any_area_is_audited():
    """Such as one whose transform collapses it: all corners at one place."""
    ground = _Ground(np.zeros((3, 3)), np.array([[0, 1, 2], [0, 2, 1]]))
    assert (ground.up == 0).all() and ground.height(np.array([[1.0, 2.0, 3.0]])) == 0


@pytest.mark.parametrize("name", ["arch", "cave"])
def test_the_audit_of_a_stage_sees_the_same_sides_and_ground(terrains, meshes, name):
    ground = _Ground(np.asarray(meshes[name].vertices, float), np.asarray(meshes[name].faces, np.int64))
    points = around(1000)
    np.testing.assert_array_equal(ground.away(points) < 0, rock(name, points))
    np.testing.assert_allclose(
        ground.height(np.array([[0.3, 0.2, 0.1], [0.3, 0.2, 40]])), [0, {"arch": 30, "cave": 24}[name]], atol=1e-6
    )


@pytest.mark.parametrize("seed", range(5))
def test_the_space_above_a_face_is_free_where_winding_numbers_say_so(seed):
    """On a plane stand boxes that overlap and touch each other, as modellers place them."""
    draw = np.random.default_rng(seed)
    lows, sizes = draw.integers(0, 12, (12, 3)) * [1, 1, 0.5], draw.integers(1, 8, (12, 3))
    plane = box((-5, -5, -1), (25, 25, 0))
    made = trimesh.util.concatenate([plane, *(box(low, low + size) for low, size in zip(lows, sizes, strict=True))])
    surface = surface_of(np.array(made.vertices), np.array(made.faces))
    corners = surface.points[surface.faces]
    corners = corners[looks_up(corners)]
    shares = draw.dirichlet([1, 1, 1], (200, len(corners)))
    places = np.einsum("nkc,kcd->nkd", shares, corners).reshape(-1, 3)
    free = surface.free_above(places)
    np.testing.assert_array_equal(free, ~surface.inside(places + LIFT))
    assert 0 < free.mean() < 1


@pytest.mark.parametrize("path", [[0, 1, 2], [0, 1, 2, 3], [4, 3, 2, 1, 0], [0, 1, 2, 3, 4, 5, 6], [0, 1, 2, 0, 3, 4]])
@pytest.mark.parametrize("closed", [True, False])
def test_triangles_span_the_edges_of_a_bottom(path, closed):
    edges = np.array([*pairwise(path), *([(path[-1], path[0])] if closed else [])])
    faces = np.vstack([*_spanned(edges, 9)])
    balance = np.zeros((10, 10), int)
    for a, b, c in faces:
        for start, end in ((a, b), (b, c), (c, a)):
            balance[start, end] += 1
            balance[end, start] -= 1
    for start, end in edges:
        balance[start, end] -= 1
        balance[end, start] += 1
    balance[9] = balance[:, 9] = 0  # an open path is closed over that point
    assert not balance.any()
