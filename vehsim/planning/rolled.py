"""The initial guess of a car on tyres: the motion of the same car without slip, which is quick to find.

Forces of tyres are stiff where they roll and fade where they slide, so that a solver makes many steps from a path
alone. At its marks a car without slip drives nearly the same motion, unless that slides.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from vehsim.planning.constraints.actuation import Actuation
from vehsim.planning.costs import RunningCosts
from vehsim.planning.guesses.routes import InitialGuess, backwards, reversing, shunting, straight
from vehsim.planning.iterate import Iterate, Run
from vehsim.planning.problem.solver import Patience
from vehsim.planning.problem.transcription import transcribe
from vehsim.planning.refine import settle_on_frames
from vehsim.planning.request.legs import cut, legs_between
from vehsim.planning.request.request import MOST_SEGMENTS, Request
from vehsim.planning.restraint import restrain, restrained
from vehsim.planning.solve import begin, solve
from vehsim.vehicles.definition.character import STUNT
from vehsim.vehicles.definition.gripping import gripping
from vehsim.vehicles.definition.surfaces import SURFACES

Array = NDArray[np.float64]

ROLLING, SLIPPING = Patience(250), Patience(60, near=1e-2)
"""Of a solve without slip from one path, and of one with slip from there."""
SEGMENTS = 64
"""Largest number of segments of a motion without slip: with more, solves take more steps and fail more often."""
POORER = 1.25
"""Factor on the cost without slip above which a motion with slip is tried on more segments. Most cost a few hundredths
more."""
GRIP = 0.9
"""The share of the friction of its surface that a stunt without slip uses."""


def without_slip(run: Run, request: Request, guess: InitialGuess) -> Iterate | None:
    """The motion of a car on tyres without slip in its character, and as a stunt within its grip; None if none is
    found.

    Its joints and controls are those of the car, and so are its marks, limits and costs.
    """
    vehicle = gripping(request.vehicle)
    if vehicle is None or guess.clip is not None:
        return None
    same = replace(request, vehicle=vehicle, segments=min(request.segments, SEGMENTS))
    if request.traits.name == STUNT:
        same = replace(same, limits=same.limits.within({"grip": GRIP * SURFACES[vehicle.surface].friction}))
    own, transcription = Run(same, run.progress, end=run.end), transcribe(same.weighed)
    for choices in _choices(same, guess):
        if own.deadline.late:
            break
        solved = [solve(own, begin(own, same, transcription, None, p, coarse=False), ROLLING) for p in choices]
        found = [each for each in solved if each.success]
        if found:
            run.iterations += own.iterations
            return settle_on_frames(own, restrain(own, min(found, key=lambda each: each.cost)))
    return None


def _choices(request: Request, guess: InitialGuess) -> Iterator[list[Sequence[Array]]]:
    """Paths of which the best is taken, and others if none leads to a motion: first forwards, straight where they are
    bent for tyres, and in reverse if a nose points away; then backwards, and by turns."""
    paths, legs = guess.paths, legs_between(request.stops)
    if guess.given:
        yield [paths]
        return
    if all(path.shape[1] == 3 for path in paths):
        paths = straight(request)
    away = reversing(request)
    yield [paths, *([] if away is None else [cut(away, legs)])]
    for other in (backwards, shunting):
        if driven := other(request, paths):
            yield [driven]


def with_slip(run: Run, begun: Iterate, rolled: Iterate) -> Iterate:
    """The motion of a car on tyres, solved from that without slip instead of its guess ``begun``; it may have failed.

    It is tried within the soft limits of its character if that is, then without them; on a slope also on twice the
    segments, because slips on long ones may end in a much poorer motion than that without slip.
    """
    request, tried = begun.request, []
    sloping = request.weighed is not request.vehicle
    for times in (1, 2) if sloping and 2 * request.segments <= MOST_SEGMENTS else (1,):
        solved = _slipping(run, replace(begun, request=replace(request, segments=times * request.segments)), rolled)
        if solved.success and solved.cost <= POORER * rolled.cost:
            return solved
        tried.append(solved)
        if run.deadline.late:
            break
    return min(tried, key=lambda each: each.cost)


def _slipping(run: Run, begun: Iterate, rolled: Iterate) -> Iterate:
    request, transcription, blocks = begun.request, begun.transcription, begun.blocks
    guess = begin(run, request, transcription, begun.cover, rolled.paths, rolled.clip, blocks=blocks, coarse=False)
    # brakes that are released within their lag need rows for their commands
    blocks = tuple(replace(block, active=True) if isinstance(block, Actuation) else block for block in guess.blocks)
    guess, costs = replace(guess, blocks=blocks, prolongated=True), rolled.block(RunningCosts)
    starts = [restrained(guess)] if costs is not None and costs.restrained else []
    solved = guess
    for start in (*starts, guess):
        solved = solve(run, start, SLIPPING)
        if solved.success or run.deadline.late:
            break
    return solved
