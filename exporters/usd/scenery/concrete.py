"""The material of standing obstacles: painted concrete cast in panels of a metre, which shows their size.

This module holds the material, its texture and its mapping; `obstacles.py` writes the meshes.
"""

from __future__ import annotations

import io
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vehsim.exporters.usd.scenery.lighting import encode_srgb, fractal_noise

Array = NDArray[np.float64]

TILE, TEXELS = 2.0, 256
"""Side of the repeating texture, in m and in texels."""
PANEL, JOINT, HOLE = 1.0, 0.010, 0.022
"""Side of a panel, half a joint between panels, and radius of the tie holes, m."""


@lru_cache(maxsize=8)
def picture(colour: tuple[float, float, float]) -> bytes:
    """The PNG of concrete painted in a linear ``colour``."""
    from PIL import Image

    at = (np.arange(TEXELS) + 0.5) / TEXELS * TILE % PANEL
    x, y = np.meshgrid(at, at)
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
    png = io.BytesIO()
    Image.fromarray(encode_srgb(shade[..., None] * np.array(colour))).save(png, "png")
    return png.getvalue()


def coordinates(corners: Array, normals: Array) -> Array:
    """Texture coordinates (m, 3, 2) of triangles ``corners`` (m, 3, 3) m: each projected along its normal's main
    axis."""
    main = np.argmax(np.abs(normals), axis=1)
    across = np.array([[1, 2], [0, 2], [0, 1]])[main]
    return np.take_along_axis(corners, across[:, None, :].repeat(3, axis=1), axis=2) / TILE


def author_material(stage: Any, path: str, file: Path, relative: str, colour: tuple[float, float, float]) -> Any:
    """Write the texture to ``file``, and a material at ``path`` that names it ``relative``; returns the material."""
    from pxr import Sdf, UsdShade

    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_bytes(picture(colour))
    types = Sdf.ValueTypeNames
    material = UsdShade.Material.Define(stage, path)
    reader, texture, surface = (UsdShade.Shader.Define(stage, f"{path}/{n}") for n in ("st", "picture", "surface"))
    reader.CreateIdAttr("UsdPrimvarReader_float2")
    reader.CreateInput("varname", types.String).Set("st")
    texture.CreateIdAttr("UsdUVTexture")
    texture.CreateInput("file", types.Asset).Set(Sdf.AssetPath(relative))
    texture.CreateInput("sourceColorSpace", types.Token).Set("sRGB")
    for wrap in ("wrapS", "wrapT"):
        texture.CreateInput(wrap, types.Token).Set("repeat")
    texture.CreateInput("st", types.Float2).ConnectToSource(reader.CreateOutput("result", types.Float2))
    surface.CreateIdAttr("UsdPreviewSurface")
    surface.CreateInput("diffuseColor", types.Color3f).ConnectToSource(texture.CreateOutput("rgb", types.Float3))
    surface.CreateInput("roughness", types.Float).Set(0.8)
    material.CreateSurfaceOutput().ConnectToSource(surface.CreateOutput("surface", types.Token))
    return material
