"""The distance field with obstacles: the smaller of two exact distances, in one spline; open without terrain."""

import igl
import numpy as np
import trimesh

from vehsim import World
from vehsim.world.distance import field as field_module
from vehsim.world.obstacles import obstacles as ob
from vehsim.world.terrain.terrain import Terrain

THINGS = (ob.box("hut", (12, 8, 0), (6, 5, 9), 25), ob.sphere("ball", (28, 20, 14), 4.0))


def exact(points, terrain=None):
    """Signed distances (n,) m by libigl."""
    shapes = [trimesh.convex.convex_hull(hull) for thing in THINGS for hull in thing.hulls]
    found = [
        igl.signed_distance(points, np.array(s.vertices), np.array(s.faces), igl.SIGNED_DISTANCE_TYPE_PSEUDONORMAL)[0]
        for s in shapes
    ]
    if terrain is not None:
        above = np.sign(points[:, 2] - terrain.height(points[:, :2]))
        found.append(above * np.sqrt(igl.point_mesh_squared_distance(points, terrain.vertices, terrain.faces)[0]))
    return np.min(found, axis=0)


def test_obstacles_alone_are_an_open_field():
    """Near them accurate to a few centimetres; beyond the box never too large."""
    field = World(obstacles=THINGS).distance_field()
    rng = np.random.default_rng(0)
    points = rng.uniform(field.lower, field.upper, (600, 3))
    off = field.value(points) - exact(points)
    assert np.abs(off).max() < 0.25 and np.sqrt(np.mean(off**2)) < 0.03
    outside = rng.uniform(field.lower - 60, field.upper + 60, (600, 3))
    assert (field.value(outside) <= exact(outside) + 0.25).all()
    assert field.value([[12, 8, 4]])[0] < -2


def test_with_terrain_the_field_is_the_smaller_distance():
    x, y = np.meshgrid(np.arange(0, 61, 2.0), np.arange(0, 41, 2.0))
    terrain = Terrain("waves", 2 * np.sin(x / 9) * np.cos(y / 7), (0.0, 0.0), (2.0, 2.0))
    field = World(terrain, obstacles=THINGS).distance_field()
    assert not field.open and field.upper[2] > 18 + 10
    points = np.random.default_rng(1).uniform((2, 2, 3), (58, 38, 24), (500, 3))
    off = field.value(points) - exact(points, terrain)
    assert np.abs(off).max() < 0.3 and np.sqrt(np.mean(off**2)) < 0.04


def test_a_moved_obstacle_does_not_measure_the_terrain_again(monkeypatch):
    """And the field is the same to the bit as one that was measured from the start."""
    x, y = np.meshgrid(np.arange(0, 61, 2.0), np.arange(0, 41, 2.0))
    terrain = Terrain("waves", 2 * np.sin(x / 9) * np.cos(y / 7), (0.0, 0.0), (2.0, 2.0))
    moved = (ob.box("hut", (14, 9, 0), (6, 5, 9), 40), THINGS[1])
    fresh = World(terrain, obstacles=moved).distance_field()
    world = World(terrain, obstacles=THINGS)
    world.distance_field()
    monkeypatch.setattr(field_module, "_by_field", None)
    again = world.with_only(moved).distance_field()
    assert np.array_equal(again.distances, fresh.distances) and np.array_equal(again.lower, fresh.lower)


def test_obstacles_are_measured_only_where_they_may_be_nearer(monkeypatch):
    """The field is the same to the bit as if they were measured everywhere, also in rock."""
    x, y = np.meshgrid(np.arange(0, 61, 2.0), np.arange(0, 41, 2.0))
    terrain = Terrain("waves", 2 * np.sin(x / 9) * np.cos(y / 7), (0.0, 0.0), (2.0, 2.0))
    things, asked, to_hulls = (ob.box("cellar", (40, 30, -9), (5, 5, 12), 10), *THINGS), [], field_module._to_hulls

    def counted(hulls):
        law = to_hulls(hulls)
        return lambda points: asked.append(len(points)) or law(points)

    monkeypatch.setattr(field_module, "_to_hulls", counted)
    field = World(terrain, obstacles=things).distance_field()
    few = sum(asked)
    monkeypatch.setattr(field_module, "MARGIN", np.inf)  # everywhere
    whole = World(terrain, obstacles=things).distance_field()
    assert np.array_equal(field.distances, whole.distances) and few < 0.8 * (sum(asked) - few)
    assert sum(asked) - few == field.distances.size


def test_the_fields_functions_agree_inside_and_outside_the_box():
    """numpy, CasADi and the optimiser's models agree; in an open field nothing is subtracted."""
    field = World(obstacles=THINGS).distance_field()
    points = np.random.default_rng(2).uniform(field.lower - 20, field.upper + 20, (60, 3))
    values = field.value(points)
    by_models = np.asarray(field.models(60)(points.T))
    np.testing.assert_allclose(by_models[0], values, atol=1e-9)
    np.testing.assert_allclose([float(field.function(p)) for p in points], values, atol=1e-9)
    step = 1e-4
    for k in range(3):
        slope = (field.value(points + step * np.eye(3)[k]) - field.value(points - step * np.eye(3)[k])) / (2 * step)
        inside = ((points > field.lower + 1) & (points < field.upper - 1)).all(axis=1)
        np.testing.assert_allclose(by_models[1 + k][inside], slope[inside], atol=1e-5)
