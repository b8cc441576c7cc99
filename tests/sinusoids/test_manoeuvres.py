"""Vehicles steered to marks: they arrive, keep limits, wheels do not slip, and momentum is conserved."""

import re
import textwrap
from itertools import pairwise

import numpy as np
import pytest
from PIL import Image

import vehsim
from vehsim.errors import SolveError
from vehsim.shot.offers import paint_offers
from vehsim.sinusoids import models
from vehsim.sinusoids.manoeuvres.manoeuvres import choose_manoeuvre, clearance, joined, manoeuvres, timed_clip
from vehsim.sinusoids.manoeuvres.options import SinusoidOptions
from vehsim.sinusoids.manoeuvres.picture import FAINT, paint
from vehsim.sinusoids.manoeuvres.rigs import rigged
from vehsim.sinusoids.manoeuvres.trailers import steer_trailers
from vehsim.sinusoids.steering import PACES, Stage, Steering, integrate
from vehsim.world.obstacles.obstacles import box, moving
from vehsim.world.world import World

TAU = 2 * np.pi
LIMITS = {"speed": 1.5, "steering_rate": 0.7}
LOOP = SinusoidOptions(amplitude=2.6, cycles=1, phase=0.0)


@pytest.fixture(scope="module")
def car():
    return rigged(vehsim.load_vehicle("car"))


@pytest.fixture(scope="module")
def parked(car):
    start = car.state(vehsim.State(position=(6.0, 0, 0)))
    return manoeuvres(car, start, car.state(vehsim.State(position=(0, -2.3, 0))), LOOP)


def test_every_manoeuvre_has_the_same_net_motion_within_its_limits(car, parked):
    assert len(parked) >= 3 and len({m.number for m in parked}) == len(parked)
    for m in parked:
        assert m.steering.end_error < 1e-9
        peaks = np.abs(m.steering.controls).max(axis=0)
        assert peaks[0] <= 1.5 * (1 + 1e-6) and peaks[1] <= car.limits["steering_rate"] * (1 + 1e-6)
        assert np.abs(m.steering.states[:, 3]).max() <= car.steering + 1e-9


def test_the_one_chosen_keeps_clear_of_obstacles(car, parked):
    """A box across the direct path of the loops leaves only the others; one over the goal leaves none."""
    start, goal = parked[0].steering.start, parked[0].steering.goal
    ahead = World().with_obstacles([box("ahead", (6.7, -2.3, 0), (4.3, 1.8, 1.2))])
    found = manoeuvres(car, start, goal, LOOP, ahead)
    chosen = choose_manoeuvre(found, None, 0.1)
    assert chosen.clearance >= 0.1 and min(m.clearance for m in found) < 0
    over = World().with_obstacles([box("over", (0.0, -2.3, 0), (1, 1, 1))])
    with pytest.raises(SolveError, match="none of"):
        choose_manoeuvre(manoeuvres(car, start, goal, LOOP, over), None, 0.1)


def facing(car, x, y, degrees):
    half = np.radians(degrees) / 2
    return car.state(vehsim.State(position=(x, y, 0), orientation=(np.cos(half), 0, 0, np.sin(half))))


def test_cars_park_at_any_heading_of_the_world(car):
    """Charts bound the turn, not the heading: across the world's X, and past 180 degrees, where it jumps by a turn."""
    poses = [facing(car, *pose) for pose in ((0, 0, 80), (1, 6, 100), (-5, 7, 175), (-11, 6, -170), (-16, 6, -160))]
    ways = [manoeuvres(car, a, b, LOOP, only=6)[0].steering for a, b in pairwise(poses)]
    whole = joined(ways, [0.0, 1.0])
    assert np.degrees(whole.goal[2]) == pytest.approx(200.0) and whole.end_error < 1e-8
    assert np.degrees(np.ptp(whole.states[:, 2])) < 300.0
    # too large a turn for loops: around a bend wide enough for wheels that steer by 35 degrees
    (round_it,) = manoeuvres(car, poses[0], facing(car, 6, 5, -150), LOOP, only=7)
    assert round_it.label == "round the bend" and np.abs(round_it.steering.states[:, 3]).max() < car.steering


def test_moving_obstacles_are_checked_at_the_time_of_passing(car, parked):
    """Another car does the same a minute later: only a motion at that time meets it."""
    steering, clip = timed_clip(car, parked[0].steering, None, 24, 1441)
    world = World().with_obstacles([moving("other", clip)])
    assert clearance(steering, car, world, None) == np.inf
    assert clearance(steering, car, world, 1441 / 24) < -1.0
    (found,) = manoeuvres(car, steering.start, steering.goal, LOOP, world, only=parked[0].number)
    assert found.clearance == np.inf


def test_manoeuvres_are_listed_and_drawn_with_obstacles(tmp_path):
    """`vehsim manoeuvres`: one line each, and an elliptic pillar in the picture as dark as a box."""
    shot = """
        [shot]
        schema = 1
        name = "alley"
        [[world.obstacle]]
        shape = "ellipse"
        name = "pillar"
        centre = [9, 1]
        radii = [2, 3]
        [[vehicle]]
        name = "taxi"
        asset = "car"
        [vehicle.motion]
        method = "sinusoid"
        manoeuvre = 6
        amplitude = 2.6
        cycles = 1
        phase = 0
        [[vehicle.motion.mark]]
        frame = 1001
        position = [0, 0, 0]
        [[vehicle.motion.mark]]
        frame = "free"
        position = [6, -2.3, 0]
    """
    (tmp_path / "alley.toml").write_text(textwrap.dedent(shot))
    line, picture = paint_offers(vehsim.Shot.load(tmp_path / "alley.toml"), tmp_path)
    assert re.fullmatch(r"alley: taxi: mark\[1\]: 6, 1 cycle, .*: \d+\.\d s, collides by \d\.\d\d m", line)
    with Image.open(picture) as image:
        pixels = np.asarray(image)
    assert np.all(pixels == FAINT, axis=2).mean() > 0.01


def test_manoeuvres_stay_near_a_limit_throughout(parked):
    """Start and stop take a quarter of a stage, and in between an input is close to its limit."""
    for m in parked:
        for stage in m.steering.stages:
            share = (np.abs(stage.inputs(np.linspace(0, stage.duration, 401))) / [1.5, 0.7]).max(axis=1)
            assert np.mean(share < 0.1) < 0.22 and np.mean(share) > 0.5, m.label


def test_an_even_pace_does_not_change_the_path():
    """The car ends at the same place, sooner."""
    system = models.car(2.0)
    stage = Stage("out", lambda s: np.column_stack([3 * np.sin(TAU * s) ** 4, 0.5 * np.cos(TAU * s) * s]))
    steering = Steering(system, np.zeros(4), np.zeros(4), (stage,))
    evened = steering.evened(LIMITS)
    assert np.abs(evened.states[-1] - steering.states[-1]).max() < 1e-11
    assert evened.fastest(LIMITS).duration < 0.75 * steering.fastest(LIMITS).duration
    for pace in PACES:
        assert np.abs(evened.eased(pace).states[-1] - steering.states[-1]).max() < 1e-11


def test_a_frame_that_is_too_early_reports_a_sufficient_one(car, parked):
    with pytest.raises(SolveError, match=r"too short .* use "):
        timed_clip(car, parked[0].steering, 2.0, 24, 1001)


def test_clips_meet_the_constraints(car, parked):
    """No slip: the lateral velocity at the rear axle is zero, and its path is that of the states."""
    steering, clip = timed_clip(car, parked[0].steering, None, 24, 1001)
    axle = clip.positions[:, :2] - 1.3 * np.column_stack([np.cos(steering.states[:, 2]), np.sin(steering.states[:, 2])])
    assert np.abs(axle - steering.states[:, :2]).max() < 1e-9
    sideways = clip.twists[:, 2] - 1.3 * clip.twists[:, 0]
    assert np.abs(sideways).max() < 1e-9


def test_hopper_keeps_its_angular_momentum_and_falls_freely():
    rig = rigged(vehsim.load_vehicle("hopper"), take_off=(0, 0, 0.9), landing=(2, 1, 0.9), heading=0.4)
    start, goal = np.zeros(3), np.array([-2 * np.pi, 0, 2 * np.pi])
    found = manoeuvres(rig, start, goal, SinusoidOptions(1.0, 2, 0.0))
    steering, clip = timed_clip(rig, found[0].steering, None, 24, 1001)
    assert steering.end_error < 1e-9 and np.allclose(clip.positions[-1], [2, 1, 0.9])
    psi, reach, theta = steering.states[:, 0], 0.9 * (1 + steering.states[:, 1]), steering.states[:, 2]
    plane = np.array([np.cos(0.4), np.sin(0.4)])
    down = -np.column_stack([np.outer(np.sin(psi + theta), plane), np.cos(psi + theta)])
    foot = clip.positions + reach[:, None] * down
    centre = (16.0 * clip.positions + 0.9 * foot) / 16.9
    fall = np.polynomial.polynomial.polyfit(clip.times, centre, 2)
    assert np.allclose(fall[2], [0, 0, -0.81], atol=1e-6)
    # about the centre of mass, from positions alone
    arm = foot - clip.positions
    along, up = arm[:, :2] @ plane, arm[:, 2]
    area = np.gradient(along, clip.times) * up - np.gradient(up, clip.times) * along
    spin = 0.69 * np.gradient(theta, clip.times) + 16.0 * 0.9 / 16.9 * area
    assert np.abs(spin[5:-5]).max() < 0.05 * np.abs(0.69 * np.gradient(theta, clip.times)).max()


@pytest.mark.parametrize("count", [3, 4, 5])
def test_long_trains_are_steered(count):
    hitches = [1.0] * count
    system = models.trailers(hitches)
    goal = np.zeros(system.n)
    goal[:2] = 4.0 * (count + 2), 2.0
    start = np.zeros(system.n)
    start[3:] = 0.2 * (-1.0) ** np.arange(count + 1)
    steering = steer_trailers(hitches, start, goal)
    x = steering.start
    for stage in steering.stages:
        x = integrate(system, stage, x, np.array([0.0, stage.duration]))[-1]
    assert np.abs(x - steering.goal).max() < 1e-6
    assert np.abs(np.diff(steering.states[:, 3:], axis=1)).max() < 1.4


def test_pictures_show_a_panel_for_every_manoeuvre(car, parked, tmp_path):
    path = paint([m.steering for m in parked[:2]], tmp_path / "ways.png", footprints=car.outlines, columns=2)
    with Image.open(path) as picture:
        assert picture.size == (1280, 400)
        assert len(picture.convert("RGB").getcolors(1 << 20)) > 100
