"""The systems of Murray and Sastry: Brockett's, its second-degree extension, chained form, hopper, car, trailers."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations
from typing import Any

import casadi as ca
import numpy as np

from vehsim.errors import InputError
from vehsim.sinusoids.system import DriftlessSystem, Expr

_RIGHT = 1.5
"""Angles stay below this, rad, which is less than a right angle."""


def first_degree(m: int) -> DriftlessSystem:
    """Brockett's system for m inputs (SIN eq. 4): ``x_i' = u_i``, ``x_ij' = x_i u_j`` for i < j."""
    _check_count("m", m, 2)
    pairs = list(combinations(range(m), 2))

    def fields(x: Expr) -> Expr:
        g = ca.SX(m + len(pairs), m)
        g[:m, :] = ca.SX.eye(m)
        for row, (i, j) in enumerate(pairs):
            g[m + row, j] = x[i]
        return g

    return DriftlessSystem(f"first degree, m = {m}", (*_names(range(m)), *_names(pairs)), _inputs(m), fields)


def second_degree(m: int) -> DriftlessSystem:
    """SIN eq. 6: also ``x_ijk' = x_ij u_k`` for i < j and k >= i; Jacobi's identity determines the others."""
    _check_count("m", m, 2)
    pairs, triples = list(combinations(range(m), 2)), second_degree_triples(m)

    def fields(x: Expr) -> Expr:
        g = ca.SX(m + len(pairs) + len(triples), m)
        g[:m, :] = ca.SX.eye(m)
        for row, (i, j) in enumerate(pairs):
            g[m + row, j] = x[i]
        for row, (i, j, k) in enumerate(triples):
            g[m + len(pairs) + row, k] = x[m + pairs.index((i, j))]
        return g

    names = (*_names(range(m)), *_names(pairs), *_names(triples))
    return DriftlessSystem(f"second degree, m = {m}", names, _inputs(m), fields)


def second_degree_triples(m: int) -> list[tuple[int, int, int]]:
    """(i, j, k) with i < j and k >= i, from 0."""
    return [(i, j, k) for i, j in combinations(range(m), 2) for k in range(i, m)]


def chained(n: int) -> DriftlessSystem:
    """One-chain form: ``z1' = v1, z2' = v2, z3' = z2 v1, ..., zn' = z(n-1) v1``."""
    _check_count("n", n, 3)

    def fields(z: Expr) -> Expr:
        g = ca.SX(n, 2)
        g[0, 0] = g[1, 1] = 1
        g[2:, 0] = z[1 : n - 1]
        return g

    return DriftlessSystem(f"chained form, n = {n}", tuple(f"z{i + 1}" for i in range(n)), ("v1", "v2"), fields)


def hopper(leg: float = 0.5, reach: tuple[float, float] = (-0.99, 100.0)) -> DriftlessSystem:
    """The hopping robot in the air (SIN Fig. 1): leg angle psi from the body, extension l, body angle theta.

    ``leg``: the leg's moment of inertia at l = 0 over the body's, m_l in SIN's units; lengths in legs at l = 0.
    ``reach``: smallest and largest l.
    """

    def fields(x: Expr) -> Any:
        moment = leg * (1 + x[1]) ** 2
        return [[1, 0], [0, 1], [-moment / (1 + moment), 0]]

    domain = {"psi": (-1e3, 1e3), "l": reach, "theta": (-1e3, 1e3)}
    return DriftlessSystem("hopper", ("psi", "l", "theta"), ("psi_rate", "l_rate"), fields, domain)


def car(wheelbase: float = 1.0, steering: float = _RIGHT) -> DriftlessSystem:
    """The front-wheel-drive car (SIN eq. 7): x, y of the rear axle m, heading theta, steering angle phi.

    Inputs: speed of the front wheels along their own heading m/s, and steering rate rad/s. ``steering``: largest phi,
    rad.
    """

    def fields(q: Expr) -> Any:
        theta, phi = q[2], q[3]
        return [
            [ca.cos(theta) * ca.cos(phi), 0],
            [ca.sin(theta) * ca.cos(phi), 0],
            [ca.sin(phi) / wheelbase, 0],
            [0, 1],
        ]

    domain = {"x": (-1e4, 1e4), "y": (-1e4, 1e4), "theta": (-_RIGHT, _RIGHT), "phi": (-steering, steering)}
    return DriftlessSystem("car", ("x", "y", "theta", "phi"), ("speed", "steering_rate"), fields, domain)


def trailers(hitches: Sequence[float], wheelbase: float = 1.0) -> DriftlessSystem:
    """A front-wheel-drive car with ``len(hitches)`` trailers (SIN sec. 3), each ``hitches[i]`` m behind the axle ahead.

    x, y of the car's rear axle; phi steering angle; theta0 the car's heading, theta1.. the trailers'.
    Inputs: speed of the front wheels, and steering rate.
    """
    lengths = [float(d) for d in hitches]
    if any(not np.isfinite(d) or d <= 0 for d in [*lengths, wheelbase]):
        raise InputError(
            "not lengths",
            "give lengths above zero, m",
            key="hitches, wheelbase",
            value=(list(hitches), wheelbase),
            subject="trailers",
        )

    def fields(q: Expr) -> Expr:
        phi, theta = q[2], q[3:]
        g = ca.SX(4 + len(lengths), 2)
        speed = ca.cos(phi)
        g[0, 0], g[1, 0], g[2, 1] = ca.cos(theta[0]) * speed, ca.sin(theta[0]) * speed, 1
        g[3, 0] = ca.sin(phi) / wheelbase
        for i, d in enumerate(lengths):
            bend = theta[i] - theta[i + 1]
            g[4 + i, 0] = speed * ca.sin(bend) / d
            speed = speed * ca.cos(bend)
        return g

    states = ("x", "y", "phi", *(f"theta{i}" for i in range(len(lengths) + 1)))
    domain = {"x": (-1e4, 1e4), "y": (-1e4, 1e4), "phi": (-_RIGHT, _RIGHT)}
    name = f"car with {len(lengths)} trailers"
    return DriftlessSystem(name, states, ("speed", "steering_rate"), fields, domain, tuple(lengths))


def _names(indices: Any) -> list[str]:
    return ["x" + "".join(str(i + 1) for i in (t if isinstance(t, tuple) else (t,))) for t in indices]


def _inputs(m: int) -> tuple[str, ...]:
    return tuple(f"u{i + 1}" for i in range(m))


def _check_count(name: str, value: int, least: int) -> None:
    if isinstance(value, bool) or not isinstance(value, int) or not least <= value <= 40:
        raise InputError("out of range", f"give a whole number from {least} to 40", key=name, value=value)
