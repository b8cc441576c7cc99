"""Routes: free, short, through the valley by default; and an error if there is none."""

from __future__ import annotations

import numpy as np
import pytest

from vehsim.errors import InputError, SolveError
from vehsim.world.distance import route
from vehsim.world.obstacles import box
from vehsim.world.terrain.terrain import Terrain
from vehsim.world.world import World

START, GOAL = (0, 0, 30), (180, 40, 28)


@pytest.fixture(scope="module")
def canyon():
    return World("canyon")


def length(route):
    return np.linalg.norm(np.diff(route, axis=0), axis=1).sum()


def dense(route):
    s = np.linspace(0, len(route) - 1, 40 * len(route))
    return np.stack([np.interp(s, np.arange(len(route)), route[:, k]) for k in range(3)], axis=-1)


@pytest.mark.parametrize("clearance", [1.0, 7.0, 10.0])
def test_the_route_keeps_its_clearance_between_its_points_too(canyon, clearance):
    route = canyon.route(START, GOAL, clearance)
    assert route[0].tolist() == list(START) and route[-1].tolist() == list(GOAL)
    assert canyon.distance_field().value(dense(route)).min() > clearance - 0.1


def test_the_route_winds_through_the_canyon_below_its_rim(canyon):
    route = canyon.route(START, GOAL, 7.0)
    assert route[:, 2].max() < 41
    assert length(route) > 1.3 * np.linalg.norm(np.subtract(GOAL, START))


def test_a_higher_ceiling_flies_over_and_shorter(canyon):
    over = canyon.route(START, GOAL, 7.0, ceiling=100)
    assert over[:, 2].max() > 50
    assert length(over) < length(canyon.route(START, GOAL, 7.0))


@pytest.mark.parametrize(("clearance", "ceiling"), [(1.0, 60), (7.0, 60), (7.0, 90)])
def test_the_corridor_of_a_large_grid_has_its_cheapest_path(canyon, monkeypatch, clearance, ceiling):
    """Searched whole, the grid gives the same path. If the corridor is too narrow, the whole grid is searched next."""
    narrowed = canyon.route(START, GOAL, clearance, ceiling=ceiling)
    searched = []
    cheapest = route._Search._cheapest
    monkeypatch.setattr(route._Search, "_cheapest", lambda *given: searched.append(len(given[1])) or cheapest(*given))
    canyon.route(START, GOAL, clearance, ceiling=ceiling)
    monkeypatch.setattr(route, "CORRIDORS", (1.0, 1.01))
    again = canyon.route(START, GOAL, clearance, ceiling=ceiling)
    monkeypatch.setattr(route, "FEW", np.inf)
    whole = canyon.route(START, GOAL, clearance, ceiling=ceiling)
    np.testing.assert_array_equal(narrowed, whole)
    np.testing.assert_array_equal(again, whole)
    assert searched[0] < 0.5 * searched[-1], searched


def test_in_a_part_of_space_only_the_best_path_counts(canyon):
    """Over gentle ground, the path in a box around the ends is that of the whole. Where valleys may lead elsewhere,
    there is none."""
    x, y = np.meshgrid(np.arange(0, 600, 6.0), np.arange(0, 600, 6.0))
    world = World(Terrain("waves", 6 * np.sin(x / 40) * np.sin(y / 50), cell=(6.0, 6.0)))
    ends, box = ((200, 260, 22), (320, 300, 22)), [[140, 200, -50], [380, 360, 50]]
    whole, part = world.route(*ends, 5.0), world.route(*ends, 5.0, box=box, best=True)
    assert world.distance_field(box=box, quick=True).distances.size < 0.3 * world.distance_field().distances.size
    np.testing.assert_allclose(part, whole, atol=1e-3)
    canyon_box = [[-20, -20, -100], [200, 60, 100]]
    canyon.route(START, GOAL, 7.0, ceiling=100, box=canyon_box)
    with pytest.raises(SolveError, match="the best path may lead outside the box"):
        canyon.route(START, GOAL, 7.0, box=canyon_box, best=True)


def test_the_whole_of_a_wide_flat_terrain_is_searched_in_few_levels():
    """Its grid of a few coarse levels ends far above its box, but no space continues there."""
    heights = np.zeros((101, 101))
    heights[40:61, 50] = 12.0
    world = World(Terrain("wide", heights, cell=(200.0, 200.0)))
    ends, field = ((9000, 10000, 7), (11000, 10000, 7)), world.distance_field(quick=True)
    assert field.upper[2] > world.bounds[1, 2] + field.spacing
    np.testing.assert_allclose(world.route(*ends, 3.0, best=True), world.route(*ends, 3.0))


def test_a_ceiling_is_kept(canyon):
    assert canyon.route(START, GOAL, 5.0, ceiling=32)[:, 2].max() <= 32


def test_over_open_ground_the_route_is_straight(monkeypatch):
    """And it takes no search."""
    monkeypatch.delattr(route._Search, "shortest")
    straight = World("flat").route((-50, 0, 12), (80, 60, 15), 5.0)
    assert length(straight) == pytest.approx(np.linalg.norm([130, 60, 3]), rel=1e-3)


def test_without_terrain_the_route_is_the_line():
    assert World().route(START, GOAL, 5.0).tolist() == [list(START), list(GOAL)]


def test_a_start_on_the_ground_can_be_left():
    flat = World("flat")
    route = flat.route((0, 0, 0.5), (60, 0, 12), 4.0)
    assert route[:, 2].min() >= 0.3


def test_a_missing_route_is_reported(canyon):
    with pytest.raises(SolveError, match="clearance"):
        canyon.route(START, GOAL, 40.0, ceiling=35)


def test_a_wall_without_ceiling_is_flown_over():
    heights = np.zeros((40, 60))
    heights[:, 28:32] = 25.0
    world = World(Terrain("wall", heights))
    route = world.route((5, 20, 6), (55, 20, 6), 3.0)
    assert route[:, 2].max() > 27
    with pytest.raises(SolveError, match="ceiling"):
        world.route((5, 20, 6), (55, 20, 6), 3.0, ceiling=20)


def test_ends_in_the_rock_say_how_deep_and_where_it_is_free(canyon):
    ground = float(canyon.height([GOAL[:2]])[0])
    with pytest.raises(InputError, match=r"goal.*2\.5 m inside the rock; raise it to z = "):
        canyon.route(START, (*GOAL[:2], ground - 2.5), 1.0)
    with pytest.raises(InputError, match="outside the terrain"):
        canyon.route(START, (5000, 0, 30), 1.0)
    with pytest.raises(InputError, match=r"start.*ceiling"):
        canyon.route(START, GOAL, 1.0, ceiling=10)
    with pytest.raises(InputError, match="not a point"):
        canyon.route((0, np.nan, 0), GOAL, 1.0)


@pytest.mark.parametrize(("through", "other"), [((40, 12, 20), True), ((40, -30, 20), False), ((40, -12, 20), False)])
def test_paths_on_other_sides_enclose_something(through, other):
    """A path past a tower on its right, at 12 m: on its left is another side, farther to the right is not."""
    world = World("flat", obstacles=[box("tower", (40, 0, 0), (8, 8, 40))])
    field = world.distance_field(box=[[-20, -60, -5], [100, 60, 80]], quick=True)
    one, another = (np.array([(0, 0, 20), place, (80, 0, 20)], float) for place in ((40, -12, 20), through))
    assert route.on_other_side(field, one, another) is route.on_other_side(field, another, one) is other
