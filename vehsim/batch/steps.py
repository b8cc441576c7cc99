"""A clip's work in steps, for render farms: plan, bake, render a part of the frames, deliver.

Every step reads the results of the previous one below ``DIR/.job/<clip>/`` and writes its own atomically, with the hash
of every file; a finished step is not repeated. The final delivery has the bytes of ``vehsim export``.
"""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from vehsim.batch.inputs import fingerprint, is_finished
from vehsim.batch.task import Task, measure
from vehsim.delivery.exporters import Exporter, delivering, in_order, point_at_newest, write_files
from vehsim.delivery.folders import SIGN, newest, replacing
from vehsim.delivery.take import Take, write_reports
from vehsim.errors import ExportError, InputError
from vehsim.runtime.progress import Progress, silent
from vehsim.shot import Shot

if TYPE_CHECKING:
    from vehsim.clip.clip import Clip

HIDDEN = ".job"


class Step(NamedTuple):
    """A step of a clip's work. ``run`` takes the task, and the share of the frames and the number of shares; the step
    is ``shared`` if other clips need its result, so that it runs although its own clip is finished."""

    run: Callable[[Task, tuple[int, int]], None]
    shared: bool = False


def run_step(name: str, clips: Path, index: int, part: tuple[int, int] = (1, 1)) -> str:
    """Run a step of the clip at ``index`` of a file that ``vehsim job`` wrote. Returns the clip's name.

    ``part``: number of the share of the frames to render, and the number of shares. Raises ``InputError``,
    ``SolveError``, ``ExportError``.
    """
    task = _read(clips, index)
    if fingerprint(_shot(task), task.to, task.draft) != task.inputs:
        raise InputError(
            "its files or vehsim itself changed since the job was written", "write it again", file=task.source
        )
    step = STEPS[name]
    if step.shared or not is_finished(newest(task.target), task.inputs, task.to):
        step.run(task, part)
    return task.name


def draws(to: Sequence[str]) -> bool:
    """Whether these exporters need pictures."""
    return any(exporter.name == "png" for exporter in in_order(to))


def _read(clips: Path, index: int) -> Task:
    try:
        rows = json.loads(clips.read_text(encoding="utf-8"))["clips"]
        row = rows[index]
        return Task(**(row | {name: tuple(row[name]) for name in ("to", "left_out")}))
    except (OSError, ValueError, KeyError, IndexError, TypeError) as error:
        message = f"no clip {index} in it ({type(error).__name__}: {error})"
        raise InputError(message, "give a file that vehsim job wrote", file=clips) from None


def _shot(task: Task) -> Shot:
    return task.load()


def _place(task: Task, name: str) -> Path:
    return Path(task.out) / HIDDEN / task.name / name


@contextmanager
def _whole(task: Task, name: str) -> Iterator[Path | None]:
    """A folder for a step's files, renamed into place with their hashes when the block ends; None if the step is
    already done."""
    from vehsim.exporters.tables.report import sha256

    target = _place(task, name)
    if is_finished(target, task.inputs):
        yield None
        return
    with replacing(target) as folder:
        yield folder
        files = {path.relative_to(folder).as_posix(): sha256(path) for path in folder.rglob("*") if path.is_file()}
        (folder / SIGN).write_text(json.dumps({"solved": {"inputs": task.inputs}, "files": files}, sort_keys=True))


def _need(task: Task, name: str, step: str) -> Path:
    folder = _place(task, name)
    if not is_finished(folder, task.inputs):
        raise ExportError("missing or incomplete", f"run the step {step!r} of {task.name} first", file=folder)
    return folder


def _plan(task: Task, part: tuple[int, int]) -> None:
    with _whole(task, "plan") as folder:
        if folder is None:
            return
        take = _shot(task).solve(checked=task.checked, cached=task.cached)
        for name, clip in take.clips.items():
            clip.save(folder / f"{name}.npz")
        planned = {"report": _plain(take.report), "frames": list(take.frames)}
        (folder / "take.json").write_text(json.dumps(planned), encoding="utf-8")


def _take(task: Task) -> Take:
    """The planned take, from its files."""
    from vehsim.clip.clip import Clip

    folder, shot = _need(task, "plan", "plan"), _shot(task)
    planned = json.loads((folder / "take.json").read_text(encoding="utf-8"))
    clips: dict[str, Clip] = {
        table.name: Clip.load(folder / f"{table.name}.npz", shot.vehicle(table)) for table in shot.file.vehicle
    }
    return Take(
        name=shot.name,
        clips=clips,
        world=shot.world,
        cameras=shot.cameras(clips, tuple(planned["frames"])),
        fps=shot.fps,
        frames=tuple(planned["frames"]),
        render=shot.render.draft() if task.draft else shot.render,
        report={**planned["report"], "inputs": task.inputs},
        usd=shot.usd,
        blockings=shot.blockings(),
    )


def _bake(task: Task, part: tuple[int, int]) -> None:
    """If pictures follow, write the stage for them; otherwise the delivery."""
    if not draws(task.to):
        _deliver(task, part)
        return
    with _whole(task, "bake") as folder:
        if folder is not None:
            write_files(_take(task), folder, ["usd"], silent)


def _render(task: Task, part: tuple[int, int]) -> None:
    from vehsim.exporters.pictures.frames import draw_stage, look_of

    stage = _need(task, "bake", "bake") / f"{task.name}.usda"
    with _whole(task, f"frames.{part[0]}of{part[1]}") as folder:
        if folder is not None:
            take = _take(task)
            frames = _frames(take.frames, take.render.every)
            draw_stage(stage, folder, frames=_share(frames, *part), **look_of(take))


def _deliver(task: Task, part: tuple[int, int]) -> None:
    def gather(take: Take, folder: Path, progress: Progress) -> Sequence[Path]:
        """The pictures that were rendered in parts, at the places of a single process, and their contact sheets."""
        from vehsim.exporters.pictures.frames import pictures_of, shown, write_sheets

        written = []
        shares = [_need(task, f"frames.{k}of{part[1]}", "render") for k in range(1, part[1] + 1)]
        for camera in shown(take):
            for share in shares:
                for path in sorted((path for path in (share / camera).rglob("*") if path.is_file()), key=_number):
                    place = folder / "frames" / path.relative_to(share)
                    place.parent.mkdir(parents=True, exist_ok=True)
                    written.append(Path(shutil.copy(path, place)))
        return written + write_sheets(take, folder, pictures_of(written))

    take = _take(task)
    with delivering(task.target, take.usd.versions) as folder:
        written = write_files(take, folder, task.to, silent, {"png": Exporter("png", (".png",), gather, ("usd",))})
        write_reports(take, folder, written)
    if take.usd.versions:
        point_at_newest(task.target)
    shutil.rmtree(_place(task, "plan").parent, ignore_errors=True)
    with suppress(OSError):  # other clips are still running
        (Path(task.out) / HIDDEN).rmdir()


def _frames(ends: tuple[int, int], every: int) -> list[int]:
    return list(range(ends[0], ends[1] + 1, every))


def _share(frames: Sequence[int], k: int, count: int) -> list[int]:
    """The ``k``-th (from 1) of ``count`` runs of consecutive frames, as even as possible."""
    return list(frames[len(frames) * (k - 1) // count : len(frames) * k // count])


def _number(path: Path) -> int:
    """The frame in a file's name; -1 if there is none."""
    number = path.stem.rpartition(".")[2]
    return int(number) if number.isdigit() else -1


def _plain(value: Any) -> Any:
    from vehsim.exporters.tables.report import plain

    return plain(value)


STEPS: dict[str, Step] = {
    "measure": Step(lambda task, part: measure(task), shared=True),
    "plan": Step(_plan),
    "bake": Step(_bake),
    "render": Step(_render),
    "deliver": Step(_deliver),
}
