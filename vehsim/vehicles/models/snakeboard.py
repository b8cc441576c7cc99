"""The snakeboard of LIE 5.2.2: a rider's twist and turned feet build up speed without pushing off."""

from __future__ import annotations

from collections.abc import Callable

import casadi as ca

from vehsim.lie import SE2
from vehsim.rig.rig import Channel
from vehsim.vehicles.definition.base import Control, Expr
from vehsim.vehicles.definition.nonholonomic import Nonholonomic
from vehsim.vehicles.definition.quantities import Distance, Inertia, JointDamping, Length, Mass, Slope
from vehsim.vehicles.models.ground import slope_energy
from vehsim.vehicles.models.rider import Legs

PELVIS, GAZE = 0.5, -0.7
"""How far the pelvis turns with the torso's twist, and the head against it, as shares of psi."""


def snakeboard(
    name: str = "snakeboard",
    *,
    mass: Mass,
    half_length: Length,
    rotor_inertia: Inertia,
    steering_inertia: Inertia,
    wheel_radius: Length = 0.03,
    half_track: Distance = 0.1,
    shin: Length = 0.43,
    thigh: Length = 0.43,
    hip_rise: Length = 0.68,
    hip_spread: Distance = 0.09,
    slope: Slope = (0.0, 0.0),
    damping: JointDamping = 0.0,
) -> Nonholonomic:
    """A board whose body frame stands at its centre, between two trucks turned by opposite angles.

    ``mass`` kg; ``half_length`` (LIE's l) from the centre to either truck, m; ``rotor_inertia`` (I) of the torso and
    ``steering_inertia`` (J) of either truck with the foot on it, kg m^2. As LIE has it, all of it together
    turns with ``mass * half_length^2``. Wheel radius and half track, the rider's shin and thigh, the rise of the hip
    joints above the ankles and half the distance between them, all in m, serve the channels;
    ``slope`` (2,) rise per metre along world X and Y; ``damping`` N m s/rad of both joints.
    Joints: ``psi``, torso against board, and ``phi``, the rear truck's angle, the front's being ``-phi`` [rad].
    Controls: ``torque_psi`` and ``torque_phi`` on them [N m]. Channels [rad]: ``hips``, ``foot_front``,
    ``foot_rear`` and ``roll_fl``, ``roll_fr``, ``roll_rl``, ``roll_rr`` of the wheels; of the rider ``pelvis``, which
    turns half as far as the torso, ``gaze``, and ``leg_*``, ``shin_*``, ``knee_*``, front and rear, from rest.
    The constraints lose rank where the trucks stand across the board, ``phi = +-pi/2``.
    """
    length, inertia = half_length, mass * half_length**2

    def lagrangian(r: Expr, u: Expr, xi: Expr) -> Expr:
        rotor = rotor_inertia * (u[0] ** 2 + 2 * u[0] * xi[0])
        board = inertia * xi[0] ** 2 + mass * (xi[1] ** 2 + xi[2] ** 2)
        return (rotor + 2 * steering_inertia * u[1] ** 2 + board) / 2

    def constraints(r: Expr) -> tuple[Expr, Expr]:
        s, c = ca.sin(r[1]), ca.cos(r[1])
        return ca.SX(2, 2), ca.vertcat(ca.horzcat(-length * c, -s, c), ca.horzcat(length * c, s, c))

    def roll(end: float, side: float) -> Callable[..., Expr]:
        """Rate of a wheel: its hub's speed along its own heading, ``-end phi``."""

        def rate(t: Expr, r: Expr, u: Expr, xi: Expr, c: Expr) -> Expr:
            heading, turning = -end * r[1], xi[0] - end * u[1]
            across = xi[2] + end * length * xi[0]
            truck = ca.cos(heading) * xi[1] + ca.sin(heading) * across
            return (truck - side * half_track * turning) / wheel_radius

        return rate

    legs = Legs(shin, thigh, hip_rise, hip_spread, half_length)

    def leg(end: float, which: int) -> Callable[..., Expr]:
        """An angle of a leg, relative to its value at rest."""
        rest = legs.angles(end, 0.0, 0.0)[which]
        return lambda t, r, u, xi, c: legs.angles(end, PELVIS * r[0], -end * r[1])[which] - rest

    ends, angles = {"front": 1.0, "rear": -1.0}, ("leg", "shin", "knee")
    wheels = {"fl": (1.0, 1.0), "fr": (1.0, -1.0), "rl": (-1.0, 1.0), "rr": (-1.0, -1.0)}
    return Nonholonomic(
        name=name,
        group=SE2,
        joints=("psi", "phi"),
        lagrangian=lagrangian,
        constraints=constraints,
        forces=lambda r, u, xi, c: c - damping * u,
        potential_energy=slope_energy(mass, slope),
        controls=(Control("torque_psi", unit="N m"), Control("torque_phi", unit="N m")),
        channels={
            "hips": Channel(value=lambda t, r, u, xi, c: r[0]),
            "foot_front": Channel(value=lambda t, r, u, xi, c: -r[1]),
            "foot_rear": Channel(value=lambda t, r, u, xi, c: r[1]),
            "pelvis": Channel(value=lambda t, r, u, xi, c: PELVIS * r[0]),
            "gaze": Channel(value=lambda t, r, u, xi, c: GAZE * r[0]),
            **{f"{a}_{n}": Channel(value=leg(end, k)) for n, end in ends.items() for k, a in enumerate(angles)},
            **{f"roll_{wheel}": Channel(rate=roll(*place)) for wheel, place in wheels.items()},
        },
    )
