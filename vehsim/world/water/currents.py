"""Currents: the flow of the water as a whole. Depths are below the surface, positive downwards."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from vehsim.errors import InputError
from vehsim.world.water.water import Array, Current

MAX_SPEED = 50.0
"""Largest plausible current, m/s."""


class _Hashed:
    """A hash of its content."""

    @cached_property
    def content_hash(self) -> str:
        fields = sorted((name, np.asarray(value).tolist()) for name, value in vars(self).items() if name[0] != "_")
        return hashlib.sha256(repr((type(self).__name__, fields)).encode()).hexdigest()


@dataclass(frozen=True, eq=False)
class Stream(_Hashed):
    """``velocity`` (3,) m/s everywhere; with ``depth`` m, it decreases linearly to zero at that depth."""

    speed: tuple[float, float, float]
    depth: float = np.inf

    def __post_init__(self) -> None:
        _check("current", self.speed, 3)
        if not self.depth > 0:
            raise InputError("not a depth", "give metres above zero", key="current.depth", value=self.depth)

    def velocity(self, points: Array, t: float) -> Array:
        share = np.clip(1 + points[:, 2] / self.depth, 0, 1)
        return np.asarray(share[:, None] * np.asarray(self.speed, float))


@dataclass(frozen=True, eq=False)
class Vortex(_Hashed):
    """A vortex (Lamb and Oseen) around ``centre`` (2,) m, counter-clockwise: its greatest speed is ``speed`` m/s, at
    ``radius`` m."""

    centre: tuple[float, float]
    speed: float
    radius: float

    def __post_init__(self) -> None:
        _check("vortex.centre", self.centre, 2, 1e6)
        _check("vortex", (self.speed, self.radius), 2)
        if not self.radius > 0:
            raise InputError("not a radius", "give metres above zero", key="vortex.radius", value=self.radius)

    def velocity(self, points: Array, t: float) -> Array:
        x, y = (points[:, :2] - np.asarray(self.centre, float)).T
        squared = (x * x + y * y) / self.radius**2
        # the speed is greatest where q = 1.2564 solves exp(q) = 1 + 2 q
        rate = self.speed / self.radius * -np.expm1(-1.2564312 * squared) / np.maximum(squared, 1e-12) / 0.7153318
        rate = np.where(squared < 1e-12, self.speed / self.radius * 1.2564312 / 0.7153318, rate)
        return np.column_stack([-rate * y, rate * x, np.zeros(len(x))])


@dataclass(frozen=True, eq=False)
class Sampled(_Hashed):
    """``samples`` (rows, cols, 2) m/s on a grid, row = +Y; ``origin`` (x, y) of the first, ``cell`` (dx, dy), m.

    Bilinear between; beyond its borders that of the closest place on them.
    """

    samples: Array
    origin: tuple[float, float] = (0.0, 0.0)
    cell: tuple[float, float] = (1.0, 1.0)

    def __post_init__(self) -> None:
        samples = np.asarray(self.samples, float)
        object.__setattr__(self, "samples", samples)
        if samples.ndim != 3 or samples.shape[2] != 2 or min(samples.shape[:2]) < 2 or min(self.cell) <= 0:
            raise InputError("not a grid", "give (rows, cols, 2) m/s", key="current.samples", value=samples.shape)
        _check("current.samples", samples.ravel(), samples.size)

    def velocity(self, points: Array, t: float) -> Array:
        rows, cols, _ = self.samples.shape
        u = np.clip((points[:, 0] - self.origin[0]) / self.cell[0], 0, cols - 1)
        v = np.clip((points[:, 1] - self.origin[1]) / self.cell[1], 0, rows - 1)
        col, row = np.minimum(u.astype(int), cols - 2), np.minimum(v.astype(int), rows - 2)
        u, v = (u - col)[:, None], (v - row)[:, None]
        s = self.samples
        low = (1 - u) * s[row, col] + u * s[row, col + 1]
        high = (1 - u) * s[row + 1, col] + u * s[row + 1, col + 1]
        return np.column_stack([(1 - v) * low + v * high, np.zeros(len(points))])


@dataclass(frozen=True, eq=False)
class Currents:
    """The sum of several currents."""

    parts: tuple[Current, ...]

    @cached_property
    def content_hash(self) -> str:
        return hashlib.sha256(repr([part.content_hash for part in self.parts]).encode()).hexdigest()

    def velocity(self, points: Array, t: float) -> Array:
        return np.sum([part.velocity(points, t) for part in self.parts], axis=0)


def _check(key: str, values: object, size: int, most: float = 1e3) -> None:
    array = np.asarray(values, float).ravel()
    if array.shape != (size,) or not np.isfinite(array).all() or np.abs(array).max() > most:
        raise InputError(f"not finite numbers up to {most:g}", f"give {size} of them", key=key, value=values)
