"""Exact motion as arrays, read through one C1 interpolant.

Simulation, planning and files make clips. Resampling, rendering, export and certification all read them through `at`,
so they all see the same motion.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from fractions import Fraction
from io import BytesIO
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from vehsim.clip.ending import Arrays
from vehsim.clip.interpolant import interpolate
from vehsim.clip.samples import ARRAYS, GROUPS, Samples, check_shapes
from vehsim.errors import InputError
from vehsim.intake.arrays import NUMBERS, read_arrays
from vehsim.runtime.files import write_file

if TYPE_CHECKING:
    from vehsim.vehicles import Vehicle

Array = NDArray[np.float64]

ENDING = "ending."
"""The prefix of the arrays of `Clip.ending` in a saved clip."""


@dataclass(frozen=True, eq=False, repr=False)
class Clip(Samples):
    """The motion of one vehicle's rig root, sampled at knots.

    ``times`` (n,) s from 0; ``positions`` (n, 3) m; ``orientations`` (n, 4) w, x, y, z, continuous in sign; ``twists``
    (n, d) in body axes, rad/s then m/s; ``joints``, ``joint_rates`` (n, s); ``controls`` (n, c); ``channels`` rig
    channel name -> (n,), rad or m, unwrapped; ``channel_rates``: of those that are integrals, such as the turning of
    wheels, name -> (n,), rad/s or m/s. Sample k is frame ``start_frame + times[k] * fps``. ``events``: for
    example contacts; ``energy``: name -> (n,) J. ``commands``: what the actuators of the ``controls`` followed, control
    name -> (n,); empty if a motion was not made from commands. ``ending``: what `vehsim.simulate` needs to continue it,
    as `vehsim.clip.ending` encodes it; it is saved, but no part of the motion.
    """

    ending: Arrays | None = field(default=None, compare=False)

    def at(self, times: Any) -> Clip:
        """The clip at any times (m,) s, through its interpolant: C1 in the pose, exact at the knots.

        Raises ``InputError`` for times outside the clip.
        """
        times = np.atleast_1d(np.asarray(times, float))
        if times.ndim != 1 or not np.all(np.isfinite(times)):
            raise InputError(f"times of shape {times.shape}", "give finite seconds, (m,)", key="clip")
        slack = 1e-9 * max(1.0, abs(self.times[-1]))
        if times.min() < self.times[0] - slack or times.max() > self.times[-1] + slack:
            raise InputError(
                f"time {times.min():.6g}..{times.max():.6g} s is outside {self.times[0]:.6g}..{self.times[-1]:.6g} s",
                "use times within the clip",
                key="clip",
            )
        return interpolate(self, np.clip(times, self.times[0], self.times[-1]))

    def resample(self, fps: Any = None) -> Clip:
        """The clip on whole frames, ``start_frame`` to ``end_frame``; ``fps``: default, the clip's own."""
        clip = self if fps is None else replace(self, fps=fps)
        count = clip.end_frame - clip.start_frame + 1
        times = np.array([float(k / clip.fps) for k in range(count)])
        return clip.at(np.minimum(times, clip.times[-1]))

    def save(self, path: str | Path) -> Path:
        """Write the clip as ``.npz``, with what continues it, atomically. `Clip.load` reads it back bit for bit."""
        path = Path(path).with_suffix(".npz")
        path.parent.mkdir(parents=True, exist_ok=True)
        write_file(path, self.to_bytes(ending=True))
        return path

    def to_bytes(self, *, ending: bool = False) -> bytes:
        """The clip as bytes, which `from_bytes` reads; with what continues it if ``ending``."""
        header = {
            "schema": 1,
            "vehicle": self.vehicle.name,
            "folder": _folder(self.vehicle),
            **({"parameters": dict(self.vehicle.parameters)} if self.vehicle.parameters else {}),
            "fps": str(self.fps),
            "start_frame": self.start_frame,
            "joints": list(self.vehicle.joints),
            "control_names": list(self.vehicle.control_names),
            "events": list(self.events),
        }
        arrays = {name: getattr(self, name) for name in ARRAYS}
        for group, prefix in GROUPS.items():
            arrays |= {f"{prefix}{name}": values for name, values in getattr(self, group).items()}
        if ending and self.ending is not None:
            arrays |= {f"{ENDING}{name}": values for name, values in self.ending.items()}
        buffer = BytesIO()
        np.savez(buffer, header=np.array(json.dumps(header, sort_keys=True)), **arrays)  # type: ignore[arg-type]  # arrays, not options
        return buffer.getvalue()

    @classmethod
    def load(cls, path: str | Path, vehicle: Vehicle | None = None) -> Clip:
        """Read a saved clip. ``vehicle``: its vehicle, if this is neither shipped nor in its old folder."""
        return cls._read(Path(path), vehicle, path)

    @classmethod
    def from_bytes(cls, content: bytes, vehicle: Vehicle | None = None) -> Clip:
        """The clip of bytes that `to_bytes` wrote."""
        return cls._read(BytesIO(content), vehicle, "clip")

    @classmethod
    def _read(cls, file: Path | BytesIO, vehicle: Vehicle | None, path: str | Path) -> Clip:
        try:
            if isinstance(file, Path):
                arrays = read_arrays(file, "clip", kinds=f"{NUMBERS}U")
            else:
                with np.load(file, allow_pickle=False) as data:
                    arrays = {name: data[name] for name in data.files}
            header = json.loads(str(arrays.pop("header")))
            ending = {name.removeprefix(ENDING): arrays.pop(name) for name in list(arrays) if name.startswith(ENDING)}
            numbers = {name: np.asarray(values, float) for name, values in arrays.items()}
            columns: dict[str, Any] = {name: numbers[name] for name in ARRAYS}
            events, width = tuple(map(dict, header["events"])), columns["twists"].shape[-1]
            fps, first = Fraction(header["fps"]), int(header["start_frame"])
            known = str(header["vehicle"]), str(header["folder"]), dict(header.get("parameters", {}))
        except InputError as error:
            raise InputError(f"not a clip saved by vehsim: {error.message}", error.remedy, file=path) from None
        except Exception as error:  # raised by NumPy, by zip files, or by a foreign header
            raise InputError(f"not a clip saved by vehsim: {error}", "save it with clip.save", file=path) from None
        vehicle = _moving(vehicle or _vehicle_of(*known), width, path)
        groups: dict[str, Any] = {group: _group(numbers, prefix) for group, prefix in GROUPS.items()}
        try:
            check_shapes(vehicle, columns, groups)
            return cls(vehicle, **columns, **groups, fps=fps, start_frame=first, events=events, ending=ending or None)
        except InputError as error:
            raise InputError(f"not a clip saved by vehsim: {error.message}", error.remedy, file=path) from None

    def export(self, path: str | Path, to: str | Sequence[str] | None = None) -> Path:
        """Write the clip through an exporter, found by the suffix of ``path`` or named by ``to``. Returns the file
        written."""
        from importlib.metadata import entry_points

        (entry,) = entry_points(group="vehsim.delivery", name="clip")  # delivery imports clips, so the import is here
        written: Path = entry.load()(self, Path(path), to)
        return written


def _folder(vehicle: Vehicle) -> str:
    return "" if vehicle.rig is None else str(vehicle.rig.folder or vehicle.rig.asset.parent)


def _group(arrays: Mapping[str, Array], prefix: str) -> dict[str, Array]:
    return {name.removeprefix(prefix): values for name, values in arrays.items() if name.startswith(prefix)}


def _moving(vehicle: Vehicle, width: int, path: str | Path) -> Vehicle:
    """The vehicle with twists of ``width`` columns: for a boat, this may be its planar form."""
    for self in (vehicle, vehicle.planar):
        if self is not None and self.group.dim == width:
            return self
    wrong = f"a clip of another vehicle than {vehicle.name!r}: its twists have {width} columns, not {vehicle.group.dim}"
    raise InputError(wrong, "give the vehicle whose clip it is", file=path)


def _vehicle_of(name: str, where: str, parameters: Mapping[str, Any]) -> Vehicle:
    from vehsim.vehicles import load_vehicle

    folder = Path(where) if where else None
    if folder is not None and (folder / "vehicle.toml").is_file():
        return load_vehicle(folder, parameters)
    return load_vehicle(name, parameters)
