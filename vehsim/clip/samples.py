"""A sampled motion as data: the input and output of the interpolant."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from fractions import Fraction
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from vehsim.errors import InputError

if TYPE_CHECKING:
    from vehsim.vehicles import State, Vehicle

Array = NDArray[np.float64]

ARRAYS = ("times", "positions", "orientations", "twists", "joints", "joint_rates", "controls")
GROUPS = {"channels": "channel.", "energy": "energy.", "commands": "command.", "channel_rates": "channel_rate."}
"""Fields with arrays by name, and the prefixes of their names in a saved clip."""


@dataclass(frozen=True, eq=False)
class Samples:
    """Samples of a vehicle's motion; `Clip` describes the fields."""

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
    commands: Mapping[str, Array] = field(default_factory=dict)
    channel_rates: Mapping[str, Array] = field(default_factory=dict)

    def __post_init__(self) -> None:
        object.__setattr__(self, "fps", frame_rate(self.fps))
        lengths = {name: len(getattr(self, name)) for name in ARRAYS}
        if len(set(lengths.values())) != 1 or lengths["times"] == 0:
            raise InputError(f"arrays of different lengths or empty: {lengths}", "give one row per sample", key="clip")
        if np.any(np.diff(self.times) <= 0):
            raise InputError("times must increase", "sort the samples and drop repeated ones", key="clip")
        for name in ARRAYS:
            if not np.all(np.isfinite(getattr(self, name))):
                raise InputError(f"{name} are not finite in every sample", "give numbers", key="clip")
        if np.any(np.abs(np.linalg.norm(self.orientations, axis=1) - 1) > 1e-3):
            raise InputError("orientations are not unit quaternions", "normalise them", key="clip")

    def __repr__(self) -> str:
        span = f"frames {self.start_frame} to {self.end_frame} at {self.fps} fps"
        return f"<Clip of {self.vehicle.name}: {len(self)} samples, {span}>"

    def __len__(self) -> int:
        return len(self.times)

    @property
    def duration(self) -> float:
        """Duration, s."""
        return float(self.times[-1] - self.times[0])

    @property
    def frames(self) -> Array:
        """Frame of each sample (n,); frames that are whole up to round-off are rounded."""
        frames = self.start_frame + self.times * float(self.fps)
        whole = np.round(frames)
        return np.where(np.abs(frames - whole) < 1e-6, whole, frames)

    @property
    def end_frame(self) -> int:
        """The last whole frame that the clip covers."""
        return int(np.floor(self.frames[-1] + 1e-6))

    def matrices(self) -> Array:
        """``T_wr`` (n, 4, 4): rig root to world, for column vectors."""
        from vehsim.lie.quaternions import matrices

        T_wr = np.zeros((len(self), 4, 4))
        T_wr[:, :3, :3] = matrices(self.orientations)
        T_wr[:, :3, 3] = self.positions
        T_wr[:, 3, 3] = 1.0
        return T_wr

    def state(self, index: int) -> State:
        """The state at one sample, without the tilt of a planar vehicle."""
        from vehsim.lie.quaternions import from_yaw, yaw_of
        from vehsim.vehicles import State

        orientation = self.orientations[index]
        if self.vehicle.group.planar:
            orientation = from_yaw(yaw_of(orientation))
        return State(
            position=self.positions[index],
            orientation=orientation,
            twist=self.twists[index],
            joints=self.joints[index],
            joint_rates=self.joint_rates[index],
        )


def check_shapes(vehicle: Vehicle, columns: Mapping[str, Array], groups: Mapping[str, Mapping[str, Array]]) -> None:
    """Raise ``InputError`` unless every array of `ARRAYS` and `GROUPS`, read from a file, has a row for each sample, as
    wide as the vehicle needs."""
    joints, dim = len(vehicle.joints), vehicle.group.dim
    widths = ((), (3,), (4,), (dim,), (joints,), (joints,), (len(vehicle.controls),))
    needed = dict(zip(ARRAYS, widths, strict=True))
    shapes = {name: np.shape(columns[name]) for name in ARRAYS}
    shapes |= {f"{group}.{name}": np.shape(values) for group in GROUPS for name, values in groups[group].items()}
    if len({shape[:1] for shape in shapes.values()}) != 1 or shapes["times"] in ((), (0,)):
        raise InputError(f"arrays of different lengths or empty: {shapes}", "save it again", key="clip")
    for name, shape in shapes.items():
        if shape[1:] != needed.get(name, ()):
            wanted = " by ".join(map(str, ("n", *needed.get(name, ()))))
            raise InputError(f"{name} has the shape {shape}, not {wanted}", "save it again", key="clip")


def frame_rate(fps: Any) -> Fraction:
    """Frames per second as an exact fraction. Raises ``InputError`` unless positive."""
    try:
        rate = Fraction(fps).limit_denominator(100_000)
    except (TypeError, ValueError, ZeroDivisionError, OverflowError):
        rate = Fraction(0)
    if rate <= 0:
        raise InputError(
            "not a frame rate", "give frames per second, such as 24 or Fraction(24000, 1001)", key="fps", value=fps
        )
    return rate
