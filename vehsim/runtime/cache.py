"""The cache for results that can be computed again: distance fields, converted assets. Safe to delete at any time."""

from __future__ import annotations

import json
import os
import warnings
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from functools import lru_cache
from hashlib import file_digest, sha256
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vehsim.runtime.files import write_file

Array = NDArray[np.float64]


Stamp = tuple[int, int, int, int]


def stamp(path: str | Path) -> Stamp:
    """A value that changes whenever a file is written, even if its size and date are restored, because the
    change time of its inode cannot be set. For what a process remembers about files; persistent results are cached by
    content."""
    stat = os.stat(path)
    return stat.st_mtime_ns, stat.st_ctime_ns, stat.st_size, stat.st_ino


def content_of(path: str | Path) -> str | None:
    """The hash of a file's bytes, None if it does not exist; its name belongs to the file that refers to it."""
    try:
        return _content(str(path), stamp(path))
    except OSError:
        return None


@lru_cache(maxsize=1024)
def _content(path: str, written: Stamp) -> str:
    with open(path, "rb") as file:
        return file_digest(file, "sha256").hexdigest()


def cache_folder() -> Path:
    """``VEHSIM_CACHE``, or the platform's cache folder."""
    if folder := os.environ.get("VEHSIM_CACHE"):
        return Path(folder).expanduser()
    import platformdirs

    return Path(platformdirs.user_cache_dir("vehsim", appauthor=False))


MOST = 100_000_000
"""Largest size of the cached results of one kind, bytes, where nothing else is said."""
BLOCK = 4096
"""Files take whole blocks, bytes: many small entries are bounded too."""


def kept(kind: str, key: object, make: Callable[[], bytes], most: int = MOST) -> bytes:
    """The result of ``make``, cached for other processes under everything that it depends on. Safe under concurrent
    writers; a damaged entry is made again. ``kind``: change it when ``make`` changes. ``most`` as in `store`."""
    found = lookup(kind, key)
    return store(kind, key, make(), most) if found is None else found


def lookup(kind: str, key: object) -> bytes | None:
    """The result that a process has stored with `store`; None if there is none."""
    file = _entry(kind, key)
    with suppress(OSError):
        if (found := _sealed(file)) is not None:
            return found
        warnings.warn(f"{file}: damaged cache entry, made again", stacklevel=3)
    return None


def store(kind: str, key: object, made: bytes, most: int = MOST) -> bytes:
    """Store what was ``made`` for all processes, and return it.

    The results of one kind take at most ``most`` bytes: the least recently used ones are removed. What follows a dash
    in ``kind`` is its version, so those of earlier versions count too.
    """
    if len(made) > most:
        return made
    file = _entry(kind, key)
    try:
        _write(file, made)
    except OSError as error:
        reason = error.strerror or type(error).__name__
        warnings.warn(f"{file.parent}: {kind}: could not be kept ({reason}); made again each time", stacklevel=3)
    _shrink(kind.partition("-")[0], most)
    return made


def lookup_code(kind: str, key: object) -> bytes | None:
    """The same of what will be executed: only what this user has stored under this very key. Nothing warns: without
    it, everything works."""
    with suppress(OSError, RuntimeError):
        file = _entry(kind, key)
        name = file.name.encode()
        if (found := _sealed(file, private=True)) is not None and found.startswith(name):
            return found[len(name) :]
    return None


def store_code(kind: str, key: object, made: bytes) -> None:
    """Store for `lookup_code`, with the name of its entry: one that was moved onto another is not executed."""
    with suppress(OSError, RuntimeError):
        file = _entry(kind, key)
        _write(file, file.name.encode() + made, mode=0o644)
        _shrink(kind.partition("-")[0], MOST)


def _sealed(file: Path, private: bool = False) -> bytes | None:
    """The content of an entry; None if it is damaged or, if it has to be ``private``, others can have written it."""
    with file.open("rb") as opened:
        if private and not _is_private(os.fstat(opened.fileno())):
            return None
        content = opened.read()
    if sha256(content[:-SEAL]).digest() != content[-SEAL:]:
        return None
    with suppress(OSError):  # the cache may be read-only
        os.utime(file)  # mark as used, so that `store` spares it
    return content[:-SEAL]


def _write(file: Path, made: bytes, mode: int = 0o666) -> None:
    file.parent.mkdir(parents=True, exist_ok=True)
    write_file(file, made + sha256(made).digest(), mode=mode)


def _is_private(stat: os.stat_result) -> bool:
    """Whether only this user, or the system's, can have written a file."""
    if not hasattr(os, "geteuid"):  # on Windows, a user's folders are private
        return True
    return stat.st_uid in (os.geteuid(), 0) and not stat.st_mode & 0o022


def _shrink(kind: str, most: int) -> None:
    """Remove the least recently used entries of ``kind``, until they take at most ``most`` bytes."""
    entries = []
    with suppress(OSError):
        for file in cache_folder().glob(f"{kind}-*"):
            with suppress(OSError):  # another process was faster
                stat = file.stat()
                entries.append((stat.st_mtime_ns, -(-stat.st_size // BLOCK) * BLOCK, file))
    total = sum(size for _, size, _ in entries)
    for _, size, file in sorted(entries):
        if total <= most:
            return
        with suppress(OSError):
            file.unlink(missing_ok=True)
        total -= size


def _entry(kind: str, key: object) -> Path:
    return cache_folder() / f"{kind}-{sha256(repr(key).encode()).hexdigest()[:32]}"


def kept_arrays(kind: str, made_from: Sequence[Array], make: Callable[[], Sequence[Array]]) -> list[Array]:
    """Arrays that follow from others, cached by `kept`: for example convex hulls, whose library takes half a second to
    load."""
    digest = sha256()
    for array in made_from:
        digest.update(repr((array.shape, array.dtype.str)).encode() + np.ascontiguousarray(array).tobytes())
    return unpacked(kept(kind, digest.hexdigest(), lambda: packed(make())))


def packed(arrays: Sequence[NDArray[Any]]) -> bytes:
    """Arrays as bytes; `unpacked` reads them."""
    buffer = BytesIO()
    np.savez(buffer, *arrays)
    return buffer.getvalue()


def unpacked(content: bytes) -> list[NDArray[Any]]:
    """Arrays from bytes of `packed`."""
    with np.load(BytesIO(content), allow_pickle=False) as arrays:
        return [arrays[f"arr_{k}"] for k in range(len(arrays.files))]


SEAL = 32
"""Length of the checksum at the end of `kept` entries."""


def seal(at: Path, holds: Mapping[str, bytes]) -> None:
    """Write checksums of the files to ``at`` before the files themselves; otherwise other processes would consider them
    damaged."""
    write_file(at, json.dumps({name: sha256(content).hexdigest() for name, content in holds.items()}))


def is_whole(at: Path) -> bool:
    """Whether the files match ``at``. After a power cut, a file may have the right size but lost content."""
    try:
        holds = json.loads(at.read_text())
        return all(sha256((at.parent / name).read_bytes()).hexdigest() == digest for name, digest in holds.items())
    except (OSError, ValueError, AttributeError):
        return False


SOURCE = "vehsim:source"
"""Key of a cached layer's custom data: the file from which it was made."""


def made_of(asset: str | Path) -> str:
    """The user's own file: the source of a layer in the cache, or the file itself."""
    from pxr import Sdf

    return str(Sdf.Layer.FindOrOpen(str(asset)).customLayerData.get(SOURCE, asset))
