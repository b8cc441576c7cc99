"""The water's surface in a MuJoCo model: a height field that follows time and the hull above it.

MuJoCo evaluates the height of the water over the hull (LIE 4.3.2). It knows triangles only, so heights differ from the
surface by the curvature within a cell; `Afloat` chooses cells by the effect on its hull. The surface itself gives the
flow.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from vehsim.errors import InputError, SolveError
from vehsim.world.water.motion import Motion
from vehsim.world.water.water import Array, Water

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
        self.low = self.high = np.full(2, np.nan)  # empty so far
        self.window: Window | None = None
        self.shift: Array | None = None
        self.top = float(size.max()) * FAR

    def at(self, points: Array, t: float) -> Motion:
        """The water at ``points`` (n, 3) m and ``t`` s, with the height of its surface from MuJoCo, after moving the
        field there."""
        xy = points[:, :2]
        low, high = xy.min(axis=0), xy.max(axis=0)
        if not (self.water.flat and (self.low <= low).all() and (high <= self.high).all()):
            self.update(t, low, high)
        # first, because it reports points outside a solver's grid
        found = self.water.at(points, t, self._rest(xy))
        return found._replace(height=self.heights(xy))

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
        if (last - first >= self.samples).any():
            raise SolveError(
                f"{(last - first).max() + 1} samples per side, at most {self.samples} are possible",
                subject="water field",
            )
        self.low, self.high = self.anchor + self.cell * first, self.anchor + self.cell * last
        x, y = (self.anchor[i] + self.cell[i] * np.arange(first[i], last[i] + 1) for i in range(2))
        heights, rest = self.water.grid(x, y, t)
        self.shift = None if rest is None else rest - np.stack(np.meshgrid(x, y), axis=-1)
        bottom, relief = float(heights.min()), max(float(np.ptp(heights)), 1e-3)
        model = self.model
        model.hfield_ncol[0], model.hfield_nrow[0] = len(x), len(y)
        model.hfield_size[0, :3] = [*(self.high - self.low) / 2, relief]
        model.hfield_data[: heights.size] = ((heights - bottom) / relief).ravel()
        self.data.mocap_pos[0] = [*(self.low + self.high) / 2, bottom]
        mujoco.mj_kinematics(model, self.data)

    def heights(self, xy: Any) -> Array:
        """Height (n,) m of the surface above ``xy`` (n, 2) m, by rays from above."""
        import mujoco

        points = np.asarray(xy, float).reshape(-1, 2)
        middle, bottom = self.data.geom_xpos[0, :2], self.data.geom_xpos[0, 2]
        rays = np.empty((len(points), 3))
        rays[:, :2], rays[:, 2] = points - middle, -self.top
        share, geoms = np.empty(len(points)), np.empty(len(points), np.int32)
        start = np.array([*middle, bottom + self.top])
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
