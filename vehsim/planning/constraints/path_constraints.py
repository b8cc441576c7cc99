"""Limits and users' constraints: rows at knots or segments, and at instants between knots where they are violated.

A finished motion is measured between its knots; an instant of violation becomes a row of the problem, which is solved
again: the exchange method of semi-infinite programming (Hettich and Kortanek 1993).
"""

from __future__ import annotations

from collections.abc import Hashable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Literal

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from vehsim.clip.clip import Clip
from vehsim.clip.interpolant import spatial
from vehsim.planning.constraints.block import Block, Finding
from vehsim.planning.constraints.dynamics import bound_joints
from vehsim.planning.problem.elements import Element, NonlinearProgram, Use
from vehsim.planning.problem.layout import Layout
from vehsim.planning.problem.stage import UNKNOWN, Sloping, between_view, clip_view, evaluate, knot_view, segment_view
from vehsim.planning.problem.transcription import Transcription
from vehsim.planning.request.legs import knots_within
from vehsim.planning.request.marks import Mark
from vehsim.planning.terms import Constraint, Cost, KnotView, SegmentView, Term
from vehsim.planning.trajectory import Trajectory
from vehsim.planning.trim import swims
from vehsim.runtime.progress import Progress

Array = NDArray[np.float64]
Place = Literal["knot", "segment", "between"]

FINE = 8
"""Number of instants per frame at which a motion is measured."""
LEAST = 5
"""Minimum number of them per segment."""
END = 1e-4
"""Distance of the last instant from the end of its segment, relative to the segment's duration."""
SHARE = 0.25
"""Once one instant exceeds a constraint's slack, every instant that uses this share of it becomes a row."""
TURNED = 0.025
"""Share of its range that a joint which turns at its ends keeps free at knots: between them, snakeboards' joints went
beyond by up to 3.7 %."""
APART = 0.08
"""Minimum distance between instants of a segment, relative to its duration; a nearer instant replaces the old one."""


@dataclass(frozen=True)
class Excess:
    """The worst instant of a constraint: its law's value there, the violated bound, and the time (s)."""

    constraint: Constraint
    value: float
    bound: float
    seconds: float

    def message(self, frame: float) -> str:
        """A message in the user's terms and units."""
        shown = self.constraint.shown
        return f"{self.constraint.title} is {shown(self.value)} at frame {frame:.1f}, requested {shown(self.bound)}"


@dataclass(frozen=True, eq=False)
class PathConstraint(Block):
    """A constraint's rows: at every knot or segment of its frames, and at ``instants`` (k,) between knots.

    ``instants`` are counted in segments since the start; they are its active set.
    """

    constraint: Constraint
    marks: Sequence[Mark]
    number: int
    instants: Array = field(default_factory=lambda: np.zeros(0))
    _laws: dict[Transcription, ca.Function] = field(default_factory=dict)

    def _knots(self, layout: Layout) -> tuple[int, int]:
        """The first and last knot to which it applies."""
        return knots_within(self.marks, layout.mark_knots, self.constraint.frames)

    @property
    def _instants(self) -> str:
        """The name of the parameter for the instants' fractions of their segments."""
        return f"constraint[{self.number}].instants"

    def key(self, layout: Layout, transcription: Transcription) -> Hashable:
        active = tuple(np.floor(self.instants).astype(int).tolist())
        return self.constraint.identity or self.constraint, self._knots(layout), active

    def add(self, problem: NonlinearProgram, transcription: Transcription, layout: Layout) -> None:
        term, (first, last) = self.constraint, self._knots(layout)
        knots, segments = np.arange(first, last + 1), np.arange(first, last)
        if term.over == "segments":
            add_term(problem, transcription, layout, term, "segment", segments)
        elif term.over != "between" and accelerated(transcription, term):
            # at the start of every segment, and at the end of the last
            fractions = np.append(np.zeros(len(segments)), 1.0)[None]
            add_term(problem, transcription, layout, term, "between", np.append(segments, last - 1), fractions)
        elif term.over != "between":
            add_term(problem, transcription, layout, term, "knot", knots)

    def add_active(self, problem: NonlinearProgram, transcription: Transcription, layout: Layout) -> None:
        if len(self.instants):
            segments = np.floor(self.instants).astype(np.intp)
            place = problem.parameter(self._instants, 1, len(segments))
            add_term(problem, transcription, layout, self.constraint, "between", segments, active=place)

    def values(self, trajectory: Trajectory) -> Mapping[str, Any]:
        return {self._instants: (self.instants - np.floor(self.instants))[None]}

    def describe(self, use: Use, occurrence: int, row: int, trajectory: Trajectory) -> str:
        active = len(use.parameters) > 0  # rows between knots, of which the place is a parameter
        place = self.instants[occurrence] if active else self._knots(trajectory.layout)[0] + occurrence
        seconds = trajectory.seconds()
        frame = float(np.interp(place, np.arange(len(seconds)), seconds)) * float(trajectory.request.fps)
        return f"{self.constraint.title} at frame {frame:.0f}"

    def bound(self, trajectory: Trajectory, lower: Array, upper: Array) -> None:
        if self.constraint.joint is not None:
            ends = self.constraint.lower, self.constraint.upper
            bound_joints(trajectory, {self.constraint.joint: ends}, lower, upper)
            if np.isfinite(ends).all() and swims(trajectory.request.vehicle):
                self._turn_inside(trajectory, lower, upper)

    def _turn_inside(self, trajectory: Trajectory, lower: Array, upper: Array) -> None:
        """Narrow the bounds, in place, of a joint that turns at its ends, but at marks: between knots it swings beyond
        them."""
        term, layout = self.constraint, trajectory.layout
        knots = np.setdiff1d(np.arange(layout.knots), layout.mark_knots)
        assert term.joint is not None
        joint = trajectory.request.vehicle.joints.index(term.joint)
        rows = layout.knot(knots)[trajectory.transcription.sizes[0] + joint]
        lower[rows] += TURNED * (term.upper - term.lower) / 2
        upper[rows] -= TURNED * (term.upper - term.lower) / 2

    def prolongate(self, coarse: Trajectory, fine: Trajectory) -> PathConstraint:
        activated = self._activated(coarse)
        if coarse.layout.segments == fine.layout.segments:
            return activated
        moved = activated.instants * (fine.layout.segments / coarse.layout.segments)
        return replace(activated, instants=moved[np.abs(moved - np.round(moved)) > 1e-6])  # knots are rows anyway

    def tighten(self, trajectory: Trajectory, finding: Finding) -> PathConstraint:
        return self._activated(trajectory)

    def resume(self, earlier: PathConstraint, solved: Trajectory) -> PathConstraint:
        return replace(self, instants=earlier.instants)

    def measure(self, trajectory: Trajectory, clip: Clip, progress: Progress | None) -> Finding:
        found = self.worst(trajectory)
        if found is None:
            return Finding()
        request = trajectory.request
        frame = float(request.marks[0].frame) + found.seconds * float(request.fps)
        return Finding(met=False, message=found.message(frame))

    def worst(self, trajectory: Trajectory) -> Excess | None:
        """The worst instant at which a trajectory's clip violates the constraint by more than its slack."""
        excess, values, times = self._excess(trajectory)
        if not self._broken(excess):
            return None
        term = self.constraint
        row, k = np.unravel_index(int(excess.argmax()), excess.shape)
        value = float(values[row, k])
        low, high = (float(np.broadcast_to(bound, (len(values),))[row]) for bound in (term.lower, term.upper))
        return Excess(term, value, high if value > high else low, float(times[k]))

    def _broken(self, excess: Array) -> bool:
        return bool(excess.size and excess.max() > self.constraint.slack)

    def _activated(self, trajectory: Trajectory) -> PathConstraint:
        """The block with rows added where a trajectory's clip violates the constraint."""
        excess, _, times = self._excess(trajectory)
        if not self._broken(excess):
            return self
        first, last = self._knots(trajectory.layout)
        seconds = trajectory.seconds()
        knots = seconds - seconds[0]
        worst, places = excess.max(axis=0), list(self.instants)
        at = np.interp(times, knots, np.arange(len(knots)))
        segment = np.clip(np.floor(at).astype(int), first, last - 1)
        inside = np.abs(at - np.round(at)) > 1e-6
        for k in np.unique(segment[inside & (worst > SHARE * self.constraint.slack)]):
            here = np.flatnonzero((segment == k) & inside)
            place = float(at[here[np.argmax(worst[here])]])
            places = [other for other in places if abs(other - place) > APART or np.floor(other) != k]
            places.append(place)
        return replace(self, instants=np.sort(np.array(places)))

    def _excess(self, trajectory: Trajectory) -> tuple[Array, Array, Array]:
        """The violation (rows, n) of a constraint along a clip, its values (rows, n), and the times (n,) s."""
        term, clip = self.constraint, trajectory.clip
        first, last = self._knots(trajectory.layout)
        seconds = trajectory.seconds()
        knots = (seconds - seconds[0])[first : last + 1]
        apart = term.over not in ("everywhere", "between") or len(knots) < 2
        if apart or (term.joint is not None and _within(clip, term)):
            return np.zeros((0, 0)), np.zeros((0, 0)), np.zeros(0)
        frame = 1 / float(clip.fps)
        counts = np.maximum(np.ceil(np.diff(knots) / frame * FINE - 1e-9), LEAST).astype(int)
        steps = [np.linspace(0, 1 - END, n) for n in counts]  # to just before the next knot, where the law may jump
        spans = zip(knots[:-1], np.diff(knots), steps, strict=True)
        times = np.append(np.concatenate([a + h * share for a, h, share in spans]), knots[-1])
        transcription = trajectory.transcription
        columns = samples(transcription, clip, times)
        if transcription not in self._laws:
            self._laws[transcription] = law_of_clip(transcription, term)
        values = np.asarray(self._laws[transcription].map(len(times))(*columns)).reshape(-1, len(times))
        low, high = (
            np.broadcast_to(np.asarray(bound, float), (len(values),))[:, None] for bound in (term.lower, term.upper)
        )
        return np.maximum(values - high, low - values), values, times


def _within(clip: Clip, term: Constraint) -> bool:
    """Whether a joint keeps to its range throughout a clip, because the control points of its cubics do."""
    assert term.joint is not None
    joint = clip.vehicle.joints.index(term.joint)
    values, reach = clip.joints[:, joint], clip.joint_rates[:, joint] / 3
    h = np.diff(clip.times)
    points = np.concatenate([values, values[:-1] + h * reach[:-1], values[1:] - h * reach[1:]])
    return bool(points.min() >= term.lower - term.slack and points.max() <= term.upper + term.slack)


def accelerated(transcription: Transcription, term: Term) -> bool:
    """Whether a law of a `KnotView` uses the acceleration, which is known on a segment only."""
    v = transcription.symbols("x", "c0")
    return bool(ca.depends_on(evaluate(term, knot_view(transcription, v["x"], v["c0"])), UNKNOWN))


def add_term(
    problem: NonlinearProgram,
    transcription: Transcription,
    layout: Layout,
    term: Term,
    place: Place,
    k: NDArray[np.intp],
    fractions: Array | None = None,
    active: NDArray[np.intp] | None = None,
) -> None:
    """Add a term at knots or segments ``k`` (n,), or ``between`` the knots of segments.

    Between knots, at ``fractions`` (1, n) of the segments, or at those in the parameter with indices ``active`` (1, n).
    """
    element = term_element(transcription, term, place, len(layout.legs), active is not None)
    y = np.vstack([layout.knot(k), layout.control(k)]) if place == "knot" else layout.segment(k)
    constants = {} if fractions is None else {"fraction": fractions}
    if "passed" in element.sizes:
        starts = layout.mark_knots[:-1, None]
        constants["passed"] = np.clip(k - starts, 0, np.array(layout.legs)[:, None]).astype(float)
        y = np.vstack([y, np.tile(layout.lengths[:, None], len(k))])
    problem.add(element, y, {} if active is None else {"fraction": active}, constants)


def term_element(
    transcription: Transcription, term: Term, place: Place, legs: int, between_knots: bool = False
) -> Element:
    """A term at a place.

    The places are a ``knot`` (x, c0), a ``segment`` (x, x1, c0, c1, h), or ``between`` two knots, with the same
    variables as a segment and the ``fraction`` of it as a parameter. If its law uses the time, the durations of all
    ``legs`` are variables too, and the parameter ``passed`` (legs,) counts the segments of each leg that have
    passed.
    """
    now, lengths, passed = ca.SX.sym("t"), ca.SX.sym("lengths", legs), ca.SX.sym("passed", legs)
    parameters: dict[str, Any] = {}
    view: KnotView | SegmentView
    v = transcription.symbols(*(("x", "c0") if place == "knot" else ("x", "x1", "c0", "c1", "h")))
    sloping = Sloping(transcription)
    if place == "segment":
        view = segment_view(transcription, v, now)
        view = replace(view, start=sloping(view.start), end=sloping(view.end))
    elif place == "knot":
        view = sloping(knot_view(transcription, v["x"], v["c0"], now))
    else:
        fraction = parameters["fraction"] = ca.SX.sym("fraction")
        view = sloping(between_view(transcription, v, fraction, now + fraction * v["h"]))
    y, value = ca.vertcat(*v.values()), evaluate(term, view)
    slopes = sloping.of(value)
    if ca.depends_on(value, now):
        value, y = ca.substitute(value, now, ca.dot(lengths, passed)), ca.vertcat(y, lengths)
        parameters["passed"] = passed
    if isinstance(term, Cost):
        return Element(term.name, y, parameters, f=term.weight * value, **slopes)
    name = f"{term.name} between knots" if between_knots else term.name
    return Element(name, y, parameters, g=value, lower=term.lower, upper=term.upper, **slopes)


def law_of_clip(transcription: Transcription, term: Constraint) -> ca.Function:
    """A constraint's law as a function of a clip's `samples`."""
    v = transcription.vehicle
    sizes = {"pose": 7, "twist": v.group.dim, "acceleration": 3, "r": len(v.joints), "u": len(v.joints)}
    sizes |= {"c": len(v.controls), "t": 1, "slope": 2, "lift": 1}
    given = [ca.SX.sym(name, size) for name, size in sizes.items()]
    return ca.Function("law", given, [evaluate(term, clip_view(v, *given))])


def samples(transcription: Transcription, clip: Clip, times: Array) -> list[Array]:
    """The arguments of `stage.clip_view`, columns (k, n) at ``times`` (n,) s."""
    motion = clip.at(times)
    _, velocity = spatial(clip)
    k = np.clip(np.searchsorted(clip.times, times, side="right") - 1, 0, len(clip) - 2)
    h = np.diff(clip.times)[k, None]
    slope, share = 6 * np.diff(clip.positions, axis=0)[k] / h, (times - clip.times[k])[:, None] / h
    first, last = slope - 4 * velocity[k] - 2 * velocity[k + 1], 2 * velocity[k] + 4 * velocity[k + 1] - slope
    acceleration = (first + share * (last - first)) / h
    pose = np.hstack([motion.positions, motion.orientations])
    slopes, lifts = transcription.followed(motion.positions, spatial(motion)[1])
    kept = (pose, motion.twists, acceleration, motion.joints, motion.joint_rates, motion.controls)
    return [column.T for column in (*kept, times[:, None], slopes, lifts[:, None])]
