"""Where a plan begins at speed with a free heading or attitude, the vehicle begins as it would go there."""

from __future__ import annotations

import math
import warnings

import numpy as np
import pytest

import vehsim
from vehsim import Mark
from vehsim.lie.quaternions import yaw_of
from vehsim.planning import Cost, look_at
from vehsim.planning.blocks import blocks_of
from vehsim.planning.constraints.easing import Easing
from vehsim.planning.problem.transcription import transcribe
from vehsim.planning.request.request import make_request


def ways(degrees: float, speed: float) -> tuple[float, float, float]:
    return speed * math.cos(math.radians(degrees)), speed * math.sin(math.radians(degrees)), 0.0


def slip(clip, first: int, last: int) -> np.ndarray:
    """Angles, deg, between the nose and the motion of the middle of mass."""
    return np.degrees(np.arctan2(clip.twists[first:last, 2], clip.twists[first:last, 1]))


@pytest.mark.parametrize(
    ("asset", "speeds", "place", "turn", "frames", "most", "before"),
    [
        ("drift_car", (8.8, 6.7), (46.0, 1.2, 0.0), 3.0, 158, 1.0, 18.0),
        ("boat", (4.0, 4.1), (9.0, 2.0, 0.0), 14.0, 48, 10.0, 18.0),
    ],
)
def test_it_begins_with_the_slip_of_a_steady_bend(asset, speeds, place, turn, frames, most, before):
    """A drive that is nearly straight began with a slide; a boat with twice the slip of its bend."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        plan = vehsim.plan(
            vehsim.load_vehicle(asset),
            None,
            [
                Mark(1, position=(0, 0, 0), velocity=ways(0, speeds[0])),
                Mark(1 + frames, position=place, velocity=ways(turn, speeds[1])),
            ],
        )
    assert plan.success
    clip = plan.clip
    assert np.abs(slip(clip, 0, 12)).max() < most < before
    early = clip.times <= 0.15
    change = np.polyfit(clip.times[early], clip.twists[early], 1)[0]
    assert np.abs(change[[0, 2]]).max() < 0.5


@pytest.mark.parametrize(
    ("asset", "speed", "place", "frames"), [("boat", 3.0, 45.0, 504), ("drift_car", 6.0, 33.0, 312)]
)
def test_a_heading_along_the_velocity_begins_without_a_spin(asset, speed, place, frames):
    """They spun at 74 and 67 degrees per second, which water and tyres then stopped; the car was driven as brisk."""
    turn = -47.0 if asset == "boat" else 2.0
    x, y, _ = ways(turn, place)
    last = {"velocity": ways(1.5 * turn, speed)} if asset == "boat" else {"velocity": (0, 0, 0), "heading": 1.5 * turn}
    marks = [
        Mark(1, position=(0, 0, 0), heading=0, velocity=(speed, 0, 0)),
        Mark(1 + frames, position=(x, y, 0), **last),
    ]
    plan = vehsim.plan(vehsim.load_vehicle(asset), None, marks)
    assert plan.success and "driven" not in plan.message
    assert np.degrees(np.abs(plan.clip.twists[:, 0])).max() < 20.0


def first_slips(clip) -> np.ndarray:
    """Longitudinal slips of all wheels in the first three frames (3, 4)."""
    frames = clip.resample()
    return np.array([frames.channels[f"slip_ratio_{wheel}"][:3] for wheel in ("fl", "fr", "rl", "rr")]).T


@pytest.mark.parametrize("heading", [0.0, None])
def test_a_stunt_begins_in_balance(heading):
    """It began with 49 and 89 degrees of yaw per second, which its tyres stopped, and with spun-up wheels."""
    ends = [
        Mark(1, position=(0, 0, 0), velocity=(13, 0, 0), heading=heading),
        Mark(97, position=(40, 6, 0), velocity=(0, 0, 0), heading=heading),
    ]
    clip = vehsim.plan(vehsim.load_vehicle("drift_car"), None, ends, character="stunt").clip
    early = clip.times <= 0.15
    change = np.polyfit(clip.times[early], clip.twists[early], 1)[0]
    assert np.abs(change[[0, 2]]).max() < 1.5
    assert np.abs(slip(clip, 0, 6)).max() < 1.0
    assert np.abs(np.diff(first_slips(clip), axis=0)).max() < 0.01


def rolls(clip) -> np.ndarray:
    """Roll, deg, right side down."""
    w, x, y, z = clip.orientations.T
    return np.degrees(np.arctan2(2 * (y * z + w * x), 1 - 2 * (x**2 + y**2)))


@pytest.mark.parametrize(("speed", "turn", "bank"), [(10.0, 0.0, 2.1), (20.0, -60.0, -15.0)])
def test_a_flight_begins_and_ends_in_a_coordinated_turn(speed, turn, bank):
    """At 10 m/s it began with a roll of 12 degrees, and rolled back at 25 degrees per second."""
    place = (120.0, 0.0) if turn == 0 else (130.0, -75.0)
    marks = [
        Mark(1, position=(0, 0, 60), velocity=ways(0, speed)),
        Mark(1 + 24 * (12 if turn == 0 else 8), position=(*place, 60), velocity=ways(turn, speed)),
    ]
    plan = vehsim.plan(vehsim.load_vehicle("helicopter"), None, marks)
    assert plan.success
    roll = rolls(plan.clip)
    assert np.abs(np.diff(roll) / np.diff(plan.clip.times))[[0, -1]].max() < 4.0
    assert np.abs(roll + bank).max() < 5.0


@pytest.mark.parametrize(("speed", "seconds", "heading"), [(20.0, 20, 0.0), (20.0, 20, None), (10.0, 8, 0.0)])
def test_a_flight_between_moving_marks_on_a_line_is_straight(speed, seconds, heading):
    """It began banked by three degrees more than its balance, and went 0.95, 0.98 and 0.34 m aside."""
    marks = [
        Mark(1 + 24 * t, position=(speed * t, 0, 60), velocity=(speed, 0, 0), heading=heading) for t in (0, seconds)
    ]
    plan = vehsim.plan(vehsim.load_vehicle("helicopter"), None, marks)
    assert plan.success
    assert np.abs(plan.clip.positions[:, 1]).max() < 0.001 * speed * seconds
    assert np.ptp(rolls(plan.clip)) < 1.5


@pytest.mark.parametrize(
    ("options", "straight"),
    [
        ({}, True),
        ({"cost": {"safety": 1.0, "effort": 1.0}}, False),
        ({"terms": [Cost("aside", lambda k: (k.position[1] - 2) ** 2, integral=True)]}, False),
    ],
)
def test_costs_that_may_ask_for_turns_set_no_price_on_them(options, straight):
    marks = [Mark(1 + 24 * t, position=(10 * t, 0, 60), velocity=(10, 0, 0)) for t in (0, 8)]
    request = make_request(vehsim.load_vehicle("helicopter"), None, marks, fps=24, segments=16, **options)
    (block,) = [block for block in blocks_of(request, transcribe(request.weighed), None) if isinstance(block, Easing)]
    assert block.straight is straight and len(block.steady) == 2


def test_a_flight_on_an_arc_begins_in_its_turn():
    radius, speed = 150.0, 20.0
    marks = []
    for angle in (0.0, 30.0, 60.0):
        a = np.radians(angle)
        place = (radius * np.sin(a), radius * (1 - np.cos(a)), 30)
        marks.append(Mark(1 + round(24 * radius * a / speed), position=place, velocity=ways(angle, speed)))
    roll = rolls(vehsim.plan(vehsim.load_vehicle("helicopter"), None, marks).clip)
    turn = np.degrees(np.arctan(speed**2 / (radius * 9.81)))
    assert np.abs(roll + turn).max() < 3.0 and abs(roll[0] + turn) < 3.0


def easing(first: Mark, vehicle: str = "drift_car", **more) -> Easing:
    vehicle = vehsim.load_vehicle(vehicle)
    last = Mark(100, position=(30, 2, 0), velocity=(0, 0, 0))
    request = make_request(vehicle, None, [first, last], fps=24, segments=16, **more)
    return next(b for b in blocks_of(request, transcribe(request.weighed), None) if isinstance(b, Easing))


@pytest.mark.parametrize(
    ("more", "character", "expected"),
    [
        ({"velocity": (9, 0, 0)}, "normal", True),
        ({"speed": 9.0}, "calm", True),
        ({}, "normal", True),
        ({"velocity": (9, 0, 0), "heading": 3.0}, "normal", True),
        ({"velocity": (9, 0, 0), "heading": 20.0}, "normal", False),  # a drift that the mark asks for
        ({"velocity": (9, 0, 0), "heading": 180.0}, "normal", False),
        ({"speed": 9.0, "heading": 20.0}, "normal", True),
        ({"velocity": (0, 0, 0)}, "normal", False),
        ({"speed": 0.0}, "normal", False),
        ({"velocity": (9, 0, 0)}, "stunt", True),
        ({"velocity": (9, 0, 0), "heading": 20.0}, "stunt", False),
    ],
)
def test_a_slide_and_rest_leave_the_slip_free(more, character, expected):
    assert easing(Mark(1, position=(0, 0, 0), **more), character=character).steady == [0] * expected


@pytest.mark.parametrize(
    ("more", "character", "expected"),
    [
        ({"velocity": (9, 0, 0)}, "normal", True),
        ({"velocity": (9, 0, 0), "heading": 20.0}, "calm", True),
        ({"velocity": (9, 0, 0), "orientation": (1, 0, 0, 0)}, "normal", False),
        ({"velocity": (0, 0, 0)}, "normal", False),
        ({"velocity": (9, 0, 0)}, "stunt", False),
    ],
)
def test_an_attitude_rest_and_stunts_leave_a_flight_free(more, character, expected):
    first = Mark(1, position=(0, 0, 30), **more)
    assert easing(first, "helicopter", character=character).steady == [0] * expected


def test_a_nose_on_a_place_turns_at_the_ends_the_way_that_the_place_passes():
    """It turned the other way there, at 3.5 and 2.4 deg/s, within the tolerance of the look."""
    marks = [Mark(frame, position=(x, 0, 30), velocity=(12, 0, 0)) for frame, x in ((1001, 0), (1121, 60))]
    helicopter, place = vehsim.load_vehicle("helicopter"), (30, 15, 30)
    plan = vehsim.plan(helicopter, None, marks, segments=64, terms=[look_at(place)])
    assert plan.success and plan.character == "normal"
    clip = plan.clip.resample()
    passes = np.arctan2(*(np.array(place) - clip.positions)[:, 1::-1].T)
    turns, asked = (24 * np.degrees(np.diff(np.unwrap(each)))[[0, -1]] for each in (yaw_of(clip.orientations), passes))
    assert 2 < turns.min() < turns.max() < asked.min()


def test_a_loop_begins_nowhere():
    first, last = Mark(1, position=(0, 0, 30), speed=5.0), Mark(200, position=(0, 0, 30), speed=5.0)
    vehicle = vehsim.load_vehicle("helicopter")
    request = make_request(vehicle, None, [first, last], fps=24, segments=16, loop=True)
    blocks = blocks_of(request, transcribe(request.weighed), None)
    assert next(b for b in blocks if isinstance(b, Easing)).steady == []
