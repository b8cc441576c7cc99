"""The water of a shot file: made from ``[world.water]``, angles in degrees there, and what is wrong with it."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from vehsim.errors import InputError, Problem

if TYPE_CHECKING:
    from vehsim.shot.world_tables import WaterTable
    from vehsim.vehicles import Vehicle
    from vehsim.world import World
    from vehsim.world.water import Current, Surface, Water, Waves


def make_water(table: WaterTable | None, folder: Path) -> Water | None:
    """The water a table asks for; paths are relative to ``folder``. Raises ``InputError``."""
    from vehsim.world.water import Water

    if table is None:
        return None
    return Water(table.level, _surface(table, folder), _current(table), table.density, table.height_field)


def check_water(table: WaterTable | None, folder: Path) -> Iterator[Problem]:
    """What makes no water."""
    if table is not None and table.grids is not None and (table.wave or table.sea):
        yield Problem("world.water.grids", "waves are given too", "keep one of them", table.grids)
        return
    try:
        make_water(table, folder)
    except InputError as error:
        yield Problem("world.water", str(error), "see [world.water] in docs/shot-file.md")


def check_afloat(vehicle: Vehicle, world: World) -> Iterator[Problem]:
    """A hull that is none, or does not carry its vehicle; the key is the vehicle's own."""
    if world.water is None or vehicle.hull is None:
        return
    from vehsim.world.buoyancy import Afloat

    try:
        Afloat(vehicle, world).floating()
    except InputError as error:
        yield Problem("asset", str(error), "see hull in its vehicle.toml", vehicle.name)


def _surface(table: WaterTable, folder: Path) -> Surface | None:
    from vehsim.world.sea import sea_state, together
    from vehsim.world.water import wave

    if table.grids is not None:
        from vehsim.world.water_grids import WaterGrids

        return WaterGrids.load(folder / Path(table.grids).expanduser())
    trains: list[Waves] = [
        wave(w.height, w.length, float(np.deg2rad(w.heading)), float(np.deg2rad(w.phase))) for w in table.wave
    ]
    if table.sea is not None:
        sea = table.sea
        heading, spread = (float(np.deg2rad(angle)) for angle in (sea.heading, sea.spread))
        trains.append(
            sea_state(sea.height, sea.period, sea.seed, heading=heading, spread=spread, peakedness=sea.peakedness)
        )
    return together(*trains, choppiness=table.choppiness) if trains else None


def _current(table: WaterTable) -> Current | None:
    from vehsim.world.currents import Currents, Stream, Vortex

    parts: list[Current] = []
    if any(table.current):
        x, y, z = table.current
        parts.append(Stream((x, y, z), np.inf if table.current_depth is None else table.current_depth))
    parts += [Vortex((v.centre[0], v.centre[1]), v.speed, v.radius) for v in table.vortex]
    return None if not parts else parts[0] if len(parts) == 1 else Currents(tuple(parts))
