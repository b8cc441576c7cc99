"""The fourth order in one segment: its order, its symmetry, and what it keeps exactly."""

from dataclasses import replace

import casadi as ca
import numpy as np
import pytest

import vehsim
from vehsim import Mark
from vehsim.integrators.continuous import execute
from vehsim.lie import SO3, SO3xR3
from vehsim.planning import solve
from vehsim.planning.constraints.dynamics import equations as equations_of
from vehsim.planning.problem.elements import Element, NonlinearProgram
from vehsim.planning.problem.simpson import _rotation, _unturned, simpson
from vehsim.planning.problem.solver_cache import SolverCache
from vehsim.planning.problem.transcription import transcribe
from vehsim.vehicles import Control, Holonomic

WIND = np.array([1.0, -2.0, 0.5])
VEHICLES = ["helicopter", "car", "two_wheeled", "snakeboard", "boat", "truck", "hopper"]
SECONDS = 0.8


def loaded(name):
    vehicle = vehsim.load_vehicle(name)
    return vehicle.planar or vehicle


def equations(made):
    """``y -> residuals`` of one segment, with its parameters set."""
    element = simpson(made)
    problem = NonlinearProgram(element.y.shape[0])
    problem.add(element, np.arange(problem.size))
    p = problem.vector({"wind": WIND})
    y = ca.MX.sym("y", problem.size)
    return ca.Function("residual", [y], [problem.functions()["nlp"](y, p)[1]])


def stepper(made):
    """``(x, z, c0, c1, h) -> (x1, z)``: the next node state and the middle's velocity, by Newton's method."""
    size, s, n, c = made.sizes
    state = size + s + n
    unknown, given = ca.MX.sym("w", state + n), ca.MX.sym("v", state + 2 * c + 1)
    x1, z = unknown[:state], unknown[state:]
    x, c0, c1, h = ca.vertsplit(given, [0, state, state + c, state + 2 * c, state + 2 * c + 1])
    residual = equations(made)(ca.vertcat(x, z, c0, c1, x1, h))
    root = ca.rootfinder("root", "newton", {"x": unknown, "p": given, "g": residual}, {"abstol": 1e-12})

    def step(x, z, c0, c1, h):
        found = root(x0=np.concatenate([x, z]), p=np.concatenate([x, c0, c1, [h]]))["x"].full().ravel()
        return found[:state], found[state:]

    return step


def start_of(made, seed=1):
    """A node state in motion, the velocity there, and controls (3, c) over their scale."""
    chance, m = np.random.default_rng(seed), made.mechanics
    _, s, n, c = made.sizes
    group = made.vehicle.group
    g = np.array(group.identity, float)
    if group.size > group.dim:
        q = chance.normal(size=4)
        g[:4] = q / np.linalg.norm(q)
    r, pi, controls = chance.normal(size=s) * 0.2, chance.normal(size=n) * 0.5, chance.normal(size=(3, c)) * 0.2
    z = np.ravel(m.knot_velocity_guess(r, pi * made.momentum_scale, controls[0] * made.control_scale))
    return g, r, z, np.concatenate([g, r, pi]), controls


def states(made, count):
    """Node states (count + 1, .) of ``count`` segments over `SECONDS` under controls linear in time."""
    _, _, z, x, controls = start_of(made)
    step, path = stepper(made), [x]
    for k in range(count):
        c0, c1 = (controls[0] + (k + e) / count * (controls[1] - controls[0]) for e in (0, 1))
        x, z = step(x, z, c0, c1, SECONDS / count)
        path.append(x)
    return np.array(path)


@pytest.mark.parametrize("name", VEHICLES)
def test_segments_converge_to_the_continuous_motion_with_order_four(name):
    made = transcribe(loaded(name))
    g, r, z, _, controls = start_of(made)
    fine = 64
    c = np.linspace(controls[0], controls[1], fine + 1) * made.control_scale
    to, joints = execute(made.vehicle, g, r, z, c, np.full(fine, SECONDS / fine), WIND)
    true = np.concatenate([to[-1], joints[-1]])
    off = [np.abs(states(made, count)[-1][: len(true)] - true).max() for count in (8, 16)]
    assert off[1] < 1e-3 and (off[0] / off[1] > 13 or off[1] < 1e-11), off


@pytest.mark.parametrize("name", VEHICLES)
def test_the_reversed_segment_is_the_same_segment(name):
    """From its end, with a negative duration, a segment leads back to its start: only even orders are possible."""
    made = transcribe(loaded(name))
    _, _, z, x, controls = start_of(made)
    step = stepper(made)
    x1, middle = step(x, z, *controls[:2], 0.1)
    back, again = step(x1, middle, *controls[1::-1], -0.1)
    np.testing.assert_allclose(back, x, atol=1e-9)
    np.testing.assert_allclose(again, middle, atol=1e-9)


@pytest.mark.parametrize("name", ["helicopter_lie", "two_wheeled"])
def test_a_segment_without_its_velocity_has_the_same_solution(name):
    made = transcribe(loaded(name))
    element = simpson(made)
    assert element.reduced is not None
    places, make = element.reduced
    _, _, z, x, controls = start_of(made)
    x1, middle = stepper(made)(x, z, *controls[:2], 0.1)
    found = np.concatenate([x, middle, *controls[:2], x1, [0.1]])
    problem = NonlinearProgram(element.y.shape[0])
    problem.add(element, np.arange(problem.size))
    problem.reduce()
    assert problem.uses[0].element is make() and problem.lacked.tolist() == list(places)
    p = problem.vector({"wind": WIND})
    guess = found.copy()
    guess[problem.lacked] = 0.0
    rows = np.ravel(problem.functions()["nlp"](guess, p)[1])
    assert len(rows) == element.g.shape[0] - len(places)
    np.testing.assert_allclose(rows, 0.0, atol=1e-10)
    np.testing.assert_allclose(np.ravel(problem.missing(guess, p)), middle, atol=1e-10)


def test_a_velocity_that_another_element_reads_stays_a_variable():
    made = transcribe(loaded("two_wheeled"))
    element = simpson(made)
    problem = NonlinearProgram(element.y.shape[0])
    problem.add(element, np.arange(problem.size))
    speed = ca.SX.sym("speed")
    problem.add(Element("reader", speed, g=speed, upper=1.0), np.array([element.reduced[0][0]]))
    problem.reduce()
    assert problem.uses[0].element is element and not problem.lacked.size


@pytest.mark.parametrize("name", ["simple_car", "snakeboard", "boat", "truck", "hopper"])
def test_costly_vehicles_keep_their_velocities(name):
    assert simpson(transcribe(loaded(name))).reduced is None


def test_plans_without_velocities_as_variables_are_the_same(monkeypatch):
    robot, plans = vehsim.load_vehicle("two_wheeled"), []
    marks = [
        Mark(1, position=(0, 0, 0), heading=0, velocity=(0, 0, 0)),
        Mark(241, position=(9, 4, 0), heading=30, velocity=(0, 0, 0)),
    ]
    for reduce in (NonlinearProgram.reduce, lambda problem: None):
        monkeypatch.setattr(NonlinearProgram, "reduce", reduce)
        monkeypatch.setattr(solve, "common", SolverCache)  # builds every problem again
        plans.append(vehsim.plan(robot, None, marks, segments=32))
    reduced, whole = plans
    assert reduced.success and reduced.cost == pytest.approx(whole.cost, rel=1e-8)
    np.testing.assert_allclose(reduced.clip.positions, whole.clip.positions, atol=1e-6)
    layout = reduced._iterate.layout
    assert layout.order == 4 and reduced._iterate.problem.lacked.size
    velocities = layout.velocity(np.arange(layout.segments))
    np.testing.assert_allclose(reduced._iterate.x[velocities], whole._iterate.x[velocities], atol=1e-6)


def test_quaternions_keep_unit_norm_at_a_long_step():
    path = states(transcribe(loaded("helicopter")), 2)
    np.testing.assert_allclose(np.linalg.norm(path[:, :4], axis=1), 1.0, atol=1e-14)


def test_turns_at_a_constant_rate_are_exponentials_to_fifth_order():
    """They are found from a polynomial; its solution is a unit quaternion."""
    x, q, q1 = ca.SX.sym("x", 3), ca.SX.sym("q", 4), ca.SX.sym("q1", 4)
    missed = _unturned(q - q1, (q + q1) / 2, _rotation(x, x, x, 1.0))
    jacobian, rest = ca.jacobian(missed, q1), ca.substitute(missed, q1, ca.SX.zeros(4))  # it is linear in q1
    found = ca.Function("found", [q, x], [-ca.solve(jacobian, rest)])
    start, turn = np.array([0.1, -0.7, 0.5, 0.5]), np.array([0.6, -1.0, 0.8])
    off = []
    for share in (1.0, 0.5):
        ends = np.ravel(found(start, share * turn))
        off.append(np.abs(ends - SO3.compose(start, SO3.exp(share * turn))).max())
        assert np.linalg.norm(ends) == pytest.approx(1.0, abs=1e-14)
    assert np.log2(off[0] / off[1]) == pytest.approx(5.0, abs=0.3) and off[0] < 2e-3


def test_gyroscopic_forces_are_exact_for_rates_quadratic_in_time():
    """Torques about x and y that rise from zero turn an asymmetric body about z: its rate is of fifth order in time."""
    inertia, torque, h = np.array([1.5e-3, 2.5e-3, 3.5e-3]), 1e-3, 0.1
    body = Holonomic(
        name="body", group=SO3xR3, inertia=(*inertia, 1.0, 1.0, 1.0),
        controls=(Control("x", -1.0, 1.0), Control("y", -1.0, 1.0)), wrench=lambda c: ca.vertcat(c, 0, 0, 0, 0),
    )  # fmt: skip
    made = transcribe(body)
    rest, ramp = np.eye(1, 13).ravel(), np.full(2, torque) / made.control_scale
    end, _ = stepper(made)(rest, np.zeros(6), np.zeros(2), ramp, h)
    rates = torque * h / 2 / inertia[:2]
    spin = (inertia[0] - inertia[1]) * rates.prod() * h / 5
    assert end[9] * made.momentum_scale[2] == pytest.approx(spin, rel=1e-3)


@pytest.mark.parametrize("order", [2, 4])
def test_the_curves_of_a_hull_are_looked_up_without_a_difference(order):
    """Equations, Jacobians and Hessians are those of the whole curves, with less than half of the instructions."""
    boat = loaded("boat")
    law = boat.resistance
    whole = transcribe(replace(boat, resistance=lambda twist, c: law(twist, c)))
    looked_up, steps = (equations_of(made, order) for made in (transcribe(boat), whole))
    rng = np.random.default_rng(1)
    y, p, weights = rng.normal(size=(looked_up.y.shape[0], 8)), np.tile(WIND[:, None], 8), rng.normal(size=(9, 8))
    y[:-1] *= 5.0
    speeds = np.asarray(looked_up.points.map(8)(y, p)).reshape(1, -1, order="F")
    pieces = np.asarray(looked_up.table.function(speeds.size, 0)(speeds))
    models = np.vstack([p, np.vstack([speeds, pieces]).reshape(-1, 8, order="F")])
    both = ((looked_up, models), (steps, p))
    for name in ("value", "jacobian"):
        made, expected = (getattr(element, name).map(8)(y, given)[1] for element, given in both)
        np.testing.assert_allclose(made, expected, rtol=1e-9, atol=1e-10)
    bent, expected = (element.hessian[0].map(8)(y, given, np.ones((1, 8)), weights) for element, given in both)
    np.testing.assert_allclose(bent, expected, rtol=1e-9, atol=1e-10)
    assert looked_up.value.n_instructions() < 0.5 * steps.value.n_instructions()


def test_controls_are_executed_with_curves_that_are_looked_up():
    boat = loaded("boat")
    law = boat.resistance
    whole = replace(boat, resistance=lambda twist, c: law(twist, c))
    controls = np.column_stack([np.linspace(4500.0, -1000.0, 9), np.linspace(-0.4, 0.5, 9)])
    given = (np.zeros(3), np.zeros(0), np.array([0.1, 3.0, 0.0]), controls, np.full(8, 0.5), WIND)
    np.testing.assert_allclose(execute(boat, *given)[0], execute(whole, *given)[0], rtol=1e-12)


def test_derivatives_follow_the_chain_rule_through_the_velocity_in_the_air():
    """The Hessian is that of the whole expression, with two thirds of the instructions."""
    element = simpson(transcribe(loaded("helicopter")))
    sizes = {"y": element.y.shape[0], "p": 3, "weights": element.g.shape[0]}
    y, p, weights = (ca.SX.sym(name, size) for name, size in sizes.items())
    rows = element.value(y, p)[1]
    whole = ca.Function("whole", [y, p, weights], [ca.triu(ca.hessian(ca.dot(weights, rows), y)[0])])
    rng = np.random.default_rng(2)
    at, pull = rng.normal(size=y.shape[0]), rng.normal(size=weights.shape[0])
    made, rows_of, columns = element.hessian
    dense = np.zeros((y.shape[0], y.shape[0]))
    dense[rows_of, columns] = np.ravel(made(at, WIND, 1.0, pull))
    np.testing.assert_allclose(dense, np.array(whole(at, WIND, pull)), rtol=1e-8, atol=1e-9)
    assert made.n_instructions() < 0.65 * whole.n_instructions()
