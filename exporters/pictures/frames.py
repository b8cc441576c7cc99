"""The png exporter: numbered frames per camera, their passes and a contact sheet, rendered from the exported stage."""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

from numpy.typing import NDArray

from vehsim.delivery.exporters import Exporter
from vehsim.delivery.take import Take
from vehsim.errors import ExportError, InputError
from vehsim.exporters.pictures.burn_in import burned_in
from vehsim.exporters.pictures.contact_sheet import write_contact_sheet
from vehsim.exporters.pictures.motion_passes import openexr, write_exr
from vehsim.exporters.pictures.passes import LEGEND, SUFFIXES, pass_path, picture_path, write_legend
from vehsim.exporters.pictures.render import StageRenderer
from vehsim.exporters.pictures.split import write_split
from vehsim.exporters.usd.stage import StageReader
from vehsim.intake.usd import dependencies
from vehsim.runtime.files import replacing_file
from vehsim.runtime.processes import Worker, end, may_start_workers, start_server
from vehsim.runtime.progress import Progress

MAX_SIDE = 8192
"""Largest side of a picture, px: larger off-screen buffers are refused."""


def write_frames(take: Take, folder: Path, progress: Progress) -> Sequence[Path]:
    """Write ``frames/<camera>/<shot>.<camera>.<frame>.png`` and ``contact.png``; returns every file written."""
    frames = range(take.frames[0], take.frames[1] + 1, take.render.every)
    written = draw_stage(
        folder / f"{take.name}.usda", folder / "frames", frames=frames, progress=progress, **look_of(take)
    )
    return written + write_sheets(take, folder, pictures_of(written))


def pictures_of(files: Iterable[Path]) -> list[Path]:
    """The rendered files that are pictures, not passes."""
    return [path for path in files if path.parent.name not in SUFFIXES]


def shown(take: Take) -> list[str]:
    """The names of the cameras that are rendered."""
    wanted = take.render.cameras
    return [camera.name for camera in take.cameras if wanted is None or camera.name in wanted]


def look_of(take: Take) -> dict[str, Any]:
    """Arguments of `draw_stage` for a take's render settings."""
    settings, names = take.render, shown(take)
    size = settings.panel(len(names))
    look = {"shadows": settings.shadows, "samples": settings.samples, "burn_in": settings.burn_in}
    return {"camera": names or None, "size": size, "passes": settings.passes, **look}


def write_sheets(take: Take, folder: Path, pictures: Sequence[Path]) -> list[Path]:
    """Pictures composed from the ``pictures`` below ``folder/frames``: side by side, and the contact sheet of those, or
    of all."""
    written: list[Path] = []
    if take.render.layout == "side-by-side":
        written += write_split(take, folder, shown(take), range(take.frames[0], take.frames[1] + 1, take.render.every))
    if pictures:
        written.append(write_contact_sheet(written or pictures, folder / "contact.png"))
    return written


def render_stage(stage_path: str | Path, out: str | Path, **how: Any) -> list[Path]:
    """`draw_stage` for any stage, which the reader process reads first. Raises ``InputError`` also for a stage that
    cannot be read within the limits."""
    dependencies(stage_path)
    return draw_stage(stage_path, out, **how)


def draw_stage(
    stage_path: str | Path,
    out: str | Path,
    camera: str | Sequence[str] | None = None,
    frames: Iterable[int] | None = None,
    size: tuple[int, int] | None = None,
    progress: Progress | None = None,
    shadows: bool = True,
    samples: int = 4,
    processes: int | None = None,
    passes: Sequence[str] = (),
    burn_in: bool = False,
) -> list[Path]:
    """Render a stage to ``out/<camera>/<stage>.<camera>.<frame>.png``; returns the files written.

    ``camera``: one or several by name, default all; ``frames``: default those of the stage; ``size`` (width, height)
    px, default 960 x 540; ``samples`` per pixel; ``processes``: default one per core if there is enough work.
    ``passes``: any of "depth", "segmentation", "flow" and "normals", in addition to the pictures (`passes.py`);
    ``burn_in``: write stage, camera and frame on the pictures. Raises ``InputError`` for an unusable stage, camera,
    frame, size or pass, ``ExportError`` without EGL.
    """
    size = _checked_size(size or (960, 540))
    for kind in passes:
        if kind not in SUFFIXES:
            raise InputError("no such pass", f"choose from {', '.join(SUFFIXES)}", key="passes", value=kind)
    if any(SUFFIXES[kind] == ".exr" for kind in passes):
        openexr()
    stage = StageReader(stage_path)
    chosen = _cameras(stage, camera)
    wanted = _wanted(stage, frames)
    look = {"size": size, "shadows": shadows, "samples": samples, "passes": list(passes), "burn_in": burn_in}
    count = _processes(len(chosen) * len(wanted)) if processes is None else processes
    share = {"stage_path": stage_path, "out": out, "camera": chosen, "processes": 1, **look}
    with _on_workers([{**share, "frames": wanted[k::count]} for k in range(1, count)]):
        _render(stage, Path(out), chosen, wanted[::count], look, progress)
    pictures = [_path(stage, Path(out), name, frame) for name in chosen for frame in wanted]
    legends = [Path(out) / name / "segmentation" / LEGEND for name in chosen if "segmentation" in passes]
    return pictures + [pass_path(picture, kind) for kind in passes for picture in pictures] + legends


def _render(
    stage: StageReader,
    out: Path,
    cameras: Sequence[str],
    frames: Sequence[int],
    look: dict[str, Any],
    progress: Progress | None,
) -> None:
    passes, burn_in = look["passes"], look["burn_in"]
    drawn = {key: look[key] for key in ("size", "shadows", "samples")}
    saved: list[Future[None]] = []
    with StageRenderer(stage, **drawn) as renderer, ThreadPoolExecutor(1) as writer:
        for name in cameras:
            for kind in ("", *passes):
                (out / name / kind).mkdir(parents=True, exist_ok=True)
            if "segmentation" in passes:
                write_legend(renderer.prims, out / name / "segmentation")
            for k, frame in enumerate(frames):
                if progress:
                    done = k + cameras.index(name) * len(frames)
                    progress(f"frames: {name} {frame}", done / (len(cameras) * len(frames)))
                path, words = _path(stage, out, name, frame), (Path(stage.path).stem, name, f"{frame}")
                picture = renderer.render(name, frame)
                saved.append(writer.submit(_save, picture, path, words if burn_in else None))
                if passes:
                    drawings = renderer.passes(name, frame, passes)
                    saved += [writer.submit(_save, drawings[kind], pass_path(path, kind)) for kind in passes]
        for job in saved:
            job.result()


def _path(stage: StageReader, out: Path, camera: str, frame: int) -> Path:
    return picture_path(out, Path(stage.path).stem, camera, frame)


def _processes(pictures: int) -> int:
    """One per core if each has enough work to be worth its start."""
    return max(1, min(os.cpu_count() or 1, pictures // 16)) if may_start_workers() else 1


@contextmanager
def _on_workers(shares: Sequence[dict[str, Any]]) -> Iterator[None]:
    """Render ``shares``, each the arguments of `draw_stage`, on workers during this block; it ends when they have
    finished."""
    if shares:
        start_server()
    workers = [Worker(_serve, len(shares) + 1) for _ in shares]
    try:
        for worker, share in zip(workers, shares, strict=True):
            worker.give(share)
        yield
        for worker in workers:
            failure = worker.receive()
            if failure != "":
                what = failure or f"it {worker.how_it_ended()}"
                raise ExportError(f"a render process failed: {what}", "render again, or with fewer frames at once")
            worker.job = None
    finally:
        end(workers)


def _serve(pipe: Connection) -> None:
    try:
        draw_stage(**pipe.recv())
        pipe.send("")
    except Exception as error:
        pipe.send(f"{type(error).__name__}: {error}")


def _save(picture: NDArray[Any], path: Path, words: tuple[str, str, str] | None = None) -> None:
    """Write a picture atomically, so that readers never see a partial one. ``words`` are burned into it."""
    from PIL import Image

    if path.suffix == ".exr":
        with replacing_file(path) as beside:
            write_exr(picture, path.parent.name, beside)
        return
    image = Image.fromarray(picture)
    if words:
        image = burned_in(image, words)
    how: dict[str, Any] = {"format": "png", "compress_level": 2}
    if path.suffix == ".tif":
        how = {"format": "tiff", "compression": "tiff_adobe_deflate"}
    with replacing_file(path) as beside:
        image.save(beside, **how)


def _wanted(stage: StageReader, frames: Iterable[int] | None) -> list[int]:
    """The frames to render, default all of the stage's. Raises ``InputError`` for frames outside the stage."""
    first, last = stage.frames
    wanted = list(range(first, last + 1)) if frames is None else list(frames)
    beyond = [frame for frame in wanted if not first <= frame <= last]
    if beyond:
        raise InputError(
            "outside the stage", f"give frames of {first} to {last}", key="frames", value=beyond[0], file=stage.path
        )
    return wanted


def _cameras(stage: StageReader, camera: str | Sequence[str] | None) -> list[str]:
    names = sorted(stage.cameras)
    if not names:
        raise InputError("has no camera", "add one to the shot or the stage", file=stage.path)
    wanted = names if camera is None else [camera] if isinstance(camera, str) else list(camera)
    for name in wanted:
        if name not in names:
            raise InputError(
                "no such camera", f"choose one of {', '.join(names)}", key="--camera", value=name, file=stage.path
            )
    return wanted


def _checked_size(size: Sequence[int]) -> tuple[int, int]:
    if not all(isinstance(side, int) and 16 <= side <= MAX_SIDE for side in size):
        raise InputError(
            "not a picture's size",
            f"give a width and a height of 16 to {MAX_SIDE} pixels",
            key="render.size",
            value=size,
        )
    return (size[0], size[1])


exporter = Exporter(
    name="png",
    suffixes=(".png",),
    write=write_frames,
    needs=("usd",),
    makes="a picture of every frame, and a contact sheet",
    state="rendering",
    every_frame=True,
)
