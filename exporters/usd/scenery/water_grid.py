"""The grid of a shot's water: fine around the vehicles' paths, coarser towards the horizon, fixed in the world.

Its rows are closed curves around a line along the paths: each at one distance from it, with evenly spaced points. Where
points come closer along a row than the grid is fine there, the next row has half as many.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from vehsim.exporters.usd.scenery.wake import clip_places

if TYPE_CHECKING:
    from vehsim.clip.clip import Clip
    from vehsim.delivery.take import Take

Array = NDArray[np.float64]
Indices = NDArray[np.int64]

BYTES_A_SECOND = 1e7
"""Bytes per second of motion: 100 MB for ten seconds, at any frame rate."""
BYTES_A_POINT = 12 + 6 + 2 + 2
"""Bytes per point: points in float, normals, foam and `LOWERED` in half precision."""
MOST_POINTS = 20_000
FINEST = 0.2
"""Smallest side of a cell around the paths, m."""
FINE_BORDER = 6.0
"""Margin of the fine grid around the vehicles' paths and the nearest cameras, m."""
SEEN = 30.0
"""Cameras closer than this to a path extend the fine grid, m."""
HORIZON, BEYOND, WIDER = 1500.0, 6000.0, 2.5
"""Distance up to which cells grow evenly beyond the fine grid, m, that of the surface's edge, and how many times longer
rows between the two are than the row before. Seen from a mast, a nearer edge is below the horizon, and tilted."""
GROWTH = 0.05
"""Side of a cell along its row, per metre beyond the fine grid: a sea of 2 m keeps 98 % of its height up to 150 m from
the boat."""
ACROSS = 1.3
"""Far cells are longer across their rows than along them by up to this: from low above the water, they look shorter."""


@dataclass(frozen=True)
class Grid:
    """Points in closed rows around the line of half length ``half`` m through ``origin`` (2,) along ``axes[0]``.

    ``distances`` (rows,) m from the line; ``counts`` (rows,): points of each row, each equal to or half of the one
    before. The first row is the line itself, whose two sides share their points.
    """

    half: float
    distances: Array
    counts: Indices
    origin: Array
    axes: Array

    @cached_property
    def stored(self) -> Indices:
        """Points (rows,) that the mesh has of each row."""
        stored = self.counts.copy()
        stored[0] = self.counts[0] // 2 + 1
        return stored

    @cached_property
    def _local(self) -> tuple[Array, Array]:
        """Places (n, 2) m along ``axes``, and directions (n, 2) of the rows there."""
        places, along = [], []
        for distance, count, stored in zip(self.distances, self.counts, self.stored, strict=True):
            place, direction = _around(self.half, float(distance), np.arange(stored) / count)
            places.append(place)
            along.append(direction)
        return np.concatenate(places), np.concatenate(along)

    @cached_property
    def xy(self) -> Array:
        """(n, 2) m, row after row."""
        return np.asarray(self.origin + self._local[0] @ self.axes)

    @cached_property
    def steps(self) -> tuple[Array, Array]:
        """The way (n, 2) m to the next point of the row, and that to the next row."""
        length = (4 * self.half + 2 * np.pi * self.distances) / self.counts
        along = self._local[1] @ self.axes
        outwards = np.column_stack([along[:, 1], -along[:, 0]])
        return along * self._by_row(length), outwards * self._by_row(np.gradient(self.distances))

    def _by_row(self, values: Array) -> Array:
        return np.repeat(values, self.stored)[:, None]

    @cached_property
    def cells(self) -> Array:
        """The longer side (n,) m of the cell about each point."""
        return np.maximum(*(np.linalg.norm(step, axis=1) for step in self.steps))

    @cached_property
    def triangles(self) -> Indices:
        """(m, 3) corners, counter-clockwise from above."""
        return np.concatenate([self.faces[0][:, [0, 1, 2]], self.faces[0][:, [0, 2, 3]], self.faces[1]])

    @cached_property
    def faces(self) -> tuple[Indices, Indices]:
        """Corners of the cells (m, 4), and of the triangles (k, 3) where rows get coarser, counter-clockwise from
        above."""
        quads, triangles = [], []
        first = np.concatenate([[0], np.cumsum(self.stored)])
        for row, (count, after) in enumerate(zip(self.counts[:-1], self.counts[1:], strict=True)):
            here = first[row] + _in_row(np.arange(count + 1), self.stored[row], row)
            there = first[row + 1] + np.arange(after + 1) % after
            if after == count:
                quads.append(np.column_stack([here[:-1], there[:-1], there[1:], here[1:]]))
                continue
            left, middle, right = here[:-1:2], here[1::2], here[2::2]
            triangles += [
                np.column_stack([left, there[:-1], middle]),
                np.column_stack([middle, there[:-1], there[1:]]),
                np.column_stack([middle, there[1:], right]),
            ]
        none = np.zeros((0, 3), int)
        return np.concatenate(quads), np.concatenate([none, *triangles])

    @cached_property
    def _corners(self) -> Indices:
        """First, second and third corners (3, m) of the triangles."""
        return np.ascontiguousarray(self.triangles.T)

    @cached_property
    def _gather(self) -> Any:
        """Sums (points, triangles) what triangles give to their corners."""
        from scipy.sparse import csr_array

        corners = self.triangles
        ones = np.ones(corners.size)
        return csr_array((ones, (corners.ravel(), np.arange(corners.size) // 3)), shape=(len(self.xy), len(corners)))

    def normals(self, points: Array) -> Array:
        """Unit normals (n, 3) of points (n, 3) that the grid moved to: of the faces around each, by their areas."""
        columns = np.ascontiguousarray(points.T)
        a, b, c = (columns[:, corner] for corner in self._corners)
        (ux, uy, uz), (vx, vy, vz) = b - a, c - a  # np.cross takes twice as long
        normals = self._gather @ np.column_stack([uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx])
        return np.asarray(normals / np.linalg.norm(normals, axis=1, keepdims=True))


@dataclass(frozen=True)
class Net:
    """A regular net of rows and columns over the points of a grid, for pictures.

    Every row has as many places as the first, there and back, and the first place again at its end. Each place lies
    between two points, ``low`` and ``high`` (rows, columns), of which the second has the weight ``share``.
    """

    low: Indices
    high: Indices
    share: Array

    @classmethod
    def over(cls, stored: Indices) -> Net:
        """The net over rows of ``stored`` (rows,) points: see `Grid.stored`."""
        columns = 2 * (int(stored[0]) - 1)
        first = np.concatenate([[0], np.cumsum(stored)])
        low, high = np.empty((2, len(stored), columns + 1), int)
        share = np.empty(low.shape)
        for row, count in enumerate(stored.tolist()):
            step = columns // (columns if row == 0 else count)
            index, left = np.divmod(np.arange(columns + 1)[::-1], step)
            low[row], high[row] = (first[row] + _in_row(index + k, count, row) for k in (0, 1))
            share[row] = left / step
        return cls(low, high, share)

    @property
    def shape(self) -> tuple[int, int]:
        rows, columns = self.low.shape
        return rows, columns

    def of(self, values: Array) -> Array:
        """Values (n, ...) of the grid's points on the net (rows * columns, ...)."""
        share = self.share.reshape(-1, *[1] * (values.ndim - 1))
        return np.asarray((1 - share) * values[self.low.ravel()] + share * values[self.high.ravel()])

    @property
    def triangles(self) -> Indices:
        """(m, 3) corners among the places of the net, counter-clockwise from above."""
        index = np.arange(self.low.size).reshape(self.shape)
        near, far = index[:-1], index[1:]
        quads = np.stack([near[:, :-1], near[:, 1:], far[:, 1:], far[:, :-1]], axis=-1).reshape(-1, 4)
        return np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]])


def _in_row(index: Indices, stored: int, row: int) -> Indices:
    """Which of a row's ``stored`` points is the ``index``-th around it: along the line, there and back."""
    return np.minimum(index, 2 * (stored - 1) - index) if row == 0 else index % stored


def _around(half: float, distance: float, share: Array) -> tuple[Array, Array]:
    """Places (n, 2) m at ``share`` (n,) of the way around the curve at ``distance`` m from the line between (-``half``,
    0) and (``half``, 0), counter-clockwise from its tip on X, and the directions (n, 2) of the curve there."""
    quarter = np.pi / 2 * distance
    way = share * 4 * (half + quarter)
    upper = way <= 2 * (half + quarter)
    way = np.where(upper, way, 4 * (half + quarter) - way)  # the lower side mirrors the upper one
    straight = np.clip(way - quarter, 0.0, 2 * half)
    turn = (way - straight) / distance if distance > 0 else np.where(way < half, 0.0, np.pi)
    turn = np.where((straight > 0) & (straight < 2 * half), np.pi / 2, turn)
    place = np.column_stack([half - straight + distance * np.cos(turn), distance * np.sin(turn)])
    along = np.column_stack([-np.sin(turn), np.cos(turn)])
    sign = np.where(upper, 1.0, -1.0)[:, None]
    return place * np.column_stack([np.ones(len(share)), sign]), along * np.column_stack([sign, np.ones(len(share))])


def lay_grid(take: Take) -> Grid:
    """A grid around the vehicles' paths and the cameras close to them.

    It is as fine for many vehicles as for the one among them whose path needs most points, and has at most as many
    times more points as there are vehicles.
    """
    paths = [_on_take(clip, take) for clip in take.clips.values()] or [np.zeros((1, 2))]
    eyes = [camera.positions[:: max(1, len(camera.positions) // 50), :2] for camera in take.cameras]
    count = most_points(float(take.fps))
    cell = FINEST
    for path in paths if len(paths) > 1 else []:
        cell = max(cell, _finest(*_box([path], eyes), FINEST, count)[0])
    return _finest(*_box(paths, eyes), cell, count * len(paths))[1]


def most_points(fps: float) -> int:
    """The largest number of points for one vehicle, at ``fps`` frames per second."""
    return min(MOST_POINTS, int(BYTES_A_SECOND / BYTES_A_POINT / fps))


def longest_way(cell: float, fps: float) -> float:
    """The length m of the longest straight way of one vehicle along which cells are at most ``cell`` m; 0 if none."""
    axes, low, high = np.eye(2), 0.0, HORIZON
    if cell < FINEST:
        return 0.0
    while high - low > 1.0:
        middle = (low + high) / 2
        sides = np.array([middle / 2 + FINE_BORDER, FINE_BORDER])
        fits = _laid(sides, cell, np.zeros(2), axes).stored.sum() <= most_points(fps)
        low, high = (middle, high) if fits else (low, middle)
    return low


def covers(grid: Grid, take: Take) -> bool:
    """Whether a grid that was laid for other motion is fine along the paths of a take too."""
    steps = np.diff(grid.distances)
    reach = grid.distances[1:][steps < 1.5 * steps[0]].max()
    for clip in take.clips.values():
        along, across = np.abs((_on_take(clip, take) - grid.origin) @ grid.axes.T).T
        if (np.hypot(np.maximum(along - grid.half, 0.0), across) > reach).any():
            return False
    return True


def _box(paths: list[Array], eyes: list[Array]) -> tuple[Array, Array, Array]:
    """Half sides (2,) m, the longer one first, centre (2,) m and axes (2, 2) of a box around paths and near eyes."""
    path = np.concatenate(paths)
    some = path[:: max(1, len(path) // 50)]
    near = [eye for eye in eyes if np.linalg.norm(eye[:, None] - some, axis=2).min() < SEEN]
    middle = path.mean(axis=0)
    spread = np.linalg.svd(path - middle, full_matrices=False)[2][0] if np.ptp(path) > 1.0 else np.array([1.0, 0.0])
    axes = np.array([spread, [-spread[1], spread[0]]])
    local = (np.concatenate([path, *near]) - middle) @ axes.T
    low, high = local.min(axis=0) - FINE_BORDER, local.max(axis=0) + FINE_BORDER
    centre, sides = middle + (low + high) / 2 @ axes, (high - low) / 2
    if sides[1] > sides[0]:
        axes, sides = np.array([axes[1], -axes[0]]), sides[::-1]
    return sides, centre, axes


def _finest(sides: Array, centre: Array, axes: Array, cell: float, count: int) -> tuple[float, Grid]:
    """The cell m, and the grid of it, with at most ``count`` points and cells of at least ``cell`` m."""
    while True:
        grid = _laid(sides, cell, centre, axes)
        if grid.stored.sum() <= count:
            return cell, grid
        cell *= 1.04


def _laid(sides: Array, cell: float, origin: Array, axes: Array) -> Grid:
    """A grid with cells of ``cell`` m over the box of half ``sides`` (2,) m, the longer one first."""
    half = float(sides[0] - sides[1] / 2)
    reach = float(np.hypot(sides[0] - half, sides[1]))  # of the rows that cover the box
    count = 16 * int(np.ceil((4 * half + np.pi * reach) / cell / 16))  # halfway to those rows, cells are square
    distances: list[float] = np.linspace(0.0, reach, int(np.ceil(reach / cell)) + 1).tolist()
    counts = [count] * len(distances)
    while distances[-1] < reach + HORIZON:
        wanted = cell + GROWTH * (distances[-1] - reach)
        around = 4 * half + 2 * np.pi * distances[-1]
        close = around / counts[-1] < wanted / 1.4 and counts[-1] % 4 == 0
        counts.append(counts[-1] // 2 if close else counts[-1])
        further = wanted * (1 + (ACROSS - 1) * min(1.0, (distances[-1] - reach) / reach))
        distances.append(distances[-1] + further)
    while distances[-1] < reach + BEYOND:
        counts.append(counts[-1])
        distances.append(distances[-1] + WIDER * (distances[-1] - distances[-2]))
    return Grid(half, np.array(distances), np.array(counts), origin, axes)


def _on_take(clip: Clip, take: Take) -> Array:
    frames = np.arange(take.frames[0], take.frames[1] + 1, dtype=float)
    return clip_places(clip, frames)[0][:, :2]
