"""Obstacles as constraints: what drives stays clear of polygons and ellipses, exactly (NH IV.B).

Seen from above a vehicle is a convex polygon A, and so is every part B of an obstacle, unless it is an ellipse. Two of
them are d apart exactly when the corners of A are d from B and the corners of B are d from A; each of these is a smooth
row. Rows for a few discs within A see what crosses it between corners. Where parts stand is a parameter of the problem,
one for every knot when they move, so problems are built once for all worlds of a shape. Geometry is in `world.plane`.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache
from typing import TYPE_CHECKING, Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from vehsim.clip import Clip
from vehsim.errors import InputError
from vehsim.planning.cover import attitude
from vehsim.planning.elements import Element, Problem
from vehsim.planning.legs import fixed_durations, legs_between, path_length
from vehsim.planning.marks import Mark
from vehsim.planning.transcription import Layout, Transcription
from vehsim.vehicles import Vehicle
from vehsim.world.obstacles import footprint, headings, vertical_reach
from vehsim.world.plane import Ellipse, distance, placed

if TYPE_CHECKING:
    from vehsim.planning.request import Request

Array = NDArray[np.float64]
Expr = Any

CORNERS = 8
"""Corners of the polygon the optimiser sees a vehicle as, at most; it contains the footprint."""
SIGHT = 3.0
"""How far from the first guess a part is seen at a knot, beyond the clearance asked for, m. What comes too near
unseen is found when the motion is certified, and seen from then on."""
BETWEEN = 0.005
"""What knots demand beyond the clearance asked for, m, since the way between them bends; more where that is not enough.
"""
DODGES = 4
"""How often a first guess is sought that is not in the way of what moves."""
BRISK = 5.0
"""Guess of how fast a leg between free marks is driven, m/s."""
ROUND = 1e-12
"""Added under square roots, m^2."""
FINEST = 1e-3
"""How exactly the least clearance between samples is found, m."""


@dataclass(eq=False)
class Rows:
    """The rows that keep one vehicle clear of a world's obstacles on one discretisation.

    ``parts``: (obstacle, part number); ``seen`` (parts, knots): which stand where in the problem; ``extra``: what each
    row demands beyond the clearance asked for, m.
    """

    vehicle: Vehicle
    parts: list[tuple[Any, int]]
    seen: NDArray[np.bool_] = field(default_factory=lambda: np.zeros((0, 0), bool))
    extra: Array = field(default_factory=lambda: np.zeros((0, 0)))

    @property
    def key(self) -> Any:
        """Equal for problems that differ in parameters alone."""
        return repr(
            [_kind(o.parts[i]) if hasattr(o, "parts") else "moving" for o, i in self.parts]
        ), self.seen.tobytes()

    def look(self, positions: Array, yaw: Array, seconds: Array, clearance: float) -> None:
        """See what is near the guessed poses (knots, ...) of a discretisation; what was seen already stays."""
        outline = footprint(self.vehicle)
        reach = clearance + SIGHT
        near = clearances(self.parts, placed(outline, positions[:, :2], yaw), seconds, reach) < reach
        near[:, 0] = False  # where it starts is given
        if self.seen.shape != near.shape:
            old = self.extra
            self.extra = _stretched(old, near.shape) if old.size else np.full(near.shape, BETWEEN)
            self.seen = near
        self.seen = self.seen | near

    def overlooked(self, positions: Array, yaw: Array, seconds: Array, clearance: float) -> bool:
        """Whether solved poses (knots, ...) come too near to parts unseen there; what is near them is seen from
        now on."""
        outlines = placed(footprint(self.vehicle), positions[:, :2], yaw)
        gaps = clearances(self.parts, outlines, seconds, clearance + SIGHT)
        gaps[:, 0] = np.inf
        missed = bool(np.any(~self.seen & (gaps < clearance - FINEST)))
        if missed:
            self.seen |= gaps < clearance + SIGHT
        return missed

    def drive(self, request: Request, wariness: int = 0) -> list[Array]:
        """A path (k, 4) x, y, z m and heading rad for every leg between two marks, by A*; the greater ``wariness``,
        the more room it looks for.

        Where a path meets something that moves, it is sought again about the places where that was met.
        """
        from vehsim.planning.astar import guess_drive

        nose = [None if mark.heading is None else float(np.deg2rad(mark.heading)) for mark in request.marks]
        seconds = float(int(request.marks[0].frame) / request.fps)
        fixed = fixed_durations(request.marks, request.fps)
        paths = []
        for j, leg in enumerate(legs_between(request.marks)):
            met: list[Any] = []
            for _ in range(DODGES):
                ends = np.array(leg)
                path = guess_drive(
                    self.vehicle, self.parts, ends, (nose[j], nose[j + 1]), request.clearance, wariness, met
                )
                length = path_length(path)
                duration = length / BRISK if np.isnan(fixed[j]) else fixed[j]
                new = self._met(path, seconds, duration, request.clearance)
                if not new:
                    break
                met += new
            paths.append(path)
            seconds += duration
        return paths

    def _met(self, path: Array, start: float, duration: float, clearance: float) -> list[Array]:
        """Outlines (k, 2) of what moves, where an even pace along a path (k, 4) meets it."""
        moving = [(o, k) for o, k in self.parts if not hasattr(o, "parts") and not o.stands]
        if not moving:
            return []
        way = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(path[:, :2], axis=0), axis=1))])
        seconds = start + duration * way / max(way[-1], 1e-9)
        outlines = placed(footprint(self.vehicle), path[:, :2], path[:, 3])
        gaps = clearances(moving, outlines, seconds)
        return [
            o.shapes_at(seconds[row < clearance])[0]
            for (o, _), row in zip(moving, gaps, strict=True)
            if row.min() < clearance
        ]

    def add(self, problem: Problem, t: Transcription, layout: Layout) -> None:
        """The rows, and parameters for them behind those the problem has."""
        first = problem.parameters
        for row, (obstacle, number) in enumerate(self.parts):
            knots = np.flatnonzero(self.seen[row])
            if not len(knots):
                continue
            element = _element(t, _shape_of(obstacle, number))
            width, moves = element.p.shape[0] - 1, not hasattr(obstacle, "parts")
            count = width * (len(knots) if moves else 1)
            shape = first + np.arange(width)[:, None] + width * np.arange(len(knots)) * moves
            margins = first + count + np.arange(len(knots))
            problem.add(element, layout.knot(knots), np.vstack([shape, margins]))
            first += count + len(knots)
        problem.parameters = first

    def values(self, seconds: Array, clearance: float) -> Array:
        """The parameters that `add` laid out: ``seconds`` (knots,) since frame 0, when the vehicle is at its knots."""
        out: list[Array] = []
        for row, (obstacle, number) in enumerate(self.parts):
            knots = np.flatnonzero(self.seen[row])
            if not len(knots):
                continue
            shape = _shape_of(obstacle, number)
            if not hasattr(obstacle, "parts"):
                positions, orientations = obstacle.poses_at(seconds[knots])
                shape = placed(shape, positions[:, :2], headings(orientations))
            out += [_numbers(shape), clearance + self.extra[row, knots]]
        return np.concatenate([np.zeros(0), *out])

    def tighten(self, lack: Array) -> None:
        """Demand more at both knots of the segments where a certified motion lacks clearance: (parts, segments) m."""
        beside = np.zeros_like(self.extra)
        beside[:, :-1] = lack
        beside[:, 1:] = np.maximum(beside[:, 1:], lack)
        beside[:, 0] = 0.0
        self.extra += np.where(self.seen & (beside > 0), beside + FINEST, 0.0)  # the unseen need only be seen
        self.seen |= beside > 0


def obstacle_rows(vehicle: Vehicle, world: Any, marks: Sequence[Any]) -> Rows | None:
    """The rows for the obstacles of ``world`` that a vehicle driving at the marks' height can touch, or None."""
    if world is None or vehicle.group.dim != 3 or not world.obstacles:
        return None
    height = 0.0 if marks[0].position is None else float(marks[0].position[2])
    low, high = vertical_reach(vehicle)
    parts = [
        (obstacle, number)
        for obstacle in world.obstacles
        if obstacle.bottom < height + high and obstacle.top > height + low
        for number in range(len(getattr(obstacle, "parts", [None])))
    ]
    return Rows(vehicle, parts) if parts else None


def check_marks_clear(vehicle: Vehicle, world: Any, marks: Sequence[Mark], clearance: float) -> None:
    """Raise ``InputError`` for a mark whose vehicle stands in an obstacle, or nearer than ``clearance`` m to one."""
    for i, message, mend in marks_too_near(vehicle, world, marks, clearance):
        raise InputError(f"mark[{i}].position = {list(marks[i].position or ())}: {message}; {mend}")


def marks_too_near(
    vehicle: Vehicle, world: Any, marks: Sequence[Any], clearance: float
) -> Iterator[tuple[int, str, str]]:
    """Number, message and mend of every mark whose vehicle stands in an obstacle or too near to one.

    A mark without a heading is asked for its root alone; one with a tolerance may give way by that.
    """
    if vehicle.group.dim == 6:
        yield from _flown_too_near(vehicle, world, marks, clearance)
        return
    rows = obstacle_rows(vehicle, world, marks)
    still = [] if rows is None else [(o, k) for o, k in rows.parts if hasattr(o, "parts")]
    for i, mark in enumerate(marks if still else ()):
        if mark.position is None:
            continue
        outline = footprint(vehicle) if mark.heading is not None else np.zeros((1, 2))
        yaw = np.array([np.deg2rad(mark.heading or 0.0)])
        gaps = clearances(still, placed(outline, np.array([mark.position[:2]], float), yaw), np.zeros(1))[:, 0]
        gap, name = float(gaps.min()) + mark.tolerance, still[int(gaps.argmin())][0].name
        if gap <= 0:
            yield i, f"in obstacle {name!r}", "move the mark or the obstacle"
        elif mark.heading is not None and gap < clearance - FINEST:
            mend = f"keep the clearance of {clearance:g} m, or ask for less"
            yield i, f"only {gap:.2f} m from obstacle {name!r}", mend


def _flown_too_near(
    vehicle: Vehicle, world: Any, marks: Sequence[Any], clearance: float
) -> Iterator[tuple[int, str, str]]:
    """The same for what flies: by its hulls where the attitude is given, else by its root."""
    for i, mark in enumerate(marks if world is not None and world.standing else ()):
        if mark.position is None or mark.on_ground:
            continue
        turned = mark.orientation is not None or mark.heading is not None
        body = vehicle if turned else replace(vehicle, rig=None)
        gaps = world.clearance_by_obstacle(body, mark.position, attitude(mark))[0]
        gap, name = float(gaps.min()) + mark.tolerance, world.obstacles[int(gaps.argmin())].name
        if gap <= 0:
            yield i, f"in obstacle {name!r}", "move the mark or the obstacle"
        elif turned and gap < clearance - FINEST:
            mend = f"keep the clearance of {clearance:g} m, or ask for less"
            yield i, f"only {gap:.2f} m from obstacle {name!r}", mend


def clearances(parts: Sequence[tuple[Any, int]], outlines: Array, seconds: Array, reach: float = np.inf) -> Array:
    """Signed distances (parts, n) m of outlines (n, k, 2) at ``seconds`` (n,) since frame 0.

    Those beyond ``reach`` m are lower bounds, beyond it too.
    """
    found = [gaps_to(obstacle.shapes_at(seconds)[number], outlines, reach) for obstacle, number in parts]
    return np.reshape(found, (len(parts), len(outlines)))


def gaps_to(shape: Any, outlines: Array, reach: float = np.inf) -> Array:
    """Signed distances (n,) m of outlines (n, k, 2) to one shape, or to one each (n, m, 2).

    Those beyond ``reach`` m are lower bounds, beyond it too.
    """
    centres, radii = _circle(outlines)
    alone = isinstance(shape, Ellipse) or shape.ndim == 2
    middle, radius = (shape.centre, shape.radii.max()) if isinstance(shape, Ellipse) else _circle(shape)
    out = np.asarray(np.linalg.norm(centres - middle, axis=-1) - radii - radius)
    near = out < reach
    if near.any():
        out[near] = distance(outlines[near], shape if alone else shape[near])
    return out


def _circle(polygons: Array) -> tuple[Array, Array]:
    """Centres (..., 2) and radii (...) m of circles about polygons (..., k, 2)."""
    centres = (polygons.min(axis=-2) + polygons.max(axis=-2)) / 2
    return centres, np.linalg.norm(polygons - centres[..., None, :], axis=-1).max(axis=-1)


def certify_plane(
    clip: Clip, parts: Sequence[tuple[Any, int]], reach: float = np.inf, samples: int = 8
) -> tuple[float, Array]:
    """Least signed distance (m) of a clip's vehicle to the parts, between knots too; and by part and segment.

    On the clip's interpolant: where two samples and the way between them leave room for a smaller distance, there are
    more, until the least one is known to `FINEST`. By segment, those beyond ``reach`` m are lower bounds.
    """
    if not parts or len(clip) < 2:
        return float("inf"), np.full((len(parts), max(len(clip) - 1, 1)), np.inf)
    fine = np.linspace(0, 1, samples, endpoint=False)
    times = np.append((clip.times[:-1, None] + np.diff(clip.times)[:, None] * fine).ravel(), clip.times[-1])
    pairs = np.column_stack([np.arange(len(times) - 1), np.arange(1, len(times))])
    gaps, moved = _measured(clip, parts, times, pairs, reach)
    if gaps.min() > reach:
        return certify_plane(clip, parts, np.inf, samples)
    nearest, every = float(gaps.min()), samples
    inner = gaps[:, :-1].reshape(len(parts), -1, every)
    by_segment = np.minimum(inner.min(axis=2), gaps[:, every::every])
    for _ in range(12):
        # no point of a shape comes nearer than the sum of what both ends allow
        least = (gaps[:, pairs[:, 0]] + gaps[:, pairs[:, 1]] - 1.2 * moved) / 2
        left, right = times[pairs[least.min(axis=0) < nearest - FINEST]].T
        if not len(left):
            break
        middle = (left + right) / 2
        times, place = np.unique(np.concatenate([left, middle, middle, right]), return_inverse=True)
        pairs = place.reshape(2, 2, -1).transpose(0, 2, 1).reshape(-1, 2)
        gaps, moved = _measured(clip, parts, times, pairs, reach)
        nearest = min(nearest, float(gaps.min()))
    return nearest, by_segment


def _measured(
    clip: Clip, parts: Sequence[tuple[Any, int]], times: Array, pairs: NDArray[np.intp], reach: float
) -> tuple[Array, Array]:
    """Distances (parts, n) m at ``times``; how far shapes move between ``pairs`` (m, 2) of them, (parts, m) m."""
    motion = clip.at(times)
    outlines = placed(footprint(clip.vehicle), motion.positions[:, :2], headings(motion.orientations))
    seconds = clip.start_frame / float(clip.fps) + times

    def way(corners: Array) -> Array:
        return np.asarray(np.linalg.norm(corners[pairs[:, 1]] - corners[pairs[:, 0]], axis=-1).max(axis=1))

    own = way(outlines)
    shapes = [obstacle.shapes_at(seconds)[number] for obstacle, number in parts]
    moved = [own if isinstance(shape, Ellipse) or shape.ndim == 2 else own + way(shape) for shape in shapes]
    return clearances(parts, outlines, seconds, reach), np.array(moved)


# ------------------------------------------------------------ rows


def _shape_of(obstacle: Any, number: int) -> Any:
    """A part as the optimiser sees it; a vehicle's in its root's frame."""
    return obstacle.parts[number] if hasattr(obstacle, "parts") else simplified(obstacle.outline, CORNERS)


def _kind(shape: Any) -> Any:
    return "ellipse" if isinstance(shape, Ellipse) else len(shape)


def _numbers(shape: Any) -> Array:
    """A shape's parameters: corners, or centre, radii and axis of an ellipse."""
    if isinstance(shape, Ellipse):
        return np.concatenate([shape.centre, shape.radii, shape.R[:, 0]])
    return np.asarray(shape, float).ravel()


def _element(t: Transcription, shape: Any) -> Element:
    return _built(t, _kind(shape))


@lru_cache(maxsize=64)
def _built(t: Transcription, kind: Any) -> Element:
    """The rows at one knot: (x), with the part's numbers and the clearance asked for as parameters."""
    x = ca.SX.sym("x", t.sizes[0] + t.sizes[1] + t.sizes[2])
    asked = ca.SX.sym("asked")
    g = t.split(x)[0]
    c, s = ca.cos(g[0]), ca.sin(g[0])
    R = ca.vertcat(ca.horzcat(c, -s), ca.horzcat(s, c))
    root = g[1:3] - R @ ca.DM(t.vehicle.origin[:2])
    body = simplified(footprint(t.vehicle), CORNERS)
    corners = [root + R @ ca.DM(corner) for corner in body]
    discs = [(root + R @ ca.DM(centre), radius) for centre, radius in inner_discs(body)]
    own = [ca.DM(corner) for corner in body]
    if kind == "ellipse":
        centre, radii, axis = ca.SX.sym("centre", 2), ca.SX.sym("radii", 2), ca.SX.sym("axis", 2)
        shape = ca.vertcat(centre, radii, axis)
        R_we = ca.horzcat(axis, ca.vertcat(-axis[1], axis[0]))

        def gap(point: Expr) -> Expr:
            return _from_ellipse(R_we.T @ (point - centre), radii)

        others = [centre + R_we @ p for p in _outermost(R_we.T @ R, body, radii)]
    else:
        shape = ca.SX.sym("corners", 2 * kind)
        others = [shape[2 * k : 2 * k + 2] for k in range(kind)]

        def gap(point: Expr) -> Expr:
            return _from_polygon(point, others)

    found = [gap(corner) for corner in corners]
    found += [gap(centre) - radius for centre, radius in discs]
    if len(body) > 2:
        found += [_from_polygon(R.T @ (point - root), own) for point in others]
    g_rows = ca.vertcat(*found) - asked
    return Element("obstacle", x, ca.vertcat(shape, asked), g=g_rows, lower=0.0, upper=np.inf)


def _from_polygon(point: Expr, corners: Sequence[Expr]) -> Expr:
    """Signed distance of a point from a convex polygon, counter-clockwise; C1 outside."""
    beyond, squared = [], []
    for a, b in zip(corners, [*corners[1:], corners[0]], strict=True):
        step, offset = b - a, point - a
        length = ca.sumsqr(step) + ROUND
        beyond.append((offset[0] * step[1] - offset[1] * step[0]) / ca.sqrt(length))
        share = ca.fmin(ca.fmax(ca.dot(offset, step) / length, 0), 1)
        squared.append(ca.sumsqr(offset - share * step))
    farthest = _fold(ca.fmax, beyond)
    return ca.if_else(farthest > 0, ca.sqrt(_fold(ca.fmin, squared) + ROUND), farthest)


def _from_ellipse(point: Expr, radii: Expr, rounds: int = 5) -> Expr:
    """Signed distance of a point from an ellipse about the origin, along the axes; inside, of its own measure."""
    squared = radii**2
    t = ca.SX(0)
    for _ in range(rounds):
        ratio = radii * point / (t + squared)
        size = ca.sqrt(ca.sumsqr(ratio) + ROUND)
        t = ca.fmax(t + (size - 1) * size**2 / (ca.dot(ratio, ratio / (t + squared)) + ROUND), 0)
    foot = squared * point / (t + squared)
    inside = (ca.sqrt(ca.sumsqr(point / radii) + ROUND) - 1) * ca.fmin(radii[0], radii[1])
    return ca.if_else(inside > 0, ca.sqrt(ca.sumsqr(point - foot) + ROUND), inside)


def _outermost(R_eb: Expr, body: Array, radii: Expr) -> list[Expr]:
    """The points of an ellipse farthest towards each edge of the body, in the ellipse's own frame."""
    out = []
    for a, b in zip(body, np.roll(body, -1, axis=0), strict=True):
        inwards = R_eb @ ca.DM([-(b - a)[1], (b - a)[0]])
        out.append(radii**2 * inwards / ca.sqrt(ca.sumsqr(radii * inwards) + ROUND))
    return out


def _fold(law: Any, values: Sequence[Expr]) -> Expr:
    folded = values[0]
    for value in values[1:]:
        folded = law(folded, value)
    return folded


# ------------------------------------------------------------ the vehicle from above


def simplified(polygon: Array, count: int) -> Array:
    """A convex polygon of at most ``count`` corners that contains ``polygon`` (k, 2) and little more."""
    while len(polygon) > count:
        added = [_without_edge(polygon, i) for i in range(len(polygon))]
        best = min(range(len(polygon)), key=lambda i: added[i][0])
        if not np.isfinite(added[best][0]):
            break
        polygon = added[best][1]
    return polygon


def _without_edge(polygon: Array, i: int) -> tuple[float, Array]:
    """The area added when edge ``i`` goes and its neighbours are drawn on until they meet; inf where they do not."""
    n = len(polygon)
    before, a, b, after = (polygon[k % n] for k in (i - 1, i, i + 1, i + 2))
    u, v = a - before, b - after
    cross = u[0] * v[1] - u[1] * v[0]
    if cross >= -1e-12:
        return np.inf, polygon
    offset = b - a
    corner = a + (offset[0] * v[1] - offset[1] * v[0]) / cross * u
    area = abs((b - a)[0] * (corner - a)[1] - (b - a)[1] * (corner - a)[0]) / 2
    kept = polygon.copy()
    kept[i] = corner
    return float(area), np.delete(kept, (i + 1) % n, axis=0)


def inner_discs(polygon: Array) -> list[tuple[Array, float]]:
    """Discs (centre (2,), radius m) within a convex polygon, from end to end, about a radius apart."""
    if len(polygon) < 3:
        return []
    low, high = polygon.min(axis=0), polygon.max(axis=0)
    grid = np.stack(np.meshgrid(*np.linspace(low, high, 41).T, indexing="ij"), axis=-1).reshape(-1, 2)
    step = np.roll(polygon, -1, axis=0) - polygon
    inward = np.stack([-step[:, 1], step[:, 0]], axis=-1) / np.linalg.norm(step, axis=1, keepdims=True)
    depth = ((grid[:, None] - polygon) * inward).sum(-1).min(axis=1)
    deep = np.flatnonzero(depth >= 0.8 * depth.max())
    along = grid[deep, int(np.argmax(high - low))]
    count = int(np.ceil(np.ptp(along) / depth.max())) + 1
    places = np.linspace(along.min(), along.max(), count)
    # where several are as near, the deepest
    chosen = {int(deep[np.argmin(np.abs(along - place) - 1e-3 * depth[deep])]) for place in places}
    return [(grid[n], float(depth[n])) for n in sorted(chosen)]


def _stretched(values: Array, shape: tuple[int, int]) -> Array:
    """Rows of ``values`` on another number of knots."""
    old, new = np.linspace(0, 1, values.shape[1]), np.linspace(0, 1, shape[1])
    return np.array([np.interp(new, old, row) for row in values])
