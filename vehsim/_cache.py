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
