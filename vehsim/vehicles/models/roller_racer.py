"""The roller racer: two wheeled bodies on a pivot, driven by swinging the front one like a handlebar."""

from __future__ import annotations

import casadi as ca

from vehsim.lie import SE2
from vehsim.rig.rig import Channel
from vehsim.vehicles.definition.base import Control, Expr
from vehsim.vehicles.definition.nonholonomic import Nonholonomic
from vehsim.vehicles.definition.quantities import Coordinate, Inertia, JointDamping, Length, Mass, Slope
from vehsim.vehicles.models.ground import slope_energy


def roller_racer(
    name: str = "roller_racer",
    *,
    mass: Mass,
    yaw_inertia: Inertia,
    pivot_ahead: Coordinate,
    bar_mass: Mass,
    bar_inertia: Inertia,
    bar_length: Length,
    wheel_radius: Length = 0.06,
    slope: Slope = (0.0, 0.0),
    damping: JointDamping = 0.0,
) -> Nonholonomic:
    """A seat on an unsteered axle and a handlebar with an axle of its own.

    Body frame and the seat's centre of mass stand on the rear axle, ``pivot_ahead`` m behind the pivot; the bar's axle
    and centre of mass lie ``bar_length`` m ahead of the pivot along the bar. Masses kg, inertias about the bodies' own
    centres kg m^2; ``slope`` (2,) rise per metre along world X and Y (felt by the seat); ``damping`` N m s/rad of the
    pivot. Joint: ``phi``, the bar's angle [rad]. Control: ``torque`` on it [N m].
    Channels: ``bar``, ``roll_rear``, ``roll_front`` [rad].
    """

    def bar_axle(r: Expr, u: Expr, xi: Expr) -> tuple[Expr, Expr]:
        """Velocity of the bar's axle along and across the seat."""
        turning = xi[0] + u[0]
        along = xi[1] - bar_length * ca.sin(r[0]) * turning
        return along, xi[2] + pivot_ahead * xi[0] + bar_length * ca.cos(r[0]) * turning

    def lagrangian(r: Expr, u: Expr, xi: Expr) -> Expr:
        along, across = bar_axle(r, u, xi)
        seat = mass * (xi[1] ** 2 + xi[2] ** 2) + yaw_inertia * xi[0] ** 2
        return (seat + bar_mass * (along**2 + across**2) + bar_inertia * (xi[0] + u[0]) ** 2) / 2

    def constraints(r: Expr) -> tuple[Expr, Expr]:
        s, c = ca.sin(r[0]), ca.cos(r[0])
        front = ca.horzcat(pivot_ahead * c + bar_length, -s, c)
        return ca.vertcat(0, bar_length), ca.vertcat(ca.SX(ca.DM([[0, 0, 1]])), front)

    def front_roll(t: Expr, r: Expr, u: Expr, xi: Expr, c: Expr) -> Expr:
        along, across = bar_axle(r, u, xi)
        return (ca.cos(r[0]) * along + ca.sin(r[0]) * across) / wheel_radius

    return Nonholonomic(
        name=name,
        group=SE2,
        joints=("phi",),
        lagrangian=lagrangian,
        constraints=constraints,
        forces=lambda r, u, xi, c: c - damping * u,
        potential_energy=slope_energy(mass, slope),
        controls=(Control("torque", unit="N m"),),
        channels={
            "bar": Channel(value=lambda t, r, u, xi, c: r[0]),
            "roll_rear": Channel(rate=lambda t, r, u, xi, c: xi[1] / wheel_radius),
            "roll_front": Channel(rate=front_roll),
        },
    )
