"""Trigonometric quotients of a squared angle, smooth (with all derivatives) through zero."""

from __future__ import annotations

from collections.abc import Callable
from math import factorial
from typing import Any

import casadi as ca

Expr = Any


def _smooth(closed: Callable[[Expr], Expr], coefficients: list[float], below: float) -> Callable[[Expr], Expr]:
    """``closed(t)``, or its Taylor polynomial in ``t`` where ``t < below`` and the closed form would cancel."""

    def evaluate(t: Expr) -> Expr:
        small = t < below
        series: Expr = 0.0
        for coefficient in reversed(coefficients):
            series = series * t + coefficient
        # the branch not taken is evaluated (and differentiated) too: keep it away from 0 / 0
        return ca.if_else(small, series, closed(ca.if_else(small, 1.0, t)))

    return evaluate


def _alternating(offset: int, terms: int = 8) -> list[float]:
    return [(-1.0) ** k / factorial(2 * k + offset) for k in range(terms)]


cosc = _smooth(lambda t: ca.cos(ca.sqrt(t)), _alternating(0), 0.05)
"""``cos x`` of ``t = x^2``."""
sinc = _smooth(lambda t: ca.sin(ca.sqrt(t)) / ca.sqrt(t), _alternating(1), 0.05)
"""``sin x / x`` of ``t = x^2``."""
sinsc = _smooth(lambda t: (1 - ca.sin(ca.sqrt(t)) / ca.sqrt(t)) / t, _alternating(3), 0.05)
"""``(x - sin x) / x^3`` of ``t = x^2``."""

# G(t) = (x/2) cot(x/2) - 1 = -t/12 - t^2/720 - ..., the even part of z / (exp z - 1) on z = i x (Bernoulli numbers)
_G = [-1 / 12, -1 / 720, -1 / 30240, -1 / 1209600, -1 / 47900160, -691 / 1307674368000, -1 / 74724249600]


def _half_cot(t: Expr) -> tuple[Expr, Expr]:
    x = ca.sqrt(t)
    value = x / 2 / ca.tan(x / 2) - 1
    slope = (1 / ca.tan(x / 2) - x / 2 / ca.sin(x / 2) ** 2) / (4 * x)
    return value, slope


def _square_term(t: Expr) -> Expr:
    value, slope = _half_cot(t)
    return slope - 2 * value / t


def _fourth_term(t: Expr) -> Expr:
    value, slope = _half_cot(t)
    return (slope - value / t) / t


dexpinv2 = _smooth(_square_term, [(k - 1) * g for k, g in enumerate(_G)], 0.2)
"""Coefficient of ``ad^2`` in ``dexp^-1 = I - ad/2 + dexpinv2 ad^2 + dexpinv4 ad^4``."""
dexpinv4 = _smooth(_fourth_term, [(k + 1) * g for k, g in enumerate(_G[1:])], 0.2)
"""Coefficient of ``ad^4``; exact because ``ad`` has the eigenvalues 0 and +-i x, each at most twice."""
