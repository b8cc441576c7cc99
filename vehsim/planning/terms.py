"""Costs and limits a plan can be given, as data: each is one expression of a segment or of a knot."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from difflib import get_close_matches
from typing import Any

import casadi as ca

from vehsim.errors import InputError

Expr = Any


@dataclass(frozen=True)
class SegmentView:
    """What a cost sees of a segment: the knots at its ends, ``c0, c1`` controls over their scale, ``h`` s."""

    start: KnotView
    end: KnotView
    c0: Expr
    c1: Expr
    h: Expr


@dataclass(frozen=True)
class KnotView:
    """What a cost or limit sees of a knot: the rig root's ``position`` (3,) m, ``velocity`` (3,) world m/s,
    ``omega`` (3,) body rad/s, ``rotation`` (3, 3) root to world."""

    position: Expr
    velocity: Expr
    omega: Expr
    rotation: Expr


def _effort(s: SegmentView) -> Expr:
    """Integral of the squared controls, exact for controls linear between knots."""
    return s.h / 3 * (ca.sumsqr(s.c0) + ca.dot(s.c0, s.c1) + ca.sumsqr(s.c1))


def _off_course(k: KnotView) -> Expr:
    """Horizontal speed less its part along the nose, m/s: zero in forward flight, twice the speed backwards."""
    across = ca.sqrt(ca.sumsqr(k.velocity[0:2]) + 0.01)
    return across - ca.dot(k.rotation[0:2, 0], k.velocity[0:2])


COSTS: dict[str, Callable[[SegmentView], Expr]] = {
    "effort": _effort,
    "time": lambda s: s.h,
    "distance": lambda s: ca.sqrt(ca.sumsqr(s.end.position - s.start.position) + 1e-8),
    "smoothness": lambda s: ca.sumsqr(s.c1 - s.c0) / s.h,
    "course": lambda s: s.h / 2 * (_off_course(s.start) + _off_course(s.end)),
}
"""Cost name -> its integral over a segment."""

LIMITS: dict[str, Callable[[KnotView], Expr]] = {
    "speed": lambda k: ca.sqrt(ca.sumsqr(k.velocity) + 1e-8),
    "ceiling": lambda k: k.position[2],
    "climb": lambda k: ca.sqrt(k.velocity[2] ** 2 + 1e-8),
    "turn_rate": lambda k: ca.sqrt(ca.sumsqr(k.omega) + 1e-8),
    "bank": lambda k: ca.acos(0.9999999 * k.rotation[2, 2]),
}
"""Limit name -> the value that stays below it at every knot: m/s, height of the root m, m/s up or down, rad/s, rad
between the body's and the world's Z."""

SMOOTHNESS = 1e-3
"""Weight of smoothness unless given: it keeps any optimum unique and the controls from chattering."""


def cost_weights(cost: str | Mapping[str, float], defaults: Mapping[str, float]) -> dict[str, float]:
    """Weights by cost name, from a name or a table; ``defaults`` are the vehicle's own and yield to the table."""
    table = {cost: 1.0} if isinstance(cost, str) else dict(cost)
    for name, weight in table.items():
        _known("cost", name, COSTS)
        if not (isinstance(weight, int | float) and 0 <= weight < float("inf")):
            raise InputError(f"cost.{name} = {weight!r}: give a weight, zero or more")
    if not any(table.values()):
        raise InputError(f"cost = {cost!r}: no weight above zero; weigh at least one of {', '.join(COSTS)}")
    return {name: 0.0 for name in COSTS} | {"smoothness": SMOOTHNESS} | dict(defaults) | table


def check_limits(limits: Mapping[str, float]) -> dict[str, float]:
    """The limits, every one known and positive."""
    for name, value in limits.items():
        _known("limits", name, LIMITS)
        if not (isinstance(value, int | float) and value > 0):
            raise InputError(f"limits.{name} = {value!r}: give a positive number")
    return dict(limits)


def _known(kind: str, name: str, table: Mapping[str, Any]) -> None:
    if name not in table:
        close = get_close_matches(name, table, n=1)
        hint = f"did you mean {close[0]!r}?" if close else f"choose one of {', '.join(table)}"
        raise InputError(f"{kind} = {name!r}: unknown; {hint}")
