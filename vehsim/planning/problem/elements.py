"""A large sparse optimisation problem assembled element by element.

One symbolic element (a segment, a knot, a mark) is differentiated once and mapped over its occurrences; values are
gathered from and scattered to the whole problem by constant index maps. So building costs the same at any length, and
derivatives are exact and sparse. What belongs here knows nothing of vehicles.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Indices = NDArray[np.intp]


@dataclass(frozen=True, eq=False)
class SpatialField:
    """A function of space that an element evaluates at ``points`` (3, k), expressions of its variables and parameters.

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

    ``y`` (n,) symbols, SX; ``f`` scalar, ``g`` (k,) expressions; ``lower, upper`` (k,). ``parameters``: symbols (m,) by
    name; where the problem keeps their values is up to the problem, see `NonlinearProgram.add`.
    """

    name: str
    y: Any
    parameters: Mapping[str, Any] = field(default_factory=dict)
    f: Any = 0.0
    g: Any = None
    lower: Any = 0.0
    upper: Any = 0.0
    space: SpatialField | None = None
    """A function of space that ``f`` and ``g`` use."""
    labels: Sequence[str] = ()
    """Names of the rows of ``g``, where they differ from the element's."""
    frozen: tuple[Any, Any] | None = None
    """Symbols in ``f`` and ``g``, and the expressions of ``y`` and the parameters that they stand for: derivatives take
    these as constants (a stop-gradient)."""

    def __post_init__(self) -> None:
        kind = type(self.y)
        self.sizes = {name: int(symbol.shape[0]) for name, symbol in self.parameters.items()}
        given = ca.vertcat(kind(0, 1), *self.parameters.values())
        self.given = int(given.shape[0])
        self.p = given if self.space is None else ca.vertcat(given, ca.vec(self.space.models))
        self.g = kind(0, 1) if self.g is None else ca.densify(self.g)
        self.f = kind(self.f)
        if kind is ca.SX:  # shared subexpressions are differentiated once: a fifth to a third off the derivatives
            self.f, self.g = ca.cse([self.f, self.g])
        rows = self.g.shape[0]
        self.lower = np.broadcast_to(np.asarray(self.lower, float), (rows,))
        self.upper = np.broadcast_to(np.asarray(self.upper, float), (rows,))

    @cached_property
    def points(self) -> ca.Function:
        """``(y, p) -> (3, k)``: where the function of space is evaluated; ``p`` without its models."""
        assert self.space is not None
        return ca.Function("points", [self.y, self.p[: self.given]], [self.space.points])

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
        """Of ``y, p`` and ``more``, with the frozen expressions put in after differentiation."""
        if self.frozen is not None:
            results = [ca.densify(r) for r in ca.cse(ca.substitute(results, [self.frozen[0]], [self.frozen[1]]))]
        return ca.Function(name, [self.y, self.p, *more], results)


def elastic(element: Element, price: float) -> Element:
    """The element in elastic mode: 2 k more variables, none negative, miss its rows either way at a price."""
    k = element.g.shape[0]
    over, under = ca.SX.sym("over", k), ca.SX.sym("under", k)
    return replace(
        element,
        y=ca.vertcat(element.y, over, under),
        f=element.f + price * (ca.sum1(over) + ca.sum1(under)),
        g=element.g - over + under,
    )


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
    """Where an element occurs.

    ``variables`` (n, count) and ``parameters`` (m, count) index the problem's, ``constants`` (c, count) are its last
    parameters; ``names`` (count,) of the occurrences, where they have any.
    """

    element: Element
    variables: Indices
    parameters: Indices
    constants: Array
    names: Sequence[str] = ()
    owner: int = -1
    """The number of what added it."""

    def name(self, occurrence: int, row: int) -> str:
        """What messages call a row."""
        if self.element.labels:
            return self.element.labels[row]
        return self.names[occurrence] if self.names else f"{self.element.name}[{occurrence}]"

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
        space = self.element.space
        if space is not None:
            points, k = self.mapped(self.element.points)(y, ca.vertcat(*rows)), space.points.shape[1]
            places = ca.reshape(points, 3, k * self.count)
            models = ca.vertcat(places, space.function(k * self.count, order)(places))
            rows.append(ca.reshape(models, 13 * k, self.count))
        return y, ca.vertcat(*rows)


@dataclass(eq=False)
class NonlinearProgram:
    """``size`` variables, parameters by name, and the uses of elements; `solver.Solver` hands it to an NLP solver."""

    size: int
    uses: list[Use] = field(default_factory=list)
    places: dict[str, Indices] = field(default_factory=dict)
    """Where every parameter stands: (size,), or (size, count) where it has a column for each occurrence."""

    @property
    def parameters(self) -> int:
        """The length of the parameter vector."""
        return sum(places.size for places in self.places.values())

    def parameter(self, name: str, size: int, count: int | None = None) -> Indices:
        """Where a parameter stands, (size,) or (size, count); allocated when it is first asked for."""
        shape = (size,) if count is None else (size, count)
        if name not in self.places:
            first = self.parameters
            self.places[name] = np.arange(first, first + int(np.prod(shape))).reshape(shape)
        if self.places[name].shape != shape:
            raise ValueError(f"parameter {name!r}: shape {shape}, but it has {self.places[name].shape} already")
        return self.places[name]

    def vector(self, values: Mapping[str, Any]) -> Array:
        """The parameter vector of values by name."""
        p = np.empty(self.parameters)
        for name, places in self.places.items():
            if name not in values:
                raise ValueError(f"parameter {name!r}: it has no value")
            p[places] = values[name]
        return p

    def variables(self, count: int) -> Indices:
        """New variables (count,) behind those there are."""
        self.size += count
        return np.arange(self.size - count, self.size)

    @contextmanager
    def owned_by(self, owner: int) -> Iterator[None]:
        """What is added within belongs to ``owner``."""
        first = len(self.uses)
        yield
        for use in self.uses[first:]:
            use.owner = owner

    def add(
        self,
        element: Element,
        variables: Any,
        parameters: Mapping[str, Any] | None = None,
        constants: Mapping[str, Any] | None = None,
        names: Sequence[str] = (),
    ) -> None:
        """Add an element at index columns ``variables`` (n, count).

        Of its parameters, the last may be ``constants``, numbers (m,) or (m, count); ``parameters`` says where others
        stand, (m,) or (m, count) as `parameter` gave it. The rest are shared, under the names they have.
        """
        variables = np.asarray(variables, np.intp)
        variables = variables[:, None] if variables.ndim == 1 else variables
        if variables.shape[0] != element.y.shape[0]:
            raise ValueError(f"element {element.name}: {variables.shape[0]} indices for {element.y.shape[0]} variables")
        count, constants, parameters = variables.shape[1], constants or {}, parameters or {}
        free = [name for name in element.sizes if name not in constants]
        if list(element.sizes) != [*free, *constants] or not parameters.keys() <= set(free):
            given = [*parameters, *constants]
            raise ValueError(f"element {element.name}: parameters {list(element.sizes)}, given {given}, constants last")
        stand = [parameters[name] if name in parameters else self.parameter(name, element.sizes[name]) for name in free]
        columns = [_columns(place, element.sizes[name], count) for name, place in zip(free, stand, strict=True)]
        fixed = [_columns(value, element.sizes[name], count) for name, value in constants.items()]
        places = np.vstack([np.zeros((0, count), np.intp), *columns])
        self.uses.append(Use(element, variables, places, np.vstack([np.zeros((0, count)), *fixed]), names))

    @property
    def bounds(self) -> tuple[Array, Array]:
        """Lower and upper bounds of all constraints."""
        lower = [np.tile(use.element.lower, use.count) for use in self.uses]
        upper = [np.tile(use.element.upper, use.count) for use in self.uses]
        return np.concatenate(lower), np.concatenate(upper)

    def names(self) -> list[str]:
        """What messages call the constraint rows."""
        return [use.name(k, row) for use in self.uses for k in range(use.count) for row in range(use.rows)]

    def row(self, number: int) -> tuple[Use, int, int]:
        """The use, occurrence and row of an element that constraint row ``number`` is."""
        for use in self.uses:
            if number < use.rows * use.count:
                return use, *divmod(number, use.rows)
            number -= use.rows * use.count
        raise IndexError(f"constraint row {number}: there is none")

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


def _columns(values: Any, size: int, count: int) -> Any:
    """Values (size,) or (size, count) as (size, count)."""
    values = np.asarray(values)
    return np.broadcast_to(values[:, None] if values.ndim == 1 else values, (size, count))


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
