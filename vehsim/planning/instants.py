"""Constraints at every instant, not at knots alone.

A finished motion is measured between its knots; an instant where it breaks a constraint becomes a row of the problem,
which is solved again: the exchange method of semi-infinite programming (Hettich and Kortanek 1993).
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from vehsim._interpolate import spatial
from vehsim.clip import Clip
from vehsim.planning.elements import Element
from vehsim.planning.layout import Layout
from vehsim.planning.terms import Constraint
from vehsim.planning.views import clip_view

if TYPE_CHECKING:
    from vehsim.planning.transcription import Transcription

Array = NDArray[np.float64]

FINE = 8
"""Instants a frame at which a motion is measured."""
LEAST = 5
"""And a segment, at least."""
END = 1e-4
"""How near to a segment's end it is measured last, of its length."""
SHARE = 0.25
"""An instant is asked where this share of a constraint's slack is used up, once another uses more than all of it."""
APART = 0.08
"""Instants of a segment are as far apart as this, of its length; a nearer one moves."""


@dataclass(frozen=True)
class Excess:
    """The worst instant of a constraint: its law's value there, the bound it passes, when (s), and by how much of its
    slack."""

    constraint: Constraint
    value: float
    bound: float
    seconds: float
    slacks: float

    def said(self, frame: float) -> str:
        """In the user's words and units."""
        shown = self.constraint.shown
        return f"{self.constraint.said} is {shown(self.value)} at frame {frame:.1f}, {shown(self.bound)} was asked for"


@dataclass(eq=False)
class Instants:
    """Where between knots constraints are rows of the problem.

    ``places``: of every constraint its instants (k,), in segments since the start, of so many ``segments``.
    """

    t: Transcription
    constraints: Sequence[Constraint]
    segments: int = 0
    places: list[Array] = field(default_factory=list)
    _laws: dict[int, ca.Function] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self.places = self.places or [np.zeros(0) for _ in self.constraints]

    @property
    def key(self) -> Any:
        """Equal for problems that differ in parameters alone."""
        return tuple(tuple(np.floor(at).astype(int).tolist()) for at in self.places)

    def settle(self, layout: Layout) -> None:
        """The same instants on another discretisation; those that are knots of it are rows anyway."""
        if self.segments and self.segments != layout.segments:
            moved = [at * (layout.segments / self.segments) for at in self.places]
            self.places = [at[np.abs(at - np.round(at)) > 1e-6] for at in moved]
        self.segments = layout.segments

    def elements(self, layout: Layout) -> Iterator[tuple[Element, bool, NDArray[np.intp]]]:
        """Of every constraint asked anywhere its element, whether that asks for the time, and the segments."""
        for term, at in zip(self.constraints, self.places, strict=True):
            if len(at):
                element, timed = self.t.term(term, "between", len(layout.phases))
                element.name = f"{term.name} between knots"
                yield element, timed, np.floor(at).astype(np.intp)

    def values(self) -> Array:
        """The parameters of the elements, one after the other: fractions of a segment."""
        return np.concatenate([np.zeros(0), *(at - np.floor(at) for at in self.places)])

    def measure(self, clip: Clip, knots: Array, spans: Sequence[tuple[int, int]]) -> list[Excess]:
        """The worst instants of the constraints that a clip breaks by more than their slack; ``knots`` (n,) s, and the
        first and last of them that each constraint is about."""
        return [
            found
            for number, span in enumerate(spans)
            if (found := self._worst(number, clip, knots[span[0] : span[1] + 1]))
        ]

    def _worst(self, number: int, clip: Clip, knots: Array) -> Excess | None:
        excess, values, times = self._excess(number, clip, knots)
        term = self.constraints[number]
        if not excess.size or excess.max() <= term.slack:
            return None
        row, k = np.unravel_index(int(excess.argmax()), excess.shape)
        value = float(values[row, k])
        low, high = (float(np.broadcast_to(bound, (len(values),))[row]) for bound in (term.lower, term.upper))
        bound = high if value > high else low
        return Excess(term, value, bound, float(times[k]), float(excess.max() / term.slack))

    def see(self, clip: Clip, knots: Array, spans: Sequence[tuple[int, int]]) -> None:
        """Ask the constraints that the clip breaks where it does."""
        for number, (first, last) in enumerate(spans):
            if self._worst(number, clip, knots[first : last + 1]) is not None:
                self._see(number, clip, knots, first, last)

    def _see(self, number: int, clip: Clip, knots: Array, first: int, last: int) -> None:
        excess, _, times = self._excess(number, clip, knots[first : last + 1])
        worst, places = excess.max(axis=0), list(self.places[number])
        at = np.interp(times, knots, np.arange(len(knots)))
        segment = np.clip(np.floor(at).astype(int), first, last - 1)
        inside = np.abs(at - np.round(at)) > 1e-6
        for k in np.unique(segment[inside & (worst > SHARE * self.constraints[number].slack)]):
            here = np.flatnonzero((segment == k) & inside)
            place = float(at[here[np.argmax(worst[here])]])
            places = [other for other in places if abs(other - place) > APART or np.floor(other) != k]
            places.append(place)
        self.places[number] = np.sort(np.array(places))

    def _excess(self, number: int, clip: Clip, knots: Array) -> tuple[Array, Array, Array]:
        """By how much a constraint is broken (rows, n), its values (rows, n), and at which times (n,) s."""
        term = self.constraints[number]
        if term.over not in ("everywhere", "between") or len(knots) < 2:
            return np.zeros((0, 0)), np.zeros((0, 0)), np.zeros(0)
        frame = 1 / float(clip.fps)
        counts = np.maximum(np.ceil(np.diff(knots) / frame * FINE - 1e-9), LEAST).astype(int)
        steps = [np.linspace(0, 1 - END, n) for n in counts]  # to just before the next knot, where a jump may be
        spans = zip(knots[:-1], np.diff(knots), steps, strict=True)
        times = np.append(np.concatenate([a + h * share for a, h, share in spans]), knots[-1])
        columns = samples(clip, times)
        values = np.asarray(self._law(number).map(len(times))(*columns)).reshape(-1, len(times))
        low, high = (
            np.broadcast_to(np.asarray(bound, float), (len(values),))[:, None] for bound in (term.lower, term.upper)
        )
        return np.maximum(values - high, low - values), values, times

    def _law(self, number: int) -> ca.Function:
        if number not in self._laws:
            self._laws[number] = law_of_clip(self.t, self.constraints[number])
        return self._laws[number]


def law_of_clip(t: Transcription, term: Constraint) -> ca.Function:
    """A constraint's law as a function of a clip's `samples`."""
    v = t.vehicle
    sizes = {"pose": 7, "twist": v.group.dim, "acceleration": 3, "r": len(v.joints), "u": len(v.joints)}
    sizes |= {"c": len(v.controls), "t": 1}
    given = [ca.SX.sym(name, size) for name, size in sizes.items()]
    return ca.Function("law", given, [t.law(term, clip_view(v, *given))])


def samples(clip: Clip, times: Array) -> list[Array]:
    """What `views.clip_view` takes, columns (k, n) at ``times`` (n,) s."""
    motion = clip.at(times)
    _, velocity = spatial(clip)
    k = np.clip(np.searchsorted(clip.times, times, side="right") - 1, 0, len(clip) - 2)
    h = np.diff(clip.times)[k, None]
    way, share = 6 * np.diff(clip.positions, axis=0)[k] / h, (times - clip.times[k])[:, None] / h
    first, last = way - 4 * velocity[k] - 2 * velocity[k + 1], 2 * velocity[k] + 4 * velocity[k + 1] - way
    acceleration = (first + share * (last - first)) / h
    pose = np.hstack([motion.positions, motion.orientations])
    kept = (pose, motion.twists, acceleration, motion.joints, motion.joint_rates, motion.controls, times[:, None])
    return [column.T for column in kept]
