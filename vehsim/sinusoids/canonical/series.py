"""Truncated power series as arrays, with coefficients of rising order along the last axis, for the trailers' paths."""

from __future__ import annotations

import numpy as np

from vehsim.sinusoids.system import Array


def one(order: int) -> Array:
    return np.eye(1, order)[0]


def times(a: Array, b: Array) -> Array:
    out = np.zeros(np.broadcast_shapes(a.shape, b.shape), np.result_type(a, b))
    for k in range(out.shape[-1]):
        out[..., k] = sum(a[..., i] * b[..., k - i] for i in range(k + 1))
    return out


def divide(a: Array, b: Array) -> Array:
    out = np.zeros(np.broadcast_shapes(a.shape, b.shape), np.result_type(a, b))
    for k in range(out.shape[-1]):
        out[..., k] = (a[..., k] - sum(out[..., i] * b[..., k - i] for i in range(k))) / b[..., 0]
    return out


def sqrt(a: Array) -> Array:
    out = np.zeros_like(a)
    out[..., 0] = np.sqrt(a[..., 0])
    for k in range(1, a.shape[-1]):
        cross = sum(out[..., i] * out[..., k - i] for i in range(1, k))
        out[..., k] = (a[..., k] - cross) / (2 * out[..., 0])
    return out


def sincos(a: Array) -> tuple[Array, Array]:
    sine, cosine = np.zeros_like(a), np.zeros_like(a)
    sine[..., 0], cosine[..., 0] = np.sin(a[..., 0]), np.cos(a[..., 0])
    for k in range(1, a.shape[-1]):
        sine[..., k] = sum(i * a[..., i] * cosine[..., k - i] for i in range(1, k + 1)) / k
        cosine[..., k] = -sum(i * a[..., i] * sine[..., k - i] for i in range(1, k + 1)) / k
    return sine, cosine


def derivative(a: Array, keep: bool = False) -> Array:
    """Differentiated: one order shorter, or padded with a zero to ``keep`` its length."""
    out = a[..., 1:] * np.arange(1, a.shape[-1])
    return np.concatenate([out, np.zeros_like(a[..., :1])], axis=-1) if keep else out


def angle(y: Array, x: Array) -> Array:
    """arctan2 that propagates an infinitesimal imaginary part."""
    angle = np.arctan2(y.real, x.real)
    if not np.iscomplexobj(y):
        return angle
    return angle + 1j * (x.real * y.imag - y.real * x.imag) / (x.real**2 + y.real**2)
