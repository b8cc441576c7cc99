"""The walls, roofs and edges of a terrain with overhangs, as a vehicle on the ground meets them.

Relative to the vehicle's ground (`levels`), rock from `STEP` above it up to the vehicle's height is an obstacle, and so
is every place without ground. In plan view, these are convex polygons for the planner; distances are those of the
rock's own triangles.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from vehsim.world.ground.levels import STEP
from vehsim.world.obstacles.plane import convex_parts, signed_area
from vehsim.world.terrain.level import Level
from vehsim.world.terrain.terrain import Terrain

Array = NDArray[np.float64]
Faces = NDArray[np.int64]

PIECE = 3.0
"""Longest edge of the pieces of triangles whose height above the ground is linear, m."""
MOST = 30
"""Largest number of times that an edge is halved for it."""
SLACK = 0.02
"""How far polygons of the plan view stand out from the rock at most, m: they have fewer corners than it."""
ROUGH = 24
"""Polygons with more corners are divided before they are split into convex parts."""
THIN = 1e-3
"""Half the width of a wall without any in plan view, and the smallest width of a part, m."""


@dataclass(frozen=True, eq=False)
class Walls:
    """What a vehicle ``height`` m high, with its clearance, must not touch on a ``terrain`` whose level is chosen."""

    terrain: Terrain
    height: float
    name: ClassVar[str] = "rock"
    moves: ClassVar[bool] = False
    bottom: ClassVar[float] = -np.inf
    top: ClassVar[float] = np.inf

    @cached_property
    def parts(self) -> tuple[Array, ...]:
        """Convex polygons (k, 2) m that cover it in plan view."""
        corners, _, above, floor = self._pieces
        beside = ~floor & (above.max(axis=1) > STEP) & (above.min(axis=1) < self.height)
        rock = [
            low[:, :2]
            for high in _clipped_above(corners[beside], above[beside])
            for low in _clipped(high[:, :3], high[:, 3], self.height, -1.0)
        ]
        return tuple(_parts(self.level, corners[floor][..., :2], rock))

    @cached_property
    def mesh(self) -> tuple[Array, Faces]:
        """Points (n, 3) m and triangles (m, 3) of the rock that is `STEP` or more above the ground."""
        corners, source, above, floor = self._pieces
        assert self.terrain.surface is not None
        surface, high = self.terrain.surface, ~floor & (above.max(axis=1) > STEP)
        whole = np.ones(len(surface.faces), bool)
        np.logical_and.at(whole, source, high & (above.min(axis=1) >= STEP))
        cut = high & ~whole[source]
        fans = _clipped_above(corners[cut], above[cut])
        triangles = [piece[[0, k, k + 1], :3] for piece in fans for k in range(1, len(piece) - 1)]
        triangles += [*surface.points[surface.faces[np.unique(source[high & whole[source]])]]]
        points, faces = np.unique(np.array(triangles).reshape(-1, 3), axis=0, return_inverse=True)
        return points, np.ascontiguousarray(faces.reshape(-1, 3))

    @property
    def level(self) -> Level:
        """The vehicle's ground."""
        assert self.terrain.level is not None
        return self.terrain.level

    @cached_property
    def _pieces(self) -> tuple[Array, NDArray[np.intp], Array, NDArray[np.bool_]]:
        """Small pieces of the rock's triangles: corners (n, 3, 3) m, the triangle of each, heights (n, 3) m of the
        corners above the ground, and which pieces are this ground."""
        assert self.terrain.surface is not None
        corners, source = _pieces(self.terrain, self.level)
        above = corners[..., 2] - self.level.at(corners[..., :2].reshape(-1, 2)).reshape(corners.shape[:2])
        return corners, source, above, self.terrain.surface.is_ground(corners) & (np.abs(above) < STEP).all(axis=1)

    def shapes_at(self, seconds: Array) -> Sequence[Array]:
        """The parts; ``seconds`` (n,) since frame 0."""
        return self.parts


def _clipped_above(corners: Array, above: Array) -> list[Array]:
    """The parts (k, 4) of pieces (n, 3, 3) that are `STEP` or more above the ground, with their heights above it."""
    return [part for piece, d in zip(corners, above, strict=True) for part in _clipped(piece, d, STEP, 1.0)]


def _pieces(terrain: Terrain, level: Level) -> tuple[Array, NDArray[np.intp]]:
    """Corners (n, 3, 3) m of small pieces of the rock's triangles near the level's grid, and the triangle of each."""
    import trimesh

    surface = terrain.surface
    assert surface is not None
    ends = surface.points[surface.faces][..., :2]
    near = ((ends.max(axis=1) > level.lower) & (ends.min(axis=1) < level.upper)).all(axis=1)
    points, faces, source = trimesh.remesh.subdivide_to_size(
        surface.points, surface.faces[near], PIECE, max_iter=MOST, return_index=True
    )
    corners = points[faces]
    inside = ((corners.max(axis=1)[:, :2] > level.lower) & (corners.min(axis=1)[:, :2] < level.upper)).all(axis=1)
    return corners[inside], np.flatnonzero(near)[source[inside]]


def _clipped(piece: Array, above: Array, limit: float, sign: float) -> list[Array]:
    """The part (k, 4) of a convex piece (n, 3) on one side of a height above the ground, with that height; or none."""
    inside = sign * (above - limit)
    full = np.column_stack([piece, above])
    if (inside >= 0).all():
        return [full]
    kept: list[Array] = []
    for k in range(len(piece)):
        a, b = inside[k - 1], inside[k]
        if a * b < 0:
            kept.append(full[k - 1] + a / (a - b) * (full[k] - full[k - 1]))
        if b >= 0:
            kept.append(full[k])
    return [np.array(kept)] if len(kept) > 2 else []


def _parts(level: Level, floor: Array, rock: list[Array]) -> list[Array]:
    """Convex polygons (k, 2) m: places without ground, and rock seen from above."""
    import shapely
    from scipy.ndimage import binary_dilation

    wide = np.ones((3, 3), bool)
    near = binary_dilation(level.solid, wide, iterations=2)
    index = np.round((floor.mean(axis=1) - level.lower) / level.cell).astype(int)
    i, j = np.clip(index, 0, np.subtract(near.shape, 1)).T
    beside = binary_dilation(near, wide, iterations=int(np.ceil(PIECE / level.cell)) + 1)[i, j]
    gone = shapely.difference(_squares(level, near), shapely.union_all(shapely.polygons(floor[beside])))
    flat = shapely.buffer([_seen(piece) for piece in rock], THIN, cap_style="square", join_style="mitre")
    blocked = shapely.union_all([gone, *flat, _squares(level, level.seams)])
    blocked = shapely.simplify(shapely.buffer(blocked, SLACK / 2, join_style="mitre"), SLACK / 2)
    return [part for polygon in shapely.get_parts(blocked).tolist() for part in _convex(polygon)]


def _squares(level: Level, cells: NDArray[np.bool_]) -> Any:
    """The union of cells of the grid (nx, ny)."""
    import shapely

    ends = np.diff(np.pad(cells, ((0, 0), (1, 1))).astype(int), axis=1)
    column, first = np.nonzero(ends > 0)
    last = np.nonzero(ends < 0)[1]
    low = level.lower + level.cell * (np.column_stack([column, first]) - 0.5)
    high = level.lower + level.cell * (np.column_stack([column + 1, last]) - 0.5)
    return shapely.union_all(shapely.box(*low.T, *high.T))


def _seen(piece: Array) -> Any:
    """A convex piece (k, 2) seen from above: a polygon, or a line if it is upright."""
    import shapely

    return shapely.convex_hull(shapely.multipoints(piece))


def _convex(polygon: Any) -> list[Array]:
    """Convex polygons (k, 2), counter-clockwise, whose union is a shapely polygon; slivers are left out."""
    import shapely

    shell = shapely.get_coordinates(polygon.exterior)[:-1]
    if not len(shell) or polygon.buffer(-THIN).is_empty:
        return []
    if len(polygon.interiors) or len(shell) > ROUGH:
        (x0, y0), (x1, y1) = shell.min(axis=0), shell.max(axis=0)
        middle = ((x0 + x1) / 2, y1) if x1 - x0 > y1 - y0 else (x1, (y0 + y1) / 2)
        first = shapely.box(x0, y0, *middle)
        halves = shapely.intersection(polygon, first), shapely.difference(polygon, first)
        parts = [part for half in halves for part in shapely.get_parts(half).tolist() if part.geom_type == "Polygon"]
        return [found for part in parts for found in _convex(part)]
    ring = shell if signed_area(shell) > 0 else shell[::-1]
    return [part for part in convex_parts(ring) if len(part) > 2]
