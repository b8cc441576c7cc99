"""Standing on the ground: how far a vehicle can be lowered, and how well it stands there.

This module answers geometric queries; planning finds the motion.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from vehsim.errors import InputError, Problem
from vehsim.world.obstacles.obstacles import hulls_of

if TYPE_CHECKING:
    from vehsim.world.world import World

Array = NDArray[np.float64]

TOUCH = 2e-5
"""Distance at which the vehicle touches, m."""
FOOT = 5e-3
"""Points of the hulls at most this height above the lowest one carry the vehicle, m."""
SUNK = 0.5
"""Permitted depth of a given position in the ground, m; users give the ground's height with no better accuracy."""
STEPS = 400
"""Maximum number of steps down."""


def put_down(world: World, vehicle: Any, position: ArrayLike, orientation: ArrayLike) -> Array:
    """The root's position (3,) m where a vehicle lowered from ``position``, without rotation, touches terrain or
    obstacle.

    Exact to `TOUCH`: in each step the hulls go down by their distance, which never overshoots. If the vehicle already
    touches, or is too deep by up to `SUNK`, it starts higher by that much. Raises ``InputError`` if it starts inside
    something, with the height to which to raise it, or nothing is below.
    """

    def gap(place: Array) -> float:
        return float(world.clearance(vehicle, place[None], np.asarray(orientation)[None])[0])

    ends = [(o.bottom, o.top) for o in world.standing]
    ends += [(world.terrain.lower[2], world.terrain.upper[2])] if world.terrain else []
    lowest, highest = min((low for low, _ in ends), default=np.inf), max((high for _, high in ends), default=-np.inf)

    def lowered(place: Array) -> Array | None:
        for _ in range(STEPS):
            left = gap(place)
            if left <= TOUCH:
                return place
            place = place - [0, 0, min(left, 1e3)]
            if place[2] < lowest - 1e3:
                break
        return None

    start = np.array(position, float)
    if gap(start) <= 0:
        start[2] += SUNK
        if gap(start) <= 0:
            size = float(np.ptp(np.vstack([np.zeros((1, 3)), *hulls_of(vehicle)]), axis=0).max())
            top = lowered(np.array([*start[:2], highest + size]))
            raise InputError.of(_inside(np.asarray(position, float), top))
    found = lowered(start)
    if found is None:
        remedy = "move it, or give the world a terrain"
        raise InputError("nothing below it to stand on", remedy, key="position", value=np.asarray(position))
    return found


def _inside(position: Array, top: Array | None) -> Problem:
    """The problem of a position in something, on top of which the root would stand at ``top`` (3,) m."""
    place = None if top is None else [*position[:2].tolist(), round(float(top[2]), 2)]
    remedy = "raise it" if place is None else f"raise it to {place[2]:.2f} m, where it stands on top"
    fixes = () if place is None else (("position", place),)
    return Problem("position", "inside the ground or an obstacle", remedy, position.tolist(), fixes=fixes)


def feet(vehicle: Any, count: int = 6) -> Array:
    """Points (k, 3) m of the hulls, in the root's frame, on which a vehicle stands, as far apart as possible."""
    corners = np.vstack([np.zeros((0, 3)), *hulls_of(vehicle)])
    if not len(corners):
        return np.zeros((1, 3))
    low = corners[corners[:, 2] < corners[:, 2].min() + FOOT]
    chosen = [low[np.argmax(np.linalg.norm(low - low.mean(axis=0), axis=1))]]
    while len(chosen) < min(count, len(low)):
        chosen.append(low[np.argmax(np.linalg.norm(low[:, None] - chosen, axis=2).min(axis=1))])
    return np.array(chosen)


def height_below(world: World, points: Array) -> Array:
    """Height (n,) m of the terrain or standing obstacle below points (n, 3) m, or of the one that contains them."""
    found = np.full(len(points), -np.inf) if world.terrain is None else world.terrain.height_below(points)
    if not world.standing:
        return np.asarray(found)
    from scipy.spatial import ConvexHull  # it takes a third of a second to load

    for hull in (hull for obstacle in world.standing for hull in obstacle.hulls):
        planes = ConvexHull(hull).equations
        reach = -(points[:, :2] @ planes[:, :2].T + planes[:, 3])  # n_z z stays below it
        up, down = planes[:, 2] > 1e-9, planes[:, 2] < -1e-9
        top = (reach[:, up] / planes[up, 2]).min(axis=1)
        bottom = (reach[:, down] / planes[down, 2]).max(axis=1)
        beside = (reach[:, ~up & ~down] < 0).any(axis=1)
        there = (top >= bottom) & ~beside & (bottom <= points[:, 2])
        found = np.where(there, np.maximum(found, top), found)
    return found
