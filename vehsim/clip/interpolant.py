"""The one interpolant of a clip: cubic Hermite on the group, from knot poses and knot twists.

Positions are cubic in the world with the knot velocities as slopes. Orientations are ``q_k exp(phi(s))`` with ``phi`` a
cubic whose end slopes make the body's angular velocity that of both knots. Joints are cubic with their rates, controls
linear (as the integrators take them). A channel that follows joints alone follows them between knots too; one that is
the integral of a rate is cubic with that rate, so that wheels roll where their vehicle goes; the others are monotone
where their knots are.

Planar vehicles are interpolated in the plane; the height and tilt that terrain gave them are interpolated like
channels.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, TypeVar

import numpy as np
from numpy.typing import NDArray

from vehsim.lie.quaternions import (
    conjugate,
    from_vectors,
    from_yaw,
    product,
    right_jacobian,
    right_jacobian_inverse,
    rotate,
    rotation_vectors,
    tilt_of,
    yaw_tilt,
)

if TYPE_CHECKING:
    from vehsim.clip.samples import Samples
    from vehsim.lie import Group

Array = NDArray[np.float64]
S = TypeVar("S", bound="Samples")

SAME = 1e-11
"""Times closer than this, s, are equal."""
JUMP = 0.01
"""An interval shorter than this share of both neighbours is a jump."""


def interpolate(clip: S, times: Array) -> S:
    """The clip at ``times`` (m,) s, all inside it."""
    rows = np.minimum(np.searchsorted(clip.times, times - SAME), len(clip) - 1)
    if len(clip) == 1 or np.all(np.abs(clip.times[rows] - times) < SAME):  # only knots: a clip on whole frames, baked
        return _select(clip, rows, times)
    k = np.clip(np.searchsorted(clip.times, times, side="right") - 1, 0, len(clip) - 2)
    h = clip.times[k + 1] - clip.times[k]
    s = (times - clip.times[k]) / h
    omega, velocity = spatial(clip)

    flat, tilt = _planar(clip)
    positions, linear = _hermite(s, h, clip.positions[k], clip.positions[k + 1], velocity[k], velocity[k + 1])
    orientations, angular = _rotations(s, h, flat[k], flat[k + 1], omega[k], omega[k + 1])
    joints, rates = _hermite(s, h, clip.joints[k], clip.joints[k + 1], clip.joint_rates[k], clip.joint_rates[k + 1])
    twists = _twists(clip.vehicle.group, orientations, angular, linear)
    channels, channel_rates = _channels(clip, times, joints)
    if tilt is not None:
        z, pitch, roll = monotone(clip.times, np.column_stack([clip.positions[:, 2], *tilt]), times).T
        positions[:, 2] = z
        orientations = product(orientations, yaw_tilt(np.zeros(len(times)), pitch, roll))
    return replace(
        clip,
        times=times,
        positions=positions,
        orientations=orientations,
        twists=twists,
        joints=joints,
        joint_rates=rates,
        controls=clip.controls[k] + s[:, None] * (clip.controls[k + 1] - clip.controls[k]),
        channels=channels,
        channel_rates=channel_rates,
        energy={name: np.interp(times, clip.times, values) for name, values in clip.energy.items()},
        commands={name: np.interp(times, clip.times, values) for name, values in clip.commands.items()},
    )


def channels_at(clip: Samples, times: Array, joints: Array) -> dict[str, Array]:
    """Channels (m,) at ``times``, where the joints are ``joints`` (m, s).

    A channel that follows joints is its law at the joints, plus the interpolated difference of its knots from that law;
    this is zero unless a knot was edited.
    """
    return _channels(clip, times, joints)[0]


def _channels(clip: Samples, times: Array, joints: Array) -> tuple[dict[str, Array], dict[str, Array]]:
    """The same, and the rates (m,) of the channels that are integrals."""
    from vehsim.vehicles.definition.joint_channels import joint_channels

    if not clip.channels:
        return {}, {}
    at_knots, between = (joint_channels(clip.vehicle, values) for values in (clip.joints, joints))
    rest = [
        values - at_knots.get(name, 0.0) for name, values in clip.channels.items() if name not in clip.channel_rates
    ]
    columns = iter(monotone(clip.times, np.column_stack([np.zeros((len(clip), 0)), *rest]), times).T)
    k = np.clip(np.searchsorted(clip.times, times, side="right") - 1, 0, len(clip) - 2)
    h = clip.times[k + 1] - clip.times[k]
    s, found, rates = (times - clip.times[k]) / h, {}, {}
    for name, values in clip.channels.items():
        if name in clip.channel_rates:
            turning = clip.channel_rates[name][:, None]
            ends = (values[k, None], values[k + 1, None], turning[k], turning[k + 1])
            found[name], rates[name] = (column[:, 0] for column in _hermite(s, h, *ends))
        else:
            found[name] = next(columns) + between.get(name, 0.0)
    return found, rates


def spatial(clip: Samples) -> tuple[Array, Array]:
    """Angular velocity in body axes and linear velocity in world axes, (n, 3) each, from twists of any group."""
    n, d = clip.twists.shape
    omega, body = np.zeros((n, 3)), np.zeros((n, 3))
    if clip.vehicle.group.planar:
        omega[:, 2], body[:, :2] = clip.twists[:, 0], clip.twists[:, 1:3]
        return omega, rotate(_planar(clip)[0], body)
    omega = clip.twists[:, :3]
    body[:, : d - 3] = clip.twists[:, 3:]
    return omega, rotate(clip.orientations, body)


def _planar(clip: Samples) -> tuple[Array, tuple[Array, Array] | None]:
    """Orientations (n, 4) without the tilt of the terrain, and this tilt: pitch and roll, (n,) each."""
    if not clip.vehicle.group.planar:
        return clip.orientations, None
    yaw, pitch, roll = tilt_of(clip.orientations)
    if max(np.abs(pitch).max(), np.abs(roll).max(), np.ptp(clip.positions[:, 2])) < 1e-12:
        return clip.orientations, None
    return from_yaw(yaw), (pitch, roll)


def _twists(group: Group, q: Array, omega: Array, velocity: Array) -> Array:
    """Body twists (n, d): (omega, v), (omega_z, vx, vy) in the plane, omega alone on SO3."""
    body = rotate(conjugate(q), velocity)
    if group.fixed:
        return omega
    return np.column_stack([omega[:, 2], body[:, :2]]) if group.planar else np.hstack([omega, body])


def _hermite(s: Array, h: Array, a: Array, b: Array, da: Array, db: Array) -> tuple[Array, Array]:
    """Cubic through ``a, b`` (n, m) with slopes ``da, db`` over steps ``h`` (n,), and its slope, at ``s`` in 0..1."""
    s, h = s[:, None], h[:, None]
    rise = b - a
    value = a + s * h * da + s**2 * (3 * rise - h * (2 * da + db)) + s**3 * (h * (da + db) - 2 * rise)
    slope = da + 2 * s * (3 * rise / h - 2 * da - db) + 3 * s**2 * (da + db - 2 * rise / h)
    return value, slope


def _rotations(s: Array, h: Array, qa: Array, qb: Array, wa: Array, wb: Array) -> tuple[Array, Array]:
    """Unit quaternions (n, 4) and body angular velocities (n, 3) at ``s``."""
    relative = product(conjugate(qa), qb)
    relative = np.where(relative[:, :1] < 0, -relative, relative)
    phi = rotation_vectors(relative)
    # body velocity is J_r(phi) phi', so the slope at the far end is J_r(phi)^-1 w
    end = right_jacobian_inverse(phi, wb)
    value, slope = _hermite(s, h, np.zeros_like(phi), phi, wa, end)
    q = product(qa, from_vectors(value))
    return q / np.linalg.norm(q, axis=1, keepdims=True), right_jacobian(value, slope)


def monotone(x: Array, y: Array, at: Array) -> Array:
    """The monotone piecewise cubic through ``y`` (n, ...) of Fritsch and Butland (1984), the same as scipy's PCHIP,
    whose import takes as long as baking a clip.

    Where knots are so close that values jump, as where a motion is cut off, either side has its own slope.
    """
    h, v = np.diff(x), y.reshape(len(y), -1)
    jumps = np.flatnonzero((h[1:-1] < JUMP * h[:-2]) & (h[1:-1] < JUMP * h[2:])) + 2
    rates = np.vstack([_rates(*run) for run in zip(np.split(x, jumps), np.split(v, jumps), strict=True)])
    k = np.clip(np.searchsorted(x, at, side="right") - 1, 0, len(h) - 1)
    value, _ = _hermite((at - x[k]) / h[k], h[k], v[k], v[k + 1], rates[k], rates[k + 1])
    return value.reshape(len(at), *y.shape[1:])


def _rates(x: Array, v: Array) -> Array:
    """The slopes (n, m) of the monotone cubic at its knots."""
    h = np.diff(x)
    slopes = np.diff(v, axis=0) / h[:, None]
    rates = np.repeat(slopes[:1], len(x), axis=0)
    if len(x) > 2:
        a, b, before, after = 2 * h[1:, None] + h[:-1, None], h[1:, None] + 2 * h[:-1, None], slopes[:-1], slopes[1:]
        with np.errstate(divide="ignore", invalid="ignore"):
            rates[1:-1] = np.where(before * after > 0, (a + b) / (a / before + b / after), 0.0)
        rates[0] = _end_rate(h[0], h[1], slopes[0], slopes[1])
        rates[-1] = _end_rate(h[-1], h[-2], slopes[-1], slopes[-2])
    return rates


def _end_rate(h0: float, h1: float, slope: Array, inner: Array) -> Array:
    rate = ((2 * h0 + h1) * slope - h0 * inner) / (h0 + h1)
    rate = np.where(rate * slope <= 0, 0.0, rate)
    return np.where((slope * inner <= 0) & (np.abs(rate) > 3 * np.abs(slope)), 3 * slope, rate)


def _select(clip: S, rows: NDArray[np.intp], times: Array) -> S:
    names = ("positions", "orientations", "twists", "joints", "joint_rates", "controls")
    return replace(
        clip,
        times=times,
        **{name: getattr(clip, name)[rows] for name in names},
        channels={name: values[rows] for name, values in clip.channels.items()},
        channel_rates={name: values[rows] for name, values in clip.channel_rates.items()},
        energy={name: values[rows] for name, values in clip.energy.items()},
        commands={name: values[rows] for name, values in clip.commands.items()},
    )
