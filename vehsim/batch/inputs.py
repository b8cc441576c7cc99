"""What a clip is made of, as one hash, and whether a folder holds the finished clip of that hash.

Nothing here trusts a date or a file's presence: inputs are hashed, and so is every file of a delivery.
"""

from __future__ import annotations

import hashlib
import json
import platform
from collections.abc import Iterable, Sequence
from functools import cache, lru_cache
from pathlib import Path
from typing import Any

from vehsim import __version__, exporters
from vehsim.delivery import GROUP, SIGN, entries, in_order
from vehsim.exporters.packing import _dependencies
from vehsim.exporters.report import PACKAGES, sha256, version
from vehsim.shot import Shot


def fingerprint(shot: Shot, to: Sequence[str], draft: bool = False) -> str:
    """A hash of all that decides the bytes of a clip: shot, the files it names, exporters, and the code itself."""
    file = shot.file.model_copy(update={"sweep": None})
    made_of = {
        "code": code(),
        "shot": file.model_dump(mode="json", by_alias=True),
        "files": [_content(path) for path in _files(shot)],
        "world": shot.world.content_hash,
        "to": [_exporter(exporter.name) for exporter in in_order(to)],
        "draft": draft,
    }
    return hashlib.sha256(json.dumps(made_of, sort_keys=True).encode()).hexdigest()


def is_finished(folder: Path, inputs: str, to: Sequence[str] = ()) -> bool:
    """Does ``folder`` hold the whole clip of these inputs? Every file is read and held against its hash.

    ``to``: the exporters in question; what others delivered beside them is not looked at.
    """
    try:
        report = json.loads((folder / SIGN).read_text(encoding="utf-8"))
        files, solved = report["files"], report["solved"]
        made = solved.get("exporters", {})
        sources = [made[name]["inputs"] for name in to] or [solved["inputs"]]
        others = {file for name, one in made.items() if name not in to for file in one["files"]} if to else set()
        return set(sources) == {inputs} and all(sha256(folder / name) == files[name] for name in files.keys() - others)
    except (OSError, ValueError, KeyError, TypeError, AttributeError):
        return False


def _files(shot: Shot) -> Iterable[Path]:
    """The files of a shot beside its own and its world's: rigs and looks with all they refer to, clips."""
    for table in shot.file.vehicle:
        rig = shot.vehicle(table).rig
        if rig is not None:
            yield (rig.folder or rig.asset.parent) / "vehicle.toml"
            yield from _with_dependencies(rig.asset, rig.asset.stat().st_mtime_ns)
        path = getattr(table.motion, "path", None)
        if path is not None:
            yield shot.folder / path
    for blocking in shot.blockings().values():
        yield from _with_dependencies(blocking.path, blocking.path.stat().st_mtime_ns)
    terrain = shot.world.terrain
    if terrain is not None and terrain.look is not None:
        yield from _with_dependencies(terrain.look, terrain.look.stat().st_mtime_ns)


@lru_cache(maxsize=64)
def _with_dependencies(asset: Path, changed: int) -> tuple[Path, ...]:
    return tuple(_dependencies(Path(asset).resolve())[0])


def _content(path: Path) -> str | None:
    """The hash of a file's bytes, None when it is not there; its name belongs to the file that refers to it."""
    try:
        stat = path.stat()
    except OSError:
        return None
    return _hash(path, stat.st_mtime_ns, stat.st_size)


@lru_cache(maxsize=1024)
def _hash(path: Path, changed: int, size: int) -> str:
    return sha256(path)


@cache
def code() -> str:
    """The code at work and what it stands on: another version may well give other bytes."""
    digest = hashlib.sha256(repr((__version__, platform.python_version(), platform.machine())).encode())
    digest.update(repr([(package, version(package)) for package in PACKAGES]).encode())
    for home in (Path(__file__).parents[1], Path(str(exporters.__file__)).parent):
        for path in sorted(home.rglob("*.py")):
            digest.update(path.relative_to(home).as_posix().encode() + path.read_bytes())
    return digest.hexdigest()


@cache
def _exporter(name: str) -> Any:
    """An exporter's name with the version of the package it comes from: a studio's own may change without us."""
    entry = next(entry for entry in entries(GROUP) if entry.name == name)
    return [name, entry.value, entry.dist.version if entry.dist else None]
