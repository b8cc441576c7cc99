"""How the preview draws spray: soft specks, streaked by their motion while a shutter is open."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

SHUTTER = 0.5
"""Time for which the shutter is open, in frames."""
STREAK = 8
"""Specks along a drop's way."""
PUFF = 2.5
"""Radius of what a drop stands for, mist around it, in its widths."""
DENSE = 0.5
"""How much a speck hides at its middle, before its light is spread along its way."""
LARGEST = 24
"""Largest radius of a speck, px."""


def draw_spray(
    picture: NDArray[np.uint8],
    distance: Array,
    drops: tuple[Array, Array, Array],
    view: tuple[Array, Array, Array],
    half: tuple[float, float],
    shift: tuple[float, float],
    frame_time: float,
    colour: Array,
) -> NDArray[np.uint8]:
    """A picture (h, w, 3) with drops in front of what is farther than they are.

    ``distance`` (h, w) m along the view; ``drops``: places (n, 3), velocities (n, 3), widths (n,); ``view``: eye,
    forward and up (3,); ``half``, ``shift``: see `places_of`; ``frame_time`` s; ``colour`` (3,): of dense spray, 0 to
    255.
    """
    (h, w), (eye, forward, up) = distance.shape, view
    places, velocities, widths = drops
    right = np.cross(forward, up)
    when = np.linspace(-0.5, 0.5, STREAK) * SHUTTER * frame_time
    away = (places[:, None] + velocities[:, None] * when[:, None] - eye).reshape(-1, 3)
    depth = away @ forward
    ahead = np.flatnonzero(depth > 0.2)
    away, depth, widths = away[ahead], depth[ahead], np.repeat(widths, STREAK)[ahead]
    scale = w / (2 * half[0])
    column = (w - 1) / 2 + scale * (away @ right / depth - shift[0])
    row = (h - 1) / 2 - scale * (away @ up / depth - shift[1])
    true = PUFF * widths * scale / depth
    radius = np.clip(true, 0.7, LARGEST)
    strength = DENSE / STREAK * np.minimum(true / radius, 1.0) ** 2
    hidden = np.zeros(h * w)
    reach = np.ceil(2 ** np.ceil(np.log2(2 * radius))).astype(int)
    for size in np.unique(reach):
        of = np.flatnonzero((reach == size) & (column > -size) & (column < w + size) & (row > -size) & (row < h + size))
        dy, dx = (part.ravel() for part in np.mgrid[-size : size + 1, -size : size + 1])
        c, r = (np.round(each[of]).astype(int)[:, None] + d for each, d in ((column, dx), (row, dy)))
        square = ((c - column[of, None]) ** 2 + (r - row[of, None]) ** 2) / radius[of, None] ** 2
        seen = (c >= 0) & (c < w) & (r >= 0) & (r < h) & (square < 4)
        pixel = r[seen] * w + c[seen]
        behind = distance.ravel()[pixel] > np.broadcast_to(depth[of, None], c.shape)[seen] - 0.1
        dark = (strength[of, None] * np.exp(-2 * square))[seen] * behind
        hidden += np.bincount(pixel, dark, h * w)
    share = (1 - np.exp(-hidden)).reshape(h, w, 1)
    touched = share > 0
    mixed = picture + share * (colour - picture)
    return np.where(touched, np.round(mixed), picture).astype(np.uint8)
