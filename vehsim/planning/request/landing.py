"""Landing and taking off: what a mark on the ground asks of the way there, besides standing on it.

The clearance asked for falls along a cone towards the place, and so does the speed at which the vehicle may come down.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from vehsim.lie.quaternions import from_yaw
from vehsim.planning.request.marks import Mark
from vehsim.planning.terms import Constraint, Expr, KnotView
from vehsim.requests import Ask

Array = NDArray[np.float64]

SLOPE = 0.35
"""How steeply the clearance asked for falls towards a landing: metres a metre, an approach of 20 degrees."""
ROUND = 0.1
"""Rounds the tip of that cone, m."""
GENTLE, SINK = 0.5, 1.0
"""How fast it may come down where it lands, m/s, and how much faster a metre away from there, 1/s."""
BRIEF = 0.005
"""By how much that may be passed between knots, m/s."""


def landings(marks: Sequence[Mark]) -> list[Mark]:
    """The marks where it stands on the ground, each once."""
    return [mark for mark in marks if mark.on_ground and not mark.hold]


def attitude(mark: Mark) -> Array:
    """The orientation of a mark on the ground (4,) w, x, y, z; level by default."""
    if mark.orientation is not None:
        return np.asarray(mark.orientation, float) / np.linalg.norm(mark.orientation)
    return from_yaw(np.deg2rad(mark.heading or 0.0))


def approach(distance: Any, asked: Any, touching: Any, tanh: Any = np.tanh) -> Any:
    """The clearance asked for, m, ``distance`` m from a landing where it is ``touching`` m: it falls along a cone."""
    lack = asked - touching
    return asked - lack * (1 - tanh(SLOPE * distance / lack))


def rounded_distance(position: Expr, place: Expr) -> Expr:
    """How far a position (3,) is from a landing, m, smooth there."""
    return ca.sqrt(ca.sumsqr(position - place) + ROUND**2) - ROUND


def forgiven(marks: Sequence[Mark], wanted: float) -> Callable[[Array], Array]:
    """Positions (n, 3) -> how much less than the clearance ``wanted`` is asked there (n,), m: all, on a landing."""
    places = [np.asarray(mark.position, float) for mark in landings(marks)]

    def less(positions: Array) -> Array:
        away = [wanted - approach(np.linalg.norm(positions - p, axis=1), wanted, 0.0) for p in places]
        return np.max(away, axis=0, initial=0.0) if away else np.zeros(len(positions))

    return less


def descent(mark: Mark) -> Constraint:
    """How fast a motion may come down about a landing, between knots too: at knots `constraints.landing` asks it."""
    place = [float(x) for x in np.asarray(mark.position, float)]

    def law(k: KnotView) -> Expr:
        return k.velocity[2] + GENTLE + SINK * rounded_distance(k.position, ca.DM(place))

    def ask(first: float, last: float) -> Ask:
        wanted = {"place": place, "sink": SINK}
        return Ask(key, "descent", first, last, wanted, upper=GENTLE + 2 * BRIEF, unit="m/s")

    key = f"{mark.name}.on_ground (descent)"
    return Constraint(
        key, law, lower=0.0, over="between", slack=BRIEF, ask=ask, identity=("descent", *place),
        shown=lambda value: f"{-value:.2g} m/s too fast",
    )  # fmt: skip
