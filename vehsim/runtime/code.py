"""Versions and a hash of the running code; results cached or resumed by content depend on it."""

from __future__ import annotations

import platform
from collections.abc import Sequence
from functools import cache
from hashlib import sha256
from importlib import metadata
from pathlib import Path

from vehsim.runtime.registry import extensions

PACKAGES = ("vehsim", "mujoco", "usd-core", "casadi", "numpy", "scipy", "av", "pillow")
VEHSIM = Path(__file__).parents[1]


@cache
def version(package: str) -> str | None:
    """A package's version, None if it is not installed."""
    try:
        return metadata.version(package)
    except metadata.PackageNotFoundError:
        return None


def code(homes: Sequence[Path] = (VEHSIM,)) -> str:
    """A hash of the sources below ``homes`` and of extending packages, Python, the machine's type and libraries."""
    return _code((*homes, *extensions()))


@cache
def _code(homes: tuple[Path, ...]) -> str:
    machine = (platform.python_version(), platform.machine())
    digest = sha256(repr((machine, [(package, version(package)) for package in PACKAGES])).encode())
    for home in homes:
        for path in sorted(home.rglob("*.py")) if home.is_dir() else [home]:
            digest.update(path.relative_to(home).as_posix().encode() + path.read_bytes())
    return digest.hexdigest()
