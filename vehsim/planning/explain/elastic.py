"""Explain a failed plan: relaxed problems, in which marks may be missed or late, show which marks, and by how much."""

from __future__ import annotations

import math
from collections.abc import Hashable, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from vehsim.planning.constraints.block import Block, assemble, parameter_values, variable_bounds
from vehsim.planning.constraints.mark_constraints import MarkConstraint
from vehsim.planning.constraints.timing import Timing
from vehsim.planning.explain.earliest import first_frame
from vehsim.planning.explain.work import affordable
from vehsim.planning.iterate import Iterate, Run, Why
from vehsim.planning.problem.elements import Element, NonlinearProgram
from vehsim.planning.problem.layout import Layout
from vehsim.planning.problem.solver import Solution, Solver
from vehsim.planning.problem.transcription import Transcription
from vehsim.planning.refine import largest_error, refine, to_requested_segments
from vehsim.planning.request.character import NO_TRAITS
from vehsim.planning.request.marks import Mark
from vehsim.planning.solve import begin, solve
from vehsim.planning.trajectory import Trajectory

Array = NDArray[np.float64]

PRICE = 1e3
"""Cost of missing a mark by one unit, or of being late by one second: more than any effort it could save."""
ITERATIONS = 200
"""Maximum number of iterations for each relaxed problem."""
SLACKS = (0.0, 0.01, 0.03, 0.1, 0.3)
"""Shares of the time since the first mark that are added until a plan at whole frames is found."""
MORE_TIME = (0.1, 0.25, 0.5)
"""Shares of the time since the first mark that are added, in turn, where marks far from obstacles are missed."""
SHARES = (0.5, 0.25, 0.0)
"""Shares of the requested clearance that are tried, in turn, where marks near obstacles are missed."""
MUCH = 2.0
"""Ratio of the later time since the first mark to the given one from which obstacles may be what is in the way."""
NOTHING = 1e-3
"""Misses and delays below this count as zero, in m and s."""


@dataclass(frozen=True, eq=False)
class LooseTiming(Timing):
    """Timing in which the duration of each leg to a free mark varies by itself; with a ``price`` per second, all legs
    but holds may also take longer."""

    price: float = 0.0

    @property
    def spans(self) -> list[tuple[list[int], float]]:
        return []

    def key(self, layout: Layout, transcription: Transcription) -> Hashable:
        return "loose timing", self.price

    def add(self, problem: NonlinearProgram, transcription: Transcription, layout: Layout) -> None:
        if not self.price:
            return
        durations, counts = self.durations, np.array(layout.legs, float)
        held = np.array([mark.hold > 0 for mark in self.marks[:-1]])
        fixed = np.isfinite(durations) & ~held
        h = ca.SX.sym("h", len(durations))
        delay = ca.dot(ca.DM(fixed.astype(float)), ca.DM(counts) * h - ca.DM(np.nan_to_num(durations)))
        problem.add(Element("late", h, f=self.price * delay), layout.lengths)

    def bound(self, trajectory: Trajectory, lower: Array, upper: Array) -> None:
        super().bound(trajectory, lower, upper)
        held = np.array([mark.hold > 0 for mark in self.marks[:-1]])
        varies = (self.free | (self.price > 0)) & ~held
        upper[trajectory.layout.lengths] = np.where(varies, trajectory.lengths * 8, trajectory.lengths)


def diagnose(run: Run, guess: Iterate) -> tuple[Why, Array | None]:
    """Explain why a plan failed: the reason, and None; or an empty reason and variables that meet all marks.

    The reason names frames that are too early and possible ones, or the marks that are missed and by how much. It is
    empty, and the variables are None, if the relaxed problems are not solved either.
    """
    missed, x = _missed(run, guess)
    if x is not None and not missed:
        return Why(), x
    late = too_early(run, guess if x is None else replace(guess, x=x)) or _by_leg(run, guess)
    unknown = bool(missed) and not late
    in_the_way = unknown or (bool(missed) and _much_later(guess, late))
    clearance = _possible_clearance(run, guess) if in_the_way else None
    later = _with_more_time(run, guess) if unknown and not guess.blocked else Why()
    closer = "" if clearance is None else f"a motion was found with clearance = {clearance:g}"
    remedies = [text for text in (closer, later.text) if text] or [guess.request.loosen] * unknown
    texts = filter(None, (late.text, missed, *remedies))
    return replace(late or later, text="; ".join(texts), clearance=clearance), None


def _much_later(failed: Iterate, late: Why) -> bool:
    """Whether a mark that is too early would be met only after a multiple of its time."""
    marks = failed.request.marks
    first = int(marks[0].frame)
    given = [(mark.name, int(mark.given_frame)) for mark in marks if mark.given_frame is not None]
    return any(late.frames.get(name, 0) - first > MUCH * (frame - first) for name, frame in given)


def _possible_clearance(run: Run, failed: Iterate) -> float | None:
    """A smaller clearance, m, with which a motion was found along the same paths; None if none was, or nothing is
    near."""
    request = failed.request
    for share in SHARES if failed.blocked and request.clearance > 0 else ():
        if run.deadline.late:
            return None
        closer = replace(request, clearance=float(f"{share * request.clearance:.2g}"), deadline=math.inf)
        closer = replace(
            closer, max_iterations=affordable(failed.layout.size, request.max_iterations), traits=NO_TRAITS
        )
        other = Run(closer)
        guess = begin(other, closer, failed.transcription, failed.cover, failed.paths)
        other.deadline.end = run.deadline.end
        if solve(other, guess).success:
            return closer.clearance
    return None


def _with_more_time(run: Run, failed: Iterate) -> Why:
    """Later frames of all marks with which a motion was found; empty if none was. For motion that no relaxed problem
    shows to be too early, such as a slide."""
    marks = failed.request.marks
    given = {i: int(mark.frame) for i, mark in enumerate(marks) if not i or mark.given_frame is not None}
    if len(given) == 1 or any(term.frames is not None for term in failed.request.terms):
        return Why()
    for share in MORE_TIME:
        moved = dict[int, int]()
        for i, frame in given.items():  # a mark with a hold is two, which stay as far apart
            held = i - 1 in given and marks[i - 1].hold
            moved[i] = moved[i - 1] + frame - given[i - 1] if held else math.ceil(frame + share * (frame - given[0]))
        later = {i: frame for i, frame in moved.items() if frame != given[i]}
        if not run.deadline.late and _is_met(run, failed, later):
            at = _by_name(marks, later)
            frames = [f"{name}.frame = {frame}" for name, frame in at.items()]
            return Why(f"a motion was found with {frames[0]}{_then(frames[1:])}", at)
    return Why()


def _missed(run: Run, guess: Iterate) -> tuple[str, Array | None]:
    """Which marks are missed in elastic mode and by how much, and the variables; None if it is not solved."""
    loose = _loosened(guess.blocks, 0.0)
    blocks = [replace(b, price=PRICE) if isinstance(b, MarkConstraint) and b.number else b for b in loose]
    problem = assemble(guess.transcription, guess.layout, blocks)
    answer = _solved(run, guess, problem, blocks)
    if not answer.success:
        return "", None
    x, misses = answer.x, []
    for use in problem.uses:
        block, rows = blocks[use.owner], use.rows
        if not (isinstance(block, MarkConstraint) and block.price):
            continue
        slack, labels = x[use.variables[-2 * rows :, 0]], np.array(use.element.labels)
        by = np.abs(slack[:rows] - slack[rows:])
        for label in dict.fromkeys(use.element.labels):
            off = by[labels == label]
            if off.max() > NOTHING:
                misses.append((float(np.linalg.norm(off)), block.missed(label, off)))
    misses.sort(reverse=True)
    return "; ".join(text for _, text in misses[:3]), x[: guess.layout.size]


def _loosened(blocks: Sequence[Block], price: float) -> list[Block]:
    """The blocks with timing that may be late at a price; at price zero without delays."""
    return [LooseTiming(b.marks, b.fps, price=price) if isinstance(b, Timing) else b for b in blocks]


def too_early(run: Run, near: Iterate) -> Why:
    """The first mark that can only be met later, and when; empty if none is found.

    ``near``: a motion that misses marks.
    """
    request, layout = near.request, near.layout
    held = np.array([mark.hold > 0 for mark in request.marks[:-1]])
    if not np.any(~near.timing.free & ~held):
        return Why()
    blocks = _loosened(near.blocks, PRICE)
    answer = _solved(run, near, assemble(near.transcription, layout, blocks), blocks)
    if not (answer.success or answer.violation < NOTHING):
        return Why()
    durations = answer.x[layout.lengths] * np.array(layout.legs)
    arrivals: Array = np.cumsum(durations) * float(request.fps) + int(request.marks[0].frame)
    late = {
        i: math.ceil(frame - 1e-3)
        for i, (mark, frame) in enumerate(zip(request.marks[1:], arrivals, strict=True), 1)
        if mark.given_frame is not None and frame > int(mark.given_frame) + NOTHING * float(request.fps)
    }
    return _earliest(run, near, min(late), late) if late else Why()


def _is_met(run: Run, guess: Iterate, frames: dict[int, int]) -> bool:
    """Whether a motion is found with marks at other ``frames``, from the initial paths of the plan."""
    marks = [replace(m, frame=frames.get(i, m.frame)) for i, m in enumerate(guess.request.marks)]
    request = replace(guess.request, marks=marks, deadline=math.inf)
    request = replace(request, max_iterations=affordable(guess.layout.size, request.max_iterations))
    other = Run(request)
    iterate = begin(other, request, guess.transcription, guess.cover, guess.paths)
    other.deadline.end = run.deadline.end
    solved = solve(other, iterate)
    if solved.success and math.isfinite(request.vehicle.largest_step):  # controls may not repeat a slide
        solved = refine(other, to_requested_segments(other, solved))
        return solved.success and solved.executed.final <= largest_error(request)
    return solved.success


def _by_leg(run: Run, guess: Iterate) -> Why:
    """The first mark that is too early for its own leg."""
    request, marks = guess.request, guess.request.marks
    known = [i for i, mark in enumerate(marks) if mark.given_frame is not None]
    placed = [i for i in known if marks[i].position is not None]
    for i, j in pairwise(placed):
        here = int(marks[j].frame)
        if marks[i].hold or run.deadline.late:
            continue
        found = first_frame(request, i, j, here)
        if found is not None and found > here:
            later = {k: int(marks[k].frame) + found - here for k in known if k >= j}
            return _earliest(run, guess, j, later)
    return Why()


def _earliest(run: Run, guess: Iterate, i: int, frames: dict[int, int]) -> Why:
    """The reason that mark ``i`` is too early, and a frame for which a plan is found.

    The marks from ``i`` on are tried at ``frames``, or a little later.
    """
    request, marks = guess.request, guess.request.marks
    if any(term.frames is not None for term in request.terms):  # ranges of frames cannot move
        own = marks[i].place >= 0
        where = f"{marks[i].name}.frame = {marks[i].frame}" if own else f"{marks[i].name} (an end of a range of frames)"
        return Why(f"{where} is too early; {_not_before(frames[i])}")
    first, early = int(marks[0].frame), f"{marks[i].name}.frame = {marks[i].frame} is too early"
    for margin in SLACKS:
        later = {k: math.ceil(frame + margin * (frame - first) - 1e-3) for k, frame in frames.items()}
        if not run.deadline.late and _is_met(run, guess, later):
            at = _by_name(marks, later)
            return Why(f"{early}; use {later[i]}{_then([f'{name}.frame = {at[name]}' for name in at][1:])}", at)
    return Why(f"{early}; {_not_before(frames[i])}")


def _not_before(frame: int) -> str:
    """The remedy where no plan was found at a ``frame`` that a relaxed problem leads to."""
    return f"the fastest motion found takes until {frame}; give that frame or a later one"


def _by_name(marks: Sequence[Mark], frames: dict[int, int]) -> dict[str, int]:
    """Frames of ``marks`` by their names; a mark with a hold is two of the same name, of which the first counts."""
    at = dict[str, int]()
    for i, frame in frames.items():
        at.setdefault(marks[i].name, frame)
    return at


def _then(others: Sequence[str]) -> str:
    """The frames of the marks that have to move with the late one."""
    return "" if not others else f", then {', '.join(others[:3])}{' ...' if len(others) > 3 else ''}"


def _solved(run: Run, start: Iterate, problem: NonlinearProgram, blocks: Sequence[Block]) -> Solution:
    """The solution of a relaxed problem from a start with all its slack variables at one."""
    extra = problem.size - start.layout.size
    lower, upper = variable_bounds(start, blocks)
    lower, upper = np.append(lower, np.zeros(extra)), np.append(upper, np.full(extra, np.inf))
    values = parameter_values(problem, start, blocks)
    solver = Solver(problem, max_iterations=affordable(problem.size, ITERATIONS))
    return solver.solve(np.append(start.x, np.ones(extra)), lower, upper, values, run.deadline.solving)
