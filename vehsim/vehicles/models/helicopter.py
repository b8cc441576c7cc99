"""The helicopter of LIE 4.3.1 and SYM III.A on SO(3) x R^3, with the aerodynamics that its trim depends on.

Thrusts and the tilt of the disc are the controls, so that the equations stay explicit; rotors add their torque and
in-plane drag, the fuselage and the tail surfaces their forces and moments. Without these numbers, it is the papers'.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated

import casadi as ca
from annotated_types import Len

from vehsim.constants import AIR
from vehsim.lie import SO3xR3
from vehsim.rig.rig import CONING, DISC_PITCH, DISC_ROLL, Channel
from vehsim.vehicles.definition.base import Control, Expr
from vehsim.vehicles.definition.holonomic import Holonomic
from vehsim.vehicles.definition.quantities import (
    Angle,
    AngularRate,
    Area,
    Coefficient,
    Coordinate,
    Distance,
    JointDamping,
    LinearDamping,
    Mass,
    MomentVolume,
    PrincipalInertia,
    QuadraticDamping,
    SignedAngle,
    Stiffness,
    With,
)
from vehsim.vehicles.models.rotor import Rotor

HEADING_HOLD = 10.0
"""Weight of the squared yaw rate, in s: our choice, with which a cruise of 5 m/s deviates by less than a degree."""


def helicopter(
    name: str = "helicopter",
    *,
    mass: Mass,
    inertia: PrincipalInertia,
    d_t: Coordinate,
    d_r: Coordinate,
    hub_ahead: Coordinate = 0.0,
    tail_height: Coordinate = 0.0,
    mast_tilt: SignedAngle = 0.0,
    hub_stiffness: Stiffness = 0.0,
    rotor_radius: Distance = 0.0,
    solidity: Annotated[Coefficient, With("rotor_radius")] = 0.0,
    tail_radius: Annotated[Distance, With("rotor_radius")] = 0.0,
    tail_solidity: Annotated[Coefficient, With("tail_radius")] = 0.0,
    lock_number: Annotated[Coefficient, With("rotor_radius")] = 0.0,
    blades_up: Annotated[Angle, With("rotor_radius")] = 0.0,
    profile_drag: Annotated[Coefficient, With("rotor_radius")] = 0.01,
    induced_factor: Annotated[Coefficient, With("rotor_radius")] = 1.15,
    drag_linear: Annotated[Sequence[LinearDamping], Len(3, 3)] = (0.0, 0.0, 0.0),
    drag_quadratic: Annotated[Sequence[QuadraticDamping], Len(3, 3)] = (0.0, 0.0, 0.0),
    drag_angular: Annotated[Sequence[JointDamping], Len(3, 3)] = (0.0, 0.0, 0.0),
    hub_drag: Area = 0.0,
    fuselage_moments: Annotated[Sequence[MomentVolume], Len(3, 3)] = (0.0, 0.0, 0.0),
    stabiliser_area: Area = 0.0,
    stabiliser_behind: Annotated[Distance, With("stabiliser_area")] = 0.0,
    stabiliser_angle: Annotated[SignedAngle, With("stabiliser_area")] = 0.0,
    fin_area: Area = 0.0,
    fin_behind: Annotated[Distance, With("fin_area")] = 0.0,
    fin_height: Annotated[Coordinate, With("fin_area")] = 0.0,
    fin_angle: Annotated[SignedAngle, With("fin_area")] = 0.0,
    main_rotor_speed: AngularRate = 40.0,
    tail_rotor_speed: AngularRate = 200.0,
) -> Holonomic:
    """A rigid fuselage carried by a tilting thrust and a tail force.

    ``mass`` kg; ``inertia`` (3,) principal, kg m^2; the thrust acts ``d_t`` m above the centre of mass and
    ``hub_ahead`` m ahead of it, the tail force ``d_r`` m behind it and ``tail_height`` m above it, along -Y. Controls:
    collective, the thrust [N], yaw [N], pitch and roll of the rotor disc against the mast [rad]; the mast leans
    forward by ``mast_tilt``. ``hub_stiffness`` N m/rad: moment of the hub per tilt of the disc. With a
    ``rotor_radius``, the torque of the main rotor, which turns counter-clockwise seen from above, acts on the fuselage;
    with a ``tail_radius``, the tail rotor needs power too. ``solidity``, ``tail_solidity``, ``profile_drag``,
    ``induced_factor``: see `Rotor`. ``lock_number``: lift of a blade over its inertia, ``rho a c R^4 / I``; with it,
    blades cone with the thrust, on a channel that starts at ``blades_up`` rad, the coning of the asset at rest.
    Against the air: ``drag_linear`` N s/m and ``drag_quadratic`` N s^2/m^2 per body axis, ``drag_angular`` N m s;
    ``hub_drag`` m^2, drag of hub and mast over dynamic pressure, at the place of the thrust; ``fuselage_moments`` m^3,
    moments over dynamic pressure: nose-up at zero incidence, nose-up per angle of attack, and nose-right per sideslip
    to the right. Stabiliser and fin: area times lift slope, m^2; distance behind the centre of mass; angles that lift
    the tail and push it to the right.
    """
    main, tail = (
        Rotor(radius, speed, blades, profile_drag, induced_factor)
        for radius, speed, blades in (
            (rotor_radius, main_rotor_speed, solidity),
            (tail_radius, tail_rotor_speed, tail_solidity),
        )
    )
    hub, tail_hub = ca.DM([hub_ahead, 0.0, d_t]), ca.DM([-d_r, 0.0, tail_height])

    def direction(c: Expr) -> Expr:
        """Unit vector of the thrust, LIE 4.3.1, on a mast that leans forward."""
        pitch, roll = c[2] + mast_tilt, c[3]
        return ca.vertcat(ca.sin(pitch) * ca.cos(roll), -ca.sin(roll), ca.cos(pitch) * ca.cos(roll))

    def wrench(c: Expr) -> Expr:
        """LIE 4.3.1, F(gamma) u, with the moment of the hub."""
        thrust, force = c[0] * direction(c), ca.vertcat(0, -c[1], 0)
        torque = ca.cross(hub, thrust) + ca.cross(tail_hub, force)
        if hub_stiffness:
            torque += hub_stiffness * ca.vertcat(ca.sin(c[3]), ca.sin(c[2]), 0)
        return ca.vertcat(torque, thrust + force)

    def main_power(air: Expr, c: Expr, height: Expr) -> Expr:
        """Power of the main rotor, W, ``d_t`` above a centre of mass at a ``height`` m above the ground."""
        along = ca.dot(direction(c), air[3:6])
        return main.power(c[0], along, ca.sumsqr(air[3:6]) - along**2 + 1e-6, height + d_t)

    def power(air: Expr, c: Expr, height: Expr) -> Expr:
        """Power of both rotors, W."""
        total = main_power(air, c, height)
        if tail_radius:
            across = air[3] ** 2 + air[5] ** 2 + 1e-6
            total += tail.power(c[1], -air[4], across)
        return total

    def torque(air: Expr, c: Expr, height: Expr) -> Expr:
        """The reaction of the main rotor's torque on the fuselage."""
        about = main_power(air, c, height) / main.speed
        return -about * ca.vertcat(ca.sin(mast_tilt), 0, ca.cos(mast_tilt))

    linear, quadratic, angular = (ca.DM(list(map(float, d))) for d in (drag_linear, drag_quadratic, drag_angular))
    surfaces = [
        (axis, area, ca.DM([-behind, 0.0, height]), angle)
        for axis, area, behind, height, angle in (
            (2, stabiliser_area, stabiliser_behind, 0.0, -stabiliser_angle),
            (1, fin_area, fin_behind, fin_height, fin_angle),
        )
        if area
    ]
    lift, attack, slip = (AIR / 2 * float(m) for m in fuselage_moments)

    def drag(air: Expr) -> Expr:
        v = air[3:6]
        # |v| made smooth at rest, so that an optimiser sees a derivative there
        speed = ca.sqrt(ca.dot(v, v) + 1e-6)
        force = -(linear * v + quadratic * speed * v)
        moment = -angular * air[0:3] - v[0] * ca.vertcat(0, lift * speed - attack * v[2], slip * v[1])
        if rotor_radius:
            in_plane = -main.drag * ca.vertcat(v[0], v[1], 0)
            force, moment = force + in_plane, moment + ca.cross(hub, in_plane)
        if hub_drag:
            behind = -AIR / 2 * hub_drag * speed * v
            force, moment = force + behind, moment + ca.cross(hub, behind)
        for axis, area, place, angle in surfaces:
            push = ca.SX(3, 1)
            push[axis] = -AIR / 2 * area * speed * (v[axis] + angle * speed)
            force, moment = force + push, moment + ca.cross(place, push)
        return ca.vertcat(moment, force)

    def coning(thrust: Expr) -> Expr:
        """Coning of the blades above that of the asset at rest, rad."""
        cones = lock_number and solidity and rotor_radius
        return main.coning(thrust, lock_number) - blades_up if cones else 0 * thrust

    has_drag = any((*drag_linear, *drag_quadratic, *drag_angular, *fuselage_moments))
    has_drag = has_drag or bool(rotor_radius or hub_drag or stabiliser_area or fin_area)
    return Holonomic(
        name=name,
        group=SO3xR3,
        inertia=(*inertia, mass, mass, mass),
        controls=tuple(Control(n) for n in ("collective", "yaw", "pitch", "roll")),
        wrench=wrench,
        drag=drag if has_drag else None,
        rotors=torque if rotor_radius else None,
        power=power if rotor_radius else None,
        # nose first; the torque of a rotor changes with speed, and letting it swing the nose would save a little effort
        default_costs={"course": 1.0} | ({"turning": HEADING_HOLD} if rotor_radius else {}),
        channels={
            # the disc stands across the thrust: `direction` is R_y(pitch) R_x(roll) e_z on an upright mast
            DISC_PITCH: Channel(value=lambda t, r, u, xi, c: c[2]),
            DISC_ROLL: Channel(value=lambda t, r, u, xi, c: c[3]),
            CONING: Channel(value=lambda t, r, u, xi, c: coning(c[0])),
            "main_rotor": Channel(rate=lambda t, r, u, xi, c: main_rotor_speed),
            "tail_rotor": Channel(rate=lambda t, r, u, xi, c: tail_rotor_speed),
        },
    )
