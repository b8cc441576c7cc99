"""Cameras: a rig (data) and a take's motion in, a camera per frame out. The same camera is exported and rendered.

A rig is a row of `CameraRig` and a function in `RIGS` that says where the camera would like to be and what it looks
at. What every camera then gets is common: a distance that fills the frame as asked, ground kept below it, motion
smoothed, the horizon level.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from vehsim.errors import InputError

if TYPE_CHECKING:
    from vehsim.clip import Clip

Array = NDArray[np.float64]

FILL_RANGE = (0.09, 0.33)
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

    ``rig``: one of `RIGS`. ``target``: the vehicle it looks at (the first one when None). ``fill``: share of the frame's
    height that the target takes, which sets the distance; ``distance`` m sets it outright. ``height`` m above the target.
    ``azimuth`` degrees, counter-clockwise: from straight behind (chase) or from looking along +X (follow, orbit).
    ``position`` and ``look_at`` (x, y, z) m place a static camera. ``turn`` degrees a second of an orbit. ``margin`` m
    above the ground that it never goes below.
    """

    name: str = "chase"
    rig: str = "chase"
    target: str | None = None
    lens_mm: float = 35.0
    aperture_width_mm: float = 36.0
    fill: float = 0.18
    distance: float | None = None
    height: float | None = None
    azimuth: float | None = None
    position: tuple[float, float, float] | None = None
    look_at: tuple[float, float, float] | None = None
    turn: float = 20.0
    margin: float = 1.5


@dataclass(frozen=True)
class Subject:
    """What a camera looks at: ``corners`` (n, k, 3) the outline's world points per frame, ``centre`` (n, 3), at ``fps``."""

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
    for _ in range(1 if rig.distance else 5):
        positions, aims = move(rig, subject, distance, world)
        positions = _keep_above_ground(positions, aims, world, rig, subject.fps)
        rotations = look_at(positions, aims)
        fills = projected_heights(positions, rotations, subject.corners, rig.lens_mm / aperture[1])
        distance *= _rescale(fills, rig.fill)
    return Camera(rig.name, every, positions, _quaternions(rotations), rig.lens_mm, aperture)


def look_at(positions: Array, aims: Array) -> Array:
    """Rotations R_wc (n, 3, 3) that look from ``positions`` to ``aims`` (n, 3) with a level horizon: X is horizontal."""
    forward = aims - positions
    forward /= np.linalg.norm(forward, axis=1, keepdims=True)
    right = np.stack([forward[:, 1], -forward[:, 0], np.zeros(len(forward))], axis=1)
    flat = np.linalg.norm(right, axis=1, keepdims=True)
    right = np.where(flat > 1e-9, right / np.maximum(flat, 1e-9), (0.0, -1.0, 0.0))
    return np.stack([right, np.cross(right, forward), -forward], axis=2)


def projected_heights(positions: Array, rotations: Array, corners: Array, zoom: float) -> Array:
    """Share of the frame's height (n,) that ``corners`` (n, k, 3) take; ``zoom`` is focal length over aperture height."""
    seen = np.einsum("nji,nkj->nki", rotations, corners - positions[:, None])
    depth = np.maximum(-seen[..., 2], 1e-3)
    return zoom * np.ptp(seen[..., 1] / depth, axis=1)


# ---------------------------------------------------------------- rigs


def _chase(rig: CameraRig, subject: Subject, distance: float, world: Any) -> tuple[Array, Array]:
    """Towed behind the target as on a rope: calm in hover, swinging wide round bends, never the jerks of the body."""
    path = _smooth(subject.centre, 0.45 * subject.fps)
    azimuth = np.radians(12.0 if rig.azimuth is None else rig.azimuth)
    height = 0.16 * distance if rig.height is None else rig.height
    reach = np.sqrt(max(distance**2 - height**2, (0.2 * distance) ** 2))
    rope = np.empty((len(path), 2))
    rope[0] = -reach * np.array([np.cos(subject.headings[0]), np.sin(subject.headings[0])])
    for k in range(1, len(path)):
        slack = path[k - 1, :2] + rope[k - 1] - path[k, :2]
        rope[k] = slack * (reach / max(float(np.linalg.norm(slack)), 1e-9))
    angle = _smooth(np.unwrap(np.arctan2(rope[:, 1], rope[:, 0])), 0.5 * subject.fps) + azimuth
    offset = np.stack([reach * np.cos(angle), reach * np.sin(angle), np.full(len(angle), height)], axis=1)
    calm = np.column_stack([path[:, :2], _smooth(subject.centre[:, 2], 0.8 * subject.fps)])
    return calm + offset, _smooth(subject.centre, 0.2 * subject.fps)


def _follow(rig: CameraRig, subject: Subject, distance: float, world: Any) -> tuple[Array, Array]:
    """Travels beside the target, always looking the same way."""
    path = _smooth(subject.centre, 0.35 * subject.fps)
    azimuth = np.radians(rig.azimuth if rig.azimuth is not None else np.degrees(np.median(subject.headings)) + 50.0)
    return path + _arm(np.full(len(path), azimuth), distance, rig.height), path


def _orbit(rig: CameraRig, subject: Subject, distance: float, world: Any) -> tuple[Array, Array]:
    """Turns about the target at ``turn`` degrees a second."""
    path = _smooth(subject.centre, 0.35 * subject.fps)
    start = np.radians(rig.azimuth if rig.azimuth is not None else np.degrees(subject.headings[0]) + 30.0)
    turn = start + np.radians(rig.turn) * np.arange(len(path)) / subject.fps
    return path + _arm(turn, distance, rig.height), path


def _static(rig: CameraRig, subject: Subject, distance: float, world: Any) -> tuple[Array, Array]:
    """Stands still at ``position`` and pans with the target, or looks at ``look_at`` and does not turn."""
    aims = _smooth(subject.centre, 0.2 * subject.fps)
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


def _keep_above_ground(positions: Array, aims: Array, world: Any, rig: CameraRig, fps: float) -> Array:
    """Lift the camera, smoothly and ahead of need, until neither it nor its line of sight touches the ground."""
    steps = np.linspace(0.0, 0.75, 10)
    sight = positions[:, None] + steps[:, None] * (aims - positions)[:, None]
    around = rig.margin * np.array([[0, 0], [1, 0], [-1, 0], [0, 1], [0, -1]], float)
    footprint = (sight[:, :, None, :2] + around).reshape(-1, 2)
    ground = np.asarray(world.height(footprint)).reshape(*sight.shape[:2], -1).max(axis=2)
    # Raising the camera by 1 raises its sight by 1 - step at that step.
    need = ((ground + rig.margin - sight[..., 2]) / (1.0 - steps)).max(axis=1)
    need = np.maximum(np.where(np.isfinite(need), need, 0.0), 0.0)
    if rig.rig in ("static", "fixed"):
        lift = np.full(len(need), need.max())
    else:
        lift = _envelope(need, fps)
    return positions + np.stack([np.zeros_like(lift), np.zeros_like(lift), lift], axis=1)


def _envelope(values: Array, fps: float) -> Array:
    """A smooth curve (n,) that lies nowhere below ``values``."""
    from scipy.ndimage import gaussian_filter1d, maximum_filter1d

    sigma = 0.7 * fps
    widened = maximum_filter1d(values, size=2 * int(4 * sigma) + 1, mode="nearest")
    return np.maximum(gaussian_filter1d(widened, sigma, mode="nearest", truncate=4.0), 0.0)


def _smooth(values: Array, sigma: float) -> Array:
    """Gaussian-filtered along the first axis, running straight on beyond both ends."""
    from scipy.ndimage import gaussian_filter1d

    pad = min(int(4 * sigma) + 1, len(values) - 1)
    if pad < 1:
        return np.array(values, float)
    before = 2 * values[:1] - values[pad:0:-1]
    after = 2 * values[-1:] - values[-2 : -pad - 2 : -1]
    padded = np.concatenate([before, values, after])
    return np.asarray(gaussian_filter1d(padded, sigma, axis=0, mode="nearest"))[pad : pad + len(values)]


def _rescale(fills: Array, wanted: float) -> float:
    """Factor on the distance that brings the usual fill to ``wanted`` and its extremes into `FILL_RANGE`."""
    usual = float(np.median(fills)) / wanted
    nearest, farthest = float(fills.max()) / FILL_RANGE[1], float(fills.min()) / FILL_RANGE[0]
    return float(np.clip(min(max(usual, nearest), max(farthest, nearest)), 0.3, 3.0))


def _subject(clip: Clip, frames: Array) -> Subject:
    """Outline, centre and heading of a vehicle on ``frames``, held still before and after its clip."""
    fps = float(clip.fps)
    times = np.clip((frames - clip.start_frame) / fps, clip.times[0], clip.times[-1])
    clip = clip.at(times)
    outline = vehicle_outline(clip.vehicle)
    matrices = clip.matrices()
    corners = np.einsum("nij,kj->nki", matrices[:, :3, :3], outline) + matrices[:, None, :3, 3]
    centre = clip.positions + (outline.max(axis=0) + outline.min(axis=0)) / 2 * (0.0, 0.0, 1.0)
    return Subject(corners, centre, _headings(matrices, fps), fps)


def _headings(matrices: Array, fps: float) -> Array:
    """Headings (n,) rad of the smoothed path; where the target hovers, that of its body."""
    path = _smooth(matrices[:, :2, 3], 0.5 * fps)
    velocity = np.gradient(path, axis=0) * fps if len(path) > 1 else np.zeros((1, 2))
    way = velocity + 0.5 * matrices[:, :2, 0]
    return np.unwrap(np.arctan2(way[:, 1], way[:, 0]))


def vehicle_outline(vehicle: Any) -> Array:
    """The outline (k, 3) m of a vehicle in its rig root's frame: the hull of all its parts; a 2 m cube without a rig."""
    from scipy.spatial import ConvexHull

    from vehsim.parts import read_parts

    if vehicle.rig is None:
        return np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (0, 2)], float)
    parts = read_parts(vehicle.rig.asset, vehicle.rig.root or None)
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
