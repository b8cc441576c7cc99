"""Read triangles from OBJ, STL, PLY, GLB, glTF and USD files, in metres and Z up."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vehsim.intake import gltf
from vehsim.intake.foreign import reading, refuse
from vehsim.intake.polygons import has_polygons
from vehsim.intake.reader import Answer, read_cached, read_in_process
from vehsim.intake.usd import SUFFIXES, is_drawn, open_stage, triangles_of

Array = NDArray[np.float64]
Triangles = tuple[Array, NDArray[np.int64]]

MESHES = (".obj", ".stl", ".ply", ".glb", ".gltf")
READABLE = (*MESHES, *SUFFIXES)
MAX_FACES = 20_000_000
"""Largest accepted number of triangles."""
MAX_REACH = 1e9
"""Largest accepted coordinate, m."""
_Z_UP = ([0, 2, 1], [1, -1, 1])
"""Selection and signs of axes that turn Y up into Z up."""


def read_triangles(path: Path, key: str = "mesh") -> Triangles:
    """Points (n, 3) m, finite, and triangles (m, 3) with valid indices, at least one. Raises ``InputError``."""
    suffix = path.suffix.lower()
    if suffix in SUFFIXES:
        with reading(path, key):
            return _checked(path, key, *_read_usd(path))
    if suffix not in MESHES:
        raise refuse(path, key, "not a mesh file", f"use one of {' '.join(READABLE)}", path.suffix)
    read = read_in_process if suffix == ".gltf" else read_cached  # its points are in other files
    _, (points, faces) = read(triangles, path, key, key)
    return points, faces


def triangles(path: Path, key: str) -> Answer:
    """Points and triangles of a file in a format other than USD. It runs in the reader process."""
    import trimesh

    if is_gltf := path.suffix.lower() in gltf.SUFFIXES:
        gltf.scene_of(path, key)
    scene = trimesh.load_scene(path, process=False)  # unchanged: a silent repair would make another mesh
    points, faces = _placed(scene)
    if is_gltf:  # Y up
        points = points[:, _Z_UP[0]] * _Z_UP[1]
    return {}, list(_checked(path, key, points, faces))


def _placed(scene: Any) -> Triangles:
    """All triangles of trimesh's ``scene``. Each node's matrix is made once; trimesh multiplies all above it."""
    graph, children = scene.graph.transforms, scene.graph.transforms.children
    points, faces, count = [np.zeros((0, 3))], [np.zeros((0, 3), np.int64)], 0
    left = [(scene.graph.base_frame, np.eye(4))]
    while left:
        node, matrix = left.pop()
        mesh = scene.geometry.get(graph.node_data[node].get("geometry"))
        if hasattr(mesh, "faces"):  # others are points and lines
            corners = np.asarray(mesh.faces, np.int64)
            mirrored = np.linalg.det(matrix[:3, :3]) < 0
            points.append(np.asarray(mesh.vertices, float) @ matrix[:3, :3].T + matrix[:3, 3])
            faces.append((corners[:, ::-1] if mirrored else corners) + count)
            count += len(points[-1])
        left += [
            (each, matrix @ graph.edge_data[node, each].get("matrix", np.eye(4))) for each in children.get(node, [])
        ]
    return np.concatenate(points), np.concatenate(faces)


def _checked(path: Path, key: str, points: Array, faces: NDArray[np.int64]) -> Triangles:
    """The same, contiguous; raises ``InputError`` if they are not a mesh."""
    if points.ndim != 2 or points.shape[1:] != (3,) or faces.ndim != 2 or faces.shape[1:] != (3,) or not len(faces):
        raise refuse(path, key, "has no triangles", "export a mesh of triangles")
    if len(faces) > MAX_FACES:
        raise refuse(path, key, f"{len(faces):,} triangles, at most {MAX_FACES:,}", "decimate it")
    if faces.min() < 0 or faces.max() >= len(points):
        wrong = int(((faces < 0) | (faces >= len(points))).any(axis=1).sum())
        message = f"{wrong} of {len(faces)} faces name corners that its {len(points)} points do not have"
        raise refuse(path, key, message, "export the mesh again")
    if not np.isfinite(points).all():
        wrong = int((~np.isfinite(points)).any(axis=1).sum())
        raise refuse(path, key, f"{wrong} of {len(points)} points are not finite", "export the mesh again")
    if (reach := float(np.abs(points).max())) > MAX_REACH:
        raise refuse(path, key, f"points beyond {MAX_REACH:g} m", "export it in metres", reach)
    return np.ascontiguousarray(points), np.ascontiguousarray(faces)


def _read_usd(path: Path) -> Triangles:
    """All meshes and shapes of a stage, in metres and Z up, for any units of the stage."""
    from pxr import Usd, UsdGeom

    stage = open_stage(path)
    points, faces, count = [np.zeros((0, 3))], [np.zeros((0, 3), np.int64)], 0
    cache = UsdGeom.XformCache()
    for prim in stage.Traverse():
        if not has_polygons(prim) or not is_drawn(prim):
            continue
        found = triangles_of(prim, Usd.TimeCode.Default(), path)
        if found is None:
            continue
        matrix = np.array(cache.GetLocalToWorldTransform(prim))
        points.append(found[0] @ matrix[:3, :3] + matrix[3, :3])
        faces.append(found[1] + count)
        count += len(found[0])
    world = np.concatenate(points) * UsdGeom.GetStageMetersPerUnit(stage)
    if UsdGeom.GetStageUpAxis(stage) == UsdGeom.Tokens.y:
        world = world[:, _Z_UP[0]] * _Z_UP[1]
    return world, np.concatenate(faces)
