"""Water: its surface, sea states, currents, recorded grids, and its effect on a hull."""

from __future__ import annotations

from typing import TYPE_CHECKING

from vehsim.runtime.lazy import attach

if TYPE_CHECKING:
    from vehsim.world.water.sea import sea_state as sea_state
    from vehsim.world.water.water import Current as Current
    from vehsim.world.water.water import Surface as Surface
    from vehsim.world.water.water import Water as Water
    from vehsim.world.water.water import Waves as Waves
    from vehsim.world.water.water import wave as wave

_PUBLIC = {
    "Current": "vehsim.world.water.water",
    "Surface": "vehsim.world.water.water",
    "Water": "vehsim.world.water.water",
    "Waves": "vehsim.world.water.water",
    "sea_state": "vehsim.world.water.sea",
    "wave": "vehsim.world.water.water",
}
__all__ = ["Current", "Surface", "Water", "Waves", "sea_state", "wave"]

# at their first use: heavy libraries are loaded only when they are needed
__getattr__, __dir__ = attach(__name__, _PUBLIC)
