"""The boat of LIE 4.3.2: a hull in water with thrusters or a steered outboard, and wind.

On SE(3) it is a rigid body under gravity, and the world's water acts on it (`Hull`). Its ``planar`` form glides on calm
water on SE(2), with the same thrusters, rudder, wind, added mass and resistance in closed form.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Annotated, Any

import casadi as ca
import numpy as np
from annotated_types import Len

from vehsim.constants import AIR, SEA_WATER
from vehsim.errors import InputError
from vehsim.lie import SE2, SE3
from vehsim.rig.rig import Channel
from vehsim.vehicles.definition.base import Control, Expr
from vehsim.vehicles.definition.holonomic import Holonomic
from vehsim.vehicles.definition.hydrodynamics import Hull
from vehsim.vehicles.definition.quantities import (
    AddedMass,
    Angle,
    AngularRate,
    Area,
    Coefficient,
    Coordinate,
    Distance,
    Force,
    Length,
    LinearDamping,
    Mass,
    Place,
    Pressing,
    PrincipalInertia,
    QuadraticDamping,
    Share,
    With,
    Without,
)
from vehsim.vehicles.definition.resistance import ByCurves, Planing, Running, running

ANSWER = 0.5
"""Response time of a motor and its steering, s. Plans weigh the rate of the controls with its square, so that no plan
goes from full ahead to astern faster. Without this cost, a turn on the spot is a series of bursts ahead and astern."""


def boat(
    name: str = "boat",
    *,
    mass: Mass,
    inertia: PrincipalInertia,
    thrusters: Sequence[Place],
    outboard: Coefficient = 1.0,
    propeller_diameter: Length = 0.35,
    propeller_speed: AngularRate = 200.0,
    full_thrust: Force = 5000.0,
    rudder: Annotated[Place, With("rudder_area")] = (0.0, 0.0, 0.0),
    rudder_area: Area = 0.0,
    rudder_slope: Annotated[Coefficient, With("rudder_area")] = 4.0,
    skeg: Annotated[Share, With("outboard")] = 0.5,
    damping: Annotated[Sequence[LinearDamping], Len(3, 3)] = (0.0, 0.0, 0.0),
    damping_quadratic: Annotated[Sequence[QuadraticDamping], Len(3, 3)] = (0.0, 0.0, 0.0),
    wetted_centre: Coordinate = 0.0,
    wetted_radius: Distance = 0.0,
    reference_area: Area = 0.0,
    normal_force: Pressing = 0.0,
    impact: Coefficient = 0.0,
    planing: Annotated[Coefficient, Without("chine_beam")] = 0.0,
    impact_drag: Annotated[Sequence[QuadraticDamping], Len(2, 2)] = (0.0, 0.0),
    added_mass: Annotated[Sequence[AddedMass], Len(6, 6)] = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0),
    wetted_length: Distance = 0.0,
    wetted_area: Area = 0.0,
    form_factor: Annotated[Coefficient, With("wetted_area")] = 0.0,
    chine_beam: Distance = 0.0,
    deadrise: Annotated[Angle, With("chine_beam")] = 0.0,
    transom: Annotated[Sequence[Coordinate], Len(2, 2), With("chine_beam")] = (0.0, 0.0),
    running_centre: Annotated[Coordinate, With("running_radius")] = 0.0,
    running_radius: Annotated[Distance, With("wetted_area")] = 0.0,
    wind_area: Annotated[Sequence[Area], Len(2, 2)] = (0.0, 0.0),
    wind_centre: Annotated[Place, With("wind_area")] = (0.0, 0.0, 0.0),
    wind_coefficient: Annotated[Coefficient, With("wind_area")] = 1.0,
) -> Holonomic:
    """A boat. Positions are in the body frame, m from the centre of mass.

    ``mass`` kg, ``inertia`` (3,) principal, kg m^2. ``thrusters`` (p, 3): one outboard that steers (``outboard`` 1:
    controls thrust [N] and steering [rad], positive to port) or thrusters fixed along X (``outboard`` 0:
    LIE's controls, a thrust each [N], named right and left when they are two, and a steering when there is a rudder).
    Thrust fades as the propeller, ``propeller_diameter`` m, comes out of the water; at ``full_thrust`` N it turns at
    ``propeller_speed`` rad/s (channel ``propeller``). ``rudder``: a fin, or the outboard's leg, of ``rudder_area`` m^2
    and lift slope ``rudder_slope`` 1/rad, turned by the steering, except the share ``skeg`` of an outboard's, which is
    the keel's end and stands still: without it, a planing hull drifts as far as the helm is over, and skids.
    ``damping`` N s/m, ``damping_quadratic``, ``reference_area``, ``normal_force``, ``impact``, ``planing`` and
    ``added_mass``: see `Hull`; ``wetted_centre`` (x, m) and ``wetted_radius`` (root mean square of x, m) of the wetted
    surface carry the resistance over to ``planar``, and ``impact_drag`` (2,) N s^2/m^2, ahead and across, what
    ``impact`` and ``planing`` add to it. ``wetted_length`` m and ``wetted_area`` m^2 of the hull at rest add the
    friction of ITTC 1957, times 1 + ``form_factor``. With ``chine_beam`` m, ``deadrise`` rad and the end of the keel at
    the ``transom`` (x, z), m from the centre of mass, the boat planes as Savitsky's hulls: see
    `vehsim.vehicles.definition.resistance`; ``running_centre`` and ``running_radius`` m take the place of those of the
    wetted surface when it does.
    Wind: ``wind_area`` seen from ahead and from the side, m^2, pushed at ``wind_centre``, ``wind_coefficient``.
    """
    places = [tuple(map(float, place)) for place in thrusters]
    if outboard not in (0, 1):
        raise InputError(
            "neither 0 nor 1",
            "give 1 for an outboard that steers, 0 for thrusters that stand still",
            key="physics.outboard",
            value=outboard,
            subject=name,
        )
    if outboard and len(places) != 1:
        raise InputError(
            "an outboard is one thruster", "or set outboard = 0", key="physics.thrusters", value=places, subject=name
        )
    steered = bool(outboard) or rudder_area > 0
    pushes = ("thrust",) if len(places) == 1 else ("right", "left") if len(places) == 2 else None
    names = pushes or tuple(f"thrust_{k + 1}" for k in range(len(places)))
    controls = tuple(Control(n, -full_thrust, full_thrust, full_thrust / 2, "N") for n in names)
    if steered:
        controls += (Control("steering", -0.5236, 0.5236, 0.2, "rad"),)
    along = ca.DM([*map(float, rudder)])

    def propulsion(c: Expr, flow: Expr, immersion: Expr) -> Expr:
        """Thrust of every propeller, reduced when it comes out of the water, and the rudder's lift in the flow."""
        angle = c[len(places)] if steered else 0.0
        turn = angle if outboard else 0.0
        wrench = ca.SX(6, 1)
        for k, place in enumerate(places):
            force = immersion[k] * c[k] * ca.vertcat(ca.cos(turn), -ca.sin(turn), 0)
            wrench += ca.vertcat(ca.cross(ca.DM(list(place)), force), force)
        if rudder_area > 0:
            depth = sum((immersion[k] for k in range(len(places))), ca.SX(0)) / len(places)
            local = flow[3:6] + ca.cross(flow[0:3], along)
            speed = ca.sqrt(local[0] ** 2 + local[1] ** 2 + 1e-4)
            still = skeg if outboard else 0.0
            for share, turned in ((1 - still, angle), (still, 0.0)):
                # lift across the fin: area times slope times speed times the lateral speed; no stall and no drag
                fin = ca.vertcat(ca.sin(turned), ca.cos(turned), 0)
                area = share * rudder_area * depth
                force = -0.5 * SEA_WATER * area * rudder_slope * speed * ca.dot(local, fin) * fin
                wrench += ca.vertcat(ca.cross(along, force), force)
        return wrench

    def windage(air: Expr) -> Expr:
        at = ca.DM([*map(float, wind_centre)])
        local = air[3:6] + ca.cross(air[0:3], at)
        speed = ca.sqrt(local[0] ** 2 + local[1] ** 2 + 1e-4)
        force = -0.5 * AIR * wind_coefficient * speed * ca.vertcat(wind_area[0] * local[0], wind_area[1] * local[1], 0)
        return ca.vertcat(ca.cross(at, force), force)

    run = _running(name, mass, places, wetted_length, wetted_area, form_factor, chine_beam, deadrise, transom)
    curves = None if run is None else run.curves(impact_drag[1])
    a = [*map(float, added_mass)]

    def moving(twist: Expr) -> Expr:
        """Speeds through the water: ahead, and that of the hull's patches."""
        return ca.vertcat(twist[1], ca.sqrt(twist[1] ** 2 + twist[2] ** 2 + (wetted_radius * twist[0]) ** 2 + 1e-6))

    def resistance(twist: Expr, pieces: Expr | None = None) -> Expr:
        """`Hull`'s resistance for the upright hull; in a rotation about Z, patches move sideways in proportion to their
        distance."""
        speeds: Any = moving(twist)
        ahead, speed = speeds[0], speeds[1]
        rate, share, dry, pressed = 0.0, 0.0, 0.0, speed * impact_drag[1]
        if curves is not None:
            at = [None, None] if pieces is None else ca.horzsplit(pieces)
            rate, share, dry, _ = curves.at(ahead, at[0])
            *_, pressed = curves.at(speed, at[1])
        if not running_radius:
            share = 0.0
        along = damping[0] + speed * (damping_quadratic[0] + impact_drag[0]) + rate
        across = damping[1] + speed * damping_quadratic[1] + pressed
        middle = wetted_centre + share * (running_centre - wetted_centre)
        spread = wetted_radius**2 + share * (running_radius**2 - wetted_radius**2)
        force = ca.vertcat(
            -across * (middle * twist[2] + spread * twist[0]),
            -along * twist[1],
            -across * (twist[2] + middle * twist[0]),
        )
        return force - dry * _turned(a, twist)

    hull = Hull(
        damping=damping,
        quadratic=damping_quadratic,
        reference_area=reference_area or None,
        normal_force=normal_force,
        impact=impact,
        planing=planing,
        added_mass=added_mass,
        propulsion=propulsion,
        propulsors=places,
        propulsor_size=propeller_diameter,
        windage=windage if any(wind_area) else None,
        running=run,
    )
    channels = {"propeller": Channel(rate=_spin(len(places), propeller_speed, full_thrust))}
    if steered:
        channels["steer"] = Channel(value=lambda t, r, u, xi, c: -c[len(places)])
    common: dict[str, Any] = {"name": name, "controls": controls, "channels": channels, "feels_wind": any(wind_area)}
    common["default_costs"] = {"smoothness": ANSWER**2}

    def on_calm_water(twist: Expr, c: Expr, pieces: Expr | None = None) -> Expr:
        return resistance(twist, pieces) + _flat(propulsion(c, _level(twist), ca.SX.ones(len(places))))

    planar = Holonomic(
        group=SE2,
        inertia=(float(inertia[2]) + a[2], mass + a[3], mass + a[4]),
        resistance=on_calm_water if curves is None else ByCurves(on_calm_water, curves, moving),
        drag=(lambda air: _flat(windage(_level(air)))) if any(wind_area) else None,
        mass=mass,
        **common,
    )
    return Holonomic(group=SE3, inertia=(*inertia, mass, mass, mass), mass=mass, hull=hull, planar=planar, **common)


def _turned(added_mass: Sequence[float], twist: Expr) -> Expr:
    """Yaw moment and forces ahead and to the left of the water that a hull takes along (Kirchhoff): a rising hull takes
    less of it."""
    ahead, left = added_mass[3] * twist[1], added_mass[4] * twist[2]
    return ca.vertcat(ahead * twist[2] - left * twist[1], left * twist[0], -ahead * twist[0])


def _running(
    name: str,
    mass: float,
    thrusters: Sequence[Sequence[float]],
    length: float,
    area: float,
    form: float,
    beam: float,
    deadrise: float,
    transom: Sequence[float],
) -> Running | None:
    """The resistance of a hull with a wetted surface; it planes if it has a chine beam."""
    if bool(length) != bool(area) or (beam and not (length and transom[0] < 0)):
        key = "wetted_area" if length and not area else "wetted_length" if not length else "transom"
        remedy = "give wetted_length and wetted_area, and for a planing hull chine_beam, deadrise and transom too"
        raise InputError("missing", remedy, key=f"physics.{key}", subject=name)
    depth = -float(np.mean([place[2] for place in thrusters]))
    planing = Planing(beam, deadrise, -transom[0], -transom[1], depth, mass, length) if beam else None
    return running(mass, length, area, planing, form) if length else None


def _spin(count: int, speed: float, full: float) -> Callable[..., Expr]:
    """Propeller speed (rad/s) of the mean thrust: thrust grows with its square."""

    def rate(t: Expr, r: Expr, u: Expr, xi: Expr, c: Expr) -> Expr:
        thrust = ca.sum1(c[:count]) / count / full
        return speed * thrust / (thrust**2 + 1e-6) ** 0.25

    return rate


def _level(twist: Expr) -> Expr:
    """The twist (6,) of a body that moves in the plane with (yaw rate, x, y)."""
    return ca.vertcat(0, 0, twist, 0)


def _flat(wrench: Expr) -> Expr:
    """The planar components (yaw, x, y) of a wrench (6,)."""
    return wrench[2:5]
