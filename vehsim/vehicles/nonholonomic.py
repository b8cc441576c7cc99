"""Vehicles with joints and rolling constraints, from a Lagrangian and the constraints alone (LIE section 5).

The basis of the free directions and the connection follow by automatic differentiation: nobody writes them by hand.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import Any

import casadi as ca
import numpy as np

from vehsim.errors import InputError
from vehsim.vehicles._base import Expr, Vehicle


@dataclass(frozen=True, eq=False, kw_only=True)
class Nonholonomic(Vehicle):
    """A vehicle on ``group`` with shape ``r`` (s,), Lagrangian ``l(r, u, xi)`` and ``W_r(r) u + W_xi(r) xi = 0``.

    ``lagrangian``: (r, u, xi) -> scalar, J; ``constraints``: r -> (W_r (m, s), W_xi (m, d)), of nested lists, arrays or
    expressions. ``forces``: (r, u, xi, controls) -> joint forces (s,), or (joint forces (s,), body wrench (d,)); what
    acts at zero controls counts as damping. ``potential_energy``: (g, r) -> J, of the group's coordinates and joints.
    ``sample``: joint values (s,) at which rank and definiteness are checked (zeros unless given).

    Raises ``InputError`` when constraints lose rank, or the kinetic energy is not positive definite on the velocities
    that the constraints and rate controls leave free.
    """

    lagrangian: Callable[[Expr, Expr, Expr], Expr]
    constraints: Callable[[Expr], tuple[Any, Any]] | None = None
    forces: Callable[[Expr, Expr, Expr, Expr], Any] | None = None
    potential_energy: Callable[[Expr, Expr], Expr] | None = None
    sample: Sequence[float] | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        sample = np.zeros(len(self.joints)) if self.sample is None else np.asarray(self.sample, float)
        r = ca.SX.sym("r", len(self.joints))
        _, w_xi = self._constraints(r)
        numeric = np.array(ca.Function("w", [r], [ca.densify(w_xi)])(sample)).reshape(w_xi.shape)
        object.__setattr__(self, "_pivots", _pivots(self.name, numeric, sample))
        _check_definite(self, sample)

    def _constraints(self, r: Expr) -> tuple[Expr, Expr]:
        s, d = len(self.joints), self.group.dim
        if self.constraints is None:
            return ca.SX(0, s), ca.SX(0, d)
        w_r, w_xi = (_matrix(w) for w in self.constraints(r))
        if w_r.shape[0] != w_xi.shape[0] or w_r.shape[1] != s or w_xi.shape[1] != d:
            raise InputError(
                f"{self.name}: constraints: W_r has shape {w_r.shape} and W_xi {w_xi.shape}; "
                f"they must be (m, {s}) and (m, {d})"
            )
        return w_r, w_xi

    def reduced_lagrangian(self, r: Expr, u: Expr, xi: Expr) -> Expr:
        return self.lagrangian(r, u, xi)

    def basis(self, r: Expr) -> Expr:
        """Basis of null(W_xi(r)), (d, b): the pivot columns are eliminated."""
        _, w_xi = self._constraints(r)
        pivots: tuple[int, ...] = self._pivots  # type: ignore[attr-defined]
        free = [i for i in range(self.group.dim) if i not in pivots]
        basis = ca.SX(self.group.dim, len(free))
        for column, i in enumerate(free):
            basis[i, column] = 1
        if pivots and free:
            basis[list(pivots), :] = -ca.solve(w_xi[:, list(pivots)], w_xi[:, free])
        return basis

    def connection(self, r: Expr) -> Expr:
        """``A(r)`` (d, s) with ``xi = -A u`` the lift that meets the constraints and carries no free momentum."""
        s, d = len(self.joints), self.group.dim
        w_r, w_xi = self._constraints(r)
        u, xi = ca.SX.sym("u", s), ca.SX.sym("xi", d)
        momentum = ca.gradient(self.reduced_lagrangian(r, u, xi), xi)
        e = self.basis(r)
        rows_u = ca.vertcat(w_r, e.T @ ca.jacobian(momentum, u))
        rows_xi = ca.vertcat(w_xi, e.T @ ca.jacobian(momentum, xi))
        return ca.solve(rows_xi, rows_u) if s else ca.SX(d, 0)

    def force(self, g: Expr, r: Expr, u: Expr, xi: Expr, c: Expr, wind: Expr) -> tuple[Expr, Expr]:
        s, d = len(self.joints), self.group.dim
        if self.forces is None:
            return ca.SX(s, 1), ca.SX(d, 1)
        forces = self.forces(r, u, self.group.velocity_to_body(g, xi), c)
        joint, body = forces if isinstance(forces, tuple) and len(forces) == 2 else (forces, ca.SX(d, 1))
        return _column(joint), self.group.wrench_from_body(g, _column(body))

    def potential(self, g: Expr, r: Expr) -> Expr:
        return 0.0 if self.potential_energy is None else self.potential_energy(g, r)

    def dissipation(self, g: Expr, r: Expr, u: Expr, xi: Expr, wind: Expr) -> Expr:
        on_joints, on_group = self.force(g, r, u, xi, ca.SX.zeros(len(self.controls)), wind)
        return -ca.dot(on_joints, u) - ca.dot(on_group, xi)


def _column(values: Any) -> Expr:
    return ca.vertcat(*values) if isinstance(values, list | tuple) else ca.SX(values)


def _matrix(values: Any) -> Expr:
    if isinstance(values, list | tuple):
        return ca.vertcat(*(ca.horzcat(*row) for row in values))
    return ca.SX(values)


def _pivots(name: str, w_xi: np.ndarray, sample: np.ndarray) -> tuple[int, ...]:
    """Columns of W_xi to eliminate: the best conditioned square block at the sample."""
    rows, columns = w_xi.shape
    if rows == 0:
        return ()
    best = max(combinations(range(columns), rows), key=lambda c: np.linalg.svd(w_xi[:, c], compute_uv=False)[-1])
    if np.linalg.matrix_rank(w_xi, tol=1e-9 * max(1.0, np.abs(w_xi).max())) < rows:
        raise InputError(
            f"{name}: constraints lose rank at joints = {sample.tolist()}: W_xi = {w_xi.tolist()}; "
            "drop the dependent row, or give a `sample` where they are independent"
        )
    return tuple(best)


def _check_definite(vehicle: Nonholonomic, sample: np.ndarray) -> None:
    from vehsim.vehicles.mechanics import free_velocity

    s = len(vehicle.joints)
    r, z = ca.SX.sym("r", s), ca.SX.sym("z", vehicle.basis(ca.SX(sample)).shape[1] + len(vehicle.dynamic))
    u, xi = free_velocity(vehicle, r, z, ca.SX(s, 1))
    hessian = ca.hessian(vehicle.reduced_lagrangian(r, u, xi), z)[0]
    value = np.array(ca.Function("m", [r, z], [ca.densify(hessian)])(sample, 0)).reshape(z.shape[0], z.shape[0])
    eigenvalues = np.linalg.eigvalsh((value + value.T) / 2) if value.size else np.ones(1)
    if eigenvalues.min() <= 1e-12 * max(1.0, eigenvalues.max()):
        raise InputError(
            f"{vehicle.name}: lagrangian: kinetic energy is not positive definite on the free velocities at joints = "
            f"{sample.tolist()} (eigenvalues {eigenvalues.tolist()}); give every free velocity inertia, "
            "or make its joint follow a rate control"
        )
