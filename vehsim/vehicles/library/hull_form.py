"""Particulars of a hull, measured on its mesh where the ``vehicle.toml`` does not give them."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vehsim.constants import SEA_WATER
from vehsim.errors import InputError

Array = NDArray[np.float64]

AFT = np.linspace(0.05, 0.5, 10)
"""Sections at which the bottom is measured, from the transom, over the length of the waterline."""
ACROSS = 80
"""Points from the keel to the side of a section."""
STEEP = 1.0
"""The bottom ends, at its chine, where a section rises more steeply than this."""


def particulars(points: Array, faces: NDArray[np.int64], mass: float, planing: bool) -> dict[str, Any]:
    """``wetted_length`` and ``wetted_area`` of a hull (n, 3) m, relative to the centre of mass, that floats upright in
    sea water; if ``planing``, also ``chine_beam``, ``deadrise`` and ``transom``. See `vehsim.vehicles.models.boat`.

    Raises ``InputError`` if the mesh is open, if it does not float, or if it has no keel amidships.
    """
    import manifold3d
    from scipy.optimize import brentq

    solid = manifold3d.Manifold(manifold3d.Mesh64(points, faces.astype(np.uint64)))
    if solid.is_empty():
        raise InputError(f"it cannot be measured: {solid.status()}", "give its particulars in physics", key="hull_form")
    low, high = points[:, 2].min(), points[:, 2].max()
    if solid.volume() <= mass / SEA_WATER:
        raise InputError("the hull does not float", "lower physics.mass, or give it a larger hull", key="hull_form")

    def below(height: float) -> Any:
        return solid.trim_by_plane((0.0, 0.0, -1.0), -height)

    line = brentq(lambda height: below(height).volume() - mass / SEA_WATER, low, high, xtol=1e-9)
    wet = below(line)
    first, _, _, last, _, _ = wet.bounding_box()
    found: dict[str, Any] = {
        "wetted_length": last - first,
        "wetted_area": wet.surface_area() - solid.slice(line).area(),
    }
    if planing:
        lengthwise = manifold3d.Manifold(manifold3d.Mesh64(points[:, [1, 2, 0]], faces.astype(np.uint64)))
        sections = np.array([_bottom(lengthwise, first + share * (last - first)) for share in AFT])
        beam, rise, keel = sections.T
        found["chine_beam"] = 2 * float(beam.mean())
        found["deadrise"] = math.atan(float(np.mean(rise / beam)))
        along = AFT * (last - first)
        found["transom"] = [first, float(np.polyval(np.polyfit(along, keel, 1), 0.0))]
    return {key: np.round(value, 4).tolist() for key, value in found.items()}


def _bottom(lengthwise: Any, x: float) -> tuple[float, float, float]:
    """Half of the beam between the chines, the rise to the chine of a straight bottom with the same area, and the
    height of the keel of the section at ``x``; the solid's axes are Y, Z, X."""
    rings = lengthwise.slice(x).to_polygons()
    ends = np.concatenate([np.stack([ring, np.roll(ring, -1, axis=0)], axis=1) for ring in rings])
    side = float(ends[:, :, 0].max())
    y = np.linspace(1e-3 * side, 0.999 * side, ACROSS)
    (ya, za), (yb, zb) = ends[:, 0].T, ends[:, 1].T
    share = (y[:, None] - ya) / np.where(np.abs(yb - ya) < 1e-12, np.inf, yb - ya)
    heights = np.where((share >= 0) & (share <= 1) & (np.abs(yb - ya) > 1e-12), za + share * (zb - za), np.inf)
    low = heights.min(axis=1)
    if not np.isfinite(low[0]) or low[0] > low.min() + 0.05 * side:
        raise InputError(
            "its bottom is not one keel with two chines",
            "give physics.chine_beam, deadrise and transom of one of its hulls, or leave hull_form out",
            key="hull_form",
            value="planing",
        )
    steep = np.flatnonzero(~(np.diff(low) < STEEP * np.diff(y)))
    chine = int(steep[0]) if len(steep) else ACROSS - 1
    width = float(y[max(chine, 1)])
    area = float(np.trapezoid(low[: chine + 1] - low[0], y[: chine + 1]))
    return width, 2 * area / width, float(low[0])
