"""`Request`: everything that a plan has to achieve, checked."""

from __future__ import annotations

import math
import time
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from fractions import Fraction
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from vehsim.clip.samples import frame_rate
from vehsim.errors import Caution, InputError, OutsideTerrain, Problem
from vehsim.lie import SO3
from vehsim.planning.problem.solver import check_solver
from vehsim.planning.problem.transcription import transcribe
from vehsim.planning.request.character import NO_TRAITS, Traits, traits_of
from vehsim.planning.request.landing import attitude, descent, landings
from vehsim.planning.request.legs import closed, knots_within, mark_positions
from vehsim.planning.request.marks import Mark, around, check_marks, end_of_hold, heading_of, with_breaks
from vehsim.planning.request.marks_near_obstacles import at_level, check_marks_clear
from vehsim.planning.terms import LIMITS, Constraint, Limits, Term, check_limits, check_terms, cost_weights
from vehsim.planning.trim import leans, rests_uncontrolled
from vehsim.vehicles import Vehicle
from vehsim.vehicles.definition.character import BRISK, DEFAULT
from vehsim.vehicles.definition.standing import peak
from vehsim.vehicles.definition.surfaces import SURFACES
from vehsim.world.ground import touchdown
from vehsim.world.ground.below import above_marks
from vehsim.world.ground.levels import NEAR
from vehsim.world.ground.placing import can_stand, tyre_grip
from vehsim.world.ground.slope import on_terrain
from vehsim.world.ground.wheels import wheels_of

Array = NDArray[np.float64]

ROOM = 30.0
"""Margin around marks and paths within which terrain and obstacles are considered, m."""
BESIDE = 0.5
"""The least such margin over terrain without obstacles, relative to the distance between marks: few paths lead farther
aside."""
FINER = 8.0
"""Least ratio of volumes, of the box of all obstacles to that of the marks, at which paths are first searched around
the marks: the coarse grid of the larger box has no points in a narrow gap."""
MUCH = 2.0
"""Least ratio of volumes, of the terrain's box to that part of it, at which distances are measured in the part only."""
MOST_SEGMENTS = 4096
"""Largest number of segments of a plan."""
UPRIGHT = 1e-4
"""Lean in balance, rad, up to which a vehicle counts as upright."""
TILTED = 5.0
"""Angle between a mark's attitude and the ground, degrees, above which there is a warning that it does not count."""
SPAN = 0.5
"""Half the length over which the slope of the ground at a mark is measured, m."""
JOINTS = "joints", "joint_rates"
"""The limits that are tables of joints."""
UNEVEN = 0.02
"""Largest height above the ground, m, of a part of a standing vehicle without a warning."""
IGNORED = "simulate the plan's controls to see their effect, or leave them out"
"""The remedy for what does not act on plans."""


@dataclass(frozen=True, eq=False)
class Request:
    """Everything that a plan has to achieve; ``deadline``: on the clock of `time.monotonic`, s."""

    vehicle: Vehicle
    world: Any
    marks: list[Mark]
    fps: Fraction
    segments: int
    weights: dict[str, float]
    clearance: float
    limits: Limits
    refine: bool
    max_iterations: int
    terms: tuple[Term, ...] = ()
    loop: bool = False
    solver: str = "ipopt"
    deadline: float = math.inf
    traits: Traits = NO_TRAITS
    """The traits of its character."""
    given: Sequence[Mark] = ()
    """The marks before those at rest were turned along their legs."""

    @property
    def wind(self) -> Array:
        return np.zeros(3) if self.world is None else np.asarray(self.world.wind, float)

    @property
    def costs(self) -> tuple[str, ...]:
        """Names of the costs with a weight above zero."""
        return tuple(name for name, weight in self.weights.items() if weight)

    @property
    def constraints(self) -> list[Constraint]:
        """The limits and ranges of joints, the user's constraints, the turning of a start in motion, and the descent
        speeds of landings."""
        own = (term for term in self.terms if isinstance(term, Constraint))
        starts = () if self.loop or "turn_rate" in self.limits.values else starting(self.vehicle, self.marks[0])
        limits = replace(self.limits, joints=self.joint_ranges)
        return [*limits.constraints(), *own, *starts, *map(descent, landings(self.marks))]

    @property
    def joint_ranges(self) -> dict[str, tuple[float, float]]:
        """The least and greatest values of joints by name: those of the vehicle and of the limits."""
        own, asked, free = self.vehicle.joint_limits, self.limits.joints, (-math.inf, math.inf)
        pairs = {joint: (own.get(joint, free), asked.get(joint, free)) for joint in {**own, **asked}}
        ranges = {joint: (max(a[0], b[0]), min(a[1], b[1])) for joint, (a, b) in pairs.items()}
        return {joint: ends for joint, ends in ranges.items() if np.isfinite(ends).any()}

    def aimed(self, mark: Mark) -> bool:
        """Whether a constraint sets the heading at this mark, or between it and the places before and after: the time
        that is left may be too short to turn along the leg."""
        ranges = [term.frames for term in self.constraints if term.aim is not None]
        first = mark.given_frame
        if first is None:
            return None in ranges
        i = [known.given_frame for known in self.marks].index(first)
        last = int(self.marks[end_of_hold(self.marks, i)].frame)
        places = [other.given_frame for other in self.marks if other.position is not None]
        before = max((frame for frame in places if frame is not None and frame < first), default=first)
        after = min((frame for frame in places if frame is not None and frame > last), default=last)
        return any(r is None or (r[0] <= after and before <= r[1]) for r in ranges)

    def aims(self, mark_knots: NDArray[np.intp]) -> list[tuple[int, int, Any, float]]:
        """The constraints that set headings: (first knot, last knot, point, angle)."""
        aimed = [(term, term.aim) for term in self.constraints if term.aim is not None]
        return [(*knots_within(self.marks, mark_knots, term.frames), *aim) for term, aim in aimed]

    @property
    def top_speed(self) -> float:
        """The largest allowed speed, m/s: the limit, or otherwise the vehicle's top speed."""
        return self.limits.get("speed", self.vehicle.top_speed)

    def speed_limit(self) -> str:
        """That speed and its origin, for messages."""
        given = math.isfinite(self.limits.get("speed"))
        own = f"and the {self.vehicle.name} reaches {self.top_speed:g}; limits.speed can allow more"
        return f"limit {self.top_speed:g}" if given else own

    @property
    def loosen(self) -> str:
        """What could be given up where no motion is found, for messages."""
        limits = [*self.limits.values, *(f"{kind}.{name}" for kind in JOINTS for name in getattr(self.limits, kind))]
        terms = dict.fromkeys(f"{term.name!r}" for term in self.terms if isinstance(term, Constraint))
        near = self.world is not None and (bool(self.world.obstacles) or self.hazards)
        keys = ["marks", *["clearance"] * near, *(f"limits.{name}" for name in limits), *terms]
        return f"loosen {' or '.join(filter(None, (', '.join(keys[:-1]), keys[-1])))}"

    @property
    def stops(self) -> Sequence[Mark]:
        """The marks between which paths are searched: a loop leads back to its first one."""
        return closed(self.marks) if self.loop else self.marks

    @property
    def weighed(self) -> Vehicle:
        """The vehicle with the force of gravity on slopes, or with the ground below its rotors."""
        places = mark_positions(self.marks)
        flies = self.vehicle.group.dim == 6
        return (above_marks if flies else on_terrain)(self.vehicle, self.world, places)

    def steepness(self, mark: Mark) -> float:
        """The slope of the ground below the root at a mark, m/m: no more than the least of all places that its
        tolerance or gate allows; 0 without a position, on level ground, and for what does not drive."""
        relief = None if mark.position is None else transcribe(self.weighed).relief
        if relief is None:
            return 0.0
        places, gap = around(mark)
        slopes, _ = relief.followed(places, np.zeros_like(places))
        bend = relief.steepest(places.min(axis=0), places.max(axis=0))[1]
        return max(float(np.linalg.norm(slopes, axis=1).min()) - gap * bend, 0.0)

    @property
    def hazards(self) -> bool:
        """Whether the vehicle flies and there is terrain or an obstacle to hit."""
        about = self.world is not None and (self.world.terrain is not None or self.world.obstacles)
        return bool(about) and self.vehicle.group.dim == 6


def starting(vehicle: Vehicle, mark: Mark) -> list[Constraint]:
    """Where a flight begins with a given speed, it turns no faster than the character `brisk`.

    How it came there is free. With least effort alone it would spin, because damping stops that without effort;
    backwards in time, through the handles of a shot, the spin would grow.
    """
    trait = vehicle.character.limits.get("turn_rate")
    moves = not mark.at_rest and (mark.velocity is not None or mark.speed)
    if vehicle.group.dim != 6 or trait is None or not moves or mark.given_frame is None:
        return []
    value, at = trait.of(BRISK), mark.given_frame
    made = Limits({"turn_rate": value}).constraints()
    return [
        replace(limit, name=f"{mark.name} (turn rate)", over="knots", frames=(at, at), identity=("starting", value))
        for limit in made
    ]


def _on_surface(limits: Limits, vehicle: Vehicle) -> Limits:
    """The limits with those of friction, which are given as on dry asphalt, on the vehicle's surface."""
    friction = SURFACES[vehicle.surface].friction
    return limits.within({name: friction * value for name, value in limits.values.items() if LIMITS[name].on_tyres})


def make_request(
    vehicle: Vehicle,
    world: Any,
    marks: Sequence[Mark],
    *,
    fps: Any,
    segments: int,
    cost: str | Mapping[str, float] = "effort",
    clearance: float = 1.0,
    limits: Mapping[str, Any] | None = None,
    character: str = DEFAULT,
    refine: bool = True,
    terms: Sequence[Term] = (),
    loop: bool = False,
    solver: str = "ipopt",
    max_iterations: int = 200,
    time_limit: float | None = None,
) -> Request:
    """The checked request of `vehsim.plan`; raises ``InputError`` with key, value and remedy."""
    if not isinstance(vehicle, Vehicle):
        raise InputError("not a vehicle", "give what vehsim.load_vehicle returns", key="vehicle", value=vehicle)
    for name in limits or {}:
        if name in LIMITS and LIMITS[name].on_tyres and vehicle.group.dim != 3:
            remedy = "limit g_load or acceleration"
            raise InputError(f"{vehicle.name} does not stand on tyres", remedy, key=f"limits.{name}")
    marks = afloat(marks, vehicle, world)
    _tell_of_gusts(vehicle, world)
    vehicle = vehicle.planar or vehicle
    world = at_level(world, vehicle, marks)
    if not (math.isfinite(clearance) and clearance >= 0):
        raise InputError("not a distance", "give metres, zero or more", key="clearance", value=clearance)
    if time_limit is not None and not time_limit > 0:
        raise InputError("not a time", "give seconds, more than zero", key="time_limit", value=time_limit)
    kept = check_terms(terms)
    traits = traits_of(vehicle, character, cost)
    request = Request(
        vehicle=vehicle,
        world=world,
        marks=all_marks(marks, vehicle, world, kept),
        fps=frame_rate(fps),
        segments=int(segments),
        weights=cost_weights(cost, default_costs(vehicle, marks)),
        clearance=float(clearance),
        limits=_on_surface(check_limits(limits or {}, vehicle.joints), vehicle),
        refine=refine,
        max_iterations=max_iterations,
        terms=kept,
        loop=loop,
        solver=check_solver(solver),
        traits=traits,
        deadline=math.inf if time_limit is None else time.monotonic() + time_limit,
    )
    least = 2 * (len(request.marks) - 1)
    if not least <= segments <= MOST_SEGMENTS:
        raise InputError(
            "out of range",
            f"give at least 2 per leg between marks, {least}, and at most {MOST_SEGMENTS}",
            key="segments",
            value=segments,
        )
    check_loop(request)
    check_inside(request.marks, vehicle, world)
    check_marks_clear(vehicle, world, request.marks, request.clearance, request.fps)
    check_level(vehicle, world, request.marks)
    check_standing(vehicle, world, request.marks)
    check_held(request)
    heights = {float(np.asarray(mark.position)[2]) for mark in request.marks if mark.position is not None}
    if vehicle.group.dim == 3 and len(heights) > 1 and (world is None or world.terrain is None):
        raise InputError(
            f"heights {sorted(heights)} m",
            f"{vehicle.name} keeps its height: give all marks the same z",
            key="mark.position",
        )
    return request


def default_costs(vehicle: Vehicle, marks: Sequence[Mark]) -> dict[str, float]:
    """The vehicle's own costs.

    Time is added if the duration is free and standing still costs no effort: otherwise the slowest motion would be
    optimal.
    """
    patient = len(marks) > 0 and marks[-1].given_frame is None and rests_uncontrolled(vehicle)
    return ({"time": 1.0} if patient else {}) | dict(vehicle.default_costs)


def all_marks(marks: Sequence[Mark], vehicle: Vehicle, world: Any, terms: Sequence[Term]) -> list[Mark]:
    """The marks, with holds as two marks, marks on the ground placed there, and marks where a term's frames begin or
    end."""
    standing = [put_down(mark, vehicle, world) for mark in check_marks(marks, vehicle.joints)]
    return with_breaks(standing, [frame for term in terms for frame in term.frames or ()])


def put_down(mark: Mark, vehicle: Vehicle, world: Any) -> Mark:
    """A mark on the ground at the height where the vehicle touches it; warns on uneven ground. Raises
    ``InputError``."""
    if not mark.on_ground:
        return mark
    assert mark.position is not None
    key = f"{mark.name}.on_ground"
    if world is None or vehicle.group.dim != 6:
        remedy = "leave it out" if vehicle.group.dim != 6 else "give a terrain or obstacles to stand on"
        raise InputError(f"{vehicle.name} does not land", remedy, key=key)
    check_inside([mark], vehicle, world)
    q = attitude(mark)
    try:
        place = touchdown.put_down(world, vehicle, mark.position, q)
    except InputError as error:
        raise InputError.of(error.problem.below(mark.name)) from None
    below = place + touchdown.feet(vehicle) @ SO3.matrix(q).T
    hollow = float(np.max(below[:, 2] - touchdown.height_below(world, below)))
    if hollow > UNEVEN:
        message = f"it touches the ground, but stands up to {hollow:.2f} m above it elsewhere"
        warnings.warn(Caution(Problem(key, message, "land on level ground or on a pad (an obstacle)")), stacklevel=5)
    if np.any(world.wind) or leans(vehicle) > UPRIGHT:  # it stands level, which is not in balance
        mark = replace(mark, orientation=tuple(q.tolist()), heading=None)
    return replace(mark, position=tuple(place.tolist()))


def afloat(marks: Sequence[Mark], vehicle: Vehicle, world: Any) -> Sequence[Mark]:
    """The marks of a boat, at the height where it floats on calm water. Warn of a height far from it: 0 is none there;
    and of waves and currents, which do not act on plans. Raises ``InputError`` if it sinks."""
    boat = vehicle if vehicle.planar is not None else vehicle.floating
    if boat is None or boat.hull is None or getattr(world, "water", None) is None:
        return marks
    from vehsim.world.water.buoyancy import Afloat

    acts = {"waves": not world.water.flat, "current": world.water.current is not None}
    if any(acts.values()):
        ignored = " and ".join(name for name, there in acts.items() if there)
        message = f"the motion is planned on calm, still water, without the {ignored}"
        warnings.warn(Caution(Problem("mark", message, IGNORED)), stacklevel=4)
    floating = world.water.level + Afloat(boat, world).floating()[0] - float(boat.origin[2])
    height = round(floating, 3) + 0.0
    for mark in marks:
        z = 0.0 if mark.position is None else float(mark.position[2])
        if z and abs(z - height) > NEAR:
            message = f"{z:.2f} m: {vehicle.name} floats on the water, at {height:.2f} m"
            warnings.warn(Caution(Problem(f"{mark.name}.position", message, "give that height, or 0")), stacklevel=4)
    return [mark if mark.position is None else replace(mark, position=(*mark.position[:2], height)) for mark in marks]


def _tell_of_gusts(vehicle: Vehicle, world: Any) -> None:
    """Warn of gusts, which do not act on plans."""
    if getattr(world, "gusts", None) is not None and np.any(world.wind) and vehicle.feels_wind:
        message, remedy = "the motion is planned in the steady wind, without the gusts", IGNORED
        warnings.warn(Caution(Problem("mark", message, remedy)), stacklevel=4)


def check_standing(vehicle: Vehicle, world: Any, marks: Sequence[Mark]) -> None:
    """Raise ``InputError`` for all marks where a vehicle with wheels cannot stand, such as on a wall of rock; without a
    heading, at none of some. Warn of a height far from the ground, on which it stands: 0 is no height there."""
    terrain, wrong = None if world is None else world.terrain, dict[str, Problem]()
    for mark in marks if vehicle.group.planar else ():
        if mark.position is None:
            continue
        x, y, z = (float(v) for v in mark.position)
        ground = z if terrain is None else float(np.ravel(terrain.height(np.array([[x, y]])))[0])
        if z and abs(z - ground) > NEAR and vehicle.rig is not None and wheels_of(vehicle.rig):
            message = f"{z:.2f} m: {vehicle.name} stands on the ground, at {ground:.2f} m"
            warnings.warn(Caution(Problem(f"{mark.name}.position", message, "give that height, or 0")), stacklevel=4)
        if not _can_stand(vehicle, world, mark):
            place = [float(x) for x in mark.position]
            message = f"{vehicle.name} cannot stand there: the ground is too steep or too rough"
            wrong[mark.name] = Problem(f"{mark.name}.position", message, "move the mark to gentler ground", place)
    if wrong:
        raise InputError.of(*wrong.values())


def _can_stand(vehicle: Vehicle, world: Any, mark: Mark) -> bool:
    """Whether a vehicle with wheels can stand at a mark, or somewhere that its tolerance or gate allows; without a
    heading, at one of some."""
    nose, places = heading_of(mark), around(mark)[0]
    yaw = np.arange(8) * np.pi / 4 if nose is None else np.array([nose])
    return any(
        can_stand(vehicle, world, np.repeat(some, len(yaw), axis=0), np.tile(yaw, len(some))).any()
        for some in (places[:1], places[1:])  # most stand at the position itself
        if len(some)
    )


def check_held(request: Request) -> None:
    """Warn of a mark at rest on ground so steep that tyres slide there, where nothing else limits their grip: tyres
    that never slip hold the vehicle on any slope, and others let it rest for an instant. Holds are refused there."""
    vehicle, held = request.vehicle, {mark.name for mark in request.marks if mark.hold}
    slips = vehicle.standing is not None
    most = peak(vehicle) if slips else tyre_grip(vehicle)
    if math.isinf(most) or (not slips and math.isfinite(request.limits.get("grip"))):
        return
    for mark in {mark.name: mark for mark in request.marks if mark.at_rest}.values():  # a hold is two marks
        steep = request.steepness(mark)
        if steep <= most or (slips and (mark.name in held or request.limits.get("grip") < steep)):
            continue
        then = ": it cannot stay at rest there" if slips else ", but wheels never slip here"
        message = f"tyres on {vehicle.surface} slide on a slope of {100 * steep:.0f} %{then}"
        problem = Problem(f"{mark.name}.position", message, f"move it to a slope of at most {whole_percent(most)}")
        warnings.warn(Caution(problem), stacklevel=4)


def whole_percent(slope: float) -> str:
    """A slope, m/m, rounded down."""
    return f"{math.floor(100 * slope + 1e-9)} %"


def check_level(vehicle: Vehicle, world: Any, marks: Sequence[Mark]) -> None:
    """For a vehicle that moves in the plane: raise ``InputError`` for a gate that it cannot pass, which lies flat; warn
    of an attitude that leans against the ground, of which it takes the heading alone."""
    for mark in marks if vehicle.group.planar else ():
        if mark.gate is not None and not np.any(np.asarray(mark.gate.direction, float)[:2]):
            message, key = f"straight up or down: {vehicle.name} moves in the plane", f"{mark.name}.gate.direction"
            raise InputError(message, "give a direction along the ground", key=key, value=list(mark.gate.direction))
        if mark.orientation is None:
            continue
        up = SO3.matrix(np.asarray(mark.orientation, float) / np.linalg.norm(mark.orientation))[:, 2]
        tilt = math.degrees(math.acos(min(1.0, float(up @ _normal(world, mark.position)))))
        if tilt > TILTED:
            message = f"leans by {tilt:.0f} degrees against the ground: {vehicle.name} takes its heading alone"
            remedy = "give that heading instead; the ground and its springs determine how it leans"
            warnings.warn(Caution(Problem(f"{mark.name}.orientation", message, remedy)), stacklevel=4)


def _normal(world: Any, place: Sequence[float] | None) -> Array:
    """Unit normal (3,) of the ground at a place; straight up without a terrain."""
    slope = np.zeros(2)
    if place is not None and world is not None and world.terrain is not None:
        steps = np.array([[SPAN, 0.0], [-SPAN, 0.0], [0.0, SPAN], [0.0, -SPAN]])
        z = np.ravel(world.terrain.height(np.asarray(place, float)[:2] + steps))
        slope = np.array([z[0] - z[1], z[2] - z[3]]) / (2 * SPAN)
    normal = np.array([-slope[0], -slope[1], 1.0])
    return normal / np.linalg.norm(normal)


def check_inside(marks: Sequence[Mark], vehicle: Vehicle, world: Any) -> None:
    """Raise ``InputError`` if a flying vehicle has a mark outside the terrain; warn if a driving vehicle has one.

    Routes are searched inside the terrain only. Outside, the ground is level and not drawn.
    """
    terrain = None if world is None else world.terrain
    if terrain is None or vehicle.hull is not None:
        return
    for mark in marks:
        end = "" if mark.position is None else terrain.beyond(mark.position)
        if not end:
            continue
        place = [float(x) for x in mark.position or ()]
        problem = Problem(f"{mark.name}.position", f"outside the terrain, which ends at {end}", "move it inside", place)
        if vehicle.group.dim == 6:
            raise InputError.of(problem)
        level = replace(problem, remedy="the ground there is level and not drawn")
        warnings.warn(str(level), OutsideTerrain, stacklevel=4)


def check_loop(request: Request) -> None:
    """Raise ``InputError`` if a loop would end elsewhere than it begins."""
    first, last = request.marks[0], request.marks[-1]
    if not request.loop:
        return
    for key in ("position", "heading", "orientation", "velocity"):
        a, b = getattr(first, key), getattr(last, key)
        if a is not None and b is not None and not np.allclose(a, b, atol=1e-9):
            raise InputError(
                f"a loop ends as it begins, with {a!r}",
                "leave it out of the last mark",
                key=f"{last.name}.{key}",
                value=b,
            )


def airspace(request: Request) -> Array | None:
    """A box (2, 3) m around the marks and nearby obstacles, in which paths are searched; None: the terrain's box."""
    world = request.world
    if world.terrain is not None or not world.standing:
        return None
    places = mark_positions(request.marks)
    low, high = places.min(axis=0) - ROOM, places.max(axis=0) + ROOM
    for obstacle in world.standing:
        corners = np.vstack(obstacle.hulls)
        a, b = corners.min(axis=0), corners.max(axis=0)
        if (a < high).all() and (b > low).all():
            low, high = np.minimum(low, a - ROOM), np.maximum(high, b + ROOM)
    return np.array([low, high])


def search_boxes(request: Request) -> list[Array | None]:
    """Boxes (2, 3) m in which paths are searched in turn: around the marks, if that is much less or much finer, then
    all."""
    world, places = request.world, mark_positions(request.marks)
    if not world.standing:
        part = None if world.terrain is None else part_around(world, places)
        return [None] if part is None else [part, None]
    wide, near = airspace(request), np.array([places.min(axis=0) - ROOM, places.max(axis=0) + ROOM])
    if wide is not None and np.prod(np.ptp(wide, axis=0)) < FINER * np.prod(np.ptp(near, axis=0)):
        return [wide]
    return [near, wide]


def part_around(world: Any, places: ArrayLike) -> Array | None:
    """The box (2, 3) m of the part of a terrain around ``places`` (n, 3) m in which a flight to them is searched first;
    None: the whole."""
    whole, places = world.bounds, np.asarray(places, float)
    aside = max(ROOM, BESIDE * float(np.ptp(places, axis=0).max()))
    low, high = np.maximum(places.min(axis=0) - aside, whole[0]), np.minimum(places.max(axis=0) + aside, whole[1])
    part = np.array([[*low[:2], whole[0, 2]], [*high[:2], whole[1, 2]]])
    much = (high > low)[:2].all() and np.prod(np.ptp(whole, axis=0)) >= MUCH * np.prod(np.ptp(part, axis=0))
    return part if much else None
