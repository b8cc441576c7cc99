"""Feedback controllers ``pilot(t, state) -> controls``, and the paths and gaits they follow."""

from __future__ import annotations

from typing import TYPE_CHECKING

from vehsim.runtime.lazy import attach

if TYPE_CHECKING:
    from vehsim.pilots.controllers import PILOTS as PILOTS
    from vehsim.pilots.controllers import FlyTo as FlyTo
    from vehsim.pilots.controllers import FollowPath as FollowPath
    from vehsim.pilots.controllers import Hover as Hover
    from vehsim.pilots.gait import Gait as Gait

_PUBLIC = {
    "FlyTo": "vehsim.pilots.controllers",
    "FollowPath": "vehsim.pilots.controllers",
    "Gait": "vehsim.pilots.gait",
    "Hover": "vehsim.pilots.controllers",
    "PILOTS": "vehsim.pilots.controllers",
}
__all__ = ["PILOTS", "FlyTo", "FollowPath", "Gait", "Hover"]

# Loaded at first use: heavy libraries are loaded only when they are needed.
__getattr__, __dir__ = attach(__name__, _PUBLIC)
