"""What a vehicle is, and the vehicles that ship: each written once, symbolically."""

from __future__ import annotations

from typing import TYPE_CHECKING

from vehsim._lazy import attach
from vehsim.vehicles._base import Channel as Channel
from vehsim.vehicles._base import Control as Control
from vehsim.vehicles._base import Drive as Drive
from vehsim.vehicles._base import Rig as Rig
from vehsim.vehicles._base import State as State
from vehsim.vehicles._base import Suspension as Suspension
from vehsim.vehicles._base import Vehicle as Vehicle
from vehsim.vehicles.library import available as available
from vehsim.vehicles.library import load_vehicle as load_vehicle

if TYPE_CHECKING:
    from vehsim.vehicles.holonomic import Holonomic as Holonomic
    from vehsim.vehicles.nonholonomic import Nonholonomic as Nonholonomic

_SYMBOLIC = {"Holonomic": "vehsim.vehicles.holonomic", "Nonholonomic": "vehsim.vehicles.nonholonomic"}
# at their first use: CasADi is loaded only when a vehicle's equations are needed
__getattr__, __dir__ = attach(__name__, _SYMBOLIC)
