"""The simple helicopter of LIE 4.3.1 and SYM III.A, on SO(3) x R^3."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated

import casadi as ca
from annotated_types import Len

from vehsim.lie import SO3xR3
from vehsim.rig.rig import Channel
from vehsim.vehicles.definition.base import Control, Expr
from vehsim.vehicles.definition.holonomic import Holonomic
from vehsim.vehicles.definition.quantities import (
    AngularRate,
    Coordinate,
    JointDamping,
    LinearDamping,
    Mass,
    PrincipalInertia,
    QuadraticDamping,
)


def helicopter(
    name: str = "helicopter",
    *,
    mass: Mass,
    inertia: PrincipalInertia,
    d_t: Coordinate,
    d_r: Coordinate,
    drag_linear: Annotated[Sequence[LinearDamping], Len(3, 3)] = (0.0, 0.0, 0.0),
    drag_quadratic: Annotated[Sequence[QuadraticDamping], Len(3, 3)] = (0.0, 0.0, 0.0),
    drag_angular: Annotated[Sequence[JointDamping], Len(3, 3)] = (0.0, 0.0, 0.0),
    main_rotor_speed: AngularRate = 40.0,
    tail_rotor_speed: AngularRate = 200.0,
) -> Holonomic:
    """A rigid fuselage carried by a tilting thrust and a tail force.

    ``mass`` kg; ``inertia`` (3,) principal, kg m^2; the thrust acts ``d_t`` m above the centre of mass, the tail force
    ``d_r`` m behind it, along -Y. Controls: collective [N], yaw [N], pitch and roll of the rotor disc [rad].
    Drag against the air per body axis: ``drag_linear`` N s/m, ``drag_quadratic`` N s^2/m^2, ``drag_angular`` N m s.
    Rotor speeds in rad/s drive the channels ``main_rotor`` and ``tail_rotor``.
    """

    def wrench(c: Expr) -> Expr:
        """LIE 4.3.1, F(gamma) u."""
        collective, yaw, pitch, roll = c[0], c[1], c[2], c[3]
        thrust = collective * ca.vertcat(ca.sin(pitch) * ca.cos(roll), -ca.sin(roll), ca.cos(pitch) * ca.cos(roll))
        tail = ca.vertcat(0, -yaw, 0)
        torque = ca.cross(ca.vertcat(0, 0, d_t), thrust) + ca.cross(ca.vertcat(-d_r, 0, 0), tail)
        return ca.vertcat(torque, thrust + tail)

    linear, quadratic, angular = (ca.DM(list(map(float, d))) for d in (drag_linear, drag_quadratic, drag_angular))

    def drag(air: Expr) -> Expr:
        # |v| made smooth at rest, so that an optimiser sees a derivative there
        speed = ca.sqrt(ca.dot(air[3:6], air[3:6]) + 1e-6)
        return -ca.vertcat(angular * air[0:3], linear * air[3:6] + quadratic * speed * air[3:6])

    has_drag = any((*drag_linear, *drag_quadratic, *drag_angular))
    return Holonomic(
        name=name,
        group=SO3xR3,
        inertia=(*inertia, mass, mass, mass),
        controls=tuple(Control(n) for n in ("collective", "yaw", "pitch", "roll")),
        wrench=wrench,
        drag=drag if has_drag else None,
        default_costs={"course": 1.0},  # nose first
        channels={
            "main_rotor": Channel(rate=lambda t, r, u, xi, c: main_rotor_speed),
            "tail_rotor": Channel(rate=lambda t, r, u, xi, c: tail_rotor_speed),
        },
    )
