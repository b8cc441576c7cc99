"""A few spheres that hold a vehicle's hulls: what the optimiser keeps off the rock.

The cover contains every hull, so clear spheres are a clear vehicle; how near the vehicle really comes is certified
afterwards with the hulls themselves.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vehsim.vehicles import Vehicle

Array = NDArray[np.float64]

SPHERES = 8
"""More follow the hull more closely and cost the optimiser more."""
_SPACING = 0.6


@dataclass(eq=False)
class Cover:
    """What keeps a vehicle off the rock: ``models`` of the distance (`vehsim.world.field.DistanceField.models`),
    spheres ``centres`` (k, 3) m and ``radii`` (k,) m, and the elements made of them, shared by all discretisations."""

    models: Callable[[int, int], Any]
    centres: Array
    radii: Array
    elements: dict[Any, Any] = field(default_factory=dict)


@lru_cache(maxsize=32)
def sphere_cover(vehicle: Vehicle, count: int = SPHERES) -> tuple[Array, Array]:
    """Centres (k, 3) in the rig root's frame and radii (k,), m; one point without a rig."""
    if vehicle.rig is None:
        return np.zeros((1, 3)), np.zeros(1)
    from vehsim.parts import collision_hulls

    points = np.vstack([_surface(hull) for hull in collision_hulls(vehicle.rig.asset, vehicle.rig.root or None)])
    centres = _spread(points, min(count, len(points)))
    for _ in range(10):  # Lloyd's algorithm with enclosing balls instead of means: it shrinks the largest radius
        nearest = np.argmin(np.linalg.norm(points[:, None] - centres, axis=2), axis=1)
        centres = np.array([_ball(points[nearest == k], centres[k]) for k in range(len(centres))])
    distance = np.linalg.norm(points[:, None] - centres, axis=2)
    nearest = np.argmin(distance, axis=1)
    radii = np.array([distance[nearest == k, k].max(initial=0.0) for k in range(len(centres))])
    return centres, radii + _SPACING / np.sqrt(3)


def _surface(hull: Array) -> Array:
    """Points on a convex hull's surface, none further than ``_SPACING`` / sqrt(3) from its triangles' every point."""
    from scipy.spatial import ConvexHull

    points = []
    for a, b, c in hull[ConvexHull(hull).simplices]:
        n = int(np.ceil(max(np.linalg.norm(b - a), np.linalg.norm(c - a), np.linalg.norm(c - b)) / _SPACING))
        i, j = np.meshgrid(np.arange(n + 1), np.arange(n + 1))
        inside = i + j <= n
        points.append(a + np.outer(i[inside] / n, b - a) + np.outer(j[inside] / n, c - a))
    return np.unique(np.round(np.vstack(points), 6), axis=0)


def _spread(points: Array, count: int) -> Array:
    """Farthest-point sampling."""
    chosen = [points[np.argmax(np.linalg.norm(points - points.mean(axis=0), axis=1))]]
    distance = np.linalg.norm(points - chosen[0], axis=1)
    while len(chosen) < count:
        chosen.append(points[np.argmax(distance)])
        distance = np.minimum(distance, np.linalg.norm(points - chosen[-1], axis=1))
    return np.array(chosen)


def _ball(points: Array, start: Array) -> Array:
    """Centre of a ball that nearly is the smallest around the points (Badoiu and Clarkson's iteration)."""
    if not len(points):
        return start
    centre = points.mean(axis=0)
    for k in range(1, 30):
        centre = centre + (points[np.argmax(np.linalg.norm(points - centre, axis=1))] - centre) / (k + 1)
    return centre
