"""Parts shared by vehicles on the plane: gravity along a slope, and the wheels of a car."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import casadi as ca

from vehsim.constants import GRAVITY
from vehsim.rig.rig import Channel
from vehsim.vehicles.definition.base import Expr


def slope_energy(mass: float, slope: Sequence[float], ahead: float = 0.0) -> Callable[[Expr, Expr], Expr] | None:
    """Potential energy (g, r) -> J of ``mass`` kg, ``ahead`` m along the body's X, on a plane that rises by ``slope``
    (2,) metres per metre along world X and Y. None when it is level.
    """
    rise_x, rise_y = (float(x) for x in slope)
    if rise_x == rise_y == 0:
        return None
    # component along the plane; the vehicle's coordinates are lengths along it
    weight = mass * GRAVITY / (1 + rise_x**2 + rise_y**2) ** 0.5

    def potential(g: Expr, r: Expr) -> Expr:
        return weight * (rise_x * (g[1] + ahead * ca.cos(g[0])) + rise_y * (g[2] + ahead * ca.sin(g[0])))

    return potential


def ackermann_channels(wheel_radius: float, wheelbase: float, half_track: float) -> dict[str, Channel]:
    """Channels of a car's wheels: ``roll_*`` of the four, each without slip, ``steer_*`` of the front two [rad].
    ``travel_*`` [m] rest until a terrain lifts the wheels (`vehsim.world.ground`).

    The car's body frame stands on its rear axle, its second joint is sigma, the tangent of the steering angle; lengths
    in m.
    """

    def rear(side: float) -> Channel:
        return Channel(rate=lambda t, r, u, xi, c: (xi[1] - side * half_track * xi[0]) / wheel_radius)

    def front(side: float) -> Channel:
        # the hub moves along the wheel's own heading, at the length of (1 - side b sigma / l, sigma) times vx
        def rate(t: Expr, r: Expr, u: Expr, xi: Expr, c: Expr) -> Expr:
            return xi[1] / wheel_radius * ca.sqrt((1 - side * half_track / wheelbase * r[1]) ** 2 + r[1] ** 2)

        return Channel(rate=rate)

    return {
        "roll_rl": rear(1.0),
        "roll_rr": rear(-1.0),
        "roll_fl": front(1.0),
        "roll_fr": front(-1.0),
        **steer_channels(wheelbase, half_track, 1),
        **{f"travel_{wheel}": Channel(value=lambda t, r, u, xi, c: 0.0) for wheel in ("rl", "rr", "fl", "fr")},
    }


def steer_channels(wheelbase: float, half_track: float, sigma: int) -> dict[str, Channel]:
    """Channels ``steer_fl`` and ``steer_fr`` [rad] of a car's front wheels; ``sigma``: the index of the joint that is
    the tangent of the steering angle; lengths in m."""

    def steer(side: float) -> Channel:
        # tan of a front wheel's angle: sigma / (1 - side * half_track * sigma / wheelbase), Ackermann
        ratio = side * half_track / wheelbase
        return Channel(value=lambda t, r, u, xi, c: ca.atan2(r[sigma], 1 - ratio * r[sigma]))

    return {"steer_fl": steer(1.0), "steer_fr": steer(-1.0)}
