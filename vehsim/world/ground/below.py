"""The ground below a flying vehicle, over which its rotors need less power: a height in the equations of motion.

The heights of terrain, standing obstacles and calm water become one bicubic spline, so that simulation, planning and
the review of a motion share it and differentiate it exactly.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from vehsim.world.ground.slope import FINEST, KNOTS, ROOM, Relief, box_around, on_terrain

if TYPE_CHECKING:
    from vehsim.vehicles import Vehicle

Array = NDArray[np.float64]

DISC = 5.0
"""Radius of the disc, m, over half of which something must lie to count as ground: that of a light helicopter. Walls
and poles are narrower."""
NOTHING = 50.0
"""Depth below everything else at which the ground lies where there is none, m: no rotor feels it."""
HIGH = 1e4
"""A height above everything, m."""
LEVEL = 1e-6
"""Heights that differ by less, m, are one level."""


def with_ground(vehicle: Vehicle, world: Any, places: ArrayLike | None = None) -> Vehicle:
    """The vehicle with the ground that acts on it: with its weight on slopes if it drives, or above it if it flies. See
    `on_terrain` and `above_ground`."""
    return (above_ground if vehicle.group.dim == 6 else on_terrain)(vehicle, world, places)


def above_ground(vehicle: Vehicle, world: Any, places: ArrayLike | None = None) -> Vehicle:
    """The vehicle with the ground below it, `Holonomic.ground`; unchanged if its rotors do not react on it or the world
    is empty.

    ``places`` (n, 2 or 3) m: where it may come, with `ROOM` around them; None: the whole terrain. With heights, it is
    over what lies below the closest of them, and under the rest; without, over everything.
    """
    if getattr(vehicle, "rotors", None) is None or world is None or vehicle.group.dim != 6:
        return vehicle
    if world.terrain is None and not world.standing and world.water is None:
        return vehicle
    around = None if places is None else np.asarray(places, float)
    box = _box(world, around)
    levels = around if around is not None and around.shape[1] > 2 and _has_levels(world) else None
    key = (*_content(world), box.tobytes(), None if levels is None else levels.tobytes())
    kept = vehicle.__dict__.setdefault("_above_ground", {})
    if key not in kept:
        kept[key] = replace(vehicle, ground=_below(vehicle.group, world, box, levels))  # type: ignore[call-arg]  # rotors belong to a holonomic vehicle
    found: Vehicle = kept[key]
    return found


def above_marks(vehicle: Vehicle, world: Any, positions: Array) -> Vehicle:
    """The vehicle of a plan with marks at ``positions`` (n, 3) m, with the ground below it.

    Of the obstacles, only those below a mark count, so that others may move without another vehicle.
    """
    if world is not None and world.obstacles:
        world = world.with_only([one for one in world.standing if _carries(one, positions)])
    over = world is None or world.terrain is None or world.terrain.surface is None
    return above_ground(vehicle, world, positions[:, :2] if over else positions)


def aloft(vehicle: Vehicle) -> Vehicle:
    """The vehicle far above any ground."""
    if getattr(vehicle, "ground", None) is None:
        return vehicle
    kept = vehicle.__dict__.setdefault("_aloft", [])
    if not kept:
        kept.append(replace(vehicle, ground=None))  # type: ignore[call-arg]  # the ground belongs to a holonomic vehicle
    found: Vehicle = kept[0]
    return found


@dataclass(frozen=True, eq=False)
class Below:
    """Height m of the ground below a body of ``group``, ``g -> m``: of a ``relief``, or the ``level`` m without one.

    With ``cell``, a symbol, it is that height. Plans insert the height at every iterate, and their derivatives leave
    out how it changes from place to place. ``depth``: by how much the ground is lower, m.
    """

    group: Any
    relief: Relief | None
    level: float = 0.0
    cell: Any = None
    depth: Any = 0.0

    CELL = 1

    def place(self, g: Any) -> Any:
        """The body's place (2,) m in the world."""
        return self.group.pose(g)[0:2]

    def __call__(self, g: Any) -> Any:
        if self.cell is not None:
            return self.cell - self.depth
        return (self.level if self.relief is None else self.relief.height(self.place(g))) - self.depth

    def cells(self, count: int) -> Any:
        """A casadi ``Function``, places (2, count) m -> heights (1, count) m; built once per count."""
        if count not in self._cells:
            self._cells[count] = self._heights_at(count)
        return self._cells[count]

    @cached_property
    def _cells(self) -> dict[int, Any]:
        return {}

    def _heights_at(self, count: int) -> Any:
        import casadi as ca

        places = ca.MX.sym("places", 2, count)
        if self.relief is None:
            return ca.Function("heights", [places], [ca.MX(ca.DM.ones(1, count) * self.level)])
        place, cell = ca.SX.sym("place", 2), ca.SX.sym("cell", self.relief.CELL)
        height = ca.Function("height", [place, cell], [self.relief.height(place, cell)])
        return ca.Function("heights", [places], [height.map(count)(places, self.relief.cells(count)(places))])

    def heights(self, places: Array) -> Array:
        """Heights (n,) m at places (n, 2) m."""
        return np.asarray(self.cells(len(places))(np.asarray(places, float).T)).ravel()


def _content(world: Any) -> tuple[Any, ...]:
    parts = (world.terrain, *world.standing)
    level = None if world.water is None else world.water.level
    return (*(None if part is None else part.content_hash for part in parts), level)


def _has_levels(world: Any) -> bool:
    return bool(world.standing) or (world.terrain is not None and world.terrain.surface is not None)


def _carries(obstacle: Any, positions: Array) -> bool:
    """Whether a hull of an obstacle lies below one of the positions (n, 3) m, as far as its box tells."""
    boxes = [(hull.min(axis=0), hull.max(axis=0)) for hull in obstacle.hulls]
    flat, z = positions[:, :2], positions[:, 2]
    return any(
        bool((((low[:2] <= flat) & (flat <= high[:2])).all(axis=1) & (low[2] <= z)).any()) for low, high in boxes
    )


def _box(world: Any, places: Array | None) -> Array:
    """Lower and upper corner (2, 2) m of the region in which the ground is resolved."""
    if world.terrain is not None:
        return box_around(world.terrain.lower[:2], world.terrain.upper[:2], places)
    corners = [
        corner for one in world.standing for hull in one.hulls for corner in (hull.min(axis=0), hull.max(axis=0))
    ]
    if not corners:
        return np.zeros((2, 2))
    edges = np.array(corners)[:, :2]
    lower, upper = edges.min(axis=0) - ROOM, edges.max(axis=0) + ROOM
    return box_around(lower, upper, places)


def _below(group: Any, world: Any, box: Array, places: Array | None) -> Below:
    from vehsim.world.ground.touchdown import height_below

    if not np.ptp(box, axis=0).all():
        return Below(group, None, world.water.level)
    counts = np.clip(np.ceil(np.diff(box, axis=0)[0] / FINEST).astype(int), 4, KNOTS)
    spacing = np.diff(box, axis=0)[0] / counts
    parts = np.ceil(spacing / FINEST - 1e-9).astype(int)  # sampled at least that finely
    at = [box[0, k] + spacing[k] / parts[k] * np.arange(counts[k] * parts[k] + 1) for k in range(2)]
    grid = np.stack(np.meshgrid(*at, indexing="ij"), axis=-1)
    flat = grid.reshape(-1, 2)
    points = np.column_stack([flat, _levels(world, flat, places)])
    heights = height_below(world, points).reshape(grid.shape[:2])
    if world.water is not None:
        heights = np.maximum(heights, world.water.level)
    known = np.isfinite(heights)
    lowest = float((heights[known] if known.any() else points[:, 2]).min())
    heights = np.where(known, heights, lowest - NOTHING)
    if np.ptp(heights) < LEVEL:
        return Below(group, None, float(heights[0, 0]))
    heights = _of_half_a_disc(heights, spacing / parts, parts)
    # as coefficients, heights become a smooth spline that never exceeds them, unlike one through them
    base = float(heights.mean())
    return Below(group, Relief(box[0], spacing, np.pad(heights - base, 1, mode="edge"), base))


def _of_half_a_disc(heights: Array, spacing: Array, every: NDArray[np.int64]) -> Array:
    """The medians of ``heights`` (n, m) m, sampled with a ``spacing`` (2,) m, over a disc about ``every`` (2,) one."""
    reach = [np.arange(-(n := int(DISC / spacing[k])), n + 1) for k in range(2)]
    disc = np.add.outer((reach[0] * spacing[0]) ** 2, (reach[1] * spacing[1]) ** 2) <= DISC**2
    across = [reach[k][place] for k, place in enumerate(np.nonzero(disc))]
    centres = [np.arange(0, heights.shape[k], every[k]) for k in range(2)]
    rows, columns = (
        np.clip(np.add.outer(centres[k], across[k]), 0, heights.shape[k] - 1) for k in range(2)
    )  # beyond the borders, the heights of the borders
    return np.asarray(np.median(heights[rows[:, None], columns[None]], axis=2))


def _levels(world: Any, xy: Array, places: Array | None) -> Array:
    """Heights (n,) m from which the ground is looked for at ``xy`` (n, 2) m: that of the closest place."""
    if places is None:
        return np.full(len(xy), HIGH)
    from scipy.spatial import cKDTree

    return np.asarray(places[cKDTree(places[:, :2]).query(xy)[1], 2])
