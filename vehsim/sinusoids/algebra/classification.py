"""The control Lie algebra of a driftless system: filtration, growth, and the consequences for steering (SIN sec. 1).

Ranks follow from singular values at several random states (generic) and at a given one. A decision without a clear gap
between singular values is reported as uncertain. The brackets are in `brackets.py`.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import casadi as ca
import numpy as np

from vehsim.errors import InputError
from vehsim.sinusoids.algebra.brackets import (
    Bracket,
    Rank,
    evaluate,
    function_of,
    growth_bound,
    hall_levels,
    input_fields,
    product,
    rank_of,
)
from vehsim.sinusoids.system import Array, DriftlessSystem

SAMPLES = 6
"""Random states at which generic ranks are decided."""
DEEPEST = 12
"""Brackets of more fields than this are not evaluated."""
WIDEST, LONGEST = 200, 200_000
"""Largest number of brackets of one degree, and of operations in an expression."""


@dataclass(frozen=True)
class Classification:
    """Properties of the control Lie algebra. Growth vectors are generic, ``*_at`` those at the given state.

    ``growth``: r_i = rank G_i; ``relative_growth``: r_i - r_{i-1}; ``bound``: sigma_i, the largest possible growth of m
    fields (SIN eq. 2). ``brackets``: degree of nonholonomy as SIN's examples count it, the number of bracketings (1 for
    Brockett's system); ``levels``: as its definition counts it, the number of G_i (2 there). ``nilpotency``: the k from
    which all Lie products of k fields vanish, None if there is none up to ``depth``. ``basis``: brackets that span
    generically. ``span_at`` (n, k): all evaluated brackets, as vectors at the state. ``notes``: why the result is not
    ``certain``. ``regular``: the growth at the state is the generic one. ``controllable``: Chow's condition, at the
    state (and generically).
    """

    system: DriftlessSystem
    at: Array
    growth: tuple[int, ...]
    growth_at: tuple[int, ...]
    bound: tuple[int, ...]
    nilpotency: int | None
    basis: tuple[Bracket, ...]
    regular: bool
    certain: bool
    depth: int
    span_at: Array
    notes: tuple[str, ...] = ()

    @property
    def relative_growth(self) -> tuple[int, ...]:
        return _relative(self.growth)

    @property
    def relative_growth_at(self) -> tuple[int, ...]:
        return _relative(self.growth_at)

    @property
    def levels(self) -> int:
        return len(self.growth)

    @property
    def brackets(self) -> int:
        return len(self.growth) - 1

    @property
    def controllable(self) -> bool:
        return self.growth_at[-1] == self.system.n

    @property
    def maximal_growth(self) -> bool:
        """Whether a_i = sigma_i for every level (SIN sec. 1), and the brackets span everything."""
        return self.growth[-1] == self.system.n and self.relative_growth == self.bound[: self.levels]

    def require_controllable(self) -> None:
        """Raise ``InputError`` naming the directions that no bracket reaches."""
        if self.controllable:
            return
        rank = self.growth_at[-1]
        missing = _words(self.system, _annihilator(self.span_at, rank))
        notes = "".join(f"; {note}" for note in self.notes)
        raise InputError(
            f"not controllable at {np.round(self.at, 4).tolist()}: its brackets span {rank} of {self.system.n} "
            f"directions (growth {self.growth_at}); no bracket reaches {', '.join(missing)}",
            f"choose a goal on the leaf through the start (vehsim.sinusoids.algebra.leaf), or another input{notes}",
            subject=self.system.name,
        )


def classify(system: DriftlessSystem, at: Sequence[float] | None = None, depth: int | None = None) -> Classification:
    """The control Lie algebra of ``system``, generically and at the state ``at`` (default: the middle of the domain).

    ``depth``: greatest number of fields in a bracket; default: two more than the generic filtration needs.
    """
    x0 = _middle(system) if at is None else np.asarray(at, float)
    if x0.shape != (system.n,) or not np.all(np.isfinite(x0)):
        raise InputError(
            "not a state",
            f"give {system.n} finite numbers: {', '.join(system.states)}",
            key="at",
            value=at,
            subject=system.name,
        )
    points = system.samples(SAMPLES)
    growth, basis, ranks = _generic_filtration(system, points, min(depth or DEEPEST, DEEPEST))
    notes = [f"generic rank {r.value} has a gap of only {r.gap:.0e}" for r in ranks if not r.certain]
    growth_at, more, span_at = _growth_at(system, x0, growth, basis, min(depth or DEEPEST, DEEPEST))
    notes += [f"rank {r.value} at the state has a gap of only {r.gap:.0e}" for r in more if not r.certain]
    if growth_at[-1] < growth[-1]:
        notes.append(f"rank {growth_at[-1]} at the state up to brackets of {len(more)} fields: deeper ones may add")
    if len(growth) == min(depth or DEEPEST, DEEPEST) and growth[-1] < system.n:
        notes.append(f"generic rank {growth[-1]} up to brackets of {len(growth)} fields: deeper ones may add")
    bound = growth_bound(system.m, len(growth))
    return Classification(
        system=system,
        at=x0,
        growth=growth,
        growth_at=growth_at,
        bound=bound,
        nilpotency=_nilpotency(system, points, (depth or len(growth)) + 1),
        basis=tuple(basis),
        regular=growth_at[: len(growth)] == growth,
        certain=not notes,
        depth=depth or len(growth) + 1,
        span_at=span_at,
        notes=tuple(notes),
    )


@dataclass(frozen=True, eq=False)
class Leaf:
    """The manifold through ``at`` to which the motion of an uncontrollable system is confined (Frobenius).

    ``dimension``; ``span``: brackets whose fields span its tangent space near ``at``; ``pivots``: states that serve as
    its coordinates there.
    """

    system: DriftlessSystem
    at: Array
    span: tuple[Bracket, ...]
    pivots: tuple[int, ...]

    @property
    def dimension(self) -> int:
        return len(self.span)

    def tangent(self, x: Any) -> Array:
        """Basis (n, r) of the tangent space at ``x``."""
        return np.asarray(self._tangent(np.asarray(x, float)))

    @cached_property
    def _tangent(self) -> ca.Function:
        return function_of(self.system, self.span)

    def annihilator(self, x: Any) -> Array:
        """Orthonormal covectors (n - r, n) that vanish on the leaf's tangent space at ``x``."""
        return _annihilator(self.tangent(x), self.dimension)

    def offset(self, x: Any) -> Array:
        """Offset of ``x`` from the leaf: (n - r,), zero on it.

        ``x`` is moved along its own leaf until its pivot states equal those of ``at``; the offset is the difference of
        the other states. Raises ``InputError`` if the pivots cannot be reached in this way.
        """
        from scipy.integrate import solve_ivp

        x, pivots = np.asarray(x, float), list(self.pivots)
        gap = self.at[pivots] - x[pivots]

        def rate(_: float, y: Array) -> Array:
            t = self.tangent(y)
            return t @ np.linalg.solve(t[pivots], gap)

        try:
            end = solve_ivp(rate, (0, 1), x, method="DOP853", rtol=1e-11, atol=1e-12).y[:, -1]
        except np.linalg.LinAlgError:
            end = np.full(self.system.n, np.nan)
        rest = [i for i in range(self.system.n) if i not in pivots]
        if not np.all(np.isfinite(end)) or np.abs(end[pivots] - self.at[pivots]).max(initial=0) > 1e-6:
            raise InputError(
                f"the leaf's coordinates {[self.system.states[i] for i in pivots]} fail between "
                f"{np.round(x, 4).tolist()} and {np.round(self.at, 4).tolist()}",
                "compare nearer states",
                subject=self.system.name,
            )
        return end[rest] - self.at[rest]

    def missing(self) -> list[str]:
        """The unreached directions in words: covectors, rounded."""
        return _words(self.system, self.annihilator(self.at))


def _annihilator(vectors: Array, rank: int) -> Array:
    """Orthonormal covectors (n - rank, n) that vanish on the columns of (n, k)."""
    return np.linalg.svd(vectors)[0][:, rank:].T


def _words(system: DriftlessSystem, covectors: Array) -> list[str]:
    """Covectors (k, n) as text, such as ``dz - 0.4 dx``."""
    words = []
    for row in covectors:
        row = row / row[np.argmax(np.abs(row))]
        sizes = [(c, f"{abs(c):.3g} d{s}".removeprefix("1 ")) for c, s in zip(row, system.states, strict=True)]
        terms = [f"{'-' if c < 0 else '+'} {size}" for c, size in sizes if abs(c) > 1e-9]
        words.append(" ".join(terms).removeprefix("+ "))
    return words


def leaf(system: DriftlessSystem, at: Sequence[float] | Array, known: Classification | None = None) -> Leaf:
    """The leaf through ``at``, from the involutive closure of the input fields."""
    from scipy.linalg import qr

    x0 = np.asarray(at, float)
    span = (known or classify(system, x0.tolist())).basis
    value = evaluate(system, span, x0[None])[0]
    if rank_of(value).value < len(span):
        raise InputError(
            "a singular state, its leaf is smaller than those around it",
            "ask at a regular state",
            key="at",
            value=x0.tolist(),
            subject=system.name,
        )
    _, _, order = qr(value.T, pivoting=True)
    return Leaf(system, x0, tuple(span), tuple(sorted(int(i) for i in order[: len(span)])))


def _generic_filtration(
    system: DriftlessSystem, points: Array, depth: int
) -> tuple[tuple[int, ...], list[Bracket], list[Rank]]:
    """Generic growth, brackets that realise it, and the certainty of each rank.

    Over functions, G_{i+1} needs only brackets of the inputs with the new fields of G_i, because all older ones are in
    G_i.
    """
    basis: list[Bracket] = []
    candidates = inputs = input_fields(system)
    growth: list[int] = []
    ranks: list[Rank] = []
    values = np.zeros((len(points), system.n, 0))
    while candidates:
        new, values = _select(values, evaluate(system, candidates, points), ranks)
        basis += [candidates[i] for i in new]
        if not new and growth:
            break
        growth.append(len(basis))
        if len(basis) == system.n or len(growth) == depth:
            break
        pairs = [(i, k) for k in new for i in range(system.m) if len(growth) > 1 or i < k]
        candidates = [product(inputs[i], candidates[k], system.x) for i, k in pairs]
    return tuple(growth), basis, ranks


def _select(values: Array, columns: Array, ranks: list[Rank]) -> tuple[list[int], Array]:
    """Candidates, columns of (k, n, c), that increase the generic rank, best conditioned first."""
    chosen: list[int] = []
    while len(chosen) < columns.shape[2]:
        trials = []
        for i in range(columns.shape[2]):
            if i not in chosen:
                stack = np.concatenate([values, columns[:, :, i : i + 1]], axis=2)
                # the rank is generic: the largest over the states, with the clearest gap
                trials.append((max((rank_of(s) for s in stack), key=lambda r: (r.value, r.gap)), -i, stack))
        best, index, stack = max(trials, key=lambda t: (t[0].value, _conditioning(t[2]), t[1]))
        if best.value <= values.shape[2]:
            ranks += [best]
            break
        chosen.append(-index)
        values = stack
        ranks += [best]
    return sorted(chosen), values


def _conditioning(stack: Array) -> float:
    """Median of the smallest singular values, rounded to two digits so that earlier brackets win ties."""
    unit = stack / np.maximum(np.linalg.norm(stack, axis=1, keepdims=True), 1e-300)
    if stack.shape[2] > stack.shape[1]:
        return 0.0
    return float(np.round(np.median(np.linalg.svd(unit, compute_uv=False)[:, -1]), 2))


def _growth_at(
    system: DriftlessSystem, x0: Array, growth: tuple[int, ...], basis: list[Bracket], depth: int
) -> tuple[tuple[int, ...], list[Rank], Array]:
    """Growth at one state, the evaluated ranks, and the vectors (n, k) that span.

    If the generic basis has a lower rank, a Hall basis is evaluated beyond the end of generic growth.
    """
    span = evaluate(system, basis, x0[None])[0]
    ranks = [rank_of(span[:, [b.degree <= level for b in basis]]) for level in range(1, len(growth) + 1)]
    if tuple(rank.value for rank in ranks) == growth:
        return growth, ranks, span
    span, ranks = np.zeros((system.n, 0)), []
    for values in _hall_values(system, x0[None], depth):
        span = np.hstack([span, values[0]])
        ranks.append(rank_of(span))
        if ranks[-1].value == growth[-1]:
            break
    grown = [rank.value for rank in ranks]
    while len(grown) > 1 and grown[-1] == grown[-2] < growth[-1]:
        grown.pop()
    return tuple(grown), ranks, span


def _nilpotency(system: DriftlessSystem, points: Array, depth: int) -> int | None:
    """The smallest k such that all brackets of k fields vanish, up to ``depth``."""
    size = 1.0
    for k, values in enumerate(_hall_values(system, points, depth), 1):
        largest = float(np.abs(values).max(initial=0.0))
        if k > 1 and largest <= 1e-10 * max(1.0, size):
            return k
        size = largest
    return None


def _hall_values(system: DriftlessSystem, points: Array, depth: int) -> Iterator[Array]:
    """Values (k, n, c) of a Hall basis at states (k, n), degree by degree, as far as the cost permits."""
    levels = hall_levels(system)
    for width in growth_bound(system.m, depth):
        if width > WIDEST:
            return
        level = next(levels)
        if function_of(system, level).n_instructions() > LONGEST:
            return
        yield evaluate(system, level, points)


def _middle(system: DriftlessSystem) -> Array:
    return np.array([sum(system.domain.get(name, (0.0, 0.0))) / 2 for name in system.states])


def _relative(growth: tuple[int, ...]) -> tuple[int, ...]:
    return tuple(b - a for a, b in zip((0, *growth[:-1]), growth, strict=True))
