"""Where a plan begins at speed with a free heading, what slips begins as it would go there."""

from __future__ import annotations

import math
import warnings

import numpy as np
import pytest

import vehsim
from vehsim import Mark
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


def easing(first: Mark, **more) -> Easing:
    vehicle = vehsim.load_vehicle("drift_car")
    last = Mark(100, position=(30, 2, 0))
    request = make_request(vehicle, None, [first, last], fps=24, segments=16, **more)
    return next(b for b in blocks_of(request, transcribe(request.weighed), None) if isinstance(b, Easing))


@pytest.mark.parametrize(
    ("more", "character", "expected"),
    [
        ({"velocity": (9, 0, 0)}, "normal", True),
        ({"speed": 9.0}, "calm", True),
        ({}, "normal", True),
        ({"velocity": (9, 0, 0), "heading": 20.0}, "normal", False),  # a drift that the mark asks for
        ({"velocity": (0, 0, 0)}, "normal", False),
        ({"speed": 0.0}, "normal", False),
        ({"velocity": (9, 0, 0)}, "stunt", False),
    ],
)
def test_a_heading_rest_and_stunts_leave_the_slip_free(more, character, expected):
    assert easing(Mark(1, position=(0, 0, 0), **more), character=character).under_way == expected
