"""The obstacles of a shot file: made from ``[[world.obstacle]]`` tables, and their checks.

Geometry and its messages are in `vehsim.world.obstacles`; a vehicle that is an obstacle joins once its motion is known.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from vehsim.errors import InputError, Problem
from vehsim.shot.checks import did_you_mean
from vehsim.shot.schema.world import VehicleObstacleTable

if TYPE_CHECKING:
    from vehsim.clip.clip import Clip
    from vehsim.shot.schema.tables import MarkTable
    from vehsim.vehicles import Vehicle
    from vehsim.world.obstacles.obstacles import Obstacle
    from vehsim.world.world import World

HALFWAY = 0.02
"""Share of half a height within which an obstacle above the ground counts as placed by its middle."""


def standing(tables: Sequence[Any], folder: Path) -> list[Obstacle]:
    """All standing obstacles. Raises ``InputError``."""
    return [_make(i, table, folder) for i, table in enumerate(tables) if not isinstance(table, VehicleObstacleTable)]


def with_vehicles(world: World, clips: Mapping[str, Clip], names: Collection[str], but: str) -> World:
    """The world with the moving vehicles ``names``, except ``but``."""
    from vehsim.world.obstacles.obstacles import moving

    return world.with_obstacles([moving(name, clip) for name, clip in clips.items() if name in names and name != but])


def check_obstacles(
    tables: Sequence[Any], folder: Path, vehicles: Sequence[str], left_out: Sequence[str] = ()
) -> Iterator[Problem]:
    """Shapes are valid, names differ, vehicles exist and none of them was ``left_out``."""
    names: list[str] = []
    for i, table in enumerate(tables):
        key = f"world.obstacle[{i}]"
        if isinstance(table, VehicleObstacleTable):
            if table.vehicle in left_out:
                message, remedy = "left out, but the others avoid it", f"add --only {table.vehicle}"
                yield Problem(f"{key}.vehicle", message, remedy, table.vehicle)
            elif table.vehicle not in vehicles:
                yield Problem(f"{key}.vehicle", "no such vehicle", did_you_mean(table.vehicle, vehicles), table.vehicle)
        else:
            try:
                _make(i, table, folder)
            except InputError as error:
                for problem in error.problems:
                    if problem.file:  # of the file that it names
                        yield problem.seen_from(f"{key}.path", table.path)
                    else:
                        yield problem.below(key, value=getattr(table, problem.key, None), subject="")
        name = name_of(i, table)
        if name in names:
            yield Problem(f"{key}.name", "used twice", "give every obstacle a name of its own", name)
        names.append(name)


def check_stands(tables: Sequence[Any], world: World) -> Iterator[Problem]:
    """Boxes and cones whose middle is where their bottom belongs: a warning."""
    height_of = {"box": lambda table: table.size[2], "cone": lambda table: table.height}
    for i, table in enumerate(tables):
        if table.shape not in height_of:
            continue
        half = height_of[table.shape](table) / 2
        below = max(float(world.height(table.centre[:2])[0]), -math.inf if world.water is None else world.water.level)
        gap = table.centre[2] - below
        if gap > 0 and abs(gap - half) < HALFWAY * half:
            message = f"obstacle {name_of(i, table)!r} hangs {gap:.3g} m above the ground, half of its height"
            remedy = f"centre is the centre of its bottom; if it stands, give z = {below:.3g}"
            yield Problem(f"world.obstacle[{i}].centre", message, remedy, table.centre, severity="warning")


def check_marks(marks: Sequence[MarkTable], vehicle: Vehicle, world: World, clearance: float) -> Iterator[Problem]:
    """Marks at which the vehicle would be in an obstacle, or too close to one."""
    from vehsim.planning.request.marks_near_obstacles import marks_too_near

    for i, message, remedy in marks_too_near(vehicle, world, marks, clearance):
        key = f"mark[{i}].position"
        yield Problem(
            key, message, remedy, marks[i].position, fixes=clear_place(key, marks[i], vehicle, world, clearance)
        )


def clear_place(
    key: str, mark: MarkTable, vehicle: Vehicle, world: World, clearance: float
) -> tuple[tuple[str, list[float]], ...]:
    """The fix of a mark in or too near to an obstacle or rock: its key with the nearest place, if one was found."""
    from vehsim.planning.request.marks_near_obstacles import nearest_clear

    place = nearest_clear(vehicle, world, mark, clearance, lambda there: mark.model_copy(update={"position": there}))
    return () if place is None else ((key, place),)


def name_of(i: int, table: Any) -> str:
    """The name of the obstacle at index ``i``."""
    return table.name or f"{table.shape}_{i}"


def _make(i: int, table: Any, folder: Path) -> Obstacle:
    from vehsim.world.obstacles import obstacles

    given = table.model_dump(exclude={"shape", "name", "finish", "colour"})
    if "path" in given:
        given["path"] = folder / Path(given["path"]).expanduser()
    made: Obstacle = getattr(obstacles, table.shape)(name_of(i, table), **given)
    colour = None if table.colour is None else tuple(table.colour)
    return replace(made, finish=table.finish or made.finish, colour=colour)
