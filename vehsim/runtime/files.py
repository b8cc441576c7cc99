"""Files and folders that are written beside their place and then moved into it: a reader finds all of one or nothing.

The folders of deliveries, which replace one another, are moved by `vehsim.delivery.folders`.
"""

from __future__ import annotations

import hashlib
import os
import platform
import secrets
import shutil
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from functools import cache, partial
from pathlib import Path


@contextmanager
def replacing_file(path: Path, durable: bool = False) -> Iterator[Path]:
    """Yield a hidden path beside ``path``. The file written there takes the place of ``path`` when the block ends well.

    ``durable``: the file is on the disk before it moves, so that a power cut leaves the old file or the new one.
    """
    beside = path.with_name(f".{path.name}.{owner()}.partial")
    try:
        yield beside
        if durable:
            with beside.open("rb") as file:
                os.fsync(file.fileno())
        beside.replace(path)
    finally:
        with suppress(OSError):
            beside.unlink()


@contextmanager
def making_folder(folder: Path) -> Iterator[Path]:
    """Yield a hidden path beside ``folder``. The folder made there becomes ``folder`` when the block ends well.

    If another process was faster, its folder stays: both must have the same content.
    """
    beside = folder.with_name(f".{folder.name}.{owner()}.partial")
    try:
        yield beside
        with suppress(OSError):  # another process was faster
            beside.rename(folder)
    finally:
        shutil.rmtree(beside, ignore_errors=True)


def write_file(path: Path, content: bytes | str, durable: bool = False, mode: int = 0o666) -> None:
    """Write a whole file; a text is written in UTF-8. ``durable`` as in `replacing_file`; ``mode``: its permissions,
    without those that the process forbids."""
    with replacing_file(path, durable) as beside, open(beside, "wb", opener=partial(os.open, mode=mode)) as file:
        file.write(content.encode() if isinstance(content, str) else content)


def owner() -> str:
    """A name for what this process writes beside a file or folder; no other process, on any machine, uses it."""
    return f"{machine()}-{os.getpid()}-{secrets.token_hex(4)}"


@cache
def machine() -> str:
    """A hash of this machine and of the space in which its process ids are unique."""
    space = Path("/proc/self/ns/pid")
    name = f"{platform.node()} {space.readlink() if space.is_symlink() else ''}"
    return hashlib.sha256(name.encode()).hexdigest()[:8]
