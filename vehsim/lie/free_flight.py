"""The motion of a free rigid body over one step, to fourth or sixth order in the step.

A step with `tln` keeps the momentum exactly for any increment ``x``. Here ``x`` is the increment of the exact motion,
up to a power of ``h``, as a function of the mean ``mu`` of the momenta at the ends of the step; docs/derivations.md
derives it. As ``x`` is odd in ``h``, the step stays symmetric and its order is even.
"""

from __future__ import annotations

from typing import Any

import casadi as ca
import numpy as np

from vehsim.lie.groups import Group

Expr = Any


def fourth(group: Group, inertia: Any, xi: Expr, h: Expr) -> Expr:
    """``x`` (dim,) to fourth order on any group; ``inertia`` (dim, dim), ``xi = inertia^-1 mu`` (dim,), step ``h`` s.

    ``x = h xi + h^3 ([xi, J mu'] - J mu'' - cube(xi)) / 12`` with ``J = inertia^-1`` and ``mu' = ad(xi)^T mu``.
    """
    mu, along, mobility = ca.DM(inertia) @ xi, group.ad(xi), ca.DM(np.linalg.inv(inertia))
    force = along.T @ mu
    change = mobility @ force
    swing = group.ad(change).T @ mu + along.T @ force
    return h * xi + h**3 / 12 * (along @ change - mobility @ swing - group.cube(xi))


def rotation(inertia: Any, omega: Expr, h: Expr, order: int) -> Expr:
    """``x`` (3,) of a rotation to order 4 or 6; ``inertia`` (3, 3) kg m^2, ``omega = inertia^-1 mu`` (3,) rad/s.

    In principal axes ``x_i = m_i`` times an even polynomial of the momentum, with constant coefficients.
    """
    moments, axes = np.linalg.eigh(inertia)
    axes = axes if np.any(inertia - np.diag(np.diag(inertia))) else np.eye(3)
    moments = np.diag(axes.T @ inertia @ axes)
    turned = axes.T if np.any(axes - np.eye(3)) else None
    w = omega if turned is None else ca.DM(turned) @ omega
    squares = [(moments[i] * w[i]) ** 2 for i in range(3)]
    h2, parts = h**2, []
    for i in range(3):
        j, k = (i + 1) % 3, (i + 2) % 3
        a, b, c = (float(1 / moments[n]) for n in (i, j, k))
        p, q, r = (h2 * squares[n] for n in (i, j, k))
        factor = 1 + (a**3 * p + _linear(a, b, c) * q + _linear(a, c, b) * r) / (12 * a)
        if order == 6:
            factor += (
                p * (a**5 * p + _mixed(a, b, c) * q + _mixed(a, c, b) * r)
                + q * (_square(a, b, c) * q + _cross(a, b, c) * r)
                + _square(a, c, b) * r**2
            ) / (120 * a)
        parts.append(h * w[i] * factor)
    x = ca.vertcat(*parts)
    return x if turned is None else ca.DM(axes) @ x


def _linear(a: float, b: float, c: float) -> float:
    return (b - c) * (2 * a * b - a**2) + b**2 * c


def _mixed(a: float, b: float, c: float) -> float:
    return (
        4 * a**4 * (c - b)
        + a**3 * (9 * b**2 - 7 * b * c - 2 * c**2)
        + a**2 * (-3 * b**3 + 2 * b**2 * c + 6 * b * c**2)
        + a * (b**3 * c - 6 * b**2 * c**2)
        + 2 * b**3 * c**2
    )


def _square(a: float, b: float, c: float) -> float:
    return (b - c) ** 2 * (a**3 - 3 * a**2 * b + 3 * a * b**2) + b**3 * c * (2 * b - c)


def _cross(a: float, b: float, c: float) -> float:
    return (b - c) ** 2 * (6 * a**2 * (b + c) - 4 * a**3 - 7 * a * b * c) + b**2 * c**2 * (b + c)
