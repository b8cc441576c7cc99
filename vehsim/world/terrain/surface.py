"""The surface of a terrain that is not a height field, so that the space below arches and in caves and tunnels is free.

Distances are those of the file's own triangles (libigl's bounding boxes). The side of a point follows from its winding
number (Barill et al. 2018), for which the rock below an open surface is closed by a skirt and a level bottom. Above a
face, the same number follows from the faces along a vertical line, which costs less.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Faces = NDArray[np.int64]

BELOW = 1.0
"""Depth of the level bottom below the lowest point, m."""
TOUCHED = 0.1
"""Depth at which a point in the ground still touches it, m."""
ABOVE = 1e-3
"""Height above a face at which a point has to be free for the face to be ground, m."""
LIFT = np.array([0.0, 0.0, ABOVE])
ASIDE = np.array([1e-4, 0.7e-4, 0.0])
"""Distance beside a point of the two lines along which faces above it are counted, m: a line may run along an edge."""

LARGE = 0.01
"""Longest edge, as a share of the terrain's width, up to which a face is ground as a whole or not at all. So is a
larger one that no other face touches."""
MOST_FACES, MOST_PAIRS = 300_000, 2_000_000
"""Up to so many faces, and pairs of faces that overlap seen from above, it is found which large ones others touch."""
BUNCH = 32
"""How many large faces are compared with all others at a time: pairs take memory."""
EDGE = 1e-6
"""How far within its edges a triangle is compared with others, as a share of its size."""
LEVELS = 8
"""Largest number of levels of ground at a place."""


@dataclass(frozen=True, eq=False, repr=False)
class TerrainSurface:
    """Triangles between air and rock: ``points`` (n, 3) m and ``faces`` (m, 3), counter-clockwise seen from the air.

    Below its borders the rock continues downwards.
    """

    points: Array
    faces: Faces

    @cached_property
    def normals(self) -> Array:
        """Area vectors (m, 3) m^2 of the faces, twice their area long; they point into the air."""
        a, b, c = (self.points[self.faces[:, k]] for k in range(3))
        return np.cross(b - a, c - a)

    @cached_property
    def closed(self) -> tuple[Array, Faces]:
        """Points and faces of the rock as a closed solid: the surface, a skirt below its borders, a level bottom."""
        first, second = open_edges(self.faces).T
        n, low = len(self.points), self.points[:, 2].min() - BELOW
        foot = np.column_stack([self.points[:, :2], np.full(n, low)])
        middle = np.append(self.points[:, :2].mean(axis=0), low)
        sides = [np.column_stack(corners) for corners in ((second, first, first + n), (second, first + n, second + n))]
        bottom = _spanned(np.column_stack([second + n, first + n]), 2 * n)
        faces = np.concatenate([self.faces, *sides, *bottom])
        return np.vstack([self.points, foot, middle]), np.ascontiguousarray(faces)

    def inside(self, points: Array) -> NDArray[np.bool_]:
        """Whether points (n, 3) m lie in the rock, (n,)."""
        if not len(points):
            return np.zeros(0, bool)
        return np.asarray(self._turns.winding_number(np.ascontiguousarray(points - self._middle))) > 0.5

    @cached_property
    def _turns(self) -> Any:
        import igl

        turns, (points, faces) = igl.FastWindingNumberBVH(), self.closed
        turns.init(points - self._middle, faces)
        return turns

    @cached_property
    def _middle(self) -> Array:
        """Winding numbers are computed about this place (3,) m, because libigl computes them in single precision: half
        a metre at 4,600 km."""
        return np.asarray((self.points.min(axis=0) + self.points.max(axis=0)) / 2)

    @property
    def ground(self) -> Faces:
        """The faces (k, 3) on which something can stand: they look up, and the space above their middle is free, or
        above a part of one that is covered in part."""
        return self._ground[0]

    @cached_property
    def _ground(self) -> tuple[Faces, NDArray[np.bool_]]:
        """The faces of the ground (k, 3), and those that rock may cover in part, as a pillar on a plane does, (k,)."""
        corners = self.points[self.faces]
        found, parted = looks_up(corners), np.zeros(len(corners), bool)
        edges = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).max(axis=1)
        large = np.flatnonzero(found & (edges > LARGE * np.ptp(self.points[:, :2], axis=0).max()))
        parted[large] = touched_from_above(corners, large)
        whole = found & ~parted
        found[whole] = self.free_above(corners[whole].mean(axis=1))
        return np.ascontiguousarray(self.faces[found]), parted[found]

    def is_ground(self, corners: Array) -> NDArray[np.bool_]:
        """Whether something can stand on pieces (n, 3, 3) m of its faces, (n,)."""
        found = looks_up(corners)
        found[found] = self.free_above(corners[found].mean(axis=1))
        return found

    def free_above(self, places: Array) -> NDArray[np.bool_]:
        """Whether the space above ``places`` (n, 3) m on its faces is free, (n,).

        Faces above are counted. Where that differs between two lines beside a place, its winding number decides.
        """
        above = places + LIFT
        first, second = (self._rock_above(above + beside) for beside in (ASIDE, -ASIDE))
        free, unsure = first < 1, (first < 1) != (second < 1)
        free[unsure] = ~self.inside(above[unsure])
        return free

    def _rock_above(self, points: Array) -> NDArray[np.int64]:
        """How often straight lines up from points (n, 3) m leave the rock more often than they enter it, (n,): that is
        the winding number, since no rock is above all faces."""
        if not len(points):
            return np.zeros(0, np.int64)
        up = np.tile([0.0, 0.0, 1.0], (len(points), 1))
        hits = self.tree.intersect_ray(self.points, self.faces, np.ascontiguousarray(points), up)
        line = np.repeat(np.arange(len(points)), [len(each) for each in hits])
        met = np.array([hit[0] for each in hits for hit in each], np.int64)
        leaving = np.sign(self.normals[met, 2])
        return np.bincount(line, leaving, len(points)).astype(np.int64)

    def floor(self, xy: Array) -> Array:
        """Height (n,) m of the lowest ground at ``xy`` (n, 2) m on which no rock stands; beyond the borders, of the
        closest border point; nan where there is none."""
        low, high = self.points.min(axis=0), self.points.max(axis=0)
        inset = 1e-7 * (high - low)[:2]  # a ray exactly along a border could miss
        inner = np.clip(xy, low[:2] + inset, high[:2] - inset)
        return self._ground_along(np.column_stack([inner, np.full(len(xy), low[2] - BELOW)]), 1.0)

    def ground_below(self, points: Array) -> Array:
        """Height (n,) m of the first ground below points (n, 3) m or up to `TOUCHED` above them; nan where there is
        none."""
        lift = np.array([0.0, 0.0, TOUCHED])
        return self._ground_along(points + lift, -1.0)

    def levels(self, xy: Array) -> Array:
        """All heights (n, k) m of the ground at ``xy`` (n, 2) m, from the highest to the lowest, then nan."""
        top = float(self.points[:, 2].max()) + BELOW
        found: list[Array] = []
        at = np.column_stack([xy, np.full(len(xy), top)])
        while len(found) < LEVELS:
            below = np.full(len(xy), np.nan)
            known = np.isfinite(at[:, 2])
            below[known] = self._ground_along(at[known], -1.0)
            if found and np.isnan(below).all():
                break
            found.append(below)
            at = np.column_stack([xy, below - ABOVE])
        return np.stack(found, axis=1)

    def _ground_along(self, points: Array, direction: float) -> Array:
        """Height (n,) m of the first ground straight up (1) or down (-1) from points (n, 3) m; nan where there is
        none."""
        ground, parted = self._ground
        if not len(points) or not len(ground):
            return np.full(len(points), np.nan)
        found, left = np.full(len(points), np.nan), np.arange(len(points))
        for _ in range(LEVELS):
            rays, points = np.tile([0.0, 0.0, direction], (len(points), 1)), np.ascontiguousarray(points)
            hit, _, _ = self._ground_tree.intersect_ray_first(self.points, ground, points, rays)
            met = np.asarray(hit) >= 0
            corners, left = self.points[ground[hit[met]]], left[met]
            places = np.column_stack([points[met, :2], heights_on(corners, points[met])])
            covered = parted[hit[met]]
            covered[covered] = ~self.free_above(places[covered])
            found[left[~covered]] = places[~covered, 2]
            left, points = left[covered], places[covered] + direction * LIFT
            if not len(left):
                break
        return found

    @cached_property
    def tree(self) -> Any:
        """The triangles as libigl searches them."""
        import igl

        tree = igl.AABB()
        tree.init(self.points, self.faces)
        return tree

    @cached_property
    def _ground_tree(self) -> Any:
        import igl

        tree = igl.AABB()
        tree.init(self.points, self.ground)
        return tree

    @cached_property
    def content_hash(self) -> str:
        """A hash of the triangles."""
        return hashlib.sha256(self.points.tobytes() + self.faces.tobytes()).hexdigest()


def surface_of(points: Array, faces: Faces) -> TerrainSurface:
    """The surface of a mesh file's triangles: corners at the same place are joined, copies of a face are left out, and
    the faces look into the air."""
    import igl

    points, place = np.unique(points, axis=0, return_inverse=True)
    faces = place.ravel()[faces]
    distinct = (faces != np.roll(faces, 1, axis=1)).all(axis=1)
    surface = TerrainSurface(points, _without_copies(faces[distinct]))
    if _consistent(surface.faces):
        turned = np.full(len(surface.faces), _volumes(surface).sum() < 0)
    else:
        oriented, body = igl.bfs_orient(surface.faces)
        surface = TerrainSurface(points, np.ascontiguousarray(oriented))
        turned = (np.bincount(body, _volumes(surface)) < 0)[body]
    return TerrainSurface(points, np.where(turned[:, None], surface.faces[:, ::-1], surface.faces))


def _without_copies(faces: Faces) -> Faces:
    """Each face (k, 3) once: faces with the same corners in the same sense of rotation are copies."""
    lowest = faces.argmin(axis=1)[:, None]
    turned = np.take_along_axis(faces, (lowest + np.arange(3)) % 3, axis=1)
    _, first = np.unique(turned, axis=0, return_index=True)
    return np.ascontiguousarray(faces[np.sort(first)])


def _spanned(edges: NDArray[np.int64], middle: int) -> Iterator[Faces]:
    """Triangles (m, 3) between directed ``edges`` (k, 2) of one plane; paths that do not close are closed over the
    point ``middle``.

    Neighbours are joined first, then every second point: most triangles are small, so that winding numbers of points
    far from them are cheap. From one common point, all would reach through the terrain.
    """
    following: dict[int, list[int]] = {}
    for start, end in edges.tolist():
        following.setdefault(start, []).append(end)
    for start in list(following):
        while following[start]:
            path = [start]
            while ends := following.get(path[-1]):
                path.append(ends.pop())
            ring = np.array(path[:-1] if path[-1] == start else [*path, middle])
            while len(ring) > 2:
                whole = ring[: len(ring) // 2 * 2].reshape(-1, 2)
                yield np.column_stack([whole, np.append(ring, ring[0])[2 : 2 * len(whole) + 2 : 2]])
                ring = ring[::2]


def touched_from_above(corners: Array, those: NDArray[np.intp]) -> NDArray[np.bool_]:
    """Whether another of the triangles ``corners`` (n, 3, 3) m crosses the plane of ``those`` (k,), or comes within
    `ABOVE` m of it from above, and overlaps them seen from above, more than along their edges, (k,).

    So are all that are not compared because there are too many.
    """
    import shapely

    touched = np.ones(len(those), bool)
    if not len(those) or len(corners) > MOST_FACES:
        return touched
    low, high = corners.min(axis=1), corners.max(axis=1)
    tree, pairs = shapely.STRtree(shapely.box(*low[:, :2].T, *high[:, :2].T)), 0
    for begin in range(0, len(those), BUNCH):
        part = those[begin : begin + BUNCH]
        one, other = tree.query(tree.geometries[part])
        pairs += len(one)
        if pairs > MOST_PAIRS:
            break
        near = (part[one] != other) & (low[part[one], 2] <= high[other, 2])
        near &= low[other, 2] <= high[part[one], 2] + ABOVE
        one, other = one[near], other[near]
        a, b = corners[part[one]], corners[other]
        above = b[..., 2] - np.stack([heights_on(a, b[:, k]) for k in range(3)], axis=1)
        near = (above.min(axis=1) <= ABOVE) & (above.max(axis=1) >= 0)
        near[near] = _overlap(a[near, :, :2], b[near, :, :2])
        touched[begin : begin + BUNCH] = np.bincount(one[near], minlength=len(part)) > 0
    return touched


def _overlap(a: Array, b: Array) -> NDArray[np.bool_]:
    """Whether triangles ``a`` and ``b`` (n, 3, 2) overlap, more than along edges of ``a``, (n,)."""
    a = a + EDGE * (a.mean(axis=1, keepdims=True) - a)
    together = np.ones(len(a), bool)
    for triangle in (a, b):
        for k in range(3):
            edge = triangle[:, k] - triangle[:, k - 1]
            normal = np.stack([edge[:, 1], -edge[:, 0]], axis=1)[:, None]
            along, across = (a * normal).sum(axis=2), (b * normal).sum(axis=2)
            together &= (along.min(axis=1) <= across.max(axis=1)) & (across.min(axis=1) <= along.max(axis=1))
    return together


def looks_up(corners: Array) -> NDArray[np.bool_]:
    """Whether triangles (n, 3, 3) m look upwards, (n,)."""
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    return np.asarray(normals[:, 2] > 1e-9 * np.linalg.norm(normals, axis=1))


def heights_on(corners: Array, points: Array) -> Array:
    """Height (n,) m at points (n, 2 or 3) m of the planes of triangles (n, 3, 3) that are not vertical."""
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    across = ((points[:, :2] - corners[:, 0, :2]) * normal[:, :2]).sum(axis=1)
    return np.asarray(corners[:, 0, 2] - across / normal[:, 2])


def open_edges(faces: Faces) -> Faces:
    """The edges (k, 2) without a neighbour that runs the other way, each as often as it lacks one."""
    edges = faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2)
    size = int(faces.max()) + 1
    there, back = edges @ [size, 1], edges @ [1, size]
    keys, first, counts = np.unique(there, return_index=True, return_counts=True)
    others, their = np.unique(back, return_counts=True)
    at = np.minimum(np.searchsorted(others, keys), len(others) - 1)
    lacking = np.maximum(counts - np.where(others[at] == keys, their[at], 0), 0)
    return np.repeat(edges[first], lacking, axis=0)


def _consistent(faces: Faces) -> bool:
    """Whether no two faces run along an edge in the same direction."""
    edges = faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2)
    return len(np.unique(edges @ [int(faces.max()) + 1, 1])) == len(edges)


def _volumes(surface: TerrainSurface) -> Array:
    """The volume (m,) m^3 between each face and the level bottom, negative for a face that looks down."""
    height = surface.points[surface.faces, 2].mean(axis=1) - surface.points[:, 2].min() + BELOW
    return np.asarray(surface.normals[:, 2] * height / 2)
