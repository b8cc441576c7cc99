"""Constraints over a range of frames: look at a point, stay above or below a height, stay inside a rectangle."""

from __future__ import annotations

import math
from collections.abc import Sequence

import casadi as ca
import numpy as np

from vehsim.errors import InputError
from vehsim.planning.terms import Constraint, Expr, KnotView
from vehsim.requests import Ask, look_ask, stay_ask

ANGLE, LENGTH = 0.02, 5e-4
"""Tolerances of such a range between knots, deg and m."""
Frames = tuple[int, int] | None
AXES = {"x": (0, 1.0), "y": (1, 1.0), "z": (2, 1.0), "-x": (0, -1.0), "-y": (1, -1.0), "-z": (2, -1.0)}
"""Body axes by name: column of the rotation matrix, and sign."""


def look_at(
    point: Sequence[float], frames: Frames = None, *, within: float = 5.0, axis: str = "x", level: bool = True
) -> Constraint:
    """A body axis (the nose, ``"x"``) points at ``point`` (3,) m to within ``within`` degrees over ``frames`` (first,
    last).

    ``level``: the angle is measured in plan view, so that the vehicle may pitch and bank; otherwise in space. Raises
    ``InputError``.
    """
    if np.shape(point) != (3,) or not np.all(np.isfinite(point)):
        raise InputError("not a point", "give [x, y, z] in metres", key="point", value=point, subject="look_at")
    if axis not in AXES or (level and axis.endswith("z")):
        raise InputError(
            "not an axis for this",
            f"choose one of {', '.join(AXES)}; z cannot be level",
            key="axis",
            value=axis,
            subject="look_at",
        )
    if not 0 < within < 180:
        raise InputError(
            "not an angle", "give degrees between 0 and 180", key="within", value=within, subject="look_at"
        )
    column, sign = AXES[axis]
    shown = slice(0, 2 if level else 3)

    def law(k: KnotView) -> Expr:
        offset, nose = (ca.DM(list(point)) - k.position)[shown], sign * k.rotation[shown, column]
        return ca.dot(offset, nose) / ca.sqrt((ca.sumsqr(offset) + 1e-6) * (ca.sumsqr(nose) + 1e-9))

    aside = None if axis.endswith("z") else (0.0, math.pi / 2)[column] + (math.pi if sign < 0 else 0.0)
    aim = None if aside is None else (tuple(point), aside)

    def ask(first: float, last: float) -> Ask:
        return look_ask("look_at", first, last, point, math.radians(within), column, sign, level)

    lower = math.cos(math.radians(within))
    return Constraint(
        "look_at", law, lower=lower, frames=frames, aim=aim, slack=lower - math.cos(math.radians(within + ANGLE)),
        shown=lambda value: f"{math.degrees(math.acos(min(1.0, value))):.3g} deg off", ask=ask,
    )  # fmt: skip


def stay(
    frames: Frames = None, *, above: float | None = None, below: float | None = None, within: Sequence[float] = ()
) -> Constraint:
    """The root stays between the heights ``above`` and ``below``, m, and inside ``within`` (x0, y0, x1, y1), m.

    It applies between knots too. Raises ``InputError``.
    """
    low, high = -math.inf if above is None else float(above), math.inf if below is None else float(below)
    box = np.array(within, float) if len(within) else np.array([-np.inf, -np.inf, np.inf, np.inf])
    if not low < high or (above is None and below is None and not len(within)):
        raise InputError(
            "not heights",
            "give heights in metres, above less than below",
            key="above, below",
            value=(above, below),
            subject="stay",
        )
    if box.shape != (4,) or not np.all(box[:2] < box[2:]):
        raise InputError(
            "not a rectangle",
            "give [x0, y0, x1, y1] in metres, x0 < x1 and y0 < y1",
            key="within",
            value=within,
            subject="stay",
        )
    lower, upper = np.array([box[0], box[1], low]), np.array([box[2], box[3], high])
    kept = [i for i in range(3) if np.isfinite(lower[i]) or np.isfinite(upper[i])]
    law, bounds = (lambda k: k.position[kept]), (lower[kept], upper[kept])

    def ask(first: float, last: float) -> Ask:
        return stay_ask("stay", first, last, lower.tolist(), upper.tolist())

    return Constraint(
        "stay", law, *bounds, frames=frames, box=(lower, upper), slack=LENGTH, shown=lambda value: f"{value:.4g} m",
        ask=ask,
    )  # fmt: skip
