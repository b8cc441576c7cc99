"""What a time limit allows: when solving has to stop so that certifying is done in time, and what can still begin."""

from __future__ import annotations

import math
import time
from collections.abc import Callable

Progress = Callable[[str, float], None]

MORE = 1.5
"""What is kept for certifying a plan, times what its initial guess took."""


class OutOfTime(Exception):
    """There is no time left for what it names."""


class Deadline:
    """An ``end`` on `time.monotonic`'s clock, s, and what was measured on the way to it."""

    def __init__(self, end: float = math.inf) -> None:
        self.end = end
        self.kept = 0.0
        """What certifying is expected to take, s."""
        self.guessed = 0.0
        """What the initial guess took, certified and all, s."""
        self.a_node = 0.0
        """What the last solve took, built and all, s a node."""
        self.over = False
        """A solver was stopped."""
        self.cut = False
        """Something was not begun for want of time."""

    @property
    def solving(self) -> float:
        """When solving has to stop, on `time.monotonic`'s clock, s."""
        return self.end - self.kept

    @property
    def late(self) -> bool:
        """No time is left to solve anything more."""
        return self.over or time.monotonic() > self.solving

    @property
    def hopeless(self) -> bool:
        """No time is left to build a problem, which cannot be stopped: that takes half as long as the initial guess."""
        return self.late or time.monotonic() + self.guessed / 2 > self.solving

    def watched(self, progress: Progress | None) -> Progress:
        """``progress``, which raises `OutOfTime` where it is told anything after the end."""

        def tell(text: str, fraction: float) -> None:
            if time.monotonic() > self.end:
                raise OutOfTime(text)
            if progress is not None:
                progress(text, fraction)

        return tell

    def rehearse(self, finish: Callable[[], object], times: float = MORE) -> None:
        """Learn how long it takes to ``finish``: so many ``times`` that is kept, beside what is kept already."""
        began = time.monotonic()
        finish()
        self.kept += times * (time.monotonic() - began)

    def solved(self, began: float, nodes: int, over: bool) -> None:
        """A solve over ``nodes`` that was built from ``began`` on is done, or was stopped when time was ``over``."""
        self.a_node, self.over = (time.monotonic() - began) / nodes, self.over or over

    def allows(self, nodes: int) -> bool:
        """Whether it is worth beginning a solve over ``nodes`` from a solved motion: that takes half as long, a node.

        What is begun too late is lost, and while it builds it cannot be stopped.
        """
        fits = not self.late and time.monotonic() + self.a_node * nodes / 2 <= self.solving
        self.cut |= not fits
        return fits
