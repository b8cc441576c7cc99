"""A helicopter that leans against its tail rotor is checked, and guessed, in the pose of its balance."""

import re
from dataclasses import replace

import numpy as np
import pytest

import vehsim
from vehsim import Mark
from vehsim.errors import InputError
from vehsim.lie.quaternions import yaw_of
from vehsim.planning.certificates import FINEST
from vehsim.planning.request.marks_near_obstacles import facing_clear, marks_too_near
from vehsim.planning.trim import balanced, steady, upright
from vehsim.world.obstacles.obstacles import box, moving

REST = (0.0, 0.0, 0.0)
ROTORS = {
    "rotor_radius": 5.35,
    "solidity": 0.0625,
    "tail_radius": 0.93,
    "tail_solidity": 0.13,
    "tail_height": 0.67,
    "hub_stiffness": 20000.0,
    "drag_angular": [2900.0, 2900.0, 600.0],
    "fin_area": 1.5,
    "fin_behind": 6.0,
    "fin_height": 0.6,
    "controls": {"yaw": {"lower": -1000.0, "upper": 3000.0, "scale": 1500.0}},
    "actuators": {"yaw": {"rate": 4000.0}},
}


def helicopter(asset):
    """A helicopter that hovers level, or one that leans against its tail rotor by 2.6 degrees."""
    return vehsim.load_vehicle("helicopter", parameters=ROTORS) if asset == "leaning" else vehsim.load_vehicle(asset)


@pytest.mark.parametrize(
    "asset, needed, wrong",
    [
        ("helicopter_lie", 0.3, "only 0.15 m from obstacle 'other' at any heading at frame 200"),
        # where both lean alike, one disc is above the other: 10.9 sin(3.4 deg), at which the thrust balances the tail
        # rotor's, less their thickness
        ("leaning", 0.33, "only 0.30 m from obstacle 'other' at any heading at frame 200"),
        ("leaning", 0.29, ""),
    ],
)
def test_a_mark_in_the_way_of_another_vehicle_is_refused_with_its_frame(asset, needed, wrong):
    """A helicopter that ends 10.9 m from another: their rotors are 10.7 m wide."""
    heli = helicopter(asset)
    hover = [vehsim.Mark(frame, position=(0, 0, 20), heading=0, velocity=REST) for frame in (1, 25)]
    goes = vehsim.plan(heli, None, hover, segments=8).clip
    world = vehsim.World(obstacles=[moving("other", goes)])
    start = vehsim.Mark(1, position=(-40, 0, 20), velocity=REST)
    for place, expected in ((10.9, wrong), (14.0, "")):
        marks = [start, vehsim.Mark(200, position=(place, 0, 20), velocity=REST)]
        found = [message for _, message, _ in marks_too_near(heli, world, marks, needed, 24)]
        assert found == [expected] * bool(expected)
        assert not list(marks_too_near(heli, world, marks, needed))


@pytest.mark.parametrize("asset, wind", [("helicopter_lie", REST), ("leaning", REST), ("leaning", (6.0, -3.0, 1.0))])
def test_a_helicopter_stays_where_it_is_upright(asset, wind):
    """Its simulation, which does not know of balances, moves less than 1 mm in a second, at any heading."""
    heli, still = helicopter(asset), (0.0, 0.0, 0.0)
    headings = np.linspace(-3, 3, 20)
    for heading, turn in zip(headings, upright(heli, headings, wind), strict=True):
        c, s = np.cos(heading), np.sin(heading)
        felt = (c * wind[0] + s * wind[1], c * wind[1] - s * wind[0], wind[2])
        state = vehsim.State((0.0, 0.0, 20.0), tuple(turn))
        clip = vehsim.simulate(heli, vehsim.World(wind=wind), steady(heli, still, felt).controls, state, 1.0)
        assert np.ptp(clip.positions, axis=0).max() < 1e-3


@pytest.mark.parametrize("asset, into", [("helicopter_lie", 2.69), ("leaning", 1.91)])
def test_a_mark_too_near_to_rock_is_refused_at_any_heading(asset, into):
    """In the canyon, 4 m from a wall: less than half the rotor. Tolerance and landings reduce the clearance."""
    heli, world = helicopter(asset), vehsim.World("canyon")

    def found(mark, clearance, *others, world=world):
        start = Mark(1, position=(0, 0, 30), velocity=REST)
        return [(i, message) for i, message, _ in marks_too_near(heli, world, [start, mark, *others], clearance, 24)]

    near = Mark(200, position=(36, 0, 28.8), velocity=REST)
    assert found(near, 0.5) == [(1, f"the vehicle reaches {into} m into rock at any heading")]
    # at the best of 720 headings, with the hulls where they are there
    yaw = np.linspace(0, 2 * np.pi, 720, endpoint=False)
    turns, channels = balanced(heli, yaw)
    gaps = world.clearance(heli, np.repeat([near.position], len(yaw), axis=0), turns, channels=channels)
    assert gaps.max() == pytest.approx(-into, abs=0.02)
    assert found(near, 0.5, world=vehsim.World("canyon", wind=(2, 2, 0)))
    assert found(replace(near, position=(24, 0, 26.4)), 0.5) == []
    free = replace(near, position=(32, 0, 28))
    ((_, message),) = found(free, 5.0)
    gap = float(re.fullmatch(r"only (.*) m from rock at any heading", message)[1])
    assert found(free, gap + 0.03) and found(free, gap - 0.03) == []
    assert found(replace(free, tolerance=0.2), gap + 0.3) == []
    assert found(free, gap + 0.3, Mark(300, position=(32, 0, 26), velocity=REST, on_ground=True)) == []
    with pytest.raises(InputError, match=r"mark\[1\].position = .*into rock at any heading"):
        vehsim.plan(heli, world, [Mark(1, position=(0, 0, 30), velocity=REST), near])


@pytest.mark.parametrize("seconds, distance, aside, swing", [(12, 60, 0.15, 1.0), (20, 300, 1.0, 4.0)])
def test_a_helicopter_flies_straight_although_its_torque_changes_with_speed(seconds, distance, aside, swing):
    """With least effort alone, the nose swings by 4 and 12 degrees and the path by 0.7 and 1.7 m."""
    heli, ends = helicopter("leaning"), ((1, 0), (1 + 24 * seconds, distance))
    marks = [Mark(frame, position=(x, 0, 20), heading=0, velocity=REST) for frame, x in ends]
    clip = vehsim.plan(heli, None, marks, refine=False).clip
    assert np.abs(clip.positions[:, 1]).max() < aside
    assert np.degrees(np.abs(yaw_of(clip.orientations))).max() < swing
    free = vehsim.plan(heli, None, marks, refine=False, cost={"effort": 1.0, "turning": 0.0}).clip
    assert np.abs(free.positions[:, 1]).max() > 1.2 * aside
    assert np.degrees(np.abs(yaw_of(free.orientations))).max() > 2 * swing


def test_a_flight_that_begins_in_motion_does_not_begin_in_a_spin():
    """Damping stops a spin without effort. A limit of the user replaces that of the start: it then begins faster."""
    heli, ends = helicopter("leaning"), ((1, (0, 0, 10), (12, 0, 0)), (49, (26, 6, 12), (12, 5, 0)))
    marks = [Mark(frame, position=place, velocity=speed) for frame, place, speed in ends]
    most = heli.character.limits["turn_rate"].brisk
    starts = [
        np.linalg.norm(vehsim.plan(heli, None, marks, character="stunt", limits=limits).clip.twists[0, :3])
        for limits in ({}, {"turn_rate": 2.0})
    ]
    assert starts[0] < most + 1e-5 < 1.5 < starts[1] < 2.0 + 1e-5


def slot():
    walls = [box(f"wall{s}", (0, s * 36.5, 0), (6, 60, 120)) for s in (1, -1)]
    return vehsim.World(obstacles=walls)


@pytest.mark.parametrize("heading, wrong", [(0, "only 0.95 m from obstacle 'wall1'"), (45, "")])
def test_a_slot_that_only_the_level_hulls_fit_is_refused_with_a_clearance_that_will_do(heading, wrong):
    """13 m between walls for 10.7 m and a clearance of 0.99 m: level, it has 1.12 m on either side; leaning, 0.95 m."""
    world, start = slot(), Mark(1, position=(-40, 0, 12), heading=0, velocity=REST)
    marks = [start, Mark(289, position=(0, 0, 12), heading=heading, velocity=REST)]
    assert not list(marks_too_near(helicopter("helicopter_lie"), world, marks, 0.99))
    found = list(marks_too_near(helicopter("leaning"), world, marks, 0.99))
    assert [message for _, message, _ in found] == [wrong] * bool(wrong)
    if found:
        assert found[0][2] == "keep the clearance of 0.99 m, or reduce it to 0.95"
    assert not list(marks_too_near(helicopter("leaning"), world, marks, 0.94))


@pytest.mark.parametrize("asset, turned", [("helicopter_lie", 0), ("leaning", 4)])
def test_a_mark_without_a_heading_is_turned_until_the_leaning_hulls_have_room(asset, turned):
    """Along its leg, in the slot, it would have 0.95 m; its rotor, a polygon of hulls, is narrower 4 degrees beside."""
    heli, start = helicopter(asset), Mark(1, position=(-40, 0, 12), heading=0, velocity=REST)
    given = [start, *(Mark(f, position=(0, 0, 12), velocity=REST, hold=n) for f, n in ((289, 24), (313, 0)))]
    faced = [start, *(replace(mark, heading=0.0) for mark in given[1:])]
    found = facing_clear(heli, slot(), given, faced, 0.965, 24)
    assert [abs(mark.heading) for mark in found] == [0, turned, turned] and found[1].heading == found[2].heading
    turns, channels = balanced(heli, np.radians([0, 2, 4, 6]))
    gaps = slot().clearance(heli, np.tile([0.0, 0, 12], (4, 1)), turns, channels=channels)
    assert ((gaps > 0.965 - FINEST) == (np.array([0, 2, 4, 6]) >= turned)).all()
    assert not list(marks_too_near(heli, slot(), found, 0.965, 24))
    # a given heading stays
    assert facing_clear(heli, slot(), faced, faced, 0.965, 24) == faced


@pytest.mark.parametrize("name", ["drift_car", "rally_car"])
def test_controls_without_effect_at_rest_are_released(name):
    """The balance does not depend on brakes, which have bounds but no force at rest."""
    vehicle = vehsim.load_vehicle(name)
    controls = dict(zip([control.name for control in vehicle.controls], steady(vehicle, REST).controls, strict=True))
    assert controls["brake"] == controls["handbrake"] == 0
    assert np.allclose(list(controls.values()), 0, atol=1e-6)
