"""The code at work, as versions and one hash: what is kept or resumed by content depends on it too."""

from __future__ import annotations

import platform
from collections.abc import Sequence
from functools import cache
from hashlib import sha256
from importlib import metadata
from pathlib import Path

PACKAGES = ("vehsim", "mujoco", "usd-core", "casadi", "numpy", "scipy", "av", "pillow")
VEHSIM = Path(__file__).parent


def version(package: str) -> str | None:
    """A package's version, None where it is not installed."""
    try:
        return metadata.version(package)
    except metadata.PackageNotFoundError:
        return None


def code(homes: Sequence[Path] = (VEHSIM,)) -> str:
    """A hash of the sources below ``homes``, Python, the machine's type and the packages they stand on."""
    return _code(tuple(homes))


@cache
def _code(homes: tuple[Path, ...]) -> str:
    machine = (platform.python_version(), platform.machine())
    digest = sha256(repr((machine, [(package, version(package)) for package in PACKAGES])).encode())
    for home in homes:
        for path in sorted(home.rglob("*.py")):
            digest.update(path.relative_to(home).as_posix().encode() + path.read_bytes())
    return digest.hexdigest()
