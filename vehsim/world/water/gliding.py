"""Put planar motion on calm water: a planing hull raises its bow and rises with its speed.

This is geometry after the motion is solved, as for wheels on the ground; it does not change the motion in the plane.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from vehsim.clip.interpolant import monotone
from vehsim.lie.quaternions import continuous, tilt_of, yaw_tilt

if TYPE_CHECKING:
    from vehsim.clip.clip import Clip
    from vehsim.vehicles.definition.resistance import Running
    from vehsim.vehicles.definition.vehicle import Vehicle

Array = NDArray[np.float64]

LEVEL = 1e-9
"""Pitch below which a sample counts as not placed yet, rad."""


def boat_of(vehicle: Vehicle) -> Vehicle | None:
    """The vehicle with the hull on which this one floats: itself, or what its planar form stands for; None: none."""
    boat = vehicle.floating or vehicle
    return None if boat.hull is None else boat


def place_on_water(clip: Clip, world: Any) -> Clip:
    """The clip of a boat that moves in the plane on ``world``'s water, with the trim and the height at which its hull
    runs steadily at its speed ahead (`Running`), as in a simulation on calm water; its roll stays zero.

    Places and heading do not change, and neither does the pose at rest. Samples that are tilted have been placed
    before and stay as they are. Other clips, and those of hulls that do not plane, are returned unchanged.
    """
    water, boat = getattr(world, "water", None), clip.vehicle.floating
    if water is None or boat is None or boat.hull is None or not len(clip):
        return clip
    running = boat.hull.running
    if running is None or running.trim is None:
        return clip
    yaw, pitch, roll = tilt_of(clip.orientations)
    trim, height, share = _attitude(running, clip.twists[:, 1])
    fresh = (np.abs(pitch) < LEVEL) & (trim > LEVEL)
    if not fresh.any():
        return clip
    x, _, z = boat.origin
    at_rest = clip.positions[:, 2] + z
    centre = at_rest + share * (water.level + height - at_rest)
    root = centre - x * np.sin(trim) - z * np.cos(trim)
    positions = clip.positions.copy()
    positions[:, 2] = np.where(fresh, root, positions[:, 2])
    orientations = np.where(fresh[:, None], yaw_tilt(yaw, -trim, roll), clip.orientations)
    return replace(clip, positions=positions, orientations=continuous(orientations))


def _attitude(running: Running, ahead: Array) -> tuple[Array, Array, Array]:
    """At speeds (n,) m/s ahead: the trim (n,) rad, bow up; the height (n,) m of the centre of mass above the water of
    a hull that planes, below its least speed as there; and the share (n,) of its way from rest to planing. Astern, as
    at rest."""
    assert running.trim is not None and running.draft is not None and running.share is not None
    (x, z), planes = running.transom, np.isfinite(running.draft)
    heights = -running.draft - x * np.sin(running.trim) - z * np.cos(running.trim)
    heights = np.where(planes, heights, heights[planes][0])
    rows = np.column_stack([running.trim, heights, running.share])
    trim, height, share = monotone(running.speeds, rows, np.clip(ahead, 0.0, running.speeds[-1])).T
    return trim, height, share
