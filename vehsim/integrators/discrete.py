"""Discrete mechanics of one segment, from a vehicle's definition; the forward step and DMOC share it.

The state at a knot is ``(g, r, pi)``: group element, joints, and the momentum restricted to the free velocities. A
segment of length h has one velocity ``z``, and the discrete Legendre transforms map its two ends:

    left(z)  = pi_k        the momentum at the start that belongs to the segment's velocity
    right(z) = pi_k+1      the momentum at the end
    next(z)  = g_k+1, r_k+1

(LIE eq. 10-11 and 17-18 split at the knot, SYM eq. 10-12.) The forward step solves ``left = pi_k`` for ``z``; DMOC
imposes all three equations. Midpoint shape, a symmetric difference map and mirrored force weights make the segment
symmetric, hence second order and suitable for composition. Momenta and velocities at the knots are second-order
accurate.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import casadi as ca

from vehsim.errors import InputError
from vehsim.lie import SO3, difference_map
from vehsim.lie.maps import DEFAULT_MAP, MAPS
from vehsim.vehicles import Vehicle
from vehsim.vehicles.definition.mechanics import (
    Expr,
    coefficients,
    conservative,
    driven_rates,
    free_size,
    free_velocity,
    momentum,
    project,
    rows,
    shape_gradient,
)

QUADRATURES: dict[str, tuple[float, float]] = {
    "galerkin": (1 / 3, 1 / 6),  # exact for forces linear between knots
    "trapezoidal": (1 / 2, 0.0),
    "averaged": (1 / 4, 1 / 4),  # SYM's; blind to forces that alternate from knot to knot
}
"""Weights of a segment's force impulse: (near end, far end) for the momentum at either end."""


Loads = tuple[tuple[Expr, Expr], tuple[Expr, Expr]]
"""Applied forces and forces of a potential, each on the joints (s,) and on the group (d,)."""


@dataclass(frozen=True, eq=False)
class DiscreteMechanics:
    """Expressions and functions of one segment of ``vehicle``.

    Symbols (columns): ``g`` (size,), ``r`` (s,), ``pi`` and ``z`` (n_z,), ``c0, c1`` (c,) controls at both ends,
    ``h`` s, ``wind`` (3,) m/s.
    """

    vehicle: Vehicle
    map_name: str = DEFAULT_MAP
    quadrature: str = "galerkin"

    def __post_init__(self) -> None:
        difference_map(self.map_name, self.vehicle.group)
        if self.quadrature not in QUADRATURES:
            raise InputError(
                "unknown", f"choose one of {', '.join(QUADRATURES)}", key="quadrature", value=self.quadrature
            )

    @cached_property
    def sizes(self) -> tuple[int, int, int, int]:
        """(group coordinates, joints, segment velocity, controls)."""
        v = self.vehicle
        return v.group.size, len(v.joints), free_size(v), len(v.controls)

    @cached_property
    def symbols(self) -> dict[str, Expr]:
        size, s, n, c = self.sizes
        shapes = {"g": size, "r": s, "pi": n, "z": n, "c0": c, "c1": c, "h": 1, "wind": 3}
        return {name: ca.SX.sym(name, count) for name, count in shapes.items()}

    def driven(self, c: Expr) -> Expr:
        """Joint rates (s,) that rate controls set, zero for the dynamic joints."""
        return driven_rates(self.vehicle, c)

    @cached_property
    def segment(self) -> dict[str, Expr]:
        """``left, right`` (n_z,), ``g1`` (size,), ``r1`` (s,) as expressions of ``symbols``.

        ``bend`` is the part of ``left`` that depends most nonlinearly on ``z``, and is cheap to differentiate; ``push``
        is the contribution of forces.
        """
        v, wind = self.vehicle, self.symbols["wind"]

        def loads(_: int, g: Expr, r: Expr, u: Expr, xi: Expr, c: Expr) -> Loads:
            return v.force(g, r, u, xi, c, wind), conservative(v, g, r)

        return self.segment_under(loads)

    def segment_under(
        self, loads: Callable[[int, Expr, Expr, Expr, Expr, Expr], Loads], end: Expr | None = None
    ) -> dict[str, Expr]:
        """`segment` under ``loads``: ``(k, g, r, u, xi, c) -> `` forces at its start (k = 0) and its end (k = 1).

        ``end`` (size,): symbols that stand for ``g1`` there; by default they are its expression.
        """
        v, y = self.vehicle, self.symbols
        g, r, z, c0, c1, h = (y[name] for name in ("g", "r", "z", "c0", "c1", "h"))
        tau = difference_map(self.map_name, v.group)

        middle, rate = self._middle(r, z, self.driven((c0 + c1) / 2), h)
        u, xi = rate
        on_joints, on_group = momentum(v, middle, u, xi)
        x = tau.increment(self._inertia, xi, h)
        g1, r1 = v.group.compose(g, tau.tau(x)), r + h * u
        shape = shape_gradient(v, middle, u, xi)

        start, steady = loads(0, g, r, u, xi, c0)
        stop, steady1 = loads(1, g1 if end is None else end, r1, u, xi, c1)
        near, far = QUADRATURES[self.quadrature]
        # forces of a potential stay variational: half of each end's impulse at that end, for every quadrature
        before = [h * (near * a + far * b + p / 2) for a, b, p in zip(start, stop, steady, strict=True)]
        after = [h * (far * a + near * b + p / 2) for a, b, p in zip(start, stop, steady1, strict=True)]
        left = project(v, r, on_joints - h / 2 * shape - before[0], tau.dual(x, on_group) - before[1])
        right = project(v, r1, on_joints + h / 2 * shape + after[0], tau.dual_end(x, on_group) + after[1])
        damped = [h * (near + far) * f for f in start]
        bend = project(v, r, on_joints - h / 2 * shape - damped[0], tau.near.dual(h * xi, on_group) - damped[1])
        push = project(v, r, *before)
        return {"left": left, "right": right, "g1": g1, "r1": r1, "bend": bend, "push": push}

    @property
    def _follows_free_flight(self) -> bool:
        return bool(MAPS[self.map_name].free_flight)  # with long steps: worth two more iterations

    def _inertia(self) -> Any:
        """Inertia (d, d) of a single body. Raises ``InputError`` for other vehicles."""
        v, (_, s, n, _) = self.vehicle, self.sizes
        if s or n < v.group.dim:
            raise InputError(
                f"{v.name} is not a single body without constraints",
                "choose another map",
                key="difference_map",
                value=self.map_name,
            )
        xi = ca.SX.sym("xi", n)
        return ca.evalf(ca.hessian(v.reduced_lagrangian(ca.SX(0, 1), ca.SX(0, 1), xi), xi)[0]).full()

    def _middle(self, r: Expr, z: Expr, driven: Expr, h: Expr) -> tuple[Expr, tuple[Expr, Expr]]:
        """Shape at mid-segment and the velocity ``(u, xi)`` there."""
        u, _ = free_velocity(self.vehicle, r, z, driven)
        middle, tied = r + h / 2 * u, self.vehicle.tied
        if tied:  # the rates of tied joints depend on the shape that they produce: Newton's method, unrolled
            symbols = [ca.SX.sym(x, n.shape[0]) for x, n in (("m", r), ("r", r), ("z", z), ("driven", r), ("h", h))]
            m_, r_, z_, driven_, h_ = symbols
            gap = rows(m_ - r_ - h_ / 2 * free_velocity(self.vehicle, m_, z_, driven_)[0], tied)
            update = ca.solve(ca.jacobian(gap, m_)[:, list(tied)], gap)
            newton = ca.Function("middle", symbols, [update])
            for _ in range(NEWTON_STEPS):
                middle[list(tied)] -= newton(middle, r, z, driven, h)
        return middle, free_velocity(self.vehicle, middle, z, driven)

    @cached_property
    def advance(self) -> ca.Function:
        """``(g, r, pi, z_guess, c0, c1, h, wind) -> (g1, r1, pi1, z, residual)`` by Newton's method, unrolled."""
        y, given = self.symbols, self._given
        residual = self.segment["left"] - y["pi"]
        jacobian = ca.jacobian(residual, y["z"])
        update = y["z"] - (ca.solve(jacobian, residual) if jacobian.shape[0] else residual)
        newton = ca.Function("newton", given, [update])
        z = y["z"]
        for _ in range(NEWTON_STEPS):
            z = newton(z, *given[1:])
        size = ca.diag(ca.jacobian(self.segment["bend"], y["z"]))
        return ca.Function("advance", self._inputs, self._finish(z, size))

    @cached_property
    def advance_fast(self) -> ca.Function:
        """`advance` at a fifth of its cost: a predicted velocity, and one cheap Jacobian for all iterations.

        The Jacobian omits where forces act and the curvature of the map, which enter with h^2 only. So at ordinary
        steps the residual reaches round-off; otherwise the residual shows it. ``z`` is the velocity of the previous
        segment.
        """
        return self._chords(1, predicted=True)

    @cached_property
    def advance_far(self) -> ca.Function:
        """`advance_fast` for long steps: the Jacobian is renewed twice. Still much cheaper than a full Newton
        iteration."""
        return self._chords(3)

    @property
    def _given(self) -> list[Expr]:
        return [self.symbols[n] for n in ("z", "g", "r", "pi", "c0", "c1", "h", "wind")]

    @property
    def _inputs(self) -> list[Expr]:
        return [self.symbols[n] for n in ("g", "r", "pi", "z", "c0", "c1", "h", "wind")]

    def _chords(self, rounds: int, predicted: bool = False) -> ca.Function:
        y, given = self.symbols, self._given
        left = self.segment["left"] - y["pi"]
        exact = ca.jacobian(left, y["z"])
        explicit = not ca.depends_on(exact, y["z"])  # LIE's car with C_TLN: one solve, from any start
        jacobian = exact if explicit else ca.jacobian(self.segment["bend"], y["z"])
        slope = ca.Function("slope", given, [_inverse(jacobian), ca.densify(ca.diag(jacobian))])
        residual = ca.Function("residual", given, [left])
        z = y["z"]
        # extrapolate past the knot's velocity by as much as the previous segment fell short of it
        if predicted and not explicit:
            z = 2 * self.knot_velocity_guess(y["r"], y["pi"], y["c0"]) - z
        size = slope(z, *given[1:])[1]
        for _ in range(1 if explicit else rounds):
            matrix, _ = slope(z, *given[1:])
            for _ in range(1 if explicit else CHORD_STEPS + 2 * self._follows_free_flight):
                z = z - matrix @ residual(z, *given[1:])
        return ca.Function("advance_chords", self._inputs, ca.cse([ca.densify(x) for x in self._finish(z, size)]))

    def _finish(self, z: Expr, inertia: Expr) -> list[Expr]:
        """``g1, r1, pi1, z`` of a solved segment, and its residual relative to the terms that it balances.

        ``inertia`` (n_z,): the approximate momentum of a unit of each velocity.
        """
        segment, given = self.segment, self._given
        residual = segment["left"] - self.symbols["pi"]
        # component by component: momenta of a wheel and of a whole car differ by orders of magnitude
        outputs = [segment["g1"], segment["r1"], segment["right"], residual, segment["push"]]
        g1, r1, pi1, residual, push = ca.Function("finish", given, outputs)(z, *given[1:])
        size = 1e-3 * ca.fabs(inertia) + ca.fabs(self.symbols["pi"]) + ca.fabs(push)
        error = ca.mmax(ca.fabs(residual) / size) if residual.shape[0] else ca.SX(0)
        r = self.symbols["r"]
        regular = [self.vehicle.regularity(at) for at in (r, (r + r1) / 2, r1)]
        if any(not isinstance(x, float) for x in regular):
            error = ca.if_else(ca.mmin(ca.vertcat(*regular)) > _SINGULAR, error, ca.inf)
        # carry the remaining residual along; otherwise a million steps would accumulate it
        return [g1, r1, pi1 - residual, z, error]

    @cached_property
    def knot_momentum(self) -> ca.Function:
        """``(r, u, xi) -> pi``: the restricted momentum of joint rates and group velocity at a knot."""
        v = self.vehicle
        r, u, xi = ca.SX.sym("r", len(v.joints)), ca.SX.sym("u", len(v.joints)), ca.SX.sym("xi", v.group.dim)
        return ca.Function("knot_momentum", [r, u, xi], [project(v, r, *momentum(v, r, u, xi))])

    @cached_property
    def wrench_momentum(self) -> ca.Function:
        """``(g, r, wrench) -> (n_z,)``: the rate of the restricted momentum due to a body wrench (d,)."""
        v, y = self.vehicle, self.symbols
        wrench = ca.SX.sym("wrench", v.group.dim)
        covector = project(v, y["r"], ca.SX(len(v.joints), 1), v.group.wrench_from_body(y["g"], wrench))
        return ca.Function("wrench", [y["g"], y["r"], wrench], [covector])

    @cached_property
    def knot_velocity(self) -> ca.Function:
        """``(r, pi, c) -> (u, xi)``: joint rates and group velocity at a knot; exact for quadratic Lagrangians."""
        v, y = self.vehicle, self.symbols
        r, pi, z, c = y["r"], y["pi"], y["z"], y["c0"]
        u, xi = free_velocity(v, r, z, self.driven(c))
        restricted = project(v, r, *momentum(v, r, u, xi))
        still = ca.SX.zeros(z.shape[0])
        mass, rest = (ca.substitute(x, z, still) for x in (ca.jacobian(restricted, z), restricted))
        solved = ca.ldl_solve(pi - rest, *ca.ldl(mass)) if z.shape[0] else z
        values = ca.substitute([u, xi], [z], [ca.densify(solved)])
        return ca.Function("knot_velocity", [r, pi, c], values)

    @cached_property
    def knot_velocity_guess(self) -> ca.Function:
        """``(r, pi, c) -> z``: the knot's own velocity as the initial guess for its segment."""
        v, y = self.vehicle, self.symbols
        u, xi = self.knot_velocity(y["r"], y["pi"], y["c0"])
        return ca.Function("guess", [y["r"], y["pi"], y["c0"]], [coefficients(v, y["r"], u, xi)])

    @cached_property
    def root_state(self) -> ca.Function:
        """``(g, r, pi, c) -> (pose (7,), twist (d,), r, u)`` of the rig's root: what `State` and clips hold."""
        v, y = self.vehicle, self.symbols
        g = y["g"]
        u, xi = self.knot_velocity(y["r"], y["pi"], y["c0"])
        pose = v.group.pose(v.group.normalize(g))
        root = ca.vertcat(pose[0:3] - SO3.matrix(pose[3:7]) @ ca.DM(v.origin), pose[3:7])
        twist = v.group.shift(v.group.velocity_to_body(g, xi), ca.DM(-v.origin))
        return ca.Function("root_state", [g, y["r"], y["pi"], y["c0"]], [root, twist, y["r"], u])


def mechanics_of(vehicle: Vehicle, map_name: str, quadrature: str) -> DiscreteMechanics:
    """One per vehicle object and scheme: expressions are built once and live as long as the vehicle."""
    kept = vehicle.__dict__.setdefault("_mechanics", {})
    key = (map_name, quadrature)
    if key not in kept:
        kept[key] = DiscreteMechanics(vehicle, map_name, quadrature)
    return kept[key]


def keep(mechanics: DiscreteMechanics, key: str, build: Callable[[], Any]) -> Any:
    """A value built once and kept as long as the mechanics."""
    kept = mechanics.__dict__.setdefault("_kept", {})
    if key not in kept:
        kept[key] = build()
    return kept[key]


NEWTON_STEPS = 4
"""From a warm start two iterations reach round-off at ordinary steps; otherwise the residual shows it."""


_SINGULAR = 1e-8
"""Regularity of the eliminated columns below which round-off spoils a step."""

CHORD_STEPS = 3
"""From a predicted start two iterations reach the tolerance at ordinary steps, three reach round-off."""


def _inverse(matrix: Expr) -> Expr:
    """Inverse (n, n) by blocks, without pivots: for mass matrices, nearly symmetric and positive definite."""
    n = matrix.shape[0]
    if n == 0:
        return ca.SX(0, 0)
    if n <= 3:
        return ca.inv_minor(matrix)
    k = n // 2
    a, b, c, d = matrix[:k, :k], matrix[:k, k:], matrix[k:, :k], matrix[k:, k:]
    first = _inverse(a)
    down, across = c @ first, first @ b
    second = _inverse(d - down @ b)
    back = second @ down
    return ca.vertcat(ca.horzcat(first + across @ back, -across @ second), ca.horzcat(-back, second))
