"""The polygons of meshes and of USD's cubes, spheres, cylinders, cones and capsules, in the units of their prims."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from vehsim.errors import InputError

Array = NDArray[np.float64]
Faces = NDArray[np.int64]
SIDES = 48
"""Sides of a round shape, a multiple of four, so that it touches its bounds. Edges are within 0.3 % of the radius."""


class Polygons(NamedTuple):
    """Points (n, 3), the number of corners of each face (m,), the points at the corners (k,), and normals (k, 3) at the
    corners of a shape, None of a mesh."""

    points: Array
    counts: Faces
    indices: Faces
    normals: Array | None


class _Band(NamedTuple):
    """A part of a surface of revolution: (radius, height) and normal (radial, axial), at its lower and upper end."""

    low: tuple[float, float]
    low_normal: tuple[float, float]
    high: tuple[float, float]
    high_normal: tuple[float, float]


def has_polygons(prim: Any) -> bool:
    """Whether `polygons` reads the prim."""
    from pxr import UsdGeom

    return prim.IsA(UsdGeom.Mesh) or str(prim.GetTypeName()) in _SHAPES


def polygons(prim: Any, when: Any, file: str | Path) -> Polygons | None:
    """The polygons of a mesh or a shape at a time, in the authored winding order; None for an empty one.

    Raises ``InputError`` that names the prim and ``file``, which holds it, for sizes of a shape that are no lengths.
    """
    from pxr import UsdGeom

    if prim.IsA(UsdGeom.Mesh):
        mesh = UsdGeom.Mesh(prim)
        points = np.array(mesh.GetPointsAttr().Get(when) or [], float).reshape(-1, 3)
        counts = np.array(mesh.GetFaceVertexCountsAttr().Get(when) or [], np.int64)
        indices = np.array(mesh.GetFaceVertexIndicesAttr().Get(when) or [], np.int64)
        return Polygons(points, counts, indices, None) if len(points) and len(counts) else None
    names, shape = _SHAPES[str(prim.GetTypeName())]
    sizes = [float(prim.GetAttribute(name).Get(when)) for name in names]
    if not np.isfinite(sizes).all() or min(sizes) < 0:
        said = f"{' x '.join(names)} = {' x '.join(f'{size:g}' for size in sizes)}: not a size"
        raise InputError(said, "give lengths", key=str(prim.GetPath()), file=file)
    if not any(sizes):
        return None
    found = shape(*sizes)
    axis = prim.GetAttribute("axis").Get(when) if prim.HasAttribute("axis") else "Z"
    turn = np.roll(np.arange(3), "ZXY".index(str(axis)))
    assert found.normals is not None
    return found._replace(points=found.points[:, turn], normals=found.normals[:, turn])


def _cube(size: float) -> Polygons:
    corners = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]) * size / 2
    faces = np.array([[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]])
    normals = np.repeat(np.array([[-1, 0, 0], [1, 0, 0], [0, -1, 0], [0, 1, 0], [0, 0, -1], [0, 0, 1]]), 4, axis=0)
    return Polygons(corners, np.full(6, 4), faces.ravel(), normals.astype(float))


def _sphere(radius: float) -> Polygons:
    return _revolved(_arc(radius, 0.0, -0.5, 0.5))


def _cylinder(bottom: float, top: float, height: float) -> Polygons:
    half = height / 2
    slope = np.array([height, bottom - top]) / max(np.hypot(height, bottom - top), np.finfo(float).tiny)
    side = (float(slope[0]), float(slope[1]))
    below, above = (0.0, -1.0), (0.0, 1.0)
    caps = [
        _Band((0.0, -half), below, (bottom, -half), below),
        _Band((bottom, -half), side, (top, half), side),
        _Band((top, half), above, (0.0, half), above),
    ]
    return _revolved([band for band in caps if band.low != band.high])


def _capsule(radius: float, height: float) -> Polygons:
    half = height / 2
    side = [_Band((radius, -half), (1.0, 0.0), (radius, half), (1.0, 0.0))] * bool(height)
    return _revolved([*_arc(radius, -half, -0.5, 0.0), *side, *_arc(radius, half, 0.0, 0.5)])


_SHAPES: dict[str, tuple[tuple[str, ...], Callable[..., Polygons]]] = {
    "Cube": (("size",), _cube),
    "Sphere": (("radius",), _sphere),
    "Cylinder": (("radius", "height"), lambda radius, height: _cylinder(radius, radius, height)),
    "Cylinder_1": (("radiusBottom", "radiusTop", "height"), _cylinder),
    "Cone": (("radius", "height"), lambda radius, height: _cylinder(radius, 0.0, height)),
    "Capsule": (("radius", "height"), _capsule),
}
"""By type: the attributes that give its size, and what makes its polygons, about Z."""


def _arc(radius: float, middle: float, start: float, end: float) -> list[_Band]:
    """Bands of a sphere whose centre is at height ``middle``, between latitudes in half turns."""
    angles = np.linspace(start, end, round((end - start) * SIDES / 2) + 1) * np.pi
    normals = [(float(np.cos(a)) if abs(a) < 1.57 else 0.0, float(np.sin(a))) for a in angles]
    places = [(radius * r, middle + radius * z) for r, z in normals]
    return [_Band(places[k], normals[k], places[k + 1], normals[k + 1]) for k in range(len(places) - 1)]


def _revolved(bands: Sequence[_Band]) -> Polygons:
    """Bands about Z, from the bottom upwards; at the axis their faces are triangles."""
    turn = 2 * np.pi * np.arange(SIDES) / SIDES
    around = np.column_stack([np.cos(turn), np.sin(turn), np.ones(SIDES)])
    around[np.abs(around) < 1e-15] = 0.0
    here = np.arange(SIDES)
    there = (here + 1) % SIDES
    points, counts, indices, normals = [], [], [], []
    for k, (low, low_normal, high, high_normal) in enumerate(bands):
        ring = [around * (r, r, z) for r, z in (low, high, low_normal, high_normal)]
        points += ring[:2]
        corners = [here, there, there + SIDES, here + SIDES]
        if low[0] == 0:
            corners = [here, there + SIDES, here + SIDES]
        elif high[0] == 0:
            corners = [here, there, here + SIDES]
        faces = np.column_stack(corners)
        counts.append(np.full(SIDES, len(corners)))
        indices.append(faces.ravel() + 2 * SIDES * k)
        normals.append(np.concatenate(ring[2:])[faces.ravel()])
    return Polygons(np.concatenate(points), np.concatenate(counts), np.concatenate(indices), np.concatenate(normals))
