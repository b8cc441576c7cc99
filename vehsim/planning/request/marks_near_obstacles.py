"""Obstacles that a vehicle can touch on its path, and marks in or too near to an obstacle."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from vehsim.errors import InputError
from vehsim.planning.certificates import FINEST
from vehsim.planning.outlines import clearances
from vehsim.planning.request.landing import attitude
from vehsim.planning.request.marks import Mark, heading_of, leeway
from vehsim.vehicles import Vehicle
from vehsim.world.obstacles.obstacles import footprint, vertical_reach
from vehsim.world.obstacles.plane import placed

TURNS = 180
"""Number of headings to try at a mark without a heading."""


def parts_in_reach(vehicle: Vehicle, world: Any, marks: Sequence[Any]) -> list[tuple[Any, int]]:
    """The obstacles of ``world``, with indices of their parts, that a vehicle driving at the height of the marks can
    touch."""
    if world is None or not vehicle.group.planar:
        return []
    height = 0.0 if marks[0].position is None else float(marks[0].position[2])
    low, high = vertical_reach(vehicle)
    return [
        (obstacle, number)
        for obstacle in world.obstacles
        if obstacle.bottom < height + high and obstacle.top > height + low
        for number in range(1 if obstacle.moves else len(obstacle.parts))
    ]


def check_marks_clear(vehicle: Vehicle, world: Any, marks: Sequence[Mark], clearance: float) -> None:
    """Raise ``InputError`` if the vehicle, at a mark, would be in an obstacle or nearer than ``clearance`` m to one."""
    for i, message, remedy in marks_too_near(vehicle, world, marks, clearance):
        place = np.asarray(marks[i].position, float).tolist()
        raise InputError(message, remedy, key=f"mark[{i}].position", value=place)


def marks_too_near(
    vehicle: Vehicle, world: Any, marks: Sequence[Any], clearance: float
) -> Iterator[tuple[int, str, str]]:
    """Index, message and remedy of every mark at which the vehicle is in an obstacle or too near to one.

    For a mark without a heading, the best heading counts. For a flying vehicle without an attitude, only the root is
    checked. The tolerance or gate of a mark is taken off the required clearance.
    """
    if vehicle.group.dim == 6:
        yield from _flown_too_near(vehicle, world, marks, clearance)
        return
    still = [(o, k) for o, k in parts_in_reach(vehicle, world, marks) if not o.moves]
    for i, mark in enumerate(marks if still else ()):
        if mark.position is None:
            continue
        outline, place = footprint(vehicle), np.array([mark.position[:2]], float)
        nose = heading_of(mark)
        faced = nose is not None
        yaw = np.array([nose]) if faced else np.arange(TURNS) * 2 * np.pi / TURNS
        between = 0.0 if faced else np.pi / TURNS * float(np.linalg.norm(outline, axis=1).max())
        seconds = np.zeros(len(yaw))
        near = clearances(still, placed(outline, np.repeat(place, len(yaw), axis=0), yaw), seconds)
        best = int(near.min(axis=0).argmax())
        gap, name = float(near[:, best].min()), still[int(near[:, best].argmin())][0].name
        if gap + leeway(mark) + between < clearance - FINEST:
            yield i, *_nearness(gap, name, clearance, "" if faced else " at any heading")


def _flown_too_near(
    vehicle: Vehicle, world: Any, marks: Sequence[Any], clearance: float
) -> Iterator[tuple[int, str, str]]:
    """The same for flying vehicles: with their hulls if the attitude is given, otherwise with the root."""
    for i, mark in enumerate(marks if world is not None and world.standing else ()):
        if mark.position is None or mark.on_ground:
            continue
        turned = heading_of(mark) is not None
        body = vehicle if turned else replace(vehicle, rig=None)
        gaps = world.clearance_by_obstacle(body, mark.position, attitude(mark))[0]
        gap, name = float(gaps.min()), world.obstacles[int(gaps.argmin())].name
        if gap + leeway(mark) < (clearance - FINEST if turned else 0.0):
            yield i, *_nearness(gap, name, clearance)


def _nearness(gap: float, name: str, clearance: float, heading: str = "") -> tuple[str, str]:
    """Message and remedy of a mark at ``gap`` m from an obstacle."""
    if gap <= 0:
        return f"in obstacle {name!r}{heading}", "move the mark or the obstacle"
    remedy = f"keep the clearance of {clearance:g} m, or reduce it"
    return f"only {gap:.2f} m from obstacle {name!r}{heading}", remedy
