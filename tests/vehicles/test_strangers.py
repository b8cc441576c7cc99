"""Vehicles outside the repository, written with the public API, compared with models in maximal coordinates.

These models know nothing of groups or connections: world coordinates, constraints with Lagrange multipliers
differentiated once, one linear system for the accelerations, DOP853 at 1e-12.
"""

import casadi as ca
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import vehsim
from vehsim.errors import InputError, SolveError
from vehsim.integrators import Integrator
from vehsim.lie import SE2, SE3, SO3
from vehsim.vehicles import Control, Holonomic, Nonholonomic, State

END = 1.5


def judge(kinetic, rows, force, q, v, q0, v0, t):
    """``q(END), v(END)`` of ``d/dt dT/dv - dT/dq = force + rows^T lambda``, ``rows v = 0``; all are expressions."""
    n, m = q.shape[0], rows.shape[0]
    mass, momentum = ca.hessian(kinetic, v)[0], ca.gradient(kinetic, v)
    rest = force + ca.gradient(kinetic, q) - ca.jtimes(momentum, q, v)
    drift = ca.jtimes(rows @ v, q, v)
    system = ca.vertcat(ca.horzcat(mass, rows.T), ca.horzcat(rows, ca.SX(m, m)))
    a = ca.Function("a", [t, q, v], [ca.solve(system, ca.vertcat(rest, -drift))[:n]])
    law = lambda s, x: np.concatenate([x[n:], np.asarray(a(s, x[:n], x[n:])).ravel()])
    x = solve_ivp(law, (0, END), np.concatenate([q0, v0]), "DOP853", rtol=1e-12, atol=1e-12).y[:, -1]
    return x[:n], x[n:]


def knots(h, law):
    return np.array([np.atleast_1d(law(t)) for t in h * np.arange(round(END / h) + 1)])


def end_by_refinement(vehicle, start, law, h=END / 240):
    """The last state, and the convergence of the second-order scheme to the sixth-order solution."""
    clips = [
        Integrator(vehicle, step, order=o).rollout(start, knots(step, law))
        for step, o in ((h, 6), (4 * h, 2), (2 * h, 2))
    ]
    ends = [np.concatenate([c.positions[-1], c.orientations[-1], c.joints[-1]]) for c in clips]
    coarse, fine = (np.abs(end - ends[0]).max() for end in ends[1:])
    return clips[0], np.log2(coarse / fine)


def test_a_tractor_with_two_trailers_all_with_inertia():
    """Wheels of three axles do not slip sideways; both hitches are tied joints, found from the constraints."""
    m, J, L, b = (900.0, 500.0, 300.0), (800.0, 400.0, 150.0), (2.4, 1.8, 1.5), 0.4
    steer = 0.25

    def lagrangian(r, u, xi):
        energy = J[0] * xi[0] ** 2 + m[0] * (xi[1] ** 2 + xi[2] ** 2)
        hitch, angle, turn = ca.vertcat(xi[1], xi[2] - b * xi[0]), ca.SX(0), xi[0]
        for i in (1, 2):  # velocity of each axle in the tractor's axes
            angle, turn = angle + r[i - 1], turn + u[i - 1]
            hitch = hitch - L[i] * turn * ca.vertcat(-ca.sin(angle), ca.cos(angle))
            energy += J[i] * turn**2 + m[i] * ca.sumsqr(hitch)
        return energy / 2

    def constraints(r):
        c, s = ca.cos, ca.sin
        a, both = r[0], r[0] + r[1]
        W_xi = ca.vertcat(
            ca.horzcat(0, 0, 1),
            ca.horzcat(-L[0], ca.tan(steer), 0),
            ca.horzcat(-b * c(a) - L[1], -s(a), c(a)),
            ca.horzcat(-b * c(both) - L[1] * c(both - a) - L[2], -s(both), c(both)),
        )
        W_r = ca.vertcat(ca.SX(2, 2), ca.horzcat(-L[1], 0), ca.horzcat(-L[1] * c(both - a) - L[2], -L[2]))
        return W_r, W_xi

    vehicle = Nonholonomic(
        name="train",
        group=SE2,
        joints=("first", "second"),
        lagrangian=lagrangian,
        constraints=constraints,
        forces=lambda r, u, xi, c: (ca.vertcat(0, 0), ca.vertcat(0, c[0], 0)),
        controls=(Control("pull"),),
        sample=(0.3, -0.2),
    )
    assert vehicle.tied == (0, 1)
    start = State(twist=(np.tan(steer) * 3.0 / L[0], 3.0, 0.0), joints=(0.5, -0.4))
    clip, order = end_by_refinement(vehicle, start, lambda t: 2000.0 - 1000.0 * t)
    assert order == pytest.approx(2, abs=0.2)

    q, v, t = ca.SX.sym("q", 9), ca.SX.sym("v", 9), ca.SX.sym("t")  # (x, y, angle) of three separate bodies
    along = [ca.vertcat(ca.cos(q[3 * i + 2]), ca.sin(q[3 * i + 2])) for i in range(3)]
    kinetic = sum(m[i] * ca.sumsqr(v[3 * i : 3 * i + 2]) + J[i] * v[3 * i + 2] ** 2 for i in range(3)) / 2
    joined = [q[0:2] - b * along[0] - q[3:5] - L[1] * along[1], q[3:5] - q[6:8] - L[2] * along[2]]
    rows = [ca.jacobian(ca.vertcat(*joined), q)]
    for i in range(3):
        row = ca.SX(1, 9)
        row[0, 3 * i : 3 * i + 2] = ca.horzcat(-along[i][1], along[i][0])
        rows.append(row)
    front = ca.SX(1, 9)
    front[0, 0], front[0, 1] = -ca.sin(q[2] + steer), ca.cos(q[2] + steer)
    front[0, 2] = L[0] * ca.cos(steer)
    rows = ca.vertcat(*rows, front)
    force = ca.vertcat((2000.0 - 1000.0 * t) * along[0], ca.SX(7, 1))
    q0 = np.array([0, 0, 0, 0, 0, 0.5, 0, 0, 0.1])
    q0[3:5] = [-b - L[1] * np.cos(0.5), -L[1] * np.sin(0.5)]
    q0[6:8] = q0[3:5] - L[2] * np.array([np.cos(0.1), np.sin(0.1)])
    w = np.asarray(ca.Function("w", [q], [rows])(q0))
    steady = np.zeros(9)
    steady[:3] = (3.0, 0.0, start.twist[0])
    steady[3:] = np.linalg.lstsq(w[:, 3:], -w[:, :3] @ steady[:3], rcond=None)[0]
    end, speed = judge(kinetic, rows, force, q, v, q0, steady, t)
    yaw = 2 * np.arctan2(clip.orientations[-1, 3], clip.orientations[-1, 0])
    np.testing.assert_allclose(clip.positions[-1, :2], end[:2], atol=1e-9)
    np.testing.assert_allclose([yaw, *clip.joints[-1]], [end[2], end[5] - end[2], end[8] - end[5]], atol=1e-9)
    np.testing.assert_allclose(clip.joint_rates[-1], [speed[5] - speed[2], speed[8] - speed[5]], atol=1e-9)


def test_an_upright_disc_that_rolls_and_is_turned():
    """Without torques it rolls on a circle of radius ``v / turn``: the circle is exact with C_TLN, at any step."""
    m, radius, spin, pivot = 2.0, 0.3, 0.09, 0.045
    vehicle = Nonholonomic(
        name="disc",
        group=SE2,
        joints=("roll",),
        lagrangian=lambda r, u, xi: (m * (xi[1] ** 2 + xi[2] ** 2) + pivot * xi[0] ** 2 + spin * u[0] ** 2) / 2,
        constraints=lambda r: ([[-radius], [0]], [[0, 1, 0], [0, 0, 1]]),
    )
    clip = Integrator(vehicle, END / 50, "tln").rollout(State(twist=(0.8, 1.2, 0.0)), np.zeros((51, 0)))
    np.testing.assert_allclose(np.hypot(clip.positions[:, 0], clip.positions[:, 1] - 1.5), 1.5, atol=1e-12)
    np.testing.assert_allclose(clip.joints[:, 0], 1.2 / radius * clip.times, atol=1e-12)
    np.testing.assert_allclose(clip.energy["kinetic"], clip.energy["kinetic"][0], rtol=1e-12)


def test_arms_with_a_spring_between_them():
    """Springs in the Lagrangian, joints only (no constraints), inertia that depends on them: compared with Lagrange."""
    k, a = 30.0, 0.7

    def lagrangian(r, u, xi):
        reach = 1 + a * ca.cos(r[0])
        return (
            xi[0] ** 2 * reach**2 + 2 * xi[0] * u[0] * reach + 2 * u[0] ** 2 + u[1] ** 2 + 3 * ca.sumsqr(xi[1:3])
        ) / 2 - (k * (r[0] - r[1]) ** 2 / 2)

    with pytest.raises(InputError, match=r"group = 'SE2': not a group; give the group itself, vehsim\.lie\.SE2"):
        Nonholonomic(name="arms", group="SE2", joints=("p", "q"), lagrangian=lagrangian)  # type: ignore[arg-type]
    vehicle = Nonholonomic(name="arms", group=SE2, joints=("p", "q"), lagrangian=lagrangian)
    start = State(twist=(1.0, 0.4, -0.3), joints=(0.2, -0.1), joint_rates=(0.5, 2.0))
    clip, order = end_by_refinement(vehicle, start, lambda t: np.zeros(0))
    assert order == pytest.approx(2, abs=0.2)
    q, v, t = ca.SX.sym("q", 5), ca.SX.sym("v", 5), ca.SX.sym("t")
    full = lagrangian(q[3:], v[3:], v[:3])  # planar translation is isotropic, so world velocities can be used
    end, _ = judge(full, ca.SX(0, 5), ca.SX(5, 1), q, v, [0, 0, 0, 0.2, -0.1], [1.0, 0.4, -0.3, 0.5, 2.0], t)
    yaw = 2 * np.arctan2(clip.orientations[-1, 3], clip.orientations[-1, 0])
    np.testing.assert_allclose([yaw, *clip.positions[-1, :2], *clip.joints[-1]], end, atol=1e-9)
    total = clip.energy["kinetic"] + clip.energy["potential"]
    np.testing.assert_allclose(total, total[0], atol=1e-8)


def test_a_dart_in_space():
    """It can only move along its own X, and rotate freely: it keeps its speed and rotates as a free top does."""
    inertia = np.diag([1.0, 2.0, 2.5, 3.0, 3.0, 3.0])
    dart = Nonholonomic(
        name="dart",
        group=SE3,
        lagrangian=lambda r, u, xi: xi.T @ ca.DM(inertia) @ xi / 2,
        constraints=lambda r: (ca.SX(2, 0), ca.DM(np.eye(6)[4:])),
    )
    clip = Integrator(dart, 0.02, order=4).rollout(State(twist=(0.6, 0.9, -0.4, 2.0, 0, 0)), np.zeros((76, 0)))
    top = Holonomic(name="top", group=SO3, inertia=(1.0, 2.0, 2.5), gravity=0.0)
    free = Integrator(top, 0.02, order=4).rollout(State(twist=(0.6, 0.9, -0.4)), np.zeros((76, 0)))
    np.testing.assert_allclose(clip.twists[:, :3], free.twists, atol=1e-7)
    np.testing.assert_allclose(clip.twists[:, 3:], np.tile([2.0, 0, 0], (76, 1)), atol=1e-7)
    np.testing.assert_allclose(clip.energy["kinetic"], clip.energy["kinetic"][0], rtol=1e-7)


def sled(**changed):
    given = {
        "name": "sled",
        "group": SE2,
        "joints": (),
        "lagrangian": lambda r, u, xi: (2 * xi[0] ** 2 + 5 * (xi[1] ** 2 + xi[2] ** 2)) / 2,
        "constraints": lambda r: (ca.SX(1, 0), [[0, 0, 1]]),
    }
    return Nonholonomic(**{**given, **changed})


def test_a_vehicle_may_have_no_joints_and_no_controls():
    """Turning and gliding at once: a circle; simulated, copied and written like any vehicle."""
    clip = vehsim.simulate(sled(), vehsim.World(), (), State(twist=(0.5, 2.0, 0.0)), duration=END, step=0.01)
    np.testing.assert_allclose(np.hypot(clip.positions[:, 0], clip.positions[:, 1] - 4.0), 4.0, atol=3e-4)
    assert clip.joints.shape == (len(clip), 0) and clip.controls.shape == (len(clip), 0)


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"constraints": lambda r: (ca.SX(2, 0), [[0, 0, 1], [0, 0, 2]])}, "constraints: rows lose rank at joints = "),
        ({"constraints": lambda r: (ca.SX(4, 0), ca.SX.ones(4, 3))}, "constraints: rows lose rank"),
        ({"constraints": lambda r: (ca.SX(1, 1), [[0, 0, 1]])}, r"W_r has shape \(1, 1\)"),
        (
            {"lagrangian": lambda r, u, xi: (xi[1] ** 2 + xi[2] ** 2) / 2},
            "not positive definite on the free velocities",
        ),
        (
            {"lagrangian": lambda r, u, xi: (xi[1] ** 2 - xi[0] ** 2) / 2},
            "not positive definite on the free velocities",
        ),
        ({"rate_controls": {"spin": "wheel"}}, "rate_controls"),
        ({"constraints": lambda r: [[0, 0, 1]]}, r"constraints: does not give two matrices; return W_r \(m, 0\)"),
        ({"constraints": lambda r: (ca.SX(1, 0), [0, 0, 1])}, "constraints: does not give two matrices"),
        ({"forces": lambda r, u, xi, c: [1.0]}, r"forces: returns shape \(1, 1\); return an empty column, ca.SX"),
        ({"forces": lambda r, u, xi, c: ([], [1.0, 2.0])}, r"forces: returns shape \(2, 1\); return a column of 3"),
        ({"forces": lambda r, u, xi, c: None}, "forces: returns NoneType, neither numbers nor expressions; return an"),
        ({"lagrangian": lambda r, u, xi: xi}, r"lagrangian: returns shape \(3, 1\); return a scalar"),
        ({"lagrangian": lambda r, u, xi: ca.dot(xi, xi) + xi[1] ** 4}, "lagrangian: not quadratic in the velocities"),
        ({"lagrangian": lambda r, u, xi: ca.sqrt(1 + ca.dot(xi, xi))}, "lagrangian: not quadratic in the velocities"),
        (
            {"lagrangian": lambda r, u, xi: ca.dot(xi, xi) * ca.if_else(xi[1] > 50, 2, 1)},
            "lagrangian: not quadratic in the velocities",
        ),
        ({"lagrangian": lambda r, u, xi: ca.dot(xi, xi) * float("nan")}, "lagrangian: not finite at joints"),
        ({"lagrangian": lambda r, u, xi: ca.dot(xi, xi) * ca.SX.sym("m")}, "lagrangian: depends on m, which"),
        ({"lagrangian": lambda r, u, xi: xi[4]}, r"lagrangian: cannot be evaluated: .*shapes \(0,\), \(0,\), \(3,\)"),
        ({"constraints": lambda r: (ca.SX(1, 0), [[0, ca.SX.sym("k"), 1]])}, "constraints: depends on k"),
        ({"constraints": lambda r: (ca.SX(1, 0), [[0, float("inf"), 1]])}, "constraints: .* not finite"),
        ({"potential_energy": lambda g, r: g}, r"potential_energy: returns shape \(3, 1\); return a scalar"),
        ({"potential_energy": lambda g, r: g[0] * ca.SX.sym("k")}, "potential_energy: depends on k"),
        ({"potential_energy": lambda g, r: r[1]}, "potential_energy: cannot be evaluated"),
        ({"forces": lambda r, u, xi, c: ([], [0, 0, c[2]])}, "forces: cannot be evaluated: .*out of bounds"),
        ({"forces": lambda r, u, xi, c: ([], [0, 0, ca.SX.sym("k")])}, "forces: depends on k"),
    ],
)
def test_a_vehicle_that_cannot_move_is_refused_when_it_is_made(changed, message):
    with pytest.raises(InputError, match=message):
        sled(**changed)


@pytest.mark.parametrize(("name", "law"), [("wrench", lambda c: c), ("drag", lambda x: x[:2])])
def test_a_law_of_a_body_with_the_wrong_shape_is_named(name, law):
    with pytest.raises(InputError, match=rf"body: {name}: returns shape .*; return a column of 3"):
        Holonomic(name="body", group=SE2, inertia=(1, 2, 2), controls=(Control("thrust"),), **{name: law})


def test_lagrangians_that_are_quadratic_in_the_end_are_accepted():
    """Terms linear in the velocities, and a square root that a square undoes."""
    spinning = sled(lagrangian=lambda r, u, xi: (ca.sqrt(ca.dot(xi, xi)) ** 2 + 0.3 * xi[0]) / 2)
    clip = Integrator(spinning, 0.1).rollout(State(twist=(0.5, 2.0, 0.0)), np.zeros((11, 0)))
    np.testing.assert_allclose(clip.twists, np.tile([0.5, 2.0, 0.0], (11, 1)), atol=1e-12)


def cart_with_driven_rear_steering():
    """A front axle at the origin; a rear wheel one metre behind, whose steering has inertia and is set by its rate."""
    return Nonholonomic(
        name="cart",
        group=SE2,
        joints=("steer",),
        lagrangian=lambda r, u, xi: (10 * (xi[1] ** 2 + xi[2] ** 2) + 1.5 * xi[0] ** 2 + 0.4 * (xi[0] + u[0]) ** 2) / 2,
        constraints=lambda r: ([[0], [0]], [[0, 0, 1], [-ca.cos(r[0]), -ca.sin(r[0]), ca.cos(r[0])]]),
        controls=(Control("rate"),),
        rate_controls={"rate": "steer"},
    )


def cart_with_driven_boom():
    """A cart that cannot slip sideways, with a boom that is turned by its rate, and air that slows both."""

    def lagrangian(r, u, xi):
        tip = ca.vertcat(xi[1], xi[2]) + 0.4 * (xi[0] + u[0]) * ca.vertcat(-ca.sin(r[0]), ca.cos(r[0]))
        return (12 * (xi[1] ** 2 + xi[2] ** 2) + 1.3 * xi[0] ** 2 + 0.8 * ca.sumsqr(tip)) / 2

    return Nonholonomic(
        name="crane",
        group=SE2,
        joints=("boom",),
        lagrangian=lagrangian,
        constraints=lambda r: ([[0]], [[0, 0, 1]]),
        forces=lambda r, u, xi, c: ([0], [-0.3 * xi[0], -0.5 * xi[1], 0]),
        controls=(Control("rate"),),
        rate_controls={"rate": "boom"},
    )


@pytest.mark.parametrize(
    ("vehicle", "twist", "law"),
    [
        (vehsim.load_vehicle("hopper"), (0.1, 0.3, 0.2, 1.0, 0.0, 2.0), lambda t: [2 * np.sin(3 * t), np.cos(2 * t)]),
        (cart_with_driven_rear_steering(), (0.0, 2.0, 0.0), lambda t: [1.2 * np.cos(3 * t)]),
        (cart_with_driven_boom(), (0.3, 1.0, 0.0), lambda t: [2 * np.sin(3 * t)]),
    ],
    ids=lambda x: getattr(x, "name", ""),
)
@pytest.mark.parametrize(("order", "corners", "rate"), [(2, False, 2), (4, False, 4), (4, True, 3)])
def test_the_ledger_counts_the_work_of_drives(vehicle, twist, law, order, corners, rate):
    """Kinetic and potential energy change by the drives' work and by damping alone, to the step's order; where the
    rates of joints have corners, to third order."""
    imbalances = []
    for count in (40, 80):
        t = np.linspace(0, 2, count + 1)
        controls = np.column_stack(law(t))
        if corners:
            coarse = np.linspace(0, 2, 11)
            controls = np.column_stack([np.interp(t, coarse, rate) for rate in law(coarse)])
        energy = Integrator(vehicle, 2 / count, order=order).rollout(State(twist=twist), controls).energy
        kept = energy["kinetic"] + energy["potential"] + energy["dissipated"]
        imbalances.append(np.ptp(kept - energy["work"]))
    assert imbalances[1] < 0.02 * np.ptp(energy["work"])
    assert np.log2(imbalances[0] / imbalances[1]) > rate - 0.3, imbalances


@pytest.mark.parametrize(("step", "warned"), [(0.09, True), (0.04, False)])
def test_damping_too_fast_for_the_step_is_warned_about(step, warned, recwarn):
    """At 40/s a rotation changes its sign with every step of 0.09 s, and decays with steps of 0.04 s."""
    vehicle = Holonomic(name="top", group=SE2, inertia=(1.0, 2.0, 2.0), drag=lambda x: -40 * x)
    clip = Integrator(vehicle, step).rollout(State(twist=(1.0, 0.0, 0.0)), np.zeros((6, 0)))
    assert np.any(clip.twists[:, 0] < 0) == warned
    assert [str(w.message).partition(",")[0] for w in recwarn] == warned * [
        "top: damping of 40/s is too fast for steps of 0.09 s"
    ]


@pytest.mark.parametrize(
    "start",
    [
        lambda integrator, state: [integrator.step(state, ()), integrator.step(state, ())],
        lambda integrator, state: integrator.stepper(state),
        lambda integrator, state: integrator.fleet([state, state]),
        lambda integrator, state: integrator.rollouts([state, state], np.zeros((6, 0))),
    ],
    ids=["step", "stepper", "fleet", "rollouts"],
)
def test_too_fast_damping_is_warned_about_once_wherever_vehicles_are_stepped(start, recwarn):
    vehicle = Holonomic(name="top", group=SE2, inertia=(1.0, 2.0, 2.0), drag=lambda x: -40 * x)
    for step, warnings in ((0.04, 0), (0.09, 1)):
        start(Integrator(vehicle, step), State(twist=(1.0, 0.0, 0.0)))
        assert [w.filename for w in recwarn] == warnings * [__file__]


def test_a_linkage_that_locks_during_motion_is_named_with_its_step():
    """Two skates that swing towards each other's line: independent at the start, dependent at ``phi = 0``."""
    vehicle = Nonholonomic(
        name="scissors",
        group=SE2,
        joints=("phi",),
        lagrangian=lambda r, u, xi: (xi[0] ** 2 + 4 * (xi[1] ** 2 + xi[2] ** 2) + u[0] ** 2) / 2,
        constraints=lambda r: (
            ca.SX(2, 1),
            ca.vertcat(ca.horzcat(0, -ca.sin(r[0]), ca.cos(r[0])), ca.horzcat(0, ca.sin(r[0]), ca.cos(r[0]))),
        ),
        sample=(0.5,),
    )
    with pytest.raises(SolveError, match=r"scissors: step \d+: constraints lose rank between joints"):
        Integrator(vehicle, 0.01).rollout(State(joints=(0.5,), joint_rates=(-1.0,)), np.zeros((100, 0)))


def toboggan(**scales):
    """A skate of 58 kg that is pushed and turned, with a load on a sprung arm."""
    mass, yaw, load, arm = 50.0, 5.0, 8.0, 0.6

    def lagrangian(r, u, xi):
        turn = arm * (u[0] + xi[0])
        loads = (xi[1] - turn * ca.sin(r[0])) ** 2 + (xi[2] + turn * ca.cos(r[0])) ** 2
        return (yaw * xi[0] ** 2 + mass * (xi[1] ** 2 + xi[2] ** 2) + load * loads) / 2 - 10 * r[0] ** 2

    bounds = {"push": 150.0, "turn": 40.0}
    return Nonholonomic(
        name="toboggan",
        group=SE2,
        joints=("arm",),
        lagrangian=lagrangian,
        constraints=lambda r: ([[0]], [[0, 0, 1]]),
        forces=lambda r, u, xi, c: ([-4 * u[0]], [c[1] - 3 * xi[0], c[0] - 10 * xi[1], 0]),
        controls=tuple(Control(name, -most, most, **scales) for name, most in bounds.items()),
    )


def test_controls_without_a_scale_have_that_of_the_vehicles_own_acceleration():
    assert [control.scale for control in toboggan(scale=3.0).controls] == [3.0, 3.0]
    push, turn = (control.scale for control in toboggan().controls)
    assert push == pytest.approx(58, rel=0.05) and 1 < turn < 40


def test_a_plan_of_a_vehicle_without_scales_neither_crawls_nor_fails():
    """With effort in squared newtons, it took 33 s for 7 m; and a shuttle was refused, with a frame that is not too
    early."""
    rest, start = (0.0, 0.0, 0.0), vehsim.Mark(1001, position=(0, 0, 0), heading=0, velocity=(0, 0, 0))
    aside = vehsim.Mark("free", position=(6, -3, 0), heading=-90, velocity=rest)
    plan = vehsim.plan(toboggan(), None, [start, aside])
    assert plan.success and plan.duration < 12
    away, back = (vehsim.Mark(f, position=p, velocity=rest) for f, p in ((1200, (-6, 1, 0)), (1400, (0, 0, 0))))
    plan = vehsim.plan(toboggan(), None, [start, away, back])
    assert plan.success and plan.character == "normal"
