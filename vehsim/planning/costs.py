"""The cost of a plan: the weighted laws of `terms.COSTS` and the user's own costs, as blocks of the problem."""

from __future__ import annotations

from collections.abc import Hashable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from vehsim.planning.constraints.block import Block
from vehsim.planning.constraints.terms import add_term
from vehsim.planning.problem.elements import Element, NonlinearProgram
from vehsim.planning.problem.layout import Layout
from vehsim.planning.problem.stage import segment_view
from vehsim.planning.problem.transcription import Transcription
from vehsim.planning.request.legs import knots_within
from vehsim.planning.request.marks import Mark
from vehsim.planning.terms import COSTS, Constraint, Cost, SegmentView, costs_of, weight_of
from vehsim.planning.trajectory import Trajectory


@dataclass(frozen=True, eq=False)
class RunningCosts(Block):
    """The costs of every segment, at their ``weights`` by name; ``aims``: constraints that set the heading."""

    weights: Mapping[str, float]
    aims: Sequence[Constraint]
    marks: Sequence[Mark]

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the costs per segment with a weight above zero."""
        return costs_of(SegmentView, self.weights)

    def key(self, layout: Layout, transcription: Transcription) -> Hashable:
        return "costs", self.names, self._aimed(layout).tobytes()

    def _aimed(self, layout: Layout) -> NDArray[np.bool_]:
        """Segments (n,) on which a constraint sets the heading."""
        aimed = np.zeros(layout.segments, bool)
        for term in self.aims:
            first, last = knots_within(self.marks, layout.mark_knots, term.frames)
            aimed[first:last] = True
        return aimed

    def add(self, problem: NonlinearProgram, transcription: Transcription, layout: Layout) -> None:
        aimed, names = self._aimed(layout), self.names
        # `course` does not apply where a constraint sets the heading
        without = tuple(name for name in names if name != "course")
        for some, segments in ((names, np.flatnonzero(~aimed)), (without, np.flatnonzero(aimed))):
            if len(segments) and some:
                problem.add(cost_element(transcription, some), layout.segment(segments))

    def values(self, trajectory: Trajectory) -> Mapping[str, Any]:
        return {weight_of(name): self.weights[name] for name in self.names}


def cost_element(transcription: Transcription, names: tuple[str, ...]) -> Element:
    """The weighted costs of one segment: (x, x1, c0, c1, h)."""

    def make() -> Element:
        v = transcription.symbols("x", "x1", "c0", "c1", "h")
        view, weights = segment_view(transcription, v), ca.SX.sym("weights", len(names))
        total = ca.dot(weights, ca.vertcat(*(COSTS[name](view) for name in names)))
        parameters = {weight_of(name): weights[i] for i, name in enumerate(names)}
        return Element("cost", ca.vertcat(*v.values()), parameters, f=total)

    return transcription.kept(("cost", *names), make)


@dataclass(frozen=True, eq=False)
class OwnCost(Block):
    """A user's cost, within its range of frames."""

    cost: Cost
    marks: Sequence[Mark]

    def key(self, layout: Layout, transcription: Transcription) -> Hashable:
        return self.cost, knots_within(self.marks, layout.mark_knots, self.cost.frames)

    def add(self, problem: NonlinearProgram, transcription: Transcription, layout: Layout) -> None:
        first, last = knots_within(self.marks, layout.mark_knots, self.cost.frames)
        add_term(problem, transcription, layout, self.cost, "segment", np.arange(first, last))
