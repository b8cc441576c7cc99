"""Standing obstacles in the stage: a mesh each below ``env``, painted in turn, so that preview and pipeline show them.

Moving ones are vehicles of the shot and have layers of their own.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from vehsim.take import Take

if TYPE_CHECKING:
    from vehsim.world.obstacles import Obstacle

PAINTS = {
    "concrete": (0.42, 0.40, 0.37),
    "terracotta": (0.42, 0.17, 0.09),
    "ochre": (0.50, 0.33, 0.10),
    "slate": (0.13, 0.19, 0.26),
}
"""Linear colours, taken in turn."""


def author_obstacles(stage: Any, scope: str, take: Take) -> None:
    """Author every standing obstacle of the take's world as ``<scope>/<name>``, and the materials they share."""
    from pxr import Kind, Sdf, Tf, Usd, UsdGeom, UsdShade

    from vehsim.world.obstacles import Obstacle

    standing = [obstacle for obstacle in take.world.obstacles if isinstance(obstacle, Obstacle)]
    if not standing:
        return
    group = UsdGeom.Xform.Define(stage, scope)
    Usd.ModelAPI(group).SetKind(Kind.Tokens.group)
    UsdGeom.Scope.Define(stage, f"{scope}/materials")
    for name, colour in PAINTS.items():
        material = UsdShade.Material.Define(stage, f"{scope}/materials/{name}")
        surface = UsdShade.Shader.Define(stage, f"{scope}/materials/{name}/surface")
        surface.CreateIdAttr("UsdPreviewSurface")
        surface.CreateInput("diffuseColor", Sdf.ValueTypeNames.Color3f).Set(colour)
        surface.CreateInput("roughness", Sdf.ValueTypeNames.Float).Set(0.8)
        material.CreateSurfaceOutput().ConnectToSource(surface.CreateOutput("surface", Sdf.ValueTypeNames.Token))
    for k, obstacle in enumerate(standing):
        paint = list(PAINTS)[k % len(PAINTS)]
        name = Tf.MakeValidIdentifier(obstacle.name)
        path = f"{scope}/{name}"
        xform = UsdGeom.Xform.Define(stage, path)
        Usd.ModelAPI(xform).SetKind(Kind.Tokens.component)
        mesh = UsdGeom.Mesh.Define(stage, f"{path}/{name}")  # Blender makes one object of both, called as the mesh
        _author_mesh(mesh, obstacle)
        material = UsdShade.Material.Get(stage, f"{scope}/materials/{paint}")
        UsdShade.MaterialBindingAPI.Apply(mesh.GetPrim()).Bind(material)


def _author_mesh(mesh: Any, obstacle: Obstacle) -> None:
    from pxr import Gf, UsdGeom, Vt

    points, faces = obstacle.points, obstacle.faces
    corners = points[faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
    mesh.CreateSubdivisionSchemeAttr(UsdGeom.Tokens.none)
    mesh.CreatePointsAttr(Vt.Vec3fArray.FromNumpy(points.astype(np.float32)))
    mesh.CreateFaceVertexCountsAttr(Vt.IntArray.FromNumpy(np.full(len(faces), 3, np.int32)))
    mesh.CreateFaceVertexIndicesAttr(Vt.IntArray.FromNumpy(faces.astype(np.int32).ravel()))
    mesh.CreateNormalsAttr(Vt.Vec3fArray.FromNumpy(normals.astype(np.float32)))
    mesh.SetNormalsInterpolation(UsdGeom.Tokens.uniform)
    lower, upper = points.min(axis=0), points.max(axis=0)
    mesh.CreateExtentAttr([Gf.Vec3f(*lower.tolist()), Gf.Vec3f(*upper.tolist())])
