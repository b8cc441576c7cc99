"""Built problems kept for plans to come: building one takes as long as solving it."""

from __future__ import annotations

import math
import threading
from collections.abc import Callable
from typing import Any

from vehsim.planning.problem.solver import Solver

KEPT = 16
"""Built problems kept for plans in free space."""


class SolverCache:
    """Solvers by what their problems are made of; beyond ``most`` the oldest goes."""

    def __init__(self, most: float = math.inf) -> None:
        self._most = most
        self._solvers: dict[Any, Solver] = {}

    def get(self, key: Any, make: Callable[[], Solver]) -> Solver:
        """The solver kept under ``key``, else the one ``make`` builds."""
        if key not in self._solvers:
            self._solvers[key] = make()
            while len(self._solvers) > self._most:
                del self._solvers[next(iter(self._solvers))]
        return self._solvers[key]


class _Own(threading.local):
    def __init__(self) -> None:
        self.cache = SolverCache(KEPT)


_own = _Own()


def common() -> SolverCache:
    """Problems in free space, solved again by every plan of the same shape; a thread keeps its own."""
    return _own.cache
