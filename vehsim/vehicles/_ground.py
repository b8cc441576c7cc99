"""What vehicles on the plane share: gravity along a slope, and damping of their joints."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import casadi as ca

from vehsim.vehicles._base import Expr
from vehsim.vehicles.holonomic import GRAVITY


def slope_energy(mass: float, slope: Sequence[float], ahead: float = 0.0) -> Callable[[Expr, Expr], Expr] | None:
    """Potential energy (g, r) -> J of ``mass`` kg, ``ahead`` m along the body's X, on a plane that rises by ``slope``
    (2,) metres per metre along world X and Y. None when it is level.
    """
    rise_x, rise_y = (float(x) for x in slope)
    if rise_x == rise_y == 0:
        return None
    # along the plane, of which the vehicle's coordinates are lengths
    weight = mass * GRAVITY / (1 + rise_x**2 + rise_y**2) ** 0.5

    def potential(g: Expr, r: Expr) -> Expr:
        return weight * (rise_x * (g[1] + ahead * ca.cos(g[0])) + rise_y * (g[2] + ahead * ca.sin(g[0])))

    return potential
