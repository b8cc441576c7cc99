"""The files that a shot's motion is made of, known by their content. No date decides: it only spares reading twice."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from functools import lru_cache
from hashlib import file_digest
from pathlib import Path
from typing import TYPE_CHECKING

from vehsim._cache import Stamp, stamp
from vehsim.intake.usd import dependencies

if TYPE_CHECKING:
    from vehsim.shot.shot import Shot


def motion_files(shot: Shot) -> Iterator[Path]:
    """The files of a shot beside its own and its world's that decide motion: rigs with all they refer to, clips,
    blockings."""
    for table in shot.file.vehicle:
        rig = shot.vehicle(table).rig
        if rig is not None:
            yield (rig.folder or rig.asset.parent) / "vehicle.toml"
            yield from with_dependencies(rig.asset)
        path = getattr(table.motion, "path", None)
        if path is not None:
            yield shot.folder / path
    for blocking in shot.blockings().values():
        yield from with_dependencies(blocking.path)


def with_dependencies(asset: Path) -> tuple[Path, ...]:
    """A USD file and all it refers to, looked through again once one of them was written."""
    stamps, files = _found.get(asset, ((), ()))
    if not files or _stamps(files) != stamps:
        files = tuple(dependencies(asset.resolve())[0])
        _found[asset] = (_stamps(files), files)
    return files


_found: dict[Path, tuple[tuple[Stamp | None, ...], tuple[Path, ...]]] = {}
"""What `with_dependencies` found."""


def _stamps(files: Iterable[Path]) -> tuple[Stamp | None, ...]:
    return tuple(stamp(file) if file.exists() else None for file in files)


def content_of(path: Path) -> str | None:
    """The hash of a file's bytes, None when it is not there; its name belongs to the file that refers to it."""
    try:
        return _hash(path, stamp(path))
    except OSError:
        return None


@lru_cache(maxsize=1024)
def _hash(path: Path, written: Stamp) -> str:
    with path.open("rb") as file:
        return file_digest(file, "sha256").hexdigest()
