"""The shipped models compared with the papers and with geometry: F(gamma), rolling without slip, energy, momentum."""

import casadi as ca
import numpy as np
import pytest

import vehsim
from vehsim.errors import InputError
from vehsim.integrators import Integrator
from vehsim.lie import SE2, SE3, SO3xR3
from vehsim.vehicles import Holonomic, Nonholonomic, State
from vehsim.vehicles.definition.states import flat


def test_helicopter_wrench_is_the_printed_control_matrix():
    """LIE 4.3.1: F(gamma) (u_c, u_psi)."""
    helicopter = vehsim.load_vehicle("helicopter_lie")
    d_t, d_r = 1.61, 6.35
    c = ca.SX.sym("c", 4)
    wrench = ca.Function("w", [c], [helicopter.wrench(c)])
    for collective, yaw, p, r in np.random.default_rng(0).uniform(-1, 1, (20, 4)):
        F = np.array(
            [
                [d_t * np.sin(r), 0],
                [d_t * np.sin(p) * np.cos(r), 0],
                [0, d_r],
                [np.sin(p) * np.cos(r), 0],
                [-np.sin(r), -1],
                [np.cos(p) * np.cos(r), 0],
            ]
        )
        np.testing.assert_allclose(flat(wrench([collective, yaw, p, r])), F @ [collective, yaw], atol=1e-14)


def test_car_connection_is_the_printed_one():
    """LIE eq. 19, from the constraints alone."""
    car = vehsim.load_vehicle("car")
    rho, length, sigma = 0.32, 2.6, 0.37
    r = ca.SX.sym("r", 2)
    connection = np.array(ca.Function("A", [r], [ca.densify(car.connection(r))])([0.3, sigma]))
    np.testing.assert_allclose(connection, [[-rho / length * sigma, 0], [-rho, 0], [0, 0]], atol=1e-15)


@pytest.mark.parametrize("difference_map", ["exp", "cay"])
def test_every_wheel_rolls_without_slipping(difference_map):
    """The velocity of each contact, by differences of the hub's path, is the wheel's roll along its own heading."""
    car = vehsim.load_vehicle("car")
    radius, wheelbase, b = 0.32, 2.6, 0.77
    h = 1 / 480
    t = h * np.arange(1441)
    controls = np.column_stack([400 * np.cos(t), 0.5 * np.cos(2 * t)])
    clip = Integrator(car, h, difference_map).rollout(State(twist=(0.0, 4.0, 0.0)), controls)
    T_wr = clip.matrices()
    hubs = {"rl": (0, b), "rr": (0, -b), "fl": (wheelbase, b), "fr": (wheelbase, -b)}
    assert np.ptp(clip.joints[:, 1]) > 0.2
    for name, (x, y) in hubs.items():
        hub = (T_wr @ np.array([x + car.origin[0], y, 0.0, 1.0]))[:, :2]
        steer = clip.channels.get(f"steer_{name}", np.zeros(len(t)))
        yaw = np.unwrap(np.arctan2(T_wr[:, 1, 0], T_wr[:, 0, 0])) + steer
        velocity = np.gradient(hub, h, axis=0, edge_order=2)[5:-5]
        along = np.column_stack([np.cos(yaw), np.sin(yaw)])[5:-5]
        across = np.column_stack([-np.sin(yaw), np.cos(yaw)])[5:-5]
        roll = np.gradient(clip.channels[f"roll_{name}"], h, edge_order=2)[5:-5]
        np.testing.assert_allclose(np.sum(velocity * across, axis=1), 0, atol=2e-4)
        np.testing.assert_allclose(np.sum(velocity * along, axis=1), radius * roll, atol=2e-4)


def test_energy_and_momentum_against_hand_formulas():
    body = Holonomic(name="body", group=SE3, inertia=(1.0, 2.0, 3.0, 4.0, 4.0, 4.0))
    half = np.sqrt(0.5)
    state = State(position=(1, 2, 3), orientation=(half, 0, 0, half), twist=(0.1, 0.2, 0.3, 1.0, 0.0, 0.0))
    kinetic, potential = body.energy(state)
    assert kinetic == pytest.approx((1 * 0.01 + 2 * 0.04 + 3 * 0.09 + 4) / 2)
    assert potential == pytest.approx(4 * 9.81 * 3)
    spin, linear = np.array([-0.4, 0.1, 0.9]), np.array([0.0, 4.0, 0.0])  # body X is world Y
    np.testing.assert_allclose(body.momentum(state), [*(spin + np.cross([1, 2, 3], linear)), *linear], atol=1e-14)
    split = Holonomic(name="body", group=SO3xR3, inertia=(1.0, 2.0, 3.0, 4.0, 4.0, 4.0))
    np.testing.assert_allclose(split.momentum(state), [*spin, *linear], atol=1e-14)
    assert split.energy(state) == pytest.approx((kinetic, potential))


@pytest.mark.parametrize("name", ["helicopter", "car"])
def test_linearisation_predicts_small_changes(name):
    """One fine step from a disturbed state and controls, minus one from the undisturbed, against ``h (A d + B du)``."""
    vehicle = vehsim.load_vehicle(name)
    d, s, c = vehicle.group.dim, len(vehicle.joints), len(vehicle.controls)
    rng = np.random.default_rng(3)
    joints = np.array([0.2, 0.1])[:s]
    controls = {"helicopter": [18000.0, 100.0, 0.02, 0.01], "car": [300.0, 0.2]}[name]
    twist = rng.standard_normal(d)
    twist = twist if name == "helicopter" else np.array([0.0, 5.0, 0.0])
    state = State(position=(0, 0, 0), orientation=(1, 0, 0, 0), twist=twist, joints=joints)
    state = Integrator(vehicle, 1e-9).step(state, controls)  # project onto the constraints
    A, B = vehicle.linearize(state, controls)
    assert A.shape == (len(A), len(A)) and B.shape == (len(A), c)

    integrator, h, small = Integrator(vehicle, 1e-4, "exp", 4), 1e-4, 1e-5
    m = integrator.mechanics
    start = integrator.start(state, controls)
    log = _log(vehicle.group)

    def after(delta, change):
        phase = integrator.start(state, controls)
        phase.g = vehicle.group.compose(start.g, vehicle.group.exp(delta[:d]))
        phase.r = start.r + delta[d : d + s]
        velocity = flat(m.knot_velocity_guess(start.r, start.pi, controls)) + delta[d + s :]
        c1 = np.asarray(controls) + change
        phase.pi = _momentum(m, phase.r, velocity, c1)
        phase = integrator.advance(phase, c1, c1)
        z = flat(m.knot_velocity_guess(phase.r, phase.pi, c1))
        return phase.g, phase.r, z

    zero = after(np.zeros(len(A)), np.zeros(c))
    scale = np.array([x.scale for x in vehicle.controls])
    for i in range(len(A) + c):
        delta, change = np.zeros(len(A)), np.zeros(c)
        if i < len(A):
            delta[i] = small
        else:
            change[i - len(A)] = small * scale[i - len(A)]
        g, r, z = after(delta, change)
        moved = log(vehicle.group.compose(vehicle.group.inverse(zero[0]), g))
        got = (np.concatenate([moved, r - zero[1], z - zero[2]]) - delta) / (small * h)
        expected = (A @ delta + B @ change) / small
        np.testing.assert_allclose(got, expected, atol=5e-3 * max(1.0, np.abs(expected).max()))


def _log(group):
    """Logarithm near the identity, by Newton on exp's own expression."""
    x = ca.SX.sym("x", group.dim)
    pose = group.exp(x)[1:4] * 2 if group.size == 7 else group.exp(x)
    full = ca.vertcat(pose, group.exp(x)[4:7]) if group.size == 7 else pose

    def log(g):
        target = np.concatenate([2 * g[1:4] / np.linalg.norm(g[:4]), g[4:7]]) if group.size == 7 else g
        solve = ca.rootfinder("log", "newton", {"x": x, "p": (p := ca.SX.sym("p", group.dim)), "g": full - p})
        return flat(solve(x0=np.zeros(group.dim), p=target)["x"])

    return log


def _momentum(m, r, z, c):
    from vehsim.vehicles.definition.mechanics import free_velocity

    r_, z_, c_ = ca.SX.sym("r", len(r)), ca.SX.sym("z", len(z)), ca.SX.sym("c", len(c))
    u, xi = ca.Function("v", [r_, z_, c_], [*free_velocity(m.vehicle, r_, z_, m.driven(c_))])(r, z, c)
    return flat(m.knot_momentum(r, u, xi))


@pytest.mark.parametrize(
    ("inertia", "message"),
    [((1, 1), "needs"), ((1, 1, 1, 1, 1, -1), "positive definite"), (np.ones((6, 6)), "positive definite")],
)
def test_wrong_inertia_is_named(inertia, message):
    with pytest.raises(InputError, match=message):
        Holonomic(name="body", group=SE3, inertia=inertia)


def test_dependent_constraints_and_missing_inertia_are_named():
    def kinetic(r, u, xi):
        return (xi[0] ** 2 + xi[1] ** 2 + xi[2] ** 2) / 2

    with pytest.raises(InputError, match="lose rank"):
        Nonholonomic(name="x", group=SE2, lagrangian=kinetic, constraints=lambda r: ([[], []], [[0, 0, 1], [0, 0, 2]]))
    with pytest.raises(InputError, match="not positive definite"):
        Nonholonomic(name="x", group=SE2, lagrangian=lambda r, u, xi: (xi[1] ** 2 + xi[2] ** 2) / 2)
    with pytest.raises(InputError, match="must be"):
        Nonholonomic(name="x", group=SE2, lagrangian=kinetic, constraints=lambda r: ([[]], [[0, 1]]))
