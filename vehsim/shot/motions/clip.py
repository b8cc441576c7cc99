"""``method = "clip"``: a motion saved before, as it is."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING, Any, Literal

from vehsim.errors import InputError, Problem
from vehsim.shot.checks import Context
from vehsim.shot.schema.tables import Table, Text

if TYPE_CHECKING:
    from vehsim.clip.clip import Clip
    from vehsim.runtime.progress import Progress
    from vehsim.vehicles import Vehicle


class ClipMotion(Table):
    """``method = "clip"``: a motion saved before, as it is."""

    method: Literal["clip"]
    """plan, simulate, sticks, integrate, sinusoid or clip"""
    path: Text
    """a clip saved by vehsim (.npz), relative to the shot file"""

    def check(self, vehicle: Vehicle, context: Context) -> Iterator[Problem]:
        yield from check_clip("path", self.path, vehicle, context)

    def solve(self, vehicle: Vehicle, context: Context, progress: Progress) -> tuple[Clip, dict[str, Any]]:
        return load_clip(self.path, vehicle, context), {"path": self.path}


def check_clip(key: str, path: str, vehicle: Vehicle, context: Context) -> Iterator[Problem]:
    """What is wrong with the clip at ``path``, the value of ``key``."""
    try:
        clip = load_clip(path, vehicle, context)
    except InputError as error:
        yield error.problem.seen_from(key, path, "give a file written by clip.save or the npz exporter")
        return
    if clip.fps != context.fps:
        remedy = f"set shot.fps = {str(clip.fps)!r}, or bake the clip at the shot's rate"
        yield Problem(key, f"the clip runs at {clip.fps} frames per second, the shot at {context.fps}", remedy, path)


def load_clip(given: str, vehicle: Vehicle, context: Context) -> Clip:
    """The clip of a vehicle at a path relative to the shot file. Raises ``InputError``."""
    from vehsim.clip.clip import Clip

    path = context.folder / given
    if not path.is_file():
        raise InputError("no such file")
    clip = Clip.load(path, vehicle)
    if clip.controls.shape[1] != len(vehicle.controls) or clip.joints.shape[1] != len(vehicle.joints):
        raise InputError(f"a clip of another vehicle than {vehicle.name!r}")
    return clip
