"""Signals that end a command, raised as exceptions where they are not lost; and readers that exit before the
command."""

from __future__ import annotations

import _thread
import errno
import os
import signal
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from io import StringIO
from typing import Any

POLITE = tuple(getattr(signal, name) for name in ("SIGTERM", "SIGHUP") if hasattr(signal, name))
"""Signals that request a process to end: `kill`, and closing a terminal. A process may ignore them, for example under
`nohup`."""


def raising(error: type[BaseException], once: bool = False) -> Callable[[int, Any], None]:
    """A handler that raises ``error``; ``once``: later signals do not disturb the cleanup.

    While one of USD's modules is being loaded, it waits: USD would print the exception and continue half loaded.
    """

    def stop(number: int, frame: Any) -> None:
        if _loads_usd(frame):
            # take no lock: the interrupted code may hold it
            _thread.start_new_thread(_again, (number, _thread.get_ident()))
            return
        if once:
            signal.signal(number, signal.SIG_IGN)
        raise error

    return stop


@contextmanager
def calling(stop: Callable[[], object]) -> Iterator[None]:
    """In this block, the first signal that would raise an exception calls ``stop`` instead.

    An exception between two steps of an event loop loses the next one, and the loop then waits for it for ever.
    """
    before: dict[int, Any] = {}

    def restore() -> None:
        for number, handler in before.items():
            signal.signal(number, handler)
        before.clear()

    def stopped(number: int, frame: Any) -> None:
        restore()
        stop()

    with suppress(ValueError):  # not the main thread: the caller handles signals
        for number in (*POLITE, signal.SIGINT):
            if callable(signal.getsignal(number)):
                before[number] = signal.signal(number, stopped)
    try:
        yield
    finally:
        restore()


def _loads_usd(frame: Any) -> bool:
    while frame is not None:
        if frame.f_code.co_name == "<module>" and str(frame.f_globals.get("__name__")).startswith("pxr"):
            return True
        frame = frame.f_back
    return False


def _again(number: int, thread: int) -> None:
    """Repeat a signal to the main ``thread`` a little later."""
    time.sleep(0.02)
    if hasattr(signal, "pthread_kill"):  # it also wakes a thread that waits in a system call
        signal.pthread_kill(thread, number)
    else:
        _thread.interrupt_main(signal.Signals(number))


@contextmanager
def outliving_readers() -> Iterator[Callable[[], OSError | None]]:
    """In this block, failures to write standard output or error are ignored, and the work continues.

    Yields a function that flushes both and returns why standard output was lost; None if it was not, or if its reader
    had read enough, as `head` does.
    """
    before = sys.stdout, sys.stderr
    for number, stream in enumerate(before, start=1):
        if stream is None:  # it was closed from the start: none of our files may take its place
            os.dup2(os.open(os.devnull, os.O_WRONLY), number)
    answers, messages = (_Patient(stream or StringIO()) for stream in before)
    sys.stdout, sys.stderr = answers, messages  # type: ignore[assignment]  # all that print and tracebacks use

    def lost() -> OSError | None:
        messages.flush()
        answers.flush()
        return answers.lost

    try:
        yield lost
    finally:
        sys.stdout, sys.stderr = before


class _Patient:
    """A text stream that stores its first write error in ``lost`` and ignores later writes."""

    def __init__(self, stream: Any) -> None:
        self._stream = stream
        self.lost: OSError | None = None

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)

    def write(self, text: str) -> int:
        return self._try(lambda: int(self._stream.write(text)), len(text))

    def flush(self) -> None:
        self._try(lambda: self._stream.flush() or 0, 0)

    def _try(self, do: Callable[[], int], otherwise: int) -> int:
        try:
            return do()
        except OSError as error:
            if error.errno != errno.EPIPE:
                self.lost = self.lost or error
            with suppress(OSError, ValueError):  # flush the rest of the buffer at exit
                os.dup2(os.open(os.devnull, os.O_WRONLY), self._stream.fileno())
            return otherwise
