"""Rotations by the many, in numpy alone: unit quaternions (n, 4) w, x, y, z, their matrices, vectors and angles.

Scipy has most of it, at the price of half a second before anything moves; what is symbolic is in `vehsim.lie`.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def matrices(q: Array) -> Array:
    """Rotation matrices (..., 3, 3) of unit quaternions (..., 4) w, x, y, z; their columns are the body's axes."""
    w, x, y, z = q.T
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.moveaxis(np.array(rows), (0, 1), (-2, -1))


def quaternions(R: Array) -> Array:
    """Unit quaternions (..., 4) w, x, y, z of rotation matrices (..., 3, 3), by their largest component (Markley)."""
    r = np.moveaxis(R, (-2, -1), (0, 1))
    (a, b, c), (d, e, f), (g, h, i) = r
    x, y, z, u, v, w = h - f, c - g, d - b, b + d, c + g, f + h
    ones = np.ones_like(a)
    rows = [
        [ones + a + e + i, x, y, z],
        [x, ones + a - e - i, u, v],
        [y, u, ones - a + e - i, w],
        [z, v, w, ones - a - e + i],
    ]
    options = np.moveaxis(np.array(rows), (0, 1), (-2, -1))
    largest = np.argmax(np.diagonal(options, axis1=-2, axis2=-1), axis=-1)
    q = np.take_along_axis(options, largest[..., None, None], axis=-2)[..., 0, :]
    return q / np.linalg.norm(q, axis=-1, keepdims=True)


def continuous(quaternions: Array) -> Array:
    """The same rotations (n, 4) with no sign flips from one to the next."""
    flips = np.sum(quaternions[1:] * quaternions[:-1], axis=1) < 0
    if not flips.any():
        return quaternions
    signs = np.cumprod(np.concatenate([[1.0], np.where(flips, -1.0, 1.0)]))
    return quaternions * signs[:, None]


def cross(a: Array, b: Array) -> Array:
    """Cross products (..., 3) of vectors or rows of them, several times as quick as numpy's for a few."""
    ax, ay, az = a.T
    bx, by, bz = b.T
    product = np.empty(np.broadcast_shapes(a.shape, b.shape))
    product[..., 0], product[..., 1], product[..., 2] = ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx
    return product


def rotate(q: Array, v: Array) -> Array:
    """Vectors (n, 3) turned by unit quaternions (n, 4)."""
    t = 2 * np.cross(q[:, 1:], v)
    return v + q[:, :1] * t + np.cross(q[:, 1:], t)


def from_vectors(phi: Array) -> Array:
    """Unit quaternions (n, 4) of rotation vectors (n, 3)."""
    angle = np.linalg.norm(phi, axis=1, keepdims=True)
    return np.hstack([np.cos(angle / 2), phi / 2 * np.sinc(angle / (2 * np.pi))])


def rotation_vectors(q: Array) -> Array:
    sine = np.linalg.norm(q[:, 1:], axis=1, keepdims=True)
    angle = 2 * np.arctan2(sine, q[:, :1])
    return q[:, 1:] * np.where(sine > 1e-12, angle / np.where(sine > 1e-12, sine, 1.0), 2.0)


def product(a: Array, b: Array) -> Array:
    scalar = a[:, :1] * b[:, :1] - np.sum(a[:, 1:] * b[:, 1:], axis=1, keepdims=True)
    return np.hstack([scalar, a[:, :1] * b[:, 1:] + b[:, :1] * a[:, 1:] + np.cross(a[:, 1:], b[:, 1:])])


def yaw_tilt(yaw: Array, pitch: Array, roll: Array) -> Array:
    """Quaternions (n, 4) of turning by ``roll`` about X, then ``pitch`` about Y, then ``yaw`` about Z, rad."""
    zero = np.zeros(len(yaw))
    about_z = np.column_stack([np.cos(yaw / 2), zero, zero, np.sin(yaw / 2)])
    about_y = np.column_stack([np.cos(pitch / 2), zero, np.sin(pitch / 2), zero])
    about_x = np.column_stack([np.cos(roll / 2), np.sin(roll / 2), zero, zero])
    return product(product(about_z, about_y), about_x)


def tilt_of(q: Array) -> tuple[Array, Array, Array]:
    """Yaw, pitch and roll (n,) rad of quaternions (n, 4), as `yaw_tilt` puts them together; yaw is continuous."""
    w, x, y, z = q.T
    yaw = np.unwrap(np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z)))
    pitch = np.arcsin(np.clip(2 * (w * y - z * x), -1.0, 1.0))
    return yaw, pitch, np.arctan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y))
