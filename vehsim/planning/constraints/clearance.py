"""What flies keeps clear of terrain and obstacles: spheres about its hulls stay out of distance fields.

What stands is one field; what moves has one in its own frame, and its pose at every place is a parameter. Where the
vehicle lands the clearance asked for tapers, see `landing.approach`. The finished motion is certified with the hulls
themselves; where it comes too near, the problem asks for more.
"""

from __future__ import annotations

from collections.abc import Callable, Hashable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from vehsim.clip.clip import Clip
from vehsim.lie import SO3
from vehsim.planning.certificates import FINEST, SAMPLES, certify
from vehsim.planning.constraints.block import Block, Finding, Progress
from vehsim.planning.constraints.spheres import sphere_cover
from vehsim.planning.problem.elements import Element, NonlinearProgram, SpatialField, second_order
from vehsim.planning.problem.layout import Layout
from vehsim.planning.problem.stage import knot_view, middle_view
from vehsim.planning.problem.transcription import Transcription
from vehsim.planning.request.landing import ROUND, SLOPE, approach, attitude, forgiven, landings, rounded_distance
from vehsim.planning.request.marks import Mark
from vehsim.planning.request.request import ROOM, Request, airspace
from vehsim.planning.terms import COSTS, HazardView, KnotView, costs_of, weight_of
from vehsim.planning.trajectory import Trajectory
from vehsim.world.distance.field import DistanceField, field_about
from vehsim.world.obstacles.obstacles import Moving

Array = NDArray[np.float64]

AROUND = 4.0
"""How far from what moves its field reaches beyond what keeps its distance, m."""
SIGHT = 4.0
"""How far from a motion found on fewer segments terrain is active for those that refine it, beyond the clearance asked
for, m."""
SLACK = 0.01
"""How far below the asked clearance a certified motion may be, m."""
MORE = 0.05
"""How much more than it lacks is asked for where a certified motion comes too near, m."""


@dataclass(frozen=True, eq=False)
class Hazard:
    """What may be hit: a distance field, in its own frame where it ``moves``; its name begins its parameters' names."""

    name: str
    field: DistanceField
    moves: bool = False


@dataclass(frozen=True)
class Site:
    """A kind of place where clearance is asked: the ``variables`` of a segment that say where the vehicle is there, and
    its ``view`` from their symbols."""

    name: str
    variables: tuple[str, ...]
    view: Callable[[Transcription, Mapping[str, Any]], KnotView]


def _none(transcription: Transcription) -> Any:
    """No controls: where a vehicle is does not depend on them."""
    return ca.SX.zeros(transcription.sizes[3])


NODES = Site("nodes", ("x", "h"), lambda t, v: knot_view(t, v["x"], _none(t)))
MIDDLES = Site("middles", ("x", "z", "h"), lambda t, v: middle_view(t, v["x"], v["z"], _none(t), v["h"]))
"""At nodes, and half way along segments."""


@dataclass(eq=False)
class SphereCover:
    """Spheres ``centres`` (k, 3) m and ``radii`` (k,) m that hold a vehicle, the distance field of what ``stands`` (or
    None), what moves with its own, and the elements made of them for all discretisations."""

    stands: DistanceField | None
    centres: Array
    radii: Array
    moving: tuple[tuple[Moving, DistanceField], ...] = ()
    elements: dict[Any, Element] = field(default_factory=dict)

    def hazards(self) -> Iterator[Hazard]:
        """What stands, then everything that moves."""
        if self.stands is not None:
            yield Hazard("standing", self.stands)
        for i, (_, own) in enumerate(self.moving):
            yield Hazard(f"moving[{i}]", own, moves=True)


@dataclass(frozen=True, eq=False)
class Clearance(Block):
    """``asked`` m from terrain and obstacles, for spheres at the knots after the first and at one place between two.

    ``cover``: None in free space. ``near`` (places,): where what stands is active; None is everywhere. Costs that are
    laws of a `HazardView` count here, everywhere.
    """

    request: Request
    cover: SphereCover | None
    asked: float
    near: NDArray[np.bool_] | None = None

    @property
    def costs(self) -> tuple[str, ...]:
        """Names of the costs of what may be hit that count."""
        return costs_of(HazardView, self.request.weights)

    def key(self, layout: Layout, transcription: Transcription) -> Hashable:
        landed = tuple(mark.on_ground for mark in self.request.marks)
        return self.cover, self.costs, landed, None if self.near is None else self.near.tobytes()

    def add(self, problem: NonlinearProgram, transcription: Transcription, layout: Layout) -> None:
        if self.cover is None:
            return
        marks = self.request.marks
        touching = [problem.parameter(_touching(i), 3 + len(self.cover.radii)) for i in self._landings()]
        for hazard in self.cover.hazards():
            for site, y in _places(layout, marks).items():
                if hazard.moves:
                    parameters = {"pose": problem.parameter(f"{hazard.name}.pose at {site.name}", 12, y.shape[1])}
                else:
                    parameters = {"landings": np.concatenate([np.zeros(0, np.intp), *touching])}
                    y = y if self.near is None else y[:, _split(self.near, layout, marks)[site]]
                if y.shape[1]:
                    problem.add(self._element(transcription, hazard, site), y, parameters)

    def values(self, trajectory: Trajectory) -> Mapping[str, Any]:
        values: dict[str, Any] = {"clearance": self.asked}
        if self.cover is None:
            return values
        values |= {weight_of(name): self.request.weights[name] for name in self.costs}
        if self.cover.stands is not None:
            values |= {_touching(i): self._touching(mark) for i, mark in self._landings().items()}
        for i, (obstacle, _) in enumerate(self.cover.moving):
            positions, orientations = obstacle.poses_at(_seconds(trajectory))
            poses = np.hstack([positions, SO3.matrix(orientations).transpose(0, 2, 1).reshape(-1, 9)])
            for site, here in _split(poses, trajectory.layout, self.request.marks).items():
                values[f"moving[{i}].pose at {site.name}"] = here.T
        return values

    def _landings(self) -> dict[int, Mark]:
        """The marks where it stands on the ground by number, each once; none where nothing stands."""
        assert self.cover is not None
        if self.cover.stands is None:
            return {}
        return {i: mark for i, mark in enumerate(self.request.marks) if mark.on_ground and not mark.hold}

    def _touching(self, mark: Mark) -> Array:
        """Where a mark's root is (3,) m, and how far its spheres are from what stands there, (k,) m."""
        assert self.cover is not None and self.cover.stands is not None
        place = np.asarray(mark.position, float)
        centres = place + self.cover.centres @ SO3.matrix(attitude(mark)).T
        return np.concatenate([place, self.cover.stands.value(centres) - self.cover.radii])

    def _element(self, transcription: Transcription, hazard: Hazard, site: Site) -> Element:
        assert self.cover is not None
        landed = len(self._landings())
        key = hazard.name, site.name, landed, self.costs
        if key not in self.cover.elements:
            made = clearance_element(transcription, self.cover, hazard, site, landed, self.costs)
            self.cover.elements[key] = made
        return self.cover.elements[key]

    def distances(self, trajectory: Trajectory) -> Array:
        """How far the nearest sphere is from what stands at every place, m."""
        assert self.cover is not None and self.cover.stands is not None
        standing, out = next(self.cover.hazards()), [np.zeros(0)]
        for site, y in _places(trajectory.layout, self.request.marks).items():
            if y.shape[1]:
                element = self._element(trajectory.transcription, standing, site)
                points = np.asarray(element.points.map(y.shape[1])(trajectory.x[y], 0))
                away = self.cover.stands.value(points.T).reshape(y.shape[1], -1)
                out.append((away - self.cover.radii).min(axis=1))
        return np.concatenate(out)

    def prolongate(self, coarse: Trajectory, fine: Trajectory) -> Clearance:
        if self.cover is None or self.cover.stands is None or self.costs:
            return replace(self, near=None)
        return replace(self, near=self.distances(fine) < self.asked + SIGHT)

    def violated(self, solved: Trajectory) -> Clearance:
        if self.near is None:
            return self
        missed = ~self.near & (self.distances(solved) < self.asked - FINEST)
        return replace(self, near=self.near | missed) if missed.any() else self

    def measure(self, trajectory: Trajectory, clip: Clip, progress: Progress | None) -> Finding:
        """The least clearance; near a landing, as much is added as less is asked for."""
        request, wanted = self.request, self.request.clearance if self.cover is not None else 0.0
        if not request.hazards:
            return Finding()
        less = forgiven(request.marks, max(request.clearance, SLACK))
        nearest = certify(clip, request.world, SAMPLES, progress, less, SLOPE * bool(landings(request.marks)))
        return Finding(nearest, wanted, bool(nearest >= wanted - SLACK))

    def tighten(self, trajectory: Trajectory, finding: Finding) -> Clearance:
        if finding.met:
            return self
        return replace(self, asked=self.asked + (finding.wanted - finding.clearance) + MORE)

    def resume(self, earlier: Clearance) -> Clearance:
        return replace(self, asked=earlier.asked, near=earlier.near)


def cover_for(request: Request, paths: Sequence[Array], progress: Progress) -> SphereCover | None:
    """What is to be kept clear of around the paths, and the spheres that do; None where there is nothing to hit."""
    if not request.hazards:
        return None
    centres, radii = sphere_cover(request.vehicle)
    points = np.vstack([path[:, :3] for path in paths])
    room = np.array([points.min(axis=0) - ROOM, points.max(axis=0) + ROOM])
    if request.world.terrain is not None and request.world.standing:  # finer than the terrain's whole
        field = request.world.distance_field(progress, box=room)
    else:
        field = request.world.distance_field(progress, box=airspace(request))
        field = None if field is None else field.crop(*room)
    around = request.clearance + float(radii.max()) + AROUND
    moving = []
    for obstacle in request.world.moving:
        progress(f"measuring distances to {obstacle.name}", 0.0)
        moving.append((obstacle, field_about(obstacle, around)))
    return SphereCover(field, centres, radii, tuple(moving))


def _touching(i: int) -> str:
    return f"mark[{i}].touching"


def clearance_element(
    transcription: Transcription, cover: SphereCover, hazard: Hazard, site: Site, landed: int, costs: Sequence[str]
) -> Element:
    """Spheres off a hazard at a site.

    Parameters: the ``clearance`` asked for and the weights of ``costs``; of what stands, ``landings``: of each of the
    ``landed`` marks where its root is (3,) m and how far its spheres are from what stands there (k,) m; of what moves,
    its ``pose``: position (3,) m and columns of its rotation (9,).
    """
    v, radii = transcription.symbols(*site.variables), ca.DM(cover.radii)
    view = site.view(transcription, v)
    asked, weights = ca.SX.sym("clearance"), {weight_of(name): ca.SX.sym("weight") for name in costs}
    parameters = {"clearance": asked, **weights}
    points = [view.position + view.rotation @ ca.DM(c) for c in cover.centres]
    wanted = ca.repmat(asked, len(points), 1)
    if hazard.moves:
        pose = parameters["pose"] = ca.SX.sym("pose", 12)
        R_wo = ca.reshape(pose[3:], 3, 3)
        points = [R_wo.T @ (point - pose[:3]) for point in points]
    else:
        width = 3 + len(points)
        given = parameters["landings"] = ca.SX.sym("landings", landed * width)
        for landing in ca.vertsplit(given, width) if landed else []:
            distance = rounded_distance(view.position, landing[:3])
            touching = ca.fmin(landing[3:], asked - ROUND)
            wanted = ca.fmin(wanted, approach(distance, asked, touching, ca.tanh))
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
    """Nodes where clearance is asked, and segments half way along which it is, too: not where marks leave no choice."""
    steps, knots = len(layout.fractions), layout.mark_knots
    free, between = np.arange(layout.nodes) > 0, np.full(layout.segments, steps == 1)
    for i, mark in enumerate(marks):
        if mark.on_ground:  # to the end of its hold
            last = knots[i + 1] if mark.hold else knots[i]
            free[knots[i] * steps : last * steps + 1] = between[knots[i] : last] = False
    asked = np.isin(np.arange(layout.nodes) % steps, (0, layout.middle[0]))
    return np.flatnonzero(free & asked), np.flatnonzero(between)


def _places(layout: Layout, marks: Sequence[Mark]) -> dict[Site, NDArray[np.intp]]:
    """Variables (n, count) of the places by site."""
    node, half = _free_places(layout, marks)
    return {
        NODES: np.vstack([layout.node(node), layout.duration((node - 1) // len(layout.fractions))]),
        MIDDLES: np.vstack([layout.node(half), layout.velocity(half), layout.duration(half)]),
    }


def _split(values: NDArray[Any], layout: Layout, marks: Sequence[Mark]) -> dict[Site, NDArray[Any]]:
    """Values (places, ...) by site."""
    nodes, _ = _free_places(layout, marks)
    return {NODES: values[: len(nodes)], MIDDLES: values[len(nodes) :]}


def _seconds(trajectory: Trajectory) -> Array:
    """When it is at the places (places,), s since frame 0."""
    layout, lengths = trajectory.layout, trajectory.lengths
    node, half = _free_places(layout, trajectory.request.marks)
    steps = np.repeat(lengths, layout.phases)
    knots = np.concatenate([[0.0], np.cumsum(steps)])
    shares = np.concatenate([[0.0], np.cumsum(layout.fractions)[:-1]])
    segment, part = np.divmod(node, len(layout.fractions))
    nodes = knots[segment] + shares[part] * np.append(steps, 0.0)[segment]
    return np.asarray(trajectory.seconds()[0] + np.concatenate([nodes, knots[half] + steps[half] / 2]))
