"""The methods for comparison have their theoretical order, on a body and on a constrained vehicle."""

import numpy as np
import pytest

import vehsim
from vehsim.errors import InputError, SolveError
from vehsim.integrators import Integrator
from vehsim.integrators.references import METHODS, reference_clip, reference_rollout
from vehsim.lie import SE3
from vehsim.vehicles import Holonomic, State

BODY = Holonomic(name="body", group=SE3, inertia=(1.0, 2.0, 2.6, 1.5, 1.5, 1.5), gravity=0.0)
CASES = {
    "body": (BODY, State(twist=(0.4, 1.0, 0.3, 0.5, -0.2, 0.1)), lambda t: np.zeros((len(t), 0))),
    "car": (
        vehsim.load_vehicle("car"),
        State(twist=(0.0, 5.0, 0.0)),
        lambda t: np.column_stack([800 * np.ones_like(t), 0.3 * np.ones_like(t)]),
    ),
}
ORDER = {"rk2": 2, "rk4": 4, "implicit_rk2": 2, "lie_newmark": 2}


@pytest.mark.parametrize("name", CASES)
@pytest.mark.parametrize("method", METHODS)
def test_observed_order(name, method):
    vehicle, start, law = CASES[name]
    exact = Integrator(vehicle, 2 / 1024, "exp", 6).rollout(start, law(np.linspace(0, 2, 1025)))
    errors = []
    for n in (64, 128):
        integrator = Integrator(vehicle, 2 / n)
        controls = law(np.linspace(0, 2, n + 1))
        phase = integrator.start(start, controls[0])
        z = np.asarray(integrator.mechanics.knot_velocity_guess(phase.r, phase.pi, controls[0])).ravel()
        x = reference_rollout(vehicle, method, np.concatenate([phase.g, phase.r, z]), controls, 2 / n)[-1]
        pose = vehicle.group.pose(x[: vehicle.group.size])
        centre = exact.matrices()[-1] @ np.array([*vehicle.origin, 1.0])
        errors.append(np.linalg.norm(pose[:2] - centre[:2]))
    assert np.log2(errors[0] / errors[1]) == pytest.approx(ORDER[method], abs=0.4), errors


def test_an_unknown_method_is_named():
    with pytest.raises(InputError, match="method = 'euler': unknown; choose one of rk2"):
        reference_rollout(BODY, "euler", np.zeros(13), np.zeros((2, 0)), 0.1)


@pytest.mark.parametrize("name", CASES)
def test_clip_of_a_reference_method_contains_its_states(name):
    vehicle, start, law = CASES[name]
    controls = law(np.linspace(0, 1, 129))
    clip = reference_clip(vehicle, "rk4", start, controls, 1 / 128)
    exact = Integrator(vehicle, 1 / 128, "exp", 6).rollout(start, controls)
    assert np.allclose(clip.positions, exact.positions, atol=1e-6)
    assert np.allclose(clip.twists, exact.twists, atol=1e-6)
    assert np.allclose(clip.energy["kinetic"], exact.energy["kinetic"], rtol=1e-6)


def test_a_diverging_reference_method_reports_the_time():
    fast = State(twist=(400.0, 100.0, 300.0, 0.0, 0.0, 0.0))
    with pytest.raises(SolveError, match=r"body: rk2 blows up after [\d.]+ s at a step of 0.5 s; shorten it"):
        reference_clip(BODY, "rk2", fast, np.zeros((200, 0)), 0.5)
