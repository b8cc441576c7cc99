"""Transfer multipliers from a solved problem to a similar one: at other marks, finer, or of another order.

Without multipliers, a solver that starts from a solved motion has to find again which constraints are active and how
strongly. Multipliers of the mechanics are costates: functions of time, independent of the discretisation. Multipliers
of inequalities are impulses distributed over the instants, so with more instants each of them has a smaller share.
"""

from __future__ import annotations

from collections import defaultdict

import numpy as np
from numpy.typing import NDArray

from vehsim.planning.problem.elements import NonlinearProgram
from vehsim.planning.problem.layout import Layout
from vehsim.planning.problem.solver import Multipliers

Array = NDArray[np.float64]


def transferred(
    multipliers: Multipliers, old: tuple[NonlinearProgram, Layout], new: tuple[NonlinearProgram, Layout]
) -> Multipliers:
    """The multipliers of ``old`` as an initial guess for ``new``; zero for rows that ``old`` does not have."""
    (problem, coarse), (other, fine) = old, new
    if problem is other:
        return multipliers
    share = coarse.segments / fine.segments
    known, first = defaultdict(list), 0
    for use in problem.uses:
        rows = multipliers.g[first : first + use.rows * use.count].reshape(use.count, use.rows)
        first += rows.size
        rows = np.hstack([np.zeros((use.count, use.element.lacks)), rows])
        known[use.element.name, rows.shape[1]].append((coarse.instants(use.variables[0]), rows))
    g = [np.zeros(0)]
    for use in other.uses:
        found = known[use.element.name, use.rows + use.element.lacks]
        rows = np.zeros((use.count, use.rows))
        if found and use.count:
            rows = _at(fine.instants(use.variables[0]), *found.pop(0))
            if use.element.name == "dynamics" and coarse.order != fine.order:
                rows = _of_order(rows, fine.order, fine.sizes[2])
            rows = rows[:, use.element.lacks :]
            if use.count > 1:
                rows[:, use.element.lower < use.element.upper] *= share
        g.append(rows.ravel())
    x = np.zeros(fine.size)
    for here, there in _both(coarse, fine):
        if len(here):
            x[there] = share * _at(fine.instants(there[0]), coarse.instants(here[0]), multipliers.x[here].T).T
    x[fine.lengths] = multipliers.x[coarse.lengths]
    return Multipliers(x, np.concatenate(g), multipliers.cost)


def _of_order(rows: Array, order: int, n: int) -> Array:
    """Multipliers (segments, k) of the other order's equations as those of this ``order``.

    The first two blocks of ``n`` belong to the momentum. Those of order 2, one for either end, correspond to the
    middle's plus and minus half of the end's at order 4.
    """
    first, second, rest = np.split(rows, [n, 2 * n], axis=1)
    if order == 4:
        return np.hstack([first + second, (first - second) / 2, rest])
    return np.hstack([first / 2 + second, first / 2 - second, rest])


def _both(coarse: Layout, fine: Layout) -> list[tuple[NDArray[np.intp], NDArray[np.intp]]]:
    """Indices of corresponding bounded variables in both layouts: those of states and of controls."""
    return [
        (coarse.knot(np.arange(coarse.knots)), fine.knot(np.arange(fine.knots))),
        (coarse.control(np.arange(coarse.knots)), fine.control(np.arange(fine.knots))),
    ]


def _at(new: Array, old: Array, rows: Array) -> Array:
    """Rows (n, k) at instants ``old`` (n,), interpolated linearly at instants ``new``."""
    order = np.argsort(old, kind="stable")
    out = np.empty((len(new), rows.shape[1]))
    for k, column in enumerate(rows[order].T):
        out[:, k] = np.interp(new, old[order], column)
    return out
