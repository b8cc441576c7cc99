"""The explicit splitting that `benchmarks/order.py` compares: its order, and what it keeps."""

import numpy as np
import pytest

from benchmarks.order import Hanging
from benchmarks.splitting import flows, rk4_step, splitting_step
from vehsim.lie import SO3

BODY = Hanging(np.array([0.7, 1.6, 1.2]), 1.4, np.array([1.1, -0.6, 0.8, 0.3, 0.2, -0.1]))
START = np.array([1, *[0.0] * 6, *BODY.inertia * BODY.twist[:3], *BODY.mass * BODY.twist[3:]])


def run(step, count, seconds=2.0):
    states = [START]
    for _ in range(count):
        states.append(step(states[-1], seconds / count, [], [], np.zeros(3)).full().ravel())
    return np.array(states)


@pytest.mark.parametrize("forced", [False, True])
@pytest.mark.parametrize("method", [splitting_step, rk4_step])
def test_steps_by_hand_are_of_fourth_order(method, forced):
    """Against DOP853 on independent equations, or on RK4 with short steps where the body is free."""
    kick = BODY.kick if forced else None
    step = method(BODY.inertia.tolist(), BODY.mass, kick)
    if forced:
        position, rotation = BODY.truth(np.array([2.0]))
    else:
        (position, *_), rotation = ([2.0 * BODY.twist[3:]], 0), super(Hanging, BODY).truth(np.array([2.0]))[1]
    errors = []
    for count in (40, 80):
        end = run(step, count)[-1]
        turn = SO3.matrix(end[:4]) - rotation.as_matrix()[0]
        errors.append(np.abs(turn).max() + np.abs(end[4:7] - position).max())
    assert np.log2(errors[0] / errors[1]) == pytest.approx(4, abs=0.4), errors


def test_a_free_body_keeps_its_momentum_and_a_hanging_one_its_energy():
    free = run(splitting_step(BODY.inertia.tolist(), BODY.mass), 200, 60.0)
    momenta = np.einsum("nij,nj->ni", SO3.matrix(free[:, :4]), free[:, 7:10])
    assert np.abs(momenta - momenta[0]).max() < 1e-13
    step, explicit = (method(BODY.inertia.tolist(), BODY.mass, BODY.kick) for method in (splitting_step, rk4_step))
    energies = [BODY.energy(run(method, 1200, 120.0)) for method in (step, explicit)]
    half = [np.abs(e / e[0] - 1)[:600].max() for e in energies]
    whole = [np.abs(e / e[0] - 1).max() for e in energies]
    assert whole[0] < 2 * half[0] and whole[1] > 1.5 * half[1]


def test_the_flows_of_every_part_fill_the_step():
    for parts in (2, 3):
        assert [sum(share for part, share in flows(parts) if part == k) for k in range(parts)] == pytest.approx(
            [1.0] * parts
        )
