"""The whole problem: a vehicle's elements laid out over all segments, knots and marks, its parameters and bounds."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from vehsim.planning.asked import (
    PARAMETERS,
    adrift,
    held_controls_element,
    hold_element,
    landing_element,
    loop_element,
    mark_element,
    mark_values,
    parameter_sizes,
)
from vehsim.planning.cover import POSE, Cover, attitude, landings, places
from vehsim.planning.elements import Element, Problem, elastic
from vehsim.planning.instants import Instants
from vehsim.planning.layout import Layout
from vehsim.planning.legs import held_segments, knots_within
from vehsim.planning.marks import Mark, end_of_hold
from vehsim.planning.request import Request
from vehsim.planning.terms import COSTS, Cost, Term
from vehsim.planning.transcription import MARGIN, Transcription

Array = NDArray[np.float64]


def build(
    t: Transcription,
    layout: Layout,
    request: Request,
    cover: Cover | None,
    total: Sequence[tuple[Sequence[int], float]] = (),
    give: float = 0.0,
    near: NDArray[np.bool_] | None = None,
) -> Problem:
    """The whole problem; `parameter_values` are its parameters.

    ``cover``: what is to be kept off rock and obstacles, or None in free space. ``total``: groups of
    phases between marks at fixed frames whose lengths must add up, with their durations in s.
    ``give``: where above zero, marks after the first may be missed at this price, see `elements.elastic`.
    ``near``: which of `cover.places` see what stands, all unless given.
    """
    problem = Problem(layout.size, _marks_at(layout) + _width(t) * len(request.marks))
    _add_motion(problem, t, layout, request)
    _add_marks(problem, t, layout, request, give)
    for constraint in request.constraints:
        _add_term(problem, t, layout, request, constraint)
    for term in request.terms:
        if isinstance(term, Cost):
            _add_term(problem, t, layout, request, term)
    if cover is not None:
        _add_clearance(problem, t, layout, cover, request.marks, near, wary="safety" in request.costs)
    for phases, duration in total:
        h = ca.SX.sym("h", len(phases))
        counts = ca.DM([layout.phases[j] for j in phases])
        element = Element("frames", h, ca.SX(0, 1), g=ca.dot(counts, h) - duration)
        problem.add(element, layout.lengths[list(phases)])
    return problem


WEIGHTS = MARGIN + 1
"""First of the costs' weights in the parameter vector."""


def _marks_at(layout: Layout) -> int:
    return WEIGHTS + len(COSTS) + 2 * len(layout.fractions)


def _width(t: Transcription) -> int:
    return sum(parameter_sizes(t).values())


def _add_motion(problem: Problem, t: Transcription, layout: Layout, request: Request) -> None:
    """The discrete mechanics of every substep, a state that stays in those of holds, and the costs of every segment."""
    steps, fractions_at = len(layout.fractions), WEIGHTS + len(COSTS)
    every = np.arange(layout.segments * steps)
    held = held_segments(layout.phases, request.marks)
    node = every[~held[every // steps]]
    segment, part = node // steps, node % steps
    shared = np.tile(np.arange(3)[:, None], len(node))
    problem.add(
        t.substep,
        np.vstack([
            layout.node(node), layout.velocity(node), layout.control(segment), layout.control(segment + 1),
            layout.node(node + 1), layout.duration(segment),
        ]),
        np.vstack([shared, fractions_at + part, fractions_at + steps + part]),
        names=[f"dynamics[{k}]" for k in node],
    )  # fmt: skip
    if held.any():
        still, stays = every[held[every // steps]], np.flatnonzero(held)
        problem.add(hold_element(t), np.vstack([layout.node(still), layout.velocity(still), layout.node(still + 1)]))
        problem.add(held_controls_element(t), np.vstack([layout.control(stays), layout.control(stays + 1)]))
    aimed = _aimed(layout, request)
    without = tuple(name for name in request.costs if name != "course")  # told where to look, it need not face its way
    for names, segments in ((request.costs, np.flatnonzero(~aimed)), (without, np.flatnonzero(aimed))):
        if len(segments) and names:
            places = [WEIGHTS + list(COSTS).index(name) for name in names]
            problem.add(t.cost(names), _segments(layout, segments), places)
    if t.vehicle.group.size > t.vehicle.group.dim:
        problem.add(t.gauge, layout.knot(0))


def _aimed(layout: Layout, request: Request) -> NDArray[np.bool_]:
    """Segments (n,) where a constraint says which way to head."""
    aimed = np.zeros(layout.segments, bool)
    for term in request.constraints:
        if term.aim is not None:
            first, last = knots_within(request.marks, layout.mark_knots, term.frames)
            aimed[first:last] = True
    return aimed


def _segments(layout: Layout, k: Any) -> Any:
    """Variables of segments ``k``: (x, x1, c0, c1, h)."""
    ends = [layout.knot(k), layout.knot(k + 1), layout.control(k), layout.control(k + 1)]
    return np.vstack([*ends, layout.duration(k)])


def _add_marks(problem: Problem, t: Transcription, layout: Layout, request: Request, give: float) -> None:
    marks, first, width = request.marks, _marks_at(layout), _width(t)
    for i, (mark, knot) in enumerate(zip(marks, layout.mark_knots, strict=True)):
        if i and marks[i - 1].hold:  # it is where it was
            continue
        closes = request.loop and end_of_hold(marks, i) == len(marks) - 1
        element = mark_element(t, mark, marks[0] if closes else None)
        if element is not None:
            element.name, element.labels = mark.name, [f"{mark.name}.{key}" for key in element.labels]
            place = np.concatenate([np.arange(3), first + i * width + np.arange(width)])
            y = np.vstack([layout.knot(knot), layout.control(knot)])
            if give and i:
                slack = problem.size + np.arange(2 * len(element.labels))
                element, y, problem.size = elastic(element, give), np.vstack([y, slack[:, None]]), slack[-1] + 1
            problem.add(element, y, place)
        if mark.on_ground:
            _add_landing(problem, t, layout, request, i, first + i * width)
    if request.loop:
        ends = [np.vstack([layout.knot(k), layout.control(k)]) for k in (0, layout.segments)]
        problem.add(loop_element(t), np.vstack(ends))


def _add_landing(problem: Problem, t: Transcription, layout: Layout, request: Request, i: int, first: int) -> None:
    """Down (or up) a cone about mark ``i``, gently, at every knot; its parameters stand at ``first``."""
    knot, leaves = layout.mark_knots[[i, end_of_hold(request.marks, i)]]
    beside = np.concatenate([np.arange(1, knot), np.arange(leaves + 1, layout.segments)])
    if not len(beside):
        return
    p = [MARGIN, *(first + np.arange(PARAMETERS["position"]))]
    y = np.vstack([layout.knot(beside), layout.duration(beside - 1)])
    problem.add(landing_element(t, attitude(request.marks[i])), y, np.tile(np.array(p)[:, None], len(beside)))


def _add_term(problem: Problem, t: Transcription, layout: Layout, request: Request, term: Term) -> None:
    """A cost or constraint at every place it asks for, within its frames."""
    first, last = knots_within(request.marks, layout.mark_knots, term.frames)
    knots, segments = np.arange(first, last + 1), np.arange(first, last)
    if isinstance(term, Cost) or term.over == "segments":
        element, timed = t.term(term, "segment", len(layout.phases))
        problem.add(element, *_timed(layout, segments, _segments(layout, segments), timed))
    elif term.over != "between" and t.accelerated(term):  # at the start of every segment, and the end of the last
        element, timed = t.term(term, "between", len(layout.phases))
        k, fraction = np.append(segments, last - 1), np.append(np.zeros(len(segments)), 1.0)
        y, _, constants = _timed(layout, k, _segments(layout, k), timed)
        problem.add(element, y, constants=fraction[None] if constants is None else np.vstack([fraction, constants]))
    elif term.over != "between":
        element, timed = t.term(term, "knot", len(layout.phases))
        y = np.vstack([layout.knot(knots), layout.control(knots)])
        problem.add(element, *_timed(layout, knots, y, timed))


def _timed(layout: Layout, k: Any, y: Any, timed: bool) -> tuple[Any, None, Any]:
    """Variables, parameters and constants of an element at knots ``k`` that asks for the time where it is ``timed``."""
    if not timed:
        return y, None, None
    starts = layout.mark_knots[:-1, None]
    passed = np.clip(k - starts, 0, np.array(layout.phases)[:, None])
    return np.vstack([y, np.tile(layout.lengths[:, None], len(k))]), None, passed.astype(float)


def add_instants(problem: Problem, layout: Layout, instants: Instants) -> None:
    """Rows of the constraints at instants between knots; their parameters stand behind those the problem has."""
    for element, timed, k in instants.elements(layout):
        y, _, constants = _timed(layout, k, _segments(layout, k), timed)
        problem.add(element, y, problem.parameters + np.arange(len(k))[None], constants)
        problem.parameters += len(k)


def _add_clearance(
    problem: Problem,
    t: Transcription,
    layout: Layout,
    cover: Cover,
    marks: Sequence[Mark],
    near: NDArray[np.bool_] | None,
    wary: bool,
) -> None:
    """Spheres off what stands and what moves at the knots after the first, and at one place between two of them.

    Parameters behind the problem's own, as `Cover.values` gives them.
    """
    shared = [MARGIN, WEIGHTS + list(COSTS).index("safety")]
    landed, uses = len(landings(marks)), _at_places(layout, marks)
    for k, field in enumerate(cover.fields()):
        width = POSE if k else landed * (3 + len(cover.radii))
        for between, y in uses if k or near is None else _only(uses, near):
            count = y.shape[1]
            if field is not None and count:
                place = problem.parameters + np.arange(width)[:, None] + (width * np.arange(count) if k else 0)
                p = np.vstack([np.tile(np.array(shared)[:, None], count), np.broadcast_to(place, (width, count))])
                problem.add(t.clearance(cover, k, landed, between=between, wary=wary), y, p)
            problem.parameters += width * count if k else 0
        problem.parameters += 0 if k or field is None else width


def _at_places(layout: Layout, marks: Sequence[Mark]) -> list[tuple[bool, NDArray[np.intp]]]:
    """Whether half way along a segment, and the variables there, for both kinds of `cover.places`."""
    node, half = places(layout, marks)
    return [
        (False, np.vstack([layout.node(node), layout.duration((node - 1) // len(layout.fractions))])),
        (True, np.vstack([layout.node(half), layout.velocity(half), layout.duration(half)])),
    ]


def _only(uses: Sequence[tuple[bool, NDArray[np.intp]]], near: NDArray[np.bool_]) -> list[Any]:
    split = np.split(near, [uses[0][1].shape[1]])
    return [(between, y[:, seen]) for (between, y), seen in zip(uses, split, strict=True)]


def distances(t: Transcription, layout: Layout, cover: Cover, marks: Sequence[Mark], x: Array) -> Array:
    """How far the nearest sphere is from what stands at every one of `cover.places`, m, with variables ``x``."""
    assert cover.stands is not None
    out = [np.zeros(0)]
    for between, y in _at_places(layout, marks):
        if y.shape[1]:
            element = t.clearance(cover, 0, len(landings(marks)), between=between, wary=False)
            points = np.asarray(element.points.map(y.shape[1])(x[y], 0))
            away = cover.stands.value(points.T).reshape(y.shape[1], -1)
            out.append((away - cover.radii).min(axis=1))
    return np.concatenate(out)


def parameter_values(
    t: Transcription, layout: Layout, marks: Sequence[Mark], wind: Any, margin: float, weights: Mapping[str, float]
) -> Array:
    """The parameter vector `build` laid out."""
    starts = np.concatenate([[0.0], np.cumsum(layout.fractions)[:-1]])
    head = [np.asarray(wind, float), [margin], [weights[name] for name in COSTS], starts, layout.fractions]
    return np.concatenate([*head, *(mark_values(t, mark) for mark in marks)])


def variable_bounds(
    t: Transcription,
    layout: Layout,
    lengths: Sequence[tuple[float, float]],
    joints: Mapping[str, tuple[float, float]],
) -> tuple[Array, Array]:
    """Bounds of all variables: controls by the vehicle, joints by the vehicle and ``joints``, segment lengths (lower,
    upper) s by phase."""
    lower, upper = np.full(layout.size, -np.inf), np.full(layout.size, np.inf)
    knots = layout.control(np.arange(layout.segments + 1))
    lower[knots] = (np.array([c.lower for c in t.vehicle.controls]) / t.control_scale)[:, None]
    upper[knots] = (np.array([c.upper for c in t.vehicle.controls]) / t.control_scale)[:, None]
    nodes = layout.node(np.arange(layout.nodes))
    for joint, (low, high) in (*t.vehicle.joint_limits.items(), *joints.items()):
        row = nodes[t.sizes[0] + t.vehicle.joints.index(joint)]
        lower[row], upper[row] = np.maximum(lower[row], low), np.minimum(upper[row], high)
    lower[layout.lengths], upper[layout.lengths] = np.array(lengths).T
    return lower, upper


def hold_adrift(t: Transcription, layout: Layout, request: Request, x: Array, lower: Array, upper: Array) -> None:
    """Bound joints that nothing places to begin where ``x`` has them."""
    begins = layout.node(0)[[t.sizes[0] + joint for joint in adrift(t, request)]]
    lower[begins] = upper[begins] = x[begins]
