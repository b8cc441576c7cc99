"""A large sparse optimisation problem assembled element by element.

One symbolic element (a segment, a knot, a mark) is differentiated once and mapped over its occurrences; constant index
maps gather its values from the whole problem and scatter them into it. Building therefore costs the same at any length,
and derivatives are exact and sparse. This module knows nothing of vehicles.
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

from vehsim.integrators.fast.kernel import Kernel
from vehsim.planning.problem.repeated import Repeated, long

Array = NDArray[np.float64]
Indices = NDArray[np.intp]


@dataclass(frozen=True, eq=False)
class SpatialField:
    """A function of space that an element evaluates at ``points`` (d, k), expressions of its variables and parameters.

    ``function``: (count, order) -> a `Function`, points (d, count) -> numbers (m, count) that describe it near these
    points, exact for derivatives up to ``order``. The element itself is written in the symbols ``models`` (d + m, k):
    the point and these numbers. CasADi therefore never differentiates the function itself, which may be too large a
    spline for that.
    """

    points: Any
    models: Any
    function: Callable[[int, int], ca.Function]


def second_order(points: Any, models: Any) -> Any:
    """Values (k,) at ``points`` (3, k) from ``models`` (13, k): the point, value, gradient and Hessian (xx, yy, zz, xy,
    xz, yz) there. Exact at that point, with both derivatives."""
    values = []
    for k in range(points.shape[1]):
        place, value, slope, bend = ca.vertsplit(models[:, k], [0, 3, 4, 7, 13])
        x, y, z = ca.vertsplit(points[:, k] - place)
        mixed = ca.vertcat(x * x / 2, y * y / 2, z * z / 2, x * y, x * z, y * z)
        values.append(value + ca.dot(slope, ca.vertcat(x, y, z)) + ca.dot(bend, mixed))
    return ca.vertcat(*values)


@dataclass(eq=False)
class Element:
    """A cost term ``f`` and constraints ``lower <= g <= upper`` in a few local variables ``y``.

    ``y`` (n,) symbols, SX; ``f`` scalar, ``g`` (k,) expressions; ``lower, upper`` (k,). ``parameters``: symbols (m,) by
    name; the problem decides where their values are stored, see `NonlinearProgram.add`.
    """

    name: str
    y: Any
    parameters: Mapping[str, Any] = field(default_factory=dict)
    f: Any = 0.0
    g: Any = None
    lower: Any = 0.0
    upper: Any = 0.0
    space: SpatialField | None = None
    """The function of space that ``f`` and ``g`` use."""
    labels: Sequence[str] = ()
    """Names of the rows of ``g`` that differ from the element's name."""
    frozen: tuple[Any, Any] | None = None
    """Symbols in ``f`` and ``g``, and the expressions of ``y`` and the parameters that replace them. Derivatives treat
    them as constants (a stop-gradient)."""
    table: SpatialField | None = None
    """Another such function, of numbers such as speeds. Its models may be constants."""
    inner: Sequence[tuple[Any, Any]] = ()
    """Symbols (m,) in ``f`` and ``g``, and the expressions (m,) of ``y``, the parameters and earlier symbols that they
    stand for. Derivatives follow the chain rule through them, which takes fewer operations where ``m`` is small."""
    reduced: tuple[Sequence[int], Callable[[], Element]] | None = None
    """Indices of the variables (m,) which the first ``m`` rows determine from the others, and the element without both,
    for problems in which no other element reads them."""
    lacked: Any = None
    """The variables (m,) that a reduced element lacks, as an expression of the others."""

    def __post_init__(self) -> None:
        kind = type(self.y)
        self.sizes = {name: int(symbol.shape[0]) for name, symbol in self.parameters.items()}
        given = ca.vertcat(kind(0, 1), *self.parameters.values())
        self.given = int(given.shape[0])
        self.fields = [each for each in (self.space, self.table) if each is not None]
        self.p = ca.vertcat(given, *(ca.vec(each.models) for each in self.fields))
        self.g = kind(0, 1) if self.g is None else ca.densify(self.g)
        self.f = kind(self.f)
        if kind is ca.SX:  # shared subexpressions are then differentiated once: derivatives cost 20 to 33 % less
            symbols, expressions = zip(*self.inner, strict=True) if self.inner else ((), ())
            self.f, self.g, *expressions = ca.cse([self.f, self.g, *map(ca.densify, expressions)])
            self.inner = list(zip(symbols, expressions, strict=True))
        self._repeated: dict[tuple[ca.Function, int], Repeated] = {}
        rows = self.g.shape[0]
        self.lower = np.broadcast_to(np.asarray(self.lower, float), (rows,))
        self.upper = np.broadcast_to(np.asarray(self.upper, float), (rows,))

    @cached_property
    def points(self) -> ca.Function:
        """``(y, p) -> (d, k)`` for each of its functions of space: where they are evaluated; ``p`` excludes models."""
        points = _inserted(self.inner, [ca.densify(each.points) for each in self.fields])
        return ca.Function("points", [self.y, self.p[: self.given]], points)

    @property
    def lacks(self) -> int:
        """How many rows and variables a reduced element lacks."""
        return 0 if self.lacked is None else int(self.lacked.shape[0])

    @cached_property
    def value(self) -> ca.Function:
        """``(y, p) -> (f, g)``"""
        return self.function("value", [ca.densify(self.f), self.g])

    @cached_property
    def missing(self) -> ca.Function:
        """``(y, p) -> (m,)``: the variables that a reduced element lacks."""
        return self.function("missing", [ca.densify(self.lacked)])

    @cached_property
    def gradient(self) -> ca.Function:
        """``(y, p) -> (f, df/dy)``, dense."""
        slopes = self._through_inner(ca.jacobian(self.f, self._all))
        return self.function("gradient", [ca.densify(self.f), ca.densify(slopes.T)])

    @property
    def _all(self) -> Any:
        """``y`` and all inner symbols."""
        return ca.vertcat(self.y, *(symbols for symbols, _ in self.inner))

    @cached_property
    def _chain(self) -> list[Any]:
        """For all inner symbols, their expressions' derivatives by ``y`` and earlier symbols."""
        before = [self.y, *(symbols for symbols, _ in self.inner)]
        slopes = [ca.jacobian(at, ca.vertcat(*before[: k + 1])) for k, (_, at) in enumerate(self.inner)]
        return list(ca.cse(slopes)) if slopes else []

    @cached_property
    def _slopes(self) -> Any:
        """dg/dy."""
        return self._through_inner(ca.jacobian(self.g, self._all))

    def _through_inner(self, slopes: Any) -> Any:
        """Derivatives by ``y``, from those by ``y`` and the inner symbols."""
        for inner in reversed(self._chain):
            n = inner.shape[1]
            slopes = slopes[:, :n] + slopes[:, n:] @ inner
        return slopes

    @cached_property
    def jacobian(self) -> ca.Function:
        """``(y, p) -> (g, entries of dg/dy)``, entries in the order of ``jacobian_pattern``."""
        return self.function("jacobian", [self.g, _entries(self._slopes)])

    @cached_property
    def jacobian_pattern(self) -> tuple[Indices, Indices]:
        return _pattern(self._slopes)

    @cached_property
    def hessian(self) -> tuple[ca.Function, Indices, Indices]:
        """``(y, p, lam_f, lam_g) -> entries`` of the upper triangle of the Lagrangian's Hessian, and its pattern."""
        kind = type(self.y)
        lam_f, lam_g = kind.sym("lam_f"), kind.sym("lam_g", self.g.shape[0])
        upper = ca.triu(self.curvature(lam_f * self.f + ca.dot(lam_g, self.g))[0])
        return self.function("hessian", [_entries(upper)], lam_f, lam_g), *_pattern(upper)

    def curvature(self, value: Any) -> tuple[Any, Any]:
        """Hessian and gradient by ``y`` of an expression of ``f`` and ``g``."""
        symbols = [symbols for symbols, _ in self.inner]
        weights = [ca.SX.sym("weights", each.shape[0]) for each in symbols]
        for weight, (_, expressions) in zip(weights, self.inner, strict=True):
            value += ca.dot(weight, expressions)
        hessian, gradient = ca.hessian(value, self._all)
        known = []
        for weight, inner in reversed(list(zip(weights, self._chain, strict=True))):
            n = inner.shape[1]
            known.append((weight, gradient[n:]))
            mixed = hessian[:n, n:] @ inner
            hessian = hessian[:n, :n] + mixed + mixed.T + inner.T @ (hessian[n:, n:] @ inner)
            gradient = gradient[:n]
        hessian, gradient = _inserted(known, [hessian, gradient])
        return hessian, gradient

    def function(self, name: str, results: list[Any], *more: Any) -> ca.Function:
        """A function of ``y, p`` and ``more``; inner and frozen expressions are inserted after differentiation."""
        results = _inserted(self.inner, results)
        if self.frozen is not None:
            results = [ca.densify(r) for r in ca.cse(ca.substitute(results, [self.frozen[0]], [self.frozen[1]]))]
        return ca.Function(name, [self.y, self.p, *more], results)

    def repeated(self, function: ca.Function, count: int) -> Any:
        """One of its functions at ``count`` columns, for evaluation only: as machine code once that pays."""
        if not long(function, count):
            return _mapped(function, count)
        if (function, count) not in self._repeated:
            # of two threads, both take the one that is kept: CasADi calls another one after Python has deleted it
            self._repeated.setdefault((function, count), Repeated(Kernel(function), count))
        return self._repeated[function, count]


def _inserted(pairs: Sequence[tuple[Any, Any]], results: list[Any]) -> list[Any]:
    """The results with expressions in place of their symbols, which later expressions may contain.

    What expressions and results share is computed once; after `substitute` it would be computed twice.
    """
    if not pairs:
        return results
    symbols, expressions = zip(*pairs, strict=True)
    return list(ca.substitute_inplace(list(symbols), [ca.densify(each) for each in expressions], results)[1])


def elastic(element: Element, price: float) -> Element:
    """The element in elastic mode: 2 k more non-negative variables, by which its rows may be missed at a ``price``."""
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
    """The occurrences of an element in a problem.

    ``variables`` (n, count) and ``parameters`` (m, count) are indices into the problem's vectors; ``constants`` (c,
    count) are the values of its last parameters; ``names`` (count,): names of the occurrences, if any.
    """

    element: Element
    variables: Indices
    parameters: Indices
    constants: Array
    names: Sequence[str] = ()
    owner: int = -1
    """Index of the block that added it."""
    lacked: Indices = field(default_factory=lambda: np.zeros((0, 0), np.intp))
    """Indices (m, count) of the variables that a reduced element lacks."""

    def name(self, occurrence: int, row: int) -> str:
        """The name of a row in messages."""
        if self.element.labels:
            return ".".join([*self.names[occurrence : occurrence + 1], self.element.labels[row]])
        return self.names[occurrence] if self.names else f"{self.element.name}[{occurrence}]"

    @property
    def count(self) -> int:
        return int(self.variables.shape[1])

    @property
    def rows(self) -> int:
        return int(self.element.g.shape[0])

    def mapped(self, function: ca.Function, differentiable: bool = False) -> Any:
        """A function of the element at all occurrences; CasADi evaluates it faster than a ``differentiable`` one."""
        return _mapped(function, self.count) if differentiable else self.element.repeated(function, self.count)

    def local(self, x: Any, p: Any, order: int, differentiable: bool = False) -> tuple[Any, Any]:
        """Local variables (n, count) and parameters (m, count) from the problem's; models have derivatives up to
        ``order``."""
        y, given = _gather(x, self.variables), _gather(p, self.parameters)
        rows = [given, ca.MX(ca.DM(self.constants))] if len(self.constants) else [given]
        return y, self.with_models(y, ca.vertcat(*rows), order, differentiable)

    def with_models(self, y: Any, given: Any, order: int, differentiable: bool = False) -> Any:
        """Parameters (m, count), from those without the models of functions of space."""
        if not self.element.fields:
            return given
        rows, found = [given], self.mapped(self.element.points, differentiable)(y, given)
        for field_, points in zip(self.element.fields, found if isinstance(found, tuple) else [found], strict=True):
            d, k = field_.points.shape
            places = ca.reshape(points, d, k * self.count)
            models = ca.vertcat(places, field_.function(k * self.count, order)(places))
            rows.append(ca.reshape(models, field_.models.shape[0] * k, self.count))
        return ca.vertcat(*rows)


@dataclass(eq=False)
class NonlinearProgram:
    """``size`` variables, named parameters, and the uses of elements; `solver.Solver` passes it to an NLP solver."""

    size: int
    uses: list[Use] = field(default_factory=list)
    places: dict[str, Indices] = field(default_factory=dict)
    """Indices of every parameter: (size,), or (size, count) if it has a column for each occurrence."""

    @property
    def parameters(self) -> int:
        """The length of the parameter vector."""
        return sum(places.size for places in self.places.values())

    def parameter(self, name: str, size: int, count: int | None = None) -> Indices:
        """Indices of a parameter, (size,) or (size, count); it is allocated on the first call."""
        shape = (size,) if count is None else (size, count)
        if name not in self.places:
            first = self.parameters
            self.places[name] = np.arange(first, first + int(np.prod(shape))).reshape(shape)
        if self.places[name].shape != shape:
            raise ValueError(f"parameter {name!r}: shape {shape}, but it has {self.places[name].shape} already")
        return self.places[name]

    def vector(self, values: Mapping[str, Any]) -> Array:
        """The parameter vector, from values by name."""
        p = np.empty(self.parameters)
        for name, places in self.places.items():
            if name not in values:
                raise ValueError(f"parameter {name!r}: it has no value")
            p[places] = values[name]
        return p

    def variables(self, count: int) -> Indices:
        """Indices (count,) of new variables, appended to the existing ones."""
        self.size += count
        return np.arange(self.size - count, self.size)

    @contextmanager
    def owned_by(self, owner: int) -> Iterator[None]:
        """Within this context, every added use belongs to ``owner``."""
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

        The last of its parameters may be ``constants``, numbers (m,) or (m, count). ``parameters`` gives the indices of
        others, (m,) or (m, count), as `parameter` returned them. The remaining parameters are shared between elements
        by name.
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

    def reduce(self) -> None:
        """Take the reduced elements where no other element reads the variables that they lack."""
        readers = np.bincount(np.concatenate([use.variables.ravel() for use in self.uses]), minlength=self.size)
        for number, use in enumerate(self.uses):
            if use.element.reduced is not None:
                places, made = use.element.reduced
                if (readers[use.variables[places]] == 1).all():
                    rest, lacked = np.delete(use.variables, places, axis=0), use.variables[places]
                    self.uses[number] = replace(use, element=made(), variables=rest, lacked=lacked)

    @property
    def lacked(self) -> Indices:
        """Indices (k,) of the variables that reduced elements lack: constants for the solver."""
        return np.concatenate([np.zeros(0, np.intp), *(use.lacked.ravel() for use in self.uses)])

    @cached_property
    def missing(self) -> ca.Function:
        """``(x, p) -> (k,)``: the values of the variables that reduced elements lack."""
        x, p = ca.MX.sym("x", self.size), ca.MX.sym("p", self.parameters)
        uses = [use for use in self.uses if use.lacked.size]
        values = [ca.vec(use.mapped(use.element.missing)(*use.local(x, p, 0)).T) for use in uses]
        return ca.Function("missing", [x, p], [ca.vertcat(*values)])

    @property
    def bounds(self) -> tuple[Array, Array]:
        """Lower and upper bounds of all constraints."""
        lower = [np.tile(use.element.lower, use.count) for use in self.uses]
        upper = [np.tile(use.element.upper, use.count) for use in self.uses]
        return np.concatenate(lower), np.concatenate(upper)

    def names(self) -> list[str]:
        """The names of the constraint rows in messages."""
        return [use.name(k, row) for use in self.uses for k in range(use.count) for row in range(use.rows)]

    def row(self, number: int) -> tuple[Use, int, int]:
        """The use, the occurrence, and the row of the element that belong to a constraint row."""
        for use in self.uses:
            if number < use.rows * use.count:
                return use, *divmod(number, use.rows)
            number -= use.rows * use.count
        raise IndexError(f"constraint row {number}: there is none")

    def functions(self, differentiable: bool = False) -> dict[str, ca.Function]:
        """The functions ``nlp, grad_f, jac_g, hess_lag`` that CasADi's NLP solvers require; some solvers differentiate
        the first one."""
        x, p = ca.MX.sym("x", self.size), ca.MX.sym("p", self.parameters)
        plain = [use.local(x, p, 0, differentiable) for use in self.uses]
        models = [[use.local(x, p, order) if use.element.fields else None for use in self.uses] for order in (1, 2)]
        local = [plain, *([own or at for own, at in zip(row, plain, strict=True)] for row in models)]
        f, g = self._values(local[0], differentiable)
        names = (["x", "p"], ["f", "g"])
        return {
            "nlp": ca.Function("nlp", [x, p], [f, g], *names),
            "grad_f": ca.Function("grad_f", [x, p], list(self._gradient(local[1])), ["x", "p"], ["f", "grad_f_x"]),
            "jac_g": ca.Function("jac_g", [x, p], list(self._jacobian(local[1])), ["x", "p"], ["g", "jac_g_x"]),
            "hess_lag": self._hessian(x, p, local[2]),
        }

    def _values(self, local: Sequence[tuple[Any, Any]], differentiable: bool) -> tuple[Any, Any]:
        f: Any = 0
        g = []
        for use, arguments in zip(self.uses, local, strict=True):
            cost, rows = use.mapped(use.element.value, differentiable)(*arguments)
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
        # IPOPT's interface reads the gradient as a dense array, whatever its sparsity
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
            a, b = use.variables[i].T.ravel(), use.variables[j].T.ravel()
            twice = (a == b) & np.tile(i != j, use.count)  # an element may use a variable twice, such as a duration
            values.append(ca.DM(1.0 + twice) * ca.vec(entries) if twice.any() else ca.vec(entries))
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
    """A sparse matrix of entries; entries at the same position are added."""
    keys = columns * shape[0] + rows  # column major, as CasADi stores it
    places, target = np.unique(keys, return_inverse=True)
    sparsity = ca.Sparsity.triplet(*shape, (places % shape[0]).tolist(), (places // shape[0]).tolist())
    entries = ca.vertcat(*values)
    if len(places) == len(keys):
        order = np.argsort(target)
        return ca.MX(sparsity, entries[order.tolist()])
    pattern = ca.Sparsity.triplet(len(places), len(keys), target.tolist(), list(range(len(keys))))
    return ca.MX(sparsity, ca.mtimes(ca.DM(pattern, 1.0), entries))
