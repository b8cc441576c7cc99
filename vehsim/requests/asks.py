"""Asks as data, and the asks of marks, limits, looks and stays."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from typing import Any, Literal

EXACT = 1e-3
"""Meaning of a tolerance of 0 for a position, m, and for a velocity, m/s."""
EXACT_ANGLE = math.radians(0.05)
"""Meaning of a tolerance of 0 for an angle, rad, and for an angular velocity, rad/s."""
SLACK = 0.01
"""Share of a limit by which a finished motion may exceed it."""


@dataclass(frozen=True)
class Ask:
    """One requirement on a finished motion.

    ``key``: the key in the shot file, such as ``mark[1].position``; ``measure``: a name of `vehsim.audit.MEASURES`;
    ``first``, ``last``: the frames to which it applies, inclusive; ``wanted``: the values that the measure compares
    with, SI and radians. The ask is met if ``lower <= value <= upper``; None is no bound; ``unit`` of the value. A
    missed ask of severity ``warning`` is reported and does not fail the motion; ``remedy``: how to fix a miss, in
    words.
    """

    key: str
    measure: str
    first: float
    last: float
    wanted: Mapping[str, Any] = field(default_factory=dict)
    lower: float | None = None
    upper: float | None = None
    unit: str = ""
    severity: Literal["error", "warning"] = "error"
    remedy: str = ""

    def as_dict(self) -> dict[str, Any]:
        """The ask as JSON data; `Ask.from_dict` reads it back."""
        return asdict(self)

    @classmethod
    def from_dict(cls, data: Mapping[str, Any]) -> Ask:
        """The ask of data that `as_dict` wrote."""
        return cls(**data)


NEAR_ENOUGH = 0.01
"""What a finished motion may lack of its clearance, m."""


def clearance_ask(
    first: float,
    last: float,
    clearance: float,
    *,
    planar: bool,
    landings: Sequence[Sequence[float]] = (),
    slope: float = 0.0,
    rounded: float = 0.0,
) -> Ask:
    """The ask that a vehicle keeps ``clearance`` m from terrain and obstacles; ``planar``: from obstacles only.

    ``landings`` (k, 3) m: around them, less is allowed, by ``slope`` m per m, rounded over ``rounded`` m.
    """
    wanted = {
        "clearance": clearance,
        "obstacles_only": planar,
        "landings": [list(map(float, place)) for place in landings],
        "slope": slope,
        "round": rounded,
    }
    return Ask("clearance", "clearance", first, last, wanted, lower=clearance - NEAR_ENOUGH, unit="m")


def mark_asks(
    key: str,
    frame: float,
    *,
    hold: int = 0,
    position: Sequence[float] | None = None,
    tolerance: float = 0.0,
    heading: float | None = None,
    orientation: Sequence[float] | None = None,
    velocity: Sequence[float] | None = None,
    speed: float | None = None,
    joints: Mapping[str, float] | None = None,
    planar: bool = False,
) -> Iterator[Ask]:
    """The asks of a mark at ``frame`` and, with a hold, until ``hold`` frames later.

    ``position`` (3,) m with ``tolerance`` m along each axis, ``heading`` rad, ``orientation`` (4,) w, x, y, z,
    ``velocity`` (3,) m/s, world axes, ``speed`` m/s, ``joints`` by name in SI. ``planar``: the ground determines height
    and tilt.
    """
    until, axes, level = frame + hold, [0, 1] if planar else [0, 1, 2], {"planar": planar}
    if position is not None:
        wanted = {"position": list(map(float, position)), "axes": axes}
        yield Ask(f"{key}.position", "position", frame, until, wanted, upper=max(tolerance, EXACT), unit="m")
    if heading is not None:
        yield Ask(f"{key}.heading", "heading", frame, until, {"heading": float(heading)}, **ANGLE)
    if orientation is not None:
        attitude = {"orientation": list(map(float, orientation))}
        if planar:
            w, x, y, z = attitude["orientation"]
            yaw = math.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
            yield Ask(f"{key}.orientation", "heading", frame, until, {"heading": yaw}, **ANGLE)
        else:
            yield Ask(f"{key}.orientation", "orientation", frame, until, attitude, **ANGLE)
    if velocity is not None:
        wanted = {"velocity": list(map(float, velocity)), "axes": axes}
        yield Ask(f"{key}.velocity", "velocity", frame, until, wanted, upper=EXACT, unit="m/s")
        if not any(velocity):
            turning: dict[str, Any] = {"upper": EXACT_ANGLE, "unit": "rad/s"}
            yield Ask(f"{key}.velocity (turning)", "turn_rate", frame, until, level, **turning)
    if speed is not None:
        wanted = {"speed": float(speed), **level}
        yield Ask(f"{key}.speed", "speed_error", frame, until, wanted, upper=EXACT, unit="m/s")
    for joint, value in (joints or {}).items():
        wanted = {"joint": joint, "value": float(value)}
        yield Ask(f"{key}.joints.{joint}", "joint_error", frame, until, wanted, upper=EXACT)
    if hold:
        yield Ask(f"{key}.hold", "drift", frame, until, level, upper=max(2 * tolerance, EXACT), unit="m")
        yield Ask(f"{key}.hold (turning)", "turned", frame, until, level, **ANGLE)


ANGLE: dict[str, Any] = {"upper": EXACT_ANGLE, "unit": "rad"}


def gate_asks(
    key: str,
    frame: float,
    position: Sequence[float],
    axes: Sequence[Sequence[float]],
    radius: float | None,
    size: Sequence[float] | None,
    planar: bool,
) -> Iterator[Ask]:
    """The asks of a gate at ``position`` (3,) m, passed at ``frame``.

    ``axes`` (3, 3): rows through the gate, along its width, along its height; ``radius`` m or ``size`` (width, height)
    m.
    """
    wanted = {
        "position": list(map(float, position)),
        "gate": [list(map(float, axis)) for axis in axes],
        "half": [float(radius)] * 2 if radius is not None else [float(s) / 2 for s in size or ()],
        "round": radius is not None,
        "planar": planar,
    }
    yield Ask(f"{key}.gate (plane)", "gate_plane", frame, frame, wanted, lower=-EXACT, upper=EXACT, unit="m")
    yield Ask(f"{key}.gate (opening)", "gate_opening", frame, frame, wanted, upper=1.0 + EXACT)
    yield Ask(f"{key}.gate (direction)", "gate_direction", frame, frame, wanted, lower=-EXACT, unit="m/s")


def limit_asks(
    first: float,
    last: float,
    limits: Mapping[str, tuple[float, str]],
    joints: Mapping[str, tuple[float, float]],
    joint_rates: Mapping[str, tuple[float, float]],
    planar: bool = False,
    relief: Sequence[Sequence[float]] | None = None,
) -> Iterator[Ask]:
    """Limits over a motion: name -> (value, unit), and joints and their rates by name -> (low, high), SI.

    ``relief`` (2, 2) m: the box of the relief on which a vehicle on wheels drives; None: level ground.
    """
    wanted = {"planar": planar} if relief is None else {"planar": planar, "relief": relief}
    for name, (value, unit) in limits.items():
        slack = SLACK if unit == "m" else SLACK * value  # a share of a height depends on its zero: use 1 cm instead
        yield Ask(f"limits.{name}", name, first, last, wanted, upper=value + slack, unit=unit)
    for kind, ranges in (("joint", joints), ("joint_rate", joint_rates)):
        for joint, (low, high) in ranges.items():
            slack = SLACK * max(abs(end) for end in (low, high) if math.isfinite(end))
            ends: dict[str, Any] = {"lower": low - slack, "upper": high + slack}
            bounds = {side: end for side, end in ends.items() if math.isfinite(end)}
            yield Ask(f"limits.{kind}s.{joint}", kind, first, last, {"joint": joint}, **bounds)


def look_ask(
    key: str, first: float, last: float, at: Sequence[float], within: float, axis: int, sign: float, level: bool
) -> Ask:
    """A body axis points at ``at`` (3,) m within ``within`` rad; ``level``: compare horizontal directions."""
    wanted = {"at": list(map(float, at)), "axis": axis, "sign": sign, "level": level}
    return Ask(key, "look", first, last, wanted, upper=within + EXACT_ANGLE, unit="rad")


def stay_ask(key: str, first: float, last: float, lower: Sequence[float], upper: Sequence[float]) -> Ask:
    """The root stays in a box from ``lower`` to ``upper`` (3,) m, infinite on open sides."""
    box = [[None if math.isinf(x) else float(x) for x in side] for side in (lower, upper)]
    return Ask(key, "outside", first, last, {"box": box}, upper=EXACT, unit="m")
