"""Worker processes on this machine: each does one task after another; one that dies takes nothing with it.

Every worker has a pipe of its own, no queue or lock is shared, so a process killed at any instant can block no other.
Its clip is tried again by a fresh one. Workers are forked from a process that has loaded what they need and does
nothing else (`preload.py`), where the system has such; they end when the process that asked for them does.
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

from vehsim._ending import POLITE, raising
from vehsim.batch.task import MEMORY_MEND, Outcome, Task, Tell

ATTEMPTS = 3
"""How often a clip is begun whose worker dies."""
PATIENCE = 10.0
"""How long interrupted workers may take to tidy up, s."""
ENDING = (signal.SIGINT, *POLITE)
"""Signals that reach a whole group of processes; the first process decides what follows."""
RESERVE = 16_000_000
"""Bytes of address space that a worker keeps for its last words."""
THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "LP_NUM_THREADS")
NAME = "vehsim worker"
"""What a worker is called in the system's list of processes."""
METHODS = ["forkserver", "spawn"] if sys.platform == "linux" else ["spawn"]
"""How workers are started; the next where one cannot be, as without room for the fork server's socket. Apple's
frameworks, which numpy loads, must not be used after a fork, and Windows has none."""


class Job(NamedTuple):
    """A task and what to do of it: ``measure`` its terrain's distance field, or ``run`` it."""

    kind: str
    task: Task


def warm_up() -> None:
    """Have what workers are forked from loaded, beside whatever the caller does next."""
    if "forkserver" not in METHODS:
        return
    from multiprocessing import forkserver, resource_tracker

    forkserver.set_forkserver_preload(["vehsim.batch.preload"])
    resource_tracker.ensure_running()  # first: it lets in what is kept out next
    before = signal.pthread_sigmask(signal.SIG_BLOCK, ENDING)  # until it can take them in silence
    try:
        with _threads(1), suppress(OSError):  # what is forked has a single thread
            forkserver.ensure_running()
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def run_on_processes(tasks: Sequence[Task], count: int, tell: Tell, memory: float | None = None) -> Iterator[Outcome]:
    """The outcomes of ``tasks``, each as soon as it is there, from ``count`` processes.

    ``memory``: how much address space a worker may use, GB.
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
    """The outcomes of what is run. Clips whose field is being measured wait for it, others do not."""
    waiting, deaths, ended = deque(jobs), Counter[tuple[str, str]](), list[Outcome]()
    measuring = {job.task.field for job in jobs if job.kind == "measure"}
    while True:
        for worker in crew:
            while worker.job is None and (job := _next(waiting, measuring)) is not None:
                if not worker.give(job):
                    waiting.appendleft(job)
        yield from ended  # told when all have work again
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
            if message is None:  # it died
                how = worker.epitaph()
                worker.replace()
                deaths[job.kind, job.task.name] += 1
                if deaths[job.kind, job.task.name] < ATTEMPTS:
                    tell(job.task.name, "queued", f"its worker {how}; tried again", 0.0)
                    waiting.append(job)
                    continue
                text = f"its worker {how}, {ATTEMPTS} times; give it more memory, or ask less of it"
                message = Outcome(job.task.name, "failed", "WorkerLost", text)
            worker.job = None
            if message.retire:
                worker.replace()
            if job.kind == "run":
                ended.append(message)
            measuring.discard(job.task.field)  # what could not be measured is said by the clips that need it


def _next(waiting: deque[Job], measuring: Collection[str | None]) -> Job | None:
    """Take the first job that can begin."""
    for i, job in enumerate(waiting):
        if job.kind == "measure" or job.task.field not in measuring:
            del waiting[i]
            return job
    return None


class _Worker:
    """A process and our end of its pipe. ``job``: what it is doing."""

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
        """False when the process had ended, by itself or by another's hand; a new one has taken its place."""
        try:
            self.pipe.send(job)
        except OSError:
            self.replace()
            return False
        self.job = job
        return True

    def receive(self) -> Any:
        """What the process says; None when it is gone, be it in the middle of a word."""
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
        """Ask it to tidy up and go: idle it ends with its pipe, at work it needs a sign."""
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
    """Processes started in here share the cores: libraries read these as they are loaded."""
    before = {name: os.environ.get(name) for name in THREADS}
    os.environ.update({name: value or str(share) for name, value in before.items()})
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]


def _serve(pipe: Connection, memory: float | None, environment: Mapping[str, str]) -> None:
    """The life of a worker: a job in, words of progress and an outcome out, until the pipe closes."""
    for number in ENDING:  # Ctrl-C and a closed terminal reach us all; the first process decides
        signal.signal(number, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, raising(KeyboardInterrupt, once=True))  # the group's, or that of the first process
    with suppress(EOFError, OSError, KeyboardInterrupt, MemoryError):
        _work(pipe, memory, environment)
    os._exit(0)  # tidied up: nothing may hold up those who wait for us


def _work(pipe: Connection, memory: float | None, environment: Mapping[str, str]) -> None:
    os.environ.clear()  # what we were forked from has that of another time
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
        if outcome.retire:  # without memory not even waiting is safe
            return


def _run(run_task: Any, task: Task, tell: Tell) -> Outcome:
    """The task's outcome, also when there was not even memory left to say so: what we set aside is free by then."""
    aside = mmap.mmap(-1, RESERVE)
    try:
        outcome: Outcome = run_task(task, tell)
        return outcome
    except MemoryError:
        aside.close()
        return Outcome(task.name, "failed", "MemoryError", f"it ran out of memory; {MEMORY_MEND}", retire=True)


def die_with_parent() -> None:
    """Have the kernel kill us when the parent is gone, also in the middle of a long computation (Linux)."""
    if sys.platform != "linux":
        return
    with suppress(OSError):
        import ctypes

        ctypes.CDLL(None).prctl(1, signal.SIGKILL, 0, 0, 0)  # PR_SET_PDEATHSIG


def _end_with_parent() -> None:
    """The same wherever there are threads; it has to wait for a computation that holds the interpreter."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)


def _limit(gigabytes: float) -> None:
    import resource

    size = int(gigabytes * 1e9)
    resource.setrlimit(resource.RLIMIT_AS, (size, size))
