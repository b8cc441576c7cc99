"""Meshes and shapes of USD prims as points and triangles, with their colour, and their convex hulls."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vehsim.intake.usd import triangles_of
from vehsim.runtime.cache import kept_arrays, made_of

Array = NDArray[np.float64]
Faces = NDArray[np.int64]


def apply(transform: Any, points: Any) -> Array:
    """``points`` (n, 3) under a ``transform`` (4, 4)."""
    return points @ transform[:3, :3].T + transform[:3, 3]


@dataclass(frozen=True)
class Mesh:
    """A mesh in the rig root's frame."""

    points: Array
    faces: Faces
    rgba: tuple[float, float, float, float]


def mesh_of(asset: str | Path, node: Any, messages: list[str]) -> Mesh | None:
    """A mesh that is visible or collides, triangulated, in the rig root's frame; None if it is neither, or empty.

    Warnings are added to ``messages``. Raises ``InputError`` for a broken mesh.
    """
    from pxr import Usd, UsdGeom

    if not (node.is_look or node.collides):
        return None
    when, shape = Usd.TimeCode.EarliestTime(), UsdGeom.Gprim(node.prim)
    found = triangles_of(node.prim, when, made_of(asset))
    if found is None:
        messages.append(f"{made_of(asset)}: {node.prim.GetPath()}: an empty mesh; left out")
        return None
    points, faces = found
    left_handed = shape.GetOrientationAttr().Get(when) == UsdGeom.Tokens.leftHanded
    mirrored = np.linalg.det(node.matrix[:3, :3]) < 0
    return Mesh(apply(node.matrix, points), faces[:, ::-1] if left_handed != mirrored else faces, _colour(shape, when))


def _colour(shape: Any, when: Any) -> tuple[float, float, float, float]:
    """The linear colour and opacity of a shape's preview surface, else its display colour, else grey."""
    from pxr import UsdShade

    rgb, alpha = shape.GetDisplayColorAttr().Get(when), shape.GetDisplayOpacityAttr().Get(when)
    colour, opacity = (rgb[0] if rgb else (0.5, 0.5, 0.5)), (alpha[0] if alpha else 1.0)
    material = UsdShade.MaterialBindingAPI(shape.GetPrim()).ComputeBoundMaterial()[0]
    shader = material.ComputeSurfaceSource()[0] if material else None
    if shader:
        inputs = {name: shader.GetInput(name) for name in ("diffuseColor", "opacity")}
        values = {name: value.Get(when) for name, value in inputs.items() if value}
        colour = values.get("diffuseColor") or colour
        opacity = opacity if values.get("opacity") is None else values["opacity"]
    return (float(colour[0]), float(colour[1]), float(colour[2]), float(opacity))


def hull_moments(clouds: Sequence[Array]) -> list[tuple[float, Array, Array]]:
    """Volume m^3, centre (3,) m, and inertia (3, 3) m^5 about it, of the convex hull of each cloud of points (n, 3) at
    unit density. For flat points all are zero and the centre is their mean."""
    faces = kept_arrays("hull_faces", clouds, lambda: [_faces(points) for points in clouds])
    return [_moments(points, corners) for points, corners in zip(clouds, faces, strict=True)]


def _moments(points: Array, faces: Any) -> tuple[float, Array, Array]:
    middle = points.mean(axis=0)
    if not len(faces):
        return 0.0, middle, np.zeros((3, 3))
    corners = points[faces] - middle  # (n, 3, 3): tetrahedra whose fourth corner is the origin
    volumes, sums = np.abs(np.linalg.det(corners)) / 6, corners.sum(axis=1)
    volume = float(volumes.sum())
    centre = volumes @ sums / (4 * volume)
    second = np.einsum("n,nki,nkj->ij", volumes, corners, corners) + np.einsum("n,ni,nj->ij", volumes, sums, sums)
    second = second / 20 - volume * np.outer(centre, centre)
    return volume, middle + centre, np.trace(second) * np.eye(3) - second


def _faces(points: Array) -> Any:
    """The corners (n, 3) of the triangles of the convex hull of ``points``, as indices; none if they are flat."""
    from scipy.spatial import ConvexHull, QhullError

    try:
        return np.asarray(ConvexHull(points).simplices)
    except QhullError:
        return np.zeros((0, 3), int)


def convex_hulls(clouds: Sequence[Array]) -> list[Array]:
    """The vertices (k, 3) of the convex hull of each cloud of points (n, 3), cached by content."""
    return kept_arrays("hulls", clouds, lambda: [_hull(points) for points in clouds])


def _hull(points: Array) -> Array:
    """The vertices of the convex hull of ``points``; flat points are thickened to a millimetre."""
    from scipy.spatial import ConvexHull, QhullError

    try:
        return points[ConvexHull(points).vertices]
    except QhullError:
        corners = np.array(np.meshgrid([-1, 1], [-1, 1], [-1, 1])).reshape(3, -1).T * 5e-4
        thick = (points[:, None] + corners).reshape(-1, 3)
        return thick[ConvexHull(thick).vertices]
