"""A car whose tyres slip: single track, wheel spin, combined slip and load transfer, from standstill to sliding.

The model of M. Althoff and G. Wuersching, CommonRoad: Vehicle Models (2020), section 8 (single-track drift model),
except that loads follow the forces of the tyres instead of the requested acceleration unless that is asked for, that
brakes oppose the spin of their wheels, and that `tyres` is smooth at standstill.
"""

from __future__ import annotations

from typing import Annotated

import casadi as ca
from annotated_types import Gt

from vehsim.constants import GRAVITY
from vehsim.lie import SE2
from vehsim.rig.rig import Channel
from vehsim.vehicles.definition.base import Expr
from vehsim.vehicles.definition.nonholonomic import Nonholonomic
from vehsim.vehicles.definition.quantities import Distance, Inertia, Length, Mass, Unit
from vehsim.vehicles.definition.surfaces import SurfaceName
from vehsim.vehicles.models.ground import ackermann_channels
from vehsim.vehicles.models.tyres import (
    CONTROLS,
    LATERAL,
    LONGITUDINAL,
    SLIPS,
    SPIN,
    WEIGHTS_LATERAL,
    WEIGHTS_LONGITUDINAL,
    Four,
    Share,
    Tyre,
    brake,
    held,
    sliding,
    steered,
)

LARGEST_STEP = 1 / 1200
"""Largest step of a simulation, s: wheels follow the road within milliseconds at low speed."""


def drift_car(
    name: str = "drift_car",
    *,
    mass: Mass,
    yaw_inertia: Inertia,
    front: Length,
    rear: Length,
    mass_height: Distance,
    wheel_radius: Length,
    front_inertia: Inertia,
    rear_inertia: Inertia,
    half_track: Distance,
    drive_front: Share = 0.0,
    brake_front: Share = 0.6,
    surface: SurfaceName = "asphalt",
    friction: Annotated[float, Unit(""), Gt(0)] = 1.0,
    low_speed: Annotated[float, Unit("m/s"), Gt(0)] = 3.0,
    tyre_longitudinal: Four = LONGITUDINAL,
    tyre_lateral: Four = LATERAL,
    tyre_weights_longitudinal: Four = WEIGHTS_LONGITUDINAL,
    tyre_weights_lateral: Four = WEIGHTS_LATERAL,
    tyre_slip_push: Annotated[float, Unit("")] = 0.0,
    demanded_transfer: Share = 0.0,
) -> Nonholonomic:
    """A single-track car whose body frame stands below its centre of mass, on the ground.

    ``mass`` kg, ``yaw_inertia`` about the centre of mass kg m^2; ``front``, ``rear``: distances of the axles from it,
    and ``mass_height``, m; ``wheel_radius`` and ``half_track`` m; ``front_inertia``, ``rear_inertia``: both wheels of
    an axle, the driven ones with engine and gears, kg m^2; ``drive_front``, ``brake_front``: the front axle's share of
    ``drive`` and ``brake`` (drive 0: rear-wheel, 1: front-wheel drive); ``surface``: a name of `SURFACES`;
    ``friction``: factor of its friction; ``low_speed`` m/s and the tyres' coefficients: see `Tyre`;
    ``tyre_slip_push``: V1 of its ``slip_push``.
    ``demanded_transfer``: whether loads shift with the car's acceleration, 0, or, as in CommonRoad's model, with that
    which ``drive`` and ``brake`` would give without slip, 1.
    Joints: ``psi``, roll of the rear wheels, ``sigma``, tangent of the steering angle, ``psi_front``, roll of the front
    wheels. Controls: ``drive`` on the driven axles, ``brake`` on all wheels and ``handbrake`` on the rear ones [N m],
    ``steering_rate``, the rate of sigma [1/s]. Channels: ``roll_*`` and Ackermann ``steer_*`` [rad]; ``slip_*``, speed
    of the contact over the ground [m/s], ``slip_ratio_*``, ``slip_angle_*`` [rad] and ``load_*`` [N] of each wheel.
    """
    tyre = Tyre(
        tyre_longitudinal, tyre_lateral, tyre_weights_longitudinal, tyre_weights_lateral, friction, low_speed,
        slip_push=(tyre_slip_push, 0.0),
    ).on(surface)  # fmt: skip
    wheelbase = front + rear
    tyre.check(mass_height, min(front, rear), "lift an axle", name)

    def lagrangian(r: Expr, u: Expr, xi: Expr) -> Expr:
        spin = rear_inertia * u[0] ** 2 + front_inertia * u[2] ** 2
        return (spin + yaw_inertia * xi[0] ** 2 + mass * (xi[1] ** 2 + xi[2] ** 2)) / 2

    def velocities(r: Expr, xi: Expr) -> tuple[Expr, Expr]:
        """Velocity of the front and rear hub (2,), in the wheels' axes."""
        cosine, sine = steered(r[1])
        across = xi[2] + front * xi[0]
        return (
            ca.vertcat(cosine * xi[1] + sine * across, cosine * across - sine * xi[1]),
            ca.vertcat(xi[1], xi[2] - rear * xi[0]),
        )

    def contact(r: Expr, u: Expr, xi: Expr, c: Expr) -> tuple[Expr, Expr, tuple[Expr, Expr]]:
        """Forces over load of the front and rear tyres in their own axes, and the axles' loads, N."""
        hubs = velocities(r, xi)
        ahead = tyre.force(*tyre.slip(hubs[0], wheel_radius * u[2]))
        behind = tyre.force(*tyre.slip(hubs[1], wheel_radius * u[0]))
        # loads depend on the acceleration a, and forces are proportional to loads: linear in a
        cosine, sine = steered(r[1])
        pull = cosine * ahead[0] - sine * ahead[1]
        a = GRAVITY * (pull * rear + behind[0] * front) / (wheelbase + mass_height * (pull - behind[0]))
        a += demanded_transfer * ((c[0] - c[1]) / (mass * wheel_radius) - a)
        loads = (GRAVITY * rear - a * mass_height, GRAVITY * front + a * mass_height)
        return ahead, behind, (mass * loads[0] / wheelbase, mass * loads[1] / wheelbase)

    def forces(r: Expr, u: Expr, xi: Expr, c: Expr) -> tuple[Expr, Expr]:
        ahead, behind, loads = contact(r, u, xi, c)
        ahead, behind = ahead * loads[0], behind * loads[1]
        cosine, sine = steered(r[1])
        push, aside = cosine * ahead[0] - sine * ahead[1], sine * ahead[0] + cosine * ahead[1]
        body = ca.vertcat(front * aside - rear * behind[1], push + behind[0], aside + behind[1])
        return torques(u, c) - wheel_radius * ca.vertcat(behind[0], 0, ahead[0]), body

    def torques(u: Expr, c: Expr) -> Expr:
        on_rear = (1 - drive_front) * c[0] + brake((1 - brake_front) * c[1] + c[2], wheel_radius * u[0])
        return ca.vertcat(on_rear, 0, drive_front * c[0] + brake(brake_front * c[1], wheel_radius * u[2]))

    def rolling(r: Expr, xi: Expr) -> Expr:
        ahead, behind = velocities(r, xi)
        return ca.vertcat(behind[0], 0, ahead[0]) / wheel_radius

    def across(r: Expr, xi: Expr) -> Expr:
        return ca.vertcat(*(hub[1] for hub in velocities(r, xi)))

    def standing(r: Expr, u: Expr, xi: Expr, c: Expr, pull: Expr) -> Expr:
        spin = (u - rolling(r, xi))[[0, 2]]
        return held(tyre, mass, wheelbase, wheel_radius, spin, xi, c, pull)

    def slip(axle: int) -> Channel:
        def value(t: Expr, r: Expr, u: Expr, xi: Expr, c: Expr) -> Expr:
            return sliding(velocities(r, xi)[axle], wheel_radius * u[(2, 0)[axle]])

        return Channel(value=value, unit="m/s")

    def slips(axle: int, component: int) -> Channel:
        def value(t: Expr, r: Expr, u: Expr, xi: Expr, c: Expr) -> Expr:
            return tyre.slip(velocities(r, xi)[axle], wheel_radius * u[(2, 0)[axle]])[component]

        return Channel(value=value, unit=SLIPS[component])

    def load(axle: int) -> Channel:
        return Channel(value=lambda t, r, u, xi, c: contact(r, u, xi, c)[2][axle] / 2, unit="N")

    def roll(joint: int) -> Channel:
        return Channel(value=lambda t, r, u, xi, c: r[joint])

    axles = {"fl": 0, "fr": 0, "rl": 1, "rr": 1}
    return Nonholonomic(
        name=name,
        group=SE2,
        joints=("psi", "sigma", "psi_front"),
        lagrangian=lagrangian,
        forces=forces,
        controls=CONTROLS,
        rate_controls={"steering_rate": "sigma"},
        rolling=rolling,
        across=across,
        torques=torques,
        standing=standing,
        largest_step=LARGEST_STEP,
        surface=surface,
        default_costs={"spin": SPIN},
        channels={
            **ackermann_channels(wheel_radius, wheelbase, half_track),
            **{f"roll_{wheel}": roll((2, 0)[axle]) for wheel, axle in axles.items()},
            **{f"slip_{wheel}": slip(axle) for wheel, axle in axles.items()},
            **{f"slip_ratio_{wheel}": slips(axle, 0) for wheel, axle in axles.items()},
            **{f"slip_angle_{wheel}": slips(axle, 1) for wheel, axle in axles.items()},
            **{f"load_{wheel}": load(axle) for wheel, axle in axles.items()},
        },
    )
