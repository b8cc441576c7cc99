"""Terrain: heights on a grid, and the triangles on which MuJoCo, USD and the distance field agree.

This module holds the ground itself: its vertices, its faces, its height anywhere. `surface.py` holds rock that is not a
height field; `reading.py` reads files.
"""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from vehsim.errors import InputError
from vehsim.world.terrain.level import LIFT, Level
from vehsim.world.terrain.surface import TOUCHED, TerrainSurface

Array = NDArray[np.float64]

MAX_POINTS = 4_000_000
"""Largest permitted number of heights."""
MAX_HEIGHT = 20_000.0
"""Largest plausible magnitude of a height, m: beyond it, a file has other units or no-data values."""

ROUNDED = 1e-6
"""Allowance for rounding in an upper bound of heights, m."""


@dataclass(frozen=True, eq=False)
class HeightGrid:
    """A height field: ``heights`` (rows, cols) m, row = +Y, column = +X.

    ``origin`` (x, y) of ``heights[0, 0]`` and ``cell`` (dx, dy), m. ``look``: a USD file with the mesh, material and
    texture of this terrain, or None. Each cell is split along (r, c)-(r+1, c+1), as in MuJoCo. ``surface``: the rock of
    a terrain with overhangs, whose ``heights`` are those of the lowest ground; None for a height field.
    """

    name: str
    heights: Array
    origin: tuple[float, float] = (0.0, 0.0)
    cell: tuple[float, float] = (1.0, 1.0)
    look: Path | None = None
    surface: TerrainSurface | None = None
    level: Level | None = None
    """The ground of one vehicle among several levels; by default, the lowest."""
    shows: str | None = None
    """The surface under tyres that the look shows: pictures may show another one. None: they keep the look."""

    def __post_init__(self) -> None:
        heights = np.array(self.heights, dtype=np.float64)  # our own read-only copy, so that caches stay valid
        heights.flags.writeable = False
        object.__setattr__(self, "heights", heights)
        object.__setattr__(self, "origin", (float(self.origin[0]), float(self.origin[1])))
        object.__setattr__(self, "cell", (float(self.cell[0]), float(self.cell[1])))
        _check(self)

    @property
    def lower(self) -> Array:
        """(3,) m: the smallest x, y and height."""
        return np.array([*self.origin, self.heights.min()]) if self.surface is None else self.surface.points.min(axis=0)

    @property
    def upper(self) -> Array:
        """(3,) m: the largest x, y and height."""
        if self.surface is not None:
            return self.surface.points.max(axis=0)
        rows, cols = self.heights.shape
        x, y = self.origin[0] + self.cell[0] * (cols - 1), self.origin[1] + self.cell[1] * (rows - 1)
        return np.array([x, y, self.heights.max()])

    @cached_property
    def vertices(self) -> Array:
        """Vertices (n, 3) m of the surface; those of a height field row after row."""
        if self.surface is not None:
            return self.surface.points
        rows, cols = self.heights.shape
        x = self.origin[0] + self.cell[0] * np.arange(cols)
        y = self.origin[1] + self.cell[1] * np.arange(rows)
        grid = np.broadcast_arrays(x[None, :], y[:, None], self.heights)
        return np.stack(grid, axis=-1).reshape(-1, 3)

    @cached_property
    def faces(self) -> NDArray[np.int64]:
        """(m, 3) vertex indices, counter-clockwise from the air; two faces per cell of a height field."""
        if self.surface is not None:
            return self.surface.faces
        rows, cols = self.heights.shape
        index = np.arange(rows * cols).reshape(rows, cols)
        a, b, c, d = index[:-1, :-1], index[:-1, 1:], index[1:, :-1], index[1:, 1:]
        return np.stack([a, b, d, a, d, c], axis=-1).reshape(-1, 3)

    def boxes(self) -> tuple[Array, Array]:
        """The lower and upper corners (n, 3), (n, 3) m of boxes around the triangles: around the two of every cell of a
        height field, around each of a surface."""
        if self.surface is not None:
            triangles = self.vertices[self.faces]
            return triangles.min(axis=1), triangles.max(axis=1)
        corners = self.vertices.reshape(*self.heights.shape, 3)
        first, last = corners[:-1, :-1].copy(), corners[1:, 1:].copy()
        heights = [self.heights[r : r - 1 or None, c : c - 1 or None] for r in (0, 1) for c in (0, 1)]
        first[..., 2], last[..., 2] = np.minimum.reduce(heights), np.maximum.reduce(heights)
        return first.reshape(-1, 3), last.reshape(-1, 3)

    def nearest(self, points: ArrayLike) -> Array:
        """The points (n, 3) m of the triangles that are closest to ``points`` (n, 3) m."""
        points = np.ascontiguousarray(points, dtype=float).reshape(-1, 3)
        _, _, there = self._tree.squared_distance(self.vertices, self.faces, points)
        return np.asarray(there)

    def near(self, points: ArrayLike, starts: ArrayLike | None = None, steps: int = 3) -> Array:
        """Surface points (n, 3) m of a height field that are almost as close to ``points`` (n, 3) m as the `nearest`
        ones, in a tenth of the time.

        From the surface at the horizontal places of ``starts`` (n, 3) m (default: straight above or below), each step
        moves to the closest point of the plane of the triangle there, or half as far where that is no closer. Beside
        cliffs, another place may be closer.
        """
        x, y, z = np.asarray(points, dtype=float).reshape(-1, 3).T
        low, high = self.lower, self.upper
        start = (x, y) if starts is None else np.asarray(starts, dtype=float).reshape(-1, 3).T
        u, v = (np.clip(start[axis], low[axis], high[axis]) for axis in (0, 1))
        found = [u, v, *self._planes(np.stack([u, v], axis=-1))]
        squares, share = (x - u) ** 2 + (y - v) ** 2 + (z - found[2]) ** 2, np.ones(len(x))
        for _ in range(steps):
            u, v, h, along_x, along_y = found
            above = (z - h - along_x * (x - u) - along_y * (y - v)) / (1 + along_x**2 + along_y**2)
            tried = np.clip(u + share * (x + along_x * above - u), low[0], high[0])
            beside = np.clip(v + share * (y + along_y * above - v), low[1], high[1])
            there = [tried, beside, *self._planes(np.stack([tried, beside], axis=-1))]
            others = (x - tried) ** 2 + (y - beside) ** 2 + (z - there[2]) ** 2
            nearer = others < squares
            for own, other in zip((*found, squares), (*there, others), strict=True):
                np.copyto(own, other, where=nearer)
            share = np.where(nearer, 1.0, share / 2)
        return np.stack(found[:3], axis=-1)

    @cached_property
    def _tree(self) -> Any:
        import igl

        if self.surface is not None:
            return self.surface.tree
        tree = igl.AABB()
        tree.init(self.vertices, self.faces)
        return tree

    def height(self, xy: ArrayLike) -> Array:
        """Height (n,) m of the ground at ``xy`` (n, 2) m; beyond the borders, that of the closest border point.

        Below an arch and in a cave, it is the height of their floor, or that of the ``level``.
        """
        xy = np.asarray(xy, dtype=float).reshape(-1, 2)
        if self.level is not None:
            return self._on_level(xy, self.level)
        return self._lowest(xy)

    def _on_level(self, xy: Array, level: Level) -> Array:
        """Height (n,) m of the level's ground at ``xy`` (n, 2) m; behind walls and beyond edges, that beside them."""
        assert self.surface is not None
        near, known = level.at(xy), level.knows(self._inner(xy))
        if not known.all():
            near[~known] = self._lowest(xy[~known])
        exact = self.surface.ground_below(np.column_stack([self._inner(xy), near + LIFT]))
        return np.where(np.abs(exact - near) <= LIFT + TOUCHED, exact, near)

    def _inner(self, xy: Array) -> Array:
        """``xy`` (n, 2) m, or the closest places inside the borders; a ray exactly along a border could miss."""
        inset = 1e-7 * (self.upper - self.lower)[:2]
        return np.clip(xy, self.lower[:2] + inset, self.upper[:2] - inset)

    def _lowest(self, xy: Array) -> Array:
        if self.surface is None:
            return self._on_grid(xy)
        exact = self.surface.floor(xy)
        return np.where(np.isnan(exact), self._on_grid(xy), exact)

    def height_below(self, points: ArrayLike) -> Array:
        """Height (n,) m of the ground below ``points`` (n, 3) m, or of the ground that they touch; on top of an arch,
        that of its top."""
        points = np.asarray(points, dtype=float).reshape(-1, 3)
        lowest = self.height(points[:, :2])
        if self.surface is None:
            return lowest
        exact = self.surface.ground_below(points)
        return np.where(np.isnan(exact), lowest, exact)

    def below(self, points: ArrayLike) -> NDArray[np.bool_]:
        """Whether ``points`` (n, 3) m lie in the rock, (n,)."""
        points = np.asarray(points, dtype=float).reshape(-1, 3)
        under = points[:, 2] < self._lowest(points[:, :2])
        return under if self.surface is None else under | self.surface.inside(points)

    def _on_grid(self, xy: Array) -> Array:
        """Height (n,) m of the grid's triangles at ``xy`` (n, 2) m."""
        u, v, a, b, c, d = self._corners(xy)
        return np.asarray(a + np.where(u >= v, u * (b - a) + v * (d - b), v * (c - a) + u * (d - c)))

    def _planes(self, xy: Array) -> tuple[Array, Array, Array]:
        """Height (n,) m of the grid's triangles at ``xy`` (n, 2) m, and their slopes (n,) along x and y."""
        u, v, a, b, c, d = self._corners(xy)
        right = u >= v
        along_x, along_y = np.where(right, b - a, d - c), np.where(right, d - b, c - a)
        return a + u * along_x + v * along_y, along_x / self.cell[0], along_y / self.cell[1]

    def _corners(self, xy: Array) -> tuple[Array, ...]:
        """The place (n,), (n,) of ``xy`` (n, 2) m in its cell, from 0 to 1, and the heights (n,) of its corners a, b
        and, in the next row, c, d."""
        rows, cols = self.heights.shape
        u, v = self._cells(xy)
        col, row = np.minimum(u.astype(int), cols - 2), np.minimum(v.astype(int), rows - 2)
        first = row * cols + col
        return u - col, v - row, *(self._row_by_row.take(first + more) for more in (0, 1, cols, cols + 1))

    def _cells(self, xy: Array) -> tuple[Array, Array]:
        """Columns and rows (n,) of ``xy`` (n, 2) m, with fractions; beyond the borders, those of the closest border
        point."""
        rows, cols = self.heights.shape
        u, v = ((xy[:, axis] - self.origin[axis]) / self.cell[axis] for axis in (0, 1))
        return np.minimum(np.maximum(u, 0), cols - 1), np.minimum(np.maximum(v, 0), rows - 1)

    @cached_property
    def _row_by_row(self) -> Array:
        return self.heights.ravel()

    def at_most(self, xy: Array, reach: float) -> Array:
        """An upper bound (n,) m of the heights of the grid within ``reach`` m of ``xy`` (n, 2) m, found quickly."""
        around = int(np.ceil(reach / min(self.cell)))  # cells
        if around not in self._tops:
            tops = self.heights
            for _ in range(2):  # a cell ends with the heights of the next one
                wide = np.pad(tops, ((around, around + 1), (0, 0)), mode="edge")
                tops = np.maximum.reduce([wide[k : len(tops) + k] for k in range(2 * around + 2)]).T
            self._tops[around] = tops.ravel() + ROUNDED
        u, v = self._cells(xy)
        return np.asarray(self._tops[around].take(v.astype(int) * self.heights.shape[1] + u.astype(int)))

    @cached_property
    def _tops(self) -> dict[int, Array]:
        """The largest heights around every cell, row by row, by the number of cells around it."""
        return {}

    def beyond(self, place: ArrayLike) -> str:
        """The border, such as ``"x = 291.8"``, on the side of a ``place`` (x, y, ...) m outside; empty inside.

        Beyond its borders the ground continues level, at the height of the closest border point, and is not drawn.
        """
        for axis, value in zip("xy", np.asarray(place, float)[:2], strict=True):
            low, high = self.lower["xy".index(axis)], self.upper["xy".index(axis)]
            if not low <= value <= high:
                return f"{axis} = {low if value < low else high:g}"
        return ""

    @cached_property
    def content_hash(self) -> str:
        """A hash of the terrain: the same heights and rock at the same place have the same hash."""
        digest = hashlib.sha256(repr((self.heights.shape, self.origin, self.cell)).encode())
        digest.update(self.heights.tobytes())
        if self.surface is not None:
            digest.update(self.surface.content_hash.encode())
        if self.level is not None:
            digest.update(self.level.content)
        return digest.hexdigest()


def _check(terrain: HeightGrid) -> None:
    """Raise ``InputError`` for heights that cannot be a terrain."""

    def refuse(key: str, message: str, remedy: str, value: object = None) -> None:
        raise InputError(message, remedy, key=key, value=value, file=terrain.name)

    heights = terrain.heights
    if heights.ndim != 2 or min(heights.shape) < 2:
        refuse("heights", "not a grid of at least 2 x 2", "give one height per (row, column)", heights.shape)
    if heights.size > MAX_POINTS:
        refuse("heights", f"more than {MAX_POINTS:,} points", "crop or resample it", heights.shape)
    bad = np.argwhere(~np.isfinite(heights))
    if len(bad):
        row, col = bad[0]
        remedy = "fill the holes before loading"
        refuse(f"heights[{row}, {col}]", f"{len(bad)} not finite", remedy, float(heights[row, col]))
    if np.abs(heights).max() > MAX_HEIGHT:
        row, col = np.unravel_index(np.abs(heights).argmax(), heights.shape)
        remedy = "heights are metres; name the value of missing heights: nodata = ... in the TOML file beside it"
        refuse(f"heights[{row}, {col}]", f"beyond {MAX_HEIGHT:g} m", remedy, float(heights[row, col]))
    if not (np.isfinite(terrain.cell).all() and min(terrain.cell) >= 1e-3 and max(terrain.cell) <= 1e4):
        refuse("cell", "not between 0.001 and 10000 m", "give the spacing of the heights in metres", terrain.cell)
    if not np.isfinite(terrain.origin).all():
        refuse("origin", "not finite", "give x and y of heights[0, 0] in metres", terrain.origin)
