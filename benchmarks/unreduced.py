"""The unreduced nonholonomic scheme of NH eq. 7 and 9, in coordinates ``q = (theta, x, y, r)``, for comparison.

Midpoint discrete Lagrangian, constraints at the midpoint, variations at the knots, no group structure: the reference
for reduction. On SE(2) only; controls enter averaged, as in NH.
"""

from __future__ import annotations

from typing import Any

import casadi as ca
import numpy as np

from vehsim.errors import InputError, SolveError
from vehsim.vehicles import Vehicle
from vehsim.vehicles.definition.base import Array
from vehsim.vehicles.definition.mechanics import coefficients, driven_rates, free_size, free_velocity


def unreduced_rollout(vehicle: Vehicle, q: Array, v: Array, controls: Array, step: float) -> Array:
    """Coordinates (n + 1, 3 + s) from ``q`` and knot velocity ``v`` (3 + s,) under knot controls (n + 1, c)."""
    if not vehicle.group.planar:
        raise InputError(f"moves on {vehicle.group}", "the unreduced scheme is written for SE2", subject=vehicle.name)
    solve = _step(vehicle, step)
    rows, momentum = [np.asarray(q, float)], np.asarray(_momentum(vehicle)(q, v), float).ravel()
    z = np.asarray(_free(vehicle)(q, v), float).ravel()
    for k in range(len(controls) - 1):
        for _ in range(30):
            z1, q1, after, change = (
                np.asarray(x, float).ravel() for x in solve(rows[-1], momentum, z, controls[k], controls[k + 1])
            )
            z = z1
            if not change > 1e-13:
                break
        if not np.all(np.isfinite(q1)) or change > 1e-8:
            raise SolveError(
                f"unreduced step {k} of {step:.6g} s did not converge", "take a smaller step", subject=vehicle.name
            )
        rows.append(q1)
        momentum = after
    return np.array(rows)


def _pieces(q: Any, v: Any) -> tuple[Any, Any]:
    """Joint part and body velocity of coordinates' velocity ``v``."""
    c, s = ca.cos(q[0]), ca.sin(q[0])
    return v[3:], ca.vertcat(v[0], c * v[1] + s * v[2], -s * v[1] + c * v[2])


def _admissible(vehicle: Vehicle, q: Any, z: Any, driven: Any) -> Any:
    """Velocity of the coordinates for a free velocity ``z`` at ``q``."""
    u, xi = free_velocity(vehicle, q[3:], z, driven)
    c, s = ca.cos(q[0]), ca.sin(q[0])
    return ca.vertcat(xi[0], c * xi[1] - s * xi[2], s * xi[1] + c * xi[2], u)


def _restricted(vehicle: Vehicle, q: Any, covector: Any) -> Any:
    """A covector on the coordinates restricted to the admissible velocities at ``q``."""
    z = ca.SX.sym("z", free_size(vehicle))
    motion = _admissible(vehicle, q, z, ca.SX.zeros(len(vehicle.joints)))
    return ca.substitute(ca.jacobian(motion, z), z, ca.SX.zeros(z.shape[0])).T @ covector


def _lagrangian(vehicle: Vehicle, q: Any, v: Any) -> Any:
    u, xi = _pieces(q, v)
    return vehicle.reduced_lagrangian(q[3:], u, xi) - vehicle.potential(q[:3], q[3:])


def _momentum(vehicle: Vehicle) -> ca.Function:
    q, v = ca.SX.sym("q", 3 + len(vehicle.joints)), ca.SX.sym("v", 3 + len(vehicle.joints))
    p = ca.gradient(_lagrangian(vehicle, q, v), v)
    return ca.Function("p", [q, v], [_restricted(vehicle, q, p)])


def _free(vehicle: Vehicle) -> ca.Function:
    q, v = ca.SX.sym("q", 3 + len(vehicle.joints)), ca.SX.sym("v", 3 + len(vehicle.joints))
    return ca.Function("z", [q, v], [coefficients(vehicle, q[3:], *_pieces(q, v))])


def _step(vehicle: Vehicle, h: float) -> ca.Function:
    """``(q0, p0, z, c0, c1) -> (z + dz, q1, p1, |dz|)``: one Newton iteration on ``z`` and the mid coordinates."""
    n = 3 + len(vehicle.joints)
    q0, z = ca.SX.sym("q0", n), ca.SX.sym("z", free_size(vehicle))
    p0, c0, c1 = (
        ca.SX.sym("p0", z.shape[0]),
        ca.SX.sym("c0", len(vehicle.controls)),
        ca.SX.sym("c1", len(vehicle.controls)),
    )
    driven, wind = driven_rates(vehicle, (c0 + c1) / 2), ca.SX.zeros(3)
    middle = q0
    for _ in range(12):  # the midpoint that follows from its own admissible velocity
        middle = q0 + h / 2 * _admissible(vehicle, middle, z, driven)
    v = _admissible(vehicle, middle, z, driven)
    q1 = q0 + h * v

    q_, v_ = ca.SX.sym("q_", n), ca.SX.sym("v_", n)
    lagrangian = _lagrangian(vehicle, q_, v_)
    dq, dv = ca.substitute([ca.gradient(lagrangian, q_), ca.gradient(lagrangian, v_)], [q_, v_], [middle, v])
    u, xi = _pieces(middle, v)
    joint, body = vehicle.force(middle[:3], middle[3:], u, xi, (c0 + c1) / 2, wind)
    c, s = ca.cos(middle[0]), ca.sin(middle[0])
    force = ca.vertcat(body[0], c * body[1] - s * body[2], s * body[1] + c * body[2], joint)
    before, after = dv - h / 2 * (dq + force), dv + h / 2 * (dq + force)
    gap = _restricted(vehicle, q0, before) - p0
    change = ca.solve(ca.jacobian(gap, z), gap)
    outputs = [z - change, q1, _restricted(vehicle, q1, after), ca.norm_2(change)]
    return ca.Function("unreduced", [q0, p0, z, c0, c1], outputs)
