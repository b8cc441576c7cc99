"""Measure a finished motion against everything that was requested, without knowing how it was made.

`audit` takes a `Track` of a clip or of a composed stage, and `Ask`s, and returns a `Row` for each. A plan's success,
exit codes and ``report.json`` follow from these rows, not from a solver's verdict. This room uses geometry only,
nothing of the optimiser or its constraints.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from vehsim.audit.measures import MEASURES
from vehsim.audit.scene import Scene, WorldScene
from vehsim.audit.track import PER_FRAME, Track, track_of_clip, track_of_poses
from vehsim.errors import InputError
from vehsim.vehicles.definition.quantities import in_degrees

if TYPE_CHECKING:
    from vehsim.requests import Ask

__all__ = [
    "MEASURES",
    "PER_FRAME",
    "Row",
    "Scene",
    "Track",
    "WorldScene",
    "audit",
    "missed",
    "not_shown",
    "track_of_clip",
    "track_of_poses",
]

NOWHERE = Scene()
NUMERIC = 1e-6
"""Allowance for rounding and for the tolerance of solvers, in the unit of the value."""


@dataclass(frozen=True)
class Row:
    """One ask and its measurement: ``value`` at the worst ``frame``, against ``lower`` and ``upper``, SI.

    ``met`` is None if this representation does not show the request (a joint that moves no prim of a stage).
    """

    key: str
    measure: str
    value: float | None
    frame: float | None
    lower: float | None
    upper: float | None
    unit: str
    met: bool | None
    severity: Literal["error", "warning"] = "error"
    remedy: str = ""

    def as_dict(self) -> dict[str, Any]:
        """The row as JSON data."""
        return asdict(self)

    def __str__(self) -> str:
        if self.value is None:
            return f"{self.key}: not measured"
        factor, unit = in_degrees(self.unit)
        above = self.upper is not None and (self.lower is None or self.value > self.upper)
        bound, verb = (self.upper, "allowed") if above else (self.lower, "required")
        remedy = f"; {self.remedy}" if self.remedy and self.met is False else ""
        allowed = "" if bound is None else f", {bound * factor:.4g} {verb}"
        return f"{self.key}: {self.value * factor:.4g} {unit}".rstrip() + f"{allowed}, at frame {self.frame:g}{remedy}"


def audit(track: Track, asks: Iterable[Ask], scene: Scene = NOWHERE) -> list[Row]:
    """Measure a motion against ``asks``; returns a `Row` for each, in their order. ``InputError``: unknown measure."""
    return [_measured(track, ask, scene) for ask in asks]


def missed(rows: Sequence[Row]) -> list[Row]:
    """The rows because of which a motion fails."""
    return [row for row in rows if row.met is False and row.severity == "error"]


def not_shown(ask: Ask) -> Row:
    """The row of an ask that a representation does not show."""
    return Row(ask.key, ask.measure, None, None, ask.lower, ask.upper, ask.unit, None, ask.severity, ask.remedy)


def _measured(track: Track, ask: Ask, scene: Scene) -> Row:
    part = track.between(ask.first, ask.last)
    needed = ask.wanted.get("joint", "sigma" if ask.measure in ("steering", "steering_rate") else None)
    if needed is not None and needed not in part.joints:
        return not_shown(ask)
    if ask.measure not in MEASURES:
        remedy = "install the package that registers it in the entry point group vehsim.measures"
        raise InputError(f"no measure {ask.measure!r} is installed", remedy, key=ask.key)
    values = MEASURES[ask.measure](part, ask.wanted, scene)
    below, above = np.full((2, len(values)), -np.inf)
    if ask.lower is not None:
        below = ask.lower - NUMERIC - values
    if ask.upper is not None:
        above = values - ask.upper - NUMERIC
    excess = np.maximum(below, above)
    if np.isnan(excess).all():
        return not_shown(ask)
    worst = int(np.nanargmax(excess))
    met = bool(excess[worst] <= 0)
    value, frame = float(values[worst]), float(part.frames[worst])
    return Row(ask.key, ask.measure, value, frame, ask.lower, ask.upper, ask.unit, met, ask.severity, ask.remedy)
