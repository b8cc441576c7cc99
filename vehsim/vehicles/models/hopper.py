"""The hopping robot of SIN Fig. 1 in the air: a body and a leg that swings and stretches, under gravity."""

from __future__ import annotations

import casadi as ca

from vehsim.constants import GRAVITY
from vehsim.lie import SE3, SO3
from vehsim.rig.rig import Channel
from vehsim.vehicles.definition.base import Control, Expr
from vehsim.vehicles.definition.nonholonomic import Nonholonomic
from vehsim.vehicles.definition.quantities import Acceleration, Length, Mass, PrincipalInertia


def hopper(
    name: str = "hopper",
    *,
    mass: Mass,
    inertia: PrincipalInertia,
    foot_mass: Mass,
    leg_length: Length,
    gravity: Acceleration = GRAVITY,
) -> Nonholonomic:
    """A rigid body whose frame stands at its centre of mass, where the leg is hinged about the body's Y axis.

    ``mass`` kg, ``inertia`` (3,) principal, kg m^2, of the body; the leg's mass is at its foot, ``leg_length`` m from
    the hinge when not stretched; ``gravity`` m/s^2 along -Z of the world.
    Joints: ``psi``, the leg's angle about +Y from straight down [rad], and ``stretch`` [m], both set by their rates:
    the
    controls ``psi_rate`` [rad/s] and ``stretch_rate`` [m/s]. The body follows: in the air its angular momentum stays.
    Channels: ``leg`` [rad]; ``stretch`` and ``half_stretch`` [m], along the leg's own Z, which points up it.
    """
    tensor = ca.diag(ca.DM([float(i) for i in inertia]))

    def leg(r: Expr) -> tuple[Expr, Expr]:
        """Down the leg, and across it towards growing psi; unit vectors of the body."""
        s, c = ca.sin(r[0]), ca.cos(r[0])
        return ca.vertcat(-s, 0, -c), ca.vertcat(-c, 0, s)

    def lagrangian(r: Expr, u: Expr, xi: Expr) -> Expr:
        omega, v, (down, across), reach = xi[0:3], xi[3:6], leg(r), leg_length + r[1]
        foot = v + ca.cross(omega, reach * down) + u[1] * down + u[0] * reach * across
        return (omega.T @ tensor @ omega + mass * ca.dot(v, v) + foot_mass * ca.dot(foot, foot)) / 2

    def potential(g: Expr, r: Expr) -> Expr:
        height = g[6] + (leg_length + r[1]) * (SO3.matrix(g[0:4]) @ leg(r)[0])[2]
        return gravity * (mass * g[6] + foot_mass * height)

    return Nonholonomic(
        name=name,
        group=SE3,
        joints=("psi", "stretch"),
        lagrangian=lagrangian,
        potential_energy=potential,
        controls=(Control("psi_rate", unit="rad/s"), Control("stretch_rate", unit="m/s")),
        rate_controls={"psi_rate": "psi", "stretch_rate": "stretch"},
        channels={
            "leg": Channel(value=lambda t, r, u, xi, c: r[0]),
            "stretch": Channel(value=lambda t, r, u, xi, c: -r[1]),
            "half_stretch": Channel(value=lambda t, r, u, xi, c: -r[1] / 2),
        },
    )
