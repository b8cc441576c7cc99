"""Vehicles and terrains by name: those that ship with vehsim, and those that other packages register."""

from __future__ import annotations

from pathlib import Path

from vehsim.runtime.registry import Registry


def shipped(kind: str) -> dict[str, Path]:
    """Name -> description file of what ships with vehsim: ``kind`` is "vehicle" or "terrain"."""
    found = Path(__file__).parent.glob(f"{kind}s/*/{kind}.toml")
    return {file.parent.name: file for file in sorted(found)}


REGISTRIES: dict[str, Registry[Path]] = {
    kind: Registry(f"vehsim.{kind}s", shipped(kind)) for kind in ("vehicle", "terrain")
}
"""By kind. A package registers the path of a ``vehicle.toml`` or ``terrain.toml``, or of the folder that holds it."""


def described(kind: str) -> dict[str, Path]:
    """Name -> description file of every "vehicle" or "terrain" that has a name; warns of packages that do not load."""
    return {name: _file(kind, path) for name, path in REGISTRIES[kind].loadable()}


def description(kind: str, name: str) -> Path | None:
    """The description file of the "vehicle" or "terrain" called ``name``, None if there is none; ``InputError``."""
    return _file(kind, REGISTRIES[kind][name]) if name in REGISTRIES[kind] else None


def _file(kind: str, path: Path) -> Path:
    path = Path(path)
    return path / f"{kind}.toml" if path.is_dir() else path
