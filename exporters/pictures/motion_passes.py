"""Optical flow and normals of a picture: from the depth and geom of every pixel, and the poses of the stage.

Every pixel's point is moved from the depth buffer onto the triangle that it shows, so that flow is exact to the poses,
not to the steps of the buffer. Flow is in pixels, u to the right and v up, to the place of the same point of the same
part one frame later (forward) and earlier (backward). Water moves with the points of its surface, the sky with the
camera's rotation. Beyond the first and the last frame nothing moves.

A second layer has the flow of what is translucent in front of that: glass, blurred rotors, which turn with their
rotors, and spray, whose drops move with their velocities.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from vehsim.errors import InputError
from vehsim.exporters.pictures.spray import LARGEST, PUFF

if TYPE_CHECKING:
    from vehsim.exporters.usd.stage import StageReader, View

Array = NDArray[np.float64]

_FLOW = ("forward.u", "forward.v", "backward.u", "backward.v")
CHANNELS = {"flow": (*_FLOW, *(f"translucent.{name}" for name in _FLOW)), "normals": ("N.X", "N.Y", "N.Z")}
"""Pass -> channels of its EXR files; those of what is translucent only where a stage has that."""
NEAR = 0.05
"""Largest distance of a pixel's point from the triangle that it shows, m: farther away, the depth buffer is kept."""


class Pixels:
    """The points that the pixels of a picture show.

    ``shapes`` (h, w): index of the stage's shape, -1: background, -2: water; ``depth`` (h, w) m along the view; both
    from the top row down.
    """

    def __init__(self, stage: StageReader, camera: str, frame: float, shapes: NDArray[np.int64], depth: Array) -> None:
        view = stage.camera(camera, frame)
        self._stage, self._camera, self._view, self._shapes = stage, camera, view, shapes
        self._poses = stage.matrices(frame)
        self._size = shapes.shape[1], shapes.shape[0]
        self.rays = _rays(view, self._size)  # world axes, of length 1 along the view
        self.normals = np.zeros((*shapes.shape, 3))
        points = np.where((shapes == -1)[..., None], self.rays, view.T_wc[:3, 3] + depth[..., None] * self.rays)
        self.points = np.concatenate([points, (shapes != -1)[..., None].astype(float)], axis=-1)  # 0: at infinity
        for k in np.unique(shapes[shapes >= 0]).tolist():
            shape, mask = stage.shapes[k], shapes == k
            T_wg = self._poses.get(shape.group, np.eye(4))
            corners = shape.normals[shape.face_normals]
            self._settle(mask, shape.points, shape.faces, corners, T_wg)
        self._water = shapes == -2
        if self._water.any():
            points, normals, *_ = stage.water_at(frame)
            faces = stage.water_net.triangles
            self._of_water = self._settle(self._water, points, faces, normals[faces], np.eye(4))
            self._water_points = points

    def _settle(
        self, mask: NDArray[np.bool_], vertices: Array, faces: NDArray[Any], corners: Array, T_wg: Array
    ) -> tuple[NDArray[Any], Array]:
        """Move points onto triangles with the pose ``T_wg``, along their rays, and take the normals there, from those
        of the triangles' ``corners`` (m, 3, 3); returns each point's vertices (n, 3) and their weights (n, 3)."""
        import igl

        R, eye = T_wg[:3, :3], (self._view.T_wc[:3, 3] - T_wg[:3, 3]) @ T_wg[:3, :3]
        near = (self.points[mask][:, :3] - T_wg[:3, 3]) @ R
        rays = self.rays[mask] @ R
        vertices, faces = np.ascontiguousarray(vertices, float), np.ascontiguousarray(faces)
        tree = igl.AABB()
        tree.init(vertices, faces)
        _, face, _ = tree.squared_distance(vertices, faces, near)
        a, b, c = (vertices[faces[face, k]] for k in range(3))
        across = np.cross(b - a, c - a)
        slope = np.einsum("ni,ni->n", across, rays)
        along = np.einsum("ni,ni->n", across, a - eye) / np.where(np.abs(slope) < 1e-12, np.inf, slope)
        there = eye + along[:, None] * rays
        good = (np.linalg.norm(there - near, axis=1) < NEAR) & (along > 0)
        there = np.where(good[:, None], there, near)
        self.points[mask, :3] = there @ R.T + T_wg[:3, 3]
        weights = _barycentric(there, a, b, c)
        normals = np.einsum("nk,nki->ni", weights, corners[face])
        normals *= np.where(np.einsum("ni,ni->n", normals, rays) > 0, -1.0, 1.0)[:, None]  # the side that is seen
        self.normals[mask] = (normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)) @ R.T
        return faces[face], weights

    def flow(self, frame: float) -> Array:
        """Pixels (h, w, 2) from here to where the same points are at another time code, seen by the same camera."""
        view, poses = self._stage.camera(self._camera, frame), self._stage.matrices(frame)
        moved = self.points.copy()
        for group, T_wg in self._poses.items():
            shapes = [k for k, shape in enumerate(self._stage.shapes) if shape.group == group]
            mask = np.isin(self._shapes, shapes)
            moved[mask] = self.points[mask] @ (poses[group] @ np.linalg.inv(T_wg)).T
        if self._water.any():
            corners, weights = self._of_water
            steps = self._stage.water_at(frame)[0] - self._water_points
            moved[self._water, :3] += np.einsum("nk,nki->ni", weights, steps[corners])
        return _pixels(view, moved, self._size) - _pixels(self._view, self.points, self._size)


def drops_seen(stage: StageReader, camera: str, frame: float, away: Array) -> NDArray[np.int64]:
    """The nearest drop of spray (h, w) in front of what is ``away`` (h, w) m along the view, -1 for none."""
    view, (h, w) = stage.camera(camera, frame), away.shape
    places, _, widths = stage.spray_at(frame)
    depth = (view.T_wc[:3, 3] - places) @ view.T_wc[:3, 2]
    column, row = _columns_and_rows(view, places, (w, h))
    radius = np.clip(PUFF * widths * w / (2 * view.half_width) / np.maximum(depth, 1e-9), 0.7, LARGEST)
    ahead = np.flatnonzero((depth > 0.2) & (np.abs(column) < 2 * w) & (np.abs(row) < 2 * h))
    found, nearest = np.full((h, w), -1), away.copy()
    for k in ahead[np.argsort(depth[ahead])].tolist():
        rows = np.arange(max(0, int(row[k] - radius[k])), min(h, int(row[k] + radius[k]) + 1))
        columns = np.arange(max(0, int(column[k] - radius[k])), min(w, int(column[k] + radius[k]) + 1))
        part = np.ix_(rows, columns)
        near = (rows[:, None] + 0.5 - row[k]) ** 2 + (columns + 0.5 - column[k]) ** 2 <= radius[k] ** 2
        near &= nearest[part] > depth[k]
        found[part] = np.where(near, k, found[part])
        nearest[part] = np.where(near, depth[k], nearest[part])
    return found


def drop_flow(stage: StageReader, camera: str, frame: float, other: float, seen: NDArray[np.int64]) -> Array:
    """Pixels (h, w, 2) from the drops that are ``seen`` (h, w), see `drops_seen`, to where they are at another time
    code; NaN elsewhere."""
    places, velocities, _ = stage.spray_at(frame)
    size = seen.shape[1], seen.shape[0]
    steps = _columns_and_rows(
        stage.camera(camera, other), places + velocities * ((other - frame) / float(stage.fps)), size
    ) - _columns_and_rows(stage.camera(camera, frame), places, size)
    flow = np.full((*seen.shape, 2), np.nan)
    flow[seen >= 0] = (steps * [[1.0], [-1.0]]).T[seen[seen >= 0]]
    return flow


def _columns_and_rows(view: View, points: Array, size: tuple[int, int]) -> Array:
    """Columns from the left and rows from the top (2, n), in pixels, of world points (n, 3)."""
    u, v = _pixels(view, np.column_stack([points, np.ones(len(points))]), size).T
    return np.stack([size[0] / 2 + u, size[1] / 2 - v])


def write_exr(values: NDArray[Any], kind: str, path: Path) -> None:
    """Channels (h, w, n) as 32-bit floats. Raises ``InputError`` without OpenEXR."""
    OpenEXR = openexr()
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    planes = {
        name: np.ascontiguousarray(values[..., k], np.float32)
        for k, name in enumerate(CHANNELS[kind][: values.shape[2]])
    }
    OpenEXR.File(header, planes).write(str(path))


def openexr() -> Any:
    """The module, an optional dependency. Raises ``InputError``."""
    try:
        import OpenEXR
    except ImportError:
        raise InputError(
            "needs OpenEXR", "pip install 'vehsim[exr]', or leave out flow and normals", key="passes"
        ) from None
    return OpenEXR


def _rays(view: View, size: tuple[int, int]) -> Array:
    """Directions (h, w, 3) through the pixels' centres, of length 1 along the view, in world axes."""
    (width, height), half = size, view.half_width
    x = ((np.arange(width) + 0.5) / width * 2 - 1) * half + view.shift[0]
    y = (1 - (np.arange(height) + 0.5) / height * 2) * half * height / width + view.shift[1]
    own = np.stack([*np.meshgrid(x, y), -np.ones((height, width))], axis=-1)
    return np.asarray(own @ view.T_wc[:3, :3].T)


def _pixels(view: View, points: Array, size: tuple[int, int]) -> Array:
    """Places (h, w, 2) of homogeneous world points (h, w, 4) in pixels, u to the right and v up; NaN behind the
    camera."""
    own = (points[..., :3] - points[..., 3:] * view.T_wc[:3, 3]) @ view.T_wc[:3, :3]
    away = np.where(own[..., 2] < 0, -own[..., 2], np.nan)
    scale = size[0] / (2 * view.half_width)
    return np.asarray((own[..., :2] / away[..., None] - view.shift) * scale)


def _barycentric(points: Array, a: Array, b: Array, c: Array) -> Array:
    """Weights (n, 3) of points in triangles, none below 0."""
    normal = np.cross(b - a, c - a)
    area = np.maximum(np.einsum("ni,ni->n", normal, normal), 1e-30)
    v = np.einsum("ni,ni->n", np.cross(points - a, c - a), normal) / area
    w = np.einsum("ni,ni->n", np.cross(b - a, points - a), normal) / area
    weights = np.clip(np.stack([1 - v - w, v, w], axis=1), 0.0, 1.0)
    return np.asarray(weights / weights.sum(axis=1, keepdims=True))
