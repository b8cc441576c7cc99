"""Bodies at rest: while contact or still water holds them and nothing changes, no step is integrated."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from vehsim.vehicles.definition.base import Array

Mask = NDArray[np.bool_]

CALM = 0.25
"""Time for which bodies are held still before they rest, s."""
LOOK = 1 / 60
"""Time between two looks at what acts on a body that rests, s; with longer steps, every step."""
CHANGE = 1e-3
"""Change of a wrench, as a share of it, that does not wake them without further thought."""


class RestingBody(Protocol):
    """A body that can rest, such as `vehsim.integrators.forced.Forced`."""

    integrator: Any
    controls: Array

    @property
    def steady(self) -> bool:
        """Whether it hardly moves, and its surroundings do not change."""

    def balanced(self) -> bool:
        """Whether it stays so, by itself."""

    def stop(self) -> None: ...

    def wait(self, seconds: float) -> None: ...

    def start_with(self, wrench: Array, added: Array | None = None) -> None: ...


class Holding(Protocol):
    """What holds the bodies: ``settled`` says of each whether it is held still, ``free`` whether it neither touches
    anything nor can within a step, ``islands`` which ones lean on each other: those with equal numbers. ``asleep``:
    those that rest, which it need not look at again."""

    asleep: Sequence[bool]

    @property
    def settled(self) -> Sequence[bool]: ...

    @property
    def free(self) -> Sequence[bool]: ...

    @property
    def islands(self) -> Sequence[int]: ...

    def holds(self, changes: Sequence[Array]) -> Sequence[bool]:
        """Whether further wrenches (d,) leave each of them at rest, if it was settled."""


class Rest:
    """The rest of ``bodies``. Those that lean on each other rest together, while others move.

    ``query(which)``: the wrench and added mass on some of the bodies, where they are; ``meet()``: to be called before
    that if one of them has changed its motion.
    """

    CARRIED = ("asleep", "_calm", "_balance", "_unseen")

    def __init__(
        self,
        bodies: Sequence[RestingBody],
        holding: Holding,
        query: Callable[[Sequence[int]], list[tuple[Array, Array | None]]],
        meet: Callable[[], None] = lambda: None,
    ) -> None:
        self._bodies, self._holding, self._query, self._meet = bodies, holding, query, meet
        self.asleep = np.zeros(len(bodies), bool)
        self._calm = np.zeros(len(bodies))
        self._balance: dict[int, Array] = {}
        self._unseen = 0.0

    def begin(self, controls: Sequence[tuple[Array, Array]], seconds: float) -> Mask:
        """Which bodies (n,) rest for the next ``seconds``, whose ``controls`` start and end as given. New controls wake
        them."""
        same = [
            np.array_equal(start, end) and np.array_equal(start, body.controls) and not body.integrator.vehicle.joints
            for body, (start, end) in zip(self._bodies, controls, strict=True)
        ]
        ready = self._together(np.logical_and(same, self._held()))
        self._calm = np.where(ready, self._calm + seconds, 0.0)
        for k in map(int, np.flatnonzero(~self.asleep & (self._calm >= CALM))):
            if not self._holding.settled[k] and not self._bodies[k].balanced():
                self._calm[k] = 0.0
        self._rest(ready & self._together(self.asleep | (self._calm >= CALM)))
        self._unseen += seconds
        return self.asleep

    def wake_touched(self) -> list[int]:
        """Wake those on which a body that moves has come to lean, and return them."""
        if self.asleep.any() and not self.asleep.all():
            woken = np.flatnonzero(self.asleep & ~self._together(self.asleep))
            self._wake(woken)
            return [int(k) for k in woken]
        return []

    def end(self) -> None:
        """After their time has passed: wake those whose wrench is no longer balanced."""
        which = [int(k) for k in np.flatnonzero(self.asleep)]
        if not which or self._unseen < LOOK * (1 - 1e-9):
            return
        self._unseen = 0.0
        now, changes = self._query(which), [np.zeros_like(self._balance[which[0]]) for _ in self._bodies]
        fine = self.asleep & self._held()
        slight = fine.copy()
        for k, (wrench, _) in zip(which, now, strict=True):
            changes[k] = wrench - self._balance[k]
            slight[k] &= np.linalg.norm(changes[k]) <= CHANGE * np.linalg.norm(self._balance[k])
        if (fine & ~slight).any():
            fine &= self._together(slight) | np.asarray(self._holding.holds(changes), bool)
        woken = self.asleep & ~self._together(fine)
        self._wake(np.flatnonzero(woken))
        for k, forces in zip(which, now, strict=True):
            if woken[k]:
                self._bodies[k].start_with(*forces)

    def _held(self) -> Mask:
        """Which bodies (n,) contact holds still, or float freely and hardly move."""
        steady = [free and body.steady for body, free in zip(self._bodies, self._holding.free, strict=True)]
        return np.logical_or(self._holding.settled, steady)

    def _rest(self, asleep: Mask) -> None:
        """Let these rest."""
        new = [int(k) for k in np.flatnonzero(asleep & ~self.asleep)]
        if new:
            for k in new:
                self._bodies[k].stop()
            self._meet()
            self._balance |= {k: wrench for k, (wrench, _) in zip(new, self._query(new), strict=True)}
        self.asleep = asleep
        self._holding.asleep = asleep.tolist()

    def _wake(self, which: NDArray[np.intp]) -> None:
        self._calm[which] = 0.0
        self.asleep = self.asleep.copy()
        self.asleep[which] = False
        self._holding.asleep = self.asleep.tolist()

    def _together(self, each: Mask) -> Mask:
        """Of each body (n,), whether ``each`` holds for all that lean on each other."""
        islands = np.asarray(self._holding.islands)
        return np.asarray(~(np.equal.outer(islands, islands) & ~each).any(axis=1))
