"""vehsim: vehicles that move as physics says and land on the mark the artist set."""

from __future__ import annotations

import importlib
import os
import sys
from typing import TYPE_CHECKING, Any

__version__ = "0.1.0"

if sys.platform == "linux":
    # MuJoCo chooses its OpenGL platform at its first import, which may be for a distance, long before a picture
    os.environ.setdefault("MUJOCO_GL", "egl")

_PUBLIC = {
    "Clip": "vehsim.clip",
    "Mark": "vehsim.planning",
    "Plan": "vehsim.planning",
    "Shot": "vehsim.shot",
    "State": "vehsim.vehicles",
    "Take": "vehsim.take",
    "World": "vehsim.world",
    "load_vehicle": "vehsim.vehicles",
    "plan": "vehsim.planning",
    "simulate": "vehsim.simulation",
}
__all__ = [*_PUBLIC, "__version__"]

if TYPE_CHECKING:
    from vehsim.clip import Clip as Clip
    from vehsim.planning import Mark as Mark
    from vehsim.planning import Plan as Plan
    from vehsim.planning import plan as plan
    from vehsim.shot import Shot as Shot
    from vehsim.simulation import simulate as simulate
    from vehsim.take import Take as Take
    from vehsim.vehicles import State as State
    from vehsim.vehicles import load_vehicle as load_vehicle
    from vehsim.world import World as World


def __getattr__(name: str) -> Any:
    """Import a public name when it is first asked for, so that ``import vehsim`` stays instant."""
    if name not in _PUBLIC:
        raise AttributeError(f"module 'vehsim' has no attribute {name!r}")
    return getattr(importlib.import_module(_PUBLIC[name]), name)
