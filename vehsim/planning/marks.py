"""Marks: what an animator asks of a motion, at a frame or at a frame the planner chooses."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import KW_ONLY, dataclass, replace
from typing import Literal

import numpy as np

from vehsim.errors import InputError


@dataclass(frozen=True)
class Mark:
    """Where the rig's root has to be, and how it moves there. What is ``None`` is free.

    ``frame``: a whole frame, or ``"free"``; ``position`` (3,) m; ``heading`` deg, yaw of the body's X axis from world
    X, counter-clockwise; ``orientation`` (4,) w, x, y, z; ``velocity`` (3,) m/s in world axes; ``speed`` m/s;
    ``joints`` (s,); ``tolerance`` m, half the side of the box the position may lie in; ``hold``: frames to stay at
    rest there.

    A mark with ``velocity = (0, 0, 0)`` is at rest: the body does not turn either, and when its attitude is not given
    it stands in balance, as it must to stay there (a helicopter level, or leaning into the wind), so that motion sets
    in and ends smoothly; without a heading, what flies nose first faces along its leg. ``speed = 0`` leaves the
    attitude free.
    """

    frame: int | Literal["free"]
    _: KW_ONLY
    position: Sequence[float] | None = None
    heading: float | None = None
    orientation: Sequence[float] | None = None
    velocity: Sequence[float] | None = None
    speed: float | None = None
    joints: Sequence[float] | None = None
    tolerance: float = 0.0
    hold: int = 0

    @property
    def at_rest(self) -> bool:
        return self.velocity is not None and not np.any(self.velocity)

    @property
    def balanced(self) -> bool:
        """At rest with no attitude asked for: roll and pitch follow from standing still."""
        return self.at_rest and self.orientation is None


_SIZES = {"position": 3, "orientation": 4, "velocity": 3}


def check_marks(marks: Sequence[Mark], joints: int) -> list[Mark]:
    """The marks, holds written out; ``InputError`` names mark, key, value and the mend."""
    if len(marks) < 2:
        raise InputError(f"marks: {len(marks)} given; a plan needs at least two, a start and a goal")
    if marks[0].frame == "free":
        raise InputError("mark[0].frame = 'free': the first mark starts the clip; give it a whole frame")
    if marks[0].position is None:
        raise InputError("mark[0].position: missing; the first mark must say where the motion starts")
    last: int | None = None
    for i, mark in enumerate(marks):
        _check_numbers(i, mark, joints)
        if mark.frame == "free":
            continue
        if last is not None and mark.frame <= last:
            raise InputError(f"mark[{i}].frame = {mark.frame}: not after frame {last} before it; put marks in order")
        last = mark.frame + mark.hold
    return _with_holds(marks)


def _check_numbers(i: int, mark: Mark, joints: int) -> None:
    if mark.frame != "free" and (isinstance(mark.frame, bool) or not isinstance(mark.frame, int | np.integer)):
        raise InputError(f"mark[{i}].frame = {mark.frame!r}: give a whole frame, or 'free'")
    for key, size in (*_SIZES.items(), ("joints", joints)):
        values = getattr(mark, key)
        if values is not None and (np.shape(values) != (size,) or not np.all(np.isfinite(values))):
            raise InputError(f"mark[{i}].{key} = {values!r}: give {size} finite numbers")
    for key in ("heading", "speed", "tolerance"):
        value = getattr(mark, key)
        if value is not None and not math.isfinite(value):
            raise InputError(f"mark[{i}].{key} = {value!r}: give a finite number")
    if (mark.speed or 0) < 0 or mark.tolerance < 0 or mark.hold < 0:
        raise InputError(f"mark[{i}]: speed, tolerance and hold must not be negative")
    if mark.speed is not None and mark.velocity is not None:
        raise InputError(f"mark[{i}].speed = {mark.speed}: velocity is given too; drop one of them")
    if mark.orientation is not None and mark.heading is not None:
        raise InputError(f"mark[{i}].heading = {mark.heading}: orientation is given too; drop one of them")
    if mark.hold and not mark.balanced:
        raise InputError(
            f"mark[{i}].hold = {mark.hold}: a hold stands in balance; give velocity = [0, 0, 0], no orientation"
        )


def _with_holds(marks: Sequence[Mark]) -> list[Mark]:
    written: list[Mark] = []
    for i, mark in enumerate(marks):
        if mark.hold and mark.frame == "free":
            raise InputError(f"mark[{i}].hold = {mark.hold}: a free mark cannot be held yet; give it a frame")
        written.append(mark)
        if mark.hold:
            written.append(replace(mark, frame=int(mark.frame) + mark.hold, hold=0))
    return written
