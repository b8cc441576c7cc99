"""Why a plan failed: the same problem with room to miss marks, and with room to be late, says which and by how much."""

from __future__ import annotations

import math
import time
from dataclasses import replace
from itertools import pairwise
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from vehsim.planning.attempt import Attempt
from vehsim.planning.earliest import first_frame
from vehsim.planning.elements import Element
from vehsim.planning.legs import fixed_durations
from vehsim.planning.problem import build, variable_bounds
from vehsim.planning.request import Request
from vehsim.planning.solver import Solver

Array = NDArray[np.float64]

PRICE = 1e3
"""Cost of missing a mark by one unit, or of being late by one second: more than any effort saves."""
ITERATIONS, SECONDS = 200, 20.0
"""What either answer may take at most."""
MARGINS = (0.0, 0.01, 0.03, 0.1, 0.3)
"""Shares of the time from the first mark that are added until a plan is found at whole frames."""
NOTHING = 1e-3
"""Misses and delays below this are none, in m and s."""


def diagnose(attempt: Attempt) -> tuple[str, Array | None]:
    """Which frames are too early and what would do, and which marks are missed by how much; or, where all can be met,
    variables that meet them.

    Neither where the relaxed problem is not solved either.
    """
    missed, x = _missed(attempt)
    if x is not None and not missed:
        return "", x
    late = too_early(attempt, attempt.guess if x is None else x) or _by_leg(attempt)
    return "; ".join(filter(None, (late, missed))), None


def _missed(attempt: Attempt) -> tuple[str, Array | None]:
    problem = build(attempt.t, attempt.layout, attempt.request, attempt.cover, give=PRICE)
    x, solved = _solve(attempt, problem, late=False, start=attempt.guess)
    if x is None or not solved:
        return "", None
    first, misses = attempt.layout.size, []
    for use in problem.uses:
        rows = use.rows
        if use.variables.max() < first:
            continue
        slack, labels = x[use.variables[-2 * rows :, 0]], np.array(use.element.labels)
        by = np.abs(slack[:rows] - slack[rows:])
        for label in dict.fromkeys(use.element.labels):
            off = by[labels == label]
            if off.max() > NOTHING:
                misses.append((float(np.linalg.norm(off)), _miss(label, off)))
    misses.sort(reverse=True)
    return "; ".join(text for _, text in misses[:3]), x[:first]


def _miss(label: str, off: Array) -> str:
    name, _, key = label.rpartition(".")
    if key == "velocity (balance)":
        return f"{name}: it cannot stand in balance there"
    return f"{label} is missed by {_amount(label, off)}"


def _amount(label: str, off: Array) -> str:
    """How much is missed, in the mark's own unit, by what its rows in `asked.py` are off."""
    norm, key = float(np.linalg.norm(off)), label.rpartition(".")[2]
    if key == "heading":  # its sine, and what its cosine is below zero
        cosine = -off[1] if off[1] > 0 else math.sqrt(max(0.0, 1 - off[0] ** 2))
        return f"{math.degrees(math.atan2(off[0], cosine)):.3g} deg"
    if key == "orientation":
        return f"{math.degrees(2 * math.asin(min(1.0, norm))):.3g} deg"
    return f"{norm:.3g}{_UNITS.get(key, '')}"


_UNITS = {"position": " m", "velocity": " m/s", "speed": " m/s"}


def too_early(attempt: Attempt, near: Array) -> str:
    """The first mark that can only be later, found from a motion that misses marks, and when it can; empty where none
    is found."""
    layout, request = attempt.layout, attempt.request
    fixed = fixed_durations(request.marks, request.fps)
    held = np.array([mark.hold > 0 for mark in request.marks[:-1]])
    asked = np.isfinite(fixed) & ~held
    if not np.any(asked):
        return ""
    problem = build(attempt.t, layout, request, attempt.cover)
    h = ca.SX.sym("h", len(fixed))
    counts = np.array(layout.phases)
    delay = ca.dot(ca.DM(asked.astype(float)), ca.DM(counts.astype(float)) * h - ca.DM(np.nan_to_num(fixed)))
    problem.add(Element("late", h, ca.SX(0, 1), f=PRICE * delay), layout.lengths)
    x, _ = _solve(attempt, problem, late=True, start=near)
    if x is None:
        return ""
    arrivals: Array = np.cumsum(x[layout.lengths] * counts) * float(request.fps) + int(request.marks[0].frame)
    late = {
        i: math.ceil(frame - 1e-3)
        for i, (mark, frame) in enumerate(zip(request.marks[1:], arrivals, strict=True), 1)
        if mark.frame != "free" and frame > int(mark.frame) + NOTHING * float(request.fps)
    }
    return _earliest(attempt, min(late), late) if late else ""


def _is_met(attempt: Attempt, frames: dict[int, int]) -> bool:
    """Whether a motion is found where marks stand at other ``frames``, from the first guess that a plan begins with."""
    marks = [replace(m, frame=frames.get(i, m.frame)) for i, m in enumerate(attempt.request.marks)]
    other = Attempt(replace(attempt.request, marks=marks, deadline=math.inf), attempt.t, attempt.cover, None)
    other.start(attempt.paths)
    other.deadline.end = min(attempt.deadline.end, time.monotonic() + SECONDS)
    other.solve()
    return other.solution.success


def _by_leg(attempt: Attempt) -> str:
    """The first mark that is too early for the way from the one before it alone."""
    marks = attempt.request.marks
    known = [i for i, mark in enumerate(marks) if mark.frame != "free"]
    for i, j in pairwise(known):
        here = int(marks[j].frame)
        if marks[i].hold or attempt.deadline.late:
            continue
        found = first_frame(attempt.request, i, j, here)
        if found is not None and found[0] > here:
            frame = found[0]
            later = {k: int(marks[k].frame) + frame - here for k in known if k >= j}
            return _earliest(attempt, j, later)
    return ""


def _earliest(attempt: Attempt, i: int, frames: dict[int, int]) -> str:
    """That mark ``i`` is too early, and from when on a plan is found where it and those after it stand at ``frames``,
    or a little later."""
    marks = attempt.request.marks
    if any(term.frames is not None for term in attempt.request.terms):  # ranges of frames stay where they are
        own = marks[i].place >= 0
        where = f"{marks[i].name}.frame = {marks[i].frame}" if own else f"what is asked from {marks[i].name} on"
        return f"{where} is too early; it takes until {frames[i]} at least"
    first, early = int(marks[0].frame), f"{marks[i].name}.frame = {marks[i].frame} is too early"
    for margin in MARGINS:
        later = {k: math.ceil(frame + margin * (frame - first) - 1e-3) for k, frame in frames.items()}
        if not attempt.deadline.late and _is_met(attempt, later):
            return f"{early}; earliest {later[i]}{_then(attempt.request, i, later)}"
    return f"{early}; it takes until {frames[i]} at least"


def _then(request: Request, i: int, frames: dict[int, int]) -> str:
    """Where the marks after the late one have to go with it."""
    place = request.marks[i].place
    moved = {request.marks[k].name: frame for k, frame in frames.items() if k > i and request.marks[k].place > place}
    named = [f"{name}.frame = {frame}" for name, frame in list(moved.items())[:3]]
    return "" if not named else f", then {', '.join(named)}{' ...' if len(moved) > 3 else ''}"


def _solve(attempt: Attempt, problem: Any, late: bool, start: Array) -> tuple[Array | None, bool]:
    """The relaxed problem's variables, or None, and whether it is solved."""
    t, layout, request = attempt.t, attempt.layout, attempt.request
    problem = attempt.completed(problem)
    fixed = fixed_durations(request.marks, request.fps) / np.array(layout.phases)
    lengths = start[layout.lengths]
    most = [8 * h if late or f else h for h, f in zip(lengths, attempt.free, strict=True)]
    least = [h / 8 if f else h for h, f in zip(lengths, attempt.free, strict=True)]
    for j, mark in enumerate(request.marks[:-1]):
        if mark.hold:
            least[j] = most[j] = fixed[j]
    lower, upper = variable_bounds(t, layout, list(zip(least, most, strict=True)), request.limits.joints)
    extra = problem.size - layout.size
    lower, upper = np.append(lower, np.zeros(extra)), np.append(upper, np.full(extra, np.inf))
    values = attempt.parameters()
    deadline = min(attempt.deadline.solving, time.monotonic() + SECONDS)
    solver = Solver(problem, max_iterations=ITERATIONS)
    answer = solver.solve(np.append(start, np.ones(extra)), lower, upper, values, deadline)
    usable = answer.success or answer.violation < NOTHING
    return (answer.x if usable else None), answer.success
