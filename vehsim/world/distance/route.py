"""A path through free space: the planner's initial guess for a flight.

Dijkstra's shortest path over the distance field's grid, where passing close to rock costs more than its length; then
straightened where that costs less, and smoothed. It is a path, not a motion, and does not know the vehicle.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import pairwise, product
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from vehsim.errors import InputError, SolveError
from vehsim.world.distance.field import DistanceField

Array = NDArray[np.float64]

NODES = 400_000
"""Largest number of grid points in a search: a larger grid is thinned."""
FEW = 30_000
"""Number of grid points that are searched at once."""
CORRIDOR = 1.25
"""Largest cost of a path in the corridor of a large grid, over the least that it could be."""
SHY = 4.0
"""At the clearance limit, a metre costs 1 + SHY times as much as in the open."""
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
) -> Array:
    """A path (k, 3) m from ``start`` to ``goal`` (3,) m that keeps ``clearance`` m from the rock of ``field``.

    Near an end that is closer to the rock, the path keeps only the clearance of that end. ``ceiling`` m bounds the
    height; if None, the lowest of `LIFTS` with a path is used. ``height`` (xy -> m) is used to explain errors. Raises
    ``InputError`` if an end is in the rock, ``SolveError`` if there is no path.
    """
    ends = np.stack([_point("start", start), _point("goal", goal)])
    if field is None or np.ptp(ends, axis=0).max() == 0:
        return ends
    for name, end in zip(("start", "goal"), ends, strict=True):
        check_free(field, name, end, clearance, ceiling, height)
    highest = float(ends[:, 2].max())
    ceilings = [highest + lift for lift in LIFTS] if ceiling is None else [ceiling]
    search = _Search(field, ends, clearance)
    for bound in ceilings:
        path = search.shortest(bound)
        if path is not None:
            return search.smooth(search.pull(path), bound)
    remedy = "lower the clearance" if ceiling is None else "raise the ceiling or lower the clearance"
    below = "" if ceiling is None else f" below z = {ceiling:g} m"
    message = f"no path from {_say(ends[0])} to {_say(ends[1])} with {clearance:g} m clearance{below}"
    raise SolveError(message, remedy, key="route")


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

    def __init__(self, field: DistanceField, ends: Array, clearance: float) -> None:
        self.field, self.ends, self.clearance = field, ends, clearance
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
        return 1 + SHY * np.clip(1 - (distance - self.clearance) / COMFORT, 0, 1) ** 2

    def shortest(self, ceiling: float) -> Array | None:
        """The cheapest path (k, 3) m over the grid below ``ceiling``, with both ends; None if there is none.

        Large grids are searched only in the corridor that a grid of twice the step leaves, unless the path that is
        found there costs so much that another could be cheaper.
        """
        shape = self.distance.shape
        levels = int(np.sum(self.field.lower[2] + self.step * np.arange(shape[2]) <= ceiling + 1e-9))
        if levels == 0:
            return None
        distance = self.distance[:, :, :levels]
        candidates = np.argwhere(distance > -self.step)
        where = self.field.lower + self.step * candidates
        value = distance[tuple(candidates.T)]
        free = value >= self.demanded(where)
        nodes, where, cost = candidates[free], where[free], self.cost(value[free])
        near = [self._reach(end, where) for end in self.ends]
        if min(map(len, near)) == 0:
            return None
        if len(nodes) > FEW:
            inside, most = self._corridor(nodes, where, cost, near)
            if not np.isfinite(most):
                return None
            kept = np.cumsum(inside) - 1
            reached = [kept[each[inside[each]]] for each in near]
            path, length = self._cheapest(nodes[inside], where[inside], cost[inside], reached)
            if length <= most:
                return path
        return self._cheapest(nodes, where, cost, near)[0]

    def _corridor(
        self, nodes: NDArray[np.int64], where: Array, cost: Array, near: Sequence[NDArray[np.int64]]
    ) -> tuple[NDArray[np.bool_], float]:
        """Which nodes (n,) a path may use that costs at most the second result; inf if the ends are not connected.

        Blocks of eight nodes, each as cheap as the cheapest of them, tell the least cost of a path through each.
        """
        shape = tuple(nodes.max(axis=0) // 2 + 1)
        blocks, block = np.unique(np.ravel_multi_index(tuple(nodes.T // 2), shape), return_inverse=True)
        least = np.full(len(blocks), np.inf)
        np.minimum.at(least, block, cost)
        number = np.full(shape, -1)
        number.flat[blocks] = np.arange(len(blocks))
        ends = [np.unique(block[each]) for each in near]
        graph = _graph(_edges(number, least, 2 * self.step), len(blocks), ends, [np.zeros(len(end)) for end in ends])
        through = np.sum(_dijkstra(graph, [len(blocks), len(blocks) + 1]), axis=0)[: len(blocks)]
        most = CORRIDOR * float(through.min())
        return (through <= most + 4 * self.step * (1 + SHY))[block] & np.isfinite(through)[block], most

    def _cheapest(
        self, nodes: NDArray[np.int64], where: Array, cost: Array, near: Sequence[NDArray[np.int64]]
    ) -> tuple[Array | None, float]:
        """The cheapest path over the ``nodes`` (n, 3) at ``where`` (n, 3) m, and its cost; None, inf without one.
        ``near``: the nodes connected to each end."""
        number = np.full(nodes.max(axis=0) + 1, -1)
        number[tuple(nodes.T)] = np.arange(len(nodes))
        away = [np.linalg.norm(where[each] - end, axis=1) for each, end in zip(near, self.ends, strict=True)]
        size = len(nodes) + 2
        graph = _graph(_edges(number, cost, self.step), len(nodes), near, away)
        length, previous = _dijkstra(graph, size - 2, return_predecessors=True)
        if not np.isfinite(length[size - 1]):
            return None, np.inf
        path = [size - 1]
        while path[-1] != size - 2:
            path.append(int(previous[path[-1]]))
        return np.concatenate([where, self.ends])[path[::-1]], float(length[size - 1])

    def _reach(self, end: Array, where: Array) -> NDArray[np.int64]:
        """The nodes connected to an end: those of its cell, or straight below it if it is above the box."""
        inside = np.clip(end, self.field.lower, self.field.upper)
        return np.flatnonzero(np.abs(where - inside).max(axis=1) <= 1.01 * self.step)

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

    def smooth(self, path: Array, ceiling: float) -> Array:
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


def _graph(edges: tuple[list, list, list], count: int, near: Sequence[NDArray[np.int64]], away: Sequence[Array]) -> Any:
    """The graph of ``count`` nodes and two ends after them, which are ``away`` m from the nodes ``near`` them."""
    from scipy.sparse import coo_matrix

    rows, cols, weights = edges
    for k, (reached, length) in enumerate(zip(near, away, strict=True)):
        rows.append(np.full(len(reached), count + k))
        cols.append(reached)
        weights.append(length + 1e-9)
    entries = (np.concatenate(weights), (np.concatenate(rows), np.concatenate(cols)))
    return coo_matrix(entries, shape=(count + 2, count + 2)).tocsr()


def _dijkstra(graph: Any, start: Any, **given: Any) -> Any:
    from scipy.sparse.csgraph import dijkstra

    return dijkstra(graph, directed=False, indices=start, **given)


def _edges(number: NDArray[np.int64], cost: Array, step: float) -> tuple[list, list, list]:
    """The graph's edges between grid neighbours, each once: lists of arrays of rows, columns and weights."""
    rows, cols, weights = [], [], []
    for offset in product((-1, 0, 1), repeat=3):
        if offset <= (0, 0, 0):
            continue
        here = tuple(slice(max(0, -o), n - max(0, o)) for o, n in zip(offset, number.shape, strict=True))
        there = tuple(slice(max(0, o), n - max(0, -o)) for o, n in zip(offset, number.shape, strict=True))
        a, b = number[here].ravel(), number[there].ravel()
        both = (a >= 0) & (b >= 0)
        a, b = a[both], b[both]
        rows.append(a)
        cols.append(b)
        weights.append(0.5 * (cost[a] + cost[b]) * step * np.linalg.norm(offset))
    return rows, cols, weights
