"""Vehicles by name or folder: ``vehicle.toml``, imported assets, mass from geometry."""

from __future__ import annotations

from typing import TYPE_CHECKING

from vehsim.runtime.lazy import attach

if TYPE_CHECKING:
    from vehsim.vehicles.library.library import available as available
    from vehsim.vehicles.library.library import load_vehicle as load_vehicle

_PUBLIC = {
    "available": "vehsim.vehicles.library.library",
    "load_vehicle": "vehsim.vehicles.library.library",
}
__all__ = ["available", "load_vehicle"]

# Loaded at first use: heavy libraries are loaded only when they are needed.
__getattr__, __dir__ = attach(__name__, _PUBLIC)
