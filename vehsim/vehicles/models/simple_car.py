"""The simple car of NH IV.A.2: driven rear wheels and a steering column with inertia of its own, no slip."""

from __future__ import annotations

import casadi as ca

from vehsim.lie import SE2
from vehsim.rig.rig import Channel
from vehsim.vehicles.definition.base import Control, Expr
from vehsim.vehicles.definition.nonholonomic import Nonholonomic
from vehsim.vehicles.definition.quantities import Distance, Inertia, JointDamping, Length, Mass, Slope
from vehsim.vehicles.definition.surfaces import SurfaceName
from vehsim.vehicles.models.ground import ackermann_channels, slope_energy


def simple_car(
    name: str = "simple_car",
    *,
    mass: Mass,
    wheel_inertia: Inertia,
    yaw_inertia: Inertia,
    steering_inertia: Inertia,
    wheel_radius: Length,
    wheelbase: Length,
    half_track: Distance = 0.0,
    slope: Slope = (0.0, 0.0),
    rolling_damping: JointDamping = 0.0,
    steering_damping: JointDamping = 0.0,
    surface: SurfaceName = "asphalt",
) -> Nonholonomic:
    """A bicycle model whose body frame stands on the rear axle.

    ``mass`` kg; inertias kg m^2: rear wheels (NH's I), yaw about the rear axle (K), steering column (J); radius,
    wheelbase and half track (for the channels) m; ``slope`` (2,) rise per metre along world X and Y; dampings N m s/rad
    of rear axle and steering column. ``surface``: see `surfaces`.
    Joints: ``psi``, roll of the rear wheels [rad], and ``sigma = tan(phi)`` of the steering angle phi.
    Controls: ``torque`` on the rear axle and ``steering`` torque on the column, about phi [N m].
    Channels: ``roll_rear``, ``roll_front``, ``steer`` of the bicycle, and those of a car's four wheels [rad].
    """
    rho, length = wheel_radius, wheelbase

    def column(r: Expr) -> Expr:
        """d phi / d sigma"""
        return 1 / (1 + r[1] ** 2)

    def lagrangian(r: Expr, u: Expr, xi: Expr) -> Expr:
        # NH eq. 22, with J phidot^2 in place of the printed J sigmadot^2
        spin = wheel_inertia * u[0] ** 2 + steering_inertia * (column(r) * u[1]) ** 2
        return (spin + yaw_inertia * xi[0] ** 2 + mass * (xi[1] ** 2 + xi[2] ** 2)) / 2

    def constraints(r: Expr) -> tuple[Expr, Expr]:
        return ca.horzcat(ca.vertcat(-rho / length * r[1], -rho, 0), ca.SX(3, 1)), ca.SX.eye(3)

    def forces(r: Expr, u: Expr, xi: Expr, c: Expr) -> Expr:
        turning = c[1] - steering_damping * column(r) * u[1]
        return ca.vertcat(c[0] - rolling_damping * u[0], column(r) * turning)

    return Nonholonomic(
        name=name,
        surface=surface,
        group=SE2,
        joints=("psi", "sigma"),
        lagrangian=lagrangian,
        constraints=constraints,
        forces=forces,
        potential_energy=slope_energy(mass, slope),
        controls=(Control("torque", unit="N m"), Control("steering", unit="N m")),
        channels={
            "roll_rear": Channel(value=lambda t, r, u, xi, c: r[0]),
            "roll_front": Channel(rate=lambda t, r, u, xi, c: xi[1] / rho * ca.sqrt(1 + r[1] ** 2)),
            "steer": Channel(value=lambda t, r, u, xi, c: ca.atan(r[1])),
            **ackermann_channels(wheel_radius, wheelbase, half_track),
        },
    )
