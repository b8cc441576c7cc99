"""A look for terrain without one: a smooth-shaded mesh coloured by slope and height.

Shipped terrains have their own look; this is for a studio's height maps and meshes, and for bare ground.
"""

from __future__ import annotations

import io
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from vehsim.exporters.usd.metadata import author_points, author_stage_metadata
from vehsim.exporters.usd.scenery import lighting
from vehsim.exporters.usd.scenery.lighting import encode_srgb
from vehsim.exporters.usd.scenery.textured import author_textured
from vehsim.runtime.cache import kept
from vehsim.runtime.code import code
from vehsim.world.world import STANDING

if TYPE_CHECKING:
    from vehsim.delivery.take import Take
    from vehsim.world.terrain.terrain import Terrain

Array = NDArray[np.float64]

PICTURE = "ground"
"""Cache entries of pictures."""
TEXTURE, LEVEL_TEXTURE = 2048, 1024
TEXELS_PER_CELL = 12
TILE = 48.0
"""Width of the repeated texture of level ground, m."""
STONES = (0.7, 1.5)
"""Sizes of the stones on level ground, texels: of some 3 and 7 cm."""
STONE_CONTRAST = 0.12
"""Standard deviation of their brightness over that of the dust."""
SAND = ((0.36, 0.28, 0.19), (0.42, 0.33, 0.23))
ROCK = ((0.24, 0.17, 0.12), (0.33, 0.24, 0.17))
"""Linear colours at the lowest and the highest point."""
PATTERN = 40.0
"""The pattern of the shipped terrain ``flat`` repeats after this, m."""


def level_ground(take: Take) -> Array | None:
    """The middle (2,) m of the level ground at z = 0 that a shot without a terrain shows; None if it shows none.

    Without it, vehicles that roll would seem to float in pictures, and so would towers that flights pass. Boats have
    none, nor has what flies over water, below z = 0, or past nothing that stands at z = 0.
    """
    clips, world = take.clips.values(), take.world
    if world.terrain is not None or world.water is not None:
        return None
    shown = [clip for clip in clips if clip.vehicle.rolls]
    if not shown and world.seems_level:
        flights = all(clip.vehicle.group.dim == 6 and clip.vehicle.hull is None for clip in clips)
        above = all(clip.positions[:, 2].min() >= -STANDING for clip in clips)
        shown = [*clips] if flights and above else []
    if not shown:
        return None
    return np.asarray(PATTERN * np.round(np.mean([np.mean(clip.positions[:, :2], 0) for clip in shown], 0) / PATTERN))


def write_ground(terrain: Terrain, folder: Path) -> tuple[Path, list[Path]]:
    """Write ``folder/<name>/<name>.usdc`` and its texture; returns the asset and every file written."""
    from pxr import Kind, Tf, Usd, UsdGeom, UsdShade

    name = Tf.MakeValidIdentifier(terrain.name)
    asset = folder / name / f"{name}.usdc"
    texture = asset.with_suffix(".png")
    asset.parent.mkdir(parents=True, exist_ok=True)
    level = terrain.surface is None and float(np.ptp(terrain.heights)) < 1e-6
    texture.write_bytes(_picture(None if level else terrain))

    stage = Usd.Stage.CreateNew(str(asset))
    author_stage_metadata(stage.GetRootLayer())
    root = UsdGeom.Xform.Define(stage, f"/{name}")
    stage.SetDefaultPrim(root.GetPrim())
    Usd.ModelAPI(root).SetKind(Kind.Tokens.component)
    mesh = UsdGeom.Mesh.Define(stage, f"/{name}/{name}")
    _author_mesh(mesh, terrain, TILE if level else None)
    material = _author_material(stage, f"/{name}/materials/ground", f"./{texture.name}")
    UsdShade.MaterialBindingAPI.Apply(mesh.GetPrim()).Bind(material)
    stage.GetRootLayer().Save()
    return asset, [asset, texture]


def _author_mesh(mesh: Any, terrain: Terrain, tile: float | None) -> None:
    from pxr import Sdf, UsdGeom, Vt

    vertices = terrain.vertices
    mesh.CreateSubdivisionSchemeAttr(UsdGeom.Tokens.none)
    author_points(mesh, vertices)
    mesh.CreateFaceVertexCountsAttr(Vt.IntArray.FromNumpy(np.full(len(terrain.faces), 3, np.int32)))
    mesh.CreateFaceVertexIndicesAttr(Vt.IntArray.FromNumpy(terrain.faces.astype(np.int32).ravel()))
    if terrain.surface is None:
        mesh.CreateNormalsAttr(Vt.Vec3fArray.FromNumpy(_normals(terrain).reshape(-1, 3).astype(np.float32)))
        mesh.SetNormalsInterpolation(UsdGeom.Tokens.vertex)
    else:  # faceted, as the corners of arches and tunnels are sharp
        normals = np.repeat(terrain.surface.normals, 3, axis=0)
        lengths = np.linalg.norm(normals, axis=1, keepdims=True)
        mesh.CreateNormalsAttr(Vt.Vec3fArray.FromNumpy((normals / np.maximum(lengths, 1e-300)).astype(np.float32)))
        mesh.SetNormalsInterpolation(UsdGeom.Tokens.faceVarying)
    lower, upper = terrain.lower, terrain.upper
    span = upper[:2] - lower[:2] if tile is None else np.array([tile, tile])
    st = ((vertices[:, :2] - lower[:2]) / span).astype(np.float32)
    primvar = UsdGeom.PrimvarsAPI(mesh).CreatePrimvar("st", Sdf.ValueTypeNames.TexCoord2fArray, UsdGeom.Tokens.vertex)
    primvar.Set(Vt.Vec2fArray.FromNumpy(st))


def _author_material(stage: Any, path: str, texture: str) -> Any:
    from pxr import Gf, Sdf, UsdGeom

    types = Sdf.ValueTypeNames
    UsdGeom.Scope.Define(stage, Sdf.Path(path).GetParentPath())
    material, _, surface = author_textured(stage, path, texture, "colour")
    surface.CreateInput("roughness", types.Float).Set(0.95)
    surface.CreateInput("specularColor", types.Color3f).Set(Gf.Vec3f(0.0))
    surface.CreateInput("useSpecularWorkflow", types.Int).Set(1)
    return material


def _normals(terrain: Terrain) -> Array:
    """Unit normals (rows, cols, 3) by central differences."""
    dx, dy = terrain.cell
    slope_y, slope_x = np.gradient(terrain.heights, dy, dx)
    normals = np.stack([-slope_x, -slope_y, np.ones_like(slope_x)], axis=-1)
    return normals / np.linalg.norm(normals, axis=-1, keepdims=True)


def _picture(terrain: Terrain | None) -> bytes:
    """The PNG of a terrain's colours, None: of level ground; it is cached."""
    key = (code((Path(__file__), Path(lighting.__file__))), None if terrain is None else terrain.content_hash)
    return kept(PICTURE, key, lambda: _png(_level_colours() if terrain is None else _relief_colours(terrain)))


def _relief_colours(terrain: Terrain) -> Array:
    """Linear colours (h, w, 3), row 0 at the far end (+Y), by slope, height and noise; in single precision."""
    rows, cols = terrain.heights.shape
    extent = np.array([terrain.cell[1] * (rows - 1), terrain.cell[0] * (cols - 1)])
    longest = min(TEXTURE, TEXELS_PER_CELL * max(rows, cols))
    shape = np.maximum((longest * extent / extent.max()).astype(int), 16)
    heights, upright = _resized(terrain.heights, shape), _resized(_normals(terrain)[..., 2], shape)
    noise = _noise(heights.shape, wrap=False, fade=0.85)  # detail down to a texel, also on ground of kilometres
    steep = np.clip((0.92 - upright + 0.08 * noise) / 0.25, 0, 1)[..., None]
    rise = ((heights - heights.min()) / max(float(np.ptp(heights)), 1e-9))[..., None]
    bands = 1 + 0.10 * np.sin(heights * 2.1 + 2 * noise)[..., None] * steep
    (low_sand, high_sand), (low_rock, high_rock) = np.array([SAND, ROCK], np.float32)
    sand, rock = low_sand + rise * (high_sand - low_sand), low_rock + rise * (high_rock - low_rock)
    colours = (sand + steep * (rock - sand)) * (bands * (1 + 0.4 * noise[..., None]))
    return np.asarray(colours[::-1])


def _resized(values: Array, shape: tuple[int, ...]) -> NDArray[np.float32]:
    """Values (h, w) at the centres of texels, interpolated linearly for another number of them."""
    from PIL import Image

    height, width = shape
    picture = Image.fromarray(values.astype(np.float32)).resize((int(width), int(height)), Image.Resampling.BILINEAR)
    return np.asarray(picture)


def _level_colours() -> Array:
    """Linear colours (n, n, 3) of dust with loose stones, repeating seamlessly."""
    from scipy.ndimage import gaussian_filter

    size = (LEVEL_TEXTURE, LEVEL_TEXTURE)
    noise, patches = _noise(size), _noise(size, coarse=2, octaves=4, seed=7)
    dust = np.clip(0.5 + patches, 0, 1)[..., None]
    dark, bright = np.array((0.20, 0.165, 0.125)), np.array((0.36, 0.30, 0.225))
    stones = np.random.default_rng(11).normal(size=(2, *size))
    stones = sum(gaussian_filter(one, width, mode="wrap") * width for one, width in zip(stones, STONES, strict=True))
    light = 1 + 0.30 * noise + STONE_CONTRAST * np.clip(stones / stones.std(), -2, 2)
    return (dark + dust * (bright - dark)) * light[..., None]


def _noise(
    shape: tuple[int, ...], coarse: int = 8, octaves: int = 8, seed: int = 3, wrap: bool = True, fade: float = 0.62
) -> NDArray[np.float32]:
    """Fractal value noise (h, w) of about -1 to 1; the same every time. Each octave has ``fade`` times the amplitude of
    the one before."""
    rng = np.random.default_rng(seed)
    noise = np.zeros(shape, np.float32)
    for octave in range(octaves):
        grid = rng.uniform(-1, 1, np.minimum(np.array(shape), coarse * 2**octave))
        noise += np.float32(fade**octave) * (_repeated(grid, shape) if wrap else _resized(grid, shape))
    return noise / np.abs(noise).max()


def _repeated(values: Array, shape: tuple[int, ...]) -> Array:
    """The same as `_resized`, of a picture that repeats seamlessly."""
    from scipy.ndimage import zoom

    factor = np.array(shape) / values.shape
    return np.asarray(zoom(values, factor, order=1, grid_mode=True, mode="grid-wrap")[: shape[0], : shape[1]])


def _png(linear: Array) -> bytes:
    from PIL import Image

    png = io.BytesIO()
    Image.fromarray(encode_srgb(linear)).save(png, "png", compress_level=2)  # a fifth of the time of 6, 14 % larger
    return png.getvalue()
