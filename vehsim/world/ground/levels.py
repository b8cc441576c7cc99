"""The ground of a vehicle where several lie above each other: in a cave and on its roof, on a bridge and below it.

Seen from above, a place can have several levels of ground. A vehicle keeps to the one that it reaches first along the
ground from the places where it stands (Dijkstra over a grid of all levels). Beside a wall or an edge, the ground that
the vehicle reaches continues level for `BESIDE`, whatever else lies there.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike, NDArray

from vehsim.world.terrain.level import Level
from vehsim.world.terrain.surface import TerrainSurface
from vehsim.world.terrain.terrain import Terrain

Array = NDArray[np.float64]
Window = tuple[slice, slice]

ROOM, SPAN = 30.0, 0.5
"""Margin around the given places in which the levels are known: so many m, or this share of their extent."""
FINEST, CELLS = 0.25, 300
"""Smallest cell, m, and the largest number of cells along a side."""
STEEPEST = 1.1
"""Steepest ground that a vehicle drives on, m/m: the grip of dry tyres."""
STEP = 0.3
"""Height of a step that belongs to the ground, m."""
NEAR = 2.0
"""Places other than the first that are farther from any ground do not choose a level, m."""
BESIDE = 3.0
"""How far the ground continues behind a wall or beyond an edge, m."""


def on_level(terrain: Terrain, places: ArrayLike, around: ArrayLike = ()) -> Terrain:
    """The terrain as the ground of a vehicle that stands at ``places`` (n, 3) m, at each on the level closest to its z,
    which counts except at the first only if it is near.

    The levels are known near these places and near others, ``around`` (k, 2) m; elsewhere, the ground is the lowest.
    A terrain without overhangs has one level, and is returned unchanged; so is one whose level is chosen already.
    """
    if terrain.surface is None or terrain.level is not None:
        return terrain
    places, others = np.asarray(places, float).reshape(-1, 3), np.asarray(around, float).reshape(-1, 2)
    ends = np.vstack([places[:, :2], others])
    return _on_level(terrain, places.tobytes(), np.array([ends.min(axis=0), ends.max(axis=0)]).tobytes())


@lru_cache(maxsize=32)
def _on_level(terrain: Terrain, places: bytes, box: bytes) -> Terrain:
    surface = terrain.surface
    assert surface is not None
    return replace(
        terrain, level=_level(terrain, surface, np.frombuffer(places).reshape(-1, 3), np.frombuffer(box).reshape(2, 2))
    )


def _level(terrain: Terrain, surface: TerrainSurface, places: Array, box: Array) -> Level:
    from scipy.ndimage import distance_transform_edt
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import dijkstra

    low, high = box
    room = max(ROOM, SPAN * float((high - low).max()))
    low, high = low - room, high + room
    low, high = (
        np.minimum(np.maximum(low, terrain.lower[:2]), high),
        np.maximum(np.minimum(high, terrain.upper[:2]), low),
    )
    cell = max(FINEST, float((high - low).max()) / CELLS)
    nx, ny = np.maximum(np.ceil((high - low) / cell).astype(int) + 1, 4)
    grid = np.stack(np.meshgrid(low[0] + cell * np.arange(nx), low[1] + cell * np.arange(ny), indexing="ij"), axis=-1)
    inner = np.clip(grid.reshape(-1, 2), terrain.lower[:2] + 1e-6, terrain.upper[:2] - 1e-6)  # level beyond the borders
    levels = surface.levels(inner).reshape(nx, ny, -1)
    node = np.arange(levels.size).reshape(levels.shape)
    rows, columns, lengths = [], [], []
    for here, there, far in _neighbours((nx, ny), cell):
        rise = levels[here][..., :, None] - levels[there][..., None, :]
        joined = np.abs(rise) <= STEEPEST * far + STEP / 2
        rows.append(np.broadcast_to(node[here][..., :, None], joined.shape)[joined])
        columns.append(np.broadcast_to(node[there][..., None, :], joined.shape)[joined])
        lengths.append(np.hypot(rise[joined], far))
    ends = np.concatenate(rows), np.concatenate(columns)
    graph = coo_matrix((np.concatenate(lengths), ends), shape=(levels.size, levels.size)).tocsr()
    column = np.clip(np.round((places[:, :2] - low) / cell).astype(int), 0, [nx - 1, ny - 1])
    beside = np.abs(levels[column[:, 0], column[:, 1]] - places[:, 2:])
    beside[np.isnan(beside)] = np.inf
    nearest, known = beside.argmin(axis=1), beside.min(axis=1) < np.where(np.arange(len(places)), NEAR, np.inf)
    starts = np.unique(node[column[known, 0], column[known, 1], nearest[known]])
    ways = np.full(levels.shape, np.inf)
    if len(starts):
        ways = dijkstra(graph, indices=starts, min_only=True).reshape(levels.shape)
    first = ways.argmin(axis=2)[..., None]
    away = np.take_along_axis(ways, first, axis=2)[..., 0]
    heights = np.take_along_axis(levels, first, axis=2)[..., 0]
    reached = np.isfinite(away)
    if not reached.any():
        return Level(low, cell, terrain.height(grid.reshape(-1, 2)).reshape(nx, ny), *np.zeros((2, nx, ny), bool))
    claimed, claims = _claimed(levels, heights, away, cell)
    heights[claimed] = claims[claimed]
    reached &= ~claimed
    seams = _seams(heights, away, reached, cell)
    claimed |= np.isfinite(away)
    places_of = distance_transform_edt(~claimed, return_distances=False, return_indices=True)
    return Level(low, cell, heights[tuple(places_of)], ~reached | seams, seams)


def _claimed(levels: Array, heights: Array, away: Array, cell: float) -> tuple[NDArray[np.bool_], Array]:
    """Columns (nx, ny) beside walls and edges, and the heights of the ground that ends there.

    A column is beside one if ground that is reached much earlier ends there: no level of the column continues it.
    """
    best, height = np.where(np.isfinite(away), away, np.inf), heights.copy()
    claimed = np.zeros(away.shape, bool)
    for _ in range(int(np.ceil(BESIDE / cell))):
        before, known = best.copy(), height.copy()
        for here, there, far in _neighbours(away.shape, cell):
            least = STEEPEST * far + STEP / 2
            ends = ~(np.abs(levels[here] - known[there][..., None]) <= least).any(axis=2)
            both = ~(np.abs(levels[there] - known[here][..., None]) <= least).any(axis=2)
            taken = ends & (before[there] < best[here] + np.where(both, 0.0, far))
            best[here] = np.where(taken, before[there] + far, best[here])
            height[here] = np.where(taken, known[there], height[here])
            claimed[here] |= taken
    return claimed, height


def _seams(heights: Array, away: Array, reached: NDArray[np.bool_], cell: float) -> NDArray[np.bool_]:
    """Columns (nx, ny) where two levels meet that were reached equally soon: the later one of neighbours."""
    seams = np.zeros(away.shape, bool)
    for here, there, far in _neighbours(away.shape, cell):
        apart = np.abs(heights[here] - heights[there]) > 2 * STEEPEST * far + STEP
        seams[here] |= apart & reached[here] & reached[there] & (away[here] >= away[there])
    return seams


def _neighbours(shape: tuple[int, ...], cell: float) -> Iterator[tuple[Window, Window, float]]:
    """All columns with a neighbour on one side, these neighbours, and how far they are, m; for each of the sides."""
    for i, j in ((i, j) for i in (-1, 0, 1) for j in (-1, 0, 1) if i or j):
        there = slice(max(0, i), shape[0] + min(0, i)), slice(max(0, j), shape[1] + min(0, j))
        here = slice(max(0, -i), shape[0] + min(0, -i)), slice(max(0, -j), shape[1] + min(0, -j))
        yield here, there, cell * float(np.hypot(i, j))
