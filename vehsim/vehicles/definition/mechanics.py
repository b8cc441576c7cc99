"""Expressions that follow from a vehicle's definition and that simulation, planning and checks share."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import casadi as ca

from vehsim.errors import InputError
from vehsim.lie.once import built_once
from vehsim.vehicles.definition.base import Definition, Expr


def free_velocity(vehicle: Definition, r: Expr, z: Expr, driven: Expr) -> tuple[Expr, Expr]:
    """Joint rates ``u`` (s,) and group velocity ``xi`` (d,) of a segment's velocity ``z`` (b + s_d,).

    ``driven`` (s,): the rates set by rate controls, zero elsewhere.
    """
    basis, d = vehicle.basis(r), vehicle.group.dim
    b = basis.shape[1]
    u = ca.SX(driven)
    for position, joint in enumerate(vehicle.dynamic):
        u[joint] = z[b + position]
    free = z[:b] if b else ca.SX(0, 1)
    bound = basis @ free - vehicle.connection(r) @ u
    for position, joint in enumerate(vehicle.tied):
        u[joint] = bound[d + position]
    return u, bound[:d]


def project(vehicle: Definition, r: Expr, on_joints: Expr, on_group: Expr) -> Expr:
    """Restrict a covector on the joints (s,) and the group (d,) to the free velocities at ``r``: (b + s_d,)."""
    on_bound = ca.vertcat(on_group, rows(on_joints, vehicle.tied))
    lifted = on_joints - vehicle.connection(r).T @ on_bound
    return ca.vertcat(vehicle.basis(r).T @ on_bound, rows(lifted, vehicle.dynamic))


def coefficients(vehicle: Definition, r: Expr, u: Expr, xi: Expr) -> Expr:
    """The free velocity ``z`` (b + s_d,) of joint rates (s,) and a group velocity (d,), or the closest one."""
    basis = vehicle.basis(r)
    along = ca.vertcat(xi, rows(u, vehicle.tied)) + vehicle.connection(r) @ u
    free = ca.solve(basis.T @ basis, basis.T @ along) if basis.shape[1] else ca.SX(0, 1)
    return ca.vertcat(free, rows(u, vehicle.dynamic))


def matrix(values: Any) -> Expr:
    """Nested lists of numbers and expressions, or an expression, as an ``SX`` matrix."""
    if isinstance(values, list | tuple):
        return ca.vertcat(*(ca.horzcat(*row) for row in values))
    return ca.SX(values)


def stacked(values: Any) -> Expr:
    """A list of numbers and expressions, or an expression, as an ``SX`` column."""
    return ca.vertcat(*values) if isinstance(values, list | tuple) else ca.SX(values)


CASADI_ERRORS = (TypeError, ValueError, NotImplementedError, RuntimeError)
"""What CasADi raises when expressions do not fit together."""


def symbols(vehicle: Definition) -> tuple[Expr, ...]:
    """``g, r, u, xi, c, wind``: the arguments of `Definition.force`."""
    s, c = len(vehicle.joints), len(vehicle.controls)
    sizes = {"g": vehicle.group.size, "r": s, "u": s, "xi": vehicle.group.dim, "c": c, "wind": 3}
    return tuple(ca.SX.sym(name, size) for name, size in sizes.items())


def law(vehicle: Definition, key: str, size: int, evaluate: Callable[..., Any], *given: Expr) -> Expr:
    """The column (size,) that a vehicle's law gives. Raises ``InputError`` naming the law if it gives another shape, or
    symbols that are none of its arguments."""
    return column(vehicle, key, size, answered(vehicle, key, evaluate, *given), *given)


def column(vehicle: Definition, key: str, size: int, answer: Any, *given: Expr) -> Expr:
    """What a law, or a part of it, returned for ``given``, as a column (size,); errors as of `law`."""
    try:
        made = stacked(answer)
    except CASADI_ERRORS as error:
        told = f"returns {type(answer).__name__}, neither numbers nor expressions"
        raise InputError(told, _wanted(size), key=key, subject=vehicle.name) from error
    if made.shape != (size, 1):
        raise InputError(f"returns shape {made.shape}", _wanted(size), key=key, subject=vehicle.name)
    closed(vehicle, key, made, *given)
    return made


def _wanted(size: int) -> str:
    return {0: "return an empty column, ca.SX(0, 1)", 1: "return a scalar"}.get(size, f"return a column of {size}")


def answered(vehicle: Definition, key: str, evaluate: Callable[..., Any], *given: Expr) -> Any:
    """What a vehicle's law returns. Raises ``InputError`` naming the law if it cannot be evaluated."""
    try:
        return evaluate(*given)
    except CASADI_ERRORS as error:
        told = str(error).strip().splitlines() or [type(error).__name__]
        sizes = ", ".join(f"({expression.shape[0]},)" for expression in given)
        raise InputError(
            f"cannot be evaluated: {told[-1]}", f"its arguments have shapes {sizes}", key=key, subject=vehicle.name
        ) from error


def closed(vehicle: Definition, key: str, made: Expr, *given: Expr) -> None:
    """Raise ``InputError`` naming the law if ``made`` has symbols that ``given`` has not, or numbers that are not
    finite."""
    made = ca.SX(made)
    known = {symbol.element_hash() for symbol in ca.symvar(ca.vertcat(*map(ca.vec, given)))}
    if free := [str(symbol) for symbol in ca.symvar(made) if symbol.element_hash() not in known]:
        raise InputError(
            f"depends on {', '.join(free)}, which it is not given",
            "use its arguments, and numbers in place of other symbols",
            key=key,
            subject=vehicle.name,
        )
    if made.is_constant() and not made.is_regular():
        raise InputError("contains numbers that are not finite", "give finite ones", key=key, subject=vehicle.name)


def rows(column: Expr, indices: Sequence[int]) -> Expr:
    """Entries of a column. An empty column gives a (0, 1), where CasADi's own indexing would give a (1, 1)."""
    return ca.vertcat(*(column[i] for i in indices)) if indices else ca.SX(0, 1)


def momentum(vehicle: Definition, r: Expr, u: Expr, xi: Expr) -> tuple[Expr, Expr]:
    """``(dl/du (s,), dl/dxi (d,))``."""
    # differentiate with respect to fresh symbols: u and xi may be expressions
    u_, xi_ = ca.SX.sym("u", u.shape[0]), ca.SX.sym("xi", xi.shape[0])
    lagrangian = vehicle.reduced_lagrangian(r, u_, xi_)
    values = [ca.gradient(lagrangian, u_), ca.gradient(lagrangian, xi_)]
    p, mu = ca.substitute(values, [u_, xi_], [ca.densify(u), ca.densify(xi)])
    return p, mu


def shape_gradient(vehicle: Definition, r: Expr, u: Expr, xi: Expr) -> Expr:
    """``dl/dr`` (s,)."""
    r_ = ca.SX.sym("r", r.shape[0])
    u_, xi_ = ca.SX.sym("u", u.shape[0]), ca.SX.sym("xi", xi.shape[0])
    gradient = ca.gradient(vehicle.reduced_lagrangian(r_, u_, xi_), r_)
    return ca.substitute([gradient], [r_, u_, xi_], [ca.densify(r), ca.densify(u), ca.densify(xi)])[0]


def driven_rates(vehicle: Definition, c: Expr) -> Expr:
    """Joint rates (s,) that rate controls set, zero for the dynamic joints."""
    rates = ca.SX(len(vehicle.joints), 1)
    for joint, control in vehicle.driven:
        rates[joint] = c[control]
    return rates


def free_size(vehicle: Definition) -> int:
    """Length of a segment's velocity ``z``: free directions on the group and dynamic joints."""
    return vehicle.basis(ca.SX.sym("r", len(vehicle.joints))).shape[1] + len(vehicle.dynamic)


def conservative(vehicle: Definition, g: Expr, r: Expr) -> tuple[Expr, Expr]:
    """``-dV`` on the joints (s,) and the group (d,), for the vehicle's potential ``V(g, r)``."""
    g_, r_ = ca.SX.sym("g", g.shape[0]), ca.SX.sym("r", len(vehicle.joints))
    eta = ca.SX.sym("eta", vehicle.group.dim)
    # the derivative at the identity is the same for all coordinate maps; cay is the cheapest
    moved = ca.SX(vehicle.potential(vehicle.group.compose(g_, vehicle.group.cay(eta)), r_))
    values = [-ca.gradient(moved, r_), -ca.gradient(moved, eta)]
    values = ca.substitute(values, [eta], [ca.SX.zeros(eta.shape[0])])
    on_joints, on_group = ca.substitute(values, [g_, r_], [ca.densify(g), ca.densify(r)])
    return on_joints, on_group


def conservative_at_rest(vehicle: Definition, g: Expr, r: Expr) -> tuple[Expr, Expr]:
    """`conservative` with the forces of the Lagrangian's part without velocities, such as a sprung body's weight."""
    on_joints, on_group = conservative(vehicle, g, r)
    still = ca.SX.zeros(len(vehicle.joints)), ca.SX.zeros(vehicle.group.dim)
    return on_joints + shape_gradient(vehicle, r, *still), on_group


def energy(vehicle: Definition, g: Expr, r: Expr, u: Expr, xi: Expr) -> tuple[Expr, Expr]:
    """Kinetic and potential energy, J; the part of the Lagrangian without velocities counts as potential."""
    on_joints, on_group = momentum(vehicle, r, u, xi)
    rest = vehicle.reduced_lagrangian(r, ca.SX.zeros(u.shape[0]), ca.SX.zeros(xi.shape[0]))
    total = ca.dot(on_joints, u) + ca.dot(on_group, xi) - vehicle.reduced_lagrangian(r, u, xi)
    return total + rest, ca.SX(vehicle.potential(g, r)) - rest


def acceleration(vehicle: Definition, g: Expr, r: Expr, z: Expr, c: Expr, c_rate: Expr, wind: Expr) -> Expr:
    """``dz/dt`` (b + s_d,) of the continuous motion: reduced Lagrange-d'Alembert (LIE eq. 8-9, with constraints).

    ``d/dt dl/dxi - ad*_xi dl/dxi - f`` vanishes along the free velocities, and so does the joints' equation combined
    with the connection. ``c_rate``: rate of the controls, which matters for rate controls only.
    """
    z_dot = ca.SX.sym("z_dot", z.shape[0])
    return _balancing(project(vehicle, r, *residual_force(vehicle, g, r, z, z_dot, c, c_rate, wind)), z_dot)


def _balancing(balance: Expr, z_dot: Expr) -> Expr:
    """The ``z_dot`` at which a ``balance``, linear in it, vanishes."""
    mass, rest = ca.jacobian(balance, z_dot), ca.substitute(balance, z_dot, ca.SX.zeros(z_dot.shape[0]))
    return -ca.solve(mass, rest) if z_dot.shape[0] else ca.SX(0, 1)


@built_once
def residual_force(
    vehicle: Definition, g: Expr, r: Expr, z: Expr, z_dot: Expr, c: Expr, c_rate: Expr, wind: Expr
) -> tuple[Expr, Expr]:
    """The constraint forces, including those of rate controls: covectors on the joints (s,) and the group (d,)."""
    r_, z_, c_ = (ca.SX.sym(n, x.shape[0]) for n, x in (("r", r), ("z", z), ("c", c)))
    u, xi = free_velocity(vehicle, r_, z_, driven_rates(vehicle, c_))
    on_joints, on_group = momentum(vehicle, r_, u, xi)
    state, rates = ca.vertcat(r_, z_, c_), ca.vertcat(u, z_dot, c_rate)
    applied = vehicle.force(g, r_, u, xi, c_, wind)
    steady = conservative(vehicle, g, r_)
    joints = ca.jtimes(on_joints, state, rates) - shape_gradient(vehicle, r_, u, xi) - applied[0] - steady[0]
    body = ca.jtimes(on_group, state, rates) - vehicle.group.ad(xi).T @ on_group - applied[1] - steady[1]
    values = [ca.densify(joints), ca.densify(body)]
    on_joints, on_group = ca.substitute(values, [r_, z_, c_], [ca.densify(r), ca.densify(z), ca.densify(c)])
    return on_joints, on_group


def drive_power(vehicle: Definition, g: Expr, r: Expr, z: Expr, c: Expr, wind: Expr) -> tuple[Expr, Expr]:
    """Power of the drives of rate controls, W: their multipliers times the rates.

    Returns the power at constant controls, and the power per rate of each driving control (driven joints,).
    """
    joints, c_rate = [joint for joint, _ in vehicle.driven], ca.SX.sym("c_rate", c.shape[0])
    if not joints:
        return ca.SX(1, 1), ca.SX(0, 1)
    z_dot = ca.SX.sym("z_dot", z.shape[0])
    on_joints, on_group = residual_force(vehicle, g, r, z, z_dot, c, c_rate, wind)
    on_bound = ca.vertcat(on_group, rows(on_joints, vehicle.tied))
    multipliers = rows(on_joints - vehicle.connection(r).T @ on_bound, joints)
    found = _balancing(project(vehicle, r, on_joints, on_group), z_dot)
    power = ca.dot(ca.substitute(multipliers, z_dot, found), rows(driven_rates(vehicle, c), joints))
    per_rate = rows(ca.gradient(power, c_rate), [control for _, control in vehicle.driven])
    return ca.substitute(power, c_rate, ca.SX.zeros(c_rate.shape[0])), per_rate
