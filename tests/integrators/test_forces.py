"""Forces, controls and wind: closed forms, orders of accuracy against the continuous equations, state round trips."""

import numpy as np
import pytest

import vehsim
from vehsim.errors import InputError, SolveError
from vehsim.integrators import Integrator
from vehsim.integrators.continuous import execute
from vehsim.lie import SO3
from vehsim.vehicles import Holonomic, State
from vehsim.vehicles.definition.states import flat
from vehsim.vehicles.models.helicopter import helicopter


def test_projectile_is_a_parabola():
    vehicle = vehsim.load_vehicle("helicopter_lie")
    clip = Integrator(vehicle, 0.1).rollout(
        State(position=(1, 2, 3), twist=(0, 0, 0, 4, 1, 20)), np.zeros((31, 4)), fps=10
    )
    t = clip.times
    exact = np.column_stack([1 + 4 * t, 2 + t, 3 + 20 * t - 9.81 * t**2 / 2])
    np.testing.assert_allclose(clip.positions, exact, atol=1e-11)
    np.testing.assert_allclose(clip.twists[:, 5], 20 - 9.81 * t, atol=1e-11)


def test_steady_circle_of_the_car():
    """The rear axle goes round a circle of radius wheelbase / sigma at constant speed; exp makes it exact."""
    car = vehsim.load_vehicle("car")
    sigma, speed, h = 0.4, 6.0, 0.05
    radius = 2.6 / sigma
    turn = speed / radius
    offset = -car.origin[0]
    state = State(position=(0, 0, 0), twist=(turn, speed, turn * offset), joints=(0.0, sigma))
    clip = Integrator(car, h, "exp").rollout(state, np.zeros((201, 2)))
    np.testing.assert_allclose(clip.twists, np.tile([turn, speed, turn * offset], (201, 1)), atol=1e-11)
    axle = (clip.matrices() @ [car.origin[0], 0, 0, 1])[:, :2]
    centre = np.array([car.origin[0], radius])
    np.testing.assert_allclose(np.linalg.norm(axle - centre, axis=1), radius, atol=1e-10)
    np.testing.assert_allclose(clip.joint_rates[:, 0], speed / 0.32, atol=1e-10)


def draughty(**drag):
    return helicopter(mass=1900.0, inertia=(1300.0, 4700.0, 4200.0), d_t=1.61, d_r=6.35, **drag)


def test_drag_carries_a_body_to_the_wind():
    """Linear drag, level and trimmed: ``v = w (1 - exp(-k t / m))``; at the wind's velocity there is no drag."""
    vehicle = draughty(drag_linear=(200.0,) * 3)
    wind, hover = np.array([3.0, -2.0, 0.0]), (1900 * 9.81, 0, 0, 0)
    clip = Integrator(vehicle, 0.05, wind=wind).rollout(State(), np.tile(hover, (401, 1)))
    exact = wind * (1 - np.exp(-200 / 1900 * clip.times))[:, None]
    np.testing.assert_allclose(clip.twists[:, 3:6], exact, atol=2e-5)
    drifting = Integrator(vehicle, 0.05, wind=wind).rollout(State(twist=(0, 0, 0, *wind)), np.tile(hover, (401, 1)))
    np.testing.assert_allclose(drifting.positions, drifting.times[:, None] * wind, atol=1e-9)


CASES = {
    "helicopter": (
        draughty(drag_linear=(100.0, 200.0, 300.0), drag_quadratic=(5.0, 8.0, 20.0), drag_angular=(500.0,) * 3),
        State(twist=(0.1, -0.2, 0.3, 8.0, 1.0, 0.5)),
        lambda t: np.column_stack(
            [18000 + 3000 * np.sin(2 * t), 300 * np.cos(t), 0.05 * np.sin(3 * t), 0.04 * np.cos(2 * t)]
        ),
    ),
    "car": (
        vehsim.load_vehicle("car"),
        State(twist=(0.0, 5.0, 0.0)),
        lambda t: np.column_stack([1500 * np.sin(2 * t), 0.6 * np.cos(1.5 * t)]),
    ),
}


@pytest.mark.parametrize("name", CASES)
@pytest.mark.parametrize("difference_map", ["exp", "cay"])
@pytest.mark.parametrize(("order", "counts"), [(2, (32, 64)), (4, (16, 32)), (6, (16, 32))])
def test_order_with_controls_linear_between_knots(name, difference_map, order, counts):
    """One fixed set of piecewise-linear controls; only the steps within their segments shrink."""
    vehicle, start, law = CASES[name]
    wind, end, knots = np.array([2.0, 1.0, 0.0]), 1.6, 8
    table = law(np.linspace(0, end, knots + 1))
    integrator = Integrator(vehicle, 1.0, wind=wind)
    phase = integrator.start(start, table[0])
    z = flat(integrator.mechanics.knot_velocity_guess(phase.r, phase.pi, table[0]))
    g, r = execute(vehicle, phase.g, phase.r, z, table, np.full(knots, end / knots), wind, fine=400)
    exact = np.concatenate([vehicle.group.matrix(g[-1])[:-1].ravel(), r[-1]])
    errors = []
    for count in counts:
        integrator = Integrator(vehicle, end / count, difference_map, order, wind=wind)
        at = np.linspace(0, knots, count + 1)
        controls = np.column_stack([np.interp(at, np.arange(knots + 1), column) for column in table.T])
        phase = integrator.start(start, controls[0])
        G, R, _ = integrator._accumulate(phase, controls)
        errors.append(np.linalg.norm(np.concatenate([vehicle.group.matrix(G[-1])[:-1].ravel(), R[-1]]) - exact))
    assert np.log2(errors[0] / errors[1]) == pytest.approx(order, abs=0.4), errors


@pytest.mark.parametrize("order", [2, 4])
def test_work_and_energy_balance_to_the_order_of_the_step(order):
    vehicle, start, law = CASES["helicopter"]
    wind, defects = (2.0, 1.0, 0.0), []
    for count in (40, 80):
        t = np.linspace(0, 2, count + 1)
        energy = Integrator(vehicle, 2 / count, order=order, wind=wind).rollout(start, law(t)).energy
        balance = energy["kinetic"] + energy["potential"] - energy["work"] + energy["dissipated"]
        defects.append(np.abs(balance - balance[0]).max())
        assert np.all(np.diff(energy["dissipated"]) > 0)
    assert defects[0] < 1e-3 * np.ptp(energy["kinetic"])
    assert np.log2(defects[0] / defects[1]) == pytest.approx(order, abs=0.4)


@pytest.mark.parametrize("name", ["helicopter", "car"])
def test_public_state_round_trip(name):
    """``state(start(s)) = s`` with a rig origin away from the body frame."""
    vehicle = vehsim.load_vehicle(name)
    assert np.any(vehicle.origin)
    if name == "helicopter":
        state = State(position=(1, 2, 3), orientation=(0.5, 0.5, -0.5, 0.5), twist=(0.1, 0.2, 0.3, 1, 2, 3))
        controls = [1.0, 2.0, 0.1, 0.2]
    else:
        turn, speed = 5 * 0.3 / 2.6, 5.0
        twist = (turn, speed, turn * 1.3)
        state = State((1, 2, 3), (np.cos(0.2), 0, 0, np.sin(0.2)), twist, (0.5, 0.3), (speed / 0.32, 0.25))
        controls = [10.0, 0.25]
    integrator = Integrator(vehicle, 0.01)
    phase = integrator.start(state, controls)
    back = integrator.state(phase, controls, integrator.anchor(state, phase))
    for field in ("position", "orientation", "twist", "joints", "joint_rates"):
        expected = getattr(state, field)
        if expected is not None:
            np.testing.assert_allclose(getattr(back, field), expected, atol=1e-12)


def test_step_agrees_with_rollout_and_takes_external_wrenches():
    vehicle = draughty()
    integrator = Integrator(vehicle, 0.02)
    hover = np.array([1900 * 9.81, 0, 0, 0])
    state = State(twist=(0.1, 0.2, 0.3, 1, 2, 3))
    clip = integrator.rollout(state, np.tile(hover, (6, 1)))
    for _ in range(5):
        state = integrator.step(state, hover)
    np.testing.assert_allclose(state.position, clip.positions[-1], atol=1e-12)
    np.testing.assert_allclose(state.twist, clip.twists[-1], atol=1e-12)

    still, pushed = State(), State()
    for _ in range(50):  # a spring to the origin along X, as a queried wrench: order 2 through the predicted knot
        pushed = integrator.step(pushed, hover, wrench=lambda s: (0, 0, 0, 1900.0 * (1 - s.position[0]), 0, 0))
    assert pushed.position[0] == pytest.approx(1 - np.cos(1.0), abs=1e-4)
    assert integrator.step(still, hover, wrench=(0, 0, 100.0, 0, 0, 0)).twist[2] == pytest.approx(0.02 * 100 / 4200)


def test_a_step_that_cannot_converge_is_named():
    with pytest.raises(SolveError, match=r"step \d+ of .* did not converge: residual .* take a smaller step"):
        Integrator(draughty(), 3.0, "exp").rollout(State(twist=(9, 8, 7, 1, 3, 5)), np.zeros((4, 4)))


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"step": 0.0}, "step = 0.0"),
        ({"step": np.nan}, "step = nan"),
        ({"order": 3}, "order = 3"),
        ({"difference_map": "caley"}, "difference_map = 'caley'"),
        ({"quadrature": "simpson"}, "quadrature = 'simpson'"),
        ({"wind": (1, 2)}, "wind"),
    ],
)
def test_wrong_options_are_named(options, message):
    with pytest.raises(InputError, match=message):
        Integrator(vehsim.load_vehicle("car"), **{"step": 0.01, **options})


@pytest.mark.parametrize(
    ("state", "message"),
    [
        (State(position=(1, 2)), "state.position"),
        (State(orientation=(0, 0, 0, 0)), "no length"),
        (State(orientation=(0.9, 0.4, 0, 0)), "tilted"),
        (State(twist=(1, np.nan, 0)), "state.twist"),
        (State(joints=(1,)), "state.joints"),
        (State(position="here"), "state.position"),
    ],
)
def test_wrong_states_are_named(state, message):
    with pytest.raises(InputError, match=message):
        Integrator(vehsim.load_vehicle("car"), 0.01).rollout(state, np.zeros((3, 2)))


@pytest.mark.parametrize("name", CASES)
@pytest.mark.parametrize("order", [2, 4])
def test_stepping_in_place_step_by_state_and_rollout_agree(name, order):
    """Three methods, the same motion: a `Stepper` in place, `step` from state to state, and the compiled loop."""
    vehicle, start, law = CASES[name]
    h, n = 0.01, 600  # more than one chunk of the loop
    controls = law(h * np.arange(n + 1))
    integrator = Integrator(vehicle, h, order=order, wind=(1.0, 0.0, 0.0))
    clip = integrator.rollout(start, controls)
    motion, state = integrator.stepper(start, controls[0]), start
    for k in range(n):
        motion.controls[:] = controls[k + 1]
        motion.step()
        state = integrator.step(state, controls[k], controls[k + 1])
    assert motion.time == pytest.approx(clip.times[-1])
    for reached in (motion.state(), state):
        np.testing.assert_allclose(reached.position, clip.positions[-1], atol=1e-9)
        np.testing.assert_allclose(reached.twist, clip.twists[-1], atol=1e-9)
        np.testing.assert_allclose(reached.joints, clip.joints[-1], atol=1e-9)


def test_a_long_step_is_solved_fully_if_the_short_solve_does_not_suffice():
    """At h = 0.2 and 3 rad/s the solve with one Jacobian does not converge; momentum is exact nevertheless."""
    body = Holonomic(name="body", group=SO3, inertia=(1.0, 2.0, 2.6), gravity=0.0)
    integrator = Integrator(body, 0.2)
    phase = integrator.start(State(twist=(0.4, 3.0, 0.3)), [])
    fast = integrator.mechanics.advance_fast(phase.g, phase.r, phase.pi, phase.z, [], [], 0.2, [0, 0, 0])
    assert float(fast[4]) > 1e-12
    g, _, pi = integrator._accumulate(phase, np.zeros((601, 0)))
    spatial = np.einsum("nij,nj->ni", SO3.matrix(g), pi)
    np.testing.assert_allclose(spatial, np.tile(spatial[0], (601, 1)), atol=1e-12)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda i: i.step(State(), [1, 2]), "controls = "),
        (lambda i: i.step(State(), [1, 2, 3, np.nan]), "give 4 finite numbers"),
        (lambda i: i.step(State(), np.zeros(4), [0]), "next_controls"),
        (lambda i: i.step(State(orientation=(0, 0, 0, 0)), np.zeros(4)), "no length"),
        (lambda i: i.step(State(), np.zeros(4), wrench=(1, 2)), "wrench"),
        (lambda i: i.rollout(State(), np.zeros((3, 2))), r"controls: shape \(3, 2\)"),
        (lambda i: i.rollout(State(), np.full((3, 4), np.inf)), "finite"),
    ],
)
def test_wrong_steps_are_named(call, message):
    with pytest.raises(InputError, match=message):
        call(Integrator(draughty(), 0.01))
