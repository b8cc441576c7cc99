"""What is raised while CasADi works: by handlers of signals (Ctrl-C), by callbacks. It loses exceptions of Python code
that it calls, to look at what it was given or to tell how far it is: they are kept here and raised when it is done."""

from __future__ import annotations

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from vehsim.runtime.signals import POLITE


class _Kept(threading.local):
    """Each thread's own: handlers run in the main one alone."""

    error: BaseException | None = None
    planning = False
    silent = False
    """Nothing may be raised now."""


_kept = _Kept()


@contextmanager
def remembered() -> Iterator[None]:
    """Handlers of signals do as ever; what they raise is remembered until the outermost of these ends, and raised."""
    if _kept.planning:
        yield
        return
    handlers = _handlers()

    def note(number: int, frame: Any) -> None:
        try:
            handlers[number](number, frame)
        except BaseException as error:
            keep(error)
            if not _kept.silent:
                raise

    _kept.planning = True
    try:
        for number in handlers:
            signal.signal(number, note)
        yield
    finally:
        _kept.silent = True  # a signal that comes now does not stop us here
        for number, handler in handlers.items():
            signal.signal(number, handler)
        error, _kept.error, _kept.planning, _kept.silent = _kept.error, None, False, False
        if error is not None:
            raise error


@contextmanager
def silent() -> Iterator[None]:
    """Handlers raise nothing within: it is raised behind."""
    with remembered():
        check()
        before, _kept.silent = _kept.silent, True
        try:
            yield
        finally:
            _kept.silent = before
        check()


def keep(error: BaseException) -> None:
    """Raise the error later; only the first one is kept."""
    if _kept.error is None:
        _kept.error = error


def came() -> bool:
    """Whether an error is kept, so that the current work should stop."""
    return _kept.error is not None


def check() -> None:
    """Raise what was kept."""
    if _kept.error is not None:
        raise _kept.error


def _handlers() -> dict[int, Any]:
    """Python's handlers of the signals that end a command: none outside the main thread, or where they are ignored."""
    if threading.current_thread() is not threading.main_thread():
        return {}
    found = {number: signal.getsignal(number) for number in (signal.SIGINT, *POLITE)}
    return {number: handler for number, handler in found.items() if callable(handler)}
