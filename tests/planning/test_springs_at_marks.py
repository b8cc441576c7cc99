"""Where a plan begins or ends at speed, a body on springs neither bounces nor rocks."""

from __future__ import annotations

import warnings

import numpy as np
import pytest

import vehsim
from vehsim import Mark

SPEED = (10.0, 0.0, 0.0)
BODY = ("heave", "pitch", "roll")


def drive(*marks, **more):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        return vehsim.plan(vehsim.load_vehicle("rally_car"), None, marks, **more)


def test_a_sprung_car_that_passes_its_first_and_last_mark_at_speed_drives_as_normal():
    """With free springs, it began 12 cm above its rest, a wheel 40 cm out of its arch, driven as a stunt."""
    plan = drive(
        Mark(1, position=(0, 0, 0), heading=0, velocity=SPEED),
        Mark(145, position=(75, 0, 0), heading=0, velocity=SPEED),
    )
    assert plan.success and plan.character == "normal"
    clip, at = plan.clip, [plan.clip.vehicle.joints.index(name) for name in BODY]
    assert np.abs(clip.joints[:, at]).max() < 0.06
    for end in (0, -1):
        assert np.abs(clip.joint_rates[end, at]).max() < 1e-6
    # nothing bounces in the first and last tenth of a second either
    early, late = clip.times < 0.1, clip.times > clip.times[-1] - 0.1
    for part in (early, late):
        assert np.ptp(clip.joints[part][:, at], axis=0).max() < 0.02
    assert max(np.abs(values).max() for name, values in clip.channels.items() if name.startswith("travel")) < 0.1


def test_a_mark_within_the_motion_leaves_the_springs_free():
    """Only ends of the motion are given; what happens between them decides how the body leans on the way."""
    from vehsim.planning.constraints.mark_constraints import SPRINGS, mark_element
    from vehsim.planning.problem.transcription import transcribe

    transcription = transcribe(vehsim.load_vehicle("rally_car"))
    mark = Mark(48, position=(30, 0, 0), velocity=SPEED)
    assert SPRINGS not in mark_element(transcription, mark).labels
    assert list(mark_element(transcription, mark, cut=True).labels).count(SPRINGS) == 2 * len(BODY)
    rigid = transcribe(vehsim.load_vehicle("drift_car"))
    assert SPRINGS not in mark_element(rigid, mark, cut=True).labels


@pytest.mark.parametrize("loop", [True, False])
def test_a_loop_needs_no_rest_of_the_springs(loop):
    from vehsim.planning.blocks import blocks_of
    from vehsim.planning.constraints.mark_constraints import MarkConstraint
    from vehsim.planning.problem.transcription import transcribe
    from vehsim.planning.request.request import make_request

    car = vehsim.load_vehicle("rally_car")
    marks = [
        Mark(1, position=(0, 0, 0), heading=0, velocity=SPEED),
        Mark(97) if loop else Mark(97, position=(40, 0, 0)),
    ]
    request = make_request(car, None, marks, fps=24, segments=32, loop=loop)
    blocks = [block for block in blocks_of(request, transcribe(car), None) if isinstance(block, MarkConstraint)]
    assert [block.cut for block in blocks] == [not loop, not loop]
