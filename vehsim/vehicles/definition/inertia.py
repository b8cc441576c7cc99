"""Mass and inertia of a vehicle, as its equations have them."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def known_inertia(vehicle: Any) -> tuple[float, Array | None] | None:
    """The vehicle's mass, kg, and the inertia (6, 6) of one rigid body, rotation first; None if its equations do not
    say."""
    import casadi as ca

    if hasattr(vehicle, "inertia"):
        matrix = np.asarray(vehicle.inertia, float)
        return float(matrix[-1, -1] if vehicle.mass is None else vehicle.mass), matrix if len(matrix) == 6 else None
    if not hasattr(vehicle, "lagrangian"):
        return None
    rest, xi = ca.SX(len(vehicle.joints), 1), ca.SX.sym("xi", vehicle.group.dim)
    hessian = ca.hessian(vehicle.lagrangian(rest, rest, xi), xi)[0]
    return float(ca.Function("mass", [xi], [hessian])(0)[-1, -1]), None
