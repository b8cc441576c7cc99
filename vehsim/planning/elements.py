"""A large sparse optimisation problem assembled element by element.

One symbolic element (a segment, a knot, a mark) is differentiated once and mapped over its occurrences; values are
gathered from and scattered to the whole problem by constant index maps. So building costs the same at any length, and
derivatives are exact and sparse. What belongs here knows nothing of vehicles.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Indices = NDArray[np.intp]


@dataclass(frozen=True, eq=False)
class Seen:
    """A function of space that an element meets at ``points`` (3, k), expressions of ``y`` and ``p``.

    ``function``: (count, order) -> a `Function`, points (3, count) -> value, gradient and Hessian (xx, yy, zz, xy, xz,
    yz) there (10, count), derivatives up to ``order``. The element itself is written in ``models`` (13, k), symbols:
    the point and these ten numbers, through `second_order`. So nothing differentiates the function, which may be a
    spline too large for that.
    """

    points: Any
    models: Any
    function: Callable[[int, int], ca.Function]


def second_order(points: Any, models: Any) -> Any:
    """Values (k,) at ``points`` (3, k) by ``models`` (13, k) about them: exact there, with both derivatives."""
    values = []
    for k in range(points.shape[1]):
        place, value, slope, bend = ca.vertsplit(models[:, k], [0, 3, 4, 7, 13])
        x, y, z = ca.vertsplit(points[:, k] - place)
        mixed = ca.vertcat(x * x / 2, y * y / 2, z * z / 2, x * y, x * z, y * z)
        values.append(value + ca.dot(slope, ca.vertcat(x, y, z)) + ca.dot(bend, mixed))
    return ca.vertcat(*values)


@dataclass(eq=False)
class Element:
    """A term ``f`` of the cost and constraints ``lower <= g <= upper`` of a few local variables ``y``.

    ``y`` (n,), ``p`` (m,) symbols, all SX or all MX; ``f`` scalar, ``g`` (k,) expressions; ``lower, upper`` (k,).
    ``seen``: a function of space that ``f`` and ``g`` meet; its models are parameters behind those given.
    """

    name: str
    y: Any
    p: Any
    f: Any = 0.0
    g: Any = None
    lower: Any = 0.0
    upper: Any = 0.0
    seen: Seen | None = None
    labels: Sequence[str] = ()
    """Names of the rows of ``g``, where they differ from the element's."""
    held: tuple[Any, Any] | None = None
    """Symbols in ``f`` and ``g``, and the expressions of ``y`` and ``p`` they stand for: derivatives take them as
    constants."""

    def __post_init__(self) -> None:
        kind = type(self.y)
        self.given = int(self.p.shape[0])
        if self.seen is not None:
            self.p = ca.vertcat(self.p, ca.vec(self.seen.models))
        self.g = kind(0, 1) if self.g is None else ca.densify(self.g)
        self.f = kind(self.f)
        if kind is ca.SX:  # what is said once is differentiated once: a fifth to a third off the derivatives
            self.f, self.g = ca.cse([self.f, self.g])
        rows = self.g.shape[0]
        self.lower = np.broadcast_to(np.asarray(self.lower, float), (rows,))
        self.upper = np.broadcast_to(np.asarray(self.upper, float), (rows,))

    @cached_property
    def points(self) -> ca.Function:
        """``(y, p) -> (3, k)``: where the function of space is met; ``p`` without its models."""
        assert self.seen is not None
        return ca.Function("points", [self.y, self.p[: self.given]], [self.seen.points])

    @cached_property
    def value(self) -> ca.Function:
        """``(y, p) -> (f, g)``"""
        return self._function("value", [ca.densify(self.f), self.g])

    @cached_property
    def gradient(self) -> ca.Function:
        """``(y, p) -> (f, df/dy)``, dense."""
        return self._function("gradient", [ca.densify(self.f), ca.densify(ca.gradient(self.f, self.y))])

    @cached_property
    def jacobian(self) -> ca.Function:
        """``(y, p) -> (g, entries of dg/dy)``, entries in the order of ``jacobian_pattern``."""
        return self._function("jacobian", [self.g, _entries(ca.jacobian(self.g, self.y))])

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
        return self._function("hessian", [_entries(upper)], lam_f, lam_g), *_pattern(upper)

    def _function(self, name: str, results: list[Any], *more: Any) -> ca.Function:
        """Of ``y, p`` and ``more``, with what is held put in."""
        if self.held is not None:
            results = [ca.densify(r) for r in ca.cse(ca.substitute(results, [self.held[0]], [self.held[1]]))]
        return ca.Function(name, [self.y, self.p, *more], results)


def elastic(element: Element, price: float) -> Element:
    """The element with room to miss its rows either way, at a price: 2 k more variables, which are not negative."""
    k = element.g.shape[0]
    over, under = ca.SX.sym("over", k), ca.SX.sym("under", k)
    cost = element.f + price * (ca.sum1(over) + ca.sum1(under))
    y, g = ca.vertcat(element.y, over, under), element.g - over + under
    return Element(element.name, y, element.p, cost, g, element.lower, element.upper, labels=element.labels)


def _mapped(function: ca.Function, count: int) -> ca.Function:
    return function.map(count) if count > 1 else function


def _entries(matrix: Any) -> Any:
    entries = matrix.nz[:] if matrix.nnz() else type(matrix)(0, 1)
    return ca.reshape(entries, matrix.nnz(), 1)


def _pattern(matrix: Any) -> tuple[Indices, Indices]:
    rows, columns = matrix.sparsity().get_triplet()
    return np.asarray(rows, np.intp), np.asarray(columns, np.intp)


@dataclass(eq=False)
class Use:
    """Where an element occurs: ``variables`` (n, count) and ``parameters`` (m, count) index the problem's; ``names``
    (count,) of the occurrences, where they have any."""

    element: Element
    variables: Indices
    parameters: Indices
    constants: Array
    names: Sequence[str] = ()

    @property
    def count(self) -> int:
        return int(self.variables.shape[1])

    @property
    def rows(self) -> int:
        return int(self.element.g.shape[0])

    def mapped(self, function: ca.Function) -> ca.Function:
        return _mapped(function, self.count)

    def local(self, x: Any, p: Any, order: int) -> tuple[Any, Any]:
        """Local variables (n, count) and parameters (m, count) out of the problem's; models good to ``order``."""
        y, given = _gather(x, self.variables), _gather(p, self.parameters)
        rows = [given, ca.MX(ca.DM(self.constants))] if len(self.constants) else [given]
        seen = self.element.seen
        if seen is not None:
            points, k = self.mapped(self.element.points)(y, ca.vertcat(*rows)), seen.points.shape[1]
            places = ca.reshape(points, 3, k * self.count)
            models = ca.vertcat(places, seen.function(k * self.count, order)(places))
            rows.append(ca.reshape(models, 13 * k, self.count))
        return y, ca.vertcat(*rows)


@dataclass(eq=False)
class Problem:
    """``size`` variables, ``parameters`` and the uses of elements; `solve` hands it to an NLP solver."""

    size: int
    parameters: int
    uses: list[Use] = field(default_factory=list)

    def add(
        self,
        element: Element,
        variables: Any,
        parameters: Any = None,
        constants: Any = None,
        names: Sequence[str] = (),
    ) -> None:
        """Add an element at index columns ``variables`` (n, count) and ``parameters`` (m, count).

        ``constants`` (c, count): its last ``c`` parameters, where they are numbers.
        """
        variables = np.asarray(variables, np.intp)
        variables = variables[:, None] if variables.ndim == 1 else variables
        fixed = np.zeros((0, variables.shape[1])) if constants is None else np.atleast_2d(constants)
        width = element.given - len(fixed)
        shared = np.arange(width) if parameters is None else np.asarray(parameters, np.intp)
        shared = shared[:, None] if shared.ndim == 1 else shared
        if variables.shape[0] != element.y.shape[0]:
            raise ValueError(f"element {element.name}: {variables.shape[0]} indices for {element.y.shape[0]} variables")
        places = np.broadcast_to(shared, (width, variables.shape[1]))
        self.uses.append(Use(element, variables, places, fixed, names))

    @property
    def bounds(self) -> tuple[Array, Array]:
        """Lower and upper bounds of all constraints."""
        lower = [np.tile(use.element.lower, use.count) for use in self.uses]
        upper = [np.tile(use.element.upper, use.count) for use in self.uses]
        return np.concatenate(lower), np.concatenate(upper)

    def names(self) -> list[str]:
        """The element each constraint row comes from."""
        return [
            use.element.labels[row] if use.element.labels else use.names[k] if use.names else f"{use.element.name}[{k}]"
            for use in self.uses
            for k in range(use.count)
            for row in range(use.rows)
        ]

    def functions(self) -> dict[str, ca.Function]:
        """``nlp, grad_f, jac_g, hess_lag`` as an NLP solver wants them."""
        x, p = ca.MX.sym("x", self.size), ca.MX.sym("p", self.parameters)
        local = [[use.local(x, p, order) for use in self.uses] for order in range(3)]
        f, g = self._values(local[0])
        names = (["x", "p"], ["f", "g"])
        return {
            "nlp": ca.Function("nlp", [x, p], [f, g], *names),
            "grad_f": ca.Function("grad_f", [x, p], list(self._gradient(local[1])), ["x", "p"], ["f", "grad_f_x"]),
            "jac_g": ca.Function("jac_g", [x, p], list(self._jacobian(local[1])), ["x", "p"], ["g", "jac_g_x"]),
            "hess_lag": self._hessian(x, p, local[2]),
        }

    def _values(self, local: Sequence[tuple[Any, Any]]) -> tuple[Any, Any]:
        f: Any = 0
        g = []
        for use, arguments in zip(self.uses, local, strict=True):
            cost, rows = use.mapped(use.element.value)(*arguments)
            f = f if use.element.f.is_zero() else f + ca.sum2(cost)
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
