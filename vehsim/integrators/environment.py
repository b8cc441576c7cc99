"""The interface through which a world acts on a vehicle during integration.

An environment returns a wrench as a function of time, state and controls, independent of steps;
`vehsim.integrators.forced` applies it to second order.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from vehsim.integrators.carried import carried, carry_on
from vehsim.vehicles.definition.base import State

Array = NDArray[np.float64]


class Environment:
    """Base class of everything that acts on a vehicle from outside. An instance belongs to one vehicle in one world.

    ``max_step`` s: the longest permitted integration step; simulation takes substeps if necessary. ``next_step`` s: the
    longest step from the last evaluated state, for short events such as contact. In that state, ``settled``: whether
    contact held the vehicle still; ``free``: whether it touched nothing, and cannot within a step; ``steady``: whether
    it was free and hardly moved, and nothing around it changes with time. ``CARRIED``: attributes that an evaluation
    leaves for later ones.
    """

    CARRIED: ClassVar[tuple[str, ...]] = ()
    max_step: float = np.inf
    next_step: float = np.inf
    settled: bool = False
    free: bool = False
    steady: bool = False

    def wrench(self, t: float, state: State, controls: Array) -> Array:
        """Wrench (d,) in body axes about the body frame's origin, torque [N m] then force [N] (SE(2): yaw, x, y).

        ``state`` is public (the rig root's pose and twist) at ``t`` s; its velocity is predicted to first order.
        """
        raise NotImplementedError

    def added_inertia(self, t: float, state: State) -> Array | None:
        """Added mass (d, d), kg m^2 and kg, about the body frame's origin; None: no added mass. It resists the
        acceleration by all forces together, including contacts."""
        return None

    def holds(self, change: Array) -> bool:
        """Whether a further wrench (d,) leaves the vehicle at rest, if it was `settled`."""
        return False

    def balances(self, acceleration: Array) -> bool:
        """Whether a vehicle that was `steady` stays where it is: it has hardly an ``acceleration`` (6,), and would come
        back if it were moved."""
        return False

    def events(self) -> list[dict[str, Any]]:
        """Events so far, for clip and report: ``{"time": s, "kind": ..., ...}``, in order."""
        return []

    def memory(self) -> Any:
        """What earlier evaluations left for later ones, as plain data."""
        return carried(self)

    def recall(self, memory: Any) -> None:
        """Continue from the `memory` of another environment of the same vehicle and world."""
        carry_on(self, memory)


class Nothing(Environment):
    """Empty space around a vehicle on a group of dimension ``size``."""

    def __init__(self, size: int):
        self._size = size

    def wrench(self, t: float, state: State, controls: Array) -> Array:
        return np.zeros(self._size)


SPACING = 1 / 7
"""Time between two evaluations of a `Spaced` environment, over its own longest step."""


class Spaced(Environment):
    """A smooth environment beside contact, whose steps are far shorter than it needs, such as water.

    It is evaluated every `SPACING` of its own longest step; in between, its wrench and added mass continue linearly, so
    that the order of integration stays. Longer steps, and steps that do not advance, evaluate it as usual.
    """

    CARRIED = ("_time", "_due", "_now", "_rate")

    def __init__(self, part: Environment):
        self.part, self.max_step = part, part.max_step
        self._time, self._due = np.inf, -np.inf
        self._now: tuple[Array, Array | None] = np.zeros(0), None
        self._rate: tuple[Array, Array | None] = self._now

    @property
    def next_step(self) -> float:  # type: ignore[override]  # an attribute of `Environment`
        return self.part.next_step

    @property
    def settled(self) -> bool:  # type: ignore[override]  # the same
        return self.part.settled

    @property
    def free(self) -> bool:  # type: ignore[override]  # the same
        return self.part.free

    @property
    def steady(self) -> bool:  # type: ignore[override]  # the same
        return self.part.steady

    def balances(self, acceleration: Array) -> bool:
        return self.part.balances(acceleration)

    def wrench(self, t: float, state: State, controls: Array) -> Array:
        if not self._time < t < self._due:
            self._evaluate(t, state, controls)
        return self._now[0] + (t - self._time) * self._rate[0]

    def added_inertia(self, t: float, state: State) -> Array | None:
        added, rate = self._now[1], self._rate[1]
        return added if added is None or rate is None else added + (t - self._time) * rate

    def events(self) -> list[dict[str, Any]]:
        return self.part.events()

    def memory(self) -> Any:
        return {"own": carried(self), "part": self.part.memory()}

    def recall(self, memory: Any) -> None:
        carry_on(self, memory["own"])
        self.part.recall(memory["part"])

    def _evaluate(self, t: float, state: State, controls: Array) -> None:
        elapsed, (before, added_before) = t - self._time, self._now
        wrench = np.asarray(self.part.wrench(t, state, controls), float)
        added = self.part.added_inertia(t, state)
        self._time, self._now = t, (wrench, added)
        self._due = t + SPACING * min(self.part.max_step, self.part.next_step)
        if not 0 < elapsed < np.inf:
            self._rate = np.zeros_like(wrench), None
        elif added is None or added_before is None:
            self._rate = (wrench - before) / elapsed, None
        else:
            self._rate = (wrench - before) / elapsed, (added - added_before) / elapsed


class Combined(Environment):
    """Several environments as one: wrenches and added masses add up; the shortest step applies."""

    def __init__(self, parts: Sequence[Environment]):
        self.parts = tuple(parts)
        self.max_step = min((part.max_step for part in self.parts), default=np.inf)

    @property
    def next_step(self) -> float:  # type: ignore[override]  # the same
        return min((part.next_step for part in self.parts), default=np.inf)

    @property
    def settled(self) -> bool:  # type: ignore[override]  # the same
        return any(part.settled for part in self.parts)

    @property
    def free(self) -> bool:  # type: ignore[override]  # the same
        return all(part.free for part in self.parts)

    @property
    def steady(self) -> bool:  # type: ignore[override]  # the same
        return self.free and any(part.steady for part in self.parts)

    def balances(self, acceleration: Array) -> bool:
        return any(part.balances(acceleration) for part in self.parts)

    def holds(self, change: Array) -> bool:
        return any(part.holds(change) for part in self.parts)

    def wrench(self, t: float, state: State, controls: Array) -> Array:
        return np.sum([part.wrench(t, state, controls) for part in self.parts], axis=0)

    def added_inertia(self, t: float, state: State) -> Array | None:
        added = [a for part in self.parts if (a := part.added_inertia(t, state)) is not None]
        return np.sum(added, axis=0) if added else None

    def events(self) -> list[dict[str, Any]]:
        return sorted((event for part in self.parts for event in part.events()), key=lambda event: event["time"])

    def memory(self) -> Any:
        return [part.memory() for part in self.parts]

    def recall(self, memory: Any) -> None:
        for part, own in zip(self.parts, memory, strict=True):
            part.recall(own)
