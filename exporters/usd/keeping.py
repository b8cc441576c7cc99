"""Vehicles that an export left out stay in the shot's stage, with their guides, as they were delivered before."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any


def keep_vehicles(earlier: Path, new: Path, names: Sequence[str]) -> Mapping[Path, bytes]:
    """The content of those files of the delivery ``new`` that must also show the vehicles ``names`` of ``earlier``.

    These are the stage and the guides. The vehicles' layers are brought along by other code.
    """
    shot = earlier.name
    with TemporaryDirectory() as folder:
        scratch = Path(folder)
        changed = {
            new / f"{shot}.usda": _with(
                earlier, new, f"{shot}.usda", f"/{shot}/vehicles", lambda n: n in names, scratch
            ),
            new / "layers" / "guides.usdc": _with(
                earlier, new, "layers/guides.usdc", "/guides", lambda n: n.rpartition("_")[0] in names, scratch
            ),
        }
    return {path: content for path, content in changed.items() if content is not None}


def _with(earlier: Path, new: Path, file: str, scope: str, wanted: Any, scratch: Path) -> bytes | None:
    """A layer of ``new`` with the wanted prims of a scope that only the same layer of ``earlier`` has."""
    from pxr import Sdf

    if not ((earlier / file).is_file() and (new / file).is_file()):
        return None
    before, after = (Sdf.Layer.OpenAsAnonymous(str(folder / file)) for folder in (earlier, new))
    prims, there = (layer.GetPrimAtPath(scope) for layer in (before, after))
    if not prims or not there:
        return None
    for name in sorted({*prims.nameChildren.keys()} - {*there.nameChildren.keys()}):
        if wanted(name):
            path = f"{scope}/{name}"
            Sdf.CopySpec(before, path, after, path)
    after.startTimeCode = min(before.startTimeCode, after.startTimeCode)
    after.endTimeCode = max(before.endTimeCode, after.endTimeCode)
    written = scratch / Path(file).name
    after.Export(str(written))
    return written.read_bytes()
