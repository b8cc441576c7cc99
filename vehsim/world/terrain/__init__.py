"""The ground: heights, mesh and look, and the files they are read from."""

from __future__ import annotations

from typing import TYPE_CHECKING

from vehsim.runtime.lazy import attach

if TYPE_CHECKING:
    from vehsim.world.terrain.terrain import Terrain as Terrain

_PUBLIC = {
    "Terrain": "vehsim.world.terrain.terrain",
}
__all__ = ["Terrain"]

# at their first use: heavy libraries are loaded only when they are needed
__getattr__, __dir__ = attach(__name__, _PUBLIC)
