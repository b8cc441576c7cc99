"""Distances: a smooth field, exact clearances through MuJoCo, and routes through free space."""

from __future__ import annotations

from typing import TYPE_CHECKING

from vehsim.runtime.lazy import attach

if TYPE_CHECKING:
    from vehsim.world.distance.field import DistanceField as DistanceField

_PUBLIC = {
    "DistanceField": "vehsim.world.distance.field",
}
__all__ = ["DistanceField"]

# at their first use: heavy libraries are loaded only when they are needed
__getattr__, __dir__ = attach(__name__, _PUBLIC)
