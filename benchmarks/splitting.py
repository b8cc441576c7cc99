"""Kinetic splitting of a rigid body on SO(3) x R^3, explicit: flows that are known exactly, composed to fourth order.

With principal inertias ``I_1, I_2, I_3``, the kinetic energy is ``|m|^2 / (2 I_2)``, whose flow commutes with the
others, plus ``k_1 m_1^2 / 2`` and ``k_3 m_3^2 / 2`` with ``k_i = 1 / I_i - 1 / I_2``: rotations about body axes. Forces
that depend on the pose alone are kicks: they change momenta and leave the pose. Compositions: S6 of Blanes and Moan (J.
Comput. Appl. Math. 142, 2002), Table 2.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import casadi as ca

from vehsim.lie import SO3

A = (0.0792036964311957, 0.353172906049774, -0.0420650803577195)
B = (0.209515106613362, -0.143851773179818)
ALONG = (*A, 1 - 2 * sum(A), *A[::-1])
ACROSS = (*B, 0.5 - sum(B), 0.5 - sum(B), *B[::-1])
Flow = tuple[int, float]
"""Which part flows, and for which share of the step."""


def flows(parts: int) -> list[Flow]:
    """The flows of one step for a sum of ``parts`` terms, those of S6; neighbours of the same part are merged.

    For more than two parts, McLachlan's equivalence (SIAM J. Sci. Comput. 16, 1995) gives the shares of a first-order
    step, all parts in turn, and of its adjoint.
    """
    shares, last = [], 0.0
    for k in range(12):
        last = (ALONG if k % 2 == 0 else ACROSS)[k // 2] - last
        shares.append(last)
    sequence: list[Flow] = []
    for k, share in enumerate(shares):
        order = range(parts) if k % 2 == 0 else reversed(range(parts))
        for part in order:
            if sequence and sequence[-1][0] == part:
                share_before = sequence.pop()[1]
                sequence.append((part, share_before + share))
            else:
                sequence.append((part, share))
    return sequence


def splitting_step(inertia: Sequence[float], mass: float, kick: Callable[[Any, Any], Any] | None = None) -> ca.Function:
    """``(x, h, c0, c1, wind) -> x1`` with ``x = (quaternion, position, body momentum, linear momentum)``.

    ``kick``: (quaternion, position) -> body torque and force in the world (6,), N m and N. Controls and wind are empty,
    as for `vehsim.integrators.references.reference_step`.
    """
    x, h = ca.SX.sym("x", 13), ca.SX.sym("h")
    q, p, m, linear = x[:4], x[4:7], x[7:10], x[10:13]
    middle = sorted(range(3), key=lambda i: inertia[i])[1]
    first, last = (i for i in range(3) if i != middle)
    rates = [1 / inertia[i] - 1 / inertia[middle] for i in range(3)]
    owed: Any = 0.0  # the time of the flow of |m|^2 / (2 I_2), which commutes with rotations but not with kicks

    for part, share in flows(2) if kick is None else [(k - 1, share) for k, share in flows(3)]:
        t = share * h
        if part >= 0:
            i = (first, last)[part]
            q, m = _about(i, t * rates[i] * m[i], q, m)
            owed += t if part == 0 else 0.0
        else:
            assert kick is not None
            q, p, owed = _drift(q, m, owed / inertia[middle]), p + owed * linear / mass, 0.0
            push = kick(q, p)
            m, linear = m + t * push[:3], linear + t * push[3:]
    q, p = _drift(q, m, owed / inertia[middle]), p + owed * linear / mass
    return _step("splitting", x, h, ca.vertcat(_unit(q), p, m, linear))


def rk4_step(inertia: Sequence[float], mass: float, kick: Callable[[Any, Any], Any] | None = None) -> ca.Function:
    """RK4 on the same variables, written by hand: a rival without what a general formulation costs."""
    x, h, moments = ca.SX.sym("x", 13), ca.SX.sym("h"), ca.DM(inertia)

    def slope(x: Any) -> Any:
        q, p, m, linear = x[:4], x[4:7], x[7:10], x[10:13]
        rate = m / moments
        push = ca.SX(6, 1) if kick is None else kick(q, p)
        turning = ca.vertcat(-ca.dot(q[1:4], rate), q[0] * rate + ca.cross(q[1:4], rate)) / 2
        return ca.vertcat(turning, linear / mass, ca.cross(m, rate) + push[:3], push[3:])

    a = slope(x)
    b = slope(x + h / 2 * a)
    c = slope(x + h / 2 * b)
    d = slope(x + h * c)
    end = x + h / 6 * (a + 2 * b + 2 * c + d)
    return _step("rk4", x, h, ca.vertcat(_unit(end[:4]), end[4:]))


def _unit(q: Any) -> Any:
    return q / ca.sqrt(ca.dot(q, q))


def _step(name: str, x: Any, h: Any, end: Any) -> ca.Function:
    none = [ca.SX.sym(name, size) for name, size in (("c0", 0), ("c1", 0), ("wind", 3))]
    return ca.Function(name, [x, h, *none], ca.cse([ca.densify(end)]))


BY_HAND = {"splitting": splitting_step, "rk4 by hand": rk4_step}
"""Steps of a rigid body on SO(3) x R^3: (principal inertia (3,), mass, kick) -> function."""


def _about(axis: int, angle: Any, q: Any, m: Any) -> tuple[Any, Any]:
    """The attitude turned by ``angle`` rad about a body axis, and the momentum (3,), constant in the world."""
    c, s = ca.cos(angle / 2), ca.sin(angle / 2)
    turn = [c, 0, 0, 0]
    turn[axis + 1] = s
    a, b = (axis + 1) % 3, (axis + 2) % 3
    cosine, sine = 1 - 2 * s * s, 2 * s * c
    after = [m[0], m[1], m[2]]
    after[a], after[b] = cosine * m[a] + sine * m[b], cosine * m[b] - sine * m[a]
    return SO3.compose(q, ca.vertcat(*turn)), ca.vertcat(*after)


def _drift(q: Any, m: Any, time: Any) -> Any:
    """The attitude after a rotation at the body rates ``m`` for a time."""
    return SO3.compose(q, SO3.exp(time * m))
