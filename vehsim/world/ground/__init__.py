"""Vehicles on terrain: wheels, slopes, and landing."""

from __future__ import annotations

from typing import TYPE_CHECKING

from vehsim.runtime.lazy import attach

if TYPE_CHECKING:
    from vehsim.world.ground.placing import place_on_terrain as place_on_terrain
    from vehsim.world.ground.slope import on_terrain as on_terrain

_PUBLIC = {
    "place_on_terrain": "vehsim.world.ground.placing",
    "on_terrain": "vehsim.world.ground.slope",
}
__all__ = ["on_terrain", "place_on_terrain"]

# at their first use: heavy libraries are loaded only when they are needed
__getattr__, __dir__ = attach(__name__, _PUBLIC)
