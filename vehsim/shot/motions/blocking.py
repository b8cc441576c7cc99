"""``marks = { usd = ..., prim = ... }``: an animator's blocking as a plan's marks."""

from __future__ import annotations

from fractions import Fraction
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import numpy as np
from annotated_types import Len
from pydantic import Field

from vehsim.errors import InputError
from vehsim.lie.quaternions import quaternions
from vehsim.runtime.cache import Stamp, stamp
from vehsim.shot.schema.tables import Array, Frame, MarkTable, NotNegative, Table, Text

if TYPE_CHECKING:
    from vehsim.rig.blocking import Blocking


class BlockingTable(Table):
    """``marks = { usd = "blocking.usda", prim = "/World/heli", ... }``."""

    usd: Text
    """a USD stage at the shot's frame rate, in any unit and up axis, relative to the shot file"""
    prim: Text
    """the path of the animated prim, such as /World/heli"""
    frames: Annotated[list[Frame], Array, Len(2, 1000)] | None = None
    """the frames that become marks; default: the prim's keys or, in baked motion, its holds and bends"""
    use: Annotated[list[Literal["position", "heading", "orientation", "velocity", "speed"]], Array, Len(1, 5)] = Field(
        default=["position", "heading"]
    )
    """the values that the marks use: "position", "heading", "orientation", "velocity", "speed\""""
    tolerance: Annotated[NotNegative, Field(le=1e6)] = 0.0
    """the permitted distance from a position, in m"""
    forward: Literal["X", "-X", "Y", "-Y", "Z", "-Z"] = "X"
    """the prim's own axis that points to the vehicle's nose"""
    edit: bool = False
    """true: the prim is the vehicle of a delivery whose curves an animator changed; the motion through mark becomes the
    nearest one that the vehicle can make"""


def blocking_of(table: BlockingTable, folder: Path, fps: Fraction) -> Blocking:
    """The blocking that a table names. Raises ``InputError``."""
    path = Path(table.usd).expanduser()
    path = path if path.is_absolute() else folder / path
    if not path.is_file():
        raise InputError("no such file", file=table.usd)
    return _read(path, table.prim, fps, table.forward, stamp(path))


@lru_cache(maxsize=16)
def _read(path: Path, prim: str, fps: Fraction, forward: str, written: Stamp) -> Blocking:
    from vehsim.rig.blocking import read_blocking

    return read_blocking(path, prim, fps, forward)


def marks_of(table: BlockingTable, blocking: Blocking, fps: Fraction) -> list[MarkTable]:
    """Its marks, one for each requested frame or key. Raises ``InputError`` if there are fewer than two."""
    keys = list(blocking.keys) if table.frames is None else [(frame, 0) for frame in table.frames]
    if len(keys) < 2:
        raise InputError("one key is no motion", "add keys, or give frames", key=table.prim)
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
