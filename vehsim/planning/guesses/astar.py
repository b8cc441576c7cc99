"""Initial guesses for driving vehicles: A* over positions, or over poses for vehicles that cannot turn on the spot.

The ground is a grid of exact distances to the obstacles. A vehicle that turns in place follows the cheapest path over
it. One with a turning circle follows arcs, forwards and backwards, from pose to pose (hybrid A*), guided by that path's
length. The result is only a guess: the optimiser changes it, and certification judges the final motion.
"""

from __future__ import annotations

import heapq
import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from vehsim.errors import SolveError
from vehsim.planning.outlines import gaps_to, inner_discs
from vehsim.vehicles import Nonholonomic, Vehicle
from vehsim.world.obstacles.obstacles import footprint

Array = NDArray[np.float64]

CELLS = 150
"""Cells of the grid along its longer side; fewer if they would be finer than needed."""
FINEST = 0.05
"""Smallest cell, m."""
TURNS = 48
"""Number of headings that the search over poses distinguishes."""
SHY = 0.5
"""A metre at exactly the requested clearance costs 1 + SHY metres in the open."""
BACK, SHIFT, STEER = 1.5, 2.0, 0.05
"""Costs: of a metre backwards; of a change of direction, m; of a change of steering, m."""
EAGER = 1.3
"""Factor on the estimated length of the remaining path: above 1, fewer poses are expanded."""
POSES = 30_000
"""Maximum number of expanded poses."""


def guess_drive(
    vehicle: Vehicle,
    parts: Sequence[tuple[Any, int]],
    ends: Array,
    headings: Sequence[float | None],
    clearance: float,
    wariness: int = 0,
    met: Sequence[Array] = (),
) -> Array:
    """A path (k, 4) of x, y, z m and heading rad from ``ends[0]`` to ``ends[1]`` (2, 3) m, clear of standing ``parts``.

    ``headings``: headings at either end in rad, or None. Each step of ``wariness`` makes narrow gaps more expensive.
    ``met``: outlines (n, k, 2) to avoid if possible. Raises ``SolveError`` if there is no path.
    """
    radius = _guessed_radius(vehicle)
    bearing = float(np.arctan2(*(ends[1] - ends[0])[[1, 0]]))
    nose = [bearing if heading is None else heading for heading in headings]
    # the search moves the body frame's origin (a car's rear axle) if there is a turning circle, otherwise the root
    lead = np.asarray(vehicle.origin[:2], float) if radius > 0 else np.zeros(2)
    ground = _Ground(
        vehicle, lead, parts, ends[:, :2] + _turned(np.array(nose), lead), clearance, SHY * 4**wariness, met
    )
    path = ground.descend()
    if path is None:
        places = " to ".join("(" + ", ".join(f"{v:g}" for v in end[:2]) + ")" for end in ends)
        remedy = "open a gap, lower the clearance, or move the mark"
        raise SolveError(f"no path from {places} with {clearance:g} m clearance: obstacles close it", remedy)
    poses = None
    if radius > 0:
        poses = _Search(ground, radius).find(nose[0], headings[1])
    if poses is None:
        poses = _facing(ground.pull(path), headings)
    root = poses[:, :2] - _turned(poses[:, 2], lead)
    return np.column_stack([root, np.linspace(ends[0, 2], ends[1, 2], len(poses)), poses[:, 2]])


@lru_cache(maxsize=64)
def turning_radius(vehicle: Vehicle) -> float:
    """Radius of the smallest circle that the vehicle's body frame can drive, m; 0 if it can turn on the spot."""
    r: Any = ca.SX.sym("r", len(vehicle.joints))
    free: Any = ca.horzcat(vehicle.basis(r), vehicle.connection(r))
    moves = ca.Function("moves", [r], [free[:3, :]])
    best = math.inf
    for share in (0.999, -0.999):
        limits = [vehicle.joint_limits.get(joint, (-1.0, 1.0)) for joint in vehicle.joints]
        at = [np.clip(share * (high if share > 0 else -low), -1e3, 1e3) for low, high in limits]
        velocities = np.array(moves(at)).reshape(3, -1)
        if np.linalg.matrix_rank(velocities[:2], tol=1e-9) > 1:
            return 0.0
        turn, ahead = np.abs(velocities[:2]).max(axis=1)
        best = min(best, ahead / turn if turn > 1e-9 else math.inf)
    return best


def _guessed_radius(vehicle: Vehicle) -> float:
    """Radius of the arcs of a guess, m: of the smallest circle, or the length of a vehicle without constraints.

    Such a vehicle, like a boat, turns on the spot only while it stands.
    """
    own = turning_radius(vehicle)
    return own if isinstance(vehicle, Nonholonomic) else max(own, float(np.ptp(footprint(vehicle)[:, 0])))


class _Ground:
    """Distances on a grid around two places ``ends`` (2, 2) of a vehicle's reference point ``lead`` (2,), and its free
    cells."""

    def __init__(
        self,
        vehicle: Vehicle,
        lead: Array,
        parts: Sequence[tuple[Any, int]],
        ends: Array,
        clearance: float,
        shy: float,
        met: Sequence[Array],
    ) -> None:
        self.ends, self.clearance = ends, clearance
        outline = footprint(vehicle) - lead
        self.discs = inner_discs(outline) or [(np.zeros(2), 0.0)]
        self.radius = max(radius for _, radius in self.discs)
        size = float(np.linalg.norm(outline, axis=1).max())
        still = [o.parts[i] for o, i in parts if not o.moves]
        still += [outline for outlines in met for outline in outlines[:: max(1, len(outlines) // 8)]]
        still += [o.shapes_at(np.zeros(1))[0][0] for o, _ in parts if o.moves and o.is_static]
        corners = [shape.outline() if hasattr(shape, "outline") else shape for shape in still]
        points = np.vstack([ends, *corners])
        room = 4 * size + 2 * clearance
        lower, upper = points.min(axis=0) - room, points.max(axis=0) + room
        # obstacles far from both ends can be ignored
        reach = 3 * float(np.linalg.norm(ends[1] - ends[0])) + 10 * size
        lower, upper = np.maximum(lower, ends.min(axis=0) - reach), np.minimum(upper, ends.max(axis=0) + reach)
        self.cell = max(FINEST, min(float((upper - lower).max()) / CELLS, max(self.radius / 2, FINEST)))
        self.cell = max(self.cell, float((upper - lower).max()) / (2 * CELLS))
        self.lower = lower
        self.shape = tuple(np.ceil((upper - lower) / self.cell).astype(int) + 1)
        axes = [lower[k] + self.cell * np.arange(self.shape[k]) for k in (0, 1)]
        grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 1, 2)
        # `over` is 1 beyond this distance
        far, enough = np.full(len(grid), np.inf), 3 * (self.radius + clearance) + FINEST
        for shape in still:
            far = np.minimum(far, gaps_to(shape, grid, enough))
        self.distance = far.reshape(self.shape)
        near = np.linalg.norm(grid[:, 0, None] - ends, axis=2)
        own = np.array([max(0.0, self.distance[self.index(end)] - self.cell) for end in ends])
        # near an end with less clearance, require only what the end has
        self.demanded = np.minimum(self.radius + clearance, (own + 0.5 * near).min(axis=1)).reshape(self.shape)
        over = np.clip((self.distance - self.demanded) / (2 * self.radius + 2 * clearance + 1e-9), 0, 1)
        self.price = 1 + shy * (1 - over) ** 2

    def index(self, point: Array) -> tuple[int, int]:
        i, j = np.clip(np.round((point - self.lower) / self.cell).astype(int), 0, np.array(self.shape) - 1)
        return int(i), int(j)

    def lengths_to(self, end: int) -> tuple[Array, NDArray[np.int64]]:
        """Cost (nx, ny) of the cheapest path to an end from every cell, inf if there is none; and the next cells."""
        from scipy.sparse import coo_matrix
        from scipy.sparse.csgraph import dijkstra

        free = self.distance >= self.demanded
        free[self.index(self.ends[end])] = True
        number = np.arange(free.size).reshape(self.shape)
        rows, cols, weights = [], [], []
        for di, dj in ((1, 0), (0, 1), (1, 1), (1, -1)):
            here = (slice(0, self.shape[0] - di), slice(max(0, -dj), self.shape[1] - max(0, dj)))
            there = (slice(di, None), slice(max(0, dj), self.shape[1] + min(0, dj)))
            both = free[here] & free[there]
            rows.append(number[here][both])
            cols.append(number[there][both])
            weights.append((self.price[here] + self.price[there])[both] / 2 * self.cell * math.hypot(di, dj))
        entries = (np.concatenate(weights), (np.concatenate(rows), np.concatenate(cols)))
        graph = coo_matrix(entries, shape=(free.size, free.size)).tocsr()
        goal = number[self.index(self.ends[end])]
        lengths, following = dijkstra(graph, directed=False, indices=goal, return_predecessors=True)
        return np.asarray(lengths).reshape(self.shape), following

    def descend(self) -> Array | None:
        """The cheapest path (k, 2) from start to goal, or None."""
        lengths, following = self.lengths_to(1)
        i, j = self.index(self.ends[0])
        if not np.isfinite(lengths[i, j]):
            return None
        at, cells = i * self.shape[1] + j, []
        while at >= 0:
            cells.append(divmod(at, self.shape[1]))
            at = following[at]
        path = self.lower + self.cell * np.array(cells, float)
        path[0] = self.ends[0]
        return np.vstack([path[:-1] if len(path) > 1 else path, self.ends[1]])

    def pull(self, path: Array) -> Array:
        """The path with its corners cut where the straight line is free and not more expensive, and rounded."""
        kept = [0]
        while kept[-1] < len(path) - 1:
            here, there = kept[-1], len(path) - 1
            while there > here + 1 and not self._straight(path, here, there):
                there = here + max(1, (there - here) * 3 // 4)
            kept.append(there)
        corners = path[kept]
        station = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(corners, axis=0), axis=1))])
        even = np.linspace(0, station[-1], max(4, int(station[-1] / (2 * self.cell)) + 2))
        points = np.column_stack([np.interp(even, station, corners[:, k]) for k in (0, 1)])
        for _ in range(12):
            moved = points.copy()
            moved[1:-1] = 0.25 * points[:-2] + 0.5 * points[1:-1] + 0.25 * points[2:]
            cells = tuple(np.array([self.index(p) for p in moved]).T)
            points = np.where((self.distance[cells] >= self.demanded[cells])[:, None], moved, points)
        return points

    def _straight(self, path: Array, here: int, there: int) -> bool:
        count = max(2, there - here + 1)
        line = path[here] + np.linspace(0, 1, count)[:, None] * (path[there] - path[here])
        cells = tuple(np.array([self.index(p) for p in line]).T)
        if (self.distance[cells] < self.demanded[cells]).any():
            return False
        old = tuple(np.array([self.index(p) for p in path[here : there + 1]]).T)
        length = np.linalg.norm(path[there] - path[here])
        before = np.linalg.norm(np.diff(path[here : there + 1], axis=0), axis=1).sum()
        return bool(length * self.price[cells].mean() <= before * self.price[old].mean() * 1.02)

    def free_poses(self) -> NDArray[np.bool_]:
        """Which poses (TURNS, nx, ny) are free: the vehicle's discs keep clear at a heading and cell."""
        free = np.ones((TURNS, *self.shape), bool)
        for turn in range(TURNS):
            angle = 2 * np.pi * turn / TURNS
            R = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
            for centre, radius in self.discs:
                i, j = np.round(R @ centre / self.cell).astype(int)
                moved = np.full(self.shape, np.inf)
                a, b = (slice(max(0, -k), n - max(0, k)) for k, n in zip((i, j), self.shape, strict=True))
                c, d = (slice(max(0, k), n - max(0, -k)) for k, n in zip((i, j), self.shape, strict=True))
                moved[a, b] = self.distance[c, d]
                free[turn] &= moved >= radius + self.clearance
        for end in self.ends:  # an end may itself be nearer than requested
            grid = np.indices(self.shape) * self.cell
            about = np.hypot(*(grid - (end - self.lower)[:, None, None])) < 2 * self.cell
            free[:, about] = True
        return free


@dataclass(frozen=True)
class _Arc:
    """One step of the search: ``bend`` 1/m, ``gear`` +1 forwards or -1 backwards, ``turn`` rad."""

    bend: float
    gear: int
    turn: float


class _Search:
    """Hybrid A*: poses connected by arcs of equal length; each cell and heading keeps its cheapest pose.

    The search starts from the end with less free space: a path out of a gap is found sooner than a path into it.
    """

    def __init__(self, ground: _Ground, radius: float) -> None:
        self.ground, self.radius = ground, radius
        self.free = ground.free_poses()
        self.step = max(1.5 * ground.cell, 2 * np.pi / TURNS * radius)
        self.arcs = [
            _Arc(bend, gear, bend * gear * self.step) for gear in (1, -1) for bend in (0.0, 1 / radius, -1 / radius)
        ]

    def find(self, heading: float, wanted: float | None) -> Array | None:
        """Poses (k, 3) x, y m and heading rad from start to goal, or None if none was found."""
        if wanted is None or self._room(0) <= self._room(1):
            return self._from(0, heading, wanted, 1)
        found = self._from(1, wanted, heading, -1)
        return None if found is None else found[::-1]

    def _room(self, end: int) -> float:
        """Share of free poses around an end."""
        i, j = self.ground.index(self.ground.ends[end])
        n = int(np.ceil(2 * self.radius / self.ground.cell))
        return float(self.free[:, max(0, i - n) : i + n, max(0, j - n) : j + n].mean())

    def _from(self, end: int, heading: float, wanted: float | None, ahead: int) -> Array | None:
        """Poses from one end to the other; ``ahead``: the preferred gear, 1 or -1."""
        ground, free, price = self.ground, self.free, self.ground.price
        start, goal = ground.ends[end], ground.ends[1 - end]
        lengths, _ = ground.lengths_to(1 - end)
        (left, low), cell, (nx, ny) = ground.lower.tolist(), ground.cell, ground.shape
        near, close = 1.5 * self.step, 2.5 * 2 * math.pi / TURNS
        queue: list[tuple[float, int]] = [(0.0, 0)]
        poses, parents, costs = [(float(start[0]), float(start[1]), float(heading))], [-1], [0.0]
        drives = [_Arc(0.0, ahead, 0.0)]
        best: dict[tuple[int, int, int, int], float] = {}
        looked = 0
        while queue and looked < POSES:
            _, k = heapq.heappop(queue)
            x, y, angle = poses[k]
            here, drive = costs[k], drives[k]
            if best.get(self._key(x, y, angle, drive.gear), math.inf) < here:
                continue
            looked += 1
            off = 0.0 if wanted is None else abs((angle - wanted + math.pi) % (2 * math.pi) - math.pi)
            if math.hypot(x - goal[0], y - goal[1]) < near and off < close:
                return self._back(k, poses, parents, goal, angle if wanted is None else wanted)
            for arc in self.arcs:
                nose, middle = angle + arc.turn, angle + arc.turn / 2
                x1, y1 = x + arc.gear * self.step * math.cos(middle), y + arc.gear * self.step * math.sin(middle)
                i, j = round((x1 - left) / cell), round((y1 - low) / cell)
                if not (0 <= i < nx and 0 <= j < ny) or lengths[i, j] == math.inf:
                    continue
                if not free[round(nose * TURNS / (2 * math.pi)) % TURNS, i, j]:
                    continue
                cost = here + self.step * price[i, j] * (1.0 if arc.gear == ahead else BACK)
                cost += SHIFT * (arc.gear != drive.gear) + STEER * (arc.bend != drive.bend)
                key = self._key(x1, y1, nose, arc.gear)
                if cost >= best.get(key, math.inf):
                    continue
                best[key] = cost
                poses.append((x1, y1, nose))
                parents.append(k)
                costs.append(cost)
                drives.append(arc)
                heapq.heappush(queue, (cost + EAGER * lengths[i, j], len(poses) - 1))
        return None

    def _key(self, x: float, y: float, angle: float, gear: int) -> tuple[int, int, int, int]:
        ground = self.ground
        i, j = round((x - ground.lower[0]) / ground.cell), round((y - ground.lower[1]) / ground.cell)
        return i, j, round(angle * TURNS / (2 * math.pi)) % TURNS, gear

    def _back(self, k: int, poses: Any, parents: Any, goal: Array, wanted: float) -> Array:
        """The path to pose ``k``, with its last steps shifted so that it ends at the goal."""
        found = []
        while k >= 0:
            found.append(poses[k])
            k = parents[k]
        path = np.array(found[::-1])
        miss = (
            np.array([goal[0], goal[1], path[-1, 2] + (wanted - path[-1, 2] + np.pi) % (2 * np.pi) - np.pi]) - path[-1]
        )
        share = (
            np.clip(np.arange(len(path)) - (len(path) - 6), 0, 5) / 5 if len(path) > 6 else np.linspace(0, 1, len(path))
        )
        return np.asarray(path + share[:, None] * miss)


def _turned(angle: Array, point: Array) -> Array:
    """``point`` (2,) rotated by angles (n,) rad: (n, 2)."""
    c, s = np.cos(angle), np.sin(angle)
    return np.column_stack([c * point[0] - s * point[1], s * point[0] + c * point[1]])


def _facing(path: Array, headings: Sequence[float | None]) -> Array:
    """The path (k, 2) with headings along it, blended into the requested headings at its ends: (k, 3)."""
    step = np.gradient(path, axis=0)
    yaw = np.unwrap(np.arctan2(step[:, 1], step[:, 0]))
    share = np.linspace(0, 1, len(path))
    for wanted, weight in ((headings[0], 1 - share / 0.1), (headings[1], 1 - (1 - share) / 0.1)):
        if wanted is not None:
            yaw = yaw + np.clip(weight, 0, 1) * ((wanted - yaw + np.pi) % (2 * np.pi) - np.pi)
    return np.column_stack([path, yaw])
