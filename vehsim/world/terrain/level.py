"""The level of ground that a vehicle keeps to, where several lie above each other (`vehsim.world.ground.levels`)."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

LIFT = 0.5
"""Ground up to this much above or below a level's grid belongs to it, m."""


@dataclass(frozen=True, eq=False)
class Level:
    """Heights (nx, ny) m of a vehicle's ground on a grid of ``cell`` m from ``lower`` (2,) m on.

    ``solid`` (nx, ny): where it cannot drive, because of rock or an edge; the heights there are those beside it;
    ``seams`` (nx, ny): of these, where another level's ground begins.
    """

    lower: Array
    cell: float
    heights: Array
    solid: NDArray[np.bool_]
    seams: NDArray[np.bool_]

    @property
    def upper(self) -> Array:
        """The far corner (2,) m of the grid."""
        return self.lower + self.cell * (np.array(self.heights.shape) - 1)

    @cached_property
    def content(self) -> bytes:
        """What distinguishes it from others."""
        return self.heights.tobytes() + self.solid.tobytes() + repr((self.lower.tolist(), self.cell)).encode()

    def knows(self, xy: Array) -> NDArray[np.bool_]:
        """Whether places (n, 2) m lie on its grid, (n,)."""
        return np.asarray(((xy >= self.lower) & (xy <= self.upper)).all(axis=1))

    def at(self, xy: Array) -> Array:
        """Heights (n,) m at ``xy`` (n, 2) m between the points of the grid."""
        from scipy.ndimage import map_coordinates

        index = (np.asarray(xy, float) - self.lower) / self.cell
        return np.asarray(map_coordinates(self.heights, index.T, order=1, mode="nearest"))
