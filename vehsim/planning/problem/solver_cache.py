"""A cache of built problems for later plans: building one takes as long as solving it."""

from __future__ import annotations

import math
import threading
from collections.abc import Callable
from typing import Any

from vehsim.planning.problem.solver import Solver

KEPT = 16
"""Number of built problems that are kept for plans in free space."""


class SolverCache:
    """Solvers by the key of their problem; beyond ``most`` the oldest is dropped."""

    def __init__(self, most: float = math.inf) -> None:
        self._most = most
        self._solvers: dict[Any, Solver] = {}

    def get(self, key: Any, make: Callable[[], Solver]) -> Solver:
        """The solver stored under ``key``, or the one that ``make`` builds."""
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
    """This thread's cache of problems in free space, which all plans of the same shape share."""
    return _own.cache
