"""Variables of a motion along a path at a smooth pace, or along a clip."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from vehsim.clip.clip import Clip
from vehsim.lie import SO3
from vehsim.lie.vectorized import for_rows
from vehsim.planning.guesses.pacing import pace, stopping
from vehsim.planning.problem.layout import Layout
from vehsim.planning.problem.transcription import Transcription
from vehsim.planning.request.legs import cuts_of, legs_between, mark_positions, poses_of
from vehsim.planning.request.marks import Mark, heading_of
from vehsim.planning.trim import swims, trim, upright
from vehsim.vehicles import Vehicle

Array = NDArray[np.float64]

SWING, SWINGS, LAG = 1.1, 0.6, 0.6
"""Initial guess for vehicles that swing joints: period, s; share of the joints' limits; phase lag between joints,
rad."""

ANGLES, SLOW = 61, 0.05
"""Steering angles tried for a vehicle on tyres; share of its largest speed below which it counts as at rest."""


def along_paths(
    transcription: Transcription,
    layout: Layout,
    marks: Sequence[Mark],
    paths: Sequence[Array],
    lengths: Array,
    wind: Any,
    aims: Sequence[tuple[int, int, Any, float]] = (),
) -> Array:
    """Variables (size,) of a motion along ``paths`` (one per leg), in balance as at rest in the wind.

    A path is a polyline (k, 3) m, of poses (k, 4) with headings in rad, along which the vehicle stops wherever it
    changes its direction, or of poses with shares of the leg's duration (k, 5). ``aims``: (first knot, last knot, point
    (3,) m, angle rad): between these knots the vehicle heads for the point, plus the angle to the right.
    """
    fraction, leg = _knot_fractions(layout)
    s, positions = np.empty(len(leg)), np.empty((len(leg), 3))
    rests = [(before.at_rest, after.at_rest) for before, after in pairwise(marks)]
    paths = [stopping(path, each) if path.shape[1] == 4 else path for path, each in zip(paths, rests, strict=True)]
    for j, path in enumerate(paths):
        s[leg == j] = _progress(path, pace(*rests[j]), fraction[leg == j])
        positions[leg == j] = _along(path, s[leg == j])[:, :3]
    headings = _headings(marks, paths, s, leg)
    for first, last, point, offset in aims:
        knots = np.arange(first, last + 1)
        to_point = np.asarray(point, float)[:2] - positions[knots, :2]
        headings[knots] = np.arctan2(to_point[:, 1], to_point[:, 0]) - offset
    headings = np.unwrap(headings) if len(aims) else headings
    trimmed, turns = trim(transcription.vehicle, tuple(wind)), upright(transcription.vehicle, headings, wind)
    return from_poses(transcription, layout, positions, turns, headings, lengths, trimmed)


def along_clip(
    transcription: Transcription, layout: Layout, marks: Sequence[Mark], clip: Clip, lengths: Array
) -> Array:
    """Variables (size,) of a clip of the same vehicle, with its joints and controls, moved onto the marks'
    positions."""
    fraction, leg = _knot_fractions(layout)
    begins, ends = clip_spans(clip, marks)
    # a hold has no length in the clip: all its knots are at one time
    times, knot = np.unique(begins[leg] + fraction * (ends - begins)[leg], return_inverse=True)
    motion, (at_marks, mark) = clip.at(times), np.unique(np.append(begins, ends[-1]), return_inverse=True)
    off = mark_positions(marks) - clip.at(at_marks).positions[mark]
    positions = motion.positions[knot] + (1 - fraction)[:, None] * off[leg] + fraction[:, None] * off[leg + 1]
    headings, controls = poses_of(motion)[knot, 3], motion.controls[knot]
    joints = motion.joints[knot]
    return from_poses(transcription, layout, positions, motion.orientations[knot], headings, lengths, controls, joints)


def clip_spans(clip: Clip, marks: Sequence[Mark]) -> tuple[Array, Array]:
    """Times at which a clip begins and ends every leg between marks, (legs,) s each."""
    times = clip.times[cuts_of(clip.positions, legs_between(marks))]
    return times[:-1], times[1:]


def from_poses(
    transcription: Transcription,
    layout: Layout,
    positions: Array,
    quaternions: Array,
    headings: Array,
    lengths: Array,
    c: Array,
    joints: Array | None = None,
) -> Array:
    """Variables from poses (knots, ...) of the rig root; velocities are differences.

    ``c``: controls (c,), or (knots, c); ``joints`` (knots, s): by default values that fit the motion.
    """
    vehicle, group, m = transcription.vehicle, transcription.vehicle.group, transcription.mechanics
    s = transcription.sizes[1]
    body = positions + np.einsum("nij,j->ni", SO3.matrix(quaternions), vehicle.origin)
    g = group.from_pose(np.hstack([body, quaternions]))
    if group.planar:
        g[:, 0] = headings
    h = np.repeat(lengths, layout.legs)
    xi = _difference(group, g[:-1], g[1:]) / h[:, None]
    if joints is not None:
        r, u = joints, np.diff(joints, axis=0) / h[:, None]
    else:
        r, u = _joints(vehicle, xi, h) if s else (np.zeros((layout.knots, 0)), np.zeros((layout.segments, 0)))
    at_knots = np.broadcast_to(c, (layout.knots, len(transcription.control_scale)))
    x = np.zeros(layout.size)
    pi = np.asarray(m.knot_momentum.map(len(u))(r[:-1].T, u.T, xi.T))
    velocities = np.asarray(m.knot_velocity_guess.map(len(u))(r[:-1].T, pi, at_knots[:-1].T)).T
    momenta = np.vstack([pi.T, pi[:, -1:].T])
    x[layout.knot(np.arange(layout.knots))] = np.hstack([g, r, momenta / transcription.momentum_scale]).T
    x[layout.velocity(np.arange(layout.segments))] = velocities.T
    x[layout.control(np.arange(layout.knots))] = (at_knots / transcription.control_scale).T
    x[layout.lengths] = lengths
    return x


def _knot_fractions(layout: Layout) -> tuple[Array, NDArray[np.intp]]:
    """Fraction of its leg (0 to 1) and leg of every knot."""
    fraction = np.concatenate([*(np.arange(count) / count for count in layout.legs), [1.0]])
    leg = np.repeat(np.arange(len(layout.legs)), layout.legs)
    return fraction, np.append(leg, len(layout.legs) - 1)


def _progress(path: Array, pace: Array, fraction: Array) -> Array:
    """Share of a path's length after fractions (n,) of the leg's duration: by the path's own shares, or a
    polynomial."""
    if path.shape[1] < 5:
        return np.asarray(np.polyval(pace, fraction), float)
    steps = _lengths(path)
    return np.interp(fraction, path[:, 4], steps) / max(steps[-1], 1e-9)


def _along(path: Array, share: Array) -> Array:
    """The points (n, k) of a path at shares (n,) of its length."""
    steps = _lengths(path)
    return np.column_stack([np.interp(share * steps[-1], steps, column) for column in path.T])


def _lengths(path: Array) -> Array:
    """Length of a path (k, ...) up to each of its points, m."""
    return np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(path[:, :3], axis=0), axis=1))])


def _headings(marks: Sequence[Mark], paths: Sequence[Array], s: Array, leg: NDArray[np.intp]) -> Array:
    """Headings (knots,) rad along the path, blended into the marks' own headings at both ends of a leg."""
    out = np.zeros(len(s))
    directions = np.zeros((len(s), 2))
    for j, path in enumerate(paths):
        at = s[leg == j]
        if path.shape[1] > 3:  # the path has headings
            out[leg == j] = _along(path, at)[:, 3]
        else:
            ahead = _along(path, np.minimum(1.0, at + 0.03)) - _along(path, np.maximum(0.0, at - 0.03))
            directions[leg == j] = ahead[:, :2]
    for i, (f, j, ahead) in enumerate(zip(s, leg, directions, strict=True)):
        if paths[j].shape[1] > 3:
            continue
        flat = float(np.hypot(ahead[0], ahead[1]))
        out[i] = np.arctan2(ahead[1], ahead[0]) if flat > 1e-6 else (out[i - 1] if i else 0.0)
        for mark, weight in ((marks[j], 1 - f / 0.15), (marks[j + 1], 1 - (1 - f) / 0.15)):
            wanted = heading_of(mark)
            if wanted is not None and weight > 0:
                out[i] += weight * _wrap(wanted - out[i])
    return np.unwrap(out)


def _wrap(angle: float) -> float:
    return float((angle + np.pi) % (2 * np.pi) - np.pi)


def _difference(group: Any, a: Array, b: Array) -> Array:
    """Algebra vectors (n, d) whose Cayley map takes ``a`` to ``b``."""
    step = group.matrix(group.compose(group.inverse(a), b))
    one = np.eye(step.shape[-1])
    # (e - x/2)^-1 (e + x/2) = g, so x = 2 (g - e) (g + e)^-1
    x = 2 * np.linalg.solve(np.swapaxes(step + one, 1, 2), np.swapaxes(step - one, 1, 2))
    basis = np.array([group.hat(e) for e in np.eye(group.dim)]).reshape(group.dim, -1)
    return np.swapaxes(x, 1, 2).reshape(len(a), -1) @ np.linalg.pinv(basis)


def _swing(vehicle: Vehicle, h: Array) -> tuple[Array, Array]:
    """Joints (n + 1, s) and rates (n, s) that swing with a phase lag from joint to joint, with growing and decaying
    amplitude."""
    t = np.concatenate([[0.0], np.cumsum(h)])
    share = t / t[-1]
    wave = 2 * np.pi * max(1, round(t[-1] / SWING)) * share
    most = np.array([min(-low, high) for low, high in (vehicle.joint_limits[joint] for joint in vehicle.joints)])
    r = SWINGS * most * (1 - (2 * share - 1) ** 4)[:, None] * np.sin(wave[:, None] - LAG * np.arange(len(most)))
    return r, np.diff(r, axis=0) / h[:, None]


def _rolling(vehicle: Vehicle, xi: Array, h: Array) -> tuple[Array, Array]:
    """Joints (n + 1, s) and rates (n, s) of wheels that roll along twists ``xi`` (n, d), though they might slip: they
    are steered to where tyres push the vehicle least."""
    assert vehicle.rolling is not None
    n, s = len(xi), len(vehicle.joints)
    r, twist = ca.SX.sym("r", s), ca.SX.sym("twist", vehicle.group.dim)
    rates = ca.densify(vehicle.rolling(r, twist))
    pose, idle = ca.SX(list(vehicle.group.identity)), ca.SX.zeros(len(vehicle.controls))
    _, push = vehicle.force(pose, r, rates, twist, idle, ca.SX.zeros(3))
    law = ca.Function("rolling", [r, twist], [rates, ca.sumsqr(push)])
    turned = np.zeros((n + 1, s))
    speed = np.linalg.norm(xi, axis=1)
    fast = np.flatnonzero(speed > SLOW * speed.max())  # where it is nearly at rest, any angle is valid
    for joint in vehicle.rate_controls.values() if len(fast) else ():
        k, values = vehicle.joints.index(joint), np.linspace(*vehicle.joint_limits[joint], ANGLES)
        tried = np.eye(s)[k][:, None] * np.tile(values, len(fast))
        pushes = np.asarray(law.map(tried.shape[1])(tried, np.repeat(xi[fast].T, ANGLES, axis=1))[1])
        best = values[np.argmin(pushes.reshape(len(fast), ANGLES), axis=1)]
        steered = np.interp(np.arange(n + 1), fast, best)
        turned[:, k] = _smoothed(steered, (1, 1, 1, 1, 1))
    u = np.asarray(law.map(n)(turned[:-1].T, xi.T)[0]).T
    for k, joint in enumerate(vehicle.joints):
        if joint in vehicle.rate_controls.values():
            u[:, k] = np.diff(turned[:, k]) / h
        else:
            turned[1:, k] = np.cumsum(u[:, k] * h)
    return turned, u


def _smoothed(values: Array, weights: Sequence[int]) -> Array:
    """Means of every value (n,) and its two neighbours on either side, with these weights."""
    kernel = np.array(weights, float) / sum(weights)
    return np.convolve(np.pad(values, 2, mode="edge"), kernel, mode="valid")


def _joints(vehicle: Vehicle, xi: Array, h: Array) -> tuple[Array, Array]:
    """Joints (n + 1, s) and rates (n, s) that fit twists ``xi`` (n, d) of the vehicle as well as possible.

    A joint with limits is set directly (a steered wheel); other joints turn along (a rolling wheel). For a vehicle that
    propels itself by its joints, they swing: from straight, resting joints an optimiser finds no motion.
    """
    if swims(vehicle):
        return _swing(vehicle, h)
    if vehicle.rolling is not None:
        return _rolling(vehicle, xi, h)
    s, d, b = len(vehicle.joints), vehicle.group.dim, vehicle.basis(ca.SX.zeros(len(vehicle.joints))).shape[1]
    symbol: Any = ca.SX.sym("r", s)
    free: Any = ca.horzcat(vehicle.basis(symbol), -vehicle.connection(symbol))
    moves = ca.Function("moves", [symbol], [ca.densify(free[:d, :])])
    r = np.zeros((len(xi) + 1, s))
    for joint, (low, high) in vehicle.joint_limits.items():
        place, values = vehicle.joints.index(joint), np.linspace(max(low, -2.0), min(high, 2.0), 81)
        rays = for_rows(moves, np.eye(s)[place] * values[:, None])[0]
        onto = rays @ np.linalg.pinv(rays)
        missed = ((xi - xi @ onto.transpose(0, 2, 1)) ** 2).sum(axis=2)
        missed += 1e-6 * (values[:, None] ** 2) * (xi**2).sum(axis=1)
        chosen = values[np.argmin(missed, axis=0)]
        # at rest any value is valid: use the next one that matters
        moving = (xi**2).sum(axis=1) > 1e-4 * (xi**2).sum(axis=1).max()
        chosen = np.interp(np.arange(len(xi)), np.flatnonzero(moving), chosen[moving]) if moving.any() else chosen
        r[:-1, place] = _smoothed(chosen, (1, 2, 3, 2, 1))
        r[-1, place] = r[-2, place]
    u = (np.linalg.pinv(for_rows(moves, r[:-1])[0]) @ xi[:, :, None])[:, b:, 0]
    for place, joint in enumerate(vehicle.joints):
        if joint in vehicle.joint_limits:
            u[:, place] = np.diff(r[:, place]) / h
        else:
            r[1:, place] = np.cumsum(u[:, place] * h)
    return r, u
