"""The material of a stage's water for any renderer: its colour, whitened and roughened by foam, and ripples.

This module writes the UsdPreviewSurface and its inputs. Foam has two primvars, each a table of `SHADES` values and an
index per point and frame: indices are small on disk, and a renderer needs only UsdPrimvarReader. The preview draws
water in another way, in `pictures/water.py`.
"""

from __future__ import annotations

import io
import math
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vehsim.exporters.usd.scenery import lighting
from vehsim.exporters.usd.scenery.lighting import fractal_noise
from vehsim.runtime.cache import kept
from vehsim.runtime.code import code

Array = NDArray[np.float64]

SHADES = 64
"""Number of steps from clear water to foam."""
CLEAR, FOAM = np.array([0.010, 0.032, 0.038]), np.array([0.78, 0.80, 0.80])
"""Linear colours."""
ROUGH = (0.06, 0.85)
"""Roughness of clear water and of foam."""
RIPPLES = "ripples.png"
LACE, LACE_SIDE = 768, 12.0
"""Side of the repeating picture of foam, in texels and in m."""
SOFT = 0.7
"""How gradually it becomes white."""
THREADS, WIDER = (0.15, 0.8), 7.0
"""Samples closer than the first show all of that picture; further apart than the second, none of it, m. Those show the
same picture this many times larger, and still further apart, only the mean."""
FINER, GRAIN = 0.23, 0.5
"""Foam has a grain of bubbles: the same picture so much smaller makes it denser and thinner by half of this."""
TILE, TEXELS, STEEP = 9.0, 256, 0.075
"""The repeating texture of ripples: its side in m and in texels, and the deviation of their slopes."""

PERIOD = float(math.lcm(round(TILE), round(LACE_SIDE), round(LACE_SIDE * WIDER)))
"""Length over which the pictures of ripples and foam, of both sizes, repeat, m."""


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


def set_foam(layer: Any, path: str, frame: float, white: Array, slopes: Array) -> None:
    """Write how ``white`` (n,) foam makes the surface in a frame, see `patches`, as indices of both its primvars.

    ``slopes`` (n,): mean square slope of the waves that the mesh does not show. They make the surface rough: without
    them, distant water would be a mirror as bright as the sky, and foam a dark spot in it.
    """
    from pxr import Vt

    clear = ((ROUGH[0] ** 4 + slopes) ** 0.25 - ROUGH[0]) / (ROUGH[1] - ROUGH[0])  # roughness^4: a mean square slope
    for name, share in (("displayColor", white), ("roughness", np.clip(np.maximum(white, clear), 0.0, 1.0))):
        shade = np.round(share * (SHADES - 1)).astype(np.int32)
        layer.SetTimeSample(f"{path}.primvars:{name}:indices", frame, Vt.IntArray.FromNumpy(shade))


def patches(xy: Array, foam: Array, size: Array | float) -> NDArray[np.float32]:
    """How much of the water with rest positions ``xy`` (2, n) m ``foam`` (n,) hides: threads around holes, which widen
    and grow thin as it fades, with grain. Between samples ``size`` (n,) m apart that cannot show them, its mean."""
    white = np.array(foam, np.float32)
    size = np.broadcast_to(np.asarray(size, np.float32), white.shape)
    there = np.flatnonzero((foam > 0) & (size < THREADS[1] * WIDER))
    full, size, (x, y) = white[there], size[there], (each[there] for each in xy)
    levels = np.linspace(0, 1, SHADES)
    mean = np.interp(full, levels, _hidden(levels[:, None], levels).mean(axis=1))
    for scale in (WIDER, 1.0, FINER):
        side = scale * LACE_SIDE
        rank = _read(lace(), x / side, y / side)  # foam leaves the lowest first
        share = np.clip((scale * THREADS[1] - size) / (scale * (THREADS[1] - THREADS[0])), 0, 1)
        seen = white[there] * (1 + GRAIN * (rank - 0.5)) if scale == FINER else _hidden(full, rank) * full / mean
        white[there] += share * (np.minimum(seen, 1) - white[there])
    return np.asarray(white)


def _hidden(foam: NDArray[np.floating], rank: NDArray[np.floating]) -> NDArray[np.floating]:
    """How much ``foam`` hides where it has the ``rank`` of `lace`, from thin to dense."""
    dense = np.clip((foam - 1 + rank) / SOFT + 0.5, 0, 1)
    return np.asarray(dense**2 * (3 - 2 * dense))


def _read(tile: NDArray[np.float32], u: Array, v: Array) -> NDArray[np.float32]:
    """Values (n,) of a repeating tile (k, k) at ``u``, ``v`` (n,) in tiles, linear between texels."""
    size = len(tile)
    columns, rows = (size * (each - np.floor(each)) for each in (u, v))
    c, r = columns.astype(int), rows.astype(int)
    du, dv = (columns - c).astype(np.float32), (rows - r).astype(np.float32)
    flat = tile.ravel()
    below, above = ((r + k) % size * size for k in (0, 1))
    left, right = c % size, (c + 1) % size
    low = flat[below + left] * (1 - du) + flat[below + right] * du
    return np.asarray(low * (1 - dv) + (flat[above + left] * (1 - du) + flat[above + right] * du) * dv)


@lru_cache(maxsize=1)
def lace() -> NDArray[np.float32]:
    """A repeating tile (k, k) of foam: 1 where it lasts longest, in threads between round holes, to 0, evenly spread
    over the tile's texels. It is cached: it takes nearly a second."""
    by = code((Path(__file__), Path(lighting.__file__)))
    return np.frombuffer(kept("lace", by, lambda: _lace().tobytes()), np.float32).reshape(LACE, LACE)


def _lace() -> NDArray[np.float32]:
    from scipy.spatial import cKDTree

    axis = (np.arange(LACE) + 0.5) / LACE
    u, v = np.meshgrid(axis, axis)
    wide = [fractal_noise(LACE, 1.8, seed) for seed in (21, 22)]
    height = 0.25 * fractal_noise(LACE, 1.7, seed=23)
    for cells, weight in ((130, 0.9), (900, 0.8), (5000, 0.35)):
        seeds = np.random.default_rng(cells).uniform(size=(cells, 2))
        bent = np.stack([u + 0.16 / cells**0.5 * wide[0], v + 0.16 / cells**0.5 * wide[1]], axis=-1) % 1.0
        first, second = np.moveaxis(cKDTree(seeds, boxsize=1.0).query(bent, k=2)[0], -1, 0)
        height -= weight * np.minimum((second - first) * cells**0.5, 1.0)
    rank = np.empty(LACE**2, np.float32)
    rank[np.argsort(height.ravel(), kind="stable")] = np.linspace(0, 1, LACE**2, dtype=np.float32)
    return rank.reshape(LACE, LACE)


def author_coordinates(mesh: Any, xy: Array) -> Array:
    """Texture coordinates ``st`` of the surface: the rest positions of its points (n, 2) m, in tiles of ripples.

    They count from a place nearby at which all its pictures start, because they are stored in single precision;
    returns that place (2,) m.
    """
    from pxr import Sdf, UsdGeom, Vt

    primvars = UsdGeom.PrimvarsAPI(mesh)
    st = primvars.CreatePrimvar("st", Sdf.ValueTypeNames.TexCoord2fArray, UsdGeom.Tokens.vertex)
    start = PERIOD * np.round(xy.mean(axis=0) / PERIOD)
    st.Set(Vt.Vec2fArray.FromNumpy(((xy - start) / TILE).astype(np.float32)))
    return np.asarray(start)


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
