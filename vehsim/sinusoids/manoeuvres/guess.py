"""Sinusoids as an initial guess for `plan`: a path that a car or a train can drive, mark by mark."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import TYPE_CHECKING, Protocol

import numpy as np

from vehsim.errors import InputError, SolveError
from vehsim.lie.quaternions import from_yaw
from vehsim.sinusoids.manoeuvres.families import bodies
from vehsim.sinusoids.manoeuvres.manoeuvres import Manoeuvre, choose_manoeuvre, manoeuvres
from vehsim.sinusoids.manoeuvres.rigs import rigged
from vehsim.sinusoids.system import Array
from vehsim.vehicles import State, Vehicle

if TYPE_CHECKING:
    from vehsim.world.world import World


class Marked(Protocol):
    """The part of a mark (`vehsim.Mark`) that is used: m, degrees, joints by name."""

    @property
    def position(self) -> Sequence[float] | None: ...
    @property
    def heading(self) -> float | None: ...
    @property
    def joints(self) -> object: ...


def initial_guess(
    vehicle: Vehicle, marks: Sequence[Marked], world: World | None = None, clearance: float = 0.1
) -> Array:
    """Poses (k, 4) x, y, z m and heading rad of the rig's root from mark to mark, for ``plan(..., guess=...)``.

    Between two marks, the fastest manoeuvre that keeps ``clearance`` m from obstacles, or the one with the largest
    clearance. The vehicle stops at every mark; a mark without a heading faces the next. Raises ``InputError`` for
    vehicles that sinusoids do not drive and marks without a position, ``SolveError`` if no manoeuvre works.
    """
    rig = rigged(vehicle)
    if vehicle.group.dim != 3:
        raise InputError(
            "only cars, and trucks with trailers, are guessed by sinusoids", key="guess", subject=vehicle.name
        )
    states = [rig.state(_standing(vehicle, marks, k)) for k in range(len(marks))]
    height = float((marks[0].position or (0.0, 0.0, 0.0))[2])
    rows = []
    for start, goal in pairwise(states):
        x, y, heading = bodies(_taken(manoeuvres(rig, start, goal, None, world), clearance).steering)[:, 0].T
        c, s, (ahead, left) = np.cos(heading), np.sin(heading), vehicle.origin[:2]
        rows.append(np.column_stack([x - c * ahead + s * left, y - s * ahead - c * left, 0 * x + height, heading]))
    poses = np.concatenate(rows)
    poses[:, 3] = np.unwrap(poses[:, 3])
    return poses


def _taken(found: Sequence[Manoeuvre], clearance: float) -> Manoeuvre:
    try:
        return choose_manoeuvre(found, None, clearance)
    except SolveError:
        return max(found, key=lambda m: m.clearance)


def _standing(vehicle: Vehicle, marks: Sequence[Marked], k: int) -> State:
    """The ``k``-th mark as a state at rest."""
    place, heading = marks[k].position, marks[k].heading
    if place is None:
        raise InputError("missing", "sinusoids go from place to place", key=f"mark[{k}].position", subject=vehicle.name)
    if heading is None:
        a, b = (marks[min(k, len(marks) - 2) + i].position for i in (0, 1))
        heading = 0.0 if a is None or b is None else float(np.degrees(np.arctan2(b[1] - a[1], b[0] - a[0])))
    given = marks[k].joints
    if isinstance(given, dict):
        joints = np.array([given.get(name, 0.0) for name in vehicle.joints])
    else:
        joints = np.zeros(len(vehicle.joints)) if given is None else np.asarray(given, float)
    return State(tuple(map(float, place)), from_yaw(np.deg2rad(heading)), joints=joints)
