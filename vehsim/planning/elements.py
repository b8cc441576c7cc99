"""A large sparse optimisation problem assembled element by element.

One symbolic element (a segment, a knot, a mark) is differentiated once and mapped over its occurrences; values are
gathered from and scattered to the whole problem by constant index maps. So building costs the same at any length, and
derivatives are exact and sparse. What belongs here knows nothing of vehicles.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Indices = NDArray[np.intp]


@dataclass(eq=False)
class Element:
    """A term ``f`` of the cost and constraints ``lower <= g <= upper`` of a few local variables ``y``.

    ``y`` (n,), ``p`` (m,) symbols, all SX or all MX; ``f`` scalar, ``g`` (k,) expressions; ``lower, upper`` (k,).
    """

    name: str
    y: Any
    p: Any
    f: Any = 0.0
    g: Any = None
    lower: Any = 0.0
    upper: Any = 0.0

    def __post_init__(self) -> None:
        kind = type(self.y)
        self.g = kind(0, 1) if self.g is None else ca.densify(self.g)
        self.f = kind(self.f)
        rows = self.g.shape[0]
        self.lower = np.broadcast_to(np.asarray(self.lower, float), (rows,))
        self.upper = np.broadcast_to(np.asarray(self.upper, float), (rows,))

    @cached_property
    def value(self) -> ca.Function:
        """``(y, p) -> (f, g)``"""
        return ca.Function("value", [self.y, self.p], [ca.densify(self.f), self.g])

    @cached_property
    def gradient(self) -> ca.Function:
        """``(y, p) -> (f, df/dy)``, dense."""
        return ca.Function("gradient", [self.y, self.p], [ca.densify(self.f), ca.densify(ca.gradient(self.f, self.y))])

    @cached_property
    def jacobian(self) -> ca.Function:
        """``(y, p) -> (g, entries of dg/dy)``, entries in the order of ``jacobian_pattern``."""
        return ca.Function("jacobian", [self.y, self.p], [self.g, _entries(ca.jacobian(self.g, self.y))])

    @cached_property
    def jacobian_pattern(self) -> tuple[Indices, Indices]:
        return _pattern(ca.jacobian(self.g, self.y))

    @cached_property
    def hessian(self) -> tuple[ca.Function, Indices, Indices]:
        """``(y, p, lam_f, lam_g) -> entries`` of the upper triangle of the Lagrangian's Hessian, and its pattern."""
        kind = type(self.y)
        lam_f, lam_g = kind.sym("lam_f"), kind.sym("lam_g", self.g.shape[0])
        lagrangian = lam_f * self.f + ca.dot(lam_g, self.g)
        upper = ca.triu(ca.hessian(lagrangian, self.y)[0])
        return ca.Function("hessian", [self.y, self.p, lam_f, lam_g], [_entries(upper)]), *_pattern(upper)


def _entries(matrix: Any) -> Any:
    entries = matrix.nz[:] if matrix.nnz() else type(matrix)(0, 1)
    return ca.reshape(entries, matrix.nnz(), 1)


def _pattern(matrix: Any) -> tuple[Indices, Indices]:
    rows, columns = matrix.sparsity().get_triplet()
    return np.asarray(rows, np.intp), np.asarray(columns, np.intp)


@dataclass(eq=False)
class Use:
    """Where an element occurs: ``variables`` (n, count) and ``parameters`` (m, count) index the problem's."""

    element: Element
    variables: Indices
    parameters: Indices

    @property
    def count(self) -> int:
        return int(self.variables.shape[1])

    @property
    def rows(self) -> int:
        return int(self.element.g.shape[0])

    def mapped(self, function: ca.Function) -> ca.Function:
        return function.map(self.count) if self.count > 1 else function


@dataclass(eq=False)
class Problem:
    """``size`` variables, ``parameters`` and the uses of elements; `solve` hands it to an NLP solver."""

    size: int
    parameters: int
    uses: list[Use] = field(default_factory=list)

    def add(self, element: Element, variables: Any, parameters: Any = None) -> None:
        """Add an element at index columns ``variables`` (n, count) and ``parameters`` (m, count)."""
        variables = np.asarray(variables, np.intp)
        variables = variables[:, None] if variables.ndim == 1 else variables
        width = element.p.shape[0]
        shared = np.arange(width) if parameters is None else np.asarray(parameters, np.intp)
        shared = shared[:, None] if shared.ndim == 1 else shared
        if variables.shape[0] != element.y.shape[0]:
            raise ValueError(f"element {element.name}: {variables.shape[0]} indices for {element.y.shape[0]} variables")
        self.uses.append(Use(element, variables, np.broadcast_to(shared, (width, variables.shape[1]))))

    @property
    def bounds(self) -> tuple[Array, Array]:
        """Lower and upper bounds of all constraints."""
        lower = [np.tile(use.element.lower, use.count) for use in self.uses]
        upper = [np.tile(use.element.upper, use.count) for use in self.uses]
        return np.concatenate(lower), np.concatenate(upper)

    def names(self) -> list[str]:
        """The element each constraint row comes from."""
        return [f"{use.element.name}[{k}]" for use in self.uses for k in range(use.count) for _ in range(use.rows)]

    def functions(self) -> dict[str, ca.Function]:
        """``nlp, grad_f, jac_g, hess_lag`` as an NLP solver wants them."""
        x, p = ca.MX.sym("x", self.size), ca.MX.sym("p", self.parameters)
        local = [(_gather(x, use.variables), _gather(p, use.parameters)) for use in self.uses]
        f, g = self._values(local)
        names = (["x", "p"], ["f", "g"])
        return {
            "nlp": ca.Function("nlp", [x, p], [f, g], *names),
            "grad_f": ca.Function("grad_f", [x, p], list(self._gradient(local)), ["x", "p"], ["f", "grad_f_x"]),
            "jac_g": ca.Function("jac_g", [x, p], list(self._jacobian(local)), ["x", "p"], ["g", "jac_g_x"]),
            "hess_lag": self._hessian(x, p, local),
        }

    def _values(self, local: Sequence[tuple[Any, Any]]) -> tuple[Any, Any]:
        f: Any = 0
        g = []
        for use, arguments in zip(self.uses, local, strict=True):
            cost, rows = use.mapped(use.element.value)(*arguments)
            f = f + ca.sum2(cost)
            g.append(ca.vec(rows))
        return f, ca.vertcat(*g)

    def _gradient(self, local: Sequence[tuple[Any, Any]]) -> tuple[Any, Any]:
        f: Any = 0
        values, targets = [], []
        for use, arguments in zip(self.uses, local, strict=True):
            if use.element.f.is_zero():
                continue
            cost, slope = use.mapped(use.element.gradient)(*arguments)
            f = f + ca.sum2(cost)
            values.append(ca.vec(slope))
            targets.append(use.variables.T.ravel())
        if not values:
            return ca.MX(0), ca.MX.zeros(self.size, 1)
        # IPOPT's interface reads the gradient as a dense array, whatever its sparsity says
        return f, ca.densify(
            _scatter(np.concatenate(targets), np.zeros(sum(map(len, targets)), np.intp), values, (self.size, 1))
        )

    def _jacobian(self, local: Sequence[tuple[Any, Any]]) -> tuple[Any, Any]:
        g, values, rows, columns, first = [], [], [], [], 0
        for use, arguments in zip(self.uses, local, strict=True):
            residual, entries = use.mapped(use.element.jacobian)(*arguments)
            i, j = use.element.jacobian_pattern
            g.append(ca.vec(residual))
            values.append(ca.vec(entries))
            starts = first + use.rows * np.arange(use.count)
            rows.append((starts[:, None] + i).ravel())
            columns.append(use.variables[j].T.ravel())
            first += use.rows * use.count
        shape = (first, self.size)
        return ca.vertcat(*g), _scatter(np.concatenate(rows), np.concatenate(columns), values, shape)

    def _hessian(self, x: Any, p: Any, local: Sequence[tuple[Any, Any]]) -> ca.Function:
        lam_f, lam_g = ca.MX.sym("lam_f"), ca.MX.sym("lam_g", len(self.bounds[0]))
        values, rows, columns, first = [], [], [], 0
        for use, arguments in zip(self.uses, local, strict=True):
            function, i, j = use.element.hessian
            multipliers = ca.reshape(lam_g[first : first + use.rows * use.count], use.rows, use.count)
            first += use.rows * use.count
            if not len(i):
                continue
            entries = use.mapped(function)(*arguments, ca.repmat(lam_f, 1, use.count), multipliers)
            values.append(ca.vec(entries))
            a, b = use.variables[i].T.ravel(), use.variables[j].T.ravel()
            rows.append(np.minimum(a, b))
            columns.append(np.maximum(a, b))
        upper = _scatter(np.concatenate(rows), np.concatenate(columns), values, (self.size, self.size))
        return ca.Function(
            "hess_lag", [x, p, lam_f, lam_g], [upper], ["x", "p", "lam_f", "lam_g"], ["triu_hess_gamma_x_x"]
        )


def _gather(x: Any, indices: Indices) -> Any:
    if indices.size == 0:
        return ca.MX(*indices.shape)
    return ca.reshape(x[indices.T.ravel().tolist()], *indices.shape)


def _scatter(rows: Indices, columns: Indices, values: list[Any], shape: tuple[int, int]) -> Any:
    """Sparse matrix of entries that may share a place, in which case they add up."""
    keys = columns * shape[0] + rows  # column major, as CasADi stores it
    places, target = np.unique(keys, return_inverse=True)
    sparsity = ca.Sparsity.triplet(*shape, (places % shape[0]).tolist(), (places // shape[0]).tolist())
    entries = ca.vertcat(*values)
    if len(places) == len(keys):
        order = np.argsort(target)
        return ca.MX(sparsity, entries[order.tolist()])
    pattern = ca.Sparsity.triplet(len(places), len(keys), target.tolist(), list(range(len(keys))))
    return ca.MX(sparsity, ca.mtimes(ca.DM(pattern, 1.0), entries))
