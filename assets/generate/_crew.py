"""Drivers and pilots, their clothes, and what is visible of a cabin through glass: lining, seats, steering wheel.

This module holds what several vehicles share; each vehicle's script places it. `_figure.py` shapes the figures.
"""

from __future__ import annotations

from types import MappingProxyType

import numpy as np
from numpy.typing import ArrayLike

from vehsim.assets.generate._figure import bare_head, head, seated
from vehsim.assets.generate._shapes import Surface, aimed, box, join, revolve, torus, tube
from vehsim.assets.generate._slim import slimmed
from vehsim.assets.generate._usd import Material

DRIVER = "driver_"
"""Prefix of the names of a figure's materials."""
ABOARD = MappingProxyType({"driver": {"aboard": "", "none": DRIVER}})
"""A variant set -> its variants -> the prefix of the names of materials that the variant leaves out."""

_DARK = {
    "belt": Material((0.02, 0.02, 0.021), roughness=0.6),
    "strap": Material((0.02, 0.02, 0.021), roughness=0.6),
    "glove": Material((0.03, 0.031, 0.034), roughness=0.8),
    "skin": Material((0.42, 0.23, 0.15), roughness=0.55),
    "goggles": Material((0.012, 0.014, 0.018), roughness=0.06, clearcoat=1.0),
}
SPRAY_WEAR = {
    **_DARK,
    "jacket": Material((0.72, 0.10, 0.015), roughness=0.6),
    "accent": Material((0.70, 0.70, 0.62), roughness=0.4),
    "trim": Material((0.02, 0.022, 0.026), roughness=0.7),
    "trousers": Material((0.030, 0.042, 0.075), roughness=0.85),
    "boot": Material((0.70, 0.69, 0.66), roughness=0.6),
    "sole": Material((0.10, 0.10, 0.10), roughness=0.7),
    "helmet": Material((0.75, 0.74, 0.70), roughness=0.3, clearcoat=0.8),
}
FLIGHT_WEAR = {
    **SPRAY_WEAR,
    "jacket": Material((0.20, 0.215, 0.12), roughness=0.75),
    "accent": Material((0.80, 0.36, 0.035), roughness=0.5),
    "trousers": Material((0.17, 0.185, 0.105), roughness=0.8),
    "boot": Material((0.03, 0.028, 0.026), roughness=0.6),
}
STREET_WEAR = {
    **SPRAY_WEAR,
    "jacket": Material((0.60, 0.55, 0.46), roughness=0.8),
    "accent": Material((0.52, 0.46, 0.37), roughness=0.8),
    "trim": Material((0.30, 0.26, 0.20), roughness=0.8),
    "glove": _DARK["skin"],
    "hair": Material((0.035, 0.020, 0.012), roughness=0.6),
}

_FEET = ("boot", "sole", "strap")


def driver_materials(wear: dict[str, Material]) -> dict[str, Material]:
    """The materials of a figure with the clothes ``wear``, by their names in an asset."""
    return {f"{DRIVER}{name}": material for name, material in wear.items()}


def driver(
    hips: ArrayLike,
    hands: ArrayLike,
    ankles: ArrayLike,
    lean: float,
    left_hand: ArrayLike | None = None,
    helmet: bool = True,
    close: bool = True,
) -> dict[str, Surface]:
    """A figure at ``hips`` (3,), the middle between its hip joints, m, facing X; other arguments as in `seated`.

    ``close``: for near views; otherwise, for views through glass, it is coarser and has no feet.
    """
    ahead = np.array([[0.0, 1, 0], [-1, 0, 0], [0, 0, 1]])  # the figure's X is to its right, its Y ahead
    figure = seated(hands, ankles, lean, left_hand, head() if helmet else bare_head())
    worn = [name for name in figure if close or name not in _FEET]
    look = {f"{DRIVER}{name}": figure[name].turned(ahead).moved(hips) for name in worn}
    return slimmed(look, 0.0012) if close else slimmed(look, 0.002, shade=14.0)


def lining(skin: Surface, depth: float) -> Surface:
    """The inside of a cabin: ``skin`` moved inwards by ``depth`` m and facing inwards."""
    return Surface(skin.points - depth * skin.normals, -skin.normals, skin.faces[:, ::-1])


def seat(hips: ArrayLike, recline: float, width: float = 0.50, headrest: bool = True) -> Surface:
    """A bucket seat for a figure with its hips at ``hips``, with its back ``recline`` rad from upright."""
    lean = aimed([np.cos(recline), 0.0, np.sin(recline)])
    back = box([0.13, width - 0.02, 0.58], bevel=0.05, steps=2).turned(lean)
    up, at = lean @ [0.0, 0.0, 1.0], np.asarray(hips, float)
    spine, cushion = at + np.array([-0.17, 0.0, -0.06]), at + np.array([0.12, 0.0, -0.165])
    parts = [box([0.52, width, 0.14], cushion, 0.05, 2), back.moved(spine + 0.27 * up)]
    parts += [
        box([0.50, 0.09, 0.10], cushion + np.array([0.0, s * (width / 2 - 0.03), 0.075]), 0.04, 2) for s in (-1, 1)
    ]
    if headrest:
        parts.append(box([0.09, 0.25, 0.17], bevel=0.04, steps=2).turned(lean).moved(spine + 0.68 * up))
    return join(*parts)


def steering_wheel(at: ArrayLike, tilt: float, radius: float = 0.18) -> Surface:
    """A wheel with three spokes on its column, with its face tilted up by ``tilt`` rad."""
    hoop = torus(radius, 0.015, 28, "x", 6)
    ends = [[0.0, radius * np.cos(t), radius * np.sin(t)] for t in (0.15, np.pi - 0.15, -1.57)]
    spokes = [tube([[0.0, 0, 0], end], 0.013, 6) for end in ends]
    boss = revolve([(0.0, -0.03), (0.07, -0.02), (0.06, 0.02), (0.0, 0.03)], 12, "x")
    column = tube([[0.0, 0, 0], [-0.35, 0, 0]], 0.03, 8)
    out = aimed([-np.cos(tilt), 0.0, np.sin(tilt)])
    return join(hoop, *spokes, boss, column).turned(out).moved(at)
