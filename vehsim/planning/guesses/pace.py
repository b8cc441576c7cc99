"""How fast legs are gone and how finely they are divided at first, guessed from lengths and what the vehicle can do."""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from vehsim.planning.explain.bounds import strength
from vehsim.planning.guesses.astar import turning_radius
from vehsim.planning.request.legs import path_length
from vehsim.planning.request.request import Request
from vehsim.vehicles import Vehicle

Array = NDArray[np.float64]

CRUISE, SHARE = 12.0, 0.6
"""Guess of a free leg's speed, m/s, faster on long ones; and the share of the top speed that it is at most."""
STARTING, EACH = 1.5, 0.5
"""Time added for a start from rest or a stop, and for every leg, s."""
BENDS = 14.0
"""A segment is at most so many turning circles' radii long: on longer ones a zigzag costs less than a straight line,
which no real vehicle would find."""


def cruising(request: Request, paths: Sequence[Array]) -> Array:
    """How long legs (m,) along ``paths`` take at an easy pace, with time to start and to stop, s.

    From rest to rest over ``d`` m in ``t`` s takes ``6 d / t^2`` m/s^2: on a long way, half the vehicle's strength.
    """
    marks, lengths = request.marks, np.array([path_length(path) for path in paths])
    rests = np.array([a.at_rest + b.at_rest for a, b in pairwise(marks)])
    push = strength(request.vehicle)
    speeds = np.sqrt(lengths * push / 12) if math.isfinite(push) else np.zeros(len(paths))
    return lengths / np.minimum(np.maximum(speeds, CRUISE), SHARE * request.top_speed) + STARTING * rests + EACH


def fewest_segments(vehicle: Vehicle, length: float) -> int:
    """How many segments a way of ``length`` m takes at least."""
    radius = turning_radius(vehicle) if vehicle.group.planar else 0.0
    return math.ceil(length / (BENDS * radius)) if 0 < radius < math.inf else 0
