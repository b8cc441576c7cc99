"""Where a boat starts on the water: in balance on calm water at any speed, and on waves, moving with their surface."""

import warnings
from dataclasses import replace

import numpy as np
import pytest
from hulls import box, floating

import vehsim
from vehsim import Shot
from vehsim.lie.quaternions import continuous, from_yaw, rotate, tilt_of
from vehsim.world.water.buoyancy import Afloat
from vehsim.world.water.gliding import place_on_water
from vehsim.world.water.water import wave
from vehsim.world.world import Water, World

BOAT = vehsim.load_vehicle("boat")


def shot(world=None, **start):
    return Shot.from_dict(
        {
            "shot": {"schema": 1, "name": "start", "end_frame": 1002},
            "world": {"water": {"level": 3.0}} | (world or {}),
            "vehicle": [{"name": "boat", "asset": "boat", "motion": {"method": "simulate", "start": start}}],
        }
    )


@pytest.mark.parametrize("speed", [0.0, 2.0, 5.0, 8.0, 12.0])
@pytest.mark.parametrize("heading", [0.0, 2.0])
def test_on_calm_water_a_boat_starts_in_balance_at_its_speed(speed, heading):
    velocity = speed * np.array([np.cos(heading), np.sin(heading)])
    state = Afloat(BOAT, World(water=0.7)).riding((4.0, -3.0), heading, velocity)
    running, top = BOAT.hull.running, 1.0
    thrust = top * float(np.interp(speed, running.speeds, running.resistance)) if speed else 0.0
    clip = vehsim.simulate(BOAT, World(water=0.7), np.array([thrust, 0.0]), state, duration=0.5, actuators=False)
    _, pitch, roll = (np.degrees(angle) for angle in tilt_of(clip.orientations))
    assert np.ptp(clip.positions[:, 2]) < 0.01 and np.ptp(pitch) < 0.4 and np.abs(roll).max() < 0.05
    np.testing.assert_allclose(clip.positions[0, :2], [4.0, -3.0], atol=1e-9)


@pytest.mark.parametrize("heading", [0.3, 1.9, 4.0])
@pytest.mark.parametrize("velocity", [(0.0, 0.0), (3.0, -2.0)])
def test_on_a_long_wave_it_has_its_height_slope_and_vertical_speed(heading, velocity):
    water = Water(surface=wave(2.0, 120.0, heading=0.7, phase=0.4), level=1.5)
    body, place = floating(box(4.0, 2.0, 1.0), 4000.0), np.array([11.0, -7.0])
    environment = Afloat(body, World(water=water))
    state = environment.riding(place, heading, velocity)

    def surface(t):
        return float(water.height((place + np.array(velocity) * t)[None], t)[0])

    draft = environment.floating()[0]
    assert state.position[2] == pytest.approx(surface(0.0) + draft, abs=0.01)
    moving = rotate(state.orientation, state.twist[3:])
    np.testing.assert_allclose(moving[:2], velocity, atol=1e-9)
    assert moving[2] == pytest.approx((surface(0.01) - surface(-0.01)) / 0.02, abs=0.01)
    up = rotate(state.orientation, np.array([0.0, 0.0, 1.0]))
    np.testing.assert_allclose(up, water.normal(place[None], 0.0)[0], atol=2e-3)


def test_the_start_of_a_shot_is_on_the_water():
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for start in ({}, {"position": [1, 2, 3.0]}, {"heading": 90, "velocity": [0, 2, 0]}):
            clip = shot(**start).solve().clips["boat"]
            assert clip.positions[0, 2] == pytest.approx(3.0, abs=0.05)


def test_a_start_far_from_the_water_is_warned_about_and_dropped_on_request():
    with pytest.warns(UserWarning, match=r"starts at z = 5\.00 m and was put on the water, at 3\.0"):
        clip = shot(position=[0, 0, 5]).solve().clips["boat"]
    assert clip.positions[0, 2] == pytest.approx(3.0, abs=0.05)
    for start in ({"afloat": False}, {"orientation": [1, 0, 0, 0]}, {"velocity": [0, 0, -1]}, {"spin": [10, 0, 0]}):
        assert shot(position=[0, 0, 5], **start).solve().clips["boat"].positions[0, 2] == 5.0


def test_a_boat_on_a_beach_stays_where_it_is_put(tmp_path):
    x = np.linspace(-30.0, 30.0, 61)
    np.savez(tmp_path / "beach.npz", heights=np.tile(3.0 + 0.1 * x, (61, 1)), cell=1.0, origin=[-30.0, -30.0])
    world = {"terrain": str(tmp_path / "beach.npz"), "contact": {"friction": 0.5}}
    for place, z in (([20, 0, 5.6], 5.6), ([-25, 0, 2.9], 3.0)):
        clip = shot(world, position=place).solve().clips["boat"]
        assert clip.positions[0, 2] == pytest.approx(z, abs=0.01)


def test_a_planned_boat_floats_at_the_level_of_the_water():
    """It kept the z of its marks, and drove 1.7 m below the surface without a word."""
    marks = [vehsim.Mark(frame, position=(x, 0, 0), velocity=(0, 0, 0)) for frame, x in ((0, 0), (240, 8))]
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        high = vehsim.plan(BOAT, World(water=1.7), marks=marks, fps=24).clip
    np.testing.assert_allclose(high.positions[[0, -1], 2], 1.7, atol=1e-3)
    assert high.positions[:, 2].min() > 1.699 and high.positions[:, 2].max() < 1.72
    calm = vehsim.plan(BOAT, World(water=0.0), marks=marks, fps=24).clip
    np.testing.assert_array_equal(high.positions[:, :2], calm.positions[:, :2])
    with pytest.warns(UserWarning, match="5.00 m: boat floats on the water, at 1.70 m; give that height, or 0"):
        vehsim.plan(BOAT, World(water=1.7), marks=[mark_at(5.0, mark) for mark in marks], fps=24)


@pytest.mark.parametrize(
    ("water", "ignored"),
    [
        ({"current": [-2, 0, 0]}, "current"),
        ({"wave": [{"height": 0.5, "length": 18}]}, "waves"),
        ({"sea": {"height": 1}, "current": [1, 0, 0]}, "waves and current"),
    ],
)
def test_what_a_planned_boat_ignores_of_its_water_is_told(water, ignored):
    marks = [{"frame": 1001 + 240 * k, "position": [8 * k, 0, 0], "velocity": [0, 0, 0]} for k in (0, 1)]
    motion = {"method": "plan", "mark": marks}
    (problem,) = Shot.from_dict(
        {
            "shot": {"schema": 1, "name": "river"},
            "world": {"water": water},
            "vehicle": [{"name": "ferry", "asset": "boat", "motion": motion}],
        }
    ).check()
    assert problem.severity == "warning" and problem.key == "vehicle[0].motion.mark"
    assert f"planned on calm, still water, without the {ignored};" in str(problem)


@pytest.mark.parametrize(("asset", "told"), [("helicopter", True), ("boat", True), ("car_lie", False)])
def test_a_plan_without_the_gusts_is_told(asset, told):
    ends = [{"frame": 1001 + 240 * k, "position": [20 * k, 0, 30 * (asset == "helicopter")]} for k in (0, 1)]
    found = Shot.from_dict(
        {
            "shot": {"schema": 1, "name": "windy"},
            "world": {"wind": [3, 0, 0], "gusts": {}},
            "vehicle": [{"name": "it", "asset": asset, "motion": {"method": "plan", "mark": ends}}],
        }
    ).check()
    assert any("in the steady wind, without the gusts" in str(problem) for problem in found) == told


def level(speed):
    """A boat in the plane at a steady speed, as it is solved."""
    marks = [vehsim.Mark(24 * k, position=(speed * k, 2, 0), velocity=(speed, 0, 0)) for k in range(3)]
    clip = vehsim.plan(BOAT, World(), marks=marks, fps=24, character="stunt", segments=12).clip
    assert np.ptp(clip.positions[:, 2]) == 0 and np.abs(clip.twists[:, 1] - speed).max() < 0.05 * speed
    return clip


@pytest.mark.parametrize(("speed", "near"), [(1.5, 0.005), (3.0, 0.03), (5.0, 0.03), (7.0, 0.02), (10.0, 0.02)])
def test_a_planned_boat_runs_as_forces_on_its_hull_balance_at_its_speed(speed, near):
    clip = level(speed)
    placed = place_on_water(replace(clip, positions=clip.positions + np.array([0, 0, 1.7])), World(water=1.7))
    state = Afloat(BOAT, World(water=1.7)).riding(velocity=(speed, 0.0))
    _, pitch, roll = tilt_of(placed.orientations)
    wanted = tilt_of(np.atleast_2d(state.orientation))[1][0]
    np.testing.assert_allclose(np.degrees(pitch[[0, -1]]), np.degrees(wanted), atol=0.2)
    np.testing.assert_allclose(placed.positions[[0, -1], 2], state.position[2], atol=near)
    assert np.abs(roll).max() < 1e-12
    assert np.array_equal(placed.positions[:, :2], clip.at(placed.times).positions[:, :2])


def test_a_boat_is_placed_once_and_only_where_there_is_water():
    clip = level(8.0)
    placed = place_on_water(clip, World(water=0.0))
    assert place_on_water(placed, World(water=0.0)) is placed and place_on_water(clip, World()) is clip
    halves = placed.at(np.linspace(0, placed.times[-1], 37))
    assert place_on_water(halves, World(water=0.0)) is halves
    back = replace(clip, twists=-clip.twists)
    assert place_on_water(back, World(water=0.0)) is back  # astern, a hull stays level


def test_orientations_are_continuous_where_a_boat_that_rests_begins_to_run():
    """A turn beyond half a turn: samples at rest keep their quaternions, which may have the other sign."""
    clip = level(8.0)
    yaw, ahead = np.linspace(2.0, 5.0, len(clip)), np.where(clip.times < 1.0, 0.0, clip.twists[:, 1])
    twists = np.column_stack([clip.twists[:, 0], ahead, clip.twists[:, 2]])
    wrapped = from_yaw((yaw + np.pi) % (2 * np.pi) - np.pi)
    placed = place_on_water(replace(clip, twists=twists, orientations=continuous(-wrapped)), World(water=0.0))
    assert (np.einsum("ni,ni->n", placed.orientations[1:], placed.orientations[:-1]) > 0.9).all()


def mark_at(height, mark):
    return replace(mark, position=(*mark.position[:2], height))
