"""Every wheeled vehicle compared with an independent model: maximal coordinates and Lagrange multipliers.

Kinetic energy is built from the world positions of the parts, constraints from the world velocities of the wheels'
contacts, and the accelerations with the multipliers from one linear system, integrated by DOP853.
"""

import casadi as ca
import numpy as np
import pytest
from fleet import CAR, CONTROLS, FLEET, SLOPE, STARTS, SUSLOV
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation

from vehsim.integrators import Integrator

END, KNOTS = 1.2, 12


class Model:
    """Energies, constraints and forces in coordinates ``q = (theta, x, y, r...)``, added part by part."""

    def __init__(self, joints):
        self.q = ca.SX.sym("q", 3 + joints)
        self.v = ca.SX.sym("v", 3 + joints)
        self.c = ca.SX.sym("c", 4)
        self.theta, self.at, self.r = self.q[0], self.q[1:3], self.q[3:]
        self.u = self.v[3:]
        self.kinetic, self.potential = ca.SX(0), ca.SX(0)
        self.force = ca.SX(3 + joints, 1)
        self.rows, self.rates = [], []

    def dot(self, expression):
        return ca.jtimes(expression, self.q, self.v)

    def place(self, forward, left=0.0):
        return self.at + self.direction(0) * forward + self.direction(np.pi / 2) * left

    def direction(self, angle):
        return ca.vertcat(ca.cos(self.theta + angle), ca.sin(self.theta + angle))

    def body(self, mass, inertia, where, angle):
        speed = self.dot(where)
        self.kinetic += (mass * ca.dot(speed, speed) + inertia * self.dot(angle) ** 2) / 2

    def weight(self, mass, where):
        rise = np.array(SLOPE)
        self.potential += mass * 9.81 * ca.dot(ca.DM(rise), where) / np.sqrt(1 + rise @ rise)

    def no_slip(self, where, angle):
        self.rows.append(ca.dot(self.direction(angle + np.pi / 2), self.dot(where)))

    def drive(self, joint, control):
        """Make a control the rate of a joint."""
        self.rows.append(self.u[joint] - self.c[control])

    def accelerations(self):
        """(q, v, c, c_dot) -> a"""
        q, v, c = self.q, self.v, self.c
        c_dot = ca.SX.sym("c_dot", 4)
        rows = ca.vertcat(*self.rows)
        M, p = ca.hessian(self.kinetic, v)[0], ca.gradient(self.kinetic, v)
        rest = ca.jtimes(p, q, v) - ca.gradient(self.kinetic - self.potential, q) - self.force
        W = ca.jacobian(rows, v)
        drift = ca.jtimes(rows, q, v) + ca.jtimes(rows, c, c_dot)
        n, m = q.shape[0], rows.shape[0]
        system = ca.vertcat(ca.horzcat(M, W.T), ca.horzcat(W, ca.SX(m, m)))
        solution = ca.solve(system, ca.vertcat(-rest, -drift))
        return ca.Function("a", [q, v, c, c_dot], [solution[:n]])


def wheeled_base(joints, steering):
    model, rho, length = Model(joints), CAR["wheel_radius"], CAR["wheelbase"]
    model.body(CAR["mass"], CAR["yaw_inertia"], model.at, model.theta)
    model.kinetic += CAR["wheel_inertia"] * model.u[0] ** 2 / 2
    model.weight(CAR["mass"], model.at)
    model.no_slip(model.at, 0.0)
    model.no_slip(model.place(length), steering(model))
    model.rows.append(ca.dot(model.direction(0), model.dot(model.at)) - rho * model.u[0])
    return model


def car():
    model = wheeled_base(2, lambda m: ca.atan(m.r[1]))
    model.drive(1, 1)
    model.force[3] = model.c[0] - 3.0 * model.u[0]
    return model


def simple_car():
    """Steered by the angle itself: the coordinate is phi, not its tangent."""
    model = wheeled_base(2, lambda m: m.r[1])
    model.kinetic += 3.0 * model.u[1] ** 2 / 2
    model.force[3] = model.c[0] - 3.0 * model.u[0]
    model.force[4] = model.c[1] - 4.0 * model.u[1]
    return model


def two_wheeled():
    model, rho, d = Model(2), 0.1, 0.2
    model.body(10.0, 0.4, model.at, model.theta)
    model.kinetic += 0.02 * ca.dot(model.u, model.u) / 2
    model.weight(10.0, model.at)
    model.no_slip(model.at, 0.0)
    for i, side in enumerate((-d, d)):
        hub = model.dot(model.place(0, side))
        model.rows.append(ca.dot(model.direction(0), hub) - rho * model.u[i])
    model.force[3:] = model.c[:2]
    return model


def snakeboard():
    model, half, m, rotor, truck = Model(2), 0.35, 70.0, 2.0, 0.1
    # board and trucks have what m half^2 leaves beside rotor and trucks; trucks turn by -phi and +phi
    model.body(m, m * half**2 - rotor - 2 * truck, model.at, model.theta)
    model.kinetic += rotor * (model.v[0] + model.u[0]) ** 2 / 2
    model.kinetic += truck * ((model.v[0] + model.u[1]) ** 2 + (model.v[0] - model.u[1]) ** 2) / 2
    model.weight(m, model.at)
    model.no_slip(model.place(half), -model.r[1])
    model.no_slip(model.place(-half), model.r[1])
    model.force[3:] = model.c[:2] - 0.3 * model.u
    return model


def chaplygin_sleigh():
    model = Model(0)
    model.body(3.0, 0.5, model.place(0.3), model.theta)
    model.weight(3.0, model.place(0.3))
    model.no_slip(model.at, 0.0)
    along = ca.dot(model.direction(0), model.v[1:3])
    model.force[0] = model.c[1]
    model.force[1:3] = (model.c[0] - 0.2 * along) * model.direction(0)
    return model


def roller_racer():
    model = Model(1)
    axle = model.place(0.5) + 0.15 * model.direction(model.r[0])
    model.body(40.0, 2.0, model.at, model.theta)
    model.body(3.0, 0.1, axle, model.theta + model.r[0])
    model.no_slip(model.at, 0.0)
    model.no_slip(axle, model.r[0])
    model.force[3] = model.c[0] - 0.4 * model.u[0]
    return model


def car_trailer():
    model = wheeled_base(3, lambda m: ca.atan(m.r[1]))
    axle = model.place(-0.9) - 2.5 * model.direction(model.r[2])
    model.body(600.0, 700.0, axle, model.theta + model.r[2])
    model.no_slip(axle, model.r[2])
    model.drive(1, 1)
    model.force[3] = model.c[0]
    model.force[5] = -50.0 * model.u[2]
    return model


MODELS = {
    f.__name__: f for f in (car, simple_car, two_wheeled, snakeboard, chaplygin_sleigh, roller_racer, car_trailer)
}


def reference(accelerations, q, v, table):
    """Integrate the model under knot controls, segment by segment."""
    n, h = len(q), END / KNOTS
    x = np.concatenate([q, v])
    padded = np.zeros((len(table), 4))
    padded[:, : table.shape[1]] = table
    for k in range(KNOTS):
        c0, slope = padded[k], (padded[k + 1] - padded[k]) / h

        def law(t, x, c0=c0, slope=slope):
            return np.concatenate([x[n:], np.asarray(accelerations(x[:n], x[n:], c0 + slope * t, slope)).ravel()])

        x = solve_ivp(law, (0, h), x, method="DOP853", rtol=1e-11, atol=1e-11).y[:, -1]
    return x[:n], x[n:]


def ours(name, count, **options):
    table = CONTROLS[name](np.linspace(0, END, KNOTS + 1))
    at = np.linspace(0, KNOTS, count + 1)
    controls = np.column_stack([np.interp(at, np.arange(KNOTS + 1), column) for column in table.T])
    return table, Integrator(FLEET[name], END / count, **options).rollout(STARTS[name], controls)


@pytest.mark.parametrize("name", MODELS)
def test_motion_is_that_of_the_multiplier_model(name):
    table, clip = ours(name, 240, order=6)
    q = np.concatenate([[0.0, *clip.positions[0, :2]], clip.joints[0]])
    v = np.concatenate([clip.twists[0], clip.joint_rates[0]])
    if name == "simple_car":
        q[4], v[4] = np.arctan(q[4]), v[4] / (1 + q[4] ** 2)
    q, v = reference(MODELS[name]().accelerations(), q, v, table)
    yaw = 2 * np.arctan2(clip.orientations[-1, 3], clip.orientations[-1, 0])
    if name == "simple_car":
        q[4] = np.tan(q[4])
    turn = np.array([[np.cos(q[0]), np.sin(q[0])], [-np.sin(q[0]), np.cos(q[0])]])
    np.testing.assert_allclose(clip.positions[-1, :2], q[1:3], atol=2e-8)
    np.testing.assert_allclose((yaw - q[0] + np.pi) % (2 * np.pi), np.pi, atol=2e-8)
    np.testing.assert_allclose(clip.joints[-1], q[3:], atol=2e-7)
    np.testing.assert_allclose(clip.twists[-1], [v[0], *(turn @ v[1:3])], atol=2e-7)
    assert np.abs(clip.twists[-1] - clip.twists[0]).max() > 0.05


def test_suslov_is_that_of_the_multiplier_model():
    """``J omega' = J omega x omega + torque + lambda e_z``, ``omega_z = 0``, with rotations as quaternions."""
    table, clip = ours("suslov", 240, order=6)
    J, h = np.array(SUSLOV), END / KNOTS
    system = np.block([[J, -np.eye(3)[:, 2:]], [np.eye(3)[2:], np.zeros((1, 1))]])
    x = np.concatenate([[1.0, 0, 0, 0], [1.0, 0.5, 0.0]])
    for k in range(KNOTS):

        def law(t, x, c0=table[k], c1=table[k + 1]):
            q, w = x[:4], x[4:]
            torque = c0 + t / h * (c1 - c0)
            acceleration = np.linalg.solve(system, [*(np.cross(J @ w, w) + torque), 0.0])[:3]
            spin = 0.5 * np.array([-q[1:] @ w, *(q[0] * w + np.cross(q[1:], w))])
            return np.concatenate([spin, acceleration])

        x = solve_ivp(law, (0, h), x, method="DOP853", rtol=1e-12, atol=1e-12).y[:, -1]
    apart = Rotation.from_quat(x[[1, 2, 3, 0]]).inv() * Rotation.from_quat(clip.orientations[-1][[1, 2, 3, 0]])
    assert apart.magnitude() < 1e-9
    np.testing.assert_allclose(clip.twists[-1], x[4:], atol=1e-9)


@pytest.mark.parametrize("name", FLEET)
@pytest.mark.parametrize("difference_map", ["exp", "cay", "tln"])
@pytest.mark.parametrize(("order", "counts"), [(2, (48, 96)), (4, (24, 48)), (6, (24, 48))])
def test_order_with_constraints_and_forces(name, difference_map, order, counts):
    """Observed order of the composed scheme, under controls linear between knots, forces, slopes and damping."""

    def end(count, **options):
        _, clip = ours(name, count, **options)
        return np.concatenate([clip.matrices()[-1, :3].ravel(), clip.joints[-1], clip.twists[-1]])

    exact = end(480, order=6)
    errors = [np.abs(end(count, order=order, difference_map=difference_map) - exact).max() for count in counts]
    if errors[1] < 1e-10:  # below the tolerance of the solves
        return
    assert np.log2(errors[0] / errors[1]) == pytest.approx(order, abs=0.5), errors
