"""A batch from shots to summary, top-down: prepare tasks, run them, record each outcome."""

from __future__ import annotations

from collections.abc import Generator, Iterable, Sequence
from contextlib import closing
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING

from vehsim.batch.summary import write_summary
from vehsim.batch.task import Outcome, Task, Tell, prepare, run_task
from vehsim.batch.workers import run_on_processes, warm_up
from vehsim.errors import InputError

if TYPE_CHECKING:
    from vehsim.shot import Shot


def export_batch(
    shots: Sequence[Shot],
    out: str | Path,
    to: Sequence[str] = ("usd",),
    *,
    workers: int = 1,
    dask: str | None = None,
    resume: bool = False,
    draft: bool = False,
    cached: bool = True,
    memory: float | None = None,
    tell: Tell | None = None,
) -> list[Outcome]:
    """Export every shot to ``out/<name>/`` and write ``out/summary.json``. Returns the outcomes in the shots' order.

    ``workers`` processes, or a Dask cluster (``dask``: its address or "local"); ``resume`` skips finished clips;
    ``draft``: fast pictures; ``cached=False`` does not use the cache of solved motion; ``memory``: a worker's address
    space, GB. A shot that fails does not stop the others.

    Raises ``InputError`` before anything is written, ``ExportError`` if the summary cannot be written.
    """
    if workers > 1 and dask is None:
        warm_up()
    tasks = [prepare(shot, Path(out), to, draft, resume, cached=cached) for shot in shots]
    outcomes: dict[str, Outcome] = {}
    check_names(tasks)
    with closing(run(tasks, workers=workers, dask=dask, memory=memory, tell=tell)) as running:
        for outcome in running:
            outcomes[outcome.name] = outcome
    write_summary(Path(out), tasks, outcomes, [])
    return [outcomes[task.name] for task in tasks]


def run(
    tasks: Sequence[Task],
    *,
    workers: int = 1,
    dask: str | None = None,
    memory: float | None = None,
    tell: Tell | None = None,
) -> Generator[Outcome, None, None]:
    """Yield the outcomes of ``tasks``. A single clip needs no other process, unless memory is limited."""
    if memory is not None and find_spec("resource") is None:
        raise InputError("this system cannot limit memory", "leave it out", key="memory", value=memory)
    tell = tell or (lambda name, state, what, done: None)
    if dask is not None:
        from vehsim.batch.cluster import run_on_dask

        yield from run_on_dask(tasks, dask, workers, tell)
    elif len(tasks) == 1 and memory is None:
        yield run_task(tasks[0], tell)
    elif tasks:
        yield from run_on_processes(tasks, workers, tell, memory)


def check_names(tasks: Iterable[Task]) -> None:
    """Check that no two clips write the same folder, also on file systems that ignore case."""
    seen: dict[str, Task] = {}
    for task in tasks:
        key = task.name.casefold()
        if key in seen:
            raise InputError(
                f"{seen[key].source} has it too",
                "give every shot of a batch a name of its own",
                key="shot.name",
                value=task.name,
                file=task.source,
            )
        seen[key] = task
