"""Vehicles with joints and rolling constraints, from a Lagrangian and the constraints alone (LIE section 5).

The basis of the free directions and the connection follow by automatic differentiation.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from typing import Any

import casadi as ca
import numpy as np

from vehsim.errors import InputError
from vehsim.lie.once import built_once
from vehsim.vehicles.definition.base import Expr
from vehsim.vehicles.definition.mechanics import (
    CASADI_ERRORS,
    answered,
    closed,
    column,
    conservative,
    free_velocity,
    law,
    matrix,
    symbols,
)
from vehsim.vehicles.definition.scales import scaled
from vehsim.vehicles.definition.vehicle import Vehicle

SPEEDS = 10.0 ** np.arange(-1, 5)
"""Factors on random velocities, rad/s and m/s, at which a Lagrangian must be quadratic."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Nonholonomic(Vehicle):
    """A vehicle on ``group`` with shape ``r`` (s,), Lagrangian ``l(r, u, xi)`` and ``W_r(r) u + W_xi(r) xi = 0``.

    ``lagrangian``: (r, u, xi) -> scalar, J. ``constraints``: r -> (W_r (m, s), W_xi (m, d)), as nested lists, arrays or
    expressions. ``forces``: (r, u, xi, controls) -> joint forces (s,), or (joint forces (s,), body wrench (d,)); forces
    at zero controls count as damping. ``potential_energy``: (g, r) -> J, of the group's coordinates and the joints.
    ``sample``: joint values (s,) at which rank and definiteness are checked; default: zeros. ``pivots``: columns of
    ``bound(r)`` to eliminate; default: chosen automatically.

    Raises ``InputError`` if a law has the wrong shape, if the Lagrangian is not quadratic in the velocities, if
    constraints lose rank, or if the kinetic energy is not positive definite on the velocities that the constraints and
    rate controls leave free.
    """

    lagrangian: Callable[[Expr, Expr, Expr], Expr]
    constraints: Callable[[Expr], tuple[Any, Any]] | None = None
    forces: Callable[[Expr, Expr, Expr, Expr], Any] | None = None
    potential_energy: Callable[[Expr, Expr], Expr] | None = None
    sample: Sequence[float] | None = None
    pivots: tuple[int, ...] | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        sample = np.zeros(len(self.joints)) if self.sample is None else np.asarray(self.sample, float)
        if sample.shape != (len(self.joints),) or not np.all(np.isfinite(sample)):
            raise InputError(
                "not a sample of the joints",
                f"give {len(self.joints)} finite numbers",
                key="sample",
                value=self.sample,
                subject=self.name,
            )
        _check_laws(self)
        object.__setattr__(self, "_tied", ())
        object.__setattr__(self, "_tied", _tied(self, sample))
        if self.pivots is None:
            object.__setattr__(self, "pivots", _pivots(self, sample))
        _check_definite(self, sample)
        object.__setattr__(self, "controls", scaled(self))

    @property
    def rolls(self) -> bool:
        return self.group.planar

    @property
    def tied(self) -> tuple[int, ...]:
        return self._tied  # type: ignore[attr-defined, no-any-return]  # set when it is made

    def chart_at(self, r: Any) -> Nonholonomic | None:
        """The same vehicle with the best columns for joints ``r`` (s,) eliminated, if these differ."""
        pivots = _pivots(replace(self, joint_limits={}), np.asarray(r, float))
        if pivots == self.pivots:
            return None
        charts = self.__dict__.setdefault("_charts", {})
        if pivots not in charts:
            charts[pivots] = replace(self, pivots=pivots, sample=tuple(np.asarray(r, float)))
        return charts[pivots]

    def soundness(self, r: Any) -> float:
        """Distance of the eliminated columns from singularity at joints ``r`` (s,), from 0 (singular) to 1."""
        w = _numeric(self.bound, np.asarray(r, float))
        if not self.pivots or w.shape[1] == len(w) + 1:
            return 1.0
        return _smallest(w[:, list(self.pivots)]) / max(_smallest(w), 1e-300)

    def bound(self, r: Expr) -> Expr:
        """``W_xi`` and the tied joints' columns of ``W_r`` (m, d + t): the matrix of the unknowns of the
        constraints."""
        w_r, w_xi = self._constraints(r)
        return ca.horzcat(w_xi, w_r[:, list(self.tied)])

    def _constraints(self, r: Expr) -> tuple[Expr, Expr]:
        s, d = len(self.joints), self.group.dim
        if self.constraints is None:
            return ca.SX(0, s), ca.SX(0, d)
        try:
            w_r, w_xi = (matrix(w) for w in self.constraints(r))
        except CASADI_ERRORS as error:
            raise InputError(
                "does not give two matrices",
                f"return W_r (m, {s}) and W_xi (m, {d}) as lists of rows, arrays or expressions",
                key="constraints",
                subject=self.name,
            ) from error
        for w in (w_r, w_xi):
            closed(self, "constraints", w, r)
        if w_r.shape[0] != w_xi.shape[0] or w_r.shape[1] != s or w_xi.shape[1] != d:
            raise InputError(
                f"W_r has shape {w_r.shape} and W_xi {w_xi.shape}",
                f"they must be (m, {s}) and (m, {d})",
                key="constraints",
                subject=self.name,
            )
        return w_r, w_xi

    @built_once
    def reduced_lagrangian(self, r: Expr, u: Expr, xi: Expr) -> Expr:
        return self.lagrangian(r, u, xi)

    @built_once
    def basis(self, r: Expr) -> Expr:
        """Basis of the null space of ``bound(r)``, (d + t, b)."""
        w = self.bound(r)
        rows, columns = w.shape
        if columns == rows + 1 and w.is_constant() is False:
            return _normal(w)
        pivots = self.pivots or ()
        free = [i for i in range(columns) if i not in pivots]
        basis = ca.SX(columns, len(free))
        for place, i in enumerate(free):
            basis[i, place] = 1
        if pivots and free:
            basis[list(pivots), :] = -ca.solve(w[:, list(pivots)], w[:, free])
        return basis

    def regularity(self, r: Expr) -> Expr:
        """Squared ratio of the eliminated columns' volume to that of all columns of ``bound(r)``."""
        w, pivots = self.bound(r), list(self.pivots or ())
        if not pivots or w.shape[1] == w.shape[0] + 1:
            return 1.0
        return ca.det(w[:, pivots]) ** 2 / ca.det(w @ w.T)

    @built_once
    def connection(self, r: Expr) -> Expr:
        """``A(r)`` (d + t, s): ``-A u`` satisfies the constraints and carries no momentum along the free directions."""
        s, d, tied = len(self.joints), self.group.dim, list(self.tied)
        w_r, _ = self._constraints(r)
        u, xi, rates = ca.SX.sym("u", s), ca.SX.sym("xi", d), ca.SX.sym("rates", len(tied))
        others = [i for i in range(s) if i not in tied]
        all_rates = ca.SX(u)
        all_rates[tied] = rates
        x = ca.vertcat(xi, rates)
        momentum = ca.gradient(self.reduced_lagrangian(r, all_rates, xi), x)
        e = self.basis(r)
        rows_u = ca.vertcat(w_r, e.T @ ca.jacobian(momentum, u))[:, others]
        rows_x = ca.vertcat(self.bound(r), e.T @ ca.jacobian(momentum, x))
        lift = ca.SX(d + len(tied), s)
        if others:
            lift[:, others] = ca.solve(rows_x, rows_u)
        return lift

    @built_once
    def force(self, g: Expr, r: Expr, u: Expr, xi: Expr, c: Expr, wind: Expr) -> tuple[Expr, Expr]:
        s, d = len(self.joints), self.group.dim
        if self.forces is None:
            return ca.SX(s, 1), ca.SX(d, 1)
        twist = self.group.velocity_to_body(g, xi)
        known = r, u, twist, c
        given = answered(self, "forces", self.forces, *known)
        joint, body = given if isinstance(given, tuple) and len(given) == 2 else (given, ca.SX(d, 1))
        on_joints, on_body = (column(self, "forces", size, part, *known) for size, part in ((s, joint), (d, body)))
        if self.standing is not None and self.potential_energy is not None:
            on_body -= self.standing(*known, conservative(self, g, r)[1])
        return on_joints, self.group.wrench_from_body(g, on_body)

    def potential(self, g: Expr, r: Expr) -> Expr:
        return 0.0 if self.potential_energy is None else self.potential_energy(g, r)

    def dissipation(self, g: Expr, r: Expr, u: Expr, xi: Expr, wind: Expr) -> Expr:
        on_joints, on_group = self.force(g, r, u, xi, ca.SX.zeros(len(self.controls)), wind)
        return -ca.dot(on_joints, u) - ca.dot(on_group, xi)


def _normal(w: Expr) -> Expr:
    """The unit vector (n + 1, 1) orthogonal to n rows, by cofactors: smooth wherever the rows are independent."""
    columns = w.shape[1]
    cofactors = []
    for i in range(columns):
        rest = [j for j in range(columns) if j != i]
        cofactors.append((-1) ** i * (ca.det(w[:, rest]) if len(rest) else ca.SX(1)))
    normal = ca.vertcat(*cofactors)
    return normal / ca.sqrt(ca.dot(normal, normal))


def _numeric(expression: Callable[[Expr], Expr], r: np.ndarray) -> np.ndarray:
    symbol = ca.SX.sym("r", len(r))
    matrix = expression(symbol)
    return np.array(ca.Function("w", [symbol], [ca.densify(matrix)])(r)).reshape(matrix.shape)


def _tied(vehicle: Nonholonomic, sample: np.ndarray) -> tuple[int, ...]:
    """Joints whose rates the constraints determine in addition to the group's velocity: as few as keep the rows
    independent.

    The other joints' rates must determine the motion everywhere, not only at the sample. For example, a trailer's hitch
    stands still in a steady turn and does not determine it.
    """
    w_r, w_xi = (_numeric(_part(vehicle, i), sample) for i in (0, 1))
    scale = 1e-9 * max(1.0, *(np.abs(w).max() for w in (w_r, w_xi) if w.size)) if w_xi.size or w_r.size else 1.0
    rows = len(w_xi)
    missing = rows - (np.linalg.matrix_rank(w_xi, tol=scale) if w_xi.size else 0)
    points = [sample, *_spread(vehicle, sample, 1.0)] if rows else []
    spread = [tuple(_numeric(_part(vehicle, i), point) for i in (1, 0)) for point in points]

    def sound(tied: tuple[int, ...]) -> bool:
        """Whether a square matrix of constraints stays non-singular: its determinant keeps its sign."""
        if rows < w_xi.shape[1] + len(tied):
            return True  # free motions of the group remain for driving
        return len({np.sign(np.linalg.det(np.hstack([a, b[:, list(tied)]]))) for a, b in spread}) == 1

    def choose(count: int) -> tuple[int, ...] | None:
        choices = combinations(vehicle.dynamic, count)
        return max(choices, key=lambda tied: _smallest(np.hstack([w_xi, w_r[:, list(tied)]])), default=None)

    best = choose(missing)
    if best is not None and rows:
        more = (choose(count) for count in range(missing, len(vehicle.dynamic) + 1))
        best = next((tied for tied in more if tied is not None and sound(tied)), best)
    if best is None or (rows and _smallest(np.hstack([w_xi, w_r[:, list(best)]])) <= scale):
        raise InputError(
            f"rows lose rank at joints = {sample.tolist()}: W_r = {w_r.tolist()}, W_xi = {w_xi.tolist()}",
            "drop the dependent row, or give a `sample` where they are independent",
            key="constraints",
            subject=vehicle.name,
        )
    return best


def _part(vehicle: Nonholonomic, i: int) -> Callable[[Expr], Expr]:
    """``W_r(r)`` (0) or ``W_xi(r)`` (1)."""
    return lambda r: vehicle._constraints(r)[i]


def _spread(vehicle: Nonholonomic, sample: np.ndarray, reach: float) -> list[np.ndarray]:
    """Sixteen samples of the joints within their limits, or within ``reach`` of the sample if they have none."""
    limits = [vehicle.joint_limits.get(joint, (-np.inf, np.inf)) for joint in vehicle.joints]
    ends = [
        (a, b) if np.isfinite(a) and np.isfinite(b) else (x - reach, x + reach)
        for (a, b), x in zip(limits, sample, strict=True)
    ]
    random = np.random.default_rng(0).uniform(size=(16, len(limits)))
    return [np.array([a + t * (b - a) for (a, b), t in zip(ends, row, strict=True)]) for row in random]


def _smallest(matrix: np.ndarray) -> float:
    """Smallest singular value of the rows: zero if they are dependent."""
    rows, columns = matrix.shape
    return float(np.linalg.svd(matrix, compute_uv=False)[-1]) if 0 < rows <= columns else float(rows == 0)


def _pivots(vehicle: Nonholonomic, sample: np.ndarray) -> tuple[int, ...]:
    """The columns to eliminate: the square block that remains best conditioned within the joints' limits and at the
    sample."""
    points = [sample, *_spread(vehicle, sample, 0.0)]
    matrices = [_numeric(vehicle.bound, np.asarray(point, float)) for point in points]
    rows, columns = matrices[0].shape
    blocks = combinations(range(columns), rows)
    # at the sample first, because elsewhere the rows themselves may be dependent
    return max(blocks, key=lambda c: min(_smallest(w[:, c]) / max(_smallest(w), 1e-6) for w in matrices[:1] + matrices))


def _check_laws(vehicle: Nonholonomic) -> None:
    """Evaluate the laws once, so that wrong ones are named when the vehicle is made."""
    s, d = len(vehicle.joints), vehicle.group.dim
    g, r, u, xi, c, wind = symbols(vehicle)
    vehicle._constraints(r)
    vehicle.force(g, r, u, xi, c, wind)
    # on a terrain, the vehicle's own: that of the ground takes long to build
    potential = getattr(vehicle.potential_energy, "own", vehicle.potential_energy)
    if potential is not None:
        law(vehicle, "potential_energy", 1, potential, g, r)
    lagrangian = law(vehicle, "lagrangian", 1, vehicle.lagrangian, r, u, xi)
    velocities = ca.vertcat(u, xi)
    mass = ca.hessian(lagrangian, velocities)[0]
    if not ca.depends_on(mass, velocities):
        return
    values = ca.Function("mass", [r, velocities], [ca.densify(mass)])
    for row in np.random.default_rng(0).normal(size=(4, 2 * s + d)):
        still = np.array(values(row[:s], 1e-3))
        for speed in SPEEDS:  # a law may change at any of them
            moving = np.array(values(row[:s], speed * row[s:]))
            if not np.allclose(moving, still, rtol=1e-9, atol=1e-9 * np.abs(moving).max()):
                raise InputError(
                    "not quadratic in the velocities",
                    "let its coefficients depend on the joints only, and put other terms into forces",
                    key="lagrangian",
                    subject=vehicle.name,
                )


def _check_definite(vehicle: Nonholonomic, sample: np.ndarray) -> None:
    s = len(vehicle.joints)
    r, z = ca.SX.sym("r", s), ca.SX.sym("z", vehicle.basis(ca.SX(sample)).shape[1] + len(vehicle.dynamic))
    u, xi = free_velocity(vehicle, r, z, ca.SX(s, 1))
    hessian = ca.hessian(vehicle.reduced_lagrangian(r, u, xi), z)[0]
    value = np.array(ca.Function("m", [r, z], [ca.densify(hessian)])(sample, 0)).reshape(z.shape[0], z.shape[0])
    if not np.isfinite(value).all():
        raise InputError(
            f"not finite at joints = {sample.tolist()}",
            "give finite numbers, or a `sample` of the joints where it is finite",
            key="lagrangian",
            subject=vehicle.name,
        )
    eigenvalues = np.linalg.eigvalsh((value + value.T) / 2) if value.size else np.ones(1)
    if eigenvalues.min() <= 1e-12 * max(1.0, eigenvalues.max()):
        raise InputError(
            f"kinetic energy is not positive definite on the free velocities at joints = {sample.tolist()} "
            f"(eigenvalues {eigenvalues.tolist()})",
            "give every free velocity inertia, or make its joint follow a rate control",
            key="lagrangian",
            subject=vehicle.name,
        )
