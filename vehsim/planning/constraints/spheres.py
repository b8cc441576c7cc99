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

    return np.unique(np.round(_filled(hull[ConvexHull(hull).simplices], spacing), 6), axis=0)


def _filled(triangles: Array, spacing: float) -> Array:
    """Points of triangles (n, 3, 3) in rows along their longest sides: slivers need few of them."""
    sides = np.linalg.norm(np.roll(triangles, -1, axis=1) - triangles, axis=2)
    first, each = np.argmax(sides, axis=1), np.arange(len(triangles))
    a, b, c = (triangles[each, (first + k) % 3] for k in range(3))
    length = sides[each, first]
    height = np.linalg.norm(np.cross(b - a, c - a), axis=1) / np.maximum(length, 1e-12)
    # at most half of the first and all of the second away from a point: within spacing / sqrt(3)
    along, across = 0.8 * spacing, 0.4 * spacing
    rows = np.maximum(np.ceil(height / across).astype(int), 1)
    each, row = _counted(rows)
    down = ((row + 1) / rows[each])[:, None]
    start, side = c[each] + down * (a - c)[each], down * (b - a)[each]
    steps = np.ceil(down[:, 0] * length[each] / along).astype(int)
    each, step = _counted(steps + 1)
    share = step / np.maximum(steps, 1)[each]
    return np.vstack([c, start[each] + share[:, None] * side[each]])


def _counted(counts: NDArray[np.intp]) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Every index as often as ``counts`` says, and the numbers from zero of these."""
    each = np.repeat(np.arange(len(counts)), counts)
    return each, np.arange(len(each)) - (np.cumsum(counts) - counts)[each]


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
