"""Where vehsim keeps what it can make again: distance fields, converted assets. Safe to delete at any time."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping
from hashlib import sha256
from pathlib import Path


def cache_folder() -> Path:
    """``VEHSIM_CACHE``, or else the platform's cache folder."""
    if folder := os.environ.get("VEHSIM_CACHE"):
        return Path(folder).expanduser()
    import platformdirs

    return Path(platformdirs.user_cache_dir("vehsim", appauthor=False))


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
