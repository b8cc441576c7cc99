"""Water from an external liquid solver: grids of heights and velocities through time (LIE Fig. 8, one way)."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vehsim.errors import InputError, SolveError
from vehsim.intake.arrays import read_arrays
from vehsim.world.water.motion import Motion

Array = NDArray[np.float64]

KEYS = ("times", "heights", "velocities", "origin", "cell")
SLACK = 2e-3
"""Time before the first grid and after the last for which there is water, s, and as a share of the time between two:
times may be rounded."""


@dataclass(frozen=True, eq=False)
class WaterGrids:
    """A surface sampled at ``times`` (n,) s: ``heights`` (n, rows, cols) m above the level, row = +Y, column = +X.

    ``velocities`` (n, rows, cols, 3) m/s of the water near the surface; None: derived from the heights (vertical motion
    only). ``origin`` (x, y) of the first sample and ``cell`` (dx, dy), m. Linear in time; each cell is split along (r,
    c)-(r+1, c+1), as in MuJoCo. A query outside the grid or its times raises ``SolveError``.
    """

    times: Array
    heights: Array
    velocities: Array | None = None
    origin: tuple[float, float] = (0.0, 0.0)
    cell: tuple[float, float] = (1.0, 1.0)

    def __post_init__(self) -> None:
        for name in ("times", "heights", "velocities"):
            if getattr(self, name) is not None:
                object.__setattr__(self, name, np.asarray(getattr(self, name), float))
        times, heights, flow = self.times, self.heights, self.velocities
        if heights.ndim != 3 or times.shape != heights.shape[:1] or min(heights.shape[1:], default=0) < 2:
            raise _wrong("heights", "not a grid through time", "give (times, rows, cols)", heights.shape)
        if flow is not None and flow.shape != (*heights.shape, 3):
            raise _wrong("velocities", "do not fit the heights", "give (times, rows, cols, 3)", flow.shape)
        if not (np.isfinite(heights).all() and (flow is None or np.isfinite(flow).all())):
            raise _wrong("heights", "not finite", "fill the holes")
        if not (np.isfinite(times).all() and (np.diff(times) > 0).all()):
            raise _wrong("times", "do not rise", "give seconds in order, each once")
        for name in ("origin", "cell"):
            if np.shape(getattr(self, name)) != (2,):
                raise _wrong(name, "not two numbers", "give x and y in m", np.shape(getattr(self, name)))
            object.__setattr__(self, name, tuple(map(float, getattr(self, name))))
        if not (min(self.cell) > 0 and np.isfinite([*self.cell, *self.origin]).all()):
            raise _wrong("cell", "not a spacing", "give (dx, dy) in m", self.cell)

    @classmethod
    def load(cls, path: str | Path) -> WaterGrids:
        """Read an ``.npz`` of times, heights, origin, cell and optionally velocities."""
        given: dict[str, Any] = read_arrays(Path(path), "world.water.grids", KEYS)
        missing = [key for key in ("times", "heights", "origin", "cell") if key not in given]
        if missing:
            without = f"without {', '.join(missing)}"
            raise InputError(without, f"save {', '.join(KEYS)}", key="world.water.grids", file=path)
        try:
            return cls(**given)
        except InputError as error:
            raise InputError.of(*(replace(each, file=str(path)) for each in error.problems)) from None

    @property
    def shortest(self) -> float:
        """Four cells: shorter waves are not resolved, m."""
        return 4 * min(self.cell)

    @cached_property
    def curvature(self) -> float:
        """Root mean square (1/m) of the heights' second differences, those along X and along Y together."""
        bends = [np.diff(self.heights, 2, axis=2 - i) / self.cell[i] ** 2 for i in range(2)]
        return float(np.sqrt(sum((bend**2).mean() for bend in bends if bend.size)))

    @property
    def lower(self) -> Array:
        """(2,) m: the grid's corner of smallest x and y."""
        return np.array(self.origin)

    @property
    def upper(self) -> Array:
        """(2,) m: the grid's corner of largest x and y."""
        rows, cols = self.heights.shape[1:]
        return np.array([self.origin[0] + self.cell[0] * (cols - 1), self.origin[1] + self.cell[1] * (rows - 1)])

    @cached_property
    def content_hash(self) -> str:
        digest = hashlib.sha256(repr((self.origin, self.cell)).encode())
        for array in (self.times, self.heights, self.velocities):
            digest.update(b"" if array is None else array.tobytes())
        return digest.hexdigest()

    def grid(self, x: Array, y: Array, t: float) -> tuple[Array, Array | None]:
        points = np.stack(np.meshgrid(x, y, 0.0), axis=-1).reshape(-1, 3)
        return self.at(points, 0.0, t).height.reshape(len(y), len(x)), None

    def at(self, points: Array, level: float, t: float, guess: Array | None = None) -> Motion:
        """See `Surface`. Grids do not say how the motion fades with depth."""
        corners, weights = self._cells(points[:, :2])
        k, share, span = self._instant(t)
        before, after = (self.heights[i][corners] for i in (k, k + 1))
        height = np.einsum("ns,ns->n", weights, (1 - share) * before + share * after)
        flow, change = np.zeros((2, len(height), 3))
        if self.velocities is None:
            flow[:, 2] = np.einsum("ns,ns->n", weights, (after - before) / span)
        else:
            before, after = (np.einsum("ns,nsi->ni", weights, self.velocities[i][corners]) for i in (k, k + 1))
            flow, change = (1 - share) * before + share * after, (after - before) / span
        return Motion(height, flow, change, np.zeros(len(height)))

    def slope(self, xy: Array, t: float) -> Array:
        """Gradient (n, 2) of the height, by central differences over half a cell."""
        columns = []
        for i in range(2):
            step = np.zeros(2)
            step[i] = self.cell[i] / 2
            low, high = (np.clip(xy + s * step, self.lower, self.upper) for s in (-1, 1))
            ends = [self.at(np.column_stack([p, np.zeros(len(p))]), 0.0, t).height for p in (low, high)]
            columns.append((ends[1] - ends[0]) / (high - low)[:, i])
        return np.column_stack(columns)

    def _instant(self, t: float) -> tuple[int, float, float]:
        """The grid before ``t`` s, the weight of the one after it, and the seconds between them."""
        slack = SLACK * max(1.0, (self.times[-1] - self.times[0]) / max(len(self.times) - 1, 1))
        if len(self.times) < 2 or not self.times[0] - slack <= t <= self.times[-1] + slack:
            end = f"{self.times[0]:.3f} to {self.times[-1]:.3f} s"
            raise SolveError(
                f"queried at {t:.3f} s, but they cover {end}", "simulate more of the liquid", key="world.water.grids"
            )
        k = int(np.clip(np.searchsorted(self.times, t, side="right") - 1, 0, len(self.times) - 2))
        span = float(self.times[k + 1] - self.times[k])
        return k, float((t - self.times[k]) / span), span

    def _cells(self, xy: Array) -> tuple[tuple[Array, Array], Array]:
        """Rows and columns (n, 3) of the samples around ``xy`` (n, 2), and their weights (n, 3)."""
        rows, cols = self.heights.shape[1:]
        u, v = ((xy - self.origin) / self.cell).T
        out = (u < -1e-9) | (v < -1e-9) | (u > cols - 1 + 1e-9) | (v > rows - 1 + 1e-9) | ~np.isfinite(u + v)
        if out.any():
            x, y = xy[np.flatnonzero(out)[0]]
            low, high = self.lower.round(3).tolist(), self.upper.round(3).tolist()
            raise SolveError(
                f"queried at ({x:.2f}, {y:.2f}) m, outside the grid, {low} to {high}",
                "enlarge it",
                key="world.water.grids",
            )
        col, row = (np.clip(a.astype(int), 0, n - 2) for a, n in ((u, cols), (v, rows)))
        u, v = u - col, v - row
        right = u >= v
        corners = (
            np.column_stack([row, np.where(right, row, row + 1), row + 1]),
            np.column_stack([col, np.where(right, col + 1, col), col + 1]),
        )
        far = np.where(right, v, u)
        near = np.where(right, 1 - u, 1 - v)
        return corners, np.column_stack([near, 1 - near - far, far])


def _wrong(key: str, message: str, remedy: str, value: object = None) -> InputError:
    return InputError(message, remedy, key=f"world.water.grids.{key}", value=value)
