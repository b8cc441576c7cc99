"""A car on four tyres and springs: wheel spin, combined slip, load transfer, roll, dive and squat, differentials.

The body is a rigid mass on four springs and dampers; it rolls and pitches by small angles about axes on the ground
below its centre of mass, and heaves along its own axis. Loads shift because the mass is above the ground: the coupling
is in the Lagrangian. The links that hold a tilted body also lift it, so tyres carry more than their springs push.
Tyres as in `tyres`.
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
from vehsim.vehicles.definition.quantities import Inertia, Length, Mass, Unit, With
from vehsim.vehicles.definition.surfaces import SurfaceName
from vehsim.vehicles.models.ground import steer_channels
from vehsim.vehicles.models.tyres import (
    CONTROLS,
    LATERAL,
    LONGITUDINAL,
    SLIPS,
    SPIN,
    STRAIGHT,
    UPRIGHT,
    WEIGHTS_LATERAL,
    WEIGHTS_LONGITUDINAL,
    Five,
    Four,
    Share,
    Two,
    Tyre,
    brake,
    held,
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
CamberGain = Annotated[Sequence[Annotated[float, Unit("rad/m")]], Len(2, 2), With("tyre_camber")]
Locked = Annotated[Sequence[Share], Len(2, 2)]
SIDES = {"l": 1.0, "r": -1.0}
BODY = ("heave", "pitch", "roll")


def positive(force: Expr) -> Expr:
    """The part of a force that pushes on the ground, rounded where a wheel lifts."""
    return (force + ca.sqrt(force**2 + LIFTED**2)) / 2


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
    camber_gains: CamberGain = (0.0, 0.0),
    tyre_camber: Five = UPRIGHT,
    tyre_slip_push: Two = STRAIGHT,
    scrub: Share = 1.0,
) -> Nonholonomic:
    """A car whose body frame stands below its centre of mass, on the ground, and does not tilt.

    ``mass`` kg; inertias about the centre of mass kg m^2; ``front``, ``rear``: distances of the axles from it, and its
    ``mass_height``, m; ``half_track`` m; ``wheel_radius`` m and ``wheel_inertia`` of each wheel; ``engine_inertia``:
    engine and gears, as felt at the driven wheels, kg m^2. Of the (front, rear) axle: ``springs`` N/m and ``dampers``
    N s/m of each wheel, anti-roll ``bars`` N m/rad, and whether its differential is ``locked`` (1) or open (0).
    ``drive_front``, ``brake_front``: the front axle's share of ``drive`` and ``brake`` (drive 0: rear-wheel, 0.5:
    all-wheel with an open centre differential); ``surface``: a name of `SURFACES`; ``friction``: factor of its
    friction; ``low_speed`` and the tyres' coefficients: see `Tyre`. Wheels lean with the body, and push sideways if
    ``tyre_camber`` is given; ``camber_gains`` of the (front, rear) axle: how far the tops of its wheels lean in per
    metre that the body rises above them, rad/m. ``tyre_slip_push``: see ``slip_push`` of `Tyre`. ``scrub``: how much of
    the speed at which contacts move sideways below a rolling body the tyres feel: 1, or 0 as in CommonRoad's models.
    Joints: ``psi_*``, roll of each wheel, or of both wheels of a locked axle, rad; ``sigma``, tangent of the steering
    angle; ``heave`` m, ``pitch`` (nose down) and ``roll`` (left side up) rad of the body on its springs. Controls:
    ``drive`` on the driven axles, ``brake`` on all wheels and ``handbrake`` on the rear ones [N m], ``steering_rate``,
    the rate of sigma [1/s]. Channels: ``roll_*`` and Ackermann ``steer_*`` [rad]; ``slip_*``, speed of the contact over
    the ground [m/s], ``slip_ratio_*``, ``slip_angle_*`` [rad] and ``load_*`` [N] of each wheel.
    """
    tyre = Tyre(
        tyre_longitudinal, tyre_lateral, tyre_weights_longitudinal, tyre_weights_lateral, friction, low_speed,
        camber=tyre_camber, slip_push=tyre_slip_push,
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
        length, upright = mass_height + heave, 1 - (pitch**2 + roll**2) / 2
        x, y = length * pitch, -length * roll  # of the centre of mass
        along = xi[1] - xi[0] * y + length * pitching + pitch * rising
        across = xi[2] + xi[0] * x - length * rolling_over - roll * rising
        up = upright * rising - length * (pitch * pitching + roll * rolling_over)
        engine = sum(share[wheel[0]] * u[at[shaft]] / 2 for wheel, shaft in shafts.items())
        spin = wheel_inertia * sum(u[at[shaft]] ** 2 for shaft in shafts.values()) + engine_inertia * engine**2
        tilt = yaw_inertia * xi[0] ** 2 + pitch_inertia * pitching**2 + roll_inertia * rolling_over**2
        kinetic = (spin + tilt + mass * (along**2 + across**2 + up**2)) / 2
        return kinetic - mass * GRAVITY * length * upright

    def heading(wheel: str, r: Expr) -> tuple[Expr, Expr]:
        """Cosine and sine of a wheel's steering angle."""
        return (1.0, 0.0) if wheel[0] == "r" else steered(r[at["sigma"]], places[wheel][1] / wheelbase)

    def hub(wheel: str, r: Expr, xi: Expr, rolling_over: Expr = 0.0) -> Expr:
        """Velocity of a hub (2,), in the wheel's axes."""
        (cosine, sine), (x, y) = heading(wheel, r), places[wheel]
        along, across = xi[1] - y * xi[0], xi[2] + x * xi[0] - (1 - scrub) * mass_height * rolling_over
        return ca.vertcat(cosine * along + sine * across, cosine * across - sine * along)

    def rise(wheel: str, q: Expr) -> Expr:
        """How far, or fast, the body rises above a wheel."""
        (x, y), (heave, pitch, roll) = places[wheel], (q[at[joint]] for joint in BODY)
        return heave - x * pitch + y * roll

    def push(wheel: str, r: Expr, u: Expr) -> Expr:
        """Force of a spring, damper and bar, N; what is below zero would lift the wheel."""
        axle, y = "fr".index(wheel[0]), places[wheel][1]
        at_rest = statics[wheel[0]] - LIFTED**2 / (4 * statics[wheel[0]])
        force = at_rest - springs[axle] * rise(wheel, r) - dampers[axle] * rise(wheel, u)
        return force - bars[axle] * r[at["roll"]] / (2 * y)

    def slips(wheel: str, r: Expr, u: Expr, xi: Expr) -> tuple[Expr, Expr]:
        return tyre.slip(hub(wheel, r, xi, u[at["roll"]]), wheel_radius * u[at[shafts[wheel]]])

    def contacts(axle: str, r: Expr, u: Expr, xi: Expr) -> dict[str, tuple[Expr, Expr, Expr]]:
        """Of each wheel of an axle: the load, N, the part of it that the body's links push down, and the force over
        load (3,): along the wheel, along and across the car."""
        shares, k = {}, "fr".index(axle)
        for wheel in (w for w in places if w[0] == axle):
            lean = r[at["roll"]] + SIDES[wheel[1]] * camber_gains[k] * rise(wheel, r)
            force, (cosine, sine) = tyre.force(*slips(wheel, r, u, xi), lean), heading(wheel, r)
            along, across = cosine * force[0] - sine * force[1], sine * force[0] + cosine * force[1]
            shares[wheel] = ca.vertcat(force[0], along, across)
        # links push at right angles to a tilted body; what they push down is carried by both wheels alike
        down = {wheel: r[at["roll"]] * n[2] - r[at["pitch"]] * n[1] for wheel, n in shares.items()}
        links = sum(d * positive(push(w, r, u)) for w, d in down.items()) / (2 - sum(down.values()))
        return {wheel: (positive(push(wheel, r, u) + links), links, n) for wheel, n in shares.items()}

    def torques(u: Expr, c: Expr) -> Expr:
        on_joints = ca.SX.zeros(len(joints))
        for wheel, shaft in shafts.items():
            braking = {"f": brake_front, "r": 1 - brake_front}[wheel[0]] * c[1] + c[2] * (wheel[0] == "r")
            on_joints[at[shaft]] += share[wheel[0]] * c[0] / 2 + brake(braking / 2, wheel_radius * u[at[shaft]])
        return on_joints

    def forces(r: Expr, u: Expr, xi: Expr, c: Expr) -> tuple[Expr, Expr]:
        on_joints, on_body = torques(u, c), ca.SX.zeros(3)
        for wheel, (load, links, shares) in (contacts("f", r, u, xi) | contacts("r", r, u, xi)).items():
            (x, y), force = places[wheel], load * shares
            on_body += ca.vertcat(x * force[2] - y * force[1], force[1:])
            on_joints[at[shafts[wheel]]] -= wheel_radius * force[0]
            for joint, arm in zip(BODY, (1.0, -x, y), strict=True):
                on_joints[at[joint]] += arm * (load - links)
        return on_joints, on_body

    def rolling(r: Expr, xi: Expr) -> Expr:
        """Wheels that share a shaft turn at the mean of their speeds."""
        rates = ca.SX.zeros(len(joints))
        for wheel, shaft in shafts.items():
            rates[at[shaft]] += hub(wheel, r, xi)[0] / wheel_radius / sum(s == shaft for s in shafts.values())
        return rates

    def across(r: Expr, xi: Expr) -> Expr:
        """Sideways speeds of the axles' middles."""
        cosine, sine = steered(r[at["sigma"]])
        return ca.vertcat(cosine * (xi[2] + front * xi[0]) - sine * xi[1], xi[2] - rear * xi[0])

    def standing(r: Expr, u: Expr, xi: Expr, c: Expr, pull: Expr) -> Expr:
        spin = (u - rolling(r, xi))[[at[shaft] for shaft in dict.fromkeys(shafts.values())]]
        return held(tyre, mass, wheelbase, wheel_radius, spin, xi, c, pull)

    def roll_channel(wheel: str) -> Channel:
        return Channel(value=lambda t, r, u, xi, c: r[at[shafts[wheel]]])

    def slip_channel(wheel: str) -> Channel:
        def value(t: Expr, r: Expr, u: Expr, xi: Expr, c: Expr) -> Expr:
            return sliding(hub(wheel, r, xi, u[at["roll"]]), wheel_radius * u[at[shafts[wheel]]])

        return Channel(value=value, unit="m/s")

    def slips_channel(wheel: str, component: int) -> Channel:
        return Channel(value=lambda t, r, u, xi, c: slips(wheel, r, u, xi)[component], unit=SLIPS[component])

    def load_channel(wheel: str) -> Channel:
        return Channel(value=lambda t, r, u, xi, c: contacts(wheel[0], r, u, xi)[wheel][0], unit="N")

    return Nonholonomic(
        name=name,
        group=SE2,
        joints=joints,
        lagrangian=lagrangian,
        forces=forces,
        controls=CONTROLS,
        rate_controls={"steering_rate": "sigma"},
        rolling=rolling,
        across=across,
        torques=torques,
        standing=standing,
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
