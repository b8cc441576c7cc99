"""A clip's work in steps, for render farms: plan, bake, render a part of the frames, deliver.

Every step reads what the one before it left below ``DIR/.job/<clip>/`` and leaves its own whole, with the hash of every
file, or not at all; done twice, it finds itself done. What is delivered in the end has the bytes of ``vehsim export``.
"""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

from vehsim.batch.inputs import fingerprint, is_finished
from vehsim.batch.task import Task, measure
from vehsim.delivery import (
    SIGN,
    delivering,
    in_order,
    newest,
    point_at_newest,
    replacing,
    write_files,
    write_reports,
)
from vehsim.errors import ExportError, InputError
from vehsim.shot import Shot
from vehsim.take import Exporter, Progress, Take

if TYPE_CHECKING:
    from vehsim.clip import Clip

HIDDEN = ".job"
Step = Callable[[Task, tuple[int, int]], None]


def run_step(name: str, clips: Path, index: int, part: tuple[int, int] = (1, 1)) -> str:
    """Do a step of the clip at ``index`` of a file that ``vehsim job`` wrote. Returns the clip's name.

    ``part``: which of how many shares of the frames to render. Raises ``InputError``, ``SolveError``, ``ExportError``.
    """
    task = _read(clips, index)
    if fingerprint(_shot(task), task.to, task.draft) != task.inputs:
        raise InputError(f"{task.source}: its files or vehsim itself changed since the job was written; write it again")
    if name == "measure" or not is_finished(newest(task.target), task.inputs, task.to):
        STEPS[name](task, part)
    return task.name


def draws(to: Sequence[str]) -> bool:
    """Do these exporters need pictures?"""
    return any(exporter.name == "png" for exporter in in_order(to))


def _read(clips: Path, index: int) -> Task:
    try:
        rows = json.loads(clips.read_text(encoding="utf-8"))["clips"]
        row = rows[index]
        return Task(**(row | {"to": tuple(row["to"])}))
    except (OSError, ValueError, KeyError, IndexError, TypeError) as error:
        text = f"{clips}: no clip {index} in it ({type(error).__name__}: {error}); give a file that vehsim job wrote"
        raise InputError(text) from None


def _shot(task: Task) -> Shot:
    return Shot.from_dict(task.shot, task.folder, task.source)


def _place(task: Task, name: str) -> Path:
    return Path(task.out) / HIDDEN / task.name / name


@contextmanager
def _whole(task: Task, name: str) -> Iterator[Path | None]:
    """A folder for a step's files, sealed and moved into place when the block ends; None when it was done before."""
    from vehsim.exporters.report import sha256

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
        raise ExportError(f"{folder}: not there, or not whole; run the step {step!r} of {task.name} first")
    return folder


def _plan(task: Task, part: tuple[int, int]) -> None:
    with _whole(task, "plan") as folder:
        if folder is None:
            return
        take = _shot(task).solve(checked=task.checked, cached=task.cached)
        for name, clip in take.clips.items():
            clip.save(folder / f"{name}.npz")
        said = {"report": _plain(take.report), "frames": list(take.frames)}
        (folder / "take.json").write_text(json.dumps(said), encoding="utf-8")


def _take(task: Task) -> Take:
    """The take that was planned, from its files."""
    from vehsim.clip import Clip

    folder, shot = _need(task, "plan", "plan"), _shot(task)
    said = json.loads((folder / "take.json").read_text(encoding="utf-8"))
    clips: dict[str, Clip] = {
        table.name: Clip.load(folder / f"{table.name}.npz", shot.vehicle(table)) for table in shot.file.vehicle
    }
    return Take(
        name=shot.name,
        clips=clips,
        world=shot.world,
        cameras=shot.cameras(clips, tuple(said["frames"])),
        fps=shot.fps,
        frames=tuple(said["frames"]),
        render=shot.render.draft() if task.draft else shot.render,
        report={**said["report"], "inputs": task.inputs},
        usd=shot.usd,
        blockings=shot.blockings(),
    )


def _bake(task: Task, part: tuple[int, int]) -> None:
    """With pictures to come, the stage they are drawn from; without, the delivery."""
    if not draws(task.to):
        _deliver(task, part)
        return
    with _whole(task, "bake") as folder:
        if folder is not None:
            write_files(_take(task), folder, ["usd"], _silent)


def _render(task: Task, part: tuple[int, int]) -> None:
    from vehsim.exporters.frames import look_of, render_stage

    stage = _need(task, "bake", "bake") / f"{task.name}.usda"
    with _whole(task, f"frames.{part[0]}of{part[1]}") as folder:
        if folder is not None:
            take = _take(task)
            frames = _frames(take.frames, take.render.every)
            render_stage(stage, folder, frames=_share(frames, *part), **look_of(take))


def _deliver(task: Task, part: tuple[int, int]) -> None:
    def gather(take: Take, folder: Path, progress: Progress) -> Sequence[Path]:
        """The pictures that were rendered in parts, where one process would have put them, and their sheets."""
        from vehsim.exporters.frames import pictures_of, shown, write_sheets

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
    with delivering(take, task.target) as folder:
        written = write_files(take, folder, task.to, _silent, {"png": Exporter("png", (".png",), gather, ("usd",))})
        write_reports(take, folder, written)
    if take.usd.versions:
        point_at_newest(task.target, in_order(task.to))
    shutil.rmtree(_place(task, "plan").parent, ignore_errors=True)
    with suppress(OSError):  # other clips are still at it
        (Path(task.out) / HIDDEN).rmdir()


def _frames(ends: tuple[int, int], every: int) -> list[int]:
    return list(range(ends[0], ends[1] + 1, every))


def _share(frames: Sequence[int], k: int, count: int) -> list[int]:
    """The ``k``-th (from 1) of ``count`` runs of consecutive frames, as even as can be."""
    return list(frames[len(frames) * (k - 1) // count : len(frames) * k // count])


def _number(path: Path) -> int:
    """The frame in a file's name; -1 without one."""
    number = path.stem.rpartition(".")[2]
    return int(number) if number.isdigit() else -1


def _plain(value: Any) -> Any:
    from vehsim.exporters.report import plain

    return plain(value)


def _silent(what: str, done: float) -> None:
    """Progress that nobody watches."""


STEPS: dict[str, Step] = {
    "measure": lambda task, part: measure(task),
    "plan": _plan,
    "bake": _bake,
    "render": _render,
    "deliver": _deliver,
}
