"""The water of a shot file: made from ``[world.water]``, with angles in degrees, and its checks."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from vehsim.errors import InputError, Problem

if TYPE_CHECKING:
    from vehsim.shot.schema.world import WaterTable
    from vehsim.vehicles import Vehicle
    from vehsim.world.water.water import Current, Surface, Water, Waves
    from vehsim.world.world import World


def make_water(table: WaterTable | None, folder: Path) -> Water | None:
    """The water of a table; paths are relative to ``folder``. Raises ``InputError``."""
    from vehsim.world.water.water import Water

    if table is None:
        return None
    return Water(table.level, _surface(table, folder), _current(table), table.density, table.height_field)


def check_water(table: WaterTable | None, folder: Path) -> Iterator[Problem]:
    """Errors of a table that cannot become water."""
    if table is not None and table.grids is not None and (table.wave or table.sea):
        yield Problem("world.water.grids", "waves are given too", "keep one of them", table.grids)
        return
    if table is not None and table.mole and not (table.wave or table.sea):
        yield Problem("world.water.mole", "there are no waves", "give waves or a sea, or leave the moles out")
        return
    try:
        make_water(table, folder)
    except InputError as error:
        for problem in error.problems:
            yield problem.seen_from("world.water", remedy="see [world.water] in docs/shot-file.md")


def check_afloat(vehicle: Vehicle, world: World) -> Iterator[Problem]:
    """A hull is valid and carries its vehicle; the key is the vehicle's own."""
    if world.water is None or vehicle.hull is None:
        return
    from vehsim.world.water.buoyancy import Afloat

    try:
        Afloat(vehicle, world).floating()
    except InputError as error:
        for problem in error.problems:
            yield problem.seen_from("asset", vehicle.name, "see hull in its vehicle.toml")


def _surface(table: WaterTable, folder: Path) -> Surface | None:
    from vehsim.world.water.sea import sea_state, together
    from vehsim.world.water.water import wave

    if table.grids is not None:
        from vehsim.world.water.grids import WaterGrids

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
    moles = [np.array(mole.line, float) for mole in table.mole]
    return together(*trains, choppiness=table.choppiness, moles=moles) if trains else None


def _current(table: WaterTable) -> Current | None:
    from vehsim.world.water.currents import Currents, Stream, Vortex

    parts: list[Current] = []
    if any(table.current):
        x, y, z = table.current
        parts.append(Stream((x, y, z), np.inf if table.current_depth is None else table.current_depth))
    parts += [Vortex((v.centre[0], v.centre[1]), v.speed, v.radius) for v in table.vortex]
    return None if not parts else parts[0] if len(parts) == 1 else Currents(tuple(parts))
