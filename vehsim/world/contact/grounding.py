"""Where convex hulls sink into terrain, exactly. Both consist of flat pieces, so the deepest point is a corner of a
hull, a corner of the ground, or a crossing, seen from above, of an edge of the hull and an edge of the ground.

MuJoCo's own contacts of a height field are not used: their normals include those of the sides of its prisms (see
docs/derivations.md).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

TOUCH = 1e-12
"""Depths below this count as zero, m."""
REACH = 1.0
"""Ground closer than this is monitored, m."""
KEPT = 1000
"""Planes above windows of the ground that are kept."""
ASIDE = 1e-6
"""Distance from an edge of the ground at which its two faces are looked up, in cells."""


@dataclass(frozen=True)
class Points:
    """The overlap of two bodies: ``depths`` (n,) m, ``places`` (n, 3) m, unit ``normals`` (n, 3) towards the first."""

    depths: Array
    places: Array
    normals: Array


NOWHERE = Points(np.zeros(0), np.zeros((0, 3)), np.zeros((0, 3)))


class Underside:
    """Convex hulls (n, 3) m each, in a body's frame, above a ``terrain``."""

    def __init__(self, hulls: list[Array], terrain: Any) -> None:
        from scipy.spatial import ConvexHull

        shapes = [ConvexHull(hull) for hull in hulls]
        self.terrain, self.corners = terrain, np.concatenate(hulls)
        planes = [np.unique(shape.equations.round(9), axis=0) for shape in shapes]
        bounds = np.cumsum([0, *map(len, planes)])
        self.planes, self._hulls = np.concatenate(planes), list(pairwise(bounds))
        ends = [np.unique(np.sort(s.simplices[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2)), axis=0) for s in shapes]
        before = np.cumsum([0, *map(len, hulls[:-1])])
        self.edges = np.concatenate([pairs + first for pairs, first in zip(ends, before, strict=True)])
        self._box = self.corners.min(axis=0), self.corners.max(axis=0)
        self._planes_above: dict[tuple[int, int, int, int], tuple[float, float, float]] = {}
        self._lengths = np.linalg.norm(np.diff(self.corners[self.edges], axis=1)[:, 0], axis=1)

    def on(self, R_wb: Array, position: Array) -> tuple[float, Points | None]:
        """A lower bound of the distance from the body to the ground, m, at most `REACH`; and the overlap."""
        terrain = self.terrain
        corners = self.corners @ R_wb.T + position
        low, high = corners.min(axis=0), corners.max(axis=0)
        window = _window(terrain, low[:2] - REACH, high[:2] + REACH)
        heights = terrain.heights[window]
        above = float(low[2] - heights.max())
        if above > 0:
            return min(above, REACH), None
        found = self._found(corners, self._above(corners, window) < TOUCH)
        gap = steepest = 0.0
        if not found:
            along = [np.abs(np.diff(heights, axis=1 - i)).max(initial=0.0) / terrain.cell[i] for i in range(2)]
            steepest = float(np.hypot(*along))
            gap = self._gap(corners, steepest)
        peaks = _peaks(terrain, low - gap, high)
        local = (peaks - position) @ R_wb
        if found:  # their distance does not matter
            inside = ((local > self._box[0]) & (local < self._box[1])).all(axis=1)
            peaks, local = peaks[inside], local[inside]
        if len(peaks):
            outside = local @ self.planes[:, :3].T + self.planes[:, 3]
            far = np.maximum.reduceat(outside, [first for first, _ in self._hulls], axis=1)
            gap = max(min(gap, float(far.min())), 0.0)
            for hull in np.flatnonzero((far < -TOUCH).any(axis=0)):
                first, last = self._hulls[hull]
                inside = far[:, hull] < -TOUCH
                face = first + outside[inside, first:last].argmax(axis=1)
                found.append(Points(-far[inside, hull], peaks[inside], -self.planes[face, :3] @ R_wb.T))
        if found:
            return 0.0, Points(
                *(np.concatenate([getattr(f, k) for f in found]) for k in ("depths", "places", "normals"))
            )
        return min(gap / float(np.hypot(1.0, steepest)), REACH), None  # a neighbouring face may be closer

    def nearing(self, R_wb: Array, position: Array, velocity: Callable[[Array], Array], seconds: float) -> float:
        """The greatest speed, m/s, at which corners that are above the ground now come to lie in it after ``seconds``;
        0: none does. ``velocity``: of places (n, 3) of the body, m/s."""
        corners = self.corners @ R_wb.T + position
        later = corners + seconds * velocity(corners)
        window = _window(self.terrain, later.min(axis=0)[:2] - REACH, later.max(axis=0)[:2] + REACH)
        low = self._above(later, window) < TOUCH
        before, after = (c[:, 2] - self.terrain.height(c[:, :2]) for c in (corners[low], later[low]))
        falls = (before - after)[(before > TOUCH) & (after < TOUCH)]
        return float(falls.max(initial=0.0)) / seconds

    def _above(self, corners: Array, window: tuple[slice, slice]) -> Array:
        """Heights (n,) m of ``corners`` (n, 3) above a plane that no ground in the ``window`` exceeds."""
        rows, cols = window
        if (kept := self._planes_above.get((rows.start, rows.stop, cols.start, cols.stop))) is None:
            if len(self._planes_above) > KEPT:
                self._planes_above.clear()
            kept = self._planes_above[rows.start, rows.stop, cols.start, cols.stop] = _plane_above(self.terrain, window)
        return np.asarray(corners[:, 2] - (corners[:, 0] * kept[0] + corners[:, 1] * kept[1] + kept[2]))

    def _found(self, corners: Array, low: NDArray[np.bool_]) -> list[Points]:
        """Where ``corners`` (n, 3) and edges sink in; those between corners that are not ``low`` (n,) do not."""
        terrain, found = self.terrain, []
        deep = corners[low]
        depths = terrain.height(deep[:, :2]) - deep[:, 2]
        if (depths > TOUCH).any():
            found.append(_from_faces(terrain, deep[depths > TOUCH]))
        start, end = self.edges.T
        places, directions, lines = _crossings(terrain, corners[self.edges[low[start] | low[end]]])
        depths = terrain.height(places[:, :2]) - places[:, 2]
        below = depths > TOUCH
        if below.any():
            found.append(_from_edges(terrain, places[below], directions[below], lines[below], depths[below]))
        return found

    def _gap(self, corners: Array, steepest: float) -> float:
        """The least height of ``corners`` (n, 3) and edges, none of which sinks in, above the ground, m."""
        ground = self.terrain.height(corners[:, :2])
        gap = max(float((corners[:, 2] - ground).min()), 0.0)
        # the ground between two ends is at most as high as their mean plus a rise at the steepest slope
        start, end = self.edges.T
        highest = (ground[start] + ground[end] + steepest * self._lengths) / 2
        near = np.minimum(corners[start, 2], corners[end, 2]) - highest < gap + TOUCH
        places = _crossings(self.terrain, corners[self.edges[near]])[0]
        return min(gap, float((places[:, 2] - self.terrain.height(places[:, :2])).min(initial=np.inf)))


def _plane_above(terrain: Any, window: tuple[slice, slice]) -> tuple[float, float, float]:
    """Slopes along X and Y, and the height at the origin, of a plane that no ground in the ``window`` exceeds. Beyond
    the borders the ground is level: there it is as high as the highest."""
    rows, cols = window
    heights = terrain.heights[window]
    size = terrain.heights.shape
    if rows.start == 0 or cols.start == 0 or rows.stop == size[0] or cols.stop == size[1]:
        return 0.0, 0.0, float(heights.max())
    y, x = np.meshgrid(np.arange(rows.start, rows.stop), np.arange(cols.start, cols.stop), indexing="ij")
    x, y = terrain.origin[0] + terrain.cell[0] * x.ravel(), terrain.origin[1] + terrain.cell[1] * y.ravel()
    slopes = np.linalg.lstsq(np.column_stack([x, y, np.ones_like(x)]), heights.ravel(), rcond=None)[0][:2]
    return float(slopes[0]), float(slopes[1]), float((heights.ravel() - x * slopes[0] - y * slopes[1]).max())


def _window(terrain: Any, low: Array, high: Array) -> tuple[slice, slice]:
    """Rows and columns of all cells between ``low`` and ``high`` (2,) m; beyond the borders, the closest cells."""
    cell, origin = np.asarray(terrain.cell), np.asarray(terrain.origin)
    last = np.array(terrain.heights.shape[::-1]) - 1
    first = _between(np.floor((low - origin) / cell), last).astype(int)
    end = _between(np.ceil((high - origin) / cell), last).astype(int) + 1
    return slice(first[1], end[1]), slice(first[0], end[0])


def _peaks(terrain: Any, low: Array, high: Array) -> Array:
    """Corners (n, 3) of the ground approximately between ``low`` and ``high`` (3,) m."""
    rows, cols = _window(terrain, low[:2], high[:2])
    heights = terrain.heights[rows, cols]
    row, col = np.nonzero((heights > low[2]) & (heights < high[2]))
    x, y = (terrain.origin[i] + terrain.cell[i] * k for i, k in enumerate((col + cols.start, row + rows.start)))
    return np.column_stack([x, y, heights[row, col]])


def _crossings(terrain: Any, edges: Array) -> tuple[Array, Array, Array]:
    """Points (n, 3) on ``edges`` (e, 2, 3) above edges of the ground, which run along X, along Y and across cells; the
    directions (n, 3) of the former and, seen from above, of the latter (n, 2)."""
    grid = (edges[:, :, :2] - np.asarray(terrain.origin)) / np.asarray(terrain.cell)
    x, y = grid[:, :, 0], grid[:, :, 1]
    ends = np.concatenate([x, y, x - y])  # of every edge, in units of the lines' spacing
    first = np.ceil(ends.min(axis=1))
    counts = np.where(ends[:, 0] != ends[:, 1], np.maximum(np.floor(ends.max(axis=1)) - first + 1, 0), 0).astype(int)
    pair = np.repeat(np.arange(len(ends)), counts)
    kind, edge = np.divmod(pair, max(len(edges), 1))
    number = first[pair] + np.arange(len(pair)) - (np.cumsum(counts) - counts)[pair]
    start, end = ends[pair].T
    along = (edges[:, 1] - edges[:, 0])[edge]
    places = edges[edge, 0] + ((number - start) / (end - start))[:, None] * along
    directions = np.array([(0.0, 1.0), (1.0, 0.0), np.asarray(terrain.cell) / np.hypot(*terrain.cell)])
    return places, along, directions[kind]


def _from_faces(terrain: Any, corners: Array) -> Points:
    """Depths of ``corners`` (n, 3) in the ground: below the face above them, or below an adjacent face across a convex
    edge if that is closer."""
    row, col, right = _cells(terrain, corners[:, :2])
    side, n = np.where(right, 1, -1), len(corners)
    rows, cols = (np.concatenate(k) for k in ((row, row, row - side, row), (col, col, col, col + side)))
    sides, xy = np.concatenate([right, *3 * [~right]]), np.tile(corners[:, :2], (4, 1))
    gradients, heights = _plane(terrain, rows, cols, sides, xy)
    normals, heights = _upward(gradients).reshape(4, n, 3), heights.reshape(4, n)
    depths = np.where(heights >= heights[0], (heights - corners[:, 2]) * normals[:, :, 2], np.inf)
    nearest = depths.argmin(axis=0), np.arange(n)
    return Points(depths[nearest], corners, normals[nearest])


def _from_edges(terrain: Any, places: Array, directions: Array, lines: Array, below: Array) -> Points:
    """Depths of edges of a hull with directions ``directions`` (n, 3) under edges of the ground with directions
    ``lines`` (n, 2), by ``below`` (n,) m: perpendicular to both, and no steeper than the ground on either side."""
    across = lines[:, ::-1] * [1, -1]
    aside = ASIDE * min(terrain.cell) * across
    beside = np.concatenate([places[:, :2] - aside, places[:, :2] + aside])
    sides = _plane(terrain, *_cells(terrain, beside), beside)[0].reshape(2, -1, 2)
    along = (sides[0] * lines).sum(axis=1)
    slopes = [(gradient * across).sum(axis=1) for gradient in sides]
    slope = (directions[:, 2] - along * (directions[:, :2] * lines).sum(axis=1)) / (directions[:, :2] * across).sum(
        axis=1
    )
    slope = np.clip(slope, np.minimum(*slopes), np.maximum(*slopes))
    normals = _upward(along[:, None] * lines + slope[:, None] * across)
    return Points(below * normals[:, 2], places, normals)


def _cells(terrain: Any, xy: Array) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.bool_]]:
    """Row, column and triangle (the right or the left one), (n,) each, of the ground at ``xy`` (n, 2)."""
    most = np.array(terrain.heights.shape[::-1]) - 2
    grid = (xy - np.asarray(terrain.origin)) / np.asarray(terrain.cell)
    first = _between(np.floor(grid), most).astype(int)
    u, v = (grid - first).T
    return first[:, 1], first[:, 0], u >= v


def _plane(terrain: Any, row: Any, col: Any, right: Any, xy: Array) -> tuple[Array, Array]:
    """Gradient (n, 2) of triangles, and height (n,) m of their planes at ``xy`` (n, 2); level beyond the borders."""
    heights, origin, cell = terrain.heights, np.asarray(terrain.origin), np.asarray(terrain.cell)
    last = np.array(heights.shape[::-1]) - 1
    row, col = _between(row, last[1] - 1), _between(col, last[0] - 1)
    a, b, c, d = (heights[row + i, col + k] for i in (0, 1) for k in (0, 1))
    rise = np.stack([np.where(right, b - a, d - c), np.where(right, d - b, c - a)], axis=1)
    grid = (xy - origin) / cell
    inside = _between(grid, last)
    height = a + (rise * (inside - np.stack([col, row], axis=1))).sum(axis=1)
    return np.where(grid == inside, rise / cell, 0.0), height


def _between(values: Any, most: Any) -> Any:
    """``values`` between 0 and ``most``: ``np.clip`` in half the time."""
    return np.minimum(np.maximum(values, 0), most)


def _upward(gradients: Array) -> Array:
    """Unit normals (n, 3) of slopes (n, 2)."""
    up = np.column_stack([-gradients, np.ones(len(gradients))])
    return np.asarray(up / np.linalg.norm(up, axis=1, keepdims=True))
