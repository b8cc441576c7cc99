"""Chaplygin's sleigh: a body on a knife edge, whose centre of mass lies ahead of it."""

from __future__ import annotations

import casadi as ca

from vehsim.lie import SE2
from vehsim.vehicles.definition.base import Control, Expr
from vehsim.vehicles.definition.nonholonomic import Nonholonomic
from vehsim.vehicles.definition.quantities import Coordinate, Inertia, LinearDamping, Mass, Slope
from vehsim.vehicles.models.ground import slope_energy


def chaplygin_sleigh(
    name: str = "chaplygin_sleigh",
    *,
    mass: Mass,
    yaw_inertia: Inertia,
    ahead: Coordinate,
    slope: Slope = (0.0, 0.0),
    runner_damping: LinearDamping = 0.0,
) -> Nonholonomic:
    """A sleigh whose body frame stands on the knife edge, which lies along X and does not slip sideways.

    ``mass`` kg; ``yaw_inertia`` about the centre of mass, kg m^2, which lies ``ahead`` m of the edge; ``slope`` (2,)
    rise per metre along world X and Y; ``runner_damping`` N s/m along the edge. Controls: ``thrust`` [N] along X and
    ``torque`` [N m]. No joints.
    """

    def lagrangian(r: Expr, u: Expr, xi: Expr) -> Expr:
        return (mass * (xi[1] ** 2 + (xi[2] + ahead * xi[0]) ** 2) + yaw_inertia * xi[0] ** 2) / 2

    def forces(r: Expr, u: Expr, xi: Expr, c: Expr) -> tuple[Expr, Expr]:
        return ca.SX(0, 1), ca.vertcat(c[1], c[0] - runner_damping * xi[1], 0)

    return Nonholonomic(
        name=name,
        group=SE2,
        lagrangian=lagrangian,
        constraints=lambda r: (ca.SX(1, 0), [[0, 0, 1]]),
        forces=forces,
        potential_energy=slope_energy(mass, slope, ahead),
        controls=(Control("thrust", unit="N"), Control("torque", unit="N m")),
    )
