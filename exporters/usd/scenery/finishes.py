"""The finishes of standing obstacles: what covers them, as data, with its texture, mapping and material.

Each pattern has a known size, which shows how large an obstacle is: concrete is cast in panels of a metre, a facade has
storeys of three metres, warning stripes are a quarter of a metre wide. `obstacle_meshes.py` writes the meshes.
"""

from __future__ import annotations

import io
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vehsim.exporters.usd.scenery.lighting import encode_srgb, fractal_noise
from vehsim.exporters.usd.scenery.textured import author_textured

Array = NDArray[np.float64]
Colour = tuple[float, float, float]

TEXELS = 256
"""Side of the repeating texture, texels."""
PANEL, JOINT, HOLE = 1.0, 0.010, 0.022
"""Side of a concrete panel, half a joint between panels, and radius of the tie holes, m."""
STOREY, BAY = 3.0, 2.0
"""Height of a storey and width of a window's bay, m."""
CREASE = np.radians(30.0)
"""Angle between faces up to which their common edge is shaded smooth, and a wall goes on, rad."""
MEETING = 0.05
"""Distance between the ends of two flat parts of a wall that meet, m."""
LYING = 0.75
"""Z of the unit normal from which a face lies: bevelled edges of a box belong to its walls."""
PAINTS: dict[str, Colour] = {
    "concrete": (0.42, 0.40, 0.37),
    "terracotta": (0.42, 0.17, 0.09),
    "ochre": (0.50, 0.33, 0.10),
    "slate": (0.13, 0.19, 0.26),
}
"""Linear colours, which obstacles without a colour of their own get in turn."""


def _concrete(u: Array, v: Array, colour: Array) -> Array:
    x, y = u % PANEL, v % PANEL
    edge = np.minimum(np.minimum(x, PANEL - x), np.minimum(y, PANEL - y))
    tie = np.hypot(np.abs(x - PANEL / 2) - 0.27, np.abs(y - PANEL / 2) - 0.27)
    mottled = 1.0 + 0.075 * fractal_noise(TEXELS, 1.1, seed=5) + 0.05 * fractal_noise(TEXELS, 1.9, seed=6)
    dark = 0.55 * np.clip(1.5 - edge / JOINT, 0, 1) + 0.5 * np.clip(1.5 - tie / HOLE, 0, 1)
    rows, columns = np.divmod(np.arange(4), 2)
    tone = np.zeros_like(x)
    for row, column, share in zip(rows, columns, (0.0, 0.06, 0.03, -0.04), strict=True):
        half = TEXELS // 2
        tone[row * half : (row + 1) * half, column * half : (column + 1) * half] = share
    shade = np.clip(mottled + tone, 0.6, 1.4) * (1 - np.clip(dark, 0, 0.7))
    return np.asarray(shade[..., None] * colour)


def _paint(u: Array, v: Array, colour: Array) -> Array:
    return np.asarray((1.0 + 0.02 * fractal_noise(TEXELS, 1.9, seed=6))[..., None] * colour)


def _stripes(u: Array, v: Array, colour: Array) -> Array:
    """Black across the colour, from the lower left to the upper right."""
    return np.where(((u - v) % 0.5 < 0.25)[..., None], 0.02, colour)


def _facade(u: Array, v: Array, colour: Array) -> Array:
    """A window in each bay of each storey; curtains and blinds make some lighter."""
    across, up = np.abs(u % BAY - BAY / 2), v % STOREY - 0.9
    window = (across < 0.65) & (up > 0.0) & (up < 1.5)
    frame = window & ((across > 0.55) | (across < 0.04) | (up < 0.1) | (up > 1.4))
    light = np.random.default_rng(7).uniform(0.5, 2.5, (4, 4))
    glass = light[(v // STOREY).astype(int) % 4, (u // BAY).astype(int) % 4][..., None] * (0.035, 0.05, 0.065)
    wall = np.where((v % STOREY < 0.15)[..., None], 0.7, 1.0) * _paint(u, v, colour)
    return np.where(frame[..., None], 0.55, np.where(window[..., None], glass, wall))


def _bands(u: Array, v: Array, colour: Array) -> Array:
    """Two white bands, as on a traffic cone; ``v`` is the share of the obstacle's height."""
    white = ((v > 0.42) & (v < 0.62)) | ((v > 0.74) & (v < 0.88))
    return np.where(white[..., None], 0.75, colour)


@dataclass(frozen=True)
class Finish:
    """``paint(u, v, colour)``: linear colours (n, n, 3) at places (n, n) on the surface, m, ``v`` upwards.

    ``tile``: width and height of the part that repeats, m. If ``fits``, the obstacle is one tile high, and ``v`` goes
    from 0 to 1. Walls have a whole number of ``cells``, width and height in m, so that no window is cut at a corner.
    """

    paint: Callable[[Array, Array, Array], Array]
    tile: tuple[float, float] = (2.0, 2.0)
    fits: bool = False
    cells: tuple[float, float] | None = None
    colour: Colour | None = None
    """linear; default: one of the `PAINTS` in turn"""
    roughness: float = 0.8
    level: str | None = None
    """the finish of faces that rather lie than stand, such as roofs; default: the same"""


FINISHES = {
    "concrete": Finish(_concrete),
    "paint": Finish(_paint, roughness=0.45),
    "stripes": Finish(_stripes, tile=(1.0, 1.0), colour=(0.80, 0.50, 0.02), roughness=0.45),
    "facade": Finish(
        _facade, tile=(8.0, 12.0), cells=(BAY, STOREY), colour=(0.44, 0.40, 0.34), roughness=0.7, level="concrete"
    ),
    "bands": Finish(_bands, tile=(1.0, 1.0), fits=True, colour=(0.80, 0.14, 0.02), roughness=0.5),
}
"""``finish`` of an obstacle -> what covers it."""


@lru_cache(maxsize=64)
def picture(finish: str, colour: Colour) -> bytes:
    """The PNG of one tile of a finish in a linear ``colour``."""
    from PIL import Image

    width, height = FINISHES[finish].tile
    at = (np.arange(TEXELS) + 0.5) / TEXELS
    u, v = np.meshgrid(width * at, height * (1 - at))
    png = io.BytesIO()
    Image.fromarray(encode_srgb(FINISHES[finish].paint(u, v, np.array(colour)))).save(png, "png")
    return png.getvalue()


def lying(normals: Array, finish: str) -> NDArray[np.bool_]:
    """Which faces (m,) with ``normals`` (m, 3) have the finish of level ones instead."""
    return (np.abs(normals[:, 2]) > LYING) & (FINISHES[finish].level is not None)


def coordinates(corners: Array, normals: Array, finish: str) -> Array:
    """Texture coordinates (m, 3, 2) of triangles ``corners`` (m, 3, 3) m: each projected along its normal's main
    axis. They count from a whole number of tiles nearby, because they are stored in single precision."""
    main, tile = np.argmax(np.abs(normals), axis=1), np.array(FINISHES[finish].tile)
    across = np.array([[1, 2], [0, 2], [0, 1]])[main]
    plane = np.take_along_axis(corners, across[:, None, :].repeat(3, axis=1), axis=2)
    plane -= np.floor(corners.min(axis=(0, 1))[across] / tile)[:, None] * tile
    if FINISHES[finish].fits:
        low, high = corners[..., 2].min(), corners[..., 2].max()
        plane[..., 1] = np.clip((corners[..., 2] - low) / (high - low), 0.002, 0.998)  # it must not repeat at the ends
    cells = FINISHES[finish].cells
    if cells is not None:
        plane = _whole_cells(corners, normals, cells)
    return np.asarray(plane / tile)


def _whole_cells(corners: Array, normals: Array, cells: tuple[float, float]) -> Array:
    """Places (m, 3, 2) on the walls of triangles (m, 3, 3), m: along each wall and upwards, stretched to whole
    ``cells``. A wall is flat, or bends by less than `CREASE` from one flat part to the next, as round towers do."""
    width, height = cells
    across = normals[:, :2] / np.maximum(np.linalg.norm(normals[:, :2], axis=1, keepdims=True), 1e-9)
    along = np.einsum("mck,mk->mc", corners[..., :2], across[:, ::-1] * (-1.0, 1.0))
    away = np.einsum("mck,mk->m", corners[..., :2], across) / 3
    flats, of_face = np.unique(np.column_stack([normals, away]).round(2), axis=0, return_inverse=True)
    ends, places = np.zeros((len(flats), 2)), np.zeros((2, len(flats), 2))
    for k in range(len(flats)):
        on, at = along[of_face == k].ravel(), corners[of_face == k, :, :2].reshape(-1, 2)
        ends[k], places[:, k] = (on.min(), on.max()), at[[on.argmin(), on.argmax()]]
    starts, stops = places
    meets = np.linalg.norm(stops[:, None] - starts[None], axis=2) < MEETING
    bends = (flats[:, :3] @ flats[:, :3].T > np.cos(CREASE)) & ~np.eye(len(flats), dtype=bool)
    after = {int(k): int(n) for k, n in np.argwhere(meets & bends)}
    firsts = [k for k in range(len(flats)) if k not in after.values()]
    u, v, left = np.zeros_like(along), corners[..., 2] - corners[..., 2].min(), {*range(len(flats))}
    for first in [*firsts, *range(len(flats))]:  # then those of round towers, which have no first
        wall = []
        while first in left:
            left.remove(first)
            wall.append(first)
            first = after.get(first, -1)
        lengths = np.ptp(ends[wall], axis=1)
        stretch = width * round(lengths.sum() / width) / max(lengths.sum(), 1e-9)
        for flat, start in zip(wall, np.cumsum(lengths) - lengths, strict=True):
            u[of_face == flat] = stretch * (start + along[of_face == flat] - ends[flat, 0])
    v *= height * max(round(v.max() / height), 1) / v.max()
    return np.stack([u, v], axis=-1)


def author_material(stage: Any, path: str, file: Path, relative: str, finish: str, colour: Colour) -> Any:
    """Write the texture to ``file``, and a material at ``path`` that names it ``relative``; returns the material."""
    from pxr import Sdf

    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_bytes(picture(finish, colour))
    material, _, surface = author_textured(stage, path, relative, "picture")
    surface.CreateInput("roughness", Sdf.ValueTypeNames.Float).Set(FINISHES[finish].roughness)
    return material
