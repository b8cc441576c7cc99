"""The whole problem: a vehicle's elements laid out over all segments, knots and marks, its parameters and bounds."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from vehsim.planning.elements import Element, Problem
from vehsim.planning.layout import Layout
from vehsim.planning.marks import Mark
from vehsim.planning.terms import COSTS
from vehsim.planning.transcription import MARGIN, Transcription

Array = NDArray[np.float64]


def build(
    t: Transcription,
    layout: Layout,
    marks: Sequence[Mark],
    limits: Mapping[str, float],
    cover: tuple[Any, Array, Array] | None,
    total: Sequence[tuple[Sequence[int], float]] = (),
) -> tuple[Problem, int]:
    """The whole problem and the place of the marks' parameters.

    ``cover``: distance function and sphere cover (centres, radii), or None in free space. ``total``: groups of phases
    between marks at fixed frames whose lengths must add up, with their durations in s.
    """
    steps, segments = len(layout.fractions), layout.segments
    starts = np.concatenate([[0.0], np.cumsum(layout.fractions)[:-1]])
    weights_at, fractions_at = MARGIN + 1, MARGIN + 1 + len(COSTS)
    marks_at = fractions_at + 2 * steps
    width = int(sum(t.mark_sizes.values()))
    problem = Problem(layout.size, marks_at + width * len(marks))

    node = np.arange(segments * steps)
    segment, part = node // steps, node % steps
    shared = np.tile(np.arange(3)[:, None], len(node))
    problem.add(
        t.substep,
        np.vstack([
            layout.node(node), layout.velocity(node), layout.control(segment), layout.control(segment + 1),
            layout.node(node + 1), layout.duration(segment),
        ]),
        np.vstack([shared, fractions_at + part, fractions_at + steps + part]),
    )  # fmt: skip
    k = np.arange(segments)
    problem.add(
        t.cost,
        np.vstack([layout.knot(k), layout.knot(k + 1), layout.control(k), layout.control(k + 1), layout.duration(k)]),
        np.arange(weights_at, weights_at + len(COSTS)),
    )
    every = np.arange(segments + 1)
    for name, value in limits.items():
        problem.add(t.limit(name, value), np.vstack([layout.knot(every), layout.control(every)]))
    if t.vehicle.group.size > t.vehicle.group.dim:
        problem.add(t.gauge, layout.knot(0))
    for i, (mark, knot) in enumerate(zip(marks, layout.mark_knots, strict=True)):
        if i and marks[i - 1].hold:  # the vehicle stands in balance: unchanged controls keep it there
            problem.add(t.hold, layout.control(np.array([knot - 1, knot])).T.reshape(-1, 1))
            continue
        element = t.mark(mark)
        if element is not None:
            place = np.concatenate([np.arange(3), marks_at + i * width + np.arange(width)])
            problem.add(element, np.vstack([layout.knot(knot), layout.control(knot)]), place)
    if cover is not None:
        # the knots after the first and one place between: the substep's middle, or a composition's node nearest to it
        middle = int(np.argmin(np.abs(starts - 0.5)))
        inner = np.arange(1, layout.nodes)
        inner = inner[np.isin(inner % steps, (0, middle))]
        problem.add(t.clearance(*cover, between=False), layout.node(inner), [MARGIN])
        if steps == 1:
            y = np.vstack([layout.node(node), layout.velocity(node), layout.duration(segment)])
            problem.add(t.clearance(*cover, between=True), y, [MARGIN])
    for phases, duration in total:
        h = ca.SX.sym("h", len(phases))
        counts = ca.DM([layout.phases[j] for j in phases])
        element = Element("frames", h, ca.SX(0, 1), g=ca.dot(counts, h) - duration)
        problem.add(element, layout.lengths[list(phases)])
    return problem, marks_at


def parameter_values(
    t: Transcription, layout: Layout, marks: Sequence[Mark], wind: Any, margin: float, weights: Mapping[str, float]
) -> Array:
    """The parameter vector `build` laid out."""
    starts = np.concatenate([[0.0], np.cumsum(layout.fractions)[:-1]])
    head = [np.asarray(wind, float), [margin], [weights[name] for name in COSTS], starts, layout.fractions]
    return np.concatenate([*head, *(t.mark_values(mark) for mark in marks)])


def variable_bounds(t: Transcription, layout: Layout, lengths: Sequence[tuple[float, float]]) -> tuple[Array, Array]:
    """Bounds of all variables: controls and joints by the vehicle, segment lengths (lower, upper) s by phase."""
    lower, upper = np.full(layout.size, -np.inf), np.full(layout.size, np.inf)
    knots = layout.control(np.arange(layout.segments + 1))
    lower[knots] = (np.array([c.lower for c in t.vehicle.controls]) / t.control_scale)[:, None]
    upper[knots] = (np.array([c.upper for c in t.vehicle.controls]) / t.control_scale)[:, None]
    nodes = layout.node(np.arange(layout.nodes))
    for joint, (low, high) in t.vehicle.joint_limits.items():
        row = nodes[t.sizes[0] + t.vehicle.joints.index(joint)]
        lower[row], upper[row] = low, high
    lower[layout.lengths], upper[layout.lengths] = np.array(lengths).T
    return lower, upper
