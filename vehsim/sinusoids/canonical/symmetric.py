"""Symmetric products: which velocities a vehicle with drift can reach from rest (SYM's argument for its helicopter).

From a state at rest whose controls balance all other forces, the vectors ``Y_a`` (accelerations per control) and their
symmetric products ``<Y_a : Y_b> = [Y_b, [f, Y_a]]`` span the reachable velocities. A product in which every Y occurs an
even number of times, such as ``<Y_a : Y_a>``, is bad: it pushes in one direction only. It must lie in the span of lower
products for the system to be locally controllable and not only accessible.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations_with_replacement
from typing import Any

import casadi as ca
import numpy as np

from vehsim.errors import InputError
from vehsim.sinusoids.algebra.brackets import Rank, lie_bracket, rank_of
from vehsim.sinusoids.algebra.classification import classify
from vehsim.sinusoids.system import Array, DriftlessSystem, Expr
from vehsim.vehicles import State, Vehicle


@dataclass(frozen=True)
class SymmetricClosure:
    """``dimension``: of the velocities; ``ranks``: span of the ``Y_a``, then with products of two, of three, ...

    ``unreached``: number of directions of the pose that no bracket of the velocities reaches (Chow), for example of a
    vehicle on rails. ``accessible``: the products span all velocities, and those all poses. ``bad``: labels of the bad
    products that prevent controllability, unless ``linear``: the linearised motion is controllable (Kalman), for
    example through the weight. ``controllable``: from rest the vehicle reaches all poses and velocities nearby, as long
    as no control is at a bound.
    """

    dimension: int
    ranks: tuple[Rank, ...]
    labels: tuple[str, ...]
    bad: tuple[str, ...]
    linear: bool
    unreached: int = 0

    @property
    def accessible(self) -> bool:
        return self.ranks[-1].value == self.dimension and not self.unreached

    @property
    def controllable(self) -> bool:
        return self.linear or (self.accessible and not self.bad)

    @property
    def certain(self) -> bool:
        return all(rank.certain for rank in self.ranks)


def symmetric_closure(
    vehicle: Vehicle, at: State | None = None, controls: Sequence[float] | None = None, order: int = 3
) -> SymmetricClosure:
    """Symmetric products of ``vehicle`` at the state ``at`` (default: at the origin), at rest and in balance.

    ``controls`` that balance it; default: the trim. Products of up to ``order`` vectors. The Y are the accelerations by
    small changes of the controls, so controls need not enter linearly. Raises ``InputError`` if the controls do not
    balance the vehicle, or if all of them are rates.
    """
    from vehsim.integrators.continuous import equations_of_motion
    from vehsim.planning.trim import trim, upright
    from vehsim.vehicles.definition.states import internal

    if not vehicle.controls:
        raise InputError("no controls: nothing can be reached from rest", "give it one", subject=vehicle.name)
    if set(vehicle.control_names) == set(vehicle.rate_controls):
        raise InputError(
            f"{', '.join(vehicle.control_names)} set rates and push nothing: no force for a symmetric product",
            "use the brackets of its driftless system, algebra.classify(rigged(vehicle).system)",
            subject=vehicle.name,
        )
    at = State(orientation=upright(vehicle, [0.0])[0]) if at is None else at
    law = equations_of_motion(vehicle)
    g0, r0, _, _ = internal(vehicle, at)
    c0 = np.asarray(trim(vehicle, (0.0, 0.0, 0.0)) if controls is None else controls, float)
    sizes = [law.size1_in(i) for i in range(3)]
    symbols = [ca.SX.sym(name, size) for name, size in zip("grz", sizes, strict=True)]
    x, c = ca.vertcat(*symbols), ca.SX.sym("c", len(c0))
    motion = ca.vertcat(*law(*symbols, c, 0, 0))
    drift, inputs = ca.substitute(motion, c, ca.DM(c0)), ca.substitute(ca.jacobian(motion, c), c, ca.DM(c0))
    start, rows = np.concatenate([g0, r0, np.zeros(sizes[2])]), slice(sum(sizes[:2]), None)
    unbalanced = _value(drift, x, start)
    if np.abs(unbalanced).max() > 1e-6:
        raise InputError(
            f"these controls do not balance it at rest: it accelerates by {np.round(unbalanced[rows], 3).tolist()}",
            _remedy(vehicle, controls),
            key="controls",
            value=np.round(c0, 4).tolist(),
            subject=vehicle.name,
        )
    found: list[tuple[tuple[str, ...], str, Expr]] = [
        ((n,), n, inputs[:, i]) for i, n in enumerate(vehicle.control_names)
    ]
    values = [_value(field, x, start)[rows] for _, _, field in found]
    ranks, labels, bad = [rank_of(np.array(values).T)], [label for _, label, _ in found], []
    for count in range(2, order + 1):
        if ranks[-1].value == sizes[2]:
            break
        lower, new = np.array(values).T, []
        for (a, la, fa), (b, lb, fb) in combinations_with_replacement(found, 2):
            if len(a) + len(b) == count:
                product = lie_bracket(fb, lie_bracket(drift, fa, x), x)
                new.append((tuple(sorted((*a, *b))), f"<{la} : {lb}>", product))
        for names, label, field in new:
            values.append(_value(field, x, start)[rows])
            even = all(names.count(name) % 2 == 0 for name in names)
            if even and rank_of(np.column_stack([lower, values[-1]])).value > rank_of(lower).value:
                bad.append(label)
        found += new
        labels += [label for _, label, _ in new]
        ranks.append(rank_of(np.array(values).T))
    linear = _kalman(*vehicle.linearize(at, c0))
    allowed = ca.jacobian(ca.vertcat(*law(*symbols, c, 0, 0)[:2]), ca.vertcat(symbols[2], c))
    unreached = _unreached(vehicle, ca.vertcat(*symbols[:2]), allowed, start[: sum(sizes[:2])])
    return SymmetricClosure(sizes[2], tuple(ranks), tuple(labels), tuple(bad), linear, unreached)


def _unreached(vehicle: Vehicle, x: Expr, fields: Expr, at: Array) -> int:
    """The number of directions of the pose that no bracket of the permitted velocities ``fields`` (n, m) reaches."""
    states, inputs = (tuple(f"{kind}{i}" for i in range(size)) for kind, size in zip("xu", fields.shape, strict=True))
    system = DriftlessSystem(vehicle.name, states, inputs, lambda q: ca.substitute(fields, x, q))
    pose = classify(system, at.tolist()).span_at[: len(vehicle.group.identity)]
    return vehicle.group.dim - rank_of(pose).value


def _remedy(vehicle: Vehicle, controls: Sequence[float] | None) -> str:
    if vehicle.hull is not None and vehicle.planar is not None:
        return "its equations do not include the water that carries it: use `vehicle.planar`, which glides on it"
    return "give controls that do" if controls is not None else "none within their bounds do: it cannot rest here"


def _kalman(a: Array, b: Array) -> bool:
    """Whether B, AB, .. span everything: the reachable subspace grown by orthonormal steps."""
    q = np.zeros((len(a), 0))
    new = b / max(1.0, np.abs(b).max())
    while new.size:
        u, values, _ = np.linalg.svd(new - q @ (q.T @ new), full_matrices=False)
        fresh = u[:, values > 1e-9]
        fresh -= q @ (q.T @ fresh)
        q, new = np.hstack([q, fresh]), a @ fresh / max(1.0, np.abs(a).max())
    return q.shape[1] == len(a)


def _value(field: Any, x: Expr, at: Array) -> Array:
    return np.asarray(ca.Function("f", [x], [ca.densify(field)])(at)).ravel()
