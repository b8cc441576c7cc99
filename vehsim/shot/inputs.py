"""The files of a shot's motion, identified by their content. Dates only avoid reading a file twice."""

from __future__ import annotations

from collections.abc import Iterable
from functools import lru_cache
from hashlib import file_digest
from pathlib import Path

from vehsim.intake.usd import dependencies
from vehsim.runtime.cache import Stamp, stamp


def with_dependencies(asset: Path) -> tuple[Path, ...]:
    """A USD file and all its references, examined again once one of them was written."""
    stamps, files = _found.get(asset, ((), ()))
    if not files or _stamps(files) != stamps:
        files = tuple(dependencies(asset.resolve())[0])
        _found[asset] = (_stamps(files), files)
    return files


_found: dict[Path, tuple[tuple[Stamp | None, ...], tuple[Path, ...]]] = {}
"""The results of `with_dependencies`."""


def _stamps(files: Iterable[Path]) -> tuple[Stamp | None, ...]:
    return tuple(stamp(file) if file.exists() else None for file in files)


def content_of(path: Path) -> str | None:
    """The hash of a file's bytes, None if it does not exist; its name belongs to the file that refers to it."""
    try:
        return _hash(path, stamp(path))
    except OSError:
        return None


@lru_cache(maxsize=1024)
def _hash(path: Path, written: Stamp) -> str:
    with path.open("rb") as file:
        return file_digest(file, "sha256").hexdigest()
