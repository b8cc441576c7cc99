"""Convert public states to the coordinates of the dynamics; energy, momentum and linearisation of one state.

A `State` describes the rig's root. The dynamics use the body frame and the group's own coordinates and velocities.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import casadi as ca
import numpy as np

from vehsim.errors import InputError
from vehsim.lie import SO3, difference_map
from vehsim.vehicles.definition.base import Array, Definition, Expr, State
from vehsim.vehicles.definition.mechanics import (
    acceleration,
    coefficients,
    driven_rates,
    energy,
    free_size,
    free_velocity,
    momentum,
    symbols,
)


def internal(vehicle: Definition, state: State) -> tuple[Array, Array, Array, Array]:
    """``(g, r, u, xi)`` of a public state: group element, joints, joint rates and the group's velocity.

    What is not given follows: joint rates from the twist through the constraints, or the twist from the joint rates.
    Raises ``InputError`` naming the field, its value and the remedy.
    """
    group, s = vehicle.group, len(vehicle.joints)
    orientation = _sized("orientation", state.orientation, 4)
    length = np.linalg.norm(orientation)
    if length < 1e-6:
        raise InputError(
            "has no length", "give a unit quaternion w, x, y, z", key="state.orientation", value=state.orientation
        )
    orientation = orientation / length
    if group.planar and np.hypot(orientation[1], orientation[2]) > 1e-6:
        raise InputError(
            f"tilted, but {vehicle.name} moves in the plane",
            "give a rotation about Z: (cos(yaw/2), 0, 0, sin(yaw/2))",
            key="state.orientation",
            value=state.orientation,
        )
    position = _sized("position", state.position, 3) + SO3.matrix(orientation) @ vehicle.origin
    g = group.from_pose(np.concatenate([position, orientation]))
    r = _sized("joints", state.joints, s)
    twist = _sized("twist", state.twist, group.dim)
    xi = group.velocity_from_body(g, group.shift(twist, vehicle.origin))
    u = _sized("joint_rates", state.joint_rates, s)
    basis, connection = (np.array(m) for m in kept(vehicle, "lift", lambda: _lift(vehicle))(r))
    connection = connection.reshape(len(basis), s)
    if state.joint_rates is None and vehicle.rolling is not None:
        u = flat(kept(vehicle, "rolling", lambda: _rolling(vehicle))(r, group.velocity_to_body(g, xi)))
    elif state.joint_rates is None and s:
        # first the motion with locked joints, then the joint rates that the rest of the twist needs
        rest = xi - basis[: group.dim] @ np.linalg.lstsq(basis[: group.dim], xi, rcond=None)[0]
        u = np.linalg.lstsq(connection[: group.dim], -rest, rcond=None)[0]
    elif state.twist is None and s:
        xi = -(connection @ u)[: group.dim]
    if state.joint_rates is None and vehicle.tied:
        free = np.linalg.lstsq(basis[: group.dim], xi + (connection @ u)[: group.dim], rcond=None)[0]
        u[list(vehicle.tied)] = (basis @ free - connection @ u)[group.dim :]
    return g, r, u, xi


def shift_twist(twist: Expr, offset: Expr) -> Expr:
    """A body twist (3,) or (6,) at the point ``offset`` (3,), in the same axes; unchanged on SO(3)."""
    if twist.shape[0] == 6:
        return ca.vertcat(twist[0:3], twist[3:6] + ca.cross(twist[0:3], ca.DM(offset)))
    return ca.vertcat(twist[0], twist[1] - twist[0] * offset[1], twist[2] + twist[0] * offset[0])


def state_energy(vehicle: Definition, state: State) -> tuple[float, float]:
    """Kinetic and potential energy of a state, J."""

    def build() -> ca.Function:
        g, r, u, xi, _, _ = symbols(vehicle)
        return ca.Function("energy", [g, r, u, xi], [*energy(vehicle, g, r, u, xi)])

    kinetic, potential = kept(vehicle, "energy", build)(*internal(vehicle, state))
    return float(kinetic), float(potential)


def state_momentum(vehicle: Definition, state: State) -> Array:
    """Spatial momentum ``Ad*(g^-1) dl/dxi`` of a state (d,), conserved if all forces have the group's symmetry."""

    def build() -> ca.Function:
        g, r, u, xi, _, _ = symbols(vehicle)
        group = vehicle.group
        return ca.Function("p", [g, r, u, xi], [group.Ad(group.inverse(g)).T @ momentum(vehicle, r, u, xi)[1]])

    return flat(kept(vehicle, "momentum", build)(*internal(vehicle, state)))


def linearize(vehicle: Definition, state: State, controls: Any, wind: Any = (0.0, 0.0, 0.0)) -> tuple[Array, Array]:
    """Matrices ``A`` (n, n) and ``B`` (n, c) of the equations of motion about a state and constant controls (c,).

    ``d/dt delta = A delta + B delta_controls`` with ``delta = (eta, delta r, delta z)``: the displacement ``eta`` (d,)
    that moves ``g`` to ``g exp(eta)``, the joints (s,), and the free velocities (b + s_d,) along the basis and the
    dynamic joints. On SO3xR3 the translational part of ``eta`` and ``z`` is in world axes, on SE3 and SE2 in body axes.
    """

    def build() -> ca.Function:
        g, r, _, _, c, wind = symbols(vehicle)
        group, z = vehicle.group, ca.SX.sym("z", free_size(vehicle))
        eta = ca.SX.sym("eta", group.dim)
        moved = group.compose(g, difference_map("exp", group).tau(eta))
        u, xi = free_velocity(vehicle, r, z, driven_rates(vehicle, c))
        rate = ca.vertcat(xi, u, acceleration(vehicle, moved, r, z, c, ca.SX(c.shape[0], 1), wind))
        x = ca.vertcat(eta, r, z)
        # the frame in which eta is measured moves along: eta' = delta xi - ad(xi) eta
        transport = ca.SX(x.shape[0], x.shape[0])
        transport[: group.dim, : group.dim] = group.ad(xi)
        a, b = ca.substitute([ca.jacobian(rate, x) - transport, ca.jacobian(rate, c)], [eta], [ca.SX.zeros(group.dim)])
        return ca.Function("linear", [g, r, z, c, wind], [ca.densify(a), ca.densify(b)])

    g, r, u, xi = internal(vehicle, state)
    c = control_vector(vehicle, controls)
    z = flat(kept(vehicle, "coefficients", lambda: _coefficients(vehicle))(r, u, xi))
    a, b = kept(vehicle, "linearize", build)(g, r, z, c, np.asarray(wind, float))
    return np.array(a), np.array(b).reshape(a.shape[0], len(c))


def control_vector(vehicle: Definition, controls: Any, name: str = "controls") -> Array:
    """Controls (c,) as an array. Raises ``InputError`` for a wrong number of controls or one that is not finite."""
    array = np.asarray(() if controls is None else controls, float).ravel()
    names = vehicle.control_names
    if array.shape != (len(names),) or not np.all(np.isfinite(array)):
        raise InputError(
            "not one number per control",
            f"give {len(names)} finite numbers: {', '.join(names) or 'none'}",
            key=name,
            value=controls,
        )
    return array


def kept(vehicle: Definition, key: str, build: Callable[[], ca.Function]) -> ca.Function:
    """A function that is built once and kept as long as the vehicle."""
    functions = vehicle.__dict__.setdefault("_functions", {})
    if key not in functions:
        functions[key] = build()
    return functions[key]


def _lift(vehicle: Definition) -> ca.Function:
    """``r -> (basis, connection)``"""
    r = ca.SX.sym("r", len(vehicle.joints))
    return ca.Function("lift", [r], [ca.densify(vehicle.basis(r)), ca.densify(vehicle.connection(r))])


def _rolling(vehicle: Definition) -> ca.Function:
    """``(r, twist) -> u``"""
    assert vehicle.rolling is not None
    r, twist = ca.SX.sym("r", len(vehicle.joints)), ca.SX.sym("twist", vehicle.group.dim)
    return ca.Function("rolling", [r, twist], [ca.densify(vehicle.rolling(r, twist))])


def _coefficients(vehicle: Definition) -> ca.Function:
    """``(r, u, xi) -> z``"""
    _, r, u, xi, _, _ = symbols(vehicle)
    return ca.Function("z", [r, u, xi], [ca.densify(coefficients(vehicle, r, u, xi))])


def _sized(name: str, values: Any, size: int) -> Array:
    try:
        array = np.zeros(size) if values is None else np.asarray(values, float).ravel()
    except (TypeError, ValueError):
        array = np.full(1, np.nan)
    if array.shape != (size,) or not np.all(np.isfinite(array)):
        raise InputError(
            "of the wrong shape or not finite", f"give {size} finite numbers", key=f"state.{name}", value=values
        )
    return array


def flat(values: Any) -> Array:
    """A CasADi column, or an array of that size, as (n,)."""
    return np.asarray(values, float).ravel()
