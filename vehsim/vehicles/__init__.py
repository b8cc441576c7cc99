"""What a vehicle is, and the shipped vehicles, each defined once, symbolically."""

from __future__ import annotations

from typing import TYPE_CHECKING

from vehsim.rig.rig import Channel as Channel
from vehsim.rig.rig import Drive as Drive
from vehsim.rig.rig import Rig as Rig
from vehsim.rig.rig import Suspension as Suspension
from vehsim.runtime.lazy import attach
from vehsim.vehicles.definition.base import Control as Control
from vehsim.vehicles.definition.base import State as State
from vehsim.vehicles.definition.vehicle import Vehicle as Vehicle
from vehsim.vehicles.library.library import available as available
from vehsim.vehicles.library.library import load_vehicle as load_vehicle

if TYPE_CHECKING:
    from vehsim.vehicles.definition.holonomic import Holonomic as Holonomic
    from vehsim.vehicles.definition.nonholonomic import Nonholonomic as Nonholonomic

_SYMBOLIC = {
    "Holonomic": "vehsim.vehicles.definition.holonomic",
    "Nonholonomic": "vehsim.vehicles.definition.nonholonomic",
}
# Loaded at first use: CasADi is loaded only when a vehicle's equations are needed.
__getattr__, __dir__ = attach(__name__, _SYMBOLIC)
