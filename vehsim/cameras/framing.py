"""Solve cameras: from a rig (data) and a take's motion to a camera per frame. The same camera is exported and rendered.

A rig is a `CameraRig` and an entry of `RIGS` (`rigs.py`), which gives the desired places and aims. The rest is common
to all cameras: a distance that gives the requested fill, a view past ground and obstacles, smooth motion, a level
horizon. A cut list combines cameras into another one.
"""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import lru_cache
from itertools import chain, product
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from vehsim.cameras.camera import Camera, CameraRig, Subject
from vehsim.cameras.path import (
    Parked,
    Passing,
    Surroundings,
    all_around,
    blocked,
    buried_in,
    calm,
    crowded,
    envelope,
    goes_through,
    hidden,
    in_rock,
    raise_camera,
    smooth,
    steer,
)
from vehsim.cameras.rigs import RIGS, Move
from vehsim.cameras.view import only_sky, out_of_view
from vehsim.errors import InputError
from vehsim.lie.quaternions import continuous, from_vectors, matrices, quaternions
from vehsim.runtime.cache import Stamp, kept_arrays, stamp

if TYPE_CHECKING:
    from vehsim.clip.clip import Clip

Array = NDArray[np.float64]

JERK = 6.0
"""Largest jerk of a camera, in units of its distance per cubed second."""
FILL_RANGE = (0.09, 0.34)
"""Permitted range of the target's share of the frame's height, measured on the upright target."""
SIDES = np.array([0.0, 180.0, 60.0, -60.0, 120.0, -120.0])
"""Other azimuths for a camera at a fixed place, degrees from its own choice."""
STEP_ASIDE = 0.02
"""Cost of a camera on the opposite side: the mean length of obstructions in front of the target that it outweighs,
relative to the camera's distance."""
HIDDEN = 0.5
"""Cost of a target that obstacles hide all the time, on the same scale: a pole is thin, and hides what is behind it."""
LIFTS, STEP_UP = (0.0, 0.2, 0.4), 0.05
"""How much higher such a camera may be, and the cost of 1, relative to its distance."""
NEAREST, TOO_NEAR = 0.6, 0.2
"""The share of its distance to which the target may come, and the cost where it comes twice as near: the whole shot
would be taken from farther away."""
SPREAD = 16
"""Points at which a target may be hidden."""
UNSEEN = 0.25
"""How long obstacles may hide most of a target, or it may be outside the picture, without a warning, s: a post passes
through the picture."""
STILL = 0.05
"""Largest movement of a parked vehicle, m."""
OUTLINE = 2000
"""Most corners of a vehicle's outline: of more, those farthest in as many directions, within 3e-3 of its size."""
TILTED = 0.55
"""Largest share of the frame's height for the target with its pitch: a steeply pitched vehicle is tall, and would
otherwise be shown small and far away."""


def solve_camera(
    rig: CameraRig,
    clips: Mapping[str, Clip],
    world: Any,
    frames: tuple[int, int],
    aspect: float = 16 / 9,
    shown: Sequence[tuple[float, float]] | None = None,
) -> Camera:
    """The camera of ``rig`` for whole ``frames`` (first, last); ``aspect`` is width divided by height of the picture.

    ``shown``: the frames (first, last) that a cut list shows of it, by default all: warnings of a target that is hidden
    or outside the picture, and of nothing but sky, count only these.

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
    around = Surroundings.of(world, *_others(clips, world, rig.target or next(iter(clips)), every))
    ups = np.broadcast_to((0.0, 0.0, 1.0), subject.centre.shape) if level else subject.matrices[:, :3, 2]
    too_near, too_far = 0.0, np.inf
    for _ in range(5 if framed else 1):
        positions, aims = _placed(rig, move, subject, distance, around)
        back = np.ones(len(positions))
        if move.guided and np.ptp(positions, axis=0).max() > 0:  # a standing camera was given its place
            positions = steer(positions, aims, around, rig.margin, subject.size / 2, subject.fps, move.behind)
            if framed:
                back = _back_off(positions, aims, subject, zoom)
                positions = aims + (positions - aims) * back[:, None]
        if move.fill is not None:
            positions = raise_camera(positions, aims, around, rig.margin, subject.fps, not move.guided)
            apart = float(np.linalg.norm(positions - aims, axis=1).mean())
            positions = calm(positions, aims, around, rig.margin, subject.fps, JERK * apart, not move.guided)
        rotations = look_at(positions, aims, ups)
        if rig.framing is not None:
            rotations = _framed(rotations, rig.framing, aperture, rig.lens_mm, ups)
        if framed:
            fills = projected_heights(positions, rotations, subject.upright, zoom)
            factor = _rescale(fills, back, rig.fill, move.fill)
            too_near, too_far = (distance, too_far) if factor > 1 else (too_near, distance)
            distance *= factor
            if too_near < too_far and not too_near <= distance <= too_far:  # it would go to and fro between the two
                distance = np.sqrt(too_near * too_far)
    counts = np.ones(len(every), bool)
    if shown is not None:
        counts = np.any([(first <= every) & (every <= last) for first, last in shown], axis=0)
    view = positions, rotations, np.array(aperture) / (2 * rig.lens_mm)
    if (buried := in_rock(positions, around)).any():
        warnings.warn(
            f"camera {rig.name!r} is inside the rock at frame {every[buried.argmax()]:g}; give it another place, "
            "distance or azimuth",
            stacklevel=2,
        )
    elif rig.position is not None and (where := buried_in(rig.position, around)):
        warnings.warn(
            f"camera {rig.name!r}: position = {list(rig.position)} is {where}, and the camera "
            f"{'stays there' if np.allclose(positions[0], rig.position) else 'was raised'}; give it another place",
            stacklevel=2,
        )
    elif move.fill is not None and (through := goes_through(positions, around)):
        warnings.warn(
            f"camera {rig.name!r} goes through {through[1]} at frame {every[through[0]]:g}; give it another place, "
            "distance, height or azimuth",
            stacklevel=2,
        )
    elif (outside := counts & _outside(rig, move, view, subject, clips, every)).sum() > UNSEEN * subject.fps:
        begin, end = every[outside][[0, -1]]
        remedy = "put it farther away" if rig.look_at is None else "leave out look_at, so that it pans"
        warnings.warn(
            f"camera {rig.name!r}: its target is outside the picture in {outside.sum()} of {counts.sum()} frames, "
            f"first in {begin:g}, last in {end:g}; {remedy}, or give it a shorter lens_mm or another place",
            stacklevel=2,
        )
    elif (unseen := counts & _unseen(rig, move, positions, subject, around)).sum() > UNSEEN * subject.fps:
        warnings.warn(
            f"camera {rig.name!r}: obstacles hide most of its target in {unseen.sum()} of {counts.sum()} frames, first "
            f"in {every[unseen.argmax()]:g}; give it another place, distance, height or azimuth",
            stacklevel=2,
        )
    elif around.terrain is not None or getattr(world, "water", None) is not None:
        moving = (_subject(clip, every) for clip in (*clips.values(), *(m.clip for m in getattr(world, "moving", ()))))
        seen = ((s.matrices, s.outline) for s in moving)
        standing = ((np.eye(4)[None], hull) for obstacle in around.standing for hull in obstacle.hulls)
        if (sky := counts & only_sky(*view, around, chain(standing, seen))).any():
            warnings.warn(
                f"camera {rig.name!r} shows only the sky in {sky.sum()} of {counts.sum()} frames, first in "
                f"{every[sky.argmax()]:g}; tilt it down with framing = [0, 0.5], or give it a shorter lens_mm or "
                "another rig",
                stacklevel=2,
            )
    return Camera(rig.name, every, positions, continuous(quaternions(rotations)), rig.lens_mm, aperture)


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
    """``rotations`` (n, 3, 3) turned so that the centre of the picture moves to ``framing``."""
    across, along = (share * side / (2 * lens) for share, side in zip(framing, aperture, strict=True))
    return look_at(np.zeros(rotations.shape[:2]), rotations @ (-across, -along, -1.0), ups)


def projected_heights(positions: Array, rotations: Array, corners: Array, zoom: float) -> Array:
    """Share of the frame's height (n,) that ``corners`` (n, k, 3) occupy; ``zoom``: focal length divided by aperture
    height."""
    seen = (corners - positions[:, None]) @ rotations
    depth = np.maximum(-seen[..., 2], 1e-3)
    return zoom * np.ptp(seen[..., 1] / depth, axis=1)


def _back_off(positions: Array, aims: Array, subject: Subject, zoom: float) -> Array:
    """Factor (n,) on the distance, ahead of time, where the target would fill too much of the frame."""
    rotations = look_at(positions, aims)
    upright, tilted = (projected_heights(positions, rotations, c, zoom) for c in (subject.upright, subject.corners))
    excess = np.maximum(upright / FILL_RANGE[1], tilted / TILTED) / 0.97
    return envelope(np.clip(excess, 1.0, 2.0), subject.fps)


# ---------------------------------------------------------------- what all cameras share


def _placed(rig: CameraRig, move: Move, subject: Subject, distance: float, around: Surroundings) -> tuple[Array, Array]:
    """Desired places and aims (n, 3). A still rig is placed where least hides the target and the target does not come
    too near, preferably on its own side, and raised only where that shows more; the shot may place it instead."""
    if move.side is None or rig.azimuth is not None or rig.position is not None:
        return move.place(rig, subject, distance, around)
    best, least = move.place(rig, subject, distance, around), np.inf
    own = move.side(subject, distance)
    targets = _spread(subject)
    some = slice(None, None, max(1, round(subject.fps / 4)))
    for aside, lift in product(SIDES, LIFTS if around.standing and rig.height is None else LIFTS[:1]):
        at = rig if aside == 0 else replace(rig, azimuth=float(own + aside))
        positions, aims = move.place(at, subject, distance, around)
        positions = positions + np.array((0.0, 0.0, lift * distance))
        nearest = float(np.linalg.norm(positions - aims, axis=1).min())
        cost = (
            float(blocked(positions, aims, around, rig.margin, subject.size / 2).mean()) / distance
            + HIDDEN * float(hidden(positions[some], targets[some], around).mean())
            + HIDDEN * float(crowded(positions, around, 0.5 * rig.margin).any())
            + TOO_NEAR * max(0.0, NEAREST * distance / max(nearest, 1e-9) - 1.0)
            + STEP_ASIDE * abs(aside) / 180.0
            + STEP_UP * lift
        )
        if cost < least:
            best, least = (positions, aims), cost
    return best


def _outside(
    rig: CameraRig,
    move: Move,
    view: tuple[Array, Array, Array],
    subject: Subject,
    clips: Mapping[str, Clip],
    frames: Array,
) -> NDArray[np.bool_]:
    """On which ``frames`` (n,) nothing of the target is in the ``view``, see `out_of_view`, of a camera that does not
    ride on it. One that looks at a place, and names no target, may show any vehicle."""
    if move.fill is None:
        return np.zeros(len(frames), bool)
    any_will_do = rig.target is None and rig.look_at is not None
    shown = (_subject(clip, frames) for clip in clips.values()) if any_will_do else (subject,)
    return np.all([out_of_view(*view, each.matrices, each.outline) for each in shown], axis=0)


def _unseen(rig: CameraRig, move: Move, positions: Array, subject: Subject, around: Surroundings) -> NDArray[np.bool_]:
    """On which frames (n,) obstacles hide most of the target, of a camera that looks at it."""
    if move.fill is None or rig.look_at is not None:
        return np.zeros(len(positions), bool)
    return hidden(positions, _spread(subject), around) > 0.5


def _spread(subject: Subject) -> Array:
    """Points (n, k, 3) all over the target, a little inside its outline."""
    places = np.unique((subject.outline @ all_around(SPREAD).T).argmax(axis=0))
    middle = subject.corners.mean(axis=1, keepdims=True)
    return middle + 0.8 * (subject.corners[:, places] - middle)


def _others(
    clips: Mapping[str, Clip], world: Any, target: str, frames: Array
) -> tuple[tuple[Parked, ...], tuple[Passing, ...]]:
    """The other vehicles: those that stand still on ``frames`` may hide the target, cameras keep clear of the rest."""
    everyone = {**{one.name: one.clip for one in getattr(world, "moving", ())}, **clips}
    others = {name: _subject(clip, frames) for name, clip in everyone.items() if name != target}
    still = {name for name, s in others.items() if np.ptp(s.corners, axis=0).max() < STILL}
    parked = tuple(Parked((s.corners[0],)) for name, s in others.items() if name in still)
    moving = {name: s for name, s in others.items() if name not in still}
    passing = tuple(
        Passing(name, np.asarray(np.linalg.inv(s.matrices), float), s.outline) for name, s in moving.items()
    )
    return parked, passing


def _rescale(fills: Array, back: Array, wanted: float, measure: Any = np.median) -> float:
    """Factor on the distance that brings the typical fill to ``wanted`` and its extremes into `FILL_RANGE`.

    Some frames that are farther ``back`` by these factors (n,) do not make the others nearer. Nor do frames that would
    be too near without them, such as where rock leaves no room, move the whole camera away.
    """
    usual = float(measure(fills * back)) / wanted
    if measure is np.max:  # the far end of a pass may be small
        return float(np.clip(usual, 0.3, 3.0))
    nearest, farthest = float(fills.max()) / FILL_RANGE[1], float((fills * back).min()) / FILL_RANGE[0]
    return float(np.clip(min(max(usual, nearest), max(farthest, nearest)), 0.3, 3.0))


def _subject(clip: Clip, frames: Array) -> Subject:
    """Outline, centre and heading of a vehicle on ``frames``, constant before and after its clip."""
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
    """Rotations (n, 3, 3) of vehicles without their tilt, so that their Z axis is vertical."""
    tilt = np.cross(R_wr[:, :, 2], (0.0, 0.0, 1.0))
    sine = np.linalg.norm(tilt, axis=1, keepdims=True)
    angle = np.arctan2(sine[:, 0], R_wr[:, 2, 2])[:, None]
    return matrices(from_vectors(tilt * angle / np.maximum(sine, 1e-9))) @ R_wr


def _headings(matrices: Array, fps: float) -> Array:
    """Headings (n,) rad of the smoothed path; while the target hovers, that of its body."""
    path = smooth(matrices[:, :2, 3], 0.5 * fps)
    velocity = np.gradient(path, axis=0) * fps if len(path) > 1 else np.zeros((1, 2))
    course = velocity + 0.5 * matrices[:, :2, 0]
    return np.unwrap(np.arctan2(course[:, 1], course[:, 0]))


def vehicle_outline(vehicle: Any) -> Array:
    """The outline (k, 3) m of a vehicle in its rig root's frame: its parts' hull; a 2 m cube without a rig."""
    if vehicle.rig is None:
        return np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (0, 2)], float)
    return _outline(Path(vehicle.rig.asset), vehicle.rig.root or None, stamp(vehicle.rig.asset))


@lru_cache(maxsize=16)
def _outline(asset: Path, root: str | None, written: Stamp) -> Array:
    from vehsim.rig.parts import read_parts

    parts = read_parts(asset, root)
    points = np.concatenate([part.points @ part.T_rp[:3, :3].T + part.T_rp[:3, 3] for part in parts])

    def hull() -> list[Array]:
        from scipy.spatial import ConvexHull

        corners = points[ConvexHull(points, qhull_options="QJ").vertices]
        if len(corners) > OUTLINE:
            corners = corners[np.unique((corners @ all_around(OUTLINE).T).argmax(axis=0))]
        return [corners]

    return kept_arrays("outline-2", [points], hull)[0]


def _check(rig: CameraRig, clips: Mapping[str, Clip]) -> None:
    if rig.rig not in RIGS:
        raise InputError(
            "unknown",
            f"choose one of {', '.join(sorted(RIGS))}",
            key="rig",
            value=rig.rig,
            subject=f"camera {rig.name!r}",
        )
    if not clips:
        raise InputError("there is no vehicle to look at", "add a [[vehicle]]", subject=f"camera {rig.name!r}")
    if rig.target is not None and rig.target not in clips:
        names = ", ".join(clips)
        raise InputError(
            "no such vehicle", f"choose one of {names}", key="target", value=rig.target, subject=f"camera {rig.name!r}"
        )
    if rig.look_at is not None and rig.position is not None and tuple(rig.look_at) == tuple(rig.position):
        raise InputError(
            "the camera is at this point",
            "give another point to look at",
            key="look_at",
            value=rig.look_at,
            subject=f"camera {rig.name!r}",
        )
