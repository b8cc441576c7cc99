"""Worker processes on this machine: each runs one task after another; a worker that dies does not affect the others.

Every worker has its own pipe, and no queue or lock is shared, so a process killed at any instant cannot block another.
A new worker retries its clip. Where the system permits, workers are forked from a process that has only loaded what
they need (`preload.py`). They exit when their parent does.
"""

from __future__ import annotations

import mmap
import multiprocessing
import os
import signal
import sys
import threading
import time
from collections import Counter, deque
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import closing, contextmanager, suppress
from multiprocessing.connection import Connection, wait
from pathlib import Path
from typing import Any, NamedTuple

from vehsim.batch.task import MEMORY_MEND, Outcome, Task, Tell
from vehsim.runtime.signals import POLITE, raising

ATTEMPTS = 3
"""How often a clip is started whose worker dies."""
PATIENCE = 10.0
"""Time for interrupted workers to clean up, s."""
ENDING = (signal.SIGINT, *POLITE)
"""Signals that reach a whole group of processes; the first process decides what to do."""
RESERVE = 16_000_000
"""Bytes of address space that a worker reserves for reporting that it ran out of memory."""
THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "LP_NUM_THREADS")
NAME = "vehsim worker"
"""The name of a worker in the system's list of processes."""
METHODS = ["forkserver", "spawn"] if sys.platform == "linux" else ["spawn"]
"""Start methods of workers, in order of preference; the first fails, for example, without room for the fork server's
socket. Apple's frameworks, which numpy loads, must not be used after a fork, and Windows has no fork."""


class Job(NamedTuple):
    """A task and its action: ``measure`` its terrain's distance field, or ``run`` it."""

    kind: str
    task: Task


def warm_up() -> None:
    """Start loading the process from which workers are forked, in parallel with the caller's work."""
    if "forkserver" not in METHODS:
        return
    from multiprocessing import forkserver, resource_tracker

    forkserver.set_forkserver_preload(["vehsim.batch.preload"])
    resource_tracker.ensure_running()  # first, because it admits what is kept out next
    before = signal.pthread_sigmask(signal.SIG_BLOCK, ENDING)  # until they can be received silently
    try:
        with _threads(1), suppress(OSError):  # forked processes must have a single thread
            forkserver.ensure_running()
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def run_on_processes(tasks: Sequence[Task], count: int, tell: Tell, memory: float | None = None) -> Iterator[Outcome]:
    """The outcomes of ``tasks``, each as soon as it is available, from ``count`` processes.

    ``memory``: address space of each worker, GB.
    """
    warm_up()
    fields = {task.field: task for task in tasks if task.field is not None}
    jobs = [*(Job("measure", task) for task in fields.values()), *(Job("run", task) for task in tasks)]
    count = max(1, min(count, len(tasks)))
    crew = [_Worker(count, memory) for _ in range(count)]
    try:
        yield from _dispatch(crew, jobs, tell)
    finally:
        for worker in crew:
            worker.stop()
        deadline = time.monotonic() + PATIENCE
        for worker in crew:
            worker.end(deadline)


def _dispatch(crew: list[_Worker], jobs: Sequence[Job], tell: Tell) -> Iterator[Outcome]:
    """The outcomes of the runs. Clips whose field is being measured wait for it, the others do not."""
    waiting, deaths, ended = deque(jobs), Counter[tuple[str, str]](), list[Outcome]()
    measuring = {job.task.field for job in jobs if job.kind == "measure"}
    while True:
        for worker in crew:
            while worker.job is None and (job := _next(waiting, measuring)) is not None:
                if not worker.give(job):
                    waiting.appendleft(job)
        yield from ended  # reported when all have work again
        ended.clear()
        busy: dict[Any, tuple[_Worker, Job]] = {w.pipe: (w, w.job) for w in crew if w.job is not None}
        if not busy:
            return
        for pipe in wait(list(busy)):
            worker, job = busy[pipe]
            message = worker.receive()
            if isinstance(message, tuple):
                tell(*message)
                continue
            if message is None:  # the worker died
                how = worker.epitaph()
                worker.replace()
                deaths[job.kind, job.task.name] += 1
                if deaths[job.kind, job.task.name] < ATTEMPTS:
                    tell(job.task.name, "queued", f"its worker {how}; tried again", 0.0)
                    waiting.append(job)
                    continue
                text = f"its worker {how}, {ATTEMPTS} times; give it more memory, or reduce the work"
                message = Outcome(job.task.name, "failed", "WorkerLost", text)
            worker.job = None
            if message.retire:
                worker.replace()
            if job.kind == "run":
                ended.append(message)
            measuring.discard(job.task.field)  # clips that need an unmeasured field report the error


def _next(waiting: deque[Job], measuring: Collection[str | None]) -> Job | None:
    """Take the first job that can start."""
    for i, job in enumerate(waiting):
        if job.kind == "measure" or job.task.field not in measuring:
            del waiting[i]
            return job
    return None


class _Worker:
    """A process and our end of its pipe. ``job``: its current job."""

    def __init__(self, count: int, memory: float | None) -> None:
        self._count, self._memory = count, memory
        self._start()

    def _start(self) -> None:
        self.job: Job | None = None
        self.pipe, theirs = multiprocessing.Pipe()
        with closing(theirs), _threads(max(1, (os.cpu_count() or 1) // self._count)):
            arguments = (theirs, self._memory, dict(os.environ))
            for method in METHODS:
                context: Any = multiprocessing.get_context(method)
                self._process = context.Process(target=_serve, args=arguments, name=NAME, daemon=True)
                try:
                    self._process.start()
                    return
                except (OSError, EOFError):  # no room for a socket, or the server was just killed
                    if method == METHODS[-1]:
                        raise

    def give(self, job: Job) -> bool:
        """False if the process had ended; a new one has replaced it."""
        try:
            self.pipe.send(job)
        except OSError:
            self.replace()
            return False
        self.job = job
        return True

    def receive(self) -> Any:
        """The process's message; None if it has ended, even in the middle of a message."""
        try:
            return self.pipe.recv()
        except Exception:
            return None

    def epitaph(self) -> str:
        self._process.join(5.0)
        code = self._process.exitcode
        if code is None:
            return "stopped answering"
        return f"died of {signal.Signals(-code).name}" if code < 0 else f"ended with code {code}"

    def replace(self) -> None:
        self.stop()
        self.end(time.monotonic() + PATIENCE)
        self._start()

    def stop(self) -> None:
        """Request it to clean up and exit: an idle one exits when its pipe closes, a busy one needs a signal."""
        self.pipe.close()
        if self.job is not None and self._process.is_alive():
            self._process.terminate()

    def end(self, deadline: float) -> None:
        self._process.join(max(0.0, deadline - time.monotonic()))
        if self._process.is_alive():
            self._process.kill()
            self._process.join()


@contextmanager
def _threads(share: int) -> Iterator[None]:
    """Processes started in this block share the cores: libraries read these variables as they are loaded."""
    before = {name: os.environ.get(name) for name in THREADS}
    os.environ.update({name: value or str(share) for name, value in before.items()})
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]


def _serve(pipe: Connection, memory: float | None, environment: Mapping[str, str]) -> None:
    """The main loop of a worker: receive a job, send progress and an outcome, until the pipe closes."""
    for number in ENDING:  # Ctrl-C and a closed terminal reach all processes; the first one decides
        signal.signal(number, signal.SIG_IGN)
    # a signal to the group, or from the first process
    signal.signal(signal.SIGTERM, raising(KeyboardInterrupt, once=True))
    with suppress(EOFError, OSError, KeyboardInterrupt, MemoryError):
        _work(pipe, memory, environment)
    os._exit(0)  # already cleaned up: exit at once, because others are waiting


def _work(pipe: Connection, memory: float | None, environment: Mapping[str, str]) -> None:
    os.environ.clear()  # the parent's value is from another time
    os.environ.update(environment)
    with suppress(OSError):
        Path("/proc/self/comm").write_text(NAME)
    die_with_parent()
    threading.Thread(target=_end_with_parent, daemon=True).start()
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
        kind, task = pipe.recv()
        if kind == "measure":
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
        return Outcome(task.name, "failed", "MemoryError", f"it ran out of memory; {MEMORY_MEND}", retire=True)


def die_with_parent() -> None:
    """Have the kernel kill this process when its parent exits, even during a long computation (Linux)."""
    if sys.platform != "linux":
        return
    with suppress(OSError):
        import ctypes

        ctypes.CDLL(None).prctl(1, signal.SIGKILL, 0, 0, 0)  # PR_SET_PDEATHSIG


def _end_with_parent() -> None:
    """The same on other systems, by a thread; it has to wait for computations that hold the interpreter."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)


def _limit(gigabytes: float) -> None:
    import resource

    size = int(gigabytes * 1e9)
    resource.setrlimit(resource.RLIMIT_AS, (size, size))
