"""The frames at which motion is written: whole frames, additional ones in an open shutter, or as few as possible.

This module chooses frames from arrays and tolerances; `animation.py` writes them.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from vehsim.lie.quaternions import angles_between

if TYPE_CHECKING:
    from vehsim.clip.clip import Clip
    from vehsim.rig.rig import Rig

Array = NDArray[np.float64]

CHORD = 1e-3
"""Largest distance, m, of a point of a moving part from its path under linear interpolation of samples."""
MOST = 16
"""Largest number of samples within a shutter's opening."""


def clip_at(clip: Clip, frames: Array) -> Clip:
    """The clip at rising ``frames`` (m,); extrapolated beyond its ends, because a shutter may open early."""
    from vehsim.clip.interpolant import spatial

    times = (np.asarray(frames, float) - clip.start_frame) / float(clip.fps)
    inner, rows = np.unique(np.clip(times, clip.times[0], clip.times[-1]), return_inverse=True)
    inside = clip.at(inner)
    if len(inner) == len(times) and np.allclose(inner, times, rtol=0, atol=1e-9):
        return replace(inside, times=times)
    beyond = times - inner[rows]
    omega, velocity = (values[rows] for values in spatial(inside))
    # of a quarter frame, which is sufficient
    turned = np.column_stack([np.ones(len(times)), omega * beyond[:, None] / 2])
    turned /= np.linalg.norm(turned, axis=1, keepdims=True)
    names = ("twists", "joints", "joint_rates", "controls")
    return replace(
        inside,
        times=times,
        positions=inside.positions[rows] + velocity * beyond[:, None],
        orientations=_product(inside.orientations[rows], turned),
        channels={n: values[rows] + _end_slopes(clip, n, beyond) * beyond for n, values in inside.channels.items()},
        channel_rates={name: values[rows] for name, values in inside.channel_rates.items()},
        energy={name: values[rows] for name, values in inside.energy.items()},
        commands={name: values[rows] for name, values in inside.commands.items()},
        **{name: getattr(inside, name)[rows] for name in names},
    )


def _end_slopes(clip: Clip, channel: str, beyond: Array) -> Array:
    """A channel's rate (m,) at the end of the clip, for times beyond it."""
    if clip.duration == 0:
        return np.zeros(len(beyond))
    step = min(0.25 / float(clip.fps), clip.duration)
    first, last = clip.times[0], clip.times[-1]
    start = np.diff(clip.at([first, first + step]).channels[channel])[0] / step
    end = np.diff(clip.at([last - step, last]).channels[channel])[0] / step
    return np.where(beyond < 0, start, end)


def _product(p: Array, q: Array) -> Array:
    scalar = p[:, :1] * q[:, :1] - np.sum(p[:, 1:] * q[:, 1:], axis=1, keepdims=True)
    return np.hstack([scalar, p[:, :1] * q[:, 1:] + q[:, :1] * p[:, 1:] + np.cross(p[:, 1:], q[:, 1:])])


def frames_of(clip: Clip) -> Array:
    """The frames (n,) of a clip from `clip_at`, exactly as requested."""
    return np.asarray(clip.start_frame + clip.times * float(clip.fps))


class Shutter:
    """Fine samples of a clip within every frame's opening; each attribute uses a part of them."""

    def __init__(self, clip: Clip, opening: tuple[float, float], frames: tuple[int, int]) -> None:
        self.whole = np.arange(frames[0], frames[1] + 1, dtype=float)
        self.offsets = np.linspace(*opening, MOST + 1)
        fine, self.rows = np.unique(np.round(self.whole[:, None] + self.offsets, 9).ravel(), return_inverse=True)
        self.fine = clip_at(clip, fine)

    def pose_frames(self, reach: float, name: str) -> Array:
        """Frames (m,) at which a body of radius ``reach`` m needs samples of position and orientation."""
        shape = (len(self.whole), MOST + 1)
        positions = self.fine.positions[self.rows].reshape(*shape, 3)
        q = self.fine.orientations[self.rows].reshape(*shape, 4)

        def error(n: int) -> Array:
            off, turned = np.zeros(shape), np.zeros(shape)
            for a, b, s, inner in _spans(n):
                off[:, inner] = np.linalg.norm(_lerp(positions, a, b, s) - positions[:, inner], axis=-1)
                between = _lerp(q, a, b, s)
                between /= np.linalg.norm(between, axis=-1, keepdims=True)
                turned[:, inner] = angles_between(between, q[:, inner])
                off[:, inner] += reach * (
                    1 - np.cos(angles_between(q[:, [a]], q[:, [b]]) / 2)
                )  # renderers interpolate matrices linearly
            return (off + reach * turned).max(axis=1)

        return self._choose(error, f"{name}: its pose")

    def channel_frames(self, channel: str, factor: float, reach: float, turns: bool, name: str) -> Array:
        """Frames (m,) at which a driven part needs samples; ``reach`` m is the distance of its outermost point from its
        axis."""
        values = self.fine.channels[channel][self.rows].reshape(len(self.whole), MOST + 1) * factor

        def error(n: int) -> Array:
            off = np.zeros(values.shape)
            for a, b, s, inner in _spans(n):
                off[:, inner] = np.abs(_lerp(values[..., None], a, b, s)[..., 0] - values[:, inner])
                if turns:
                    chord = np.minimum(np.abs(values[:, [b]] - values[:, [a]]) / 2, np.pi)
                    off[:, inner] = reach * (off[:, inner] + 1 - np.cos(chord))
            return off.max(axis=1)

        return self._choose(error, f"{name}: {channel}")

    def _choose(self, error: Callable[[int], Array], what: str) -> Array:
        """Whole frames, and per opening the fewest of 1, 2, 4, 8, 16 spans with a sufficiently small error."""
        spans = np.full(len(self.whole), MOST)
        worst = np.zeros(len(self.whole))
        for n in (16, 8, 4, 2, 1):
            found = error(n)
            if n == MOST:
                worst = found
            spans = np.where(found <= CHORD, n, spans)
        if (excess := worst.max()) > CHORD:
            at = self.whole[worst.argmax()]
            warnings.warn(
                f"{what}: {1e3 * excess:.2g} mm off its path at frame {at:g} between {MOST} samples of the open "
                "shutter; show a fast rotor as its disc, or open the shutter for less",
                stacklevel=4,
            )
        chosen = [frame + self.offsets[:: MOST // n] for frame, n in zip(self.whole, spans, strict=True)]
        return np.unique(np.round(np.concatenate([self.whole, *chosen]), 9))


def _spans(n: int) -> list[tuple[int, int, Array, slice]]:
    """(first, last, weights, inner indices) of ``n`` spans over the fine samples of an opening."""
    width = MOST // n
    weights = np.linspace(0, 1, width + 1)
    return [(k * width, (k + 1) * width, weights, slice(k * width, (k + 1) * width + 1)) for k in range(n)]


def _lerp(values: Array, a: int, b: int, s: Array) -> Array:
    return values[:, [a]] + s[:, None] * (values[:, [b]] - values[:, [a]])


# ---------------------------------------------------------------- as few as will do


PLACE, TURN = "xformOp:translate", "xformOp:orient"
"""The pose's attributes, beside a rig's channels."""


def fewest_together(
    frames: Array, at: Clip, rig: Rig, reaches: Mapping[str, float], tolerance: float
) -> dict[str, NDArray[np.intp]]:
    """A subset of the samples of a clip at ``frames`` (n,): indices by channel, `PLACE` and `TURN`.

    Each attribute gets the fewest samples within its share of ``tolerance`` m, and all get the largest share at which
    every point is within the tolerance, including parts on moving carriers. ``reaches``: m, of the root ("") and of
    each channel.
    """
    levers = {name: reaches.get(name, 1.0) if d.op.startswith("rotate") else 1.0 for name, d in rig.drives.items()}
    carriers = {
        name: [up for up, d in rig.drives.items() if not d.prim or f"{drive.prim}/".startswith(f"{d.prim}/")]
        for name, drive in rig.drives.items()
    }
    share = tolerance
    while True:
        chosen = {PLACE: fewest(frames, at.positions, share / np.sqrt(3))}
        chosen[TURN] = fewest_poses(frames, at.orientations, share / max(reaches[""], 1e-3))
        off = np.linalg.norm(_between(frames, at.positions, chosen[PLACE]), axis=1)
        off += reaches[""] * slerp_errors(frames, at.orientations, chosen[TURN])
        errors = {}
        for name, lever in levers.items():
            chosen[name] = fewest(frames, at.channels[name], share / max(lever, 1e-3))
            errors[name] = lever * np.abs(_between(frames, at.channels[name], chosen[name]))[:, 0]
        carried = [np.sum([errors[up] for up in above], axis=0) for above in carriers.values()]
        if (off + np.max(carried, axis=0, initial=0.0)).max() <= tolerance or share < 1e-3 * tolerance:
            return chosen
        share *= 0.8


def _between(frames: Array, values: Array, chosen: NDArray[np.intp]) -> Array:
    """Distance (n, m) of the samples from linear interpolation between the chosen ones."""
    columns = np.reshape(values, (len(frames), -1)).T
    return np.stack([np.interp(frames, frames[chosen], column[chosen]) - column for column in columns], axis=1)


def fewest(frames: Array, values: Array, tolerance: float) -> NDArray[np.intp]:
    """The fewest of the samples whose linear interpolation is within ``tolerance`` of all of them, in every column.

    ``frames`` (n,), ``values`` (n, m); returns indices (k,), including the first and the last. The shortest path over
    all valid chords (Imai and Iri 1988): from sample i, a line with a slope within the narrowest cone reaches sample j.
    """
    n = len(frames)
    values = np.asarray(values, float).reshape(n, -1)
    if n <= 2:
        return np.unique([0, n - 1])
    cost = np.full(n, n + 1)
    before = np.zeros(n, np.intp)
    cost[0] = 0
    for i in range(n - 1):
        run = (frames[i + 1 :] - frames[i])[:, None]
        slope = (values[i + 1 :] - values[i]) / run
        low = np.maximum.accumulate(slope - tolerance / run, axis=0)
        high = np.minimum.accumulate(slope + tolerance / run, axis=0)
        # the cone of the samples between, not of the end itself: a chord passes through its own end
        low = np.vstack([np.full((1, values.shape[1]), -np.inf), low[:-1]])
        high = np.vstack([np.full((1, values.shape[1]), np.inf), high[:-1]])
        reached = i + 1 + np.flatnonzero(((slope >= low) & (slope <= high)).all(axis=1))
        better = reached[cost[reached] > cost[i] + 1]
        cost[better], before[better] = cost[i] + 1, i
    chain = [n - 1]
    while chain[-1]:
        chain.append(int(before[chain[-1]]))
    return np.array(chain[::-1], np.intp)


def fewest_poses(frames: Array, q: Array, angle: float) -> NDArray[np.intp]:
    """The same for unit quaternions (n, 4) that are slerped: every orientation is within ``angle`` rad."""
    tolerance = angle / 4  # of each of four components: their norm is half the angle
    for _ in range(8):
        chosen = fewest(frames, q, tolerance)
        if slerp_errors(frames, q, chosen).max() <= angle:
            return chosen
        tolerance /= 2
    return np.arange(len(frames))


def slerp_errors(frames: Array, q: Array, chosen: NDArray[np.intp]) -> Array:
    """Angles (n,) between the samples and slerps between those chosen."""
    from scipy.spatial.transform import Rotation, Slerp

    if len(frames) < 2:
        return np.zeros(len(frames))
    rotations = Rotation.from_quat(q, scalar_first=True)
    between = Slerp(frames[chosen], rotations[chosen])(frames)
    return np.asarray((between.inv() * rotations).magnitude())
