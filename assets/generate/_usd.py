"""Surfaces, materials and pivots written as a USD vehicle asset, in the same form for every generated vehicle.

This module holds USD only: stage metadata, parts as Xform prims with their pivot as rest translate, one mesh per
material with purpose `render` and a coarse one with purpose `proxy`, UsdPreviewSurface materials, liveries as a variant
set, and collision meshes with purpose `guide`.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from types import MappingProxyType

import numpy as np

from vehsim.assets.generate._shapes import Surface
from vehsim.assets.generate._slim import slimmed

COARSE, COARSEST = 0.01, 0.04
"""Largest distance of a proxy from the look: a share of the vehicle's size, and m."""


@dataclass(frozen=True)
class Material:
    """A UsdPreviewSurface: linear colours; other values are from 0 to 1."""

    colour: tuple[float, float, float]
    roughness: float = 0.5
    metallic: float = 0.0
    opacity: float = 1.0
    clearcoat: float = 0.0
    ior: float = 1.5
    glow: tuple[float, float, float] = (0.0, 0.0, 0.0)


@dataclass(frozen=True)
class PartShape:
    """A moving part: its pivot in its parent part's frame, m, its rest rotation, and its surfaces in its own frame.

    ``turn``: degrees about X, then Y, then Z. ``look`` has one surface per material name, ``collision`` surfaces by
    name ("" stands for the part's name), ``parts`` the parts that it carries.
    """

    pivot: tuple[float, float, float] = (0.0, 0.0, 0.0)
    look: Mapping[str, Surface] = field(default_factory=dict)
    collision: Mapping[str, Surface] = field(default_factory=dict)
    parts: Mapping[str, PartShape] = field(default_factory=dict)
    turn: tuple[float, float, float] = (0.0, 0.0, 0.0)


Liveries = Mapping[str, Mapping[str, Material]]
"""Livery name -> the materials it changes. The first is the default."""
PLAIN: Liveries = MappingProxyType({})
Absent = Mapping[str, Mapping[str, str]]
"""Variant set -> its variants -> the prefix of the names of materials whose meshes the variant leaves out; "": none.
The first variant is the default."""
WHOLE: Absent = MappingProxyType({})


def write_asset(
    path: Path,
    parts: Mapping[str, PartShape],
    materials: Mapping[str, Material],
    doc: str,
    liveries: Liveries = PLAIN,
    absent: Absent = WHOLE,
) -> None:
    """Write a vehicle named like ``path``: ``/<name>/<part>/<part>_<material>``, metres, Z up.

    ``liveries`` become the variant set "livery" on the root; every material one of them changes must be in all.
    ``absent`` become variant sets too.
    """
    from pxr import Kind, Sdf, Usd, UsdGeom

    path.parent.mkdir(parents=True, exist_ok=True)
    path.unlink(missing_ok=True)
    stage = Usd.Stage.CreateNew(str(path))
    UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.z)
    stage.GetRootLayer().documentation = doc
    root = UsdGeom.Xform.Define(stage, f"/{path.stem}")
    stage.SetDefaultPrim(root.GetPrim())
    model = Usd.ModelAPI(root.GetPrim())
    model.SetKind(Kind.Tokens.component)
    model.SetAssetName(path.stem)
    model.SetAssetIdentifier(Sdf.AssetPath(path.name))
    model.SetAssetVersion("1")
    shaders = _write_materials(stage, f"/{path.stem}", materials)
    coarse = min(COARSE * _size(parts), COARSEST)
    for name, part in parts.items():
        _write_part(stage, f"/{path.stem}/{name}", part, shaders, coarse)
    _write_liveries(stage, root.GetPrim(), liveries)
    _write_absent(root.GetPrim(), absent)
    geometry = UsdGeom.ModelAPI.Apply(root.GetPrim())
    cache = UsdGeom.BBoxCache(Usd.TimeCode.Default(), ["default", "render", "proxy", "guide"], useExtentsHint=False)
    geometry.SetExtentsHint(geometry.ComputeExtentsHint(cache))
    stage.Save()


def triangles(parts: Mapping[str, PartShape]) -> int:
    """Number of triangles in the look of ``parts``, including the parts that they carry."""
    return sum(sum(len(s.faces) for s in p.look.values()) + triangles(p.parts) for p in parts.values())


def _size(parts: Mapping[str, PartShape]) -> float:
    """The longest side of the largest surface, m."""
    own = [float(np.ptp(s.points, axis=0).max()) for part in parts.values() for s in part.look.values()]
    return max([*own, *(_size(part.parts) for part in parts.values() if part.parts)], default=0.0)


def _write_materials(stage, root: str, materials: Mapping[str, Material]) -> dict:
    """Author the materials; those that liveries change are written by them, because a local value would be stronger."""
    from pxr import Sdf, UsdGeom, UsdShade

    UsdGeom.Scope.Define(stage, f"{root}/materials")
    bound = {}
    for name, material in materials.items():
        shader_material = UsdShade.Material.Define(stage, f"{root}/materials/{name}")
        shader = UsdShade.Shader.Define(stage, f"{root}/materials/{name}/surface")
        shader.CreateIdAttr("UsdPreviewSurface")
        shader_material.CreateSurfaceOutput().ConnectToSource(shader.CreateOutput("surface", Sdf.ValueTypeNames.Token))
        _author_surface(shader, material)
        bound[name] = (shader_material, material)
    return bound


def _author_surface(shader, material: Material) -> None:
    from pxr import Gf, Sdf

    colour, number = Sdf.ValueTypeNames.Color3f, Sdf.ValueTypeNames.Float
    shader.CreateInput("diffuseColor", colour).Set(Gf.Vec3f(*material.colour))
    shader.CreateInput("emissiveColor", colour).Set(Gf.Vec3f(*material.glow))
    for key in ("roughness", "metallic", "opacity", "clearcoat"):
        shader.CreateInput(key, number).Set(getattr(material, key))
    shader.CreateInput("clearcoatRoughness", number).Set(0.05)
    if material.opacity < 1:
        shader.CreateInput("ior", number).Set(material.ior)


def _write_liveries(stage, root, liveries: Liveries) -> None:
    """The variant set "livery": each variant authors the surfaces that it changes and their display colours.

    Local opinions are stronger than a variant's, so what a livery changes is cleared outside the variants.
    """
    from pxr import Gf, Usd, UsdGeom, UsdShade

    if not liveries:
        return
    changed = sorted({name for livery in liveries.values() for name in livery})
    for choice, chosen in liveries.items():
        if missing := sorted(set(changed) - set(chosen)):
            raise ValueError(
                f"livery {choice!r} says nothing of {missing}: every livery must say all that one of them does"
            )
    meshes: dict[str, list] = {name: [] for name in changed}
    for prim in Usd.PrimRange(root):
        bound = UsdShade.MaterialBindingAPI(prim).GetDirectBinding().GetMaterialPath().name
        if bound in meshes:
            meshes[bound].append(UsdGeom.Gprim(prim))
    shaders = {
        name: UsdShade.Shader(stage.GetPrimAtPath(f"{root.GetPath()}/materials/{name}/surface")) for name in changed
    }
    for name in changed:
        for port in shaders[name].GetInputs():
            port.GetAttr().Clear()
        for mesh in meshes[name]:
            mesh.GetDisplayColorAttr().Clear()
    choices = root.GetVariantSets().AddVariantSet("livery")
    for livery, surfaces in liveries.items():
        choices.AddVariant(livery)
        choices.SetVariantSelection(livery)
        with choices.GetVariantEditContext():
            for name in changed:
                _author_surface(shaders[name], surfaces[name])
                for mesh in meshes[name]:
                    mesh.GetDisplayColorAttr().Set([Gf.Vec3f(*surfaces[name].colour)])
    choices.SetVariantSelection(next(iter(liveries)))


def _write_absent(root, absent: Absent) -> None:
    """Variant sets that leave meshes out, by their materials' names."""
    from pxr import Usd, UsdShade

    prims = list(Usd.PrimRange(root))
    bound = {p: UsdShade.MaterialBindingAPI(p).GetDirectBinding().GetMaterialPath().name for p in prims}
    for name, variants in absent.items():
        choices = root.GetVariantSets().AddVariantSet(name)
        for variant, start in variants.items():
            choices.AddVariant(variant)
            choices.SetVariantSelection(variant)
            with choices.GetVariantEditContext():
                for prim, material in bound.items():
                    if start and material.startswith(start):
                        prim.SetActive(False)
        choices.SetVariantSelection(next(iter(variants)))


def _write_part(stage, path: str, part: PartShape, shaders: Mapping, coarse: float) -> None:
    """``coarse``: largest distance of the proxies from the look, m."""
    from pxr import Gf, UsdGeom, UsdPhysics

    xform = UsdGeom.Xform.Define(stage, path)
    xform.AddTranslateOp().Set(Gf.Vec3d(*part.pivot))
    if any(part.turn):
        xform.AddRotateXYZOp(UsdGeom.XformOp.PrecisionDouble).Set(Gf.Vec3d(*part.turn))
    name = path.rsplit("/", 1)[-1]
    if twice := set(part.look) & set(part.collision):
        raise ValueError(
            f"{path}: {sorted(twice)} names a look and a collision surface; give the collision another name"
        )
    proxies = slimmed(part.look, coarse, shade=180.0, turn=55.0) if part.look else {}
    for key, surface in part.look.items():
        mesh = _write_look(stage, f"{path}/{name}_{key}", surface, *shaders[key])
        mesh.CreatePurposeAttr(UsdGeom.Tokens.render)
        if len(proxies[key].faces):
            proxy = _write_look(stage, f"{path}/{name}_{key}_proxy", proxies[key], *shaders[key])
            proxy.CreatePurposeAttr(UsdGeom.Tokens.proxy)
            mesh.SetProxyPrim(proxy.GetPrim())
    for key, surface in part.collision.items():
        mesh = _write_mesh(stage, f"{path}/{name}_{key}" if key else f"{path}/{name}", surface)
        mesh.CreatePurposeAttr(UsdGeom.Tokens.guide)
        UsdPhysics.CollisionAPI.Apply(mesh.GetPrim())
        UsdPhysics.MeshCollisionAPI.Apply(mesh.GetPrim()).CreateApproximationAttr(UsdPhysics.Tokens.convexHull)
    for key, child in part.parts.items():
        _write_part(stage, f"{path}/{key}", child, shaders, coarse)


def _write_look(stage, path: str, surface: Surface, shader, material: Material):
    from pxr import Gf, UsdGeom, UsdShade

    mesh = _write_mesh(stage, path, surface)
    colour = mesh.CreateDisplayColorPrimvar(UsdGeom.Tokens.constant)
    colour.Set([Gf.Vec3f(*material.colour)])
    mesh.CreateDisplayOpacityPrimvar(UsdGeom.Tokens.constant).Set([material.opacity])
    mesh.CreateNormalsAttr([Gf.Vec3f(*n) for n in (np.round(surface.normals, 7) + 0.0).tolist()])
    mesh.SetNormalsInterpolation(UsdGeom.Tokens.vertex)
    UsdShade.MaterialBindingAPI.Apply(mesh.GetPrim()).Bind(shader)
    return mesh


def _write_mesh(stage, path: str, surface: Surface):
    from pxr import Gf, UsdGeom, Vt

    points = np.ascontiguousarray(np.round(surface.points, 8) + 0.0, np.float32)
    faces = np.ascontiguousarray(surface.faces, np.int32)
    mesh = UsdGeom.Mesh.Define(stage, path)
    mesh.CreateSubdivisionSchemeAttr(UsdGeom.Tokens.none)
    mesh.CreatePointsAttr(Vt.Vec3fArray.FromNumpy(points))
    mesh.CreateFaceVertexCountsAttr(Vt.IntArray.FromNumpy(np.full(len(faces), 3, np.int32)))
    mesh.CreateFaceVertexIndicesAttr(Vt.IntArray.FromNumpy(faces.reshape(-1)))
    mesh.CreateExtentAttr([Gf.Vec3f(*points.min(0).tolist()), Gf.Vec3f(*points.max(0).tolist())])
    return mesh
