"""The continuous equations of motion, from the same definition: the reference for the discrete motion."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import lru_cache
from typing import Any

import casadi as ca
import numpy as np

from vehsim.integrators.discrete import DiscreteMechanics
from vehsim.integrators.fast.kernel import Kernel
from vehsim.vehicles import Vehicle
from vehsim.vehicles.definition.base import Array
from vehsim.vehicles.definition.mechanics import acceleration, free_velocity
from vehsim.vehicles.definition.resistance import in_pieces, speeds_of


@lru_cache(maxsize=32)
def equations_of_motion(vehicle: Vehicle) -> ca.Function:
    """``(g, r, z, c, c_rate, wind) -> (g_dot, r_dot, z_dot)`` with ``z`` the free velocity at an instant.

    ``c_rate``: time derivative of the controls, which matters for rate controls only.
    """
    return _equations(vehicle, [])


@lru_cache(maxsize=32)
def local_equations(vehicle: Vehicle) -> tuple[ca.Function, Any]:
    """The same with one more input, the cell of the ground's relief at ``g``, and the law that finds it with ``place``
    and ``cells``; None, and no such input, for a vehicle without relief.

    Everywhere at once, the relief needs twenty times as many operations as the rest.
    """
    own: Any = vehicle  # only some vehicles have these fields
    for name in ("potential_energy", "ground"):
        law: Any = getattr(own, name, None)
        if getattr(law, "relief", None) is not None:
            cell = ca.SX.sym("cell", law.CELL)
            return _equations(replace(own, **{name: replace(law, cell=cell)}), [cell]), law
    return equations_of_motion(vehicle), None


def _equations(vehicle: Vehicle, more: list[ca.SX]) -> ca.Function:
    m = DiscreteMechanics(vehicle)
    y = m.symbols
    g, r, z, c, wind = y["g"], y["r"], y["z"], y["c0"], y["wind"]
    c_rate = ca.SX.sym("c_rate", c.shape[0])
    u, xi = free_velocity(vehicle, r, z, m.driven(c))
    z_dot = acceleration(vehicle, g, r, z, c, c_rate, wind)
    group = vehicle.group
    t = ca.SX.sym("t")
    flow = ca.substitute([ca.jacobian(group.compose(g, group.exp(t * xi)), t)], [t], [ca.SX.zeros(1)])[0]
    return ca.Function("equations_of_motion", [g, r, z, c, c_rate, wind, *more], [flow, u, z_dot])


def execute(
    vehicle: Vehicle, g: Array, r: Array, z: Array, controls: Array, steps: Array, wind: Array, fine: int = 16
) -> tuple[Array, Array]:
    """Execute knot controls (n, c), linear between knots, with RK4 and at least ``fine`` steps per segment: more where
    the vehicle's `largest_step` requires it, as longer steps would be unstable.

    ``steps`` (n - 1,) s. Starts from ``g, r`` and the free velocity ``z``. Returns group coordinates (n, size) and
    joints (n, s) at the knots, to compare a plan with the actual effect of its controls.
    """
    fine = max(fine, math.ceil(float(steps.max()) / vehicle.largest_step - 1e-9))
    sizes, count = [len(g), len(r), len(z)], fine * len(steps)
    share = np.linspace(0.0, 1.0, fine + 1)[:, None]
    fractions = controls[:-1, None] + share * np.diff(controls, axis=0)[:, None]
    ends = (np.ascontiguousarray(fractions[:, k : fine + k].reshape(count, -1)) for k in (0, 1))
    lengths, states = np.repeat(steps / fine, fine)[:, None], np.empty((count + 1, sum(sizes)))
    states[0] = np.concatenate([g, r, z])
    inputs = [states[:-1], *ends, lengths, np.broadcast_to(np.asarray(wind, float), (count, 3))]
    _rk4_step(vehicle).rows(inputs, [states[1:]], carries=True)
    rows = states[::fine]
    return rows[:, : sizes[0]], rows[:, sizes[0] : sizes[0] + sizes[1]]


@lru_cache(maxsize=32)
def _rk4_step(vehicle: Vehicle) -> Kernel:
    """``(x, c0, c1, h, wind) -> x``: one step of RK4 with ``x = (g, r, z)`` and controls linear in time."""
    law, ground = local_equations(vehicle)
    kind: Any = ca.SX if ground is None else ca.MX  # in SX, a relief cannot be looked up
    pieces, within = in_pieces(vehicle)
    if pieces.numel():
        law = _equations(within, [pieces])
    sizes = [law.size1_in(i) for i in range(4)]
    x, c0, c1 = (kind.sym("x", n) for n in (sum(sizes[:3]), sizes[3], sizes[3]))
    h, wind = kind.sym("h"), kind.sym("wind", 3)
    cuts, rate = [0, *(int(k) for k in np.cumsum(sizes[:3]))], (c1 - c0) / h
    if ground is not None:
        g = ca.SX.sym("g", sizes[0])
        place, cells = ca.Function("place", [g], [ground.place(g)]), ground.cells(1)

    def slope(x: Any, c: Any) -> Any:
        state = ca.vertsplit(x, cuts)
        more = [] if ground is None else [cells(place(state[0]))]
        if pieces.numel():
            speeds, curves = speeds_of(vehicle, (state[0], state[2])).T, vehicle.resistance.curves  # type: ignore[attr-defined]  # a holonomic vehicle has it
            more = [ca.vec(curves.pieces_at(speeds.shape[1])(speeds))]
        return h * ca.vertcat(*law(*state, c, rate, wind, *more))

    k1 = slope(x, c0)
    k2 = slope(x + k1 / 2, (c0 + c1) / 2)
    k3 = slope(x + k2 / 2, (c0 + c1) / 2)
    k4 = slope(x + k3, c1)
    return Kernel(ca.Function("rk4", [x, c0, c1, h, wind], [x + (k1 + 2 * k2 + 2 * k3 + k4) / 6]))
