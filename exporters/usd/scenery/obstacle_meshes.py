"""Standing obstacles in the stage: one mesh each below ``env`` with its finish, visible to any renderer.

Moving obstacles are vehicles of the shot and have their own layers.
"""

from __future__ import annotations

from collections.abc import Iterator
from itertools import cycle
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from vehsim.delivery.take import Take
from vehsim.exporters.usd.metadata import author_points
from vehsim.exporters.usd.packing import Pack
from vehsim.exporters.usd.scenery.finishes import CREASE, FINISHES, PAINTS, Colour, author_material, coordinates, lying
from vehsim.exporters.usd.scenery.lighting import encode_srgb, to_linear

if TYPE_CHECKING:
    from vehsim.world.obstacles.obstacles import Obstacle

Array = NDArray[np.float64]

MOST = 4_000_000
"""Most pairs of faces at a common point; with more, all edges are sharp."""


def author_obstacles(stage: Any, scope: str, take: Take, pack: Pack) -> None:
    """Author every standing obstacle of the take's world as ``<scope>/<name>``, and their shared materials."""
    from pxr import Kind, Tf, Usd, UsdGeom, UsdShade, Vt

    from vehsim.world.obstacles.obstacles import Obstacle

    standing = [obstacle for obstacle in take.world.obstacles if isinstance(obstacle, Obstacle)]
    if not standing:
        return
    group = UsdGeom.Xform.Define(stage, scope)
    Usd.ModelAPI(group).SetKind(Kind.Tokens.group)
    UsdGeom.Scope.Define(stage, f"{scope}/materials")
    layer = Path(stage.GetRootLayer().realPath)
    materials: dict[str, Any] = {}
    paints = cycle(PAINTS.items())

    def material_of(name: str, finish: str, colour: Colour) -> Any:
        if name not in materials:
            file = pack.folder / "assets" / "obstacles" / f"{name}.png"
            place, relative = f"{scope}/materials/{name}", pack.relative(file, layer)
            materials[name] = author_material(stage, place, file, relative, finish, colour)
            pack.written.append(file)
        return materials[name]

    for obstacle in standing:
        name = Tf.MakeValidIdentifier(obstacle.name)
        path = f"{scope}/{name}"
        xform = UsdGeom.Xform.Define(stage, path)
        Usd.ModelAPI(xform).SetKind(Kind.Tokens.component)
        mesh = UsdGeom.Mesh.Define(stage, f"{path}/{name}")  # Blender merges both into one object with the mesh's name
        level = _author_mesh(mesh, obstacle)
        material, colour = _finish(obstacle, paints)
        binding = UsdShade.MaterialBindingAPI.Apply(mesh.GetPrim())
        binding.Bind(material_of(material, obstacle.finish, colour))
        finish = FINISHES[obstacle.finish].level
        if finish is not None and len(level):
            subset = binding.CreateMaterialBindSubset("level", Vt.IntArray.FromNumpy(level.astype(np.int32)))
            other = material_of(finish, finish, PAINTS[finish])
            UsdShade.MaterialBindingAPI.Apply(subset.GetPrim()).Bind(other)


def _finish(obstacle: Obstacle, paints: Iterator[tuple[str, Colour]]) -> tuple[str, Colour]:
    """The name of an obstacle's material, and its linear colour; ``paints``: those of obstacles without a colour."""
    colour = FINISHES[obstacle.finish].colour
    if obstacle.colour is not None:
        red, green, blue = to_linear(obstacle.colour).tolist()
        colour = (red, green, blue)
    if colour is None:
        name, colour = next(paints)
        return (name if obstacle.finish == "concrete" else f"{obstacle.finish}_{name}"), colour
    return f"{obstacle.finish}_{encode_srgb(colour).tobytes().hex()}", colour


def _author_mesh(mesh: Any, obstacle: Obstacle) -> NDArray[np.int64]:
    """Write the mesh; returns the faces that have the finish of level ones."""
    from pxr import Sdf, UsdGeom, Vt

    points, faces = obstacle.points, obstacle.faces
    corners = points[faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
    mesh.CreateSubdivisionSchemeAttr(UsdGeom.Tokens.none)
    author_points(mesh, points)
    mesh.CreateFaceVertexCountsAttr(Vt.IntArray.FromNumpy(np.full(len(faces), 3, np.int32)))
    mesh.CreateFaceVertexIndicesAttr(Vt.IntArray.FromNumpy(faces.astype(np.int32).ravel()))
    shaded = shading_normals(points, faces).reshape(-1, 3)
    mesh.CreateNormalsAttr(Vt.Vec3fArray.FromNumpy(shaded.astype(np.float32)))
    mesh.SetNormalsInterpolation(UsdGeom.Tokens.faceVarying)
    st = UsdGeom.PrimvarsAPI(mesh).CreatePrimvar("st", Sdf.ValueTypeNames.TexCoord2fArray, UsdGeom.Tokens.faceVarying)
    uvs, level = coordinates(corners, normals, obstacle.finish), lying(normals, obstacle.finish)
    if level.any():
        uvs[level] = coordinates(corners[level], normals[level], FINISHES[obstacle.finish].level or obstacle.finish)
    st.Set(Vt.Vec2fArray.FromNumpy(uvs.reshape(-1, 2).astype(np.float32)))
    return np.flatnonzero(level)


def shading_normals(points: Array, faces: NDArray[np.int64]) -> Array:
    """Unit normals (m, 3, 3) at the corners of triangles (m, 3): the mean over the faces around each point that are
    within `CREASE` of the corner's own, weighted by their angles there."""
    corners = points[faces]
    ahead, back = np.roll(corners, -1, axis=1) - corners, np.roll(corners, 1, axis=1) - corners
    across = np.cross(ahead, back)
    normals = across[:, 0] / np.maximum(np.linalg.norm(across[:, 0], axis=1, keepdims=True), 1e-12)
    angles = np.arctan2(np.linalg.norm(across, axis=2), (ahead * back).sum(axis=2)).ravel()
    order = np.argsort(faces, axis=None, kind="stable")  # corners, by point
    count = np.bincount(faces.ravel(), minlength=len(points))
    of_corner = count[faces.ravel()[order]]
    if of_corner.sum() > MOST:
        return np.repeat(normals[:, None], 3, axis=1)
    first = np.repeat(np.cumsum(count) - count, count)  # of the point's corners, in that order
    mine = np.repeat(order, of_corner)
    step = np.arange(len(mine)) - np.repeat(np.cumsum(of_corner) - of_corner, of_corner)
    other = order[np.repeat(first, of_corner) + step]
    close = (normals[mine // 3] * normals[other // 3]).sum(axis=1) >= np.cos(CREASE)
    means = np.zeros((faces.size, 3))
    np.add.at(means, mine[close], angles[other[close], None] * normals[other[close] // 3])
    means /= np.maximum(np.linalg.norm(means, axis=1, keepdims=True), 1e-12)
    return means.reshape(-1, 3, 3)
