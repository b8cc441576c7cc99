"""Wheels: which parts of a rig they are, and how far each travels until it touches the terrain.

Each wheel is a profile rotated about its axle. Its travel along the body's vertical is measured on the terrain itself.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vehsim.lie.quaternions import matrices
from vehsim.rig.rig import HITCH_PITCH, HITCH_ROLL, Rig
from vehsim.runtime.cache import Stamp, stamp
from vehsim.world.terrain.terrain import Terrain

Array = NDArray[np.float64]

ARC, ANGLES = np.radians(100.0), 41
"""The part of a tyre's circumference at which contact is sought, rad, and the number of angles: 0.05 mm of a car's
tyre."""
PROFILE = 7
"""Number of rings that represent a tyre's profile."""
ROUNDS, TOUCHING = 12, 1e-6
"""Largest number of iterations of a contact's height, each of which reduces the error by the slope times the body's
tilt; and the change at which they end, m."""
TRAVEL = "travel_"
"""Prefix of channels that slide a wheel along its suspension."""


@dataclass(frozen=True)
class Wheel:
    """``centre`` (3,) m in the rig root's frame; ``rings`` (k, 2): lateral offset and radius of its profile, m.

    ``travel``, ``roll``: the channels that slide and turn it, or None; ``prim``: the path of its part below the root;
    ``carrier``: that of the trailer it belongs to, "" for the vehicle's own body. ``angles``: number of them
    at which contact is sought.
    """

    centre: Array
    rings: Array
    travel: str | None
    roll: str | None
    prim: str = ""
    carrier: str = ""
    angles: int = ANGLES

    @cached_property
    def coarse(self) -> Wheel:
        """The wheel with a quarter of its points: within 1.3 mm for a car's tyre."""
        return replace(self, angles=ANGLES // 4 + 1)

    @cached_property
    def rim(self) -> Array:
        """Points (m, 3) of the tyre's lower half, about the root, straight ahead."""
        (side, radius), angles = self.rings.T, np.linspace(-ARC / 2, ARC / 2, self.angles)
        x = radius[:, None] * np.sin(angles)
        z = -radius[:, None] * np.cos(angles)
        return self.centre + np.stack(np.broadcast_arrays(x, side[:, None], z), axis=-1).reshape(-1, 3)


def wheels_of(rig: Rig) -> tuple[Wheel, ...]:
    """The wheels of a rig: of each body, the parts that ``travel_*`` channels slide; without such channels, parts that
    turn about an axle across the vehicle, in any of their own axes, and carry no joint."""
    pivots = {name: tuple(d.pivot) if isinstance(d.pivot, list) else d.pivot for name, d in rig.drives.items()}
    drives = tuple(sorted((name, drive.prim, drive.op, pivots[name]) for name, drive in rig.drives.items()))
    return _wheels(Path(rig.asset), rig.root or None, drives, stamp(rig.asset))


@lru_cache(maxsize=32)
def _wheels(asset: Path, root: str | None, drives: tuple[Any, ...], written: Stamp) -> tuple[Wheel, ...]:
    from vehsim.rig.parts import read_parts

    parts = {part.path: part for part in read_parts(asset, root)}
    sliding = {prim: name for name, prim, *_ in drives if name.startswith(TRAVEL)}
    tilting = (HITCH_PITCH, HITCH_ROLL)
    carriers = ["", *{prim: None for name, prim, *_ in drives if name.startswith(tilting)}]
    # for example a leg
    joints = {prim for _, prim, *_ in drives for _, other, *_ in drives if other.startswith(f"{prim}/")}
    turning = {
        prim: name
        for name, prim, op, _ in drives
        if prim in parts and prim not in joints and not name.startswith(tilting) and _across(parts[prim], op)
    }
    pivots = {prim: pivot for name, prim, _, pivot in drives if name in turning.values() and pivot is not None}
    carried = {prim: max((c for c in carriers if _below(prim, c)), key=len) for prim in (*sliding, *turning)}
    sprung = {carried[prim] for prim in sliding}
    found = []
    for prim in (*sliding, *(prim for prim in turning if carried[prim] not in sprung)):
        below = [path for path in parts if _below(path, prim)]
        if not below:
            continue
        points = np.concatenate([parts[p].points @ parts[p].T_rp[:3, :3].T + parts[p].T_rp[:3, 3] for p in below])
        if not len(points):
            continue
        spin = next((path for path in sorted(turning) if path in below), None)
        hub = parts[spin if spin in parts else below[0]].T_rp[:3, 3]
        if spin in pivots:
            hub = (points.min(axis=0) + points.max(axis=0)) / 2 if pivots[spin] == "centre" else np.array(pivots[spin])
        channels = sliding.get(prim), turning.get(spin or "")
        found.append(Wheel(hub, _profile(points - hub), *channels, prim, carried[prim]))
    return tuple(found)


def _below(path: str, prim: str) -> bool:
    """Whether a part is ``prim`` or below it."""
    return not prim or f"{path}/".startswith(f"{prim}/")


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


def touch(
    terrain: Terrain,
    wheel: Wheel,
    positions: Array,
    orientations: Array,
    rounds: int = ROUNDS,
    tolerance: float = TOUCHING,
) -> Array:
    """Travel (n,) m along the body's vertical, relative to the wheel's rest, at which it just touches the terrain.

    If the travel is small, one of the ``rounds`` suffices. It ends with a change of at most ``tolerance`` m.
    """
    moves = (np.diff(positions, axis=0) != 0).any(axis=1) | (np.diff(orientations, axis=0) != 0).any(axis=1)
    if not moves.all():  # it stands at times
        some = np.flatnonzero(np.concatenate([[True], moves]))
        each = touch(terrain, wheel, positions[some], orientations[some], rounds, tolerance)
        return np.repeat(each, np.diff(some, append=len(positions)))
    level = float(terrain.heights.flat[0])
    if terrain.surface is None and np.all(terrain.heights == level):
        vertical = matrices(orientations)[:, 2]
        return np.asarray(((level - positions[:, 2:] - vertical @ wheel.rim.T) / vertical[:, 2:]).max(axis=1))
    blocks = _blocks(len(positions))
    found = [_touch(terrain, wheel, positions[k], orientations[k], rounds, tolerance) for k in blocks]
    return np.concatenate(found or [np.zeros(0)])


def _touch(
    terrain: Terrain, wheel: Wheel, positions: Array, orientations: Array, rounds: int, tolerance: float
) -> Array:
    R_wr = matrices(orientations)
    # one product for all samples takes a third of the time of one for each
    points = positions[:, :, None] + (R_wr.reshape(-1, 3) @ wheel.rim.T).reshape(*R_wr.shape[:2], -1)
    up, travel = R_wr[:, :, 2, None], np.zeros(len(positions))
    for _ in range(rounds):
        moved = points[:, :2] + travel[:, None, None] * up[:, :2]
        ground = terrain.height(moved.swapaxes(1, 2).reshape(-1, 2)).reshape(len(moved), -1)
        before, travel = travel, ((ground - points[:, 2]) / up[:, 2]).max(axis=1)
        if np.abs(travel - before).max() < tolerance:
            break
    return travel


def _blocks(count: int, size: int = 64) -> Iterator[slice]:
    """Number of samples per block: the intermediate results fit into the processor's cache, which is twice as fast."""
    return (slice(k, k + size) for k in range(0, count, size))
