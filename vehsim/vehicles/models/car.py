"""The car of LIE 5.2.1: driven rear wheels, steering whose rate is an input, no slip."""

from __future__ import annotations

import casadi as ca

from vehsim.lie import SE2
from vehsim.vehicles.definition.base import Control, Expr
from vehsim.vehicles.definition.nonholonomic import Nonholonomic
from vehsim.vehicles.definition.quantities import Distance, Inertia, JointDamping, Length, Mass, Slope
from vehsim.vehicles.definition.surfaces import SurfaceName
from vehsim.vehicles.models.ground import ackermann_channels, slope_energy


def car(
    name: str = "car",
    *,
    mass: Mass,
    wheel_inertia: Inertia,
    yaw_inertia: Inertia,
    wheel_radius: Length,
    wheelbase: Length,
    half_track: Distance,
    slope: Slope = (0.0, 0.0),
    rolling_damping: JointDamping = 0.0,
    surface: SurfaceName = "asphalt",
) -> Nonholonomic:
    """A car whose body frame stands on the rear axle.

    ``mass`` kg, ``wheel_inertia`` (rear wheels, LIE's I) and ``yaw_inertia`` (K, about the rear axle) kg m^2; radius,
    wheelbase and half track in m; ``slope`` (2,) rise of the ground per metre along world X and Y; ``rolling_damping``
    N m s/rad of the rear axle; ``surface``: see `surfaces`.
    Joints: ``psi``, roll of the rear wheels [rad], and ``sigma = tan(steering angle)``.
    Controls: ``torque`` on the rear axle [N m] and ``steering_rate``, the rate of sigma [1/s].
    Channels: ``roll_*`` of the four wheels, each without slip, and Ackermann ``steer_*`` of the front two [rad].
    """
    rho, length = wheel_radius, wheelbase

    def lagrangian(r: Expr, u: Expr, xi: Expr) -> Expr:
        return (wheel_inertia * u[0] ** 2 + yaw_inertia * xi[0] ** 2 + mass * (xi[1] ** 2 + xi[2] ** 2)) / 2

    def constraints(r: Expr) -> tuple[Expr, Expr]:
        psi_dot = ca.vertcat(-rho / length * r[1], -rho, 0)
        return ca.horzcat(psi_dot, ca.SX(3, 1)), ca.SX.eye(3)

    def forces(r: Expr, u: Expr, xi: Expr, c: Expr) -> Expr:
        return ca.vertcat(c[0] - rolling_damping * u[0], 0)

    return Nonholonomic(
        name=name,
        surface=surface,
        group=SE2,
        joints=("psi", "sigma"),
        lagrangian=lagrangian,
        constraints=constraints,
        forces=forces,
        potential_energy=slope_energy(mass, slope),
        controls=tuple(Control(n) for n in ("torque", "steering_rate")),
        rate_controls={"steering_rate": "sigma"},
        channels=ackermann_channels(wheel_radius, wheelbase, half_track),
    )
