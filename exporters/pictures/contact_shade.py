"""Contact shade: how much of the sky vehicles and obstacles hide from the ground under and beside them.

MuJoCo's renderer has one shadow, that of the sun. Under a low sun or an overcast sky, what touches the ground within a
millimetre then looks afloat. A `Shade` is computed once per vehicle and per obstacle, from its shape: an ambient
occlusion field, the share of the sky that is hidden at each point of a grid around its lower part. `StageRenderer`
looks pixels up in it.
"""

from __future__ import annotations

import hashlib
import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from vehsim.exporters.pictures.grain import OBSTACLES
from vehsim.exporters.usd.stage import Shape, StageReader

Array = NDArray[np.float64]
Placed = tuple[Array, Shape]
"""A shape, and the transform (4, 4) to the root's frame from its own, at the first frame."""

CELLS = 56
"""Cells along a vehicle's longest side."""
MARGIN = 0.5
"""How far the grid extends around and below a vehicle, as a share of its longest horizontal side."""
FINER, LAYERS = 300, 3
"""Most cells along an obstacle's longest side, and cells of its height if these suffice: a kerb is long and low."""
TALL = 1.5
"""How far around itself an obstacle hides the sky, relative to its height, and up to which height, relative to its
longest side: beyond these, little is hidden."""
INSTANTS = 17
"""Number of frames at which it is found which parts of a vehicle move sideways."""
RINGS, SPOKES = 4, 12
"""Directions towards the sky: elevations of equal cosine-weighted solid angle, and azimuths."""
FADES = (0.04, 0.16)
"""Heights above a vehicle's lowest point, as shares of its height, up to which shade is full, and at which it ends:
the ground is shaded, not the vehicle itself."""
STRENGTH = 0.85
"""Share of its light that a point loses whose whole sky is hidden; the rest is reflected from the ground."""


@dataclass(frozen=True)
class Shade:
    """The share of the sky (x, y, z) that a vehicle hides at the points of a grid, in the frame of its root.

    ``lower`` (3,) m: the first point; ``cell`` m; ``heights`` (2,) m: where shade starts to fade, and ends; infinite:
    nowhere.
    """

    hidden: NDArray[np.float32]
    lower: Array
    cell: float
    heights: tuple[float, float]

    @classmethod
    def of(cls, points: Array, faces: NDArray[np.int64], standing: bool = False) -> Shade:
        """The shade of triangles ``faces`` (m, 3) of ``points`` (n, 3) m; ``standing``: of an obstacle, which may stand
        on a slope: it shades ground at any height."""
        from scipy.ndimage import gaussian_filter

        low, high = points.min(axis=0), points.max(axis=0)
        longest = max(float((high - low)[:2].max()), 1e-3)
        cell = longest / CELLS
        margin = MARGIN * longest
        heights = tuple(float(low[2] + share * (high - low)[2]) for share in FADES)
        if standing:
            tall = float((high - low)[2])
            cell = min(cell, max(tall / LAYERS, longest / FINER))
            margin = min(margin, TALL * tall)
            high[2] = min(high[2], low[2] + TALL * longest)
            heights = (math.inf, math.inf)
        lower = low - margin
        count = np.ceil((high - low + [2 * margin, 2 * margin, margin]) / cell).astype(int) + 2
        solid = np.zeros(count, bool)
        filled = ((_dense(points, faces, 0.7 * cell) - lower) / cell).round().astype(int)
        solid[tuple(filled[filled[:, 2] < count[2]].T)] = True
        layers = None if standing else int(np.ceil((heights[1] - lower[2]) / cell)) + 2
        hidden = gaussian_filter(_hidden(solid)[:, :, :layers], (0.8, 0.8, 0.0))
        hidden *= np.multiply.outer(*(_window(n, margin / cell / 2) for n in hidden.shape[:2]))[..., None]
        return cls(hidden, lower, cell, (heights[0], heights[1]))

    @property
    def corners(self) -> Array:
        """The corners (8, 3) m of the grid."""
        upper = self.lower + self.cell * (np.array(self.hidden.shape) - 1)
        return np.array(np.meshgrid(*zip(self.lower, upper, strict=True))).reshape(3, -1).T

    def at(self, places: Array) -> Array:
        """The share (...) of their light that ``places`` (..., 3) m in the root's frame lose."""
        from scipy.ndimage import map_coordinates

        start, end = self.heights
        lost = np.full(places.shape[:-1], STRENGTH)
        if start < end:
            lost *= np.clip((end - places[..., 2]) / (end - start), 0, 1)
        upper = self.lower + self.cell * np.array(self.hidden.shape)
        near = lost > 0
        for place, low, high in zip(np.moveaxis(places, -1, 0), self.lower, upper, strict=True):
            near &= (place > low) & (place < high)
        at = (places[near] - self.lower) / self.cell
        lost[near] *= map_coordinates(self.hidden, at.T, order=1, mode="constant")
        return np.where(near, lost, 0.0)


class Shades:
    """The shades of a stage's vehicles, by the path of a moving prim: their roots, which no other prim moves, and parts
    that move sideways below them, such as trailers; and those of obstacles that stand still.

    A shade is computed when it is first asked for, from all opaque parts below the prim that have no shade of their
    own, as they are at the first frame; equal shapes share it. In empty space there is nothing to shade.

    ``standing``: the pose (4, 4) of each obstacle that stands still.
    """

    def __init__(self, stage: StageReader) -> None:
        standing = stage.water is not None or any(not shape.group for shape in stage.shapes)
        instants = np.linspace(stage.frames[0], stage.frames[1], INSTANTS)
        poses = [stage.matrices(frame) for frame in instants] if standing and stage.groups else [{}]
        self._first = poses[0]
        self.bodies: list[str] = []
        self._roots: dict[str, str] = {}
        self._parts: dict[str, list[Placed]] = {}
        for group in sorted(poses[0]):
            above = [body for body in self.bodies if group.startswith(f"{body}/")]
            root = self._roots[above[0]] if above else group
            parts = self._opaque(stage, group, root)
            if above:
                whole = _points(self._opaque(stage, root, root))
                if not parts or _beyond_shade(_points(parts), whole):
                    continue
                middle = _points(parts).mean(axis=0)  # that of wheels and rotors stays
                if self._travel(group, above[-1], middle, poses) <= np.ptp(whole, axis=0)[:2].max() / CELLS:
                    continue
                own = {id(shape) for _, shape in parts}
                self._parts[above[-1]] = [part for part in self._parts[above[-1]] if id(part[1]) not in own]
            self.bodies.append(group)
            self._roots[group], self._parts[group] = root, parts
        self.standing: dict[str, Array] = {}
        for path, shapes in _obstacles(stage).items() if standing else ():
            points = np.concatenate([shape.points for shape in shapes])
            T_wr: Array = np.eye(4)
            T_wr[:3, 3] = (points.min(axis=0) + points.max(axis=0)) / 2
            T_rw = np.asarray(np.linalg.inv(T_wr))
            self.standing[path], self._parts[path] = T_wr, [(T_rw, shape) for shape in shapes]
            self.bodies.append(path)
        self._of_shape: dict[bytes, Shade] = {}
        self._shades: dict[str, Shade | None] = {}

    def _opaque(self, stage: StageReader, group: str, root: str) -> list[Placed]:
        """The opaque shapes at and below a prim, as they are placed at the first frame."""
        return [
            (np.linalg.inv(self._first[root]) @ self._first[shape.group], shape)
            for shape in stage.shapes
            if shape.surface.opacity == 1 and (shape.group == group or shape.group.startswith(f"{group}/"))
        ]

    def _travel(self, group: str, above: str, middle: Array, poses: list[dict[str, Array]]) -> float:
        """How far a point (3,) m in the frame of the root moves sideways with ``group``, relative to ``above``, m."""
        first, root = self._first, self._first[self._roots[above]]
        in_group = np.linalg.inv(first[group]) @ root @ np.append(middle, 1.0)
        from_above = np.linalg.inv(root) @ first[above]
        places = np.array([from_above @ np.linalg.inv(now[above]) @ now[group] @ in_group for now in poses])
        return float(np.abs(places[:, :2] - middle[:2]).max())

    def frame(self, body: str, poses: dict[str, Array]) -> Array:
        """Pose (4, 4) of the frame of a shade when prims have these ``poses``: its root's, moved with the body."""
        if body in self.standing:
            return self.standing[body]
        first = self._first
        return np.asarray(poses[body] @ np.linalg.inv(first[body]) @ first[self._roots[body]])

    def __getitem__(self, body: str) -> Shade | None:
        """The shade of a vehicle or a part; None if nothing of it is opaque."""
        if body not in self._shades:
            self._shades[body] = self._made(self._parts[body], body in self.standing)
        return self._shades[body]

    def _made(self, parts: list[Placed], standing: bool) -> Shade | None:
        if not parts:
            return None
        points = _points(parts)
        firsts = np.cumsum([0, *(len(shape.points) for _, shape in parts)])
        faces = np.concatenate([shape.faces + first for first, (_, shape) in zip(firsts, parts, strict=False)])
        key = hashlib.sha256(np.round(points, 4).tobytes() + faces.tobytes() + bytes([standing])).digest()
        if key not in self._of_shape:
            self._of_shape[key] = Shade.of(points, faces, standing)
        return self._of_shape[key]


def _obstacles(stage: StageReader) -> dict[str, list[Shape]]:
    """The opaque shapes of each obstacle that stands still, by its path."""
    found: dict[str, list[Shape]] = {}
    for shape in stage.shapes:
        before, within, after = shape.name.partition(OBSTACLES)
        if within and not shape.group and shape.surface.opacity == 1:
            found.setdefault(before + within + after.split("/")[0], []).append(shape)
    return found


def _points(parts: list[Placed]) -> Array:
    """The points (n, 3) m of shapes in the root's frame."""
    return np.concatenate([np.zeros((0, 3)), *(shape.points @ T[:3, :3].T + T[:3, 3] for T, shape in parts)])


def _beyond_shade(points: Array, whole: Array) -> bool:
    """Whether points are above those of a ``whole`` vehicle that shade the ground: a rider's shade would fall on the
    board."""
    return bool(points[:, 2].min() > whole[:, 2].min() + FADES[1] * np.ptp(whole[:, 2]))


def _window(count: int, width: float) -> NDArray[np.float32]:
    """Weights (count,) that rise from 0 at both ends to 1 over ``width``, so that the grid has no visible border."""
    ends = np.minimum(np.arange(count), np.arange(count)[::-1])
    return np.clip(ends / width, 0, 1).astype(np.float32)


def _dense(points: Array, faces: NDArray[np.int64], spacing: float) -> Array:
    """Points (n, 3) on the triangles, no farther than about ``spacing`` from each other."""
    corners = points[faces]
    longest = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).max(axis=1, initial=0)
    parts = np.maximum(np.ceil(longest / spacing).astype(int), 1)
    found = [points]
    for count in np.unique(parts[parts > 1]):
        i, j = np.nonzero(np.add.outer(np.arange(count + 1), np.arange(count + 1)) <= count)
        weights = np.stack([i, j, count - i - j], axis=1) / count
        found.append(np.einsum("wc,mcd->mwd", weights, corners[parts == count]).reshape(-1, 3))
    return np.concatenate(found)


def _hidden(solid: NDArray[np.bool_]) -> NDArray[np.float32]:
    """The share of the sky, weighted by the cosine to the vertical, that ``solid`` cells hide from each cell."""
    shares = (np.arange(RINGS) + 0.5) / RINGS
    total = np.zeros(solid.shape, np.float32)
    for k, share in enumerate(shares):
        slope = np.sqrt((1 - share) / share)  # cells sideways per cell up
        for spoke in range(SPOKES):
            azimuth = 2 * np.pi * (spoke + k / RINGS) / SPOKES
            total += _swept(solid, slope * np.cos(azimuth), slope * np.sin(azimuth))
    return total / np.float32(RINGS * SPOKES)


def _swept(solid: NDArray[np.bool_], right: float, ahead: float) -> NDArray[np.bool_]:
    """Whether a ray from each cell meets a solid one, ``right`` and ``ahead`` cells sideways per cell up."""
    blocked = np.zeros_like(solid)
    steps = max(1, int(np.ceil(np.hypot(right, ahead))))
    for layer in range(solid.shape[2] - 2, -1, -1):
        above = solid[:, :, layer + 1] | blocked[:, :, layer + 1]
        # the ray's drift is rounded per layer from the top, so that it stays straight over many layers
        start = np.round([right * layer, ahead * layer]).astype(int)
        found = _moved(above, *(np.round([right * (layer + 1), ahead * (layer + 1)]).astype(int) - start))
        for step in range(1, steps):
            found |= _moved(solid[:, :, layer], *np.round(np.array([right, ahead]) * step / steps).astype(int))
        blocked[:, :, layer] = found
    return blocked


def _moved(layer: NDArray[np.bool_], right: int, ahead: int) -> NDArray[np.bool_]:
    """``layer`` as it is ``right`` and ``ahead`` cells away; nothing beyond its border."""
    moved = np.zeros_like(layer)
    w, h = layer.shape
    to_x, to_y = (slice(max(0, -d), n - max(0, d)) for d, n in ((right, w), (ahead, h)))
    from_x, from_y = (slice(max(0, d), n - max(0, -d)) for d, n in ((right, w), (ahead, h)))
    if abs(right) < w and abs(ahead) < h:
        moved[to_x, to_y] = layer[from_x, from_y]
    return moved
