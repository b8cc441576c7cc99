"""Put planar motion on what carries it: wheels on the ground, hulls on the water."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from vehsim.world.ground.placing import SAMPLES, place_on_terrain
from vehsim.world.water.gliding import place_on_water

if TYPE_CHECKING:
    from vehsim.clip.clip import Clip


def placed(clip: Clip, world: Any, samples: int = SAMPLES, coarse: bool = False, loop: bool = False) -> Clip:
    """The clip on ``world``'s terrain and water: `place_on_terrain` and `place_on_water`."""
    return place_on_water(place_on_terrain(clip, world, samples, coarse, loop), world, samples, loop)
