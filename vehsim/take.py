"""A take: everything a shot's exporters receive. How files come into being is in `delivery.py`."""

from __future__ import annotations

import hashlib
import re
import shutil
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, fields, is_dataclass, replace
from fractions import Fraction
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from vehsim.blocking import Blocking
    from vehsim.cameras import Camera
    from vehsim.clip import Clip
    from vehsim.world import World


PANEL_GAP = 4
"""Pixels between two pictures side by side."""


@dataclass(frozen=True)
class RenderSettings:
    """How the playblast looks: ``size`` (width, height) px; ``every`` n-th frame; ``samples`` of multisampling.

    ``cameras``: the names of those to render, all of the take's when None. ``layout`` "side-by-side" puts their
    pictures together, each as wide as its share of ``size``, with ``captions`` by camera name. ``mood``: the light,
    "afternoon" or "dusk". ``passes``: "depth" and "segmentation" beside the pictures; ``burn_in``: shot, camera and
    frame written on them.
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
        """The size of one of ``cameras`` pictures, px: even, as films want them."""
        width, height = self.size
        if self.layout != "side-by-side":
            return width, height
        return (width - PANEL_GAP * (cameras - 1)) // cameras // 2 * 2, height

    def draft(self) -> RenderSettings:
        """Quick to render: half the size, no shadows."""
        width, height = (max(16, side // 4 * 2) for side in self.size)
        return replace(self, size=(width, height), samples=0, shadows=False)


@dataclass(frozen=True)
class UsdSettings:
    """How the stage is delivered: ``up_axis`` and ``meters_per_unit`` of all that is written.

    ``assets``: "copy" them along, or "keep" them where they are; ``outside``: "copy" what they refer to outside their
    folders too, or "refuse" it. ``shutter``: frames from and to which it is open; it
    adds the samples motion blur needs. ``thin`` m: a variant with the fewest keys that stay within it.
    ``clip_frames``: value clips of that many frames. ``layer_only``: the vehicles' animation layers and nothing else.
    """

    up_axis: str = "Z"
    meters_per_unit: float = 1.0
    assets: str = "copy"
    outside: str = "refuse"
    shutter: tuple[float, float] | None = None
    thin: float | None = None
    clip_frames: int | None = None
    layer_only: bool = False
    versions: bool = False


@dataclass(frozen=True)
class Exporter:
    """A way to write a take. ``write(take, folder, progress)`` returns the files it wrote below ``folder``.

    ``needs`` names exporters whose files this one reads back from ``folder`` (pictures are rendered from the USD that
    ships); the take runs them first and drops their files again when they were not asked for.
    """

    name: str
    suffixes: tuple[str, ...]
    write: Callable[[Take, Path, Progress], Sequence[Path]]
    needs: tuple[str, ...] = ()
    latest: Callable[[Path, Path], None] | None = None
    """``latest(version, home)`` points what stands in ``home`` at its newest version"""
    makes: str = ""
    """What it makes, in a few words: shown by ``vehsim export --help``"""
    every_frame: bool = False
    """It renders every frame of every camera: minutes for a long shot"""


Progress = Callable[[str, float], None]
"""Called with what is being done and the fraction done, 0 to 1."""


@dataclass(frozen=True)
class Take:
    """A solved shot: clips by vehicle name, the world, cameras, and what to say about them in ``report.json``.

    ``frames``: first and last whole frame, inclusive, handles included; ``blockings``: the animator's own motion of
    vehicles that were blocked in, by name.
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
    recalled: bool = False
    """The motion is from the cache: it was solved before"""

    @property
    def content_hash(self) -> str:
        """Names what is shown: motion, rigs, world and cameras, not how stages are written or pictures look."""
        rigs = {clip.vehicle.name: clip.vehicle.rig for clip in self.clips.values()}
        looks = {name: [rig.asset.read_bytes(), rig.variants] for name, rig in rigs.items() if rig is not None}
        parts = (self.name, self.clips, looks, self.world.content_hash, self.cameras, self.fps, self.frames)
        digest = hashlib.sha256()
        _feed(digest, parts)
        return digest.hexdigest()

    def export(
        self,
        out: str | Path,
        to: Sequence[str] = ("usd",),
        progress: Progress | None = None,
        overwrite: bool = True,
    ) -> Path:
        """Write the take to ``out/<name>/`` through the exporters ``to``, and say in ``report.json`` what was done.

        Everything is written beside and moved into place at the end: an earlier delivery stays whole until then, and
        whatever goes wrong. Files that other exporters delivered earlier stay; those of another motion are set apart in
        ``earlier/``, with a warning. Raises ``InputError`` for unknown exporters, ``ExportError`` for what cannot be
        written.
        """
        from vehsim.delivery import (
            check_stage_is_there,
            delivering,
            in_order,
            point_at_newest,
            write_files,
            write_reports,
        )

        to = (to,) if isinstance(to, str) else tuple(to)
        in_order(to)
        check_stage_is_there(to, self.usd.layer_only)
        target = Path(out) / self.name
        with delivering(self, target, overwrite) as folder:
            written = write_files(self, folder, to, progress or _silent)
            write_reports(self, folder, written)
        return point_at_newest(target, in_order(to)) if self.usd.versions else target


def export_clip(clip: Clip, path: Path, to: str | Sequence[str] | None = None) -> Path:
    """Write one clip in empty space, seen by a chase camera; ``path`` names it, its suffix or ``to`` the exporter.

    Exporters that write several files put them beside ``path``. Returns the file that ``path`` asked for. Raises
    ``InputError`` for an unknown suffix or exporter, ``ExportError`` for what cannot be written.
    """
    from vehsim.delivery import exporter_for, find_exporter, staging, write_files

    names = [exporter_for(path).name] if to is None else [to] if isinstance(to, str) else list(to)
    suffixes = {suffix for name in names for suffix in find_exporter(name).suffixes}
    take = _take_of(clip, re.sub(r"\W|^(?=\d)", "_", path.stem) or "clip")
    with staging(path) as folder:
        files = {file for paths in write_files(take, folder, names, _silent).values() for file in paths}
        moved = {
            file.relative_to(folder): _move(file, path.parent / file.relative_to(folder)) for file in sorted(files)
        }
    tops = [file for relative, file in moved.items() if len(relative.parts) == 1]
    return next((file for file in tops if file.suffix in suffixes), (tops or list(moved.values()))[0])


def _feed(digest: Any, value: Any) -> None:
    """Add a value to a hash: arrays by their bytes, tables and dataclasses by their fields, vehicles by their name."""
    if hasattr(value, "tobytes"):
        digest.update(f"{value.dtype}{value.shape}".encode() + value.tobytes())
    elif isinstance(value, Mapping):
        _feed(digest, sorted(value.items()))
    elif is_dataclass(value):
        for part in fields(value):
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
    from vehsim.cameras import CameraRig, solve_camera
    from vehsim.world import World

    frames, world, clips = (clip.start_frame, clip.end_frame), World(), {name: clip}
    camera = solve_camera(CameraRig(), clips, world, frames)
    return Take(name, clips, world, (camera,), clip.fps, frames)


def _silent(what: str, done: float) -> None:
    """Progress that nobody watches."""
