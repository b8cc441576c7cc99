"""A function of one row run down the rows of arrays, memory to memory: what rollouts and clips spend their time in.

CasADi's interpreter does it in blocks, machine code (`machine.py`) in one call that lets Python's lock go.
"""

from __future__ import annotations

import ctypes
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from itertools import pairwise
from typing import Any

import casadi as ca
import numpy as np

from vehsim.integrators import machine
from vehsim.vehicles._base import Array

BLOCKS = (256, 16, 1)
"""Rows in one call of the interpreter: as many as are left, then fewer."""


class Loop:
    """``function`` for every row: ``loop(inputs, outputs)`` with arrays (n, width) or, side by side, (m, n, width).

    ``carries``: the function's first output is the first input of the next row; hand it ``x[:-1]`` and ``x[1:]`` of
    one array whose first row is set. Rows are contiguous, or broadcast (``np.broadcast_to``) where all are the same.
    """

    def __init__(self, function: ca.Function, carries: bool = False, compiled: bool = False):
        self.function, self.carries = function, carries
        self._blocks: dict[int, tuple[Any, Any]] = {}
        self._code = machine.loop(function) if compiled else None

    def __call__(self, inputs: Sequence[Array], outputs: Sequence[Array]) -> None:
        if outputs[0].ndim == 2:
            inputs, outputs = [a[None] for a in inputs], [a[None] for a in outputs]
        if self._code is not None:
            _call(self._code, inputs, outputs)
            return
        for j in range(len(outputs[0])):
            self._interpret([a[j] for a in inputs], [a[j] for a in outputs])

    def _interpret(self, inputs: Sequence[Array], outputs: Sequence[Array]) -> None:
        n, first = len(outputs[0]), 0
        for size in BLOCKS:
            if first + size > n:
                continue
            buffer, evaluate = self._block(size)
            held = [np.repeat(a[:1], size, axis=0) if a.strides[0] == 0 else None for a in inputs]
            for _ in range((n - first) // size):
                rows = slice(first, first + size)
                given = [a[rows] if h is None else h for a, h in zip(inputs, held, strict=True)]
                if self.carries:
                    given[0] = given[0][:1]
                _point(buffer.set_arg, given)
                _point(buffer.set_res, [a[rows] for a in outputs])
                evaluate()
                first += size

    def _block(self, size: int) -> tuple[Any, Any]:
        """Buffer and call of ``size`` rows at once, built once."""
        if size not in self._blocks:
            function = self.function.mapaccum(size) if self.carries else self.function.map(size)
            self._blocks[size] = (self.function if size == 1 else function).buffer()
        return self._blocks[size]


def each_part(count: int, threads: int, work: Callable[[slice], None]) -> None:
    """``work`` on ``threads`` equal parts of ``count`` rows at once."""
    cuts = np.linspace(0, count, max(1, min(threads, count)) + 1).astype(int)
    parts = [slice(int(a), int(b)) for a, b in pairwise(cuts)]
    if len(parts) == 1:
        work(parts[0])
        return
    with ThreadPoolExecutor(len(parts)) as pool:
        list(pool.map(work, parts))


def _point(place: Callable[[int, Any], None], arrays: Sequence[Array]) -> None:
    """Have a buffer read, or write, arrays where they are."""
    for i, array in enumerate(arrays):
        if array.size:
            place(i, memoryview(array))  # type: ignore[arg-type]


def _call(code: Any, inputs: Sequence[Array], outputs: Sequence[Array]) -> None:
    m, n = outputs[0].shape[:2]
    code(ctypes.c_longlong(m), ctypes.c_longlong(n), *_pointers(inputs), *_pointers(outputs))


def _pointers(arrays: Sequence[Array]) -> tuple[Any, Any, Any]:
    """First elements, and strides over and along, in doubles; null where there is nothing."""
    count = len(arrays)
    starts = (ctypes.c_void_p * count)(*(a.ctypes.data if a.size else None for a in arrays))
    over, along = ((ctypes.c_longlong * count)(*(a.strides[axis] // 8 for a in arrays)) for axis in (0, 1))
    return starts, over, along
