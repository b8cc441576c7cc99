"""vehsim: vehicles that obey physics and arrive on the artist's marks."""

from __future__ import annotations

import os
import sys
from typing import TYPE_CHECKING

from vehsim.runtime.lazy import attach

__version__ = "0.1.0"

if sys.platform == "linux":
    # MuJoCo chooses its OpenGL platform at its first import, which may be for a distance query, long before a picture
    os.environ.setdefault("MUJOCO_GL", "egl")

_PUBLIC = {
    "Clip": "vehsim.clip",
    "Mark": "vehsim.planning",
    "Plan": "vehsim.planning",
    "Shot": "vehsim.shot",
    "State": "vehsim.vehicles",
    "Take": "vehsim.delivery",
    "World": "vehsim.world",
    "load_vehicle": "vehsim.vehicles",
    "plan": "vehsim.planning",
    "simulate": "vehsim.simulation",
}
__all__ = [*_PUBLIC, "__version__"]

if TYPE_CHECKING:  # type checkers see the names and modules, and report typing errors
    from vehsim import assets as assets
    from vehsim import audit as audit
    from vehsim import batch as batch
    from vehsim import cameras as cameras
    from vehsim import clip as clip
    from vehsim import delivery as delivery
    from vehsim import errors as errors
    from vehsim import exporters as exporters  # type: ignore[attr-defined]  # not in the folder
    from vehsim import integrators as integrators
    from vehsim import lie as lie
    from vehsim import pilots as pilots
    from vehsim import planning as planning
    from vehsim import requests as requests
    from vehsim import rig as rig
    from vehsim import shot as shot
    from vehsim import simulation as simulation
    from vehsim import sinusoids as sinusoids
    from vehsim import vehicles as vehicles
    from vehsim import world as world
    from vehsim.clip import Clip as Clip
    from vehsim.delivery import Take as Take
    from vehsim.planning import Mark as Mark
    from vehsim.planning import Plan as Plan
    from vehsim.planning import plan as plan
    from vehsim.shot import Shot as Shot
    from vehsim.simulation import simulate as simulate
    from vehsim.vehicles import State as State
    from vehsim.vehicles import load_vehicle as load_vehicle
    from vehsim.world import World as World
else:  # imported at first use, so that ``import vehsim`` is instant
    __getattr__, __dir__ = attach(__name__, _PUBLIC, elsewhere=("assets", "exporters"))
