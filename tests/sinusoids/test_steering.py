"""Growth vectors compared with the paper's and manual ones; steering judged by an independent integrator."""

from dataclasses import replace
from itertools import pairwise

import casadi as ca
import numpy as np
import pytest
from scipy.integrate import solve_ivp

from vehsim.errors import SolveError
from vehsim.sinusoids import models
from vehsim.sinusoids.algebra.classification import classify, growth_bound
from vehsim.sinusoids.algebra.feedback import car_triangular
from vehsim.sinusoids.canonical.chained import steer_chained, steer_first_degree, steer_second_degree
from vehsim.sinusoids.canonical.fourier import steer_triangular
from vehsim.sinusoids.manoeuvres.trailers import _gain, _joined, _pull, steer_trailers
from vehsim.sinusoids.manoeuvres.train import Pose, Train, across, straighten
from vehsim.sinusoids.steering import Stage, integrate


def end_error(steering):
    """Largest difference from the goal when the returned inputs are integrated stage by stage by DOP853."""
    system = steering.system
    inputs = ca.SX.sym("u", system.m)
    field = ca.Function("f", [system.x, inputs], [ca.densify(system.G @ inputs)])
    x = np.asarray(steering.start, float)
    for a, b in zip(steering.knots[:-1], steering.knots[1:], strict=True):
        inside = np.nextafter(a, b)

        def rate(t, x, inside=inside, b=b):
            u = steering.inputs(min(max(t, inside), b))[0]
            return np.ravel(np.asarray(field(x, u)))

        x = solve_ivp(rate, (a, b), x, method="DOP853", rtol=1e-12, atol=1e-13).y[:, -1]
    return float(np.abs(x - steering.goal).max())


@pytest.mark.parametrize(
    ("system", "expected"),
    [
        (models.first_degree(3), (3, 3)),
        (models.second_degree(2), (2, 1, 2)),
        (models.chained(5), (2, 1, 1, 1)),
        (models.hopper(), (2, 1)),
        (models.car(), (2, 1, 1)),
        (models.trailers([1.0]), (2, 1, 1, 1)),
        (models.trailers([1.0, 1.0]), (2, 1, 1, 1, 1)),
    ],
    ids=["brockett", "second degree", "chained", "hopper", "car", "one trailer", "two trailers"],
)
def test_relative_growth(system, expected):
    found = classify(system)
    assert found.relative_growth == expected and found.controllable


def test_growth_bound_is_the_papers():
    """sigma_i of free Lie algebras: 2, 1, 2, 3, 6 for two fields and 3, 3, 8, 18 for three (Witt)."""
    assert growth_bound(2, 5) == (2, 1, 2, 3, 6)
    assert growth_bound(3, 4) == (3, 3, 8, 18)


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("m", [2, 3, 4])
def test_first_degree_system_is_steered_exactly(m, seed):
    ends = np.random.default_rng(seed).uniform(-1, 1, (2, m + m * (m - 1) // 2))
    assert end_error(steer_first_degree(m, *ends)) < 1e-8


@pytest.mark.parametrize("seed", range(2))
def test_second_degree_system_is_steered_exactly(seed):
    ends = np.random.default_rng(seed).uniform(-1, 1, (2, models.second_degree(2).n))
    assert end_error(steer_second_degree(2, *ends)) < 1e-7


@pytest.mark.parametrize("method", ["together", "staged"])
@pytest.mark.parametrize("n", [3, 4, 5])
def test_chained_form_is_steered_exactly(n, method):
    ends = np.random.default_rng(n).uniform(-1, 1, (2, n))
    assert end_error(steer_chained(n, *ends, method=method)) < 1e-7


@pytest.mark.parametrize("n", [8, 14])
def test_long_chains_keep_their_digits(n):
    """With swings to both sides; with swings to one side, n = 14 ends 1e-5 off and takes a hundred times the effort."""
    ends = np.random.default_rng(n).uniform(-1, 1, (2, n))
    steering = steer_chained(n, *ends)
    assert steering.end_error < 1e-9 and end_error(steering) < 1e-6
    assert steering.effort < 5e3


def test_the_papers_car():
    """SIN Fig. 4: (x, y, theta, phi) with a wheelbase long enough for its constant first stage."""
    change = car_triangular(4.0)
    names = list(change.source.states)
    start, goal = {"x": -5.0, "y": 1.0, "theta": 0.05, "phi": 1.0}, {"x": 0.0, "y": 0.5, "theta": 0.0, "phi": 0.0}
    ends = [[end[name] for name in names] for end in (start, goal)]
    assert end_error(steer_triangular(change, *ends)) < 1e-6


@pytest.mark.parametrize("count", [0, 1, 2])
def test_trailers_are_steered(count):
    system = models.trailers([1.2] * count)
    start = np.zeros(system.n)
    goal = np.zeros(system.n)
    goal[list(system.states).index("x")] = 6.0
    goal[list(system.states).index("y")] = 1.0
    assert end_error(steer_trailers([1.2] * count, start, goal)) < 1e-6


@pytest.mark.parametrize("count", [1, 3, 5])
def test_trains_between_random_states(count):
    rng = np.random.default_rng(count)
    ends = np.zeros((2, 4 + count))
    ends[:, :2], ends[:, 2] = rng.uniform(-10, 10, (2, 2)), rng.uniform(-0.4, 0.4, 2)
    ends[:, 3:] = np.cumsum(rng.uniform(-0.5, 0.5, (2, count + 1)), axis=1)
    assert end_error(steer_trailers([1.5] * count, *ends)) < 1e-6


def test_a_leg_started_nearby_ends_at_the_same_place():
    """To the last digits of the steering, a seventh derivative: rounded coefficients of the path keep half of them."""
    train, goal = Train((1.5,) * 5, 1.0), np.array([1.0, 2.0, -0.3, 0.7, 0.4, 0.5, 0.1, -0.2, -0.6])
    for span in (5.1, -5.1):
        leg = straighten(train, goal, [span], "straighten")[0].back("bend")
        start = leg.states(np.zeros(1))[0] + 1e-12 * np.array([1, 1, 0, 1, -1, 1, -1, 1, -1])
        begun = leg.begun(start)
        assert np.abs(begun.states(np.zeros(1))[0] - start).max() < 1e-13
        assert np.abs(begun.states(np.ones(1))[0] - goal).max() < 1e-12


@pytest.mark.parametrize("span", [8.5, 13.6])
def test_straightening_does_not_oscillate(span):
    """Bent by 0.1 rad, five trailers need no larger angles; minimising these alone turns the wheels by 2 rad per
    metre."""
    state = np.array([0.0, 0.0, 0.1, 0.1, 0.0, 0.1, 0.05, 0.0, -0.1])
    (leg,) = straighten(Train((1.5,) * 5, 1.0), state, [span], "straighten")
    speed, rate = leg.inputs(np.linspace(0, 1, 801)).T
    assert max(leg.angles) < 0.105 and np.abs(rate / speed).max() < 1.0


def test_a_pull_is_smooth_enough_for_any_steps():
    """Where wheels stop turning in its middle: a jump of the law's second derivative caused 1e-8 rad of steering."""
    system, q = models.trailers((1.5,) * 5), np.array([5.0, 3.0, 0.4, -0.4, 0.1, 0.0, 0.3, -0.2, -0.5])
    pull = _pull(system, q, 6.0)
    for count in (49, 98, 143):
        end = integrate(system, Stage("pull", pull.law), q, np.linspace(0, 1, count))[-1]
        assert np.abs(end - pull.end).max() < 1e-11


def test_the_gain_of_a_straight_path_is_half_its_squared_length():
    """A small steering error over D m at a wheelbase of 1 m: D^2 / 2 to the side."""
    assert _gain(steer_trailers([], [0, 0, 0, 0], [40, 0, 0, 0])) == pytest.approx(800, rel=1e-6)


def test_a_route_that_amplifies_errors_less_is_preferred():
    """The route with the gentlest legs reverses fifteen metres and multiplies errors by 45,000."""
    start = [5.76, 2.24, 0.24, 0.61, 1.03, 1.23, 1.5, 1.42, 1.05]
    goal = [7.62, 7.81, -0.22, 0.09, -0.15, -0.36, -0.67, -0.69, -0.19]
    assert _gain(steer_trailers([1.5] * 5, start, goal)) < 5e3


def test_short_legs_do_not_correct_errors():
    """With five trailers, correcting 1e-10 m on 30 cm would need wheel angles of 1e5 rad: the next leg does it."""
    hitches = (1.5,) * 5
    poses = [Pose(0, 0, 0), Pose(40, 6, 0), Pose(40.3, 6, 0), Pose(80, 0, 0)]
    legs = [across(Train(hitches, 1.0), a, b, "drive") for a, b in pairwise(poses)]
    start = legs[0].states(np.zeros(1))[0] + 1e-10 * np.array([1, 1, 0, 1, -1, 1, -1, 1, -1])
    joined = _joined(models.trailers(hitches), start, legs)
    turning = [float(np.abs(leg.law(np.linspace(0, 1, 99))[:, 1]).max()) for leg in joined]
    assert turning[1] < 1e-3 and turning[2] == pytest.approx(turning[0], rel=0.2)


@pytest.mark.parametrize("heading", [-2.5, 0.3, 1.1, 2.86])
def test_a_short_straight_leg_does_not_turn_the_wheels(heading):
    """Round-off beside the line counts with the seventh power of one over the length: on 15 cm it once gave 0.4 rad."""
    start = Pose(-7.3, 21.7, heading)
    leg = across(Train((1.5,) * 5, 1.0), start.ahead(9.7), start.ahead(9.9), "round the bend")
    assert np.abs(leg.inputs(np.linspace(0, 1, 101))[:, 1]).max() < 1e-12


def test_an_excessively_bent_leg_is_a_named_error():
    leg = across(Train((1.5,) * 5, 1.0), Pose(0, 0, 0), Pose(40, 6, 0), "drive")
    with pytest.raises(SolveError, match="leg 'drive': bends without bound"):
        _ = replace(leg, right=leg.right * 1e300).law


def test_wheels_are_straightened_for_loops_that_leave_the_chart():
    """A goal with turned wheels: loops around it would turn the car across its axes."""
    steering = steer_triangular(car_triangular(2.6), [4.0, 1.0, -0.3, 0.4], [-4.0, -1.5, 0.55, 0.5], amplitude=2.6)
    assert [steering.stages[0].label, steering.stages[-1].label] == ["release", "set"]
    assert end_error(steering) < 1e-6
