"""The first frame at which a mark can be met after the previous one: found by planning only this leg, for least
time."""

from __future__ import annotations

import math
import warnings
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from vehsim.errors import VehsimError
from vehsim.planning.explain.work import affordable
from vehsim.planning.guesses.pace import cruising
from vehsim.planning.guesses.routes import backwards, shunting
from vehsim.planning.iterate import Iterate, Run
from vehsim.planning.problem.transcription import Transcription, transcribe
from vehsim.planning.refine import execution_tolerance
from vehsim.planning.request.character import NO_TRAITS
from vehsim.planning.request.legs import facing, legs_between, path_length
from vehsim.planning.request.request import Request
from vehsim.planning.solve import begin, solve
from vehsim.planning.terms import Cost, cost_weights
from vehsim.requests.mark_frame import FREE
from vehsim.world.ground.below import aloft
from vehsim.world.world import World

Array = NDArray[np.float64]

SEGMENTS = 16
"""Segments per leg: with bang-bang controls on so few knots a motion takes slightly more than the least time, never
less."""
FINER = (1, 2, 4)
"""Factors on the number of segments (one is added, as odd numbers are not halved), tried until the controls lead where
the motion does or its duration has settled."""
SHARE, SETTLED = 0.02, 0.03
"""Tolerance of the end of the executed controls, relative to the distance; and of the change of the duration,
relative."""
STRETCHES = (1.0, 2.5, 0.5)
"""Initial guesses of the duration, as factors on a cruise, and on the lower bound of the duration."""
LONGER = 1.3
NEAR, MET, ITERATIONS = 1e-3, 1e-6, 100
"""Largest violation of a motion at a free frame and at a whole one, and maximum number of iterations: the exact optimum
is not needed."""
LATER = (0.02, 0.06, 0.15)
"""Shares of the duration that are added until a motion at a whole frame is found."""


def first_frame(request: Request, i: int, j: int, least: int) -> int | None:
    """A frame, at least ``least``, for which a motion from mark ``i`` to mark ``j`` was found; None if none was found.

    The search is in empty space, with the ground's slopes, the wind, the marks between, and the limits that always
    apply. It is local: a faster motion may exist.
    """
    if request.marks[i].position is None or request.marks[j].position is None:
        return None
    wind = request.wind
    marks = [*request.marks[i:j], replace(request.marks[j], frame=FREE, hold=0)]
    terms = tuple(term for term in request.terms if term.frames is None and not isinstance(term, Cost))
    quick = replace(
        request,
        marks=marks,
        world=World(wind=wind),
        weights=cost_weights({"time": 1.0, "smoothness": 1e-3, "effort": 3e-3}, {}),
        segments=SEGMENTS * (len(marks) - 1),
        clearance=0.0,
        limits=request.limits if math.isinf(request.top_speed) else request.limits.within({"speed": request.top_speed}),
        refine=False,
        max_iterations=ITERATIONS,
        terms=terms,
        loop=False,
        traits=NO_TRAITS,  # a character may be exceeded
        given=(),
    )
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            return _found(quick, request, least)
    except VehsimError:
        return None


def _found(quick: Request, request: Request, least: int) -> int | None:
    paths = [np.array(leg) for leg in legs_between(quick.marks)]
    found = _first(quick, request, least, paths)
    for other in (backwards, shunting):
        if (found is None or found > least) and (driven := other(quick, paths)):
            found = min(filter(None, (found, _first(quick, request, least, driven))), default=None)
    return found


def _first(quick: Request, request: Request, least: int, paths: list[Array]) -> int | None:
    """The first frame that is found along these paths."""
    choices, transcription = [quick.marks], transcribe(aloft(request.weighed))  # the ground below rotors costs no time
    if request.weights["course"]:
        choices.insert(0, facing(quick.marks, paths, quick.aimed))
    for marks in choices:
        before, stretches = math.inf, [_share(quick, paths, least), *STRETCHES]
        for times in FINER:
            finer = replace(quick, marks=marks, segments=times * quick.segments + 1)
            run = Run(replace(quick, deadline=math.inf))
            iterate = _quickest(run, finer, transcription, paths, stretches)
            if iterate is None:
                break
            taken = float(iterate.seconds()[-1] - iterate.seconds()[0])
            off = iterate.run_controls().final
            settled = abs(taken - before) < SETTLED * taken
            if settled or off <= max(execution_tolerance(request), SHARE * sum(path_length(path) for path in paths)):
                frame = _whole(run, iterate, least)
                if frame is not None:
                    return frame
            before = taken
    return None


def _share(quick: Request, paths: list[Array], least: int) -> float:
    """The factor on a cruise that takes slightly longer than until the frame ``least``."""
    cruise = float(cruising(quick, paths).sum())
    return max(LONGER * (least - int(quick.marks[0].frame)) / float(quick.fps) / cruise, 0.1)


def _quickest(
    run: Run, request: Request, transcription: Transcription, paths: list[Array], stretches: list[float]
) -> Iterate | None:
    """The iterate solved for least time: guesses are tried until one succeeds, and the shortest valid motion counts."""
    best: tuple[float, float, Iterate] | None = None
    for stretch in stretches:
        run.deadline.end = math.inf
        guess = begin(run, request, transcription, None, paths, stretch=stretch)
        run.deadline.end = request.deadline
        finite = replace(request, max_iterations=affordable(guess.layout.size, request.max_iterations))
        iterate = solve(run, replace(guess, request=finite))
        taken = float((iterate.lengths * iterate.layout.legs).sum())
        if _violation(iterate) < NEAR and (best is None or taken < best[0]):
            best = taken, stretch, iterate
        if iterate.success:
            break
    if best is None:
        return None
    stretches.sort(key=lambda one: one != best[1])
    return best[2]


def _violation(iterate: Iterate) -> float:
    assert iterate.solution is not None
    return iterate.solution.violation


def _whole(run: Run, iterate: Iterate, least: int) -> int | None:
    """The first whole frame for which a motion is found, with all legs stretched by the same factor."""
    marks, fps = iterate.request.marks, float(iterate.request.fps)
    legs, lengths = np.array(iterate.layout.legs), iterate.lengths
    held = np.array([mark.hold > 0 for mark in marks[:-1]])
    standing, moving = (lengths * legs)[held].sum(), (lengths * legs)[~held].sum()
    for margin in LATER:
        frames = math.ceil((standing + (1 + margin) * moving) * fps - 1e-3)
        frame = max(least, int(marks[0].frame) + frames)
        longer = ((frame - int(marks[0].frame)) / fps - standing) / moving
        x = iterate.stretched(np.where(held, lengths, lengths * longer))
        whole = solve(run, replace(iterate, x=x).with_timing(iterate.timing.settled()))
        if _violation(whole) < MET:
            return frame
    return None
