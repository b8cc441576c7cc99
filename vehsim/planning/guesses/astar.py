"""Initial guesses for driving vehicles: A* over positions, or over poses for vehicles that cannot turn on the spot.

The ground is a grid of exact distances to the obstacles. A vehicle that turns in place follows the cheapest path over
it. One with a turning circle follows arcs, forwards and backwards, from pose to pose (hybrid A*), guided by that path's
length, and finally a curve to the goal. The result is only a guess: the optimiser changes it, and certification judges
the final motion.
"""

from __future__ import annotations

import heapq
import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache, partial
from itertools import product
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from vehsim.errors import SolveError
from vehsim.planning.guesses import dubins
from vehsim.planning.guesses.pacing import changes_of_gear
from vehsim.planning.outlines import gaps_to, inner_discs
from vehsim.vehicles import Nonholonomic, Vehicle
from vehsim.world.obstacles.articulated import fixed_footprint
from vehsim.world.obstacles.obstacles import footprint
from vehsim.world.obstacles.plane import placed

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
PATIENCE = 1000
"""After so many poses, a path that ends in a curve to the goal is taken although another may be half as long; after
fewer, only if it is nearly the shortest."""
STEPS = (1.0, 0.3)
"""Lengths of arcs to try, relative to the default: where long ones lead nowhere, short ones may."""
EARLY, EACH, TRIED = 50, 8, 2
"""Curves to the goal are tried from each of the first `EARLY` poses, then from one of `EACH`: in each gear the shortest
`TRIED`."""
DETOUR, SHORTER = 1.2, 0.9
"""A path that costs more than so many times the way over the ground is searched from its other end too, with `EARLY`
poses; what is found there is taken if it costs no more and is at most so long, relative to the first."""
SHARES = (0.75, 0.5, 0.25, 0.0)
"""Shares of the requested clearance that are tried, in turn, to find one with which obstacles leave a path."""
LOOP = 1.5
"""A vehicle without constraints, such as a boat, goes sideways rather than along arcs longer by this factor."""
SHIFTED = 6
"""Number of last poses of a found path that are shifted so that it ends exactly at the goal."""


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

    Where no such path of arcs is found, or a boat would loop, only the reference point is clear of them.
    ``headings``: headings at either end in rad, or None. Each step of ``wariness`` makes narrow gaps more expensive.
    ``met``: outlines (n, k, 2) to avoid if possible. Raises ``SolveError`` if there is no path.
    """
    radius = _guessed_radius(vehicle)
    bearing = float(np.arctan2(*(ends[1] - ends[0])[[1, 0]]))
    nose = [bearing if heading is None else heading for heading in headings]
    # the search moves the body frame's origin (a car's rear axle) if there is a turning circle, otherwise the root
    lead = np.asarray(vehicle.origin[:2], float) if radius > 0 else np.zeros(2)
    shy = SHY * 4 ** (wariness + len(vehicle.tied))  # the search does not know where a trailer swings
    places = ends[:, :2] + _turned(np.array(nose), lead)
    path, poses, shifts = None, None, math.inf
    for outline in _outlines(vehicle):
        grounds = partial(_Ground, outline - lead, parts, places, shy=shy, met=met)
        ground = grounds(clearance)
        path, found = ground.descend(), None
        if path is not None and radius > 0:
            found = _arcs(ground, radius, (nose[0], headings[1]))
        if found is not None and (changes := _shifts(found)) < shifts:
            poses, shifts = found, changes
        if path is not None and (radius == 0 or shifts == 0):
            break
    if path is None:
        between = " to ".join("(" + ", ".join(f"{v:g}" for v in end[:2]) + ")" for end in ends)
        tried = (float(f"{share * clearance:.2g}") for share in (SHARES if clearance > 0 and not met else ()))
        less = next((value for value in tried if grounds(value).descend() is not None), None)
        lower = "" if less is None else f", lower the clearance to {less:g} m at most"
        remedy = f"open a gap{lower}, or move the mark"
        raise SolveError(f"no path from {between} with {clearance:g} m clearance: obstacles close it", remedy)
    if poses is None or not isinstance(vehicle, Nonholonomic):
        straight = _facing(ground.pull(path), headings)
        poses = straight if poses is None or _length(poses) > LOOP * _length(straight) else poses
    root = poses[:, :2] - _turned(poses[:, 2], lead)
    return np.column_stack([root, np.linspace(ends[0, 2], ends[1, 2], len(poses)), poses[:, 2]])


def _outlines(vehicle: Vehicle) -> list[Array]:
    """The outlines (k, 2) m with which a path is searched: with trailers in line, and without them, which swing out of
    the way in bends."""
    whole, alone = footprint(vehicle), fixed_footprint(vehicle)
    return [whole] if np.array_equal(whole, alone) else [whole, alone]


def _arcs(ground: _Ground, radius: float, headings: Sequence[float | None]) -> Array | None:
    """Poses (k, 3) x, y m and heading rad from start to goal by arcs, or None if none were found."""
    for slack, share in product((0.0, ground.partly), STEPS):
        search = _Search(ground, radius, headings, share, slack)
        poses = search.find()
        if poses is not None or search.looked >= POSES:
            break
    if slack == 0 and search.looked > PATIENCE and (poses is None or _shifts(poses)):
        other = _Search(ground, radius, headings, STEPS[0], ground.partly).find(PATIENCE)
        if other is not None and not _shifts(other):
            return other  # it meets a gap nearly, which the optimiser corrects, where arcs must back up to meet it
    return poses


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
    """Distances on a grid around two places ``ends`` (2, 2) of a vehicle's reference point, from which its ``outline``
    (k, 2) is measured, and its free cells."""

    def __init__(
        self,
        outline: Array,
        parts: Sequence[tuple[Any, int]],
        ends: Array,
        clearance: float,
        shy: float,
        met: Sequence[Array],
    ) -> None:
        self.outline, self.ends, self.clearance = outline, ends, clearance
        discs = inner_discs(outline) or [(np.zeros(2), 0.0)]
        self.points = np.vstack([*(centre for centre, _ in discs), outline])
        self.radii = np.array([*(radius for _, radius in discs), *np.zeros(len(outline))])
        self.radius = float(self.radii.max())
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
        self.partly = self.cell / math.sqrt(2)  # a place in a cell may be so much freer than its middle
        self.lower = lower
        self.shape = tuple(np.ceil((upper - lower) / self.cell).astype(int) + 1)
        axes = [lower[k] + self.cell * np.arange(self.shape[k]) for k in (0, 1)]
        grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 1, 2)
        # `over` is 1 beyond this distance
        self.shapes, enough = still, 3 * (self.radius + clearance) + FINEST
        far = _nearest(still, grid, enough)
        self.distance = far.reshape(self.shape)
        self.capped = np.minimum(far, enough)
        near = np.linalg.norm(grid[:, 0, None] - ends, axis=2)
        own = np.array([max(0.0, self.distance[self.index(end)] - self.cell) for end in ends])
        # near an end with less clearance, require only what the end has
        self.demanded = np.minimum(self.radius + clearance, (own + 0.5 * near).min(axis=1)).reshape(self.shape)
        self.shy = shy
        self.price = self.priced(self.distance - self.demanded)

    def priced(self, spare: Array) -> Array:
        """Cost of a metre where the vehicle has ``spare`` m more than it needs."""
        over = np.clip(spare / (2 * self.radius + 2 * self.clearance + 1e-9), 0, 1)
        return np.asarray(1 + self.shy * (1 - over) ** 2)

    def index(self, point: Array) -> tuple[int, int]:
        i, j = self.cells(point[None])[0]
        return int(i), int(j)

    def cells(self, points: Array) -> NDArray[np.int64]:
        """The cells (n, 2) nearest to points (n, 2 or more)."""
        nearest = np.round((points[:, :2] - self.lower) / self.cell).astype(int)
        return np.asarray(np.clip(nearest, 0, np.array(self.shape) - 1))

    def lengths_to(self, end: int, slack: float = 0.0) -> tuple[Array, NDArray[np.int64]]:
        """Cost (nx, ny) of the cheapest path to an end from every cell, inf if there is none; and the next cells.

        Cells that are ``slack`` m too near to obstacles are free.
        """
        from scipy.sparse import coo_matrix
        from scipy.sparse.csgraph import dijkstra

        free = self.distance >= self.demanded - slack
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
        """The cheapest path (k, 2) from start to goal, or None; if no cells lead there, through cells partly free."""
        i, j = self.index(self.ends[0])
        for slack in (0.0, self.partly):
            lengths, following = self.lengths_to(1, slack)
            if np.isfinite(lengths[i, j]):
                break
        else:
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
            cells = tuple(self.cells(moved).T)
            points = np.where((self.distance[cells] >= self.demanded[cells])[:, None], moved, points)
        return points

    def _straight(self, path: Array, here: int, there: int) -> bool:
        count = max(2, there - here + 1)
        line = path[here] + np.linspace(0, 1, count)[:, None] * (path[there] - path[here])
        cells = tuple(self.cells(line).T)
        if (self.distance[cells] < self.demanded[cells]).any():
            return False
        old = tuple(self.cells(path[here : there + 1]).T)
        length = np.linalg.norm(path[there] - path[here])
        before = np.linalg.norm(np.diff(path[here : there + 1], axis=0), axis=1).sum()
        return bool(length * self.price[cells].mean() <= before * self.price[old].mean() * 1.02)

    def margins(self, poses: Array) -> Array:
        """Least distances (n,) m from the discs and corners of the vehicle at poses (n, 3) to the obstacles.

        Distances are interpolated between cells, because half a cell may be all the room that a gap leaves.
        """
        cos, sin = np.cos(poses[:, 2:]), np.sin(poses[:, 2:])
        x, y = self.points.T
        i = (poses[:, :1] + cos * x - sin * y - self.lower[0]) / self.cell
        j = (poses[:, 1:2] + sin * x + cos * y - self.lower[1]) / self.cell
        low = np.clip(i.astype(int), 0, self.shape[0] - 2), np.clip(j.astype(int), 0, self.shape[1] - 2)
        di, dj = np.clip(i - low[0], 0, 1), np.clip(j - low[1], 0, 1)
        at = low[0] * self.shape[1] + low[1]
        far, row = self.capped, self.shape[1]
        before = far[at] + dj * (far[at + 1] - far[at])
        after = far[at + row] + dj * (far[at + row + 1] - far[at + row])
        return np.asarray((before + di * (after - before) - self.radii).min(axis=1))

    def exactly(self, poses: Array) -> Array:
        """Distances (n,) m of the vehicle at poses (n, 3) from the obstacles."""
        return _nearest(self.shapes, placed(self.outline, poses[:, :2], poses[:, 2]), self.clearance + self.cell)


@dataclass(frozen=True)
class _Arc:
    """One step of the search: ``bend`` 1/m, ``gear`` +1 forwards or -1 backwards."""

    bend: float
    gear: int


class _Search:
    """Hybrid A*: poses connected by arcs of equal length; each cell and heading keeps its cheapest pose.

    The search starts from the end nearer to obstacles: a path out of a gap is found sooner than a path into it. Where
    that path is a detour, it may have passed an obstacle on the wrong side for the heading at its end, and is searched
    from the other end too. Poses may be ``slack`` m too near to obstacles, since distances between cells are not exact.
    """

    def __init__(
        self, ground: _Ground, radius: float, headings: Sequence[float | None], share: float, slack: float
    ) -> None:
        self.ground, self.radius, self.headings, self.slack = ground, radius, headings, slack
        self.own = np.array([
            math.inf if heading is None else float(ground.margins(np.array([[*end, heading]]))[0])
            for end, heading in zip(ground.ends, headings, strict=True)
        ])  # fmt: skip
        self.step = share * max(1.5 * ground.cell, 2 * np.pi / TURNS * radius)
        self.place, self.turn = min(ground.cell, self.step / 1.5), share * 2 * np.pi / TURNS
        self.looked = 0
        self.arcs = [_Arc(bend, gear) for gear in (1, -1) for bend in (0.0, 1 / radius, -1 / radius)]
        self.turns = self.step * np.array([arc.bend * arc.gear for arc in self.arcs])
        self.ways = self.step * np.array([arc.gear for arc in self.arcs])

    def find(self, most: int = POSES) -> Array | None:
        """Poses (k, 3) x, y m and heading rad from start to goal, or None if none was found among ``most``."""
        end = 0 if self.headings[1] is None or self.own[0] <= self.own[1] else 1
        lengths = self._lengths_from(end)
        cost, found, self.looked = self._from(end, lengths, most)
        detour = cost > DETOUR * lengths[self.ground.index(self.ground.ends[end])]
        if found is None or self.headings[1] is None or not detour:
            return found
        other, path, _ = self._from(1 - end, self._lengths_from(1 - end), EARLY)
        return path if path is not None and other <= cost and _length(path) <= SHORTER * _length(found) else found

    def _lengths_from(self, end: int) -> Array:
        """Costs (nx, ny) of the cheapest paths over the ground to the other end, whatever the headings."""
        return self.ground.lengths_to(1 - end, self.ground.partly)[0]

    def _prices(self, poses: Array, together: bool = False) -> Array:
        """Cost (n,) of a metre at poses (n, 3), inf nearer than the clearance; near an end with less, what that end has
        is enough. ``together``: one pose that is too near is enough to reject them all."""
        gone = np.hypot(*(poses[:, None, :2] - self.ground.ends).T)
        demanded = np.minimum(self.ground.clearance, (self.own[:, None] + 0.5 * gone).min(axis=0) - 1e-6)
        spare = self.ground.margins(poses) - demanded
        # between two obstacles, distances between cells are too small by up to half a cell
        closed = spare <= -self.slack - self.ground.partly
        doubtful = (spare < -self.slack) & ~closed
        if doubtful.any() and not (together and closed.any()):
            spare[doubtful] = self.ground.exactly(poses[doubtful]) - demanded[doubtful]
        return np.where(spare >= -self.slack, self.ground.priced(spare), np.inf)

    def _from(self, end: int, lengths: Array, most: int) -> tuple[float, Array | None, int]:
        """Cost and poses, from start to goal, of a path that is searched from an ``end``, inf and None if none was
        found; and the number of poses expanded, at most ``most``. ``lengths``: as of `_lengths_from`."""
        ground = self.ground
        ahead = 1 if end == 0 else -1  # the gear in which it drives forwards from start to goal
        start, goal = ground.ends[end], ground.ends[1 - end]
        heading, wanted = self.headings[end], self.headings[1 - end]
        assert heading is not None
        (left, low), cell, (nx, ny) = ground.lower.tolist(), ground.cell, ground.shape
        near, close = 1.5 * self.step, 2.5 * self.turn
        queue: list[tuple[float, int]] = [(0.0, 0)]
        poses, parents, costs = [(float(start[0]), float(start[1]), float(heading))], [-1], [0.0]
        drives = [_Arc(0.0, ahead)]
        best: dict[tuple[int, int, int, int], float] = {}
        least, last, curve = math.inf, 0, np.empty((0, 3))  # the cheapest path that ends in a curve to the goal
        looked = 0
        while queue and looked < most:
            promised, k = heapq.heappop(queue)
            if least < promised * (1 + looked / PATIENCE):
                break
            x, y, angle = poses[k]
            here, drive = costs[k], drives[k]
            if best.get(self._key(x, y, angle, drive.gear), math.inf) < here:
                continue
            looked += 1
            off = 0.0 if wanted is None else abs((angle - wanted + math.pi) % (2 * math.pi) - math.pi)
            if math.hypot(x - goal[0], y - goal[1]) < near and off < close:
                path = self._shifted(self._back(k, poses, parents), goal, angle if wanted is None else wanted)
                if np.isfinite(self._prices(path[-SHIFTED:], together=True)).all():
                    return here, path[::ahead], looked
            if wanted is not None and (looked < EARLY or looked % EACH == 0):
                for cost, way in self._curves(poses[k], (float(goal[0]), float(goal[1]), wanted), ahead, drive.gear):
                    if here + cost < least:
                        least, last, curve = here + cost, k, way
            middle = angle + self.turns / 2
            after = np.stack(
                [x + self.ways * np.cos(middle), y + self.ways * np.sin(middle), angle + self.turns], axis=-1
            )
            for arc, pose, price in zip(self.arcs, after.tolist(), self._prices(after).tolist(), strict=True):
                x1, y1, nose = pose
                i, j = round((x1 - left) / cell), round((y1 - low) / cell)
                if price == math.inf or not (0 <= i < nx and 0 <= j < ny) or lengths[i, j] == math.inf:
                    continue
                cost = here + self.step * price * (1.0 if arc.gear == ahead else BACK)
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
        found = np.vstack([self._back(last, poses, parents), curve])[::ahead] if least < math.inf else None
        return least, found, looked

    def _key(self, x: float, y: float, angle: float, gear: int) -> tuple[int, int, int, int]:
        left, low = self.ground.lower
        return (
            round((x - left) / self.place),
            round((y - low) / self.place),
            round(angle % (2 * math.pi) / self.turn),
            gear,
        )

    def _curves(
        self, pose: tuple[float, ...], goal: tuple[float, ...], ahead: int, gear: int
    ) -> list[tuple[float, Array]]:
        """Costs of free curves from a pose to the goal, one in each gear, and their poses (n, 3)."""
        found = []
        for drive in (ahead, -ahead):
            away = 0.0 if drive > 0 else math.pi  # backwards, a curve leads where the tail points
            ends = (*pose[:2], pose[2] + away), (*goal[:2], goal[2] + away)
            for parts in sorted(dubins.curves(*ends, self.radius), key=dubins.length)[:TRIED]:
                poses = dubins.along(ends[0], parts, self.step) - [0, 0, away]
                price = float(self._prices(poses, together=True).mean())
                if price < math.inf:
                    cost = dubins.length(parts) * price
                    found.append((cost * (1.0 if drive == ahead else BACK) + SHIFT * (drive != gear), poses))
                    break
        return found

    def _back(self, k: int, poses: Sequence[tuple[float, ...]], parents: Sequence[int]) -> Array:
        """The path (n, 3) to pose ``k``."""
        found = []
        while k >= 0:
            found.append(poses[k])
            k = parents[k]
        return np.array(found[::-1])

    def _shifted(self, path: Array, goal: Array, wanted: float) -> Array:
        """A path with its last poses shifted so that it ends at the goal."""
        turn = (wanted - path[-1, 2] + np.pi) % (2 * np.pi) - np.pi
        last = min(SHIFTED, len(path))
        share = np.concatenate([np.zeros(len(path) - last), np.linspace(0, 1, last)])
        return np.asarray(path + share[:, None] * [*(goal - path[-1, :2]), turn])


def _nearest(shapes: Sequence[Any], outlines: Array, reach: float = math.inf) -> Array:
    """Distances (n,) m of outlines (n, k, 2) to the nearest of the shapes; above ``reach`` m, lower bounds."""
    far = np.full(len(outlines), np.inf)
    for shape in shapes:
        far = np.minimum(far, gaps_to(shape, outlines, reach))
    return far


def _turned(angle: Array, point: Array) -> Array:
    """``point`` (2,) rotated by angles (n,) rad: (n, 2)."""
    c, s = np.cos(angle), np.sin(angle)
    return np.column_stack([c * point[0] - s * point[1], s * point[0] + c * point[1]])


def _shifts(poses: Array) -> int:
    """How often the direction changes along poses (k, 3)."""
    return int(changes_of_gear(np.insert(poses, 2, 0.0, axis=1))[-1])


def _length(path: Array) -> float:
    return float(np.linalg.norm(np.diff(path[:, :2], axis=0), axis=1).sum())


def _facing(path: Array, headings: Sequence[float | None]) -> Array:
    """The path (k, 2) with headings along it, blended into the requested headings at its ends: (k, 3)."""
    step = np.gradient(path, axis=0)
    yaw = np.unwrap(np.arctan2(step[:, 1], step[:, 0]))
    share = np.linspace(0, 1, len(path))
    for wanted, weight in ((headings[0], 1 - share / 0.1), (headings[1], 1 - (1 - share) / 0.1)):
        if wanted is not None:
            yaw = yaw + np.clip(weight, 0, 1) * ((wanted - yaw + np.pi) % (2 * np.pi) - np.pi)
    return np.column_stack([path, yaw])
