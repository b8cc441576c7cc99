"""Paths of driving vehicles among obstacles, leg by leg, clear of moving obstacles at the time of passing."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vehsim.planning.constraints.timing import fixed_durations
from vehsim.planning.guesses import astar
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
BRISK = 5.0
"""Guessed speed on a leg between free marks, m/s."""


def drive(request: Request, parts: Parts, wariness: int = 0) -> list[Array]:
    """A path (k, 4) x, y, z m and heading rad for every leg between two marks, by A*.

    A larger ``wariness`` keeps more distance. If a path meets a moving obstacle, it is searched again around the places
    where they met.
    """
    nose = [heading_of(mark) for mark in request.marks]
    seconds = float(int(request.marks[0].frame) / request.fps)
    fixed = fixed_durations(request.marks, request.fps)
    paths = []
    for j, leg in enumerate(legs_between(request.marks)):
        met: list[Any] = []
        for _ in range(DODGES):
            ends = np.array(leg)
            noses = (nose[j], nose[j + 1])
            path = astar.guess_drive(request.vehicle, parts, ends, noses, request.clearance, wariness, met)
            length = path_length(path)
            duration = length / BRISK if np.isnan(fixed[j]) else fixed[j]
            new = _met(request, parts, path, seconds, duration)
            if not new:
                break
            met += new
        paths.append(path)
        seconds += duration
    return paths


def _met(request: Request, parts: Parts, path: Array, start: float, duration: float) -> list[Array]:
    """Outlines (k, 2) of moving obstacles where a motion at constant speed along a path (k, 4) meets them."""
    moving = [(o, k) for o, k in parts if o.moves and not o.is_static]
    if not moving:
        return []
    travelled = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(path[:, :2], axis=0), axis=1))])
    seconds = start + duration * travelled / max(travelled[-1], 1e-9)
    outlines = placed(footprint(request.vehicle), path[:, :2], path[:, 3])
    gaps = clearances(moving, outlines, seconds)
    return [
        o.shapes_at(seconds[row < request.clearance])[0]
        for (o, _), row in zip(moving, gaps, strict=True)
        if row.min() < request.clearance
    ]
