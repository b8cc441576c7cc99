"""The two-wheeled robot of NH IV.A.1: a torque on either wheel, no slip."""

from __future__ import annotations

from vehsim.lie import SE2
from vehsim.rig.rig import Channel
from vehsim.vehicles.definition.base import Control, Expr
from vehsim.vehicles.definition.nonholonomic import Nonholonomic
from vehsim.vehicles.definition.quantities import Distance, Inertia, JointDamping, Length, Mass, Slope
from vehsim.vehicles.definition.surfaces import SurfaceName
from vehsim.vehicles.models.ground import slope_energy


def two_wheeled(
    name: str = "two_wheeled",
    *,
    mass: Mass,
    yaw_inertia: Inertia,
    wheel_inertia: Inertia,
    wheel_radius: Length,
    half_track: Distance,
    slope: Slope = (0.0, 0.0),
    rolling_damping: JointDamping = 0.0,
    surface: SurfaceName = "asphalt",
) -> Nonholonomic:
    """A robot whose body frame, and centre of mass, stands between its wheels.

    ``mass`` kg; ``yaw_inertia`` and ``wheel_inertia`` (each) kg m^2; ``wheel_radius`` and ``half_track`` (NH's d) m;
    ``slope`` (2,) rise per metre along world X and Y; ``rolling_damping`` N m s/rad of each wheel; ``surface``: see
    `surfaces`. Joints and channels:
    ``right`` and ``left``, roll of the wheels [rad]. Controls: ``torque_right`` and ``torque_left`` [N m].
    The right wheel turns the robot left: ``omega = rho / (2 d) (right - left)``.
    """
    turn, drive = wheel_radius / (2 * half_track), wheel_radius / 2

    def lagrangian(r: Expr, u: Expr, xi: Expr) -> Expr:
        wheels = wheel_inertia * (u[0] ** 2 + u[1] ** 2)
        return (wheels + yaw_inertia * xi[0] ** 2 + mass * (xi[1] ** 2 + xi[2] ** 2)) / 2

    def constraints(r: Expr) -> tuple[list[list[float]], list[list[float]]]:
        return [[-turn, turn], [-drive, -drive], [0, 0]], [[1, 0, 0], [0, 1, 0], [0, 0, 1]]

    return Nonholonomic(
        name=name,
        surface=surface,
        group=SE2,
        joints=("right", "left"),
        lagrangian=lagrangian,
        constraints=constraints,
        forces=lambda r, u, xi, c: c - rolling_damping * u,
        potential_energy=slope_energy(mass, slope),
        controls=(Control("torque_right", unit="N m"), Control("torque_left", unit="N m")),
        channels={
            "roll_right": Channel(value=lambda t, r, u, xi, c: r[0]),
            "roll_left": Channel(value=lambda t, r, u, xi, c: r[1]),
        },
    )
