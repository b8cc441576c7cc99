"""Distances by elementary geometry."""

from __future__ import annotations

import igl
import numpy as np
from scipy.spatial import ConvexHull

from vehsim.world.terrain.terrain import Terrain


class ExactDistance:
    """The distance from placed convex hulls to a terrain's triangles.

    Two disjoint polyhedral surfaces are nearest at a vertex of one and a face of the other, or at two edges: all three
    are enumerated where they can matter.
    """

    def __init__(self, terrain: Terrain) -> None:
        self.vertices = np.ascontiguousarray(terrain.vertices)
        self.faces = np.ascontiguousarray(terrain.faces)
        self.tree = igl.AABB()
        self.tree.init(self.vertices, self.faces)
        pairs = np.sort(self.faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
        self.edges = np.unique(pairs, axis=0)
        ends = self.vertices[self.edges]
        self.low, self.high = ends.min(axis=1), ends.max(axis=1)

    def __call__(self, hull: np.ndarray) -> float:
        """Distance of the hull with vertices (n, 3), which must not touch the terrain."""
        faces = ConvexHull(hull).simplices.astype(np.int64)
        best = np.sqrt(self.tree.squared_distance(self.vertices, self.faces, np.ascontiguousarray(hull))[0].min())
        low, high = hull.min(axis=0) - best, hull.max(axis=0) + best
        near = ((self.high >= low) & (self.low <= high)).all(axis=1)
        if not near.any():
            return float(best)
        ground = np.unique(self.edges[near])
        points = np.ascontiguousarray(self.vertices[ground])
        best = min(best, np.sqrt(igl.point_mesh_squared_distance(points, np.ascontiguousarray(hull), faces)[0].min()))
        edges = np.unique(np.sort(faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1), axis=0)
        a, b = hull[edges][:, None], self.vertices[self.edges[near]][None]
        return float(min(best, segment_distance(a[:, :, 0], a[:, :, 1], b[:, :, 0], b[:, :, 1]).min()))


def segment_distance(p0, p1, q0, q1) -> np.ndarray:
    """Distances between segments p0 p1 and q0 q1 (..., 3): the inner solution, or an end against the other segment."""
    u, v, w = p1 - p0, q1 - q0, p0 - q0
    a, b, c, d, e = (np.sum(x * y, axis=-1) for x, y in ((u, u), (u, v), (v, v), (u, w), (v, w)))
    det = a * c - b * b
    safe = np.where(det > 1e-12 * a * c, det, 1.0)
    s, t = (b * e - c * d) / safe, (a * e - b * d) / safe
    inner = (det > 1e-12 * a * c) & (s >= 0) & (s <= 1) & (t >= 0) & (t <= 1)
    gap = np.linalg.norm(w + s[..., None] * u - t[..., None] * v, axis=-1)
    best = np.where(inner, gap, np.inf)
    for point, start, along in ((p0, q0, v), (p1, q0, v), (q0, p0, u), (q1, p0, u)):
        x = np.clip(np.sum((point - start) * along, axis=-1) / np.sum(along * along, axis=-1), 0, 1)
        best = np.minimum(best, np.linalg.norm(point - start - x[..., None] * along, axis=-1))
    return best
