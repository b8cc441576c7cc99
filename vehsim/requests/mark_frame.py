"""The frame of a mark: a whole frame, or ``"free"``, which leaves the choice to the planner or the manoeuvre."""

from __future__ import annotations

from typing import Final, Literal, Protocol

FREE: Final = "free"


class _HasFrame(Protocol):
    @property
    def frame(self) -> int | Literal["free"]: ...


class Timed:
    """What has a ``frame``, `FREE` or whole: marks of plans, and the tables of marks in a shot file."""

    @property
    def given_frame(self: _HasFrame) -> int | None:
        """The whole frame; None if it is free."""
        return None if self.frame == FREE else self.frame
