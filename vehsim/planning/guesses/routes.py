"""Paths for initial guesses: a given path, a route through free space, a drive among obstacles, or straight lines."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import pairwise
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from vehsim.clip.clip import Clip
from vehsim.errors import InputError, SolveError
from vehsim.planning.certificates import extent
from vehsim.planning.constraints.easing import slides
from vehsim.planning.constraints.spheres import balls
from vehsim.planning.guesses.astar import guess_drive, turning_radius
from vehsim.planning.guesses.drive import drive
from vehsim.planning.request.legs import (
    ROUND,
    cut,
    divided,
    legs_between,
    path_length,
    placed_marks,
    poses_of,
    round_trip,
)
from vehsim.planning.request.marks import Mark, heading_of
from vehsim.planning.request.marks_near_obstacles import parts_in_reach
from vehsim.planning.request.request import Request, search_boxes
from vehsim.planning.trim import swims
from vehsim.runtime.progress import Progress, silent
from vehsim.vehicles import Vehicle
from vehsim.vehicles.definition.character import STUNT
from vehsim.world.distance.route import check_free, on_other_side

if TYPE_CHECKING:
    from vehsim.world.distance.field import DistanceField

Array = NDArray[np.float64]

DETOUR = 1.5
"""Largest length of a preferred wide route, relative to a narrow route."""
SHORTER, BOLD = 0.96, 0.5
"""Length of a route between obstacles relative to that around them below which it is the better guess; and how much it
avoids them, see `SHY`. Round both towers instead of between them, a flight banked by 45 degrees instead of 29."""
RUN_UP = 0.5
"""Length of the straight way to a mark that is passed in a direction, relative to the turning radius."""

AWAY = -1e-6
"""Cosine of the angle between a leg and a nose below which the nose points away."""
REVERSED = 16.0
"""Longest way that a driver reverses rather than turning round, in turning radii, or in lengths of what turns on the
spot: our choice."""
CURVE_POINTS, GENTLE = 33, math.radians(25.0)
"""Points of a curve from mark to mark; its largest angle with the straight line at its ends, rad: from sharper curves,
a car on tyres was solved less often than from straight lines."""


@dataclass(frozen=True, eq=False)
class InitialGuess:
    """Where a search begins: ``paths``, one per leg, as of `find_paths`, and a ``clip`` along them, to use its joints
    and controls too. ``given``: whether the user gave them."""

    paths: Sequence[Array]
    clip: Clip | None = None
    given: bool = False


def initial_guess(request: Request, given: Any, progress: Progress) -> InitialGuess:
    """The guess that the user gave, a `Clip` or a path (k, 3), or else paths through free space."""
    return InitialGuess(find_paths(request, given, progress), as_clip(request, given), given is not None)


def find_paths(request: Request, guess: Any, progress: Progress) -> list[Array]:
    """A polyline (k, 3) for every leg between marks, poses (k, 4) with headings in rad, or also with paces (k, 5)."""
    if guess is not None:
        points = poses_of(guess) if isinstance(guess, Clip) else np.asarray(guess, float)
        if points.ndim != 2 or points.shape[1] not in (3, 4) or len(points) < 2:
            raise InputError(f"shape {points.shape}", "give a Clip, or a path of (k, 3) points in metres", key="guess")
        return cut(points, legs_between(request.stops))
    kept = [request.stops[i] for i in placed_marks(request.stops)]
    if not request.hazards:
        parts = parts_in_reach(request.vehicle, request.world, request.marks, request.clearance)
        if not parts:
            return curved(request)
        progress("searching for a path among obstacles", 0.0)
        return divided(drive(replace(request, marks=kept), parts), request.stops)
    return (
        _flown(request, kept, progress)
        if request.world.standing or request.world.terrain is not None
        else straight(request)
    )


def _flown(request: Request, kept: Sequence[Mark], progress: Progress) -> list[Array]:
    """Routes through free space between the marks ``kept``, one per leg.

    Routes are searched for a ball around all spheres, then for a smaller ball, which passes gaps that the vehicle may
    pass nose first; only solving shows whether it does. A wide route is preferred to a narrow one if it is at most
    `DETOUR` times as long.
    """
    _, roomy, tight = balls(request.vehicle)
    near, *wider = search_boxes(request)
    shortest = sum(math.dist(a, b) for a, b in legs_between(kept))

    def shortened(found: list[Array] | None, radius: float) -> list[Array] | None:
        """The route for a ball of that radius instead, if the one found is a detour."""
        if found is not None and _length(found) <= DETOUR * shortest:
            return found
        narrow = _searched(request, kept, progress, radius, near)
        return found if found and (narrow is None or _length(found) <= DETOUR * _length(narrow)) else narrow

    found = _searched(request, kept, progress, roomy, near)
    if found is None and wider:
        found = _searched(request, kept, progress, roomy, wider[0])
    # the middle of a gap may be between the points of the field
    spacing = request.world.distance_field(progress, box=near, quick=True).spacing
    found = shortened(found, tight)
    if found is None and wider:
        found = _searched(request, kept, progress, tight, wider[0])
    found = shortened(found, tight - spacing)
    return divided(found or _routes(request, kept, progress, tight, [near, *wider][-1]), request.stops)


def around(request: Request, paths: Sequence[Array]) -> list[Array]:
    """Routes with room for the vehicle at every attitude, where ``paths`` lead through narrower places; else none."""
    if not request.hazards:
        return []
    kept, (_, roomy, _) = [request.stops[i] for i in placed_marks(request.stops)], balls(request.vehicle)
    for box in search_boxes(request):
        found = _searched(request, kept, silent, roomy, box)
        if found is not None:
            wide = divided(found, request.stops)
            return [] if math.isclose(_length(wide), _length(paths)) else wide
    return []


def roundabout(request: Request) -> Array | None:
    """The path (k, 3) around the narrow places of the route that `find_paths` chooses; None if it has none."""
    way = around(request, find_paths(request, None, silent)) if request.hazards else []
    return np.vstack(way) if way else None


def _searched(
    request: Request, kept: Sequence[Mark], progress: Progress, radius: float, box: Array | None
) -> list[Array] | None:
    """The same as `_routes`; None if there is no route."""
    try:
        return _routes(request, kept, progress, radius, box)
    except SolveError:
        return None


def _routes(
    request: Request, kept: Sequence[Mark], progress: Progress, radius: float, box: Array | None
) -> list[Array]:
    """Routes of a ball of ``radius`` m in a ``box``; raises ``SolveError`` that names the leg without one."""
    field = request.world.distance_field(progress, box=box, quick=True)
    up = np.array([0, 0, balls(request.vehicle)[0][2]])
    ceiling = request.limits.get("ceiling")
    lid = ceiling + up[2] if math.isfinite(ceiling) else None
    found, legs, best = [], legs_between(kept), not request.world.standing
    for done, (a, b) in enumerate(legs):
        progress("searching for a path", done / len(legs))
        try:
            route = partial(request.world.route, a + up, b + up, radius + request.clearance, lid, box, best)
            path = route()
            if request.world.standing and SHORTER * path_length(path) > math.dist(a, b):
                path = _direct(field, path, route(shy=BOLD))
            found.append(path - up)
        except InputError:
            for mark, end in ((kept[done], a), (kept[done + 1], b)):
                check_free(field, f"{mark.name}.position", end, request.clearance, ceiling, request.world.height)
            raise
        except SolveError:
            room = f"{request.clearance:g} m clearance and {radius:.1f} m for the {request.vehicle.name} itself"
            below = "" if lid is None else f" below the ceiling of {ceiling:g} m"
            wide = f"widen the gap to {math.ceil(2 * (radius + request.clearance)) + 1} m"
            remedy = (
                f"{wide} or lower the clearance" if lid is None else f"{wide}, raise the ceiling or lower the clearance"
            )
            names = f"{kept[done].name} to {kept[done + 1].name}"
            raise SolveError(f"no path from {names} with {room}{below}", remedy) from None
    return found


def _direct(field: DistanceField, wide: Array, short: Array) -> Array:
    """The ``short`` one of two routes (k, 3), if it passes something on another side and saves enough; else the
    ``wide`` one, from which solves are easier."""
    shorter = path_length(short) < SHORTER * path_length(wide)
    return short if shorter and on_other_side(field, wide, short) else wide


def _length(paths: Sequence[Array]) -> float:
    return sum(path_length(path) for path in paths)


def straight(request: Request) -> list[Array]:
    """A straight path for every leg."""
    return round_trip(request.stops) if request.loop else [np.array(leg) for leg in legs_between(request.stops)]


def curved(request: Request) -> list[Array]:
    """The same, but for a vehicle on tyres, bent into the directions at marks: it would slide sideways along a straight
    path, and the forces of tyres that slide do not show a solver the way back."""
    paths = straight(request)
    if request.vehicle.rolling is None or request.loop or request.traits.name == STUNT:
        return paths  # a stunt may slide
    directions = pairwise(_direction(mark) for mark in request.marks)
    return [_curve(path, *ends) for path, ends in zip(paths, directions, strict=True)]


def _curve(path: Array, start: Array | None, end: Array | None) -> Array:
    """A cubic curve (k, 3) between the ends of a path that leaves and arrives in horizontal directions (3,), by default
    along the path; the path itself if one of them is not within `GENTLE` of it."""
    chord = path[-1] - path[0]
    length = float(np.linalg.norm(chord))
    slopes = [chord if way is None else length * way for way in (start, end)]
    if len(path) != 2 or min(slope @ chord for slope in slopes) < math.cos(GENTLE) * length**2:
        return path
    t = np.linspace(0.0, 1.0, CURVE_POINTS)[:, None]
    return np.asarray(path[0] + t**2 * (3 - 2 * t) * chord + t * (1 - t) ** 2 * slopes[0] - t**2 * (1 - t) * slopes[1])


def _direction(mark: Mark) -> Array | None:
    """The horizontal direction (3,) in which a vehicle passes a mark or, at rest, in which it points; None if free."""
    if (along := _approach(mark, 1.0)).any():
        return along
    heading = heading_of(mark)
    return None if heading is None else np.array([math.cos(heading), math.sin(heading), 0.0])


def backwards(request: Request, paths: Sequence[Array]) -> list[Array]:
    """The paths as poses (k, 4) of a vehicle that drives backwards along them; none if it need not drive nose first.

    A leg that is too early for a vehicle that turns round first may be possible in reverse.
    """
    moving = [path_length(path) > 1e-6 for path in paths]
    if not _turns(request.vehicle) or not any(moving) or any(path.shape[1] > 3 for path in paths):
        return []
    poses, heading = [], _tail_first(paths[moving.index(True)])[0]
    for path, moves in zip(paths, moving, strict=True):
        headings = _tail_first(path) if moves else np.full(len(path), heading)  # a hold keeps its heading
        poses.append(np.column_stack([path, headings]))
        heading = headings[-1]
    return poses


def turnings(request: Request, paths: Sequence[Array]) -> list[list[Array]]:
    """Other paths for a vehicle that goes nose first but whose nose points away from its way, or whose way doubles
    back, none by default.

    With a turning circle, they are arcs and lines that it can drive, forwards and backwards; and straight back if no
    nose points ahead and it is not far. What turns on the spot, or swims, shuttles. A loop past one mark may also be a
    circle.
    """
    along, vehicle = _along_legs(request), request.vehicle
    if not _turns(vehicle) or not ((along < AWAY).any() or _doubles_back(request)):
        return []
    if slides(vehicle):
        return [round_trip(request.stops, ROUND)] if request.loop and len(along) == 2 else []
    radius, back = turning_radius(vehicle), straight(request)
    if radius == 0 or swims(vehicle):
        others = [shuttling(request)]
    else:
        short = sum(map(path_length, back)) <= REVERSED * radius
        others = [shunting(request, paths), backwards(request, back) if short and (along < AWAY).all() else []]
    return [other for other in others if other]


def shuttling(request: Request) -> list[Array]:
    """Straight poses (2, 4) of a vehicle that goes tail first along each leg that leads back and is not long; none if
    there is no such leg."""
    noses = [heading_of(mark) for mark in request.stops]
    poses, nose, backs = [], noses[0], False
    for (start, end), after in zip(legs_between(request.stops), noses[1:], strict=True):
        step = np.subtract(end, start)
        if (length := float(np.linalg.norm(step))) < 1e-6:
            heading = nose or 0.0
        else:
            ahead = math.atan2(step[1], step[0])
            nose = next((each for each in (nose, after) if each is not None), ahead)
            off = math.remainder(ahead - nose, 2 * math.pi)
            if abs(off) > math.pi / 2 and length <= REVERSED * extent(request.vehicle):
                off, backs = off - math.copysign(math.pi, off), True
            heading = nose + off
        poses.append(np.array([[*start, heading], [*end, heading]]))
        nose = heading
    return poses if backs else []


def _along_legs(request: Request) -> Array:
    """The cosines (legs, 2) of the angles between each leg and the noses at its marks; nan where a heading is free or
    the leg has no length."""
    noses = [np.nan if (nose := heading_of(mark)) is None else nose for mark in request.stops]
    steps = _steps(request)
    lengths = np.linalg.norm(steps, axis=1)
    steps[lengths < 1e-6] = np.nan
    pairs = np.array(list(pairwise(noses)))
    return np.asarray((steps[:, :1] * np.cos(pairs) + steps[:, 1:] * np.sin(pairs)) / lengths[:, None])


def _doubles_back(request: Request) -> bool:
    """Whether a leg leads back along the one before it, by less than a right angle between them."""
    steps = _steps(request)
    steps = steps[np.linalg.norm(steps, axis=1) > 1e-6]
    following = np.roll(steps, -1, axis=0) if request.loop else steps[1:]
    return bool(((steps[: len(following)] * following).sum(axis=1) < 0).any())


def _steps(request: Request) -> Array:
    """The horizontal vectors (legs, 2) m from each mark to the next."""
    return np.array([np.subtract(end, start)[:2] for start, end in legs_between(request.stops)])


def reversing(request: Request) -> Array | None:
    """Poses (k, 4) of a vehicle that reverses straight from mark to mark; None if no nose points away."""
    away = bool((_along_legs(request) < AWAY).any()) and not request.loop
    poses = backwards(request, straight(request)) if away else []
    return np.vstack(poses) if poses else None


def shunting(request: Request, paths: Sequence[Array]) -> list[Array]:
    """Poses (k, 4) that a vehicle with a turning circle can drive from mark to mark, forwards and backwards; none if
    it has no such circle, or if the paths are such poses already."""
    if not _drives(request.vehicle) or turning_radius(request.vehicle) == 0 or any(p.shape[1] > 3 for p in paths):
        return []
    vehicle, kept = request.vehicle, [request.stops[i] for i in placed_marks(request.stops)]
    nose, driven = [heading_of(mark) for mark in kept], []
    for j, leg in enumerate(legs_between(kept)):
        start, end = np.array(leg, float)
        before = end - _approach(kept[j + 1], RUN_UP * turning_radius(vehicle))
        path = guess_drive(vehicle, [], np.array([start, before]), (nose[j], nose[j + 1]), 0.0)
        driven.append(path if np.allclose(before, end) else np.vstack([path, [*end, path[-1, 3]]]))
    return divided(driven, request.stops)


def _approach(mark: Mark, length: float) -> Array:
    """The last part of the way to a mark that is passed in a direction, (3,) m; zero otherwise."""
    along = mark.gate.direction if mark.gate is not None else mark.velocity
    way = np.zeros(3) if along is None else np.array([along[0], along[1], 0.0])
    return way * length / max(float(np.linalg.norm(way)), 1e-9)


def _turns(vehicle: Vehicle) -> bool:
    """Whether a vehicle moves in the plane and has a turning circle, or turns on the spot."""
    return vehicle.group.planar and math.isfinite(turning_radius(vehicle))


def _drives(vehicle: Vehicle) -> bool:
    return _turns(vehicle) and not swims(vehicle)


def _tail_first(path: Array) -> Array:
    """Headings (k,) rad, opposite to the direction of a path (k, 3)."""
    step = np.gradient(path, axis=0)
    return np.asarray(np.unwrap(np.arctan2(-step[:, 1], -step[:, 0])))


def as_clip(request: Request, guess: Any) -> Clip | None:
    """The guess if it is a clip of such a vehicle, to use its joints and controls too; otherwise None."""
    if not isinstance(guess, Clip):
        return None
    names = [[*v.joints, *(control.name for control in v.controls)] for v in (request.vehicle, guess.vehicle)]
    return guess if names[0] == names[1] and request.vehicle.group.name == guess.vehicle.group.name else None
