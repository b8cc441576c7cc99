"""Functions that read nothing but crash or block their process as a hostile file may."""

from __future__ import annotations

import ctypes
import os
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np


def crashes(path: Path) -> Any:
    ctypes.string_at(0)


def leaves_a_trace(path: Path, crash: bool) -> Any:
    """As USD does when it crashes."""
    Path(tempfile.gettempdir(), "st_python").write_bytes(b"trace")
    if crash:
        crashes(path)
    return {"process": os.getpid(), "folder": tempfile.gettempdir()}, []


def aborts(path: Path) -> Any:
    os.abort()


def never_ends(path: Path) -> Any:
    while True:
        pass


def sleeps(path: Path) -> Any:
    time.sleep(3600)


def takes_memory(path: Path) -> Any:
    return {}, [np.zeros(10**10)]


def prints(path: Path) -> Any:
    os.write(1, b"from a library\n")
    print("from Python")
    return {"size": path.stat().st_size, "process": os.getpid()}, [np.zeros((0, 3)), np.array("text"), np.eye(2).T]
