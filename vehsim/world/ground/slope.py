"""Gravity along a terrain's slope, for vehicles on wheels: the ground's height as a potential in the equations of
motion.

The heights become one bicubic spline, written as an expression, so that simulation and planning use the same vehicle,
differentiate it exactly and conserve its energy. Coordinates are horizontal: the extra length of a slope, 2 % at ten
degrees, is neglected in the inertia.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from vehsim.constants import GRAVITY
from vehsim.world.terrain.terrain import Terrain

if TYPE_CHECKING:
    from vehsim.vehicles import Vehicle

Array = NDArray[np.float64]

KNOTS = 56
"""Largest number of knots of the spline along an axis: a box of 140 m is resolved to 2.5 m, the size of a car."""
FINEST = 2.5
"""Smallest distance of knots, m: a vehicle's wheels average shorter features."""
ROOM = 30.0
"""Margin around the given places in which the slope is known, m; beyond it, the ground is level."""


def on_terrain(vehicle: Vehicle, world: Any, places: ArrayLike | None = None) -> Vehicle:
    """The vehicle with its weight on the terrain's slopes; unchanged if it does not drive or the ground is level.

    ``places`` (n, 2 or more) m: where it may come, with `ROOM` around them; None: the whole terrain. Its weight is the
    mass of its translation in the plane, and acts at the rig's root.
    """
    from vehsim.vehicles.definition.nonholonomic import Nonholonomic

    terrain = None if world is None else world.terrain
    if terrain is None or not isinstance(vehicle, Nonholonomic) or not vehicle.rolls:
        return vehicle
    if np.ptp(terrain.heights) < 1e-9:
        return vehicle
    box = box_around(terrain.lower[:2], terrain.upper[:2], places)
    kept = vehicle.__dict__.setdefault("_on_terrain", {})
    key = (terrain.content_hash, box.tobytes())
    if key not in kept:
        kept[key] = replace(vehicle, potential_energy=_weight(vehicle, terrain, box))
    found: Vehicle = kept[key]
    return found


def box_around(lower: Array, upper: Array, places: ArrayLike | None) -> Array:
    """Lower and upper corner (2, 2) m of the region around ``places`` (n, 2 or more) m where heights are resolved, to
    whole multiples of `ROOM`, within given corners (2,) m."""
    if places is None:
        return np.array([lower, upper])
    at = np.asarray(places, float)[:, :2]
    around = np.array([np.floor(at.min(axis=0) / ROOM - 1) * ROOM, np.ceil(at.max(axis=0) / ROOM + 1) * ROOM])
    box = np.clip(around, lower, upper)
    empty = (np.diff(box, axis=0) < 1.0).any()
    return np.array([lower, upper]) if empty else box


@dataclass(frozen=True, eq=False)
class Weight:
    """The potential ``(g, r) -> J`` of ``mass`` kg on the ground's ``relief``, and of the vehicle's ``own`` potential.

    ``root`` (2,) m: the rig's root in the body frame. With ``cell``, symbols of one cell of the relief, the potential
    holds within that cell, and costs a hundredth: see `Relief.cells`.
    """

    mass: float
    relief: Relief
    root: Array
    own: Any = None
    cell: Any = None

    def place(self, g: Any) -> Any:
        """The root's place (2,) m in the world."""
        import casadi as ca

        c, s = ca.cos(g[0]), ca.sin(g[0])
        return ca.vertcat(g[1] + c * self.root[0] - s * self.root[1], g[2] + s * self.root[0] + c * self.root[1])

    @property
    def CELL(self) -> int:
        """Size of a cell."""
        return self.relief.CELL

    def cells(self, count: int) -> Any:
        """See `Relief.cells`."""
        return self.relief.cells(count)

    def __call__(self, g: Any, r: Any) -> Any:
        height = self.relief.height(self.place(g), self.cell)
        return self.mass * GRAVITY * height + (0.0 if self.own is None else self.own(g, r))


def _weight(vehicle: Any, terrain: Terrain, box: Array) -> Weight:
    import casadi as ca

    r, u = ca.DM.zeros(len(vehicle.joints)), ca.SX.zeros(len(vehicle.joints))
    xi = ca.SX.sym("xi", 3)
    mass = float(ca.evalf(ca.hessian(vehicle.reduced_lagrangian(ca.SX(r), u, xi), xi)[0][1, 1]))
    return Weight(mass, relief_of(terrain, box), -vehicle.origin[:2], vehicle.potential_energy)


@dataclass(frozen=True, eq=False)
class Relief:
    """Heights of the ground: a bicubic spline, C2, on a grid from ``lower`` (2,) m; beyond it, the ground is level.

    ``spacing`` (2,) m; ``coefficients`` (nx + 3, ny + 3) m above ``base`` m.
    """

    lower: Array
    spacing: Array
    coefficients: Array
    base: float

    CELL = 18
    """Size of a cell: its place on the grid, and its 16 coefficients."""

    def _index(self, xy: Any) -> list[Any]:
        """The place on the grid, in cells."""
        import casadi as ca

        counts = np.array(self.coefficients.shape) - 3
        return [ca.fmin(ca.fmax((xy[k] - self.lower[k]) / self.spacing[k], 0), counts[k]) for k in range(2)]

    def height(self, xy: Any, cell: Any = None) -> Any:
        """Height m at ``xy`` (2,) m, as an expression; within ``cell`` (18,), or everywhere, which costs much more."""
        import casadi as ca

        index = self._index(xy)
        if cell is not None:
            x, y = (_pieces(index[k] - cell[k]) for k in range(2))
            return self.base + ca.mtimes([x.T, ca.reshape(cell[2:], 4, 4), y])
        x, y = (_basis(index[k], count) for k, count in enumerate(self.coefficients.shape))
        return self.base + ca.mtimes([x.T, ca.DM(self.coefficients), y])

    def slope(self, xy: Any, cell: Any = None) -> Any:
        """Slope (2,) m/m at ``xy`` (2,) m, as an expression; within ``cell`` (18,), or everywhere."""
        import casadi as ca

        at = ca.SX.sym("xy", 2)
        return ca.substitute(ca.gradient(self.height(at, cell), at), at, xy)

    def lift(self, xy: Any, velocity: Any, cell: Any = None) -> Any:
        """Vertical acceleration m/s^2 of what follows the ground at a steady horizontal ``velocity`` (2,) m/s, as an
        expression: below zero on a crest."""
        import casadi as ca

        at = ca.SX.sym("xy", 2)
        bend = ca.substitute(ca.hessian(self.height(at, cell), at)[0], at, xy)
        return ca.bilin(bend, velocity, velocity)

    def followed(self, xy: Array, velocities: Array) -> tuple[Array, Array]:
        """Slopes (n, 2) m/m at places (n, 2) m, and `lift` (n,) m/s^2 at ``velocities`` (n, 2) m/s."""
        import casadi as ca

        at, velocity, cell = ca.SX.sym("xy", 2), ca.SX.sym("velocity", 2), ca.SX.sym("cell", self.CELL)
        laws = [self.slope(at, cell), self.lift(at, velocity, cell)]
        found = ca.Function("followed", [at, velocity, cell], laws).map(len(xy))
        slopes, lifts = found(xy.T, velocities.T, self.cells(len(xy))(xy.T))
        return np.asarray(slopes).T, np.asarray(lifts).ravel()

    def steepest(self, low: Any = (-np.inf, -np.inf), high: Any = (np.inf, np.inf)) -> tuple[float, float]:
        """Upper bounds on the slope, m/m, and on its change, 1/m, between corners ``low`` and ``high`` (2,) m, or
        everywhere: derivatives of a spline are averages of the differences of its coefficients."""
        counts = np.array(self.coefficients.shape) - 3
        ends = [np.clip((np.asarray(end, float) - self.lower) / self.spacing, 0, counts) for end in (low, high)]
        first, last = np.minimum(np.floor(ends[0]), counts - 1).astype(int), np.ceil(ends[1]).astype(int)
        i, j = (slice(a, max(b, a + 1) + 3) for a, b in zip(first, last, strict=True))
        part, (dx, dy) = self.coefficients[i, j], self.spacing
        along = [np.abs(np.diff(part, axis=axis)).max() / step for axis, step in ((0, dx), (1, dy))]
        xx, yy = (np.abs(np.diff(part, 2, axis=axis)).max() / step**2 for axis, step in ((0, dx), (1, dy)))
        xy = np.abs(np.diff(np.diff(part, axis=0), axis=1)).max() / (dx * dy)
        return float(np.hypot(*along)), float(np.linalg.norm([[xx, xy], [xy, yy]], 2))

    @property
    def box(self) -> Array:
        """Lower and upper corner (2, 2) m of the region where heights are resolved."""
        return np.array([self.lower, self.lower + self.spacing * (np.array(self.coefficients.shape) - 3)])

    def cells(self, count: int) -> Any:
        """A casadi ``Function``, places (2, count) m -> the cells that contain them (18, count): constant in a cell, so
        that `height` has exact derivatives there."""
        import casadi as ca

        nx, ny = self.coefficients.shape
        xy = ca.SX.sym("xy", 2)
        first = [ca.fmin(ca.floor(index), n - 4) for index, n in zip(self._index(xy), (nx, ny), strict=True)]
        place = ca.Function("place", [xy], [ca.vertcat(*first), first[0] + nx * first[1]])
        near = ca.MX(ca.DM([i + nx * j for j in range(4) for i in range(4)]))
        places = ca.MX.sym("places", 2, count)
        corners, start = place.map(count)(places)
        table = ca.MX(ca.DM(self.coefficients.ravel(order="F")))
        return ca.Function("cells", [places], [ca.vertcat(corners, table.get_nz(False, near, ca.vec(start)))])


def _basis(index: Any, count: int) -> Any:
    """Values (count,) of all cubic B-splines on the integers from -1."""
    import casadi as ca

    t = ca.fabs(index - ca.DM(np.arange(count) - 1.0))
    return (ca.fmax(2 - t, 0) ** 3 - 4 * ca.fmax(1 - t, 0) ** 3) / 6


def _pieces(u: Any) -> Any:
    """Values (4,) of the four of them that are not zero between 0 and 1."""
    import casadi as ca

    v = 1 - u
    return ca.vertcat(v**3, 4 - 3 * u**2 * (2 - u), 4 - 3 * v**2 * (2 - v), u**3) / 6


def relief_of(terrain: Terrain, box: Array) -> Relief:
    """The relief of a terrain in a box from ``box[0]`` to ``box[1]`` (2,) m."""
    from scipy.interpolate import make_interp_spline

    counts = [int(np.clip(np.ceil(length / FINEST), 4, KNOTS)) for length in box[1] - box[0]]
    spacing = (box[1] - box[0]) / counts
    at = [box[0, k] + spacing[k] * np.arange(counts[k] + 1) for k in range(2)]
    grid = _averaged(terrain, at, spacing)
    for count in counts:  # level at the borders, where the ground continues level
        knots = np.arange(-3.0, count + 4)
        grid = make_interp_spline(np.arange(count + 1.0), grid, k=3, t=knots, bc_type="clamped").c.T
    base = float(grid.mean())
    return Relief(box[0], spacing, grid - base, base)


def _averaged(terrain: Terrain, at: list[Array], spacing: Array) -> Array:
    """Mean heights (nx, ny) around the grid points, so that heights between them count."""
    offsets = np.array([-0.375, -0.125, 0.125, 0.375])
    x = at[0][:, None, None, None] + spacing[0] * offsets[:, None]
    y = at[1][None, :, None, None] + spacing[1] * offsets
    points = np.stack(np.broadcast_arrays(x, y), axis=-1)
    heights = terrain.height(points.reshape(-1, 2)).reshape(points.shape[:-1])
    return np.asarray(heights.mean(axis=(2, 3)))
