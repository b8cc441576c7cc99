"""Vehicles and terrains that ship with vehsim, and the scripts that generate them."""

from __future__ import annotations

from pathlib import Path


def shipped(kind: str) -> dict[str, Path]:
    """Name -> description file of what ships: ``kind`` is "vehicle" or "terrain"."""
    found = Path(__file__).parent.glob(f"{kind}s/*/{kind}.toml")
    return {file.parent.name: file for file in sorted(found)}
