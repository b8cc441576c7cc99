"""Difference maps: ``tau`` from the algebra to the group, and its tangent, as one object so nobody can mix them.

``tau(x) tau(-x) = e``. The tangent is right-trivialised: ``D tau(x).d = (dtau(x) d) tau(x)``. Integrators use its
inverse, LIE's ``C_tau``; its dual carries momenta. Momentum is exact because ``C(-x) = C(x) Ad(tau(x))``.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import casadi as ca

from vehsim.errors import InputError
from vehsim.lie._lift import lifted
from vehsim.lie._series import dexpinv2, dexpinv4
from vehsim.lie.groups import Group

Expr = Any


def _exp_tangent_inverse(group: Group, x: Expr) -> Expr:
    """Closed form of ``dexp^-1`` (SYM eq. 13 summed), for every group at once."""
    ad, squared = group.ad(x), group.angle_squared(x)
    ad2 = ad @ ad
    return ca.SX.eye(group.dim) - ad / 2 + dexpinv2(squared) * ad2 + dexpinv4(squared) * ad2 @ ad2


def _cay_tangent_inverse(group: Group, x: Expr) -> Expr:
    """``dcay^-1(x) y = (e - x/2) y (e + x/2)`` (SYM eq. 14) on the group's matrices; LIE eq. 15 on SE(3)."""
    half = group.hat(x) / 2
    one = ca.SX.eye(half.shape[0])
    return group._columns(lambda basis: (one - half) @ basis @ (one + half))


_TAU: dict[str, tuple[Callable[[Group, Expr], Expr], Callable[[Group, Expr], Expr]]] = {
    "exp": (lambda group, x: group.exp(x), _exp_tangent_inverse),
    "cay": (lambda group, x: group.cay(x), _cay_tangent_inverse),
}


@dataclass(frozen=True, eq=False)
class DifferenceMap:
    """A difference map on a group. Methods take CasADi columns, or arrays ``(..., dim)``."""

    name: str
    group: Group

    @lifted
    def tau(self, x: Expr) -> Expr:
        """Group element (size,) of an algebra vector (dim,)."""
        return _TAU[self.name][0](self.group, x)

    @lifted
    def C(self, x: Expr) -> Expr:  # noqa: N802 LIE's name
        """Inverse of the right-trivialised tangent, (dim, dim)."""
        return _TAU[self.name][1](self.group, x)

    @lifted
    def dtau(self, x: Expr) -> Expr:
        """Right-trivialised tangent, (dim, dim)."""
        return ca.inv(self.C(x))


def difference_map(name: str, group: Group) -> DifferenceMap:
    """The map called ``name`` ("exp" or "cay") on ``group``; ``InputError`` when there is none of that name."""
    if name not in _TAU:
        raise InputError(f"difference_map = {name!r}: unknown; choose one of {', '.join(sorted(_TAU))}")
    return DifferenceMap(name, group)
