"""Surfaces under tyres, as shares of dry asphalt."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

SurfaceName = Literal["asphalt", "wet asphalt", "gravel", "snow", "ice"]


@dataclass(frozen=True)
class Surface:
    """What the ground does to a tyre: its peak ``friction`` and its slip ``stiffness`` as shares of those on dry
    asphalt, and the source of both."""

    friction: float
    stiffness: float
    source: str


NOON = "friction: Noon (1994), means of braking tests: {} over 0.65 on dry asphalt"
BURCKHARDT = "stiffness: Burckhardt (1993), slope {} over 30.2"
SURFACES: Mapping[SurfaceName, Surface] = {
    "asphalt": Surface(1.0, 1.0, "the tyre's own coefficients"),
    "wet asphalt": Surface(0.77, 0.95, f"{NOON.format(0.5)}; {BURCKHARDT.format(28.6)}"),
    "gravel": Surface(0.54, 0.6, f"{NOON.format(0.35)}; stiffness: our choice, as on snow, which also shears"),
    "snow": Surface(0.35, 0.6, f"{NOON.format('0.2 to 0.25')}; {BURCKHARDT.format(18.3)}"),
    "ice": Surface(0.19, 0.51, f"{NOON.format('0.1 to 0.15')}; {BURCKHARDT.format(15.3)}"),
}
