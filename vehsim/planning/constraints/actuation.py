"""Actuators: controls within their largest rates, and their commands within the bounds of the controls.

In a segment a control changes linearly, at one rate. The command that it follows with its lag is the control plus the
lag times this rate; it is farthest out at the end of the segment (see `vehsim.vehicles.definition.actuator`).
"""

from __future__ import annotations

from collections.abc import Hashable, Iterator
from dataclasses import dataclass, replace
from typing import Any

import casadi as ca
import numpy as np

from vehsim.planning.constraints.block import Block
from vehsim.planning.problem.elements import Element, NonlinearProgram, Use
from vehsim.planning.problem.layout import Layout
from vehsim.planning.problem.transcription import Transcription
from vehsim.planning.trajectory import Trajectory

NEAR = 1e-6
"""By how much a motion may violate a row, which is scaled to one, before the rows become active."""


@dataclass(frozen=True, eq=False)
class Actuation(Block):
    """Two rows per segment and actuator: the control's rate, and its command.

    They become active once a motion violates them: what a careful driver does is far within what the machine can do.
    """

    continues = True
    active: bool = False

    def key(self, layout: Layout, transcription: Transcription) -> Hashable:
        return "actuation", self.active

    def add_active(self, problem: NonlinearProgram, transcription: Transcription, layout: Layout) -> None:
        if self.active:
            k = np.arange(layout.segments)
            controls = [layout.control(k), layout.control(k + 1)]
            problem.add(actuator_element(transcription), np.vstack([*controls, layout.duration(k)]))

    def violated(self, solved: Trajectory) -> Actuation:
        return self if self.active or excess(solved) <= NEAR else replace(self, active=True)

    def resume(self, earlier: Actuation, solved: Trajectory) -> Actuation:
        return replace(self, active=self.active or earlier.active)

    def describe(self, use: Use, occurrence: int, row: int, trajectory: Trajectory) -> str:
        frame = trajectory.seconds()[occurrence] * float(trajectory.request.fps)
        return f"{use.element.labels[row]} at frame {frame:.0f}"


def excess(trajectory: Trajectory) -> float:
    """By how much a trajectory violates the rows at most."""
    layout, k = trajectory.layout, np.arange(trajectory.layout.segments)
    first, last, h = (trajectory.x[rows] for rows in (layout.control(k), layout.control(k + 1), layout.duration(k)))
    rows = _rows(trajectory.transcription, first, last, h[0])
    return max((float(np.maximum(value - upper, lower - value).max()) for _, value, lower, upper in rows), default=0.0)


def actuator_element(transcription: Transcription) -> Element:
    """The rows of a segment: (c0, c1, h)."""

    def make() -> Element:
        v = transcription.symbols("c0", "c1", "h")
        labels, values, lower, upper = zip(*_rows(transcription, **v), strict=True)
        y, g = ca.vertcat(*v.values()), ca.vertcat(*values)
        return Element("actuators", y, g=g, lower=lower, upper=upper, labels=labels)

    return transcription.kept("actuators", make)


def _rows(transcription: Transcription, c0: Any, c1: Any, h: Any) -> Iterator[tuple[str, Any, float, float]]:
    """Label, value and bounds of every row of a segment of ``h`` s from controls ``c0`` to ``c1`` over their scale."""
    for k, control in enumerate(transcription.vehicle.controls):
        rate = (c1[k] - c0[k]) / h
        if np.isfinite(fastest := control.actuator.rate / control.scale):
            yield f"the rate of {control.name}", rate / fastest, -1.0, 1.0
        if (lag := control.actuator.lag) and np.isfinite([control.lower, control.upper]).any():
            low, high = control.lower / control.scale, control.upper / control.scale
            yield f"the command of {control.name}", c1[k] + lag * rate, low, high
