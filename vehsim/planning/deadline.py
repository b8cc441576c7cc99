"""Time limits: when solving must stop so that certification finishes in time, and which steps can still start."""

from __future__ import annotations

import math
import time
from collections.abc import Callable

from vehsim.runtime.progress import Progress

MORE = 1.5
"""Safety factor: time reserved for certifying a plan, over the time that certifying its initial guess took."""


class OutOfTime(Exception):
    """The time limit is reached; the message names the step that was running."""


class Deadline:
    """An ``end`` on the clock of `time.monotonic`, s, and the durations measured before it."""

    def __init__(self, end: float = math.inf) -> None:
        self.end = end
        self.kept = 0.0
        """Time reserved for certification, s."""
        self.guessed = 0.0
        """Time that the initial guess took, including its certification, s."""
        self.a_node = 0.0
        """Time per node of the last solve, including the time to build its problem, s."""
        self.over = False
        """Whether a solver was stopped."""
        self.cut = False
        """Whether a step was skipped for lack of time."""

    @property
    def solving(self) -> float:
        """When solving must stop, on the clock of `time.monotonic`, s."""
        return self.end - self.kept

    @property
    def late(self) -> bool:
        """Whether there is no time left for another solve."""
        return self.over or time.monotonic() > self.solving

    @property
    def hopeless(self) -> bool:
        """Whether there is no time left to build a problem.

        Building cannot be interrupted; it is estimated to take half as long as the initial guess.
        """
        return self.late or time.monotonic() + self.guessed / 2 > self.solving

    def watched(self, progress: Progress | None) -> Progress:
        """A wrapper of ``progress`` that raises `OutOfTime` if it is called after the end."""

        def tell(text: str, fraction: float) -> None:
            if time.monotonic() > self.end:
                raise OutOfTime(text)
            if progress is not None:
                progress(text, fraction)

        return tell

    def rehearse(self, finish: Callable[[], object], times: float = MORE) -> None:
        """Measure how long ``finish`` takes, and add ``times`` this duration to the reserved time."""
        began = time.monotonic()
        finish()
        self.kept += times * (time.monotonic() - began)

    def solved(self, began: float, nodes: int, over: bool) -> None:
        """Record a solve over ``nodes`` nodes that started to build at ``began``; ``over``: the deadline stopped it."""
        self.a_node, self.over = (time.monotonic() - began) / nodes, self.over or over

    def allows(self, nodes: int) -> bool:
        """Whether there is time for a solve over ``nodes`` nodes from a solved motion.

        It is estimated at half the time per node of the last solve. A solve that does not finish in time is lost, and
        building it cannot be interrupted.
        """
        fits = not self.late and time.monotonic() + self.a_node * nodes / 2 <= self.solving
        self.cut |= not fits
        return fits
