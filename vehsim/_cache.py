"""Where vehsim keeps what it can make again: distance fields, converted assets. Safe to delete at any time."""

from __future__ import annotations

import os
from pathlib import Path


def cache_folder() -> Path:
    """``VEHSIM_CACHE``, or else the platform's cache folder."""
    if folder := os.environ.get("VEHSIM_CACHE"):
        return Path(folder).expanduser()
    import platformdirs

    return Path(platformdirs.user_cache_dir("vehsim", appauthor=False))


SOURCE = "vehsim:source"
"""Key of a cached layer's custom data: the file it was made of."""


def made_of(asset: str | Path) -> str:
    """The file that a user knows: what a layer in the cache was made of, or itself."""
    from pxr import Sdf

    return str(Sdf.Layer.FindOrOpen(str(asset)).customLayerData.get(SOURCE, asset))
