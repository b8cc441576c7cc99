"""Boxes and wheels as a USD asset, for a vehicle without one: enough to see it move and to rig it further.

`with_primitives(vehicle, folder, parts)` writes the asset and returns the vehicle rigged to it; without ``parts`` it
makes a box with a wheel for every channel. A ``vehicle.toml`` or a `Rig` can later refer to a real asset instead.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from vehsim.errors import InputError
from vehsim.rig.rig import Drive, Rig
from vehsim.vehicles.definition.base import Array
from vehsim.vehicles.definition.vehicle import Vehicle

Numbers = tuple[float, float, float]


@dataclass(frozen=True)
class Box:
    """A box of ``size`` (3,) m whose own origin, ``at`` (3,) m in its parent's frame, is its centre."""

    size: Numbers
    at: Numbers = (0.0, 0.0, 0.0)
    colour: Numbers = (0.16, 0.30, 0.55)
    parent: str = ""
    channel: str = ""
    op: str = "rotateZ"

    def mesh(self) -> list[tuple[str, Array, Array, Numbers]]:
        corners = np.array([[x, y, z] for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (-0.5, 0.5)])
        faces = np.array([[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]])
        return [("shape", corners * self.size, faces, self.colour)]


@dataclass(frozen=True)
class Wheel:
    """A wheel about its Y axis, ``radius`` and ``width`` m, with a bar across its faces that shows it turning."""

    radius: float
    width: float = 0.05
    at: Numbers = (0.0, 0.0, 0.0)
    colour: Numbers = (0.04, 0.04, 0.045)
    parent: str = ""
    channel: str = ""
    op: str = "rotateY"

    def mesh(self) -> list[tuple[str, Array, Array, Numbers]]:
        turn = np.linspace(0, 2 * np.pi, 24, endpoint=False)
        ring = self.radius * np.column_stack([np.cos(turn), 0 * turn, np.sin(turn)])
        half = np.array([0.0, self.width / 2, 0.0])
        points = np.vstack([ring - half, ring + half, [-half, half]])
        k, after = np.arange(24), (np.arange(24) + 1) % 24
        tread = np.column_stack([k, after, after + 24, k + 24])
        caps = [
            np.column_stack([k, 0 * k + 48, after, after]),
            np.column_stack([k + 24, after + 24, 0 * k + 49, 0 * k + 49]),
        ]
        tyre = np.vstack([tread, *caps])[:, ::-1]
        bar = Box((1.6 * self.radius, 1.06 * self.width, 0.18 * self.radius), colour=(0.8, 0.75, 0.6)).mesh()[0]
        return [("shape", points, tyre, self.colour), ("mark", bar[1], bar[2], bar[3])]


def with_primitives(vehicle: Vehicle, folder: str | Path, parts: Mapping[str, Box | Wheel] | None = None) -> Vehicle:
    """``vehicle`` rigged to a new USD asset ``<folder>/<name>.usda`` of ``parts`` (name -> `Box` or `Wheel`).

    A part with a ``channel`` is driven by it, about or along the axis of ``op``. Raises ``InputError`` for a channel or
    a parent that does not exist.
    """
    parts = default_parts(vehicle) if parts is None else parts
    for name, part in parts.items():
        if part.channel and part.channel not in vehicle.channels:
            known = ", ".join(vehicle.channels) or "none"
            raise InputError(
                "unknown", f"{vehicle.name} has {known}", key=f"parts[{name!r}].channel", value=part.channel
            )
        if part.parent and part.parent not in parts:
            raise InputError(
                "unknown", f"choose one of {', '.join(parts)}", key=f"parts[{name!r}].parent", value=part.parent
            )
    paths = {name: _path(name, parts) for name in parts}
    asset = Path(folder) / f"{vehicle.name}.usda"
    _write(asset, vehicle.name, parts, paths)
    drives = {part.channel: Drive(paths[name], part.op) for name, part in parts.items() if part.channel}
    return replace(vehicle, rig=Rig(asset=asset.resolve(), root="", drives=drives))


def default_parts(vehicle: Vehicle) -> dict[str, Box | Wheel]:
    """A box a metre long with a nose, and a wheel for every channel along its sides."""
    parts: dict[str, Box | Wheel] = {
        "body": Box((1.0, 0.5, 0.25), at=(0.0, 0.0, 0.3)),
        "nose": Box((0.2, 0.2, 0.1), at=(0.6, 0.0, 0.3), colour=(0.75, 0.25, 0.12)),
    }
    for k, channel in enumerate(vehicle.channels):
        side = 0.32 if k % 2 == 0 else -0.32
        parts[channel] = Wheel(0.15, at=(0.4 - 0.35 * (k // 2), side, 0.15), channel=channel)
    return parts


def _path(name: str, parts: Mapping[str, Box | Wheel], depth: int = 0) -> str:
    if depth > len(parts):
        raise InputError(
            "its parents form a cycle", "break the cycle", key=f"parts[{name!r}].parent", value=parts[name].parent
        )
    parent = parts[name].parent
    return f"{_path(parent, parts, depth + 1)}/{name}" if parent else name


def _write(asset: Path, name: str, parts: Mapping[str, Box | Wheel], paths: Mapping[str, str]) -> None:
    from pxr import Gf, Kind, Usd, UsdGeom

    asset.parent.mkdir(parents=True, exist_ok=True)
    stage = Usd.Stage.CreateInMemory()
    UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.z)
    root = UsdGeom.Xform.Define(stage, f"/{name}")
    stage.SetDefaultPrim(root.GetPrim())
    Usd.ModelAPI(root.GetPrim()).SetKind(Kind.Tokens.component)
    for part_name, part in sorted(parts.items(), key=lambda item: paths[item[0]].count("/")):
        path = f"/{name}/{paths[part_name]}"
        UsdGeom.Xform.Define(stage, path).AddTranslateOp().Set(Gf.Vec3d(*map(float, part.at)))
        for suffix, points, faces, colour in part.mesh():
            material = _material(stage, f"/{name}", colour)
            _write_mesh(stage, f"{path}/{part_name}_{suffix}", points, faces, colour, material)
    stage.GetRootLayer().Export(str(asset))


def _material(stage: Any, root: str, colour: Numbers) -> Any:
    from pxr import Gf, Sdf, UsdGeom, UsdShade

    UsdGeom.Scope.Define(stage, f"{root}/materials")
    path = f"{root}/materials/colour_" + "_".join(str(round(100 * c)) for c in colour)
    material = UsdShade.Material.Define(stage, path)
    shader = UsdShade.Shader.Define(stage, f"{path}/surface")
    shader.CreateIdAttr("UsdPreviewSurface")
    shader.CreateInput("diffuseColor", Sdf.ValueTypeNames.Color3f).Set(Gf.Vec3f(*colour))
    shader.CreateInput("roughness", Sdf.ValueTypeNames.Float).Set(0.5)
    material.CreateSurfaceOutput().ConnectToSource(shader.CreateOutput("surface", Sdf.ValueTypeNames.Token))
    return material


def _write_mesh(stage: Any, path: str, points: Array, faces: Array, colour: Numbers, material: Any) -> None:
    """Write a flat-shaded mesh: a point and a normal for every corner of every face.

    A repeated last corner makes a triangle.
    """
    from pxr import Gf, UsdGeom, UsdShade, Vt

    corners = [list(dict.fromkeys(face.tolist())) for face in faces]
    flat = np.array([points[i] for face in corners for i in face], np.float32)
    normals = np.vstack([np.tile(_normal(points[face]), (len(face), 1)) for face in corners]).astype(np.float32)
    mesh = UsdGeom.Mesh.Define(stage, path)
    mesh.CreateSubdivisionSchemeAttr(UsdGeom.Tokens.none)
    mesh.CreatePointsAttr(Vt.Vec3fArray.FromNumpy(flat))
    mesh.CreateFaceVertexCountsAttr([len(face) for face in corners])
    mesh.CreateFaceVertexIndicesAttr(list(range(len(flat))))
    mesh.CreateNormalsAttr(Vt.Vec3fArray.FromNumpy(normals))
    mesh.SetNormalsInterpolation(UsdGeom.Tokens.vertex)
    mesh.CreateExtentAttr([Gf.Vec3f(*flat.min(0).tolist()), Gf.Vec3f(*flat.max(0).tolist())])
    mesh.CreateDisplayColorPrimvar(UsdGeom.Tokens.constant).Set([Gf.Vec3f(*colour)])
    UsdShade.MaterialBindingAPI.Apply(mesh.GetPrim()).Bind(material)


def _normal(corners: Array) -> Array:
    normal = np.cross(corners[1] - corners[0], corners[2] - corners[0])
    return normal / np.linalg.norm(normal)
