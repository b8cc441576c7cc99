"""The steepest slope on which a vehicle stands whose tyres may slip, and how fast it creeps down others.

Friction is rounded near its peak, so it bears a little less than the pull of the weight: tyres slip slowly under what
is left.
"""

from __future__ import annotations

import math
from functools import lru_cache

import casadi as ca
import numpy as np

from vehsim.constants import GRAVITY
from vehsim.vehicles.definition.vehicle import Vehicle

SEEN = 1e-3
"""Speed, m/s, up to which a vehicle stands: the audit's tolerance of rest."""
BEYOND = 100.0
"""A slope, m/m, on which no tyre holds."""
HALVINGS = 30
"""Number of halvings that find the steepest slope."""


@lru_cache(maxsize=64)
def steepest(vehicle: Vehicle, speed: float = SEEN) -> float:
    """The steepest slope, m/m, on which a vehicle with its brakes on creeps with a ``speed``, m/s, at most; infinite if
    its tyres never slip."""
    if vehicle.standing is None:
        return math.inf
    low, high = 0.0, peak(vehicle)
    for _ in range(HALVINGS):
        middle = (low + high) / 2
        low, high = (middle, high) if creep(vehicle, middle) <= speed else (low, middle)
    return low


def peak(vehicle: Vehicle) -> float:
    """The greatest force over weight of its standing tyres: on a steeper slope, the vehicle slides. Infinite if they
    never slip."""
    return math.inf if vehicle.standing is None else float(_on_slope(vehicle)(BEYOND)[0])


def creep(vehicle: Vehicle, slope: float) -> float:
    """Speed, m/s, at which a vehicle with its brakes on creeps along or across a ``slope``, m/m, that is less steep
    than its `peak`: the greater one."""
    return float(np.abs(np.asarray(_on_slope(vehicle)(slope)[1])).max())


def braked(vehicle: Vehicle) -> list[float]:
    """Controls (c,) with the brakes on, which are the controls that only pull one way."""
    return [control.upper if control.lower == 0 else 0.0 for control in vehicle.controls]


@lru_cache(maxsize=16)
def _on_slope(vehicle: Vehicle) -> ca.Function:
    """A function of the slope, m/m: the force over weight that friction bears across the vehicle, and the speeds (2,)
    m/s along and across it at which the slip of its tyres and its brakes bear the rest."""
    assert vehicle.standing is not None
    s, driven = len(vehicle.joints), {*vehicle.rate_controls.values(), *(vehicle.attitude or ())}
    wheels = [k for k, joint in enumerate(vehicle.joints) if joint not in driven]
    slope, r, u, xi = ca.SX.sym("slope"), ca.SX.zeros(s), ca.SX.sym("u", s), ca.SX.sym("xi", 3)
    brakes = ca.SX(braked(vehicle))
    on_joints, on_body = vehicle.force(ca.SX.zeros(3), r, u, xi, brakes, ca.SX.zeros(3))
    forces, rates = ca.vertcat(on_joints[wheels], on_body), ca.vertcat(u[wheels], xi)
    at_rest = ca.vertcat(u, xi), ca.SX.zeros(s + 3)
    resistance = ca.substitute(ca.jacobian(forces, rates), *at_rest)
    mass = ca.substitute(ca.hessian(vehicle.reduced_lagrangian(r, u, xi), xi)[0][1, 1], *at_rest)
    speeds, held = [], ca.SX(0)
    for k in (1, 2):  # along and across
        pull = ca.SX.zeros(3)
        pull[k] = mass * GRAVITY * slope
        held = vehicle.standing(r, ca.SX.zeros(s), ca.SX.zeros(3), brakes, pull)
        left = ca.vertcat(ca.SX.zeros(len(wheels)), pull - held)
        speeds.append(ca.solve(resistance, left)[len(wheels) + k])
    return ca.Function("on_slope", [slope], [held[2] / (mass * GRAVITY), ca.vertcat(*speeds)])
