"""Shelter behind moles: how much of the waves is left at a place.

A wave passes a mole as light passes the edge of a screen: by Kirchhoff's integral in Fresnel's approximation, which is
Sommerfeld's solution for a straight breakwater near the edge of its shadow (Penney and Price 1952). The parts of a line
that a wave meets from one side are one screen; of several screens, such as the two sides of a ring, the shares
multiply. The shelter is the root mean square over all waves of a sea, weighted by their energy, so it changes their
height and not their phases: crests behind a mole stay straight. Waves are not reflected, and moles are taken as thin.
"""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from vehsim.errors import InputError

Array = NDArray[np.float64]

REACH, CELLS = 4.0, 96
"""The shelter is known on a square this many times as wide as the moles, with so many cells a side."""
MOST = 48
"""Most waves that count: those with the most energy."""


@dataclass(frozen=True, eq=False)
class Shelter:
    """Of moles along ``lines``, each (n, 2) m, from waves with ``amplitude`` (k,) m and wave vectors ``number`` (k, 2)
    rad/m. Raises ``InputError``."""

    lines: Sequence[Array]
    amplitude: Array
    number: Array
    content_hash: str = field(init=False)

    def __post_init__(self) -> None:
        digest = hashlib.sha256(self.amplitude.tobytes() + self.number.tobytes())
        for line in self.lines:
            if len(line) < 2 or not np.isfinite(line).all() or (np.abs(np.diff(line, axis=0)).max(axis=1) <= 0).any():
                raise InputError("not a line", "give two or more different places", key="shelter", value=line.tolist())
            digest.update(np.ascontiguousarray(line).tobytes())
        object.__setattr__(self, "content_hash", digest.hexdigest())

    @cached_property
    def _grid(self) -> tuple[Array, Array, Array]:
        """Coordinates (n,) and (n,) m and the share (n, n) there."""
        ends = np.concatenate(self.lines)
        low, high = ends.min(axis=0), ends.max(axis=0)
        middle, half = (low + high) / 2, REACH / 2 * float((high - low).max())
        x, y = (centre + np.linspace(-half, half, CELLS + 1) for centre in middle)
        places = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
        used = np.argsort(-np.abs(self.amplitude), kind="stable")[:MOST]
        power = self.amplitude[used] ** 2
        found = sum(
            part * self.of(number, places) ** 2 for part, number in zip(power, self.number[used], strict=True)
        ) / max(float(power.sum()), 1e-300)
        return x, y, np.sqrt(np.asarray(found)).reshape(len(y), len(x))

    def of(self, number: Array, places: Array) -> Array:
        """Share (n,) of the height of one wave with a wave vector ``number`` (2,) rad/m that is left at ``places`` (n,
        2) m, at most 1: fringes beside the shadow are left out."""
        from scipy.special import fresnel

        k = float(np.hypot(*number))
        ahead = number / k
        across = np.array([-ahead[1], ahead[0]])
        share = np.ones(len(places))
        for line in self.lines:
            behind, aside = (places[:, None] - line) @ ahead, (line - places[:, None]) @ across
            sine, cosine = fresnel(aside * np.sqrt(k / np.pi / np.maximum(behind, 1e-9 / k)))
            known, past = cosine + 1j * sine, behind > 0
            (s0, s1), (y0, y1) = ((each[:, :-1], each[:, 1:]) for each in (behind, aside))
            crossing = y0 + s0 / np.where(s0 == s1, 1.0, s0 - s1) * (y1 - y0)
            edge = (0.5 + 0.5j) * np.sign(crossing)  # of the part of a segment that is upwave: infinitely near
            parts = np.where(past[:, 1:], known[:, 1:], edge) - np.where(past[:, :-1], known[:, :-1], edge)
            parts *= past[:, 1:] | past[:, :-1]
            facing = np.sign(np.diff(line @ across))
            for side in (-1.0, 1.0):
                share *= np.abs(1 - side * parts[:, facing == side].sum(axis=1) / (1 + 1j))
        return np.minimum(share, 1.0)

    def share(self, xy: Array) -> Array:
        """Share (n,) of the waves' height that is left at ``xy`` (n, 2) m: linear between the cells of a square around
        the moles, and that of its edge beyond."""
        x, y, values = self._grid
        column, row = (
            np.clip((xy[:, i] - axis[0]) / (axis[1] - axis[0]), 0, CELLS - 1e-9) for i, axis in enumerate((x, y))
        )
        i, j = column.astype(int), row.astype(int)
        u, v = column - i, row - j
        below = (1 - u) * values[j, i] + u * values[j, i + 1]
        above = (1 - u) * values[j + 1, i] + u * values[j + 1, i + 1]
        return np.asarray((1 - v) * below + v * above)
