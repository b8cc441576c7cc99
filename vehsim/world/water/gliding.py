"""Put planar motion on calm water: a planing hull raises its bow and rises with its speed, as fast as it can pitch.

This is geometry after the motion is solved, as for wheels on the ground; it does not change the motion in the plane.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from vehsim.clip.interpolant import monotone
from vehsim.lie.quaternions import continuous, tilt_of, yaw_tilt
from vehsim.rig.rig import Suspension
from vehsim.world.ground.placing import SAMPLES, dense
from vehsim.world.ground.springs import deflections, followed

if TYPE_CHECKING:
    from vehsim.clip.clip import Clip
    from vehsim.vehicles.definition.resistance import Running
    from vehsim.vehicles.definition.vehicle import Vehicle

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

LEVEL = 1e-9
"""Pitch below which a sample counts as level, rad."""
MISSING = 1e-4
"""Trim from which a level sample counts as not placed yet, rad: when a placed hull starts, its pitch lags behind."""
STILL = 1e-3
"""Slower boats are at rest, m/s and rad/s."""
PITCH_DAMPING, HEAVE_DAMPING = 0.4, 0.6
"""Damping ratios while the bow rises: the simulated shipped hull, linearised about its steady run at 3 to 6 m/s, has
0.33 to 0.54 and 0.39 to 0.70."""


def boat_of(vehicle: Vehicle) -> Vehicle | None:
    """The vehicle with the hull on which this one floats: itself, or what its planar form stands for; None: none."""
    boat = vehicle.floating or vehicle
    return None if boat.hull is None else boat


def place_on_water(clip: Clip, world: Any, samples: int = SAMPLES, loop: bool = False) -> Clip:
    """The clip of a boat that moves in the plane on ``world``'s water. The trim and the height at which its hull runs
    steadily at its speed ahead (`Running`) are what it follows in pitch and heave, as a damped oscillator each with the
    hull's natural frequency; its roll stays zero.

    Places and heading do not change, and neither does the pose at rest: at rest it does not heave or pitch either.
    Samples that are tilted have been placed before and stay as they are; the others continue their motion. Other clips,
    and those of hulls that do not plane, are returned unchanged. ``samples``: at least so many per frame; ``loop``: it
    ends as it begins.
    """
    water, boat = getattr(world, "water", None), clip.vehicle.floating
    if water is None or boat is None or boat.hull is None or not len(clip):
        return clip
    running = boat.hull.running
    if running is None or running.trim is None:
        return clip
    steps, fresh = clip.times, _fresh(clip, running)
    if not fresh.any():
        return clip
    from vehsim.world.water.buoyancy import Afloat

    clip = dense(clip, samples)
    fresh = np.interp(clip.times, steps, fresh) > 0
    afloat = Afloat(boat, world)
    yaw, pitch, roll = tilt_of(clip.orientations)
    x, _, z = boat.origin
    # what continues a placed motion begins at its height
    at_rest = clip.positions[:, 2] + z if fresh.all() else water.level + afloat.floating()[0]
    trim, height, share = _attitude(running, clip.twists[:, 1])
    centre = clip.positions[:, 2] - x * np.sin(pitch) + z * np.cos(pitch)
    rests = np.abs(clip.twists).max(axis=1) < STILL
    heave, _, rocks = afloat.natural_frequencies
    springs = (Suspension(rocks, PITCH_DAMPING), Suspension(heave, HEAVE_DAMPING))
    aims = (trim, share * (water.level + height - at_rest))
    known = (-pitch, centre - at_rest)
    trim, rise = (_following(clip.times, *each, fresh, rests, loop) for each in zip(aims, known, springs, strict=True))
    root = at_rest + rise - x * np.sin(trim) - z * np.cos(trim)
    positions = clip.positions.copy()
    positions[:, 2] = np.where(fresh, root, positions[:, 2])
    orientations = np.where(fresh[:, None], yaw_tilt(yaw, -trim, roll), clip.orientations)
    return replace(clip, positions=positions, orientations=continuous(orientations))


def _fresh(clip: Clip, running: Running) -> Mask:
    """Which samples (n,) have not been placed yet: those of level runs that lack a trim."""
    level = np.abs(tilt_of(clip.orientations)[1]) < LEVEL
    runs = np.cumsum(np.diff(level, prepend=level[:1]))
    lacking = level & (_attitude(running, clip.twists[:, 1])[0] > MISSING)
    return np.isin(runs, runs[lacking])


def _following(
    times: Array, aim: Array, known: Array, springs: Suspension, fresh: Mask, rests: Mask, loop: bool
) -> Array:
    """What follows ``aim`` (n,) where it is ``fresh`` (n,), from and to what is ``known`` (n,) elsewhere; with a rate
    of zero where it ``rests`` (n,), and as it begins at the end of a ``loop``."""
    last = len(times) - 1
    if not springs.frequency or not last:
        return np.where(fresh, aim, known)
    if loop and fresh.all() and not rests.any():
        return deflections(times, np.zeros((last + 1, 1)), aim[:, None], springs, loop)[:, 0]
    if loop and fresh.all() and not rests[0]:  # begin the lap where it rests
        first = int(rests.argmax())
        order = np.append((first + np.arange(last)) % last, first)
        lap = np.concatenate([[0.0], np.cumsum(np.roll(np.diff(times), -first))])
        turned = _following(lap, aim[order], known[order], springs, fresh[order], rests[order], False)
        return np.append(np.roll(turned[:-1], first), turned[(last - first) % last])
    fixed = rests | ~fresh
    values = np.where(fresh, aim, known)
    slopes = np.diff(values) / np.diff(times)
    ends = np.unique(np.concatenate([[0], np.flatnonzero(fixed), [last]]))
    for a, b in zip(ends[:-1].tolist(), ends[1:].tolist(), strict=True):
        if fresh[a : b + 1].any() and not (b == a + 1 and fixed[a] and fixed[b]):
            start = np.array([values[a], slopes[a - 1] if a and not fresh[a] else 0.0])
            end = np.array([values[b], slopes[b] if b < last and not fresh[b] else 0.0]) if fixed[b] else None
            values[a : b + 1] = followed(times[a : b + 1], aim[a : b + 1], springs, start, end)
    return values


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
