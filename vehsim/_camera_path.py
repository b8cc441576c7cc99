"""Where a camera can be: steers a wished-for path round what is in the way, then lifts what is left over it, smoothly.

What belongs here is the camera's way past terrain and standing obstacles; what it wishes for is decided in
`cameras.py`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from itertools import product
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from vehsim.world.obstacles import Obstacle

Array = NDArray[np.float64]

SIDESTEPS = np.radians((0.0, 12.0, -12.0, 24.0, -24.0, 38.0, -38.0))
SCALES = (1.0, 0.85)
LIFTS = (0.0, 0.12, 0.25, 0.4)
"""What a camera may do to see its target: go round it (rad), nearer (factor), higher (of its distance)."""
HIGHER = (0.55, 0.7)
"""How much higher besides, where it keeps its side of the target."""
ASIDE = 3.0
"""How much more a turn weighs there, which is at most 24 degrees unless obstacles stand."""
SIGHT = np.linspace(0.0, 0.75, 14)
"""Where the line of sight is tested, from the camera (0) towards the target (1)."""
ROUND = np.radians((55.0, -55.0, 75.0, -75.0))
"""How far round it may go besides, where obstacles stand: they may hide a target from close by."""
THROUGH = 0.2
"""What a metre of sight inside an obstacle counts, in metres of the ground's mean depth along the sight."""
RAISES = np.linspace(0.0, 1.2, 25)
"""How far it may be raised over an obstacle, of its distance."""


def steer(
    positions: Array, aims: Array, world: Any, margin: float, radius: float, fps: float, behind: bool = False
) -> Array:
    """Camera positions (n, 3) near the wished ``positions`` that see ``radius`` m about ``aims`` past all that stands.

    Every quarter second it may stand as wished or a little round the target, nearer or higher; dynamic programming
    picks the sequence with the least blocked sight, then the least departure and change. One that stays ``behind`` its
    target is raised sooner than it goes round.
    """
    count = len(positions)
    step = max(1, round(fps / 4))
    keys = np.unique(np.append(np.arange(0, count, step), count - 1))
    turns = SIDESTEPS[:5] if behind else SIDESTEPS
    turns = np.append(turns, ROUND) if _standing(world) else turns
    choices = np.array(list(product(turns, SCALES, LIFTS + HIGHER * behind)))
    moves = np.stack([_moved(positions[keys] - aims[keys], *choice) for choice in choices], axis=1)
    hidden = blocked(aims[keys][:, None] + moves, aims[keys][:, None], world, margin, radius)
    reach = np.linalg.norm(positions - aims, axis=1).mean()
    departure = (
        ((ASIDE if behind else 1.0) * choices[:, 0]) ** 2 + (2 * (1 - choices[:, 1])) ** 2 + (2 * choices[:, 2]) ** 2
    )
    chosen = _cheapest(hidden / reach * 400.0 + departure, choices / (0.10, 0.12, 0.10))
    path = np.array([np.interp(np.arange(count), keys, choices[chosen, k]) for k in range(3)])
    path = smooth(path.T, 0.35 * fps)
    calm = smooth(aims, 0.5 * fps)
    return calm + _moved(positions - calm, path[:, 0], path[:, 1], path[:, 2])


def lift(positions: Array, aims: Array, world: Any, margin: float, fps: float) -> Array:
    """Raise the camera, ahead of need, until it sees its aim and keeps ``margin`` m from the ground.

    One that stands still is raised for good, over the ground alone: what else hides its aim, it was put behind.
    """
    sight = _sight(positions, aims)
    need = (_ground(sight, world, 0.5 * margin) - sight[..., 2]) / (1.0 - SIGHT)  # its sight rises less than it
    need[:, 0] = _ground(sight[:, 0], world, margin) + margin - sight[:, 0, 2]
    need = need.max(axis=1)
    need = np.maximum(np.where(np.isfinite(need), need, 0.0), 0.0)
    still = np.ptp(positions, axis=0).max() < 1e-9
    raised = np.full(len(need), need.max()) if still else envelope(need, fps)
    if not still and _standing(world):  # blocks have steeper sides than the ground: a longer run-up
        raised = raised + envelope(_over_obstacles(positions, aims, world, margin), fps, 0.8)
    return positions + raised[:, None] * (0.0, 0.0, 1.0)


def calm(positions: Array, aims: Array, world: Any, margin: float, fps: float, limit: float) -> Array:
    """The path (n, 3) smoothed just as far as its jerk (m/s^3) stays below ``limit``, still over the ground."""
    path = positions
    for sigma in (0.15, 0.25, 0.4, 0.6, 0.9, 1.3):
        if jerk(path, fps) <= limit:
            break
        path = lift(smooth(positions, sigma * fps), aims, world, margin, fps)
    return path


def jerk(positions: Array, fps: float) -> float:
    """Largest third difference of ``positions`` (n, 3), m/s^3."""
    if len(positions) < 4:
        return 0.0
    return float(np.linalg.norm(np.diff(positions, n=3, axis=0), axis=1).max()) * fps**3


def smooth(values: Array, sigma: float) -> Array:
    """Gaussian-filtered along the first axis, running straight on beyond both ends; ``sigma`` in samples."""
    pad = min(int(4 * sigma) + 1, len(values) - 1)
    if pad < 1:
        return np.array(values, float)
    before = 2 * values[:1] - values[pad:0:-1]
    after = 2 * values[-1:] - values[-2 : -pad - 2 : -1]
    return _blurred(np.concatenate([before, values, after]), sigma, 4.0)[pad : pad + len(values)]


def envelope(values: Array, fps: float, ahead: float = 0.4) -> Array:
    """A smooth curve (n,) that lies nowhere below ``values``; it begins to rise thrice ``ahead`` s before them."""
    sigma = ahead * fps
    reach = int(3 * sigma + 0.5)
    around = np.lib.stride_tricks.sliding_window_view(np.pad(values, reach, mode="edge"), 2 * reach + 1)
    return _blurred(around.max(axis=1), sigma, 3.0)


def _blurred(values: Array, sigma: float, cut: float) -> Array:
    """Weighted by a bell as wide as ``sigma`` samples, up to ``cut`` times that, along the first axis."""
    reach = int(cut * sigma + 0.5)  # by numpy alone: scipy's filters take half a second to load
    bell = np.exp(-((np.arange(-reach, reach + 1) / sigma) ** 2) / 2)
    rows = np.pad(values.reshape(len(values), -1), ((reach, reach), (0, 0)), mode="edge").T
    found = [np.convolve(row, bell / bell.sum(), mode="valid") for row in rows]
    return np.column_stack(found).reshape(values.shape)


def _moved(offsets: Array, turn: Any, scale: Any, rise: Any) -> Array:
    """Offsets (n, 3) from the target, turned about the vertical (rad), scaled, raised by ``rise`` of their length."""
    x, y, z = offsets.T * scale
    cos, sin = np.cos(turn), np.sin(turn)
    return np.stack([x * cos - y * sin, x * sin + y * cos, z + rise * np.linalg.norm(offsets, axis=1)], axis=1)


@dataclass(frozen=True, eq=False)
class Parked:
    """A vehicle that stands still, as cameras see it: an obstacle. ``hulls``: convex, vertices (n, 3) m."""

    hulls: tuple[Array, ...]


@dataclass(frozen=True)
class Surroundings:
    """What may hide a target: the ground and all that stands, vehicles too."""

    terrain: Any
    height: Callable[[Array], Any]
    standing: tuple[Obstacle | Parked, ...]

    @staticmethod
    def of(world: Any, parked: tuple[Parked, ...]) -> Surroundings:
        return Surroundings(getattr(world, "terrain", world), world.height, (*_standing(world), *parked))


def blocked(positions: Array, aims: Array, world: Any, margin: float, radius: float) -> Array:
    """How much stands (...,), m, in the way to the target, its left and right; it weighs more at the camera."""
    if getattr(world, "terrain", world) is None and not _standing(world):
        return np.zeros(positions.shape[:-1])
    ray = aims - positions
    side = np.stack([-ray[..., 1], ray[..., 0], np.zeros_like(ray[..., 0])], axis=-1)
    side *= radius / np.maximum(np.linalg.norm(side, axis=-1, keepdims=True), 1e-9)
    total = np.zeros(positions.shape[:-1])
    for weight, aim in ((1.0, aims + 0 * side), (0.5, aims + side), (0.5, aims - side)):
        sight = _sight(positions, aim)
        depth = np.maximum(_ground(sight, world, margin) + margin * (1.0 - SIGHT) - sight[..., 2], 0.0)
        depth = np.where(np.isfinite(depth), depth, 0.0)
        total += weight * (depth.mean(axis=-1) + 1.5 * depth[..., 0])
        if _standing(world):
            total += weight * THROUGH * _through_obstacles(positions, aim, world, margin)
    return total


def _sight(positions: Array, aims: Array) -> Array:
    return positions[..., None, :] + SIGHT[:, None] * (aims - positions)[..., None, :]


def _over_obstacles(positions: Array, aims: Array, world: Any, margin: float) -> Array:
    """The least raise (n,) m of each camera that sees its aim past every obstacle; 0 where none does."""
    apart = np.linalg.norm(aims - positions, axis=1)[:, None]

    def free(raises: Array) -> Any:
        raised = positions[:, None] + (apart * raises)[..., None] * (0.0, 0.0, 1.0)
        return _through_obstacles(raised, aims[:, None], world, margin) <= 0.0

    enough = RAISES[free(np.tile(RAISES, (len(apart), 1))).argmax(axis=1)][:, None]
    short = np.maximum(enough - RAISES[1], 0.0)
    for _ in range(8):
        middle = (short + enough) / 2
        seen = free(middle)
        short, enough = np.where(seen, short, middle), np.where(seen, middle, enough)
    return np.asarray((apart * enough)[:, 0])


def _through_obstacles(positions: Array, aims: Array, world: Any, margin: float) -> Array:
    """How far (...,), m, the sight from ``positions`` to ``aims`` (..., 3) runs inside obstacles, or close by them;
    added to it what a camera lacks of half the ``margin`` from them."""
    start, end = (np.reshape(ends, (-1, 3)) for ends in np.broadcast_arrays(positions, aims))
    ray = end - start
    reach = np.linalg.norm(ray, axis=1)
    total = np.zeros(len(start))
    for centre, radius, planes in (solid for obstacle in _standing(world) for solid in _solids(obstacle)):
        nearest = np.clip(((centre - start) * ray).sum(axis=1) / np.maximum(reach**2, 1e-9), 0.0, 1.0)
        close = np.linalg.norm(start + nearest[:, None] * ray - centre, axis=1) < radius + margin
        if not close.any():
            continue
        over = start[close] @ planes[:, :3].T + planes[:, 3]  # how far outside each face the sight begins
        lacking = np.maximum(0.5 * margin - over.max(axis=1), 0.0)
        rate = ray[close] @ planes[:, :3].T + 0.1 * margin  # a little air about the sight, less towards the target
        rate[np.abs(rate) < 1e-12] = -1e-12  # along a face: inside for all of the way or for none
        crossing = (0.1 * margin - over) / rate
        enters = np.where(rate < 0, crossing, -np.inf).max(axis=1)
        leaves = np.where(rate > 0, crossing, np.inf).min(axis=1)
        inside = np.clip(leaves, 0.0, 1.0) - np.clip(enters, 0.0, 1.0)
        total[close] += np.maximum(inside, 0.0) * reach[close] + lacking
    return total.reshape(np.broadcast_shapes(np.shape(positions), np.shape(aims))[:-1])


@lru_cache(maxsize=256)
def _solids(obstacle: Obstacle | Parked) -> list[tuple[Array, float, Array]]:
    """An obstacle's hulls: centre (3,) m, radius m, faces (m, 4), unit normals outwards and offsets."""
    from scipy.spatial import ConvexHull

    centres = [hull.mean(axis=0) for hull in obstacle.hulls]
    spread = [hull - centre for hull, centre in zip(obstacle.hulls, centres, strict=True)]
    radii = [float(np.linalg.norm(offsets, axis=1).max()) for offsets in spread]
    planes = [np.unique(ConvexHull(hull).equations.round(9), axis=0) for hull in obstacle.hulls]
    return list(zip(centres, radii, planes, strict=True))


def _standing(world: Any) -> tuple[Obstacle | Parked, ...]:
    return getattr(world, "standing", ())


def _ground(points: Array, world: Any, margin: float) -> Array:
    """The highest ground (...,) within ``margin`` of ``points`` (..., 3)."""
    if getattr(world, "terrain", world) is None:
        return np.full(points.shape[:-1], -np.inf)
    around = margin * np.array([[0, 0], [1, 0], [-1, 0], [0, 1], [0, -1]], float)
    footprint = points[..., None, :2] + around
    return np.asarray(world.height(footprint.reshape(-1, 2))).reshape(footprint.shape[:-1]).max(axis=-1)


def _cheapest(costs: Array, places: Array) -> NDArray[np.int64]:
    """The row of ``places`` (m, d) per step (k,) with the least sum of ``costs`` (k, m) and squared changes."""
    change = ((places[:, None] - places[None]) ** 2).sum(axis=2)
    best, came = costs[0], []
    for cost in costs[1:]:
        reached = best[:, None] + change
        came.append(reached.argmin(axis=0))
        best = reached.min(axis=0) + cost
    chosen = [int(best.argmin())]
    for back in reversed(came):
        chosen.append(int(back[chosen[-1]]))
    return np.array(chosen[::-1])
