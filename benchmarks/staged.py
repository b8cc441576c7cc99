"""A problem of `vehsim.plan` in fatrop's structure by stages, for comparison with IPOPT. No plan uses it.

fatrop wants ``x[k + 1] = F(x[k], u[k])``, but our equations of motion are implicit. So stage k has the state and the
controls of knot k as its states; its own controls are the segment's velocity, if the problem has it, and *copies* of
the next knot's state and controls. The next stage's states equal the copies, and the equations of motion are
constraints within the stage. The durations of segments are constants here: marks are at given frames.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from vehsim.planning.problem.elements import NonlinearProgram, Use
from vehsim.planning.problem.layout import Layout

Array = NDArray[np.float64]
Indices = NDArray[np.intp]


@dataclass(frozen=True, eq=False)
class Staged:
    """``problem`` on a ``layout`` by stages; ``x`` (size,): its variables, of which only the durations matter."""

    problem: NonlinearProgram
    layout: Layout
    x: Array

    @cached_property
    def sources(self) -> Indices:
        """The problem's variable (size,) of every variable by stages."""
        layout, every = self.layout, np.arange(self.layout.segments)
        knots = np.vstack([layout.knot(np.arange(layout.knots)), layout.control(np.arange(layout.knots))])
        stages = np.vstack([knots[:, :-1], layout.velocity(every)[: self.velocities], knots[:, 1:]])
        return np.append(stages.T.ravel(), knots[:, -1]).astype(np.intp)

    @property
    def sizes(self) -> tuple[int, int]:
        """Numbers of states and controls of a stage."""
        states = self.layout.state + self.layout.sizes[3]
        return states, self.velocities + states

    @property
    def velocities(self) -> int:
        """Number of variables of a segment's velocity, zero if the problem lacks it."""
        return 0 if self.problem.lacked.size else self.layout.sizes[2]

    @cached_property
    def first(self) -> NDArray[np.bool_]:
        """Which variables are not copies."""
        states, controls = self.sizes
        copy = np.arange(len(self.sources)) % (states + controls) >= controls
        copy[-states:] = False
        return ~copy

    def _place(self, use: Use) -> tuple[Indices, Indices]:
        """Stages (count,) of the occurrences of an element, and their variables by stages (n, count).

        Durations are appended to the variables.
        """
        width, knots = sum(self.sizes), self.layout.knots
        stages, columns = [], []
        for column in use.variables.T:
            for k in range(knots):
                begin = k * width
                own = {int(q): begin + i for i, q in reversed([*enumerate(self.sources[begin : begin + width])])}
                own |= {int(q): len(self.sources) + i for i, q in enumerate(self.layout.lengths)}
                if all(int(q) in own for q in column):
                    break
            else:
                raise ValueError(f"element {use.element.name}: it spans more than one segment")
            stages.append(k)
            columns.append([own[int(q)] for q in column])
        return np.array(stages), np.array(columns).T

    @cached_property
    def places(self) -> list[tuple[Indices, Indices]]:
        return [self._place(use) for use in self.problem.uses]

    @cached_property
    def rows(self) -> tuple[list[Indices], Indices, list[int]]:
        """Rows (count, k) of every use, those of the equations between stages, and numbers of the others by stage."""
        states, last = self.sizes[0], self.layout.segments
        own: list[list[Any]] = [[None] * use.count for use in self.problem.uses]
        between, counts, row = [], [], 0
        for k in range(last + 1):
            if k < last:
                between.append(np.arange(row, row + states))
                row += states
            begin = row
            for rows, use, (stages, _) in zip(own, self.problem.uses, self.places, strict=True):
                for j in np.flatnonzero(stages == k):
                    rows[j] = np.arange(row, row + use.rows)
                    row += use.rows
            counts.append(row - begin)
        return [np.array(rows, np.intp) for rows in own], np.concatenate(between), counts

    def solver(self, tolerance: float = 1e-8) -> ca.Function:
        """fatrop on this problem, with our elements' derivatives."""
        states, controls = self.sizes
        last, (own, between, counts) = self.layout.segments, self.rows
        size, total = len(self.sources), len(between) + sum(counts)
        x, p = ca.MX.sym("x", size), ca.MX.sym("p", self.problem.parameters)
        lam_f, lam = ca.MX.sym("lam_f"), ca.MX.sym("lam", total)
        whole = ca.vertcat(x, ca.DM(self.x[self.layout.lengths]))
        width = states + controls
        ahead = np.concatenate([(k + 1) * width + np.arange(states) for k in range(last)])
        copies = ahead - states
        f, slopes = ca.MX(0), _Sum((size, 1))
        g, jacobian = _Sum((total, 1)), _Sum((total, size))
        lagrangian, hessian = _Sum((size, 1)), _Sum((size, size))
        g.add(between, 0 * between, _at(x, ahead) - _at(x, copies))
        for variables, sign in ((ahead, 1.0), (copies, -1.0)):
            jacobian.add(between, variables, ca.MX(ca.DM([sign] * len(between))))
            lagrangian.add(variables, 0 * variables, sign * _at(lam, between))
        for use, (_, variables), rows in zip(self.problem.uses, self.places, own, strict=True):
            element, (n, count) = use.element, variables.shape
            y = ca.reshape(_at(whole, variables.T.ravel()), n, count)
            given = ca.reshape(_at(p, use.parameters.T.ravel()), *use.parameters.shape)
            given = ca.vertcat(given, ca.DM(use.constants)) if len(use.constants) else given
            arguments = (y, use.with_models(y, given, 2, differentiable=True))
            cost, values = use.mapped(element.value, differentiable=True)(*arguments)
            if not element.f.is_zero():
                f += ca.sum2(cost)
                _, slope = use.mapped(element.gradient)(*arguments)
                slopes.add(variables.T.ravel(), np.zeros(n * count, np.intp), ca.vec(slope))
            if use.rows:
                g.add(rows.ravel(), np.zeros(rows.size, np.intp), ca.vec(values))
                i, j = element.jacobian_pattern
                _, entries = use.mapped(element.jacobian)(*arguments)
                jacobian.add(rows[:, i].ravel(), variables[j].T.ravel(), ca.vec(entries))
            multipliers = ca.reshape(_at(lam, rows.ravel()), use.rows, count)
            function, i, j = _curvature(use)
            slope, entries = use.mapped(function)(*arguments, ca.repmat(lam_f, 1, count), multipliers)
            lagrangian.add(variables.T.ravel(), np.zeros(n * count, np.intp), ca.vec(slope))
            hessian.add(variables[i].T.ravel(), variables[j].T.ravel(), ca.vec(entries))
        values = ca.densify(g.made())
        nlp = ca.Function("nlp", [x, p], [f, values], ["x", "p"], ["f", "g"])
        own_functions = [
            ca.Function("nlp_grad_f", [x, p], [ca.densify(slopes.made())], ["x", "p"], ["grad_f_x"]),
            ca.Function("nlp_jac_g", [x, p], [values, jacobian.made()], ["x", "p"], ["g", "jac_g_x"]),
            ca.Function(
                "nlp_hess_l", [x, p, lam_f, lam], [ca.densify(lagrangian.made()), hessian.made()],
                ["x", "p", "lam_f", "lam_g"], ["grad_gamma_x", "hess_gamma_x_x"],
            ),
        ]  # fmt: skip
        options: dict[str, Any] = {
            "structure_detection": "manual",
            "N": last,
            "nx": [states] * (last + 1),
            "nu": [controls] * last + [0],
            "ng": counts,
            "cache": {function.name(): function for function in own_functions},  # instead of CasADi's derivatives
            "fatrop": {"print_level": 0, "tol": tolerance},
            "print_time": False,
            "error_on_fail": False,
            "calc_lam_p": False,
        }
        return ca.nlpsol("staged", "fatrop", nlp, options)

    def given(self, x: Array, lower: Array, upper: Array, parameters: Array) -> dict[str, Array]:
        """fatrop's arguments, from those of the problem; copies have no bounds."""
        own, between, counts = self.rows
        least, most = np.zeros(len(between) + sum(counts)), np.zeros(len(between) + sum(counts))
        for use, rows in zip(self.problem.uses, own, strict=True):
            least[rows], most[rows] = use.element.lower, use.element.upper
        low, high = (np.where(self.first, a[self.sources], inf) for a, inf in ((lower, -np.inf), (upper, np.inf)))
        return {"x0": x[self.sources], "lbx": low, "ubx": high, "lbg": least, "ubg": most, "p": parameters}

    def back(self, x: Array) -> Array:
        """The problem's variables from those by stages."""
        out = self.x.copy()
        out[self.sources[self.first]] = x[self.first]
        return out


class _Sum:
    """A sparse matrix as a sum of entries; those beyond its columns or rows, of the durations, are left out."""

    def __init__(self, shape: tuple[int, int]):
        self.shape, self.entries = shape, list[tuple[Indices, Indices, Any]]()

    def add(self, rows: Indices, columns: Indices, values: Any) -> None:
        kept = np.flatnonzero((rows < self.shape[0]) & (columns < self.shape[1]))
        self.entries.append((rows[kept], columns[kept], _at(values, kept)))

    def made(self) -> Any:
        rows, columns = (np.concatenate([entry[k] for entry in self.entries]) for k in (0, 1))
        keys = columns * self.shape[0] + rows
        places, target = np.unique(keys, return_inverse=True)
        pattern = ca.Sparsity.triplet(len(places), len(keys), target.tolist(), list(range(len(keys))))
        sparsity = ca.Sparsity.triplet(
            *self.shape, (places % self.shape[0]).tolist(), (places // self.shape[0]).tolist()
        )
        return ca.MX(sparsity, ca.mtimes(ca.DM(pattern, 1.0), ca.vertcat(*(entry[2] for entry in self.entries))))


def _at(values: Any, places: Sequence[int] | Indices) -> Any:
    return values[[int(place) for place in places]]


def _curvature(use: Use) -> tuple[ca.Function, Indices, Indices]:
    """``(y, p, lam_f, lam_g) -> (gradient, entries)`` of an element's Lagrangian and its Hessian, and their pattern."""
    element = use.element
    lam_f, lam_g = ca.SX.sym("lam_f"), ca.SX.sym("lam_g", use.rows)
    hessian, gradient = element.curvature(lam_f * element.f + ca.dot(lam_g, element.g))
    entries = hessian.nz[:] if hessian.nnz() else ca.SX(0, 1)
    results = ca.cse([ca.densify(gradient), ca.reshape(entries, hessian.nnz(), 1)])
    i, j = (np.asarray(part, np.intp) for part in hessian.sparsity().get_triplet())
    return element.function("curvature", results, lam_f, lam_g), i, j
