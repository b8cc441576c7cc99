"""Worker processes on this machine: each runs one job after another; one that dies does not affect the others.

Every worker has its own pipe, and no queue or lock is shared, so a process killed at any instant cannot block another.
Where the system permits, workers are forked from a server process that has only loaded what they need. They do not
import the calling script, and exit when their parent does.
"""

from __future__ import annotations

import multiprocessing
import os
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import closing, contextmanager, suppress
from multiprocessing.connection import Connection
from pathlib import Path
from types import ModuleType
from typing import Any

from vehsim.runtime.signals import POLITE, raising

Serve = Callable[[Connection], None]
"""What a worker runs: receive jobs from the pipe and send answers, until `EOFError`. Defined in a module, so that a new
process can import it."""
PATIENCE = 10.0
"""Time for interrupted workers to clean up, s."""
ENDING = (signal.SIGINT, *POLITE)
"""Signals that reach a whole group of processes; the first process decides what to do."""
THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "LP_NUM_THREADS")
NAME = "vehsim worker"
"""The name of a worker in the system's list of processes."""
METHODS = ["forkserver", "spawn"] if sys.platform == "linux" else ["spawn"]
"""Start methods of workers, in order of preference; the first fails, for example, without room for the fork server's
socket. Apple's frameworks, which numpy loads, must not be used after a fork, and Windows has no fork."""


def start_server(preload: Sequence[str] = ()) -> None:
    """Start the process from which workers are forked, in parallel with the caller's work, unless it is running.

    ``preload``: modules that it imports first.
    """
    if "forkserver" not in METHODS:
        return
    from multiprocessing import forkserver, resource_tracker

    forkserver.set_forkserver_preload(list(preload))
    resource_tracker.ensure_running()  # first, because it unblocks what is blocked next
    before = signal.pthread_sigmask(signal.SIG_BLOCK, ENDING)  # until they can be received silently
    try:
        with _threads(1), suppress(OSError):  # forked processes must have a single thread
            forkserver.ensure_running()
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def may_start_workers() -> bool:
    """False in a worker: it has its share of the cores already."""
    return multiprocessing.parent_process() is None


class Worker:
    """A process that runs ``serve``, and this process's end of its pipe. ``job``: its current job.

    ``count`` workers share the cores. Raises ``OSError`` if no process can be started.
    """

    def __init__(self, serve: Serve, count: int) -> None:
        self._serve, self._count = serve, count
        self._start()

    def _start(self) -> None:
        self.job: Any = None
        self.pipe, theirs = multiprocessing.Pipe()
        with closing(theirs), _threads(max(1, (os.cpu_count() or 1) // self._count)), _without_script():
            arguments = (theirs, self._serve, dict(os.environ))
            for method in METHODS:
                context: Any = multiprocessing.get_context(method)
                self._process = context.Process(target=_run, args=arguments, name=NAME, daemon=True)
                try:
                    self._process.start()
                    return
                except (OSError, EOFError):  # no room for a socket, or the server was just killed
                    if method == METHODS[-1]:
                        raise

    def give(self, job: Any) -> bool:
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

    def how_it_ended(self) -> str:
        """How the process ended, for a message."""
        self._process.join(5.0)
        code = self._process.exitcode
        if code is None:
            return "stopped answering"
        return f"died of {signal.Signals(-code).name}" if code < 0 else f"ended with code {code}"

    def replace(self) -> None:
        """Start a new process in place of this one."""
        end([self])
        self._start()

    def _stop(self) -> None:
        """Request it to clean up and exit: an idle one exits when its pipe closes, a busy one needs a signal."""
        self.pipe.close()
        if self.job is not None and self._process.is_alive():
            self._process.terminate()

    def _end(self, deadline: float) -> None:
        self._process.join(max(0.0, deadline - time.monotonic()))
        if self._process.is_alive():
            self._process.kill()
            self._process.join()


def end(workers: Sequence[Worker]) -> None:
    """End all of them: together they have `PATIENCE` to clean up."""
    for worker in workers:
        worker._stop()
    deadline = time.monotonic() + PATIENCE
    for worker in workers:
        worker._end(deadline)


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


@contextmanager
def _without_script() -> Iterator[None]:
    """Processes started in this block do not import the calling script, which may lack a ``__name__`` guard."""
    script = sys.modules["__main__"]
    sys.modules["__main__"] = ModuleType("__main__")
    try:
        yield
    finally:
        sys.modules["__main__"] = script


def _run(pipe: Connection, serve: Serve, environment: Mapping[str, str]) -> None:
    """The whole life of a worker."""
    for number in ENDING:  # Ctrl-C and a closed terminal reach all processes; the first one decides
        signal.signal(number, signal.SIG_IGN)
    # a signal to the group, or from the first process
    signal.signal(signal.SIGTERM, raising(KeyboardInterrupt, once=True))
    with suppress(EOFError, OSError, KeyboardInterrupt, MemoryError):
        os.environ.clear()  # the fork server's is from another time
        os.environ.update(environment)
        with suppress(OSError):
            Path("/proc/self/comm").write_text(NAME)
        die_with_parent()
        threading.Thread(target=_end_with_parent, daemon=True).start()
        serve(pipe)
    os._exit(0)  # already cleaned up: exit at once, because others are waiting


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
