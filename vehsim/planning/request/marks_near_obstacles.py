"""Obstacles that a vehicle can touch on its way, and marks that stand in one or too near."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from vehsim.errors import InputError
from vehsim.planning.certificates import FINEST
from vehsim.planning.outlines import clearances
from vehsim.planning.request.landing import attitude
from vehsim.planning.request.marks import Mark, leeway
from vehsim.vehicles import Vehicle
from vehsim.world.obstacles.obstacles import footprint, vertical_reach
from vehsim.world.obstacles.plane import placed

TURNS = 180
"""Headings tried at a mark that leaves it open."""


def parts_in_reach(vehicle: Vehicle, world: Any, marks: Sequence[Any]) -> list[tuple[Any, int]]:
    """The obstacles of ``world``, and numbers of their parts, that a vehicle driving at the marks' height can touch."""
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
    """Raise ``InputError`` for a mark whose vehicle stands in an obstacle, or nearer than ``clearance`` m to one."""
    for i, message, remedy in marks_too_near(vehicle, world, marks, clearance):
        raise InputError(message, remedy, key=f"mark[{i}].position", value=list(marks[i].position or ()))


def marks_too_near(
    vehicle: Vehicle, world: Any, marks: Sequence[Any], clearance: float
) -> Iterator[tuple[int, str, str]]:
    """Number, message and remedy of every mark whose vehicle stands in an obstacle or too near to one.

    A mark without a heading may have any, what flies without an attitude is asked for its root alone; one with a
    tolerance or a gate may give way by that.
    """
    if vehicle.group.dim == 6:
        yield from _flown_too_near(vehicle, world, marks, clearance)
        return
    still = [(o, k) for o, k in parts_in_reach(vehicle, world, marks) if not o.moves]
    for i, mark in enumerate(marks if still else ()):
        if mark.position is None:
            continue
        outline, place = footprint(vehicle), np.array([mark.position[:2]], float)
        faced = mark.heading is not None
        yaw = np.deg2rad([mark.heading] if faced else np.arange(TURNS) * 360 / TURNS)
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
    """The same for what flies: by its hulls where the attitude is given, else by its root."""
    for i, mark in enumerate(marks if world is not None and world.standing else ()):
        if mark.position is None or mark.on_ground:
            continue
        turned = mark.orientation is not None or mark.heading is not None
        body = vehicle if turned else replace(vehicle, rig=None)
        gaps = world.clearance_by_obstacle(body, mark.position, attitude(mark))[0]
        gap, name = float(gaps.min()), world.obstacles[int(gaps.argmin())].name
        if gap + leeway(mark) < (clearance - FINEST if turned else 0.0):
            yield i, *_nearness(gap, name, clearance)


def _nearness(gap: float, name: str, clearance: float, heading: str = "") -> tuple[str, str]:
    """Message and remedy of a mark at ``gap`` m from an obstacle."""
    if gap <= 0:
        return f"in obstacle {name!r}{heading}", "move the mark or the obstacle"
    remedy = f"keep the clearance of {clearance:g} m, or ask for less"
    return f"only {gap:.2f} m from obstacle {name!r}{heading}", remedy
