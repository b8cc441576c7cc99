"""Clearance of driving vehicles from obstacles: polygons and ellipses in plan view, exactly (NH IV.B).

The active set says which `features` of which parts have rows at which knots: those near the guess, and those that a
solution violates. The positions of parts are parameters, one per knot for moving parts, so that one built problem
serves all worlds with the same shapes.
"""

from __future__ import annotations

import warnings
from collections.abc import Hashable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from vehsim.clip.clip import Clip
from vehsim.lie.quaternions import yaw_of
from vehsim.planning.certificates import FINEST, certify_plane, certify_walls, extent
from vehsim.planning.constraints.block import Block, Finding
from vehsim.planning.constraints.features import CORNERS, Feature, Outline, bodies_of, element, form_of, gap
from vehsim.planning.outlines import bounds_to, simplified
from vehsim.planning.problem.elements import NonlinearProgram
from vehsim.planning.problem.layout import Layout
from vehsim.planning.problem.transcription import Transcription
from vehsim.planning.trajectory import Trajectory
from vehsim.runtime.progress import Progress
from vehsim.vehicles import Vehicle
from vehsim.world.ground.placing import place_on_terrain
from vehsim.world.ground.walls import Walls
from vehsim.world.obstacles.plane import placed

Array = NDArray[np.float64]
Active = NDArray[np.bool_]


class Poses(NamedTuple):
    """Those of a root: positions (knots, 2 or 3) m, headings (knots,) rad, seconds (knots,) since frame 0, and joints
    (knots, s) that turn trailers."""

    positions: Array
    yaw: Array
    seconds: Array
    joints: Array = np.zeros((1, 0))


SIGHT, SHARE = 1.0, 0.2
"""Distance from the guess beyond the requested clearance, m, within which a part is active at a knot, and its least
share of the vehicle's length. If an inactive part comes too near, this is found after the solve, and the part becomes
active: farther sight costs more in every iteration than it saves in repeated solves."""
DRAGGING = 3.0
"""The same while an obstacle is dragged, m: a motion may follow it by half of this before the problem is built anew."""
SPREAD = 2.0
"""Features of a part are active up to this much farther away than its nearest feature, m."""
LEANS = 0.005
"""Leaning may reduce the clearance by this much without another solve, m; the audit allows twice as much."""
BETWEEN = 0.005
"""Margin added to the requested clearance at knots, m, since the path between them curves; it grows where necessary."""


@dataclass(frozen=True, eq=False)
class ObstacleClearance(Block):
    """``clearance`` m from ``parts``, (obstacle, part index), for one vehicle on one discretisation.

    ``active`` (features, knots): which `features` have rows at which knots; ``extra`` (parts, knots): margin added to
    the clearance, m; ``sight`` m, see `SIGHT`; ``guess``: the poses at which the discretisation started.
    """

    vehicle: Vehicle
    parts: Sequence[tuple[Any, int]]
    clearance: float
    active: Active = field(default_factory=lambda: np.zeros((0, 0), bool))
    extra: Array = field(default_factory=lambda: np.zeros((0, 0)))
    sight: float = SIGHT
    guess: Poses | None = None
    levels: Sequence[float] = ()
    """The heights at which the vehicle passes the parts, m; trailers pass over what is lower than they are. By default
    zero."""
    features: Any = ()
    """All features: the index of the part, that of the vehicle's body, and the feature."""
    owners: Any = None
    """The part (features,) that each feature belongs to."""

    def __post_init__(self) -> None:
        if not len(self.levels):
            object.__setattr__(self, "levels", [0.0] * len(self.parts))
        if self.owners is None:
            features = [
                (row, number, one)
                for row, ((obstacle, k), level) in enumerate(zip(self.parts, self.levels, strict=True))
                for number, body in enumerate(bodies_of(self.vehicle))
                if body.trailer is None or body.trailer.meets(obstacle, level)
                for one in _features(_shape_of(obstacle, k), body.outline)
            ]
            object.__setattr__(self, "features", features)
            object.__setattr__(self, "owners", np.array([row for row, _, _ in features], np.intp))

    def key(self, layout: Layout, transcription: Transcription) -> Hashable:
        kinds = tuple((self.parts[row][0].name, row, self.parts[row][0].moves, *one) for row, *one in self.features)
        return kinds, self.active.tobytes()

    def activate(self, guess: Trajectory) -> ObstacleClearance:
        return self.near(poses_of(guess))

    def prolongate(self, coarse: Trajectory, fine: Trajectory) -> ObstacleClearance:
        return self.near(poses_of(fine))

    def near(self, poses: Poses) -> ObstacleClearance:
        """The block with features active near the initial poses of a discretisation; active features stay active."""
        block, shape = replace(self, guess=poses), (len(self.features), len(poses[0]))
        if self.active.shape != shape:
            knots = (len(self.parts), len(poses[0]))
            extra = _stretched(self.extra, knots) if self.extra.size else np.full(knots, BETWEEN)
            sight = max(SIGHT, SHARE * extent(self.vehicle))
            block = replace(block, extra=extra, active=np.zeros(shape, bool), sight=sight)
        return block._activated(block._gaps(poses))

    def violated(self, solved: Trajectory) -> ObstacleClearance:
        return self.violated_at(poses_of(solved))

    def violated_at(self, poses: Poses) -> ObstacleClearance:
        """The block with features active that come too near at solved poses; itself if there are none.

        It activates all features near these poses, and twice as far around the guess, since knots slide along the path.
        """
        gaps = self._gaps(poses)
        if not np.any(~self.active & (gaps < self.clearance - FINEST)):
            return self
        block = self._activated(gaps)
        block = replace(block, sight=2 * block.sight)
        return block if block.guess is None else block._activated(block._gaps(block.guess))

    def _activated(self, gaps: Array) -> ObstacleClearance:
        nearest = np.full((len(self.parts), gaps.shape[1]), np.inf)
        np.minimum.at(nearest, self.owners, gaps)
        reach = np.minimum(self.clearance + self.sight, np.maximum(nearest, self.clearance)[self.owners] + SPREAD)
        return replace(self, active=self.active | (gaps < reach))

    def _gaps(self, poses: Poses) -> Array:
        """Distance of every feature at poses, (features, knots) m; inf beyond `sight` and at the start of the
        motion."""
        features, seconds = self.features, poses.seconds
        out, reach = np.full((len(features), len(seconds)), np.inf), self.clearance + self.sight
        shapes = [obstacle.shapes_at(seconds)[k] for obstacle, k in self.parts]
        numbers = [_numbers(*part, seconds) for part in self.parts]
        for number, body in enumerate(bodies_of(self.vehicle)):
            pose = np.asarray(body.pose(np.vstack([poses.yaw, poses.positions.T[:2]]), poses.joints.T))
            outlines = placed(np.array(body.outline), pose[1:].T, pose[0])
            near = np.array([bounds_to(shape, outlines) < reach for shape in shapes])
            near[:, 0] = False  # the start of the motion is fixed
            for kind in dict.fromkeys(feature.kind for _, own, feature in features if own == number):
                of_kind = [n for n, (_, own, feature) in enumerate(features) if (own, feature.kind) == (number, kind)]
                where = [(n, np.flatnonzero(near[self.owners[n]])) for n in of_kind]
                columns = [_columns(features[n][2], numbers[self.owners[n]], pose, knots) for n, knots in where]
                rows, at = np.repeat(of_kind, [len(k) for _, k in where]), np.concatenate([k for _, k in where])
                if len(rows):
                    found = gap(kind, body.outline)(*map(np.hstack, zip(*columns, strict=True)))
                    out[rows, at] = np.asarray(found).ravel()
        return out

    def add_active(self, problem: NonlinearProgram, transcription: Transcription, layout: Layout) -> None:
        uses: dict[Any, list[tuple[Any, ...]]] = {}
        names: dict[Any, list[str]] = {}
        features, owners = self.features, self.owners
        for part, knots in self._active_at():
            obstacle, number = self.parts[part]
            width = len(_numbers(obstacle, number, np.zeros(1)))
            numbers = problem.parameter(_place(part), width, len(knots) if obstacle.moves else 1)
            needed = problem.parameter(_clearance_of(part), 1, len(knots))
            for n in np.flatnonzero((owners == part) & self.active.any(axis=1)):
                (_, body, feature), here = features[n], self.active[n, knots]
                own = np.broadcast_to(numbers, (width, len(knots)))[list(feature.numbers)][:, here]
                constants = np.tile(np.array(feature.constants)[:, None], np.sum(here))
                key = feature.kind, body
                uses.setdefault(key, []).append((layout.knot(knots[here]), own, needed[:, here], constants))
                names.setdefault(key, []).extend([f"obstacle {obstacle.name!r}"] * int(here.sum()))
        for key, found in uses.items():
            variables, own, needed, constants = map(np.hstack, zip(*found, strict=True))
            parameters = {"numbers": own, "clearance": needed}
            problem.add(element(transcription, *key), variables, parameters, {"constants": constants}, names[key])

    def values(self, trajectory: Trajectory) -> Mapping[str, Any]:
        seconds, values = trajectory.seconds(), {}
        for part, knots in self._active_at():
            values[_place(part)] = _numbers(*self.parts[part], seconds[knots])
            values[_clearance_of(part)] = self.clearance + self.extra[part, knots][None]
        return values

    def _active_at(self) -> Iterator[tuple[int, NDArray[np.intp]]]:
        """Every part with an active feature, and the knots at which it has one."""
        owners = self.owners
        for part in range(len(self.parts)):
            knots = np.flatnonzero(self.active[owners == part].any(axis=0))
            if len(knots):
                yield part, knots

    def measure(self, trajectory: Trajectory, clip: Clip, progress: Progress | None) -> Finding:
        """The smallest clearance, and the shortfall per part and segment."""
        nearest, by_segment = certify_plane(clip, self.parts, self.clearance, levels=self.levels)
        leaning = self._leaning(trajectory, clip, by_segment)
        nearest, by_segment = min(nearest, float(leaning.min(initial=np.inf))), np.minimum(by_segment, leaning)
        lack = np.maximum(self.clearance - by_segment, 0.0)
        return Finding(nearest, self.clearance, bool(nearest >= self.clearance - FINEST), lack)

    def _leaning(self, trajectory: Trajectory, clip: Clip, by_segment: Array) -> Array:
        """Distances (parts, segments) m of the hulls as they lean on terrain: of obstacles at whole frames, of rock
        always; inf where they are not smaller than the clearance by more than `LEANS`."""
        request, apart = trajectory.request, np.full((len(self.parts), max(len(clip) - 1, 1)), np.inf)
        world, vehicle = request.world, request.vehicle
        if world.terrain is None or vehicle.rig is None or len(clip) < 2:
            return apart
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # the finished motion warns
            placed = place_on_terrain(replace(clip, vehicle=vehicle), world, samples=1)
        seconds = placed.start_frame / float(placed.fps) + placed.times
        poses = placed.positions, placed.orientations
        gaps = world.clearance_by_obstacle(vehicle, *poses, seconds, placed.channels)
        rock = [row for row, (obstacle, _) in enumerate(self.parts) if isinstance(obstacle, Walls)]
        if rock:
            begins = np.clip(np.searchsorted(clip.times, placed.times[:-1], "right") - 1, 0, len(clip) - 2)
            by_interval = certify_walls(placed, world)[1]
            here = np.full(apart.shape[1], np.inf)
            np.minimum.at(here, begins, by_interval)
            row = np.array(rock)[by_segment[rock].argmin(axis=0)]  # the wall that is nearest in plan view
            near = here < self.clearance - LEANS
            apart[row[near], np.flatnonzero(near)] = here[near]
        segment = np.clip(np.searchsorted(clip.times, placed.times, "right") - 1, 0, len(clip) - 2)
        columns = {id(obstacle): k for k, obstacle in enumerate(world.obstacles)}
        for row, (obstacle, _) in enumerate(self.parts):
            if id(obstacle) not in columns:
                continue
            here = gaps[:, columns[id(obstacle)]]
            near = here < self.clearance - LEANS
            np.minimum.at(apart[row], segment[near], here[near])
        return apart

    def tighten(self, trajectory: Trajectory, finding: Finding) -> ObstacleClearance:
        """The block with a larger margin at both knots of segments that lack clearance."""
        if finding.met:
            return self
        extra, beside = self.extra.copy(), np.zeros_like(self.extra)
        beside[:, :-1] = finding.lack
        beside[:, 1:] = np.maximum(beside[:, 1:], finding.lack)
        beside[:, 0] = 0.0
        for part, knots in self._active_at():  # inactive parts only need to become active
            extra[part, knots] += np.where(beside[part, knots] > 0, beside[part, knots] + FINEST, 0.0)
            beside[part, knots] = 0.0
        return replace(self, extra=extra, active=self.active | (beside[self.owners] > 0))

    def resume(self, earlier: ObstacleClearance, solved: Trajectory) -> ObstacleClearance:
        """If only the places of obstacles differ, the active set is kept while it contains all that is near: one built
        problem then serves many places."""
        same = len(self.parts) == len(earlier.parts)
        if same and all(a is b for (a, _), (b, _) in zip(self.parts, earlier.parts, strict=True)):
            return earlier
        poses = poses_of(solved)
        if self.features != earlier.features:
            return self.near(poses)
        block = replace(self, active=earlier.active, extra=earlier.extra, guess=poses, sight=DRAGGING)
        gaps = block._gaps(poses)
        missing = ~block.active & (gaps < self.clearance + DRAGGING / 2)
        return replace(block, active=np.zeros_like(block.active))._activated(gaps) if missing.any() else block


def _place(part: int) -> str:
    return f"obstacle[{part}].numbers"


def _clearance_of(part: int) -> str:
    return f"obstacle[{part}].clearance"


def poses_of(trajectory: Trajectory) -> Poses:
    """The poses at a driving vehicle's knots."""
    return Poses(*trajectory.poses(), trajectory.seconds(), trajectory.knots()[1])


def _shape_of(obstacle: Any, number: int) -> Any:
    """A part as the optimiser models it; that of a vehicle in its root's frame."""
    return simplified(obstacle.outline, CORNERS) if obstacle.moves else obstacle.parts[number]


def _features(shape: Any, outline: Outline) -> list[Feature]:
    return form_of(shape).features(shape, outline)


def _numbers(obstacle: Any, number: int, seconds: Array) -> Array:
    """The numbers (width, 1) of a part, or (width, knots) at ``seconds`` if it moves."""
    shape = _shape_of(obstacle, number)
    if not obstacle.moves:
        return form_of(shape).numbers(shape)[:, None]
    positions, orientations = obstacle.poses_at(seconds)
    return placed(shape, positions[:, :2], yaw_of(orientations)).reshape(len(seconds), -1).T


def _columns(feature: Feature, numbers: Array, poses: Array, knots: NDArray[np.intp]) -> tuple[Array, Array, Array]:
    """Pose, numbers and constants of a feature at knots, one column each."""
    own = numbers[list(feature.numbers)]
    own = np.tile(own, len(knots)) if own.shape[1] == 1 else own[:, knots]
    return poses[:, knots], own, np.tile(np.array(feature.constants)[:, None], len(knots))


def _stretched(values: Array, shape: tuple[int, int]) -> Array:
    """Rows of ``values`` resampled to another number of knots."""
    old, new = np.linspace(0, 1, values.shape[1]), np.linspace(0, 1, shape[1])
    return np.array([np.interp(new, old, row) for row in values])
