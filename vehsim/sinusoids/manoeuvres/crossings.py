"""Routes of a train between straight poses of its last axle, as sequences of poses.

A route is direct, goes past the goal and back, or around bends. This module is geometry only: `train.py` makes the legs
between the poses, and `trailers.py` chooses a route.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace
from itertools import pairwise, product

import numpy as np

from vehsim.planning.guesses import dubins
from vehsim.sinusoids.manoeuvres.train import Pose, Train
from vehsim.sinusoids.system import Array

CORNER = 1.75
"""Largest turn of one leg of a path around a bend, rad."""
CHART = 2.0
"""Largest turn of any leg, rad: the leg is a graph over the mean of its headings."""

Step = tuple[Pose, Pose, str]
"""One leg: from, to, name."""


def crossings(train: Train, a: Pose, b: Pose) -> Iterator[list[Step]]:
    """Routes between straight poses: direct, around bends forwards, or through a turning point in line with one of
    them."""
    dx, dy, _ = b.within(a)
    turn = float((b.heading - a.heading + np.pi) % math.tau - np.pi)
    if np.hypot(dx, dy) < 1e-9 and abs(turn) < 1e-9:
        yield []
        return
    b = replace(b, heading=a.heading + turn)
    if abs(turn) < CHART:
        yield from _direct(train, [(a, b, "drive")])
        reach = abs(dy) + train.length
        for far, sign in product((reach, 2 * reach), (1.0, -1.0)):
            for turning in (a.ahead(max(0.0, sign * dx) * sign + sign * far), b.ahead(sign * far)):
                yield from _direct(train, [(a, turning, "drive past"), (turning, b, "and back")])
    radii = 1.2 * max((*train.hitches, train.wheelbase)) + train.length * np.array([0.0, 0.25, 0.7, 1.4, 2.4, 3.4, 5.0])
    for radius, lead in product(radii, train.length * np.array([0.0, 0.6, 1.2])):
        for route in _round_bends(a, b, float(radius), float(lead)):
            yield [(p, q, "round the bend") for p, q in pairwise(route)]


def span(a: Pose, b: Pose) -> float:
    """Length of the leg from ``a`` to ``b`` along the mean of their headings, m; negative for reversing."""
    half = (a.heading + b.heading) / 2
    return float((b.x - a.x) * np.cos(half) + (b.y - a.y) * np.sin(half))


def _direct(train: Train, steps: list[Step]) -> Iterator[list[Step]]:
    """The steps as one route; no route if one of them is too short for a train."""
    if all(abs(span(a, b)) > 0.3 * train.length for a, b, _ in steps):
        yield steps


def _round_bends(a: Pose, b: Pose, radius: float, lead: float) -> Iterator[list[Pose]]:
    """Forwards along circles at either end and the straight line between them (Dubins), with smooth corners.

    Corners start and end ``lead`` m before and after their arcs: a short arc needs this, or the train swings.
    """
    start, end = a.ahead(lead), b.ahead(-lead)
    for (turned, first), (straight, _), (unturned, last) in dubins.curves(_pose(start), _pose(end), radius):
        centre_a, centre_b = (_beside(at, math.copysign(radius, bend)) for at, bend in ((start, first), (end, last)))
        arcs = [first * turned, last * unturned]
        room = straight - lead * sum(arc != 0 for arc in arcs)
        if room < -1e-9:
            continue
        bend = _around(start, centre_a, arcs[0])
        unbend = _around(bend[-1].ahead(straight), centre_b, arcs[1])
        bend = [a, *bend[1:-1], bend[-1].ahead(lead)] if arcs[0] else [a]
        last_pose = replace(b, heading=unbend[-1].heading)  # b, after as many turns as the route makes
        unbend = [unbend[0].ahead(-lead), *unbend[1:-1], last_pose] if arcs[1] else [last_pose]
        poses = [*bend, *unbend] if room > 1e-9 else [*bend, *unbend[1:]]
        if len(poses) > 1:
            yield poses


def _around(start: Pose, centre: Array, arc: float) -> list[Pose]:
    """Poses along a circle through ``start``, one corner apart."""
    count = int(np.ceil(abs(arc) / CORNER - 1e-9)) if abs(arc) > 1e-9 else 0
    spoke = np.array([start.x, start.y]) - centre
    poses = [start]
    for turn in arc * np.arange(1, count + 1) / max(count, 1):
        c, s = np.cos(turn), np.sin(turn)
        x, y = centre + np.array([c * spoke[0] - s * spoke[1], s * spoke[0] + c * spoke[1]])
        poses.append(Pose(float(x), float(y), start.heading + turn))
    return poses


def _pose(pose: Pose) -> tuple[float, float, float]:
    return pose.x, pose.y, pose.heading


def _beside(pose: Pose, distance: float) -> Array:
    """The point ``distance`` m to the left."""
    return np.array([pose.x - distance * np.sin(pose.heading), pose.y + distance * np.cos(pose.heading)])
