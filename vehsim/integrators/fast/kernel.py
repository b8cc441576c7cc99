"""A CasADi function that works on NumPy memory: interpreted, or as machine code."""

from __future__ import annotations

import threading
import warnings
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from functools import cache, lru_cache, partial
from itertools import pairwise
from typing import Any

import casadi as ca
import numpy as np

from vehsim.lie.vectorized import point
from vehsim.runtime.machine_code import MachineCode, code_key
from vehsim.vehicles.definition.base import Array

BLOCKS = (256, 16, 1)
"""Numbers of rows per interpreter call: the largest that fits, then smaller ones."""
WORTH = 1800
"""Evaluations after which a function has been interpreted for about as long as its machine code takes to build: 5 ns
and 9 us for each operation. So they take at most about twice the least possible time."""
KNOWN = 200
"""The same of looking for its machine code in the cache, 1 us for each operation."""
SHORT = 200
"""Operations that take as long as a call: shorter functions are interpreted, unless for many rows."""


class Evaluations:
    """How often a function was interpreted, and its machine code when that is worth it. All its kernels share it."""

    def __init__(self, function: ca.Function):
        self._function, self._count = function, 0
        self._key: str | None = None
        self._built: MachineCode | None = None
        self.code: MachineCode | None = None
        self.lock = threading.Lock()

    def build(self) -> MachineCode | None:
        """Its machine code; None if LLVM is missing or fails here, or does not know an operation of the function."""
        return self._made(partial(MachineCode, self._function, self.key()))

    def recall(self) -> MachineCode | None:
        """Its machine code that another process has built, None if there is none."""
        return self._made(partial(MachineCode.recalled, self.key()))

    def _made(self, make: Callable[[], MachineCode | None]) -> MachineCode | None:
        with suppress(ImportError, OSError, RuntimeError, ValueError):
            self._built = self._built or make()
        return self._built

    def key(self) -> str:
        """The key of its machine code; it must be known before a thread builds that."""
        if self._key is None:
            self._key = code_key(self._function)
        return self._key

    def count(self, inputs: Sequence[Array], outputs: Sequence[Array], aside: bool = False) -> None:
        """Count interpreted rows (m, n, width). When machine code is worth it, it is looked for in the cache, then
        built, ``aside`` in a thread, and used if it gives the same last row."""
        before, self._count = self._count, self._count + len(outputs[0]) * outputs[0].shape[1]
        for worth, make in ((KNOWN, self.recall), (WORTH, self.build)):
            if before < worth <= self._count and self._built is None:
                if aside:  # a vehicle that is driven must not wait
                    threading.Thread(target=make).start()
                else:
                    make()
        if (built := self._built) is not None:
            last = [np.empty_like(a[-1:, -1:]) for a in outputs]
            built.rows([a[-1:, -1:] for a in inputs], last)
            same = all(np.array_equal(a, b[-1:, -1:], equal_nan=True) for a, b in zip(last, outputs, strict=True))
            self.code, self._built = built if same else None, None


@lru_cache(maxsize=256)
def _evaluations(function: ca.Function) -> Evaluations:
    return Evaluations(function)


class Kernel:
    """``function`` of columns, with the memory that it reads and writes.

    ``kernel(*columns)`` returns its outputs as new arrays, at a tenth of what a plain CasADi call costs. ``bind`` makes
    ``run()`` work in place; ``rows`` works down the rows of arrays. ``compiled``: by machine code at once; by default
    as soon as that pays. Results are the same to the last bit. Two threads may share a kernel only for ``rows``; those
    by machine code release Python's lock.
    """

    run: Callable[[], None]
    """Read the bound inputs, write the bound outputs."""

    def __init__(self, function: ca.Function, compiled: bool = False):
        self.function = _dense(function)
        self._evaluations = _evaluations(self.function)
        if compiled and not self.compiled:
            self._evaluations.code = self._evaluations.recall() or self._evaluations.build()
        if compiled and not self.compiled:
            _warn_once("no machine code: llvmlite is missing, or fails here; CasADi interprets, which takes longer")
        self._in: list[Array] = []
        self._out: list[Array] | None = None
        self._blocks: dict[tuple[int, bool], tuple[Any, Any]] = {}

    @property
    def compiled(self) -> bool:
        """Whether machine code runs, and not CasADi's interpreter."""
        return self._evaluations.code is not None

    def bind(self, inputs: Sequence[Array], outputs: Sequence[Array]) -> Kernel:
        """Let `run` use these arrays where they are: float64, contiguous, as large as the function's columns, and apart
        from each other."""
        self._in, self._out = list(inputs), list(outputs)  # the buffer points into them
        self._buffer, self._run = self.function.buffer()
        point(self._buffer, inputs, outputs)
        long = self.function.is_a("SXFunction") and self.function.n_instructions() > SHORT
        if long:
            self._evaluations.key()  # later, a vehicle that is driven would wait
        self.run = self._counted if long else self._run
        return self

    def _counted(self) -> None:
        if self._evaluations.code is None:
            self._run()
            inputs, outputs = ([a[None, None] for a in arrays] for arrays in (self._in, self._out or ()))
            self._evaluations.count(inputs, outputs, aside=True)
        if self._evaluations.code is not None:
            self.run = self._evaluations.code.bound(self._in, self._out or ())
            self.run()

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
        if self._evaluations.code is not None:
            self._evaluations.code.rows(inputs, outputs)
            return
        with self._evaluations.lock:  # its buffers are shared
            for j in range(len(outputs[0])):
                self._interpret([a[j] for a in inputs], [a[j] for a in outputs], carries)
            self._evaluations.count(inputs, outputs)

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


@cache
def _warn_once(message: str) -> None:
    warnings.warn(message, stacklevel=4)
