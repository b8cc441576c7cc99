"""Decimate a skin cut into materials: remove vertices that matter little for shape, shading and borders.

This module holds decimation only. Edges collapse onto one of their own ends, so remaining vertices keep their place and
normal; borders between materials, creases and open edges collapse only along themselves and stay shared by both sides.
Errors are quadrics (Garland and Heckbert, "Surface Simplification Using Quadric Error Metrics", 1997); collapses that
do not touch each other are made in rounds.

The result is the same on every CPU. Places and normals are rounded on entry (`_GRID`), which removes the last digits in
which CPUs differ, and all later arithmetic is elementwise `+ - * /` and `sqrt`, which IEEE 754 rounds exactly: no BLAS
and no `einsum`, whose order of operations and fused multiply-adds depend on the CPU.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from vehsim.assets.generate._shapes import Array, Faces, Surface

_ROUNDS = 60
_GRID = 2.0**-23
"""Places (m) and components of normals are rounded to multiples of it: 1.2e-7."""
_SLIVER = 0.03
"""Smallest height of a new triangle as a share of its longest edge, unless the one it replaces was thinner."""

Flags = NDArray[np.bool_]


def slimmed(
    look: Mapping[str, Surface], tolerance: float, shade: float = 6.0, turn: float = 20.0, **of: float
) -> dict[str, Surface]:
    """``look`` without the vertices whose removal moves the skin, or a line on it, by less than about ``tolerance`` m.

    ``of``: tolerances of single materials, m; where materials meet, the smallest applies. Vertices of several surfaces
    at one place stay together; lines are borders, creases and open edges. ``shade``: largest angle, degrees, between
    the normals of a removed vertex and of the one that replaces it, so that highlights keep their shape. ``turn``:
    largest angle, degrees, between a triangle and the one it replaces, and between its plane and its corners' normals.
    """
    skin = _Skin(look, *np.cos(np.radians([shade, turn])))
    for _ in range(_ROUNDS):
        if not skin.collapse(np.array([of.get(name, tolerance) for name in look])):
            break
    return skin.look()


class _Skin:
    """All surfaces of a look as one mesh: ``faces`` (m, 3) of vertices; a vertex has a place, a normal and a
    material."""

    def __init__(self, look: Mapping[str, Surface], shade: float, turn: float) -> None:
        """``shade``, ``turn``: cosines of the angles of `slimmed`."""
        self.shade, self.turn = shade, turn
        self.names = list(look)
        points, normals = (
            _on_grid(np.concatenate([getattr(s, k) for s in look.values()])) for k in ("points", "normals")
        )
        owner = np.repeat(np.arange(len(look)), [len(s.points) for s in look.values()])
        offsets = np.cumsum([0, *(len(s.points) for s in look.values())])
        faces = np.concatenate([s.faces + o for s, o in zip(look.values(), offsets, strict=False)])
        places, place = np.unique(points, axis=0, return_inverse=True)
        self.places: Array = places
        key = np.column_stack([place.reshape(-1), owner, np.round(normals, 3)])
        _, first, vertex = np.unique(key, axis=0, return_index=True, return_inverse=True)
        self.place, self.owner, self.normals = place.reshape(-1)[first], owner[first], normals[first]
        self.faces: Faces = self._whole(vertex.reshape(-1)[faces])
        self.shape, self.line = self._quadrics()
        self.shuffle = np.random.default_rng(0).permutation(len(self.places))

    def look(self) -> dict[str, Surface]:
        surfaces = {}
        for k, name in enumerate(self.names):
            used, inverse = np.unique(self.faces[self.owner[self.faces[:, 0]] == k], return_inverse=True)
            surfaces[name] = Surface(self.places[self.place[used]], self.normals[used], inverse.reshape(-1, 3))
        return surfaces

    def collapse(self, tolerances: Array) -> int:
        """Make one round of collapses, cheapest first, within ``tolerances`` by material, m; returns their number."""
        (going, staying), pairs, edge = self._candidates()
        cost = np.maximum(*(_distance(q[going], self.places[staying]) for q in (self.shape, self.line)))
        cost /= tolerances[self.owner[pairs[:, :, 0]]].min(1)
        normals = self.normals[pairs]
        alike = (_dot(normals[:, :, 0], normals[:, :, 1]) > self.shade).all(1)
        keep = np.flatnonzero((cost < 1.0) & alike)
        keep = keep[self._fits(going[keep], staying[keep], pairs[keep])]
        # costs in steps, shuffled within each: otherwise neighbours on a plane, where all costs are zero, wait for each
        # other
        order = keep[np.lexsort([cost[keep], self.shuffle[going[keep]], np.floor(8 * cost[keep])])]
        rank = np.full(len(self.places), len(order))
        np.minimum.at(rank, going[order], np.arange(len(order)))
        nearby = np.full(len(self.places), len(order))
        for one, other in (edge, edge[::-1]):
            np.minimum.at(nearby, one, rank[other])
        chosen = order[(rank[going[order]] == np.arange(len(order))) & (rank < nearby)[going[order]]]
        target = np.arange(len(self.place))
        target[pairs[chosen, :, 0]] = pairs[chosen, :, 1]
        self.faces = self._whole(target[self.faces])
        for quadric in (self.shape, self.line):
            np.add.at(quadric, staying[chosen], quadric[going[chosen]])
        return len(chosen)

    def _whole(self, faces: Faces) -> Faces:
        a, b, c = self.place[faces].T
        return faces[(a != b) & (b != c) & (c != a)]

    def _edges(self) -> tuple[Faces, Faces, Flags, NDArray[np.int64]]:
        """Edges: places (2, e), vertices on both sides (e, side, end), which of them are lines, and the faces on
        each."""
        vertices = self.faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)
        vertices = np.where(np.diff(self.place[vertices]) < 0, vertices[:, ::-1], vertices)
        low, high = self.place[vertices].T
        order = np.lexsort([high, low])
        low, high, vertices = low[order], high[order], vertices[order]
        first = np.flatnonzero(np.append(True, (low[1:] != low[:-1]) | (high[1:] != high[:-1])))
        count = np.diff(np.append(first, len(low)))
        sides = np.stack([vertices[first], vertices[first + count - 1]], 1)
        return np.stack([low[first], high[first]]), sides, (count != 2) | (sides[:, 0] != sides[:, 1]).any(1), count

    def _candidates(self) -> tuple[Faces, Faces, Faces]:
        """Collapses that keep topology and lines.

        Returns removed and remaining places (2, c); removed and remaining vertices on both sides of the edge (c, side,
        2); and all edges (2, e).
        """
        edge, sides, line, count = self._edges()
        size = len(self.places)
        lines = np.bincount(edge[:, line].ravel(), minlength=size)
        lines[edge[:, count > 2].ravel()] = 3  # never removed
        normals = np.bincount(self.place[np.unique(self.faces)], minlength=size)
        joined = sparse.csr_array((np.ones(len(line)), (edge[0], edge[1])), shape=(size, size))
        joined = (joined + joined.T).tocsr()
        apart = np.asarray(joined[edge[0]].multiply(joined[edge[1]]).sum(axis=1)).ravel() == count
        found = []
        for places, pairs in ((edge, sides), (edge[::-1], sides[:, :, ::-1])):
            same = (pairs[:, 0] == pairs[:, 1]) | (pairs[:, 0, :1] != pairs[:, 1, :1])
            covered = 1 + (pairs[:, 0, 0] != pairs[:, 1, 0]) == normals[places[0]]
            along = (lines[places[0]] == 0) | ((lines[places[0]] == 2) & line)
            ok = apart & same.all(1) & covered & along
            found.append((places[:, ok], pairs[ok]))
        return np.concatenate([p for p, _ in found], 1), np.concatenate([s for _, s in found]), edge

    def _fits(self, going: Faces, staying: Faces, pairs: Faces) -> Flags:
        """Whether every remaining triangle keeps its facing and is no sliver."""
        corners = self.faces.ravel()
        order = np.argsort(self.place[corners], kind="stable")
        start = np.searchsorted(self.place[corners][order], np.arange(len(self.places) + 1))
        number = (start[1:] - start[:-1])[going]
        which = np.repeat(np.arange(len(going)), number)
        slot = np.arange(number.sum()) - np.repeat(np.cumsum(number) - number, number) + start[going][which]
        old = self.faces[order[slot] // 3]
        stays = (self.place[old] != staying[which, None]).all(1)
        which, old = which[stays], old[stays]
        new = old.copy()
        for side in (0, 1):
            new = np.where(old == pairs[which, side, :1], pairs[which, side, 1:], new)
        (was, fat), (now, thin) = self._facing(old), self._facing(new)
        lean = [_dot(self.normals[f], n[:, None]).min(1) for f, n in ((old, was), (new, now))]
        good = _dot(was, now) > np.where(fat > _SLIVER, self.turn, 0.5)
        good &= (lean[1] > self.turn) | (lean[1] >= lean[0])
        good &= (thin > _SLIVER) | (thin >= fat)
        return np.bincount(which[~good], minlength=len(going)) == 0

    def _facing(self, faces: Faces) -> tuple[Array, Array]:
        """Unit normals of triangles (f, 3), and their heights as a share of their longest edge."""
        a, b, c = (self.places[self.place[faces[:, k]]] for k in range(3))
        cross = np.cross(b - a, c - a)
        twice = np.sqrt(_dot(cross, cross))
        longest = np.max([_dot(p - q, p - q) for p, q in ((a, b), (b, c), (c, a))], axis=0)
        return cross / np.maximum(twice, 1e-20)[:, None], twice / longest

    def _quadrics(self) -> tuple[Array, Array]:
        """Two quadrics (4, 4) per place, with their weight in a last row: of the planes and of the lines around it."""
        unit, _ = self._facing(self.faces)
        a, b, c = (self.places[self.place[self.faces[:, k]]] for k in range(3))
        cross = np.cross(b - a, c - a)
        area = np.sqrt(_dot(cross, cross))
        shape, line = np.zeros((2, len(self.places), 5, 4))
        plane = np.column_stack([unit, -_dot(unit, a)])
        for k in range(3):
            _gather(shape, self.place[self.faces[:, k]], area, plane[:, :, None] * plane[:, None, :])
        (one, other), _, is_line, _ = self._edges()
        one, other = one[is_line], other[is_line]
        along = self.places[other] - self.places[one]
        squared = _dot(along, along)
        across = np.eye(3) - along[:, :, None] * along[:, None, :] / squared[:, None, None]
        affine = np.concatenate([across, -_dot(across, self.places[one][:, None])[:, :, None]], 2)
        columns = np.swapaxes(affine, 1, 2)
        for end in (one, other):
            _gather(line, end, np.sqrt(squared), _dot(columns[:, :, None], columns[:, None]))
        return shape, line


def _gather(quadrics: Array, at: Faces, weight: Array, square: Array) -> None:
    np.add.at(quadrics[:, :4], at, weight[:, None, None] * square)
    np.add.at(quadrics[:, 4, 0], at, weight)


def _distance(quadrics: Array, points: Array) -> Array:
    """Root mean square distance (n,) m of points (n, 3) from the planes or lines of quadrics (n, 5, 4)."""
    homogeneous = np.column_stack([points, np.ones(len(points))])
    square = _dot(_dot(quadrics[:, :4], homogeneous[:, None]), homogeneous)
    return np.sqrt(np.maximum(square, 0.0) / np.maximum(quadrics[:, 4, 0], 1e-20))


def _dot(a: Array, b: Array) -> Array:
    """Inner products along the last axis, added in a fixed order: the same digits on every CPU."""
    total = a[..., 0] * b[..., 0]
    for k in range(1, a.shape[-1]):
        total = total + a[..., k] * b[..., k]
    return total


def _on_grid(values: Array) -> Array:
    return np.rint(values / _GRID) * _GRID + 0.0  # no negative zero
