"""Exact motion as arrays, read through one C1 interpolant.

Simulation, planning and files make clips; resampling, rendering, export and certification all read them through `at`,
so nobody sees another motion than anybody else.
"""

from __future__ import annotations

import json
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from fractions import Fraction
from io import BytesIO
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from vehsim.errors import InputError

if TYPE_CHECKING:
    from vehsim.vehicles import State, Vehicle

Array = NDArray[np.float64]

_ARRAYS = ("times", "positions", "orientations", "twists", "joints", "joint_rates", "controls")


@dataclass(frozen=True, eq=False)
class Clip:
    """The motion of one vehicle's rig root, sampled at knots.

    ``times`` (n,) s from 0; ``positions`` (n, 3) m; ``orientations`` (n, 4) w, x, y, z, continuous in sign;
    ``twists`` (n, d) in body axes, rad/s then m/s; ``joints``, ``joint_rates`` (n, s); ``controls`` (n, c);
    ``channels`` rig channel name -> (n,), rad or m, unwrapped. Sample k is frame ``start_frame + times[k] * fps``.
    ``events``: what happened (contacts); ``energy``: name -> (n,) J.
    """

    vehicle: Vehicle
    times: Array
    positions: Array
    orientations: Array
    twists: Array
    joints: Array
    joint_rates: Array
    controls: Array
    channels: Mapping[str, Array] = field(default_factory=dict)
    fps: Fraction = Fraction(24)
    start_frame: int = 1001
    events: Sequence[Mapping[str, Any]] = ()
    energy: Mapping[str, Array] = field(default_factory=dict)

    def __post_init__(self) -> None:
        object.__setattr__(self, "fps", frame_rate(self.fps))
        lengths = {name: len(getattr(self, name)) for name in _ARRAYS}
        if len(set(lengths.values())) != 1 or lengths["times"] == 0:
            raise InputError(f"clip: arrays of different lengths or empty: {lengths}; give one row per sample")
        if np.any(np.diff(self.times) <= 0):
            raise InputError("clip: times must increase; sort the samples and drop repeated ones")
        for name in _ARRAYS:
            if not np.all(np.isfinite(getattr(self, name))):
                raise InputError(f"clip: {name} are not finite in every sample; give numbers")
        if np.any(np.abs(np.linalg.norm(self.orientations, axis=1) - 1) > 1e-3):
            raise InputError("clip: orientations are not unit quaternions; normalise them")

    def __repr__(self) -> str:
        span = f"frames {self.start_frame} to {self.end_frame} at {self.fps} fps"
        return f"<Clip of {self.vehicle.name}: {len(self)} samples, {span}>"

    def __len__(self) -> int:
        return len(self.times)

    @property
    def duration(self) -> float:
        """s"""
        return float(self.times[-1] - self.times[0])

    @property
    def frames(self) -> Array:
        """Frame of each sample (n,); whole frames come out whole."""
        frames = self.start_frame + self.times * float(self.fps)
        whole = np.round(frames)
        return np.where(np.abs(frames - whole) < 1e-6, whole, frames)

    @property
    def end_frame(self) -> int:
        """The last whole frame the clip covers."""
        return int(np.floor(self.frames[-1] + 1e-6))

    def matrices(self) -> Array:
        """``T_wr`` (n, 4, 4): rig root to world, for column vectors."""
        from vehsim._quaternions import matrices

        T_wr = np.zeros((len(self), 4, 4))
        T_wr[:, :3, :3] = matrices(self.orientations)
        T_wr[:, :3, 3] = self.positions
        T_wr[:, 3, 3] = 1.0
        return T_wr

    def state(self, index: int) -> State:
        """The state at one sample; what drives in the plane has no tilt in it."""
        from vehsim._quaternions import tilt_of, yaw_tilt
        from vehsim.vehicles import State

        orientation = self.orientations[index]
        if self.vehicle.group.planar:
            orientation = yaw_tilt(tilt_of(orientation[None])[0], np.zeros(1), np.zeros(1))[0]
        return State(
            position=self.positions[index],
            orientation=orientation,
            twist=self.twists[index],
            joints=self.joints[index],
            joint_rates=self.joint_rates[index],
        )

    def at(self, times: Any) -> Clip:
        """The clip at any times (m,) s, through its interpolant: C1 in the pose, exact at the knots.

        Times outside the clip are an ``InputError``: a clip does not guess.
        """
        from vehsim._interpolate import interpolate

        times = np.atleast_1d(np.asarray(times, float))
        if times.ndim != 1 or not np.all(np.isfinite(times)):
            raise InputError(f"clip: times of shape {times.shape}; give finite seconds, (m,)")
        slack = 1e-9 * max(1.0, abs(self.times[-1]))
        if times.min() < self.times[0] - slack or times.max() > self.times[-1] + slack:
            raise InputError(
                f"clip: time {times.min():.6g}..{times.max():.6g} s is outside "
                f"{self.times[0]:.6g}..{self.times[-1]:.6g} s; ask for times within the clip"
            )
        return interpolate(self, np.clip(times, self.times[0], self.times[-1]))

    def resample(self, fps: Any = None) -> Clip:
        """The clip on whole frames, ``start_frame`` to ``end_frame``; ``fps`` unchanged unless given."""
        clip = self if fps is None else replace(self, fps=fps)
        count = clip.end_frame - clip.start_frame + 1
        times = np.array([float(k / clip.fps) for k in range(count)])
        return clip.at(np.minimum(times, clip.times[-1]))

    def save(self, path: str | Path) -> Path:
        """Write the clip as ``.npz``, beside and then into place. `Clip.load` reads it back bit for bit."""
        path = Path(path).with_suffix(".npz")
        path.parent.mkdir(parents=True, exist_ok=True)
        beside = path.with_name(f".{path.name}.{os.getpid()}.tmp")
        beside.write_bytes(self.to_bytes())
        beside.replace(path)
        return path

    def to_bytes(self) -> bytes:
        """What `save` writes; `from_bytes` reads it."""
        header = {
            "schema": 1,
            "vehicle": self.vehicle.name,
            "folder": _folder(self.vehicle),
            "fps": str(self.fps),
            "start_frame": self.start_frame,
            "joints": list(self.vehicle.joints),
            "control_names": list(self.vehicle.control_names),
            "events": list(self.events),
        }
        arrays = {name: getattr(self, name) for name in _ARRAYS}
        arrays |= {f"channel.{name}": values for name, values in self.channels.items()}
        arrays |= {f"energy.{name}": values for name, values in self.energy.items()}
        buffer = BytesIO()
        np.savez(buffer, header=np.array(json.dumps(header, sort_keys=True)), **arrays)  # type: ignore[arg-type]
        return buffer.getvalue()

    @classmethod
    def load(cls, path: str | Path, vehicle: Vehicle | None = None) -> Clip:
        """Read a saved clip. ``vehicle``: whose clip it is, when it is neither shipped nor at its old folder."""
        return cls._read(Path(path), vehicle, path)

    @classmethod
    def from_bytes(cls, content: bytes, vehicle: Vehicle | None = None) -> Clip:
        """The clip that `to_bytes` wrote."""
        return cls._read(BytesIO(content), vehicle, "clip")

    @classmethod
    def _read(cls, file: Path | BytesIO, vehicle: Vehicle | None, path: str | Path) -> Clip:
        try:
            with np.load(file, allow_pickle=False) as data:
                arrays = {name: data[name] for name in data.files}
            header = json.loads(str(arrays.pop("header")))
            columns = {name: arrays[name] for name in _ARRAYS}
            events, width = tuple(header["events"]), columns["twists"].shape[-1]
            fps, first = Fraction(header["fps"]), int(header["start_frame"])
            known = str(header["vehicle"]), str(header["folder"])
        except Exception as error:  # of NumPy, of zip files, of a header that is another's
            raise InputError(f"{path}: not a clip saved by vehsim: {error}; save it with clip.save") from None
        return cls(
            vehicle=_moving(vehicle or _vehicle_of(*known), width, path),
            **columns,
            channels=_group(arrays, "channel."),
            energy=_group(arrays, "energy."),
            fps=fps,
            start_frame=first,
            events=events,
        )

    def export(self, path: str | Path, to: str | Sequence[str] | None = None) -> Path:
        """Write the clip through an exporter, found by ``path``'s suffix or named by ``to``. Returns what it wrote."""
        from vehsim.take import export_clip

        return export_clip(self, Path(path), to)


def frame_rate(fps: Any) -> Fraction:
    """Frames a second as an exact fraction; ``InputError`` unless positive."""
    try:
        rate = Fraction(fps).limit_denominator(100_000)
    except (TypeError, ValueError, ZeroDivisionError, OverflowError):
        rate = Fraction(0)
    if rate <= 0:
        raise InputError(f"fps = {fps!r}: give frames a second, such as 24 or Fraction(24000, 1001)")
    return rate


def _folder(vehicle: Vehicle) -> str:
    return "" if vehicle.rig is None else str(vehicle.rig.folder or vehicle.rig.asset.parent)


def _group(arrays: Mapping[str, Array], prefix: str) -> dict[str, Array]:
    return {name.removeprefix(prefix): values for name, values in arrays.items() if name.startswith(prefix)}


def _moving(vehicle: Vehicle, width: int, path: str | Path) -> Vehicle:
    """The vehicle as twists of ``width`` columns have it move: a boat's may be those of its planar self."""
    for self in (vehicle, vehicle.planar):
        if self is not None and self.group.dim == width:
            return self
    wrong = f"a clip of another vehicle than {vehicle.name!r}: its twists have {width} columns, not {vehicle.group.dim}"
    raise InputError(f"{path}: {wrong}; give the vehicle whose clip it is")


def _vehicle_of(name: str, where: str) -> Vehicle:
    from vehsim.vehicles import load_vehicle

    folder = Path(where) if where else None
    if folder is not None and (folder / "vehicle.toml").is_file():
        return load_vehicle(folder)
    return load_vehicle(name)
