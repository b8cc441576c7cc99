"""Run a batch on worker processes of this machine: a clip whose worker dies is tried again on a new one."""

from __future__ import annotations

import mmap
import time
from collections import Counter, deque
from collections.abc import Collection, Iterator, Sequence
from functools import partial
from multiprocessing.connection import Connection, wait
from typing import Any, NamedTuple

from vehsim.batch.task import MEMORY_REMEDY, Outcome, Task, Tell
from vehsim.runtime.processes import Worker, end, start_server

ATTEMPTS = 3
"""How often a clip is started if its workers die."""
RESERVE = 16_000_000
"""Bytes of address space that a worker reserves for reporting that it ran out of memory."""


class Job(NamedTuple):
    """A task to run, or, if it ``measures``, the distance field of the task's terrain to measure before."""

    task: Task
    measures: bool = False


def warm_up() -> None:
    """Start loading the process from which workers are forked, in parallel with the caller's work."""
    start_server(["vehsim.batch.preload"])


def run_on_processes(tasks: Sequence[Task], count: int, tell: Tell, memory: float | None = None) -> Iterator[Outcome]:
    """The outcomes of ``tasks``, each as soon as it is available, from ``count`` processes.

    ``memory``: address space of each worker, GB.
    """
    warm_up()
    fields = {task.field: task for task in tasks if task.field is not None}
    jobs = [*(Job(task, measures=True) for task in fields.values()), *map(Job, tasks)]
    count = max(1, min(count, len(tasks)))
    crew = [Worker(partial(_serve, memory), count) for _ in range(count)]
    try:
        yield from _dispatch(crew, jobs, tell)
    finally:
        end(crew)


def _dispatch(crew: list[Worker], jobs: Sequence[Job], tell: Tell) -> Iterator[Outcome]:
    """The outcomes of the runs. Clips whose field is being measured wait for it, the others do not."""
    waiting, deaths, ended = deque(jobs), Counter[tuple[bool, str]](), list[Outcome]()
    measuring = {job.task.field for job in jobs if job.measures}
    while True:
        for worker in crew:
            while worker.job is None and (job := _next(waiting, measuring)) is not None:
                if not worker.give(job):
                    waiting.appendleft(job)
        yield from ended  # reported when all have work again
        ended.clear()
        busy: dict[Any, tuple[Worker, Job]] = {w.pipe: (w, w.job) for w in crew if w.job is not None}
        if not busy:
            return
        for pipe in wait(list(busy)):
            worker, job = busy[pipe]
            message = worker.receive()
            if isinstance(message, tuple):
                tell(*message)
                continue
            if message is None:  # the worker died
                how = worker.how_it_ended()
                worker.replace()
                deaths[job.measures, job.task.name] += 1
                if deaths[job.measures, job.task.name] < ATTEMPTS:
                    tell(job.task.name, "queued", f"its worker {how}; tried again", 0.0)
                    waiting.append(job)
                    continue
                text = f"its worker {how}, {ATTEMPTS} times; give it more memory, or reduce the work"
                message = Outcome(job.task.name, "failed", "WorkerLost", text)
            worker.job = None
            if message.retire:
                worker.replace()
            if not job.measures:
                ended.append(message)
            measuring.discard(job.task.field)  # clips that need an unmeasured field report the error


def _next(waiting: deque[Job], measuring: Collection[str | None]) -> Job | None:
    """Take the first job that can start."""
    for i, job in enumerate(waiting):
        if job.measures or job.task.field not in measuring:
            del waiting[i]
            return job
    return None


def _serve(memory: float | None, pipe: Connection) -> None:
    """The main loop of a worker: receive a job, send progress and an outcome, until the pipe closes."""
    if memory is not None:
        _limit(memory)
    from vehsim.batch.task import measure, run_task

    last_time, last_state = 0.0, ""

    def tell(name: str, state: str, what: str, done: float) -> None:
        nonlocal last_time, last_state
        now = time.monotonic()
        if state != last_state or now - last_time > 0.1:
            last_time, last_state = now, state
            pipe.send((name, state, what, done))

    while True:
        task, measures = pipe.recv()
        if measures:
            try:
                measure(task)
            except Exception as error:
                pipe.send(Outcome(task.name, "failed", type(error).__name__, str(error)))
            else:
                pipe.send(Outcome(task.name, "done"))
            continue
        outcome = _run(run_task, task, tell)
        pipe.send(outcome)
        if outcome.retire:  # without memory, even waiting may fail
            return


def _run(run_task: Any, task: Task, tell: Tell) -> Outcome:
    """The task's outcome. Without memory for it, free the reserve and report that."""
    aside = mmap.mmap(-1, RESERVE)
    try:
        outcome: Outcome = run_task(task, tell)
        return outcome
    except MemoryError:
        aside.close()
        return Outcome(task.name, "failed", "MemoryError", f"it ran out of memory; {MEMORY_REMEDY}", retire=True)


def _limit(gigabytes: float) -> None:
    import resource

    size = int(gigabytes * 1e9)
    resource.setrlimit(resource.RLIMIT_AS, (size, size))
