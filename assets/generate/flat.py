"""Generate the flat ground: a concrete apron in slabs of 10 m, whose joints make motion visible.

Vehicles have 600 m of it to drive on; the visible ground extends to where haze hides everything. Run from the
repository: ``python -m vehsim.assets.generate.flat``.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from vehsim.assets.generate._noise import fractal, gradient_noise
from vehsim.assets.generate._terrain_look import sheet, write_look, write_picture
from vehsim.world.terrain.terrain import Terrain

Array = NDArray[np.float64]

FOLDER = Path(__file__).parents[1] / "terrains" / "flat"
HALF, CELL = 300.0, 10.0
BEYOND = np.array([320.0, 360.0, 440.0, 600.0, 900.0, 1500.0, 3000.0])
"""Borders of the ever longer slabs of the visible ground, m from the middle."""
SLAB, SLABS = 10.0, 4
"""Size of a slab, m, and number of slabs along the side of the repeating picture: the joints hide its seams."""
PICTURE = 1024
CONCRETE = np.array([0.53, 0.52, 0.50])


def apron_colour(size: int) -> Array:
    """Colours (size^2, 3) of a few slabs, each with its own tone, with joints, aggregate, stains and wear."""
    side = SLAB * SLABS
    u = (np.arange(size) + 0.5) / size * side
    xy = np.stack(np.meshgrid(u, u[::-1]), axis=-1).reshape(-1, 2)
    slab = np.floor(xy / SLAB).astype(int)
    tone = np.random.default_rng(4).normal(0, 0.035, (SLABS, SLABS))[slab[:, 0], slab[:, 1]]
    own = xy + 57.0 * slab  # every slab has its own stains
    stain = 0.06 * fractal(own / 3.5, 4, 1) + 0.05 * fractal(own / 0.45, 2, 2) + 0.05 * gradient_noise(own / 0.09, 3)
    brushed = 0.02 * gradient_noise(own / [2.5, 0.12], 4)
    inside = np.min(np.minimum(xy % SLAB, SLAB - xy % SLAB), axis=1)
    joint = np.clip(1 - (inside - 0.03) / 0.04, 0, 1)
    worn = 0.05 * np.exp(-inside / 0.25)
    grey = 1 + tone + stain + brushed + worn
    warmth = 1 + np.outer(0.5 * tone + 0.02 * fractal(own / 6, 2, 5), [1, 0.2, -1])
    return np.asarray(CONCRETE * grey[:, None] * warmth * (1 - 0.62 * joint)[:, None])


def main() -> None:
    """Write heights, picture and the USD look."""
    FOLDER.mkdir(parents=True, exist_ok=True)
    count = int(2 * HALF / CELL) + 1
    heights = np.zeros((count, count), np.float32)
    np.savez_compressed(FOLDER / "heights.npz", heights=heights)
    terrain = Terrain("flat", heights.astype(float), (-HALF, -HALF), (CELL, CELL))
    x = np.concatenate([-BEYOND[::-1], np.linspace(-HALF, HALF, count), BEYOND])
    whole = np.stack([*np.meshgrid(x, x), np.zeros((len(x), len(x)))], axis=-1).reshape(-1, 3)
    faces = Terrain("flat", np.zeros((len(x), len(x))), (0.0, 0.0), (1.0, 1.0)).faces
    far = faces[np.abs(whole[faces]).max(axis=(1, 2)) > HALF]
    used, far = np.unique(far, return_inverse=True)
    meshes = (terrain.vertices, terrain.faces), (whole[used], far.reshape(-1, 3))
    ground, horizon = (sheet(points, faces, points[:, :2] / (SLAB * SLABS)) for points, faces in meshes)
    write_picture(FOLDER / "flat_ground.jpg", apron_colour(PICTURE), PICTURE)
    looks = {"ground": (ground, "flat_ground.jpg", 0.9), "horizon": (horizon, "flat_ground.jpg", 0.9)}
    write_look(FOLDER / "flat.usdc", looks, wrap="repeat")


if __name__ == "__main__":
    main()
