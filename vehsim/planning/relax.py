"""Why a plan failed: the same problem with room to miss marks, and with room to be late, says which and by how much."""

from __future__ import annotations

import math
import time
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from vehsim.planning.attempt import Attempt
from vehsim.planning.elements import Element
from vehsim.planning.legs import fixed_durations
from vehsim.planning.problem import build, variable_bounds
from vehsim.planning.solver import Solver

Array = NDArray[np.float64]

PRICE = 1e3
"""Cost of missing a mark by one unit, or of being late by one second: more than any effort saves."""
ITERATIONS, SECONDS = 200, 20.0
"""What either answer may take at most."""
NOTHING = 1e-3
"""Misses and delays below this are none, in m and s."""


def diagnose(attempt: Attempt) -> tuple[str, Array | None]:
    """Which marks cannot be met, by how much, and which frames would do; or, where all can, variables that meet them.

    Neither where the relaxed problem is not solved either.
    """
    missed, x = _missed(attempt)
    if x is None or not missed:
        return "", x
    late = too_early(attempt, x, "earliest {}")
    return f"{missed}; {late}" if late else missed, None


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
                misses.append((float(np.linalg.norm(off)), f"{label} is missed by {_amount(label, off)}"))
    misses.sort(reverse=True)
    return "; ".join(text for _, text in misses[:3]), x[:first]


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


def too_early(attempt: Attempt, near: Array, when: str = "{} would do") -> str:
    """The first mark that can only be later, found from a motion that misses marks, and ``when`` it can; empty where
    none is found."""
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
    x, solved = _solve(attempt, problem, late=True, start=near)
    if x is None or not solved:
        return ""
    arrivals = np.cumsum(x[layout.lengths] * counts) * float(request.fps) + int(request.marks[0].frame)
    for mark, frame in zip(request.marks[1:], arrivals, strict=True):
        if mark.frame != "free" and frame > int(mark.frame) + NOTHING * float(request.fps):
            return f"{mark.name}.frame = {mark.frame} is too early; {when.format(math.ceil(frame - 1e-3))}"
    return ""


def _solve(attempt: Attempt, problem: Any, late: bool, start: Array) -> tuple[Array | None, bool]:
    """The relaxed problem's variables, or None, and whether it is solved."""
    t, layout, request = attempt.t, attempt.layout, attempt.request
    if attempt.rows is not None:
        attempt.rows.add(problem, t, layout)
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
