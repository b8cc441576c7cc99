"""Functions at many columns at once, for CasADi's solvers."""

from __future__ import annotations

from typing import Any

import casadi as ca
import numpy as np

from vehsim.integrators.fast.kernel import Kernel

LEAST = 5000
"""Operations that take longer than the call of Python by which CasADi reaches a kernel."""


class Repeated(ca.Callback):
    """A ``kernel`` of dense columns at ``count`` of them, as CasADi's ``map``, but without derivatives. Keep a
    reference: CasADi has none."""

    def __init__(self, kernel: Kernel, count: int):
        super().__init__()
        self._kernel, f = kernel, kernel.function
        self._in = [(count, f.numel_in(i)) for i in range(f.n_in())]
        self._out = [(count, f.numel_out(i)) for i in range(f.n_out())]
        self.construct(f.name(), {})

    def get_n_in(self) -> int:
        return len(self._in)

    def get_n_out(self) -> int:
        return len(self._out)

    def get_sparsity_in(self, i: int) -> ca.Sparsity:
        return ca.Sparsity.dense(*reversed(self._in[i]))

    def get_sparsity_out(self, i: int) -> ca.Sparsity:
        return ca.Sparsity.dense(*reversed(self._out[i]))

    def has_eval_buffer(self) -> bool:
        return True

    def eval_buffer(self, arguments: Any, results: Any) -> int:
        self._kernel.rows(_rows(arguments, self._in), _rows(results, self._out))
        return 0


def _rows(memory: Any, shapes: Any) -> list[Any]:
    """CasADi's memory as rows; zeros where an argument is missing, space where a result is not wanted."""
    return [np.frombuffer(m).reshape(s) if m else np.zeros(s) for m, s in zip(memory, shapes, strict=True)]


def long(function: ca.Function, count: int) -> bool:
    """Whether machine code is worth the call for ``count`` columns of a function."""
    return bool(function.is_a("SXFunction")) and function.n_instructions() * count > LEAST
