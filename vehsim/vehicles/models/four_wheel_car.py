"""A car on four tyres and springs: wheel spin, combined slip, load transfer, roll, dive and squat, differentials.

The body is a rigid mass on four springs and dampers; it rolls and pitches about axes on the ground below its centre of
mass, by small angles. Its springs carry the weight, so the load of a tyre follows from the body's motion alone. Loads
shift because the mass is above the ground: the coupling is in the Lagrangian. Tyres as in `tyres`.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated

import casadi as ca
from annotated_types import Ge, Gt, Len

from vehsim.constants import GRAVITY
from vehsim.errors import InputError
from vehsim.lie import SE2
from vehsim.rig.rig import Channel
from vehsim.vehicles.definition.base import Expr
from vehsim.vehicles.definition.nonholonomic import Nonholonomic
from vehsim.vehicles.definition.quantities import Inertia, Length, Mass, Unit
from vehsim.vehicles.definition.surfaces import SurfaceName
from vehsim.vehicles.models.ground import steer_channels
from vehsim.vehicles.models.tyres import (
    CONTROLS,
    LATERAL,
    LONGITUDINAL,
    SPIN,
    WEIGHTS_LATERAL,
    WEIGHTS_LONGITUDINAL,
    Four,
    Share,
    Tyre,
    brake,
    sliding,
    steered,
)

LIFTED = 50.0
"""Load, N, over which a tyre's lift-off is rounded: it never pulls on the ground."""
LARGEST_STEP = 1 / 2400
"""Largest step of a simulation, s: at low speed, a wheel follows the road within a millisecond."""
Stiffness = Annotated[Sequence[Annotated[float, Unit("N/m"), Gt(0)]], Len(2, 2)]
Damping = Annotated[Sequence[Annotated[float, Unit("N s/m"), Ge(0)]], Len(2, 2)]
Torsion = Annotated[Sequence[Annotated[float, Unit("N m/rad"), Ge(0)]], Len(2, 2)]
Locked = Annotated[Sequence[Share], Len(2, 2)]
SIDES = {"l": 1.0, "r": -1.0}
BODY = ("heave", "pitch", "roll")


def four_wheel_car(
    name: str = "four_wheel_car",
    *,
    mass: Mass,
    yaw_inertia: Inertia,
    roll_inertia: Inertia,
    pitch_inertia: Inertia,
    front: Length,
    rear: Length,
    half_track: Length,
    mass_height: Length,
    wheel_radius: Length,
    wheel_inertia: Inertia,
    engine_inertia: Inertia,
    springs: Stiffness,
    dampers: Damping,
    bars: Torsion = (0.0, 0.0),
    drive_front: Share = 0.0,
    locked: Locked = (0.0, 0.0),
    brake_front: Share = 0.6,
    surface: SurfaceName = "asphalt",
    friction: Annotated[float, Unit(""), Gt(0)] = 1.0,
    low_speed: Annotated[float, Unit("m/s"), Gt(0)] = 3.0,
    tyre_longitudinal: Four = LONGITUDINAL,
    tyre_lateral: Four = LATERAL,
    tyre_weights_longitudinal: Four = WEIGHTS_LONGITUDINAL,
    tyre_weights_lateral: Four = WEIGHTS_LATERAL,
) -> Nonholonomic:
    """A car whose body frame stands below its centre of mass, on the ground, and does not tilt.

    ``mass`` kg; inertias about the centre of mass kg m^2; ``front``, ``rear``: distances of the axles from it, and its
    ``mass_height``, m; ``half_track`` m; ``wheel_radius`` m and ``wheel_inertia`` of each wheel; ``engine_inertia``:
    engine and gears, as felt at the driven wheels, kg m^2. Of the (front, rear) axle: ``springs`` N/m and ``dampers``
    N s/m of each wheel, anti-roll ``bars`` N m/rad, and whether its differential is ``locked`` (1) or open (0).
    ``drive_front``, ``brake_front``: the front axle's share of ``drive`` and ``brake`` (drive 0: rear-wheel, 0.5:
    all-wheel with an open centre differential); ``surface``: a name of `SURFACES`; ``friction``: factor of its
    friction; ``low_speed`` and the tyres' coefficients: see `Tyre`.
    Joints: ``psi_*``, roll of each wheel, or of both wheels of a locked axle, rad; ``sigma``, tangent of the steering
    angle; ``heave`` m, ``pitch`` (nose down) and ``roll`` (left side up) rad of the body on its springs. Controls:
    ``drive`` on the driven axles, ``brake`` on all wheels and ``handbrake`` on the rear ones [N m], ``steering_rate``,
    the rate of sigma [1/s]. Channels: ``roll_*`` and Ackermann ``steer_*`` [rad]; ``slip_*``, speed of the contact over
    the ground [m/s], ``slip_ratio_*``, ``slip_angle_*`` [rad] and ``load_*`` [N] of each wheel.
    """
    tyre = Tyre(
        tyre_longitudinal, tyre_lateral, tyre_weights_longitudinal, tyre_weights_lateral, friction, low_speed
    ).on(surface)  # fmt: skip
    wheelbase = front + rear
    tyre.check(mass_height, min(front, rear, half_track), "tip over a car whose wheels are", name)
    if not set(locked) <= {0, 1}:
        raise InputError("neither open nor locked", "give 0 or 1", key="physics.locked", value=locked, subject=name)

    places = {
        f"{axle}{side}": (x, y * half_track)
        for axle, x in {"f": front, "r": -rear}.items()
        for side, y in SIDES.items()
    }
    shafts = {wheel: f"psi_{wheel[:1] if locked['fr'.index(wheel[0])] else wheel}" for wheel in places}
    joints = (*dict.fromkeys(shafts.values()), "sigma", *BODY)
    at = {joint: k for k, joint in enumerate(joints)}
    share = {"f": drive_front, "r": 1 - drive_front}
    statics = {"f": mass * GRAVITY * rear / wheelbase / 2, "r": mass * GRAVITY * front / wheelbase / 2}

    def lagrangian(r: Expr, u: Expr, xi: Expr) -> Expr:
        heave, pitch, roll = (r[at[joint]] for joint in BODY)
        rising, pitching, rolling_over = (u[at[joint]] for joint in BODY)
        x, y = mass_height * pitch, -mass_height * roll  # of the centre of mass
        along = xi[1] - xi[0] * y + mass_height * pitching
        across = xi[2] + xi[0] * x - mass_height * rolling_over
        engine = sum(share[wheel[0]] * u[at[shaft]] / 2 for wheel, shaft in shafts.items())
        spin = wheel_inertia * sum(u[at[shaft]] ** 2 for shaft in shafts.values()) + engine_inertia * engine**2
        tilt = yaw_inertia * xi[0] ** 2 + pitch_inertia * pitching**2 + roll_inertia * rolling_over**2
        kinetic = (spin + tilt + mass * (along**2 + across**2 + rising**2)) / 2
        return kinetic - mass * GRAVITY * (heave - mass_height * (pitch**2 + roll**2) / 2)

    def heading(wheel: str, r: Expr) -> tuple[Expr, Expr]:
        """Cosine and sine of a wheel's steering angle."""
        return (1.0, 0.0) if wheel[0] == "r" else steered(r[at["sigma"]], places[wheel][1] / wheelbase)

    def hub(wheel: str, r: Expr, xi: Expr) -> Expr:
        """Velocity of a hub (2,), in the wheel's axes."""
        (cosine, sine), (x, y) = heading(wheel, r), places[wheel]
        along, across = xi[1] - y * xi[0], xi[2] + x * xi[0]
        return ca.vertcat(cosine * along + sine * across, cosine * across - sine * along)

    def load(wheel: str, r: Expr, u: Expr) -> Expr:
        """Load of a tyre, N: its spring and damper, which only push."""
        (x, y), axle, (heave, pitch, roll) = places[wheel], "fr".index(wheel[0]), (at[joint] for joint in BODY)
        height, rate = (q[heave] - x * q[pitch] + y * q[roll] for q in (r, u))
        at_rest = statics[wheel[0]] - LIFTED**2 / (4 * statics[wheel[0]])
        force = at_rest - springs[axle] * height - dampers[axle] * rate - bars[axle] * r[roll] / (2 * y)
        return (force + ca.sqrt(force**2 + LIFTED**2)) / 2

    def forces(r: Expr, u: Expr, xi: Expr, c: Expr) -> tuple[Expr, Expr]:
        on_joints, on_body = ca.SX.zeros(len(joints)), ca.SX.zeros(3)
        for wheel, (x, y) in places.items():
            carried, rim = load(wheel, r, u), wheel_radius * u[at[shafts[wheel]]]
            force = carried * tyre.force(*tyre.slip(hub(wheel, r, xi), rim))
            (cosine, sine), handbrake = heading(wheel, r), c[2] * (wheel[0] == "r")
            along, across = cosine * force[0] - sine * force[1], sine * force[0] + cosine * force[1]
            on_body += ca.vertcat(x * across - y * along, along, across)
            braking = {"f": brake_front, "r": 1 - brake_front}[wheel[0]] * c[1] + handbrake
            on_joints[at[shafts[wheel]]] += (
                share[wheel[0]] * c[0] / 2 + brake(braking / 2, rim) - wheel_radius * force[0]
            )
            for joint, arm in zip(BODY, (1.0, -x, y), strict=True):
                on_joints[at[joint]] += arm * carried
        return on_joints, on_body

    def rolling(r: Expr, xi: Expr) -> Expr:
        """Wheels that share a shaft turn at the mean of their speeds."""
        rates = ca.SX.zeros(len(joints))
        for wheel, shaft in shafts.items():
            rates[at[shaft]] += hub(wheel, r, xi)[0] / wheel_radius / sum(s == shaft for s in shafts.values())
        return rates

    def roll_channel(wheel: str) -> Channel:
        return Channel(value=lambda t, r, u, xi, c: r[at[shafts[wheel]]])

    def slip_channel(wheel: str) -> Channel:
        return Channel(value=lambda t, r, u, xi, c: sliding(hub(wheel, r, xi), wheel_radius * u[at[shafts[wheel]]]))

    def slips_channel(wheel: str, component: int) -> Channel:
        def value(t: Expr, r: Expr, u: Expr, xi: Expr, c: Expr) -> Expr:
            return tyre.slip(hub(wheel, r, xi), wheel_radius * u[at[shafts[wheel]]])[component]

        return Channel(value=value)

    def load_channel(wheel: str) -> Channel:
        return Channel(value=lambda t, r, u, xi, c: load(wheel, r, u))

    return Nonholonomic(
        name=name,
        group=SE2,
        joints=joints,
        lagrangian=lagrangian,
        forces=forces,
        controls=CONTROLS,
        rate_controls={"steering_rate": "sigma"},
        rolling=rolling,
        attitude=BODY,
        largest_step=LARGEST_STEP,
        surface=surface,
        default_costs={"spin": SPIN},
        channels={
            **{f"roll_{wheel}": roll_channel(wheel) for wheel in places},
            **steer_channels(wheelbase, half_track, at["sigma"]),
            **{f"travel_{wheel}": Channel(value=lambda t, r, u, xi, c: 0.0) for wheel in places},
            **{f"slip_{wheel}": slip_channel(wheel) for wheel in places},
            **{f"slip_ratio_{wheel}": slips_channel(wheel, 0) for wheel in places},
            **{f"slip_angle_{wheel}": slips_channel(wheel, 1) for wheel in places},
            **{f"load_{wheel}": load_channel(wheel) for wheel in places},
        },
    )
