"""The controls that keep a vehicle in balance, and whether joints alone propel it."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike, NDArray

from vehsim.lie import SO3
from vehsim.lie.quaternions import from_yaw, yaw_tilt
from vehsim.planning.problem.nlpsol import nlpsol
from vehsim.vehicles import Vehicle
from vehsim.vehicles.definition.mechanics import conservative_at_rest
from vehsim.world.ground.below import aloft
from vehsim.world.obstacles.articulated import swings_of

Array = NDArray[np.float64]

MOST_LEAN = 1.2
"""Largest roll and pitch of a balance, rad."""
BALANCED = 1e-4
"""Largest residual of a balance, as a share of the force without controls."""
DIRECTIONS = 16
"""Headings at which the lean in wind is computed."""


@dataclass(frozen=True)
class Trim:
    """Steady flight: ``controls`` (c,), ``roll`` and ``pitch`` rad (nose up), the ``residual`` (n,) of force and torque
    that the controls' bounds leave, N and N m, and the largest of either, ``size``, that acts without controls."""

    controls: Array
    roll: float
    pitch: float
    residual: Array
    size: float = 1.0

    @property
    def holds(self) -> bool:
        """Whether the controls balance the vehicle."""
        return bool(np.abs(self.residual).max(initial=0.0) < BALANCED * self.size)


def trim(vehicle: Vehicle, wind: tuple[float, ...]) -> Array:
    """Controls (c,) that keep the vehicle at rest in the wind, as nearly as their bounds allow: level, or, in flight,
    at the attitude of balance (a helicopter leans against its tail rotor)."""
    return steady(vehicle, (0.0, 0.0, 0.0), wind).controls


@lru_cache(maxsize=256)
def steady(vehicle: Vehicle, velocity: tuple[float, ...], wind: tuple[float, ...] = (0.0, 0.0, 0.0)) -> Trim:
    """The balance of a vehicle that moves with a world ``velocity`` (3,) m/s and the heading zero, without turning.

    Its attitude is found too if it flies free; otherwise it is level.
    """
    if not vehicle.controls:
        return Trim(np.zeros(0), 0.0, 0.0, np.zeros(0))
    law, scale = _standing(vehicle), np.array([control.scale for control in vehicle.controls])
    zero, air = np.zeros(len(scale)), (velocity, wind)
    force = np.ravel(np.asarray(law(zero, np.zeros(2), *air)[0]))
    size = max(1.0, float(np.abs(force).max(initial=0.0)))
    if not force.any() and all(control.lower <= 0 <= control.upper for control in vehicle.controls):
        return Trim(zero, 0.0, 0.0, force)  # nothing to solve, such as for a car at rest
    solver, bounds = _balancer(vehicle)
    found = np.asarray(solver(p=np.concatenate([*air, [size]]), **bounds)["x"]).ravel()
    controls, lean = found[: len(scale)] * scale, found[len(scale) :]
    roll, pitch = map(float, lean if len(lean) else np.zeros(2))
    residual, effect = map(np.asarray, law(controls, np.array([roll, pitch]), *air))
    idle = ~effect.any(axis=0)  # such as brakes at rest: a start within the bounds is not a reason to pull them
    controls[idle] = np.clip(0.0, *np.array([(control.lower, control.upper) for control in vehicle.controls]).T)[idle]
    return Trim(controls, roll, pitch, residual.ravel(), size)


@lru_cache(maxsize=16)
def _balancer(vehicle: Vehicle) -> tuple[ca.Function, dict[str, Array]]:
    """A solver for the controls over their scale and the lean that make the force of `_standing` vanish, with the
    parameters velocity (3,), wind (3,) and the size of the force; and the solver's bounds and start."""
    scale = np.array([control.scale for control in vehicle.controls])
    lower = np.array([control.lower for control in vehicle.controls]) / scale
    upper = np.array([control.upper for control in vehicle.controls]) / scale
    law, v, p = _standing(vehicle), ca.SX.sym("v", len(scale)), ca.SX.sym("p", 7)
    lean = ca.SX.sym("lean", 2 if flies(vehicle) else 0)
    tilted = lean if lean.shape[0] else ca.SX.zeros(2)
    missed = ca.sumsqr(law(v * scale, tilted, p[:3], p[3:6])[0] / p[6]) + 1e-12 * (ca.sumsqr(v) + ca.sumsqr(lean))
    options: Any = {"ipopt": {"tol": 1e-12, "print_level": 0, "sb": "yes"}, "print_time": False}
    solver = nlpsol("trim", "ipopt", {"x": ca.vertcat(v, lean), "f": missed, "p": p}, options)
    bounded, level = np.isfinite(lower) & np.isfinite(upper), np.zeros(lean.shape[0])
    middle = (np.nan_to_num(lower) + np.nan_to_num(upper)) / 2
    start = np.where(bounded, middle, np.clip(0.0, lower + 1e-6, upper - 1e-6))
    bounds = {"lbx": np.append(lower, level - MOST_LEAN), "ubx": np.append(upper, level + MOST_LEAN)}
    return solver, {"x0": np.append(start, level), **bounds}


def upright(vehicle: Vehicle, headings: ArrayLike, wind: ArrayLike = (0.0, 0.0, 0.0)) -> Array:
    """Orientations (n, 4) w, x, y, z in which the vehicle rests in the ``wind`` (3,) m/s, at headings (n,) rad: level,
    or, in flight, in balance. See `balanced`."""
    return balanced(vehicle, headings, wind)[0]


def balanced(
    vehicle: Vehicle, headings: ArrayLike, wind: ArrayLike = (0.0, 0.0, 0.0)
) -> tuple[Array, dict[str, Array]]:
    """The orientations of `upright`, and the channels (n,) of parts that turn there, such as a rotor's disc.

    The balance in wind is found at up to `DIRECTIONS` headings, between which it is interpolated by sines and cosines.
    """
    yaw = np.asarray(headings, float)
    if not flies(vehicle):
        return from_yaw(yaw), {}
    if not (vehicle.feels_wind and np.any(wind)):
        found = np.repeat(_balance(vehicle, 0.0, (0.0, 0.0, 0.0))[None], len(yaw), axis=0)
    elif len(yaw) <= DIRECTIONS:
        found = np.array([_balance(vehicle, angle, wind) for angle in yaw])
    else:
        table = np.fft.rfft([_balance(vehicle, k * 2 * np.pi / DIRECTIONS, wind) for k in range(DIRECTIONS)], axis=0)
        table[1:-1] *= 2  # the negative frequencies
        waves = np.exp(1j * np.outer(yaw, np.arange(len(table))))
        found = np.real(waves @ table) / DIRECTIONS
    roll, pitch, *turned = found.T
    return yaw_tilt(yaw, -pitch, roll), dict(zip(swings_of(vehicle), turned, strict=True))


def _balance(vehicle: Vehicle, yaw: float, wind: ArrayLike) -> Array:
    """Roll and pitch, nose up, rad, and the channels of the parts that turn, at rest with a heading in a wind; level if
    no attitude is in balance."""
    c, s, (x, y, z) = np.cos(yaw), np.sin(yaw), np.asarray(wind, float).tolist()
    balance, swings = (
        steady(vehicle, (0.0, 0.0, 0.0), (float(c * x + s * y), float(c * y - s * x), z)),
        swings_of(vehicle),
    )
    if not balance.holds:
        return np.zeros(2 + len(swings))
    joints, twist = ca.DM.zeros(len(vehicle.joints)), ca.DM.zeros(vehicle.group.dim)
    laws = [vehicle.channels[name].value for name in swings]
    turned = [float(law(0.0, joints, joints, twist, ca.DM(balance.controls))) for law in laws if law is not None]
    return np.array([balance.roll, balance.pitch, *turned])


def leans(vehicle: Vehicle) -> float:
    """How far a flying vehicle leans at rest in still air, rad."""
    if not flies(vehicle):
        return 0.0
    balance = steady(vehicle, (0.0, 0.0, 0.0))
    return float(np.hypot(balance.roll, balance.pitch))


def rests_uncontrolled(vehicle: Vehicle) -> bool:
    """Whether the vehicle stays at rest and level with its controls at zero."""
    force = _standing(vehicle)(np.zeros(len(vehicle.controls)), *(np.zeros(n) for n in (2, 3, 3)))[0]
    return bool(np.abs(np.asarray(force)).max(initial=0.0) < 1e-9)


def flies(vehicle: Vehicle) -> bool:
    """Whether the vehicle moves in space, under gravity and without a hull that floats."""
    return bool(vehicle.group.dim == 6 and vehicle.hull is None and getattr(vehicle, "gravity", 0.0))


@lru_cache(maxsize=16)
def _standing(vehicle: Vehicle) -> ca.Function:
    """A function of the controls (c,), roll and pitch (2,) rad, world velocity (3,) and wind (3,) m/s: the force on the
    vehicle, far above the ground if it flies, and its derivative by the controls."""
    vehicle = aloft(vehicle)
    s, d, group = len(vehicle.joints), vehicle.group.dim, vehicle.group
    c, lean, velocity, wind = (ca.SX.sym("x", n) for n in (len(vehicle.controls), 2, 3, 3))
    still = ca.SX(list(group.identity))
    moving = ca.SX.zeros(d)
    if flies(vehicle):
        about = [
            ca.vertcat(ca.cos(a / 2), ca.sin(a / 2) * ca.DM(axis))
            for a, axis in ((lean[0], [1, 0, 0]), (-lean[1], [0, 1, 0]))
        ]
        attitude = SO3.compose(about[1], about[0])
        still = group.from_pose(ca.vertcat(0, 0, 0, attitude))
        body = SO3.matrix(attitude).T @ velocity
        moving = group.velocity_from_body(still, ca.vertcat(ca.SX.zeros(3), body))
    joints = (ca.SX.zeros(s), ca.SX.zeros(s))
    forces = vehicle.force(still, *joints, moving, c, wind)
    weight = conservative_at_rest(vehicle, still, joints[0])
    residual = ca.densify(ca.vertcat(*(a + b for a, b in zip(forces, weight, strict=True))))
    return ca.Function("force", [c, lean, velocity, wind], [residual, ca.densify(ca.jacobian(residual, c))])


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
