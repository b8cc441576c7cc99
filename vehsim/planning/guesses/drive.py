"""Paths of driving vehicles among obstacles, leg by leg, clear of moving obstacles at the time of passing."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vehsim.errors import SolveError
from vehsim.planning.constraints.timing import fixed_durations
from vehsim.planning.guesses import astar
from vehsim.planning.guesses.pace import cruise
from vehsim.planning.guesses.pacing import STEPS, paced, smoothest, stations
from vehsim.planning.outlines import clearances
from vehsim.planning.request.legs import legs_between, path_length
from vehsim.planning.request.marks import heading_of
from vehsim.planning.request.request import Request
from vehsim.world.obstacles.obstacles import footprint
from vehsim.world.obstacles.plane import placed

Array = NDArray[np.float64]
Parts = Sequence[tuple[Any, int]]
"""Obstacles and indices of their parts."""

DODGES = 4
"""Maximum number of searches for a path that avoids moving obstacles."""
EACH = 3
"""Distances from moving obstacles are measured at each so many cells of a path."""
STILL = 1e-3
"""Length below which a path needs no pace, m."""


def drive(request: Request, parts: Parts, wariness: int = 0, stretch: float = 1.0) -> list[Array]:
    """A path for every leg between two marks, by A*: (k, 4) x, y, z m and heading rad.

    Among moving obstacles (k, 5), with the share of the leg's duration. If the vehicle would meet one, paths around the
    places where they met are searched too. Of these paths, that with the smoothest motion through free places and times
    is chosen. A larger ``wariness`` keeps more distance; ``stretch``: factor on the duration of free legs.
    """
    nose = [heading_of(mark) for mark in request.marks]
    seconds = float(int(request.marks[0].frame) / request.fps)
    fixed = fixed_durations(request.marks, request.fps)
    moving = [(o, k) for o, k in parts if o.moves and not o.is_static]
    paths = []
    for j, leg in enumerate(legs_between(request.marks)):
        marks = request.marks[j], request.marks[j + 1]
        met: list[Any] = []
        found: list[tuple[float, Array]] = []
        for _ in range(DODGES):
            ends, noses = np.array(leg), (nose[j], nose[j + 1])
            try:
                path = astar.guess_drive(request.vehicle, parts, ends, noses, request.clearance, wariness, met)
            except SolveError as error:
                if not found:
                    key = f"{marks[1].name}.position"
                    raise SolveError.of(*(replace(problem, key=key) for problem in error.problems)) from None
                break  # the places where they met close every way
            duration = stretch * cruise(request, marks, path) if np.isnan(fixed[j]) else fixed[j]
            if not moving or path_length(path) < STILL or duration <= 0:
                found.append((0.0, path))
                break
            rests = marks[0].at_rest, marks[1].at_rest
            found.append(_paced(request, moving, path, seconds, duration, rests))
            new = _met(request, moving, path, seconds, duration)
            if not new:
                break
            met += new
        path = min(found, key=lambda one: one[0])[1]
        paths.append(path)
        seconds += stretch * cruise(request, marks, path) if np.isnan(fixed[j]) else fixed[j]
    return paths


def _paced(
    request: Request, moving: Parts, path: Array, start: float, duration: float, rests: tuple[bool, bool]
) -> tuple[float, Array]:
    """The merit of a path (k, 4) among moving obstacles, and the path with its smoothest pace (n, 5)."""
    poses = stations(path)
    seen = poses[::EACH]
    outlines = placed(footprint(request.vehicle), seen[:, :2], seen[:, 3])
    seconds = np.repeat(np.linspace(start, start + duration, STEPS + 1), len(seen))
    gaps = clearances(moving, np.tile(outlines, (STEPS + 1, 1, 1)), seconds, request.clearance)
    taken = (gaps < request.clearance).any(axis=0).reshape(STEPS + 1, len(seen))
    nearest = (np.arange(len(poses)) + EACH // 2) // EACH
    merit, at = smoothest(taken[:, nearest], poses, duration, rests)
    return merit, paced(poses, at)


def _met(request: Request, moving: Parts, path: Array, start: float, duration: float) -> list[Array]:
    """Outlines (k, 2) of moving obstacles where a motion at constant speed along a path (k, 4) meets them."""
    travelled = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(path[:, :2], axis=0), axis=1))])
    seconds = start + duration * travelled / max(travelled[-1], 1e-9)
    outlines = placed(footprint(request.vehicle), path[:, :2], path[:, 3])
    gaps = clearances(moving, outlines, seconds)
    return [
        o.shapes_at(seconds[row < request.clearance])[0]
        for (o, _), row in zip(moving, gaps, strict=True)
        if row.min() < request.clearance
    ]
