"""The water's surface in a MuJoCo model: a height field that follows time and the hull above it.

MuJoCo evaluates the height of the water over the hull (LIE 4.3.2). It knows triangles only, so heights differ from the
surface within a cell, but not on average (`level_with`); `Afloat` chooses cells by the effect on its hull. The surface
itself gives the flow.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from vehsim.errors import InputError, SolveError
from vehsim.world.water.motion import Motion
from vehsim.world.water.water import Array, Water, places

NAME = "water"
GROUP = 4
"""MuJoCo geom group of the surface: not drawn by default, collides with nothing."""
BELOW = 1.0
"""Thickness of the water below its lowest trough in MuJoCo's model, m."""
MOST = 2049
"""Largest number of samples per side."""
FAR = 2e4
"""Height of the common origin of all rays above the field, in widths of the field: the rays are practically vertical,
and one call casts them all, in a fifth of the time of separate calls."""


Window = tuple[NDArray[np.int64], NDArray[np.int64]]


class WaterField:
    """``water`` as a height field with cells of ``cell`` m and at most ``samples`` samples per side.

    ``update(t, low, high)`` moves it by whole cells, so that it does not slide over the surface, and writes its
    heights. ``heights(xy)`` casts rays in MuJoCo, and raises ``SolveError`` for one outside the field. ``at(points,
    t)`` does both. Grids of a liquid solver keep their own cells.
    """

    def __init__(self, water: Water, cell: float, samples: int = 129):
        import mujoco

        if not (np.isfinite(cell) and cell > 0 and 4 <= samples <= MOST):
            remedy = f"give a cell in m and 4 to {MOST} samples a side"
            raise InputError("not a grid", remedy, key="water field", value=(cell, samples))
        self.water, self.samples = water, samples
        grids = water.grids
        self.cell = np.full(2, float(cell)) if grids is None else np.array(grids.cell)
        self.anchor = np.zeros(2) if grids is None else grids.lower
        size = self.cell * (samples - 1)
        spec = mujoco.MjSpec()
        spec.add_hfield(
            name=NAME, size=[*size / 2, 1.0, BELOW], nrow=samples, ncol=samples, userdata=[0.0] * samples**2
        )
        body = spec.worldbody.add_body(name=NAME, mocap=True)
        body.add_geom(
            name=NAME, type=mujoco.mjtGeom.mjGEOM_HFIELD, hfieldname=NAME, group=GROUP, contype=0, conaffinity=0
        )
        self.model = spec.compile()
        self.data = mujoco.MjData(self.model)
        model = self.model  # each access makes a new view, which takes as long as writing the surface
        self._counts, self._size, self._data = (
            (model.hfield_ncol, model.hfield_nrow),
            model.hfield_size[0],
            model.hfield_data,
        )
        self._place, self._centre = self.data.mocap_pos[0], self.data.geom_xpos[0]
        self.low = self.high = np.full(2, np.nan)  # empty so far
        self.window: Window | None = None
        self.shift: Array | None = None
        self.tops = np.zeros((1, 1))
        """The highest sample of each cell (rows - 1, cols - 1), m."""
        self.top = float(size.max()) * FAR

    def at(self, points: Array, t: float) -> Motion:
        """The water at ``points`` (n, 3) m and ``t`` s, with the height of its surface from MuJoCo, after moving the
        field there."""
        self.cover(points, t)
        return self.motion(points, t)

    def cover(self, points: Array, t: float) -> None:
        """Write the surface at ``t`` s over ``points`` (n, 3) m."""
        x, y = points[:, 0], points[:, 1]  # reductions along an axis of three take eight times as long
        low, high = np.array([x.min(), y.min()]), np.array([x.max(), y.max()])
        if not (self.water.flat and (self.low <= low).all() and (high <= self.high).all()):
            self.update(t, low, high)

    def motion(self, points: Array, t: float, asked: Any = slice(None)) -> Motion:
        """The water at ``points`` (n, 3) m, which the field covers at ``t`` s. Except where ``asked`` (n,), the height
        is that of the formula."""
        # first, because it reports points outside a solver's grid
        found = self.water.at(points, t, self._rest(points[:, :2]))
        found.height[asked] = self.heights(points[asked, :2])
        return found

    def ceiling(self, points: Array) -> Array:
        """The highest sample (n,) m around each of ``points`` (n, 3) m; inf outside a solver's grid."""
        if self.water.flat:
            return np.full(len(points), self.water.level)
        rows, cols = self.tops.shape
        col, row = ((points[:, k] - self.low[k]) / self.cell[k] for k in range(2))
        known = self.tops.take(row.astype(np.int64) * cols + col.astype(np.int64), mode="clip")
        if self.water.grids is None:
            return known
        return np.where((col >= 0) & (col < cols) & (row >= 0) & (row < rows), known, np.inf)

    def _rest(self, xy: Array) -> Array | None:
        """Approximate rest positions (n, 2) of the water at ``xy`` (n, 2), interpolated between the samples."""
        if self.shift is None:
            return None
        place = (xy - self.low) / self.cell
        first = np.clip(place.astype(int), 0, np.array(self.shift.shape[1::-1]) - 2)
        u, v = (place - first).T[:, :, None]
        col, row = first.T
        shift = self.shift
        return np.asarray(
            xy
            + (1 - v) * ((1 - u) * shift[row, col] + u * shift[row, col + 1])
            + v * ((1 - u) * shift[row + 1, col] + u * shift[row + 1, col + 1])
        )

    def update(self, t: float, low: Any, high: Any) -> None:
        """Write the surface at ``t`` s from ``low`` to ``high``, (2,) m each, with a margin of one cell."""
        first = np.floor((np.asarray(low, float) - self.anchor) / self.cell).astype(int) - 1
        last = np.ceil((np.asarray(high, float) - self.anchor) / self.cell).astype(int) + 1
        if self.water.grids is not None:  # queries never leave its grid
            rows, cols = self.water.grids.heights.shape[1:]
            first, last = np.clip(first, 0, [cols - 2, rows - 2]), np.clip(last, 1, [cols - 1, rows - 1])
        self.show(t, (first, last))

    def show(self, t: float, window: Window) -> None:
        """Write the surface at ``t`` s over a ``window``: its first and last sample (2,), along X and Y."""
        import mujoco

        first, last = self.window = window
        if max(last - first) >= self.samples:
            raise SolveError(
                f"{max(last - first) + 1} samples per side, at most {self.samples} are possible",
                subject="water field",
            )
        self.low, self.high = self.anchor + self.cell * first, self.anchor + self.cell * last
        x, y = (
            a + cell * np.arange(i, j + 1) for a, cell, i, j in zip(self.anchor, self.cell, first, last, strict=True)
        )
        heights, rest = self.water.grid(x, y, t)
        self.shift = None if rest is None else rest - places(x, y)
        if self.water.grids is None:
            heights = level_with(heights)
        pairs = np.maximum(heights[:-1], heights[1:])
        self.tops = np.maximum(pairs[:, :-1], pairs[:, 1:])
        bottom = float(heights.min())
        relief = max(float(heights.max()) - bottom, 1e-3)
        for counts, count in zip(self._counts, (len(x), len(y)), strict=True):
            counts[0] = count
        self._size[:2], self._size[2] = (self.high - self.low) / 2, relief
        self._data[: heights.size] = ((heights - bottom) / relief).ravel()
        self._place[:2], self._place[2] = (self.low + self.high) / 2, bottom
        mujoco.mj_kinematics(self.model, self.data)

    def heights(self, xy: Any) -> Array:
        """Height (n,) m of the surface above ``xy`` (n, 2) m, by rays from above."""
        import mujoco

        points = np.asarray(xy, float).reshape(-1, 2)
        start, bottom = self._centre.copy(), float(self._centre[2])
        start[2] += self.top
        rays = np.empty((len(points), 3))
        np.subtract(points, start[:2], out=rays[:, :2])
        rays[:, 2] = -self.top
        share, geoms = np.empty(len(points)), np.empty(len(points), np.int32)
        mujoco.mj_multiRay(
            self.model, self.data, start, rays.ravel(), None, 1, -1, geoms, share, None, len(points), np.inf
        )
        if geoms.min(initial=0) < 0:
            x, y = points[geoms.argmin()]
            raise SolveError(
                f"queried at ({x:.2f}, {y:.2f}) m, outside its {np.round(self.low, 2).tolist()} to "
                f"{np.round(self.high, 2).tolist()}",
                "move it with update()",
                subject="water field",
            )
        return np.asarray(bottom + self.top * (1.0 - share))


def level_with(heights: Array) -> Array:
    """Heights (rows, cols) between which MuJoCo's triangles are as high, on average, as the smooth surface with samples
    ``heights``. Between the samples themselves they are too low at crests and too high in troughs, by 1/24 of the sum
    of the second differences along their three edges. Samples at the border stay."""
    inner, found = heights[1:-1, 1:-1], heights.copy()
    along, across = heights[1:-1, 2:] + heights[1:-1, :-2], heights[2:, 1:-1] + heights[:-2, 1:-1]
    found[1:-1, 1:-1] = inner - (along + across + heights[2:, 2:] + heights[:-2, :-2] - 6 * inner) / 24
    return found
