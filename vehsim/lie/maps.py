"""Difference maps: ``tau`` from the algebra to the group and its tangent, kept in one object so that they always match.

The tangent is right-trivialised: ``D tau(x).d = (dtau(x) d) tau(x)``. Integrators use its inverse, LIE's ``C_tau``. Its
dual transforms momenta: ``C(x)`` at the start of a segment, ``C_end(x)`` at its end. Spatial momentum is conserved
exactly if ``C_end(x) = C(x) Ad(tau(x))``. The step is symmetric, hence second order and suitable for composition, if
also ``C_end(x) = C(-x)`` and ``tau(x) tau(-x) = e``. Measured on a tumbling body (``tests/lie``,
``tests/integrators``):

| map             | what it is                                    | C is the tangent | momentum kept | order |
|-----------------|-----------------------------------------------|------------------|---------------|-------|
| `exp`           | exponential, LIE eq. 12 and 14                | yes              | 1e-13         | 2     |
| `exp_truncated` | the same with LIE's printed C, eq. 15         | to 4th order     | 1e-6 lost     | 2     |
| `cay`           | Cayley map of the group's matrices            | yes              | 1e-13         | 2     |
| `tln`           | trapezoidal Lie-Newmark: Cayley map of ``ad`` | no               | 1e-13         | 2     |
| `tln4`, `tln6`  | `tln` that follows a body's free flight       | no               | 1e-13         | 4, 6  |
| `ccsk`          | coordinates of the second kind                | yes              | 1e-13         | 1     |
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import reduce
from typing import Any

import casadi as ca
import numpy as np

from vehsim.errors import InputError
from vehsim.lie.free_flight import fourth, rotation
from vehsim.lie.groups import Group
from vehsim.lie.series import dexpinv2, dexpinv4
from vehsim.lie.vectorized import vectorized

Expr = Any


def _exp_tangent_inverse(group: Group, x: Expr) -> Expr:
    """Closed form of ``dexp^-1`` (SYM eq. 13, summed) for all groups."""
    ad, squared = group.ad(x), group.angle_squared(x)
    ad2 = ad @ ad
    return ca.SX.eye(group.dim) - ad / 2 + dexpinv2(squared) * ad2 + dexpinv4(squared) * ad2 @ ad2


def _cay_tangent_inverse(group: Group, x: Expr) -> Expr:
    """``dcay^-1(x) y = (e - x/2) y (e + x/2)`` (SYM eq. 14) on the group's matrices; LIE eq. 15 on SE(3)."""
    half = group.hat(x) / 2
    one = ca.SX.eye(half.shape[0])
    return group._columns(lambda basis: (one - half) @ basis @ (one + half))


def _exp_truncated(group: Group, x: Expr) -> Expr:
    """LIE eq. 15 as printed: ``I - ad/2 + ad^2/12``."""
    ad = group.ad(x)
    return ca.SX.eye(group.dim) - ad / 2 + ad @ ad / 12


def _exp_truncated_dual(group: Group, x: Expr, covector: Expr) -> Expr:
    transposed = group.ad(x).T
    once = transposed @ covector
    return covector - once / 2 + transposed @ once / 12


def _tln(group: Group, x: Expr) -> Expr:
    """``I - ad/2``, LIE's C_TLN; intertwines with the Cayley map of ``ad`` (LIE eq. 14, B_cay) alone."""
    return ca.SX.eye(group.dim) - group.ad(x) / 2


def _exp_dual(group: Group, x: Expr, covector: Expr) -> Expr:
    """`_exp_tangent_inverse` transposed times a covector, without forming the matrix."""
    transposed, squared = group.ad(x).T, group.angle_squared(x)
    once = transposed @ covector
    twice = transposed @ once
    fourth = transposed @ (transposed @ twice)
    return covector - once / 2 + dexpinv2(squared) * twice + dexpinv4(squared) * fourth


def _factors(group: Group, x: Expr) -> list[Expr]:
    return [group.exp(x * ca.SX(e)) for e in np.eye(group.dim)]


def _ccsk(group: Group, x: Expr) -> Expr:
    """Product of the one-parameter subgroups, ``exp(x_1 e_1) ... exp(x_d e_d)``."""
    return reduce(group.compose, _factors(group, x))


def _ccsk_tangent_inverse(group: Group, x: Expr) -> Expr:
    """Column i of the tangent is ``Ad(exp(x_1 e_1) ... exp(x_i-1 e_i-1)) e_i``."""
    columns, before = [], ca.SX(ca.DM(group.identity))
    for i, factor in enumerate(_factors(group, x)):
        columns.append(group.Ad(before)[:, i])
        before = group.compose(before, factor)
    return ca.inv(ca.horzcat(*columns))


@dataclass(frozen=True)
class _Law:
    """A map as data: ``tau`` and ``C`` as functions of (group, x), whether its step is symmetric, ``C.T`` times a
    covector.

    ``free_flight``: order to which a step follows the free flight of a body (`vehsim.lie.free_flight`); 0: no more than
    the order of the map.
    ``near``: name of a map with a simpler ``C`` that agrees to second order, for the derivatives in Newton's method;
    None: the map itself.
    """

    tau: Callable[[Group, Expr], Expr]
    C: Callable[[Group, Expr], Expr]
    symmetric: bool = True
    dual: Callable[[Group, Expr, Expr], Expr] | None = None
    near: str | None = None
    free_flight: int = 0


MAPS: dict[str, _Law] = {
    "exp": _Law(lambda group, x: group.exp(x), _exp_tangent_inverse, dual=_exp_dual, near="exp_truncated"),
    "cay": _Law(lambda group, x: group.cay(x), _cay_tangent_inverse),
    "tln": _Law(lambda group, x: group.cay_ad(x), _tln),
    "tln4": _Law(lambda group, x: group.cay_ad(x), _tln, near="tln", free_flight=4),
    "tln6": _Law(lambda group, x: group.cay_ad(x), _tln, near="tln", free_flight=6),
    "exp_truncated": _Law(lambda group, x: group.exp(x), _exp_truncated, dual=_exp_truncated_dual),
    "ccsk": _Law(_ccsk, _ccsk_tangent_inverse, symmetric=False),
}


DEFAULT_MAP = "tln"
"""The cheapest and, at equal CPU time, the most accurate on every shipped vehicle (docs/derivations.md)."""


@dataclass(frozen=True, eq=False)
class DifferenceMap:
    """A difference map on a group. Methods accept CasADi columns, or arrays ``(..., dim)``."""

    name: str
    group: Group

    @property
    def symmetric(self) -> bool:
        """Whether a step with this map, run backwards, is its own inverse: then it is second order and suitable for
        composition."""
        return MAPS[self.name].symmetric

    def increment(self, inertia: Callable[[], Any], xi: Expr, h: Expr) -> Expr:
        """What `tau` and `C` take for a step of ``h`` s with the velocity ``xi`` (dim,): ``h xi``, or for `tln4` and
        `tln6` that of the free flight of a body with ``inertia()`` (dim, dim).

        Raises ``InputError`` if the map does not know the free flight.
        """
        order = MAPS[self.name].free_flight
        if not order:
            return h * xi
        matrix = np.asarray(inertia(), float)
        turn, rest = matrix[:3, :3], matrix[:3, 3:]
        if self.group.direct and not np.any(rest):
            return ca.vertcat(rotation(turn, xi[:3], h, order), h * xi[3:])
        if order > 4:
            raise InputError(
                f"known on SO3, and on SO3xR3 about the centre of mass, not for this body on {self.group}",
                'choose "tln4"',
                key="difference_map",
                value=self.name,
            )
        return fourth(self.group, matrix, xi, h)

    @property
    def near(self) -> DifferenceMap:
        """A map whose ``C`` is cheaper and accurate enough to differentiate in Newton's method."""
        return DifferenceMap(MAPS[self.name].near or self.name, self.group)

    @vectorized
    def tau(self, x: Expr) -> Expr:
        """Group element (size,) of an algebra vector (dim,)."""
        return MAPS[self.name].tau(self.group, x)

    @vectorized
    def C(self, x: Expr) -> Expr:
        """Inverse of the right-trivialised tangent, (dim, dim)."""
        return MAPS[self.name].C(self.group, x)

    @vectorized
    def C_end(self, x: Expr) -> Expr:
        """Transforms the momentum at a segment's end, (dim, dim): ``C(-x)``, or ``C(x) Ad(tau(x))`` if asymmetric."""
        return self.C(-x) if self.symmetric else self.C(x) @ self.group.Ad(self.tau(x))

    @vectorized
    def dual(self, x: Expr, covector: Expr) -> Expr:
        """``C(x).T`` times a covector (dim,)."""
        dual = MAPS[self.name].dual
        return self.C(x).T @ covector if dual is None else dual(self.group, x, covector)

    @vectorized
    def dual_end(self, x: Expr, covector: Expr) -> Expr:
        """``C_end(x).T`` times a covector (dim,)."""
        return self.dual(-x, covector) if self.symmetric else self.C_end(x).T @ covector

    @vectorized
    def dtau(self, x: Expr) -> Expr:
        """Right-trivialised tangent, (dim, dim)."""
        return ca.inv(self.C(x))


def difference_map(name: str, group: Group) -> DifferenceMap:
    """The map called ``name`` (a key of ``MAPS``) on ``group``. Raises ``InputError`` if there is no such map."""
    if name not in MAPS:
        raise InputError("unknown", f"choose one of {', '.join(sorted(MAPS))}", key="difference_map", value=name)
    return DifferenceMap(name, group)
