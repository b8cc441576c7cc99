"""Where a vehicle on the ground meets the walls and roofs of caves, tunnels and arches."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from vehsim.clip.clip import Clip
from vehsim.lie.quaternions import matrices
from vehsim.world.obstacles.obstacles import hulls_of

Array = NDArray[np.float64]

GROUND = 0.3
"""Lower points of a vehicle's hulls may touch uneven ground, m above the lowest one."""


def rock_under_wheels(clip: Clip, world: Any) -> bool:
    """Whether the middle of a wheel of the vehicle's own body ever lies in the rock of a terrain with overhangs, where
    it has no ground."""
    from vehsim.world.ground.wheels import wheels_of

    terrain = None if world is None else world.terrain
    if terrain is None or terrain.surface is None or clip.vehicle.rig is None:
        return False
    centres = np.array([wheel.centre for wheel in wheels_of(clip.vehicle.rig) if not wheel.carrier]).reshape(-1, 3)
    places = clip.positions[:, None] + centres @ matrices(clip.orientations).swapaxes(1, 2)
    return bool(terrain.surface.inside(places.reshape(-1, 3)).any())


def rock_met(clip: Clip, world: Any) -> tuple[float, Array] | None:
    """The first frame at which a corner of a vehicle's hulls lies in the rock of a terrain with overhangs, and the
    corner's place (3,) m; None if there is none."""
    from scipy.spatial import ConvexHull

    terrain = None if world is None else world.terrain
    if terrain is None or terrain.surface is None or clip.vehicle.rig is None:
        return None
    corners = np.vstack(hulls_of(clip.vehicle))
    corners = corners[ConvexHull(corners).vertices]
    corners = corners[corners[:, 2] > corners[:, 2].min() + GROUND]
    places = clip.positions[:, None] + corners @ matrices(clip.orientations).swapaxes(1, 2)
    met = terrain.surface.inside(places.reshape(-1, 3)).reshape(places.shape[:2])
    if not met.any():
        return None
    sample, corner = np.argwhere(met)[0]
    return float(clip.frames[sample]), places[sample, corner]
