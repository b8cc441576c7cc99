"""Vehicles and obstacles in plan view: distances from outlines to shapes, and simplified outlines.

This module computes with numpy. The rows of the optimisation problem are in `features.py`, exact distances in
`world.obstacles.plane`.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vehsim.world.obstacles.plane import bounding_circle, distance

Array = NDArray[np.float64]


def clearances(parts: Sequence[tuple[Any, int]], outlines: Array, seconds: Array, reach: float = np.inf) -> Array:
    """Signed distances (parts, n) m of outlines (n, k, 2) at ``seconds`` (n,) since frame 0.

    Distances above ``reach`` m are lower bounds, also above ``reach``.
    """
    found = [gaps_to(obstacle.shapes_at(seconds)[number], outlines, reach) for obstacle, number in parts]
    return np.reshape(found, (len(parts), len(outlines)))


def least_clearance(parts: Sequence[tuple[Any, int]], outlines: Array, seconds: Array) -> float:
    """Smallest signed distance, m, of outlines (n, k, 2) at ``seconds`` (n,) since frame 0 to any of the parts."""
    shapes = [obstacle.shapes_at(seconds)[number] for obstacle, number in parts]
    bounds = [bounds_to(shape, outlines).min() for shape in shapes]
    least = np.inf
    for i in np.argsort(bounds):
        if bounds[i] >= least:
            break
        least = min(least, float(gaps_to(shapes[i], outlines, least).min()))
    return least


def gaps_to(shape: Any, outlines: Array, reach: float = np.inf) -> Array:
    """Signed distances (n,) m of outlines (n, k, 2) to one shape, or to one shape each (n, m, 2).

    Distances above ``reach`` m are lower bounds, also above ``reach``.
    """
    out = bounds_to(shape, outlines)
    near = out < reach
    if near.any():
        out[near] = distance(outlines[near], shape[near] if np.ndim(shape) == 3 else shape)
    return out


def bounds_to(shape: Any, outlines: Array) -> Array:
    """Lower bounds (n,) m on the distances of outlines (n, k, 2) to one shape, or to one shape each (n, m, 2)."""
    (centres, radii), (middle, radius) = bounding_circle(outlines), bounding_circle(shape)
    return np.asarray(np.linalg.norm(centres - middle, axis=-1) - radii - radius)


def simplified(polygon: Array, count: int) -> Array:
    """A convex polygon of at most ``count`` corners that contains ``polygon`` (k, 2) with little added area."""
    while len(polygon) > count:
        added = [_without_edge(polygon, i) for i in range(len(polygon))]
        best = min(range(len(polygon)), key=lambda i: added[i][0])
        if not np.isfinite(added[best][0]):
            break
        polygon = added[best][1]
    return polygon


def _without_edge(polygon: Array, i: int) -> tuple[float, Array]:
    """The area added when edge ``i`` is removed and its neighbours are extended until they meet, and the new polygon.

    The area is inf if the neighbours do not meet.
    """
    n = len(polygon)
    before, a, b, after = (polygon[k % n] for k in (i - 1, i, i + 1, i + 2))
    u, v = a - before, b - after
    cross = u[0] * v[1] - u[1] * v[0]
    if cross >= -1e-12:
        return np.inf, polygon
    offset = b - a
    corner = a + (offset[0] * v[1] - offset[1] * v[0]) / cross * u
    area = abs((b - a)[0] * (corner - a)[1] - (b - a)[1] * (corner - a)[0]) / 2
    kept = polygon.copy()
    kept[i] = corner
    return float(area), np.delete(kept, (i + 1) % n, axis=0)


def inner_discs(polygon: Array) -> list[tuple[Array, float]]:
    """Discs (centre (2,), radius m) inside a convex polygon, from one end to the other, about one radius apart."""
    if len(polygon) < 3:
        return []
    low, high = polygon.min(axis=0), polygon.max(axis=0)
    grid = np.stack(np.meshgrid(*np.linspace(low, high, 41).T, indexing="ij"), axis=-1).reshape(-1, 2)
    step = np.roll(polygon, -1, axis=0) - polygon
    inward = np.stack([-step[:, 1], step[:, 0]], axis=-1) / np.linalg.norm(step, axis=1, keepdims=True)
    depth = ((grid[:, None] - polygon) * inward).sum(-1).min(axis=1)
    deep = np.flatnonzero(depth >= 0.8 * depth.max())
    along = grid[deep, int(np.argmax(high - low))]
    count = int(np.ceil(np.ptp(along) / depth.max())) + 1
    places = np.linspace(along.min(), along.max(), count)
    # of several discs that are equally near, choose the deepest
    chosen = {int(deep[np.argmin(np.abs(along - place) - 1e-3 * depth[deep])]) for place in places}
    return [(grid[n], float(depth[n])) for n in sorted(chosen)]
