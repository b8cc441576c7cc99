"""Standing and moving obstacles, in three dimensions and in plan view."""

from __future__ import annotations

from typing import TYPE_CHECKING

from vehsim.runtime.lazy import attach

if TYPE_CHECKING:
    from vehsim.world.obstacles.obstacles import Moving as Moving
    from vehsim.world.obstacles.obstacles import Obstacle as Obstacle
    from vehsim.world.obstacles.obstacles import box as box
    from vehsim.world.obstacles.obstacles import cone as cone
    from vehsim.world.obstacles.obstacles import ellipse as ellipse
    from vehsim.world.obstacles.obstacles import mesh as mesh
    from vehsim.world.obstacles.obstacles import moving as moving
    from vehsim.world.obstacles.obstacles import polygon as polygon
    from vehsim.world.obstacles.obstacles import sphere as sphere

_PUBLIC = {
    "Moving": "vehsim.world.obstacles.obstacles",
    "Obstacle": "vehsim.world.obstacles.obstacles",
    "box": "vehsim.world.obstacles.obstacles",
    "cone": "vehsim.world.obstacles.obstacles",
    "ellipse": "vehsim.world.obstacles.obstacles",
    "mesh": "vehsim.world.obstacles.obstacles",
    "moving": "vehsim.world.obstacles.obstacles",
    "polygon": "vehsim.world.obstacles.obstacles",
    "sphere": "vehsim.world.obstacles.obstacles",
}
__all__ = ["Moving", "Obstacle", "box", "cone", "ellipse", "mesh", "moving", "polygon", "sphere"]

# at their first use: heavy libraries are loaded only when they are needed
__getattr__, __dir__ = attach(__name__, _PUBLIC)
