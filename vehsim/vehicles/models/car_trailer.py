"""The car of LIE 5.2.1 towing a trailer that has mass and swings freely on its hitch."""

from __future__ import annotations

import casadi as ca

from vehsim.lie import SE2
from vehsim.rig.rig import Channel
from vehsim.vehicles.definition.base import Control, Expr
from vehsim.vehicles.definition.nonholonomic import Nonholonomic
from vehsim.vehicles.definition.quantities import Coordinate, Inertia, JointDamping, Length, Mass, Slope
from vehsim.vehicles.definition.surfaces import SurfaceName
from vehsim.vehicles.models.ground import slope_energy


def car_trailer(
    name: str = "car_trailer",
    *,
    mass: Mass,
    wheel_inertia: Inertia,
    yaw_inertia: Inertia,
    wheel_radius: Length,
    wheelbase: Length,
    hitch_behind: Coordinate,
    trailer_mass: Mass,
    trailer_inertia: Inertia,
    trailer_length: Length,
    slope: Slope = (0.0, 0.0),
    hitch_damping: JointDamping = 0.0,
    surface: SurfaceName = "asphalt",
) -> Nonholonomic:
    """A car whose body frame stands on the rear axle, its hitch ``hitch_behind`` m behind, and a one-axle trailer.

    Car: ``mass`` kg, ``wheel_inertia`` and ``yaw_inertia`` (about the rear axle) kg m^2, radius and wheelbase m.
    Trailer: mass and inertia about its centre of mass, which stands on its axle, ``trailer_length`` m from the hitch.
    ``slope`` (2,) rise per metre along world X and Y (felt by the car); ``hitch_damping`` N m s/rad;
    ``surface``: see `surfaces`.
    Joints: ``psi`` roll of the rear wheels, ``sigma = tan(steering angle)``, ``hitch``, the trailer's angle against the
    car [rad]. Controls: ``torque`` on the rear axle [N m] and ``steering_rate`` of sigma [1/s].
    Channels: ``roll_rear``, ``roll_front``, ``steer``, ``hitch``, ``roll_trailer`` [rad];
    ``hitch_pitch`` and ``hitch_roll`` rest until a terrain tilts the trailer.
    """
    rho, length = wheel_radius, wheelbase

    def trailer(r: Expr, u: Expr, xi: Expr) -> tuple[Expr, Expr, Expr]:
        """The trailer's yaw rate, and its axle's velocity along and across the trailer."""
        turning, s, c = xi[0] + u[2], ca.sin(r[2]), ca.cos(r[2])
        across = xi[2] - hitch_behind * xi[0]
        return turning, c * xi[1] + s * across, -s * xi[1] + c * across - trailer_length * turning

    def lagrangian(r: Expr, u: Expr, xi: Expr) -> Expr:
        turning, along, across = trailer(r, u, xi)
        towed = trailer_mass * (along**2 + across**2) + trailer_inertia * turning**2
        own = wheel_inertia * u[0] ** 2 + yaw_inertia * xi[0] ** 2 + mass * (xi[1] ** 2 + xi[2] ** 2)
        return (own + towed) / 2

    def constraints(r: Expr) -> tuple[Expr, Expr]:
        u, xi = ca.SX.sym("u", 3), ca.SX.sym("xi", 3)
        rolling = ca.vertcat(xi[0] - rho / length * r[1] * u[0], xi[1] - rho * u[0], xi[2])
        rows = ca.vertcat(rolling, trailer(r, u, xi)[2])
        return ca.jacobian(rows, u), ca.jacobian(rows, xi)

    def forces(r: Expr, u: Expr, xi: Expr, c: Expr) -> Expr:
        return ca.vertcat(c[0], 0, -hitch_damping * u[2])

    return Nonholonomic(
        name=name,
        surface=surface,
        group=SE2,
        joints=("psi", "sigma", "hitch"),
        lagrangian=lagrangian,
        constraints=constraints,
        forces=forces,
        potential_energy=slope_energy(mass, slope),
        controls=(Control("torque", unit="N m"), Control("steering_rate", unit="1/s")),
        rate_controls={"steering_rate": "sigma"},
        channels={
            "roll_rear": Channel(value=lambda t, r, u, xi, c: r[0]),
            "roll_front": Channel(rate=lambda t, r, u, xi, c: xi[1] / rho * ca.sqrt(1 + r[1] ** 2)),
            "steer": Channel(value=lambda t, r, u, xi, c: ca.atan(r[1])),
            "hitch_pitch": Channel(value=lambda t, r, u, xi, c: 0.0),
            "hitch_roll": Channel(value=lambda t, r, u, xi, c: 0.0),
            "hitch": Channel(value=lambda t, r, u, xi, c: r[2]),
            "roll_trailer": Channel(rate=lambda t, r, u, xi, c: trailer(r, u, xi)[1] / rho),
        },
    )
