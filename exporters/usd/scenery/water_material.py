"""The material of a stage's water for any renderer: its colour, whitened and roughened by foam, and ripples.

This module writes the UsdPreviewSurface and its inputs. Foam has two primvars, each a table of `SHADES` values and an
index per point and frame: indices are small on disk, and a renderer needs only UsdPrimvarReader. The preview draws
water in another way, in `pictures/water.py`.
"""

from __future__ import annotations

import io
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vehsim.exporters.usd.scenery.lighting import fractal_noise

Array = NDArray[np.float64]

SHADES = 64
"""Number of steps from clear water to foam."""
CLEAR, FOAM = np.array([0.010, 0.032, 0.038]), np.array([0.78, 0.80, 0.80])
"""Linear colours."""
ROUGH = (0.06, 0.85)
"""Roughness of clear water and of foam."""
RIPPLES = "ripples.png"
TILE, TEXELS, STEEP = 9.0, 256, 0.075
"""The repeating texture of ripples: its side in m and in texels, and the deviation of their slopes."""


def author_foam(mesh: Any) -> None:
    """Create the primvars ``displayColor`` and ``roughness``, as tables, on the surface; `set_foam` fills them."""
    from pxr import Sdf, UsdGeom, Vt

    share = np.linspace(0.0, 1.0, SHADES)
    colours = CLEAR + share[:, None] * (FOAM - CLEAR)
    rough = ROUGH[0] + share * (ROUGH[1] - ROUGH[0])
    primvars, types = UsdGeom.PrimvarsAPI(mesh), Sdf.ValueTypeNames
    for name, kind, table in (
        ("displayColor", types.Color3fArray, Vt.Vec3fArray.FromNumpy(colours.astype(np.float32))),
        ("roughness", types.FloatArray, Vt.FloatArray.FromNumpy(rough.astype(np.float32))),
    ):
        primvar = primvars.CreatePrimvar(name, kind, UsdGeom.Tokens.vertex)
        primvar.Set(table)
        primvar.CreateIndicesAttr()


def set_foam(layer: Any, path: str, frame: float, points: Array, foam: Array) -> None:
    """Write the foam (n,) of a frame on ``points`` (n, 3), in `patches`, as indices of both primvars of the surface."""
    from pxr import Vt

    shade = np.round(patches(points[:, 0], points[:, 1], foam) * (SHADES - 1)).astype(np.int32)
    for name in ("displayColor", "roughness"):
        layer.SetTimeSample(f"{path}.primvars:{name}:indices", frame, Vt.IntArray.FromNumpy(shade))


def patches(x: Array, y: Array, foam: Array) -> Array:
    """How much of the water at places (n,) m ``foam`` (n,) hides: patches with holes."""
    white = np.zeros_like(foam)
    there = np.flatnonzero(foam > 0)
    x, y = x[there], y[there]
    coarse = np.sin(3.1 * x + 1.7 * y + 1.3 * np.sin(-1.3 * x + 4.3 * y))
    grain = 0.55 * coarse + 0.45 * np.sin(7.9 * x - 2.2 * y + 1.7 * np.sin(1.9 * x + 9.1 * y + coarse))
    white[there] = np.clip(1.25 * foam[there] * (1 + 1.1 * grain), 0, 1)
    return white


def author_coordinates(mesh: Any, xy: Array) -> None:
    """Texture coordinates ``st`` of the surface: the rest positions of its points (n, 2) m, in tiles of ripples."""
    from pxr import Sdf, UsdGeom, Vt

    primvars = UsdGeom.PrimvarsAPI(mesh)
    st = primvars.CreatePrimvar("st", Sdf.ValueTypeNames.TexCoord2fArray, UsdGeom.Tokens.vertex)
    st.Set(Vt.Vec2fArray.FromNumpy((xy / TILE).astype(np.float32)))


@lru_cache(maxsize=1)
def ripples() -> bytes:
    """The PNG of a normal map of ripples, wavelengths from about 0.2 to 2 m, in OpenGL's handedness."""
    from PIL import Image

    height = fractal_noise(TEXELS, 1.5, seed=8)
    wide = np.fft.ifft2(np.fft.fft2(height) * _band()).real
    slopes = [(np.roll(wide, -1, axis) - np.roll(wide, 1, axis)) for axis in (1, 0)]
    slopes = [slope * STEEP / slope.std() for slope in slopes]
    normal = np.stack([-slopes[0], slopes[1], np.ones_like(wide)], axis=-1)  # rows run down, v runs up
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    png = io.BytesIO()
    Image.fromarray(np.round(127.5 * (normal + 1)).astype(np.uint8)).save(png, "png")
    return png.getvalue()


def _band() -> Array:
    """The frequencies of the texture that are ripples."""
    waves = np.hypot(*np.meshgrid(*[np.fft.fftfreq(TEXELS) * TEXELS] * 2)) / TILE  # per metre
    return np.asarray(np.exp(-((0.5 / np.maximum(waves, 1e-9)) ** 2)) * np.exp(-((waves / 4.0) ** 2)))


def bind_material(stage: Any, mesh: Any, folder: Path) -> Path:
    """Author ``/water/materials/water`` and bind it; returns its texture, written below ``folder``."""
    from pxr import Gf, Sdf, UsdShade

    picture = folder / "assets" / "water" / RIPPLES
    picture.parent.mkdir(parents=True, exist_ok=True)
    picture.write_bytes(ripples())
    types, path = Sdf.ValueTypeNames, "/water/materials/water"
    material = UsdShade.Material.Define(stage, path)
    stage.GetPrimAtPath("/water/materials").SetTypeName("Scope")
    surface = UsdShade.Shader.Define(stage, f"{path}/surface")
    surface.CreateIdAttr("UsdPreviewSurface")
    surface.CreateInput("ior", types.Float).Set(1.333)

    def read(name: str, width: str, kind: Any) -> Any:
        reader = UsdShade.Shader.Define(stage, f"{path}/{name}")
        reader.CreateIdAttr(f"UsdPrimvarReader_{width}")
        reader.CreateInput("varname", types.String).Set(name)
        return reader.CreateOutput("result", kind)

    surface.CreateInput("diffuseColor", types.Color3f).ConnectToSource(read("displayColor", "float3", types.Float3))
    surface.CreateInput("roughness", types.Float).ConnectToSource(read("roughness", "float", types.Float))
    texture = UsdShade.Shader.Define(stage, f"{path}/ripples")
    texture.CreateIdAttr("UsdUVTexture")
    texture.CreateInput("file", types.Asset).Set(Sdf.AssetPath(f"../assets/water/{RIPPLES}"))
    texture.CreateInput("sourceColorSpace", types.Token).Set("raw")
    texture.CreateInput("scale", types.Float4).Set(Gf.Vec4f(2, 2, 2, 1))
    texture.CreateInput("bias", types.Float4).Set(Gf.Vec4f(-1, -1, -1, 0))
    for wrap in ("wrapS", "wrapT"):
        texture.CreateInput(wrap, types.Token).Set("repeat")
    texture.CreateInput("st", types.Float2).ConnectToSource(read("st", "float2", types.Float2))
    surface.CreateInput("normal", types.Normal3f).ConnectToSource(texture.CreateOutput("rgb", types.Float3))
    material.CreateSurfaceOutput().ConnectToSource(surface.CreateOutput("surface", types.Token))
    UsdShade.MaterialBindingAPI.Apply(mesh.GetPrim()).Bind(material)
    return picture
