"""Easing: controls change smoothly, and start and end in balance, without rates, at marks where the vehicle rests.

What slips sideways, such as a boat, begins as it would go there if nothing fixes its heading.
"""

from __future__ import annotations

from collections.abc import Hashable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from vehsim.planning.constraints.block import Block
from vehsim.planning.constraints.mark_constraints import asks_balance, imbalance
from vehsim.planning.problem.elements import Element, NonlinearProgram
from vehsim.planning.problem.layout import Layout
from vehsim.planning.problem.transcription import Transcription
from vehsim.planning.request.character import Traits, control_rates, eased
from vehsim.planning.request.marks import Mark
from vehsim.planning.terms import COSTS, BendView, costs_of, weight_of
from vehsim.planning.trajectory import Trajectory
from vehsim.vehicles.definition.mechanics import acceleration

Array = NDArray[np.float64]

REST, ABRUPT = 6e3, 0.05
"""Price of imbalance x at rest, m/s^2, and of the rates x of controls, as shares of their largest: ``REST`` x^2 /
2 up to about ``ABRUPT``, so that a thousandth remains of what the rest of the motion would gain; from there on ``REST
ABRUPT`` x, so that a motion to a mark that is too early starts and ends abruptly rather than exceed its limits
everywhere between."""


@dataclass(frozen=True, eq=False)
class Easing(Block):
    """The costs of changing rates of controls, at their ``weights`` by name, and of marks at rest.

    Where a motion eases out of a mark at rest, its controls start in balance and without rates; the same holds for its
    arrival.
    """

    weights: Mapping[str, float]
    traits: Traits
    marks: Sequence[Mark]
    under_way: bool = False
    """Whether the motion begins at speed with a free heading."""

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the costs of two consecutive segments with a weight above zero."""
        return costs_of(BendView, self.weights)

    def key(self, layout: Layout, transcription: Transcription) -> Hashable:
        ground = tuple(mark.on_ground for mark in self.marks)
        ends = tuple(eased(self.traits, self.marks))
        return "easing", self.names, ends, ground, self._rates(transcription).tobytes(), self.under_way

    def _rates(self, transcription: Transcription) -> Array:
        """The largest rates of the controls over their scale, 1/s."""
        return np.asarray(control_rates(self.traits, transcription.vehicle) / transcription.control_scale)

    def add(self, problem: NonlinearProgram, transcription: Transcription, layout: Layout) -> None:
        if not transcription.sizes[3]:
            return
        if self.names:
            k = np.arange(1, layout.segments)
            controls = [layout.control(k + i) for i in (-1, 0, 1)]
            variables = np.vstack([*controls, layout.duration(k - 1), layout.duration(k)])
            problem.add(bend_element(transcription, self.names), variables)
        for i, comes, leaves in eased(self.traits, self.marks):
            knot = layout.mark_knots[i]
            element = rest_element(transcription, self.names, self._rates(transcription), self.traits.price)
            for side, there in ((-1, comes), (1, leaves)):
                if there:
                    segment = knot - 1 if side < 0 else knot
                    here = [layout.control(knot), layout.control(knot + side), layout.duration(segment)]
                    problem.add(element, np.vstack(here))
            held = i > 0 and self.marks[i - 1].hold
            if not (asks_balance(transcription.vehicle, self.marks[i]) or held):
                element = balance_element(transcription, self.traits.price, self.marks[i].on_ground)
                problem.add(element, np.vstack([layout.knot(knot), layout.control(knot)]))
        if self.under_way and slides(transcription):
            first = np.vstack([layout.knot(0), layout.control(0)])
            problem.add(steady_element(transcription, self.traits.price), first)

    def values(self, trajectory: Trajectory) -> Mapping[str, Any]:
        return {weight_of(name): self.weights[name] for name in self.names}


def bend_element(transcription: Transcription, names: tuple[str, ...]) -> Element:
    """The weighted costs of two consecutive segments: (c0, c1, c2, h0, h1)."""

    def make() -> Element:
        size = transcription.sizes[3]
        c, h = [ca.SX.sym(f"c{i}", size) for i in range(3)], [ca.SX.sym(f"h{i}") for i in range(2)]
        f, parameters = _weighted(names, BendView(*c, *h))
        return Element("easing", ca.vertcat(*c, *h), parameters, f=f)

    return transcription.kept(("easing", *names), make)


def rest_element(transcription: Transcription, names: tuple[str, ...], rates: Array, price: float) -> Element:
    """The costs of a segment that starts or ends at rest, and of the controls' rates there: (c at rest, c, h)."""

    def make() -> Element:
        size = transcription.sizes[3]
        rest, c, h = ca.SX.sym("rest", size), ca.SX.sym("c", size), ca.SX.sym("h")
        f, parameters = _weighted(names, BendView(rest, rest, c, h, h))
        f += price * _abrupt((c - rest) / (h * rates))
        return Element("ease", ca.vertcat(rest, c, h), parameters, f=f)

    return transcription.kept(("ease", *names, rates.tobytes(), price), make)


def balance_element(transcription: Transcription, price: float, on_ground: bool = False) -> Element:
    """The cost of imbalance of a vehicle at rest: (x, c).

    On the ground, friction bears forces to the side: a level helicopter cannot balance the push of its tail rotor.
    """

    def make() -> Element:
        v = transcription.symbols("x", "c0")
        off = imbalance(transcription, v["x"], v["c0"])
        f = price * _abrupt(ca.vertcat(off[:3], off[5]) if on_ground and off.shape[0] == 6 else off)
        space = transcription.space(transcription.split(v["x"])[0])
        return Element("balance", ca.vertcat(*v.values()), transcription.air, f=f, space=space)

    return transcription.kept(("balance", price, on_ground), make)


def slides(transcription: Transcription) -> bool:
    """Whether a vehicle in the plane can move and turn in any direction, as boats and cars on tyres can."""
    vehicle = transcription.vehicle
    return vehicle.group.name == "SE2" and transcription.sizes[2] - len(vehicle.dynamic) == vehicle.group.dim


def steady_element(transcription: Transcription, price: float) -> Element:
    """The cost of accelerations sideways, in body axes, and in yaw: (x, c).

    They vanish in a steady bend. A motion with a free heading would otherwise begin with a slide, on which the water or
    the road then pushes it to its next mark.
    """

    def make() -> Element:
        v = transcription.symbols("x", "c0")
        vehicle = transcription.local_in_air[1]
        g, r, pi = transcription.split(v["x"])
        controls = v["c0"] * transcription.control_scale
        z = transcription.mechanics.knot_velocity_guess(r, pi, controls)
        still = ca.SX.zeros(controls.shape[0])
        rates = acceleration(vehicle, g, r, z, controls, still, transcription.air["wind"])
        f = price * _abrupt(ca.vertcat(rates[0], rates[2]))
        return Element("steady", ca.vertcat(*v.values()), transcription.air, f=f, space=transcription.space(g))

    return transcription.kept(("steady", price), make)


def _abrupt(values: Any) -> Any:
    """The price of values that should be zero at rest: quadratic for small ones, linear for large ones."""
    return REST * ABRUPT**2 * ca.sum1(ca.sqrt(1 + (values / ABRUPT) ** 2) - 1)


def _weighted(names: tuple[str, ...], view: BendView) -> tuple[Any, dict[str, Any]]:
    """The sum of the costs ``names``, and the parameters that are their weights."""
    parameters = {weight_of(name): ca.SX.sym(name) for name in names}
    return sum((parameters[weight_of(n)] * COSTS[n](view) for n in names), ca.SX(0)), parameters
