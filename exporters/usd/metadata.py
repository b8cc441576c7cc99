"""Common to all layers: stage metadata, time samples from numpy, units and their corrections."""

from __future__ import annotations

from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vehsim.errors import ExportError

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Units:
    """The up axis and metres per unit of a delivery. Ours are metres, Z up.

    A pose ``T_wr`` becomes ``C T_wr C^-1`` with ``C`` = `matrix`, so a vehicle at rest has no rotation in either.
    """

    up_axis: str = "Z"
    metres: float = 1.0

    @property
    def turn(self) -> Array:
        """(3, 3) from our axes to these."""
        return np.eye(3) if self.up_axis == "Z" else np.array([[1.0, 0, 0], [0, 0, 1.0], [0, -1.0, 0]])

    @property
    def matrix(self) -> Array:
        """``C`` (4, 4): our coordinates, metres Z up, to these."""
        matrix = np.eye(4)
        matrix[:3, :3] = self.turn / self.metres
        return matrix

    def points(self, points: Array) -> Array:
        """Positions (n, 3) of places in m."""
        return points @ self.turn.T / self.metres

    def poses(self, q: Array) -> Array:
        """Orientations (n, 4) of objects that rotate with the axes: vehicles."""
        return q if self.up_axis == "Z" else np.column_stack([q[:, 0], q[:, 1:] @ self.turn.T])

    def views(self, q: Array) -> Array:
        """Orientations (n, 4) of objects that keep their own axes: cameras look along -Z in any stage."""
        if self.up_axis == "Z":
            return q
        w, x, y, z = q.T  # a quarter turn about -X from the left
        return np.column_stack([w + x, x - w, y + z, z - y]) / np.sqrt(2.0)

    def corrections(self) -> list[tuple[str, Any]]:
        """Ops that convert content in metres, Z up, to these units."""
        return _corrections("Z", 1.0, self)


Z_UP_METRES = Units()

FAR, COARSE = 10_000.0, 1_000.0
"""Beyond `FAR` m, single precision is coarser than 1 mm; there, coordinates refer to a multiple of `COARSE` m."""


def local_origin(place: Array) -> Array:
    """The point (3,) m to which coordinates in single precision near ``place`` (3,) refer; zero near the origin."""
    return COARSE * np.round(place / COARSE) if np.abs(place).max() > FAR else np.zeros(3)


def author_origin(prim: Any, place: Array) -> Array:
    """Translate a prim whose points are near ``place`` (3,) m if they are far from the origin; returns the translation
    (3,), to which its points refer."""
    from pxr import Gf

    origin = local_origin(place)
    if origin.any():
        prim.AddTranslateOp().Set(Gf.Vec3d(*origin.tolist()))
    return origin


def author_points(mesh: Any, points: Array) -> None:
    """The points (n, 3) m of a mesh, and its extent; see `author_origin`."""
    from pxr import Vt

    single = (points - author_origin(mesh, points.mean(axis=0))).astype(np.float32)
    mesh.CreatePointsAttr(Vt.Vec3fArray.FromNumpy(single))
    mesh.CreateExtentAttr(Vt.Vec3fArray.FromNumpy(np.stack([single.min(axis=0), single.max(axis=0)])))


def author_stage_metadata(
    layer: Any,
    fps: Fraction | None = None,
    frames: tuple[int, int] | None = None,
    units: Units = Z_UP_METRES,
) -> None:
    """Author units, up axis and time: without them USD assumes centimetres, Y up and 24 frames per second.

    A rate that is not a whole number is also kept exactly, as text, in ``customLayerData``.
    """
    layer.pseudoRoot.SetInfo("metersPerUnit", units.metres)
    layer.pseudoRoot.SetInfo("upAxis", units.up_axis)
    if fps is not None and frames is not None:
        if fps.denominator != 1:
            layer.customLayerData = {"frameRate": str(fps)}
        layer.timeCodesPerSecond = layer.framesPerSecond = float(fps)
        layer.startTimeCode, layer.endTimeCode = (float(frame) for frame in frames)


def samples(prim: Any, name: str, type_name: Any, frames: Array, values: Any) -> Any:
    """Author an attribute on a prim *spec* from numpy: time samples, or one default value if nothing moves.

    ``values`` (n,) or (n, 3), or quaternions (n, 4) as w, x, y, z. Call it inside an ``Sdf.ChangeBlock``; setting
    ``timeSampleMap`` would look simpler but silently does nothing. Raises ``ExportError`` for values that are not
    finite.
    """
    from pxr import Sdf

    values = np.asarray(values, float)
    bad = ~np.isfinite(values.reshape(len(values), -1)).all(axis=1)
    if bad.any():
        frame = frames[bad.argmax()]
        raise ExportError(f"not a finite number at frame {frame:g}", "fix the clip", key=f"{prim.path}.{name}")
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


def unit_corrections(asset: Path, units: Units = Z_UP_METRES) -> list[tuple[str, Any]]:
    """Ops (name, value) that convert an asset of other units or up axis to ours, because USD does not."""
    from pxr import Usd, UsdGeom

    stage = Usd.Stage.Open(str(asset), Usd.Stage.LoadNone)
    return _corrections(str(UsdGeom.GetStageUpAxis(stage)), UsdGeom.GetStageMetersPerUnit(stage), units)


def _corrections(up_axis: str, metres: float, units: Units) -> list[tuple[str, Any]]:
    from pxr import Gf

    ops: list[tuple[str, Any]] = []
    if up_axis != units.up_axis:
        ops.append(("xformOp:rotateX:upAxis", 90.0 if up_axis == "Y" else -90.0))
    if not np.isclose(metres, units.metres, rtol=1e-9):
        ops.append(("xformOp:scale:units", Gf.Vec3d(metres / units.metres)))
    return ops


def correct_units(xform: Any, asset: Path, units: Units = Z_UP_METRES) -> None:
    """Put the corrections of ``asset`` before the ops that the referencing prim inherits from it."""
    author_corrections(xform, unit_corrections(asset, units))


def author_corrections(xform: Any, corrections: list[tuple[str, Any]]) -> None:
    """Put constant ops before those that a prim has."""
    order = list(xform.GetXformOpOrderAttr().Get() or [])
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
