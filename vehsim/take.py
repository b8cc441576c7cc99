"""A take: everything a shot's exporters receive. It writes beside, then moves into place."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from fractions import Fraction
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from vehsim.cameras import Camera
    from vehsim.clip import Clip
    from vehsim.world import World


@dataclass(frozen=True)
class RenderSettings:
    """How the playblast looks: ``size`` (width, height) px; ``every`` n-th frame; ``samples`` of multisampling."""

    size: tuple[int, int] = (960, 540)
    every: int = 1
    samples: int = 4
    shadows: bool = True


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


Progress = Callable[[str, float], None]
"""Called with what is being done and the fraction done, 0 to 1."""


@dataclass(frozen=True)
class Take:
    """A solved shot: clips by vehicle name, the world, cameras, and what to say about them in ``report.json``.

    ``frames``: first and last whole frame, inclusive, handles included.
    """

    name: str
    clips: dict[str, Clip]
    world: World
    cameras: tuple[Camera, ...]
    fps: Fraction
    frames: tuple[int, int]
    render: RenderSettings = RenderSettings()
    report: dict[str, Any] = field(default_factory=dict)
