"""Grain of the ground near the camera: soil, stones and blades finer than the ground's texture.

A texture that spans hundreds of metres has texels of a decimetre, which look blurred from a few metres. The preview
adds grain to wide ground where it is near, as it adds ripples to water: the same at one place in every frame, in
proportion to the texture's own contrast, and none where a pixel is too wide to show it. This module knows nothing of
MuJoCo.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from vehsim.exporters.usd.stage import Shape

Array = NDArray[np.float64]
Float = NDArray[np.float32]

TEXELS = 1024
TILES = (5.3, 1.37)
"""Widths of the repeated squares of grain, m. Their ratio is not simple, so that repetition is not seen."""
LONGEST = 1 / 9
"""Longest wavelength of the grain, as a share of its square: longer ones are in the ground's own texture."""
CONTRAST, STRONGEST = 3.5, 0.14
"""Standard deviation of the grain's brightness per median contrast of the ground's texture, and its largest value."""
FADES = (20.0, 70.0)
"""Distances between which grain fades, m."""
WIDE = 30.0
"""Ground has grain if it is wider than this, m."""
COARSE = 4
"""The ground's slope is found from every fourth pixel."""
OBSTACLES = "/env/obstacles/"
"""In the paths of prims that stand on the ground."""


def is_ground(shape: Shape) -> bool:
    """Whether a shape stands still and is no obstacle."""
    return not shape.group and OBSTACLES not in shape.name


def strengths_of(shapes: Sequence[Shape]) -> list[float]:
    """The strength of the grain of each of a stage's ``shapes``; 0 for what is not textured ground."""
    return [
        _strength(shape.surface.texture)
        if is_ground(shape) and shape.surface.texture and np.ptp(shape.points[:, :2], axis=0).max() > WIDE
        else 0.0
        for shape in shapes
    ]


@cache
def _strength(texture: Path) -> float:
    """Of the grain on a ``texture``: proportional to the median difference of its texels from their surroundings."""
    from PIL import Image, ImageFilter

    with Image.open(texture) as image:
        grey = image.convert("L").reduce(4)
    bright = np.asarray(grey, float)
    contrast = np.median(np.abs(bright - np.asarray(grey.filter(ImageFilter.GaussianBlur(3)), float)))
    return float(min(CONTRAST * contrast / max(bright.mean(), 1.0), STRONGEST))


def grained(
    picture: NDArray[np.uint8], strength: Float, distance: Array, rays: tuple[Array, Array, Array], eye: Array
) -> NDArray[np.uint8]:
    """A picture (h, w, 3) with grain of ``strength`` (h, w).

    ``distance`` (h, w) m along the view; pixel (i, j) is at ``eye + distance * (forward + x[j] + y[i])`` with ``rays``:
    forward (3,), x (w, 3) and y (h, 3).
    """
    near = np.clip((FADES[1] - distance) / (FADES[1] - FADES[0]), 0, 1)
    weight = (strength * near).astype(np.float32)
    rows, columns = np.nonzero(weight)
    if not len(rows):
        return picture
    forward, x, y = rays
    across, grazing = (np.repeat(np.repeat(each, COARSE, 0), COARSE, 1) for each in _slopes(distance, rays))
    across, grazing = across[rows, columns], grazing[rows, columns]
    z = distance[rows, columns].astype(np.float32)
    footprint = z * np.float32(np.linalg.norm(x[1] - x[0])) / np.sqrt(grazing)
    right, up = (each.astype(np.float32) for each in (x, y))
    away = [z * (np.float32(forward[k]) + right[columns, k] + up[rows, k]) for k in range(3)]
    first, second = np.where(across == 0, away[1], away[0]), np.where(across == 2, away[1], away[2])
    grain = np.zeros(len(rows), np.float32)
    for tile in TILES:
        start = (np.mod(eye, tile) / tile).astype(np.float32)  # single precision is enough from there
        u = start[[1, 0, 0]][across] + first / np.float32(tile)
        v = start[[2, 2, 1]][across] + second / np.float32(tile)
        grain += _looked_up(u, v, (footprint * (TEXELS / tile)).astype(np.float32))
    changed = picture.copy()
    light = 1 + weight[rows, columns] * grain
    changed[rows, columns] = np.clip(picture[rows, columns] * light[:, None] + 0.5, 0, 255)
    return changed


def _slopes(distance: Array, rays: tuple[Array, Array, Array]) -> tuple[NDArray[np.int64], Float]:
    """The axis that the surface faces most, and the sine of the angle at which it is seen; of every `COARSE`-th
    pixel."""
    forward, x, y = rays
    z = np.minimum(distance[::COARSE, ::COARSE], 1e6)
    ray = forward + x[None, ::COARSE] + y[::COARSE, None]
    places = z[..., None] * ray
    normal = np.cross(np.gradient(places, axis=1), np.gradient(places, axis=0))
    size = np.linalg.norm(normal, axis=2) * np.linalg.norm(ray, axis=2)
    seen = np.abs(np.einsum("ijk,ijk->ij", normal, ray)) / np.maximum(size, 1e-300)
    return np.abs(normal).argmax(axis=2), np.maximum(seen, 0.02).astype(np.float32)


def _looked_up(u: Float, v: Float, texels: Float) -> Float:
    """Grain (n,) at ``u``, ``v`` (n,) in squares, averaged over pixels ``texels`` (n,) wide."""
    level = np.log2(np.maximum(texels, 1.0))
    whole = level.astype(np.int32)
    images, firsts = _levels()
    found = np.zeros(len(u), np.float32)
    for step, share in ((0, 1 - (level - whole)), (1, level - whole)):
        deep = np.minimum(whole + step, len(firsts) - 1)
        size = np.int32(TEXELS) >> deep
        row, column = (np.floor(each * size).astype(np.int32) & (size - 1) for each in (v, u))
        found += share * images.take(firsts[deep] + row * size + column)
    return found


@cache
def _levels() -> tuple[Float, NDArray[np.int32]]:
    """Grain of mean 0 and deviation 1 that repeats without a seam, with its means over squares of 2, 4, ... texels: all
    texels in one array, and where each level starts."""
    rng = np.random.default_rng(11)
    frequency = np.fft.fftfreq(TEXELS, 1 / TEXELS)
    radius = np.hypot(*np.meshgrid(frequency, frequency[: TEXELS // 2 + 1], indexing="ij"))
    power = np.where(radius > 1 / LONGEST, 1 / np.maximum(radius, 1), 0.0)
    image = np.fft.irfft2(power * np.fft.rfft2(rng.standard_normal((TEXELS, TEXELS))))
    image = np.tanh(image / image.std() / 1.6)
    levels = [(image - image.mean()) / image.std()]
    while len(levels[-1]) > 1:
        half = len(levels[-1]) // 2
        levels.append(levels[-1].reshape(half, 2, half, 2).mean(axis=(1, 3)))
    flat = [level.astype(np.float32).ravel() for level in levels]
    return np.concatenate(flat), np.cumsum([0, *(len(level) for level in flat[:-1])]).astype(np.int32)
