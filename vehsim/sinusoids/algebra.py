"""The control Lie algebra of a driftless system: filtration, growth, and what follows for steering (SIN sec. 1).

Brackets are symbolic; ranks are decided from singular values at several random states (generic) and at a given one,
and a decision without a clear gap between the singular values is called uncertain, not guessed.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np

from vehsim.errors import InputError
from vehsim.sinusoids.system import Array, DriftlessSystem, Expr

SAMPLES = 6
"""Random states at which generic ranks are decided."""
TOLERANCE = 1e-9
"""Singular values of unit columns below it count as zero."""
GAP = 1e3
"""Smallest ratio between the singular values on either side of a rank that is called certain."""
DEEPEST = 12
"""Brackets of more fields than this are not looked at."""


@dataclass(frozen=True)
class Bracket:
    """A Lie product: ``label`` such as ``[g1, [g1, g2]]``, of ``degree`` input fields; ``field`` (n,) of the state."""

    label: str
    degree: int
    field: Expr


@dataclass(frozen=True)
class Rank:
    """A rank read off singular values. ``gap``: the ratio across the cut; ``certain`` when it is wide."""

    value: int
    gap: float

    @property
    def certain(self) -> bool:
        return self.gap >= GAP


@dataclass(frozen=True)
class Classification:
    """What the control Lie algebra says. Growth vectors are generic, ``*_at`` those at the state asked about.

    ``growth``: r_i = rank G_i; ``relative_growth``: r_i - r_{i-1}; ``bound``: sigma_i, the most any m fields can grow
    (SIN eq. 2). ``brackets``: degree of nonholonomy as SIN's examples count it, bracketings needed (1 for Brockett's
    system); ``levels``: as its definition does, the number of G_i (2 there). ``nilpotency``: the k from which all Lie
    products of k fields vanish, None when there is none up to ``depth``. ``basis``: brackets that span generically.
    ``regular``: the growth at the state is the generic one. ``controllable``: Chow, at the state (and generically).
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
        """a_i = sigma_i for every level (SIN sec. 1), and the brackets span everything."""
        return self.growth[-1] == self.system.n and self.relative_growth == self.bound[: self.levels]

    def require_controllable(self) -> None:
        """``InputError`` naming the directions that no bracket reaches."""
        if self.controllable:
            return
        n, rank = self.system.n, self.growth_at[-1]
        missing = leaf(self.system, self.at, self).missing()
        raise InputError(
            f"{self.system.name}: not controllable at {np.round(self.at, 4).tolist()}: its brackets span {rank} of {n} "
            f"directions (growth {self.growth_at}); no bracket reaches {', '.join(missing)}: choose a goal on the leaf "
            "through the start (vehsim.sinusoids.leaf), or another input"
        )


def classify(system: DriftlessSystem, at: Sequence[float] | None = None, depth: int | None = None) -> Classification:
    """The control Lie algebra of ``system``, generically and at the state ``at`` (the middle of the domain).

    ``depth``: most fields in a bracket; as many as the generic filtration needs and two more unless given.
    """
    x0 = _middle(system) if at is None else np.asarray(at, float)
    if x0.shape != (system.n,) or not np.all(np.isfinite(x0)):
        raise InputError(f"{system.name}: at = {at!r}: give {system.n} finite numbers: {', '.join(system.states)}")
    points = system.samples(SAMPLES)
    growth, basis, ranks = _generic_filtration(system, points, min(depth or DEEPEST, DEEPEST))
    notes = [f"generic rank {r.value} has a gap of only {r.gap:.0e}" for r in ranks if not r.certain]
    growth_at, more, unfinished = _growth_at(system, x0, growth, basis, depth)
    notes += [f"rank {r.value} at the state has a gap of only {r.gap:.0e}" for r in more if not r.certain]
    if unfinished:
        notes.append(
            f"rank {growth_at[-1]} at the state up to brackets of {len(growth_at)} fields: deeper ones may add"
        )
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
        notes=tuple(notes),
    )


def growth_bound(m: int, levels: int) -> tuple[int, ...]:
    """sigma_1 .. sigma_levels: dimensions of the free Lie algebra on m generators, by degree (SIN eq. 2)."""
    sigma: list[int] = []
    for i in range(1, levels + 1):
        sigma.append((m**i - sum(j * sigma[j - 1] for j in range(1, i) if i % j == 0)) // i)
    return tuple(sigma)


def lie_bracket(f: Expr, g: Expr, x: Expr) -> Expr:
    """``[f, g] = (dg/dx) f - (df/dx) g``."""
    return ca.jtimes(g, x, f) - ca.jtimes(f, x, g)


def hall_basis(system: DriftlessSystem, degree: int) -> list[Bracket]:
    """All brackets of a Philip Hall basis up to ``degree`` fields, in order."""
    x = system.x
    # an element is (degree, left, right); [a, b] belongs when a < b and b's left factor is not after a
    found: list[tuple[Bracket, int, int]] = [(Bracket(f"g{i + 1}", 1, system.G[:, i]), -1, -1) for i in range(system.m)]
    for d in range(2, degree + 1):
        level = []
        for i, (a, _, _) in enumerate(found):
            for j, (b, left, _) in enumerate(found):
                if a.degree + b.degree != d or i >= j or (b.degree > 1 and left > i):
                    continue
                level.append((_product(a, b, x), i, j))
        found += level
    return [bracket for bracket, _, _ in found]


def _product(a: Bracket, b: Bracket, x: Expr) -> Bracket:
    return Bracket(f"[{a.label}, {b.label}]", a.degree + b.degree, lie_bracket(a.field, b.field, x))


def rank_of(vectors: Array) -> Rank:
    """Rank of the columns of (n, k), each scaled to unit length; columns that vanish do not count."""
    lengths = np.linalg.norm(vectors, axis=0)
    scale = max(1.0, lengths.max(initial=0.0))
    counts = lengths > TOLERANCE * scale
    kept = vectors[:, counts] / lengths[counts]
    if not kept.size:
        return Rank(0, np.inf)
    values = np.linalg.svd(kept, compute_uv=False)
    value = int(np.sum(values > TOLERANCE * max(1.0, values[0])))
    below = values[value] if value < len(values) else 0.0
    return Rank(value, float(values[value - 1] / max(below, 1e-16 * values[0])))


@dataclass(frozen=True, eq=False)
class Leaf:
    """The manifold through ``at`` that a system which is not controllable stays on (Frobenius).

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
        fields = ca.horzcat(*(b.field for b in self.span))
        return np.array(ca.Function("T", [self.system.x], [ca.densify(fields)])(np.asarray(x, float)))

    def annihilator(self, x: Any) -> Array:
        """Orthonormal covectors (n - r, n) that vanish on the leaf's tangent space at ``x``."""
        u, _, _ = np.linalg.svd(self.tangent(x))
        return u[:, self.dimension :].T

    def offset(self, x: Any) -> Array:
        """How far ``x`` is from the leaf: (n - r,), zero on it.

        ``x`` is carried along its own leaf until its pivot states are those of ``at``; the other states then differ
        by the offset. Raises ``InputError`` where the pivots cannot be reached that way.
        """
        from scipy.integrate import solve_ivp

        x, pivots = np.asarray(x, float), list(self.pivots)
        way = self.at[pivots] - x[pivots]

        def rate(_: float, y: Array) -> Array:
            t = self.tangent(y)
            return t @ np.linalg.solve(t[pivots], way)

        try:
            end = solve_ivp(rate, (0, 1), x, method="DOP853", rtol=1e-11, atol=1e-12).y[:, -1]
        except np.linalg.LinAlgError:
            end = np.full(self.system.n, np.nan)
        rest = [i for i in range(self.system.n) if i not in pivots]
        if not np.all(np.isfinite(end)) or np.abs(end[pivots] - self.at[pivots]).max(initial=0) > 1e-6:
            raise InputError(
                f"{self.system.name}: the leaf's coordinates {[self.system.states[i] for i in pivots]} fail between "
                f"{np.round(x, 4).tolist()} and {np.round(self.at, 4).tolist()}; compare nearer states"
            )
        return end[rest] - self.at[rest]

    def missing(self) -> list[str]:
        """The directions that are not reached, in words: covectors rounded for reading."""
        words = []
        for row in self.annihilator(self.at):
            row = row / row[np.argmax(np.abs(row))]
            terms = [f"{c:+.3g} d{s}" for c, s in zip(row, self.system.states, strict=True) if abs(c) > 1e-9]
            words.append(" ".join(terms).removeprefix("+").replace("1 d", "d", 1))
        return words


def leaf(system: DriftlessSystem, at: Sequence[float] | Array, known: Classification | None = None) -> Leaf:
    """The leaf through ``at``, from the involutive closure of the input fields."""
    from scipy.linalg import qr

    x0 = np.asarray(at, float)
    span = (known or classify(system, x0.tolist())).basis
    fields = ca.Function("T", [system.x], [ca.densify(ca.horzcat(*(b.field for b in span)))])
    value = np.array(fields(x0)).reshape(system.n, len(span))
    if rank_of(value).value < len(span):
        raise InputError(
            f"{system.name}: at = {x0.tolist()}: a singular state, its leaf is smaller than those around it; "
            "ask at a regular state"
        )
    _, _, order = qr(value.T, pivoting=True)
    return Leaf(system, x0, tuple(span), tuple(sorted(int(i) for i in order[: len(span)])))


def _generic_filtration(
    system: DriftlessSystem, points: Array, depth: int
) -> tuple[tuple[int, ...], list[Bracket], list[Rank]]:
    """Generic growth, brackets that realise it, and how clear each rank was.

    Over functions, G_{i+1} needs only brackets of the inputs with what was new in G_i: everything older is in G_i.
    """
    basis: list[Bracket] = []
    candidates = [Bracket(f"g{i + 1}", 1, system.G[:, i]) for i in range(system.m)]
    growth: list[int] = []
    ranks: list[Rank] = []
    values = np.zeros((len(points), system.n, 0))
    while candidates:
        columns = [_evaluate(system, b.field, points) for b in candidates]
        new, values = _select(values, columns, ranks)
        basis += [candidates[i] for i in new]
        if not new and growth:
            break
        growth.append(len(basis))
        if len(basis) == system.n or len(growth) == depth:
            break
        inputs = [Bracket(f"g{i + 1}", 1, system.G[:, i]) for i in range(system.m)]
        pairs = [(i, k) for k in new for i in range(system.m) if len(growth) > 1 or i < k]
        candidates = [_product(inputs[i], candidates[k], system.x) for i, k in pairs]
    return tuple(growth), basis, ranks


def _select(values: Array, columns: list[Array], ranks: list[Rank]) -> tuple[list[int], Array]:
    """Candidates that raise the generic rank, the best conditioned first."""
    chosen: list[int] = []
    while len(chosen) < len(columns):
        trials = []
        for i, column in enumerate(columns):
            if i not in chosen:
                stack = np.concatenate([values, column[:, :, None]], axis=2)
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
    """Median of the smallest singular values, to two digits so that earlier brackets win ties."""
    unit = stack / np.maximum(np.linalg.norm(stack, axis=1, keepdims=True), 1e-300)
    if stack.shape[2] > stack.shape[1]:
        return 0.0
    return float(np.round(np.median(np.linalg.svd(unit, compute_uv=False)[:, -1]), 2))


def _growth_at(
    system: DriftlessSystem, x0: Array, growth: tuple[int, ...], basis: list[Bracket], depth: int | None
) -> tuple[tuple[int, ...], list[Rank], bool]:
    """Growth at one state. Where it lags behind the generic one, deeper brackets are looked at, all of them."""
    ranks, quick = [], []
    for level in range(1, len(growth) + 1):
        fields = [b.field for b in basis if b.degree <= level]
        ranks.append(rank_of(np.hstack([_evaluate(system, f, x0[None]).T for f in fields])))
        quick.append(ranks[-1].value)
    if tuple(quick) == growth:
        return growth, ranks, False
    limit = depth or _affordable(system.m, len(growth) + 2)
    hall = hall_basis(system, limit)
    grown: list[int] = []
    ranks = []
    for level in range(1, limit + 1):
        columns = [_evaluate(system, b.field, x0[None]).T for b in hall if b.degree <= level]
        ranks.append(rank_of(np.hstack(columns)))
        grown.append(ranks[-1].value)
        if grown[-1] == growth[-1]:
            break
    finished = grown[-1] == growth[-1]
    while not finished and len(grown) > len(growth) and grown[-1] == grown[-2]:
        grown.pop()
    return tuple(grown), ranks, not finished


def _affordable(m: int, levels: int) -> int:
    """The deepest level whose Hall basis stays small."""
    while sum(growth_bound(m, levels)) > 150 and levels > 2:
        levels -= 1
    return levels


def _nilpotency(system: DriftlessSystem, points: Array, depth: int) -> int | None:
    """The smallest k such that all brackets of k fields vanish, up to ``depth`` + 1."""
    limit = _affordable(system.m, depth)
    hall = hall_basis(system, limit)
    for k in range(2, limit + 1):
        fields = [b.field for b in hall if b.degree == k]
        lower = [b.field for b in hall if b.degree == k - 1]
        size = max((np.abs(_evaluate(system, f, points)).max() for f in lower), default=1.0)
        if all(np.abs(_evaluate(system, f, points)).max() <= 1e-10 * max(1.0, size) for f in fields):
            return k
    return None


def _evaluate(system: DriftlessSystem, field: Expr, points: Array) -> Array:
    """(k, n) values of a vector field at states (k, n)."""
    function = ca.Function("f", [system.x], [ca.densify(field)])
    values = np.array([np.asarray(function(p)).ravel() for p in points])
    if not np.all(np.isfinite(values)):
        where = points[int(np.argmin(np.isfinite(values).all(axis=1)))]
        raise InputError(
            f"{system.name}: its fields or their brackets are not finite at {np.round(where, 4).tolist()}: a singular "
            "state of these coordinates; ask at another, or choose other inputs"
        )
    return values


def _middle(system: DriftlessSystem) -> Array:
    return np.array([sum(system.domain.get(name, (0.0, 0.0))) / 2 for name in system.states])


def _relative(growth: tuple[int, ...]) -> tuple[int, ...]:
    return tuple(b - a for a, b in zip((0, *growth[:-1]), growth, strict=True))
