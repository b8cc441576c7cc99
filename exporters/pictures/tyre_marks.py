"""How the preview draws tyre marks: ribbons that darken the ground, by OpenGL in the same buffers as MuJoCo.

MuJoCo has no opacity by vertex. A mark multiplies what it covers by its colour over that of the ground, so it keeps
the light and the shadows that are drawn there.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from vehsim.exporters.usd.scenery.lighting import to_srgb
from vehsim.exporters.usd.scenery.tyre_marks import SHOULDER
from vehsim.exporters.usd.stage import Ribbon

Array = NDArray[np.float64]

GROUND = 0.22
"""Albedo of usual ground, linear, that a mark's colour is over; brighter ground, such as snow, has its own."""
ACROSS = np.array([0.0, SHOULDER, 1 - SHOULDER, 1.0])
"""Where a ribbon has vertices from its left to its right end: it is full between the inner two."""
FULL = np.array([0.0, 1.0, 1.0, 0.0])


def draw_tyre_marks(ribbons: Sequence[Ribbon], eye: Array, haze: tuple[float, float], albedo: Array) -> None:
    """Draw after ``mjr_render``, with its context current. ``eye`` (3,) m; ``haze``: the distances at which it begins
    and ends, m; ``albedo`` (3,): that of the ground, linear."""
    if not ribbons:
        return
    from OpenGL import GL

    switched = GL.GL_LIGHTING, GL.GL_FOG, GL.GL_CULL_FACE, GL.GL_TEXTURE_2D
    on = [bool(GL.glIsEnabled(state)) for state in switched]
    for state in switched:
        GL.glDisable(state)
    GL.glDepthMask(GL.GL_FALSE)
    GL.glEnable(GL.GL_BLEND)
    GL.glBlendFunc(GL.GL_ZERO, GL.GL_SRC_COLOR)
    GL.glEnable(GL.GL_POLYGON_OFFSET_FILL)
    GL.glPolygonOffset(1.0, 8.0)  # nearer is more in MuJoCo's depth
    GL.glEnableClientState(GL.GL_VERTEX_ARRAY)
    GL.glEnableClientState(GL.GL_COLOR_ARRAY)
    for ribbon in ribbons:
        points, left = strip(ribbon, eye, haze, albedo)
        GL.glVertexPointer(3, GL.GL_FLOAT, 0, points)
        GL.glColorPointer(3, GL.GL_FLOAT, 0, left)
        GL.glDrawArrays(GL.GL_QUADS, 0, len(points))
    GL.glDisableClientState(GL.GL_COLOR_ARRAY)
    GL.glDisableClientState(GL.GL_VERTEX_ARRAY)
    GL.glDisable(GL.GL_POLYGON_OFFSET_FILL)
    GL.glDisable(GL.GL_BLEND)
    GL.glDepthMask(GL.GL_TRUE)
    for state, was in zip(switched, on, strict=True):
        if was:
            GL.glEnable(state)


def across(ribbon: Ribbon) -> tuple[Array, Array]:
    """Vertices (k, 4, 3) m of a ribbon, from the left to the right end of its rows, and their opacity (k, 4)."""
    left, right = ribbon.rows[:, :1], ribbon.rows[:, 1:]
    opacity = ribbon.opacity[:, :1] + ACROSS * (ribbon.opacity[:, 1:] - ribbon.opacity[:, :1])
    return left + ACROSS[:, None] * (right - left), FULL * opacity


def strip(
    ribbon: Ribbon, eye: Array, haze: tuple[float, float], albedo: Array
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Corners (n, 3) m of a ribbon's quads, and the share of the light (n, 3) that it leaves there."""
    grid, opacity = across(ribbon)
    distance = np.linalg.norm(grid - eye, axis=-1)
    clear = np.clip((haze[1] - distance) / (haze[1] - haze[0]), 0, 1)
    shade = np.minimum(to_srgb(ribbon.colour) / to_srgb(np.maximum(albedo, GROUND)), 1.0)
    light = 1 - (clear * opacity)[..., None] * (1 - shade)
    quads = [(slice(0, -1), k) for k in range(3)]
    corners = [
        np.stack([each[a, k], each[a, k + 1], each[1:, k + 1], each[1:, k]], axis=1)
        for each in (grid, light)
        for a, k in quads
    ]
    points, shares = np.concatenate(corners[:3]), np.concatenate(corners[3:])
    return points.reshape(-1, 3).astype(np.float32), shares.reshape(-1, 3).astype(np.float32)
