"""The cost of a plan: the weighted laws of `terms.COSTS` and the user's own costs, as blocks of the problem."""

from __future__ import annotations

from collections.abc import Hashable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from vehsim.planning.constraints.block import Block
from vehsim.planning.constraints.path_constraints import add_term
from vehsim.planning.problem.elements import Element, NonlinearProgram
from vehsim.planning.problem.layout import Layout
from vehsim.planning.problem.stage import segment_view
from vehsim.planning.problem.transcription import Transcription
from vehsim.planning.request.legs import knots_within
from vehsim.planning.request.marks import Mark, given_frames
from vehsim.planning.terms import (
    COSTS,
    LIMITS,
    UNTIMED,
    Constraint,
    Cost,
    SegmentView,
    costs_of,
    positive,
    weight_of,
)
from vehsim.planning.trajectory import Trajectory


@dataclass(frozen=True, eq=False)
class RunningCosts(Block):
    """The costs of every segment, at their ``weights`` by name; ``aims``: constraints that set the heading."""

    weights: Mapping[str, float]
    aims: Sequence[Constraint]
    marks: Sequence[Mark]
    limits: Mapping[str, float] = field(default_factory=dict)
    """Soft limits by name, SI: exceeding them has a price."""
    control_rates: Mapping[str, float] = field(default_factory=dict)
    """Soft limits of the rates of controls, by control name."""
    price: float = 1.0
    restrained: bool = False
    """Whether the soft limits are active: a motion is found without them first, because most initial guesses exceed
    them."""

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the costs per segment with a weight above zero."""
        return costs_of(SegmentView, self.weights)

    def key(self, layout: Layout, transcription: Transcription) -> Hashable:
        timed = self._timed(layout).tobytes()
        return "costs", self.names, self._exceeded, self._aimed(layout).tobytes(), timed

    @property
    def _exceeded(self) -> tuple[tuple[str, ...], tuple[str, ...]]:
        """Names of the active soft limits, and of controls with one."""
        return (tuple(self.limits), tuple(self.control_rates)) if self.restrained else ((), ())

    def _aimed(self, layout: Layout) -> NDArray[np.bool_]:
        """Segments (n,) on which a constraint sets the heading."""
        aimed = np.zeros(layout.segments, bool)
        for term in self.aims:
            first, last = knots_within(self.marks, layout.mark_knots, term.frames)
            aimed[first:last] = True
        return aimed

    def _timed(self, layout: Layout) -> NDArray[np.bool_]:
        """Segments (n,) until the last given frame; all of them if no cost has another law after it."""
        last = int(np.flatnonzero(np.isfinite(given_frames(self.marks)))[-1])
        return UNTIMED.keys().isdisjoint(self.names) | (np.arange(layout.segments) < layout.mark_knots[last])

    def add(self, problem: NonlinearProgram, transcription: Transcription, layout: Layout) -> None:
        aimed, timed, names = self._aimed(layout), self._timed(layout), self.names
        # `course` does not apply where a constraint sets the heading
        without = tuple(name for name in names if name != "course")
        for some, which in ((names, ~aimed), (without, aimed)):
            for given in (True, False):
                segments = np.flatnonzero(which & (timed == given))
                if len(segments) and some:
                    element = cost_element(transcription, some, *self._exceeded, timed=given)
                    problem.add(element, layout.segment(segments))

    def values(self, trajectory: Trajectory) -> Mapping[str, Any]:
        values: dict[str, Any] = {weight_of(name): self.weights[name] for name in self.names}
        values |= {_most(name): value for name, value in {**self.limits, **self.control_rates}.items()}
        return values | {PRICE: self.price}

    def resume(self, earlier: RunningCosts, solved: Trajectory) -> RunningCosts:
        return replace(self, restrained=earlier.restrained)


PRICE = "price of the character"
EXCESS = 100.0
"""Cost per second of exceeding a soft limit by 100 %, relative to the price of the character. Effort makes a motion
exceed it by about one per cent; marks may require more."""


def _most(name: str) -> str:
    """The parameter name of a soft limit."""
    return f"character.{name}"


def cost_element(
    transcription: Transcription,
    names: tuple[str, ...],
    limits: tuple[str, ...] = (),
    rates: tuple[str, ...] = (),
    timed: bool = True,
) -> Element:
    """The weighted costs of a segment, and of exceeding ``limits`` and control ``rates`` in it: (x, x1, c0, c1, h).

    ``timed``: whether it lies before the last given frame.
    """

    def make() -> Element:
        v = transcription.symbols("x", "x1", "c0", "c1", "h")
        inner: list[tuple[Any, Any]] = []
        view, vehicle = segment_view(transcription, v, inner=inner), transcription.vehicle
        parameters = {weight_of(name): ca.SX.sym(name) for name in names}
        laws = {name: COSTS[name] if timed or name not in UNTIMED else UNTIMED[name] for name in names}
        total = sum((parameters[weight_of(name)] * law(view) for name, law in laws.items()), ca.SX(0))
        most = {name: ca.SX.sym(name) for name in (*limits, *rates)}
        excess = ca.SX(0)
        for name in limits:
            for knot in (view.start, view.end):
                # the cubic's own acceleration would oscillate from knot to knot
                seen = replace(knot, acceleration=view.acceleration)
                excess += v["h"] / 2 * positive(LIMITS[name].law(seen) / most[name] - 1, EDGE) ** 2
        for name in rates:
            k = vehicle.control_names.index(name)
            share = (v["c1"][k] - v["c0"][k]) * transcription.control_scale[k] / (v["h"] * most[name])
            excess += v["h"] * (positive(share - 1, EDGE) ** 2 + positive(-share - 1, EDGE) ** 2)
        if most:
            parameters |= {_most(name): symbol for name, symbol in most.items()} | {PRICE: ca.SX.sym("price")}
            total += EXCESS * parameters[PRICE] * excess
        return Element("cost", ca.vertcat(*v.values()), parameters, f=total, inner=inner)

    return transcription.kept(("cost", names, limits, rates, timed), make)


EDGE = 0.03
"""Share of a limit over which its price sets in: an optimiser needs fewer steps where costs have no kinks."""


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
