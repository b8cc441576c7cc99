"""A truck with trailers, each coupled on the axle ahead (SIN sec. 3): a semi-trailer, or a road train of them."""

from __future__ import annotations

from collections.abc import Sequence

import casadi as ca

from vehsim.errors import InputError
from vehsim.lie import SE2
from vehsim.rig.rig import Channel
from vehsim.vehicles.definition.base import Control, Expr
from vehsim.vehicles.definition.nonholonomic import Nonholonomic
from vehsim.vehicles.definition.quantities import Distance, Inertia, Length, Mass
from vehsim.vehicles.definition.surfaces import SurfaceName


def truck(
    name: str = "truck",
    *,
    mass: Mass,
    wheel_inertia: Inertia,
    yaw_inertia: Inertia,
    wheel_radius: Length,
    wheelbase: Length,
    half_track: Distance,
    hitches: Sequence[Length] = (),
    trailer_masses: Sequence[Mass] = (),
    trailer_inertias: Sequence[Inertia] = (),
    surface: SurfaceName = "asphalt",
) -> Nonholonomic:
    """A tractor whose body frame stands on the rear axle, on the ground, and its trailers.

    Tractor: ``mass`` kg, ``wheel_inertia`` of the driven wheels, ``yaw_inertia`` about the rear axle kg m^2; radius of
    all wheels, wheelbase and half track m. Trailers from the front: ``hitches`` m from each axle to the one ahead,
    where it is coupled; masses on the axle and inertias about it. ``surface``: see `surfaces`.
    Joints: ``psi``, roll of the driven wheels, ``sigma = tan(steering angle)``, and for every trailer ``hitch_k``, its
    angle against what pulls it [rad]. Controls: ``torque`` on the driven axle [N m] and ``steering_rate`` of sigma
    [1/s].
    Channels: ``roll_*`` and Ackermann ``steer_*`` of the tractor's wheels, ``hitch_k``, ``roll_tk_l`` and
    ``roll_tk_r``. ``travel_*`` [m] of the same wheels, and ``hitch_pitch_k`` and ``hitch_roll_k`` of the trailers, rest
    until a terrain moves them (`vehsim.world.ground`).
    """
    rho, length, count = wheel_radius, wheelbase, len(hitches)
    if len(trailer_masses) != count or len(trailer_inertias) != count:
        raise InputError(
            f"{count} hitches, {len(trailer_masses)} trailer_masses, {len(trailer_inertias)} trailer_inertias",
            "give one of each for every trailer",
            subject=name,
        )

    def axles(r: Expr, u: Expr, xi: Expr) -> list[tuple[Expr, Expr, Expr]]:
        """Yaw rate and velocity along and across of the rear axle and every trailer's."""
        rows = [(xi[0], xi[1], xi[2])]
        for k, d in enumerate(hitches):
            turning, along, across = rows[-1]
            s, c, turning = ca.sin(r[2 + k]), ca.cos(r[2 + k]), turning + u[2 + k]
            rows.append((turning, c * along + s * across, c * across - s * along - d * turning))
        return rows

    def lagrangian(r: Expr, u: Expr, xi: Expr) -> Expr:
        energy = wheel_inertia * u[0] ** 2
        rows = zip(axles(r, u, xi), (mass, *trailer_masses), (yaw_inertia, *trailer_inertias), strict=True)
        for (turning, along, across), m, inertia in rows:
            energy += m * (along**2 + across**2) + inertia * turning**2
        return energy / 2

    def constraints(r: Expr) -> tuple[Expr, Expr]:
        u, xi = ca.SX.sym("u", 2 + count), ca.SX.sym("xi", 3)
        rolling = ca.vertcat(xi[0] - rho / length * r[1] * u[0], xi[1] - rho * u[0], xi[2])
        rows = ca.vertcat(rolling, *(across for _, _, across in axles(r, u, xi)[1:]))
        return ca.jacobian(rows, u), ca.jacobian(rows, xi)

    def forces(r: Expr, u: Expr, xi: Expr, c: Expr) -> Expr:
        return ca.vertcat(c[0], ca.SX.zeros(1 + count))

    def roll(axle: int, side: float) -> Channel:
        def rate(t: Expr, r: Expr, u: Expr, xi: Expr, c: Expr) -> Expr:
            turning, along, _ = axles(r, u, xi)[axle]
            return (along - side * half_track * turning) / rho

        return Channel(rate=rate)

    def front(side: float) -> Channel:
        gain = side * half_track / length
        return Channel(rate=lambda t, r, u, xi, c: xi[1] / rho * ca.sqrt((1 - gain * r[1]) ** 2 + r[1] ** 2))

    def steer(side: float) -> Channel:
        return Channel(value=lambda t, r, u, xi, c: ca.atan2(r[1], 1 - side * half_track / length * r[1]))

    def hitch(k: int) -> Channel:
        return Channel(value=lambda t, r, u, xi, c: r[2 + k])

    sides = {"l": 1.0, "r": -1.0}
    channels = {f"roll_r{n}": roll(0, side) for n, side in sides.items()}
    channels |= {f"roll_f{n}": front(side) for n, side in sides.items()}
    channels |= {f"steer_f{n}": steer(side) for n, side in sides.items()}
    channels |= {f"hitch_{k + 1}": hitch(k) for k in range(count)}
    channels |= {f"roll_t{k + 1}_{n}": roll(k + 1, side) for k in range(count) for n, side in sides.items()}
    still = Channel(value=lambda t, r, u, xi, c: 0.0)
    channels |= {name.replace("roll", "travel"): still for name in [*channels] if name.startswith("roll_")}
    channels |= {f"hitch_{tilt}_{k + 1}": still for tilt in ("pitch", "roll") for k in range(count)}
    return Nonholonomic(
        name=name,
        surface=surface,
        group=SE2,
        joints=("psi", "sigma", *(f"hitch_{k + 1}" for k in range(count))),
        lagrangian=lagrangian,
        constraints=constraints,
        forces=forces,
        controls=(Control("torque", unit="N m"), Control("steering_rate", unit="1/s")),
        rate_controls={"steering_rate": "sigma"},
        channels=channels,
    )
