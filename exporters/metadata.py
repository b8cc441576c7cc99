"""What every layer we write has in common: stage metadata, time samples from numpy, corrections of foreign units."""

from __future__ import annotations

from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vehsim.errors import ExportError

Array = NDArray[np.float64]


def author_stage_metadata(layer: Any, fps: Fraction | None = None, frames: tuple[int, int] | None = None) -> None:
    """Metres, Z up, and time: what USD would otherwise take for centimetres, Y up and 24 frames a second."""
    layer.pseudoRoot.SetInfo("metersPerUnit", 1.0)
    layer.pseudoRoot.SetInfo("upAxis", "Z")
    if fps is not None and frames is not None:
        layer.timeCodesPerSecond = layer.framesPerSecond = float(fps)
        layer.startTimeCode, layer.endTimeCode = (float(frame) for frame in frames)


def samples(prim: Any, name: str, type_name: Any, frames: Array, values: Any) -> Any:
    """Author an attribute on a prim *spec* from numpy: time samples, or one default when nothing moves.

    ``values`` (n,) or (n, 3), or quaternions (n, 4) as w, x, y, z. Call it inside an ``Sdf.ChangeBlock``; setting
    ``timeSampleMap`` would look simpler but silently does nothing. Raises ``ExportError`` for what is not finite.
    """
    from pxr import Sdf

    values = np.asarray(values, float)
    bad = ~np.isfinite(values.reshape(len(values), -1)).all(axis=1)
    if bad.any():
        frame = frames[bad.argmax()]
        raise ExportError(f"{prim.path}.{name}: not a finite number at frame {frame:g}; mend the clip")
    spec = Sdf.AttributeSpec(prim, name, type_name)
    converted = _vt_array(type_name, values)
    if (values == values[0]).all():
        spec.default = converted[0]
        return spec
    layer, path = prim.layer, spec.path
    for frame, value in zip(frames.tolist(), converted, strict=True):
        layer.SetTimeSample(path, frame, value)
    return spec


def _vt_array(type_name: Any, values: Array) -> Any:
    from pxr import Sdf, Vt

    if type_name == Sdf.ValueTypeNames.Quatd:  # USD's arrays hold the real part last
        return Vt.QuatdArray.FromNumpy(np.ascontiguousarray(values[:, [1, 2, 3, 0]]))
    if type_name == Sdf.ValueTypeNames.Double3:
        return Vt.Vec3dArray.FromNumpy(np.ascontiguousarray(values))
    return Vt.DoubleArray.FromNumpy(np.ascontiguousarray(values))


def unit_corrections(asset: Path) -> list[tuple[str, Any]]:
    """Ops (name, value) that bring an asset of other units or up axis to metres, Z up. USD does not do it itself."""
    from pxr import Gf, Usd, UsdGeom

    stage = Usd.Stage.Open(str(asset), Usd.Stage.LoadNone)
    ops: list[tuple[str, Any]] = []
    if UsdGeom.GetStageUpAxis(stage) == UsdGeom.Tokens.y:
        ops.append(("xformOp:rotateX:upAxis", 90.0))
    scale = UsdGeom.GetStageMetersPerUnit(stage)
    if not np.isclose(scale, 1.0, rtol=1e-9):
        ops.append(("xformOp:scale:units", Gf.Vec3d(scale)))
    return ops


def correct_units(xform: Any, asset: Path) -> None:
    """Put the corrections of ``asset`` before the ops that the referencing prim got from it."""
    order = list(xform.GetXformOpOrderAttr().Get() or [])
    corrections = unit_corrections(asset)
    if not corrections:
        return
    for name, value in corrections:
        author_op(xform.GetPrim(), name, value)
    reset = order[:1] if order[:1] == ["!resetXformStack!"] else []
    xform.GetXformOpOrderAttr().Set([*reset, *(name for name, _ in corrections), *order[len(reset) :]])


def author_op(prim: Any, name: str, value: Any) -> None:
    """A constant op attribute; scale is a double3, the rest a double."""
    from pxr import Sdf

    kind = Sdf.ValueTypeNames.Double3 if name.startswith("xformOp:scale") else Sdf.ValueTypeNames.Double
    prim.CreateAttribute(name, kind, custom=False).Set(value)
