"""Vehicles propelled only by their joints: from rest to rest, without a given gait."""

import numpy as np
import pytest

import vehsim
from vehsim import Mark
from vehsim.planning.guesses.paths import along_clip
from vehsim.planning.problem.layout import Layout
from vehsim.planning.problem.transcription import transcribe
from vehsim.planning.trim import swims
from vehsim.vehicles.library.library import available

REST, STRAIGHT = (0.0, 0.0, 0.0), {"psi": 0.0, "phi": 0.0}


@pytest.fixture(scope="module")
def board():
    return vehsim.load_vehicle("snakeboard")


def to(goal, heading, frame):
    return [
        Mark(1, position=(0, 0, 0), heading=0, velocity=REST, joints=STRAIGHT),
        Mark(frame, position=(*goal, 0), heading=heading, velocity=REST, joints=STRAIGHT),
    ]


@pytest.mark.parametrize("goal, heading, frame", [((4, 0), 0, 145), ((3.4, 1.7), 28, 125), ((5, 1.5), 40, 169)])
def test_a_snakeboard_gets_from_rest_to_rest(board, goal, heading, frame):
    """At the mark, in time, at rest; the controls alone lead there; no wheel slips sideways."""
    plan = vehsim.plan(board, None, to(goal, heading, frame), segments=48)
    assert plan.success and plan.clip.end_frame == frame
    assert plan.executed.final < 0.03  # it may be a fortieth of its greatest length, 0.044
    last = plan.clip.at([plan.duration])
    np.testing.assert_allclose(last.positions[0, :2], goal, atol=1e-6)
    assert np.abs(last.twists).max() < 1e-6 and np.abs(last.joint_rates).max() < 1e-5
    omega, ahead, aside = plan.clip.twists.T
    phi = plan.clip.joints[:, 1]
    for end in (1.0, -1.0):  # each truck's axle, at its own angle
        across = aside + end * 0.27 * omega
        slip = np.sin(end * phi) * ahead + np.cos(phi) * across
        assert np.abs(slip).max() < 1e-6


@pytest.mark.parametrize("seed", range(3))
def test_joints_turn_inside_their_ranges_between_knots_too(board, seed):
    random = np.random.default_rng(seed)
    goal, heading = random.uniform((2.5, -1.5), (5, 1.5)), random.uniform(-40, 40)
    plan = vehsim.plan(board, None, to(goal, heading, round(30 * np.hypot(*goal)) + 30))
    assert plan.success
    within = plan.clip.at(np.linspace(0, plan.duration, 4001)).joints
    for k, joint in enumerate(board.joints):
        low, high = board.joint_limits[joint]
        assert within[:, k].min() >= low - 0.005 * high and within[:, k].max() <= high + 0.005 * high
    rows = {row.key: row for row in plan.audit}
    assert rows["limits.joints.psi"].met and rows["limits.joints.phi"].met


def test_a_clip_as_guess_provides_joints_and_controls(board):
    """A clip as initial guess provides its poses, joints and controls, and is moved onto marks elsewhere."""
    clip = vehsim.plan(board, None, to((4, 0), 0, 145), segments=96, refine=False).clip
    t = transcribe(board)
    layout, marks = Layout(t.sizes, (96,)), to((4.2, 0.3), 0, 145)
    x = along_clip(t, layout, marks, clip, np.array([6 / 96]))
    states = x[layout.knot(np.arange(97))].T
    share = np.linspace(0, 1, 97)[:, None]
    np.testing.assert_allclose(states[:, 1:3], clip.positions[:, :2] + share * [0.2, 0.3], atol=1e-9)
    np.testing.assert_allclose(states[:, 3:5], clip.joints, atol=1e-9)
    controls = x[layout.control(np.arange(97))].T * t.control_scale
    np.testing.assert_allclose(controls, clip.controls, atol=1e-9)
    nearby = vehsim.plan(board, None, marks, segments=96, refine=False, guess=clip)
    assert nearby.success


def test_swimming_vehicles_are_recognised():
    assert [name for name in available() if swims(vehsim.load_vehicle(name))] == ["snakeboard", "snakeboard_lie"]
