"""A path through free space: the planner's initial guess for a flight.

Dijkstra's shortest path over the distance field's grid, where passing close to rock costs more than its length; then
straightened where that costs less, and smoothed. It is a path, not a motion, and does not know the vehicle.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from itertools import pairwise, product

import numpy as np
from numpy.typing import ArrayLike, NDArray

from vehsim.errors import InputError, SolveError
from vehsim.world.distance.field import DistanceField

Array = NDArray[np.float64]

NODES = 400_000
"""Largest number of grid points in a search: a larger grid is thinned."""
FEW = 30_000
"""Number of grid points that are searched at once."""
CORRIDORS = (1.06, 1.25)
"""Largest cost of a path in the corridors of a large grid that are searched in turn, over the least that it could be:
most paths cost at most 1.04 of that."""
STRAIGHT = 1.02
"""Largest cost of a straight path that is taken without a search, over its length: no path costs less than that."""
SHY = 4.0
"""At the clearance limit, a metre costs 1 + SHY times as much as in the open."""
BETWEEN, EVEN = 16, 64
"""Numbers of paths between two, and of points on each, by which `on_other_side` compares them."""
COMFORT = 8.0
"""Distance beyond the requested clearance at which rock no longer adds cost, m."""
LIFTS = (10.0, 30.0, np.inf)
"""Ceilings that are tried in turn, m above the ends, if none is given: first through the valley, finally over it."""


def find_route(
    field: DistanceField | None,
    start: ArrayLike,
    goal: ArrayLike,
    clearance: float,
    ceiling: float | None = None,
    height: Callable[[Array], Array] | None = None,
    bounds: Array | None = None,
    shy: float | None = None,
) -> Array:
    """A path (k, 3) m from ``start`` to ``goal`` (3,) m that keeps ``clearance`` m from the rock of ``field``.

    Near an end that is closer to the rock, the path keeps only the clearance of that end. ``ceiling`` m bounds the
    height; if None, the lowest of `LIFTS` with a path is used. ``height`` (xy -> m) is used to explain errors.
    ``bounds`` (2, 3) m: the box of all space, of which the field may be a part; then a path counts only if none that
    leaves the part can be better. ``shy``: in place of `SHY`. Raises ``InputError`` if an end is in the rock,
    ``SolveError`` if there is no path.
    """
    ends = np.stack([_point("start", start), _point("goal", goal)])
    if field is None or np.ptp(ends, axis=0).max() == 0:
        return ends
    for name, end in zip(("start", "goal"), ends, strict=True):
        check_free(field, name, end, clearance, ceiling, height)
    highest = float(ends[:, 2].max())
    ceilings = [highest + lift for lift in LIFTS] if ceiling is None else [ceiling]
    search, least = _Search(field, ends, clearance, SHY if shy is None else shy), _least_outside(field, ends, bounds)
    free, cost = search.sample(*ends)
    if free and cost <= STRAIGHT * np.linalg.norm(ends[1] - ends[0]):
        return search.smooth(ends)
    for bound in ceilings:
        path, cost = search.shortest(bound)
        if cost > least:
            raise SolveError("the best path may lead outside the box", "search a larger box", key="route")
        if path is not None:
            return search.smooth(search.pull(path))
    remedy = "lower the clearance" if ceiling is None else "raise the ceiling or lower the clearance"
    below = "" if ceiling is None else f" below z = {ceiling:g} m"
    message = f"no path from {_say(ends[0])} to {_say(ends[1])} with {clearance:g} m clearance{below}"
    raise SolveError(message, remedy, key="route")


def on_other_side(field: DistanceField, one: Array, other: Array) -> bool:
    """Whether two paths (k, 3) m between the same ends pass something in ``field`` on different sides: then paths
    between them lead through it."""
    even = []
    for path in (one, other):
        station = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(path, axis=0), axis=1))])
        at = np.linspace(0, station[-1], EVEN)
        even.append(np.stack([np.interp(at, station, path[:, k]) for k in range(3)], axis=-1))
    between = even[0] + np.linspace(0, 1, BETWEEN)[:, None, None] * (even[1] - even[0])
    return bool((field.value(between.reshape(-1, 3)) < 0.5 * field.spacing).any())


def _least_outside(field: DistanceField, ends: Array, bounds: Array | None) -> float:
    """The length of the shortest way between the ``ends`` (2, 3) m that leaves the ``field`` where the box ``bounds``
    (2, 3) m continues, m; inf if it does not."""
    least = np.inf
    if bounds is None:
        return least
    for border, continues in ((field.lower, field.lower > bounds[0]), (field.upper, field.upper < bounds[1])):
        for axis in np.flatnonzero(continues):
            mirrored = ends[1].copy()
            mirrored[axis] = 2 * border[axis] - mirrored[axis]
            least = min(least, float(np.linalg.norm(mirrored - ends[0])))
    return least


def _say(point: Array) -> str:
    return "(" + ", ".join(f"{x:g}" for x in point) + ")"


def _point(name: str, value: ArrayLike) -> Array:
    point = np.asarray(value, dtype=float)
    if point.shape != (3,) or not np.isfinite(point).all():
        raise InputError("not a point", "give x, y, z in metres", key=name, value=value)
    return point


def check_free(
    field: DistanceField,
    name: str,
    point: Array,
    clearance: float,
    ceiling: float | None,
    height: Callable[[Array], Array] | None,
) -> None:
    """Raise ``InputError`` if ``point`` lies in the rock, outside the terrain or above the ceiling."""
    value = point.tolist()
    if (point[:2] < field.lower[:2]).any() or (point[:2] > field.upper[:2]).any():
        remedy = f"choose x, y from {_say(field.lower[:2])} to {_say(field.upper[:2])}"
        raise InputError("lies outside the terrain", remedy, key=name, value=value)
    if ceiling is not None and point[2] > ceiling:
        raise InputError(f"lies above the ceiling of {ceiling:g} m", "raise the ceiling", key=name, value=value)
    column = np.column_stack([np.tile(point[:2], (2000, 1)), np.linspace(field.lower[2], field.upper[2], 2000)])
    free = field.value(column)
    ground = float(height(point[None, :2])[0]) if height is not None else float(column[np.argmax(free > 0), 2])
    if point[2] <= ground or field.value(point)[0] <= -field.spacing:
        over = (column[:, 2] > ground) & (free >= clearance)
        lowest = column[np.argmax(over), 2] if over.any() else field.upper[2]
        remedy = f"raise it to z = {np.ceil(10 * lowest) / 10:g} m or more, or move it"
        raise InputError(f"lies {ground - point[2]:.1f} m inside the rock", remedy, key=name, value=value)


class _Search:
    """Free space between two ends as a graph: grid points, and the cost per metre at each."""

    def __init__(self, field: DistanceField, ends: Array, clearance: float, shy: float) -> None:
        self.field, self.ends, self.clearance, self.shy = field, ends, clearance, shy
        self.at_ends = field.value(ends)
        stride = int(np.ceil((field.distances.size / (4 * NODES)) ** (1 / 3)))
        self.distance = field.distances[::stride, ::stride, ::stride].astype(float)
        self.step = field.spacing * stride

    def demanded(self, points: Array) -> Array:
        """Required clearance (n,) m at ``points``; near an end with less clearance, that of the end."""
        near = np.linalg.norm(points[:, None] - self.ends, axis=2)
        relaxed = np.maximum(self.at_ends, 0) - self.field.spacing + 0.5 * near
        return np.minimum(self.clearance, relaxed.min(axis=1))

    def cost(self, distance: Array) -> Array:
        """Cost per metre at a ``distance`` of m from the rock."""
        return 1 + self.shy * np.clip(1 - (distance - self.clearance) / COMFORT, 0, 1) ** 2

    def shortest(self, ceiling: float) -> tuple[Array | None, float]:
        """The cheapest path (k, 3) m over the grid below ``ceiling``, with both ends, and its cost; None, inf if there
        is none.

        Large grids are searched only in the corridor that a grid of twice the step leaves, unless the path that is
        found there costs so much that another could be cheaper.
        """
        shape = self.distance.shape
        levels = int(np.sum(self.field.lower[2] + self.step * np.arange(shape[2]) <= ceiling + 1e-9))
        if levels == 0:
            return None, np.inf
        distance = self.distance[:, :, :levels]
        free = self._free(distance)
        nodes, cost = np.argwhere(free), self.cost(distance[free])
        near = [self._reach(end, nodes) for end in self.ends]
        if min(map(len, near)) == 0:
            return None, np.inf
        if len(nodes) > FEW:
            through, block = self._through(nodes, cost, near)
            least = float(through.min())
            if not np.isfinite(least):
                return None, np.inf
            for factor in CORRIDORS:
                # a path's ends, and where it crosses a block, may be this much farther
                inside = (through <= factor * least + 2 * self.step * (1 + self.shy))[block]
                kept = np.cumsum(inside) - 1
                reached = [kept[each[inside[each]]] for each in near]
                path, length = self._cheapest(nodes[inside], cost[inside], reached)
                if length <= factor * least:
                    return path, length
        return self._cheapest(nodes, cost, near)

    def _free(self, distance: Array) -> NDArray[np.bool_]:
        """Which grid points (nx, ny, nz) with these distances a path may use."""
        free = distance >= self.clearance
        for end, here in zip(self.ends, self.at_ends, strict=True):
            reach = 2 * (self.clearance - max(here, 0.0) + self.field.spacing)  # beyond, `demanded` is the clearance
            low, high = ((end + side * reach - self.field.lower) / self.step for side in (-1, 1))
            box = tuple(slice(max(int(a), 0), max(int(b) + 2, 0)) for a, b in zip(low, high, strict=True))
            indices = np.stack(np.meshgrid(*(np.arange(n)[part] for n, part in zip(free.shape, box, strict=True)),
                                           indexing="ij"), axis=-1)  # fmt: skip
            wanted = self.demanded((self.field.lower + self.step * indices).reshape(-1, 3)).reshape(indices.shape[:3])
            free[box] = (distance[box] >= wanted) & (distance[box] > -self.step)
        return free

    def _through(
        self, nodes: NDArray[np.int64], cost: Array, near: Sequence[NDArray[np.int64]]
    ) -> tuple[Array, NDArray[np.int64]]:
        """About the least cost (blocks,) of a path through each block of eight nodes, all as cheap as the cheapest of
        them, and the block (n,) of each node; inf if the ends are not connected."""
        shape = tuple(nodes.max(axis=0) // 2 + 1)
        block = np.ravel_multi_index(tuple(nodes.T // 2), shape)
        least = np.full(np.prod(shape), np.inf)
        np.minimum.at(least, block, cost)
        blocks = np.flatnonzero(np.isfinite(least))
        number = np.empty(len(least), np.int64)
        number[blocks] = np.arange(len(blocks))
        block = number[block]
        graph = _Graph(np.stack(np.unravel_index(blocks, shape), axis=-1), least[blocks], 2 * self.step)
        return np.sum([graph.costs_from(np.unique(block[each]), 0.0) for each in near], axis=0), block

    def _cheapest(
        self, nodes: NDArray[np.int64], cost: Array, near: Sequence[NDArray[np.int64]]
    ) -> tuple[Array | None, float]:
        """The cheapest path over the ``nodes`` (n, 3), and its cost; None, inf without one. ``near``: the nodes
        connected to each end."""
        where = self.field.lower + self.step * nodes
        away = [np.linalg.norm(where[each] - end, axis=1) for each, end in zip(near, self.ends, strict=True)]
        graph = _Graph(nodes, cost, self.step)
        least = graph.costs_from(near[0], away[0])
        through = least[near[1]] + away[1]
        best = int(through.argmin())
        if not np.isfinite(through[best]):
            return None, np.inf
        path = graph.path_to(int(near[1][best]), least, dict(zip(near[0].tolist(), away[0].tolist(), strict=True)))
        return np.concatenate([self.ends[:1], where[path], self.ends[1:]]), float(through[best])

    def _reach(self, end: Array, nodes: NDArray[np.int64]) -> NDArray[np.int64]:
        """The nodes connected to an end: those of its cell, or straight below it if it is above the box."""
        inside = (np.clip(end, self.field.lower, self.field.upper) - self.field.lower) / self.step
        return np.flatnonzero((np.abs(nodes - inside) <= 1.01).all(axis=1))

    def sample(self, a: Array, b: Array) -> tuple[bool, float]:
        """Whether the straight line from ``a`` to ``b`` (3,) is free, and its cost."""
        length = float(np.linalg.norm(b - a))
        count = max(2, int(np.ceil(length / (0.5 * self.field.spacing))) + 1)
        points = a + np.linspace(0, 1, count)[:, None] * (b - a)
        value = self.field.value(points)
        return bool((value >= self.demanded(points)).all()), length * float(self.cost(value).mean())

    def pull(self, path: Array) -> Array:
        """``path`` (k, 3) with its corners cut wherever the straight line is free and costs no more."""
        leg = [self.sample(a, b)[1] for a, b in pairwise(path)]
        so_far = np.concatenate([[0], np.cumsum(leg)])
        kept = [0]
        while kept[-1] < len(path) - 1:
            here = kept[-1]
            there = len(path) - 1
            while there > here + 1:
                free, cost = self.sample(path[here], path[there])
                if free and cost <= so_far[there] - so_far[here] + 1e-9:
                    break
                there = here + max(1, (there - here) * 3 // 4)
            kept.append(there)
        return path[kept]

    def smooth(self, path: Array) -> Array:
        """``path`` sampled evenly, with its corners rounded as far as space permits."""
        leg = np.linalg.norm(np.diff(path, axis=0), axis=1)
        station = np.concatenate([[0], np.cumsum(leg)])
        count = max(3, int(np.ceil(station[-1] / (2 * self.field.spacing))) + 1)
        even = np.linspace(0, station[-1], count)
        points = np.stack([np.interp(even, station, path[:, k]) for k in range(3)], axis=-1)
        for _ in range(12):
            moved = points.copy()
            moved[1:-1] = 0.25 * points[:-2] + 0.5 * points[1:-1] + 0.25 * points[2:]
            value = self.field.value(moved)
            worse = (value < self.demanded(moved)) & (value < self.field.value(points))
            points = np.where(worse[:, None], points, moved)
        return points


class _Graph:
    """Grid ``nodes`` (n, 3) at a spacing of ``step`` m, each connected to its 26 neighbours, and their ``cost`` (n,)
    per metre, at least 1."""

    def __init__(self, nodes: NDArray[np.int64], cost: Array, step: float) -> None:
        size = nodes.max(axis=0) + 3  # a border of one
        strides = np.array([size[1] * size[2], size[2], 1])
        places = (nodes + 1) @ strides
        number = np.full(np.prod(size), len(nodes), np.int32)
        number[places] = np.arange(len(nodes))
        ways = np.array([way for way in product((-1, 0, 1), repeat=3) if any(way)])
        self.step, self.cost = step, np.append(cost, np.inf)
        self._there = number[places[:, None] + ways @ strides]  # the number of a neighbour that is missing is n
        self._half = 0.5 * step * np.linalg.norm(ways, axis=1)

    def costs_from(self, start: NDArray[np.int64], away: ArrayLike) -> Array:
        """The least cost (n,) of a path to each node from a place that is ``away`` m from the nodes ``start``; inf
        where there is none.

        Dijkstra's algorithm in layers: no way to a neighbour is shorter than a step, so all open nodes that are at most
        a step farther than the nearest one are final. SciPy's takes a tenth of a plan's time to import.
        """
        least, is_open = np.full(len(self.cost), np.inf), np.zeros(len(self.cost), bool)
        least[start], is_open[start] = away, True
        while len(known := np.flatnonzero(is_open)):
            costs = least[known]
            layer = known[costs <= costs.min() + self.step]
            is_open[layer] = False
            there, lengths = self._ways(layer)
            reached = least[layer, None] + lengths
            nearer = reached < least[there]
            there = there[nearer]
            np.minimum.at(least, there, reached[nearer])
            is_open[there] = True
        return least[:-1]

    def path_to(self, goal: int, least: Array, starts: Mapping[int, float]) -> list[int]:
        """The nodes of the path to the node ``goal`` with the ``least`` costs from ``starts``: node -> m away."""
        least, path = np.append(least, np.inf), [goal]
        while starts.get(path[-1], np.inf) > least[path[-1]]:
            there, lengths = self._ways(np.array(path[-1]))
            path.append(int(there[(least[there] + lengths).argmin()]))
        return path[::-1]

    def _ways(self, nodes: NDArray[np.int64]) -> tuple[NDArray[np.int32], Array]:
        """The neighbours (..., 26) of ``nodes`` (...), and the costs of the ways there."""
        there = self._there[nodes]
        return there, (self.cost[nodes, None] + self.cost[there]) * self._half
