"""Bodies at rest: while contact holds them still and nothing changes, no step is integrated."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, Protocol

import numpy as np

from vehsim.vehicles.definition.base import Array

CALM = 0.25
"""Time for which contact holds bodies still before they rest, s."""
CHANGE = 1e-3
"""Change of a wrench, as a share of it, that does not wake them without further thought."""


class RestingBody(Protocol):
    """A body that can rest, such as `vehsim.integrators.forced.Forced`."""

    integrator: Any
    controls: Array

    def stop(self) -> None: ...

    def wait(self, seconds: float) -> None: ...

    def start_with(self, wrench: Array, added: Array | None = None) -> None: ...


class Rest:
    """The rest of ``bodies``, which act on each other.

    ``settled()``: whether contact holds all of them; ``holds(changes)``: whether it still does if the wrench on each
    changes; ``query()``: the wrench and added mass on each, at their states.
    """

    CARRIED = ("_calm", "_held", "_balance")

    def __init__(
        self,
        bodies: Sequence[RestingBody],
        settled: Callable[[], bool],
        holds: Callable[[Sequence[Array]], bool],
        query: Callable[[], list[tuple[Array, Array | None]]],
    ) -> None:
        self._bodies, self._settled, self._holds, self._query = bodies, settled, holds, query
        self._calm, self._held = 0.0, False
        self._balance: list[tuple[Array, Array | None]] = []

    def keeps(self, controls: Sequence[tuple[Array, Array]], seconds: float) -> bool:
        """Whether the bodies rest for ``seconds``, whose ``controls`` start and end as given; their time then passes.

        New controls, a touch, or a wrench that contact does not balance wake them.
        """
        same = all(
            np.array_equal(start, end) and np.array_equal(start, body.controls)
            for body, (start, end) in zip(self._bodies, controls, strict=True)
        )
        if not (same and self._settled()) or any(body.integrator.vehicle.joints for body in self._bodies):
            self._calm, self._held = 0.0, False
            return False
        if not self._held:
            self._calm += seconds
            if self._calm < CALM:
                return False
            self._held = True
            for body in self._bodies:
                body.stop()
            self._balance = self._query()
        for body in self._bodies:
            body.wait(seconds)
        now = self._query()
        changes = [new - old for (new, _), (old, _) in zip(now, self._balance, strict=True)]
        slight = all(
            np.linalg.norm(change) <= CHANGE * np.linalg.norm(old)
            for change, (old, _) in zip(changes, self._balance, strict=True)
        )
        if not (self._settled() and (slight or self._holds(changes))):
            self._calm, self._held = 0.0, False
            for body, (wrench, added) in zip(self._bodies, now, strict=True):
                body.start_with(wrench, added)
        return True
