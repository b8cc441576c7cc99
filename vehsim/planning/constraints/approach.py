"""Landing and take-off at knots: stay inside a cone above the mark, descend gently, and slide or turn little."""

from __future__ import annotations

from collections.abc import Hashable, Sequence
from dataclasses import dataclass

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from vehsim.lie import SO3
from vehsim.planning.constraints.block import Block
from vehsim.planning.problem.elements import Element, NonlinearProgram
from vehsim.planning.problem.layout import Layout
from vehsim.planning.problem.stage import knot_view
from vehsim.planning.problem.transcription import Transcription
from vehsim.planning.request.landing import GENTLE, SINK, attitude, landing_clearance, rounded_distance
from vehsim.planning.request.marks import Mark, end_of_hold
from vehsim.world.ground.touchdown import feet

Array = NDArray[np.float64]

FALL, NEAR = 1.0, 4.0
"""Cost per second of descending at 1 m/s at the landing, and the distance over which it falls to 1/e, m. It keeps the
descent speed off its bound, along which controls would chatter."""
SLIDE, LOW = 100.0, 0.7
"""Cost per second of feet that move at 1 m/s over the ground, and the height, m, over which it falls to 1/e: pilots
hover over the place first, and then come down."""
FADE = 10.0
"""Distance from a landing, m, at which its cone is halved: there the vehicle may be as much below the mark."""


@dataclass(frozen=True, eq=False)
class Landing(Block):
    """The approach to and departure from mark ``number``.

    The mark's position is a parameter of its `mark_constraints.MarkConstraint`, and the requested clearance one of
    `clearance.Clearance`.
    """

    marks: Sequence[Mark]
    number: int

    def key(self, layout: Layout, transcription: Transcription) -> Hashable:
        return "landing", self.number, tuple(attitude(self.marks[self.number]))

    def add(self, problem: NonlinearProgram, transcription: Transcription, layout: Layout) -> None:
        knot, leaves = layout.mark_knots[[self.number, end_of_hold(self.marks, self.number)]]
        beside = np.concatenate([np.arange(1, knot), np.arange(leaves + 1, layout.segments)])
        if len(beside):
            element = landing_element(transcription, attitude(self.marks[self.number]))
            y = np.vstack([layout.knot(beside), layout.duration(beside - 1)])
            problem.add(element, y, {"place": problem.parameter(f"mark[{self.number}].position", 3)})


def landing_element(transcription: Transcription, upright: Array) -> Element:
    """The constraint and cost of a landing vehicle at a knot: inside the cone above the landing, gently down: (x, h).

    ``upright`` (4,): its attitude at the mark. Parameters: the requested ``clearance`` farther away, and the ``place``
    (3,).
    """
    v = transcription.symbols("x", "h")
    clearance, place = ca.SX.sym("clearance"), ca.SX.sym("place", 3)
    view = knot_view(transcription, v["x"], ca.SX.zeros(transcription.sizes[3]))
    distance = rounded_distance(view.position, place)
    counts = 1 / (1 + (distance / FADE) ** 4)
    above = landing_clearance(distance, clearance, 0.0, ca.tanh)
    below = feet(transcription.vehicle)
    flat = below @ SO3.matrix(upright).T
    offsets = ca.DM(below.T)
    arms = view.rotation @ offsets
    rise = (arms[2, :] - ca.DM(flat[:, 2]).T + view.position[2] - place[2]).T
    slide = (ca.repmat(view.velocity, 1, len(below)) + view.rotation @ ca.skew(view.omega) @ offsets)[:2, :]
    down = view.velocity[2] + GENTLE + SINK * distance
    g = ca.vertcat(counts * (rise - above) + (1 - counts) * FADE, down)
    near = ca.exp(-((distance / NEAR) ** 2))
    low = ca.exp(-((ca.sum1(rise) / len(below) / LOW) ** 2))
    cost = v["h"] * near * (FALL * view.velocity[2] ** 2 + SLIDE * low * ca.sumsqr(slide) / len(below))
    parameters = {"clearance": clearance, "place": place}
    return Element("landing", ca.vertcat(*v.values()), parameters, f=cost, g=g, lower=0.0, upper=np.inf)
