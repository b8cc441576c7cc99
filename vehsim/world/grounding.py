"""Where convex hulls sink into terrain, exactly: both are flat pieces, so what is deepest is a corner of a hull, a
corner of the ground, or where an edge of the one crosses an edge of the other, seen from above.

MuJoCo's own contacts of a height field are not asked: their normals are those of its prisms' sides (derivations).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

TOUCH = 1e-12
"""Less depth than this is none, m."""
HAND = 0.05
"""Reach of the slope about a place, m."""


@dataclass(frozen=True)
class Points:
    """Where two things overlap: ``depths`` (n,) m, ``places`` (n, 3) m, unit ``normals`` (n, 3) towards the first."""

    depths: Array
    places: Array
    normals: Array


class Underside:
    """Convex hulls (n, 3) m each, in a body's frame, above a ``terrain``."""

    def __init__(self, hulls: list[Array], terrain: Any) -> None:
        from scipy.spatial import ConvexHull

        shapes = [ConvexHull(hull) for hull in hulls]
        self.terrain, self.corners = terrain, np.concatenate(hulls)
        self.planes = [np.unique(shape.equations.round(9), axis=0) for shape in shapes]
        ends = [np.unique(np.sort(s.simplices[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2)), axis=0) for s in shapes]
        before = np.cumsum([0, *map(len, hulls[:-1])])
        self.edges = np.concatenate([pairs + first for pairs, first in zip(ends, before, strict=True)])
        along = [np.abs(np.diff(terrain.heights, axis=1 - i)).max() / terrain.cell[i] for i in range(2)]
        self.steepest = float(np.hypot(*along))

    def on(self, R_wb: Array, position: Array) -> tuple[float, Points | None]:
        """How far above the ground the body is, m, or nearer, and where it is in it."""
        terrain = self.terrain
        corners = self.corners @ R_wb.T + position
        peaks = _within(terrain, corners[:, :2].min(axis=0), corners[:, :2].max(axis=0))
        ground = terrain.height(corners[:, :2])
        above = float(corners[:, 2].min() - max(peaks[:, 2].max(initial=-np.inf), ground.max()))
        if above > 0:
            return above, None
        gap = max(float((corners[:, 2] - ground).min()), 0.0)
        ends = corners[self.edges]
        long = np.hypot(*(ends[:, 1, :2] - ends[:, 0, :2]).T)
        # the ground between two ends is no higher than halfway between them and then up as steeply as it gets
        near = ends[:, :, 2].min(axis=1) - ground[self.edges].mean(axis=1) - self.steepest * long / 2 < gap + TOUCH
        places = np.concatenate([corners, _crossings(terrain, ends[near])])
        depths = terrain.height(places[:, :2]) - places[:, 2]
        gap = -float(depths.max())
        under = depths > TOUCH
        normals = slope_normals(terrain, places[under, :2])
        found = [Points(depths[under] * normals[:, 2], places[under], normals)]
        peaks = peaks[peaks[:, 2] > corners[:, 2].min() - max(gap, 0.0)]  # others are farther away
        local = (peaks - position) @ R_wb
        for planes in self.planes:
            outside = local @ planes[:, :3].T + planes[:, 3]
            face = outside.argmax(axis=1)
            far = outside.max(axis=1, initial=-np.inf)
            gap = min(gap, float(far.min(initial=np.inf)))
            inside = far < -TOUCH
            found.append(Points(-far[inside], peaks[inside], -planes[face[inside], :3] @ R_wb.T))
        joined = Points(*(np.concatenate([getattr(f, k) for f in found]) for k in ("depths", "places", "normals")))
        return (max(gap, 0.0), None) if not len(joined.depths) else (0.0, joined)


def _within(terrain: Any, low: Array, high: Array) -> Array:
    """Corners (n, 3) of the ground between ``low`` and ``high`` (2,) m."""
    cell, origin = np.asarray(terrain.cell), np.asarray(terrain.origin)
    most = np.array(terrain.heights.shape[::-1])
    first = np.clip(np.ceil((low - origin) / cell), 0, most).astype(int)
    last = np.clip(np.floor((high - origin) / cell) + 1, first, most).astype(int)
    heights = terrain.heights[first[1] : last[1], first[0] : last[0]]
    x, y = (origin[i] + cell[i] * np.arange(first[i], last[i]) for i in range(2))
    return np.stack([*np.meshgrid(x, y), heights], axis=-1).reshape(-1, 3)


def _crossings(terrain: Any, edges: Array) -> Array:
    """Points (n, 3) on ``edges`` (e, 2, 3) above edges of the ground: along X, along Y and across cells."""
    grid = (edges[:, :, :2] - np.asarray(terrain.origin)) / np.asarray(terrain.cell)
    found = [np.zeros((0, 3))]
    for lines in (grid[:, :, 0], grid[:, :, 1], grid[:, :, 0] - grid[:, :, 1]):
        low, high = lines.min(axis=1), lines.max(axis=1)
        counts = np.maximum(np.floor(high) - np.ceil(low) + 1, 0).astype(int)
        edge = np.repeat(np.arange(len(edges)), counts)
        number = np.ceil(low)[edge] + np.arange(len(edge)) - np.repeat(np.cumsum(counts) - counts, counts)
        start, end = lines[edge].T
        share = np.divide(number - start, end - start, out=np.zeros(len(edge)), where=end != start)
        found.append(edges[edge, 0] + share[:, None] * (edges[edge, 1] - edges[edge, 0]))
    return np.concatenate(found)


def slope_normals(terrain: Any, xy: Array) -> Array:
    """Upward unit normals (n, 3) of the terrain, a hand's width about each place."""
    offsets = HAND * np.array([[1, 0], [-1, 0], [0, 1], [0, -1]])
    heights = terrain.height((xy[:, None] + offsets).reshape(-1, 2)).reshape(len(xy), 4)
    up = np.column_stack([heights[:, 1] - heights[:, 0], heights[:, 3] - heights[:, 2], np.full(len(xy), 2 * HAND)])
    return np.asarray(up / np.linalg.norm(up, axis=1, keepdims=True))
