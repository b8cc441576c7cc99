"""Write an expression once in CasADi and evaluate it on arrays too."""

from __future__ import annotations

import functools
from collections.abc import Callable
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
        columns = [np.broadcast_to(a, (*lead, a.shape[-1])).reshape(-1, a.shape[-1]).T for a in arrays]
        count = int(np.prod(lead, dtype=int))
        rows, width = function.size_out(0)
        if count == 0:
            values = np.zeros((0, rows, width))
        else:
            values = stacked(function.map(count)(*columns) if count > 1 else function(*columns), count)
        shape = (rows, width) if width > 1 else (rows,) if rows > 1 else ()
        return values.reshape(*lead, *shape)

    return call


def stacked(side_by_side: Any, count: int) -> NDArray[np.float64]:
    """The matrices (m, k) that a mapped function gives side by side, as (count, m, k)."""
    values = np.asarray(side_by_side)
    return values.reshape(len(values), count, -1).transpose(1, 0, 2)


def _function(owner: Any, method: Callable[..., Any], sizes: tuple[int, ...]) -> ca.Function:
    cache = owner.__dict__.setdefault("_functions", {})
    key = (method.__qualname__, sizes)
    if key not in cache:
        symbols = [ca.SX.sym(f"x{i}", n) for i, n in enumerate(sizes)]
        cache[key] = ca.Function(method.__name__.strip("_"), symbols, [ca.densify(ca.SX(method(owner, *symbols)))])
    return cache[key]
