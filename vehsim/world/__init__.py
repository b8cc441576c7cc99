"""The world: terrain, water, wind, obstacles, and the queries of vehicles about them."""

from __future__ import annotations

from typing import TYPE_CHECKING

from vehsim.runtime.lazy import attach

if TYPE_CHECKING:
    from vehsim.world.distance.field import DistanceField as DistanceField
    from vehsim.world.distance.field import cache_folder as cache_folder
    from vehsim.world.terrain.terrain import Terrain as Terrain
    from vehsim.world.water.water import Water as Water
    from vehsim.world.world import World as World

_PUBLIC = {
    "DistanceField": "vehsim.world.distance.field",
    "Terrain": "vehsim.world.terrain.terrain",
    "Water": "vehsim.world.water.water",
    "World": "vehsim.world.world",
    "cache_folder": "vehsim.world.distance.field",
}
__all__ = ["DistanceField", "Terrain", "Water", "World", "cache_folder"]

# at their first use: heavy libraries are loaded only when they are needed
__getattr__, __dir__ = attach(__name__, _PUBLIC)
