"""Guides: the path each vehicle takes and the marks it was asked to hit, for animators to see and nobody to render."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from vehsim.take import Take

if TYPE_CHECKING:
    from vehsim.clip import Clip

PATH_WIDTH = 0.15
MARK_WIDTH = 1.0


def author_guides(stage: Any, scope: str, take: Take, clips: Mapping[str, Clip]) -> None:
    """Author guide-purpose curves ``<vehicle>_path`` and points ``<vehicle>_marks`` below ``scope``.

    Marks come from ``take.report["marks"]``: vehicle name -> list of mappings with a ``position`` (x, y, z) m.
    """
    from pxr import UsdGeom, Vt

    for name, clip in clips.items():
        if len(clip.positions) > 1:
            path = UsdGeom.BasisCurves.Define(stage, f"{scope}/{name}_path")
            path.CreateTypeAttr(UsdGeom.Tokens.linear)
            path.CreateCurveVertexCountsAttr([len(clip.positions)])
            path.CreateWidthsAttr([PATH_WIDTH])
            path.SetWidthsInterpolation(UsdGeom.Tokens.constant)
            _place(path, Vt.Vec3fArray.FromNumpy(clip.positions.astype(np.float32)), PATH_WIDTH, (0.1, 0.7, 1.0))
    for name, marks in take.report.get("marks", {}).items():
        positions = [mark["position"] for mark in marks if mark.get("position") is not None]
        if positions:
            points = UsdGeom.Points.Define(stage, f"{scope}/{name}_marks")
            points.CreateWidthsAttr([MARK_WIDTH])
            points.SetWidthsInterpolation(UsdGeom.Tokens.constant)
            _place(points, Vt.Vec3fArray.FromNumpy(np.asarray(positions, np.float32)), MARK_WIDTH, (1.0, 0.6, 0.0))


def _place(prim: Any, points: Any, width: float, colour: tuple[float, float, float]) -> None:
    from pxr import Gf, UsdGeom

    prim.CreatePurposeAttr(UsdGeom.Tokens.guide)
    prim.CreatePointsAttr(points)
    prim.CreateDisplayColorAttr([Gf.Vec3f(*colour)])
    array = np.array(points)
    half = width / 2
    prim.CreateExtentAttr([Gf.Vec3f(*(array.min(0) - half).tolist()), Gf.Vec3f(*(array.max(0) + half).tolist())])
