"""Spray: how drops fly, where they come from, that they are the same whichever frames are asked for, and pictures."""

from dataclasses import replace
from fractions import Fraction

import igl
import numpy as np
import pytest
from pxr import Usd, UsdGeom
from scipy.integrate import solve_ivp

import vehsim
from vehsim.clip.clip import Clip
from vehsim.delivery.take import Take
from vehsim.exporters.checks.validate import validate_stage
from vehsim.exporters.pictures.spray import draw_spray
from vehsim.exporters.usd.scenery import spray as authored
from vehsim.exporters.usd.scenery.spray import DRAG, GENTLE, LIFE, MOST, Drops, flown
from vehsim.exporters.usd.scenery.water import floating, surfaces
from vehsim.exporters.usd.scenery.water_grid import lay_grid
from vehsim.exporters.usd.stage import StageReader
from vehsim.world.water.sea import sea_state
from vehsim.world.world import Water, World

BOAT = vehsim.load_vehicle("boat")
FPS = 24


def moving(velocity, seconds, height=0.0, water=None, wind=(0.0, 0.0, 0.0)):
    """A take of a boat that keeps its attitude and moves with ``velocity`` (3,) m/s from ``height`` m."""
    times = np.arange(int(seconds * FPS) + 1) / FPS
    n = len(times)
    positions = np.outer(times, velocity) + np.array([0.0, 0.0, height])
    empty, channels = np.zeros((n, 0)), {name: np.zeros(n) for name in BOAT.channels}
    twists, quaternions = np.tile([0.0, 0, 0, *velocity], (n, 1)), np.tile([1.0, 0, 0, 0], (n, 1))
    clip = Clip(BOAT, times, positions, quaternions, twists, empty, empty, np.zeros((n, 2)), channels, Fraction(FPS))
    world = World(water=Water(surface=water), wind=wind)
    return Take("sea", {"boat": clip}, world, (), Fraction(FPS), (1001, 1000 + n))


def sprays(take, frames):
    return [shown.drops for shown in surfaces(take, lay_grid(take), np.asarray(frames, float))]


def test_drops_fly_as_gravity_and_drag_say():
    drops = Drops(np.array([[1.0, 2.0, 3.0]]), np.array([[4.0, -2.0, 6.0]]), np.array([0.02]))
    wind, constant = np.array([5.0, 1.0, 0.0]), DRAG[0] + DRAG[1] * 0.02

    def rates(_, state):
        return [*state[3:], *((wind - state[3:]) / constant - [0.0, 0.0, 9.81])]

    exact = solve_ivp(rates, (0, 1.3), [1, 2, 3, 4, -2, 6], rtol=1e-10, atol=1e-10).y[:, -1]
    now = flown(drops, np.array([1.3]), wind)
    assert np.concatenate([now.places[0], now.velocities[0]]) == pytest.approx(exact, abs=5e-3)  # g is 9.80665


def test_a_hull_that_slams_throws_water_up_and_outwards():
    """A boat falls flat into calm water at 4 m/s; at rest, or in the air, there is no spray."""
    take = moving((0.0, 0.0, -4.0), 1.0, 2.0)
    drops = sprays(take, range(1001, 1026))
    counts = np.array([len(each.widths) for each in drops])
    assert counts[:8].max() == 0 and counts.max() > 500
    thrown = drops[int(counts.argmax())]
    assert np.median(thrown.velocities[:, 1] * np.sign(thrown.places[:, 1])) > 0.5
    assert sprays(moving((0.0, 0.0, 0.0), 0.5), [1013])[0].widths.size == 0
    assert sprays(moving((9.0, 0.0, 0.0), 0.5, 5.0), [1013])[0].widths.size == 0


def test_a_faster_hull_throws_more():
    slow, fast = (len(sprays(moving((speed, 0.0, 0.0), 1.0), [1025])[0].widths) for speed in (3.0, 9.0))
    assert fast > 2 * slow


@pytest.fixture(scope="module")
def storm():
    return moving((6.0, 0.0, 0.0), 2.0, 0.0, sea_state(1.5, seed=5), (0.0, 17.0, 0.0))


def test_spray_falls_on_a_sea_of_large_cells_too(monkeypatch):
    """The way is so long that the grid has no cell as fine as those that wind tears drops off."""
    take = moving((0.0, 0.0, -4.0), 1.0, 2.0)
    grid = lay_grid(take)
    frames = np.arange(1001.0, 1026.0)
    fine = [shown.drops for shown in surfaces(take, grid, frames)]
    monkeypatch.setattr(authored, "NEAR", 0.0)
    coarse = [shown.drops for shown in surfaces(take, grid, frames)]
    assert sum(len(each.widths) for each in coarse) == sum(len(each.widths) for each in fine) > 100


def test_spray_is_the_same_whichever_frames_are_asked_for(storm):
    whole, part = sprays(storm, range(1001, 1050)), sprays(storm, [1030, 1049])
    assert len(part[0].widths) > 100
    for one, other in zip((whole[29], whole[48]), part, strict=True):
        assert all((a == b).all() for a, b in zip(one, other, strict=True))


def test_its_drops_are_bounded_and_above_the_water(storm, monkeypatch):
    monkeypatch.setattr(authored, "MOST", 300)
    for drops, shown in zip(sprays(storm, [1049]), surfaces(storm, lay_grid(storm), np.array([1049.0])), strict=True):
        assert 20 < len(drops.widths) <= 300
        assert drops.places[:, 2].min() > shown.points[:, 2].min() - 0.1


def test_no_drop_flies_inside_a_hull(monkeypatch):
    """The boat falls into the water, and then is under its own spray."""
    take = moving((4.0, 0.0, -2.0), 0.6, 0.9)
    T_wr = take.clips["boat"].matrices()[-1]
    frame = float(take.frames[1])
    corners, faces = floating(take, np.array([frame]))["boat"].hull

    def aboard():
        (drops,) = sprays(take, [frame])
        own = (drops.places - T_wr[:3, 3]) @ T_wr[:3, :3]
        return sum(igl.winding_number(corners, faces, place) > 0.5 for place in own)

    assert aboard() == 0
    monkeypatch.setattr(authored, "aboard", lambda *_: [])
    assert aboard() > 10


def test_wind_tears_drops_off_crests_downwind(storm):
    """Without the boat's spray: with a boat high in the air."""
    flying = moving((0.0, 0.0, 0.0), 1.0, 30.0, storm.world.water.surface, (0.0, 17.0, 0.0))
    drops = sprays(flying, [1020])[0]
    assert len(drops.widths) > 20 and drops.velocities[:, 1].mean() > 3
    calm = replace(flying, world=World(water=flying.world.water, wind=(0.0, 6.0, 0.0)))
    assert sprays(calm, [1020])[0].widths.size == 0


def test_spray_is_on_the_stage_as_points(storm, tmp_path):
    path = storm.export(tmp_path) / "sea.usda"
    assert not validate_stage(path)
    stage = Usd.Stage.Open(str(path))
    points = UsdGeom.Points(stage.GetPrimAtPath("/sea/env/water/spray"))
    places, velocities, widths = (
        np.array(each.Get(1030))
        for each in (points.GetPointsAttr(), points.GetVelocitiesAttr(), points.GetWidthsAttr())
    )
    assert 100 < len(places) == len(velocities) == len(widths) <= MOST
    assert (np.array(points.GetExtentAttr().Get(1030))[1] > places.max(axis=0)).all()
    assert not points.GetPointsAttr().Get()  # at rest: none
    expected = sprays(storm, [1030])[0]
    for one, other in zip(StageReader(path).spray_at(1030.0), expected, strict=True):
        assert np.abs(one - other).max() < 1e-4
    assert GENTLE > 0 and LIFE < 5


def test_drops_are_drawn_before_what_is_behind_them():
    """A camera that looks along X: a drop 5 m ahead hides a wall at 10 m, and not one at 3 m."""
    view = np.zeros(3), np.array([1.0, 0, 0]), np.array([0, 0, 1.0])
    drops = np.array([[5.0, 0, 0]]), np.zeros((1, 3)), np.array([0.08])
    grey = np.full((90, 160, 3), 60, np.uint8)
    for wall, seen in ((10.0, True), (np.inf, True), (3.0, False)):
        white = np.full(3, 255.0)
        drawn = draw_spray(grey, np.full((90, 160), wall), drops, view, (0.5, 0.28), (0.0, 0.0), 1 / 24, white)
        assert (drawn[44, 80, 0] > 90) == seen and drawn[5, 5, 0] == 60
    moving_up = drops[0], np.array([[0.0, 0, 60.0]]), drops[2]
    streak = draw_spray(grey, np.full((90, 160), 10.0), moving_up, view, (0.5, 0.28), (0.0, 0.0), 1 / 24, white)
    rows, columns = np.nonzero(streak[..., 0] > 62)
    assert np.ptp(rows) > 2 * np.ptp(columns)
