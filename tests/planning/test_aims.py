"""Where a constraint points the nose on a leg, the headings at its ends are free: no turn is hurried."""

import numpy as np
import pytest

import vehsim
from vehsim import Mark
from vehsim.lie.quaternions import yaw_of
from vehsim.planning import look_at
from vehsim.planning.request.request import make_request

REST = (0.0, 0.0, 0.0)


def flown(at, frames, *marks):
    """Times s and yaw deg of a flight that looks at a place for some ``frames``."""
    looks = [look_at(at, frames, within=8)]
    plan = vehsim.plan(vehsim.load_vehicle("helicopter"), None, marks, terms=looks)
    assert plan.success and plan.message == "solved"
    return plan.clip.times, np.degrees(np.unwrap(yaw_of(plan.clip.orientations)))


@pytest.mark.parametrize(("at", "frames"), [((-60, 40, 2), (1025, 1150)), ((-20, 32, 2), (1097, 1289))])
def test_a_flight_that_looks_aside_on_its_leg_need_not_turn_at_its_ends(at, frames):
    """It turned at 80 degrees per second, as a stunt, after its start, and at 62 before its end."""
    first, last = Mark(1001, position=(-75, 0, 12), velocity=REST), Mark(1337, position=(-20, 15, 14), velocity=REST)
    times, yaw = flown(at, frames, first, last)
    assert np.abs(np.diff(yaw) / np.diff(times)).max() < 24.2


def test_long_after_a_look_the_nose_is_along_the_leg():
    first = Mark(1001, position=(-75, 0, 12), velocity=REST, heading=30)
    times, yaw = flown((-20, 32, 2), (1030, 1120), first, Mark(1337, position=(40, 15, 14), velocity=REST))
    assert yaw.max() > 30
    assert np.abs(yaw[times > 9]).max() < 10


def test_looks_on_other_legs_leave_a_mark_facing_along_its_own():
    places, frames = ((-75, 0, 12), (0, 0, 12), (60, 60, 12)), (1001, 1241, 1641)
    marks = [Mark(frame, position=place, velocity=REST) for frame, place in zip(frames, places, strict=True)]
    looks = [look_at((-20, 80, 2), (1097, 1145), within=8)]
    request = make_request(vehsim.load_vehicle("helicopter"), None, marks, fps=24, segments=32, terms=looks)
    assert [request.aimed(mark) for mark in request.marks if mark.position is not None] == [True, True, False]
