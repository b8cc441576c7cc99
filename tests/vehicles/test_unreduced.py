"""The unreduced scheme converges, with order 2, to the same motion as the reduced one."""

import numpy as np
import pytest
from fleet import CONTROLS, FLEET, STARTS

from benchmarks.unreduced import unreduced_rollout
from vehsim.errors import InputError
from vehsim.integrators import Integrator


@pytest.mark.parametrize("name", ["car", "simple_car", "two_wheeled", "snakeboard"])
def test_unreduced_and_reduced_schemes_converge_with_order_two(name):
    vehicle, end, errors = FLEET[name], 0.8, []
    fine = Integrator(vehicle, end / 640, order=4).rollout(STARTS[name], CONTROLS[name](np.linspace(0, end, 641)))
    q0 = np.concatenate([[0.0, *fine.positions[0, :2]], fine.joints[0]])
    v0 = np.concatenate([fine.twists[0], fine.joint_rates[0]])
    for n in (20, 40):
        q = unreduced_rollout(vehicle, q0, v0, CONTROLS[name](np.linspace(0, end, n + 1)), end / n)[-1]
        errors.append(np.abs(q[1:3] - fine.positions[-1, :2]).max() + np.abs(q[3:] - fine.joints[-1]).max())
    assert np.log2(errors[0] / errors[1]) == pytest.approx(2, abs=0.4), errors


def test_the_unreduced_scheme_refuses_other_groups():
    with pytest.raises(InputError, match="SE2"):
        unreduced_rollout(FLEET["suslov"], np.zeros(3), np.zeros(3), np.zeros((2, 3)), 0.1)
