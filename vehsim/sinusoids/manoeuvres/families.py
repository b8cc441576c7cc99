"""Families of manoeuvres over amplitude, cycles and phase, and the member that keeps clear of obstacles."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from itertools import product
from typing import Any

import numpy as np

from vehsim.errors import InputError, SolveError
from vehsim.sinusoids.algebra.feedback import Feedback
from vehsim.sinusoids.canonical.fourier import steer_triangular
from vehsim.sinusoids.steering import Steering
from vehsim.sinusoids.system import Array, DriftlessSystem

Distance = Callable[[Array], Array]
"""Points (k, 2) m -> distance (k,) m to the nearest obstacle, negative inside."""


def family(
    system: DriftlessSystem | Feedback,
    start: Any,
    goal: Any,
    *,
    amplitudes: Sequence[float] = (1.0, -1.0),
    cycles: Sequence[int] = (1, 2, 4),
    phases: Sequence[float] = (0.0, np.pi / 2),
) -> list[Steering]:
    """Steerings from ``start`` to ``goal`` with the same net motion, one for every combination that works.

    ``amplitudes`` of the slow sinusoid, whose sign is the initial direction; ``cycles`` and ``phases`` of every loop.
    Raises ``SolveError`` with the reasons if none works.
    """
    found, reasons = [], []
    for amplitude, count, phase in product(amplitudes, cycles, phases):
        label = f"a = {amplitude:g}, {count} cycle{'s' * (count > 1)}, phase {np.degrees(phase):.0f} deg"
        try:
            steering = steer_triangular(system, start, goal, amplitude=amplitude, cycles=count, phase=phase)
        except SolveError as error:
            reasons.append(f"{label}: {error}")
            continue
        found.append(replace(steering, label=label))
    if not found:
        raise SolveError(f"no member of the family works: {'; '.join(reasons[:3])}")
    return found


def discs(obstacles: Iterable[tuple[float, float, float]]) -> Distance:
    """Distance to discs (x, y, radius), m."""
    rows = np.array(list(obstacles), float).reshape(-1, 3)

    def distance(points: Array) -> Array:
        gaps = np.linalg.norm(points[:, None] - rows[None, :, :2], axis=2) - rows[:, 2]
        return gaps.min(axis=1) if len(rows) else np.full(len(points), np.inf)

    return distance


def boxes(obstacles: Iterable[tuple[float, float, float, float, float]]) -> Distance:
    """Distance to rectangles (x, y, heading rad, length, width), m: parked cars, kerbs, bays."""
    rows = np.array(list(obstacles), float).reshape(-1, 5)

    def distance(points: Array) -> Array:
        gaps = np.full((len(points), max(1, len(rows))), np.inf)
        for i, (x, y, heading, length, width) in enumerate(rows):
            c, s = np.cos(heading), np.sin(heading)
            local = np.abs((points - [x, y]) @ np.array([[c, -s], [s, c]])) - [length / 2, width / 2]
            gaps[:, i] = np.linalg.norm(np.maximum(local, 0), axis=1) + np.minimum(local.max(axis=1), 0)
        return gaps.min(axis=1)

    return distance


def outline(length: float, width: float, behind: float = 0.0, spacing: float = 0.25) -> Array:
    """Points (k, 2) m, in order around a rectangle that starts ``behind`` m behind the axle and is ``length`` long."""
    along, across = (
        np.linspace(0, 1, max(2, int(length / spacing))),
        np.linspace(-0.5, 0.5, max(2, int(width / spacing))),
    )
    right, left = (np.column_stack([along * length - behind, 0 * along + side * width / 2]) for side in (-1, 1))
    back, front = (np.column_stack([0 * across + end * length - behind, across * width]) for end in (0, 1))
    return np.concatenate([right[:-1], front[:-1], left[:0:-1], back[:0:-1]])


def clearance(steering: Steering, distance: Distance, footprints: Sequence[Array]) -> float:
    """Smallest distance, m, of the footprints (k, 2) of every body to the obstacles, along the sampled motion."""
    poses = bodies(steering)
    if len(footprints) != poses.shape[1]:
        raise InputError(
            f"{len(footprints)} footprints for {poses.shape[1]} bodies", "give one each", subject=steering.system.name
        )
    smallest = np.inf
    for body, points in enumerate(footprints):
        for x, y, heading in poses[:, body]:
            c, s = np.cos(heading), np.sin(heading)
            smallest = min(smallest, float(distance(points @ np.array([[c, s], [-s, c]]) + [x, y]).min()))
    return smallest


def choose(
    steerings: Sequence[Steering], distance: Distance, footprints: Sequence[Array], margin: float = 0.1
) -> Steering:
    """The steering of least effort with a clearance of ``margin`` m. ``SolveError`` gives the best clearance if there
    is none."""
    if not steerings:
        raise InputError("none given", "make some with vehsim.sinusoids.family", key="steerings")
    for steering in sorted(steerings, key=lambda s: s.effort):
        if clearance(steering, distance, footprints) >= margin:
            return steering
    nearest = max(clearance(s, distance, footprints) for s in steerings)
    raise SolveError(
        f"none of {len(steerings)} manoeuvres keeps {margin:g} m clear, the best comes to {nearest:.3f} m",
        "offer more amplitudes and cycles, or move start, goal or obstacles",
        subject=steerings[0].system.name,
    )


def bodies(steering: Steering) -> Array:
    """Poses (k, bodies, 3) of the axles of a car or train: x, y m, heading rad. Trailers from the front."""
    names, q = list(steering.system.states), steering.states
    if not {"x", "y"} <= set(names):
        raise InputError(
            "does not drive on a plane", "it has no bodies to see from above", subject=steering.system.name
        )
    headings = [i for i, name in enumerate(names) if name.startswith("theta")]
    spot, poses = q[:, [names.index("x"), names.index("y")]], []
    for k, i in enumerate(headings):
        along = np.column_stack([np.cos(q[:, i]), np.sin(q[:, i])])
        if k:
            spot = spot - steering.system.lengths[k - 1] * along
        poses.append(np.column_stack([spot, q[:, i]]))
    return np.stack(poses, axis=1)
