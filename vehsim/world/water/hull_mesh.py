"""The closed surface of a hull: read, welded, checked, refined, cut at a waterline and integrated exactly.

This module holds the geometry; `buoyancy.py` computes forces.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vehsim.errors import InputError

Array = NDArray[np.float64]
Faces = NDArray[np.int64]

WELD = 1e-6
"""Corners closer than this share of the hull's size are merged."""
MAX_FACES = 200_000
CHECKED_FACES = 20_000
"""Hulls with more faces are not checked for self-intersection, which would take minutes."""

PLACE, DEPTH, THROUGH, HEAD, RISEN, BELOW, COLUMNS = slice(3), 3, slice(4, 7), 7, 8, 9, 10
"""Columns of a floating hull's nodes: place (m) and velocity through the water (m/s) in body axes, depth below the
surface (m), the depth (m) of still water with the same pressure, and the depth (m) below water that rises along the
bottom; the number of columns."""
STEEP = 0.5
"""Faces whose normals point downwards by less than this share belong to the sides: the flow separates below them."""


@dataclass(frozen=True, eq=False)
class HullMesh:
    """A closed surface: ``points`` (n, 3) m, ``faces`` (m, 3) counter-clockwise from outside; ``name`` for messages.

    Points at the same place are merged. Raises ``InputError`` if it is empty, open, inside out or self-intersecting.
    """

    points: Array
    faces: Faces
    name: str = "hull"

    def __post_init__(self) -> None:
        points, faces = np.asarray(self.points, float), np.asarray(self.faces, np.int64)
        if points.size == 0 or faces.size == 0:
            raise self._wrong("empty", "give the hull a mesh with faces")
        if points.ndim != 2 or faces.ndim != 2 or points.shape[1] != 3 or faces.shape[1] != 3:
            raise self._wrong(f"shapes {points.shape}, {faces.shape}", "give points (n, 3) and triangles (m, 3)")
        if not np.isfinite(points).all() or faces.min() < 0 or faces.max() >= len(points):
            raise self._wrong("points that are not finite, or faces that do not fit them", "export the mesh again")
        if len(faces) > MAX_FACES:
            raise self._wrong(f"{len(faces):,} faces", f"a buoyancy hull needs a few hundred, at most {MAX_FACES:,}")
        points, faces = _welded(points, faces)
        object.__setattr__(self, "points", points)
        object.__setattr__(self, "faces", faces)
        self._check()

    def _check(self) -> None:
        if len(self.faces) == 0:
            raise self._wrong("empty: all its faces are degenerate", "give it a volume")
        edges = self.faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2)
        key, back = edges @ [len(self.points), 1], edges @ [1, len(self.points)]
        ordered = np.sort(key)  # which is faster than sets
        if not np.array_equal(ordered, np.sort(back)) and (alone := ~np.isin(key, back)).any():
            x, y, z = self.points[edges[alone][0]].mean(axis=0)
            message = f"open: {alone.sum()} edges without a neighbour, one at ({x:.3g}, {y:.3g}, {z:.3g})"
            raise self._wrong(message, "close the mesh, or turn its faces outwards")
        if (ordered[1:] == ordered[:-1]).any():
            raise self._wrong("more than two faces meet at an edge", "make each part a closed surface of its own")
        volume = _volume(self.points, self.faces)
        size = float(np.ptp(self.points, axis=0).max())
        if abs(volume) < 1e-9 * size**3:
            raise self._wrong("encloses no volume", "give it a volume")
        if len(self.faces) <= CHECKED_FACES:
            crossing = _crossing(self.points, self.faces)
            if crossing is not None:
                x, y, z = crossing
                message = f"intersects itself at ({x:.3g}, {y:.3g}, {z:.3g})"
                raise self._wrong(message, "unite its parts into one surface, or separate them")
        parts = _parts(self.faces)
        for part in parts:
            inward, nested = _volume(self.points, self.faces[part]) < 0, self._nested(part)
            if nested and inward:
                raise self._wrong(
                    "a cavity in it", "remove the inner surface: a sealed hull displaces its outer volume"
                )
            if nested:
                raise self._wrong("a hull inside a hull, which would count twice", "remove the inner surface")
            if inward:
                raise self._wrong("inside out", "turn its faces outwards")

    def _nested(self, part: NDArray[np.bool_]) -> bool:
        """Whether one of the parts is inside the others."""
        import igl

        if part.all():
            return False
        corner = self.points[self.faces[part][:1, 0]]
        return bool(abs(igl.winding_number(self.points, self.faces[~part], corner)[0]) > 0.5)

    def _wrong(self, message: str, remedy: str) -> InputError:
        return InputError(f"not a hull: {message}", remedy, key=self.name)

    @cached_property
    def volume(self) -> float:
        """The enclosed volume, m^3."""
        return _volume(self.points, self.faces)

    @property
    def parts(self) -> list[NDArray[np.bool_]]:
        """For each connected surface, which faces (m,) are its own."""
        return list(_parts(self.faces))

    def shifted(self, offset: Array) -> HullMesh:
        """The same hull relative to ``offset`` (3,) m."""
        return self.replaced(self.points - offset, self.faces)

    def refined(self, edge: float) -> HullMesh:
        """The same surface with no edge longer than ``edge`` m, or as close to this as ``MAX_FACES`` permits.

        Only longer edges are halved: the surface stays closed, and slender faces become less slender.
        """
        points, faces = self.points, self.faces
        while 4 * len(faces) <= MAX_FACES:
            (a, b), index = _edges(faces, len(points))
            long = np.linalg.norm(points[a] - points[b], axis=1) > edge
            if not long.any():
                break
            middle = np.where(long, len(points) + np.cumsum(long) - 1, -1)
            points = np.concatenate([points, (points[a[long]] + points[b[long]]) / 2])
            faces = _halved(points, faces, middle[index])
        return self.replaced(points, faces)

    def simplified(self, count: int) -> HullMesh:
        """A similar surface of at most ``count`` faces, by collapsing edges (Garland and Heckbert 1997)."""
        import igl

        if len(self.faces) <= count:
            return self
        points, faces, _, _ = igl.qslim(self.points, self.faces.astype(np.int32), count)
        return self.replaced(points, faces.astype(np.int64))

    @cached_property
    def quadratic(self) -> tuple[Array, Faces]:
        """Its points and the midpoints of its edges (n, 3), and faces (m, 6): corners, then the midpoints of edges k to
        k + 1; see `wetted`."""
        (a, b), index = _edges(self.faces, len(self.points))
        middles = (self.points[a] + self.points[b]) / 2
        return np.concatenate([self.points, middles]), np.concatenate([self.faces, len(self.points) + index], axis=1)

    def keel(self, x: Array) -> Array:
        """Heights (n,) m of the lower convex envelope of the hull, seen from the side, at ``x`` (n,) m."""
        from scipy.spatial import ConvexHull

        side = self.points[:, [0, 2]]
        around = side[ConvexHull(side).vertices]  # counter-clockwise: from its least x, the lower envelope comes first
        around = np.roll(around, -int(np.lexsort((around[:, 1], around[:, 0]))[0]), axis=0)
        lower = around[: int(around[:, 0].argmax()) + 1]
        return np.asarray(np.interp(x, lower[:, 0], lower[:, 1]))

    @cached_property
    def bottom(self) -> NDArray[np.bool_]:
        """Whether each face (m,) belongs to the bottom; see `STEEP`."""
        return np.asarray(self.normals[:, 2] < -STEEP * np.linalg.norm(self.normals, axis=1))

    @cached_property
    def normals(self) -> Array:
        """Outward normals (m, 3) of its faces, as long as their areas, m^2."""
        return _normals(self.points[self.faces])

    def replaced(self, points: Array, faces: Faces) -> HullMesh:
        """A hull whose surface is known to be valid."""
        other = object.__new__(HullMesh)
        for key, value in (("points", points), ("faces", faces), ("name", self.name)):
            object.__setattr__(other, key, value)
        return other


def read_hull(asset: Any, root: str, prim: str) -> HullMesh:
    """The mesh ``prim``, a path below the rig root of a USD ``asset``, in the rig root's frame; see `HullMesh`."""
    from vehsim.rig.parts import read_mesh

    return HullMesh(*read_mesh(asset, root, prim), name=f"{asset}: {prim}")


@dataclass(frozen=True, eq=False)
class Wetted:
    """The part of a hull below a waterline, as triangles: ``middles`` (k, 3, w) are the midpoints of their edges, with
    the columns given to `wetted`, where quadratic functions integrate exactly; ``normals`` (k, 3) point outwards and
    have the areas as lengths."""

    middles: Array
    normals: Array

    def __add__(self, other: Wetted) -> Wetted:
        """Both together."""
        return Wetted(np.concatenate([self.middles, other.middles]), np.concatenate([self.normals, other.normals]))

    @property
    def corners(self) -> Array:
        """Corners (k, 3, 3) m of the triangles."""
        m = self.middles[:, :, :3]
        return np.asarray(m + m.take([2, 0, 1], axis=1) - m.take([1, 2, 0], axis=1))

    @cached_property
    def area(self) -> float:
        return float(np.sqrt(np.einsum("ki,ki->k", self.normals, self.normals)).sum())

    def volume(self, up: Array, depth: int = 3) -> float:
        """Volume (m^3) between hull and surface; ``up`` (3,) unit, column ``depth`` holds the depth below it."""
        return -float((self.normals @ up) @ self.middles[:, :, depth] @ np.ones(3)) / 3

    def centroid(self, up: Array, depth: int = 3) -> Array:
        """Centroid (3,) m of that volume below a level surface, in the frame of the first three columns."""
        weight = (self.normals @ up)[:, None] * self.middles[:, :, depth] / -3
        moments = np.einsum("ki,kij->j", weight, self.middles[:, :, :3])
        deep = 0.5 * float((weight * self.middles[:, :, depth]).sum())
        middle = moments / self.volume(up, depth)
        # along `up` the surface's own flux would count: the moment of the depth is used instead
        first = self.middles[0, 0] if len(self.middles) else np.zeros(depth + 1)
        level = float(first[:3] @ up + first[depth])
        return np.asarray(middle + up * (level - deep / self.volume(up, depth) - middle @ up))


def wetted(columns: Array, faces: Faces, depth: int = 3) -> Wetted:
    """The triangles ``faces`` where column ``depth`` of ``columns`` (n, w) is positive, cut where it is zero.

    The first three columns are places. On faces (m, 3) all columns are linear. On faces (m, 6), which also give the
    midpoints of their edges (`HullMesh.quadratic`), they are quadratic, and the cut is a straight line between its
    points on the edges.
    """
    wet = columns[:, depth] > 0
    count = wet[faces[:, :3]].sum(axis=1)
    whole = columns.take(faces[count == 3], axis=0)
    places, middles = [whole[:, :3, :3]], [whole[:, 3:] if faces.shape[1] == 6 else _halfway(whole)]
    cut = (count == 1) | (count == 2)
    if cut.any():
        one, cut = count[cut] == 1, faces[cut]
        odd = (wet[cut[:, :3]] == one[:, None]).argmax(axis=1)  # the corner that is alone on its side comes first
        nodes = columns.take(cut[np.arange(len(cut))[:, None], TURNED[odd, : faces.shape[1]]], axis=0)
        first, others = nodes[:, :1, depth], nodes[:, 1:3, depth]
        between = nodes[:, 3::2, depth] if faces.shape[1] == 6 else 0.5 * (first + others)
        corners, owner = _pieces(_zero(first, between, others), one)
        nodes, halfway = nodes.take(owner, axis=0), _halfway(corners)
        places.append(corners @ nodes[:, :3, :3])
        middles.append((_quadratic(halfway) if faces.shape[1] == 6 else halfway) @ nodes)
    return Wetted(np.concatenate(middles), _normals(np.concatenate(places)))


TURNED = np.array([[0, 1, 2, 3, 4, 5], [1, 2, 0, 4, 5, 3], [2, 0, 1, 5, 3, 4]])
"""Nodes of a triangle, starting with another of its corners."""


def _halfway(corners: Array) -> Array:
    """Middles (k, 3, w) of the edges of triangles (k, 3, w)."""
    return 0.5 * (corners + corners.take([1, 2, 0], axis=1))


def _zero(a: Array, middle: Array, b: Array) -> Array:
    """The zero of a quadratic function that changes its sign along an edge, from 0 at its start to 1 at its end."""
    bend, rise = 2 * (a + b - 2 * middle), 4 * middle - 3 * a - b
    return 2 * a / (np.copysign(np.sqrt(np.maximum(rise**2 - 4 * bend * a, 0.0)), a - b) - rise)


def _pieces(shares: Array, one: NDArray[np.bool_]) -> tuple[Array, Faces]:
    """Barycentric corners (j, 3, 3) of the wet pieces of cut triangles, and the triangle (j,) of each.

    Cuts are at ``shares`` (k, 2) of the way from the first corner, a, to the second and third, b and c: at p and q. The
    wet part is a, p, q where ``one`` (k,) is true, else p, b, c and p, c, q.
    """
    first, rest = np.flatnonzero(one), np.flatnonzero(~one)
    owner = np.concatenate([first, rest, rest])
    p, q = shares.take(owner, axis=0).T
    corners, n, m = np.zeros((len(owner), 3, 3)), len(first), len(one)
    corners[:n, 0, 0] = corners[n:m, 1, 1] = corners[n:m, 2, 2] = corners[m:, 1, 2] = 1
    corners[:n, 1, 0], corners[:n, 1, 1] = 1 - p[:n], p[:n]
    corners[n:, 0, 0], corners[n:, 0, 1] = 1 - p[n:], p[n:]
    for these in (slice(n), slice(m, None)):
        corners[these, 2, 0], corners[these, 2, 2] = 1 - q[these], q[these]
    return corners, owner


def _quadratic(places: Array) -> Array:
    """Weights (..., 6) of a triangle's nodes at barycentric ``places`` (..., 3)."""
    return np.concatenate([places * (2 * places - 1), 4 * places * places[..., [1, 2, 0]]], axis=-1)


def _normals(corners: Array) -> Array:
    """Outward normals (k, 3) of triangles (k, 3, >=3), as long as their areas."""
    ax, ay, az = (corners[:, 1, :3] - corners[:, 0, :3]).T
    bx, by, bz = (corners[:, 2, :3] - corners[:, 0, :3]).T
    normals = np.empty((len(corners), 3))
    normals[:, 0], normals[:, 1], normals[:, 2] = ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx
    normals *= 0.5
    return normals


def _volume(points: Array, faces: Faces) -> float:
    corners = points[faces] - points.mean(axis=0)
    return float(np.einsum("ki,ki->", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])) / 6)


def _welded(points: Array, faces: Faces) -> tuple[Array, Faces]:
    """Merge points at the same place, and remove collapsed faces and points without faces."""
    import igl

    size = max(float(np.ptp(points, axis=0).max()), 1e-12)
    _, first, _, faces = igl.remove_duplicate_vertices(points, faces, WELD * size)
    a, b, c = faces.T
    faces = faces[(a != b) & (b != c) & (c != a)]
    used, faces = np.unique(faces, return_inverse=True)
    return points[first[used]], faces.reshape(-1, 3).astype(np.int64)


def _edges(faces: Faces, count: int) -> tuple[tuple[Faces, Faces], Faces]:
    """The two ends (e,) of every edge of triangles between ``count`` points, and the edge (m, 3) that starts at corner
    k."""
    pairs = np.sort(np.stack([faces, np.roll(faces, -1, axis=1)], axis=2), axis=2)
    key, index = np.unique(pairs.reshape(-1, 2) @ [count, 1], return_inverse=True)
    a, b = np.divmod(key, count)
    return (a, b), index.reshape(-1, 3)


def _halved(points: Array, faces: Faces, middle: Faces) -> Faces:
    """Triangles (m, 3) cut where edges k to k + 1 have a ``middle`` (m, 3); -1: none."""
    count = (middle >= 0).sum(axis=1)

    def corners(these: Any, first: Any) -> Any:
        """Corners and midpoints, rotated so that edge ``first`` comes first."""
        turned = (first[:, None] + np.arange(3)) % 3
        f, m = (np.take_along_axis(x[these], turned, axis=1).T for x in (faces, middle))
        return (*f, *m)

    one, two, three = (np.flatnonzero(count == k) for k in (1, 2, 3))
    p, q, r, pq, _, _ = corners(one, (middle[one] >= 0).argmax(axis=1))
    made = [faces[count == 0], (p, pq, r), (pq, q, r)]
    p, q, r, _, qr, rp = corners(two, (middle[two] < 0).argmax(axis=1))
    # the rest of the face below r has four corners, and is cut along its shorter diagonal
    across = np.linalg.norm(points[p] - points[qr], axis=1) < np.linalg.norm(points[q] - points[rp], axis=1)
    made += [(qr, r, rp), (p, q, np.where(across, qr, rp)), (np.where(across, p, q), qr, rp)]
    p, q, r, pq, qr, rp = corners(three, np.zeros(len(three), np.int64))
    made += [(p, pq, rp), (pq, q, qr), (rp, qr, r), (pq, qr, rp)]
    return np.concatenate([made[0], *(np.stack(triangle, axis=1) for triangle in made[1:])])


def _parts(faces: Faces) -> list[NDArray[np.bool_]]:
    """Masks of the faces of each connected part."""
    import igl

    of_face = igl.vertex_components(faces)[faces[:, 0]]
    return [of_face == k for k in np.unique(of_face)]


def _crossing(points: Array, faces: Faces) -> Array | None:
    """The point (3,) where an edge pierces a face that it does not share a corner with, None if there is none."""
    edges = np.unique(np.sort(faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1), axis=0)
    triangles = points[faces]
    low, high = triangles.min(axis=1), triangles.max(axis=1)
    block = max(1, 4_000_000 // len(faces))
    for start in range(0, len(edges), block):
        ends = points[edges[start : start + block]]
        below, above = ends.min(axis=1), ends.max(axis=1)
        near = np.ones((len(ends), len(faces)), bool)
        for i in range(3):
            near &= (below[:, None, i] <= high[None, :, i]) & (above[:, None, i] >= low[None, :, i])
        e, f = np.nonzero(near)
        if not len(e):
            continue
        shared = (faces[f][:, :, None] == edges[start : start + block][e][:, None, :]).any(axis=(1, 2))
        e, f = e[~shared], f[~shared]
        found = _pierced(ends[e], triangles[f])
        if found is not None:
            return found
    return None


def _pierced(ends: Array, triangles: Array) -> Array | None:
    """The first point (3,) where segments (k, 2, 3) pass through the interior of their triangles (k, 3, 3)."""
    along = ends[:, 1] - ends[:, 0]
    u, v = triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0]
    normal = np.cross(u, v)
    slope = np.einsum("ki,ki->k", along, normal)
    size = np.linalg.norm(along, axis=1) * np.linalg.norm(normal, axis=1)
    crosses = np.abs(slope) > 1e-9 * size
    slope = np.where(crosses, slope, 1.0)
    share = np.einsum("ki,ki->k", triangles[:, 0] - ends[:, 0], normal) / slope
    from_corner = ends[:, 0] + share[:, None] * along - triangles[:, 0]
    squared = np.maximum(np.einsum("ki,ki->k", normal, normal), 1e-300)
    a = np.einsum("ki,ki->k", np.cross(from_corner, v), normal) / squared
    b = np.einsum("ki,ki->k", np.cross(u, from_corner), normal) / squared
    edge = 1e-7
    inside = crosses & (share > edge) & (share < 1 - edge) & (a > edge) & (b > edge) & (a + b < 1 - edge)
    k = np.flatnonzero(inside)
    return None if not len(k) else np.asarray(ends[k[0], 0] + share[k[0]] * along[k[0]])
