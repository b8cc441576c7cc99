"""Standing obstacles in the stage: one mesh each below ``env`` with its finish, visible to any renderer.

Moving obstacles are vehicles of the shot and have their own layers.
"""

from __future__ import annotations

from collections.abc import Iterator
from itertools import cycle
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from vehsim.delivery.take import Take
from vehsim.exporters.usd.metadata import author_points
from vehsim.exporters.usd.packing import Pack
from vehsim.exporters.usd.scenery.finishes import FINISHES, PAINTS, Colour, author_material, coordinates
from vehsim.exporters.usd.scenery.lighting import encode_srgb, to_linear

if TYPE_CHECKING:
    from vehsim.world.obstacles.obstacles import Obstacle


def author_obstacles(stage: Any, scope: str, take: Take, pack: Pack) -> None:
    """Author every standing obstacle of the take's world as ``<scope>/<name>``, and their shared materials."""
    from pxr import Kind, Tf, Usd, UsdGeom, UsdShade

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
    for obstacle in standing:
        material, colour = _finish(obstacle, paints)
        if material not in materials:
            file = pack.folder / "assets" / "obstacles" / f"{material}.png"
            place, relative = f"{scope}/materials/{material}", pack.relative(file, layer)
            materials[material] = author_material(stage, place, file, relative, obstacle.finish, colour)
            pack.written.append(file)
        name = Tf.MakeValidIdentifier(obstacle.name)
        path = f"{scope}/{name}"
        xform = UsdGeom.Xform.Define(stage, path)
        Usd.ModelAPI(xform).SetKind(Kind.Tokens.component)
        mesh = UsdGeom.Mesh.Define(stage, f"{path}/{name}")  # Blender merges both into one object with the mesh's name
        _author_mesh(mesh, obstacle)
        UsdShade.MaterialBindingAPI.Apply(mesh.GetPrim()).Bind(materials[material])


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


def _author_mesh(mesh: Any, obstacle: Obstacle) -> None:
    from pxr import Sdf, UsdGeom, Vt

    points, faces = obstacle.points, obstacle.faces
    corners = points[faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
    mesh.CreateSubdivisionSchemeAttr(UsdGeom.Tokens.none)
    author_points(mesh, points)
    mesh.CreateFaceVertexCountsAttr(Vt.IntArray.FromNumpy(np.full(len(faces), 3, np.int32)))
    mesh.CreateFaceVertexIndicesAttr(Vt.IntArray.FromNumpy(faces.astype(np.int32).ravel()))
    mesh.CreateNormalsAttr(Vt.Vec3fArray.FromNumpy(normals.astype(np.float32)))
    mesh.SetNormalsInterpolation(UsdGeom.Tokens.uniform)
    st = UsdGeom.PrimvarsAPI(mesh).CreatePrimvar("st", Sdf.ValueTypeNames.TexCoord2fArray, UsdGeom.Tokens.faceVarying)
    st.Set(Vt.Vec2fArray.FromNumpy(coordinates(corners, normals, obstacle.finish).reshape(-1, 2).astype(np.float32)))
