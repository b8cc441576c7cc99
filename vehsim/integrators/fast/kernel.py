"""A CasADi function that works on NumPy memory: interpreted, or as machine code (`machine.py`)."""

from __future__ import annotations

import ctypes
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import lru_cache
from itertools import pairwise
from typing import Any

import casadi as ca
import numpy as np

from vehsim.integrators.fast import machine
from vehsim.lie.vectorized import point
from vehsim.vehicles.definition.base import Array

BLOCKS = (256, 16, 1)
"""Numbers of rows per interpreter call: the largest that fits, then smaller ones."""


class Kernel:
    """``function`` of columns, with the memory that it reads and writes.

    ``kernel(*columns)`` returns its outputs as new arrays, at a tenth of what a plain CasADi call costs. ``bind`` makes
    ``run()`` work in place; ``rows`` works down the rows of arrays. ``compiled``: by machine code, where there is a
    compiler. Two threads may share a kernel only for compiled ``rows``, which release Python's lock.
    """

    run: Callable[[], None]
    """Read the bound inputs, write the bound outputs."""

    def __init__(self, function: ca.Function, compiled: bool = False):
        self.function = _dense(function)
        self._built = machine.build(self.function) if compiled else None
        self._in: list[Array] = []
        self._out: list[Array] | None = None
        self._blocks: dict[tuple[int, bool], tuple[Any, Any]] = {}

    @property
    def compiled(self) -> bool:
        """Whether machine code runs, and not CasADi's interpreter."""
        return self._built is not None

    def bind(self, inputs: Sequence[Array], outputs: Sequence[Array]) -> Kernel:
        """Let `run` use these arrays where they are: float64, contiguous, as large as the function's columns."""
        function = self.function if self._built is None else self._built.function()
        self._in, self._out = list(inputs), list(outputs)  # the buffer points into them
        self._buffer, self.run = function.buffer()
        point(self._buffer, inputs, outputs)
        return self

    def __call__(self, *columns: Any) -> list[Array]:
        if self._out is None:
            f = self.function
            self.bind(
                [np.zeros(f.numel_in(i)) for i in range(f.n_in())],
                [np.zeros(f.numel_out(i)) for i in range(f.n_out())],
            )
        for array, column in zip(self._in, columns, strict=True):
            array[:] = column
        self.run()
        return [array.copy() for array in self._out]  # type: ignore[union-attr]  # bound above

    def rows(self, inputs: Sequence[Array], outputs: Sequence[Array], carries: bool = False) -> None:
        """Call the function for every row of arrays (n, width) or, side by side, (m, n, width).

        ``carries``: the first output is the first input of the next row; pass ``x[:-1]`` and ``x[1:]`` of one array
        whose first row is set. Rows are contiguous, or broadcast (``np.broadcast_to``) where all are the same.
        """
        if outputs[0].ndim == 2:
            inputs, outputs = [a[None] for a in inputs], [a[None] for a in outputs]
        if self._built is not None:
            m, n = (ctypes.c_longlong(size) for size in outputs[0].shape[:2])
            self._built.loop(m, n, *_pointers(inputs), *_pointers(outputs))
            return
        for j in range(len(outputs[0])):
            self._interpret([a[j] for a in inputs], [a[j] for a in outputs], carries)

    def _interpret(self, inputs: Sequence[Array], outputs: Sequence[Array], carries: bool) -> None:
        n, first = len(outputs[0]), 0
        for size in BLOCKS:
            if first + size > n:
                continue
            buffer, evaluate = self._block(size, carries)
            same = [np.repeat(a[:1], size, axis=0) if a.strides[0] == 0 else None for a in inputs]
            for _ in range((n - first) // size):
                rows = slice(first, first + size)
                given = [a[rows] if s is None else s for a, s in zip(inputs, same, strict=True)]
                if carries:
                    given[0] = given[0][:1]
                point(buffer, given, [a[rows] for a in outputs])
                evaluate()
                first += size

    def _block(self, size: int, carries: bool) -> tuple[Any, Any]:
        """Buffer and call of ``size`` rows at once, built once."""
        if (size, carries) not in self._blocks:
            self._blocks[size, carries] = _repeated(self.function, size, carries).buffer()
        return self._blocks[size, carries]


@lru_cache(maxsize=32)
def _repeated(function: ca.Function, size: int, carries: bool) -> ca.Function:
    """The function of ``size`` rows at once; it is kept, as it takes longer to build than to run."""
    if size == 1:
        return function
    return function.mapaccum(size) if carries else function.map(size)


def each_part(count: int, threads: int, work: Callable[[slice], None]) -> None:
    """Run ``work`` on ``threads`` equal parts of ``count`` rows in parallel."""
    cuts = np.linspace(0, count, max(1, min(threads, count)) + 1).astype(int)
    parts = [slice(int(a), int(b)) for a, b in pairwise(cuts)]
    if len(parts) == 1:
        work(parts[0])
        return
    with ThreadPoolExecutor(len(parts)) as pool:
        list(pool.map(work, parts))


def _dense(function: ca.Function) -> ca.Function:
    """The same function with dense inputs and outputs: a buffer holds no other elements."""
    sparsities = [function.sparsity_in(i) for i in range(function.n_in())]
    sparsities += [function.sparsity_out(i) for i in range(function.n_out())]
    if all(sparsity.is_dense() for sparsity in sparsities):
        return function
    symbols = [ca.SX.sym(f"x{i}", *function.size_in(i)) for i in range(function.n_in())]
    made: Any = function(*symbols)
    outputs = made if isinstance(made, tuple | list) else [made]
    return ca.Function(function.name(), symbols, [ca.densify(x) for x in outputs])


def _pointers(arrays: Sequence[Array]) -> tuple[Any, Any, Any]:
    """First elements, and strides across and along, in doubles; null for missing arguments."""
    count = len(arrays)
    starts = (ctypes.c_void_p * count)(*(a.ctypes.data if a.size else None for a in arrays))
    over, along = ((ctypes.c_longlong * count)(*(a.strides[axis] // 8 for a in arrays)) for axis in (0, 1))
    return starts, over, along
