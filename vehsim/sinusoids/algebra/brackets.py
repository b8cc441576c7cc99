"""Lie brackets of a driftless system's input fields, symbolic; their values at states, and ranks of those values.

`classification.py` draws conclusions about the system.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import count, islice

import casadi as ca
import numpy as np

from vehsim.errors import InputError
from vehsim.sinusoids.system import Array, DriftlessSystem, Expr

TOLERANCE = 1e-9
"""Singular values of unit columns below this count as zero."""
GAP = 1e3
"""Smallest ratio between the singular values on either side of a rank that counts as certain."""


@dataclass(frozen=True)
class Bracket:
    """A Lie product: ``label`` such as ``[g1, [g1, g2]]``, of ``degree`` input fields; ``field`` (n,) of the state."""

    label: str
    degree: int
    field: Expr


@dataclass(frozen=True)
class Rank:
    """A rank from singular values. ``gap``: the ratio across the cut; ``certain`` if it is large."""

    value: int
    gap: float

    @property
    def certain(self) -> bool:
        return self.gap >= GAP


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
    return [bracket for level in islice(hall_levels(system), degree) for bracket in level]


def hall_levels(system: DriftlessSystem) -> Iterator[list[Bracket]]:
    """The brackets of a Philip Hall basis, degree by degree, without end."""
    level = input_fields(system)
    found = [(bracket, -1) for bracket in level]
    for degree in count(2):
        yield level
        # [a, b] belongs to the basis if a < b and b's left factor is not after a
        pairs = [
            (i, a, b)
            for i, (a, _) in enumerate(found)
            for b, left in found[i + 1 :]
            if a.degree + b.degree == degree and left <= i
        ]
        level = [product(a, b, system.x) for _, a, b in pairs]
        found += [(bracket, i) for bracket, (i, _, _) in zip(level, pairs, strict=True)]


def input_fields(system: DriftlessSystem) -> list[Bracket]:
    return [Bracket(f"g{i + 1}", 1, system.G[:, i]) for i in range(system.m)]


def product(a: Bracket, b: Bracket, x: Expr) -> Bracket:
    return Bracket(f"[{a.label}, {b.label}]", a.degree + b.degree, lie_bracket(a.field, b.field, x))


def rank_of(vectors: Array) -> Rank:
    """Rank of the columns of (n, k), each scaled to unit length; zero columns do not count."""
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


def function_of(system: DriftlessSystem, brackets: Sequence[Bracket]) -> ca.Function:
    fields = ca.horzcat(ca.SX(system.n, 0), *(b.field for b in brackets))
    return ca.Function("brackets", [system.x], [ca.densify(fields)])


def evaluate(system: DriftlessSystem, brackets: Sequence[Bracket], points: Array) -> Array:
    """(k, n, c) values of brackets at states (k, n)."""
    function = function_of(system, brackets)
    values = np.array([np.asarray(function(p)).reshape(system.n, len(brackets)) for p in points])
    finite = np.isfinite(values).all(axis=(1, 2))
    if not finite.all():
        raise InputError(
            f"its fields or their brackets are not finite at {np.round(points[finite.argmin()], 4).tolist()}: a "
            "singular state of these coordinates",
            "ask at another, or choose other inputs",
            subject=system.name,
        )
    return values
