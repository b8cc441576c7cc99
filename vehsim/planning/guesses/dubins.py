"""Curves of bounded curvature between two poses: an arc, a straight line and an arc (Dubins 1957)."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Pose = Sequence[float]
Parts = list[tuple[float, float]]
"""Length, m, and signed curvature, 1/m, of every part of a curve."""


def curves(start: Pose, goal: Pose, radius: float) -> list[Parts]:
    """The curves from a pose (x, y m, heading rad) to another that begin and end with arcs of ``radius`` m."""
    found = []
    for first in (1, -1):
        for last in (1, -1):
            dx = goal[0] - start[0] - radius * (last * math.sin(goal[2]) - first * math.sin(start[2]))
            dy = goal[1] - start[1] + radius * (last * math.cos(goal[2]) - first * math.cos(start[2]))
            between, direction, straight = math.hypot(dx, dy), math.atan2(dy, dx), math.hypot(dx, dy)
            if first != last:  # the line crosses from one side to the other
                if between < 2 * radius:
                    continue
                straight = math.sqrt(between**2 - 4 * radius**2)
                direction += first * math.asin(2 * radius / between)
            arcs = _turn(first * (direction - start[2])), _turn(last * (goal[2] - direction))
            found.append([(radius * arcs[0], first / radius), (straight, 0.0), (radius * arcs[1], last / radius)])
    return found


def length(parts: Parts) -> float:
    """Length of a curve, m."""
    return sum(part[0] for part in parts)


def along(start: Pose, parts: Parts, step: float) -> Array:
    """Poses (n, 3) on a curve, at most ``step`` m apart, from the first after ``start`` to the end."""
    whole = length(parts)
    at = np.linspace(0, whole, max(2, math.ceil(whole / step) + 1))[1:]
    x, y, heading = (np.full(len(at), value) for value in start)
    for part, bend in parts:
        gone = np.clip(at, 0, part)
        at, turn = at - part, bend * gone
        chord = gone * np.sinc(turn / 2 / np.pi)
        x, y = x + chord * np.cos(heading + turn / 2), y + chord * np.sin(heading + turn / 2)
        heading = heading + turn
    return np.column_stack([x, y, heading])


def _turn(angle: float) -> float:
    """The angle, rad, from 0 to a full turn; rounding does not add a turn."""
    turn = (angle + 1e-9) % math.tau - 1e-9
    return turn if turn > 1e-9 else 0.0
