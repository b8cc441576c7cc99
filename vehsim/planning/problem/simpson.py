"""A whole segment to fourth order: the Hermite-Simpson rule on the group, in the variables of DMOC.

Joints, momenta and places follow Simpson's rule, with the middle on the Hermite cubic through both ends (Hargraves and
Paris 1987). Rotations are ``q exp(x)`` with ``x`` to fourth order, so that quaternions keep unit norm; gyroscopic
forces are integrated exactly for velocities quadratic in time. The segment is symmetric in time, and constraints hold
exactly at its ends and middle. Without forces, momentum is conserved to fourth order only: docs/derivations.md tells
what exact conservation costs.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import casadi as ca

from vehsim.lie import SO3
from vehsim.planning.problem.elements import Element, SpatialField
from vehsim.vehicles.definition.mechanics import free_velocity, momentum, project, shape_gradient

if TYPE_CHECKING:
    from vehsim.planning.problem.transcription import Transcription
    from vehsim.vehicles import Vehicle

Expr = Any


CHEAP = 110
"""Largest number of instructions of a segment's equations, for every component of its velocity, with which the velocity
is eliminated: smaller linear systems then outweigh larger Hessians. Solves of a body without drag (108) take 15 to 20 %
less, of the two-wheeled robot (90) 4 %; those of the simple car (114) would take 5 % more, and of boats (185) a fifth
more."""


def simpson(transcription: Transcription, reduced: bool = False) -> Element:
    """The equations of a segment (x, z, c0, c1, x1, h); ``z`` is the velocity at its middle.

    Rows and parameters are those of `Transcription.variational`: two of momentum, of the middle and of the end, then
    pose and joints. ``reduced``: without ``z`` and the row of the middle's momentum, from which it follows.
    """
    t, m = transcription, transcription.mechanics
    v, wind, depth = t.symbols("x", "z", "c0", "c1", "x1", "h"), t.air["wind"], t.air.get("depth", 0)
    g, r, pi = t.split(v["x"])
    g1, r1, pi1 = t.split(v["x1"])
    h, step = v["h"], v["c1"] - v["c0"]
    a, middle, b = ((v["c0"] + s * step) * t.control_scale for s in (0.0, 0.5, 1.0))
    laws, ground = _laws(t), t.ground
    cells, pieces, airs = (ca.SX.sym(name + "s", laws.size1_in(name), 3) for name in ("cell", "piece", "air"))

    rates = [ca.vertcat(*m.knot_velocity(*at)) for at in ((r, pi, a), (r1, pi1, b))]
    inner = []
    if t.sizes[1]:  # the inverse of a mass matrix that depends on the joints takes many operations
        inner = [(ca.SX.sym(f"rate{k}", rate.shape[0]), rate) for k, rate in enumerate(rates)]
        rates = [symbols for symbols, _ in inner]
    (u, xi), (u1, xi1) = (ca.vertsplit(rate, [0, t.sizes[1], rate.shape[0]]) for rate in rates)
    g_dot, _, push, turned = laws(g, r, u, xi, a, wind, cells[:, 0] - depth, pieces[:, 0], airs[:, 0])
    g1_dot, _, push1, turned1 = laws(g1, r1, u1, xi1, b, wind, cells[:, 1] - depth, pieces[:, 1], airs[:, 1])
    gm, rm = (g + g1) / 2 + h / 8 * (g_dot - g1_dot), (r + r1) / 2 + h / 8 * (u - u1)
    pose = ca.SX.sym("pose", gm.shape[0] + rm.shape[0])
    g_, r_ = ca.vertsplit(pose, [0, gm.shape[0], pose.shape[0]])
    um, xim = free_velocity(t.vehicle, r_, v["z"], m.driven(middle))
    between = (pi + pi1) / 2 + h / 8 * (push - push1)
    gm_dot, pim, pushm, _ = laws(g_, r_, um, xim, middle, wind, cells[:, 2] - depth, pieces[:, 2], airs[:, 2])

    next_g, next_r = (
        start_ + h / 6 * (x + 4 * y + z) for start_, x, y, z in ((g, g_dot, gm_dot, g1_dot), (r, u, um, u1))
    )
    missed, gained = next_g - g1, h / 6 * (push + 4 * pushm + push1)
    rest = []
    if t.vehicle.group.size > t.vehicle.group.dim:
        sizes = {"mean": 4, "half": 3, "turn": 3, "bend": pi.shape[0]}
        mean, half, turn, bend = (ca.SX.sym(name, size) for name, size in sizes.items())
        gm[0:4] = _halfway(mean, half)
        inner += [(mean, (g[0:4] + g1[0:4]) / 2), (half, h / 16 * (xi - xi1)[0:3])]
        rest = [(turn, _rotation(xi[0:3], xim[0:3], xi1[0:3], h))]
        rest += [(bend, pi - 2 * pim + pi1 - h / 4 * (turned1 - turned))]
        missed[0:4] = _unturned(g[0:4] - g1[0:4], mean, turn)
        gained -= h / 30 * _gyroscopic(t, r_, bend)
    inner += t.blown(airs[:, :2], (g, xi), (g1, xi1))
    inner.append((pose, ca.vertcat(gm, rm)))
    inner += t.blown(airs[:, 2], (g_, xim))
    velocity = [(v["z"], m.knot_velocity_guess(r_, between, middle))] if reduced else []
    at_end = (pi1 - pi - gained) / t.momentum_scale
    residuals = [] if reduced else [(pim - between) / t.momentum_scale]
    residuals += [at_end, missed, next_r - r1]
    space = None
    if ground is not None:
        places = ca.horzcat(*(ground.place(at) for at in (g, g1, gm)))
        models = ca.vertcat(ca.SX.sym("places", 2, 3), cells)
        space = SpatialField(places, models, lambda count, order: ground.cells(count))
    z = v.pop("z") if reduced else None
    element = Element(
        "dynamics",
        ca.vertcat(*v.values()),
        t.air,
        g=ca.vertcat(*residuals),
        space=space,
        inner=[*inner, *velocity, *rest],
        lacked=z,
        table=t.looked_up(pieces, (g, xi), (g1, xi1), (g_, xim)),
    )
    n = v["x"].shape[0]
    if not reduced and element.value.n_instructions() <= CHEAP * t.sizes[2]:
        places = range(n, n + t.sizes[2])
        element.reduced = places, lambda: t.kept("reduced simpson", lambda: simpson(t, reduced=True))
    return element


def _halfway(mean: Expr, half: Expr) -> Expr:
    """The attitude (4,) in the middle, to fourth order: that of the ends' mean (4,), turned by twice the vector
    ``half`` (3,), ``h/16`` times the difference of the ends' rates."""
    return SO3.compose(mean * (3 - ca.sumsqr(mean)) / 2, ca.vertcat(1, half))


def _rotation(first: Expr, middle: Expr, last: Expr, h: Expr) -> Expr:
    """``y = 4 tan(|x|/4) x/|x|`` (3,) of a segment's rotation vector ``x`` with these body rates (3,) rad/s, to fourth
    order (Magnus)."""
    x = h / 6 * (first + 4 * middle + last)
    return x * (1 + ca.dot(x, x) / 48) + h**2 / 12 * ca.cross(middle, last - first)


def _unturned(fallen: Expr, mean: Expr, y: Expr) -> Expr:
    """By how much a rotation misses the segment's end, (4,): zero where ``q1 (1 - y/4) = q (1 + y/4)``.

    From the difference of the ends, ``q - q1``, and their mean. A polynomial, whose second derivatives take a fifth
    fewer operations than those of the exponential.
    """
    return fallen + SO3.compose(mean / 2, ca.vertcat(0, y))


def _gyroscopic(t: Transcription, r: Expr, pi: Expr) -> Expr:
    """The gyroscopic force ``ad(xi)^T mu`` at a restricted momentum (n,), as a restricted covector (n,).

    Other forces that change linearly make velocities quadratic in time, hence gyroscopic forces quartic. Simpson's rule
    misses a thirtieth of that at the second difference of the momentum that they cause, which matters most where
    controls change within few segments. The momentum that gyroscopic forces cause is of higher degree, and its own
    second difference would make segments less accurate at constant forces.
    """
    u, xi = t.mechanics.knot_velocity(r, pi, ca.SX.zeros(t.sizes[3]))
    return _on_group(t.vehicle, r, t.vehicle.group.ad(xi).T @ momentum(t.vehicle, r, u, xi)[1])


def _on_group(vehicle: Vehicle, r: Expr, force: Expr) -> Expr:
    """A covector on the group (d,), restricted to the free velocities (n,)."""
    return project(vehicle, r, ca.SX.zeros(r.shape[0]), force)


def _laws(t: Transcription) -> ca.Function:
    """``(g, r, u, xi, c, wind, cell, piece, air) -> (g_dot, pi, pi_dot, turned)``: the rate of the group's coordinates,
    the restricted momentum with its rate, and the gyroscopic part of that; arguments as of `Transcription.loads`."""
    m = t.mechanics
    g, r, c, wind = (m.symbols[name] for name in ("g", "r", "c0", "wind"))
    cell, piece, air = (ca.SX.sym(name, t.loads.size1_in(name)) for name in ("cell", "piece", "air"))
    vehicle, group = t.vehicle, t.vehicle.group
    u, xi = ca.SX.sym("u", r.shape[0]), ca.SX.sym("xi", group.dim)
    p, mu = momentum(vehicle, r, u, xi)
    *applied, on_joints, on_group = t.loads(g, r, u, xi, c, wind, cell, piece, air)
    on_joints += shape_gradient(vehicle, r, u, xi) + applied[0]
    turned = group.ad(xi).T @ mu
    on_group += turned + applied[1]
    # the free directions turn with the joints
    fixed_p, fixed_mu = ca.SX.sym("p", p.shape[0]), ca.SX.sym("mu", mu.shape[0])
    turning = ca.jtimes(project(vehicle, r, fixed_p, fixed_mu), r, u) if r.shape[0] else 0
    turning = ca.substitute(ca.SX(turning), ca.vertcat(fixed_p, fixed_mu), ca.vertcat(p, mu))
    s = ca.SX.sym("s")
    flow = ca.jacobian(group.compose(g, group.cay(s * xi)), s)
    g_dot = ca.substitute(flow, s, 0)
    pi_dot = project(vehicle, r, on_joints, on_group) + turning
    results = [ca.densify(x) for x in (g_dot, project(vehicle, r, p, mu), pi_dot, _on_group(vehicle, r, turned))]
    names = ["g", "r", "u", "xi", "c", "wind", "cell", "piece", "air"]
    return ca.Function(
        "laws", [g, r, u, xi, c, wind, cell, piece, air], ca.cse(results), names, ["g_dot", "pi", "pi_dot", "turned"]
    )
