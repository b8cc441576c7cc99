"""Gravity along a terrain's slope, for vehicles on wheels: the ground's height as a potential in the equations of
motion.

The heights become one bicubic spline, written as an expression, so that simulation and planning use the same vehicle,
differentiate it exactly and conserve its energy. Coordinates are horizontal: the extra length of a slope, 2 % at ten
degrees, is neglected in the inertia.
"""

from __future__ import annotations

from dataclasses import replace
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
    if terrain is None or not isinstance(vehicle, Nonholonomic) or not vehicle.group.planar:
        return vehicle
    if np.ptp(terrain.heights) < 1e-9:
        return vehicle
    box = _box(terrain, places)
    kept = vehicle.__dict__.setdefault("_on_terrain", {})
    key = (terrain.content_hash, box.tobytes())
    if key not in kept:
        kept[key] = replace(vehicle, potential_energy=_weight(vehicle, terrain, box))
    found: Vehicle = kept[key]
    return found


def _box(terrain: Terrain, places: ArrayLike | None) -> Array:
    """Lower and upper corner (2, 2) m of the region where the slope is resolved, to whole multiples of `ROOM`."""
    lower, upper = terrain.lower[:2], terrain.upper[:2]
    if places is None:
        return np.array([lower, upper])
    at = np.asarray(places, float)[:, :2]
    around = np.array([np.floor(at.min(axis=0) / ROOM - 1) * ROOM, np.ceil(at.max(axis=0) / ROOM + 1) * ROOM])
    box = np.clip(around, lower, upper)
    empty = (np.diff(box, axis=0) < 1.0).any()
    return np.array([lower, upper]) if empty else box


def _weight(vehicle: Any, terrain: Terrain, box: Array) -> Any:
    """``(g, r) -> J``"""
    import casadi as ca

    r, u = ca.DM.zeros(len(vehicle.joints)), ca.SX.zeros(len(vehicle.joints))
    xi = ca.SX.sym("xi", 3)
    mass = float(ca.evalf(ca.hessian(vehicle.reduced_lagrangian(ca.SX(r), u, xi), xi)[0][1, 1]))
    height, own, back = _spline(terrain, box), vehicle.potential_energy, -vehicle.origin

    def potential(g: Any, r: Any) -> Any:
        c, s = ca.cos(g[0]), ca.sin(g[0])
        root = ca.vertcat(g[1] + c * back[0] - s * back[1], g[2] + s * back[0] + c * back[1])
        return mass * GRAVITY * height(root) + (0.0 if own is None else own(g, r))

    return potential


def _spline(terrain: Terrain, box: Array) -> Any:
    """Height as an expression of ``xy`` (2,): the bicubic spline through heights on a grid over ``box``, C2."""
    import casadi as ca
    from scipy.interpolate import make_interp_spline

    counts = [int(np.clip(np.ceil(length / FINEST), 4, KNOTS)) for length in box[1] - box[0]]
    spacing = (box[1] - box[0]) / counts
    at = [box[0, k] + spacing[k] * np.arange(counts[k] + 1) for k in range(2)]
    grid = _averaged(terrain, at, spacing)
    for count in counts:  # level at the borders, where the ground continues level
        knots = np.arange(-3.0, count + 4)
        grid = make_interp_spline(np.arange(count + 1.0), grid, k=3, t=knots, bc_type="clamped").c.T
    base = float(grid.mean())

    def basis(x: Any, count: int) -> Any:
        t = ca.fabs(x - ca.DM(np.arange(-1.0, count + 2)))
        return (ca.fmax(2 - t, 0) ** 3 - 4 * ca.fmax(1 - t, 0) ** 3) / 6

    def height(xy: Any) -> Any:
        u = [ca.fmin(ca.fmax((xy[k] - box[0, k]) / spacing[k], 0), counts[k]) for k in range(2)]
        rows = basis(u[0], counts[0])
        return base + ca.mtimes([rows.T, ca.DM(grid - base), basis(u[1], counts[1])])

    return height


def _averaged(terrain: Terrain, at: list[Array], spacing: Array) -> Array:
    """Mean heights (nx, ny) around the grid points, so that heights between them count."""
    offsets = np.array([-0.375, -0.125, 0.125, 0.375])
    x = at[0][:, None, None, None] + spacing[0] * offsets[:, None]
    y = at[1][None, :, None, None] + spacing[1] * offsets
    points = np.stack(np.broadcast_arrays(x, y), axis=-1)
    heights = terrain.height(points.reshape(-1, 2)).reshape(points.shape[:-1])
    return np.asarray(heights.mean(axis=(2, 3)))
