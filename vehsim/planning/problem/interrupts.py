"""Defer exceptions that are raised while CasADi works, by signal handlers (Ctrl-C) or by callbacks.

CasADi swallows exceptions of the Python code that it calls. They are kept here and raised when CasADi returns.
"""

from __future__ import annotations

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from vehsim.runtime.signals import POLITE


class _Kept(threading.local):
    """The state of one thread; signal handlers run in the main thread only."""

    error: BaseException | None = None
    planning = False
    silent = False
    """Whether nothing may be raised at the moment."""


_kept = _Kept()


@contextmanager
def remembered() -> Iterator[None]:
    """Keep what signal handlers raise, and raise it when the outermost of these contexts ends."""
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
        _kept.silent = True  # a signal that arrives now must not interrupt this code
        for number, handler in handlers.items():
            signal.signal(number, handler)
        error, _kept.error, _kept.planning, _kept.silent = _kept.error, None, False, False
        if error is not None:
            raise error


@contextmanager
def silent() -> Iterator[None]:
    """Within this context signal handlers raise nothing; it is raised afterwards."""
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


def interrupted() -> bool:
    """Whether an error is kept, so that the current work should stop."""
    return _kept.error is not None


def check() -> None:
    """Raise the kept error, if any."""
    if _kept.error is not None:
        raise _kept.error


def _handlers() -> dict[int, Any]:
    """Python's handlers of the signals that end a command; empty outside the main thread; ignored signals are left
    out."""
    if threading.current_thread() is not threading.main_thread():
        return {}
    found = {number: signal.getsignal(number) for number in (signal.SIGINT, *POLITE)}
    return {number: handler for number, handler in found.items() if callable(handler)}
