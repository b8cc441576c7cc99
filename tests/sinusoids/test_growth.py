"""Growth vectors of systems that are not in the paper, known from the literature; errors that name what fails."""

import casadi as ca
import numpy as np
import pytest

from vehsim.errors import InputError, SolveError
from vehsim.sinusoids import models
from vehsim.sinusoids.algebra.classification import classify, leaf
from vehsim.sinusoids.algebra.feedback import car_triangular, chained_form_exists
from vehsim.sinusoids.canonical.fourier import steer_triangular, triangular
from vehsim.sinusoids.manoeuvres.trailers import steer_trailers
from vehsim.sinusoids.steering import Stage, Steering
from vehsim.sinusoids.system import DriftlessSystem, from_constraints


def system(name, states, m, fields, **more):
    return DriftlessSystem(name, tuple(states), tuple(f"u{i}" for i in range(m)), fields, **more)


def penny(q):
    return [[ca.cos(q[2]), 0], [ca.sin(q[2]), 0], [0, 1], [1, 0]]


def ball(q):
    """A unit ball on a plane, orientation by Z-Y-X angles; both rolling rates are inputs."""
    psi, theta = q[2], q[3]
    spatial = ca.horzcat(
        ca.vertcat(0, 0, 1),
        ca.vertcat(-ca.sin(psi), ca.cos(psi), 0),
        ca.vertcat(ca.cos(psi) * ca.cos(theta), ca.sin(psi) * ca.cos(theta), -ca.sin(theta)),
    )
    # rolling along +X turns about +Y, along +Y about -X
    turning = ca.solve(spatial, ca.DM([[0, -1], [1, 0], [0, 0]]))
    return ca.vertcat(ca.DM.eye(2), turning)


def off_axle(q):
    """A unicycle with a trailer hitched 0.4 m behind its axle."""
    bend = q[2] - q[3]
    return [[ca.cos(q[2]), 0], [ca.sin(q[2]), 0], [0, 1], [ca.sin(bend), -0.4 * ca.cos(bend)]]


def fire_truck(q):
    """Steered at both ends: x, y, steering phi0, cab theta0, ladder's steering phi1, trailer theta1; three inputs."""
    theta0, phi0, phi1, theta1 = q[3], q[2], q[4], q[5]
    turning = -ca.sin(phi1 - theta0 + theta1) / ca.cos(phi1)
    speed = ca.vertcat(ca.cos(theta0), ca.sin(theta0), 0, ca.tan(phi0), 0, turning)
    return ca.horzcat(speed, ca.DM([0, 0, 1, 0, 0, 0]), ca.DM([0, 0, 0, 0, 1, 0]))


def trident_snake(q):
    """A unit triangle with a wheeled leg of length 1 at every corner, the three leg angles driven (Ishikawa 2004)."""
    theta, rows = q[2], []
    for i, alpha in enumerate((-2 * ca.pi / 3, 0.0, 2 * ca.pi / 3)):
        leg = q[3 + i]
        side = theta + alpha + leg
        rows.append(ca.horzcat(ca.sin(side), -ca.cos(side), -1 - ca.cos(leg)))
    return ca.vertcat(ca.solve(ca.vertcat(*rows), ca.DM.eye(3)), ca.DM.eye(3))


def spacecraft(q):
    """Attitude by Z-Y-X angles, two rotors along the body's X and Y, zero angular momentum: w = -k (rates)."""
    theta, phi = q[1], q[2]
    rates = ca.vertcat(
        ca.horzcat(0, ca.sin(phi) / ca.cos(theta), ca.cos(phi) / ca.cos(theta)),
        ca.horzcat(0, ca.cos(phi), -ca.sin(phi)),
        ca.horzcat(1, ca.sin(phi) * ca.tan(theta), ca.cos(phi) * ca.tan(theta)),
    )
    return ca.vertcat(rates @ ca.DM([[-0.2, 0], [0, -0.3], [0, 0]]), ca.DM.eye(2))


def attitude(q):
    """Attitude alone, turned about two of the body's axes: SO(3), two inputs."""
    return spacecraft(q)[:3, :]


def two_axles(q):
    """A car steered at both axles, x, y, heading, both steering angles: moved along its front wheels (Bushnell)."""
    ahead = q[2] + q[3]
    speed = ca.vertcat(ca.cos(ahead), ca.sin(ahead), ca.sin(q[3] - q[4]) / ca.cos(q[4]), 0, 0)
    return ca.horzcat(speed, ca.DM([0, 0, 0, 1, 0]), ca.DM([0, 0, 0, 0, 1]))


def submarine(q):
    """Driven ahead and turned about all three body axes; x, y, z and Z-Y-X angles."""
    psi, theta, phi = q[3], q[4], q[5]
    ahead = ca.vertcat(ca.cos(psi) * ca.cos(theta), ca.sin(psi) * ca.cos(theta), -ca.sin(theta), 0, 0, 0)
    rates = ca.vertcat(
        ca.horzcat(0, ca.sin(phi) / ca.cos(theta), ca.cos(phi) / ca.cos(theta)),
        ca.horzcat(0, ca.cos(phi), -ca.sin(phi)),
        ca.horzcat(1, ca.sin(phi) * ca.tan(theta), ca.cos(phi) * ca.tan(theta)),
    )
    return ca.horzcat(ahead, ca.vertcat(ca.SX(3, 3), rates))


def rolling_balls(ratio):
    """A unit ball rolling on one of radius ``ratio``: Montana's contact coordinates u, v on each, and their angle."""

    def fields(q):
        u, v, angle = q[0], q[2], q[4]
        turn = ca.vertcat(
            ca.horzcat(ca.cos(angle), -ca.sin(angle)),
            ca.horzcat(-ca.sin(angle), -ca.cos(angle)),
        )
        rolling = ca.mtimes(ca.inv(ca.DM.eye(2) / ratio + turn @ turn), ca.DM([[0, -1], [1, 0]]))
        below = rolling / ca.vertcat(ca.horzcat(ratio, ratio), ca.horzcat(ratio * ca.cos(u), ratio * ca.cos(u)))
        above = (turn @ rolling) / ca.vertcat(ca.horzcat(1, 1), ca.horzcat(ca.cos(v), ca.cos(v)))
        spin = -ca.sin(u) * below[1, :] - ca.sin(v) * above[1, :]
        return ca.vertcat(below, above, spin)

    return system(f"balls, {ratio:g} to 1", ("u", "u2", "v", "v2", "angle"), 2, fields)


def snake(q):
    """Three links of length 2 with wheels at their middles, both joints driven: no link's middle slips."""
    rows = [ca.horzcat(ca.sin(q[2]), -ca.cos(q[2]), 0, 0, 0)]
    for joint, end in ((3, -1), (4, 1)):
        link, bend = q[2] + q[joint], q[joint]
        turning = [end * (ca.cos(bend) + 1), 0, 0]
        turning[joint - 2] = end
        rows.append(ca.horzcat(-ca.sin(link), ca.cos(link), *turning))
    return ca.vertcat(*rows)


def free_to_degree_four(q):
    """The free nilpotent system of two inputs and degree 4 (Grayson and Grossman)."""
    a, b = q[0], q[1]
    return [[1, 0], [0, 1], *([0, w] for w in (a, a**2 / 2, a * b, a**3 / 6, a**2 * b / 2, a * b**2 / 2))]


KNOWN = [
    (system("car steered at both axles", "xyapq", 3, two_axles), (3, 5)),
    (system("submarine", ("x", "y", "z", "psi", "theta", "phi"), 4, submarine), (4, 6)),
    (rolling_balls(2.0), (2, 3, 5)),
    (
        from_constraints("snake", "xyabc", snake, domain={"b": (0.3, 1.0), "c": (-1.0, -0.4)}, at=[0, 0, 0, 0.5, -0.8]),
        (2, 3, 5),
    ),
    (system("free to degree 4", "abcdefgh", 2, free_to_degree_four), (2, 3, 5, 8)),
    (system("fire truck", ("x", "y", "phi0", "theta0", "phi1", "theta1"), 3, fire_truck), (3, 5, 6)),
    (system("trident snake", ("x", "y", "theta", "a", "b", "c"), 3, trident_snake), (3, 6)),
    (system("spacecraft with two rotors", ("psi", "theta", "phi", "r1", "r2"), 2, spacecraft), (2, 3, 5)),
    (system("attitude by two axes", ("psi", "theta", "phi"), 2, attitude), (2, 3)),
    (system("sleigh", "xya", 2, lambda q: [[ca.cos(q[2]), 0], [ca.sin(q[2]), 0], [0, 1]]), (2, 3)),
    (system("rolling penny", "xyat", 2, penny), (2, 3, 4)),
    (system("ball on a plane", ("x", "y", "psi", "theta", "phi"), 2, ball), (2, 3, 5)),
    (system("Engel", "xyzw", 2, lambda q: [[1, 0], [0, 1], [0, q[0]], [0, q[0] ** 2 / 2]]), (2, 3, 4)),
    (
        system("Cartan", "abcde", 2, lambda q: [[1, 0], [0, 1], [0, q[0]], [0, q[0] ** 2 / 2], [0, q[0] * q[1]]]),
        (2, 3, 5),
    ),
    (system("trailer off the axle", "xyab", 2, off_axle), (2, 3, 4)),
    (
        system(
            "Heisenberg twice",
            "abcdz",
            4,
            lambda q: [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1], [0, q[0], 0, q[2]]],
        ),
        (4, 5),
    ),
]


@pytest.mark.parametrize(("which", "growth"), KNOWN, ids=lambda x: getattr(x, "name", None))
def test_growth_of_systems_not_in_the_paper(which, growth):
    found = classify(which)
    assert found.growth == growth and found.controllable and found.certain
    assert (found.levels, found.brackets) == (len(growth), len(growth) - 1)


def test_chained_form_requires_growth_by_one():
    """Goursat: the car's flag grows by one per step, Cartan's 2-3-5 does not."""
    assert chained_form_exists(models.car())
    assert not chained_form_exists(next(which for which, _ in KNOWN if which.name == "Cartan"))


def test_singular_states_of_martinets_distribution():
    """Martinet: growth (2, 3) nearly everywhere, (2, 2, 3) on the surface x = 0."""
    martinet = system("Martinet", "xyz", 2, lambda q: [[1, 0], [0, 1], [0, q[0] ** 2 / 2]])
    off, on = classify(martinet, [1.0, 0.0, 0.0]), classify(martinet, [0.0, 0.0, 0.0])
    assert (off.growth_at, off.regular) == ((2, 3), True)
    assert (on.growth_at, on.regular, on.controllable) == ((2, 2, 3), False, True)
    assert (off.relative_growth_at, on.relative_growth_at) == ((2, 1), (2, 0, 1))


def test_states_where_much_deeper_brackets_are_needed():
    """``z' = x^5 u2`` takes six fields at x = 0; for unicycles with two and three trailers, see Jean (1996).

    The first trailer is at a right angle, and the bound is a Fibonacci number.
    """
    flat = system("flat", "xyz", 2, lambda q: [[1, 0], [0, 1], [0, q[0] ** 5]])
    assert classify(flat, [0.0, 0.3, 0.0]).growth_at == (2, 2, 2, 2, 2, 3)

    def train(count):
        def fields(q):
            rows, speed = [[ca.cos(q[2]), 0], [ca.sin(q[2]), 0], [0, 1]], 1
            for ahead, behind in zip(range(2, 2 + count), range(3, 3 + count), strict=True):
                rows.append([speed * ca.sin(q[ahead] - q[behind]), 0])
                speed = speed * ca.cos(q[ahead] - q[behind])
            return rows

        return system("train", "xyabcd"[: 3 + count], 2, fields)

    assert classify(train(2), [0, 0, np.pi / 2, 0, 0]).growth_at == (2, 3, 4, 4, 5)
    assert classify(train(3), [0, 0, np.pi, np.pi / 2, 0, 0]).growth_at == (2, 3, 4, 4, 5, 5, 5, 6)


def test_two_balls_of_one_size_roll_on_a_leaf():
    """Only then is rolling integrable: growth (2,)."""
    found = classify(rolling_balls(1.0))
    assert found.growth == (2,) and found.certain
    with pytest.raises(InputError, match="span 2 of 5 directions"):
        found.require_controllable()


def test_constraints_choose_inputs_that_serve_the_whole_domain():
    """A car from the no-slip rows of its axles: at rest straight ahead, sideways must not be an input."""
    rows = [lambda q: [ca.sin(q[2]), -ca.cos(q[2]), 0, 0]]
    rows.append(lambda q: [ca.sin(q[2] + q[3]), -ca.cos(q[2] + q[3]), -ca.cos(q[3]), 0])
    car = from_constraints("car", "xyap", lambda q: [row(q) for row in rows])
    assert car.inputs == ("x_rate", "p_rate") and classify(car).growth_at == (2, 3, 4)
    with pytest.raises(InputError, match="row 3 of 3 is zero or follows from those above it"):
        from_constraints("car", "xyap", lambda q: [*(row(q) for row in rows), [0.5 * w for w in rows[0](q)]])


def test_leaf_of_a_system_that_keeps_a_sphere():
    """x x' + y y' + z z' = 0 keeps the radius: leaves are spheres, and the error names the radial direction."""
    sphere = from_constraints("sphere", "xyz", lambda q: [[q[0], q[1], q[2]]], at=[0.5, 0.9, 0.5])
    with pytest.raises(InputError, match="not finite at"):
        leaf(sphere, [0.6, 0.0, 0.8])  # where the state that the constraint gives is zero
    at = [0.48, 0.36, 0.8]
    found = leaf(sphere, at)
    assert found.dimension == 2
    assert np.allclose(np.cross(found.annihilator(at)[0], at), 0, atol=1e-9)
    assert np.abs(found.offset([0.36, 0.48, 0.8])).max() < 1e-8
    assert np.abs(found.offset([0.36, 0.48, 0.9])).max() > 0.05
    with pytest.raises(InputError, match=r"span 2 of 3.*dx.*dz|span 2 of 3.*dz.*dx"):
        classify(sphere, at).require_controllable()


def test_steering_in_an_unreachable_direction_names_it():
    """``z - x y`` never changes: no loop moves it, and the error gives this reason instead of the loops that were
    tried."""
    kept = system("kept", "xyz", 2, lambda q: [[1, 0], [0, 1], [q[1], q[0]]])
    with pytest.raises(InputError, match=r"kept: not controllable.* no bracket reaches dz"):
        steer_triangular(kept, [0, 0, 0], [0, 0, 1])


def test_steering_to_the_start_is_a_rest():
    steering = steer_triangular(models.hopper(), [0.1, 0, 0], [0.1, 0, 0])
    assert [stage.label for stage in steering.stages] == ["rest"] and steering.end_error == 0.0


def test_non_triangular_systems_are_named():
    with pytest.raises(InputError, match="not triangular"):
        triangular(models.trailers([1.0]))


def test_zero_time_is_refused():
    steering = Steering(models.chained(3), np.zeros(3), np.zeros(3), (Stage("s", lambda s: np.zeros((len(s), 2))),))
    with pytest.raises(InputError, match="not times for these stages"):
        steering.timed(0.0)


def test_goals_across_a_singularity_name_the_coordinate():
    with pytest.raises(InputError, match=r"goal\.theta = 2.0: outside"):
        steer_triangular(car_triangular(), [0, 0, 0, 0], [0, 0, 2.0, 0])
    with pytest.raises(InputError, match="hitch 1 is at a right angle"):
        steer_trailers([1.0], [0, 0, 0, 0, 0], [5, 0, 0, 0, 1.7])


def test_goals_out_of_reach_of_every_loop_name_the_coordinate():
    with pytest.raises(SolveError, match="theta"):
        steer_triangular(models.hopper(0.01, (-0.01, 0.01)), [0, 0, 0], [0, 0, 900.0])
