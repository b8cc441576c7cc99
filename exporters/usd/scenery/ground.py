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
from vehsim.exporters.usd.scenery import driven, lighting
from vehsim.exporters.usd.scenery.driven import BARE, GROUNDS, Ground, noise, resized
from vehsim.exporters.usd.scenery.lighting import encode_srgb
from vehsim.exporters.usd.scenery.textured import author_textured
from vehsim.runtime.cache import kept
from vehsim.runtime.code import code
from vehsim.world.world import STANDING

if TYPE_CHECKING:
    from vehsim.delivery.take import Take
    from vehsim.vehicles.definition.surfaces import SurfaceName
    from vehsim.world.terrain.terrain import Terrain

Array = NDArray[np.float64]

PICTURE = "ground"
"""Cache entries of pictures."""
TEXTURE = 2048
TEXELS_PER_CELL = 12
TILE = 48.0
"""Width of the repeated texture of level ground, m."""
ROCK = ((0.24, 0.17, 0.12), (0.33, 0.24, 0.17))
"""Linear colours of steep ground, at the lowest and the highest point."""
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


def write_ground(terrain: Terrain, folder: Path, surface: SurfaceName | None = None) -> tuple[Path, list[Path]]:
    """Write ``folder/<name>/<name>.usdc`` and its texture; returns the asset and every file written.

    ``surface``: what it shows, one of `GROUNDS`; None: bare ground.
    """
    from pxr import Kind, Tf, Usd, UsdGeom, UsdShade

    name = Tf.MakeValidIdentifier(terrain.name)
    asset = folder / name / f"{name}.usdc"
    texture = asset.with_suffix(".png")
    asset.parent.mkdir(parents=True, exist_ok=True)
    level = terrain.surface is None and float(np.ptp(terrain.heights)) < 1e-6
    look = GROUNDS[surface or BARE]
    texture.write_bytes(_picture(look, None if level else terrain))

    stage = Usd.Stage.CreateNew(str(asset))
    author_stage_metadata(stage.GetRootLayer())
    root = UsdGeom.Xform.Define(stage, f"/{name}")
    stage.SetDefaultPrim(root.GetPrim())
    Usd.ModelAPI(root).SetKind(Kind.Tokens.component)
    mesh = UsdGeom.Mesh.Define(stage, f"/{name}/{name}")
    _author_mesh(mesh, terrain, TILE if level else None)
    material = _author_material(stage, f"/{name}/materials/ground", f"./{texture.name}", look)
    UsdShade.MaterialBindingAPI.Apply(mesh.GetPrim()).Bind(material)
    stage.GetRootLayer().Save()
    return asset, [asset, texture]


def author_surface(stage: Any, path: str, prim: Any, file: Path, relative: str, surface: SurfaceName) -> None:
    """Show a ``surface`` on a ``prim`` instead of its own look: write the texture to ``file``, and a material at
    ``path`` that names it ``relative``; it is bound more strongly than what the prim's asset binds."""
    from pxr import UsdShade

    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_bytes(_picture(GROUNDS[surface], None))
    material = _author_material(stage, path, relative, GROUNDS[surface])
    stronger = UsdShade.Tokens.strongerThanDescendants
    UsdShade.MaterialBindingAPI.Apply(prim).Bind(material, bindingStrength=stronger)


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


def _author_material(stage: Any, path: str, texture: str, look: Ground) -> Any:
    from pxr import Gf, Sdf, UsdGeom

    types = Sdf.ValueTypeNames
    UsdGeom.Scope.Define(stage, Sdf.Path(path).GetParentPath())
    material, _, surface = author_textured(stage, path, texture, "colour")
    surface.CreateInput("roughness", types.Float).Set(look.roughness)
    surface.CreateInput("specularColor", types.Color3f).Set(Gf.Vec3f(look.specular))
    surface.CreateInput("useSpecularWorkflow", types.Int).Set(1)
    return material


def _normals(terrain: Terrain) -> Array:
    """Unit normals (rows, cols, 3) by central differences."""
    dx, dy = terrain.cell
    slope_y, slope_x = np.gradient(terrain.heights, dy, dx)
    normals = np.stack([-slope_x, -slope_y, np.ones_like(slope_x)], axis=-1)
    return normals / np.linalg.norm(normals, axis=-1, keepdims=True)


def _picture(look: Ground, terrain: Terrain | None) -> bytes:
    """The PNG of a terrain's colours, None: of level ground; it is cached."""
    files = (Path(__file__), Path(driven.__file__), Path(lighting.__file__))
    key = (code(files), look.low, look.high, None if terrain is None else terrain.content_hash)
    return kept(PICTURE, key, lambda: _png(look.paint() if terrain is None else _relief_colours(terrain, look)))


def _relief_colours(terrain: Terrain, look: Ground) -> Array:
    """Linear colours (h, w, 3), row 0 at the far end (+Y), by slope, height and noise; in single precision."""
    rows, cols = terrain.heights.shape
    extent = np.array([terrain.cell[1] * (rows - 1), terrain.cell[0] * (cols - 1)])
    longest = min(TEXTURE, TEXELS_PER_CELL * max(rows, cols))
    shape = np.maximum((longest * extent / extent.max()).astype(int), 16)
    heights, upright = resized(terrain.heights, shape), resized(_normals(terrain)[..., 2], shape)
    grain = noise(heights.shape, wrap=False, fade=0.85)  # detail down to a texel, also on ground of kilometres
    steep = np.clip((0.92 - upright + 0.08 * grain) / 0.25, 0, 1)[..., None]
    rise = ((heights - heights.min()) / max(float(np.ptp(heights)), 1e-9))[..., None]
    bands = 1 + 0.10 * np.sin(heights * 2.1 + 2 * grain)[..., None] * steep
    (low_sand, high_sand), (low_rock, high_rock) = np.array([(look.low, look.high), ROCK], np.float32)
    sand, rock = low_sand + rise * (high_sand - low_sand), low_rock + rise * (high_rock - low_rock)
    colours = (sand + steep * (rock - sand)) * (bands * (1 + 0.4 * grain[..., None]))
    return np.asarray(colours[::-1])


def _png(linear: Array) -> bytes:
    from PIL import Image

    png = io.BytesIO()
    Image.fromarray(encode_srgb(linear)).save(png, "png", compress_level=2)  # a fifth of the time of 6, 14 % larger
    return png.getvalue()
