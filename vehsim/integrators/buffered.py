"""CasADi functions called on the spot, numbers in and numbers out, at a tenth of what a plain call costs."""

from __future__ import annotations

from typing import Any

import casadi as ca
import numpy as np

from vehsim.vehicles._base import Array


class Buffered:
    """``function`` of dense columns as ``call(*columns) -> list of columns``. Not to be shared between threads."""

    def __init__(self, function: ca.Function):
        symbols = [ca.SX.sym(f"x{i}", function.size1_in(i), function.size2_in(i)) for i in range(function.n_in())]
        made: Any = function(*symbols)
        outputs = made if isinstance(made, tuple | list) else [made]
        dense = ca.Function(function.name(), symbols, [ca.densify(x) for x in outputs])
        self._in = [np.zeros(dense.numel_in(i)) for i in range(dense.n_in())]
        self._out = [np.zeros(dense.numel_out(i)) for i in range(dense.n_out())]
        self._buffer: Any
        self._buffer, self._evaluate = dense.buffer()
        for i, array in enumerate(self._in):
            if array.size:
                self._buffer.set_arg(i, memoryview(array))  # type: ignore[arg-type]
        for i, array in enumerate(self._out):
            if array.size:
                self._buffer.set_res(i, memoryview(array))  # type: ignore[arg-type]

    def __call__(self, *columns: Any) -> list[Array]:
        for array, column in zip(self._in, columns, strict=True):
            array[:] = column
        self._evaluate()
        return [array.copy() for array in self._out]
