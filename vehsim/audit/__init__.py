"""Measures a finished motion against everything that was asked of it, and knows nothing of how it was made.

`audit` takes a `Track`, of a clip or of a composed stage, and `Ask`s, and returns a `Row` for each. Whether a plan
succeeded, what a command exits with and what ``report.json`` says follow from these rows, not from a solver's word.
What belongs here is geometry; neither the optimiser nor its constraints do.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from vehsim.audit.measures import MEASURES
from vehsim.audit.scene import Scene, WorldScene
from vehsim.audit.track import PER_FRAME, Track, track_of_clip, track_of_poses

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
"""What is put down to rounding and to the tolerance of solvers, in the unit of the value."""


@dataclass(frozen=True)
class Row:
    """One ask and what was measured: ``value`` at the worst ``frame``, against ``lower`` and ``upper``, SI.

    ``met`` is None where this representation does not show what was asked (a joint that moves no prim of a stage).
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
        """The row as JSON takes it."""
        return asdict(self)

    def __str__(self) -> str:
        if self.value is None:
            return f"{self.key}: not measured"
        angle = self.unit.startswith("rad")
        factor, unit = (180 / math.pi if angle else 1.0), self.unit.replace("rad", "deg")
        above = self.upper is not None and (self.lower is None or self.value > self.upper)
        bound, verb = (self.upper, "allowed") if above else (self.lower, "asked")
        remedy = f"; {self.remedy}" if self.remedy and self.met is False else ""
        allowed = "" if bound is None else f", {bound * factor:.4g} {verb}"
        return f"{self.key}: {self.value * factor:.4g} {unit}".rstrip() + f"{allowed}, at frame {self.frame:g}{remedy}"


def audit(track: Track, asks: Iterable[Ask], scene: Scene = NOWHERE) -> list[Row]:
    """Measure a motion against ``asks``; a `Row` for each, in their order."""
    return [_measured(track, ask, scene) for ask in asks]


def missed(rows: Sequence[Row]) -> list[Row]:
    """The rows that make a motion fail."""
    return [row for row in rows if row.met is False and row.severity == "error"]


def not_shown(ask: Ask) -> Row:
    """The row of an ask that a representation says nothing about."""
    return Row(ask.key, ask.measure, None, None, ask.lower, ask.upper, ask.unit, None, ask.severity, ask.remedy)


def _measured(track: Track, ask: Ask, scene: Scene) -> Row:
    part = track.between(ask.first, ask.last)
    needed = ask.wanted.get("joint", "sigma" if ask.measure in ("steering", "steering_rate") else None)
    if needed is not None and needed not in part.joints:
        return not_shown(ask)
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
