"""The pairs of features by which a convex shape and a vehicle in plan view can be nearest: one smooth row for each.

Two convex shapes are at least d apart exactly if the corners of each are at least d from the other; for an ellipse,
its outermost points towards the other shape's edges count as well. Discs inside the vehicle detect shapes that cross it
between its corners. The numbers of a shape are parameters of the problem; forms of shapes are data (`FORMS`). Only the
distance of a point from a shape has branches: it enters through its value, slope and curvature at the current point, so
nothing differentiates the branches.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from vehsim.planning.outlines import inner_discs, simplified
from vehsim.planning.problem.elements import Element
from vehsim.planning.problem.transcription import Transcription
from vehsim.vehicles import Vehicle
from vehsim.world.obstacles.articulated import ArticulatedPart, articulated_footprint, fixed_footprint
from vehsim.world.obstacles.obstacles import footprint
from vehsim.world.obstacles.plane import Ellipse

Array = NDArray[np.float64]
Expr = Any
Outline = tuple[tuple[float, float], ...]
"""A rigid part of a vehicle in plan view, as the optimiser models it: corners in the rig root's frame at rest, m."""
Model = tuple[Expr, Expr, Expr]
"""The distance of a point from a shape to second order: value, slope (2,) and second derivatives (xx, yy, xy)."""
Law = Callable[[Expr, Expr, Expr, Outline], tuple[Expr, Expr, Model]]
"""A function of a body's pose (yaw, x, y), a shape's numbers, a feature's constants and the body. It returns the
radius to subtract from the distance, the point from which it is measured, and the model at that point."""

CORNERS = 8
"""Maximum number of corners of a polygon that models a vehicle; it contains the footprint."""
ROUND = 1e-12
"""Added under square roots, m^2."""
ROUNDS = 5
"""Number of Newton steps towards the nearest point of an ellipse."""


@dataclass(frozen=True)
class Feature:
    """One row: its ``law``, the indices of the shape's ``numbers`` that it uses, and its own ``constants``."""

    law: Law
    numbers: tuple[int, ...]
    constants: tuple[float, ...]

    @property
    def kind(self) -> tuple[Law, int, int]:
        """A key that is equal for features that share one element."""
        return self.law, len(self.numbers), len(self.constants)


@dataclass(frozen=True)
class Form:
    """A kind of shape: the ``numbers`` of a shape, and its ``features`` next to a body."""

    numbers: Callable[[Any], Array]
    features: Callable[[Any, Outline], list[Feature]]


def form_of(shape: Any) -> Form:
    """The form of a shape of `world.plane`."""
    return FORMS[type(shape)]


@dataclass(frozen=True, eq=False)
class Body:
    """A rigid part of a vehicle: its ``outline``; the ``trailer`` that it is of, None for the vehicle itself; and its
    ``pose``, (yaw and position of the root, joints) -> those of the frame that was the root's at rest."""

    outline: Outline
    trailer: ArticulatedPart | None
    pose: ca.Function


@lru_cache(maxsize=64)
def bodies_of(vehicle: Vehicle) -> tuple[Body, ...]:
    """The vehicle as the optimiser models it: convex polygons with few corners around its footprint, or a point, and
    around each trailer.

    If something but the joints turns a trailer, the footprint contains all of them in line, and certification measures
    where they are.
    """
    root, r = ca.SX.sym("root", 3), ca.SX.sym("r", len(vehicle.joints))
    others = [ca.SX.sym("x", n) for n in (1, len(vehicle.joints), vehicle.group.dim, len(vehicle.controls))]

    def body(outline: Array, trailer: ArticulatedPart | None, pose: Expr) -> Body:
        corners = tuple((float(x), float(y)) for x, y in simplified(outline, CORNERS))
        return Body(corners, trailer, ca.Function("pose", [root, r], [pose]))

    made = [body(fixed_footprint(vehicle), None, root)]
    for trailer in articulated_footprint(vehicle):
        turned, shift = ca.SX(0), ca.SX.zeros(2)
        for channel, factor, place in reversed(trailer.pivots):
            law = vehicle.channels[channel].value
            angle = None if law is None else ca.SX(law(others[0], r, *others[1:]))
            if angle is None or ca.depends_on(angle, ca.vertcat(*others)):
                return (body(footprint(vehicle), None, root),)
            about = ca.DM(place)
            turned, shift = turned + factor * angle, about + _turn(factor * angle) @ (shift - about)
        made.append(body(trailer.outline, trailer, ca.vertcat(root[0] + turned, root[1:] + _turn(root[0]) @ shift)))
    return tuple(made)


@lru_cache(maxsize=256)
def gap(kind: tuple[Law, int, int], body: Outline) -> ca.Function:
    """Distance of a feature: ``(pose (3,), numbers, constants) -> m``; the pose is yaw and position of the body."""
    pose, numbers, constants = _symbols(kind)
    less, _, (value, _, _) = kind[0](pose, numbers, constants, body)
    return ca.Function("gap", [pose, numbers, constants], [value - less])


@lru_cache(maxsize=256)
def element(transcription: Transcription, kind: tuple[Law, int, int], number: int) -> Element:
    """The row of features of a kind and of one of the `bodies_of` the vehicle at a knot: (x).

    Parameters: the ``numbers`` of the shape, the requested ``clearance``, and the features' ``constants``.
    """
    x, clearance = transcription.symbols("x")["x"], ca.SX.sym("clearance")
    _, numbers, constants = _symbols(kind)
    g, r = transcription.split(x)[:2]
    vehicle, body = transcription.vehicle, bodies_of(transcription.vehicle)[number]
    pose = body.pose(ca.vertcat(g[0], g[1:3] - _turn(g[0]) @ ca.DM(vehicle.origin[:2])), r)
    less, point, (value, slope, bend) = kind[0](pose, numbers, constants, body.outline)
    at, height, rise, curve = (ca.SX.sym(name, k) for name, k in (("at", 2), ("value", 1), ("slope", 2), ("bend", 3)))
    off = point - at
    squares = ca.vertcat(off[0] ** 2 / 2, off[1] ** 2 / 2, off[0] * off[1])
    row = height + ca.dot(rise, off) + ca.dot(curve, squares) - less - clearance
    frozen = (ca.vertcat(at, height, rise, curve), ca.vertcat(point, value, slope, bend))
    parameters = {"numbers": numbers, "clearance": clearance, "constants": constants}
    return Element("obstacle", x, parameters, g=row, upper=np.inf, frozen=frozen)


def _symbols(kind: tuple[Law, int, int]) -> tuple[Expr, Expr, Expr]:
    return ca.SX.sym("pose", 3), ca.SX.sym("numbers", kind[1]), ca.SX.sym("constants", kind[2])


def _placed(pose: Expr) -> tuple[Expr, Expr]:
    """Rotation (2, 2) and place (2,) m of a root with ``pose`` (yaw, x, y)."""
    yaw, place = ca.vertsplit(pose, [0, 1, 3])
    return _turn(yaw), place


def _turn(angle: Expr) -> Expr:
    c, s = ca.cos(angle), ca.sin(angle)
    return ca.vertcat(ca.horzcat(c, -s), ca.horzcat(s, c))


# ------------------------------------------------------------ laws


def _point_from_polygon(pose: Expr, numbers: Expr, constants: Expr, body: Outline) -> tuple[Expr, Expr, Model]:
    """Distance of a point of the body, or of a disc around it, from a polygon; constants: its place and radius."""
    R_wb, place = _placed(pose)
    own, radius = ca.vertsplit(constants, [0, 2, 3])
    point = place + R_wb @ own
    return radius, point, from_polygon(point, ca.vertsplit(numbers, 2))


def _corner_from_body(pose: Expr, numbers: Expr, constants: Expr, body: Outline) -> tuple[Expr, Expr, Model]:
    """Distance of a polygon's corner from the body."""
    R_wb, place = _placed(pose)
    point = R_wb.T @ (numbers - place)
    return 0.0, point, from_polygon(point, [ca.DM(corner) for corner in body])


def _point_from_ellipse(pose: Expr, numbers: Expr, constants: Expr, body: Outline) -> tuple[Expr, Expr, Model]:
    """Distance of a point of the body, or of a disc around it, from an ellipse; constants: its place and radius."""
    centre, radii, R_we = _ellipse(numbers)
    R_wb, place = _placed(pose)
    own, radius = ca.vertsplit(constants, [0, 2, 3])
    point = R_we.T @ (place + R_wb @ own - centre)
    return radius, point, from_ellipse(point, radii)


def _ellipse_from_body(pose: Expr, numbers: Expr, constants: Expr, body: Outline) -> tuple[Expr, Expr, Model]:
    """Distance from the body of an ellipse's outermost point towards an edge of the body; constants: the edge's inner
    normal."""
    centre, radii, R_we = _ellipse(numbers)
    R_wb, place = _placed(pose)
    inwards = R_we.T @ R_wb @ constants
    outermost = radii**2 * inwards / ca.sqrt(ca.sumsqr(radii * inwards) + ROUND)
    point = R_wb.T @ (centre + R_we @ outermost - place)
    return 0.0, point, from_polygon(point, [ca.DM(corner) for corner in body])


def _ellipse(numbers: Expr) -> tuple[Expr, Expr, Expr]:
    """Centre, radii, and rotation from its own axes to the world."""
    axis: Expr
    centre, radii, axis = ca.vertsplit(numbers, 2)
    return centre, radii, ca.horzcat(axis, ca.vertcat(-axis[1], axis[0]))


# ------------------------------------------------------------ forms


def _points(law: Law, count: int, body: Outline) -> list[Feature]:
    """The features of the body's corners and inner discs next to a shape of ``count`` numbers."""
    discs = inner_discs(np.array(body))
    points = [(*corner, 0.0) for corner in body] + [(*map(float, centre), radius) for centre, radius in discs]
    return [Feature(law, tuple(range(count)), point) for point in points]


def _of_polygon(shape: Array, body: Outline) -> list[Feature]:
    own = range(len(shape)) if len(body) > 2 else ()
    corners = [Feature(_corner_from_body, (2 * k, 2 * k + 1), ()) for k in own]
    return _points(_point_from_polygon, shape.size, body) + corners


def _of_ellipse(shape: Ellipse, body: Outline) -> list[Feature]:
    corners = np.array(body)
    steps = np.roll(corners, -1, axis=0) - corners if len(body) > 2 else np.zeros((0, 2))
    edges = [Feature(_ellipse_from_body, tuple(range(6)), (float(-y), float(x))) for x, y in steps]
    return _points(_point_from_ellipse, 6, body) + edges


FORMS: dict[type, Form] = {
    np.ndarray: Form(np.ravel, _of_polygon),
    Ellipse: Form(lambda shape: np.concatenate([shape.centre, shape.radii, shape.R[:, 0]]), _of_ellipse),
}
"""Type of a shape -> its form. The numbers are the corners of a polygon; centre, radii and first axis of an ellipse."""


# ------------------------------------------------------------ a point from a shape


def from_polygon(point: Expr, corners: Sequence[Expr]) -> Model:
    """Signed distance of a point from a convex, counter-clockwise polygon, to second order; C1 outside."""
    farthest, squared = ca.SX(-np.inf), ca.SX(np.inf)
    normal, off, corner = ca.SX.zeros(2), ca.SX.zeros(2), ca.SX(0)
    for a, b in zip(corners, [*corners[1:], corners[0]], strict=True):
        step, offset = b - a, point - a
        length = ca.sumsqr(step) + ROUND
        outward = ca.vertcat(step[1], -step[0]) / ca.sqrt(length)
        beyond, share = ca.dot(offset, outward), ca.dot(offset, step) / length
        foot = offset - ca.fmin(ca.fmax(share, 0), 1) * step
        away = ca.sumsqr(foot)
        normal, farthest = ca.if_else(beyond > farthest, outward, normal), ca.fmax(beyond, farthest)
        nearer, beside = away < squared, ca.logic_and(share > 0, share < 1)
        off, corner = ca.if_else(nearer, foot, off), ca.if_else(nearer, ca.if_else(beside, 0, 1), corner)
        squared = ca.fmin(away, squared)
    outside, distance = farthest > 0, ca.sqrt(squared + ROUND)
    slope = ca.if_else(outside, off / distance, normal)
    bend = ca.if_else(outside, corner / distance, 0)  # around a corner the distance is a cone
    return ca.if_else(outside, distance, farthest), slope, _across(slope, bend)


def from_ellipse(point: Expr, radii: Expr) -> Model:
    """Signed distance of a point from an axis-aligned ellipse at the origin; inside it, an approximation."""
    squared, t = radii**2, ca.SX(0)
    for _ in range(ROUNDS):
        ratio = radii * point / (t + squared)
        size = ca.sqrt(ca.sumsqr(ratio) + ROUND)
        t = ca.fmax(t + (size - 1) * size**2 / (ca.dot(ratio, ratio / (t + squared)) + ROUND), 0)
    foot = squared * point / (t + squared)
    distance, steep = ca.sqrt(ca.sumsqr(point - foot) + ROUND), ca.sumsqr(foot / squared) + ROUND
    normal = foot / squared / ca.sqrt(steep)
    curved = _across(normal, 1 / (distance + ca.fmax(squared[0] * squared[1] * steep**1.5, ROUND)))
    least, far = ca.fmin(radii[0], radii[1]), ca.sqrt(ca.sumsqr(point / radii) + ROUND)
    inner = point / squared / far
    cupped = (ca.vertcat(1 / squared, 0) - ca.vertcat(inner**2, inner[0] * inner[1])) / far
    outside = far > 1
    return (
        ca.if_else(outside, distance, (far - 1) * least),
        ca.if_else(outside, normal, least * inner),
        ca.if_else(outside, curved, least * cupped),
    )


def _across(normal: Expr, bend: Expr) -> Expr:
    """Second derivatives (xx, yy, xy) of a function that curves only across ``normal``."""
    return bend * ca.vertcat(normal[1] ** 2, normal[0] ** 2, -normal[0] * normal[1])
