"""The durations of legs: fixed between marks at frames, free otherwise until they are rounded to whole frames."""

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
from vehsim.planning.request.marks import Mark, given_frames
from vehsim.planning.trajectory import Trajectory

Array = NDArray[np.float64]

EARLY = 0.25
"""How much earlier than its optimal time, in frames, a free mark may be placed: most motions can be slightly faster."""
LONGEST = 8.0
"""How much longer or shorter than the guess a free leg may become, as a factor."""


@dataclass(frozen=True, eq=False)
class Timing(Block):
    """The durations of segments, one variable per leg.

    Those of legs to free marks vary while it is ``open``; between two marks at frames they add up to the time between
    them. Once free marks are on whole frames, all are fixed.
    """

    marks: Sequence[Mark]
    fps: Fraction
    open: bool = True

    @property
    def durations(self) -> Array:
        """Duration of every leg, s; nan where the planner chooses it."""
        return fixed_durations(self.marks, self.fps)

    @property
    def free(self) -> NDArray[np.bool_]:
        """Legs whose duration the planner chooses."""
        return np.isnan(self.durations)

    @property
    def spans(self) -> list[tuple[list[int], float]]:
        """Runs of legs whose durations have a given sum, s."""
        return spans_between(self.marks, self.fps) if self.open else []

    def key(self, layout: Layout, transcription: Transcription) -> Hashable:
        return "timing", tuple(tuple(legs) for legs, _ in self.spans)

    def add(self, problem: NonlinearProgram, transcription: Transcription, layout: Layout) -> None:
        for legs, _ in self.spans:
            h, total = ca.SX.sym("h", len(legs)), ca.SX.sym("total")
            counts = ca.DM([layout.legs[leg] for leg in legs])
            element = Element("frames", h, {"total": total}, g=ca.dot(counts, h) - total)
            problem.add(element, layout.lengths[legs], {"total": problem.parameter(_duration(legs), 1)})

    def values(self, trajectory: Trajectory) -> Mapping[str, Any]:
        return {_duration(legs): total for legs, total in self.spans}

    def bound(self, trajectory: Trajectory, lower: Array, upper: Array) -> None:
        lengths, varies = trajectory.lengths, self.free & self.open
        lower[trajectory.layout.lengths] = np.where(varies, lengths / LONGEST, lengths)
        upper[trajectory.layout.lengths] = np.where(varies, lengths * LONGEST, lengths)

    def settled(self) -> Timing:
        """The same block with all durations fixed."""
        return replace(self, open=False)

    def opened(self) -> Timing:
        """The same block with free durations of legs to free marks."""
        return replace(self, open=True)

    def on_frames(self, trajectory: Trajectory, early: float = EARLY) -> Array:
        """Segment durations (legs,) s near a trajectory's that put free marks on whole frames.

        A free mark is at most ``early`` of a frame too early.
        """
        segments = np.array(trajectory.layout.legs)
        return np.asarray(whole_frames(trajectory.lengths * segments, self.marks, self.fps, early) / segments)


def _duration(legs: Sequence[int]) -> str:
    return f"duration of legs {legs[0]} to {legs[-1]}"


def fixed_durations(marks: Sequence[Mark], fps: Fraction) -> Array:
    """Seconds of each leg between two marks at frames, and of holds; nan where the planner chooses."""
    frames = given_frames(marks)
    spans = [float(a.hold) if a.hold else y - x for a, x, y in zip(marks[:-1], frames[:-1], frames[1:], strict=True)]
    return np.array(spans) / float(fps)


def spans_between(marks: Sequence[Mark], fps: Fraction) -> list[tuple[list[int], float]]:
    """Runs of legs between two marks at frames with free marks between: their indices and total duration, s."""
    fixed = [i for i, mark in enumerate(marks) if mark.given_frame is not None]
    spans = []
    for a, b in pairwise(fixed):
        if b > a + 1:
            spans.append((list(range(a, b)), float((int(marks[b].frame) - int(marks[a].frame)) / fps)))
    return spans


def share_known_spans(durations: Array, marks: Sequence[Mark], fps: Fraction) -> None:
    """Scale the guessed durations of free legs so that they fill the time between marks at frames."""
    free = np.isnan(fixed_durations(marks, fps))
    for legs, total in spans_between(marks, fps):
        open_ = [j for j in legs if free[j]]
        rest = total - sum(durations[j] for j in legs if not free[j])
        if rest <= 0:
            raise InputError(
                f"the holds between mark[{legs[0]}] and mark[{legs[-1] + 1}] take longer than the {total:g} s "
                "between their frames",
                "shorten them",
                key="mark",
            )
        durations[open_] *= rest / durations[open_].sum()


def whole_frames(lengths: Array, marks: Sequence[Mark], fps: Fraction, early: float = EARLY) -> Array:
    """Durations (legs,) s near ``lengths`` s that put marks on whole frames, free ones at most ``early`` of a frame
    early."""
    frames, at = [0], 0.0
    for length, leave, mark in zip(lengths, marks[:-1], marks[1:], strict=True):
        at += length * float(fps)
        if mark.given_frame is not None:
            frames.append(int(mark.given_frame) - int(marks[0].frame))
        elif leave.hold:
            frames.append(frames[-1] + leave.hold)
        else:
            frames.append(max(math.ceil(at - max(early, 1e-6)), frames[-1] + 1))
    return np.diff(frames) / float(fps)
