"""Cameras: a rig (data) and a take's motion in, a camera per frame out. The same camera is exported and rendered.

A rig is a row of `CameraRig` and a function in `RIGS` that says where the camera would like to be and what it looks
at. What every camera then gets is common: a distance that fills the frame as asked, ground kept below it, motion
smoothed, the horizon level.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from vehsim._camera_path import envelope, lift, smooth, steer
from vehsim.errors import InputError

if TYPE_CHECKING:
    from vehsim.clip import Clip

Array = NDArray[np.float64]

FILL_RANGE = (0.09, 0.34)
"""Share of the frame's height that a target shall keep to."""


@dataclass(frozen=True)
class Camera:
    """A solved camera: looks along its own -Z with +Y up (the USD convention).

    ``frames`` (n,) time codes; ``positions`` (n, 3) m and ``orientations`` (n, 4) w, x, y, z, camera to world (T_wc);
    ``lens_mm`` focal length and ``aperture_mm`` (width, height) in millimetres; ``clip_range`` near and far, m.
    """

    name: str
    frames: Array
    positions: Array
    orientations: Array
    lens_mm: float = 35.0
    aperture_mm: tuple[float, float] = (36.0, 20.25)
    clip_range: tuple[float, float] = (0.3, 3000.0)


@dataclass(frozen=True)
class CameraRig:
    """What a camera shall do. What is None is chosen.

    ``rig``: one of `RIGS`. ``target``: the vehicle it looks at (the first one when None). ``fill``: share of the
    frame's height that the target takes, which sets the distance; ``distance`` m sets it outright. ``height`` m above
    the target. ``azimuth`` degrees, counter-clockwise: from straight behind (chase) or from looking along +X (follow,
    orbit). ``position`` and ``look_at`` (x, y, z) m place a static camera. ``turn`` degrees a second of an orbit.
    ``margin`` m above the ground that it never goes below.
    """

    name: str = "chase"
    rig: str = "chase"
    target: str | None = None
    lens_mm: float = 35.0
    aperture_width_mm: float = 36.0
    fill: float = 0.30
    distance: float | None = None
    height: float | None = None
    azimuth: float | None = None
    position: tuple[float, float, float] | None = None
    look_at: tuple[float, float, float] | None = None
    turn: float = 20.0
    margin: float = 1.5


@dataclass(frozen=True)
class Subject:
    """What a camera looks at: the outline's points ``corners`` (n, k, 3), ``centre`` (n, 3), ``headings`` (n,)."""

    corners: Array
    centre: Array
    headings: Array
    fps: float

    @property
    def size(self) -> float:
        """Largest extent, m."""
        return float(np.ptp(self.corners[0], axis=0).max())


def solve_camera(
    rig: CameraRig, clips: Mapping[str, Clip], world: Any, frames: tuple[int, int], aspect: float = 16 / 9
) -> Camera:
    """The camera of ``rig`` for whole ``frames`` (first, last); ``aspect`` is width over height of the picture.

    Raises ``InputError`` for an unknown rig or target.
    """
    _check(rig, clips)
    every = np.arange(frames[0], frames[1] + 1, dtype=float)
    subject = _subject(clips[rig.target or next(iter(clips))], every)
    aperture = (rig.aperture_width_mm, rig.aperture_width_mm / aspect)
    move = RIGS[rig.rig]
    distance = rig.distance or subject.size / (2 * rig.fill)
    zoom = rig.lens_mm / aperture[1]
    for _ in range(1 if rig.distance else 5):
        positions, aims = move(rig, subject, distance, world)
        if np.ptp(positions, axis=0).max() > 0:  # what stands still was put there
            positions = steer(positions, aims, world, rig.margin, subject.size / 2, subject.fps)
            if rig.distance is None:
                positions = _back_off(positions, aims, subject, zoom)
        positions = lift(positions, aims, world, rig.margin, subject.fps)
        rotations = look_at(positions, aims)
        fills = projected_heights(positions, rotations, subject.corners, zoom)
        distance *= _rescale(fills, rig.fill)
    return Camera(rig.name, every, positions, _quaternions(rotations), rig.lens_mm, aperture)


def look_at(positions: Array, aims: Array) -> Array:
    """Rotations R_wc (n, 3, 3) that look from ``positions`` to ``aims`` (n, 3), X horizontal: a level horizon."""
    forward = aims - positions
    forward /= np.linalg.norm(forward, axis=1, keepdims=True)
    right = np.stack([forward[:, 1], -forward[:, 0], np.zeros(len(forward))], axis=1)
    flat = np.linalg.norm(right, axis=1, keepdims=True)
    right = np.where(flat > 1e-9, right / np.maximum(flat, 1e-9), (0.0, -1.0, 0.0))
    return np.stack([right, np.cross(right, forward), -forward], axis=2)


def projected_heights(positions: Array, rotations: Array, corners: Array, zoom: float) -> Array:
    """Share of the frame's height (n,) that ``corners`` (n, k, 3) take; ``zoom``: focal length over aperture height."""
    seen = (corners - positions[:, None]) @ rotations
    depth = np.maximum(-seen[..., 2], 1e-3)
    return zoom * np.ptp(seen[..., 1] / depth, axis=1)


def _back_off(positions: Array, aims: Array, subject: Subject, zoom: float) -> Array:
    """Positions (n, 3) drawn back, ahead of need, where the target banks and would fill too much of the frame."""
    fills = projected_heights(positions, look_at(positions, aims), subject.corners, zoom)
    factor = envelope(np.clip(fills / (0.97 * FILL_RANGE[1]), 1.0, 1.5), subject.fps)
    return aims + (positions - aims) * factor[:, None]


# ---------------------------------------------------------------- rigs


def _chase(rig: CameraRig, subject: Subject, distance: float, world: Any) -> tuple[Array, Array]:
    """Towed behind the target on a rope: calm in hover, wide round bends, never the jerks of the body."""
    path = smooth(subject.centre, 0.45 * subject.fps)
    height = 0.06 * distance if rig.height is None else rig.height
    reach = np.sqrt(max(distance**2 - height**2, (0.2 * distance) ** 2))
    first = _open_way(path[0], subject.headings[0], reach, world)
    rope = _tow(path[:, :2], first, reach)
    turn = smooth(np.unwrap(np.arctan2(rope[:, 1], rope[:, 0])), 0.5 * subject.fps)
    turn += np.radians(0.0 if rig.azimuth is None else rig.azimuth)
    level = smooth(subject.centre[:, 2], 0.8 * subject.fps)
    place = np.stack([path[:, 0] + reach * np.cos(turn), path[:, 1] + reach * np.sin(turn), level + height], axis=1)
    return place, smooth(subject.centre, 0.2 * subject.fps)


def _tow(path: Array, heading: float, length: float) -> Array:
    """A rope (n, 2) of ``length`` m from each point of ``path`` (n, 2) to what it tows, first straight behind."""
    rope = np.empty_like(path)
    rope[0] = -length * np.array([np.cos(heading), np.sin(heading)])
    for k in range(1, len(path)):
        pulled = path[k - 1] + rope[k - 1] - path[k]
        rope[k] = pulled * (length / max(float(np.linalg.norm(pulled)), 1e-9))
    return rope


def _open_way(start: Array, heading: float, length: float, world: Any) -> float:
    """The heading rad nearest to ``heading`` that has free air for ``length`` m behind ``start`` (3,)."""
    turns = np.radians(np.arange(0, 91, 5))
    headings = heading + np.concatenate([[0.0], np.stack([turns[1:], -turns[1:]], axis=1).ravel()])
    behind = -np.stack([np.cos(headings), np.sin(headings)], axis=1)[:, None] * np.linspace(0, length, 16)[:, None]
    ground = np.asarray(world.height((start[:2] + behind).reshape(-1, 2))).reshape(len(headings), -1).max(axis=1)
    blocked = np.maximum(np.where(np.isfinite(ground), ground, -np.inf) - start[2], 0.0)
    return float(headings[np.argmin(blocked + 0.1 * length * np.abs(headings - heading))])


def _follow(rig: CameraRig, subject: Subject, distance: float, world: Any) -> tuple[Array, Array]:
    """Travels beside the target, always looking the same way."""
    path = smooth(subject.centre, 0.35 * subject.fps)
    azimuth = np.radians(rig.azimuth if rig.azimuth is not None else np.degrees(np.median(subject.headings)) + 50.0)
    return path + _arm(np.full(len(path), azimuth), distance, rig.height), path


def _orbit(rig: CameraRig, subject: Subject, distance: float, world: Any) -> tuple[Array, Array]:
    """Turns about the target at ``turn`` degrees a second."""
    path = smooth(subject.centre, 0.35 * subject.fps)
    start = np.radians(rig.azimuth if rig.azimuth is not None else np.degrees(subject.headings[0]) + 30.0)
    turn = start + np.radians(rig.turn) * np.arange(len(path)) / subject.fps
    return path + _arm(turn, distance, rig.height), path


def _static(rig: CameraRig, subject: Subject, distance: float, world: Any) -> tuple[Array, Array]:
    """Stands still at ``position`` and pans with the target, or looks at ``look_at`` and does not turn."""
    aims = smooth(subject.centre, 0.2 * subject.fps)
    if rig.position is not None:
        place = np.array(rig.position, float)
    else:
        middle = subject.centre[len(subject.centre) // 2]
        side = np.radians(rig.azimuth if rig.azimuth is not None else np.degrees(np.median(subject.headings)) + 60.0)
        place = middle + _arm(np.array([side]), distance, rig.height)[0]
    if rig.look_at is not None:
        aims = np.broadcast_to(np.array(rig.look_at, float), aims.shape)
    return np.tile(place, (len(aims), 1)), aims


RIGS: dict[str, Callable[[CameraRig, Subject, float, Any], tuple[Array, Array]]] = {
    "chase": _chase,
    "follow": _follow,
    "orbit": _orbit,
    "static": _static,
    "fixed": _static,
}
"""Rig name -> positions and aims (n, 3) for a distance."""


def _arm(azimuth: Array, distance: float, height: float | None) -> Array:
    """Offset (n, 3) to a camera that looks along ``azimuth`` (n,) rad from ``distance``."""
    up = 0.18 * distance if height is None else height
    reach = np.sqrt(max(distance**2 - up**2, (0.2 * distance) ** 2))
    return np.stack([-reach * np.cos(azimuth), -reach * np.sin(azimuth), np.full(len(azimuth), up)], axis=1)


# ---------------------------------------------------------------- what all cameras share


def _rescale(fills: Array, wanted: float) -> float:
    """Factor on the distance that brings the usual fill to ``wanted`` and its extremes into `FILL_RANGE`."""
    usual = float(np.median(fills)) / wanted
    nearest, farthest = float(fills.max()) / FILL_RANGE[1], float(fills.min()) / FILL_RANGE[0]
    return float(np.clip(min(max(usual, nearest), max(farthest, nearest)), 0.3, 3.0))


def _subject(clip: Clip, frames: Array) -> Subject:
    """Outline, centre and heading of a vehicle on ``frames``, held still before and after its clip."""
    fps = float(clip.fps)
    times = np.clip((frames - clip.start_frame) / fps, clip.times[0], clip.times[-1])
    times, sample = np.unique(times, return_inverse=True)
    matrices = clip.at(times).matrices()[sample]
    outline = vehicle_outline(clip.vehicle)
    corners = outline @ matrices[:, :3, :3].swapaxes(1, 2) + matrices[:, None, :3, 3]
    centre = matrices[:, :3, 3] + (outline.max(axis=0) + outline.min(axis=0)) / 2 * (0.0, 0.0, 1.0)
    return Subject(corners, centre, _headings(matrices, fps), fps)


def _headings(matrices: Array, fps: float) -> Array:
    """Headings (n,) rad of the smoothed path; where the target hovers, that of its body."""
    path = smooth(matrices[:, :2, 3], 0.5 * fps)
    velocity = np.gradient(path, axis=0) * fps if len(path) > 1 else np.zeros((1, 2))
    way = velocity + 0.5 * matrices[:, :2, 0]
    return np.unwrap(np.arctan2(way[:, 1], way[:, 0]))


def vehicle_outline(vehicle: Any) -> Array:
    """The outline (k, 3) m of a vehicle in its rig root's frame: its parts' hull; a 2 m cube without a rig."""
    if vehicle.rig is None:
        return np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (0, 2)], float)
    stat = Path(vehicle.rig.asset).stat()
    return _outline(Path(vehicle.rig.asset), vehicle.rig.root or None, stat.st_mtime_ns, stat.st_size)


@lru_cache(maxsize=16)
def _outline(asset: Path, root: str | None, changed: int, size: int) -> Array:
    from scipy.spatial import ConvexHull

    from vehsim.parts import read_parts

    parts = read_parts(asset, root)
    points = np.concatenate([part.points @ part.T_rp[:3, :3].T + part.T_rp[:3, 3] for part in parts])
    return points[ConvexHull(points, qhull_options="QJ").vertices]


def _quaternions(rotations: Array) -> Array:
    """Quaternions (n, 4) w, x, y, z of rotations (n, 3, 3), continuous in sign."""
    from scipy.spatial.transform import Rotation

    quaternions = Rotation.from_matrix(rotations).as_quat(scalar_first=True)
    flips = np.where((quaternions[1:] * quaternions[:-1]).sum(axis=1) < 0, -1.0, 1.0)
    return quaternions * np.concatenate([[1.0], np.cumprod(flips)])[:, None]


def _check(rig: CameraRig, clips: Mapping[str, Clip]) -> None:
    if rig.rig not in RIGS:
        raise InputError(f"camera {rig.name!r}: rig = {rig.rig!r}: unknown; choose one of {', '.join(sorted(RIGS))}")
    if not clips:
        raise InputError(f"camera {rig.name!r}: there is no vehicle to look at; add a [[vehicle]]")
    if rig.target is not None and rig.target not in clips:
        names = ", ".join(clips)
        raise InputError(f"camera {rig.name!r}: target = {rig.target!r}: no such vehicle; choose one of {names}")
    if rig.look_at is not None and rig.position is not None and tuple(rig.look_at) == tuple(rig.position):
        raise InputError(f"camera {rig.name!r}: look_at = {rig.look_at!r}: the camera stands there; look elsewhere")
