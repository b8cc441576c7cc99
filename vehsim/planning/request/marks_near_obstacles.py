"""Obstacles that a vehicle can touch on its path, and marks in or too near to an obstacle or to rock."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vehsim.errors import InputError, Problem
from vehsim.planning.certificates import FINEST
from vehsim.planning.outlines import clearances
from vehsim.planning.request.landing import attitude, forgiven
from vehsim.planning.request.marks import Mark, heading_of, leeway
from vehsim.planning.trim import balanced, leans
from vehsim.vehicles import Holonomic, Vehicle
from vehsim.world.ground.walls import Walls
from vehsim.world.ground.wheels import wheels_of
from vehsim.world.obstacles.articulated import ArticulatedPart, articulated_footprint, fixed_footprint
from vehsim.world.obstacles.obstacles import footprint, hulls_of, vertical_reach
from vehsim.world.obstacles.plane import Ellipse, placed

Array = NDArray[np.float64]

MOST_LEAN = 0.1
"""The largest lean with which the hulls of a moving vehicle are compared as if it were level, rad."""
LEANING = 0.2
"""Room above a vehicle for its motion on its springs, m."""
STEPS = 5
"""Number of steps from the middle of an obstacle to each corner at which the ground below it is measured."""
TURNS = 180
"""Number of headings to try at a mark without a heading."""
FINE = 0.01
"""In flight, headings between them are tried too until no point of the vehicle moves farther than this, m."""
DIRECTIONS = 16
"""Number of directions in which `nearest_clear` looks."""
ROOM = 0.25
"""Distance beyond the clearance of a place that it finds, m, so that there is a way to it."""
FARTHEST = 50.0
"""How far it looks, m."""
ASIDE = 0.3
"""Angle, rad, by which a trailer that is not in a bay can turn to one side at least."""
SPARSE = 15
"""Every so many of these headings are tried first: in the open, they are enough."""
_HEADINGS = np.arange(TURNS) * 2 * np.pi / TURNS


def parts_in_reach(vehicle: Vehicle, world: Any, marks: Sequence[Any], clearance: float = 0.0) -> list[tuple[Any, int]]:
    """The obstacles of ``world``, with indices of their parts, that a vehicle in the plane can touch, on wheels on the
    ground below them, otherwise at the height of the marks; and the walls of a terrain with overhangs, up to
    ``clearance`` m above the vehicle."""
    if world is None or not vehicle.group.planar:
        return []
    low, high = vertical_reach(vehicle)
    rock = at_level(world, vehicle, marks).walls(high + LEANING + clearance)
    walls = [] if rock is None else [(rock, number) for number in range(len(rock.parts))]
    standing = [(o, number) for o in world.obstacles for number in range(1 if o.moves else len(o.parts))]
    levels = levels_at(vehicle, world, marks, standing)
    met = [o.bottom < at + high and o.top > at + low for (o, _), at in zip(standing, levels, strict=True)]
    return walls + [part for part, meets in zip(standing, met, strict=True) if meets]


def levels_at(vehicle: Vehicle, world: Any, marks: Sequence[Any], parts: Sequence[tuple[Any, int]]) -> list[float]:
    """Heights, m, at which a vehicle in the plane passes ``parts`` of obstacles: on wheels, of the ground below each,
    otherwise of the marks; at the rock of a terrain, those of the marks."""
    height = 0.0 if marks[0].position is None else float(marks[0].position[2])
    if world.terrain is None or vehicle.rig is None or not wheels_of(vehicle.rig):
        return [height] * len(parts)
    there = at_level(world, vehicle, marks)
    return [height if isinstance(o, Walls) else _ground_below(there, o, number) for o, number in parts]


def _ground_below(world: Any, obstacle: Any, number: int) -> float:
    """The median height, m, of the ground below one part of an obstacle, or along the way of one that moves.

    A bridge may rest on the banks of the valley that it spans.
    """
    if obstacle.moves:
        return float(np.median(world.height(obstacle.clip.positions[:, :2])))
    shape = obstacle.parts[number]
    corners = shape.outline() if isinstance(shape, Ellipse) else shape
    middle = corners.mean(axis=0)
    places = middle + np.linspace(0.0, 1.0, STEPS)[:, None, None] * (corners - middle)
    return float(np.median(world.height(places.reshape(-1, 2))))


def at_level(world: Any, vehicle: Vehicle, marks: Sequence[Any]) -> Any:
    """The ``world`` with the level of ground on which a vehicle drives to ``marks``; see `World.on_level`."""
    if world is None or world.terrain is None or world.terrain.surface is None:
        return world
    places = [mark.position for mark in marks if mark.position is not None]
    if not places or not vehicle.group.planar or vehicle.rig is None or not wheels_of(vehicle.rig):
        return world
    return world.on_level(np.array(places, float))


def check_marks_clear(vehicle: Vehicle, world: Any, marks: Sequence[Mark], clearance: float, fps: Any) -> None:
    """Raise ``InputError`` for all of `marks_too_near`."""
    wrong = {  # a hold is two marks with one name
        marks[i].name: Problem(
            f"{marks[i].name}.position", message, remedy, np.asarray(marks[i].position, float).tolist()
        )
        for i, message, remedy in marks_too_near(vehicle, world, marks, clearance, fps)
    }
    if wrong:
        raise InputError.of(*wrong.values())


def marks_too_near(
    vehicle: Vehicle, world: Any, marks: Sequence[Any], clearance: float, fps: Any = None
) -> Iterator[tuple[int, str, str]]:
    """Index, message and remedy of every mark at which the vehicle is in an obstacle, or too near to one; a flying
    vehicle also in rock, or too near to it.

    For a mark without a heading, the best heading counts. At rest, a flying vehicle leans as its balance demands; where
    it may tilt, only the root is checked, and only against obstacles. The tolerance or gate of a mark, and its distance
    to a landing, reduce the required clearance. ``fps``: frames per second; with them, moving obstacles count at marks
    with a frame.
    """
    if world is None:
        return
    parts, flies = parts_in_reach(vehicle, world, marks, clearance), vehicle.group.dim == 6
    less = forgiven(marks if flies else [], clearance)
    for i, mark in enumerate(marks):
        frame = mark.given_frame
        seconds = None if fps is None or frame is None else float(int(frame) / fps)
        if mark.position is None:
            continue
        wanted = clearance - FINEST - leeway(mark) - float(less(np.array([mark.position], float))[0])
        found = (
            _flown(vehicle, world, mark, seconds, wanted) if flies else _driven(vehicle, parts, mark, seconds, wanted)
        )
        if found is None or found.gap + found.spare >= wanted:
            continue
        obstacle, gap, what = found.obstacle, found.gap, found.part and f"its {found.part} is "
        rock = obstacle is None or isinstance(obstacle, Walls)
        where = "rock" if rock else f"obstacle {obstacle.name!r}"
        where += " at any heading" if found.turned else ""
        where += f" at frame {frame}" if obstacle is not None and obstacle.moves else ""
        if gap > 0:
            least = math.floor(100 * (gap + clearance - FINEST - wanted)) / 100
            yield (
                i,
                f"{what}only {gap:.2f} m from {where}",
                f"keep the clearance of {clearance:g} m, or reduce it to {least:g}",
            )
        elif obstacle is None:
            yield i, f"the vehicle reaches {-gap:.2f} m into {where}", "move the mark out of the terrain"
        else:
            yield i, f"{what}in {where}", "move the mark" if rock else "move the mark or the obstacle"


def straightened(vehicle: Vehicle, world: Any, marks: Sequence[Mark], loop: bool = False) -> list[Mark]:
    """The marks; trailers stand straight at a first mark, in a loop only at rest, and wherever the vehicle rests if it
    does so in a bay, unless marks give joints. A free trailer would start folded, as its tractor then leaves more
    easily."""
    if not vehicle.tied:
        return list(marks)
    bay = world is not None and any(_in_bay(vehicle, world, mark) for mark in marks)
    free = [
        mark.joints is None and (mark.at_rest and bay if i else mark.at_rest or not loop)
        for i, mark in enumerate(marks)
    ]
    return [with_trailers_straight(vehicle, mark) if each else mark for mark, each in zip(marks, free, strict=True)]


def with_trailers_straight(vehicle: Vehicle, mark: Mark) -> Mark:
    """The mark with joints at which trailers stand straight; other joints are free."""
    straight = np.full(len(vehicle.joints), np.nan)
    straight[list(vehicle.tied)] = 0.0
    return replace(mark, joints=tuple(straight.tolist()))


def _in_bay(vehicle: Vehicle, world: Any, mark: Mark) -> bool:
    """Whether a vehicle with free trailers rests where they would touch something if turned by `ASIDE` to either
    side; what moves does not count."""
    if not mark.at_rest or mark.joints is not None or mark.position is None or heading_of(mark) is None:
        return False
    turned = {vehicle.joints[joint]: np.array([-ASIDE, ASIDE]) for joint in vehicle.tied}
    poses = np.tile(mark.position, (2, 1)), np.tile(attitude(mark), (2, 1))
    away = world.clearance_by_obstacle(vehicle, *poses, channels=turned)
    return bool((away.min(axis=1, initial=np.inf) <= 0).all())


def facing_clear(
    vehicle: Vehicle, world: Any, given: Sequence[Mark], turned: Sequence[Mark], clearance: float, fps: Any
) -> list[Mark]:
    """The marks ``turned``, with each heading that ``given`` leaves free, and at which the vehicle is too near to
    something, replaced by the nearest one at which it is not; unchanged without one."""
    marks = list(turned)
    landed = [mark for mark in marks if mark.on_ground]
    for i in [i for i, *_ in marks_too_near(vehicle, world, turned, clearance, fps)]:
        mark = marks[i]
        if i and marks[i - 1].hold:
            marks[i] = replace(mark, heading=marks[i - 1].heading)
        elif heading_of(given[i]) is None and mark.heading is not None:
            tried = [mark.heading + side * angle for angle in range(2, 181, 2) for side in (1, -1)]
            there = (replace(mark, heading=heading) for heading in tried)
            marks[i] = next((at for at in there if not _near_first(vehicle, world, at, landed, clearance, fps)), mark)
    return marks


def _near_first(vehicle: Vehicle, world: Any, mark: Mark, landed: Sequence[Mark], clearance: float, fps: Any) -> bool:
    return any(i == 0 for i, *_ in marks_too_near(vehicle, world, [mark, *landed], clearance, fps))


def nearest_clear(
    vehicle: Vehicle, world: Any, mark: Any, clearance: float, moved: Callable[[list[float]], Any]
) -> list[float] | None:
    """The nearest place [x, y, z] m, in whole mm, for a mark in or too near to an obstacle or rock, with some room.

    It is beside the mark or, for a flying vehicle, above it; None if none was found within `FARTHEST`.
    ``moved``: the mark at another place. Along each direction, a step is as long as the missing distance, which no
    shorter way can gain.
    """
    flies, start = vehicle.group.dim == 6, np.array(mark.position, float)
    angles = np.arange(DIRECTIONS) * 2 * np.pi / DIRECTIONS
    ways = [*np.column_stack([np.cos(angles), np.sin(angles), 0 * angles]), *([np.array([0.0, 0.0, 1.0])] * flies)]
    best, found = FARTHEST, None
    for way in ways:
        away = 0.0
        while away < best:
            place = start + away * way
            if not flies and world.terrain is not None:
                place[2] = world.height(place[None, :2])[0]
            place = place.round(3)
            if (missing := _missing(vehicle, world, moved(place.tolist()), clearance + ROOM)) <= 0:
                best, found = away, place.tolist()
            away += max(missing, 0.01)
    return found


def _missing(vehicle: Vehicle, world: Any, mark: Any, clearance: float) -> float:
    """How much farther a mark must be from obstacles and rock, m; at most 0 if it is clear."""
    if vehicle.group.dim == 6 and world.terrain is not None and world.terrain.below([mark.position])[0]:
        return max(float(world.height([mark.position[:2]])[0]) - mark.position[2], 0.0) + max(clearance, 0.01)
    if vehicle.group.dim == 6:
        near = _flown(vehicle, world, mark, None, clearance - leeway(mark))
    else:
        near = _driven(vehicle, parts_in_reach(vehicle, world, [mark], clearance), mark, None, clearance)
    return -np.inf if near is None else clearance - near.gap - leeway(mark)


@dataclass(frozen=True)
class _Nearest:
    """The smallest signed distance at a mark, m, and from which obstacle; without one, from rock. ``turned``: at the
    best of all headings; ``spare``: by how much it may be larger, m, because not all headings were measured; ``part``:
    the name of what alone is that near, such as a trailer; empty for the vehicle itself."""

    gap: float
    obstacle: Any
    turned: bool = False
    spare: float = 0.0
    part: str = ""


def _driven(
    vehicle: Vehicle, parts: Sequence[tuple[Any, int]], mark: Any, seconds: float | None, wanted: float
) -> _Nearest | None:
    """The nearest of the obstacles at a mark of a vehicle on the ground, with its trailers straight and, where the mark
    gives their joints, also as it gives them. ``wanted`` m: the distance that would do."""
    parts = [(obstacle, number) for obstacle, number in parts if seconds is not None or not obstacle.moves]
    if not parts:
        return None
    nose, swings = heading_of(mark), articulated_footprint(vehicle)
    yaw = _HEADINGS if nose is None else np.array([nose])
    places = np.repeat(np.array([mark.position[:2]], float), len(yaw), axis=0)

    def gaps(outline: Array, chosen: Sequence[tuple[Any, int]], at: Any = slice(None)) -> Array:
        return clearances(chosen, placed(outline, places[at], yaw[at]), np.full(len(yaw[at]), seconds or 0.0))

    turned = [(part, outline) for part in swings if (outline := _turned(vehicle, part, mark)) is not None]
    near, height = gaps(footprint(vehicle), parts), float(mark.position[2])
    for part, outline in turned:
        level = [part.meets(o, height) for o, _ in parts]
        near[level] = np.minimum(near[level], gaps(outline, parts)[level])
    best = int(near.min(axis=0).argmax())
    nearest, gap, here = parts[int(near[:, best].argmin())], float(near[:, best].min()), slice(best, best + 1)
    spare = 0.0 if nose is not None else max(map(_between, [footprint(vehicle), *(outline for _, outline in turned)]))
    found = _Nearest(gap, nearest[0], nose is None, spare)
    if not swings or gap >= wanted or gaps(fixed_footprint(vehicle), [nearest], here)[0, 0] < wanted:
        return found
    swung = [(part.name, part.outline) for part in swings] + [(part.name, outline) for part, outline in turned]
    name, _ = min(swung, key=lambda one: gaps(one[1], [nearest], here)[0, 0])
    return replace(found, part=name)


def _turned(vehicle: Vehicle, part: ArticulatedPart, mark: Any) -> Array | None:
    """The outline (k, 2) m of a part in the root's frame where a mark gives all joints that turn it; None elsewhere."""
    given = mark.joints or {}
    given = given if isinstance(given, Mapping) else dict(zip(vehicle.joints, given, strict=True))
    angles = {name: np.array([given.get(name, np.nan)]) for name, _, _ in part.pivots}
    outline = part.at(angles)[0]
    return outline if np.isfinite(outline).all() else None


def _flown(vehicle: Vehicle, world: Any, mark: Any, seconds: float | None, wanted: float) -> _Nearest | None:
    """The same for a flying vehicle: with its hulls if its attitude is given or follows from balance, or, with an
    allowance, if it has a heading. ``wanted`` m: the distance that would do."""
    if mark.on_ground:
        return None
    nose, rests, lean = heading_of(mark), mark.velocity is not None and not np.any(mark.velocity), 0.0
    if mark.orientation is None and not rests:
        lean = np.inf if nose is None else _lean(vehicle, world.wind)
    if lean >= MOST_LEAN:
        obstacles, gaps = _gaps(replace(vehicle, rig=None), world, mark, attitude(mark)[None], {}, seconds)
        return _Nearest(float(gaps.min()), obstacles[int(gaps.argmin())]) if gaps.min(initial=np.inf) <= 0 else None
    points, found = np.vstack(hulls_of(vehicle)) if vehicle.rig else np.zeros((1, 3)), None
    turned = rests and nose is None
    headings, width = (_HEADINGS[::SPARSE], 2 * np.pi / TURNS * SPARSE) if turned else (np.array([nose or 0.0]), 0.0)
    reach, sideways = (float(np.linalg.norm(points[:, :n], axis=1).max()) for n in (3, 2))
    while True:
        in_balance = mark.orientation is None and rests
        turns, channels = balanced(vehicle, headings, world.wind) if in_balance else (attitude(mark)[None], {})
        obstacles, gaps = _gaps(vehicle, world, mark, turns, channels, seconds)
        if not obstacles:
            return None
        spare, least = width / 2 * sideways + lean * reach, gaps.min(axis=1)
        best = int(least.argmax())
        if found is None or least[best] > found.gap:
            found = _Nearest(float(least[best]), obstacles[int(gaps[best].argmin())], turned)
        hopeful = least + spare >= wanted
        if turned and found.gap < wanted and width > 2 * np.pi / TURNS:
            headings, width = _HEADINGS, 2 * np.pi / TURNS
            continue
        if not hopeful.any() or found.gap >= wanted or spare < FINE or not turned:
            return replace(found, spare=spare if hopeful.any() else 0.0)
        headings = (headings[hopeful, None] + width * np.array([-3, -1, 1, 3]) / 8).ravel()
        width /= 4


def _gaps(
    vehicle: Vehicle, world: Any, mark: Any, turns: Array, channels: Mapping[str, Array], seconds: float | None
) -> tuple[list[Any], Array]:
    """What is near a mark, None for rock, and the distances from it with orientations (n, 4) and channels (n,),
    (n, obstacles) m."""
    places = np.repeat(np.array([mark.position], float), len(turns), axis=0)
    obstacles, gaps = [], np.empty((len(turns), 0))
    if world.terrain is not None and not world.terrain.below(places[:1])[0]:  # routes and shots report a root in rock
        obstacles, gaps = [None], world.clearance_from_terrain(vehicle, places, turns, channels)[:, None]
    if world.standing or (world.obstacles and seconds is not None):
        times = None if seconds is None else np.full(len(turns), seconds)
        gaps = np.hstack([gaps, world.clearance_by_obstacle(vehicle, places, turns, times, channels)])
        obstacles += world.obstacles
    return obstacles, gaps


def _lean(vehicle: Vehicle, wind: Any) -> float:
    """How far a flying vehicle may lean to hold its place in a wind (3,) m/s, rad: as in still air, and twice what the
    wind asks for; inf if unknown."""
    still = leans(vehicle)
    if not (vehicle.feels_wind and np.any(wind)):
        return still
    if not isinstance(vehicle, Holonomic) or not vehicle.gravity:
        return np.inf
    weight = vehicle.gravity * (vehicle.mass or float(np.diag(vehicle.inertia)[3:].min()))
    return still + 2 * vehicle.largest_drag(float(np.linalg.norm(wind))) / weight


def _between(points: Array) -> float:
    """How far a point of the vehicle (k, 2) moves between two of the headings that are tried, at most, m."""
    return np.pi / TURNS * float(np.linalg.norm(points, axis=1).max())
