"""How motion enters a USD rig: its parts and hulls, the ops that drive them, an animator's blocking."""

from __future__ import annotations

from typing import TYPE_CHECKING

from vehsim.runtime.lazy import attach

if TYPE_CHECKING:
    from vehsim.rig.blocking import Blocking as Blocking
    from vehsim.rig.blocking import read_blocking as read_blocking
    from vehsim.rig.ops import rig_problems as rig_problems
    from vehsim.rig.parts import Part as Part
    from vehsim.rig.parts import add_to_spec as add_to_spec
    from vehsim.rig.parts import collision_hulls as collision_hulls
    from vehsim.rig.parts import read_parts as read_parts

_PUBLIC = {
    "Blocking": "vehsim.rig.blocking",
    "Part": "vehsim.rig.parts",
    "add_to_spec": "vehsim.rig.parts",
    "collision_hulls": "vehsim.rig.parts",
    "read_blocking": "vehsim.rig.blocking",
    "read_parts": "vehsim.rig.parts",
    "rig_problems": "vehsim.rig.ops",
}
__all__ = ["Blocking", "Part", "add_to_spec", "collision_hulls", "read_blocking", "read_parts", "rig_problems"]

# Loaded at first use: heavy libraries are loaded only when they are needed.
__getattr__, __dir__ = attach(__name__, _PUBLIC)
