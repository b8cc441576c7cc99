"""What laws see of a plan's variables: a knot's view, from its state or from a segment's velocity half way along."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import casadi as ca

from vehsim.lie import SO3, difference_map
from vehsim.planning.terms import GRAVITY, KnotView
from vehsim.vehicles import Vehicle
from vehsim.vehicles.mechanics import free_velocity
from vehsim.vehicles.states import shift_twist

if TYPE_CHECKING:
    from vehsim.planning.transcription import Transcription

Expr = Any


def knot_view(t: Transcription, x: Expr, c: Expr, time: Expr = 0.0) -> KnotView:
    """The view of a node state ``x`` with controls ``c`` over their scale."""
    g, r, pi = t.split(x)
    c = c * t.control_scale
    u, xi = t.mechanics.knot_velocity(r, pi, c)
    return _view(t.vehicle, t.vehicle.group.normalize(g), r, u, xi, c, time)


def middle_view(t: Transcription, x: Expr, z: Expr, c: Expr, h: Expr, time: Expr = 0.0) -> KnotView:
    """The view half way along a substep of length ``h``, from its velocity ``z``; ``c``: its mean controls, scaled."""
    vehicle, (g, r, _) = t.vehicle, t.split(x)
    c = c * t.control_scale
    u, xi = free_velocity(vehicle, r, z, t.mechanics.driven(c))
    tau = difference_map(t.mechanics.map_name, vehicle.group).tau
    return _view(vehicle, vehicle.group.compose(g, tau(h / 2 * xi)), r + h / 2 * u, u, xi, c, time)


def root_pose(vehicle: Vehicle, g: Expr) -> Expr:
    """Pose (7,) of the rig's root."""
    pose = vehicle.group.pose(g)
    return ca.vertcat(pose[0:3] - SO3.matrix(pose[3:7]) @ ca.DM(vehicle.origin), pose[3:7])


def _view(vehicle: Vehicle, g: Expr, r: Expr, u: Expr, xi: Expr, c: Expr, time: Expr) -> KnotView:
    root = root_pose(vehicle, g)
    rotation = SO3.matrix(root[3:7])
    twist = vehicle.group.velocity_to_body(g, xi)
    if vehicle.group.fixed:
        omega, body = twist, ca.SX.zeros(3)
    else:
        twist = shift_twist(twist, -vehicle.origin)
        flat = vehicle.group.dim == 3
        omega = ca.vertcat(0, 0, twist[0]) if flat else twist[0:3]
        body = ca.vertcat(twist[1:3], 0) if flat else twist[3:6]
    push, rates = _push(vehicle, g, r, u, xi, c), ca.vertcat(u, xi)
    return KnotView(root[0:3], rotation @ body, omega, rotation, r, u, c, push, rates, ca.SX(time), vehicle.joints)


def _push(vehicle: Vehicle, g: Expr, r: Expr, u: Expr, xi: Expr, c: Expr) -> Expr:
    """Forces of the controls on the joints (s,) and the group (d,) over its weight; rate controls have none."""
    still = ca.SX.zeros(3)
    given = vehicle.force(g, r, u, xi, c, still)
    rest = vehicle.force(g, r, u, xi, ca.SX.zeros(c.shape[0]), still)
    force = ca.vertcat(*(a - b for a, b in zip(given, rest, strict=True)))
    speed = ca.SX.sym("speed")
    along = ca.vertcat(ca.SX.zeros(vehicle.group.dim - 1), speed)
    kinetic = ca.SX(vehicle.reduced_lagrangian(ca.SX.zeros(r.shape[0]), ca.SX.zeros(u.shape[0]), along))
    mass = float(ca.evalf(ca.substitute(ca.hessian(kinetic, speed)[0], speed, 0)))
    return force / (max(mass, 1e-9) * GRAVITY)
