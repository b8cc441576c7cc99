"""A vehicle's animation layer: only what moves, as overs on the asset's own prims.

The layer's default prim is the vehicle's root; it references the asset, so the layer works referenced (as the shot
does it) and sublayered. The root is posed by translate and orient. A channel becomes one scalar op with accumulated
degrees (or asset units) on the prim it drives: read through a quaternion, a rotor would turn backwards.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from vehsim.errors import ExportError
from vehsim.exporters.metadata import author_stage_metadata, samples, unit_corrections
from vehsim.exporters.packing import Pack

if TYPE_CHECKING:
    from vehsim.clip import Clip
    from vehsim.vehicles._base import Rig

Array = NDArray[np.float64]
RESET = "!resetXformStack!"


@dataclass(frozen=True)
class RigOps:
    """Where motion goes in an asset: op orders per prim path below the root ("" is the root), and op names.

    ``orders[path]``: the prim's new xformOpOrder. ``channels``: channel -> (path, op name, factor from SI to op units).
    ``translate`` and ``orient`` are the root's pose ops, ``corrections`` its constant ops for foreign units.
    """

    orders: Mapping[str, list[str]]
    channels: Mapping[str, tuple[str, str, float]]
    translate: str
    orient: str
    corrections: list[tuple[str, Any]]


def write_animation(clip: Clip, name: str, pack: Pack, path: Path, fps: Fraction, frames: tuple[int, int]) -> Path:
    """Write ``clip`` (already on whole frames) as the animation layer ``path`` of a vehicle called ``name``."""
    from pxr import Sdf, Tf

    rig = clip.vehicle.rig
    if rig is None:
        raise ExportError(f"vehicle {name!r}: has no rig (USD asset) to animate; give it one in its vehicle.toml")
    if not Tf.IsValidIdentifier(name):
        raise ExportError(f"vehicle name {name!r}: not a USD prim name; use letters, digits and _ only")
    asset = pack.add(rig.asset, rig.asset.stem)
    ops = rig_ops(asset, rig)

    path.parent.mkdir(parents=True, exist_ok=True)
    layer = Sdf.Layer.CreateNew(str(path))
    with Sdf.ChangeBlock():
        author_stage_metadata(layer, fps, frames)
        layer.defaultPrim = name
        root = Sdf.PrimSpec(layer, name, Sdf.SpecifierDef, "Xform")
        root.referenceList.prependedItems = [Sdf.Reference(pack.relative(asset, path), _prim_path(rig) or Sdf.Path())]
        _author_root(root, ops, clip)
        for channel, (prim_path, op, factor) in ops.channels.items():
            values = clip.channels[channel] * factor
            if not np.any(values):
                continue  # rests where the asset left it
            spec = Sdf.CreatePrimInLayer(layer, root.path.AppendPath(prim_path))
            samples(spec, op, Sdf.ValueTypeNames.Double, clip.frames, values)
            _author_order(spec, ops.orders[prim_path])
    layer.Save()
    return path


def rig_ops(asset: Path, rig: Rig) -> RigOps:
    """Fit the motion into the asset's own op orders, so that its pivots, scales and resets survive."""
    from pxr import UsdGeom

    stage, root = open_rig(asset, rig)
    scale = UsdGeom.GetStageMetersPerUnit(stage)
    own = _order(root)
    reset, own = ([RESET], own[1:]) if own[:1] == [RESET] else ([], own)
    translate, orient = (_free_name(root, name) for name in ("xformOp:translate", "xformOp:orient"))
    corrections = unit_corrections(asset)
    orders = {"": [*reset, translate, orient, *(name for name, _ in corrections), *own]}
    channels = {}
    for channel, drive in rig.drives.items():
        prim = root.GetPrimAtPath(drive.prim)
        if not prim or not prim.IsA(UsdGeom.Xformable):
            raise ExportError(
                f"{rig.asset}: channels.{channel}.prim = {drive.prim!r}: no such Xform below the rig root; "
                f"choose one of {', '.join(_xformables(root))}"
            )
        op, factor = drive_op(drive.op, scale)
        order = orders.get(drive.prim, _order(prim))
        if op in order and drive.prim in orders:
            raise ExportError(f"{rig.asset}: channels.{channel}: {drive.op} on {drive.prim!r} is driven twice")
        orders[drive.prim] = order if op in order else insert_op(order, op)
        channels[channel] = (drive.prim, op, factor)
    return RigOps(orders, channels, translate, orient, corrections)


def drive_op(op: str, metres_per_unit: float = 1.0) -> tuple[str, float]:
    """The full op name of a drive ("rotateZ" -> "xformOp:rotateZ:spin") and the factor from rad or m to its unit."""
    if op.startswith("rotate"):
        return f"xformOp:{op}:spin", 180.0 / np.pi
    return f"xformOp:{op}:slide", 1.0 / metres_per_unit


def insert_op(order: list[str], op: str) -> list[str]:
    """``order`` with ``op`` after the prim's placement: inside its pivot, and before the scale that shapes its mesh.

    USD applies the last op first, so an op behind a scale would turn the unscaled shape and shear a stretched one.
    """
    inverses = [k for k, name in enumerate(order) if name.startswith("!invert!")]
    end = inverses[0] if inverses else len(order)
    while end > 0 and order[end - 1].split(":")[1:2] == ["scale"]:
        end -= 1
    return [*order[:end], op, *order[end:]]


def open_rig(asset: Path, rig: Rig) -> tuple[Any, Any]:
    """The asset's stage and the rig's root prim on it."""
    from pxr import Usd

    stage = Usd.Stage.Open(str(asset))
    path = _prim_path(rig)
    root = stage.GetPrimAtPath(path) if path else stage.GetDefaultPrim()
    if not root:
        raise ExportError(f"{rig.asset}: no {path or 'defaultPrim'}; author it or mend the vehicle's `root` key")
    return stage, root


def _author_root(root: Any, ops: RigOps, clip: Clip) -> None:
    from pxr import Sdf

    samples(root, ops.translate, Sdf.ValueTypeNames.Double3, clip.frames, clip.positions)
    samples(root, ops.orient, Sdf.ValueTypeNames.Quatd, clip.frames, clip.orientations)
    for op, value in ops.corrections:
        kind = Sdf.ValueTypeNames.Double3 if op.startswith("xformOp:scale") else Sdf.ValueTypeNames.Double
        Sdf.AttributeSpec(root, op, kind).default = value
    _author_order(root, ops.orders[""])


def _author_order(prim: Any, order: list[str]) -> None:
    from pxr import Sdf, Vt

    spec = prim.attributes.get("xformOpOrder")
    if spec is None:
        spec = Sdf.AttributeSpec(prim, "xformOpOrder", Sdf.ValueTypeNames.TokenArray, Sdf.VariabilityUniform)
    spec.default = Vt.TokenArray(order)


def _prim_path(rig: Rig) -> str:
    return rig.root if not rig.root or rig.root.startswith("/") else f"/{rig.root}"


def _order(prim: Any) -> list[str]:
    from pxr import UsdGeom

    return list(UsdGeom.Xformable(prim).GetXformOpOrderAttr().Get() or [])


def _free_name(prim: Any, name: str) -> str:
    """An op name the asset's root does not use itself."""
    return f"{name}:motion" if prim.HasAttribute(name) else name


def _xformables(root: Any) -> list[str]:
    from pxr import Usd, UsdGeom

    skip = len(str(root.GetPath())) + 1
    prims = Usd.PrimRange(root, Usd.TraverseInstanceProxies())
    names = [str(prim.GetPath())[skip:] for prim in prims if prim.IsA(UsdGeom.Xform)]
    return [name for name in names if name][:20]
