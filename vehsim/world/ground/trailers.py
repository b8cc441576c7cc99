"""Trailers on the ground: each hangs on its hitch, and pitches and rolls there until its wheels touch the terrain."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from vehsim.constants import GRAVITY
from vehsim.lie.quaternions import matrices, tilt_of
from vehsim.rig.linkage import part_poses, screws
from vehsim.rig.rig import HITCH_PITCH, HITCH_ROLL, Rig
from vehsim.vehicles import Vehicle
from vehsim.world.ground.springs import deflections, lean_of
from vehsim.world.ground.wheels import Wheel, touch, wheels_of
from vehsim.world.terrain.terrain import Terrain

Array = NDArray[np.float64]
Channels = Mapping[str, Array]

SETTLING = 10
"""Largest number of iterations of a trailer's rest pose, each with one iteration of its contacts."""
SETTLED = 1e-6
"""Travel of its wheels at which it rests, m."""
STEP, STEEPEST = 0.1, 0.6
"""Largest change of a tilt in an iteration, and largest tilt, rad: on a wall there is no rest."""


@dataclass(frozen=True)
class Trailer:
    """The part at ``path`` below the root, and its ``tilts``: (channel, column of (heave, pitch, roll)). They turn it
    about its hitch at ``pivot`` (3,) m, in the rig root's frame."""

    path: str
    pivot: Array
    tilts: tuple[tuple[str, int], ...]
    wheels: tuple[Wheel, ...]


def trailers_of(rig: Rig) -> tuple[Trailer, ...]:
    """The trailers whose channels ``hitch_pitch*`` and ``hitch_roll*`` a rig drives, in order of coupling."""
    found: dict[str, list[tuple[str, int]]] = {}
    for name, drive in rig.drives.items():
        for prefix, column in ((HITCH_PITCH, 1), (HITCH_ROLL, 2)):
            if name.startswith(prefix):
                found.setdefault(drive.prim, []).append((name, column))
    wheels = wheels_of(rig)
    return tuple(
        Trailer(path, _pivot(rig, path, tilts[0][0]), tuple(tilts), tuple(w for w in wheels if w.carrier == path))
        for path, tilts in sorted(found.items(), key=lambda item: item[0].count("/"))
    )


def _pivot(rig: Rig, path: str, channel: str) -> Array:
    return next(screw.pivot for screw in screws(rig, path) if screw.channel == channel)


def follows_ground(vehicle: Vehicle) -> bool:
    """Whether all trailers of a vehicle can follow uneven ground."""
    if vehicle.rig is None:
        return True
    tilting = [drive.prim for name, drive in vehicle.rig.drives.items() if name.startswith((HITCH_PITCH, HITCH_ROLL))]
    hitched = [drive.prim for name, drive in vehicle.rig.drives.items() if name.startswith("hitch")]
    return all(any(f"{tilt}/".startswith(f"{prim}/") for tilt in tilting) for prim in hitched)


def tilted(
    rig: Rig, terrain: Terrain, channels: Channels, times: Array, positions: Array, orientations: Array, loop: bool
) -> dict[str, Array]:
    """The tilt channels (n,) rad of all trailers on ``terrain``, at poses of the root (n, 3) m, (n, 4); in a ``loop``,
    they end as they begin."""
    made: dict[str, Array] = {}
    for trailer in trailers_of(rig):
        if trailer.wheels:
            known = {**channels, **made}
            made |= _tilted(rig, trailer, terrain, known, times, positions, orientations, loop)
    return made


def _tilted(
    rig: Rig,
    trailer: Trailer,
    terrain: Terrain,
    channels: Channels,
    times: Array,
    positions: Array,
    orientations: Array,
    loop: bool,
) -> dict[str, Array]:
    """The tilt channels of one trailer behind others."""
    columns = [column for _, column in trailer.tilts]
    away = np.array([wheel.centre for wheel in trailer.wheels]) - trailer.pivot
    # derivatives of a wheel's height with respect to heave, pitch and roll about the hitch
    heights = np.column_stack([0 * away[:, 0], -away[:, 0], away[:, 1]])[:, columns]
    fit = np.asarray(np.linalg.pinv(heights, rcond=1e-6), np.float64)

    def placed(tilt: Array) -> tuple[Array, Array]:
        values = {name: tilt[:, k] for k, (name, _) in enumerate(trailer.tilts)}
        return part_poses(rig, trailer.path, {**channels, **values}, positions, orientations)

    def travel(tilt: Array) -> Array:
        there = placed(tilt)
        return np.column_stack([touch(terrain, wheel, *there, 1) for wheel in trailer.wheels])

    tilt = _settled(travel, np.zeros((len(times), len(columns))), fit)
    if any(wheel.travel for wheel in trailer.wheels) and len(times) > 2:
        rest = np.column_stack([np.zeros(len(times)), *tilt_of(placed(tilt)[1])[1:]])
        lean = lean_of(*_tyre_force(times, trailer, *placed(tilt)), trailer.wheels, rig.suspension)
        tilt = tilt + deflections(times, rest[:, columns], lean[:, columns], rig.suspension, loop)
    return {name: tilt[:, k] for k, (name, _) in enumerate(trailer.tilts)}


def _settled(travel: Callable[[Array], Array], tilt: Array, fit: Array) -> Array:
    """Tilts (n, k) at which the ``travel`` (n, wheels) of a trailer's wheels is least, by Broyden's method from ``fit``
    (k, wheels), the inverse of its derivatives on level ground."""
    now = travel(tilt)
    best, least = tilt, np.linalg.norm(now, axis=1)
    inverse = np.repeat(fit[None], len(tilt), axis=0)
    for _ in range(SETTLING):
        if least.max() < SETTLED:
            break
        step = np.clip((inverse @ now[..., None])[..., 0], -STEP, STEP)
        step = np.clip(tilt + step, -STEEPEST, STEEPEST) - tilt
        then = travel(tilt + step)
        change = (inverse @ (now - then)[..., None])[..., 0]
        along = np.sum(step * change, axis=1)
        safe = np.where(np.abs(along) > 1e-12, along, np.inf)[:, None, None]
        inverse = inverse + (step - change)[..., None] * (step[:, None] @ inverse) / safe
        tilt, now, size = tilt + step, then, np.linalg.norm(then, axis=1)
        best, least = np.where((size < least)[:, None], tilt, best), np.minimum(size, least)
    return best


def _tyre_force(times: Array, trailer: Trailer, positions: Array, orientations: Array) -> tuple[Array, Array]:
    """The force per mass that a trailer's tyres and hitch must provide: (n,) m/s^2 along and across it."""
    axle = np.mean([wheel.centre for wheel in trailer.wheels], axis=0)
    yaw, pitch, roll = tilt_of(orientations)
    path = (positions + matrices(orientations) @ axle)[:, :2]
    x, y = np.gradient(np.gradient(path, times, axis=0), times, axis=0).T
    along = np.cos(yaw) * x + np.sin(yaw) * y - GRAVITY * np.sin(pitch)
    return along, np.cos(yaw) * y - np.sin(yaw) * x + GRAVITY * np.sin(roll)
