"""Rotors as blades or as a blurred disc: a variant set ``rotor`` on the vehicle's root.

A disc is the asset's own geometry (meshes by a pattern), or a translucent ring with the radius of the blades.
"""

from __future__ import annotations

from fnmatch import fnmatch
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from vehsim.intake.polygons import has_polygons, polygons
from vehsim.rig.ops import driven_prim, open_rig

if TYPE_CHECKING:
    from vehsim.rig.rig import Rig

Array = NDArray[np.float64]
CORNERS = 64
OPACITY = 0.3
COLOUR = (0.03, 0.03, 0.035)


def author_rotors(root: Any, rig: Rig) -> None:
    """Author the variants ``blades`` and ``disc`` on the prim spec ``root`` of an animation layer.

    With a generated ring, ``blades`` is selected and the ring is visible only in ``disc``. An asset with its own discs
    shows both, unchanged, until a variant is selected.
    """
    from pxr import Sdf

    rotors = [channel for channel, drive in rig.drives.items() if drive.disc]
    if not rotors:
        return
    stage, prim = open_rig(rig.asset, rig)
    shown: dict[str, list[str]] = {"blades": [], "disc": []}
    made = False
    for channel in rotors:
        drive = rig.drives[channel]
        blades, discs = _meshes(prim, driven_prim(rig, prim, channel), drive.disc)
        if not discs and blades:
            discs, made = [f"{drive.prim}/disc"], True
            _author_ring(Sdf.CreatePrimInLayer(root.layer, root.path.AppendPath(discs[0])), stage, prim, rig, channel)
        shown["blades"] += blades
        shown["disc"] += discs
    variants = Sdf.VariantSetSpec(root, "rotor")
    root.variantSetNameList.Prepend("rotor")
    for name, hidden in (("blades", "disc"), ("disc", "blades")):
        variant = Sdf.VariantSpec(variants, name)
        for path in shown[hidden]:
            over = Sdf.CreatePrimInLayer(root.layer, variant.primSpec.path.AppendPath(path))
            Sdf.AttributeSpec(over, "visibility", Sdf.ValueTypeNames.Token).default = "invisible"
    if made and "rotor" not in rig.variants:
        root.variantSelections["rotor"] = "blades"


def _meshes(root: Any, rotor: Any, pattern: str | bool) -> tuple[list[str], list[str]]:
    """Paths below ``root`` of the rotor's visible meshes: blades, and the discs that the pattern selects."""
    from pxr import Usd, UsdGeom

    skip = len(str(root.GetPath())) + 1
    blades: list[str] = []
    discs: list[str] = []
    for prim in Usd.PrimRange(rotor, Usd.TraverseInstanceProxies()):
        if has_polygons(prim) and UsdGeom.Imageable(prim).ComputePurpose() != UsdGeom.Tokens.guide:
            disc = isinstance(pattern, str) and fnmatch(prim.GetName(), pattern)
            (discs if disc else blades).append(str(prim.GetPath())[skip:])
    return blades, discs


def _author_ring(spec: Any, stage: Any, root: Any, rig: Rig, channel: str) -> None:
    """A ring about the rotor's axis, from a tenth of the blades' radius to all of it, in the driven prim's own
    space."""
    from pxr import Gf, Sdf, Usd, UsdGeom, Vt

    prim = driven_prim(rig, root, channel)
    cache = UsdGeom.XformCache()
    inverse = np.linalg.inv(np.array(cache.GetLocalToWorldTransform(prim)).T)
    clouds = []
    for path in _meshes(root, prim, False)[0]:
        blade = root.GetPrimAtPath(path)
        shape = polygons(blade, Usd.TimeCode.Default(), rig.asset)
        points = np.zeros((0, 3)) if shape is None else shape.points
        to_own = inverse @ np.array(cache.GetLocalToWorldTransform(blade)).T
        clouds.append(points @ to_own[:3, :3].T + to_own[:3, 3])
    cloud = np.concatenate(clouds)
    axis = "XYZ".index(rig.drives[channel].op[-1])
    across = [(axis + 1) % 3, (axis + 2) % 3]
    radius, height = float(np.linalg.norm(cloud[:, across], axis=1).max()), float(np.median(cloud[:, axis]))
    angle = np.arange(CORNERS) / CORNERS * 2 * np.pi
    ring = np.full((2 * CORNERS, 3), height)
    for k, inner in enumerate((0.1, 1.0)):
        ring[k * CORNERS : (k + 1) * CORNERS, across] = (
            inner * radius * np.stack([np.cos(angle), np.sin(angle)], axis=1)
        )
    here, there = np.arange(CORNERS), (np.arange(CORNERS) + 1) % CORNERS
    faces = np.stack([here, here + CORNERS, there + CORNERS, there], axis=1)
    spec.specifier, spec.typeName = Sdf.SpecifierDef, "Mesh"
    types = Sdf.ValueTypeNames
    for name, kind, value in (
        ("points", types.Point3fArray, Vt.Vec3fArray.FromNumpy(ring.astype(np.float32))),
        ("faceVertexCounts", types.IntArray, Vt.IntArray([4] * CORNERS)),
        ("faceVertexIndices", types.IntArray, Vt.IntArray.FromNumpy(faces.astype(np.int32).ravel())),
        ("extent", types.Float3Array, [Gf.Vec3f(*ring.min(0).tolist()), Gf.Vec3f(*ring.max(0).tolist())]),
        ("primvars:displayColor", types.Color3fArray, [Gf.Vec3f(*COLOUR)]),
        ("primvars:displayOpacity", types.FloatArray, [OPACITY]),
        ("doubleSided", types.Bool, True),
        ("subdivisionScheme", types.Token, "none"),
    ):
        uniform = Sdf.VariabilityUniform if kind in (types.Bool, types.Token) else Sdf.VariabilityVarying
        Sdf.AttributeSpec(spec, name, kind, uniform).default = value
