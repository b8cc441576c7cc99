"""Holds: the vehicle stays where it is, in balance, on any number of segments, also when its controls are executed."""

from dataclasses import replace

import casadi as ca
import numpy as np
import pytest

import vehsim
from vehsim import Mark, World
from vehsim.integrators.continuous import execute
from vehsim.planning import look_at, stay
from vehsim.planning.explain.balance import out_of_balance
from vehsim.planning.problem.transcription import transcribe
from vehsim.planning.request.request import make_request
from vehsim.world.terrain.terrain import Terrain

REST = (0.0, 0.0, 0.0)
PLANNED = {  # height, distance, and number of frames
    "helicopter": (20.0, 30.0, 144),
    "boat": (0.0, 15.0, 216),
    "car": (0.0, 15.0, 144),
    "simple_car": (0.0, 15.0, 144),
    "two_wheeled": (0.0, 2.0, 144),
    "truck": (0.0, 25.0, 240),
    "snakeboard": (0.0, 1.2, 144),
}
HOLD = 36
TIGHT = 1e-6
"""What constraints that are met leave at most: m, rad, m/s, and shares of the controls' scales."""


def rest(frame, position, **keys):
    return Mark(frame, position=position, velocity=REST, **keys)


def journey(name, place, free):
    """Marks with a hold at the ``place``: first, middle or last."""
    z, way, frames = PLANNED[name]
    first, middle, last = (0.0, 0.0, z), (way, way / 8, z), (2 * way, 0.0, z)
    if place == "first":
        return [rest(1, first, heading=0, hold=HOLD), rest("free" if free else 1 + HOLD + frames, middle)]
    held = rest("free" if free else 1 + frames, middle, hold=HOLD)
    if place == "last":
        return [rest(1, first, heading=0), held]
    return [rest(1, first, heading=0), held, rest("free" if free else 1 + 2 * frames + HOLD, last)]


def holds(plan):
    """The first and last knot of the phase of every hold."""
    iterate = plan._iterate
    knots, marks = iterate.layout.mark_knots, iterate.request.marks
    return [(knots[i], knots[i + 1]) for i, mark in enumerate(marks[:-1]) if mark.hold]


def assert_held(plan):
    """Assert that nothing moves, turns or leans on the clip, nor when RK4 executes the controls."""
    assert plan.success, plan.message
    iterate, found = plan._iterate, holds(plan)
    assert found
    g, r, pi, c, steps = iterate.knots()
    for first, last in found:
        still = plan.clip.at(np.linspace(plan.clip.times[first], plan.clip.times[last], 101))
        assert np.ptp(still.positions, axis=0).max() < TIGHT
        assert np.ptp(still.orientations, axis=0).max() < TIGHT
        assert np.abs(still.twists).max() < TIGHT
        if iterate.transcription.vehicle.group.planar and not np.any(iterate.request.wind):  # else it drives
            for name, values in still.channels.items():
                assert np.ptp(values) < 1e-5, name
        assert np.ptp(c[first : last + 1] / iterate.transcription.control_scale, axis=0).max(initial=0.0) < TIGHT
        z = np.ravel(np.asarray(iterate.transcription.mechanics.knot_velocity_guess(r[first], pi[first], c[first])))
        run = execute(
            iterate.transcription.vehicle,
            g[first],
            r[first],
            z,
            c[first : last + 1],
            steps[first:last],
            iterate.request.wind,
        )
        for coordinates in run:
            assert np.ptp(coordinates, axis=0).max(initial=0.0) < 1e-6


@pytest.mark.parametrize("free", [False, True], ids=["framed", "free"])
@pytest.mark.parametrize("place", ["first", "middle", "last"])
@pytest.mark.parametrize("name", PLANNED)
def test_held_vehicles_stand_still(name, place, free):
    assert_held(vehsim.plan(vehsim.load_vehicle(name), None, journey(name, place, free), segments=48))


@pytest.mark.parametrize("segments", [9, 16, 27, 64, 96])
@pytest.mark.parametrize("name", ["helicopter", "car"])
def test_held_vehicles_stand_still_on_any_number_of_segments(name, segments):
    plan = vehsim.plan(vehsim.load_vehicle(name), None, journey(name, "last", True), segments=segments)
    assert_held(plan)


@pytest.mark.parametrize("hold", [1, 240])
def test_short_and_long_holds(hold):
    marks = journey("helicopter", "middle", False)
    marks = [marks[0], replace(marks[1], hold=hold, tolerance=0.5), replace(marks[2], frame=1 + 2 * 144 + hold)]
    assert_held(vehsim.plan(vehsim.load_vehicle("helicopter"), None, marks, segments=32))


def test_a_clip_with_a_hold_can_be_the_guess():
    """All its nodes in the hold are at one time of the clip."""
    marks = journey("boat", "middle", False)
    boat = vehsim.load_vehicle("boat")
    first = vehsim.plan(boat, None, marks, segments=48)
    assert_held(vehsim.plan(boat, None, marks, segments=48, guess=first.clip))


def test_a_range_may_begin_within_a_hold():
    """The hold is divided there, and still is one hold."""
    marks = [rest(1, (0, 0, 20)), rest(145, (30, 10, 20), hold=72), rest(361, (80, 0, 20))]
    tower = (30.0, 60.0, 10.0)
    terms = [look_at(tower, (160, 190), within=6.0), stay((130, 180), above=15.0)]
    plan = vehsim.plan(vehsim.load_vehicle("helicopter"), None, marks, segments=48, terms=terms)
    assert_held(plan)
    assert len(holds(plan)) == 4  # cut at 160, 180 and 190
    still = plan.clip.at(np.linspace(144 / 24, 216 / 24, 50))
    assert np.ptp(still.positions, axis=0).max() < TIGHT and np.ptp(still.orientations, axis=0).max() < TIGHT


def test_a_loop_may_begin_and_end_with_a_hold():
    marks = [rest(1, (0, 0, 20), hold=24), rest("free", (30, 10, 20), hold=24), rest("free", (0, 0, 20), hold=12)]
    plan = vehsim.plan(vehsim.load_vehicle("helicopter"), None, marks, segments=24, loop=True, refine=False)
    assert_held(plan)
    np.testing.assert_allclose(plan.clip.positions[-1], plan.clip.positions[0], atol=TIGHT)
    np.testing.assert_allclose(plan.clip.controls[-1], plan.clip.controls[0], rtol=TIGHT, atol=1e-6)


def test_holds_are_kept_by_a_replan():
    plan = vehsim.plan(vehsim.load_vehicle("helicopter"), None, journey("helicopter", "last", False), segments=32)
    moved = plan.replan([plan.marks[0], rest(150, (34, 6, 22), hold=60)])
    assert_held(moved)


def windy(name):
    """A helicopter with a fuselage that has drag; the boat as it is."""
    vehicle = vehsim.load_vehicle(name)
    if name == "boat":
        return vehicle
    push = ca.DM([0.6, 3.0, 3.0])
    return replace(vehicle, drag=lambda air: ca.vertcat(0, 0, 0, -push * air[3:6] * ca.fabs(air[3:6])), feels_wind=True)


@pytest.mark.parametrize(("name", "wind"), [("helicopter", (0, 12, 0)), ("boat", (-6, 4, 0))])
def test_holds_lean_into_the_wind(name, wind):
    plan = vehsim.plan(windy(name), World(wind=wind), journey(name, "last", True), segments=32)
    assert_held(plan)
    calm = vehsim.plan(windy(name), None, journey(name, "last", True), segments=32)
    assert np.abs(plan.clip.orientations[-1] - calm.clip.orientations[-1]).max() > 1e-3
    assert plan.executed.final < 0.1


def test_a_boat_that_cannot_hold_broadside_to_the_wind_is_reported():
    boat = vehsim.load_vehicle("boat")
    marks = [rest(1, REST), rest("free", (40, 5, 0), heading=90, hold=48)]
    with pytest.warns(UserWarning, match=r"mark\[1\].hold: in 6 m/s of wind the boat cannot.*use heading = 0"):
        plan = vehsim.plan(boat, World(wind=(-6, 0, 0)), marks, segments=32)
    assert not plan.success
    gale = [rest(1, REST), rest("free", (40, 5, 0), hold=48)]
    with pytest.warns(UserWarning, match="weaken the wind"):
        assert not vehsim.plan(boat, World(wind=(-60, 5, 0)), gale, segments=32).success


def test_a_car_holds_on_a_slope_unless_its_brakes_are_too_weak():
    car, world = vehsim.load_vehicle("car"), World("hills")
    plan = vehsim.plan(car, world, journey("car", "last", True), segments=32)
    assert plan.success
    first, last = holds(plan)[0]
    held = plan._iterate.clip
    assert np.ptp(held.positions[first : last + 1], axis=0).max() < TIGHT
    assert abs(held.controls[last, 0]) > 1.0  # the torque that carries its weight
    weak = replace(
        car, controls=tuple(replace(c, lower=-1.0, upper=1.0) if c.name == "torque" else c for c in car.controls)
    )
    here = np.array([15.0, 2.0])
    around = world.height(here + np.array([(1, 0), (-1, 0), (0, 1), (0, -1)]))
    uphill = float(np.degrees(np.arctan2(around[2] - around[3], around[0] - around[1])))
    marks = [rest(1, (*here, 0), heading=uphill, hold=12), rest("free", (30, 2, 0))]
    request = make_request(weak, world, marks, fps=24, segments=8)
    (_, message, remedy), *_ = out_of_balance(weak, transcribe(request.weighed), request.marks, request.wind)
    assert "on this slope the car cannot stand still there" in message and "heading" in remedy


@pytest.mark.parametrize(
    ("name", "surface", "heading"), [("rally_car", "ice", 90), ("rally_car", "ice", 0), ("drift_car", "asphalt", 0)]
)
def test_a_car_whose_tyres_slip_holds_on_a_slope_without_visible_creep(name, surface, heading):
    """Rounded friction leaves it out of balance, by far less than can be seen; brakes hold it, not its engine."""
    car, x = vehsim.load_vehicle(name, {"surface": surface}), np.arange(-60, 61, 10.0)
    world = World(Terrain("slope", 0.1 * np.tile(x, (13, 1)), (-60.0, -60.0), (10.0, 10.0)))
    place = (8 * np.cos(np.radians(heading)), 8 * np.sin(np.radians(heading)), 0)
    marks = [rest(1, REST, heading=heading), rest(217, place, heading=heading, hold=48)]
    plan = vehsim.plan(car, world, marks, segments=16, refine=False)
    assert plan.success, plan.message
    assert [row.met for row in plan.audit if "hold" in row.key] == [True, True]
    iterate, first = plan._iterate, holds(plan)[0][0]
    g, r, _, c, _ = iterate.knots()
    vehicle = iterate.transcription.vehicle
    still = np.zeros(vehicle.group.dim + len(vehicle.dynamic))
    controls = np.repeat(c[first : first + 1], 11, axis=0)
    run, _ = execute(vehicle, g[first], r[first], still, controls, np.full(10, 0.2), np.zeros(3))
    assert np.linalg.norm(run[-1, 1:] - run[0, 1:]) < 1e-3


@pytest.mark.parametrize("hold", [0, 48])
def test_landing_for_a_hold_is_as_gentle(hold):
    helicopter = vehsim.load_vehicle("helicopter_lie")  # others stand level by the ground's friction, out of balance
    marks = [rest(1, (0, 0, 30), heading=0), Mark(265, position=(60, 10, 20), heading=0, on_ground=True, hold=hold)]
    plan = vehsim.plan(helicopter, World("flat"), marks, segments=48, refine=False)
    assert plan.success
    times = np.linspace(0.0, 264 / 24, 3000)
    motion = plan.clip.at(times)
    away = np.linalg.norm(motion.positions - motion.positions[-1], axis=1)
    down = -np.gradient(motion.positions[:, 2], times)
    assert (down <= 0.5 + away + 0.2).all()
    if hold:
        assert_held(plan)


def test_takes_off_from_a_hold_on_the_ground_in_wind():
    """The ground carries it, level: the wind's effect in the air does not matter there."""
    marks = [
        Mark(1, position=(0, 0, 5), heading=0, on_ground=True, hold=36),
        rest(265, (60, 10, 20), heading=0),
    ]
    plan = vehsim.plan(windy("helicopter"), World("flat", wind=(5, 3, 0)), marks, segments=48)
    assert plan.success and plan.executed.final < 0.5
    still = plan.clip.at(np.linspace(0.0, 36 / 24, 50))
    assert np.ptp(still.positions, axis=0).max() < TIGHT and np.abs(still.twists).max() < TIGHT


def test_between_knots_wheels_roll_where_the_car_goes(tmp_path):
    """Near a stop, they turned on for 4 cm: their turning was interpolated without its rate."""
    places = [(1, 0, 0), (97, 15, 96), (289, 30, 24)]
    marks = [Mark(frame, position=(x, 0, 0), heading=0, velocity=REST, hold=hold) for frame, x, hold in places]
    plan = vehsim.plan(vehsim.load_vehicle("car"), None, marks, segments=24)
    assert plan.success
    clips = [plan.clip, vehsim.Clip.load(plan.clip.save(tmp_path / "car"), plan.clip.vehicle)]
    for clip in (*clips, plan.clip.at(np.linspace(0, plan.clip.duration, 100))):
        fine = clip.at(np.arange(0, clip.duration, 1 / 192))
        turning = np.gradient(fine.channels["roll_rl"], fine.times)
        np.testing.assert_allclose(fine.channel_rates["roll_rl"][1:-1], turning[1:-1], atol=0.02)
        radius = fine.channels["roll_rl"][-1] / fine.positions[-1, 0]
        np.testing.assert_allclose(fine.channels["roll_rl"], radius * fine.positions[:, 0], atol=0.01)
