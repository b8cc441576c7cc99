"""Check that ``vehicle.toml`` and its asset describe one vehicle: lengths, mass and direction of the nose.

This module measures the asset's parts and compares; `shot/checks.py` reports.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from vehsim.errors import InputError, Problem
from vehsim.runtime.cache import Stamp, stamp
from vehsim.vehicles.definition.base import Array
from vehsim.vehicles.library.file import read_vehicle
from vehsim.vehicles.library.parameters import blamed, replaced

if TYPE_CHECKING:
    from vehsim.rig.rig import Rig

OFF, GROSS = 0.15, 3.0
"""Relative difference from the asset above which a number gives a warning, and the factor above which it is an
error."""
DENSITY, POSSIBLE = (30.0, 2500.0), (5.0, 12000.0)
"""Mass divided by the volume of a vehicle's hulls, kg/m^3: the usual range, and the possible range."""
ROTORS = ("main_rotor", "tail_rotor")
"""Channels of parts whose hulls are the space that they sweep, which has no weight."""


def misfits(rig: Rig | None, parameters: Mapping[str, Any] | None = None) -> list[Problem]:
    """Numbers of a ``vehicle.toml``, or ``parameters`` in their place, that the asset contradicts: lengths in m, mass
    in kg, the centre."""
    if rig is None or not (data := _written(rig)):
        return []
    given = parameters or {}
    shape, physics = _Shape.of(rig), replaced(data, given).get("physics", {})
    found = [*_lengths(rig, shape, physics), *_mass(rig, shape, physics), *_centre(rig, shape)]
    return [blamed(problem, given) for problem in found]


def backwards(rig: Rig | None) -> Problem | None:
    """Check that the asset's nose is along X: front wheels ahead of rear wheels, tail rotor and propeller behind."""
    if rig is None or not (data := _written(rig)):
        return None
    try:
        return next(_backwards(rig, _Shape.of(rig), data), None)
    except InputError:  # parts that cannot be read are reported where they are read
        return None


def _written(rig: Rig) -> dict[str, Any]:
    """The content of the ``vehicle.toml`` and its base; empty if there is none."""
    toml = None if rig.folder is None else rig.folder / "vehicle.toml"
    return read_vehicle(toml) if toml is not None and toml.is_file() else {}


@dataclass(frozen=True)
class _Shape:
    """Points (n, 3) of every part in the rig root's frame, m, and the volume of its hulls, m^3, by path."""

    points: dict[str, Array]
    volumes: dict[str, float]

    @staticmethod
    def of(rig: Rig) -> _Shape:
        return _shape(rig.asset, rig.root or None, stamp(rig.asset))

    def below(self, prim: str) -> Array:
        """Points (n, 3) of a prim and all prims below it."""
        rows = [p for path, p in self.points.items() if _is_below(path, prim)]
        return np.concatenate(rows) if rows else np.zeros((0, 3))

    def volume(self, rig: Rig) -> float:
        """The volume of all hulls without those of rotors, m^3."""
        swept = [rig.drives[name].prim for name in ROTORS if name in rig.drives]
        return sum(v for path, v in self.volumes.items() if not any(_is_below(path, prim) for prim in swept))

    def centres(self, rig: Rig, channels: Sequence[str]) -> Array:
        """Centres (k, 3) of the parts that the existing ones of ``channels`` drive."""
        sets = [self.below(rig.drives[name].prim) for name in channels if name in rig.drives]
        return np.array([(p.min(axis=0) + p.max(axis=0)) / 2 for p in sets if len(p)]).reshape(-1, 3)


@lru_cache(maxsize=64)
def _shape(asset: Path, root: str | None, written: Stamp) -> _Shape:
    from vehsim.rig.parts import moments, read_parts

    parts = read_parts(asset, root)
    points = {p.path: p.points @ p.T_rp[:3, :3].T + p.T_rp[:3, 3] for p in parts if len(p.points)}
    volumes = dict.fromkeys((part.path for part in parts), 0.0)
    for part, volume, _, _ in moments(parts):
        volumes[part.path] += volume
    return _Shape(points, volumes)


def _is_below(path: str, prim: str) -> bool:
    """Whether a part is a prim or below it."""
    return path == prim or path.startswith(f"{prim}/")


FRONT, REAR = ("roll_fl", "roll_fr", "steer_fl", "steer_fr", "roll_front"), ("roll_rl", "roll_rr", "roll_rear")


def _axles(rig: Rig, shape: _Shape) -> tuple[float, float] | None:
    """x of the front and of the rear axle, m."""
    front, rear = shape.centres(rig, FRONT), shape.centres(rig, REAR)
    return (float(front[:, 0].mean()), float(rear[:, 0].mean())) if len(front) and len(rear) else None


def _backwards(rig: Rig, shape: _Shape, data: dict[str, Any]) -> Iterator[Problem]:
    ends = []
    if axles := _axles(rig, shape):
        ends.append(("its front wheels", "behind its rear wheels", axles[0] - axles[1]))
    for channel, name in (("tail_rotor", "its tail rotor"), ("propeller", "its propeller")):
        for place in shape.centres(rig, [channel]):
            ends.append((name, "ahead of its centre of mass", rig.origin[0] - place[0]))
    length = np.ptp(np.concatenate(list(shape.points.values()))[:, 0]) if shape.points else 0.0
    for what, where, ahead in ends:
        if ahead < -0.05 * length:
            remedy = 'give the axis that its nose points along, such as forward = "-X"'
            remedy += ", or exchange the prims of its channels"
            message = f"{what} stand{'s' if not what.endswith('s') else ''} {-ahead:.2f} m {where}: it points backwards"
            yield Problem("forward", message, remedy, data.get("forward"))
            return


def _lengths(rig: Rig, shape: _Shape, physics: dict[str, Any]) -> Iterator[Problem]:
    origin = np.asarray(rig.origin, float)
    rolls = [shape.below(drive.prim) for name, drive in rig.drives.items() if name.startswith("roll")]
    if sizes := [float(np.ptp(p[:, 2])) / 2 for p in rolls if len(p)]:
        yield from _compare("wheel_radius", physics, float(np.median(sizes)), "its wheels have a radius of")
    if axles := _axles(rig, shape):
        yield from _compare("wheelbase", physics, axles[0] - axles[1], "its axles have a distance of")
    for key, channel, axis, sign in (("d_t", "main_rotor", 2, 1), ("d_r", "tail_rotor", 0, -1)):
        for place in shape.centres(rig, [channel]):
            far = float(sign * (place - origin)[axis])
            yield from _compare(key, physics, far, f"from its origin, its {channel.replace('_', ' ')} is")


def _compare(key: str, physics: dict[str, Any], measured: float, what: str) -> Iterator[Problem]:
    given = physics.get(key)
    if not isinstance(given, int | float) or measured <= 0 or given <= 0:
        return
    ratio = given / measured
    if abs(ratio - 1) <= OFF:
        return
    unit = next((f", as in {name}" for name, size in (("cm", 100), ("mm", 1000), ("feet", 3.281), ("inches", 39.37))
                 if abs(ratio / size - 1) < OFF), "")  # fmt: skip
    gross = not 1 / GROSS < ratio < GROSS
    remedy = f"give {measured:.3g}, in m, or fix the asset's meters_per_unit"
    message = f"{what} {measured:.3g} m{unit}"
    yield Problem(f"physics.{key}", message, remedy, given, severity="error" if gross else "warning")


def _mass(rig: Rig, shape: _Shape, physics: dict[str, Any]) -> Iterator[Problem]:
    mass = physics.get("mass")
    volume = shape.volume(rig)
    if not isinstance(mass, int | float) or volume <= 0:
        return
    density = mass / volume
    if DENSITY[0] <= density <= DENSITY[1]:
        return
    message = f"divided by the {volume:.3g} m^3 of its hulls, this is {density:.3g} kg/m^3"
    low, high = (float(f"{limit * volume:.2g}") for limit in DENSITY)
    remedy = f"give kg: {low:g} to {high:g} is usual, or physics.density to have it measured"
    possible = POSSIBLE[0] <= density <= POSSIBLE[1]
    yield Problem("physics.mass", message, remedy, mass, severity="warning" if possible else "error")


def _centre(rig: Rig, shape: _Shape) -> Iterator[Problem]:
    if not shape.points:
        return
    points = np.concatenate(list(shape.points.values()))
    lower, upper = points.min(axis=0), points.max(axis=0)
    beyond = np.maximum(np.maximum(lower - rig.origin, np.asarray(rig.origin) - upper), 0.0)
    size = float(np.linalg.norm(upper - lower))
    off = float(np.linalg.norm(beyond))
    if off > 0.1 * size:
        message = f"{off:.3g} m outside the asset, whose box is {', '.join(f'{x:.3g}' for x in upper - lower)} m"
        remedy = "give the place in the rig root's frame, in m"
        yield Problem("origin", message, remedy, list(rig.origin), severity="error" if off > size else "warning")
