"""The same car without slip: its wheels roll, and its body does not move on its springs."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import lru_cache

import casadi as ca

from vehsim.vehicles.definition.base import Expr
from vehsim.vehicles.definition.nonholonomic import Nonholonomic
from vehsim.vehicles.definition.vehicle import Vehicle


def rolling_ahead(vehicle: Vehicle, r: Expr) -> tuple[Expr, Expr] | None:
    """The joint rates (s,) and body twist (3,) of a vehicle on tyres at 1 m/s ahead without slip, where its joints have
    the values ``r`` (s,); None for others."""
    if vehicle.rolling is None or vehicle.across is None:
        return None
    xi = ca.SX.sym("xi", vehicle.group.dim)
    sideways = ca.jacobian(vehicle.across(r, xi), xi)
    turn, aside = ca.vertsplit(-ca.solve(sideways[:, [0, 2]], sideways[:, 1]))
    ahead = ca.vertcat(turn, 1, aside)
    return vehicle.rolling(r, ahead), ahead


@lru_cache(maxsize=16)
def gripping(vehicle: Vehicle) -> Nonholonomic | None:
    """A vehicle on tyres without slip, with the same joints and controls; None for others, whose wheels never slip.

    Its axles do not move sideways, its wheels roll, and its other joints keep their values: what remains is to drive
    and to steer. It has the mass of the vehicle, but no forces of tyres and springs.
    """
    if not isinstance(vehicle, Nonholonomic) or None in (vehicle.rolling, vehicle.across, vehicle.torques):
        return None
    rolling, across, torques = vehicle.rolling, vehicle.across, vehicle.torques
    assert rolling is not None and across is not None and torques is not None
    free = [k for k, joint in enumerate(vehicle.joints) if joint not in vehicle.rate_controls.values()]

    def constraints(r: Expr) -> tuple[Expr, Expr]:
        u, xi = ca.SX.sym("u", len(vehicle.joints)), ca.SX.sym("xi", vehicle.group.dim)
        rows = ca.vertcat((u - rolling(r, xi))[free], across(r, xi))
        return ca.jacobian(rows, u), ca.jacobian(rows, xi)

    attitude = vehicle.attitude or ()
    level = [vehicle.joints.index(joint) for joint in attitude]

    def lagrangian(r: Expr, u: Expr, xi: Expr) -> Expr:
        standing = ca.SX(r)
        standing[level] = 0
        return vehicle.lagrangian(standing, u, xi)

    return replace(
        vehicle,
        joint_limits={joint: ends for joint, ends in vehicle.joint_limits.items() if joint not in attitude},
        lagrangian=lagrangian,
        constraints=constraints,
        forces=lambda r, u, xi, c: torques(u, c),
        rolling=None,
        across=None,
        torques=None,
        standing=None,
        attitude=None,
        default_costs={},
        largest_step=math.inf,
        pivots=None,
    )
