"""Generate the hills: grassy downs with a dirt track over them, as a height field of about 6e4 triangles.

Heights are smooth noise, so that curvature is that of hills and not of cells; a rim of higher ground closes the
horizon. The track is a curve that a car can follow at a good pace. Run from the repository:
``python -m vehsim.assets.generate.hills``.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline
from scipy.spatial import cKDTree

from vehsim.assets.generate._noise import fractal, gradient_noise
from vehsim.assets.generate._terrain_look import at_texels, sheet, texels, write_look, write_picture
from vehsim.world import Terrain

Array = NDArray[np.float64]

FOLDER = Path(__file__).parents[1] / "terrains" / "hills"
CELL = 1.25
COUNT = 193
ORIGIN = (-120.0, -120.0)
PICTURE = 3072

TRACK = np.array([
    (-92, -34), (-66, -30), (-42, -12), (-24, 14), (2, 24), (24, 8), (38, -18), (64, -26), (92, -8),
], dtype=float)  # fmt: skip
"""The dirt track, m: what `examples/car_over_hills.toml` drives along."""


def heights(x: Array, y: Array) -> Array:
    """Heights (...,) m at ``x``, ``y`` (...,) m."""
    xy = np.stack([x, y], axis=-1)
    downs = 6.5 * gradient_noise(xy / 52, 7) + 1.6 * gradient_noise(xy / 23, 8)
    swells = 0.22 * gradient_noise(xy / 9, 9)
    out = np.maximum(0.0, np.hypot(x, y) - 78) / 42
    rim = 11.0 * out**2 * (1.0 + 0.8 * gradient_noise(xy / 40, 10))
    return np.asarray(downs + swells + rim)


def colours(surface: object, terrain: Terrain) -> Array:
    """Grass, drier on the tops, and two ruts of earth: (PICTURE^2, 3), 0 to 1, as seen."""
    face, weights = texels(surface, PICTURE)  # type: ignore[arg-type]
    place = at_texels(terrain.vertices, surface, face, weights)  # type: ignore[arg-type]
    xy = place[:, :2]
    chord = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(TRACK, axis=0), axis=1))])
    curve = CubicSpline(chord, TRACK)(np.arange(-15, chord[-1] + 15, 0.15))
    aside, _ = cKDTree(curve).query(xy, distance_upper_bound=4.0)
    aside = np.minimum(aside, 4.0) + 0.12 * gradient_noise(xy / 1.1, 21)
    tuft, patch = gradient_noise(xy / 0.45, 22), fractal(xy / 14, 3, 23)
    fine = gradient_noise(xy / 0.16, 24)
    dry = np.clip(0.45 + 0.07 * place[:, 2] + 0.9 * patch, 0, 1)[:, None]
    grass = (1 - dry) * np.array([0.29, 0.335, 0.15]) + dry * np.array([0.50, 0.455, 0.235])
    grass = grass * (1 + 0.20 * tuft + 0.16 * fine + 0.12 * fractal(xy / 3.2, 2, 25))[:, None]
    earth = np.array([0.47, 0.375, 0.27]) * (1 + 0.10 * fine + 0.12 * fractal(xy / 1.7, 2, 26))[:, None]
    rut = np.exp(-(((aside - 0.78) / 0.30) ** 4))
    worn = 0.55 * np.exp(-((aside / 1.5) ** 4))
    bare = np.clip(rut + worn * (0.6 + 0.8 * gradient_noise(xy / 0.8, 27)), 0, 1)[:, None]
    return np.asarray((1 - bare) * grass + bare * earth)


def main() -> None:
    """Write heights, picture and the USD look."""
    FOLDER.mkdir(parents=True, exist_ok=True)
    x = ORIGIN[0] + CELL * np.arange(COUNT)
    made = heights(*np.meshgrid(x, x)).astype(np.float32)
    np.savez_compressed(FOLDER / "heights.npz", heights=made)
    terrain = Terrain("hills", made.astype(float), ORIGIN, (CELL, CELL))
    st = (terrain.vertices[:, :2] - ORIGIN) / (CELL * (COUNT - 1))
    ground = sheet(terrain.vertices, terrain.faces, st)
    write_picture(FOLDER / "hills_ground.jpg", colours(ground, terrain), PICTURE, 82)
    write_look(FOLDER / "hills.usdc", {"ground": (ground, "hills_ground.jpg", 0.95)})


if __name__ == "__main__":
    main()
