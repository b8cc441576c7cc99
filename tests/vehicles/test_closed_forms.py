"""The papers' closed-form updates follow from the general scheme with C_TLN; known motions as references."""

import numpy as np
import pytest
from fleet import CAR, CONTROLS, FLEET, SUSLOV

from vehsim.integrators import Integrator
from vehsim.vehicles import State
from vehsim.vehicles.models.car import car
from vehsim.vehicles.models.chaplygin_sleigh import chaplygin_sleigh
from vehsim.vehicles.models.simple_car import simple_car
from vehsim.vehicles.models.snakeboard import snakeboard
from vehsim.vehicles.models.two_wheeled import two_wheeled

H, STEPS = 0.05, 60
TIMES = H * np.arange(STEPS + 1)


def averaged(f):
    """``h/4 (f_k-1 + 2 f_k + f_k+1)``: both papers' forces with alpha = 1/2."""
    return H / 4 * (f[:-2] + 2 * f[1:-1] + f[2:])


def run(vehicle, start, controls, name="tln"):
    return Integrator(vehicle, H, name, quadrature="averaged").rollout(start, controls)


@pytest.mark.parametrize("name", ["tln", "cay", "exp"])
def test_car_update_of_the_paper(name):
    """LIE 5.2.1, alpha = 1/2; exact with C_TLN, not with the others."""
    vehicle = car(**CAR, half_track=0.77)
    controls = CONTROLS["car"](TIMES)
    clip = run(vehicle, State(twist=(0, 4, 0), joints=(0, 0.2)), controls, name)
    I, m, K, rho, l = (CAR[k] for k in ("wheel_inertia", "mass", "yaw_inertia", "wheel_radius", "wheelbase"))  # noqa: E741
    u = np.diff(clip.joints[:, 0]) / H
    sigma, middle = clip.joints[:, 1], (clip.joints[1:, 1] + clip.joints[:-1, 1]) / 2
    left = (I + rho**2 * m) * np.diff(u) + rho**2 * K / l**2 * sigma[1:-1] * np.diff(middle * u)
    error = np.abs(left - averaged(controls[:, 0])).max() / np.abs(averaged(controls[:, 0])).max()
    assert error < 1e-11 if name == "tln" else error > 1e-7


@pytest.mark.parametrize("name", ["tln", "cay", "exp"])
def test_two_wheeled_update_of_the_paper(name):
    """NH IV.A.1 with eq. 21; exact with C_TLN, not with the others."""
    m, J, Jw, rho, d = 10.0, 0.4, 0.02, 0.1, 0.2
    vehicle = two_wheeled(mass=m, yaw_inertia=J, wheel_inertia=Jw, wheel_radius=rho, half_track=d)
    controls = CONTROLS["two_wheeled"](TIMES)
    clip = run(vehicle, State(joint_rates=(6.0, 5.0)), controls, name)
    C, D = Jw + m * rho**2 / 4 + J * rho**2 / (4 * d**2), m * rho**2 / 4 - J * rho**2 / (4 * d**2)
    change = np.diff(np.diff(clip.joints, axis=0) / H, axis=0)
    error = np.abs(change @ [[C, D], [D, C]] - averaged(controls)).max() / np.abs(averaged(controls)).max()
    assert error < 1e-12 if name == "tln" else error > 1e-4


def test_simple_car_in_the_reduced_scheme_of_the_paper():
    """NH eq. 14-17 with the curvature force of eq. 24: ours agrees to the order of both, O(h^2)."""
    vehicle = simple_car(**CAR, steering_inertia=3.0)
    I, m, K, rho, l, J = *(CAR[k] for k in ("wheel_inertia", "mass", "yaw_inertia", "wheel_radius", "wheelbase")), 3.0  # noqa: E741
    ends = []
    for h in (0.02, 0.01):
        t = h * np.arange(int(1.0 / h) + 1)
        controls = CONTROLS["simple_car"](t)
        clip = Integrator(vehicle, h, "tln").rollout(State(twist=(0, 4, 0), joints=(0, 0.2)), controls)
        r, u = clip.joints, np.diff(clip.joints, axis=0) / h
        psi, sigma, at = u[:, 0], u[:, 1], (r[1:, 1] + r[:-1, 1]) / 2
        momentum = np.column_stack([(I + m * rho**2 + K * rho**2 * at**2 / l**2) * psi, J / (1 + at**2) ** 2 * sigma])
        shape = K * rho**2 * at / l**2 * psi**2 - 2 * J * at / (1 + at**2) ** 3 * sigma**2
        force = np.column_stack([-K * rho**2 * at * psi * sigma / l**2, K * rho**2 * at * psi**2 / l**2])
        torque = controls * np.column_stack([np.ones_like(t), 1 / (1 + r[:, 1] ** 2)])
        f = (torque[:-1] + torque[1:]) / 2
        left = np.diff(momentum, axis=0) - h / 2 * np.column_stack([0 * at[1:], shape[1:] + shape[:-1]])
        right = h / 2 * (f[1:] + f[:-1]) - h / 2 * (force[1:] + force[:-1])
        ends.append(np.abs(left - right).max() / h)
    assert ends[0] / ends[1] == pytest.approx(4, rel=0.2)


def test_snakeboard_update_of_the_paper():
    """LIE 5.2.2: ``e_1(r_k) . (mu_k - mu_k-1) = 0`` and ``d(dl/du) = h f``, misprints of mu corrected."""
    m, l, I, J = 70.0, 0.35, 2.0, 0.1  # noqa: E741
    vehicle = snakeboard(mass=m, half_length=l, rotor_inertia=I, steering_inertia=J)
    controls = CONTROLS["snakeboard"](TIMES)
    clip = run(vehicle, State(twist=(0, 1, 0), joints=(0.1, 0.3)), controls)
    u = np.diff(clip.joints, axis=0) / H
    xi = segment_velocity(clip)
    phi, middle = clip.joints[:, 1], (clip.joints[1:, 1] + clip.joints[:-1, 1]) / 2
    np.testing.assert_allclose(xi[:, 0] * l * np.cos(middle), -np.sin(middle) * xi[:, 1], atol=1e-12)
    mu = np.column_stack([m * l**2 * xi[:, 0] + I * u[:, 0], m * xi[:, 1]])
    e = np.column_stack([np.tan(phi) / l, -np.ones_like(phi)])[1:-1]
    np.testing.assert_allclose(np.sum(e * np.diff(mu, axis=0), axis=1), 0, atol=1e-11 * np.abs(mu).max())
    conjugate = np.column_stack([I * (u[:, 0] + xi[:, 0]), 2 * J * u[:, 1]])
    np.testing.assert_allclose(np.diff(conjugate, axis=0), averaged(controls), atol=1e-11)


def segment_velocity(clip):
    """``(omega, vx)`` of each segment from its end poses, by the Cayley map of the plane."""
    yaw = np.unwrap(2 * np.arctan2(clip.orientations[:, 3], clip.orientations[:, 0]))
    x = 2 * np.tan(np.diff(yaw) / 2)
    step = np.diff(clip.positions[:, :2], axis=0)
    c, s = np.cos(yaw[:-1]), np.sin(yaw[:-1])
    local = np.column_stack([c * step[:, 0] + s * step[:, 1], -s * step[:, 0] + c * step[:, 1]])
    return np.column_stack([x, local[:, 0] + x / 2 * local[:, 1]]) / H


def test_snakeboard_with_locked_trucks_runs_on_an_arc():
    """LIE 5.2.2: trucks turned and fixed: a circle about a fixed centre, with constant momentum about it."""
    vehicle = snakeboard(mass=70.0, half_length=0.35, rotor_inertia=2.0, steering_inertia=1e9)
    state = State(twist=(0, 1.5, 0), joints=(0, 0.4), joint_rates=(0, 0))
    clip = Integrator(vehicle, H, "exp").rollout(state, np.zeros((200, 2)))
    radius = 0.35 / np.tan(0.4)
    yaw = np.unwrap(2 * np.arctan2(clip.orientations[:, 3], clip.orientations[:, 0]))
    left = np.column_stack([-np.sin(yaw), np.cos(yaw)])
    centres = clip.positions[:, :2] - radius * left  # it turns right: omega = -tan(phi) vx / l
    np.testing.assert_allclose(centres, np.tile(centres[0], (200, 1)), atol=1e-7)
    about = 70 * clip.twists[:, 1] * radius - (70 * 0.35**2) * clip.twists[:, 0] - 2.0 * clip.joint_rates[:, 0]
    np.testing.assert_allclose(about, about[0], rtol=1e-7)


def test_chaplygin_sleigh_ends_straight_with_its_energy():
    """``vx' = a w^2``, ``w' = -m a w vx / (J + m a^2)``: an ellipse of constant energy, from turning to straight on."""
    vehicle = chaplygin_sleigh(mass=3.0, yaw_inertia=0.5, ahead=0.3)
    clip = Integrator(vehicle, 0.02, "cay", 4).rollout(State(twist=(2.0, 0.1, 0.0)), np.zeros((1000, 2)))
    about = 0.5 + 3 * 0.3**2
    energy = (3 * clip.twists[:, 1] ** 2 + about * clip.twists[:, 0] ** 2) / 2
    np.testing.assert_allclose(energy, energy[0], rtol=1e-6)
    # closed form: w = w_m sech(k (t - t_0)), vx = v_m tanh(k (t - t_0))
    most = np.sqrt(2 * energy[0] / 3)
    k = 3 * 0.3 / about * most
    start = np.arctanh(clip.twists[0, 1] / most)
    np.testing.assert_allclose(clip.twists[:, 1], most * np.tanh(k * clip.times + start), atol=1e-5)
    assert abs(clip.twists[-1, 0]) < 1e-3


def test_suslov_ends_in_a_steady_turn_with_its_energy():
    clip = Integrator(FLEET["suslov"], 0.1, order=4).rollout(State(twist=(1.0, 0.5, 0.0)), np.zeros((1001, 3)))
    J = np.array(SUSLOV)
    np.testing.assert_allclose(clip.twists[:, 2], 0, atol=1e-12)
    # steady turns lie where J_13 w_1 + J_23 w_2 = 0
    assert abs(J[0, 2] * clip.twists[-1, 0] + J[1, 2] * clip.twists[-1, 1]) < 1e-6
    kinetic = clip.energy["kinetic"]
    assert np.ptp(kinetic) < 5e-4 * kinetic[0]


def test_a_car_coasts_down_a_slope():
    """Wheels straight, nose downhill: constant acceleration ``g sin / (1 + I / (m rho^2))``, exactly."""
    vehicle = car(**CAR, half_track=0.77, slope=(-0.1, 0.0))
    clip = Integrator(vehicle, H).rollout(State(), np.zeros((101, 2)))
    a = 9.81 * 0.1 / np.sqrt(1.01) / (1 + 2.4 / (1350 * 0.32**2))
    np.testing.assert_allclose(clip.positions[:, 0], a * clip.times**2 / 2, atol=1e-10)
    total = clip.energy["kinetic"] + clip.energy["potential"]
    np.testing.assert_allclose(total, total[0], atol=1e-6)


@pytest.mark.parametrize("name", ["car", "two_wheeled"])
def test_damping_does_not_depend_on_the_step(name):
    """The speed after two seconds of coasting at h = 1/24 is within 1 % of that at h = 1/480, and near the
    exponential."""
    vehicle = {
        "car": car(**CAR, half_track=0.77, rolling_damping=80.0),
        "two_wheeled": two_wheeled(
            mass=10, yaw_inertia=0.4, wheel_inertia=0.02, wheel_radius=0.1, half_track=0.2, rolling_damping=0.05
        ),
    }[name]
    rate = {"car": 80 / (2.4 + 1350 * 0.32**2), "two_wheeled": 0.05 / (0.02 + 10 * 0.1**2 / 2)}[name]
    left = []
    for h in (1 / 24, 1 / 480):
        n = round(2 / h)
        clip = Integrator(vehicle, h).rollout(State(twist=(0, 5, 0)), np.zeros((n + 1, 2)))
        left.append(clip.twists[-1, 1])
        lost = clip.energy["kinetic"][0] - clip.energy["kinetic"][-1]
        assert clip.energy["dissipated"][-1] == pytest.approx(lost, rel=2e-3)
    assert left[0] == pytest.approx(left[1], rel=0.01)
    assert left[1] == pytest.approx(5 * np.exp(-2 * rate), rel=1e-4)
