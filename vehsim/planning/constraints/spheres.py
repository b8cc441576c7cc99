"""A few spheres that contain a vehicle's hulls: the optimiser keeps them off terrain and obstacles in flight.

Since the spheres contain every hull, a vehicle is clear if its spheres are; its actual distance is certified afterwards
with the hulls themselves. Spheres reach farther than the hulls, which matters in narrow places: there, points on the
hulls' surface tell by how much (`surface_by_sphere`).
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from vehsim.runtime.cache import kept_arrays
from vehsim.vehicles import Vehicle
from vehsim.world.obstacles.obstacles import hulls_of

Array = NDArray[np.float64]

SPHERES = 8
"""Number of spheres: more of them follow the hull more closely but make the problem larger."""
_SPACING = 0.6
_FINE = 0.3
"""Spacing of points on hulls, m: of those that the spheres enclose, and of those that stand for the surface itself."""


@lru_cache(maxsize=32)
def sphere_cover(vehicle: Vehicle, count: int = SPHERES) -> tuple[Array, Array]:
    """Centres (k, 3) in the rig root's frame and radii (k,), m; a single point without a rig."""
    if vehicle.rig is None:
        return np.zeros((1, 3)), np.zeros(1)
    hulls = hulls_of(vehicle)
    centres, radii = kept_arrays("cover-2", [*hulls, np.array([_SPACING, count])], lambda: _covering(hulls, count))
    return centres, radii


@lru_cache(maxsize=32)
def surface_by_sphere(vehicle: Vehicle, count: int = SPHERES) -> tuple[Array, NDArray[np.intp]]:
    """Points (n, 3) on the surface of a vehicle's hulls, in the rig root's frame, sorted by the sphere nearest to them;
    and the first point of each sphere (k,)."""
    centres, _ = sphere_cover(vehicle, count)
    hulls = hulls_of(vehicle)
    points, first = kept_arrays("surface-2", [*hulls, centres, np.array([_FINE])], lambda: _by_sphere(hulls, centres))
    return points, first.astype(np.intp)


def _by_sphere(hulls: Sequence[Array], centres: Array) -> tuple[Array, Array]:
    points = np.vstack([_surface(hull, _FINE) for hull in hulls] or [np.zeros((1, 3))])
    distance = np.linalg.norm(points[:, None] - centres, axis=2)
    nearest = np.argmin(distance, axis=1)
    nearest[np.argmin(distance, axis=0)] = np.arange(len(centres))  # no sphere is without a point
    order = np.argsort(nearest, kind="stable")
    first = np.searchsorted(nearest[order], np.arange(len(centres)))
    return points[order], np.minimum(first, len(points) - 1).astype(float)


def _covering(hulls: Sequence[Array], count: int) -> tuple[Array, Array]:
    points = np.vstack([_surface(hull, _SPACING) for hull in hulls])
    centres = _spread(points, min(count, len(points)))
    for _ in range(10):  # Lloyd's algorithm with enclosing balls instead of means: it reduces the largest radius
        nearest = np.argmin(np.linalg.norm(points[:, None] - centres, axis=2), axis=1)
        centres = np.array([_ball(points[nearest == k], centres[k]) for k in range(len(centres))])
    distance = np.linalg.norm(points[:, None] - centres, axis=2)
    nearest = np.argmin(distance, axis=1)
    radii = np.array([distance[nearest == k, k].max(initial=0.0) for k in range(len(centres))])
    return centres, radii + _SPACING / np.sqrt(3)


def balls(vehicle: Vehicle) -> tuple[Array, float, float]:
    """The centre (3,) of a vehicle's spheres in the rig root's frame, and the radii of two balls around it, m.

    The first ball contains all spheres. The second is the smallest that may pass where the vehicle does, nose first.
    """
    centres, radii = sphere_cover(vehicle)
    middle = (centres.max(axis=0) + centres.min(axis=0)) / 2
    corners = np.vstack(hulls_of(vehicle) or [np.zeros((1, 3))])
    spheres = float(np.max(np.linalg.norm(centres - middle, axis=1) + radii))
    return middle, spheres, float(np.ptp(corners, axis=0)[1:].max()) / 2


def _surface(hull: Array, spacing: float) -> Array:
    """Points on a convex hull's surface: none of its points is farther than ``spacing`` / sqrt(3) m from the nearest
    of them."""
    from scipy.spatial import ConvexHull

    return np.unique(np.round(np.vstack([_filled(hull[t], spacing) for t in ConvexHull(hull).simplices]), 6), axis=0)


def _filled(triangle: Array, spacing: float) -> Array:
    """Points of a triangle (3, 3) in rows along its longest side: slivers need few of them."""
    sides = np.roll(triangle, -1, axis=0) - triangle
    lengths = np.linalg.norm(sides, axis=1)
    k = int(np.argmax(lengths))
    a, b, c = np.roll(triangle, -k, axis=0)
    # at most half of the first and all of the second away from a point: within spacing / sqrt(3)
    along, across = 0.8 * spacing, 0.4 * spacing
    rows = int(np.ceil(np.linalg.norm(np.cross(sides[k], c - a)) / max(lengths[k], 1e-12) / across)) or 1
    points = [c[None]]
    for left in np.arange(1, rows + 1) / rows:
        n = int(np.ceil(left * lengths[k] / along))
        points.append(c + left * (a - c) + np.outer(np.linspace(0.0, left, n + 1), b - a))
    return np.vstack(points)


def _spread(points: Array, count: int) -> Array:
    """Farthest-point sampling."""
    chosen = [points[np.argmax(np.linalg.norm(points - points.mean(axis=0), axis=1))]]
    distance = np.linalg.norm(points - chosen[0], axis=1)
    while len(chosen) < count:
        chosen.append(points[np.argmax(distance)])
        distance = np.minimum(distance, np.linalg.norm(points - chosen[-1], axis=1))
    return np.array(chosen)


def _ball(points: Array, start: Array) -> Array:
    """Centre of an approximately smallest ball around the points (Badoiu and Clarkson's iteration)."""
    if not len(points):
        return start
    centre = points.mean(axis=0)
    for k in range(1, 30):
        centre = centre + (points[np.argmax(np.linalg.norm(points - centre, axis=1))] - centre) / (k + 1)
    return centre
