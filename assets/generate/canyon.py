"""Generate the canyon: a meandering river cut through layered rock, as a height field of about 1e5 triangles.

The shape follows the process. A river's course and its side gullies give every point a distance from the nearest
channel; a column of strata converts that distance to a height: hard beds stand as cliffs, soft beds as slopes, the foot
is talus. Noise bends the walls into buttresses and alcoves; mesas of the same column stand on the plateau and close the
horizon. Run from the repository: ``python -m vehsim.assets.generate.canyon``.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline
from scipy.ndimage import gaussian_filter
from scipy.spatial import cKDTree

from vehsim.assets.generate._canyon_rock import country, ground_colour, horizon_colour
from vehsim.assets.generate._noise import fractal, gradient_noise, ridged
from vehsim.assets.generate._terrain_look import horizon_sheet, sheet, sky_view, unwrap, write_look, write_picture
from vehsim.world.terrain.terrain import Terrain

Array = NDArray[np.float64]

FOLDER = Path(__file__).parents[1] / "terrains" / "canyon"
CELL = 1.4
SHAPE = (174, 288)
ORIGIN = (-110.0, -101.0)
PICTURE = 2048
FINE = 3
"""Oversampling factor of the heights; they are filtered down, so that cliffs do not alias into saw teeth."""

RIVER = np.array([
    (-97, 58), (-92, 40), (-72, 26), (-45, 15), (-22, 2), (0, -1), (22, 6), (35, 26), (42, 54), (64, 72), (88, 60),
    (97, 28), (104, -8), (124, -30), (149, -22), (160, 6), (180, 40), (206, 56), (230, 44), (241, 14), (254, -14),
    (272, -22),
])  # fmt: skip
"""The river's course, m. A flight from (0, 0, 30) to (180, 40, 28) has four bends."""

GULLIES = [
    [(36, 20), (58, 8), (70, -8), (74, -32), (60, -56)],
    [(62, 72), (60, 92), (44, 112)],
    [(104, 0), (84, -14)],
    [(126, -28), (118, -52), (132, -78)],
    [(150, -20), (176, -38), (206, -44), (222, -66)],
    [(96, 44), (120, 54), (132, 80), (126, 108)],
    [(0, 0), (-4, -26), (-24, -48), (-22, -74)],
    [(-44, 15), (-46, 46), (-24, 70), (-22, 98)],
    [(192, 50), (186, 78), (204, 104)],
    [(242, 14), (222, 2)],
    [(-78, 28), (-92, 4), (-86, -24)],
]
"""Side gullies, from their mouths up."""

# strata from the river up: (thickness m, slope); hard beds are steep, soft beds less so
STRATA = [
    (0.6, 0.25), (5.4, 0.95), (14.0, 9.0), (1.8, 0.45), (13.0, 9.0), (2.6, 0.5), (10.0, 9.0), (3.6, 0.6), (6.0, 8.0),
    (1.2, 0.25), (1.6, 0.06),
]  # fmt: skip
MESA = [(2.5, 0.45), (9.0, 8.0), (1.2, 0.5), (5.0, 7.0), (0.8, 0.08), (0.7, 0.04)]


def profile(strata: list[tuple[float, float]]) -> tuple[Array, Array]:
    """Distance from the foot (n,) and height above it (n,) of a column of ``strata``: the terraced slope."""
    thickness, slope = np.array(strata).T
    return np.concatenate([[0], np.cumsum(thickness / slope)]), np.concatenate([[0], np.cumsum(thickness)])


def polyline(points: Array, spacing: float = 0.5) -> tuple[Array, Array]:
    """A smooth curve through ``points``, sampled densely: its points (n, 2) and arc lengths (n,)."""
    chord = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))])
    curve = CubicSpline(chord, points)(np.arange(0, chord[-1], spacing))
    return curve, np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(curve, axis=0), axis=1))])


def channel_distance(xy: Array) -> tuple[Array, Array]:
    """Distance from the foot of the walls of the nearest channel, positive outside, and the height of its floor, (...,)
    m."""
    river, along = polyline(RIVER.astype(float))
    distance, nearest = cKDTree(river).query(xy)
    station = along[nearest]
    width = 5.6 + 1.6 * gradient_noise(np.stack([station / 34, 0 * station], -1), 5)
    closing = 9.0 * np.maximum(0, 1 - np.minimum(station, along[-1] - station) / 14) ** 2
    beyond = distance - width + closing
    floor = 1.2 + 0.004 * station
    for number, points in enumerate(GULLIES):
        gully, up = polyline(np.array(points, dtype=float))
        distance, nearest = cKDTree(gully).query(xy)
        climb = np.maximum(0, up[nearest] - 10) / (up[-1] - 10)
        # a gully narrows and climbs through the beds to the plateau: its bottom lies ever higher in the column
        rise = 2.0 + 25.0 * climb**0.8 + 0.8 * number % 3
        beyond = smooth_minimum(beyond, distance * (1.05 + 0.35 * climb) - 3.2 * (1 - climb) + rise, 3.0)
    return beyond, floor


def smooth_minimum(a: Array, b: Array, radius: float) -> Array:
    """The smaller of ``a`` and ``b``, rounded where they are within ``radius`` of each other."""
    blend = np.clip(0.5 + 0.5 * (b - a) / radius, 0, 1)
    return b * (1 - blend) + a * blend - radius * blend * (1 - blend)


def canyon_heights(x: Array, y: Array) -> Array:
    """Heights (...,) m at ``x``, ``y`` (...,) m."""
    xy = np.stack([x, y], axis=-1)
    warp = np.stack([fractal(xy / 46, 3, 11), fractal(xy / 46, 3, 12)], axis=-1)
    beyond, floor = channel_distance(xy + 3.2 * warp)
    wall = np.clip(beyond / 6, 0, 1)  # noise fades out on the floor, where it would only make holes
    buttress = 3.6 * (ridged(xy / 19, 2, 21) - 0.55) + 1.3 * (ridged(xy / 7.5, 2, 22) - 0.5)
    beyond = np.minimum(beyond + wall * buttress, 70)
    distance, height = profile(STRATA)
    # each bed weathers back differently: build the wall once to find the bed to which a point belongs
    bed = np.interp(np.maximum(beyond, 0), distance, height)
    recess = 1.8 * fractal(np.stack([x / 13, y / 13, bed / 9], axis=-1), 3, 23)
    beyond = beyond + np.clip((beyond - 6) / 4, 0, 1) * recess
    dip = 1.2 * fractal(xy / 90, 2, 31) + 0.010 * (x - 90)
    ground = floor + dip * wall + np.interp(np.maximum(beyond, 0), distance, height)
    ground += 6.0 * np.clip((beyond - 28) / 14, 0, 1) * (0.5 + fractal(xy / 60, 4, 33))
    ground += mesas(xy, beyond)
    bars = 0.35 * fractal(xy / 7, 3, 41) * (1 - wall) - 0.5 * np.clip(-beyond / 5, 0, 1)
    # rubble below the cliffs, steps worn into the ledges
    rough = 0.30 * fractal(xy / 4.2, 2, 42) * (0.4 + wall)
    return np.asarray(ground + bars + rough)


def mesas(xy: Array, beyond: Array) -> Array:
    """Height (...,) m of the mesas: islands on the plateau and a broken rim that closes the horizon."""
    rows, cols = SHAPE
    low, high = np.array(ORIGIN), np.array(ORIGIN) + CELL * (np.array([cols, rows]) - 1)
    to_edge = np.min(np.minimum(xy - low, high - xy), axis=-1)
    rim = 10 - to_edge + 22.0 * fractal(xy / 55, 3, 51)
    island = 30.0 * (fractal(xy / 62, 2, 52) - 0.22)
    inside = np.maximum(rim, island) + 2.6 * (ridged(xy / 13, 2, 53) - 0.5)
    inside = np.minimum(inside, beyond - 36)
    distance, height = profile(MESA)
    return np.interp(inside, distance, height) + 0.5 * np.interp(inside - 16, distance, height)


def generate() -> Array:
    """The canyon's heights (rows, cols) m."""
    rows, cols = SHAPE
    step = CELL / FINE
    pad = 2 * FINE
    x = ORIGIN[0] + step * (np.arange((cols - 1) * FINE + 1 + 2 * pad) - pad)
    y = ORIGIN[1] + step * (np.arange((rows - 1) * FINE + 1 + 2 * pad) - pad)
    fine = canyon_heights(*np.meshgrid(x, y))
    smooth = gaussian_filter(fine, 0.42 * FINE)
    return np.asarray(smooth[pad : -pad or None : FINE, pad : -pad or None : FINE])


def main() -> None:
    """Write heights, pictures and the USD look."""
    FOLDER.mkdir(parents=True, exist_ok=True)
    heights = generate().astype(np.float32)
    np.savez_compressed(FOLDER / "heights.npz", heights=heights)
    terrain = Terrain("canyon", heights.astype(float), ORIGIN, (CELL, CELL))
    ground = sheet(terrain.vertices, terrain.faces, unwrap(terrain))
    sky = sky_view(terrain.heights, CELL)
    course, _ = polyline(RIVER.astype(float))
    write_picture(FOLDER / "canyon_ground.jpg", ground_colour(ground, sky, course, PICTURE), PICTURE)
    horizon = horizon_sheet(terrain, country)
    write_picture(FOLDER / "canyon_horizon.jpg", horizon_colour(horizon, PICTURE // 4), PICTURE // 4)
    looks = {"ground": (ground, "canyon_ground.jpg", 0.95), "horizon": (horizon, "canyon_horizon.jpg", 1.0)}
    write_look(FOLDER / "canyon.usdc", looks)


if __name__ == "__main__":
    main()
