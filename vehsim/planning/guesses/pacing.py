"""When a vehicle is where on a path: with a stop where it changes its direction, and among moving obstacles.

Paths and paces are searched one after the other (Kant and Zucker 1986, path-velocity decomposition): along a path, the
smoothest motion through its free places and times, by dynamic programming over place, speed and time.
"""

from __future__ import annotations

import math
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

STEPS, FINER = 32, 9
"""Steps of time on a leg, and cells of the path for each."""
FASTEST, HARDEST = 27, 6
"""Largest speed, cells per step, and its largest change from one step to the next."""
STANDS = 0.05
"""Below this share of the longest step, a step ahead has no direction: the vehicle stands."""
ASIDE = 0.5
"""Below this share of a step, its part ahead has no direction either: the vehicle slides sideways."""
MEETING = 100.0
"""Price of each second too near an obstacle, or of a change of direction without a stop, m^2/s^3: more than any
acceleration that it could save."""


def stations(path: Array) -> Array:
    """Poses (cells + 1, 4) at equal distances along a path (k, 4)."""
    length = _travelled(path)
    even = np.linspace(0.0, length[-1], STEPS * FINER + 1)
    return np.column_stack([np.interp(even, length, column) for column in path.T])


def smoothest(taken: NDArray[np.bool_], poses: Array, seconds: float, rests: tuple[bool, bool]) -> tuple[float, Array]:
    """The merit of a path, and the cell (steps + 1,) in which the smoothest motion along it is after each step.

    ``taken`` (steps + 1, cells + 1): where and when it would be too near an obstacle; ``poses``: `stations`;
    ``rests``: whether it starts and ends at rest. The merit is the integral of the squared acceleration, m^2/s^3, with
    `MEETING`: less is better.
    """
    steps, cells = taken.shape[0] - 1, taken.shape[1] - 1
    dt = seconds / steps
    unit = float(_travelled(poses)[-1]) / cells / dt**2
    speeds = np.arange(FASTEST + 1)
    changes = (unit * (speeds[:, None] - speeds)) ** 2 * dt  # from a speed (column) to the next (row)
    changes[np.abs(speeds[:, None] - speeds) > HARDEST] = math.inf
    turned = changes_of_gear(poses)
    cost = np.full((cells + 1, FASTEST + 1), math.inf)
    cost[0, : 1 if rests[0] else None] = 0.0
    came = np.zeros((steps, cells + 1, FASTEST + 1), np.int8)
    for k in range(steps):
        after = np.full_like(cost, math.inf)
        for speed in speeds:
            choices = cost[: cells + 1 - speed] + changes[speed]
            best = choices.argmin(axis=1)
            came[k, speed:, speed] = best
            after[speed:, speed] = np.take_along_axis(choices, best[:, None], axis=1)[:, 0]
            if speed > 1:
                after[speed:, speed] += MEETING * (turned[speed:] > turned[: cells + 1 - speed])
        cost = after + MEETING * dt * taken[k + 1][:, None]
    last = 0 if rests[1] else int(cost[-1].argmin())
    merit, cell, at = float(cost[-1, last]), cells, []
    for k in reversed(range(steps)):
        at.append(cell)
        cell, last = cell - last, int(came[k, cell, last])
    return merit, np.array([0, *at[::-1]])


def paced(poses: Array, at: Array) -> Array:
    """A path (steps + 1, 5): the pose after each step, and the share of the leg's duration."""
    return np.column_stack([poses[at], np.linspace(0.0, 1.0, len(at))])


def stopping(path: Array, rests: tuple[bool, bool]) -> Array:
    """A path (k, 4) with the share of its duration (k, 5) at each point if the vehicle stops wherever it changes its
    direction; the same path if it never does. ``rests``: whether it starts and ends at rest.

    From stop to stop it takes a cubic pace; the squared accelerations of all are least if their durations are as the
    square roots of their lengths.
    """
    turned = changes_of_gear(path)
    if not turned[-1]:
        return path
    travelled, cuts = _travelled(path), [0, *np.flatnonzero(np.diff(turned)), len(path) - 1]
    at = np.concatenate([[0.0], np.cumsum(np.sqrt(np.diff(travelled[cuts])))])
    stops, shares, even = [rests[0], *[True] * (len(cuts) - 2), rests[1]], np.zeros(len(path)), np.linspace(0, 1, 101)
    for i, (a, b) in enumerate(pairwise(cuts)):
        gone = np.polyval(pace(stops[i], stops[i + 1]), even) * (travelled[b] - travelled[a])
        shares[a : b + 1] = at[i] + (at[i + 1] - at[i]) * np.interp(travelled[a : b + 1] - travelled[a], gone, even)
    return np.column_stack([path[:, :4], shares / at[-1]])


def pace(rest_before: bool, rest_after: bool) -> Array:
    """A cubic from 0 to 1 whose ends are at rest as said."""
    a, b = 0.0 if rest_before else 1.0, 0.0 if rest_after else 1.0
    return np.array([a + b - 2, 3 - 2 * a - b, a, 0.0])


def _travelled(path: Array) -> Array:
    """Lengths (k,) from the start of a path to its points."""
    return np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(path[:, :3], axis=0), axis=1))])


def changes_of_gear(poses: Array) -> NDArray[np.int64]:
    """How often the vehicle has changed its direction until each point (n,) of a path of poses (n, 4 or more); never
    without headings (n, 3)."""
    if poses.shape[1] < 4 or len(poses) < 2:
        return np.zeros(len(poses), np.int64)
    step = np.gradient(poses[:, :2], axis=0)
    ahead = step[:, 0] * np.cos(poses[:, 3]) + step[:, 1] * np.sin(poses[:, 3])
    size = np.linalg.norm(step, axis=1)
    gear = np.sign(ahead) * (np.abs(ahead) > np.maximum(STANDS * size.max(), ASIDE * size))
    gear = gear[np.maximum.accumulate(np.where(gear != 0, np.arange(len(gear)), 0))]  # else it is as before
    return np.concatenate([[0], np.cumsum((np.diff(gear) != 0) & (gear[:-1] != 0))])
