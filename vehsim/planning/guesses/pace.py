"""Initial guesses of legs' durations and numbers of segments, from their lengths and the vehicle's strength."""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from vehsim.planning.explain.bounds import strength
from vehsim.planning.guesses.astar import turning_radius
from vehsim.planning.guesses.pacing import changes_of_gear
from vehsim.planning.request.legs import path_length
from vehsim.planning.request.marks import Mark
from vehsim.planning.request.request import Request
from vehsim.vehicles import Vehicle

Array = NDArray[np.float64]

CRUISE, SHARE = 12.0, 0.6
"""Guessed speed on a free leg, m/s, more on long legs; and its upper bound as a share of the top speed."""
STARTING, EACH = 1.5, 0.5
"""Time added for each start or stop, and for each leg, s."""
BENDS = 14.0
"""Largest length of a segment, in turning radii: on longer segments the discretised zigzag costs less than a straight
line."""


def cruising(request: Request, paths: Sequence[Array]) -> Array:
    """Durations (m,) of legs along ``paths`` at moderate acceleration, with time to start and to stop, s."""
    legs = zip(pairwise(request.marks), paths, strict=True)
    return np.array([cruise(request, ends, path, path.shape[1] == 5) for ends, path in legs])


def cruise(request: Request, ends: tuple[Mark, Mark], path: Array, gently: bool = True) -> float:
    """The same of one leg between two marks; ``gently``: at no more acceleration than its character or the user allows,
    so that it is among moving obstacles when it will be.

    A change of direction is a stop and a start. A motion from rest to rest over ``d`` m in ``t`` s needs ``6 d / t^2``
    m/s^2: half the vehicle's strength on long legs.
    """
    length, push = path_length(path), strength(request.vehicle)
    rests = sum(mark.at_rest for mark in ends) + 2 * int(changes_of_gear(path)[-1])
    speed = max(math.sqrt(length * push / 12) if math.isfinite(push) else 0.0, CRUISE)
    briskly = length / min(speed, SHARE * request.top_speed) + STARTING * rests + EACH
    if not gently:
        return briskly
    most = request.traits.without(request.limits).get("acceleration", request.limits.get("acceleration"))
    return max(briskly, math.sqrt(3 * rests * length / most))


def fewest_segments(vehicle: Vehicle, length: float) -> int:
    """The least number of segments for a leg of ``length`` m."""
    radius = turning_radius(vehicle) if vehicle.group.planar else 0.0
    return math.ceil(length / (BENDS * radius)) if 0 < radius < math.inf else 0
