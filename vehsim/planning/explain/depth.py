"""Where a flight leads below the level on which its obstacles stand."""

from __future__ import annotations

from vehsim.clip.clip import Clip
from vehsim.planning.request.request import Request
from vehsim.world.world import STANDING


def below_level(clip: Clip, request: Request) -> str:
    """A warning if a flight between marks above z = 0 passes below the obstacles that stand there, where a world
    without a terrain has no ground; otherwise empty."""
    world, z = request.world, clip.positions[:, 2]
    if clip.vehicle.group.planar or world is None or not world.seems_level or z.min() >= -STANDING:
        return ""
    if any(mark.position is not None and mark.position[2] < 0 for mark in request.marks):
        return ""
    frame = round(clip.start_frame + clip.fps * clip.times[z.argmin()])
    where = f"flies at z = {z.min():.1f} m at frame {frame}, below its obstacles"
    return f'{where}: without a terrain there is no ground; give the world terrain = "flat"'
