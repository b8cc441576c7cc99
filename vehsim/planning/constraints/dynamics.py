"""The equations of motion: discrete mechanics of every segment, and constant states during holds."""

from __future__ import annotations

import math
from collections.abc import Hashable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from vehsim.planning.constraints.block import Block
from vehsim.planning.problem.elements import Element, NonlinearProgram, Use
from vehsim.planning.problem.layout import Layout
from vehsim.planning.problem.simpson import simpson
from vehsim.planning.problem.stage import evaluate, knot_view, segment_view
from vehsim.planning.problem.transcription import Transcription
from vehsim.planning.request.legs import held_segments
from vehsim.planning.request.marks import Mark
from vehsim.planning.request.request import Request
from vehsim.planning.terms import Cost, Term
from vehsim.planning.trajectory import Trajectory

Array = NDArray[np.float64]

ALOFT = 1e3
"""How much lower the ground below rotors lies until a first motion is found, m: from a guess, solves with it took three
times the iterations beside steps of the ground, such as a pad's."""
TURNS = 4 * np.pi
"""How far headings in the plane may be from those of the initial guess, rad. Along linearised equations, turning many
times over is a cheap way to move; without a bound, steps of the solver do so over long times. Tyres that slip resist
it themselves."""


@dataclass(frozen=True, eq=False)
class Dynamics(Block):
    """The discrete mechanics of every segment outside of holds; during holds state and controls are constant.

    Controls and joints stay within the vehicle's bounds, and without slipping tyres headings stay within `TURNS` of
    the guess. ``aloft``: rotors do not feel the ground; ``unused``: the controls that stay as near to zero as their
    bounds permit.
    """

    marks: Sequence[Mark]
    aloft: bool = True
    unused: tuple[str, ...] = ()

    def complete(self) -> Dynamics:
        return replace(self, aloft=False) if self.aloft else self

    def values(self, trajectory: Trajectory) -> Mapping[str, Any]:
        return {"depth": ALOFT if self.aloft else 0.0} if trajectory.transcription.rides_on_air else {}

    def key(self, layout: Layout, transcription: Transcription) -> Hashable:
        return "dynamics", tuple(mark.hold > 0 for mark in self.marks)

    def _segments(self, layout: Layout) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
        """Segments outside of holds, and those during holds."""
        held = held_segments(layout.legs, self.marks)
        return np.flatnonzero(~held), np.flatnonzero(held)

    def add(self, problem: NonlinearProgram, transcription: Transcription, layout: Layout) -> None:
        moving, still = self._segments(layout)
        y = [
            layout.knot(moving), layout.velocity(moving), layout.control(moving), layout.control(moving + 1),
            layout.knot(moving + 1), layout.duration(moving),
        ]  # fmt: skip
        problem.add(equations(transcription, layout.order), np.vstack(y))
        if len(still):
            state = [layout.knot(still), layout.velocity(still), layout.knot(still + 1)]
            problem.add(hold_element(transcription), np.vstack(state))
            controls = np.vstack([layout.control(still), layout.control(still + 1)])
            problem.add(held_controls_element(transcription), controls)

    def bound(self, trajectory: Trajectory, lower: Array, upper: Array) -> None:
        transcription, layout = trajectory.transcription, trajectory.layout
        knots = layout.control(np.arange(layout.knots))
        for row, control in zip(knots, transcription.vehicle.controls, strict=True):
            ends = np.array([control.lower, control.upper])
            ends = np.clip([0.0, 0.0], *ends) if control.name in self.unused else ends
            lower[row], upper[row] = ends / control.scale
        if transcription.vehicle.group.planar and math.isinf(transcription.vehicle.largest_step):
            headings = layout.knot(np.arange(layout.knots))[0]
            lower[headings], upper[headings] = trajectory.x[headings] - TURNS, trajectory.x[headings] + TURNS
        bound_joints(trajectory, transcription.vehicle.joint_limits, lower, upper)

    def describe(self, use: Use, occurrence: int, row: int, trajectory: Trajectory) -> str:
        if use.element.name != "dynamics":
            return super().describe(use, occurrence, row, trajectory)
        segment = int(self._segments(trajectory.layout)[0][occurrence])
        return f"the motion at frame {trajectory.seconds()[segment] * float(trajectory.request.fps):.0f}"


def equations(transcription: Transcription, order: int) -> Element:
    """The equations of motion of a segment of this order, 2 or 4."""
    if order == 4:
        return transcription.kept("simpson", lambda: simpson(transcription))
    return transcription.variational


def bound_joints(trajectory: Trajectory, ranges: Mapping[str, tuple[float, float]], lower: Array, upper: Array) -> None:
    """Bound joints by name at every knot."""
    transcription, layout = trajectory.transcription, trajectory.layout
    knots = layout.knot(np.arange(layout.knots))
    for joint, (low, high) in ranges.items():
        row = knots[transcription.sizes[0] + transcription.vehicle.joints.index(joint)]
        lower[row], upper[row] = np.maximum(lower[row], low), np.minimum(upper[row], high)


def hold_element(transcription: Transcription) -> Element:
    """A constant state at zero velocity: (x, z, x1).

    During a hold it replaces the mechanics. In balance, the mechanics would repeat what constant controls already
    imply. Balance itself is required once, by the mark at which the hold begins.
    """
    v = transcription.symbols("x", "z", "x1")
    return Element("hold", ca.vertcat(*v.values()), g=ca.vertcat(v["x1"] - v["x"], v["z"]))


def held_controls_element(transcription: Transcription) -> Element:
    """Constant controls: (c0, c1)."""
    v = transcription.symbols("c0", "c1")
    return Element("held controls", ca.vertcat(*v.values()), g=v["c1"] - v["c0"])


class UnitQuaternion(Block):
    """Unit norm of the first knot's quaternion, which the steps preserve; no rows if the group has no quaternion."""

    def add(self, problem: NonlinearProgram, transcription: Transcription, layout: Layout) -> None:
        group = transcription.vehicle.group
        if group.size > group.dim:
            problem.add(transcription.kept("gauge", lambda: _unit_norm(transcription)), layout.knot(0))


def _unit_norm(transcription: Transcription) -> Element:
    x = transcription.symbols("x")["x"]
    q = transcription.split(x)[0][0:4]
    return Element("gauge", x, g=ca.dot(q, q) - 1)


@dataclass(frozen=True, eq=False)
class UnconstrainedJoints(Block):
    """Fix joints that neither motion, limit, term nor mark constrains, such as a wheel's roll, at the guess's first
    value.

    A solver that is free to choose them may end up anywhere.
    """

    request: Request
    transcription: Transcription

    @cached_property
    def joints(self) -> list[int]:
        """Indices of the unconstrained joints."""
        request, transcription = self.request, self.transcription
        rows = [np.asarray(mark.joints, float) for mark in request.marks if mark.joints is not None]
        return [
            i
            for i, name in enumerate(transcription.vehicle.joints)
            if i in transcription.idle
            and name not in request.limits.joints
            and not any(np.isfinite(row[i]) for row in rows)
            and not any(_reads(transcription, term, i) for term in request.terms)
        ]

    def bound(self, trajectory: Trajectory, lower: Array, upper: Array) -> None:
        begins = trajectory.layout.knot(0)[[self.transcription.sizes[0] + joint for joint in self.joints]]
        lower[begins] = upper[begins] = trajectory.x[begins]


def _reads(transcription: Transcription, term: Term, joint: int) -> bool:
    """Whether a term's law depends on the joint."""
    v = transcription.symbols("x", "x1", "c0", "c1", "h")
    whole = isinstance(term, Cost) or term.over == "segments"
    view = segment_view(transcription, v) if whole else knot_view(transcription, v["x"], v["c0"])
    return bool(ca.depends_on(evaluate(term, view), v["x"][transcription.sizes[0] + joint]))
