"""The gait drives the snakeboard from rest, and refuses other vehicles."""

from __future__ import annotations

import numpy as np
import pytest

import vehsim
from vehsim.errors import InputError
from vehsim.pilots.controllers import PILOTS

TWIST = {"amplitude": [0.9, -0.32], "period": 1.15, "phase": [0.0, -0.6]}


@pytest.fixture(scope="module")
def board():
    return vehsim.load_vehicle("snakeboard")


def test_the_swings_rates_and_accelerations_are_its_derivatives(board):
    gait = PILOTS["gait"](board, **TWIST, rise=0.8, until=2.0)
    for t in (0.0, 0.3, 0.8, 1.5, 2.3, 2.7, 3.5):
        before, at, after = (gait.swing(t + d) for d in (-1e-5, 0.0, 1e-5))
        assert np.allclose(at[1], (after[0] - before[0]) / 2e-5, atol=1e-6)
        assert np.allclose(at[2], (after[1] - before[1]) / 2e-5, atol=1e-3)
    assert np.allclose(gait.swing(0.0), 0.0) and np.allclose(gait.swing(3.0), 0.0)


def test_twist_and_feet_drive_the_board_from_rest(board):
    clip = vehsim.simulate(board, None, PILOTS["gait"](board, **TWIST, until=4.0), duration=6.0)
    wanted = np.array([PILOTS["gait"](board, **TWIST, until=4.0).swing(t)[0] for t in clip.times])
    assert np.abs(clip.joints - wanted).max() < 0.03
    assert clip.twists[0, 1] == 0 and clip.twists[-1, 1] > 0.9
    settled = clip.twists[clip.times > 5.3]
    assert np.ptp(settled[:, 1]) < 0.01  # feet straight again: it coasts
    back = PILOTS["gait"](board, **{**TWIST, "amplitude": [0.9, 0.32]}, until=4.0)
    assert vehsim.simulate(board, None, back, duration=6.0).twists[-1, 1] == pytest.approx(
        -clip.twists[-1, 1], rel=1e-6
    )


def test_feet_alone_or_twist_alone_do_not_drive_it(board):
    for amplitude in ([0.9, 0.0], [0.0, 0.32]):
        clip = vehsim.simulate(board, None, PILOTS["gait"](board, amplitude=amplitude, period=1.15), duration=2.0)
        assert np.linalg.norm(np.ptp(clip.positions, axis=0)) < 1e-6


@pytest.mark.parametrize(
    ("vehicle", "change", "message"),
    [
        ("car", {}, "gait: car does not have one torque per joint"),
        ("helicopter", {}, "gait: helicopter does not have one torque per joint"),
        ("snakeboard", {"amplitude": [0.9]}, "amplitude = .0.9.: not one number per joint; give 2, rad"),
        ("snakeboard", {"period": 0.0}, "period = 0.0: not a time; give a positive number, s"),
        ("snakeboard", {"until": "now"}, "until"),
    ],
)
def test_refusals(vehicle, change, message):
    with pytest.raises(InputError, match=message):
        PILOTS["gait"](vehsim.load_vehicle(vehicle), **{**TWIST, **change})
