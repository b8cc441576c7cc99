"""A motion for an audit: poses and velocities on an even grid of eighths of a frame, from a clip or a stage."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from fractions import Fraction
from types import MappingProxyType
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from vehsim.clip.clip import Clip

Array = NDArray[np.float64]

PER_FRAME = 8
"""Samples per frame, so that the motion between frames is measured too."""


@dataclass(frozen=True, eq=False)
class Track:
    """A vehicle's rig root at ``frames`` (n,), eighths of a frame apart.

    ``positions`` (n, 3) m; ``rotations`` (n, 3, 3), whose columns are the body's axes in the world; ``velocities`` (n,
    3) m/s, world axes; ``omegas`` (n, 3) rad/s, body axes; ``joints``, ``joint_rates``: name -> (n,); ``blur``: the
    possible difference between this representation and the motion, because a stage interpolates linearly between its
    samples.
    """

    frames: Array
    fps: Fraction
    positions: Array
    rotations: Array
    velocities: Array
    omegas: Array
    blur: Blur
    joints: Mapping[str, Array] = field(default_factory=dict)
    joint_rates: Mapping[str, Array] = field(default_factory=dict)
    controls: Array | None = None
    """(n, c), in the order of the vehicle's controls; a stage shows none."""
    channels: Mapping[str, Array] = field(default_factory=dict)
    """Channels of the rig, name -> (n,); a stage's poses contain them."""
    chords: bool = False
    """Whether the poses come from a stage, so that velocities are differences of them."""

    @property
    def seconds(self) -> Array:
        """Time of each sample, (n,) s since frame 0."""
        return self.frames / float(self.fps)

    def between(self, first: float, last: float) -> Track:
        """The samples from frame ``first`` to ``last``, both included; the nearest one if there is none.

        Samples outside do not affect a stage's velocities, unless the range is shorter than a frame.
        """
        inside = (self.frames >= first - 1e-6) & (self.frames <= last + 1e-6)
        if inside.all():
            return self
        if not inside.any():
            inside[int(np.argmin(np.abs(self.frames - first)))] = True
        rows = np.flatnonzero(inside)
        if not self.chords or len(rows) in range(PER_FRAME + 1):
            return self._select(rows)
        joints = {name: values[rows] for name, values in self.joints.items()}
        return _of_chords(self.frames[rows], self.fps, self.positions[rows], self.rotations[rows], joints)

    def _select(self, rows: NDArray[np.intp]) -> Track:
        return Track(
            self.frames[rows],
            self.fps,
            self.positions[rows],
            self.rotations[rows],
            self.velocities[rows],
            self.omegas[rows],
            self.blur.at(rows),
            {name: values[rows] for name, values in self.joints.items()},
            {name: values[rows] for name, values in self.joint_rates.items()},
            None if self.controls is None else self.controls[rows],
            {name: values[rows] for name, values in self.channels.items()},
            self.chords,
        )


@dataclass(frozen=True, eq=False)
class Blur:
    """What linear interpolation between a stage's samples hides: ``position`` m, ``angle`` rad, ``velocity`` m/s and
    ``omega`` rad/s, (n,) each; ``joints``: name -> (n,), in the joint's unit."""

    position: Array
    angle: Array
    velocity: Array
    omega: Array
    joints: Mapping[str, Array] = field(default_factory=dict)

    @classmethod
    def none(cls, n: int) -> Blur:
        """No error: for a clip."""
        return cls(np.zeros(n), np.zeros(n), np.zeros(n), np.zeros(n))

    def at(self, rows: NDArray[np.intp]) -> Blur:
        """The same at some of the samples."""
        joints = {name: values[rows] for name, values in self.joints.items()}
        return Blur(self.position[rows], self.angle[rows], self.velocity[rows], self.omega[rows], joints)


def track_of_clip(clip: Clip, known: Track | None = None) -> Track:
    """A clip at eighths of a frame, through its own interpolant; ``known``: its track without channels."""
    from vehsim.clip.interpolant import channels_at, spatial
    from vehsim.lie.quaternions import matrices

    count = int(np.floor(float(clip.times[-1]) * float(clip.fps) * PER_FRAME + 1e-6))
    steps = np.arange(count + 1)
    times = np.minimum(steps / (PER_FRAME * float(clip.fps)), clip.times[-1])
    if known is not None:
        joints = np.column_stack([np.zeros((len(times), 0)), *known.joints.values()])
        return replace(known, channels=channels_at(clip, times, joints))
    at = clip.at(times)
    omegas, velocities = spatial(at)
    names = clip.vehicle.joints
    return Track(
        clip.start_frame + steps / PER_FRAME,
        clip.fps,
        at.positions,
        matrices(at.orientations),
        velocities,
        omegas,
        Blur.none(len(steps)),
        {name: at.joints[:, i] for i, name in enumerate(names)},
        {name: at.joint_rates[:, i] for i, name in enumerate(names)},
        at.controls,
        at.channels,
    )


def track_of_poses(
    frames: Array, fps: Fraction, T_wr: Array, joints: Mapping[str, Array] = MappingProxyType({})
) -> Track:
    """World matrices (n, 4, 4) of a rig root on eighths of a frame, as a stage composes them, and the ``joints`` that
    it shows, name -> (n,); velocities and rates by differences over one frame.

    A stage interpolates linearly, so that the mean over a frame is all it tells of a velocity.
    """
    return _of_chords(frames, fps, T_wr[:, :3, 3], T_wr[:, :3, :3], joints)


def _of_chords(frames: Array, fps: Fraction, positions: Array, rotations: Array, joints: Mapping[str, Array]) -> Track:
    half, rate, n = PER_FRAME // 2, float(fps), len(frames)
    centre = np.clip(np.arange(n), half, max(n - 1 - half, half))
    ahead, behind = np.minimum(centre + half, n - 1), np.maximum(centre - half, 0)
    span = np.maximum(ahead - behind, 1)[:, None] / (PER_FRAME * rate)
    velocities = (positions[ahead] - positions[behind]) / span
    relative = np.einsum("nji,njk->nik", rotations[behind], rotations[ahead])
    omegas = _rotation_vectors(relative) / span
    change, turning = _change(velocities), _change(omegas)
    turned = {name: (values[ahead] - values[behind]) / span[:, 0] for name, values in joints.items()}
    bent = {name: _change(rates[:, None]) / rate / 8 for name, rates in turned.items()}
    inside = np.arange(n) == centre  # if the frame is not centred on the sample, its mean rate belongs to another time
    # a chord's sagitta is an eighth of the change of its slope over a frame
    between = np.abs(frames - np.round(frames)) > 1e-6
    off = 1.0 + np.abs(np.arange(n) - centre) / half
    speed, turn = off * change + _bend(velocities, centre), off * turning + _bend(omegas, centre)
    return Track(
        frames,
        fps,
        positions,
        rotations,
        velocities,
        omegas,
        Blur(between * change / rate / 4, between * turning / rate / 4, speed, turn, bent),
        joints,
        {name: np.where(inside, rates, np.nan) for name, rates in turned.items()},
        chords=True,
    )


def _change(rates: Array) -> Array:
    """Change of a rate (n, 3) within the frame around each sample, (n,)."""
    n = len(rates)
    low, high = np.maximum(np.arange(n) - PER_FRAME, 0), np.minimum(np.arange(n) + PER_FRAME, n - 1)
    forward = np.linalg.norm(rates[high] - rates, axis=1)
    backward = np.linalg.norm(rates - rates[low], axis=1)
    return np.asarray(np.maximum(forward, backward))


def _bend(rates: Array, centre: NDArray[np.int64]) -> Array:
    """What the curvature of a rate (n, 3) adds between the last frame's ``centre`` and a sample near an end, (n,): the
    difference to the parabola through the means over three frames."""
    n = len(rates)
    beyond = np.arange(n) - centre
    inward = -PER_FRAME * np.sign(beyond)
    second, third = (rates[np.clip(centre + k * inward, 0, n - 1)] for k in (1, 2))
    frames = np.abs(beyond) / PER_FRAME
    return np.asarray((frames + frames**2) / 2 * np.linalg.norm(rates - 2 * second + third, axis=1))


def _rotation_vectors(R: Array) -> Array:
    """Rotation vectors (n, 3) rad of rotations (n, 3, 3) by less than half a turn."""
    axis = np.stack([R[:, 2, 1] - R[:, 1, 2], R[:, 0, 2] - R[:, 2, 0], R[:, 1, 0] - R[:, 0, 1]], axis=1)
    sine, cosine = np.linalg.norm(axis, axis=1) / 2, (np.trace(R, axis1=1, axis2=2) - 1) / 2
    angle = np.arctan2(sine, cosine)
    return np.asarray(axis * (angle / np.maximum(2 * sine, 1e-12))[:, None])
