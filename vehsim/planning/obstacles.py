"""Obstacles as constraints: what drives stays clear of polygons and ellipses, exactly (NH IV.B).

Which parts, and which `features` of theirs, the problem has rows for at which knot: what is near the guess, and what a
solved motion ran through unseen. Where parts stand is a parameter of the problem, one for every knot when they move, so
problems are built once for all worlds of a shape.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from vehsim.errors import InputError
from vehsim.planning.certify import FINEST
from vehsim.planning.cover import attitude
from vehsim.planning.elements import Problem
from vehsim.planning.features import CORNERS, Feature, body_of, element, form_of, gap
from vehsim.planning.legs import fixed_durations, legs_between, path_length
from vehsim.planning.marks import Mark, leeway
from vehsim.planning.outlines import bounds_to, clearances, simplified
from vehsim.planning.transcription import Layout, Transcription
from vehsim.vehicles import Vehicle
from vehsim.world.obstacles import footprint, headings, vertical_reach
from vehsim.world.plane import placed
from vehsim.world.swings import swings

if TYPE_CHECKING:
    from vehsim.planning.request import Request

Array = NDArray[np.float64]
Seen = NDArray[np.bool_]

SIGHT = 3.0
"""How far from the first guess a part is seen at a knot, beyond the clearance asked for, m. What comes too near
unseen is found when it is solved, and seen from then on."""
SPREAD = 2.0
"""How much farther away than the nearest feature of a part others of it are seen, m."""
BETWEEN = 0.005
"""What knots demand beyond the clearance asked for, m, since the way between them bends; more where that is not enough.
"""
DODGES = 4
"""How often a first guess is sought that is not in the way of what moves."""
TURNS = 180
"""Headings tried at a mark that leaves it open."""
BRISK = 5.0
"""Guess of how fast a leg between free marks is driven, m/s."""


@dataclass(eq=False)
class Rows:
    """The rows that keep one vehicle clear of a world's obstacles on one discretisation.

    ``parts``: (obstacle, part number); ``seen`` (features, knots): which `features` are rows of the problem where;
    ``extra`` (parts, knots): what each demands beyond the clearance asked for, m; ``sight`` m, see `SIGHT`.
    """

    vehicle: Vehicle
    parts: list[tuple[Any, int]]
    seen: Seen = field(default_factory=lambda: np.zeros((0, 0), bool))
    extra: Array = field(default_factory=lambda: np.zeros((0, 0)))
    sight: float = SIGHT
    _guessed: tuple[Array, Array, Array] | None = None

    @cached_property
    def features(self) -> list[tuple[int, Feature]]:
        """All that may be nearest: the number of its part, and the feature."""
        shapes, body = [_shape_of(*part) for part in self.parts], body_of(self.vehicle)
        return [(row, feature) for row, shape in enumerate(shapes) for feature in form_of(shape).features(shape, body)]

    @cached_property
    def owners(self) -> NDArray[np.intp]:
        """The part (features,) that each feature belongs to."""
        return np.array([row for row, _ in self.features], np.intp)

    @property
    def key(self) -> Any:
        """Equal for problems that differ in parameters alone."""
        kinds = tuple((row, self.parts[row][0].moves, feature) for row, feature in self.features)
        return kinds, self.seen.tobytes()

    def look(self, positions: Array, yaw: Array, seconds: Array, clearance: float) -> None:
        """See what is near the guessed poses (knots, ...) of a discretisation; what was seen already stays."""
        self._guessed, shape = (positions, yaw, seconds), (len(self.features), len(positions))
        if self.seen.shape != shape:
            knots = (len(self.parts), len(positions))
            self.extra = _stretched(self.extra, knots) if self.extra.size else np.full(knots, BETWEEN)
            self.seen, self.sight = np.zeros(shape, bool), SIGHT
        self._see(self._gaps(positions, yaw, seconds, clearance), clearance)

    def overlooked(self, positions: Array, yaw: Array, seconds: Array, clearance: float) -> bool:
        """Whether solved poses (knots, ...) come too near to what is unseen there; all near them is seen from now on,
        and twice as far about the guess: knots slide along it."""
        gaps = self._gaps(positions, yaw, seconds, clearance)
        missed = bool(np.any(~self.seen & (gaps < clearance - FINEST)))
        if missed:
            self._see(gaps, clearance)
            self.sight *= 2
            if self._guessed is not None:
                self._see(self._gaps(*self._guessed, clearance), clearance)
        return missed

    def _see(self, gaps: Array, clearance: float) -> None:
        nearest = np.full((len(self.parts), gaps.shape[1]), np.inf)
        np.minimum.at(nearest, self.owners, gaps)
        self.seen |= gaps < np.minimum(clearance + self.sight, np.maximum(nearest, clearance)[self.owners] + SPREAD)

    def _gaps(self, positions: Array, yaw: Array, seconds: Array, clearance: float) -> Array:
        """How far every feature is at poses (knots, ...), (features, knots) m; inf beyond sight and where it starts."""
        body, out = body_of(self.vehicle), np.full((len(self.features), len(yaw)), np.inf)
        outlines = placed(np.array(body), positions[:, :2], yaw)
        near = np.array([bounds_to(o.shapes_at(seconds)[k], outlines) < clearance + self.sight for o, k in self.parts])
        near[:, 0] = False  # where it starts is given
        poses, numbers = np.vstack([yaw, positions[:, :2].T]), [_numbers(*part, seconds) for part in self.parts]
        for kind in dict.fromkeys(feature.kind for _, feature in self.features):
            of_kind = [n for n, (_, feature) in enumerate(self.features) if feature.kind == kind]
            where = [(n, np.flatnonzero(near[self.owners[n]])) for n in of_kind]
            columns = [_columns(self.features[n][1], numbers[self.owners[n]], poses, knots) for n, knots in where]
            rows, at = np.repeat(of_kind, [len(knots) for _, knots in where]), np.concatenate([k for _, k in where])
            if len(rows):
                found = gap(kind, body)(*map(np.hstack, zip(*columns, strict=True)))
                out[rows, at] = np.asarray(found).ravel()
        return out

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
        moving = [(o, k) for o, k in self.parts if o.moves and not o.stands]
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
        """The rows, and parameters for them behind those the problem has: as `values` lays them out."""
        rows: dict[Any, list[tuple[Any, ...]]] = {}
        names: dict[Any, list[str]] = {}
        first = problem.parameters
        for row, knots in self._seen_at():
            obstacle, number = self.parts[row]
            width = len(_numbers(obstacle, number, np.zeros(1)))
            place = first + width * obstacle.moves * np.arange(len(knots))
            margins = first + width * (len(knots) if obstacle.moves else 1) + np.arange(len(knots))
            for n in np.flatnonzero((self.owners == row) & self.seen.any(axis=1)):
                feature, here = self.features[n][1], self.seen[n, knots]
                p = np.vstack([place[here] + np.array(feature.numbers)[:, None], margins[here]])
                constants = np.tile(np.array(feature.constants)[:, None], np.sum(here))
                rows.setdefault(feature.kind, []).append((layout.knot(knots[here]), p, constants))
                names.setdefault(feature.kind, []).extend([f"obstacle {obstacle.name!r}"] * int(here.sum()))
            first = int(margins[-1]) + 1
        problem.parameters = first
        for kind, uses in rows.items():
            variables, p, constants = map(np.hstack, zip(*uses, strict=True))
            problem.add(element(t, kind), variables, p, constants, names[kind])

    def values(self, seconds: Array, clearance: float) -> Array:
        """The parameters that `add` laid out: ``seconds`` (knots,) since frame 0, when the vehicle is at its knots."""
        out: list[Array] = []
        for row, knots in self._seen_at():
            numbers = _numbers(*self.parts[row], seconds[knots])
            out += [numbers.T.ravel(), clearance + self.extra[row, knots]]
        return np.concatenate([np.zeros(0), *out])

    def _seen_at(self) -> Iterator[tuple[int, NDArray[np.intp]]]:
        """Every part seen anywhere, and the knots at which any feature of it is."""
        for row in range(len(self.parts)):
            knots = np.flatnonzero(self.seen[self.owners == row].any(axis=0))
            if len(knots):
                yield row, knots

    def tighten(self, lack: Array, positions: Array, yaw: Array, seconds: Array, clearance: float) -> None:
        """Demand more at both knots of the segments where a certified motion, at these poses (knots, ...), lacks
        clearance: (parts, segments) m. What swings out comes nearer than the rest, of which rows know: that has to give
        way from where it is."""
        beside = np.zeros_like(self.extra)
        beside[:, :-1] = lack
        beside[:, 1:] = np.maximum(beside[:, 1:], lack)
        beside[:, 0] = 0.0
        if swings(self.vehicle):
            gaps = np.full_like(self.extra, np.inf)
            np.minimum.at(gaps, self.owners, self._gaps(positions, yaw, seconds, clearance))
            given = (beside > 0) & np.isfinite(gaps)
            self.extra[given] = np.maximum(self.extra, gaps - clearance)[given]
        for row, knots in self._seen_at():  # the unseen need only be seen
            self.extra[row, knots] += np.where(beside[row, knots] > 0, beside[row, knots] + FINEST, 0.0)
            beside[row, knots] = 0.0
        self.seen |= beside[self.owners] > 0


def obstacle_rows(vehicle: Vehicle, world: Any, marks: Sequence[Any]) -> Rows | None:
    """The rows for the obstacles of ``world`` that a vehicle driving at the marks' height can touch, or None."""
    if world is None or not vehicle.group.planar or not world.obstacles:
        return None
    height = 0.0 if marks[0].position is None else float(marks[0].position[2])
    low, high = vertical_reach(vehicle)
    parts = [
        (obstacle, number)
        for obstacle in world.obstacles
        if obstacle.bottom < height + high and obstacle.top > height + low
        for number in range(1 if obstacle.moves else len(obstacle.parts))
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

    A mark without a heading may have any, what flies without an attitude is asked for its root alone; one with a
    tolerance or a gate may give way by that.
    """
    if vehicle.group.dim == 6:
        yield from _flown_too_near(vehicle, world, marks, clearance)
        return
    rows = obstacle_rows(vehicle, world, marks)
    still = [] if rows is None else [(o, k) for o, k in rows.parts if not o.moves]
    for i, mark in enumerate(marks if still else ()):
        if mark.position is None:
            continue
        outline, place = footprint(vehicle), np.array([mark.position[:2]], float)
        faced = mark.heading is not None
        yaw = np.deg2rad([mark.heading] if faced else np.arange(TURNS) * 360 / TURNS)
        between = 0.0 if faced else np.pi / TURNS * float(np.linalg.norm(outline, axis=1).max())
        seconds = np.zeros(len(yaw))
        near = clearances(still, placed(outline, np.repeat(place, len(yaw), axis=0), yaw), seconds)
        best = int(near.min(axis=0).argmax())
        gap, name = float(near[:, best].min()), still[int(near[:, best].argmin())][0].name
        if gap + leeway(mark) + between < clearance - FINEST:
            yield i, *_nearness(gap, name, clearance, "" if faced else " at any heading")


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
        gap, name = float(gaps.min()), world.obstacles[int(gaps.argmin())].name
        if gap + leeway(mark) < (clearance - FINEST if turned else 0.0):
            yield i, *_nearness(gap, name, clearance)


def _nearness(gap: float, name: str, clearance: float, heading: str = "") -> tuple[str, str]:
    """Message and mend of a mark at ``gap`` m from an obstacle."""
    if gap <= 0:
        return f"in obstacle {name!r}{heading}", "move the mark or the obstacle"
    mend = f"keep the clearance of {clearance:g} m, or ask for less"
    return f"only {gap:.2f} m from obstacle {name!r}{heading}", mend


def _shape_of(obstacle: Any, number: int) -> Any:
    """A part as the optimiser sees it; a vehicle's in its root's frame."""
    return simplified(obstacle.outline, CORNERS) if obstacle.moves else obstacle.parts[number]


def _numbers(obstacle: Any, number: int, seconds: Array) -> Array:
    """The numbers (width, 1) of a part as the optimiser sees it; where it moves, (width, knots) at ``seconds``."""
    shape = _shape_of(obstacle, number)
    if not obstacle.moves:
        return form_of(shape).numbers(shape)[:, None]
    positions, orientations = obstacle.poses_at(seconds)
    return placed(shape, positions[:, :2], headings(orientations)).reshape(len(seconds), -1).T


def _columns(feature: Feature, numbers: Array, poses: Array, knots: NDArray[np.intp]) -> tuple[Array, Array, Array]:
    """Pose, numbers and constants of a feature at knots, a column each."""
    own = numbers[list(feature.numbers)]
    own = np.tile(own, len(knots)) if own.shape[1] == 1 else own[:, knots]
    return poses[:, knots], own, np.tile(np.array(feature.constants)[:, None], len(knots))


def _stretched(values: Array, shape: tuple[int, int]) -> Array:
    """Rows of ``values`` on another number of knots."""
    old, new = np.linspace(0, 1, values.shape[1]), np.linspace(0, 1, shape[1])
    return np.array([np.interp(new, old, row) for row in values])
