"""How long work reports what it does."""

from __future__ import annotations

from collections.abc import Callable

Progress = Callable[[str, float], None]
"""Called with a description of the work and the fraction done, 0 to 1."""


def silent(what: str, done: float) -> None:
    """Ignore progress."""
