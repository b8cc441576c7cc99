"""Camera rigs: the desired places and aims of each kind of camera, one function and one entry each.

`framing.py` holds what is common to all cameras (framing, ground, smoothness, horizon).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from vehsim.cameras.path import smooth
from vehsim.runtime.registry import Registry

if TYPE_CHECKING:
    from vehsim.cameras.camera import CameraRig, Subject

Array = NDArray[np.float64]

STEEPEST = 0.8
"""Largest slope of the ground behind a target over which a camera is raised."""


@dataclass(frozen=True)
class Move:
    """The behaviour of a rig. ``place``: (rig, subject, distance, world) -> positions and aims (n, 3).

    ``fill``: reduces the fills of all frames to one for the whole shot; None: the rig's distance is fixed. ``guided``:
    may move around obstructions and over obstacles; ``level``: keeps a level horizon; ``behind``: keeps its side of the
    target, and is raised over the ground rather than moved around; ``side``: for rigs at a fixed place: (subject,
    distance) -> the default azimuth, degrees.
    """

    place: Callable[[CameraRig, Subject, float, Any], tuple[Array, Array]]
    fill: Callable[[Array], Any] | None = np.median
    guided: bool = True
    level: bool = True
    behind: bool = False
    side: Callable[[Subject, float], float] | None = None


def _chase(rig: CameraRig, subject: Subject, distance: float, world: Any) -> tuple[Array, Array]:
    """Towed behind the target on a rope: calm in hover, wide around bends, without the jerks of the body."""
    path = smooth(subject.centre, 0.45 * subject.fps)
    height = 0.06 * distance if rig.height is None else rig.height
    reach = np.sqrt(max(distance**2 - height**2, (0.2 * distance) ** 2))
    first = _open_direction(path[0], subject.headings[0], reach, world)
    rope = _tow(path[:, :2], first, reach)
    turn = smooth(np.unwrap(np.arctan2(rope[:, 1], rope[:, 0])), 0.5 * subject.fps)
    turn += np.radians(0.0 if rig.azimuth is None else rig.azimuth)
    level = smooth(subject.centre[:, 2], 0.8 * subject.fps)
    place = np.stack([path[:, 0] + reach * np.cos(turn), path[:, 1] + reach * np.sin(turn), level + height], axis=1)
    return place, smooth(subject.centre, 0.2 * subject.fps)


def _tow(path: Array, heading: float, length: float) -> Array:
    """A rope (n, 2) of ``length`` m from each point of ``path`` (n, 2) to the towed camera, first straight behind."""
    rope = np.empty_like(path)
    rope[0] = -length * np.array([np.cos(heading), np.sin(heading)])
    for k in range(1, len(path)):
        pulled = path[k - 1] + rope[k - 1] - path[k]
        rope[k] = pulled * (length / max(float(np.linalg.norm(pulled)), 1e-9))
    return rope


def _open_direction(start: Array, heading: float, length: float, world: Any) -> float:
    """The heading rad closest to ``heading`` without ground too steep to look over, ``length`` m behind
    ``start`` (3,)."""
    turns = np.radians(np.arange(0, 91, 5))
    headings = heading + np.concatenate([[0.0], np.stack([turns[1:], -turns[1:]], axis=1).ravel()])
    along = np.linspace(0, length, 16)
    behind = -np.stack([np.cos(headings), np.sin(headings)], axis=1)[:, None] * along[:, None]
    ground = np.asarray(world.height((start[:2] + behind).reshape(-1, 2))).reshape(len(headings), -1)
    above = np.where(np.isfinite(ground), ground, -np.inf) - start[2]
    blocked = np.maximum(above - STEEPEST * along, 0.0).max(axis=1)
    return float(headings[np.argmin(blocked + 0.5 * length * np.abs(headings - heading))])


def _follow(rig: CameraRig, subject: Subject, distance: float, world: Any) -> tuple[Array, Array]:
    """Travels beside the target and always looks in the same direction."""
    path = smooth(subject.centre, 0.35 * subject.fps)
    azimuth = np.radians(rig.azimuth if rig.azimuth is not None else np.degrees(np.median(subject.headings)) + 50.0)
    return path + _arm(np.full(len(path), azimuth), distance, rig.height), path


def _orbit(rig: CameraRig, subject: Subject, distance: float, world: Any) -> tuple[Array, Array]:
    """Circles the target at ``turn`` degrees per second."""
    path = smooth(subject.centre, 0.35 * subject.fps)
    start = np.radians(rig.azimuth if rig.azimuth is not None else np.degrees(subject.headings[0]) + 30.0)
    turn = start + np.radians(rig.turn) * np.arange(len(path)) / subject.fps
    return path + _arm(turn, distance, rig.height), path


def _static(rig: CameraRig, subject: Subject, distance: float, world: Any) -> tuple[Array, Array]:
    """Stands still at ``position`` and pans with the target, or looks at ``look_at`` without panning."""
    aims = smooth(subject.centre, 0.2 * subject.fps)
    place = np.array(rig.position, float) if rig.position is not None else _beside(rig, subject, distance, 0.5)
    if rig.look_at is not None:
        aims = np.broadcast_to(np.array(rig.look_at, float), aims.shape)
    return np.tile(place, (len(aims), 1)), aims


def _fly_by(rig: CameraRig, subject: Subject, distance: float, world: Any) -> tuple[Array, Array]:
    """Stands close to the target's path, at two thirds of it, and pans with the target."""
    place = np.array(rig.position, float) if rig.position is not None else _beside(rig, subject, distance, 0.65)
    return np.tile(place, (len(subject.centre), 1)), smooth(subject.centre, 0.08 * subject.fps)


def _dolly(rig: CameraRig, subject: Subject, distance: float, world: Any) -> tuple[Array, Array]:
    """Rides a straight rail beside the target, from ``position`` to ``to``."""
    path = smooth(subject.centre, 0.5 * subject.fps)
    if rig.position is not None and rig.to is not None:
        ends = np.array([rig.position, rig.to], float)
        begin = ends[0]
    else:
        side = _abreast(subject, distance) if rig.azimuth is None else rig.azimuth
        ends = path[[0, -1]] + _arm(np.radians([side]), distance, rig.height)
        begin = path[0]  # it looks obliquely at other sides: ahead of the target or behind it, all along the rail
    rail = ends[1] - ends[0]
    along = np.clip((path - begin) @ rail / max(float(rail @ rail), 1e-9), 0.0, 1.0)
    return ends[0] + smooth(along, 0.4 * subject.fps)[:, None] * rail, path


def _crane(rig: CameraRig, subject: Subject, distance: float, world: Any) -> tuple[Array, Array]:
    """Stands beside the middle of the path and rises by ``rise`` m, with a gentle start and end."""
    low = replace(rig, height=0.05 * distance) if rig.height is None else rig
    place = np.array(rig.position, float) if rig.position is not None else _beside(low, subject, distance, 0.5)
    rise = 0.6 * distance if rig.rise is None else rig.rise
    t = np.linspace(0.0, 1.0, len(subject.centre)) if len(subject.centre) > 1 else np.zeros(1)
    ease = t**3 * (10 - 15 * t + 6 * t**2)
    return place + np.outer(ease, (0.0, 0.0, rise)), smooth(subject.centre, 0.3 * subject.fps)


def _abreast(subject: Subject, distance: float) -> float:
    """Perpendicular to the path as a whole, degrees; for short paths, perpendicular to the heading."""
    path = subject.centre[-1] - subject.centre[0]
    far = np.linalg.norm(path[:2]) > distance / 2
    return float(np.degrees(np.arctan2(path[1], path[0]) if far else subject.headings[0])) + 90.0


def _half_ahead(share: float) -> Callable[[Subject, float], float]:
    """Perpendicular to the target's path after ``share`` of it, and slightly along it."""
    return lambda subject, distance: float(np.degrees(subject.headings[_after(subject, share)])) + 60.0


def _after(subject: Subject, share: float) -> int:
    return int(share * (len(subject.centre) - 1))


def _first_person(rig: CameraRig, subject: Subject, distance: float, world: Any) -> tuple[Array, Array]:
    """Fixed to the vehicle at ``eye``, by default in front of its nose, and looks ahead, rotated by ``azimuth``."""
    lower, upper = subject.outline.min(axis=0), subject.outline.max(axis=0)
    nose = (upper[0] + 0.05, (lower[1] + upper[1]) / 2, lower[2] + 0.6 * (upper[2] - lower[2]))
    T_wr = subject.matrices
    eyes = T_wr[:, :3, :3] @ np.array(rig.eye if rig.eye is not None else nose, float) + T_wr[:, :3, 3]
    turn = np.radians(rig.azimuth or 0.0)
    return eyes, eyes + T_wr[:, :3, :3] @ np.array([np.cos(turn), np.sin(turn), 0.0])


RIGS: Registry[Move] = Registry(
    "vehsim.camera_rigs",
    {
        "chase": Move(_chase, behind=True),
        "follow": Move(_follow),
        "orbit": Move(_orbit),
        "static": Move(_static, side=_half_ahead(0.5)),
        "fixed": Move(_static, side=_half_ahead(0.5)),
        "dolly": Move(_dolly, guided=False, side=_abreast),
        "crane": Move(_crane, guided=False, side=_half_ahead(0.5)),
        "fly_by": Move(_fly_by, fill=np.max, guided=False, side=_half_ahead(0.65)),
        "first_person": Move(_first_person, fill=None, guided=False, level=False),
    },
)
"""Rig name -> what it does."""


def _beside(rig: CameraRig, subject: Subject, distance: float, share: float) -> Array:
    """A place (3,) at ``distance`` from the target's position after ``share`` of its path, looking across the path."""
    side = rig.azimuth if rig.azimuth is not None else _half_ahead(share)(subject, distance)
    return np.asarray(subject.centre[_after(subject, share)] + _arm(np.radians([side]), distance, rig.height)[0])


def _arm(azimuth: Array, distance: float, height: float | None) -> Array:
    """Offset (n, 3) to a camera that looks along ``azimuth`` (n,) rad from ``distance``."""
    up = 0.18 * distance if height is None else height
    reach = np.sqrt(max(distance**2 - up**2, (0.2 * distance) ** 2))
    return np.stack([-reach * np.cos(azimuth), -reach * np.sin(azimuth), np.full(len(azimuth), up)], axis=1)
