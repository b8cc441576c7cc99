"""The canyon's colours, computed at each texel's place in space, and the mesas on its horizon.

Beds of sandstone, shale and limestone alternate with height; cliffs carry desert varnish and joints, slopes dust and
boulders, flats sand and scrub. Crevices, which see less of the sky, are darker.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from vehsim.assets.generate._noise import fractal, gradient_noise, ridged
from vehsim.assets.generate._terrain_look import Sheet, at_texels, texels

Array = NDArray[np.float64]

# the column from the river up: top of each bed (m) and its visible colour (sRGB)
BEDS = [
    (0.0, (0.60, 0.44, 0.33)), (6.0, (0.66, 0.42, 0.30)), (9.0, (0.75, 0.46, 0.31)), (12.0, (0.80, 0.50, 0.34)),
    (13.2, (0.87, 0.66, 0.48)), (13.9, (0.77, 0.45, 0.30)), (18.0, (0.71, 0.40, 0.27)), (20.0, (0.58, 0.34, 0.26)),
    (22.0, (0.79, 0.49, 0.33)), (26.0, (0.83, 0.54, 0.36)), (30.0, (0.77, 0.46, 0.30)), (33.0, (0.82, 0.51, 0.34)),
    (34.5, (0.60, 0.36, 0.28)), (37.5, (0.81, 0.50, 0.33)), (41.0, (0.86, 0.60, 0.42)), (42.0, (0.78, 0.46, 0.30)),
    (46.0, (0.84, 0.54, 0.36)), (47.5, (0.62, 0.39, 0.31)), (51.0, (0.85, 0.61, 0.43)), (54.0, (0.91, 0.74, 0.57)),
    (56.5, (0.83, 0.55, 0.38)), (59.0, (0.84, 0.64, 0.47)), (62.0, (0.74, 0.47, 0.33)), (67.0, (0.80, 0.48, 0.32)),
    (74.0, (0.84, 0.53, 0.36)), (76.0, (0.62, 0.38, 0.29)), (84.0, (0.87, 0.62, 0.43)), (110.0, (0.80, 0.52, 0.36)),
]  # fmt: skip
DUST = np.array([0.72, 0.52, 0.38])
SAND = np.array([0.80, 0.66, 0.50])
GRAVEL = np.array([0.62, 0.52, 0.43])
WATER = np.array([0.36, 0.45, 0.41])
SCRUB = np.array([0.42, 0.39, 0.27])
VARNISH = np.array([0.36, 0.22, 0.18])
SHADE = np.array([0.60, 0.48, 0.45])
"""Factor on each colour where no sky is visible: shade stays reddish, because canyon walls light each other."""


def mix(a: Array, b: Array, share: Array) -> Array:
    """From ``a`` to ``b`` (..., 3) as ``share`` (...,) goes from 0 to 1."""
    return np.asarray(a + (b - a) * np.clip(share, 0, 1)[..., None])


def smoothstep(low: float, high: float, x: Array) -> Array:
    """0 below ``low``, 1 above ``high``, smooth between."""
    t = np.clip((x - low) / (high - low), 0, 1)
    return np.asarray(t * t * (3 - 2 * t))


def rock(points: Array, level: Array) -> Array:
    """Colour (n, 3) of bare rock at ``points`` (n, 3) m with the position ``level`` (n,) m in the column of beds."""
    top, colour = np.array([bed[0] for bed in BEDS]), np.array([bed[1] for bed in BEDS])
    wavy = level + 0.55 * fractal(points / [9, 9, 4], 2, 101)
    edge = np.clip((wavy[:, None] - top[None, 1:]) / 0.5 + 0.5, 0, 1)  # beds change within half a metre
    base = colour[0] + edge @ np.diff(colour, axis=0)
    base *= 1 + 0.16 * fractal(points / [28, 28, 16], 2, 105)[:, None]
    laminae = gradient_noise(np.column_stack([wavy * 1.9, points[:, 0] / 60]), 102)
    laminae += 0.7 * gradient_noise(np.column_stack([wavy * 5.2, points[:, 1] / 25]), 103)
    patches = fractal(points / 6.5, 3, 104)
    return base * (1 + 0.24 * laminae + 0.13 * patches)[:, None]


def ground_colour(ground: Sheet, sky: Array, river: Array, size: int) -> Array:
    """Colours (size^2, 3) of the canyon's picture; ``sky`` (rows, cols): visible share of the sky; ``river`` (k, 2)
    m."""
    from scipy.spatial import cKDTree

    colours = []
    course = cKDTree(river)
    face, weights = texels(ground, size)
    for part in np.array_split(np.arange(size * size), 16):
        where = (ground, face[part], weights[part])
        points, normals = at_texels(ground.points, *where), at_texels(ground.normals, *where)
        seen = at_texels(sky.ravel(), *where)
        normals /= np.linalg.norm(normals, axis=1, keepdims=True)
        bank, _ = course.query(points[:, :2], distance_upper_bound=30.0)
        colours.append(_texel_colour(points, normals, seen, np.minimum(bank, 30.0)))
    return np.concatenate(colours)


def _texel_colour(points: Array, normals: Array, seen: Array, bank: Array) -> Array:
    """Colour (n, 3) of texels at ``points`` with ``normals`` (n, 3).

    ``seen`` (n,): visible share of the sky; ``bank`` (n,) m: distance from the middle of the river.
    """
    x, y, z = points.T
    steep = 1 - normals[:, 2]
    fine = fractal(points / 0.9, 3, 111)
    coarse = fractal(points[:, :2] / 14, 3, 112)
    # the strata are tilted like the ground from which they were cut: the dip of the walls, see `canyon.py`
    level = z - 1.8 - 1.2 * fractal(points[:, :2] / 90, 2, 31) - 0.010 * (x - 90)
    colour = rock(points, level)

    cliff = smoothstep(0.30, 0.55, steep + 0.10 * fine)
    streak = fractal(np.column_stack([x / 1.3, y / 1.3, z / 36]), 3, 113) + 0.5 * fractal(points / [9, 9, 22], 2, 114)
    colour = mix(colour, VARNISH, 0.55 * cliff * smoothstep(0.05, 1.0, streak))
    pale = smoothstep(0.35, 0.9, fractal(np.column_stack([x / 2.6, y / 2.6, z / 24]), 2, 115))
    colour = mix(colour, np.array([0.93, 0.76, 0.58]), 0.35 * cliff * pale)
    joint = ridged(np.column_stack([x / 3.4, y / 3.4, z / 14]), 2, 116)
    colour *= (1 - 0.30 * cliff * smoothstep(0.86, 1.0, joint))[:, None]
    ledge = ridged(np.column_stack([x / 30, y / 30, level * 0.42]), 2, 117)
    colour *= (1 - 0.30 * cliff * smoothstep(0.88, 0.99, ledge))[:, None]

    slope = smoothstep(0.34, 0.16, steep + 0.06 * fine)
    colour = mix(colour, DUST * (1 + 0.16 * fine + 0.10 * coarse)[:, None], 0.72 * slope)
    boulder = ridged(points / 1.3, 2, 118) - 0.25 * gradient_noise(points / 0.5, 119)
    colour *= (1 - 0.34 * slope * smoothstep(0.82, 1.0, boulder) * smoothstep(0.03, 0.12, steep))[:, None]

    flat = smoothstep(0.075, 0.02, steep + 0.02 * fine)
    floor = smoothstep(6.5, 3.0, z)
    colour = mix(colour, SAND * (1 + 0.10 * coarse + 0.07 * fine)[:, None], 0.8 * flat * floor)
    braid = ridged(points[:, :2] / 8.5 + 0.25 * fine[:, None], 3, 120)
    colour = mix(colour, GRAVEL * (1 + 0.2 * fine)[:, None], 0.75 * floor * flat * smoothstep(0.62, 0.85, braid))
    colour = mix(colour, DUST * [0.94, 0.88, 0.84], 0.55 * flat * (1 - floor) * smoothstep(-0.2, 0.5, coarse))

    clump = gradient_noise(points[:, :2] / 1.1, 121) + 0.35 * fractal(points[:, :2] / 16, 2, 122) + 0.16 * fine
    dry = smoothstep(3.4, 4.2, bank) * smoothstep(0.16, 0.05, steep)
    lush = smoothstep(9.0, 4.0, bank)
    leaf = mix(SCRUB, np.array([0.42, 0.46, 0.24]), lush) * (1 + 0.4 * fine)[:, None]
    colour = mix(colour, leaf, 0.8 * dry * smoothstep(0.36, 0.46, clump + 0.10 * lush))
    shore = bank + 1.1 * fractal(points[:, :2] / 6.5, 2, 123) + 0.25 * fine
    colour = colour * (1 - 0.32 * smoothstep(3.9, 2.9, shore))[:, None]
    ripple = gradient_noise(points[:, :2] / [0.9, 0.6], 124) + 0.6 * coarse
    colour = mix(colour, WATER * (1 + 0.16 * ripple)[:, None], 0.92 * smoothstep(3.0, 2.5, shore))

    shade = SHADE + (1 - SHADE) * smoothstep(0.0, 0.85, seen)[:, None]
    return np.asarray(colour * shade * (1 + 0.10 * fine)[:, None])


# ---------------------------------------------------------------- the horizon


def country(xy: Array) -> Array:
    """Heights (...,) m of the plateau and the buttes beyond the canyon."""
    butte = fractal(xy / 210, 3, 201) + 0.25 * fractal(xy / 60, 2, 202)
    steps = 26 * smoothstep(0.12, 0.20, butte) + 34 * smoothstep(0.34, 0.41, butte) + 22 * smoothstep(0.52, 0.58, butte)
    return np.asarray(61 + 4 * fractal(xy / 120, 2, 203) + steps)


def horizon_colour(horizon: Sheet, size: int) -> Array:
    """Colours (size^2, 3) of the horizon's picture."""
    face, weights = texels(horizon, size)
    points = at_texels(horizon.points, horizon, face, weights)
    normals = at_texels(horizon.normals, horizon, face, weights)
    colour = rock(points * [0.25, 0.25, 1.0], points[:, 2] - 1.8)
    flat = smoothstep(0.30, 0.10, 1 - normals[:, 2])
    return mix(colour, DUST * (1 + 0.12 * fractal(points[:, :2] / 30, 3, 211))[:, None], 0.7 * flat) * 0.92
