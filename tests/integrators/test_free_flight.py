"""The maps that follow a body's free flight: order, momentum, symmetry, and what they refuse."""

import numpy as np
import pytest

import vehsim
from vehsim.errors import InputError
from vehsim.integrators import Integrator
from vehsim.integrators.continuous import execute
from vehsim.integrators.phase import packed
from vehsim.lie import SE2, SE3, SO3, SO3xR3
from vehsim.vehicles import Holonomic, State

TURNED = np.linalg.qr(np.random.default_rng(3).normal(size=(3, 3)))[0]
TENSOR = TURNED @ np.diag([0.8, 1.4, 2.0]) @ TURNED.T
ARM = np.array([[0, -0.2, 0.1], [0.2, 0, -0.3], [-0.1, 0.3, 0]])
BODIES = {
    "on its principal axes": (SO3, np.diag([0.8, 1.4, 2.0])),
    "on other axes": (SO3, TENSOR),
    "symmetric": (SO3, np.diag([1.0, 1.0, 2.0])),
    "in space": (SO3xR3, np.block([[TENSOR, np.zeros((3, 3))], [np.zeros((3, 3)), 1.5 * np.eye(3)]])),
    "in body axes": (SE3, np.diag([0.8, 1.4, 2.0, 1.5, 1.5, 1.5])),
    "off the centre, in water": (SE3, np.block([[TENSOR, ARM], [ARM.T, np.diag([1.5, 2.0, 3.0])]])),
    "in the plane": (SE2, np.diag([0.7, 1.0, 3.0])),
}
CASES = [("tln4", 4, name) for name in BODIES] + [("tln6", 6, name) for name in list(BODIES)[:4]]


def body(name):
    group, inertia = BODIES[name]
    vehicle = Holonomic(name="body", group=group, inertia=inertia, mass=1.0, gravity=0.0)
    twist = np.array([1.0, 2.5, 0.5, 0.5, 0.2, 0.1])[: group.dim]
    return vehicle, State(twist=twist)


def end(vehicle, start, name, count, seconds=2.0):
    """Packed phase after ``count`` steps."""
    integrator = Integrator(vehicle, seconds / count, name)
    return integrator.history(packed(integrator.start(start, ())), np.zeros((count + 1, 0)))[-1]


@pytest.mark.parametrize(("name", "order", "which"), CASES)
def test_order_against_the_continuous_equations(name, order, which):
    vehicle, start = body(which)
    phase = Integrator(vehicle, 1.0).start(start, ())
    z = np.asarray(phase.pi) @ np.linalg.inv(BODIES[which][1])
    exact = execute(vehicle, phase.g, phase.r, z, np.zeros((101, 0)), np.full(100, 0.02), np.zeros(3))[0][-1]
    matrix, size = vehicle.group.matrix, vehicle.group.size
    errors = [np.abs(matrix(end(vehicle, start, name, n)[:size]) - matrix(exact)).max() for n in (20, 40)]
    assert np.log2(errors[0] / errors[1]) == pytest.approx(order, abs=0.35), errors


@pytest.mark.parametrize(("name", "order", "which"), CASES)
def test_momentum_stays_and_a_step_back_undoes_a_step(name, order, which):
    vehicle, start = body(which)
    group, integrator = vehicle.group, Integrator(vehicle, 0.2, name)
    first = packed(integrator.start(start, ()))
    x = integrator.history(first, np.zeros((201, 0)))
    size, n = group.size, group.dim
    spatial = [group.Ad(group.inverse(row[:size])).T @ row[size : size + n] for row in x]
    np.testing.assert_allclose(spatial, np.tile(spatial[0], (201, 1)), atol=1e-12)
    m = integrator.mechanics
    g, _, pi, z, _ = m.advance(x[0, :size], [], x[0, size : size + n], x[0, size + n :], [], [], 0.2, np.zeros(3))
    back = m.advance(g, [], pi, z, [], [], -0.2, np.zeros(3))
    np.testing.assert_allclose(group.matrix(np.asarray(back[0], float).ravel()), group.matrix(x[0, :size]), atol=1e-12)
    np.testing.assert_allclose(np.asarray(back[2], float).ravel(), x[0, size : size + n], atol=1e-12)


def test_a_steady_spin_turns_by_the_tangents_series():
    """About a principal axis: ``2 atan(x / 2)`` with ``x = t + t^3 / 12 + t^5 / 120`` for the angle ``t`` of a step."""
    vehicle, angle = Holonomic(name="top", group=SO3, inertia=(0.8, 1.4, 2.0)), 0.3
    for name, x in (("tln4", angle + angle**3 / 12), ("tln6", angle + angle**3 / 12 + angle**5 / 120)):
        g = end(vehicle, State(twist=(0.0, angle, 0.0)), name, 1, 1.0)[:4]
        assert 2 * np.arctan2(g[2], g[0]) == pytest.approx(2 * np.arctan(x / 2), abs=1e-14)


@pytest.mark.parametrize(
    ("vehicle", "name"),
    [
        (vehsim.load_vehicle("car"), "tln4"),
        (body("in body axes")[0], "tln6"),
        (body("off the centre, in water")[0], "tln6"),
    ],
)
def test_other_vehicles_are_refused(vehicle, name):
    with pytest.raises(InputError, match=f"difference_map = {name!r}: .*; choose"):
        Integrator(vehicle, 0.1, name).rollout(State(), np.zeros((2, len(vehicle.controls))))
