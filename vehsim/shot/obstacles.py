"""The obstacles of a shot file: made from ``[[world.obstacle]]`` tables, and what is wrong with them.

Geometry and its messages are `vehsim.world.obstacles`; a vehicle that others keep clear of joins once its motion is
known.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from vehsim.errors import InputError, Problem, ShotError
from vehsim.shot.checks import choose
from vehsim.shot.world_tables import VehicleObstacleTable

if TYPE_CHECKING:
    from vehsim.clip import Clip
    from vehsim.shot.model import MarkTable
    from vehsim.vehicles import Vehicle
    from vehsim.world import World
    from vehsim.world.obstacles import Obstacle


def standing(tables: Sequence[Any], folder: Path) -> list[Obstacle]:
    """Everything that does not move. Raises ``InputError``."""
    return [_make(i, table, folder) for i, table in enumerate(tables) if not isinstance(table, VehicleObstacleTable)]


def with_vehicles(world: World, clips: Mapping[str, Clip], names: Collection[str], but: str) -> World:
    """The world with the vehicles ``names`` in it that are on their way already, all ``but`` one."""
    from vehsim.world.obstacles import moving

    return world.among([moving(name, clip) for name, clip in clips.items() if name in names and name != but])


def check_obstacles(tables: Sequence[Any], folder: Path, vehicles: Sequence[str]) -> Iterator[Problem]:
    """Shapes that are none, names used twice, vehicles that are not there."""
    names: list[str] = []
    for i, table in enumerate(tables):
        key = f"world.obstacle[{i}]"
        if isinstance(table, VehicleObstacleTable):
            if table.vehicle not in vehicles:
                yield Problem(f"{key}.vehicle", "no such vehicle", choose(table.vehicle, vehicles), table.vehicle)
        else:
            try:
                _make(i, table, folder)
            except ShotError as error:  # of the file that it names
                for said in error.problems:
                    yield replace(said, key=f"{key}.path", message=f"{said.file}: {said.message}", file="")
            except InputError as error:
                what, _, rest = str(error).partition(": ")[2].partition(": ")
                wrong, _, mend = rest.rpartition("; ")
                part = what.partition(" = ")[0]
                yield Problem(f"{key}.{part}", wrong, mend, getattr(table, part, None))
        if _name(i, table) in names:
            yield Problem(f"{key}.name", "used twice", "give every obstacle a name of its own", _name(i, table))
        names.append(_name(i, table))


def check_marks(marks: Sequence[MarkTable], vehicle: Vehicle, world: World, clearance: float) -> Iterator[Problem]:
    """Marks whose vehicle would stand in an obstacle, or too near to one."""
    from vehsim.planning.obstacles import marks_too_near

    for i, message, mend in marks_too_near(vehicle, world, marks, clearance):
        yield Problem(f"mark[{i}].position", message, mend, marks[i].position)


def _name(i: int, table: Any) -> str:
    return table.name or f"{table.shape}_{i}"


def _make(i: int, table: Any, folder: Path) -> Obstacle:
    from vehsim.world import obstacles

    given = table.model_dump(exclude={"shape", "name"})
    if "path" in given:
        given["path"] = folder / Path(given["path"]).expanduser()
    made: Obstacle = getattr(obstacles, table.shape)(_name(i, table), **given)
    return made
