"""What acts on a vehicle from outside: the one door through which water and contact enter the forward integrator.

An environment answers with a wrench that is a function of time, state and controls, and knows nothing of steps;
`vehsim.integrators.forced` makes it second order.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vehsim.vehicles._base import State

Array = NDArray[np.float64]


class Environment:
    """Base of all that pushes a vehicle from outside. A subclass is made for one vehicle in one world.

    ``max_step`` s: the longest step it may be integrated with; simulation takes substeps to keep to it. ``next_step``
    s: the longest from the state last asked about, for what comes and goes, such as contact.
    """

    max_step: float = np.inf
    next_step: float = np.inf

    def wrench(self, t: float, state: State, controls: Array) -> Array:
        """Wrench (d,) in body axes about the body frame's origin, torque [N m] then force [N] (SE(2): yaw, x, y).

        ``state`` is public (the rig root's pose and twist) at ``t`` s; its velocity is predicted to first order.
        """
        raise NotImplementedError

    def added_inertia(self, t: float, state: State) -> Array | None:
        """Added mass (d, d), kg m^2 and kg, about the body frame's origin; None: none. It resists the acceleration
        that everything together gives the body, contacts too."""
        return None

    def events(self) -> list[dict[str, Any]]:
        """What happened so far that clip and report should tell: ``{"time": s, "kind": ..., ...}``, in order."""
        return []


class Nothing(Environment):
    """Empty space about a vehicle on a group of dimension ``size``."""

    def __init__(self, size: int):
        self._size = size

    def wrench(self, t: float, state: State, controls: Array) -> Array:
        return np.zeros(self._size)


class Surroundings(Environment):
    """Several environments as one: wrenches and added masses add up, the shortest step rules."""

    def __init__(self, parts: Sequence[Environment]):
        self.parts = tuple(parts)
        self.max_step = min((part.max_step for part in self.parts), default=np.inf)

    @property
    def next_step(self) -> float:  # type: ignore[override]
        return min((part.next_step for part in self.parts), default=np.inf)

    def wrench(self, t: float, state: State, controls: Array) -> Array:
        return np.sum([part.wrench(t, state, controls) for part in self.parts], axis=0)

    def added_inertia(self, t: float, state: State) -> Array | None:
        added = [a for part in self.parts if (a := part.added_inertia(t, state)) is not None]
        return np.sum(added, axis=0) if added else None

    def events(self) -> list[dict[str, Any]]:
        return sorted((event for part in self.parts for event in part.events()), key=lambda event: event["time"])
