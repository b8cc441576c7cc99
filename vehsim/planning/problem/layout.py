"""The layout of a plan's variable vector."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class Layout:
    """The layout of the variable vector: ``legs``: the number of segments of each leg; ``order``: that of their
    equations of motion, 2 (`Transcription.variational`) or 4 (`vehsim.planning.problem.simpson`)."""

    sizes: tuple[int, int, int, int]
    legs: tuple[int, ...]
    order: int = 2

    @property
    def segments(self) -> int:
        return sum(self.legs)

    @property
    def knots(self) -> int:
        return self.segments + 1

    @property
    def state(self) -> int:
        return self.sizes[0] + self.sizes[1] + self.sizes[2]

    @property
    def size(self) -> int:
        return self._durations + len(self.legs)

    @property
    def _velocities(self) -> int:
        return self.knots * self.state

    @property
    def _controls(self) -> int:
        return self._velocities + self.segments * self.sizes[2]

    @property
    def _durations(self) -> int:
        return self._controls + self.knots * self.sizes[3]

    def knot(self, k: Any) -> NDArray[np.intp]:
        """Indices (state, count) of the states at knots ``k``."""
        return np.arange(self.state)[:, None] + self.state * np.atleast_1d(k)

    def velocity(self, k: Any) -> NDArray[np.intp]:
        return self._velocities + np.arange(self.sizes[2])[:, None] + self.sizes[2] * np.atleast_1d(k)

    def control(self, k: Any) -> NDArray[np.intp]:
        return self._controls + np.arange(self.sizes[3])[:, None] + self.sizes[3] * np.atleast_1d(k)

    def duration(self, segment: Any) -> NDArray[np.intp]:
        """Index (1, count) of the duration of segments ``segment``."""
        leg = np.repeat(np.arange(len(self.legs)), self.legs)
        return self._durations + leg[np.atleast_1d(segment)][None]

    def segment(self, k: Any) -> NDArray[np.intp]:
        """Indices of all variables of segments ``k``: (x, x1, c0, c1, h)."""
        ends = [self.knot(k), self.knot(k + 1), self.control(k), self.control(k + 1)]
        return np.vstack([*ends, self.duration(k)])

    @property
    def lengths(self) -> NDArray[np.intp]:
        """Indices (legs,) of the segment durations."""
        return self._durations + np.arange(len(self.legs))

    def instants(self, variables: Any) -> NDArray[np.float64]:
        """Times of variables (n,) of states, velocities or controls, in legs since the start; zero for durations."""
        places = np.asarray(variables)
        knot = np.zeros(len(places), np.intp)
        for first, last, width in (
            (0, self._velocities, self.state),
            (self._velocities, self._controls, self.sizes[2]),
            (self._controls, self._durations, self.sizes[3]),
        ):
            inside = (first <= places) & (places < last)
            knot[inside] = (places[inside] - first) // max(width, 1)
        return np.interp(knot, self.mark_knots, np.arange(len(self.mark_knots)))

    @property
    def mark_knots(self) -> NDArray[np.intp]:
        """Knot of every mark."""
        return np.concatenate([[0], np.cumsum(self.legs)]).astype(np.intp)
