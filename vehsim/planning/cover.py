"""A few spheres that hold a vehicle's hulls: what the optimiser keeps off rock and obstacles when it flies.

The cover contains every hull, so clear spheres are a clear vehicle; how near the vehicle really comes is certified
afterwards with the hulls themselves. What stands is one distance field; what moves has one in its own frame, and where
it is at every node is a parameter of the problem. Where it lands the clearance asked for tapers, see `approach`.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vehsim._cache import kept_arrays
from vehsim.lie import SO3
from vehsim.planning.layout import Layout
from vehsim.planning.marks import Mark
from vehsim.vehicles import Vehicle
from vehsim.world import DistanceField
from vehsim.world.obstacles import Moving, hulls_of

Array = NDArray[np.float64]

SPHERES = 8
"""More follow the hull more closely and cost the optimiser more."""
_SPACING = 0.6


POSE = 12
"""Parameters that say where something moving is: its root's position, and the columns of its rotation."""
SLOPE = 0.35
"""How steeply the clearance asked for falls towards a landing: metres a metre, an approach of 20 degrees."""
ROUND = 0.1
"""Rounds the tip of that cone, m."""
AROUND = 4.0
"""How far from what moves its field reaches beyond what keeps its distance, m."""


@dataclass(eq=False)
class Cover:
    """What keeps a vehicle off what it may hit: spheres ``centres`` (k, 3) m and ``radii`` (k,) m, the distance field
    of what ``stands`` (or None), what moves with its own, and the elements made of them for all discretisations."""

    stands: DistanceField | None
    centres: Array
    radii: Array
    moving: tuple[tuple[Moving, DistanceField], ...] = ()
    elements: dict[Any, Any] = field(default_factory=dict)

    def fields(self) -> list[DistanceField | None]:
        """Of what stands, then of everything that moves."""
        return [self.stands, *(own for _, own in self.moving)]

    def values(self, layout: Layout, marks: Sequence[Mark], lengths: Array, start: float) -> Array:
        """The parameters behind a problem's own: landings, then where everything moving is at every place.

        ``lengths`` (phases,) s of the segments, ``start`` s since frame 0 of the first.
        """
        found = [self.landing(mark) for mark in landings(marks)] if self.stands is not None else []
        times = start + np.concatenate(times_at(layout, marks, lengths))
        for obstacle, _ in self.moving:
            positions, orientations = obstacle.poses_at(times)
            columns = SO3.matrix(orientations).transpose(0, 2, 1).reshape(-1, 9)
            found.append(np.hstack([positions, columns]).ravel())
        return np.concatenate([np.zeros(0), *found])

    def landing(self, mark: Mark) -> Array:
        """Where a mark's root is (3,) m, and how far its spheres are from what stands there, (k,) m."""
        assert self.stands is not None
        place = np.asarray(mark.position, float)
        balls = place + self.centres @ SO3.matrix(attitude(mark)).T
        return np.concatenate([place, self.stands.value(balls) - self.radii])


def approach(distance: Any, asked: Any, touching: Any, tanh: Any = np.tanh) -> Any:
    """The clearance asked for, m, ``distance`` m from a landing where it is ``touching`` m: it falls along a cone."""
    lack = asked - touching
    return asked - lack * (1 - tanh(SLOPE * distance / lack))


def landings(marks: Sequence[Mark]) -> list[Mark]:
    """The marks where it stands on the ground, each once."""
    return [mark for mark in marks if mark.on_ground and not mark.hold]


def attitude(mark: Mark) -> Array:
    """The orientation of a mark on the ground (4,) w, x, y, z: level unless it says otherwise."""
    if mark.orientation is not None:
        return np.asarray(mark.orientation, float) / np.linalg.norm(mark.orientation)
    half = np.deg2rad(mark.heading or 0.0) / 2
    return np.array([np.cos(half), 0.0, 0.0, np.sin(half)])


def places(layout: Layout, marks: Sequence[Mark]) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Nodes where clearance is asked, and segments half way along which it is, too: not where marks leave no choice."""
    steps, knots = len(layout.fractions), layout.mark_knots
    free, between = np.arange(layout.nodes) > 0, np.full(layout.segments, steps == 1)
    for i, mark in enumerate(marks):
        if mark.on_ground:  # to the end of its hold
            last = knots[i + 1] if mark.hold else knots[i]
            free[knots[i] * steps : last * steps + 1] = between[knots[i] : last] = False
    asked = np.isin(np.arange(layout.nodes) % steps, (0, layout.middle[0]))
    return np.flatnonzero(free & asked), np.flatnonzero(between)


def times_at(layout: Layout, marks: Sequence[Mark], lengths: Array) -> tuple[Array, Array]:
    """When it is at `places`, s since the start."""
    node, half = places(layout, marks)
    steps = np.repeat(lengths, layout.phases)
    knots = np.concatenate([[0.0], np.cumsum(steps)])
    shares = np.concatenate([[0.0], np.cumsum(layout.fractions)[:-1]])
    segment, part = np.divmod(node, len(layout.fractions))
    return knots[segment] + shares[part] * np.append(steps, 0.0)[segment], knots[half] + steps[half] / 2


def forgiven(marks: Sequence[Mark], wanted: float) -> Callable[[Array], Array]:
    """Positions (n, 3) -> how much less than the clearance ``wanted`` is asked there (n,), m: all, on a landing."""
    places = [np.asarray(mark.position, float) for mark in landings(marks)]

    def less(positions: Array) -> Array:
        away = [wanted - approach(np.linalg.norm(positions - p, axis=1), wanted, 0.0) for p in places]
        return np.max(away, axis=0, initial=0.0) if away else np.zeros(len(positions))

    return less


@lru_cache(maxsize=32)
def sphere_cover(vehicle: Vehicle, count: int = SPHERES) -> tuple[Array, Array]:
    """Centres (k, 3) in the rig root's frame and radii (k,), m; one point without a rig."""
    if vehicle.rig is None:
        return np.zeros((1, 3)), np.zeros(1)
    hulls = hulls_of(vehicle)
    centres, radii = kept_arrays("cover", [*hulls, np.array([_SPACING, count])], lambda: _covering(hulls, count))
    return centres, radii


def _covering(hulls: Sequence[Array], count: int) -> tuple[Array, Array]:
    points = np.vstack([_surface(hull) for hull in hulls])
    centres = _spread(points, min(count, len(points)))
    for _ in range(10):  # Lloyd's algorithm with enclosing balls instead of means: it shrinks the largest radius
        nearest = np.argmin(np.linalg.norm(points[:, None] - centres, axis=2), axis=1)
        centres = np.array([_ball(points[nearest == k], centres[k]) for k in range(len(centres))])
    distance = np.linalg.norm(points[:, None] - centres, axis=2)
    nearest = np.argmin(distance, axis=1)
    radii = np.array([distance[nearest == k, k].max(initial=0.0) for k in range(len(centres))])
    return centres, radii + _SPACING / np.sqrt(3)


def balls(vehicle: Vehicle) -> tuple[Array, float, float]:
    """The middle (3,) of a vehicle's spheres in the rig root's frame, and radii of two balls about it, m: of one that
    holds all spheres, and of the least that may get through where the vehicle does, nose first."""
    centres, radii = sphere_cover(vehicle)
    middle = (centres.max(axis=0) + centres.min(axis=0)) / 2
    corners = np.vstack(hulls_of(vehicle) or [np.zeros((1, 3))])
    spheres = float(np.max(np.linalg.norm(centres - middle, axis=1) + radii))
    return middle, spheres, float(np.ptp(corners, axis=0)[1:].max()) / 2


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
