"""Cameras: a rig (data) and a take's motion in, a camera per frame out. The same camera is exported and rendered.

A rig is a row of `CameraRig` and a row of `RIGS` (`_camera_rigs.py`) that says where the camera would like to be and
what it looks at. What every camera then gets is common: a distance that fills the frame as asked, ground kept below it
and obstacles out of its sight, motion smoothed, the horizon level. A cut list joins cameras into one more.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from vehsim._cache import Stamp, kept_arrays, stamp
from vehsim._camera_path import Parked, Surroundings, blocked, calm, envelope, lift, smooth, steer
from vehsim._camera_rigs import RIGS as RIGS
from vehsim._camera_rigs import Move
from vehsim._quaternions import continuous, from_vectors, matrices, quaternions
from vehsim.errors import InputError

if TYPE_CHECKING:
    from vehsim.clip import Clip

Array = NDArray[np.float64]

JERK = 6.0
"""Most jerk of a camera, in its distances a cubed second."""
CUT = "cut"
"""The name of the camera that a shot's cut list makes of the others."""
JUMP = 1e-3
"""How long a cut takes, in frames: USD joins samples by straight lines."""
FILL_RANGE = (0.09, 0.34)
"""Share of the frame's height that a target shall keep to, as tall as it is upright."""
SIDES = np.array([0.0, 180.0, 60.0, -60.0, 120.0, -120.0])
"""Where else a camera that is put in a place may stand, degrees round its target from its own choice."""
STEP_ASIDE = 0.02
"""What standing on the other side costs, in mean depth of what hides the target, in distances."""
STILL = 0.05
"""How far, m, a parked vehicle may move."""
TILTED = 0.55
"""Most that it may take of it as it is: pitched steeply, a long one is tall, and would else look small and far away."""


@dataclass(frozen=True)
class Camera:
    """A solved camera: looks along its own -Z with +Y up (the USD convention).

    ``frames`` (n,) time codes; ``positions`` (n, 3) m and ``orientations`` (n, 4) w, x, y, z, camera to world (T_wc);
    ``lens_mm`` focal length, one or (n,), and ``aperture_mm`` (width, height) in millimetres; ``clip_range`` near and
    far, m.
    """

    name: str
    frames: Array
    positions: Array
    orientations: Array
    lens_mm: float | Array = 35.0
    aperture_mm: tuple[float, float] = (36.0, 20.25)
    clip_range: tuple[float, float] = (0.3, 3000.0)


@dataclass(frozen=True)
class CameraRig:
    """What a camera shall do. What is None is chosen.

    ``rig``: one of `RIGS`. ``target``: the vehicle it looks at (the first one when None). ``fill``: share of the
    frame's height that the target takes, which sets the distance; ``distance`` m sets it outright. ``height`` m above
    the target. ``azimuth`` degrees, counter-clockwise: from straight behind (chase), from straight ahead (first_person)
    or from looking along +X (the others). ``position`` (x, y, z) m: where a static, fly_by or crane camera stands and a
    dolly's rail begins; ``to``: where the rail ends; ``look_at``: what a camera looks at that does not pan. ``turn``
    degrees a second of an orbit; ``rise`` m of a crane; ``eye`` (x, y, z) m in the root frame, of first_person.
    ``framing`` (x, y): where the target stands, from the centre (0, 0) to the right and upper edges (1, 1). ``level``:
    whether the horizon is, or banks with the vehicle. ``margin`` m above the ground that it never goes below.
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
    to: tuple[float, float, float] | None = None
    turn: float = 20.0
    rise: float | None = None
    eye: tuple[float, float, float] | None = None
    framing: tuple[float, float] | None = None
    level: bool | None = None
    margin: float = 1.5


@dataclass(frozen=True)
class Subject:
    """What a camera looks at: poses ``matrices`` T_wr (n, 4, 4) of ``outline`` (k, 3) m in the root frame, which is at
    ``corners`` (n, k, 3), upright at ``upright``, ``centre`` (n, 3); ``headings`` (n,) rad."""

    matrices: Array
    outline: Array
    corners: Array
    upright: Array
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
    framed = move.fill is not None and rig.distance is None
    distance = rig.distance or subject.size / (2 * rig.fill)
    zoom = rig.lens_mm / aperture[1]
    level = move.level if rig.level is None else rig.level
    around = Surroundings.of(world, _parked(clips, rig.target or next(iter(clips)), every))
    ups = np.broadcast_to((0.0, 0.0, 1.0), subject.centre.shape) if level else subject.matrices[:, :3, 2]
    for _ in range(5 if framed else 1):
        placed = _on_the_open_side(rig, move, subject, distance, around)
        positions, aims = move.place(placed, subject, distance, around)
        back = np.ones(len(positions))
        if move.guided and np.ptp(positions, axis=0).max() > 0:  # what stands still was put there
            positions = steer(positions, aims, around, rig.margin, subject.size / 2, subject.fps, move.behind)
            if framed:
                back = _back_off(positions, aims, subject, zoom)
                positions = aims + (positions - aims) * back[:, None]
        if move.fill is not None:
            positions = lift(positions, aims, around, rig.margin, subject.fps)
            apart = float(np.linalg.norm(positions - aims, axis=1).mean())
            positions = calm(positions, aims, around, rig.margin, subject.fps, JERK * apart)
        rotations = look_at(positions, aims, ups)
        if rig.framing is not None:
            rotations = _framed(rotations, rig.framing, aperture, rig.lens_mm, ups)
        if framed:
            fills = projected_heights(positions, rotations, subject.upright, zoom)
            distance *= _rescale(fills * back, rig.fill, move.fill)  # a while farther back makes no nearer else
    return Camera(rig.name, every, positions, continuous(quaternions(rotations)), rig.lens_mm, aperture)


def cut(name: str, cameras: Mapping[str, Camera], cuts: Sequence[tuple[float, str]]) -> Camera:
    """One camera from several: from each frame of ``cuts`` (frame, camera's name) on, it is that camera.

    It jumps half a frame before, so that neither side's motion blur sees the other. Raises ``InputError`` for unknown
    cameras, frames out of order and film backs that differ.
    """
    if not cuts or any(late[0] <= early[0] for early, late in pairwise(cuts)):
        raise InputError(f"cut {name!r}: frames = {[frame for frame, _ in cuts]!r}: give frames one after the other")
    for _, used in cuts:
        if used not in cameras:
            raise InputError(f"cut {name!r}: camera = {used!r}: no such camera; choose one of {', '.join(cameras)}")
    used_cameras = [cameras[used] for _, used in cuts]
    if len({camera.aperture_mm for camera in used_cameras}) > 1:
        raise InputError(f"cut {name!r}: its cameras' film backs differ; give all the same aperture_width_mm")
    pieces: list[tuple[Array, Array, Array, Array]] = []
    for k, camera in enumerate(used_cameras):
        begin = camera.frames[0] if k == 0 else cuts[k][0] - 0.5
        end = camera.frames[-1] if k == len(cuts) - 1 else cuts[k + 1][0] - 0.5 - JUMP
        inside = camera.frames[(camera.frames > begin) & (camera.frames < end)]
        frames = np.unique(np.concatenate([[begin], inside, [end]]))
        lens = np.interp(frames, camera.frames, np.broadcast_to(camera.lens_mm, camera.frames.shape))
        pieces.append((frames, *_between(camera, frames), lens))
    frames, positions, orientations, lens = (np.concatenate(parts) for parts in zip(*pieces, strict=True))
    first = used_cameras[0]
    return Camera(name, frames, positions, continuous(orientations), lens, first.aperture_mm, first.clip_range)


def _between(camera: Camera, frames: Array) -> tuple[Array, Array]:
    """Positions and orientations of a camera at any ``frames`` within its own."""
    from scipy.spatial.transform import Rotation, Slerp

    if len(camera.frames) == 1:
        return np.repeat(camera.positions, len(frames), axis=0), np.repeat(camera.orientations, len(frames), axis=0)
    positions = np.stack([np.interp(frames, camera.frames, column) for column in camera.positions.T], axis=1)
    turns = Slerp(camera.frames, Rotation.from_quat(camera.orientations, scalar_first=True))(frames)
    return positions, turns.as_quat(scalar_first=True)


def look_at(positions: Array, aims: Array, ups: Array | None = None) -> Array:
    """Rotations R_wc (n, 3, 3) that look from ``positions`` to ``aims`` (n, 3), upright along ``ups``.

    Without ``ups`` X is horizontal: a level horizon.
    """
    forward = aims - positions
    forward /= np.linalg.norm(forward, axis=1, keepdims=True)
    right = np.cross(forward, np.broadcast_to((0.0, 0.0, 1.0), forward.shape) if ups is None else ups)
    flat = np.linalg.norm(right, axis=1, keepdims=True)
    right = np.where(flat > 1e-9, right / np.maximum(flat, 1e-9), (0.0, -1.0, 0.0))
    return np.stack([right, np.cross(right, forward), -forward], axis=2)


def _framed(
    rotations: Array, framing: tuple[float, float], aperture: tuple[float, float], lens: float, ups: Array
) -> Array:
    """``rotations`` (n, 3, 3) turned so that what was in the centre stands at ``framing``."""
    across, along = (share * side / (2 * lens) for share, side in zip(framing, aperture, strict=True))
    return look_at(np.zeros(rotations.shape[:2]), rotations @ (-across, -along, -1.0), ups)


def projected_heights(positions: Array, rotations: Array, corners: Array, zoom: float) -> Array:
    """Share of the frame's height (n,) that ``corners`` (n, k, 3) take; ``zoom``: focal length over aperture height."""
    seen = (corners - positions[:, None]) @ rotations
    depth = np.maximum(-seen[..., 2], 1e-3)
    return zoom * np.ptp(seen[..., 1] / depth, axis=1)


def _back_off(positions: Array, aims: Array, subject: Subject, zoom: float) -> Array:
    """How many times as far (n,) to stand, ahead of need, where the target would fill too much of the frame."""
    rotations = look_at(positions, aims)
    upright, tilted = (projected_heights(positions, rotations, c, zoom) for c in (subject.upright, subject.corners))
    excess = np.maximum(upright / FILL_RANGE[1], tilted / TILTED) / 0.97
    return envelope(np.clip(excess, 1.0, 2.0), subject.fps)


# ---------------------------------------------------------------- what all cameras share


def _on_the_open_side(rig: CameraRig, move: Move, subject: Subject, distance: float, around: Surroundings) -> CameraRig:
    """A rig that is put in a place, but not told where: where least hides the target, best on the side of its own."""
    told = rig.azimuth is not None or rig.position is not None
    if move.side is None or told or (around.terrain is None and not around.standing):
        return rig
    options = move.side(subject, distance) + SIDES

    def hidden(azimuth: float) -> float:
        places = move.place(replace(rig, azimuth=azimuth), subject, distance, around)
        return float(blocked(*places, around, rig.margin, subject.size / 2).mean())

    costs = [hidden(azimuth) / distance for azimuth in options.tolist()] + STEP_ASIDE * np.abs(SIDES) / 180.0
    return replace(rig, azimuth=float(options[costs.argmin()])) if costs.argmin() else rig


def _parked(clips: Mapping[str, Clip], target: str, frames: Array) -> tuple[Parked, ...]:
    """The vehicles but the target that stand still on ``frames``: they may hide it."""
    others = [_subject(clip, frames) for name, clip in clips.items() if name != target]
    return tuple(Parked((s.corners[0],)) for s in others if np.ptp(s.corners, axis=0).max() < STILL)


def _rescale(fills: Array, wanted: float, measure: Any = np.median) -> float:
    """Factor on the distance that brings the usual fill to ``wanted`` and its extremes into `FILL_RANGE`."""
    usual = float(measure(fills)) / wanted
    if measure is np.max:  # the far end of a pass is as small as it is
        return float(np.clip(usual, 0.3, 3.0))
    nearest, farthest = float(fills.max()) / FILL_RANGE[1], float(fills.min()) / FILL_RANGE[0]
    return float(np.clip(min(max(usual, nearest), max(farthest, nearest)), 0.3, 3.0))


def _subject(clip: Clip, frames: Array) -> Subject:
    """Outline, centre and heading of a vehicle on ``frames``, held still before and after its clip."""
    fps = float(clip.fps)
    times = np.clip((frames - clip.start_frame) / fps, clip.times[0], clip.times[-1])
    times, sample = np.unique(times, return_inverse=True)
    matrices = clip.at(times).matrices()[sample]
    outline = vehicle_outline(clip.vehicle)
    attitudes = (matrices[:, :3, :3], _upright(matrices[:, :3, :3]))
    corners, upright = (outline @ R_wr.swapaxes(1, 2) + matrices[:, None, :3, 3] for R_wr in attitudes)
    centre = matrices[:, :3, 3] + (outline.max(axis=0) + outline.min(axis=0)) / 2 * (0.0, 0.0, 1.0)
    return Subject(matrices, outline, corners, upright, centre, _headings(matrices, fps), fps)


def _upright(R_wr: Array) -> Array:
    """Rotations (n, 3, 3) of vehicles with as little of their tilt taken off as makes their Z axis vertical."""
    tilt = np.cross(R_wr[:, :, 2], (0.0, 0.0, 1.0))
    sine = np.linalg.norm(tilt, axis=1, keepdims=True)
    angle = np.arctan2(sine[:, 0], R_wr[:, 2, 2])[:, None]
    return matrices(from_vectors(tilt * angle / np.maximum(sine, 1e-9))) @ R_wr


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
    return _outline(Path(vehicle.rig.asset), vehicle.rig.root or None, stamp(vehicle.rig.asset))


@lru_cache(maxsize=16)
def _outline(asset: Path, root: str | None, written: Stamp) -> Array:
    from vehsim.parts import read_parts

    parts = read_parts(asset, root)
    points = np.concatenate([part.points @ part.T_rp[:3, :3].T + part.T_rp[:3, 3] for part in parts])

    def hull() -> list[Array]:
        from scipy.spatial import ConvexHull

        return [points[ConvexHull(points, qhull_options="QJ").vertices]]

    return kept_arrays("outline", [points], hull)[0]


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
