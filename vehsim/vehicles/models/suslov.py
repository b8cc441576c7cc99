"""Suslov's problem: a rigid body about a fixed point, which cannot rotate about one of its own axes."""

from __future__ import annotations

import casadi as ca
import numpy as np

from vehsim.errors import InputError
from vehsim.lie import SO3
from vehsim.vehicles.definition.base import Control, Expr
from vehsim.vehicles.definition.nonholonomic import Nonholonomic
from vehsim.vehicles.definition.quantities import Direction, InertiaMatrix


def suslov(name: str = "suslov", *, inertia: InertiaMatrix, axis: Direction = (0.0, 0.0, 1.0)) -> Nonholonomic:
    """A body on SO(3) with ``inertia`` (3, 3) kg m^2 about the fixed point and ``axis . omega = 0``, axis (3,) in body.

    If the axis is not a principal axis, the motion ends in a steady turn from any start. Controls: ``torque_x``,
    ``torque_y``, ``torque_z`` in body axes [N m]. No joints.
    """
    J = np.asarray(inertia, float)
    if J.shape != (3, 3) or not np.allclose(J, J.T):
        raise InputError(
            "not an inertia", "give a symmetric (3, 3) matrix, kg m^2", key="inertia", value=J.tolist(), subject=name
        )
    row = [[float(x) for x in axis]]

    def lagrangian(r: Expr, u: Expr, xi: Expr) -> Expr:
        return ca.dot(xi, ca.DM(J) @ xi) / 2

    return Nonholonomic(
        name=name,
        group=SO3,
        lagrangian=lagrangian,
        constraints=lambda r: (ca.SX(1, 0), row),
        forces=lambda r, u, xi, c: (ca.SX(0, 1), c),
        controls=tuple(Control(f"torque_{axis}", unit="N m") for axis in "xyz"),
    )
