"""The controls that keep a vehicle in balance, and whether joints alone propel it."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from vehsim.lie import SO3
from vehsim.planning.problem.nlpsol import nlpsol
from vehsim.vehicles import Vehicle
from vehsim.vehicles.definition.mechanics import conservative

Array = NDArray[np.float64]

MOST_LEAN = 1.2
"""Largest roll and pitch of a balance, rad."""


@dataclass(frozen=True)
class Trim:
    """Steady flight: ``controls`` (c,), ``roll`` and ``pitch`` rad (nose up), and the ``residual`` (n,) of force and
    torque that the controls' bounds leave, N and N m."""

    controls: Array
    roll: float
    pitch: float
    residual: Array


def trim(vehicle: Vehicle, wind: tuple[float, ...]) -> Array:
    """Controls (c,) that keep the vehicle at rest in the wind, as nearly as their bounds allow: level, or, in flight,
    at the attitude of balance (a helicopter leans against its tail rotor)."""
    return steady(vehicle, (0.0, 0.0, 0.0), wind).controls


@lru_cache(maxsize=64)
def steady(vehicle: Vehicle, velocity: tuple[float, ...], wind: tuple[float, ...] = (0.0, 0.0, 0.0)) -> Trim:
    """The balance of a vehicle that moves with a world ``velocity`` (3,) m/s and the heading zero, without turning.

    Its attitude is found too if it flies free; otherwise it is level.
    """
    if not vehicle.controls:
        return Trim(np.zeros(0), 0.0, 0.0, np.zeros(0))
    scale = np.array([control.scale for control in vehicle.controls])
    lower = np.array([control.lower for control in vehicle.controls]) / scale
    upper = np.array([control.upper for control in vehicle.controls]) / scale
    law, v = _standing(vehicle, velocity, wind), ca.SX.sym("v", len(scale))
    lean = ca.SX.sym("lean", 2 if _flies(vehicle) else 0)
    level = np.zeros(lean.shape[0])
    size = max(1.0, float(np.abs(np.asarray(law(np.zeros(len(scale)), np.zeros(2))[0])).max(initial=0.0)))
    tilted = lean if lean.shape[0] else ca.SX.zeros(2)
    missed = ca.sumsqr(law(v * scale, tilted)[0] / size) + 1e-12 * (ca.sumsqr(v) + ca.sumsqr(lean))
    options: Any = {"ipopt": {"tol": 1e-12, "print_level": 0, "sb": "yes"}, "print_time": False}
    solver = nlpsol("trim", "ipopt", {"x": ca.vertcat(v, lean), "f": missed}, options)
    bounded = np.isfinite(lower) & np.isfinite(upper)
    middle = (np.nan_to_num(lower) + np.nan_to_num(upper)) / 2
    start = np.where(bounded, middle, np.clip(0.0, lower + 1e-6, upper - 1e-6))
    bounds = {"lbx": np.append(lower, level - MOST_LEAN), "ubx": np.append(upper, level + MOST_LEAN)}
    found = np.asarray(solver(x0=np.append(start, level), **bounds)["x"]).ravel()
    controls, (roll, pitch) = found[: len(scale)] * scale, found[len(scale) :] if len(level) else (0.0, 0.0)
    residual = np.asarray(law(controls, np.array([roll, pitch]))[0]).ravel()
    return Trim(controls, float(roll), float(pitch), residual)


def leans(vehicle: Vehicle) -> float:
    """How far a flying vehicle leans at rest in still air, rad."""
    if not _flies(vehicle):
        return 0.0
    balance = steady(vehicle, (0.0, 0.0, 0.0))
    return float(np.hypot(balance.roll, balance.pitch))


def rests_uncontrolled(vehicle: Vehicle) -> bool:
    """Whether the vehicle stays at rest and level with its controls at zero."""
    still = (0.0, 0.0, 0.0)
    force = _standing(vehicle, still, still)(np.zeros(len(vehicle.controls)), np.zeros(2))[0]
    return bool(np.abs(np.asarray(force)).max(initial=0.0) < 1e-9)


def _flies(vehicle: Vehicle) -> bool:
    return bool(vehicle.group.dim == 6 and vehicle.hull is None and getattr(vehicle, "gravity", 0.0))


def _standing(vehicle: Vehicle, velocity: tuple[float, ...], wind: tuple[float, ...]) -> ca.Function:
    """A function of the controls (c,) and of roll and pitch (2,), rad: the force on the vehicle, and its derivative by
    the controls."""
    s, d, group = len(vehicle.joints), vehicle.group.dim, vehicle.group
    c, lean = ca.SX.sym("c", len(vehicle.controls)), ca.SX.sym("lean", 2)
    still = ca.SX(list(group.identity))
    moving = ca.SX.zeros(d)
    if _flies(vehicle):
        about = [
            ca.vertcat(ca.cos(a / 2), ca.sin(a / 2) * ca.DM(axis))
            for a, axis in ((lean[0], [1, 0, 0]), (-lean[1], [0, 1, 0]))
        ]
        attitude = SO3.compose(about[1], about[0])
        still = group.from_pose(ca.vertcat(0, 0, 0, attitude))
        body = SO3.matrix(attitude).T @ ca.DM(list(velocity))
        moving = group.velocity_from_body(still, ca.vertcat(ca.SX.zeros(3), body))
    joints = (ca.SX.zeros(s), ca.SX.zeros(s))
    forces = vehicle.force(still, *joints, moving, c, ca.SX(list(wind)))
    weight = conservative(vehicle, still, joints[0])
    residual = ca.densify(ca.vertcat(*(a + b for a, b in zip(forces, weight, strict=True))))
    return ca.Function("force", [c, lean], [residual, ca.densify(ca.jacobian(residual, c))])


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
