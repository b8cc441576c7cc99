"""How long every leg takes: frames of marks, and marks at free frames, from the solver to whole frames."""

from __future__ import annotations

import math
from collections.abc import Hashable, Mapping, Sequence
from dataclasses import dataclass, replace
from fractions import Fraction
from itertools import pairwise
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from vehsim.errors import InputError
from vehsim.planning.constraints.block import Block
from vehsim.planning.problem.elements import Element, NonlinearProgram
from vehsim.planning.problem.layout import Layout
from vehsim.planning.problem.transcription import Transcription
from vehsim.planning.request.marks import Mark
from vehsim.planning.trajectory import Trajectory

Array = NDArray[np.float64]

EARLY = 0.25
"""How much earlier than a motion takes a free mark may stand, in frames: most can be a little faster."""
LONGEST = 8.0
"""How much longer or shorter than guessed a leg of a free mark may become, as a factor."""


@dataclass(frozen=True, eq=False)
class Timing(Block):
    """The lengths of segments, one variable a leg. Those of legs to free marks vary while it is ``open``, and between
    two marks at frames add up to what lies between; once settled on whole frames they are fixed."""

    marks: Sequence[Mark]
    fps: Fraction
    open: bool = True

    @property
    def durations(self) -> Array:
        """How long every leg takes, s; nan where the planner chooses."""
        return fixed_durations(self.marks, self.fps)

    @property
    def free(self) -> NDArray[np.bool_]:
        """Legs whose duration the planner chooses."""
        return np.isnan(self.durations)

    @property
    def spans(self) -> list[tuple[list[int], float]]:
        """Runs of legs that have to add up, s."""
        return spans_between(self.marks, self.fps) if self.open else []

    def key(self, layout: Layout, transcription: Transcription) -> Hashable:
        return "timing", tuple(tuple(legs) for legs, _ in self.spans)

    def add(self, problem: NonlinearProgram, transcription: Transcription, layout: Layout) -> None:
        for legs, _ in self.spans:
            h, total = ca.SX.sym("h", len(legs)), ca.SX.sym("total")
            counts = ca.DM([layout.phases[leg] for leg in legs])
            element = Element("frames", h, {"total": total}, g=ca.dot(counts, h) - total)
            problem.add(element, layout.lengths[legs], {"total": problem.parameter(_duration(legs), 1)})

    def values(self, trajectory: Trajectory) -> Mapping[str, Any]:
        return {_duration(legs): total for legs, total in self.spans}

    def bound(self, trajectory: Trajectory, lower: Array, upper: Array) -> None:
        lengths, varies = trajectory.lengths, self.free & self.open
        lower[trajectory.layout.lengths] = np.where(varies, lengths / LONGEST, lengths)
        upper[trajectory.layout.lengths] = np.where(varies, lengths * LONGEST, lengths)

    def settled(self) -> Timing:
        """The same with all lengths fixed."""
        return replace(self, open=False)

    def opened(self) -> Timing:
        """The same with lengths of legs to free marks varying."""
        return replace(self, open=True)

    def on_frames(self, trajectory: Trajectory, early: float = EARLY) -> Array:
        """Segment lengths (legs,) s near a trajectory's that put free marks on whole frames, ``early`` of a frame too
        early at most."""
        segments = np.array(trajectory.layout.phases)
        return np.asarray(whole_frames(trajectory.lengths * segments, self.marks, self.fps, early) / segments)


def _duration(legs: Sequence[int]) -> str:
    return f"duration of legs {legs[0]} to {legs[-1]}"


def fixed_durations(marks: Sequence[Mark], fps: Fraction) -> Array:
    """Seconds of each leg between two marks at frames, and of holds; NaN where the planner chooses."""
    frames = [math.nan if mark.frame == "free" else float(mark.frame) for mark in marks]
    spans = [float(a.hold) if a.hold else y - x for a, x, y in zip(marks[:-1], frames[:-1], frames[1:], strict=True)]
    return np.array(spans) / float(fps)


def spans_between(marks: Sequence[Mark], fps: Fraction) -> list[tuple[list[int], float]]:
    """Runs of legs between two marks at frames with free ones between: their phases and what they add up to, s."""
    fixed = [i for i, mark in enumerate(marks) if mark.frame != "free"]
    spans = []
    for a, b in pairwise(fixed):
        if b > a + 1:
            spans.append((list(range(a, b)), float((int(marks[b].frame) - int(marks[a].frame)) / fps)))
    return spans


def share_known_spans(durations: Array, marks: Sequence[Mark], fps: Fraction) -> None:
    """Stretch the guessed durations of free legs so that they fill what lies between marks at frames."""
    free = np.isnan(fixed_durations(marks, fps))
    for phases, total in spans_between(marks, fps):
        open_ = [j for j in phases if free[j]]
        rest = total - sum(durations[j] for j in phases if not free[j])
        if rest <= 0:
            raise InputError(
                f"the holds between mark[{phases[0]}] and mark[{phases[-1] + 1}] take longer than the {total:g} s "
                "between their frames",
                "shorten them",
                key="mark",
            )
        durations[open_] *= rest / durations[open_].sum()


def whole_frames(lengths: Array, marks: Sequence[Mark], fps: Fraction, early: float = EARLY) -> Array:
    """Durations (legs,) s near ``lengths`` s that put marks on whole frames, free ones ``early`` of one at most."""
    frames, at = [0], 0.0
    for length, leave, mark in zip(lengths, marks[:-1], marks[1:], strict=True):
        at += length * float(fps)
        if mark.frame != "free":
            frames.append(int(mark.frame) - int(marks[0].frame))
        elif leave.hold:
            frames.append(frames[-1] + leave.hold)
        else:
            frames.append(max(math.ceil(at - max(early, 1e-6)), frames[-1] + 1))
    return np.diff(frames) / float(fps)
