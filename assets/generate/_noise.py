"""Gradient noise (Perlin 1985, 2002) over arrays of points, and the sums of octaves the terrain scripts use."""

from __future__ import annotations

from itertools import product

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def _gradients(lattice: NDArray[np.int64], seed: int) -> Array:
    """A unit vector per lattice point (..., d), the same for the same seed on every machine."""
    key = np.full(lattice.shape[:-1], (seed * 0x9E3779B97F4A7C15 + 0x1234567) % 2**64, dtype=np.uint64)
    for axis in range(lattice.shape[-1]):
        key ^= lattice[..., axis].astype(np.uint64) + np.uint64(0x9E3779B97F4A7C15 * (axis + 1) % 2**64)
        key *= np.uint64(0xBF58476D1CE4E5B9)
        key ^= key >> np.uint64(29)
    parts = [((key >> np.uint64(shift)) & np.uint64(0xFFFF)).astype(float) / 32767.5 - 1.0 for shift in (0, 16, 32)]
    vector = np.stack(parts[: lattice.shape[-1]], axis=-1)
    return np.asarray(vector / (np.linalg.norm(vector, axis=-1, keepdims=True) + 1e-9))


def gradient_noise(points: Array, seed: int = 0) -> Array:
    """Gradient noise at ``points`` (..., d), d = 2 or 3, in lattice units; about -0.7 to 0.7, C2."""
    cell = np.floor(points).astype(np.int64)
    local = points - cell
    fade = local**3 * (local * (local * 6 - 15) + 10)
    total = np.zeros(points.shape[:-1])
    for corner in product((0, 1), repeat=points.shape[-1]):
        offset = np.array(corner)
        weight = np.prod(np.where(offset, fade, 1 - fade), axis=-1)
        total += weight * np.sum(_gradients(cell + offset, seed) * (local - offset), axis=-1)
    return total


def fractal(points: Array, octaves: int = 4, seed: int = 0, gain: float = 0.5) -> Array:
    """Octaves of gradient noise, each twice as fine and ``gain`` times as strong; about -1 to 1."""
    return np.asarray(sum(1.4 * gain**k * gradient_noise(points * 2.0**k + 17.3 * k, seed + k) for k in range(octaves)))


def ridged(points: Array, octaves: int = 3, seed: int = 0, gain: float = 0.5) -> Array:
    """Octaves of creased noise, 0 in the creases to about 1 on the ridges."""
    total = sum(
        gain**k * (1 - np.abs(2.2 * gradient_noise(points * 2.0**k + 9.1 * k, seed + k))) for k in range(octaves)
    )
    return np.asarray(total / sum(gain**k for k in range(octaves)))
