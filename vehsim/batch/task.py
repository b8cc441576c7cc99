"""One clip's work: from a task to an outcome; the clip's folder is either complete or absent.

A task is plain data that can be sent to another process or machine. The work, and so the bytes, are the same
everywhere.
"""

from __future__ import annotations

import threading
import time
import traceback
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from vehsim.errors import InputError, VehsimError
from vehsim.runtime.registry import whose_error

if TYPE_CHECKING:
    from vehsim.delivery.exporters import Exporter
    from vehsim.shot import Shot

State = Literal["queued", "planning", "baking", "rendering", "done", "skipped", "failed"]
Tell = Callable[[str, str, str, float], None]
"""Called with a clip's name, its state, the current work and the fraction done."""

TRACEBACK_REMEDY = "set VEHSIM_DEBUG=1 to see the traceback"
MEMORY_REMEDY = "give it fewer segments or pixels, or the worker more memory"
_ONE_AT_A_TIME = threading.Lock()


@dataclass(frozen=True)
class Task:
    """A clip to be exported to ``out/<name>/``.

    ``shot``: a shot file's data; ``inputs``: the hash of everything that determines the clip. ``field``: the hash of a
    terrain whose distance field the clip needs, and which is measured once for all clips. ``checked``: whether the shot
    was checked with these inputs. ``cached``: whether motion may come from the cache. ``left_out``: the vehicles of the
    shot that are not exported.
    """

    name: str
    shot: Mapping[str, Any]
    folder: str
    source: str
    out: str
    to: tuple[str, ...]
    inputs: str
    draft: bool = False
    resume: bool = False
    field: str | None = None
    checked: bool = False
    cached: bool = True
    left_out: tuple[str, ...] = ()

    @property
    def target(self) -> Path:
        """The folder of the clip's delivery."""
        return Path(self.out) / self.name

    def load(self) -> Shot:
        """The shot."""
        from vehsim.shot import Shot

        return Shot.from_dict(self.shot, self.folder, self.source).without(self.left_out)


@dataclass(frozen=True)
class Outcome:
    """The outcome of a clip. ``kind``: type of the error; ``seconds`` and ``detail`` are for logs, never for files."""

    name: str
    state: State
    kind: str = ""
    message: str = ""
    problems: tuple[Mapping[str, Any], ...] = ()
    """everything that is wrong, as `vehsim.errors.Problem.as_dict`"""
    frames: tuple[int, int] | None = None
    warnings: tuple[str, ...] = ()
    seconds: float = 0.0
    detail: str = ""
    retire: bool = False
    """whether its process should exit, because it ran out of memory"""
    recalled: bool = False
    """whether its motion comes from the cache"""


def prepare(
    shot: Any,
    out: Path,
    to: Sequence[str],
    draft: bool = False,
    resume: bool = False,
    checked: bool = False,
    cached: bool = True,
) -> Task:
    """The task of a shot; unless ``checked``, the shot is checked before it is solved."""
    from vehsim.batch.inputs import fingerprint

    terrain = shot.world.terrain
    return Task(
        name=shot.name,
        shot=shot.file.model_dump(mode="python", by_alias=True, exclude_unset=True),
        folder=str(shot.folder.resolve()),
        source=shot.source,
        out=str(Path(out).resolve()),
        to=tuple(to),
        inputs=fingerprint(shot, to, draft),
        draft=draft,
        resume=resume,
        field=terrain.content_hash if terrain is not None and _measures(shot) else None,
        checked=checked,
        cached=cached,
        left_out=shot.left_out,
    )


def run_task(task: Task, tell: Tell) -> Outcome:
    """Solve and write one clip, unless it is finished already (``resume``). Never raises: errors are in the outcome."""
    began, texts = time.perf_counter(), []
    with _ONE_AT_A_TIME, warnings.catch_warnings():
        warnings.simplefilter("always", UserWarning)
        warnings.showwarning = lambda message, *rest, **more: texts.append(str(message))  # type: ignore[assignment]  # restored by the context
        try:
            outcome = _work(task, tell)
        except MemoryError:
            outcome = Outcome(task.name, "failed", "MemoryError", f"it ran out of memory; {MEMORY_REMEDY}", retire=True)
        except VehsimError as error:
            problems = tuple(problem.as_dict() for problem in error.problems)
            outcome = Outcome(task.name, "failed", type(error).__name__, str(error), problems)
        except Exception as error:
            message = f"unexpected: {type(error).__name__}: {error}; this is {whose_error(error)}: {TRACEBACK_REMEDY}"
            outcome = Outcome(task.name, "failed", type(error).__name__, message, detail=traceback.format_exc())
            if _starved(error):
                message = f"it ran out of memory ({type(error).__name__}: {error}); {MEMORY_REMEDY}"
                outcome = replace(outcome, message=message, kind="MemoryError", retire=True)
    return replace(outcome, seconds=time.perf_counter() - began, warnings=tuple(dict.fromkeys(texts)))


def _starved(error: Exception) -> bool:
    """Whether the error means a lack of memory without being a `MemoryError`.

    C++, the library loader, and extensions that return no result report it in other words.
    """
    words = ("bad_alloc", "annot allocate memory", "failed to map segment")
    return isinstance(error, SystemError) or any(word in str(error) for word in words)


def _work(task: Task, tell: Tell) -> Outcome:
    from vehsim.batch.inputs import fingerprint, is_finished
    from vehsim.delivery.folders import clean_up, newest

    clean_up(task.target)
    clean_up(task.target / "version")
    if task.resume and is_finished(newest(task.target), task.inputs, task.to):
        return Outcome(task.name, "skipped")
    tell(task.name, "planning", "starting", 0.0)
    shot = task.load()
    if fingerprint(shot, task.to, task.draft) != task.inputs:
        raise InputError("its files or vehsim itself changed while the batch ran", "export it again", file=task.source)
    take = shot.solve(
        lambda what, done: tell(task.name, "planning", what, done), checked=task.checked, cached=task.cached
    )
    take = replace(
        take,
        render=take.render.draft() if task.draft else take.render,
        report={**take.report, "inputs": task.inputs},
    )

    state = ""

    def start(exporter: Exporter) -> None:
        nonlocal state
        state = exporter.state

    take.export(task.out, task.to, lambda what, done: tell(task.name, state, what, done), starting=start)
    return Outcome(task.name, "done", frames=take.frames, recalled=take.recalled)


def measure(task: Task) -> None:
    """Put the distance field of the task's whole terrain into the cache, so that only one worker measures it."""
    task.load().world.distance_field(quick=True)


def _measures(shot: Any) -> bool:
    """Whether a flight needs the distances to its whole terrain, as far as its marks tell."""
    from vehsim.planning.request.request import part_around

    flights = [t.motion for t in shot.file.vehicle if t.motion.method == "plan" and shot.vehicle(t).group.dim == 6]
    if not flights or shot.world.standing:
        return bool(flights)
    places = [[mark.position for mark in motion.mark or () if mark.position is not None] for motion in flights]
    return any(not each or part_around(shot.world, each) is None for each in places)
