"""How long work reports what it does."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

Progress = Callable[[str, float], None]
"""Called with a description of the work and the fraction done, 0 to 1."""


def silent(what: str, done: float) -> None:
    """Ignore progress."""


@dataclass(frozen=True)
class Watching:
    """Progress that is also shown the motion at each iteration of a solver.

    ``show`` receives the vehicle's name and a function that makes the motion, a `Clip`, because not every one is
    drawn.
    """

    tell: Progress
    show: Callable[[str, Callable[[], Any]], None]

    def __call__(self, what: str, done: float) -> None:
        self.tell(what, done)


def told_as(name: str, progress: Progress, tell: Progress) -> Progress:
    """``tell`` in place of ``progress``, which is still shown motion, as that of the vehicle ``name``."""
    if not isinstance(progress, Watching):
        return tell
    return Watching(tell, lambda _, motion: progress.show(name, motion))
