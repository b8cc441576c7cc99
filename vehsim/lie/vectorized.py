"""Write an expression once in CasADi and evaluate it on arrays too."""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from vehsim.lie.once import built_once


def vectorized(method: Callable[..., Any]) -> Callable[..., Any]:
    """Let ``method(self, x, y, ...)``, written for column expressions, also accept arrays of shape ``(..., n)``.

    Symbolic arguments are inserted into the expression, which is built once, see `built_once`. Arrays broadcast over
    their leading axes. A column is returned as ``(..., n)``, a scalar as ``(...)``, a matrix as ``(..., m, n)``.
    """
    symbolic = built_once(method)

    @functools.wraps(method)
    def call(self: Any, *arguments: Any) -> Any:
        if any(isinstance(a, ca.SX | ca.MX) for a in arguments):
            return symbolic(self, *arguments)
        arrays = [np.asarray(a, float) for a in arguments]
        lead = np.broadcast_shapes(*(a.shape[:-1] for a in arrays))
        function = _function(self, method, tuple(a.shape[-1] for a in arrays))
        count = int(np.prod(lead, dtype=int))
        columns = [np.broadcast_to(a, (*lead, a.shape[-1])).reshape(count, a.shape[-1]) for a in arrays]
        values = for_rows(function, *columns)[0]
        rows, width = function.size_out(0)
        shape = (rows, width) if width > 1 else (rows,) if rows > 1 else ()
        return values.reshape(*lead, *shape)

    return call


def for_rows(function: ca.Function, *rows: NDArray[np.float64]) -> list[NDArray[np.float64]]:
    """The matrices (n, m, k) that a function of dense columns gives for each row (n, .) of its inputs, one array per
    output.

    The function works on NumPy's memory, which takes a fifth of the time of a call that converts it.
    """
    count = len(rows[0])
    sizes = [function.size_out(i) for i in range(function.n_out())]
    outputs = [np.empty((count, columns, height)) for height, columns in sizes]  # CasADi stores column by column
    if count:
        inputs = [np.ascontiguousarray(a, float) for a in rows]
        buffer, run = (function.map(count) if count > 1 else function).buffer()
        point(buffer, inputs, outputs)
        run()
    return [values.transpose(0, 2, 1) for values in outputs]


def point(buffer: Any, inputs: Sequence[NDArray[np.float64]], outputs: Sequence[NDArray[np.float64]]) -> None:
    """Let a buffer of CasADi read and write arrays where they are."""
    for place, arrays in ((buffer.set_arg, inputs), (buffer.set_res, outputs)):
        for i, array in enumerate(arrays):
            if array.size:
                place(i, memoryview(array))  # type: ignore[arg-type]  # CasADi takes any buffer


def _function(owner: Any, method: Callable[..., Any], sizes: tuple[int, ...]) -> ca.Function:
    cache = owner.__dict__.setdefault("_functions", {})
    key = (method.__qualname__, sizes)
    if key not in cache:
        symbols = [ca.SX.sym(f"x{i}", n) for i, n in enumerate(sizes)]
        cache[key] = ca.Function(method.__name__.strip("_"), symbols, [ca.densify(ca.SX(method(owner, *symbols)))])
    return cache[key]
