"""Landing and take-off: the constraints that a mark on the ground puts on the approach and departure.

Near the mark, the requested clearance decreases along a cone to zero, and so does the allowed descent speed to
`GENTLE`.
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
"""Slope of the requested clearance towards a landing: metres per metre, an approach of 20 degrees."""
ROUND = 0.1
"""Radius, m, over which the tip of that cone is rounded."""
GENTLE, SINK = 0.5, 1.0
"""Allowed descent speed at the landing, m/s, and its increase per metre of distance from it, 1/s."""
BRIEF = 0.005
"""Tolerance of the descent speed between knots, m/s."""


def landings(marks: Sequence[Mark]) -> list[Mark]:
    """The marks on the ground, each once even if it is held."""
    return [mark for mark in marks if mark.on_ground and not mark.hold]


def attitude(mark: Mark) -> Array:
    """The orientation of a mark on the ground (4,) w, x, y, z; level by default."""
    if mark.orientation is not None:
        return np.asarray(mark.orientation, float) / np.linalg.norm(mark.orientation)
    return from_yaw(np.deg2rad(mark.heading or 0.0))


def landing_clearance(distance: Any, clearance: Any, touching: Any, tanh: Any = np.tanh, slope: Any = SLOPE) -> Any:
    """The requested clearance, m, at ``distance`` m from a landing, where it is ``touching`` m: a rounded cone."""
    lack = clearance - touching + 1e-9  # without any clearance too, this is a number
    return clearance - lack * (1 - tanh(slope * distance / lack))


def rounded_distance(position: Expr, place: Expr) -> Expr:
    """Distance of a position (3,) from a landing, m, smooth at the landing."""
    return rounded(ca.sumsqr(position - place), ca.sqrt)


def rounded(squared: Any, sqrt: Any = np.sqrt) -> Any:
    """A distance, m, of which the square is given, made smooth at zero, where it grows by up to `ROUND` less."""
    return sqrt(squared + ROUND**2) - ROUND


def forgiven(marks: Sequence[Mark], wanted: float) -> Callable[[Array], Array]:
    """A function of positions (n, 3): by how much the clearance ``wanted`` is reduced there (n,), m; fully at a
    landing."""
    places = [np.asarray(mark.position, float) for mark in marks if mark.on_ground]

    def less(positions: Array) -> Array:
        far = [rounded(((positions - place) ** 2).sum(axis=1)) for place in places]
        away = [wanted - landing_clearance(distance, wanted, 0.0) for distance in far]
        return np.max(away, axis=0, initial=0.0) if away else np.zeros(len(positions))

    return less


def descent(mark: Mark) -> Constraint:
    """The descent speed around a landing, as a constraint between knots; `approach.Landing` enforces it at knots."""
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
