"""Fallbacks after the first solve fails: fewer requirements, more segments, other initial guesses."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from vehsim.planning.constraints.clearance import Clearance
from vehsim.planning.constraints.obstacle_clearance import ObstacleClearance
from vehsim.planning.constraints.timing import whole_frames
from vehsim.planning.explain.elastic import diagnose, too_early
from vehsim.planning.guesses.drive import drive
from vehsim.planning.guesses.pace import fewest_segments
from vehsim.planning.guesses.routes import InitialGuess, around, backwards, shunting
from vehsim.planning.iterate import Iterate, Run
from vehsim.planning.problem.solver import Patience
from vehsim.planning.refine import on_frames
from vehsim.planning.request.landing import landings
from vehsim.planning.request.legs import bent, divided, legs_between, path_length, placed_marks
from vehsim.planning.request.request import MOST_SEGMENTS, Request
from vehsim.planning.solve import begin, solve

Array = NDArray[np.float64]

RETRIES = ((1.7, 0.0), (0.6, 0.08), (1.2, -0.15))
"""Initial guesses to try when the first fails: factor on the duration of free legs, and how far each path is bent
sideways, relative to its length."""
MEASURED = 4
"""Maximum number of times that the distances of the vehicle's surface are measured before a motion is found."""
WAITS, GLANCE = (1.0, 1.3, 1.7), Patience(60, early=0.5)
"""Factors on the durations of the last free legs of a motion that meets moving obstacles at other times than its guess,
and how long each of these is solved."""
FEWEST, LEAST = 4, 16
"""Below `FEWEST` segments, a leg has fewer controls than two marks at rest need; a plan that fails on so few per leg is
tried on `LEAST` per leg."""


def enough_segments(request: Request) -> int:
    """The least number of segments for a plan of these marks."""
    few = LEAST * (len(request.marks) - 1) if request.segments < FEWEST else 0
    length = sum(map(path_length, map(np.array, legs_between(request.stops))))
    return min(max(few, fewest_segments(request.vehicle, length)), MOST_SEGMENTS)


def in_narrow_places(run: Run, failed: Iterate, guess: InitialGuess) -> Iterate:
    """The iterate solved with the surface of the vehicle instead of the spheres around it, or the failed one.

    The distances of both are measured along the guess, then along each solution, since they hold near the poses at
    which they were measured. What is found is certified like any motion. Landings have their own allowance.
    """
    if failed.cover is None or failed.cover.static is None or landings(failed.request.marks):
        return failed
    iterate: Iterate = begin(run, failed.request, failed.transcription, failed.cover, guess.paths, guess.clip)
    for _ in range(MEASURED):
        if run.deadline.late:
            break
        iterate = solve(run, by_surface(iterate))
        if iterate.success:
            return iterate
    return failed


def by_surface(iterate: Iterate) -> Iterate:
    """The iterate with the surface of the vehicle, measured along it, instead of the spheres around it."""
    blocks = tuple(b.of_surface(iterate) if isinstance(b, Clearance) else b for b in iterate.blocks)
    return replace(iterate, blocks=blocks, multipliers=None)


def at_their_times(run: Run, timed: Iterate) -> Iterate:
    """A motion with free legs among moving obstacles, solved with its free marks on whole frames; unchanged if that
    fails or nothing moves.

    While legs are free, moving obstacles stand where they are at the times of the initial guess. If the durations
    change much, the motion meets them at other times: then it is paced anew, with more time if necessary.
    """
    obstacles, request, timing = timed.block(ObstacleClearance), timed.request, timed.timing
    free = timed.success and timing.open and np.any(timing.free)
    if not free or obstacles is None or not any(obstacle.moves for obstacle, _ in obstacles.parts):
        return timed
    settled = solve(run, on_frames(timed), GLANCE)
    last = max(i for i, mark in enumerate(request.marks) if mark.given_frame is not None)
    later = np.arange(len(timed.layout.legs)) >= last  # the others have to end at a given frame
    for wait in WAITS if later.any() else WAITS[:1]:
        if settled.success or run.deadline.late:
            break
        seconds = np.where(later, wait, 1.0) * timed.lengths * np.array(timed.layout.legs)
        durations = whole_frames(seconds, request.marks, request.fps)
        frames = int(request.marks[0].frame) + np.rint(np.cumsum(durations) * float(request.fps)).astype(int)
        marks = [replace(mark, frame=int(frame)) for mark, frame in zip(request.marks[1:], frames, strict=True)]
        given = replace(request, marks=[request.marks[0], *marks])
        guess = begin(run, given, timed.transcription, timed.cover, _driven(given, obstacles))
        settled = solve(run, replace(guess, request=request).with_timing(timing.settled()), GLANCE)
    return settled if settled.success else timed


def with_fewer_requirements(run: Run, iterate: Iterate, request: Request, guess: InitialGuess) -> tuple[Run, Iterate]:
    """The iterate solved without the usual poses at marks at rest, and with more segments if there are few.

    Returns the last iterate that was tried; it may have failed.
    """
    legs, few, posed = len(request.marks) - 1, request.segments, bool(iterate.request.given)
    enough = LEAST * legs if few <= FEWEST * legs else few
    tries = [(few, "")] if posed else []
    tries += [(enough, f"; with {enough} segments, because {few} are too few")] if enough > few else []
    for segments, remark in tries:
        if run.deadline.late:
            break
        less = unposed(iterate.request)
        changed = replace(request, segments=segments)
        run = Run(changed, run.progress)
        again = begin(run, changed, iterate.transcription, iterate.cover, guess.paths, guess.clip)
        iterate = solve(run, again)
        if iterate.success:
            iterate = replace(iterate, remark=less + remark)
            break
    return run, iterate


def unposed(request: Request) -> str:
    """What is said of a motion without the usual poses at marks at rest."""
    if not request.given:
        return ""
    turned = any(mark.heading != before.heading for mark, before in zip(request.marks, request.given, strict=True))
    what = "headings at rest do not point along the path" if turned else "trailers do not stand straight at rest"
    return f"; {what}: no such motion was found"


def from_other_guesses(
    run: Run, failed: Iterate, guess: InitialGuess, untried: Iterate | None = None, *, brief: bool = False
) -> Iterate:
    """The iterate solved from other initial guesses, or the failed one with the reason.

    A flight through a narrow place tries the way around it. A vehicle that drives nose first tries to reverse, then to
    change its direction on the way. Then, in free space, a relaxed problem finds out whether the marks can be met
    together at all. Near obstacles this comes last, since relaxed problems take longer there.

    ``untried``: the first guess in its character, if only its stunt was tried: it comes after the other guesses;
    ``brief``: look for no reason, as less is asked of the motion afterwards.
    """
    iterate = failed
    for other in (around, backwards, shunting) if not guess.given else ():
        if iterate.success or run.deadline.late:
            return iterate
        if driven := other(iterate.request, guess.paths):
            iterate = solve(run, _again(run, failed, InitialGuess(driven)))
    if iterate.success:
        return iterate
    if not (failed.blocked or brief or run.deadline.late):
        iterate = _diagnosed(run, failed, guess)
    for wariness, (stretch, bend) in enumerate(RETRIES, 1):
        if iterate.success or iterate.why or run.deadline.late:
            return iterate
        others = InitialGuess(_other_paths(iterate, guess, wariness, stretch, bend))
        iterate = solve(run, _again(run, iterate, others, stretch=stretch))
    if iterate.success or iterate.why or brief or run.deadline.late:
        return iterate
    last = iterate if untried is None else solve(run, untried)
    if last.success:
        return last
    if failed.blocked:
        last = _diagnosed(run, iterate, guess)
        if last.success:
            return last
    first = _again(run, last, guess)
    return replace(iterate, why=last.why or too_early(run, first))


def _diagnosed(run: Run, failed: Iterate, guess: InitialGuess) -> Iterate:
    """The iterate solved from a motion that meets all marks if a relaxed problem finds one, else failed, with the
    reason."""
    first = _again(run, failed, guess)
    why, near = diagnose(run, first)
    return replace(failed, why=why) if near is None else solve(run, replace(first, x=near))


def _again(run: Run, iterate: Iterate, guess: InitialGuess, stretch: float = 1.0) -> Iterate:
    """Another initial guess for the same request; active sets are kept."""
    request, transcription, blocks = iterate.request, iterate.transcription, iterate.blocks
    return begin(run, request, transcription, iterate.cover, guess.paths, guess.clip, stretch=stretch, blocks=blocks)


def _other_paths(iterate: Iterate, guess: InitialGuess, wariness: int, stretch: float, bend: float) -> Sequence[Array]:
    """Paths bent sideways, or near obstacles paths with a wider berth; given paths are not changed there."""
    request, obstacles = iterate.request, iterate.block(ObstacleClearance)
    if obstacles is None:
        return [bent(path, bend) for path in guess.paths]
    if guess.given:
        return guess.paths
    return _driven(request, obstacles, wariness, stretch)


def _driven(request: Request, obstacles: ObstacleClearance, wariness: int = 0, stretch: float = 1.0) -> list[Array]:
    """A path among obstacles for every leg, as `drive` finds them between marks with positions."""
    kept = [request.stops[i] for i in placed_marks(request.stops)]
    return divided(drive(replace(request, marks=kept), obstacles.parts, wariness, stretch), request.stops)
