"""A take: everything that a shot's exporters receive. `folders.py` writes the files."""

from __future__ import annotations

import hashlib
import re
import shutil
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, fields, is_dataclass, replace
from fractions import Fraction
from pathlib import Path
from typing import TYPE_CHECKING, Any

from vehsim.delivery.exporters import (
    REPORT_GROUP,
    Exporter,
    check_ready,
    delivering,
    exporter_for,
    find_exporter,
    point_at_newest,
    write_files,
)
from vehsim.delivery.folders import SIGN, may_replace, staging
from vehsim.runtime.progress import Progress, silent
from vehsim.runtime.registry import entries

if TYPE_CHECKING:
    from vehsim.cameras.camera import Camera
    from vehsim.clip.clip import Clip
    from vehsim.rig.blocking import Blocking
    from vehsim.world.world import World


PANEL_GAP = 4
"""Pixels between two pictures side by side."""


@dataclass(frozen=True)
class RenderSettings:
    """Settings for pictures: ``size`` (width, height) px; ``every`` n-th frame; ``samples`` of multisampling.

    ``cameras``: names of the cameras to render; None: all of the take. ``layout`` "side-by-side" puts their pictures
    beside each other, each with its share of ``size``, with ``captions`` by camera name. ``mood``: the light,
    "afternoon", "noon", "overcast", "dusk" or "night". ``passes``: "depth", "segmentation", "flow" and "normals" in
    addition to colour; ``burn_in``: write shot, camera and frame on the pictures.
    """

    size: tuple[int, int] = (960, 540)
    every: int = 1
    samples: int = 4
    shadows: bool = True
    cameras: tuple[str, ...] | None = None
    layout: str = "separate"
    captions: Mapping[str, str] = field(default_factory=dict)
    mood: str = "afternoon"
    passes: tuple[str, ...] = ()
    burn_in: bool = False

    def panel(self, cameras: int) -> tuple[int, int]:
        """The size of each of ``cameras`` pictures, px: even, as films require."""
        width, height = self.size
        if self.layout != "side-by-side":
            return width, height
        return (width - PANEL_GAP * (cameras - 1)) // cameras // 2 * 2, height

    def draft(self) -> RenderSettings:
        """Fast settings: half the size, no shadows."""
        width, height = (max(16, side // 4 * 2) for side in self.size)
        return replace(self, size=(width, height), samples=0, shadows=False)


@dataclass(frozen=True)
class UsdSettings:
    """The form of the stage: ``up_axis`` and ``meters_per_unit`` of everything that is written.

    ``assets``: "copy" them, or "keep" their paths; ``outside``: "copy" files outside their folders that they refer to,
    or "refuse" them. ``shutter``: frames at which it opens and closes; it adds the samples for motion blur. ``thin`` m:
    adds a variant with the fewest keys within this tolerance. ``curves`` (m, degrees): adds a variant with splines
    within these tolerances; without an angle, `curve_tolerances` chooses it. ``clip_frames``: value clips of that many
    frames.
    ``layer_only``: write only the vehicles' animation layers. ``tyre_marks``: those of sliding tyres on the ground.
    ``spray``: with the water's spray, which takes nearly half of its time. ``moving_water``: else the water has only
    the surface of the first frame, without wakes and foam, which take most of the rest.
    """

    up_axis: str = "Z"
    meters_per_unit: float = 1.0
    assets: str = "copy"
    outside: str = "refuse"
    shutter: tuple[float, float] | None = None
    thin: float | None = None
    curves: tuple[float, float | None] | None = None
    clip_frames: int | None = None
    layer_only: bool = False
    tyre_marks: bool = True
    versions: bool = False
    spray: bool = True
    moving_water: bool = True


@dataclass(frozen=True)
class Take:
    """A solved shot: clips by vehicle name, the world, cameras, and the content of ``report.json``.

    ``frames``: first and last whole frame, inclusive, with handles; ``blockings``: the animator's own motion, by
    vehicle name; ``cuts``: first frames and camera names of the cut list.
    """

    name: str
    clips: dict[str, Clip]
    world: World
    cameras: tuple[Camera, ...]
    fps: Fraction
    frames: tuple[int, int]
    render: RenderSettings = RenderSettings()
    usd: UsdSettings = UsdSettings()
    report: dict[str, Any] = field(default_factory=dict)
    blockings: dict[str, Blocking] = field(default_factory=dict)
    cuts: tuple[tuple[int, str], ...] = ()
    recalled: bool = False
    """Whether the motion comes from the cache"""
    retouches: Path | None = None
    """The folder of the delivery that it retouches, whose curves stay where they still show the motion"""

    @property
    def content_hash(self) -> str:
        """A hash of what is shown: motion, rigs, world and cameras, but not the form of stages and pictures."""
        rigs = {clip.vehicle.name: clip.vehicle.rig for clip in self.clips.values()}
        looks = {name: [rig.asset.read_bytes(), rig.variants] for name, rig in rigs.items() if rig is not None}
        world = (self.world.content_hash, self.world.looks)
        parts = (self.name, self.clips, looks, world, self.cameras, self.fps, self.frames)
        digest = hashlib.sha256()
        _feed(digest, parts)
        return digest.hexdigest()

    def export(
        self,
        out: str | Path,
        to: Sequence[str] = ("usd",),
        progress: Progress | None = None,
        overwrite: bool = True,
        starting: Callable[[Exporter], None] = lambda exporter: None,
    ) -> Path:
        """Write the take to ``out/<name>/`` with the exporters ``to``, and describe the delivery in ``report.json``.

        Everything is written into a hidden folder and renamed at the end, so an earlier delivery stays complete until
        then, also after an error. Files of other exporters' earlier deliveries stay; those of another motion are set
        apart in ``earlier/``, with a warning. ``starting`` is called with each exporter before it runs. Raises
        ``InputError`` for unknown exporters, ``ExportError`` for files that cannot be written.
        """
        to = (to,) if isinstance(to, str) else tuple(to)
        check_ready(to, self.usd.layer_only)
        target = Path(out) / self.name
        if self.usd.layer_only and to == ("usd",) and not self.usd.versions and not (target / SIGN).is_file():
            return self._export_layers(target, overwrite, progress or silent)
        with delivering(target, self.usd.versions, overwrite) as folder:
            written = write_files(self, folder, to, progress or silent, starting=starting)
            write_reports(self, folder, written)
        return point_at_newest(target) if self.usd.versions else target

    def _export_layers(self, target: Path, overwrite: bool, progress: Progress) -> Path:
        """Write the layers alone: each takes the place of an earlier one of its name; there is no report."""
        may_replace(target, overwrite)
        with staging(target) as folder:
            for path in write_files(self, folder, ("usd",), progress)["usd"]:
                _move(path, target / path.relative_to(folder))
        return target


def write_reports(take: Take, folder: Path, written: Mapping[str, Sequence[Path]]) -> None:
    """Report the delivery through every entry point of the group; the first one writes ``report.json``.

    ``written``: the files of each exporter.
    """
    inputs = take.report.get("inputs")
    made = {
        name: {"inputs": inputs, "files": [path.relative_to(folder).as_posix() for path in paths]}
        for name, paths in written.items()
    }
    take = replace(take, report={**take.report, "content": take.content_hash, "exporters": made})
    files = sorted({path for paths in written.values() for path in paths})
    for entry in entries(REPORT_GROUP):
        entry.load()(take, folder, files)


def export_clip(clip: Clip, path: Path, to: str | Sequence[str] | None = None) -> Path:
    """Write one clip in empty space, on level ground if it rolls, with a chase camera.

    ``path`` gives its name, its suffix or ``to`` the exporter. Exporters with several files write them beside ``path``.
    Returns the file for ``path``. Raises ``InputError`` for an unknown suffix or exporter, ``ExportError`` for files
    that cannot be written.
    """
    names = [exporter_for(path).name] if to is None else [to] if isinstance(to, str) else list(to)
    suffixes = {suffix for name in names for suffix in find_exporter(name).suffixes}
    take = _take_of(clip, re.sub(r"\W|^(?=\d)", "_", path.stem) or "clip")
    with staging(path) as folder:
        files = {file for paths in write_files(take, folder, names, silent).values() for file in paths}
        moved = {
            file.relative_to(folder): _move(file, path.parent / file.relative_to(folder)) for file in sorted(files)
        }
    tops = [file for relative, file in moved.items() if len(relative.parts) == 1]
    return next((file for file in tops if file.suffix in suffixes), (tops or list(moved.values()))[0])


def _feed(digest: Any, value: Any) -> None:
    """Add a value to a hash: arrays by their bytes, tables by their items, dataclasses by the fields that are compared,
    vehicles by their name."""
    if hasattr(value, "tobytes"):
        digest.update(f"{value.dtype}{value.shape}".encode() + value.tobytes())
    elif isinstance(value, Mapping):
        _feed(digest, sorted(value.items()))
    elif is_dataclass(value):
        for part in filter(lambda part: part.compare, fields(value)):
            inner = getattr(value, part.name)
            _feed(digest, inner.name if part.name == "vehicle" else inner)
    elif isinstance(value, list | tuple):
        digest.update(f"{len(value)} of".encode())
        for item in value:
            _feed(digest, item)
    else:
        digest.update(f"{value!r};".encode())


def _move(source: Path, target: Path) -> Path:
    target.parent.mkdir(parents=True, exist_ok=True)
    return Path(shutil.move(source, target))


def _take_of(clip: Clip, name: str) -> Take:
    from vehsim.cameras.camera import CameraRig
    from vehsim.cameras.framing import solve_camera
    from vehsim.world.world import World

    frames, world, clips = (clip.start_frame, clip.end_frame), World(), {name: clip}
    camera = solve_camera(CameraRig(), clips, world, frames)
    return Take(name, clips, world, (camera,), clip.fps, frames)
