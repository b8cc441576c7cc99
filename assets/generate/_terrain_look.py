"""The look of a generated terrain: texture coordinates, places of texels, and the USD file with the materials.

This module holds what all terrains share; the colours of rocks and roads are in each terrain's script.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vehsim.world.terrain.terrain import Terrain

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Sheet:
    """A textured mesh: ``points`` (n, 3) m, ``faces`` (m, 3), ``st`` (n, 2) and unit ``normals`` (n, 3)."""

    points: Array
    faces: NDArray[np.int64]
    st: Array
    normals: Array


def sheet(points: Array, faces: NDArray[np.int64], st: Array) -> Sheet:
    """A sheet with smooth normals: the area-weighted mean of the faces around each vertex."""
    corners = points[faces]
    area = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals = np.zeros_like(points)
    for k in range(3):
        np.add.at(normals, faces[:, k], area)
    return Sheet(points, faces, st, normals / np.linalg.norm(normals, axis=1, keepdims=True))


RINGS = 26
FAR = 1500.0
"""Extent of the country around a terrain, m."""


def horizon_sheet(terrain: Terrain, country: Callable[[Array], Array]) -> Sheet:
    """The surroundings of a terrain: rings that start hidden below its border and end far away.

    ``country``: heights (...,) m at places (..., 2) m, fully reached 90 m from the border.
    """
    low, high = terrain.lower[:2], terrain.upper[:2]
    centre, half = 0.5 * (low + high), 0.5 * (high - low)
    angle = 2 * np.pi * np.arange(256) / 256
    direction = np.column_stack([np.cos(angle), np.sin(angle)])
    square = direction / np.max(np.abs(direction), axis=1, keepdims=True)
    outward = np.r_[-5.0, 2.0, np.geomspace(12.0, FAR, RINGS - 2)]
    blend = np.clip(outward / FAR, 0, 1)[:, None, None] ** 0.5  # from the border's rectangle to a circle
    border = square[None] * (half + np.minimum(outward, 0)[:, None, None])
    xy = centre + border + direction * np.maximum(outward, 0)[:, None, None] * (1 - 0.25 * blend)
    inner = terrain.height(np.clip(xy[0], low, high))
    edge = terrain.height(np.clip(xy, low, high).reshape(-1, 2)).reshape(xy.shape[:2])
    level = np.asarray(np.interp(outward, [2, 90], [0, 1]))[:, None]
    z = (1 - level) * edge + level * country(xy)
    z[0], z[1] = inner - 4.0, edge[1] - 0.8
    points = np.concatenate([xy, z[..., None]], axis=-1).reshape(-1, 3)
    ring, k = np.meshgrid(np.arange(RINGS - 1), np.arange(256), indexing="ij")
    a, b = ring * 257 + k, ring * 257 + k + 1
    faces = np.stack([a, a + 257, b + 257, a, b + 257, b], axis=-1).reshape(-1, 3)
    closed = np.concatenate([points.reshape(RINGS, 256, 3), points.reshape(RINGS, 256, 3)[:, :1]], axis=1)
    s, t = np.meshgrid(np.arange(257) / 256, np.arange(RINGS) / (RINGS - 1))
    return sheet(closed.reshape(-1, 3), faces, np.stack([s, t], axis=-1).reshape(-1, 2))


def unwrap(terrain: Terrain) -> Array:
    """Texture coordinates (n, 2) in the unit square that give cliffs their share of the picture.

    A projection from above would smear a cliff over a few texels. This is Tutte's embedding of the grid with springs of
    stiffness 1 / length: one to one for any heights, with edges nearly as long as they are in space.
    """
    from scipy.sparse import coo_matrix
    from scipy.sparse.linalg import spsolve

    rows, cols = terrain.heights.shape
    points = terrain.vertices
    index = np.arange(rows * cols).reshape(rows, cols)
    a = np.concatenate([index[:, :-1].ravel(), index[:-1].ravel()])
    b = np.concatenate([index[:, 1:].ravel(), index[1:].ravel()])
    stiffness = 1 / np.linalg.norm(points[a] - points[b], axis=1)
    weights = coo_matrix((np.tile(stiffness, 2), (np.r_[a, b], np.r_[b, a])), shape=(len(points),) * 2).tocsr()
    st = np.full((len(points), 2), np.nan)
    for line, axis, value in ((index[0], 0, 0), (index[-1], 0, 1), (index[:, 0], 1, 0), (index[:, -1], 1, 1)):
        length = np.linalg.norm(np.diff(points[line], axis=0), axis=1)
        st[line, axis] = np.r_[0, np.cumsum(length)] / length.sum()
        st[line, 1 - axis] = value
    fixed = ~np.isnan(st[:, 0])
    laplacian = (coo_matrix((np.asarray(weights.sum(axis=1)).ravel(), (index.ravel(),) * 2)) - weights).tocsr()
    inner = ~fixed
    known = -laplacian[inner][:, fixed] @ st[fixed]
    system = laplacian[inner][:, inner].tocsc()
    st[inner] = np.column_stack([spsolve(system, known[:, k]) for k in range(2)])
    return st


def texels(surface: Sheet, size: int) -> tuple[NDArray[np.int64], Array]:
    """For each texel of a ``size``^2 picture, row 0 on top: its face (size^2,) and barycentric weights (size^2, 3)."""
    import igl

    flat = np.column_stack([surface.st, np.zeros(len(surface.st))])
    u = (np.arange(size) + 0.5) / size
    grid = np.stack(np.meshgrid(u, u[::-1]), axis=-1).reshape(-1, 2)
    query = np.column_stack([grid, np.zeros(len(grid))])
    tree = igl.AABB()
    tree.init(flat, surface.faces)
    face = tree.squared_distance(flat, surface.faces, query)[1]
    a, b, c = (flat[surface.faces[face, k], :2] for k in range(3))
    cross = (b[:, 0] - a[:, 0]) * (c[:, 1] - a[:, 1]) - (b[:, 1] - a[:, 1]) * (c[:, 0] - a[:, 0])
    v = ((grid[:, 0] - a[:, 0]) * (c[:, 1] - a[:, 1]) - (grid[:, 1] - a[:, 1]) * (c[:, 0] - a[:, 0])) / cross
    w = ((b[:, 0] - a[:, 0]) * (grid[:, 1] - a[:, 1]) - (b[:, 1] - a[:, 1]) * (grid[:, 0] - a[:, 0])) / cross
    return face, np.clip(np.column_stack([1 - v - w, v, w]), 0, 1)


def at_texels(values: Array, surface: Sheet, face: NDArray[np.int64], weights: Array) -> Array:
    """Values (n, ...) at the vertices, interpolated at the texels."""
    corners = values[surface.faces[face]]
    return np.asarray(np.einsum("tk,tk...->t...", weights, corners))


def sky_view(heights: Array, cell: float, reach: float = 60.0, directions: int = 16) -> Array:
    """Visible share of the sky at each point (rows, cols), 0 to 1, from its horizon in ``directions``."""
    from scipy.ndimage import shift

    seen = np.zeros_like(heights)
    for angle in 2 * np.pi * np.arange(directions) / directions:
        slope = np.zeros_like(heights)
        for distance in np.geomspace(cell, reach, 14):
            offset = distance / cell * np.array([np.sin(angle), np.cos(angle)])
            slope = np.maximum(slope, (shift(heights, -offset, order=1, mode="nearest") - heights) / distance)
        seen += 1 / (1 + slope**2)  # cos^2 of the horizon's elevation: the share of a cosine-weighted sky slice
    return seen / directions


def write_picture(file: Path, colour: Array, size: int, quality: int = 88) -> None:
    """Write colours (size^2, 3), 0 to 1, in sRGB, as a JPEG."""
    from PIL import Image

    pixels = (np.clip(colour, 0, 1) * 255).round().astype(np.uint8).reshape(size, size, 3)
    Image.fromarray(pixels).save(file, quality=quality, optimize=True, subsampling=0)


def write_look(file: Path, sheets: dict[str, tuple[Sheet, str, float]], wrap: str = "clamp") -> None:
    """A USD file of textured sheets: name -> (sheet, picture beside the file, roughness). Metres, Z up."""
    from pxr import Kind, Sdf, Usd, UsdGeom

    layer = Sdf.Layer.CreateNew(str(file))
    stage = Usd.Stage.Open(layer)
    UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.z)
    root = UsdGeom.Xform.Define(stage, f"/{file.stem}").GetPrim()
    stage.SetDefaultPrim(root)
    Usd.ModelAPI(root).SetKind(Kind.Tokens.component)
    Usd.ModelAPI(root).SetAssetName(file.stem)
    UsdGeom.Scope.Define(stage, root.GetPath().AppendChild("materials"))
    for name, (surface, picture, roughness) in sheets.items():
        mesh = _define_mesh(stage, root.GetPath().AppendChild(name), surface)
        path = root.GetPath().AppendPath(f"materials/{name}")
        _bind_picture(stage, mesh, path, f"./{picture}", roughness, wrap)
    stage.Save()


def _define_mesh(stage: Any, path: Any, surface: Sheet) -> Any:
    from pxr import Sdf, UsdGeom, Vt

    mesh = UsdGeom.Mesh.Define(stage, path)
    mesh.CreateSubdivisionSchemeAttr(UsdGeom.Tokens.none)
    mesh.CreatePointsAttr(Vt.Vec3fArray.FromNumpy(surface.points.astype(np.float32)))
    mesh.CreateFaceVertexCountsAttr(Vt.IntArray.FromNumpy(np.full(len(surface.faces), 3, np.int32)))
    mesh.CreateFaceVertexIndicesAttr(Vt.IntArray.FromNumpy(surface.faces.astype(np.int32).ravel()))
    mesh.CreateNormalsAttr(Vt.Vec3fArray.FromNumpy(surface.normals.astype(np.float32)))
    mesh.SetNormalsInterpolation(UsdGeom.Tokens.vertex)
    mesh.CreateExtentAttr(UsdGeom.PointBased.ComputeExtent(mesh.GetPointsAttr().Get()))
    kind = Sdf.ValueTypeNames.TexCoord2fArray
    st = UsdGeom.PrimvarsAPI(mesh).CreatePrimvar("st", kind, UsdGeom.Tokens.vertex)
    st.Set(Vt.Vec2fArray.FromNumpy(surface.st.astype(np.float32)))
    return mesh


def _bind_picture(stage: Any, mesh: Any, path: Any, picture: str, roughness: float, wrap: str) -> None:
    """A matt UsdPreviewSurface whose colour is ``picture``."""
    from pxr import Sdf, UsdShade

    types = Sdf.ValueTypeNames
    material = UsdShade.Material.Define(stage, path)

    def shader(name: str, identifier: str, **inputs: tuple[Any, Any]) -> Any:
        node = UsdShade.Shader.Define(stage, path.AppendChild(name))
        node.CreateIdAttr(identifier)
        for key, (kind, value) in inputs.items():
            node.CreateInput(key, kind).Set(value)
        return node

    reader = shader("coordinates", "UsdPrimvarReader_float2", varname=(types.String, "st"))
    texture = shader(
        "picture",
        "UsdUVTexture",
        file=(types.Asset, Sdf.AssetPath(picture)),
        sourceColorSpace=(types.Token, "sRGB"),
        wrapS=(types.Token, wrap),
        wrapT=(types.Token, wrap),
    )
    surface = shader("surface", "UsdPreviewSurface", roughness=(types.Float, roughness), metallic=(types.Float, 0.0))
    texture.CreateInput("st", types.Float2).ConnectToSource(reader.CreateOutput("result", types.Float2))
    colour = texture.CreateOutput("rgb", types.Float3)
    surface.CreateInput("diffuseColor", types.Color3f).ConnectToSource(colour)
    material.CreateSurfaceOutput().ConnectToSource(surface.CreateOutput("surface", types.Token))
    UsdShade.MaterialBindingAPI.Apply(mesh.GetPrim()).Bind(material)
