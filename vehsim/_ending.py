"""Signals that end a command: raised as an exception, and never where it would be lost."""

from __future__ import annotations

import _thread
import signal
import time
from collections.abc import Callable
from typing import Any


def raising(error: type[BaseException], once: bool = False) -> Callable[[int, Any], None]:
    """A handler that raises ``error``; ``once``: what comes later cannot disturb what is tidied up.

    While one of USD's modules is being loaded it waits: they would print what is raised, go on half made, and nobody
    else would hear of it.
    """

    def stop(number: int, frame: Any) -> None:
        if _loads_usd(frame):
            _thread.start_new_thread(_again, (number,))  # no lock is taken: what we interrupt may hold it
            return
        if once:
            signal.signal(number, signal.SIG_IGN)
        raise error

    return stop


def _loads_usd(frame: Any) -> bool:
    while frame is not None:
        if frame.f_code.co_name == "<module>" and str(frame.f_globals.get("__name__")).startswith("pxr"):
            return True
        frame = frame.f_back
    return False


def _again(number: int) -> None:
    time.sleep(0.02)
    _thread.interrupt_main(signal.Signals(number))
