"""Put planar motion on a terrain: every tyre touches it, the body moves on its springs, and trailers follow.

The body follows its wheels (heave, pitch and roll) through springs and dampers, and leans with acceleration
(`springs`); trailers tilt on their hitches (`trailers`). This is geometry after the simulation; the pull of slopes is
in `slope.py`.
"""

from __future__ import annotations

import warnings
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from vehsim.clip.clip import Clip
from vehsim.constants import GRAVITY
from vehsim.errors import SolveError
from vehsim.lie.quaternions import matrices, tilt_of, yaw_tilt
from vehsim.rig.linkage import part_poses
from vehsim.rig.rig import Rig
from vehsim.vehicles.definition.surfaces import SURFACES
from vehsim.world.ground.levels import on_level
from vehsim.world.ground.springs import deflections, lean_of
from vehsim.world.ground.trailers import tilted
from vehsim.world.ground.tyres import LOAD, spring_loads
from vehsim.world.ground.wheels import TOUCHING, Wheel, touch, wheels_of
from vehsim.world.terrain.terrain import Terrain

if TYPE_CHECKING:
    from vehsim.vehicles import Vehicle

Array = NDArray[np.float64]

SAMPLES = 8
"""Samples per frame for coarser clips, so that wheels also touch between knots."""
SETTLING = 5
"""Iterations of the body's rest pose, each with one iteration of its contacts: within 0.02 mm. The first three need
only coarse wheels."""
SEEN = 1e-3
"""Change at which these iterations and those of contacts end where the wheels are ``coarse``, m and rad."""
ALONG = 50
"""Places along a vehicle's way that choose its level of ground."""
STEADY = 0.05
"""Largest change of the rest pose in the last iteration, m and rad: if it is larger, the body does not come to rest."""
GRIP = 1.1
"""Grip of dry tyres, in g."""
LARGEST_TRAVEL = 0.12
"""Travel beyond which a wheel leaves its arch, m."""
PLACED = {"heave": "m", LOAD: "N"}
"""Units of the channels that `place_on_terrain` adds, by the beginning of their names; of others, rad."""


def place_on_terrain(clip: Clip, world: Any, samples: int = SAMPLES, coarse: bool = False, loop: bool = False) -> Clip:
    """The clip of a vehicle with wheels on ``world``'s terrain: height, pitch and roll of its root, travel of wheels.

    A vehicle with springs of its own (`Definition.attitude`) also dives and leans on level ground without a terrain.

    Adds the channels ``heave`` (of the body above its rest on its wheels, m), ``pitch`` (nose down) and ``roll`` (left
    side up, rad), and ``load_*`` (N) of wheels on springs; fills ``travel_*`` (m, upwards), and ``hitch_pitch*`` and
    ``hitch_roll*`` of trailers, as ``pitch`` and ``roll``; wheels turn by the length of the slope. The planar motion
    does not change. The body leans as far as the grip of tyres can make it, also where the motion needs more, which is
    warned about. Other clips, and clips without terrain, are returned unchanged. ``samples``: at least so many per
    frame; ``coarse``: see `Wheel.coarse`; ``loop``: springs end as they begin.
    Raises ``SolveError`` where the vehicle cannot stand on the ground, such as on a wall of rock.
    """
    terrain = None if world is None else world.terrain
    rig = clip.vehicle.rig
    if terrain is None and clip.vehicle.attitude is not None:
        terrain = _level(clip)
    if terrain is None or rig is None or not clip.vehicle.group.planar:
        return clip
    terrain = on_level(terrain, standing(clip), clip.positions[:, :2])
    wheels = tuple(wheel.coarse if coarse else wheel for wheel in wheels_of(rig))
    own = tuple(wheel for wheel in wheels if not wheel.carrier)
    if not own:
        return clip
    if _is_on_terrain(clip, terrain, wheels):
        return clip
    clip = dense(clip, samples)
    yaw = tilt_of(clip.orientations)[0]
    rest, last = _rest(terrain, own, clip.positions[:, :2], yaw, SEEN if coarse else 0.0)
    for k in np.flatnonzero(np.abs(last).max(axis=1) > STEADY)[:1]:
        x, y = clip.positions[k, :2]
        where = f"cannot stand on the ground at ({x:.2f}, {y:.2f}) m, frame {clip.frames[k]:.0f}"
        raise SolveError(
            f"{where}: it is too steep or too rough there", "keep to gentler ground", subject=clip.vehicle.name
        )
    needed = _tyre_force(clip, rest)
    share = np.minimum(1.0, tyre_grip(clip.vehicle) * GRAVITY / np.maximum(np.hypot(*needed), 1e-9))
    held = share * needed[0], share * needed[1]
    deflection = np.zeros_like(rest)
    if any(wheel.travel for wheel in own) and len(clip) > 1:
        deflection = deflections(clip.times, rest, lean_of(*held, own, rig.suspension), rig.suspension, loop)
        deflection += _own_attitude(clip)
    z, pitch, roll = (rest + deflection).T
    there = np.column_stack([clip.positions[:, :2], z]), yaw_tilt(yaw, pitch, roll)
    channels = {**clip.channels, "heave": deflection[:, 0], "pitch": pitch, "roll": roll}
    channels |= tilted(rig, terrain, channels, clip.times, *there, loop)
    channels |= _wheel_channels(rig, terrain, wheels, channels, *there, SEEN if coarse else TOUCHING)
    travels = {wheel.travel: channels[wheel.travel] for wheel in wheels if wheel.travel}
    _warn_strain(clip, np.hypot(*needed), travels)
    placed = replace(clip, positions=there[0], orientations=there[1], channels=channels)
    return replace(placed, channels={**channels, **spring_loads(placed, wheels)})


def standing(clip: Clip) -> Array:
    """Places (n, 3) m that choose a vehicle's level of ground: its start, or its way once it is placed there."""
    if "heave" not in clip.channels:
        return clip.positions[:1]
    return clip.positions[:: max(1, len(clip) // ALONG)]


def _level(clip: Clip) -> Terrain:
    """Level ground at the height of a clip's start, which may be on it already."""
    height = clip.positions[0, 2] - clip.channels.get("heave", np.zeros(1))[0]
    return Terrain("level", np.full((2, 2), height))


def can_stand(vehicle: Vehicle, world: Any, xy: Array, yaw: Array) -> NDArray[np.bool_]:
    """Whether a vehicle with wheels can stand on ``world``'s terrain at places (n, 2) m and headings (n,) rad, (n,);
    True for others."""
    terrain, rig = None if world is None else world.terrain, vehicle.rig
    if terrain is None or rig is None or not vehicle.group.planar:
        return np.ones(len(xy), bool)
    own = tuple(wheel.coarse for wheel in wheels_of(rig) if not wheel.carrier)
    if not own:
        return np.ones(len(xy), bool)
    return np.asarray(np.abs(_rest(terrain, own, xy, yaw)[1]).max(axis=1) <= STEADY)


def _is_on_terrain(clip: Clip, terrain: Terrain, wheels: tuple[Wheel, ...]) -> bool:
    """Whether the clip stands on this terrain already."""
    if "heave" not in clip.channels:
        return False
    some = slice(None, None, max(1, len(clip) // 200))
    there, channels = (clip.positions[some], clip.orientations[some]), {n: v[some] for n, v in clip.channels.items()}
    return all(
        np.allclose(_travel(clip.vehicle.rig, terrain, wheel, channels, *there), channels[wheel.travel], atol=1e-4)
        for wheel in wheels
        if wheel.travel is not None
    )


def _travel(rig: Any, terrain: Terrain, wheel: Wheel, channels: Any, positions: Array, orientations: Array) -> Array:
    """Travel (n,) m at which a wheel touches, on the vehicle's own body or on a trailer."""
    return touch(terrain, wheel, *part_poses(rig, wheel.carrier, channels, positions, orientations))


def dense(clip: Clip, samples: int) -> Clip:
    """The clip with samples so close that motion between them is negligible."""
    step = 1 / (samples * float(clip.fps))
    if len(clip) < 2 or np.diff(clip.times).max() < 1.5 * step:
        return clip
    count = int(np.floor((clip.times[-1] - clip.times[0]) / step + 1e-6))
    times = clip.times[0] + np.array([float(k / (samples * clip.fps)) for k in range(count + 1)])
    times = np.minimum(times, clip.times[-1])
    return clip.at(times if clip.times[-1] - times[-1] < 1e-9 else np.append(times, clip.times[-1]))


def _rest(
    terrain: Terrain, wheels: tuple[Wheel, ...], xy: Array, yaw: Array, tolerance: float = 0.0
) -> tuple[Array, Array]:
    """Height, pitch and roll (n, 3) at which the body rests on equal springs, and their change in the last
    iteration, which is the first with changes below the ``tolerance``."""
    centres = np.array([wheel.centre for wheel in wheels])
    # derivatives of a wheel's travel with respect to height, pitch and roll
    fit = np.linalg.pinv(np.column_stack([np.ones(len(wheels)), -centres[:, 0], centres[:, 1]]), rcond=1e-6)
    pose = np.zeros((len(xy), 3))
    pose[:, 0] = terrain.height(xy)
    for k in range(SETTLING):
        near = [wheel.coarse for wheel in wheels] if k < 3 else wheels
        orientations = yaw_tilt(yaw, *pose[:, 1:].T)
        positions = np.column_stack([xy, pose[:, 0]])
        travel = np.column_stack([touch(terrain, wheel, positions, orientations, 1) for wheel in near])
        height, *slopes = (travel @ fit.T).T  # relative to the body as it stands now
        change = np.column_stack([height * np.cos(pose[:, 1]) * np.cos(pose[:, 2]), *np.arctan(slopes)])
        pose = pose + change
        if np.abs(change).max(initial=0.0) < tolerance:
            break
    return pose, change


def _tyre_force(clip: Clip, rest: Array) -> tuple[Array, Array]:
    """The force per mass that tyres must provide for a vehicle at rest on its springs (n, 3): (n,) m/s^2 along and
    across it; of a vehicle with springs of its own, only that against its weight on the slope."""
    along, across = -GRAVITY * np.sin(rest[:, 1]), GRAVITY * np.sin(rest[:, 2])
    if len(clip) < 2:
        return np.zeros(len(clip)), np.zeros(len(clip))
    if clip.vehicle.attitude is not None:
        return along, across
    turn, vx, vy = clip.twists.T
    return along + np.gradient(vx, clip.times) - turn * vy, across + np.gradient(vy, clip.times) + turn * vx


def tyre_grip(vehicle: Vehicle) -> float:
    """The largest force of tyres that never slip over their load; infinite for those that slip."""
    return np.inf if vehicle.rolling is not None else GRIP * SURFACES[vehicle.surface].friction


def _own_attitude(clip: Clip) -> Array:
    """Heave, pitch and roll (n, 3) of the body on springs of its own; zero without them."""
    names = clip.vehicle.attitude
    if names is None:
        return np.zeros((len(clip), 3))
    return clip.joints[:, [clip.vehicle.joints.index(name) for name in names]]


def _warn_strain(clip: Clip, force: Array, travels: dict[str, Array]) -> None:
    """Warn if tyres, or else springs, exceed their limits. ``force`` (n,) of tyres per mass, m/s^2."""
    name, travel = max(travels.items(), key=lambda item: np.abs(item[1]).max(), default=("", np.zeros(len(clip))))
    if force.max() > tyre_grip(clip.vehicle) * GRAVITY:
        k = int(force.argmax())
        most = f"{force[k] / GRAVITY:.1f} g at frame {clip.frames[k]:.0f}"
        message = f"{most}: more than the grip of tyres, but wheels never slip here; "
        remedy = "go slower, or plan with limits = { grip = 0.9 }"
    elif np.abs(travel).max() > LARGEST_TRAVEL:
        k = int(np.abs(travel).argmax())
        message = f"{name} = {travel[k]:.2f} m at frame {clip.frames[k]:.0f}: the wheel leaves its arch, because the "
        remedy = "ground is too rough or the vehicle too fast; go slower, or smooth the ground"
    else:
        return
    warnings.warn(f"{clip.vehicle.name}: {message}{remedy}", stacklevel=3)


def _wheel_channels(
    rig: Rig,
    terrain: Terrain,
    wheels: tuple[Wheel, ...],
    channels: Any,
    positions: Array,
    orientations: Array,
    tolerance: float,
) -> dict[str, Array]:
    """Travel of every wheel that has a channel for it, to a ``tolerance`` in m, and its rotation, by the true path of
    its hub."""
    made = {}
    for wheel in wheels:
        there, turned = part_poses(rig, wheel.carrier, channels, positions, orientations)
        travel = np.zeros(len(there))
        if wheel.travel is not None:
            travel = made[wheel.travel] = touch(terrain, wheel, there, turned, tolerance=tolerance)
        if wheel.roll is not None and len(there) > 1:
            R_wb = matrices(turned)
            hub = there + R_wb @ wheel.centre + travel[:, None] * R_wb[:, :, 2]
            path = np.diff(hub, axis=0)
            level = np.linalg.norm(path[:, :2], axis=1)
            longer = np.where(level > 1e-6, np.linalg.norm(path, axis=1) / np.maximum(level, 1e-6), 1.0)
            spun = channels[wheel.roll]
            made[wheel.roll] = spun[0] + np.concatenate([[0.0], np.cumsum(np.diff(spun) * longer)])
    return made
