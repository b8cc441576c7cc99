"""Joints that influence nothing, such as a wheel's roll: no equation fixes their initial values, so the plan must."""

import numpy as np
import pytest

import vehsim

REST = {"heading": 0, "velocity": (0, 0, 0)}


@pytest.mark.parametrize("cost", ["time", "effort"])
def test_wheels_start_at_the_angles_of_the_guess(cost: str) -> None:
    """Left to the solver, they started at -1e14 rad, where a wheel turns in steps of a degree."""
    marks = [vehsim.Mark(1001, position=(0, 0, 0), **REST), vehsim.Mark("free", position=(40, 20, 0), **REST)]
    plan = vehsim.plan(vehsim.load_vehicle("car"), vehsim.World(terrain="flat"), marks, cost=cost, segments=32)
    rolled = plan.clip.joints[:, plan.clip.vehicle.joints.index("psi")]
    assert plan.success
    assert rolled[0] == 0.0
    way = np.linalg.norm(np.diff(plan.clip.positions, axis=0), axis=1).sum()
    assert 0.9 * way < 0.3 * rolled[-1] < 1.3 * way  # a wheel of some 0.3 m


def test_a_mark_can_still_fix_idle_joints() -> None:
    marks = [vehsim.Mark(1001, position=(0, 0, 0), **REST), vehsim.Mark("free", position=(10, 0, 0), **REST)]
    marks[1] = vehsim.Mark("free", position=(10, 0, 0), joints=(5.0, np.nan), **REST)
    plan = vehsim.plan(vehsim.load_vehicle("car"), vehsim.World(), marks, segments=16)
    assert plan.success
    assert plan.clip.joints[-1, 0] == pytest.approx(5.0, abs=1e-6)
