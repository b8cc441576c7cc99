"""The hash of everything that a clip is made of, and whether a folder contains the finished clip of that hash.

Dates and the presence of a file prove nothing: inputs are hashed, and so is every file of a delivery.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable, Sequence
from functools import cache
from pathlib import Path
from typing import Any

from vehsim import exporters
from vehsim.delivery.exporters import GROUP, in_order
from vehsim.delivery.folders import SIGN
from vehsim.exporters.tables.report import sha256
from vehsim.intake.usd import dependencies
from vehsim.runtime.cache import content_of
from vehsim.runtime.code import VEHSIM, code
from vehsim.runtime.registry import entries
from vehsim.shot import Shot


def fingerprint(shot: Shot, to: Sequence[str], draft: bool = False) -> str:
    """A hash of everything that determines the bytes of a clip: shot, the files that it names, exporters, and
    the code."""
    file = shot.file.model_copy(update={"sweep": None})
    made_of = {
        "code": code((VEHSIM, Path(str(exporters.__file__)).parent)),
        "shot": file.model_dump(mode="json", by_alias=True),
        "files": [content_of(path) for path in _files(shot)],
        "world": shot.world.content_hash,
        "to": [_exporter(exporter.name) for exporter in in_order(to)],
        "draft": draft,
    }
    return hashlib.sha256(json.dumps(made_of, sort_keys=True).encode()).hexdigest()


def is_finished(folder: Path, inputs: str, to: Sequence[str] = ()) -> bool:
    """Whether ``folder`` contains the complete clip of these inputs. Every file is read and compared with its hash.

    ``to``: the relevant exporters; files of others are ignored.
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
    """The files of a shot in addition to its own and its world's: those of its motion, and looks with their
    references, and its timeline."""
    yield from shot.motion_files()
    if shot.file.render.cuts is not None:
        yield shot.folder / shot.file.render.cuts
    terrain = shot.world.terrain
    if terrain is not None and terrain.look is not None:
        yield from dependencies(terrain.look)[0]


@cache
def _exporter(name: str) -> Any:
    """An exporter's name with the version of its package: a studio's package may change independently."""
    entry = next(entry for entry in entries(GROUP) if entry.name == name)
    return [name, entry.value, entry.dist.version if entry.dist else None]
