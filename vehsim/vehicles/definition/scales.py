"""Sizes of typical controls, for vehicles that give none: an optimiser fails where forces of kilonewtons are measured
in newtons, and an effort in squared newtons makes motions crawl."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import TYPE_CHECKING

import casadi as ca
import numpy as np

from vehsim.vehicles.definition.mechanics import free_size, free_velocity, project

if TYPE_CHECKING:
    from vehsim.vehicles.definition.base import Control
    from vehsim.vehicles.definition.vehicle import Vehicle

DIGITS = 2
"""Significant digits of a size, so that it does not depend on the machine."""


def scaled(vehicle: Vehicle) -> tuple[Control, ...]:
    """The vehicle's controls; those that give no scale have the usual one, or 1."""
    if not any(math.isnan(control.scale) for control in vehicle.controls):
        return vehicle.controls
    usual = usual_scales(vehicle)
    return tuple(
        replace(control, scale=usual.get(control.name, 1.0)) if math.isnan(control.scale) else control
        for control in vehicle.controls
    )


def usual_scales(vehicle: Vehicle) -> dict[str, float]:
    """By control name, what accelerates a vehicle as strongly as 1 m/s^2 does, by the energy norm: its whole mass or,
    of what only turns, its inertia at 1 rad/s^2. Rate controls, and controls without force at rest, are left out."""
    s, n, size = len(vehicle.joints), free_size(vehicle), len(vehicle.controls)
    r, z, c = ca.SX.sym("r", s), ca.SX.sym("z", n), ca.SX.sym("c", size)
    u, xi = free_velocity(vehicle, r, z, ca.SX(s, 1))
    inertia = ca.hessian(vehicle.reduced_lagrangian(r, u, xi), z)[0]
    pose = ca.SX(list(vehicle.group.identity))
    force = project(vehicle, r, *vehicle.force(pose, r, u, xi, c, ca.SX.zeros(3)))
    law = ca.Function("push", [r, z, c], [*map(ca.densify, (inertia, ca.jacobian(force, c), ca.jacobian(xi, z)))])
    found = [np.asarray(part, float).reshape(part.shape) for part in law(np.zeros(s), np.zeros(n), np.zeros(size))]
    weight, pushes, twist = found
    if not n or not all(np.isfinite(part).all() for part in found) or np.linalg.matrix_rank(weight) < n:
        return {}  # joints at zero are no place to measure at
    turning = {6: 3, 3: 1}.get(vehicle.group.dim, vehicle.group.dim)
    moves = twist[turning:] if len(twist) > turning else twist
    mobility = float(np.linalg.eigvalsh(moves @ np.linalg.solve(weight, moves.T)).max(initial=0.0))
    strength = np.sqrt(np.einsum("ic,ic->c", pushes, np.linalg.solve(weight, pushes)))
    if not mobility > 0:
        return {}
    return {
        control.name: float(f"{1 / (np.sqrt(mobility) * push):.{DIGITS}g}")
        for control, push in zip(vehicle.controls, strength, strict=True)
        if push > 0 and control.name not in vehicle.rate_controls
    }
