"""What is tried when a plan's first solve fails: fewer demands, more segments, other initial guesses."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vehsim.clip.clip import Clip
from vehsim.planning.constraints.obstacle_clearance import ObstacleClearance
from vehsim.planning.explain.elastic import diagnose, too_early
from vehsim.planning.guesses.drive import drive
from vehsim.planning.guesses.routes import as_clip
from vehsim.planning.iterate import Iterate, Run
from vehsim.planning.request.legs import bent, divided, placed_marks
from vehsim.planning.request.request import Request
from vehsim.planning.solve import begin, solve

Array = NDArray[np.float64]

RETRIES = ((1.7, 0.0), (0.6, 0.08), (1.2, -0.15))
"""Initial guesses tried when the first fails: durations of free legs times, and how far each path bends aside, of its
length."""
FEWEST, LEAST = 4, 16
"""Fewer segments have fewer controls than two marks at rest ask for; and segments a leg that are tried instead of so
few a leg on which a plan fails."""


def as_asked(run: Run, iterate: Iterate, request: Request, paths: Sequence[Array], guess: Any) -> tuple[Run, Iterate]:
    """The iterate, or one solved with fewer demands: marks at rest not turned along their legs, and more segments where
    there are few."""
    legs, few, turned = len(request.marks) - 1, request.segments, bool(iterate.request.given)
    enough = LEAST * legs if few <= FEWEST * legs else few
    tries = [(few, "")] if turned else []
    tries += [(enough, f"; on {enough} segments: {few} are too few")] if enough > few else []
    for segments, remark in tries:
        if run.deadline.late:
            break
        unturned = "; nothing faces along its leg: there was no such motion" if iterate.request.given else ""
        asked = replace(request, segments=segments)
        run = Run(asked, run.progress)
        again = begin(run, asked, iterate.transcription, iterate.cover, paths, as_clip(request, guess))
        iterate = solve(run, again)
        if iterate.success:
            iterate = replace(iterate, remark=unturned + remark)
            break
    return run, iterate


def from_other_guesses(run: Run, failed: Iterate, paths: Sequence[Array], guess: Any) -> Iterate:
    """Solved from other initial guesses, or failed, with the reason why.

    In free space, find out first whether the marks can be met together at all; among obstacles last, since relaxed
    problems take longer there.
    """
    iterate = failed
    if not failed.blocked and not run.deadline.late:
        iterate = _diagnosed(run, failed, paths, guess)
    for wariness, (stretch, bend) in enumerate(RETRIES, 1):
        if iterate.success or iterate.why or run.deadline.late:
            return iterate
        others = _other_paths(iterate, paths, guess, wariness, bend)
        iterate = solve(run, _again(run, iterate, others, stretch=stretch))
    if iterate.success or iterate.why or run.deadline.late:
        return iterate
    last = iterate
    if failed.blocked:
        last = _diagnosed(run, iterate, paths, guess)
        if last.success:
            return last
    first = _again(run, last, paths, as_clip(iterate.request, guess))
    return replace(iterate, why=last.why or too_early(run, first))


def _diagnosed(run: Run, failed: Iterate, paths: Sequence[Array], guess: Any) -> Iterate:
    """Solved from a motion that meets all marks where a relaxed problem finds one, or failed, with the reason why."""
    first = _again(run, failed, paths, as_clip(failed.request, guess))
    why, near = diagnose(run, first)
    return replace(failed, why=why) if near is None else solve(run, replace(first, x=near))


def _again(
    run: Run, iterate: Iterate, paths: Sequence[Array], clip: Clip | None = None, stretch: float = 1.0
) -> Iterate:
    """Another initial guess at the same request; what was active stays active."""
    request, transcription, blocks = iterate.request, iterate.transcription, iterate.blocks
    return begin(run, request, transcription, iterate.cover, paths, clip, stretch=stretch, blocks=blocks)


def _other_paths(iterate: Iterate, paths: Sequence[Array], guess: Any, wariness: int, bend: float) -> Sequence[Array]:
    """Paths bent aside, or among obstacles with more room, unless a path was given."""
    request, obstacles = iterate.request, iterate.block(ObstacleClearance)
    if obstacles is None:
        return [bent(path, bend) for path in paths]
    if guess is not None:
        return paths
    kept = [request.marks[i] for i in placed_marks(request.marks)]
    return divided(drive(replace(request, marks=kept), obstacles.parts, wariness), request.marks)
