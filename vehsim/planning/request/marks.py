"""Marks: what an animator requests of a motion at a given frame, or at a frame that the planner chooses."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import KW_ONLY, dataclass, field, replace
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from vehsim.errors import InputError
from vehsim.lie.quaternions import yaw_of
from vehsim.requests.mark_frame import FREE, Timed

APART = 0.5
"""Distance, m, of the places that stand for all where a vehicle may be at a mark."""
MOST_STEPS = 8
"""Largest number of them from the mark to either side."""


@dataclass(frozen=True)
class Gate:
    """An opening to pass through, around a mark's position: a ring of ``radius`` m, or ``size`` (width, height) m.

    ``direction`` (3,): the direction of passage, world axes, of any length. A rectangle's width is horizontal.
    """

    direction: Sequence[float]
    radius: float | None = None
    size: Sequence[float] | None = None

    @property
    def axes(self) -> NDArray[np.float64]:
        """Unit vectors (3, 3), as rows: the direction of passage, the width, the height."""
        through = np.asarray(self.direction, float) / np.linalg.norm(self.direction)
        level = np.cross([0.0, 0.0, 1.0], through)
        width = level / np.linalg.norm(level) if np.linalg.norm(level) > 1e-9 else np.array([0.0, 1.0, 0.0])
        return np.array([through, width, np.cross(through, width)])

    def check(self, key: str) -> None:
        """Raise ``InputError`` with the faulty key, a part of ``key``."""
        direction = np.asarray(self.direction, float)
        if direction.shape != (3,) or not np.all(np.isfinite(direction)) or not np.any(direction):
            raise InputError(
                "not a direction",
                "give three numbers that point through the gate",
                key=f"{key}.direction",
                value=self.direction,
            )
        if (self.radius is None) == (self.size is None):
            raise InputError(
                "neither radius nor size, or both", "give either a radius or a size (width, height), in metres", key=key
            )
        sizes = [self.radius] if self.size is None else list(self.size)
        if (self.size is not None and len(sizes) != 2) or not all(s is not None and 0 < s < math.inf for s in sizes):
            raise InputError(
                "not above zero",
                "give metres above zero",
                key=f"{key}.{'radius' if self.size is None else 'size'}",
                value=self.radius if self.size is None else self.size,
            )


@dataclass(frozen=True)
class Mark(Timed):
    """The position of the rig's root at a frame, and its motion there. What is ``None`` is free.

    ``frame``: a whole frame, or ``"free"``; ``position`` (3,) m; ``heading`` deg, yaw of the body's X axis from world
    X, counter-clockwise; ``orientation`` (4,) w, x, y, z; ``velocity`` (3,) m/s in world axes; ``speed`` m/s;
    ``joints`` (s,), nan where free, or a table of some joints by name; ``tolerance`` m, half the side of the box the
    position may lie in; ``hold``: frames to stay at rest there; ``gate``: an opening around the position;
    ``on_ground``: a flying vehicle stands there, at rest and level, on the terrain or obstacle below ``position``;
    ``ease``: at rest, the controls start and end gently; None: as the character of the plan says.

    At a mark with ``velocity = (0, 0, 0)`` the vehicle is at rest: its body does not turn either. Without a given
    attitude it is in balance, as it must be to stay there (a helicopter leans against its tail rotor and the wind), so
    that the motion starts and ends smoothly; without a heading, a vehicle that flies nose first faces along its leg,
    or as it comes from where a constraint points it on that leg;
    trailers stand straight at a first mark at rest, and if the vehicle rests in a bay, at all marks at rest, unless
    these give joints. If no such motion is found, both are free.
    ``speed = 0`` leaves the attitude free.
    """

    frame: int | Literal["free"]
    _: KW_ONLY
    position: Sequence[float] | None = None
    heading: float | None = None
    orientation: Sequence[float] | None = None
    velocity: Sequence[float] | None = None
    speed: float | None = None
    joints: Sequence[float] | Mapping[str, float] | None = None
    tolerance: float = 0.0
    hold: int = 0
    gate: Gate | None = None
    on_ground: bool = False
    ease: bool | None = None
    place: int = field(default=-1, repr=False, compare=False)
    """Its index among the given marks; set by the planner."""

    def __post_init__(self) -> None:
        """Keep arrays as tuples: an array has no truth value, and arrays do not compare as a whole."""
        for key in ("position", "orientation", "velocity", "joints"):
            if isinstance(given := getattr(self, key), np.ndarray):
                object.__setattr__(self, key, tuple(np.atleast_1d(given).tolist()))

    @property
    def name(self) -> str:
        """Its name in messages."""
        return f"mark[{self.place}]" if self.place >= 0 else f"frame {self.frame}"

    @property
    def at_rest(self) -> bool:
        """Whether the vehicle is at rest there."""
        return self.velocity is not None and not np.any(self.velocity)

    @property
    def moves(self) -> bool:
        """Whether the vehicle moves there, or may."""
        return not (self.at_rest or self.speed == 0 or self.on_ground or self.hold)

    @property
    def balanced(self) -> bool:
        """Whether it is at rest without a given attitude: roll and pitch then follow from balance."""
        return self.at_rest and self.orientation is None


def heading_of(mark: Any) -> float | None:
    """The yaw of the nose at a mark, rad from world X, from its heading or its orientation; None without either.

    ``mark``: a `Mark`, or a table of a shot file; marks at rest for sinusoids have no orientation.
    """
    if (orientation := getattr(mark, "orientation", None)) is not None:
        return float(yaw_of(np.asarray(orientation, float) / np.linalg.norm(orientation)))
    return None if mark.heading is None else math.radians(mark.heading)


def given_frames(marks: Sequence[Mark]) -> NDArray[np.float64]:
    """The frames of marks (n,); nan where the planner chooses."""
    return np.array([math.nan if mark.given_frame is None else mark.given_frame for mark in marks], float)


def shape(marks: Sequence[Mark]) -> tuple[Any, ...]:
    """Which quantities the marks fix, without their values: marks of equal shape share one built problem."""
    return tuple(_shape(mark) for mark in marks)


def _shape(mark: Mark) -> tuple[Any, ...]:
    keys = ("position", "heading", "orientation", "velocity", "speed", "joints")
    return (
        tuple(getattr(mark, key) is not None for key in keys),
        (mark.balanced, mark.at_rest, mark.speed == 0, mark.hold > 0, mark.on_ground),
        (mark.given_frame is None, mark.tolerance),
        _fixed(mark.joints),
        mark.gate and mark.gate.radius is None,
    )


def _fixed(joints: Sequence[float] | Mapping[str, float] | None) -> tuple[Any, ...] | None:
    """Which joints have a value: their names from a table, or a flag for each in a row."""
    if isinstance(joints, Mapping):
        return tuple(sorted(name for name, value in joints.items() if np.isfinite(value)))
    return None if joints is None else tuple(np.isfinite(np.asarray(joints, float)).tolist())


def leeway(mark: Any) -> float:
    """Largest distance of the root from the mark's position, m: to the corners of its box, or of its gate."""
    gate = getattr(mark, "gate", None)
    if gate is not None:
        return float(gate.radius or math.hypot(*gate.size) / 2)
    return float(mark.tolerance * math.sqrt(3))


def around(mark: Mark) -> tuple[NDArray[np.float64], float]:
    """Places (n, 2) m in the plane where the root may be at a mark with a position: in its box, or around its gate; and
    how far the farthest place between them is from the nearest, m. The position itself is the first."""
    half = mark.tolerance if mark.gate is None else leeway(mark)
    steps = min(math.ceil(half / APART), MOST_STEPS)
    aside = np.linspace(-half, half, 2 * steps + 1) if steps else np.zeros(1)
    grid = np.stack(np.meshgrid(aside, aside, indexing="ij"), axis=-1).reshape(-1, 2)
    grid = grid[np.argsort(np.abs(grid).max(axis=1), kind="stable")]
    return np.asarray(mark.position, float)[:2] + grid, half / max(steps, 1) / math.sqrt(2)


_SIZES = {"position": 3, "orientation": 4, "velocity": 3}


def check_marks(marks: Sequence[Mark], joints: Sequence[str]) -> list[Mark]:
    """The marks, with holds as two marks and joints as rows; ``InputError`` has the mark's key, value and the
    remedy."""
    if len(marks) < 2:
        raise InputError(f"{len(marks)} given", "a plan needs at least two, a start and a goal", key="marks")
    if marks[0].given_frame is None:
        raise InputError("the first mark starts the clip", "give it a whole frame", key="mark[0].frame", value=FREE)
    if marks[0].position is None:
        raise InputError("missing", "the first mark must say where the motion starts", key="mark[0].position")
    marks = [_at_rest(replace(mark, joints=_joint_row(i, mark, joints), place=i)) for i, mark in enumerate(marks)]
    last: int | None = None
    for i, mark in enumerate(marks):
        _check_numbers(i, mark)
        frame = mark.given_frame
        if frame is None:
            continue
        if last is not None and frame <= last:
            raise InputError(
                f"not after frame {last} before it", "put marks in order", key=f"mark[{i}].frame", value=frame
            )
        last = frame + mark.hold
    return _with_holds(marks)


def _at_rest(mark: Mark) -> Mark:
    """A mark on the ground is at rest."""
    unspecified = mark.on_ground and mark.velocity is None and mark.speed is None
    return replace(mark, velocity=(0.0, 0.0, 0.0)) if unspecified else mark


def _joint_row(i: int, mark: Mark, joints: Sequence[str]) -> tuple[float, ...] | None:
    """Joint values (s,), nan where free."""
    given: Any = mark.joints
    if given is None:
        return None
    if isinstance(given, Mapping):
        unknown = [name for name in given if name not in joints]
        if unknown:
            raise InputError(
                "no such joint", f"choose one of {', '.join(joints)}", key=f"mark[{i}].joints.{unknown[0]}"
            )
        given = [given.get(name, math.nan) for name in joints]
    if np.shape(given) != (len(joints),) or np.any(np.isinf(np.asarray(given, float))):
        raise InputError(
            "not one number per joint",
            f"give {len(joints)} numbers, nan where free",
            key=f"mark[{i}].joints",
            value=mark.joints,
        )
    return tuple(float(value) for value in given)


def _check_numbers(i: int, mark: Mark) -> None:
    frame = mark.given_frame
    if frame is not None and (isinstance(frame, bool) or not isinstance(frame, int | np.integer)):
        raise InputError("not a frame", "give a whole frame, or 'free'", key=f"mark[{i}].frame", value=frame)
    for key, size in _SIZES.items():
        values = getattr(mark, key)
        if values is not None and (np.shape(values) != (size,) or not np.all(np.isfinite(values))):
            raise InputError(
                "of the wrong shape or not finite", f"give {size} finite numbers", key=f"mark[{i}].{key}", value=values
            )
    for key in ("heading", "speed", "tolerance"):
        value = getattr(mark, key)
        if value is not None and not math.isfinite(value):
            raise InputError("not a number", "give a finite number", key=f"mark[{i}].{key}", value=value)
    for key in ("speed", "tolerance", "hold"):
        if (getattr(mark, key) or 0) < 0:
            raise InputError("negative", "give zero or more", key=f"mark[{i}].{key}", value=getattr(mark, key))
    if mark.speed is not None and mark.velocity is not None:
        raise InputError("velocity is given too", "drop one of them", key=f"mark[{i}].speed", value=mark.speed)
    if mark.orientation is not None and mark.heading is not None:
        raise InputError("orientation is given too", "drop one of them", key=f"mark[{i}].heading", value=mark.heading)
    if mark.hold and not (mark.balanced or mark.on_ground):
        heading = math.degrees(heading_of(mark) or 0.0)
        raise InputError(
            "a vehicle is at rest and in balance during a hold, so its roll and pitch cannot be given",
            f"give heading = {heading:.4g} instead of orientation" if mark.at_rest else "give velocity = [0, 0, 0]",
            key=f"mark[{i}].hold",
            value=mark.hold,
        )
    if mark.on_ground and (mark.position is None or (mark.heading is None and mark.orientation is None)):
        raise InputError(
            "a landing needs a position and a heading",
            "give the position above the ground, and a heading",
            key=f"mark[{i}].on_ground",
        )
    if mark.on_ground and (not mark.at_rest or mark.tolerance or mark.gate is not None):
        raise InputError(
            "the vehicle stands still at this mark", "drop speed, tolerance and gate", key=f"mark[{i}].on_ground"
        )
    if mark.gate is not None:
        mark.gate.check(f"mark[{i}].gate")
        if mark.position is None or mark.tolerance:
            raise InputError(
                "a gate needs a position, without a tolerance",
                "give the position, and no tolerance",
                key=f"mark[{i}].gate",
            )


def _with_holds(marks: Sequence[Mark]) -> list[Mark]:
    """The marks with each held mark twice, at both ends of its hold; the first keeps the number of frames."""
    written: list[Mark] = []
    for mark in marks:
        written.append(mark)
        if mark.hold:
            frame = mark.given_frame
            written.append(replace(mark, frame=FREE if frame is None else int(frame) + mark.hold, hold=0))
    return written


def end_of_hold(marks: Sequence[Mark], i: int) -> int:
    """The index of the mark at the end of a hold that starts at mark ``i``; ``i`` itself without a hold."""
    while marks[i].hold:
        i += 1
    return i


def with_breaks(marks: Sequence[Mark], frames: Sequence[int]) -> list[Mark]:
    """The marks, with an unconstrained mark at each of ``frames`` that has none: every such frame becomes a knot.

    Raises ``InputError`` if a frame lies among marks at free frames, which may come before or after it.
    """
    written = list(marks)
    for frame in sorted(set(frames)):
        known = [i for i, mark in enumerate(written) if mark.given_frame is not None]
        if any(written[i].frame == frame for i in known):
            continue
        before = [i for i in known if int(written[i].frame) < frame]
        after = [i for i in known if int(written[i].frame) > frame]
        if not before:
            raise InputError(
                f"before the first mark, at frame {written[0].frame}", "give a later one", key="frames", value=frame
            )
        if after and after[0] > before[-1] + 1:
            raise InputError(
                f"before or after the free marks between frames {written[before[-1]].frame} and "
                f"{written[after[0]].frame}: unknown",
                "give these marks frames",
                key="frames",
                value=frame,
            )
        if not after and before[-1] + 1 == len(written):
            raise InputError(
                f"after the last mark, at frame {written[-1].frame}", "give an earlier one", key="frames", value=frame
            )
        if not after and before[-1] + 2 < len(written):
            raise InputError(
                f"before or after the free marks that follow frame {written[before[-1]].frame}: unknown",
                "give these marks frames",
                key="frames",
                value=frame,
            )
        earlier, place, added = written[before[-1]], before[-1] + 1, Mark(frame)
        if earlier.hold:  # it divides a hold in two
            passed = frame - int(earlier.frame)
            written[place - 1] = replace(earlier, hold=passed)
            added = replace(earlier, frame=frame, hold=earlier.hold - passed, place=-1)
        written.insert(place, added)
    return written
