"""The controls that keep a vehicle in balance, and whether joints alone propel it."""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from vehsim.planning.problem.nlpsol import nlpsol
from vehsim.vehicles import Vehicle
from vehsim.vehicles.definition.mechanics import conservative

Array = NDArray[np.float64]


@lru_cache(maxsize=64)
def trim(vehicle: Vehicle, wind: tuple[float, ...]) -> Array:
    """Controls (c,) that keep the vehicle at rest and level in the wind, as nearly as their bounds allow."""
    if not vehicle.controls:
        return np.zeros(0)
    scale = np.array([control.scale for control in vehicle.controls])
    lower = np.array([control.lower for control in vehicle.controls]) / scale
    upper = np.array([control.upper for control in vehicle.controls]) / scale
    law, v = _standing(vehicle, wind), ca.SX.sym("v", len(scale))
    size = max(1.0, float(np.abs(np.asarray(law(np.zeros(len(scale)))[0])).max(initial=0.0)))
    missed = ca.sumsqr(law(v * scale)[0] / size) + 1e-12 * ca.sumsqr(v)
    options: Any = {"ipopt": {"tol": 1e-12, "print_level": 0, "sb": "yes"}, "print_time": False}
    solver = nlpsol("trim", "ipopt", {"x": v, "f": missed}, options)
    bounded = np.isfinite(lower) & np.isfinite(upper)
    middle = (np.nan_to_num(lower) + np.nan_to_num(upper)) / 2
    start = np.where(bounded, middle, np.clip(0.0, lower + 1e-6, upper - 1e-6))
    return np.asarray(solver(x0=start, lbx=lower, ubx=upper)["x"]).ravel() * scale


def rests_uncontrolled(vehicle: Vehicle) -> bool:
    """Whether the vehicle stays at rest and level with its controls at zero."""
    force = _standing(vehicle, (0.0, 0.0, 0.0))(np.zeros(len(vehicle.controls)))[0]
    return bool(np.abs(np.asarray(force)).max(initial=0.0) < 1e-9)


def _standing(vehicle: Vehicle, wind: tuple[float, ...]) -> ca.Function:
    """A function of the controls (c,): the force on the vehicle at rest and level in the wind, and its derivative."""
    s, d = len(vehicle.joints), vehicle.group.dim
    c = ca.SX.sym("c", len(vehicle.controls))
    still = ca.SX(list(vehicle.group.identity))
    forces = vehicle.force(still, ca.SX.zeros(s), ca.SX.zeros(s), ca.SX.zeros(d), c, ca.SX(list(wind)))
    weight = conservative(vehicle, still, ca.SX.zeros(s))
    residual = ca.densify(ca.vertcat(*(a + b for a, b in zip(forces, weight, strict=True))))
    return ca.Function("force", [c], [residual, ca.densify(ca.jacobian(residual, c))])


def swims(vehicle: Vehicle) -> bool:
    """Whether the only controls are torques on joints that swing, as on a snakeboard."""
    s = len(vehicle.joints)
    pushed = s > 0 and len(vehicle.dynamic) == s == len(vehicle.controls) == len(vehicle.joint_limits)
    return bool(pushed and vehicle.basis(ca.SX.zeros(s)).shape[1])


def is_pushed(vehicle: Vehicle) -> bool:
    """Whether controls or joints push or turn the vehicle as a whole: in free fall they do not."""
    s, d = len(vehicle.joints), vehicle.group.dim
    g, r, u, xi = (ca.SX.sym("x", n) for n in (len(vehicle.group.identity), s, s, d))
    c, wind = ca.SX.sym("c", len(vehicle.controls)), ca.SX.zeros(3)
    on_body = vehicle.force(g, r, u, xi, c, wind)[1]
    return bool(ca.jacobian(on_body, ca.vertcat(c, r, u)).nnz() or vehicle.basis(r).shape[1] != d)
