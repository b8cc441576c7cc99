"""The png exporter: numbered frames per camera and a contact sheet, rendered from the exported stage."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from vehsim.errors import InputError
from vehsim.exporters.contact import write_contact_sheet
from vehsim.exporters.render import StageRenderer
from vehsim.exporters.stage import StageReader
from vehsim.take import Exporter, Progress, Take

MAX_SIDE = 8192
"""Largest side of a picture, px: beyond it off-screen buffers are refused."""


def write_frames(take: Take, folder: Path, progress: Progress) -> Sequence[Path]:
    """Write ``frames/<camera>/<shot>.<camera>.<frame>.png`` and ``contact.png``; returns every file written."""
    settings = take.render
    frames = range(take.frames[0], take.frames[1] + 1, settings.every)
    written = render_stage(
        folder / f"{take.name}.usda",
        folder / "frames",
        frames=frames,
        size=settings.size,
        progress=progress,
        shadows=settings.shadows,
        samples=settings.samples,
    )
    if written:
        written.append(write_contact_sheet(written, folder / "contact.png"))
    return written


def render_stage(
    stage_path: str | Path,
    out: str | Path,
    camera: str | None = None,
    frames: Iterable[int] | None = None,
    size: tuple[int, int] | None = None,
    progress: Progress | None = None,
    shadows: bool = True,
    samples: int = 4,
) -> list[Path]:
    """Render a stage to ``out/<camera>/<stage>.<camera>.<frame>.png``; returns the files written.

    ``camera``: one by name, all when None; ``frames``: those of the stage when None; ``size`` (width, height) px,
    960 x 540 when None; ``samples`` a pixel. Raises ``InputError`` for a stage, camera or size that will not do,
    ``ExportError`` without EGL.
    """
    size = _checked_size(size or (960, 540))
    stage = StageReader(stage_path)
    chosen = _cameras(stage, camera)
    wanted = list(range(stage.frames[0], stage.frames[1] + 1)) if frames is None else list(frames)
    shot = Path(stage_path).stem
    written: list[Path] = []
    total = len(chosen) * len(wanted)
    with StageRenderer(stage, size, shadows, samples) as renderer, ThreadPoolExecutor(1) as writer:
        saved = []
        for name in chosen:
            folder = Path(out) / name
            folder.mkdir(parents=True, exist_ok=True)
            for frame in wanted:
                if progress:
                    progress(f"frames: {name} {frame}", len(written) / total)
                path = folder / f"{shot}.{name}.{frame:04d}.png"
                saved.append(writer.submit(_save, renderer.render(name, frame), path))
                written.append(path)
        for job in saved:
            job.result()
    return written


def _save(picture: NDArray[np.uint8], path: Path) -> None:
    from PIL import Image

    Image.fromarray(picture).save(path, compress_level=2)


def _cameras(stage: StageReader, camera: str | None) -> list[str]:
    names = sorted(stage.cameras)
    if not names:
        raise InputError(f"{stage.path}: has no camera; add one to the shot or the stage")
    if camera is not None and camera not in names:
        raise InputError(f"{stage.path}: --camera {camera!r}: no such camera; choose one of {', '.join(names)}")
    return names if camera is None else [camera]


def _checked_size(size: tuple[int, int]) -> tuple[int, int]:
    if not all(isinstance(side, int) and 16 <= side <= MAX_SIDE for side in size):
        raise InputError(f"render.size = {size!r}: give a width and a height of 16 to {MAX_SIDE} pixels")
    return size


exporter = Exporter(name="png", suffixes=(".png",), write=write_frames, needs=("usd",))
