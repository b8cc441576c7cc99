"""Where convex hulls sink into terrain with overhangs: into its floors, walls and roofs.

The distance in the air is FCL's. Where hulls touch, three kinds of points press: corners of hulls in the rock, corners
of the rock in hulls, and edges of hulls that cross the rock between their ends.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vehsim.lie.quaternions import quaternions
from vehsim.world.contact.grounding import NOWHERE, REACH, TOUCH, Points
from vehsim.world.distance.surface_scene import SurfaceScene

Array = NDArray[np.float64]

FLAT = 1e-4
"""Smallest sine of the angle between two faces that meet in an edge."""


class Rock:
    """Convex hulls (n, 3) m each, in the frame of a rig's root, in a ``terrain`` with overhangs."""

    def __init__(self, hulls: list[Array], terrain: Any, rig: Any) -> None:
        import igl
        from scipy.spatial import ConvexHull

        shapes = [ConvexHull(hull) for hull in hulls]
        self.terrain, self._scene = terrain, SurfaceScene(terrain, rig)
        self._corners = np.concatenate([hull[shape.vertices] for hull, shape in zip(hulls, shapes, strict=True)])
        self._planes = [np.unique(shape.equations.round(9), axis=0) for shape in shapes]
        self._edges = np.concatenate([_sharp(hull, shape) for hull, shape in zip(hulls, shapes, strict=True)])
        self._mesh = np.ascontiguousarray(terrain.vertices), np.ascontiguousarray(terrain.faces)
        self._tree = igl.AABB()
        self._tree.init(*self._mesh)
        normals = terrain.surface.normals
        self._normals = normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-300)

    def on(self, R_wb: Array, position: Array) -> tuple[float, Points | None]:
        """The distance from the body to the rock, m, at most `REACH`; and the overlap."""
        gap = float(self._scene.clearance(position[None], quaternions(R_wb[None]))[0])
        if gap > 0:
            return min(gap, REACH), None
        corners = self._corners @ R_wb.T + position
        ends = self._edges @ R_wb.T + position
        low, high = corners.min(axis=0), corners.max(axis=0)
        found = [self._sunk(corners), self._crossed(ends), self._peaks(R_wb, position, low, high)]
        joined = Points(*(np.concatenate([getattr(f, k) for f in found]) for k in ("depths", "places", "normals")))
        return 0.0, joined if len(joined.depths) else None

    def nearing(self, R_wb: Array, position: Array, velocity: Callable[[Array], Array], seconds: float) -> float:
        """The speed, m/s, of the fastest corner in the air that comes to lie in the rock after ``seconds``; 0: none
        does. ``velocity``: of places (n, 3) of the body, m/s."""
        corners = self._corners @ R_wb.T + position
        speeds = velocity(corners)
        hits = self.terrain.below(corners + seconds * speeds)
        hits[hits] = ~self.terrain.below(corners[hits])
        return float(np.linalg.norm(speeds[hits], axis=1).max(initial=0.0))

    def _sunk(self, corners: Array) -> Points:
        """Corners (n, 3) of hulls in the rock, pushed to its nearest point; beyond the borders, upwards."""
        inner = self.terrain.below(corners)
        places = np.ascontiguousarray(corners[inner])
        if not len(places):
            return NOWHERE
        squared, _, nearest = self._tree.squared_distance(*self._mesh, places)
        depths = np.sqrt(squared)
        normals = (nearest - places) / np.maximum(depths, TOUCH)[:, None]
        flat = places[:, :2]
        outside = ((flat < self.terrain.lower[:2]) | (flat > self.terrain.upper[:2])).any(axis=1)
        depths[outside] = (self.terrain.height(flat[outside]) - places[outside, 2]).clip(0)
        normals[outside] = (0.0, 0.0, 1.0)
        deep = depths > TOUCH
        return Points(depths[deep], places[deep], normals[deep])

    def _crossed(self, ends: Array) -> Points:
        """Edges (n, 2, 3) of hulls with both ends in the air that cross the rock: their middle in it, pushed across
        them and the edge between the two faces."""
        near = self._near(ends)
        a, b = ends[near, 0], ends[near, 1]
        free = ~(self.terrain.below(a) | self.terrain.below(b)) if len(a) else np.zeros(0, bool)
        a, b = np.ascontiguousarray(a[free]), np.ascontiguousarray(b[free])
        if not len(a):
            return NOWHERE
        first, there, _ = self._tree.intersect_ray_first(*self._mesh, a, b - a)
        last, back, _ = self._tree.intersect_ray_first(*self._mesh, b, a - b)
        there, back = np.asarray(there), 1 - np.asarray(back)
        hit = (np.asarray(first) >= 0) & (np.asarray(last) >= 0) & (there < back) & (there < 1) & (back > 0)
        if not hit.any():
            return NOWHERE
        a, b, there, back = a[hit], b[hit], there[hit], back[hit]
        middle = a + ((there + back) / 2)[:, None] * (b - a)
        sides = self._normals[np.asarray(first)[hit]], self._normals[np.asarray(last)[hit]]
        ridge = np.cross(*sides)
        known = np.linalg.norm(ridge, axis=1) > FLAT  # otherwise the edge pierces a slab
        a, b, there, back, middle, ridge = (x[known] for x in (a, b, there, back, middle, ridge))
        sides = sides[0][known], sides[1][known]
        # the line in which the two faces' planes meet
        reach = [((a + t[:, None] * (b - a)) * n).sum(axis=1) for t, n in ((there, sides[0]), (back, sides[1]))]
        known_at = np.stack([*reach, (middle * ridge).sum(axis=1)], axis=1)
        line = np.linalg.solve(np.stack([*sides, ridge], axis=1), known_at[..., None])[..., 0]
        across = np.cross(b - a, ridge)
        across *= np.sign((across * (sides[0] + sides[1])).sum(axis=1))[:, None]
        across /= np.maximum(np.linalg.norm(across, axis=1, keepdims=True), TOUCH)
        depths = ((line - a) * across).sum(axis=1)
        deep = depths > TOUCH
        return Points(depths[deep], middle[deep], across[deep])

    def _near(self, ends: Array) -> NDArray[np.bool_]:
        """Which edges (n, 2, 3) are near enough to the rock to cross it."""
        squared, _, _ = self._tree.squared_distance(*self._mesh, np.ascontiguousarray(ends.mean(axis=1)))
        return np.asarray(4 * squared < ((ends[:, 1] - ends[:, 0]) ** 2).sum(axis=1))

    def _peaks(self, R_wb: Array, position: Array, low: Array, high: Array) -> Points:
        """Corners of the rock in hulls, pushed to the hull's nearest face."""
        points = self._mesh[0]
        local = (points[((points > low) & (points < high)).all(axis=1)] - position) @ R_wb
        found = [NOWHERE]
        for planes in self._planes:
            outside = local @ planes[:, :3].T + planes[:, 3]
            face, depths = outside.argmax(axis=1), -outside.max(axis=1, initial=-np.inf)
            inside = depths > TOUCH
            places = local[inside] @ R_wb.T + position
            found.append(Points(depths[inside], places, -planes[face[inside], :3] @ R_wb.T))
        return Points(*(np.concatenate([getattr(f, k) for f in found]) for k in ("depths", "places", "normals")))


def _sharp(hull: Array, shape: Any) -> Array:
    """The ends (n, 2, 3) of a convex hull's edges, without those within flat faces."""
    found = []
    for face, around in enumerate(shape.neighbors):
        for k, other in enumerate(around):
            if face < other and shape.equations[face, :3] @ shape.equations[other, :3] < 1 - 1e-9:
                found.append(np.delete(shape.simplices[face], k))
    return hull[np.array(found)]
