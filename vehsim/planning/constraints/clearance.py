"""Clearance in flight: spheres around the vehicle's hulls stay out of distance fields of terrain and obstacles.

Everything at rest is one field. Each moving obstacle has a field in its own frame, and its poses are parameters; so has
an obstacle at rest while it is dragged. Near a landing the requested clearance decreases, see
`landing.landing_clearance`. The finished motion is certified with the hulls themselves; if it comes too near, the
requested clearance is increased. Where no motion is found because spheres reach farther than the hulls that they
contain, the difference is measured and the problem solved again.
"""

from __future__ import annotations

from collections.abc import Callable, Container, Hashable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from vehsim.clip.clip import Clip
from vehsim.lie import SO3
from vehsim.planning.certificates import FINEST, certify
from vehsim.planning.constraints.block import Block, Finding
from vehsim.planning.constraints.spheres import sphere_cover, surface_by_sphere
from vehsim.planning.problem.elements import Element, NonlinearProgram, SpatialField, second_order
from vehsim.planning.problem.layout import Layout
from vehsim.planning.problem.stage import knot_view, middle_view
from vehsim.planning.problem.transcription import Transcription
from vehsim.planning.request.landing import (
    ROUND,
    SLOPE,
    attitude,
    forgiven,
    landing_clearance,
    landings,
    rounded_distance,
)
from vehsim.planning.request.marks import Mark
from vehsim.planning.request.request import ROOM, Request, search_boxes
from vehsim.planning.terms import COSTS, HazardView, KnotView, costs_of, weight_of
from vehsim.planning.trajectory import Trajectory
from vehsim.runtime.progress import Progress
from vehsim.world.distance.field import DistanceField, field_about
from vehsim.world.obstacles.obstacles import Moving, Obstacle

Array = NDArray[np.float64]

AROUND = 4.0
"""Margin of a moving obstacle's field beyond the clearance and the largest sphere, m."""
SIGHT = 4.0
"""Distance beyond the requested clearance, m, within which terrain stays active on a finer discretisation of a
motion."""
DRAGGING = 12.0
"""The same while an obstacle is dragged, m: a motion may follow it by half of this before the problem is built anew."""
SLACK = 0.01
"""Tolerance of a certified clearance, m."""
ROOMY = 0.25
"""How much farther than the spheres the vehicle's surface must be for them to be in the way, m."""
SAME = 1e-6
"""Largest difference between two shapes, relative to their size, that counts as none."""
DRAGGED = 64_000
"""Largest number of points of the field of an obstacle that is dragged; it is measured in a sixth of a second."""
MORE = 0.05
"""What a tighter solve adds to the clearance beyond the shortfall, m."""


@dataclass(frozen=True, eq=False)
class Hazard:
    """A distance field to keep clear of, in the frame of its ``obstacle`` if that moves; ``name``: prefix of its
    parameters' names."""

    name: str
    field: DistanceField
    obstacle: Moving | Dragged | None = None

    @property
    def moves(self) -> bool:
        return self.obstacle is not None


@dataclass(frozen=True)
class Site:
    """A kind of place at which clearance is enforced.

    ``variables``: those of a segment that determine the vehicle's pose there; ``view``: computed from their symbols.
    """

    name: str
    variables: tuple[str, ...]
    view: Callable[[Transcription, Mapping[str, Any]], KnotView]


def _none(transcription: Transcription) -> Any:
    """Zero controls: the pose does not depend on them."""
    return ca.SX.zeros(transcription.sizes[3])


KNOTS = Site("nodes", ("x", "h"), lambda t, v: knot_view(t, v["x"], _none(t)))
"""The nodes of the discretisation."""
MIDDLES = Site("middles", ("x", "z", "h"), lambda t, v: middle_view(t, v["x"], v["z"], _none(t), v["h"]))
"""The midpoints of its segments."""


@dataclass(frozen=True, eq=False)
class Dragged:
    """An obstacle at rest that is moved from solve to solve: ``obstacle`` where its field was measured, and the
    displacement ``position`` (3,) m and turn ``orientation`` (4,) since then."""

    obstacle: Obstacle
    position: Array = field(default_factory=lambda: np.zeros(3))
    orientation: Array = field(default_factory=lambda: np.array([1.0, 0.0, 0.0, 0.0]))

    @property
    def name(self) -> str:
        return self.obstacle.name

    def poses_at(self, seconds: Array) -> tuple[Array, Array]:
        """Positions (n, 3) m and orientations (n, 4) at ``seconds`` (n,)."""
        return np.tile(self.position, (len(seconds), 1)), np.tile(self.orientation, (len(seconds), 1))

    def to(self, obstacle: Obstacle) -> Dragged | None:
        """The same obstacle moved to another; None if that has another shape."""
        from scipy.spatial.transform import Rotation

        before, after = np.vstack(self.obstacle.hulls), np.vstack(obstacle.hulls)
        if before.shape != after.shape:
            return None
        middle = before.mean(axis=0), after.mean(axis=0)
        turn, off = Rotation.align_vectors(after - middle[1], before - middle[0])
        if off > SAME * np.linalg.norm(before - middle[0]):
            return None
        return replace(
            self, position=middle[1] - turn.apply(middle[0]), orientation=np.roll(turn.as_quat(canonical=True), 1)
        )


@dataclass(eq=False)
class SphereCover:
    """A sphere cover of a vehicle, and the distance fields it keeps clear of.

    ``centres`` (k, 3) m and ``radii`` (k,) m of spheres that contain the vehicle; ``static``: the distance field of
    the static obstacles and the terrain, or None; ``moving``: each moving or dragged obstacle with its field;
    ``elements``: shared by all discretisations.
    """

    static: DistanceField | None
    centres: Array
    radii: Array
    moving: tuple[tuple[Moving | Dragged, DistanceField], ...] = ()
    elements: dict[Any, Element] = field(default_factory=dict)

    def hazards(self) -> Iterator[Hazard]:
        """Everything at rest, then each moving obstacle."""
        if self.static is not None:
            yield Hazard("standing", self.static)
        for i, (obstacle, own) in enumerate(self.moving):
            yield Hazard(f"moving[{i}]", own, obstacle)

    @property
    def dragged(self) -> set[str]:
        """The names of the obstacles that are dragged."""
        return {obstacle.name for obstacle, _ in self.moving if isinstance(obstacle, Dragged)}

    @property
    def fields(self) -> tuple[DistanceField, ...]:
        """What a built problem contains of it; the poses of obstacles are parameters."""
        return tuple(hazard.field for hazard in self.hazards())


@dataclass(frozen=True, eq=False)
class Clearance(Block):
    """``required`` m from terrain and obstacles, for the spheres at every knot but the first and once per segment.

    ``cover``: None in free space. ``near`` (hazards, places): where the field of each hazard is active; None:
    everywhere. This block also adds the costs whose laws take a `HazardView`, everywhere.
    """

    request: Request
    cover: SphereCover | None
    required: float
    near: NDArray[np.bool_] | None = None
    spare: Array | None = None
    """(places, k) m: how much farther than each sphere the vehicle's surface in it is from everything at rest; None:
    the spheres count."""

    @property
    def costs(self) -> tuple[str, ...]:
        """Names of the costs of proximity with a weight above zero."""
        return costs_of(HazardView, self.request.weights)

    def key(self, layout: Layout, transcription: Transcription) -> Hashable:
        landed = tuple(mark.on_ground for mark in self.request.marks)
        spare = self.spare is not None
        fields = None if self.cover is None else self.cover.fields
        return fields, self.costs, landed, spare, None if self.near is None else self.near.tobytes()

    def add(self, problem: NonlinearProgram, transcription: Transcription, layout: Layout) -> None:
        if self.cover is None:
            return
        marks = self.request.marks
        landed = self._landings()
        touching = [problem.parameter(_touching(i), 3 + len(self.cover.radii)) for i in landed]
        slope = problem.parameter("landing slope", 1) if landed else np.zeros(0, np.intp)
        for row, hazard in enumerate(self.cover.hazards()):
            for site, y in _places(layout, marks).items():
                y = y if self.near is None else y[:, _split(self.near[row], layout, marks)[site]]
                if hazard.moves:
                    parameters = {"pose": problem.parameter(f"{hazard.name}.pose at {site.name}", 12, y.shape[1])}
                else:
                    parameters = {"landings": np.concatenate([np.zeros(0, np.intp), *touching]), "slope": slope}
                    if self.spare is not None:
                        count = len(self.cover.radii), y.shape[1]
                        parameters["spare"] = problem.parameter(_spare(site), *count)
                if y.shape[1]:
                    problem.add(self._element(transcription, hazard, site), y, parameters)

    def values(self, trajectory: Trajectory) -> Mapping[str, Any]:
        values: dict[str, Any] = {"clearance": self.required}
        if self.cover is None:
            return values
        values |= {weight_of(name): self.request.weights[name] for name in self.costs}
        if self.cover.static is not None:
            landed = self._landings()
            values |= {_touching(i): self._touching(mark) for i, mark in landed.items()}
            if landed:  # a tighter clearance must be tighter near the landing too
                values["landing slope"] = SLOPE * self.required / max(self.request.clearance, SLACK)
        for row, hazard in enumerate(self.cover.hazards()):
            if hazard.obstacle is not None:
                positions, orientations = hazard.obstacle.poses_at(_seconds(trajectory))
                poses = np.hstack([positions, SO3.matrix(orientations).transpose(0, 2, 1).reshape(-1, 9)])
                for site, here in self._active(poses, row, trajectory).items():
                    values[f"{hazard.name}.pose at {site.name}"] = here.T
            elif self.spare is not None:
                for site, here in self._active(self.spare, row, trajectory).items():
                    values[_spare(site)] = here.T
        return values

    def _active(self, values: Array, row: int, trajectory: Trajectory) -> dict[Site, Array]:
        """Values (places, ...) by site, where the hazard of this row is active."""
        near = np.ones(len(values), bool) if self.near is None else self.near[row]
        split = _split(values, trajectory.layout, self.request.marks)
        active = _split(near, trajectory.layout, self.request.marks)
        return {site: here[active[site]] for site, here in split.items()}

    def _landings(self) -> dict[int, Mark]:
        """The marks on the ground by index, each once even if held; empty if nothing is at rest."""
        assert self.cover is not None
        if self.cover.static is None:
            return {}
        return {i: mark for i, mark in enumerate(self.request.marks) if mark.on_ground and not mark.hold}

    def _touching(self, mark: Mark) -> Array:
        """The position (3,) m of a mark's root, and the distances (k,) m of its spheres from everything at rest."""
        assert self.cover is not None and self.cover.static is not None
        place = np.asarray(mark.position, float)
        centres = place + self.cover.centres @ SO3.matrix(attitude(mark)).T
        return np.concatenate([place, self.cover.static.value(centres) - self.cover.radii])

    def _element(self, transcription: Transcription, hazard: Hazard, site: Site) -> Element:
        assert self.cover is not None
        landed = len(self._landings())
        spare = self.spare is not None and not hazard.moves
        key = hazard.name, site.name, landed, self.costs, spare
        if key not in self.cover.elements:
            made = clearance_element(transcription, self.cover, hazard, site, landed, self.costs, spare)
            self.cover.elements[key] = made
        return self.cover.elements[key]

    def distances(self, trajectory: Trajectory) -> Array:
        """Distance of the nearest sphere from each hazard at every place, (hazards, places) m."""
        assert self.cover is not None
        positions, rotations = self._poses(trajectory)
        found = [np.zeros((0, len(positions)))]
        for hazard in self.cover.hazards():
            there = positions, rotations
            if hazard.obstacle is not None:
                origin, turn = hazard.obstacle.poses_at(_seconds(trajectory))
                R_ow = SO3.matrix(turn).transpose(0, 2, 1)
                there = np.squeeze(R_ow @ (positions - origin)[..., None], -1), R_ow @ rotations
            found.append(self._spheres(hazard.field, *there).min(axis=1)[None])
        return np.vstack(found)

    def of_surface(self, trajectory: Trajectory) -> Clearance:
        """The block for the vehicle's surface, instead of the spheres, near the poses of a trajectory; unchanged if
        nothing is at rest."""
        if self.cover is None or self.cover.static is None:
            return self
        positions, rotations = self._poses(trajectory)
        spheres = self._spheres(self.cover.static, positions, rotations)
        more = self._surface(spheres, positions, rotations) - spheres
        return replace(self, spare=np.maximum(more, 0.0))

    def presses(self, trajectory: Trajectory) -> bool:
        """Whether spheres bound a motion somewhere although the vehicle's surface has `ROOMY` m to spare there."""
        if self.cover is None or self.cover.static is None or self.spare is not None or self._landings():
            return False
        positions, rotations = self._poses(trajectory)
        spheres = self._spheres(self.cover.static, positions, rotations)
        bound = spheres.min(axis=1) < self.required + SLACK
        return any(self._with_room(spheres[bound], positions[bound], rotations[bound], self.required + ROOMY))

    def squeezes(self, guess: Trajectory) -> bool:
        """Whether along a guess the vehicle's surface has room everywhere, but the spheres do not.

        At marks, where the motion cannot give way, spheres that are a little too near count.
        """
        if self.cover is None or self.cover.static is None or self.spare is not None or self._landings():
            return False
        given = [i for i, mark in enumerate(self.request.marks) if mark.position is not None]
        at_marks = {KNOTS: _knots(guess.layout, guess.layout.mark_knots[given])}
        for places, room in ((None, ROOMY), (at_marks, FINEST)):
            positions, rotations = self._poses(guess, places)
            spheres = self._spheres(self.cover.static, positions, rotations)
            tight = spheres.min(axis=1) < self.required - room
            here = spheres[tight], positions[tight], rotations[tight]
            if tight.any() and all(self._with_room(*here, self.required - FINEST)):
                return True
        return False

    def _poses(
        self, trajectory: Trajectory, places: Mapping[Site, NDArray[np.intp]] | None = None
    ) -> tuple[Array, Array]:
        """Positions (places, 3) m and rotations (places, 3, 3) of the vehicle; ``places``: as from `_places`, which is
        the default."""
        found = [np.zeros((0, 12))]
        for site, y in (places or _places(trajectory.layout, self.request.marks)).items():
            if y.shape[1]:
                pose = _pose_at(trajectory.transcription, site)
                found.append(np.asarray(pose.map(y.shape[1])(trajectory.x[y])).T)
        positions, columns = np.split(np.vstack(found), [3], axis=1)
        return positions, columns.reshape(-1, 3, 3).transpose(0, 2, 1)

    def _spheres(self, field: DistanceField, positions: Array, rotations: Array) -> Array:
        """Distance (places, k) m of every sphere, by a ``field`` in whose frame the vehicle's poses are given."""
        assert self.cover is not None
        centres = positions[:, None] + self.cover.centres @ rotations.transpose(0, 2, 1)
        away = field.beyond(centres.reshape(-1, 3))
        return np.asarray(away.reshape(centres.shape[:2]) - self.cover.radii)

    def _with_room(self, spheres: Array, positions: Array, rotations: Array, room: float) -> Iterator[bool]:
        """Whether at each of the poses the vehicle's surface is more than ``room`` m away from everything at rest; of
        ``spheres`` that are so far away themselves (places, k) m, it need not be measured."""
        assert self.cover is not None and self.cover.static is not None
        points, first = surface_by_sphere(self.request.vehicle)
        parts, value = np.split(points, first[1:]), self.cover.static.value
        for away, position, R in zip(spheres, positions, rotations, strict=True):
            yield all(value(position + parts[k] @ R.T).min() > room for k in np.flatnonzero(away <= room))

    def _surface(self, spheres: Array, positions: Array, rotations: Array) -> Array:
        """Distance of the vehicle's surface in every sphere from everything at rest, (places, k) m; that of ``spheres``
        (places, k) m beyond the reach of the constraint instead, where it is not measured."""
        assert self.cover is not None and self.cover.static is not None
        points, first = surface_by_sphere(self.request.vehicle)
        parts, value, found = np.split(points, first[1:]), self.cover.static.value, spheres.copy()
        for away, position, R in zip(found, positions, rotations, strict=True):
            near = np.flatnonzero(away < self.required + SIGHT)
            if len(near):
                starts = np.cumsum([0, *(len(parts[k]) for k in near[:-1])])
                there = position + np.vstack([parts[k] for k in near]) @ R.T
                away[near] = np.minimum.reduceat(value(there), starts)
        return found

    def prolongate(self, coarse: Trajectory, fine: Trajectory) -> Clearance:
        if self.cover is None or self.cover.static is None or self.costs:
            return replace(self, near=None)
        moves = np.array([[hazard.moves] for hazard in self.cover.hazards()])
        finer = replace(self, near=moves | (self.distances(fine) < self.required + SIGHT))
        return finer if self.spare is None else finer.of_surface(fine)

    def violated(self, solved: Trajectory) -> Clearance:
        if self.near is None:
            return self
        missed = ~self.near & (self.distances(solved) < self.required - FINEST)
        return replace(self, near=self.near | missed) if missed.any() else self

    def measure(self, trajectory: Trajectory, clip: Clip, progress: Progress | None) -> Finding:
        """The smallest clearance; near a landing the reduction of the requested clearance is added to it."""
        request, wanted = self.request, self.request.clearance if self.cover is not None else 0.0
        if not request.hazards:
            return Finding()
        less = forgiven(request.marks, max(request.clearance, SLACK))
        nearest = certify(
            clip, request.world, progress=progress, less=less, slope=SLOPE * bool(landings(request.marks))
        )
        return Finding(nearest, wanted, bool(nearest >= wanted - SLACK))

    def tighten(self, trajectory: Trajectory, finding: Finding) -> Clearance:
        if finding.met:
            return self
        tighter = replace(self, required=self.required + (finding.wanted - finding.clearance) + MORE)
        return tighter if self.spare is None else tighter.of_surface(trajectory)

    def resume(self, earlier: Clearance, solved: Trajectory) -> Clearance:
        """While an obstacle is dragged, the active set is kept as long as it contains all that is near: one built
        problem then serves many places."""
        spare = earlier.spare if self.cover is earlier.cover else None
        block = replace(self, required=earlier.required, spare=spare)
        if self.cover is None or self.costs:
            return block
        dragged, near = self.cover.dragged, earlier.near
        same = earlier.cover is not None and earlier.cover.dragged == dragged
        if near is not None and not (same and len(near) == len(list(self.cover.hazards()))):
            near = None
        if dragged:
            far = self.distances(solved) - block.required
            if near is None or not (near | (far > DRAGGING / 2)).all():
                near = far < DRAGGING
        return replace(block, near=near)


def cover_for(request: Request, paths: Sequence[Array], progress: Progress) -> SphereCover | None:
    """The spheres and the distance fields around the paths; None without terrain and obstacles."""
    if not request.hazards:
        return None
    centres, radii = sphere_cover(request.vehicle)
    points = np.vstack([path[:, :3] for path in paths])
    box, *wider = search_boxes(request)
    if wider and not _contains(box, points, request.world):
        box = np.array([points.min(axis=0) - ROOM, points.max(axis=0) + ROOM])
    field = request.world.distance_field_along(points, ROOM, progress, box=box)
    moving = []
    for obstacle in request.world.moving:
        progress(f"measuring distances to {obstacle.name}", 0.0)
        moving.append((obstacle, field_about(obstacle.hulls, _around(request))))
    return SphereCover(field, centres, radii, tuple(moving))


def _contains(box: Any, points: Array, world: Any) -> bool:
    """Whether a ``box`` (2, 3) m in which paths were searched has room around ``points`` (n, 3) m, as far as the
    ``world`` has it."""
    low, high = np.clip([points.min(axis=0) - ROOM / 2, points.max(axis=0) + ROOM / 2], *world.bounds)
    return bool((low >= box[0]).all() and (high <= box[1]).all())


def dragged_cover(request: Request, paths: Sequence[Array], progress: Progress, names: Container[str]) -> SphereCover:
    """The cover for a world in which the standing obstacles with these ``names`` are dragged: they have coarse fields
    of their own, so that only parameters change with their places."""
    world = request.world
    rest = [obstacle for obstacle in world.obstacles if obstacle.name not in names]
    still = replace(request, world=world.with_only(rest))
    cover = cover_for(still, paths, progress) or SphereCover(None, *sphere_cover(request.vehicle))
    loose = [Dragged(obstacle) for obstacle in world.standing if obstacle.name in names]
    own = [(one, field_about(one.obstacle.hulls, _around(request), DRAGGED)) for one in loose]
    return replace(cover, moving=(*cover.moving, *own))


def moved_cover(cover: SphereCover, world: Any) -> SphereCover | None:
    """A cover with its dragged obstacles where those of the same name are in another ``world``; None if one is not
    there or has another shape."""
    there = {obstacle.name: obstacle for obstacle in world.standing}
    moving: list[tuple[Moving | Dragged, DistanceField]] = []
    for obstacle, own in cover.moving:
        if isinstance(obstacle, Dragged):
            moved = obstacle.to(there[obstacle.name]) if obstacle.name in there else None
            if moved is None:
                return None
            obstacle = moved
        moving.append((obstacle, own))
    return replace(cover, moving=tuple(moving))


def _around(request: Request) -> float:
    """How far from an obstacle its own field reaches, m."""
    return request.clearance + float(sphere_cover(request.vehicle)[1].max()) + AROUND


@lru_cache(maxsize=16)
def _pose_at(transcription: Transcription, site: Site) -> ca.Function:
    """The variables of a site -> position (3,) m and columns of the rotation (9,) of the vehicle."""
    v = transcription.symbols(*site.variables)
    view = site.view(transcription, v)
    return ca.Function("pose", [ca.vertcat(*v.values())], [ca.vertcat(view.position, ca.vec(view.rotation))])


def _touching(i: int) -> str:
    return f"mark[{i}].touching"


def _spare(site: Site) -> str:
    return f"spare at {site.name}"


def clearance_element(
    transcription: Transcription,
    cover: SphereCover,
    hazard: Hazard,
    site: Site,
    landed: int,
    costs: Sequence[str],
    spare: bool = False,
) -> Element:
    """The constraint that spheres keep clear of a hazard at a site.

    Parameters: the requested ``clearance`` and the weights of ``costs``. For everything at rest also ``landings``: for
    each of the ``landed`` marks, its root position (3,) m and the distances of its spheres from everything at rest (k,)
    m; the ``slope`` towards all of them; with ``spare``, that of every sphere (k,) m. For a moving obstacle also its
    ``pose``: position (3,) m and columns of its rotation (9,).
    """
    v, radii = transcription.symbols(*site.variables), ca.DM(cover.radii)
    view = site.view(transcription, v)
    clearance, weights = ca.SX.sym("clearance"), {weight_of(name): ca.SX.sym("weight") for name in costs}
    parameters = {"clearance": clearance, **weights}
    points = [view.position + view.rotation @ ca.DM(c) for c in cover.centres]
    wanted = ca.repmat(clearance, len(points), 1)
    if hazard.moves:
        pose = parameters["pose"] = ca.SX.sym("pose", 12)
        R_wo = ca.reshape(pose[3:], 3, 3)
        points = [R_wo.T @ (point - pose[:3]) for point in points]
    else:
        width = 3 + len(points)
        given = parameters["landings"] = ca.SX.sym("landings", landed * width)
        slope = parameters["slope"] = ca.SX.sym("slope", min(landed, 1))
        for landing in ca.vertsplit(given, width) if landed else []:
            distance = rounded_distance(view.position, landing[:3])
            touching = ca.fmin(landing[3:], clearance - ROUND)
            wanted = ca.fmin(wanted, landing_clearance(distance, clearance, touching, ca.tanh, slope))
    if spare:
        parameters["spare"] = ca.SX.sym("spare", len(points))
        wanted -= parameters["spare"]
    met, models = ca.horzcat(*points), ca.SX.sym("models", 13, len(points))
    free = second_order(met, models) - radii
    rates = [COSTS[name](HazardView(free)) for name in costs]
    return Element(
        "clearance",
        ca.vertcat(*v.values()),
        parameters,
        f=sum(weight * v["h"] / 2 * rate for weight, rate in zip(weights.values(), rates, strict=True)),
        g=free - wanted,
        lower=0.0,
        upper=np.inf,
        space=SpatialField(met, models, hazard.field.models),
    )


def _free_places(layout: Layout, marks: Sequence[Mark]) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Indices of the knots, and of the segments, at which (at whose midpoint) clearance is enforced: not the start, and
    no pose that a mark fixes."""
    knots = layout.mark_knots
    free, between = np.arange(layout.knots) > 0, np.full(layout.segments, True)
    for i, mark in enumerate(marks):
        if mark.on_ground:  # until the end of its hold
            last = knots[i + 1] if mark.hold else knots[i]
            free[knots[i] : last + 1] = between[knots[i] : last] = False
    return np.flatnonzero(free), np.flatnonzero(between)


def _places(layout: Layout, marks: Sequence[Mark]) -> dict[Site, NDArray[np.intp]]:
    """Indices of the variables (n, count) of the places by site."""
    knot, half = _free_places(layout, marks)
    return {
        KNOTS: _knots(layout, knot),
        MIDDLES: np.vstack([layout.knot(half), layout.velocity(half), layout.duration(half)]),
    }


def _knots(layout: Layout, knot: NDArray[np.intp]) -> NDArray[np.intp]:
    """Indices of the variables (n, count) of the site `KNOTS` at these knots."""
    return np.vstack([layout.knot(knot), layout.duration(np.maximum(knot - 1, 0))])


def _split(values: NDArray[Any], layout: Layout, marks: Sequence[Mark]) -> dict[Site, NDArray[Any]]:
    """Values (places, ...) by site."""
    knots, _ = _free_places(layout, marks)
    return {KNOTS: values[: len(knots)], MIDDLES: values[len(knots) :]}


def _seconds(trajectory: Trajectory) -> Array:
    """Times of the places (places,), s since frame 0."""
    layout, lengths = trajectory.layout, trajectory.lengths
    knot, half = _free_places(layout, trajectory.request.marks)
    seconds = trajectory.seconds()
    return np.concatenate([seconds[knot], seconds[half] + np.repeat(lengths, layout.legs)[half] / 2])
