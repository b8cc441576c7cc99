"""Where a camera can be: guide a desired path around obstructions, then raise it over the remaining ones, smoothly.

This module finds the camera's path past terrain and standing obstacles; `framing.py` provides the desired path.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache
from itertools import product
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from vehsim.world.obstacles.obstacles import Obstacle
    from vehsim.world.terrain.surface import TerrainSurface

Array = NDArray[np.float64]

SIDESTEPS = np.radians((0.0, 12.0, -12.0, 24.0, -24.0, 38.0, -38.0))
SCALES = (1.0, 0.85)
LIFTS = (0.0, 0.12, 0.25, 0.4)
"""Deviations that let a camera see its target: around it (rad), nearer (factor), higher (relative to its distance)."""
HIGHER = (0.55, 0.7)
"""Additional heights for a camera that keeps its side of the target."""
ASIDE = 3.0
"""Additional weight of turning in that case, which is at most 24 degrees unless there are obstacles."""
SIGHT = np.linspace(0.0, 0.75, 14)
"""Points at which the line of sight is tested, from the camera (0) towards the target (1)."""
ROUND = np.radians((55.0, -55.0, 75.0, -75.0))
"""Additional angles around the target if there are obstacles: they may hide a target at close range."""
LOWER, BACK = (-0.12, -0.25), np.radians((100.0, -100.0, 130.0, -130.0, 160.0, -160.0))
"""Additional lifts and angles on terrain with overhangs: its roofs may be low, its caves narrow."""
COLUMN, COLUMNS, ROOM = 0.25, 400, 10.0
"""Spacing of the columns in which its levels of ground are known, m; about the largest number of them along a side,
for which they are farther apart; and how far they reach around the places that were asked for, m."""
THROUGH = 0.2
"""Weight of a metre of sight inside an obstacle, in metres of the ground's mean depth along the sight."""
BURIED = 10.0
"""Weight of a camera inside the rock of a terrain with overhangs, relative to its distance."""
ROUNDABOUT = np.array([[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 0.5]], float)
"""Places around a camera that ought to be free too, in units of its margin."""
CHANGE = np.array([0.10, 0.12, 0.10])
"""Deviations (turn, scale, lift) whose change within a quarter second costs 1."""
HOME = 0.3
"""Additional weight of deviations, in units of `CHANGE`, of a camera that stays behind its target among obstacles."""
CLIMB = 1.2
"""Half the time in which a camera climbs over an obstacle, s, and in which it comes down again. The jerk of the largest
raise is then about the largest that a camera may have."""
JUMP, LEAP = np.radians(40.0), 1e5
"""Largest turn around the target in a quarter second among rock, and the cost of a larger one."""
CROWDED = 2.0
"""Weight of a metre that a camera lacks to a moving vehicle, in metres of the ground's mean depth along the sight."""
FACES = 200
"""Faces of the shape around a moving vehicle."""
CRAMPED = 0.3
"""Weight of rock at all of them, relative to that of a camera inside the rock."""
RAISES = np.linspace(0.0, 1.2, 25)
"""Largest raise over an obstacle, relative to its distance."""


def steer(
    positions: Array, aims: Array, world: Any, margin: float, radius: float, fps: float, behind: bool = False
) -> Array:
    """Camera positions (n, 3) close to the desired ``positions`` with a clear view of ``radius`` m around ``aims``.

    Every quarter second the camera may stay, move around the target, approach or rise; dynamic programming chooses the
    sequence with the least obstructed view, then the least deviation and change. A camera that stays ``behind`` its
    target is raised rather than moved around it.
    """
    count = len(positions)
    step = max(1, round(fps / 4))
    keys = np.unique(np.append(np.arange(0, count, step), count - 1))
    turns = SIDESTEPS[:5] if behind else SIDESTEPS
    rocky = _rock(world) is not None
    met = crowded(positions, world, 0.5 * margin).any()
    turns = np.append(turns, ROUND) if _standing(world) or rocky or met else turns
    turns = np.append(turns, BACK) if rocky else turns
    choices = np.array(list(product(turns, SCALES, LOWER * rocky + LIFTS + HIGHER * behind)))
    moves = np.stack([_moved(positions[keys] - aims[keys], *choice) for choice in choices], axis=1)
    obstructed = blocked(aims[keys][:, None] + moves, aims[keys][:, None], world, margin, radius)
    if met:
        obstructed += CROWDED * _met(positions, aims, choices, keys, world, margin)
    reach = np.linalg.norm(positions - aims, axis=1).mean()
    departure = (
        ((ASIDE if behind else 1.0) * choices[:, 0]) ** 2 + (2 * (1 - choices[:, 1])) ** 2 + (2 * choices[:, 2]) ** 2
    )
    if behind and (_standing(world) or met):
        # without this, it is cheaper to keep a small deviation for seconds than to give it up: right among ridges,
        # which follow each other, but not behind a roof
        departure += HOME * (np.abs(choices - (0.0, 1.0, 0.0)) / CHANGE).sum(axis=1)
    # among rock, a way round the target leads through every angle, each with its own cost
    jump = JUMP if rocky else np.inf
    chosen = _cheapest(obstructed / reach * 400.0 + departure, choices / CHANGE, jump / CHANGE[0])
    path = np.array([np.interp(np.arange(count), keys, choices[chosen, k]) for k in range(3)])
    path = smooth(path.T, 0.35 * fps)
    calm = smooth(aims, 0.5 * fps)
    return calm + _moved(positions - calm, path[:, 0], path[:, 1], path[:, 2])


def _met(positions: Array, aims: Array, choices: Array, keys: Array, world: Any, margin: float) -> Array:
    """What each of the ``choices`` (m, 3) lacks (k, m) of half the ``margin`` to moving vehicles, around each key: a
    vehicle that meets the camera passes it between two of them."""
    lacking = np.stack([crowded(aims + _moved(positions - aims, *c), world, 0.5 * margin) for c in choices], axis=1)
    reach = int(np.diff(keys, append=keys[-1] + 1).max())
    return np.stack([lacking[max(0, key - reach) : key + reach + 1].max(axis=0) for key in keys])


def raise_camera(positions: Array, aims: Array, world: Any, margin: float, fps: float, mounted: bool = False) -> Array:
    """Raise the camera, ahead of time, until it sees its aim and keeps ``margin`` m from the ground.

    A camera that is ``mounted``, at a fixed place or on a rail or crane, is raised permanently, which keeps its path
    straight and its rise smooth, and over the ground only.
    """
    sight = _sight(positions, aims)
    # its line of sight rises less than the camera
    still = mounted or np.ptp(positions, axis=0).max() < 1e-9
    need = (_ground(sight, world, 0.5 * margin, still) - sight[..., 2]) / (1.0 - SIGHT)
    need[:, 0] = _ground(sight[:, 0], world, margin, still) + margin - sight[:, 0, 2]
    need = need.max(axis=1)
    need = np.maximum(np.where(np.isfinite(need), need, 0.0), 0.0)
    raised = np.full(len(need), need.max()) if still else envelope(need, fps)
    if not still and (_standing(world) or crowded(positions, world, 0.5 * margin).any()):
        raised = raised + _held(_over_obstacles(positions, aims, world, margin), _arch(CLIMB * fps))
    return positions + raised[:, None] * (0.0, 0.0, 1.0)


def calm(
    positions: Array, aims: Array, world: Any, margin: float, fps: float, limit: float, mounted: bool = False
) -> Array:
    """The path (n, 3) smoothed only until its jerk (m/s^3) is below ``limit``, and still above the ground; it does not
    cut corners through rock."""
    path = positions
    for sigma in (0.15, 0.25, 0.4, 0.6, 0.9, 1.3):
        if jerk(path, fps) <= limit:
            break
        calmer = raise_camera(smooth(positions, sigma * fps), aims, world, margin, fps, mounted)
        if in_rock(calmer, world).sum() > in_rock(path, world).sum():
            break
        path = calmer
    return path


def jerk(positions: Array, fps: float) -> float:
    """Largest third difference of ``positions`` (n, 3), m/s^3."""
    if len(positions) < 4:
        return 0.0
    return float(np.linalg.norm(np.diff(positions, n=3, axis=0), axis=1).max()) * fps**3


def smooth(values: Array, sigma: float) -> Array:
    """Gaussian-filtered along the first axis, extrapolated linearly beyond both ends; ``sigma`` in samples."""
    pad = min(int(4 * sigma) + 1, len(values) - 1)
    if pad < 1:
        return np.array(values, float)
    before = 2 * values[:1] - values[pad:0:-1]
    after = 2 * values[-1:] - values[-2 : -pad - 2 : -1]
    return _blurred(np.concatenate([before, values, after]), _bell(sigma, 4.0))[pad : pad + len(values)]


def envelope(values: Array, fps: float) -> Array:
    """A smooth curve (n,) that is nowhere below ``values``; most of its rise is in the two seconds before them."""
    return _held(values, _bell(0.4 * fps, 3.0))


def _held(values: Array, kernel: Array) -> Array:
    """The largest of ``values`` (n,) around each sample, then the ``kernel``'s mean: smooth, and nowhere below
    ``values``."""
    reach = len(kernel) // 2
    around = np.lib.stride_tricks.sliding_window_view(np.pad(values, reach, mode="edge"), len(kernel))
    return _blurred(around.max(axis=1), kernel)


def _bell(sigma: float, cut: float) -> Array:
    """Weights (2k + 1,) of a Gaussian of ``sigma`` samples, truncated at ``cut`` times that."""
    reach = int(cut * sigma + 0.5)
    weights = np.exp(-((np.arange(-reach, reach + 1) / sigma) ** 2) / 2)
    return np.asarray(weights / weights.sum())


def _arch(reach: float) -> Array:
    """Weights (2k + 1,) of a raised cosine of ``reach`` samples: of bells with the same jerk, a narrow one."""
    half = int(reach)
    weights = 1 + np.cos(np.pi * np.arange(-half, half + 1) / (half + 1))
    return np.asarray(weights / weights.sum())


def _blurred(values: Array, kernel: Array) -> Array:
    """Mean with the weights ``kernel`` (2k + 1,), along the first axis."""
    reach = len(kernel) // 2  # in numpy only: scipy's filters take half a second to load
    rows = np.pad(values.reshape(len(values), -1), ((reach, reach), (0, 0)), mode="edge").T
    found = [np.convolve(row, kernel, mode="valid") for row in rows]
    return np.column_stack(found).reshape(values.shape)


def _moved(offsets: Array, turn: Any, scale: Any, rise: Any) -> Array:
    """Offsets (n, 3) from the target, rotated about the vertical (rad), scaled, raised by ``rise`` of their length."""
    x, y, z = offsets.T * scale
    cos, sin = np.cos(turn), np.sin(turn)
    return np.stack([x * cos - y * sin, x * sin + y * cos, z + rise * np.linalg.norm(offsets, axis=1)], axis=1)


@dataclass(frozen=True, eq=False)
class Parked:
    """A vehicle that stands still, as an obstacle for cameras. ``hulls``: convex, vertices (n, 3) m."""

    hulls: tuple[Array, ...]


@dataclass(frozen=True, eq=False)
class Passing:
    """A vehicle that moves: it may hide a target, but no camera goes through it. ``T_rw`` (n, 4, 4) on each frame;
    ``outline`` (k, 3) m in the root frame."""

    name: str
    T_rw: Array
    outline: Array

    def lacking(self, positions: Array, room: float) -> Array:
        """What is missing (n, ...) m of ``room`` m between ``positions`` (n, ..., 3) and a convex shape around it."""
        T_rw = self.T_rw.reshape(len(self.T_rw), *[1] * (positions.ndim - 2), 4, 4)
        away = (T_rw[..., :3, :3] @ positions[..., None])[..., 0] + T_rw[..., :3, 3]
        apart = np.linalg.norm(away, axis=-1) - np.linalg.norm(self.outline, axis=1).max()
        near = apart < room
        around = np.vstack([all_around(FACES), np.eye(3), -np.eye(3)])  # exact along its axes: most are like boxes
        apart[near] = (away[near] @ around.T - (self.outline @ around.T).max(axis=0)).max(axis=-1)
        return np.asarray(np.maximum(room - apart, 0.0))

    def inside(self, positions: Array) -> NDArray[np.bool_]:
        """Which ``positions`` (n, 3) are inside that shape."""
        return np.asarray(self.lacking(positions, 0.0) > 0)


@dataclass(frozen=True)
class Surroundings:
    """Objects that may hide a target: the ground and all standing obstacles, including vehicles. And those that
    move, which only keep cameras ``clear``."""

    terrain: Any
    height: Callable[[Array], Any]
    standing: tuple[Obstacle | Parked, ...]
    levels: Levels | None = None
    passing: tuple[Passing, ...] = ()

    @staticmethod
    def of(world: Any, parked: tuple[Parked, ...], passing: tuple[Passing, ...] = ()) -> Surroundings:
        rock = _rock(world)
        levels = None if rock is None else Levels(rock)
        standing = (*_standing(world), *parked)
        return Surroundings(getattr(world, "terrain", world), world.height, standing, levels, passing)


def crowded(positions: Array, world: Any, room: float) -> Array:
    """What is missing (n, ...) m of ``room`` m between ``positions`` (n, ..., 3) on each frame and moving vehicles."""
    lacking = np.zeros(positions.shape[:-1])
    for vehicle in getattr(world, "passing", ()):
        np.maximum(lacking, vehicle.lacking(positions, room), out=lacking)
    return lacking


def blocked(positions: Array, aims: Array, world: Any, margin: float, radius: float) -> Array:
    """Length (...,), m, of obstructions in front of the target, its left and right; those near the camera weigh
    more."""
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
    if (rock := _rock(world)) is not None:
        sight = _sight(positions, aims)
        hidden = rock.inside(sight.reshape(-1, 3)).reshape(sight.shape[:-1])
        near = positions[..., None, :] + margin * ROUNDABOUT
        cramped = rock.inside(near.reshape(-1, 3)).reshape(near.shape[:-1]).mean(axis=-1)
        reach = np.linalg.norm(ray, axis=-1)
        total += reach * (2 * THROUGH * hidden.mean(axis=-1) + BURIED * (hidden[..., 0] + CRAMPED * cramped))
    return total


def hidden(positions: Array, points: Array, world: Any) -> Array:
    """Share (n,) of a target's ``points`` (n, k, 3) that obstacles hide from ``positions`` (n, 3)."""
    if not _standing(world):
        return np.zeros(len(positions))
    return np.asarray((_through_obstacles(positions[:, None], points, world, 0.0) > 1e-3).mean(axis=1))


def _sight(positions: Array, aims: Array) -> Array:
    return positions[..., None, :] + SIGHT[:, None] * (aims - positions)[..., None, :]


def _over_obstacles(positions: Array, aims: Array, world: Any, margin: float) -> Array:
    """The smallest raise (n,) m of each camera with a clear view past every obstacle and room for moving vehicles; 0 if
    there is none."""
    apart = np.linalg.norm(aims - positions, axis=1)[:, None]

    def free(raises: Array) -> Any:
        raised = positions[:, None] + (apart * raises)[..., None] * (0.0, 0.0, 1.0)
        clear = crowded(raised, world, 0.5 * margin) <= 0.0
        return (_through_obstacles(raised, aims[:, None], world, margin) <= 0.0) & clear

    enough = RAISES[free(np.tile(RAISES, (len(apart), 1))).argmax(axis=1)][:, None]
    short = np.maximum(enough - RAISES[1], 0.0)
    for _ in range(8):
        middle = (short + enough) / 2
        seen = free(middle)
        short, enough = np.where(seen, short, middle), np.where(seen, middle, enough)
    return np.asarray((apart * enough)[:, 0])


def _through_obstacles(positions: Array, aims: Array, world: Any, margin: float) -> Array:
    """Length (...,), m, of the sight from ``positions`` to ``aims`` (..., 3) inside or close to obstacles, plus the
    missing part of half the ``margin`` between camera and obstacles."""
    start, end = (np.reshape(ends, (-1, 3)) for ends in np.broadcast_arrays(positions, aims))
    ray = end - start
    reach = np.linalg.norm(ray, axis=1)
    total = np.zeros(len(start))
    for centre, radius, planes in (solid for obstacle in _standing(world) for solid in _solids(obstacle)):
        nearest = np.clip(((centre - start) * ray).sum(axis=1) / np.maximum(reach**2, 1e-9), 0.0, 1.0)
        close = np.linalg.norm(start + nearest[:, None] * ray - centre, axis=1) < radius + margin
        if not close.any():
            continue
        over = start[close] @ planes[:, :3].T + planes[:, 3]  # distance outside each face at which the sight starts
        lacking = np.maximum(0.5 * margin - over.max(axis=1), 0.0)
        rate = ray[close] @ planes[:, :3].T + 0.1 * margin  # a little space around the sight, less towards the target
        rate[np.abs(rate) < 1e-12] = -1e-12  # parallel to a face: inside on the whole way or never
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


@lru_cache(maxsize=4)
def all_around(count: int) -> Array:
    """Evenly spread directions (count, 3): a spiral from pole to pole that turns by the golden angle."""
    turn, height = np.arange(count) * np.pi * (3 - np.sqrt(5)), 1 - (2 * np.arange(count) + 1) / count
    return np.column_stack([np.cos(turn), np.sin(turn), height]) * np.sqrt(1 - height**2)[:, None] ** [1, 1, 0]


def _standing(world: Any) -> tuple[Obstacle | Parked, ...]:
    return getattr(world, "standing", ())


def _rock(world: Any) -> TerrainSurface | None:
    """The rock of a terrain with overhangs, whose lowest ground is not all that hides a target."""
    return getattr(getattr(world, "terrain", world), "surface", None)


def in_rock(positions: Array, world: Any) -> NDArray[np.bool_]:
    """Which cameras (n,) stand in the rock of a terrain with overhangs."""
    rock = _rock(world)
    return np.zeros(len(positions), bool) if rock is None else rock.inside(positions)


def buried_in(place: Sequence[float], world: Any) -> str:
    """Where a camera's ``place`` (3,) m cannot see anything, in words: in the ground, in rock or in an obstacle's hull;
    empty elsewhere."""
    point = np.array([place], float)
    if in_rock(point, world)[0]:
        return "inside the rock"
    if _rock(world) is None and (deep := float(_ground(point, world, 0.0)[0] - point[0, 2])) > 0:
        return f"{deep:.3g} m below the ground"
    return next((f"inside the obstacle {obstacle.name!r}" for obstacle, _ in _entered(point, world)), "")


def goes_through(positions: Array, world: Any) -> tuple[int, str] | None:
    """When a camera's path (n, 3) is first inside an obstacle or a moving vehicle: the frame's index, and in which."""
    found = [(int(inside.argmax()), f"the obstacle {o.name!r}") for o, inside in _entered(positions, world)]
    for vehicle in getattr(world, "passing", ()):
        if (inside := vehicle.inside(positions)).any():
            found.append((int(inside.argmax()), f"the vehicle {vehicle.name!r}"))
    return min(found, default=None)


def _entered(positions: Array, world: Any) -> Iterator[tuple[Obstacle, NDArray[np.bool_]]]:
    """The standing obstacles that ``positions`` (n, 3) are inside of, and which of them; a camera may be aboard a
    parked vehicle."""
    for obstacle in _standing(world):
        if isinstance(obstacle, Parked):
            continue
        faces = (planes for _, _, planes in _solids(obstacle))
        inside = np.any([(positions @ each[:, :3].T + each[:, 3]).max(axis=1) < 0 for each in faces], axis=0)
        if np.any(inside):
            yield obstacle, inside


def _ground(points: Array, world: Any, margin: float, plain: bool = False) -> Array:
    """The highest ground (...,) within ``margin`` of ``points`` (..., 3), -inf where all of it is farther below than
    that; on terrain with overhangs that below them and, if ``plain``, above them where it is the only one."""
    terrain, levels = getattr(world, "terrain", world), getattr(world, "levels", None)
    highest, flat = np.full(points.shape[:-1], -np.inf), points.reshape(-1, 3)
    if terrain is None:
        return highest
    near = np.arange(len(flat))
    if _rock(world) is None:  # most points of most sights are high above the ground
        near = np.flatnonzero(flat[:, 2] <= terrain.at_most(flat[:, :2], margin) + margin)
    found, below = np.full(len(near), -np.inf), flat[near, 2] + margin
    for offset in margin * np.array([[0, 0], [1, 0], [-1, 0], [0, 1], [0, -1]], float):  # in turn: it saves memory
        around = flat[near, :2] + offset
        np.maximum(found, world.height(around) if levels is None else levels.below(around, below, plain), out=found)
    highest.ravel()[near] = found  # a view: it was made above
    return highest


class Levels:
    """The levels of ground of a terrain with overhangs, in columns around the places that were asked for."""

    def __init__(self, rock: TerrainSurface) -> None:
        self._rock, self._column = rock, COLUMN
        self._lower, self._upper = np.full(2, np.inf), np.full(2, -np.inf)
        self._levels = np.zeros((0, 0, 1))

    def below(self, xy: Array, z: Array, plain: bool) -> Array:
        """The highest ground (n,) m at ``xy`` (n, 2) that is below ``z`` (n,); -inf without any. If ``plain``, the only
        ground at a place counts too where it is above ``z``: a hill without overhangs."""
        low, high = xy.min(axis=0), xy.max(axis=0)
        if (low < self._lower).any() or (high > self._upper).any():
            self._learn(np.minimum(low - ROOM, self._lower), np.maximum(high + ROOM, self._upper))
        levels = self._levels[tuple(np.round((xy - self._lower) / self._column).astype(int).T)]
        found = np.where(levels <= z[:, None], levels, -np.inf).max(axis=1)
        alone = plain & np.isfinite(levels[:, 0]) & np.isnan(levels[:, 1:]).all(axis=1)
        return np.where(alone, levels[:, 0], found)

    def _learn(self, lower: Array, upper: Array) -> None:
        self._column = max(self._column, float((upper - lower).max()) / COLUMNS)
        sides = [np.arange(low, high + self._column, self._column) for low, high in zip(lower, upper, strict=True)]
        grid = np.stack(np.meshgrid(*sides, indexing="ij"), axis=-1)
        self._lower, self._upper = lower, upper
        self._levels = self._rock.levels(grid.reshape(-1, 2)).reshape(*grid.shape[:2], -1)


def _cheapest(costs: Array, places: Array, jump: float) -> NDArray[np.int64]:
    """The row of ``places`` (m, d) for each step (k,) with the least sum of ``costs`` (k, m) and squared changes; the
    first column changes by at most ``jump`` per step, as far as possible."""
    moved = places[:, None] - places[None]
    change = (moved**2).sum(axis=2) + LEAP * (np.abs(moved[..., 0]) > jump)
    best, origins = costs[0], []
    for cost in costs[1:]:
        reached = best[:, None] + change
        origins.append(reached.argmin(axis=0))
        best = reached.min(axis=0) + cost
    chosen = [int(best.argmin())]
    for back in reversed(origins):
        chosen.append(int(back[chosen[-1]]))
    return np.array(chosen[::-1])
