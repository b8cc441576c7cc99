"""Generate the hills: grassy downs with a dirt track over them, as a height field of about 6e4 triangles.

Heights are smooth noise, so that curvature is that of hills and not of cells; a rim of higher ground hides the start of
the downs beyond, which are only visible. A car can follow the curve of the track at a good pace. Run from the
repository: ``python -m vehsim.assets.generate.hills``.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline
from scipy.spatial import cKDTree

from vehsim.assets.generate._noise import fractal, gradient_noise
from vehsim.assets.generate._terrain_look import (
    Sheet,
    at_texels,
    horizon_sheet,
    sheet,
    texels,
    write_look,
    write_picture,
)
from vehsim.world.terrain.terrain import Terrain

Array = NDArray[np.float64]

FOLDER = Path(__file__).parents[1] / "terrains" / "hills"
CELL = 1.25
COUNT = 193
ORIGIN = (-120.0, -120.0)
PICTURE = 3072

TRACK = np.array([
    (-92, -34), (-66, -30), (-42, -12), (-24, 14), (2, 24), (24, 8), (38, -18), (64, -26), (92, -8),
], dtype=float)  # fmt: skip
"""The dirt track, m: the path of `examples/car_over_hills.toml`."""


def heights(x: Array, y: Array) -> Array:
    """Heights (...,) m at ``x``, ``y`` (...,) m."""
    xy = np.stack([x, y], axis=-1)
    downs = 6.5 * gradient_noise(xy / 52, 7) + 1.6 * gradient_noise(xy / 23, 8)
    swells = 0.22 * gradient_noise(xy / 9, 9)
    out = np.maximum(0.0, np.hypot(x, y) - 78) / 42
    rim = 11.0 * out**2 * (1.0 + 0.8 * gradient_noise(xy / 40, 10))
    return np.asarray(downs + swells + rim)


def country(xy: Array) -> Array:
    """Heights (...,) m of the downs beyond: rising slowly with the distance, low enough to leave some sky."""
    far = np.clip((np.hypot(xy[..., 0], xy[..., 1]) - 120) / 900, 0, 1)
    rolling = gradient_noise(xy / 260, 11) + 0.4 * gradient_noise(xy / 90, 12)
    return np.asarray(6 + 6 * far + (8 + 13 * far) * rolling)


def grass(place: Array, fine: Array) -> Array:
    """Grass (n, 3) at ``place`` (n, 3) m, drier on the tops; ``fine`` (n,): the contribution of single tufts."""
    xy = place[:, :2]
    dry = np.clip(0.45 + 0.07 * place[:, 2] + 0.9 * fractal(xy / 14, 3, 23), 0, 1)[:, None]
    colour = (1 - dry) * np.array([0.29, 0.335, 0.15]) + dry * np.array([0.50, 0.455, 0.235])
    return np.asarray(colour * (1 + fine + 0.12 * fractal(xy / 3.2, 2, 25))[:, None])


def far_colours(surface: Sheet, size: int) -> Array:
    """The downs beyond, (size^2, 3): grass in fields and dark copses, without invisible detail."""
    face, weights = texels(surface, size)
    place = at_texels(surface.points, surface, face, weights)
    xy = place[:, :2]
    level = place * [1, 1, 0.15]  # high ground far away is not drier
    colour = grass(level, 0.10 * fractal(xy / 24, 3, 28))
    copse = np.clip(6 * (fractal(xy / 75, 3, 29) - 0.22), 0, 1)[:, None]
    return np.asarray(colour * (1 - copse) + np.array([0.145, 0.185, 0.095]) * copse)


def colours(surface: Sheet, terrain: Terrain) -> Array:
    """Grass and two ruts of earth: (PICTURE^2, 3), 0 to 1, in sRGB."""
    face, weights = texels(surface, PICTURE)
    place = at_texels(terrain.vertices, surface, face, weights)
    xy = place[:, :2]
    chord = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(TRACK, axis=0), axis=1))])
    curve = CubicSpline(chord, TRACK)(np.arange(-15, chord[-1] + 15, 0.15))
    aside, _ = cKDTree(curve).query(xy, distance_upper_bound=4.0)
    aside = np.minimum(aside, 4.0) + 0.12 * gradient_noise(xy / 1.1, 21)
    fine = gradient_noise(xy / 0.16, 24)
    green = grass(place, 0.20 * gradient_noise(xy / 0.45, 22) + 0.16 * fine)
    earth = np.array([0.47, 0.375, 0.27]) * (1 + 0.10 * fine + 0.12 * fractal(xy / 1.7, 2, 26))[:, None]
    rut = np.exp(-(((aside - 0.78) / 0.30) ** 4))
    worn = 0.55 * np.exp(-((aside / 1.5) ** 4))
    bare = np.clip(rut + worn * (0.6 + 0.8 * gradient_noise(xy / 0.8, 27)), 0, 1)[:, None]
    return np.asarray((1 - bare) * green + bare * earth)


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
    horizon = horizon_sheet(terrain, country)
    write_picture(FOLDER / "hills_horizon.jpg", far_colours(horizon, PICTURE // 4), PICTURE // 4, 85)
    looks = {"ground": (ground, "hills_ground.jpg", 0.95), "horizon": (horizon, "hills_horizon.jpg", 1.0)}
    write_look(FOLDER / "hills.usdc", looks)


if __name__ == "__main__":
    main()
