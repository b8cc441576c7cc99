"""The continuous equations of motion, from the same definition: the reference for the discrete motion."""

from __future__ import annotations

import math
from functools import lru_cache

import casadi as ca
import numpy as np

from vehsim.integrators.discrete import DiscreteMechanics
from vehsim.vehicles import Vehicle
from vehsim.vehicles.definition.base import Array
from vehsim.vehicles.definition.mechanics import acceleration, free_velocity


@lru_cache(maxsize=32)
def equations_of_motion(vehicle: Vehicle) -> ca.Function:
    """``(g, r, z, c, c_rate, wind) -> (g_dot, r_dot, z_dot)`` with ``z`` the free velocity at an instant.

    ``c_rate``: time derivative of the controls, which matters for rate controls only.
    """
    m = DiscreteMechanics(vehicle)
    y = m.symbols
    g, r, z, c, wind = y["g"], y["r"], y["z"], y["c0"], y["wind"]
    c_rate = ca.SX.sym("c_rate", c.shape[0])
    u, xi = free_velocity(vehicle, r, z, m.driven(c))
    z_dot = acceleration(vehicle, g, r, z, c, c_rate, wind)
    group = vehicle.group
    t = ca.SX.sym("t")
    flow = ca.substitute([ca.jacobian(group.compose(g, group.exp(t * xi)), t)], [t], [ca.SX.zeros(1)])[0]
    return ca.Function("equations_of_motion", [g, r, z, c, c_rate, wind], [flow, u, z_dot])


def execute(
    vehicle: Vehicle, g: Array, r: Array, z: Array, controls: Array, steps: Array, wind: Array, fine: int = 16
) -> tuple[Array, Array]:
    """Execute knot controls (n, c), linear between knots, with RK4 and at least ``fine`` steps per segment: more where
    the vehicle's `largest_step` requires it, as longer steps would be unstable.

    ``steps`` (n - 1,) s. Starts from ``g, r`` and the free velocity ``z``. Returns group coordinates (n, size) and
    joints (n, s) at the knots, to compare a plan with the actual effect of its controls.
    """
    segment = _rk4_segment(vehicle, max(fine, math.ceil(float(steps.max()) / vehicle.largest_step - 1e-9)))
    sizes = [len(g), len(r), len(z)]
    x = np.concatenate([g, r, z])
    n = len(steps)
    states = segment.mapaccum(n)(x, controls[:-1].T, controls[1:].T, steps[None], np.tile(wind[:, None], n))
    rows = np.vstack([x, np.asarray(states).T])
    return rows[:, : sizes[0]], rows[:, sizes[0] : sizes[0] + sizes[1]]


@lru_cache(maxsize=32)
def _rk4_segment(vehicle: Vehicle, fine: int) -> ca.Function:
    law = equations_of_motion(vehicle)
    sizes = [law.size1_in(i) for i in range(4)]
    x = ca.MX.sym("x", sum(sizes[:3]))
    c0, c1, h, wind = ca.MX.sym("c0", sizes[3]), ca.MX.sym("c1", sizes[3]), ca.MX.sym("h"), ca.MX.sym("wind", 3)
    cuts = [0, *(int(k) for k in np.cumsum(sizes[:3]))]

    def slope(x: ca.MX, fraction: float) -> ca.MX:
        parts = ca.vertsplit(x, cuts)
        return h * ca.vertcat(*law(*parts, c0 + fraction * (c1 - c0), (c1 - c0) / h, wind))

    end = x
    for k in range(fine):
        s, half, next_ = k / fine, (k + 0.5) / fine, (k + 1) / fine
        k1 = slope(end, s) / fine
        k2 = slope(end + k1 / 2, half) / fine
        k3 = slope(end + k2 / 2, half) / fine
        k4 = slope(end + k3, next_) / fine
        end = end + (k1 + 2 * k2 + 2 * k3 + k4) / 6
    return ca.Function("rk4", [x, c0, c1, h, wind], [end])
