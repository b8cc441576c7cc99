"""Detect faults of a vehicle's definition during motion: constraints lose rank, or kinetic energy is not positive
definite. Warn of damping that is too fast for the step.

Rank and mass are checked at knots and between neighbours, only for definitions whose constraints or mass depend on the
shape.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable
from typing import Any

import casadi as ca
import numpy as np

from vehsim.errors import SolveError
from vehsim.integrators.discrete import DiscreteMechanics, keep
from vehsim.integrators.fast.kernel import Kernel
from vehsim.vehicles import Vehicle
from vehsim.vehicles.definition.base import Array
from vehsim.vehicles.definition.mechanics import driven_rates, free_velocity, momentum, project

_INDEFINITE = 1e-12
"""Ratio of eigenvalues below which a mass counts as singular."""
_LOST = 1e-16
"""Squared sine of the angle between constraint rows below which they count as dependent."""


def changes_rank(mechanics: DiscreteMechanics) -> bool:
    """Whether the constraints depend on the shape."""
    bound = _bound(mechanics.vehicle)
    r = mechanics.symbols["r"]
    return bound is not None and bool(ca.depends_on(bound(r), r)) if r.shape[0] else False


def check_constraints(mechanics: DiscreteMechanics, r: Array, first: int = 0) -> None:
    """Raise ``SolveError`` naming step and joints if constraints lose rank at or between knots ``r`` (n, s)."""
    if len(r) < 2 or not changes_rank(mechanics):
        return
    function = _overlap(mechanics)
    mapped = function if len(r) == 2 else function.map(len(r) - 1)
    independence, overlap = (np.asarray(x, float).ravel() for x in mapped(r[:-1].T, r[1:].T))
    bad = np.flatnonzero(~((independence > _LOST) & (overlap > 0)))
    if bad.size:
        k = int(bad[0])
        raise rank_lost(mechanics.vehicle, first + k, r[k], r[k + 1])


def check_mass(mechanics: DiscreteMechanics, r: Array, compiled: bool = False) -> None:
    """Raise ``SolveError`` naming step and joints if the kinetic energy on the free velocities is not positive
    definite.

    ``r`` (n, s), or (m, n, s) for several vehicles; ``compiled``: evaluated by machine code.
    """
    function = _mass(mechanics)
    if function is None or len(r) == 0:
        return
    if r.ndim == 3:
        try:
            check_mass(mechanics, r.reshape(-1, r.shape[2]), compiled)
        except SolveError:  # again one by one, to name the right step
            for row in r:
                check_mass(mechanics, row, compiled)
        return
    size = function.size1_out(0)
    masses = np.empty((len(r), size * size))
    kernel = keep(mechanics, f"masses {compiled}", lambda: Kernel(function, compiled))
    kernel.rows([np.ascontiguousarray(r)], [masses])
    smallest = _definiteness(masses.reshape(-1, size, size))
    for k in np.flatnonzero(~(smallest > _INDEFINITE)):
        # the basis itself may be singular: try a regular one
        value = _on_orthonormal_basis(mechanics, r[k])
        if value > _INDEFINITE:
            continue
        raise SolveError(
            f"step {k}: kinetic energy is not positive definite on the free velocities at joints = "
            f"{np.round(r[k], 6).tolist()} (smallest eigenvalue {value:.3g} of the largest)",
            "fix it, or keep the joints away from there",
            subject=mechanics.vehicle.name,
        )


def warn_of_stiff_damping(
    mechanics: DiscreteMechanics, phases: Array, controls: Array, step: float, wind: Any, stacklevel: int = 3
) -> None:
    """Warn if a velocity decays, at the first or the last of the phases (n, .), so fast that its sign alternates from
    step to step: the factor of a step, ``(2 - rate h) / (2 + rate h)``, is negative."""
    decay = _decay(mechanics)
    if decay is None or not len(phases):
        return
    for k in (0, -1):
        g, r, pi, _ = np.split(phases[k], np.cumsum(mechanics.sizes[:3]))
        matrix = np.asarray(decay(g, r, pi, controls[k], wind), float)
        rate = float(np.linalg.eigvals(matrix).real.max()) if np.all(np.isfinite(matrix)) else 0.0
        if rate * step > 2:
            warnings.warn(
                f"{mechanics.vehicle.name}: damping of {rate:.3g}/s is too fast for steps of {step:.3g} s, so a "
                f"velocity alternates instead of decaying; take steps below {1.9 / rate:.2g} s, or less damping",
                stacklevel=stacklevel,
            )
            return


def _decay(mechanics: DiscreteMechanics) -> ca.Function | None:
    """``(g, r, pi, c, wind) -> M^-1 D`` (n_z, n_z): rates at which forces make the free velocities decay."""
    v, y = mechanics.vehicle, mechanics.symbols
    g, r, z, pi, c, wind = (y[name] for name in ("g", "r", "z", "pi", "c0", "wind"))

    def build() -> ca.Function | None:
        u, xi = free_velocity(v, r, z, driven_rates(v, c))
        damping = -ca.jacobian(project(v, r, *v.force(g, r, u, xi, c, wind)), z)
        if not z.shape[0] or damping.nnz() == 0:
            return None
        mass = ca.jacobian(project(v, r, *momentum(v, r, u, xi)), z)
        rates = ca.Function("rates", [g, r, z, c, wind], [ca.densify(ca.solve(mass, damping))])
        return ca.Function(
            "decay", [g, r, pi, c, wind], [rates(g, r, mechanics.knot_velocity_guess(r, pi, c), c, wind)]
        )

    return keep(mechanics, "decay", build)  # type: ignore[no-any-return]  # `keep` is untyped


def rank_lost(vehicle: Vehicle, step: int, before: Array, after: Array) -> SolveError:
    return SolveError(
        f"step {step}: constraints lose rank between joints = {np.round(before, 6).tolist()} and "
        f"{np.round(after, 6).tolist()}: nothing determines the motion there",
        "keep the joints away from it",
        subject=vehicle.name,
    )


def _definiteness(matrices: Array) -> Array:
    """Smallest divided by largest eigenvalue of symmetric matrices (n, m, m), each scaled by its own diagonal first:
    (n,)."""
    size = np.sqrt(np.abs(np.diagonal(matrices, axis1=1, axis2=2))) + 1e-300
    scaled = matrices / size[:, :, None] / size[:, None, :]
    if matrices.shape[1] == 1:
        return np.asarray(np.sign(scaled[:, 0, 0]), float)
    values = np.linalg.eigvalsh(np.nan_to_num((scaled + scaled.transpose(0, 2, 1)) / 2, nan=-1.0, posinf=-1.0))
    return np.asarray(values[:, 0] / np.abs(values).max(axis=1), float)


def _on_orthonormal_basis(mechanics: DiscreteMechanics, r: Array) -> float:
    """Definiteness of the kinetic energy on the null space of all constraints at joints ``r`` (s,)."""
    v = mechanics.vehicle
    others = [i for i in range(len(v.joints)) if i not in {joint for joint, _ in v.driven}]

    def build() -> ca.Function:
        s, d = len(v.joints), v.group.dim
        symbol, rates, xi = ca.SX.sym("r", s), ca.SX.sym("u", len(others)), ca.SX.sym("xi", d)
        u = ca.SX.zeros(s)
        u[others] = rates
        velocity = ca.vertcat(rates, xi)
        hessian = ca.hessian(v.reduced_lagrangian(symbol, u, xi), velocity)[0]
        w_r, w_xi = v._constraints(symbol)  # type: ignore[attr-defined]  # a nonholonomic vehicle
        still = ca.SX.zeros(velocity.shape[0])
        values = [ca.substitute(hessian, velocity, still), ca.horzcat(w_r[:, others], w_xi)]
        return ca.Function("full", [symbol], [ca.densify(x) for x in values])

    hessian, rows = (np.array(x) for x in keep(mechanics, "full", build)(r))
    from scipy.linalg import null_space

    basis = null_space(rows.reshape(-1, len(hessian))) if rows.size else np.eye(len(hessian))
    return float(_definiteness((basis.T @ hessian @ basis)[None])[0]) if basis.size else 1.0


def _bound(vehicle: Vehicle) -> Callable[[Any], Any] | None:
    """The matrix that the constraints solve with, if the vehicle has constraints."""
    return getattr(vehicle, "bound", None)


def _overlap(mechanics: DiscreteMechanics) -> ca.Function:
    """``(r0, r1) -> (independence of the rows at the worse end, overlap of the two row spaces)``."""

    def build() -> ca.Function:
        bound, s = _bound(mechanics.vehicle), len(mechanics.vehicle.joints)
        assert bound is not None
        r0, r1 = ca.SX.sym("r0", s), ca.SX.sym("r1", s)
        unit = [_unit_rows(bound(r)) for r in (r0, r1)]
        own = [ca.det(w @ w.T) for w in unit]
        return ca.Function("overlap", [r0, r1], [ca.fmin(*own), ca.det(unit[0] @ unit[1].T)])

    return keep(mechanics, "overlap", build)


def _unit_rows(w: Any) -> Any:
    return ca.vertcat(*(w[i, :] / ca.sqrt(ca.sumsqr(w[i, :]) + 1e-300) for i in range(w.shape[0])))


def _mass(mechanics: DiscreteMechanics) -> ca.Function | None:
    v, y = mechanics.vehicle, mechanics.symbols

    def build() -> ca.Function:
        u, xi = free_velocity(v, y["r"], y["z"], driven_rates(v, ca.SX.zeros(len(v.controls))))
        mass = ca.hessian(v.reduced_lagrangian(y["r"], u, xi), y["z"])[0]
        return ca.Function("mass", [y["r"]], [ca.densify(ca.substitute(mass, y["z"], ca.SX.zeros(y["z"].shape[0])))])

    if not len(v.joints) or not y["z"].shape[0]:
        return None
    function = keep(mechanics, "mass", build)
    return None if function.jac_sparsity(0, 0).nnz() == 0 else function
