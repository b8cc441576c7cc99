"""Sinusoids as initial guesses: drivable from mark to mark, and plans converge faster from them."""

import numpy as np
import pytest

import vehsim
from vehsim import Mark
from vehsim.errors import InputError
from vehsim.shot.motions.plan import PlanMotion
from vehsim.sinusoids.manoeuvres.guess import initial_guess


@pytest.fixture(scope="module")
def truck():
    return vehsim.load_vehicle("truck")


def bay(truck):
    rest = {"velocity": (0.0, 0.0, 0.0), "joints": dict.fromkeys(truck.joints[1:], 0.0)}
    return [
        Mark(1001, position=(20.0, 0.0, 0.0), heading=0.0, **rest),
        Mark(1961, position=(-8.0, -5.0, 0.0), heading=15.0, **rest),
    ]


def test_a_guess_leads_from_mark_to_mark_and_its_axle_does_not_slip(truck):
    poses = initial_guess(truck, bay(truck))
    assert poses[0] == pytest.approx([20.0, 0.0, 0.0, 0.0], abs=1e-6)
    assert poses[-1] == pytest.approx([-8.0, -5.0, 0.0, np.radians(15.0)], abs=1e-5)
    x, y, _, heading = poses.T
    axle = np.column_stack([x - 1.8 * np.cos(heading), y - 1.8 * np.sin(heading)])
    middle = (heading[1:] + heading[:-1]) / 2
    step = np.diff(axle, axis=0)
    slip = step[:, 1] * np.cos(middle) - step[:, 0] * np.sin(middle)
    assert np.abs(slip).max() < 2e-3 * np.abs(step).max()


def test_a_plan_converges_from_a_sinusoid(truck):
    marks = bay(truck)
    found = vehsim.plan(truck, None, marks, guess=initial_guess(truck, marks), refine=False)
    straight = vehsim.plan(truck, None, marks, refine=False)
    assert found.success and found.iterations < straight.iterations
    assert found.cost <= straight.cost * 1.01


def test_vehicles_that_sinusoids_do_not_drive_are_refused():
    with pytest.raises(InputError, match="not a system that is steered by sinusoids"):
        initial_guess(vehsim.load_vehicle("helicopter"), [])
    with pytest.raises(InputError, match="only cars"):
        initial_guess(vehsim.load_vehicle("hopper"), [])
    table = PlanMotion(method="plan", guess="sinusoid", mark=None)
    (problem,) = table._check_guess(vehsim.load_vehicle("helicopter"), None)
    assert problem.key == "guess" and "wheels" in str(problem)
    assert not list(table._check_guess(vehsim.load_vehicle("car"), None))
