"""Group axioms, adjoints and tangents of difference maps, over all groups and maps and random elements."""

import casadi as ca
import numpy as np
import pytest
from scipy.linalg import expm

from vehsim.errors import InputError
from vehsim.lie import GROUPS, difference_map
from vehsim.lie.maps import MAPS
from vehsim.vehicles.definition.states import flat

groups = pytest.mark.parametrize("group", GROUPS.values(), ids=str)
maps = pytest.mark.parametrize("name", MAPS)
exact = pytest.mark.parametrize("name", ["exp", "cay", "ccsk"])
"""Maps whose C is the inverse of their own tangent."""
scales = pytest.mark.parametrize("scale", [0.0, 1e-9, 1e-4, 0.1, 0.44, 0.45, 1.0, 2.5])


def elements(group, count, seed=0, scale=1.0):
    rng = np.random.default_rng(seed)
    return group.exp(scale * rng.standard_normal((count, group.dim)))


@groups
def test_group_axioms(group):
    a, b, c = (elements(group, 50, seed) for seed in range(3))
    matrix = group.matrix
    np.testing.assert_allclose(matrix(group.compose(a, b)), matrix(a) @ matrix(b), atol=1e-13)
    left, right = group.compose(group.compose(a, b), c), group.compose(a, group.compose(b, c))
    np.testing.assert_allclose(matrix(left), matrix(right), atol=1e-13)
    one = np.broadcast_to(np.eye(matrix(a).shape[-1]), matrix(a).shape)
    np.testing.assert_allclose(matrix(group.compose(a, group.inverse(a))), one, atol=1e-13)
    np.testing.assert_allclose(group.compose(a, group.identity), a, atol=1e-15)


@groups
def test_hat_vee_ad_and_bracket(group):
    x, y = np.random.default_rng(1).standard_normal((2, group.dim))
    bracket = group.hat(x) @ group.hat(y) - group.hat(y) @ group.hat(x)
    np.testing.assert_allclose(group.hat(group.ad(x) @ y), bracket, atol=1e-13)
    np.testing.assert_allclose(flat(ca.DM(group.vee(ca.SX(group.hat(x))))), x, atol=0)


@groups
def test_adjoint_is_conjugation(group):
    g, x = elements(group, 1)[0], np.random.default_rng(2).standard_normal(group.dim)
    conjugate = group.matrix(g) @ group.hat(x) @ np.linalg.inv(group.matrix(g))
    np.testing.assert_allclose(group.hat(group.Ad(g) @ x), conjugate, atol=1e-13)


@groups
@scales
def test_exp_is_the_matrix_exponential(group, scale):
    x = scale * np.random.default_rng(3).standard_normal(group.dim)
    np.testing.assert_allclose(group.matrix(group.exp(x)), expm(group.hat(x)), atol=2e-14 * max(1, scale**3))


@groups
@scales
def test_cay_is_the_matrix_cayley_map(group, scale):
    x = scale * np.random.default_rng(4).standard_normal(group.dim)
    half = group.hat(x) / 2
    one = np.eye(len(half))
    np.testing.assert_allclose(group.matrix(group.cay(x)), np.linalg.solve(one - half, one + half), atol=1e-14)


@groups
@exact
@scales
def test_tangent_is_the_derivative_of_the_map(group, name, scale):
    """``D tau(x).d tau(x)^-1`` by automatic differentiation of tau's own matrix, against ``C^-1 d``."""
    tau = difference_map(name, group)
    rng = np.random.default_rng(5)
    at, direction = scale * rng.standard_normal(group.dim), rng.standard_normal(group.dim)
    x = ca.SX.sym("x", group.dim)
    matrix = group.matrix(tau.tau(x))
    slope = ca.reshape(ca.jtimes(ca.vec(matrix), x, ca.SX(direction)), matrix.shape)
    derivative = np.array(ca.Function("d", [x], [slope])(at))
    expected = derivative @ np.linalg.inv(group.matrix(tau.tau(at)))
    np.testing.assert_allclose(group.hat(tau.dtau(at) @ direction), expected, atol=2e-13)
    np.testing.assert_allclose(tau.C(at) @ tau.dtau(at), np.eye(group.dim), atol=1e-13)


@groups
@maps
@scales
def test_intertwining_and_symmetry(group, name, scale):
    """``C_end(x) = C(x) Ad(tau(x))``, which makes momentum exact; ``tau(x) tau(-x) = e`` and ``C_end(x) = C(-x)``."""
    tau = difference_map(name, group)
    x = scale * np.random.default_rng(6).standard_normal(group.dim)
    loss = np.abs(tau.C_end(x) - tau.C(x) @ group.Ad(tau.tau(x))).max()
    assert loss < 2e-13 * max(1, scale**4) or name == "exp_truncated"
    if not tau.symmetric:
        assert scale < 0.1 or np.abs(tau.C(-x) - tau.C(x) @ group.Ad(tau.tau(x))).max() > 1e-3
        return
    np.testing.assert_allclose(tau.C_end(x), tau.C(-x), atol=0)
    product = group.matrix(group.compose(tau.tau(x), tau.tau(-x)))
    np.testing.assert_allclose(product, np.eye(len(product)), atol=1e-14)


@groups
@maps
def test_second_derivatives_are_finite_at_zero(group, name):
    x = ca.SX.sym("x", group.dim)
    tau = difference_map(name, group)
    entries = ca.vertcat(tau.tau(x), ca.vec(tau.C(x)))
    second = ca.jacobian(ca.vec(ca.jacobian(entries, x)), x)
    assert np.all(np.isfinite(np.array(ca.Function("h", [x], [second])(np.zeros(group.dim)))))


@groups
def test_pose_round_trip(group):
    g = elements(group, 20, seed=7, scale=0.8)
    np.testing.assert_allclose(group.matrix(group.from_pose(group.pose(g))), group.matrix(g), atol=1e-14)


@groups
def test_body_velocity_and_wrench_are_dual(group):
    g = elements(group, 1, seed=8)[0]
    xi, wrench = np.random.default_rng(9).standard_normal((2, group.dim))
    twist = group.velocity_to_body(g, xi)
    np.testing.assert_allclose(group.velocity_from_body(g, twist), xi, atol=1e-14)
    assert group.wrench_from_body(g, wrench) @ xi == pytest.approx(wrench @ twist)


@groups
def test_arrays_broadcast_over_leading_axes(group):
    g = elements(group, 6).reshape(2, 3, -1)
    assert group.compose(g, g[0, 0]).shape == (2, 3, group.size)
    assert group.Ad(g).shape == (2, 3, group.dim, group.dim)
    np.testing.assert_allclose(group.Ad(g)[1, 2], group.Ad(g[1, 2]))
    assert group.angle_squared(np.zeros((4, group.dim))).shape == (4,)


def test_unknown_map_is_named():
    with pytest.raises(InputError, match="'caley': unknown; choose one of cay, ccsk, exp, exp_truncated, tln"):
        difference_map("caley", GROUPS["SO3"])


@groups
def test_truncated_exp_loses_momentum_with_the_fifth_power_of_the_step(group):
    tau, x = difference_map("exp_truncated", group), np.random.default_rng(6).standard_normal(group.dim)
    loss = [np.abs(tau.C(-y) - tau.C(y) @ group.Ad(tau.tau(y))).max() for y in (0.1 * x, 0.05 * x)]
    assert loss[0] / loss[1] == pytest.approx(32, rel=0.1)


def test_tln_is_not_the_tangent_of_its_map_on_se3_and_the_printed_pair_does_not_intertwine():
    """Why a map and its C are one object: LIE's B_cay belongs to C_TLN, its C_cay to the matrix Cayley map."""
    group, x = GROUPS["SE3"], np.random.default_rng(6).standard_normal(6)
    cay, tln = difference_map("cay", group), difference_map("tln", group)
    assert np.abs(cay.C(-x) - cay.C(x) @ group.Ad(tln.tau(x))).max() > 1e-2
    np.testing.assert_allclose(group.Ad(tln.tau(x)), np.linalg.solve(tln.C(x), tln.C(-x)), atol=1e-13)
    w, v = x[:3], x[3:]
    hat = group.hat(x)[:3, :3]
    printed = 2 / (4 + w @ w) * (2 * np.eye(3) + hat) @ v
    np.testing.assert_allclose(tln.tau(x)[4:7], printed, atol=1e-14)


def test_closed_forms_of_the_papers():
    """LIE eq. 15 (C_cay on SE(3)), eq. 22-23 (SE(2)) and the corrected Cayley map of appendix B."""
    w, v = np.random.default_rng(11).standard_normal((2, 3))
    hat = GROUPS["SO3"].hat
    C = np.zeros((6, 6))
    C[:3, :3] = np.eye(3) - hat(w) / 2 + np.outer(w, w) / 4
    C[3:, :3] = -(np.eye(3) - hat(w) / 2) @ hat(v) / 2
    C[3:, 3:] = np.eye(3) - hat(w) / 2
    np.testing.assert_allclose(difference_map("cay", GROUPS["SE3"]).C(np.r_[w, v]), C, atol=1e-14)

    plane, x = GROUPS["SE2"], np.random.default_rng(12).standard_normal(3)
    expected = np.eye(3) - plane.ad(x) / 2
    expected[:, 0] += x[0] * x / 4
    np.testing.assert_allclose(difference_map("cay", plane).C(x), expected, atol=1e-14)
    a, b, c = x
    matrix = [[4 - a * a, -4 * a, 4 * b - 2 * a * c], [4 * a, 4 - a * a, 2 * a * b + 4 * c]]
    np.testing.assert_allclose(plane.matrix(plane.cay(x))[:2], np.array(matrix) / (4 + a * a), atol=1e-14)


@groups
def test_shifted_twists_are_velocities_of_the_shifted_point(group):
    """Compared with poses: a body and a point fixed to it, moved by ``exp(t x)``."""
    if group.name == "SO3":  # nothing to move
        np.testing.assert_array_equal(group.shift(np.array([1.0, 2, 3]), np.array([4.0, 5, 6])), [1, 2, 3])
        return
    x, offset, dt = np.random.default_rng(7).standard_normal(group.dim), np.array([0.4, -0.3, 0.0]), 1e-6
    twist = group.velocity_to_body(np.array(group.identity), x)
    moved = group.pose(group.exp(dt * x))
    w, v = np.asarray(moved[3:7]), np.asarray(moved[:3])
    turned = offset + 2 * np.cross(w[1:], w[0] * offset + np.cross(w[1:], offset))
    speed = (v + turned - offset) / dt
    linear = group.shift(twist, offset)[-2:] if group.planar else group.shift(twist, offset)[3:]
    np.testing.assert_allclose(linear, speed[: len(linear)], atol=1e-5)
