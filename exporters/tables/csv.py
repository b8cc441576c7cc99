"""The csv exporter: one tidy table per vehicle, a row per whole frame, units in the header."""

from __future__ import annotations

import csv
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from vehsim.delivery.exporters import Exporter
from vehsim.delivery.take import Take
from vehsim.runtime.progress import Progress
from vehsim.world.ground.placing import PLACED

if TYPE_CHECKING:
    from vehsim.clip.clip import Clip

Array = NDArray[np.float64]

TWIST = {"angular_velocity": "rad/s", "velocity": "m/s"}


def write_csv(take: Take, folder: Path, progress: Progress) -> Sequence[Path]:
    """Write ``<vehicle>.csv`` per vehicle; returns the files written."""
    written = []
    for name, clip in take.clips.items():
        path = folder / f"{name}.csv"
        table = columns(clip.resample(take.fps))
        with path.open("w", newline="", encoding="utf-8") as file:
            writer = csv.writer(file, lineterminator="\n")
            writer.writerow(table)
            for row in zip(*table.values(), strict=True):
                writer.writerow([_text(value) for value in row])
        written.append(path)
    return written


def columns(clip: Clip) -> dict[str, Array]:
    """Header -> values (n,): frame, time, pose in world axes, twist in body axes, joints, channels, controls and
    commands."""
    table: dict[str, Array] = {"frame": clip.frames, "time [s]": clip.times}
    table |= {f"world.position.{axis} [m]": values for axis, values in zip("xyz", clip.positions.T, strict=True)}
    table |= {f"world.orientation.{axis}": values for axis, values in zip("wxyz", clip.orientations.T, strict=True)}
    table |= dict(zip(_twist_names(clip.twists.shape[1]), clip.twists.T, strict=True))
    for joint, values, rates in zip(clip.vehicle.joints, clip.joints.T, clip.joint_rates.T, strict=False):
        unit = clip.vehicle.joint_units.get(joint, "rad")
        table |= {f"joint.{joint}{_in(unit)}": values, f"joint_rate.{joint}{_in(f'{unit}/s')}": rates}
    for channel, values in clip.channels.items():
        table[f"channel.{channel}{_in(_channel_unit(clip, channel))}"] = values
    for control, values in zip(clip.vehicle.controls, clip.controls.T, strict=False):
        unit = _in(control.unit)
        table[f"control.{control.name}{unit}"] = values
        if control.name in clip.commands:
            table[f"command.{control.name}{unit}"] = clip.commands[control.name]
    return table


def _twist_names(size: int) -> list[str]:
    """A twist is angular before linear: (wz, vx, vy) in the plane, (wx, wy, wz, vx, vy, vz) in space."""
    if size == 3:
        return ["body.angular_velocity.z [rad/s]", "body.velocity.x [m/s]", "body.velocity.y [m/s]"]
    names = [f"body.{kind}.{axis} [{unit}]" for kind, unit in TWIST.items() for axis in "xyz"]
    return names if size == 6 else [f"twist.{k}" for k in range(size)]


def _channel_unit(clip: Clip, channel: str) -> str:
    """The unit of a channel of the model, of a part that moves, or of what stands on the ground."""
    model = clip.vehicle.channels.get(channel)
    drive = clip.vehicle.rig.drives.get(channel) if clip.vehicle.rig else None
    if model and model.unit:
        return model.unit
    if drive:
        return "m" if drive.op.startswith("translate") else "rad"
    return next((unit for start, unit in PLACED.items() if channel.startswith(start)), "rad")


def _in(unit: str) -> str:
    return f" [{unit}]" if unit else ""


def _text(value: float) -> str:
    """The shortest text that reads back to the same number; whole frames without a point."""
    return str(int(value)) if float(value).is_integer() and abs(value) < 1e15 else repr(float(value))


exporter = Exporter(name="csv", suffixes=(".csv",), write=write_csv, makes="one table per vehicle, one row per frame")
