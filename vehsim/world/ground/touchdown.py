"""Standing on the ground: how far a vehicle can be lowered, and how well it stands there.

This module answers geometric queries; planning finds the motion.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from vehsim.errors import InputError
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
    something or nothing is below.
    """

    def gap(place: Array) -> float:
        return float(world.clearance(vehicle, place[None], np.asarray(orientation)[None])[0])

    place = np.array(position, float)
    if gap(place) <= 0:
        place[2] += SUNK
        if gap(place) <= 0:
            raise InputError("inside the ground or an obstacle", "raise it", key="position", value=np.asarray(position))
    lowest = min(
        [o.bottom for o in world.standing] + ([world.terrain.lower[2]] if world.terrain else []), default=np.inf
    )
    for _ in range(STEPS):
        left = gap(place)
        if left <= TOUCH:
            return place
        place[2] -= min(left, 1e3)
        if place[2] < lowest - 1e3:
            break
    raise InputError(
        "nothing below it to stand on",
        "move it, or give the world a terrain",
        key="position",
        value=np.asarray(position),
    )


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
