"""Exact geometry in the plane: simple polygons, their convex parts, ellipses, and the distances between them.

Polygons are (k, 2) m and counter-clockwise. Distances are signed: for overlapping shapes they are minus the smallest
displacement that separates them.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]

TINY = 1e-9
"""Lengths below this count as zero, m."""
ROUNDS = 40
"""Maximum number of Newton steps to the foot of a point on an ellipse; five are usual."""


@dataclass(frozen=True, eq=False)
class Ellipse:
    """``centre`` (2,) m, ``radii`` (2,) m along its own axes, ``R`` (2, 2) own axes to world."""

    centre: Array
    radii: Array
    R: Array

    def outline(self, count: int = 64) -> Array:
        """A polygon (count, 2) about the ellipse: its edges touch it."""
        angle = (np.arange(count) + 0.5) / count * 2 * np.pi
        ring = np.column_stack([np.cos(angle), np.sin(angle)]) / np.cos(np.pi / count)
        return self.centre + (ring * self.radii) @ self.R.T


Shape = Array | Ellipse
"""A convex polygon (k, 2), or an ellipse."""


def simple_polygon(points: ArrayLike) -> Array:
    """The polygon (k, 2) counter-clockwise, without repeated corners. Raises ``ValueError`` with the fault."""
    import shapely

    try:
        corners = np.array(points, dtype=float)
    except (TypeError, ValueError):
        corners = np.empty(0)
    if corners.ndim != 2 or corners.shape[1:] != (2,) or not np.isfinite(corners).all():
        raise ValueError("not a list of corners [x, y]")
    corners = corners[np.linalg.norm(corners - np.roll(corners, 1, axis=0), axis=1) > TINY]
    if len(corners) < 3:
        raise ValueError(f"{len(corners)} different corners, a polygon has at least three")
    area = signed_area(corners)
    reason, _, place = shapely.is_valid_reason(shapely.Polygon(corners)).partition("[")
    if reason != "Valid Geometry":
        where = ", ".join(f"{float(x):.6g}" for x in place.rstrip("]").split())
        raise ValueError(f"its edges cross or touch each other at [{where}]")
    if abs(area) < TINY:
        raise ValueError("it has no area")
    return corners if area > 0 else corners[::-1].copy()


def signed_area(polygon: Array) -> float:
    """m^2, positive when counter-clockwise."""
    x, y = (polygon - polygon[0]).T
    return 0.5 * float(x @ np.roll(y, -1) - y @ np.roll(x, -1))


def convex_hull(points: ArrayLike) -> Array:
    """The hull (k, 2) of points (n, 2), counter-clockwise."""
    from scipy.spatial import ConvexHull

    points = np.asarray(points, float)
    return np.asarray(points[ConvexHull(points).vertices])


def convex_parts(polygon: Array) -> list[Array]:
    """Convex polygons whose union is the simple ``polygon``: its triangles, merged (Hertel and Mehlhorn)."""
    if _is_convex(polygon):
        return [polygon]
    parts = _triangles(polygon)
    merged = True
    while merged:
        merged = False
        for i, a in enumerate(parts):
            for j in range(i + 1, len(parts)):
                both = _joined(a, parts[j])
                if both is not None and _is_convex(polygon[both]):
                    parts[i] = both
                    del parts[j]
                    merged = True
                    break
            if merged:
                break
    return [polygon[part] for part in parts]


def _is_convex(polygon: Array) -> bool:
    step = np.roll(polygon, -1, axis=0) - polygon
    turn = step[:, 0] * np.roll(step[:, 1], -1) - step[:, 1] * np.roll(step[:, 0], -1)
    return bool((turn >= -TINY).all())


def _triangles(polygon: Array) -> list[list[int]]:
    """Triangles of corner numbers, counter-clockwise, whose union is the polygon."""
    import shapely

    number = {tuple(corner): k for k, corner in enumerate(polygon.tolist())}
    found = shapely.constrained_delaunay_triangles(shapely.Polygon(polygon)).geoms
    rings = (shapely.get_coordinates(shapely.normalize(triangle))[2::-1] for triangle in found)  # clockwise there
    return [[number[tuple(corner)] for corner in ring.tolist()] for ring in rings]


def _joined(a: list[int], b: list[int]) -> list[int] | None:
    """Two polygons of corner numbers joined along a shared edge, or None."""
    for k in range(len(a)):
        i, j = a[k], a[(k + 1) % len(a)]
        for m in range(len(b)):
            if b[m] == j and b[(m + 1) % len(b)] == i:
                return [*a[: k + 1], *(b[(m + 2 + s) % len(b)] for s in range(len(b) - 2)), *a[k + 1 :]]
    return None


def bounding_circle(shape: Shape) -> tuple[Array, Array]:
    """Centres (..., 2) and radii (...) m of circles around an ellipse or polygons (..., k, 2)."""
    if isinstance(shape, Ellipse):
        return shape.centre, shape.radii.max()
    centres = np.einsum("...ke->...e", shape) / shape.shape[-2]
    offset = shape - centres[..., None, :]
    return centres, np.sqrt(np.einsum("...ke,...ke->...k", offset, offset).max(axis=-1))


def placed(polygon: Array, positions: Array, headings: Array) -> Array:
    """``polygon`` (k, 2), or one each (n, k, 2), moved by poses: (n, k, 2) for positions (n, 2) m and headings (n,)
    rad."""
    c, s = np.cos(headings)[:, None], np.sin(headings)[:, None]
    x, y = polygon[..., 0], polygon[..., 1]
    return np.stack([c * x - s * y, s * x + c * y], axis=-1) + positions[:, None]


def distance(a: Array, b: Array | Ellipse) -> Array:
    """Signed distance (n,) m of convex polygons ``a`` (n, k, 2) from a shape, or from one polygon each (n, m, 2).

    A polygon of one corner is a point.
    """
    if isinstance(b, Ellipse):
        return _to_ellipse(a, b)
    b = np.broadcast_to(b, (len(a), *b.shape[-2:]))
    gap, apart = _gap(b, a).max(axis=1), _corner_to_edge(a, b)
    if a.shape[1] > 2:
        gap, apart = np.maximum(gap, _gap(a, b).max(axis=1)), np.minimum(apart, _corner_to_edge(b, a))
    return np.where(gap > 0, apart, gap)


def _normals(a: Array) -> Array:
    """Outward unit normals (n, k, 2) of the edges of polygons (n, k, 2)."""
    step = np.roll(a, -1, axis=1) - a
    normal = np.stack([step[..., 1], -step[..., 0]], axis=-1)
    return normal / np.maximum(np.linalg.norm(normal, axis=-1, keepdims=True), TINY)


def _gap(a: Array, b: Array) -> Array:
    """(n, k): the distance by which all of ``b`` lies beyond each edge of ``a``."""
    normal = _normals(a)
    along_b = np.einsum("nke,nme->nkm", normal, b).min(axis=2)
    return along_b - np.einsum("nke,nke->nk", normal, a)


def _corner_to_edge(a: Array, b: Array) -> Array:
    """(n,): smallest distance of the corners of ``a`` from the edges of ``b``."""
    start, step = b[:, None], (np.roll(b, -1, axis=1) - b)[:, None]
    offset = a[:, :, None] - start
    share = np.clip((offset * step).sum(-1) / np.maximum((step**2).sum(-1), TINY**2), 0, 1)
    return np.sqrt(((offset - share[..., None] * step) ** 2).sum(-1).min(axis=(1, 2)))


def _to_ellipse(a: Array, ellipse: Ellipse) -> Array:
    own, radii = (a - ellipse.centre) @ ellipse.R, ellipse.radii
    apart = np.sqrt(((own - foot_on_ellipse(own, radii)) ** 2).sum(-1)).min(axis=1)
    if a.shape[1] < 3:
        return np.where(((own / radii) ** 2).sum(-1).min(axis=1) > 1, apart, -apart)
    # an edge is nearest if the ellipse's outermost point towards it projects onto it
    normal = _normals(own)
    outermost = -(radii**2) * normal / np.linalg.norm(radii * normal, axis=-1, keepdims=True)
    gap = ((outermost - own) * normal).sum(-1)
    step = np.roll(own, -1, axis=1) - own
    share = ((outermost - own) * step).sum(-1) / np.maximum((step**2).sum(-1), TINY**2)
    beside = (share >= 0) & (share <= 1) & (gap >= 0)
    apart = np.minimum(apart, np.where(beside, gap, np.inf).min(axis=1))
    circle = own / radii  # in coordinates where the ellipse is the unit circle, overlap is a distance from the origin
    origin = np.zeros((len(a), 1, 2))
    overlap = (_corner_to_edge(origin, circle) <= 1) | (_gap(circle, origin).max(axis=1) <= 0)
    return np.where(overlap, np.minimum(gap.max(axis=1), 0.0), apart)


def foot_on_ellipse(points: Array, radii: Array) -> Array:
    """The closest points (..., 2) of an ellipse about the origin, along the axes, to points outside it (..., 2).

    Points inside are moved to its border along their ray. Newton on ``1 / |(r x / (t + r^2))|``, nearly linear in t.
    """
    squared = radii**2
    inside = ((points / radii) ** 2).sum(-1) < 1
    t = np.zeros(points.shape[:-1])
    for _ in range(ROUNDS):
        ratio = radii * points / (t[..., None] + squared)
        size = np.maximum(np.sqrt((ratio**2).sum(-1)), TINY)
        slope = (ratio**2 / (t[..., None] + squared)).sum(-1) / size
        step = np.where(inside, 0.0, (size - 1) * size / np.maximum(slope, TINY**2))
        t = np.maximum(t + step, 0.0)
        if np.abs(step).max(initial=0.0) <= 1e-14 * (1 + t.max(initial=0.0)):
            break
    foot = squared * points / (t[..., None] + squared)
    size = np.sqrt(((foot / radii) ** 2).sum(-1, keepdims=True))
    return np.asarray(foot / np.maximum(size, TINY))
