"""Expressions that follow from a vehicle's definition and that simulation, planning and checks share."""

from __future__ import annotations

import casadi as ca

from vehsim.vehicles._base import Expr, Vehicle


def free_velocity(vehicle: Vehicle, r: Expr, z: Expr, driven: Expr) -> tuple[Expr, Expr]:
    """Joint rates ``u`` (s,) and group velocity ``xi`` (d,) of a segment's velocity ``z`` (b + s_d,).

    ``driven`` (s,): the rates set by rate controls, zero elsewhere.
    """
    basis = vehicle.basis(r)
    b = basis.shape[1]
    u = ca.SX(driven)
    for position, joint in enumerate(vehicle.dynamic):
        u[joint] = z[b + position]
    free = z[:b] if b else ca.SX(0, 1)
    return u, basis @ free - vehicle.connection(r) @ u


def project(vehicle: Vehicle, r: Expr, on_joints: Expr, on_group: Expr) -> Expr:
    """A covector on the joints (s,) and the group (d,) restricted to the free velocities at ``r``: (b + s_d,)."""
    lifted = on_joints - vehicle.connection(r).T @ on_group
    return ca.vertcat(vehicle.basis(r).T @ on_group, lifted[list(vehicle.dynamic)])


def momentum(vehicle: Vehicle, r: Expr, u: Expr, xi: Expr) -> tuple[Expr, Expr]:
    """``(dl/du (s,), dl/dxi (d,))``."""
    # differentiate with respect to fresh symbols: u and xi may be expressions
    u_, xi_ = ca.SX.sym("u", u.shape[0]), ca.SX.sym("xi", xi.shape[0])
    lagrangian = vehicle.reduced_lagrangian(r, u_, xi_)
    values = [ca.gradient(lagrangian, u_), ca.gradient(lagrangian, xi_)]
    return tuple(ca.substitute(values, [u_, xi_], [ca.densify(u), ca.densify(xi)]))


def shape_gradient(vehicle: Vehicle, r: Expr, u: Expr, xi: Expr) -> Expr:
    """``dl/dr`` (s,)."""
    r_ = ca.SX.sym("r", r.shape[0])
    u_, xi_ = ca.SX.sym("u", u.shape[0]), ca.SX.sym("xi", xi.shape[0])
    gradient = ca.gradient(vehicle.reduced_lagrangian(r_, u_, xi_), r_)
    return ca.substitute([gradient], [r_, u_, xi_], [ca.densify(r), ca.densify(u), ca.densify(xi)])[0]
