"""Wheels on the ground: lift planar motion onto a terrain, with every tyre touching it and the body on its springs.

Each wheel is a profile rotated about its axle. Its travel along the body's vertical until it touches is measured on the
terrain itself. The body follows the wheels (heave, pitch and roll) through springs and dampers, and leans with
acceleration. This is geometry after the simulation; the pull of slopes is in `slope.py`.
"""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vehsim.clip.clip import Clip
from vehsim.lie.quaternions import matrices, tilt_of, yaw_tilt
from vehsim.rig.rig import Rig, Suspension
from vehsim.runtime.cache import Stamp, stamp
from vehsim.world.terrain.terrain import Terrain

Array = NDArray[np.float64]

SAMPLES = 8
"""Samples per frame for coarser clips, so that wheels also touch between knots."""
ARC = np.radians(np.linspace(-50.0, 50.0, 41))
"""Angles along a tyre's lower half at which contact is sought: 1.3 degrees apart, 0.05 mm of a car's tyre."""
PROFILE = 7
"""Number of rings that represent a tyre's profile."""
ROUNDS = 4
"""Iterations of a contact's height; each reduces the error by the square of the slope."""
SETTLING = 5
"""Iterations of the body's rest pose, each with one iteration of its contacts: within 0.02 mm."""
TRAVEL = "travel_"
"""Prefix of channels that slide a wheel along its suspension."""
GRIP = 1.1
"""Grip of dry tyres, in g."""
LARGEST_TRAVEL = 0.12
"""Travel beyond which a wheel leaves its arch, m."""


@dataclass(frozen=True)
class Wheel:
    """``centre`` (3,) m in the rig root's frame; ``rings`` (k, 2): lateral offset and radius of its profile, m.

    ``travel``, ``roll``: the channels that slide and turn it, or None; ``prim``: the path of its part below the root.
    """

    centre: Array
    rings: Array
    travel: str | None
    roll: str | None
    prim: str = ""

    @property
    def rim(self) -> Array:
        """Points (m, 3) of the tyre's lower half, about the root, straight ahead."""
        side, radius = self.rings.T
        x = radius[:, None] * np.sin(ARC)
        z = -radius[:, None] * np.cos(ARC)
        return self.centre + np.stack(np.broadcast_arrays(x, side[:, None], z), axis=-1).reshape(-1, 3)


def place_on_terrain(clip: Clip, world: Any) -> Clip:
    """The clip of a vehicle with wheels on ``world``'s terrain: height, pitch and roll of its root, travel of wheels.

    Adds the channels ``heave`` (of the body above its rest on its wheels, m), ``pitch`` (nose down) and ``roll`` (left
    side up, rad); fills ``travel_*`` (m, upwards); wheels turn by the length of the slope. The planar motion does not
    change. Other clips, and clips without terrain, are returned unchanged.
    """
    terrain = None if world is None else world.terrain
    rig = clip.vehicle.rig
    if terrain is None or rig is None or not clip.vehicle.group.planar:
        return clip
    wheels = wheels_of(rig)
    if not wheels:
        return clip
    if _is_on_terrain(clip, terrain, wheels):
        return clip
    clip = _dense(clip)
    yaw = tilt_of(clip.orientations)[0]
    rest = _rest(terrain, wheels, clip.positions[:, :2], yaw)
    sprung = any(wheel.travel for wheel in wheels)
    deflection = _deflections(clip, rest, wheels, rig.suspension) if sprung else np.zeros_like(rest)
    z, pitch, roll = (rest + deflection).T
    positions = np.column_stack([clip.positions[:, :2], z])
    orientations = yaw_tilt(yaw, pitch, roll)
    channels = {**clip.channels, "heave": deflection[:, 0], "pitch": pitch, "roll": roll}
    channels |= _wheel_channels(clip, terrain, wheels, positions, orientations)
    _warn_strain(clip, rest, {wheel.travel: channels[wheel.travel] for wheel in wheels if wheel.travel})
    return replace(clip, positions=positions, orientations=orientations, channels=channels)


def _is_on_terrain(clip: Clip, terrain: Terrain, wheels: tuple[Wheel, ...]) -> bool:
    """Whether the clip stands on this terrain already."""
    if "heave" not in clip.channels:
        return False
    some = slice(None, None, max(1, len(clip) // 200))
    there = clip.positions[some], clip.orientations[some]
    return all(
        np.allclose(touch(terrain, wheel, *there), clip.channels[wheel.travel][some], atol=1e-4)
        for wheel in wheels
        if wheel.travel is not None
    )


def wheels_of(rig: Rig) -> tuple[Wheel, ...]:
    """The wheels of a rig: the parts that its ``travel_*`` channels slide; without such channels, parts that turn about
    an axle across the vehicle, in any of their own axes, and carry no joint."""
    pivots = {name: tuple(d.pivot) if isinstance(d.pivot, list) else d.pivot for name, d in rig.drives.items()}
    drives = tuple(sorted((name, drive.prim, drive.op, pivots[name]) for name, drive in rig.drives.items()))
    return _wheels(Path(rig.asset), rig.root or None, drives, stamp(rig.asset))


@lru_cache(maxsize=32)
def _wheels(asset: Path, root: str | None, drives: tuple[Any, ...], written: Stamp) -> tuple[Wheel, ...]:
    from vehsim.rig.parts import read_parts

    parts = {part.path: part for part in read_parts(asset, root)}
    sliding = {prim: name for name, prim, *_ in drives if name.startswith(TRAVEL)}
    # for example a leg
    joints = {prim for _, prim, *_ in drives for _, other, *_ in drives if other.startswith(f"{prim}/")}
    turning = {
        prim: name for name, prim, op, _ in drives if prim in parts and prim not in joints and _across(parts[prim], op)
    }
    pivots = {prim: pivot for name, prim, _, pivot in drives if name in turning.values() and pivot is not None}
    found = []
    for prim in sliding or turning:
        below = [path for path in parts if path == prim or path.startswith(f"{prim}/")]
        if not below:
            continue
        points = np.concatenate([parts[p].points @ parts[p].T_rp[:3, :3].T + parts[p].T_rp[:3, 3] for p in below])
        if not len(points):
            continue
        spin = next((path for path in sorted(turning) if path in below), None)
        hub = parts[spin if spin in parts else below[0]].T_rp[:3, 3]
        if spin in pivots:
            hub = (points.min(axis=0) + points.max(axis=0)) / 2 if pivots[spin] == "centre" else np.array(pivots[spin])
        found.append(Wheel(hub, _profile(points - hub), sliding.get(prim), turning.get(spin or ""), prim))
    return tuple(found)


def _across(part: Any, op: str) -> bool:
    """Whether an op turns a part about an axle along the vehicle's Y, to 5 degrees."""
    return op.startswith("rotate") and bool(abs(part.T_rp[1, "XYZ".index(op[-1])]) > 0.996)


def _profile(points: Array) -> Array:
    """Rings (k, 2) of a wheel's points about its hub: the convex outline of its tread, which rolls."""
    from scipy.spatial import ConvexHull

    radius = np.hypot(points[:, 0], points[:, 2])
    tread = np.column_stack([points[:, 1], radius])[radius > 0.9 * radius.max()]
    if np.ptp(tread[:, 0]) < 1e-4:
        return np.array([[tread[:, 0].mean(), radius.max()]])
    floor = np.column_stack([[tread[:, 0].min(), tread[:, 0].max()], np.zeros(2)])
    outline = np.vstack([tread, floor])
    outline = outline[ConvexHull(outline).vertices]
    outline = outline[outline[:, 1] > 0]
    outline = outline[np.argsort(outline[:, 0])]
    sides = np.linspace(outline[0, 0], outline[-1, 0], PROFILE)
    return np.column_stack([sides, np.interp(sides, *outline.T)])


def _dense(clip: Clip) -> Clip:
    """The clip with samples so close that motion between them is negligible."""
    step = 1 / (SAMPLES * float(clip.fps))
    if len(clip) < 2 or np.diff(clip.times).max() < 1.5 * step:
        return clip
    count = int(np.floor((clip.times[-1] - clip.times[0]) / step + 1e-6))
    times = clip.times[0] + np.array([float(k / (SAMPLES * clip.fps)) for k in range(count + 1)])
    times = np.minimum(times, clip.times[-1])
    return clip.at(times if clip.times[-1] - times[-1] < 1e-9 else np.append(times, clip.times[-1]))


def _rest(terrain: Terrain, wheels: tuple[Wheel, ...], xy: Array, yaw: Array) -> Array:
    """Height, pitch and roll (n, 3) at which the body rests on equal springs, for any slope."""
    centres = np.array([wheel.centre for wheel in wheels])
    # derivatives of a wheel's travel with respect to height, pitch and roll
    fit = np.linalg.pinv(np.column_stack([np.ones(len(wheels)), -centres[:, 0], centres[:, 1]]), rcond=1e-6)
    pose = np.zeros((len(xy), 3))
    pose[:, 0] = terrain.height(xy)
    for _ in range(SETTLING):
        orientations = yaw_tilt(yaw, *pose[:, 1:].T)
        positions = np.column_stack([xy, pose[:, 0]])
        travel = np.column_stack([touch(terrain, wheel, positions, orientations, 1) for wheel in wheels])
        pose = pose + travel @ fit.T
    return pose


def touch(terrain: Terrain, wheel: Wheel, positions: Array, orientations: Array, rounds: int = ROUNDS) -> Array:
    """Travel (n,) m along the body's vertical, relative to the wheel's rest, at which it just touches the terrain.

    If the travel is small, one of the ``rounds`` suffices.
    """
    level = float(terrain.heights.flat[0])
    if np.all(terrain.heights == level):
        vertical = matrices(orientations)[:, 2]
        return np.asarray(((level - positions[:, 2:] - vertical @ wheel.rim.T) / vertical[:, 2:]).max(axis=1))
    blocks = _blocks(len(positions))
    found = [_touch(terrain, wheel, positions[k], orientations[k], rounds) for k in blocks]
    return np.concatenate(found or [np.zeros(0)])


def _touch(terrain: Terrain, wheel: Wheel, positions: Array, orientations: Array, rounds: int) -> Array:
    R_wr = matrices(orientations)
    points = positions[:, None] + wheel.rim @ R_wr.swapaxes(1, 2)
    up, travel = R_wr[:, None, :, 2], np.zeros(len(positions))
    for _ in range(rounds):
        moved = points[..., :2] + travel[:, None, None] * up[..., :2]
        ground = terrain.height(moved.reshape(-1, 2)).reshape(moved.shape[:2])
        travel = ((ground - points[..., 2]) / up[..., 2]).max(axis=1)
    return travel


def _blocks(count: int, size: int = 64) -> Iterator[slice]:
    """Number of samples per block: the intermediate results fit into the processor's cache, which is twice as fast."""
    return (slice(k, k + size) for k in range(0, count, size))


def _deflections(clip: Clip, rest: Array, wheels: tuple[Wheel, ...], springs: Suspension) -> Array:
    """Heave, pitch and roll (n, 3) of the body relative to its rest on the wheels, from equilibrium at the start.

    A damped oscillator for each, ``d'' + 2 zeta omega d' + omega^2 d = load - rest''``, stepped exactly with ``rest``
    linear between samples. ``load``: the tilting effect of acceleration and gravity on the mass above the ground.
    """
    omega, zeta = 2 * np.pi * springs.frequency, springs.damping
    load = omega**2 * _lean(clip, rest, wheels, springs)
    d, rate = load[0] / omega**2, np.zeros(3)
    path = [d]
    steps = np.diff(clip.times)
    slopes = np.diff(rest, axis=0) / steps[:, None]
    kicks = np.diff(slopes, axis=0, prepend=slopes[:1])
    for h, kick, a, b in zip(steps.tolist(), kicks, load[:-1], load[1:], strict=True):
        flow = _oscillator(round(h, 12), omega, zeta)
        level = (a + b) / (2 * omega**2)
        offset, rate = d - level, rate - kick
        d, rate = level + flow[0][0] * offset + flow[0][1] * rate, flow[1][0] * offset + flow[1][1] * rate
        path.append(d)
    return np.array(path)


@lru_cache(maxsize=256)
def _oscillator(h: float, omega: float, zeta: float) -> list[list[float]]:
    """The matrix (2, 2) that advances (d, d') by ``h`` s in ``d'' + 2 zeta omega d' + omega^2 d = 0``."""
    from scipy.linalg import expm

    flow: list[list[float]] = expm(h * np.array([[0.0, 1.0], [-(omega**2), -2 * zeta * omega]])).tolist()
    return flow


def _lean(clip: Clip, rest: Array, wheels: tuple[Wheel, ...], springs: Suspension) -> Array:
    """Equilibrium of the springs under the current acceleration: heave zero, pitch and roll (n, 3)."""
    lean = np.zeros((len(clip), 3))
    if len(clip) < 2:
        return lean
    ax, ay = _held(clip, rest)
    centres = np.array([wheel.centre for wheel in wheels])
    along, across = ((centres[:, :2] - centres[:, :2].mean(axis=0)) ** 2).mean(axis=0)
    stiffness = (2 * np.pi * springs.frequency) ** 2
    if along > 1e-4:
        lean[:, 1] = -springs.mass_height * ax / (stiffness * along)
    if across > 1e-4:
        lean[:, 2] = springs.mass_height * ay / (stiffness * across)
    return np.clip(lean, -0.2, 0.2)


def _held(clip: Clip, rest: Array) -> tuple[Array, Array]:
    """The force that tyres must hold for a vehicle at rest on its springs (n, 3), per mass: (n,) m/s^2 along and across
    it."""
    from vehsim.vehicles.definition.holonomic import GRAVITY

    turn, vx, vy = clip.twists.T
    along = np.gradient(vx, clip.times) - turn * vy - GRAVITY * np.sin(rest[:, 1])
    return along, np.gradient(vy, clip.times) + turn * vx + GRAVITY * np.sin(rest[:, 2])


def _warn_strain(clip: Clip, rest: Array, travels: dict[str, Array]) -> None:
    """Warn if tyres, or else springs, exceed their limits."""
    from vehsim.vehicles.definition.holonomic import GRAVITY

    needed = np.hypot(*_held(clip, rest)) / GRAVITY if len(clip) > 1 else np.zeros(len(clip))
    name, travel = max(travels.items(), key=lambda item: np.abs(item[1]).max(), default=("", np.zeros(len(clip))))
    if needed.max() > GRIP:
        frame = clip.frames[int(needed.argmax())]
        message = (
            f"{needed.max():.1f} g at frame {frame:.0f}: more than the grip of tyres, but wheels never slip here; "
        )
        remedy = "go slower, or plan with limits = { acceleration = 8 }"
    elif np.abs(travel).max() > LARGEST_TRAVEL:
        k = int(np.abs(travel).argmax())
        message = f"{name} = {travel[k]:.2f} m at frame {clip.frames[k]:.0f}: too rough a ground or too fast a drive "
        remedy = "for the wheels to stay in their arches; go slower, or smooth the ground"
    else:
        return
    warnings.warn(f"{clip.vehicle.name}: {message}{remedy}", stacklevel=3)


def _wheel_channels(
    clip: Clip, terrain: Terrain, wheels: tuple[Wheel, ...], positions: Array, orientations: Array
) -> dict[str, Array]:
    """Travel of every wheel that has a channel for it, and its rotation, by the true path of its hub."""
    made = {}
    R_wr = matrices(orientations)
    for wheel in wheels:
        travel = np.zeros(len(clip))
        if wheel.travel is not None:
            travel = made[wheel.travel] = touch(terrain, wheel, positions, orientations)
        if wheel.roll is not None and len(clip) > 1:
            hub = positions + R_wr @ wheel.centre + travel[:, None] * R_wr[:, :, 2]
            path = np.diff(hub, axis=0)
            level = np.linalg.norm(path[:, :2], axis=1)
            longer = np.where(level > 1e-6, np.linalg.norm(path, axis=1) / np.maximum(level, 1e-6), 1.0)
            turned = clip.channels[wheel.roll]
            made[wheel.roll] = turned[0] + np.concatenate([[0.0], np.cumsum(np.diff(turned) * longer)])
    return made
