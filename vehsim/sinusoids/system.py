"""Driftless control systems ``x' = g_1(x) u_1 + ... + g_m(x) u_m`` (SIN eq. 1), the input of all steering.

A system is a CasADi expression, or given by its Pfaffian constraints ``W(x) x' = 0``. `algebra` analyses it;
`canonical` and `manoeuvres` steer it.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from itertools import combinations
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from vehsim.errors import InputError
from vehsim.vehicles.definition.mechanics import matrix as matrix

Array = NDArray[np.float64]
BLOCK = 32
"""Integration steps per call."""
Expr = Any
"""A CasADi ``SX`` expression."""


@dataclass(frozen=True, eq=False)
class DriftlessSystem:
    """``x' = G(x) u`` with ``fields``: x (n,) -> G (n, m), a CasADi expression or nested lists of them.

    ``domain``: state name -> (lower, upper), the intended range: random samples are drawn from it, and start and goal
    are checked against it; states without a range are sampled from -1 to 1 and not checked. ``lengths``: of hitches, m,
    for systems that are drawn from above.
    """

    name: str
    states: tuple[str, ...]
    inputs: tuple[str, ...]
    fields: Callable[[Expr], Any]
    domain: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    lengths: tuple[float, ...] = ()

    def __post_init__(self) -> None:
        object.__setattr__(self, "states", tuple(self.states))
        object.__setattr__(self, "inputs", tuple(self.inputs))
        for name in self.domain:
            if name not in self.states:
                raise InputError(
                    "no such state", f"choose one of {', '.join(self.states)}", key=f"domain.{name}", subject=self.name
                )
        shape = self.G.shape
        if shape != (self.n, self.m):
            raise InputError(
                f"shape {shape}",
                f"{self.n} states and {self.m} inputs need ({self.n}, {self.m})",
                key="fields",
                subject=self.name,
            )

    @property
    def n(self) -> int:
        return len(self.states)

    @property
    def m(self) -> int:
        return len(self.inputs)

    @cached_property
    def x(self) -> Expr:
        """The state's symbols (n,)."""
        return ca.vertcat(*(ca.SX.sym(name) for name in self.states))

    @cached_property
    def G(self) -> Expr:
        """Input vector fields (n, m) as expressions of ``x``."""
        return ca.densify(matrix(self.fields(self.x)))

    @cached_property
    def rates(self) -> Callable[[Array, Array], Array]:
        """``(x (k, n), u (k, m)) -> x' (k, n)``."""
        u = ca.SX.sym("u", self.m)
        function = ca.Function("rate", [self.x, u], [ca.densify(self.G @ u)])
        return lambda x, u: np.asarray(function.map(len(x))(x.T, u.T)).T

    @cached_property
    def jacobians(self) -> Callable[[Array, Array], Array]:
        """``(x (k, n), u (k, m)) -> d x' / d x (k, n, n)``."""
        u = ca.SX.sym("u", self.m)
        function = ca.Function("A", [self.x, u], [ca.densify(ca.jacobian(self.G @ u, self.x))])
        return lambda x, u: np.asarray(function.map(len(x))(x.T, u.T)).T.reshape(len(x), self.n, self.n).swapaxes(1, 2)

    @cached_property
    def _steps(self) -> ca.Function:
        """``BLOCK`` steps of Dormand and Prince's method of order 8: ``(x, inputs at each one's 12 nodes, h) -> x``."""
        from scipy.integrate import DOP853

        field = ca.Function("f", [self.x, u := ca.SX.sym("u", self.m)], [ca.densify(self.G @ u)])
        x, h, inputs = ca.SX.sym("x", self.n), ca.SX.sym("h"), ca.SX.sym("u", self.m * DOP853.n_stages)
        slopes: list[Expr] = []
        for i, row in enumerate(DOP853.A[: DOP853.n_stages]):
            ahead = sum((a * k for a, k in zip(row, slopes, strict=False) if a), ca.SX.zeros(self.n))
            slopes.append(field(x + h * ahead, inputs[self.m * i : self.m * (i + 1)]))
        gained = sum((b * k for b, k in zip(DOP853.B, slopes, strict=True) if b), ca.SX.zeros(self.n))
        return ca.Function("step", [x, inputs, h], [ca.densify(x + h * gained)]).mapaccum(BLOCK)

    def march(self, x: Array, u: Array, h: Array) -> Array:
        """States (k + 1, n) from ``x`` (n,) with steps ``h`` (k,) and inputs ``u`` (k, 12 m) at the nodes of each."""
        rows = [np.asarray(x, float)[None]]
        for first in range(0, len(h), BLOCK):
            size = min(BLOCK, len(h) - first)
            inputs, steps = np.zeros((BLOCK, u.shape[1])), np.zeros(BLOCK)
            inputs[:size], steps[:size] = u[first : first + size], h[first : first + size]
            rows.append(np.asarray(self._steps(rows[-1][-1], inputs.T, steps[None])).T[:size])
        return np.concatenate(rows)

    @cached_property
    def matrix(self) -> Callable[[Array], Array]:
        """``x (n,) -> G(x) (n, m)``."""
        function = ca.Function("G", [self.x], [self.G])
        return lambda x: np.array(function(x)).reshape(self.n, self.m)

    def samples(self, count: int, seed: int = 0) -> Array:
        """Random states (count, n) of the domain."""
        random = np.random.default_rng(seed)
        bounds = np.array([self.domain.get(name, (-1.0, 1.0)) for name in self.states])
        return random.uniform(bounds[:, 0], bounds[:, 1], (count, self.n))

    def check_state(self, key: str, values: Any) -> Array:
        """A state (n,) as an array. Raises ``InputError`` if a number is missing, not finite or outside the domain."""
        x = np.asarray(values, float).ravel() if values is not None else np.zeros(0)
        if x.shape != (self.n,) or not np.all(np.isfinite(x)):
            raise InputError(
                "not a state",
                f"give {self.n} finite numbers: {', '.join(self.states)}",
                key=key,
                value=values,
                subject=self.name,
            )
        for name, value in zip(self.states, x, strict=True):
            lower, upper = self.domain.get(name, (-np.inf, np.inf))
            if not lower <= value <= upper:
                raise InputError(
                    f"outside {lower:g} to {upper:g}, the chart that can be steered in",
                    "give a value inside it",
                    key=f"{key}.{name}",
                    value=value,
                    subject=self.name,
                )
        return x


def from_constraints(
    name: str,
    states: Sequence[str],
    constraints: Callable[[Expr], Any],
    *,
    at: Sequence[float] | None = None,
    domain: Mapping[str, tuple[float, float]] | None = None,
) -> DriftlessSystem:
    """The system that Pfaffian constraints ``W(x) x' = 0``, W (k, n), leave free (SIN sec. 1).

    The inputs are the rates of the states that the constraints do not determine, chosen so that the constraints are
    well conditioned at ``at``, or throughout the domain. Raises ``InputError`` naming a dependent row.
    """
    x = ca.vertcat(*(ca.SX.sym(s) for s in states))
    w = matrix(constraints(x))
    rows, n = w.shape
    if n != len(states) or rows >= n:
        raise InputError(
            f"shape {w.shape}", f"give fewer than {len(states)} rows of {len(states)}", key="constraints", subject=name
        )
    bounds = np.array([(domain or {}).get(s, (-1.0, 1.0)) for s in states])
    random = np.random.default_rng(1).uniform(bounds[:, 0], bounds[:, 1], (8, n))
    points = np.vstack([bounds.mean(axis=1), random]) if at is None else np.asarray(at, float)[None]
    function = ca.Function("W", [x], [ca.densify(w)])
    values = [np.array(function(p)).reshape(rows, n) for p in points]
    regular = [v for v in values if smallest_singular_value(v) > 1e-9 * max(1.0, np.abs(v).max())]
    if not regular:
        k = next(k for k in range(rows) if np.linalg.matrix_rank(values[-1][: k + 1]) <= k)
        raise InputError(
            f"row {k + 1} of {rows} is zero or follows from those above it at {np.round(points[-1], 4).tolist()}",
            "drop it, or give another point `at`",
            key="constraints",
            subject=name,
        )
    pivots = max(combinations(range(n), rows), key=lambda c: min(smallest_singular_value(v[:, c]) for v in regular))
    free = [i for i in range(n) if i not in pivots]

    def fields(x_: Expr) -> Expr:
        g = ca.SX(n, n - rows)
        w_ = matrix(constraints(x_))
        for column, i in enumerate(free):
            g[i, column] = 1
        g[list(pivots), :] = -ca.solve(w_[:, list(pivots)], w_[:, free])
        return g

    return DriftlessSystem(name, tuple(states), tuple(f"{states[i]}_rate" for i in free), fields, domain or {})


def smallest_singular_value(a: Array) -> float:
    return float(np.linalg.svd(a, compute_uv=False)[-1]) if a.size else np.inf
