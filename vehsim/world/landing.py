"""Standing on what is below: how far down a vehicle can be put, and how well it stands there.

What belongs here are questions of geometry; how it gets there is planning's.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from vehsim.errors import InputError
from vehsim.world.obstacles import hulls_of

if TYPE_CHECKING:
    from vehsim.world import World

Array = NDArray[np.float64]

TOUCH = 2e-5
"""Where it touches it is no farther away than this, m."""
FOOT = 5e-3
"""What a vehicle stands on: points of its hulls no higher than this above its lowest, m."""
SUNK = 0.5
"""By how much it may stand too deep, m: whoever gives the height of the ground gives it no finer."""
STEPS = 400
"""Steps down, at most."""


def put_down(world: World, vehicle: Any, position: ArrayLike, orientation: ArrayLike) -> Array:
    """The root's position (3,) m where a vehicle let down from ``position``, not turning, touches terrain or obstacle.

    Exact to `TOUCH`: hulls go down by their distance, which never is too far. Where it touches already or stands too
    deep by up to `SUNK`, it is let down from as much higher. Raises ``InputError`` where it begins inside something,
    and where there is nothing below.
    """

    def gap(place: Array) -> float:
        return float(world.clearance(vehicle, place[None], np.asarray(orientation)[None])[0])

    place = np.array(position, float)
    if gap(place) <= 0:
        place[2] += SUNK
        if gap(place) <= 0:
            raise InputError(f"{_say(position)}: inside the ground or an obstacle; raise it")
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
    raise InputError(f"{_say(position)}: nothing below it to stand on; move it, or give the world a terrain")


def feet(vehicle: Any, count: int = 6) -> Array:
    """Points (k, 3) m in the root's frame that a vehicle stands on, as far apart as they are."""
    corners = np.vstack([np.zeros((0, 3)), *hulls_of(vehicle)])
    if not len(corners):
        return np.zeros((1, 3))
    low = corners[corners[:, 2] < corners[:, 2].min() + FOOT]
    chosen = [low[np.argmax(np.linalg.norm(low - low.mean(axis=0), axis=1))]]
    while len(chosen) < min(count, len(low)):
        chosen.append(low[np.argmax(np.linalg.norm(low[:, None] - chosen, axis=2).min(axis=1))])
    return np.array(chosen)


def height_below(world: World, points: Array) -> Array:
    """Height (n,) m of the terrain or standing obstacle below points (n, 3) m, or of the one they are in."""
    from scipy.spatial import ConvexHull

    found = np.asarray(world.height(points[:, :2]), float)
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


def _say(position: ArrayLike) -> str:
    return "(" + ", ".join(f"{x:g}" for x in np.asarray(position, float)) + ")"
