"""Vehicles on the ground of terrain with walls, roofs and several levels, compared with boxes and MuJoCo."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh

import vehsim
from vehsim.errors import InputError
from vehsim.lie.quaternions import from_yaw, matrices
from vehsim.vehicles.library.library import load_vehicle
from vehsim.world import obstacles
from vehsim.world.obstacles.obstacles import hulls_of
from vehsim.world.terrain.terrain import Terrain
from vehsim.world.world import World

RNG = np.random.default_rng(3)
GROUND = ((-40, -25, -5), (40, 25, 0))
WALLS = ((-10, -15, -1), (10, -3, 8)), ((-10, 3, -1), (10, 15, 8))
ROOF = ((-10, -3, 3), (10, 3, 8))
PILLAR = ((16, -1, -1), (18, 1, 6))
"""A hill with a tunnel along X, 6 m wide and 3 m high, and a pillar of rock behind it."""
DECK = ((-10, -4, 5), (10, 4, 6))
"""A bridge along X; its ramps end at x = 30 m on either side."""


@pytest.fixture(scope="module")
def car():
    return load_vehicle("car")


def box(bounds):
    return trimesh.creation.box(bounds=bounds)


def ramp(side):
    corners = [(side * x, y, z) for y in (-4, 4) for x, z in ((30, -1), (10, -1), (10, 6), (30, 0))]
    return trimesh.Trimesh(corners).convex_hull


@pytest.fixture(scope="module")
def worlds(tmp_path_factory):
    folder = tmp_path_factory.mktemp("walls")
    made = {}
    for name, parts in (
        ("tunnel", [box(b) for b in (GROUND, *WALLS, ROOF, PILLAR)]),
        ("bridge", [box(GROUND), box(DECK), ramp(-1), ramp(1)]),
    ):
        trimesh.boolean.union(parts).export(folder / f"{name}.obj")
        made[name] = World(Terrain.load(folder / f"{name}.obj"))
    return made


def marks(start, goal, seconds, heading=0.0):
    rest = {"heading": heading, "velocity": (0.0, 0.0, 0.0)}
    return [vehsim.Mark(1001, position=start, **rest), vehsim.Mark(1001 + 24 * seconds, position=goal, **rest)]


def apart(points, bounds):
    """Distance of each point (n, 3) from a box."""
    low, high = np.array(bounds, float)
    return np.linalg.norm(np.maximum(np.maximum(low - points, points - high), 0), axis=1)


# ---------------------------------------------------------------- levels


@pytest.mark.parametrize(
    ("start", "expected"),
    [((0, 0, 6), [6, 6, 3]), ((0, -20, 0), [0, 0, 3]), ((-38, 20, 0), [0, 0, 3])],
    ids=["on the deck", "on the road", "beside it"],
)
def test_a_vehicle_stands_on_the_level_that_it_reaches_first(worlds, start, expected):
    level = worlds["bridge"].on_level([start])
    places = [(1.3, 0.4), (-4.2, 2.9), (20, 0)]
    if start[2] == 0:
        places[2] = (0, -8)
        expected = [0, 0, 0]
    np.testing.assert_allclose(level.height(places), expected, atol=1e-6)


def test_the_ground_in_a_tunnel_continues_behind_its_walls(worlds):
    """So that the hill above does not pull on a car beside the wall."""
    level = worlds["tunnel"].on_level([(0, 0, 0)])
    assert np.abs(level.height(RNG.uniform((-9, -5), (9, 5), (200, 2)))).max() < 1e-6
    roof = worlds["tunnel"].on_level([(0, 0, 8)])
    np.testing.assert_allclose(roof.height([(0, 0), (5, 10)]), 8, atol=1e-6)


def test_terrain_without_overhangs_has_one_level():
    world = World("hills")
    assert world.on_level([(0, 0, 0)]) is world and world.walls(2.0) is None


# ---------------------------------------------------------------- walls in plan view and in space


def test_walls_in_plan_view_are_the_rock_at_the_height_of_a_car(worlds):
    import shapely

    parts = worlds["tunnel"].on_level([(-20, 0, 0), (30, 0, 0)]).walls(1.8).parts
    points = RNG.uniform((-30, -14), (30, 14), (4000, 2))
    inside = np.any([shapely.contains_xy(shapely.Polygon(part), *points.T) for part in parts], axis=0)
    at = np.column_stack([points, np.full(len(points), 1.0)])
    gaps = np.min([apart(at, bounds) for bounds in (*WALLS, PILLAR)], axis=0)
    assert inside[gaps == 0].all() and not inside[gaps > 0.03].any() and 0.1 < inside.mean() < 0.9
    assert len(parts) < 10


def test_a_low_roof_closes_the_way(worlds):
    """The roof is 3 m above the road."""
    level = worlds["tunnel"].on_level([(-20, 0, 0), (30, 0, 0)])
    tall, low = (np.vstack([p for p in level.walls(height).parts]) for height in (3.5, 2.5))
    assert not (np.abs(low[:, 1]) < 2.9).sum() > 4 and len(tall) != len(low)


def test_distances_from_walls_agree_with_mujoco(worlds, car):
    count = 300
    places = np.column_stack([RNG.uniform((-14, -2.5), (20, 2.5), (count, 2)), np.full(count, 0.0)])
    turned = from_yaw(RNG.uniform(-np.pi, np.pi, count))
    found = worlds["tunnel"].on_level([(-20, 0, 0), (30, 0, 0)]).clearance_from_walls(car, places, turned)
    boxes = [
        obstacles.box(f"box{k}", (*((np.add(low, high) / 2)[:2]), 0.3), (*np.subtract(high, low)[:2], high[2] - 0.3))
        for k, (low, high) in enumerate((*WALLS, PILLAR))
    ]
    low, high = np.array(ROOF, float)
    boxes.append(obstacles.box("roof", (*((low + high) / 2)[:2], low[2]), high - low))
    expected = World(obstacles=boxes).clearance(car, places, turned)
    free = expected > 0
    assert 0.3 < free.mean() < 0.95
    np.testing.assert_array_equal(found > 0, free)
    np.testing.assert_allclose(found[free], expected[free], atol=1e-5)


# ---------------------------------------------------------------- plans


def test_a_car_drives_through_a_tunnel_and_round_a_pillar(worlds, car):
    plan = vehsim.plan(car, worlds["tunnel"], marks((-25, 0, 0), (30, 0, 0), 14), clearance=0.5, segments=48)
    assert plan.success, plan.message
    assert 0.498 < plan.clearance < 1.0
    clip = plan.clip.at(np.linspace(0, plan.clip.times[-1], 500))
    corners = np.vstack(hulls_of(car))
    corners = corners[corners[:, 2] > 0.3]
    placed = clip.positions[:, None] + corners @ matrices(clip.orientations).swapaxes(1, 2)
    gaps = [apart(placed.reshape(-1, 3), bounds).min() for bounds in (*WALLS, ROOF, PILLAR)]
    assert min(gaps) > 0.495
    assert np.abs(clip.positions[:, 2]).max() < 0.05
    (row,) = (row for row in plan.audit if row.key == "clearance")
    assert row.value == pytest.approx(min(gaps), abs=0.02)


def test_a_mark_in_a_wall_or_below_too_low_a_roof_is_refused(worlds, car):
    with pytest.raises(InputError, match=r"mark\[1\]\.position.*in rock"):
        vehsim.plan(car, worlds["tunnel"], marks((-25, 0, 0), (0, 3.5, 0), 10), clearance=0.5)
    with pytest.raises(InputError, match=r"mark\[1\]\.position.*in rock|m from rock"):
        vehsim.plan(car, worlds["tunnel"], marks((-25, 0, 0), (0, 0, 0), 10), clearance=1.9)


@pytest.mark.parametrize(
    ("start", "goal", "heading", "height"),
    [((-8, 0, 6), (8, 1, 6), 0.0, 6.0), ((0, -12, 0), (1, 12, 0), 90.0, 0.0)],
    ids=["over", "under"],
)
def test_a_car_drives_over_a_bridge_and_another_below_it(worlds, car, start, goal, heading, height):
    plan = vehsim.plan(car, worlds["bridge"], marks(start, goal, 8, heading), clearance=0.5, segments=24)
    assert plan.success, plan.message
    assert np.abs(plan.clip.positions[:, 2] - height).max() < 0.05


def test_a_simulated_car_stays_on_its_level(worlds, car):
    for z, up in ((6.0, 6.0), (0.0, 0.0)):
        place, heading = ((-8, 0, z), 0.0) if z else ((0, -8, z), np.pi / 2)
        start = vehsim.State(place, from_yaw(heading), (0, 3, 0))
        clip = vehsim.simulate(car, worlds["bridge"], None, start, duration=2.0)
        assert np.abs(clip.positions[:, 2] - up).max() < 0.05
