"""Rotations as NumPy arrays: unit quaternions w, x, y, z, and their matrices, rotation vectors and angles.

Every function broadcasts over leading axes. Symbolic rotations are in `vehsim.lie.groups`. SciPy's ``Rotation`` does
most of this, but importing it takes 0.3 s of CPU time (0.13 s for NumPy alone), and nothing else that simulates or
plans loads SciPy.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]


def matrices(q: Array) -> Array:
    """Rotation matrices (..., 3, 3) of unit quaternions (..., 4) w, x, y, z; their columns are the body's axes."""
    single = q.ndim == 1  # as Python's numbers, in a fifth of the time
    w, x, y, z = q.tolist() if single else _components(q)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.array(rows) if single else np.moveaxis(np.array(rows), (0, 1), (-2, -1))


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
    """The same rotations (n, 4) without sign flips between neighbours."""
    flips = np.sum(quaternions[1:] * quaternions[:-1], axis=1) < 0
    if not flips.any():
        return quaternions
    signs = np.cumprod(np.concatenate([[1.0], np.where(flips, -1.0, 1.0)]))
    return quaternions * signs[:, None]


def cross(a: Array, b: Array) -> Array:
    """Cross products (..., 3) of vectors (..., 3), several times as quick as NumPy's for a few."""
    ax, ay, az = a[..., 0], a[..., 1], a[..., 2]
    bx, by, bz = b[..., 0], b[..., 1], b[..., 2]
    x = ay * bz - az * by
    product = np.empty((*x.shape, 3))
    product[..., 0], product[..., 1], product[..., 2] = x, az * bx - ax * bz, ax * by - ay * bx
    return product


def rotate(q: Array, v: Array) -> Array:
    """Vectors (..., 3) turned by unit quaternions (..., 4)."""
    t = 2 * cross(q[..., 1:], v)
    return v + q[..., :1] * t + cross(q[..., 1:], t)


def conjugate(q: Array) -> Array:
    """The inverse rotations (..., 4)."""
    return q * [1, -1, -1, -1]


def product(a: Array, b: Array) -> Array:
    """Quaternions (..., 4) of turning by ``b``, then by ``a``."""
    scalar = a[..., :1] * b[..., :1] - np.sum(a[..., 1:] * b[..., 1:], axis=-1, keepdims=True)
    vector = a[..., :1] * b[..., 1:] + b[..., :1] * a[..., 1:] + cross(a[..., 1:], b[..., 1:])
    return np.concatenate([scalar, vector], axis=-1)


def angles_between(p: Array, q: Array) -> Array:
    """Angles (...) rad between rotations (..., 4), accurate near zero."""
    d = np.minimum(np.linalg.norm(p - q, axis=-1), np.linalg.norm(p + q, axis=-1))
    return np.asarray(4 * np.arcsin(np.clip(d / 2, 0, 1)))


def from_vectors(phi: Array) -> Array:
    """Unit quaternions (..., 4) of rotation vectors (..., 3) rad."""
    angle = np.linalg.norm(phi, axis=-1, keepdims=True)
    return np.concatenate([np.cos(angle / 2), phi / 2 * np.sinc(angle / (2 * np.pi))], axis=-1)


def rotation_vectors(q: Array) -> Array:
    """Rotation vectors (..., 3) rad of unit quaternions (..., 4), by less than a full turn."""
    sine = np.linalg.norm(q[..., 1:], axis=-1, keepdims=True)
    angle = 2 * np.arctan2(sine, q[..., :1])
    return q[..., 1:] * np.where(sine > 1e-12, angle / np.where(sine > 1e-12, sine, 1.0), 2.0)


def right_jacobian(phi: Array, v: Array) -> Array:
    """``J_r(phi) v`` (..., 3): the body's angular velocity while its rotation vector ``phi`` changes at rate ``v``."""
    a = np.linalg.norm(phi, axis=-1, keepdims=True)
    small = a < 1e-4
    a = np.where(small, 1.0, a)
    first = np.where(small, 0.5, (1 - np.cos(a)) / a**2)
    second = np.where(small, 1 / 6, (a - np.sin(a)) / a**3)
    turned = cross(phi, v)
    return v - first * turned + second * cross(phi, turned)


def right_jacobian_inverse(phi: Array, v: Array) -> Array:
    """``J_r(phi)^-1 v`` (..., 3): the rate of the rotation vector ``phi`` at the body's angular velocity ``v``."""
    a = np.linalg.norm(phi, axis=-1, keepdims=True)
    small = a < 1e-3
    a = np.where(small, 1.0, a)
    second = np.where(small, 1 / 12, (1 - a / 2 / np.tan(a / 2)) / a**2)
    turned = cross(phi, v)
    return v + turned / 2 + second * cross(phi, turned)


def from_yaw(yaw: ArrayLike) -> Array:
    """Unit quaternions (..., 4) of turning by ``yaw`` (...) rad about Z: headings."""
    half = np.asarray(yaw, float) / 2
    zero = np.zeros_like(half)
    return np.stack([np.cos(half), zero, zero, np.sin(half)], axis=-1)


def yaw_of(q: Array) -> Array:
    """Yaw (...) rad, within half a turn, of unit quaternions (..., 4): the heading of their X axis."""
    w, x, y, z = _components(q)
    return np.asarray(np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z)))


def yaw_tilt(yaw: Array, pitch: Array, roll: Array) -> Array:
    """Quaternions (n, 4) of a rotation by ``roll`` about X, then ``pitch`` about Y, then ``yaw`` about Z, rad."""
    zero = np.zeros(len(yaw))
    about_y = np.column_stack([np.cos(pitch / 2), zero, np.sin(pitch / 2), zero])
    about_x = np.column_stack([np.cos(roll / 2), np.sin(roll / 2), zero, zero])
    return product(product(from_yaw(yaw), about_y), about_x)


def tilt_of(q: Array) -> tuple[Array, Array, Array]:
    """Yaw, pitch and roll (n,) rad of quaternions (n, 4), the inverse of `yaw_tilt`; yaw is continuous."""
    w, x, y, z = q.T
    pitch = np.arcsin(np.clip(2 * (w * y - z * x), -1.0, 1.0))
    return np.unwrap(yaw_of(q)), pitch, np.arctan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y))


def _components(q: Array) -> Array:
    """w, x, y, z (4, ...); a plain transpose, where it will do, is several microseconds quicker."""
    return q.T if q.ndim < 3 else np.moveaxis(q, -1, 0)
