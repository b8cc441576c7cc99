"""External forces, drag and added mass enter the step to second order."""

import numpy as np
import pytest

from vehsim.errors import InputError, SolveError
from vehsim.integrators.environment import SPACING, Combined, Environment, Spaced
from vehsim.integrators.forced import Forced
from vehsim.integrators.integrator import Integrator
from vehsim.lie import SE3
from vehsim.vehicles import State
from vehsim.vehicles.definition.holonomic import Holonomic

BODY = Holonomic(name="body", group=SE3, inertia=(1.0, 2.0, 3.0, 4.0, 4.0, 4.0), gravity=0.0)


class Spring(Environment):
    """A spring to the origin, linear and quadratic drag, and a force that changes with time."""

    def wrench(self, t, state, controls):
        twist = np.asarray(state.twist)
        drag = -(0.8 + 0.3 * np.linalg.norm(twist)) * twist
        w, x, y, z = state.orientation
        turn = np.array([[1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
                         [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
                         [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)]])  # fmt: skip
        force = turn.T @ (-9.0 * np.asarray(state.position) + [np.sin(3 * t), 0, 0])
        return drag + np.concatenate([[0.3, 0.0, -0.2], force])


class Heavy(Environment):
    def wrench(self, t, state, controls):
        return np.zeros(6)

    def added_inertia(self, t, state):
        return np.diag([0.5, 0.5, 0.5, 2.0, 2.0, 2.0])


START = State(position=np.array([1.0, 0.5, -0.3]), twist=np.array([0.4, -0.2, 0.6, 0.0, 1.0, 0.0]))


def end(steps, *parts):
    body = Forced(Integrator(BODY, 1.5 / steps, "tln"), Combined(parts), START, np.zeros(0))
    for _ in range(steps):
        body.advance(np.zeros(0))
    return np.concatenate([body.state.position, body.state.orientation, body.state.twist])


@pytest.mark.parametrize("parts", [(Spring(),), (Spring(), Heavy())], ids=["plain", "added mass"])
def test_second_order(parts):
    fine = end(2400, *parts)
    errors = [np.linalg.norm(end(n, *parts) - fine) for n in (30, 60, 120)]
    assert np.log2(errors[0] / errors[1]) == pytest.approx(2, abs=0.2)
    assert np.log2(errors[1] / errors[2]) == pytest.approx(2, abs=0.2)


class Counted(Combined):
    """Parts that need only one evaluation per ``spacing`` s; ``asked``: how often they were evaluated."""

    def __init__(self, spacing, *parts):
        super().__init__(parts)
        self.max_step, self.asked = spacing / SPACING, 0

    def wrench(self, t, state, controls):
        self.asked += 1
        return super().wrench(t, state, controls)


class Sinking(Environment):
    """An added mass that grows."""

    def wrench(self, t, state, controls):
        return np.zeros(6)

    def added_inertia(self, t, state):
        return (1 + t) * np.diag([0.5, 0.5, 0.5, 2.0, 2.0, 2.0])


@pytest.mark.parametrize("parts", [(Spring(),), (Spring(), Sinking())], ids=["plain", "added mass"])
def test_evaluations_farther_apart_than_steps_keep_the_order(parts):
    fine, errors = end(2400, *parts), []
    for n in (30, 60, 120):
        counted = Counted(1.5 / n, *parts)
        errors.append(np.linalg.norm(end(2400, Spaced(counted)) - fine))
        assert counted.asked <= n + 2
    assert np.log2(errors[0] / errors[1]) == pytest.approx(2, abs=0.3)
    assert np.log2(errors[1] / errors[2]) == pytest.approx(2, abs=0.3)


def test_steps_longer_than_the_spacing_are_as_without_it():
    assert np.array_equal(end(30, Spaced(Counted(1.5 / 60, Spring(), Heavy()))), end(30, Spring(), Heavy()))


def test_predictions_are_not_steps():
    body = Forced(Integrator(BODY, 0.01), Spring(), START, np.zeros(0))
    seen = body.predict(np.zeros(0))
    body.advance(np.zeros(0))
    np.testing.assert_allclose(body.state.position, seen.position, atol=1e-12)
    np.testing.assert_allclose(body.state.twist, seen.twist, atol=1e-2)


def test_wrong_options_and_wrenches_are_refused():
    with pytest.raises(InputError, match="to second order only; take order 2"):
        Forced(Integrator(BODY, 0.01, order=4), Spring(), START, np.zeros(0))

    class Broken(Environment):
        def wrench(self, t, state, controls):
            return np.full(6, np.nan)

    with pytest.raises(SolveError, match="body: step 0: the environment's wrench is"):
        Forced(Integrator(BODY, 0.01), Broken(), START, np.zeros(0))
