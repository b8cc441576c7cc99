"""The layout of a plan's variable vector."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vehsim.integrators.composition import COMPOSITIONS

WHOLE = 4
"""The order at which a segment is whole (`vehsim.planning.problem.simpson`); others are compositions of substeps."""


@dataclass(frozen=True)
class Layout:
    """The layout of the variable vector: ``legs``: the number of segments of each leg, at ``order``."""

    sizes: tuple[int, int, int, int]
    legs: tuple[int, ...]
    order: int = 2

    @property
    def fractions(self) -> tuple[float, ...]:
        """Fractions of a segment of its parts, which have a node each."""
        return (1.0,) if self.order == WHOLE else COMPOSITIONS[self.order]

    @property
    def segments(self) -> int:
        return sum(self.legs)

    @property
    def nodes(self) -> int:
        return self.segments * len(self.fractions) + 1

    @property
    def state(self) -> int:
        return self.sizes[0] + self.sizes[1] + self.sizes[2]

    @property
    def size(self) -> int:
        return self._durations + len(self.legs)

    @property
    def _velocities(self) -> int:
        return self.nodes * self.state

    @property
    def _controls(self) -> int:
        return self._velocities + (self.nodes - 1) * self.sizes[2]

    @property
    def _durations(self) -> int:
        return self._controls + (self.segments + 1) * self.sizes[3]

    def node(self, k: Any) -> NDArray[np.intp]:
        """Indices (state, count) of nodes ``k``."""
        return np.arange(self.state)[:, None] + self.state * np.atleast_1d(k)

    def knot(self, k: Any) -> NDArray[np.intp]:
        """Indices (state, count) of the nodes at knots ``k``."""
        return self.node(np.atleast_1d(k) * len(self.fractions))

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
        """Times of variables (n,) of nodes, velocities or controls, in legs since the start; zero for durations."""
        places, steps = np.asarray(variables), len(self.fractions)
        node = np.zeros(len(places), np.intp)
        for first, last, width, every in (
            (0, self._velocities, self.state, 1),
            (self._velocities, self._controls, self.sizes[2], 1),
            (self._controls, self._durations, self.sizes[3], steps),
        ):
            inside = (first <= places) & (places < last)
            node[inside] = (places[inside] - first) // max(width, 1) * every
        starts = np.concatenate([[0.0], np.cumsum(self.fractions)[:-1]])
        segments = np.append((np.arange(self.segments)[:, None] + starts).ravel(), self.segments)
        return np.interp(segments[node], self.mark_knots, np.arange(len(self.mark_knots)))

    @property
    def middle(self) -> tuple[int, float]:
        """The substep whose start is nearest to the middle of a segment, and the fraction of the segment at its
        start."""
        starts = np.concatenate([[0.0], np.cumsum(self.fractions)[:-1]])
        part = int(np.argmin(np.abs(starts - 0.5)))
        return part, float(starts[part])

    @property
    def mark_knots(self) -> NDArray[np.intp]:
        """Knot of every mark."""
        return np.concatenate([[0], np.cumsum(self.legs)]).astype(np.intp)
