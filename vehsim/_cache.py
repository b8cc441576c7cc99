"""Where vehsim keeps what it can make again: distance fields, converted assets. Safe to delete at any time."""

from __future__ import annotations

import json
import os
import secrets
import warnings
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from hashlib import sha256
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


Stamp = tuple[int, int, int, int]


def stamp(path: str | Path) -> Stamp:
    """What is another once a file was written, also by one who keeps its size and restores its date: the time at which
    its inode changed cannot be set. For what a process remembers of files; what outlives it is kept by content."""
    stat = os.stat(path)
    return stat.st_mtime_ns, stat.st_ctime_ns, stat.st_size, stat.st_ino


def cache_folder() -> Path:
    """``VEHSIM_CACHE``, or else the platform's cache folder."""
    if folder := os.environ.get("VEHSIM_CACHE"):
        return Path(folder).expanduser()
    import platformdirs

    return Path(platformdirs.user_cache_dir("vehsim", appauthor=False))


def kept(kind: str, key: object, make: Callable[[], bytes]) -> bytes:
    """What ``make`` gives, kept for other processes under all that it depends on. Safe under concurrent writers, and
    made again when the entry is damaged. ``kind``: to be changed with what ``make`` does.
    """
    found = recalled(kind, key)
    return keep(kind, key, make()) if found is None else found


def recalled(kind: str, key: object) -> bytes | None:
    """What a process was told to `keep`, None where there is nothing."""
    file = _entry(kind, key)
    with suppress(OSError):
        content = file.read_bytes()
        if sha256(content[:-SEAL]).digest() == content[-SEAL:]:
            with suppress(OSError):  # a cache that may only be read
                os.utime(file)  # used now: `shrink` spares it
            return content[:-SEAL]
        warnings.warn(f"{file}: damaged cache entry, made again", stacklevel=3)
    return None


def keep(kind: str, key: object, made: bytes) -> bytes:
    """Keep what was ``made`` for all processes, and return it."""
    file = _entry(kind, key)
    try:
        file.parent.mkdir(parents=True, exist_ok=True)
        beside = file.with_name(f".{file.name}.{secrets.token_hex(4)}.tmp")
        try:
            beside.write_bytes(made + sha256(made).digest())
            beside.replace(file)
        finally:
            beside.unlink(missing_ok=True)
    except OSError as error:
        reason = error.strerror or type(error).__name__
        warnings.warn(f"{file.parent}: {kind}: could not be kept ({reason}); made again each time", stacklevel=3)
    return made


def shrink(kind: str, most: int) -> None:
    """Remove entries of ``kind``, those not used for longest first, until they take at most ``most`` bytes."""
    entries = []
    with suppress(OSError):
        for file in cache_folder().glob(f"{kind}-*"):
            with suppress(OSError):  # another process was quicker
                stat = file.stat()
                entries.append((stat.st_mtime_ns, stat.st_size, file))
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
    """Arrays that follow from others, `kept` under these: convex hulls, whose library takes half a second to load."""
    digest = sha256()
    for array in made_from:
        digest.update(repr((array.shape, array.dtype.str)).encode() + np.ascontiguousarray(array).tobytes())
    return unpacked(kept(kind, digest.hexdigest(), lambda: packed(make())))


def packed(arrays: Sequence[NDArray[Any]]) -> bytes:
    """Arrays as bytes, to be kept; `unpacked` gives them back."""
    buffer = BytesIO()
    np.savez(buffer, *arrays)
    return buffer.getvalue()


def unpacked(content: bytes) -> list[NDArray[Any]]:
    """Arrays that were `packed`."""
    with np.load(BytesIO(content), allow_pickle=False) as arrays:
        return [arrays[f"arr_{k}"] for k in range(len(arrays.files))]


SEAL = 32
"""Bytes at the end of what is `kept`: the checksum of those before."""


def seal(at: Path, holds: Mapping[str, bytes]) -> None:
    """Write to ``at`` what the files beside it, by name, are to hold: before they are there, or others take them for
    damaged."""
    beside = at.with_name(f".{at.name}.{os.getpid()}.tmp")
    beside.write_text(json.dumps({name: sha256(content).hexdigest() for name, content in holds.items()}))
    beside.replace(at)


def is_whole(at: Path) -> bool:
    """Do the files hold what ``at`` says? A power cut may leave some of the right size that never reached the disk."""
    try:
        holds = json.loads(at.read_text())
        return all(sha256((at.parent / name).read_bytes()).hexdigest() == digest for name, digest in holds.items())
    except (OSError, ValueError, AttributeError):
        return False


SOURCE = "vehsim:source"
"""Key of a cached layer's custom data: the file it was made of."""


def made_of(asset: str | Path) -> str:
    """The file that a user knows: what a layer in the cache was made of, or itself."""
    from pxr import Sdf

    return str(Sdf.Layer.FindOrOpen(str(asset)).customLayerData.get(SOURCE, asset))
