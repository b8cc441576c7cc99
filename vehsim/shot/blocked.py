"""``marks = { usd = ..., prim = ... }``: an animator's blocking as a plan's marks."""

from __future__ import annotations

from fractions import Fraction
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import numpy as np
from annotated_types import Len
from pydantic import Field

from vehsim._cache import Stamp, stamp
from vehsim._quaternions import quaternions
from vehsim.errors import InputError
from vehsim.shot.model import Array, Frame, MarkTable, NotNegative, Table, Text

if TYPE_CHECKING:
    from vehsim.blocking import Blocking


class BlockingTable(Table):
    """``marks = { usd = "blocking.usda", prim = "/World/heli", ... }``."""

    usd: Text
    """a USD stage at the shot's frame rate, in any unit and up axis, relative to the shot file"""
    prim: Text
    """the path of the prim that was blocked in, such as /World/heli"""
    frames: Annotated[list[Frame], Array, Len(2, 1000)] | None = None
    """the frames that become marks; the prim's keys, or in baked motion its holds and bends, unless given"""
    use: Annotated[list[Literal["position", "heading", "orientation", "velocity", "speed"]], Array, Len(1, 5)] = Field(
        default=["position", "heading"]
    )
    """what the marks take over: "position", "heading", "orientation", "velocity", "speed\""""
    tolerance: Annotated[NotNegative, Field(le=1e6)] = 0.0
    """how far from a position is good enough, in m"""
    forward: Literal["X", "-X", "Y", "-Y", "Z", "-Z"] = "X"
    """the prim's own axis that is the vehicle's nose"""


def blocking_of(table: BlockingTable, folder: Path, fps: Fraction) -> Blocking:
    """The blocking a table names. Raises ``InputError``."""
    path = Path(table.usd).expanduser()
    path = path if path.is_absolute() else folder / path
    if not path.is_file():
        raise InputError(f"{table.usd}: no such file")
    return _read(path, table.prim, fps, table.forward, stamp(path))


@lru_cache(maxsize=16)
def _read(path: Path, prim: str, fps: Fraction, forward: str, written: Stamp) -> Blocking:
    from vehsim.blocking import read_blocking

    return read_blocking(path, prim, fps, forward)


def marks_of(table: BlockingTable, blocking: Blocking, fps: Fraction) -> list[MarkTable]:
    """Its marks, one for each frame asked for or key found. Raises ``InputError`` when there are fewer than two."""
    keys = list(blocking.keys) if table.frames is None else [(frame, 0) for frame in table.frames]
    if len(keys) < 2:
        raise InputError(f"{table.prim}: one key alone is no motion; key it again, or give frames")
    velocities, headings = blocking.velocities(fps), np.degrees(blocking.headings)
    marks = []
    for frame, held in keys:
        k = blocking.index(frame)
        known: dict[str, Any] = {
            "position": blocking.positions[k].tolist(),
            "heading": float(headings[k]),
            "orientation": quaternions(blocking.rotations[k]).tolist(),
            "velocity": velocities[k].tolist(),
            "speed": float(np.linalg.norm(velocities[k])),
        }
        mark = {"frame": frame} | {name: known[name] for name in table.use}
        if table.tolerance and "position" in table.use:
            mark["tolerance"] = table.tolerance
        if held:
            mark |= {"hold": held, "velocity": [0.0, 0.0, 0.0]}
            mark.pop("speed", None)
        marks.append(MarkTable(**mark))
    return marks
