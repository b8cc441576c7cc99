"""Surfaces for generated vehicles: lofts, tubes, wings, hulls, and cutting a surface along a field's zero line.

This module holds geometry only, in metres. Each vehicle's script combines shapes, and `_usd.py` writes them as USD.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import sparse
from scipy.interpolate import Akima1DInterpolator, PchipInterpolator
from scipy.spatial import ConvexHull, HalfspaceIntersection

Array = NDArray[np.float64]
Faces = NDArray[np.int64]
Field = Callable[[Array], Array]
"""A scalar (n,) on points (n, 3); negative inside, and near zero approximately a distance in metres."""

TIE = 1e-9
"""Added when comparing two numbers that may be equal by construction: CPUs differ in the last digits (1e-16), and the
outcome must not depend on them."""


@dataclass(frozen=True)
class Surface:
    """Triangles (m, 3), counter-clockwise from outside, over ``points`` (n, 3) with unit ``normals`` (n, 3)."""

    points: Array
    normals: Array
    faces: Faces

    def moved(self, by: ArrayLike) -> Surface:
        return Surface(self.points + np.asarray(by, float), self.normals, self.faces)

    def turned(self, rotation: Array) -> Surface:
        """This surface under a rotation (3, 3) about the origin."""
        return Surface(self.points @ rotation.T, self.normals @ rotation.T, self.faces)

    def mirrored(self) -> Surface:
        """The reflection through the plane y = 0, facing outward again."""
        flip = np.array([1.0, -1.0, 1.0])
        return Surface(self.points * flip, self.normals * flip, self.faces[:, ::-1])

    def pair(self) -> Surface:
        """This surface together with its mirror image."""
        return join(self, self.mirrored())


def join(*surfaces: Surface) -> Surface:
    """All of ``surfaces`` as one."""
    offsets = np.cumsum([0] + [len(s.points) for s in surfaces])
    return Surface(
        np.concatenate([s.points for s in surfaces]),
        np.concatenate([s.normals for s in surfaces]),
        np.concatenate([s.faces + o for s, o in zip(surfaces, offsets, strict=False)]),
    )


def shade(points: Array, faces: Faces, crease: float = 40.0) -> Surface:
    """A surface with smooth normals that break where neighbouring faces differ by more than ``crease`` degrees."""
    cross = np.cross(points[faces[:, 1]] - points[faces[:, 0]], points[faces[:, 2]] - points[faces[:, 0]])
    area = np.linalg.norm(cross, axis=1)
    faces, cross, area = faces[area > 1e-10], cross[area > 1e-10], area[area > 1e-10]
    unit = cross / area[:, None]
    _, weld = np.unique(np.round(points, 6), axis=0, return_inverse=True)
    corners = weld.reshape(-1)[faces].reshape(-1)
    owner = np.repeat(np.arange(len(faces)), 3)
    touches = sparse.csr_array((np.ones(len(corners)), (corners, owner)), shape=(len(points), len(faces)))
    around = touches[corners].tocoo()  # every face around every face corner
    near = np.einsum("ij,ij->i", unit[owner[around.row]], unit[around.col]) > np.cos(np.radians(crease)) - TIE
    normals = np.zeros((len(corners), 3))
    np.add.at(normals, around.row[near], cross[around.col[near]])
    normals /= np.linalg.norm(normals, axis=1)[:, None]
    key = np.column_stack([corners, np.round(normals, 4)])
    _, first, inverse = np.unique(key, axis=0, return_index=True, return_inverse=True)
    return Surface(points[faces.reshape(-1)[first]], normals[first], inverse.reshape(-1, 3))


def lattice(rows: Any, wrap: bool = True, caps: bool = True, crease: float = 40.0) -> Surface:
    """A skin over sections ``rows`` (m, n, 3); ``wrap`` closes each section, ``caps`` the two ends with a fan."""
    rows = np.asarray(rows, float)
    m, n, _ = rows.shape
    i, j = np.meshgrid(np.arange(m - 1), np.arange(n if wrap else n - 1), indexing="ij")
    k = (j + 1) % n
    a, b, c, d = (i * n + j).ravel(), (i * n + k).ravel(), ((i + 1) * n + k).ravel(), ((i + 1) * n + j).ravel()
    points, faces = rows.reshape(-1, 3), np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)])
    if wrap and caps:
        points = np.concatenate([points, [rows[0].mean(0), rows[-1].mean(0)]])
        j = np.arange(n)
        k = (j + 1) % n
        first = np.stack([np.full(n, m * n), k, j], 1)
        last = np.stack([np.full(n, m * n + 1), (m - 1) * n + j, (m - 1) * n + k], 1)
        faces = np.concatenate([faces, first, last])
        a, b, c = points[faces[:, 0]], points[faces[:, 1]], points[faces[:, 2]]
        if np.einsum("ij,ij->", a, np.cross(b, c)) < 0:
            faces = faces[:, ::-1]
    return shade(points, faces, crease)


def tube(path: Any, radius: Any, sides: int = 12, samples: int = 0, crease: float = 50.0) -> Surface:
    """A round tube along ``path`` (m, 3), optionally splined to ``samples`` points; ``radius``: a number or (m,)."""
    path = np.asarray(path, float)
    radius = np.broadcast_to(np.asarray(radius, float), len(path))
    if samples:
        s = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(path, axis=0), axis=1))])
        t = np.linspace(0, s[-1], samples)
        path, radius = Akima1DInterpolator(s, path, method="makima")(t), PchipInterpolator(s, radius)(t)
    tangent = np.gradient(path, axis=0)
    tangent /= np.linalg.norm(tangent, axis=1)[:, None]
    across = np.cross(tangent[0], np.eye(3)[np.argmin(np.round(np.abs(tangent[0]), 6))])
    rows = []
    turn = np.linspace(0, 2 * np.pi, sides, endpoint=False)
    for p, t, r in zip(path, tangent, radius, strict=True):  # parallel transport: the frame never twists
        across = across - t * (across @ t)
        across /= np.linalg.norm(across)
        up = np.cross(t, across)
        rows.append(p + r * (np.outer(np.cos(turn), across) + np.outer(np.sin(turn), up)))
    return lattice(rows, crease=crease)


def revolve(profile: ArrayLike, sides: int = 32, axis: str = "z", crease: float = 35.0) -> Surface:
    """The solid of a ``profile`` (m, 2) of (radius, height) turned about ``axis``, closed at both ends."""
    profile = np.asarray(profile, float)
    turn = np.linspace(0, 2 * np.pi, sides, endpoint=False)
    ring = np.stack([np.cos(turn), np.sin(turn), np.zeros(sides)], 1)
    rows = profile[:, None, :1] * ring + profile[:, None, 1:] * np.array([0.0, 0.0, 1.0])
    return lattice(np.roll(rows, {"z": 0, "x": 1, "y": 2}[axis], axis=2), crease=crease)


def box(size: ArrayLike, centre: ArrayLike = (0, 0, 0), bevel: float = 0.0, steps: int = 1) -> Surface:
    """A box with its edges bevelled in ``steps`` (3 look round): the hull of its shrunken corners, grown."""
    half = np.asarray(size, float) / 2
    corners = np.array(np.meshgrid([-1, 1], [-1, 1], [-1, 1])).reshape(3, -1).T * (half - bevel)
    grown = np.concatenate([corners + bevel * np.sign(corners) * d for d in _octant(steps)]) if bevel else corners
    return convex(grown + np.asarray(centre, float), 30.0 if steps == 1 else 100.0 / steps)


def _octant(steps: int) -> Array:
    """Directions (n, 3) of one octant of the unit sphere, ``steps`` apart along its edges."""
    i, j = (k.ravel() for k in np.meshgrid(np.arange(steps + 1), np.arange(steps + 1), indexing="ij"))
    i, j = i[i + j <= steps], j[i + j <= steps]
    weights = np.sin(np.stack([i, j, steps - i - j], 1) / steps * np.pi / 2)
    return weights / np.linalg.norm(weights, axis=1)[:, None]


def sheet(rows: Any, facing: ArrayLike, crease: float = 40.0) -> Surface:
    """An open skin over ``rows`` (m, n, 3) that faces ``facing`` (3,) on average."""
    surface = lattice(rows, wrap=False, crease=crease)
    a, b, c = (surface.points[surface.faces[:, k]] for k in range(3))
    away = np.cross(b - a, c - a).sum(0) @ np.asarray(facing, float) < 0
    return Surface(surface.points, -surface.normals, surface.faces[:, ::-1]) if away else surface


def ring(profile: ArrayLike, sides: int, axis: str = "y", crease: float = 40.0) -> Surface:
    """A closed ``profile`` (m, 2) of (radius, height along ``axis``) turned about ``axis``: tyres, rims, hoops."""
    profile = np.asarray(profile, float)
    turn = np.linspace(0, 2 * np.pi, sides, endpoint=False)
    around = np.stack([np.cos(turn), np.sin(turn), np.zeros(sides)], 1)
    loop = np.concatenate([profile, profile[:1]])
    rows = loop[:, None, :1] * around + loop[:, None, 1:] * np.array([0.0, 0.0, 1.0])
    rows = np.roll(rows, {"z": 0, "x": 1, "y": 2}[axis], axis=2)
    surface = lattice(rows, caps=False, crease=crease)
    a, b, c = (surface.points[surface.faces[:, k]] for k in range(3))
    inward = np.einsum("ij,ij->", a, np.cross(b, c)) < 0
    return Surface(surface.points, -surface.normals, surface.faces[:, ::-1]) if inward else surface


def superellipse(length: float, width: float, power: float, around: int) -> Array:
    """A closed curve (around, 2) with half axes ``length`` and ``width``: ``power`` 2 is an ellipse, more is
    squarer."""
    turn = np.linspace(0, 2 * np.pi, around, endpoint=False)
    c, s = np.cos(turn), np.sin(turn)
    return np.stack([length * np.sign(c) * np.abs(c) ** (2 / power), width * np.sign(s) * np.abs(s) ** (2 / power)], 1)


def torus(radius: float, thickness: float, sides: int = 32, axis: str = "z", around: int = 8) -> Surface:
    """A ring of round section: ``radius`` to the middle of the section, ``thickness`` its own radius."""
    turn = np.linspace(0, 2 * np.pi, around, endpoint=False)
    return ring(np.stack([radius + thickness * np.cos(turn), thickness * np.sin(turn)], 1), sides, axis, 70.0)


def aimed(direction: ArrayLike, up: ArrayLike = (0.0, 0.0, 1.0)) -> Array:
    """A rotation (3, 3) that maps X to ``direction`` and keeps Z as close to ``up`` as possible."""
    x = np.asarray(direction, float) / np.linalg.norm(direction)
    y = np.cross(np.asarray(up, float), x)
    y /= np.linalg.norm(y)
    return np.stack([x, y, np.cross(x, y)], 1)


def convex(points: Array, crease: float = 30.0) -> Surface:
    """The convex hull of ``points`` as a surface."""
    points = np.round(points, 9)  # Qhull decides by the last digit whether a face is flat
    hull = ConvexHull(points)
    faces = hull.simplices.astype(np.int64)
    a, b, c = points[faces[:, 0]], points[faces[:, 1]], points[faces[:, 2]]
    inward = np.einsum("ij,ij->i", np.cross(b - a, c - a), hull.equations[:, :3]) < 0
    faces[inward] = faces[inward, ::-1]
    return shade(points, faces, crease)


def airfoil(chord: float, thickness: float, points: int = 12) -> Array:
    """A symmetric four-digit NACA section (2 points - 2, 2): x from +chord/4 (nose) to -3 chord/4, y thickness."""
    x = (1 - np.cos(np.linspace(0, np.pi, points))) / 2
    y = 5 * thickness * (0.2969 * np.sqrt(x) - 0.126 * x - 0.3516 * x**2 + 0.2843 * x**3 - 0.1036 * x**4)
    top, bottom = np.stack([x, y], 1), np.stack([x, -y], 1)[-2:0:-1]
    section = np.concatenate([top, bottom])
    return np.stack([chord * (0.25 - section[:, 0]), chord * section[:, 1]], 1)


def wing(stations: Sequence[tuple[ArrayLike, float, float, float]], lift: ArrayLike, points: int = 12) -> Surface:
    """An airfoil skin through ``stations`` (quarter-chord point, chord m, thickness ratio, twist rad).

    The chord points along X turned by ``twist`` towards ``lift``, the direction of the section's thickness.
    """
    forward, up = np.array([1.0, 0.0, 0.0]), np.asarray(lift, float)
    rows = []
    for point, chord, thickness, twist in stations:
        section = airfoil(chord, thickness, points)
        x, z = np.cos(twist) * forward + np.sin(twist) * up, np.cos(twist) * up - np.sin(twist) * forward
        rows.append(np.asarray(point, float) + section[:, :1] * x + section[:, 1:] * z)
    return lattice(rows, crease=50)


# ---------------------------------------------------------------- cutting


def split(surface: Surface, field: Field) -> tuple[Surface, Surface]:
    """``surface`` cut along ``field`` = 0: inside (negative) and outside, sharing the cut's points."""
    value = field(surface.points)
    value = np.where(np.abs(value) < 1e-5, 1e-5, value)
    inside = value < 0
    edges = np.sort(surface.faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
    edges = np.unique(edges[inside[edges[:, 0]] != inside[edges[:, 1]]], axis=0)
    at = _roots(surface.points, value, edges, field)[:, None]
    points = surface.points[edges[:, 0]] * (1 - at) + surface.points[edges[:, 1]] * at
    normals = surface.normals[edges[:, 0]] * (1 - at) + surface.normals[edges[:, 1]] * at
    normals /= np.linalg.norm(normals, axis=1)[:, None]
    whole = Surface(np.concatenate([surface.points, points]), np.concatenate([surface.normals, normals]), surface.faces)
    cut = {(int(a), int(b)): len(surface.points) + i for i, (a, b) in enumerate(edges)}
    sides: tuple[list, list] = ([], [])
    for face in surface.faces:
        within = inside[face]
        if within.all() or not within.any():
            sides[0 if within[0] else 1].append(face)
            continue
        lone = int(np.argmax(within == (within.sum() == 1)))  # the single corner on its side
        a, b, c = (int(face[(lone + k) % 3]) for k in range(3))
        ab, ac = cut[min(a, b), max(a, b)], cut[min(a, c), max(a, c)]
        sides[0 if inside[a] else 1].append((a, ab, ac))
        sides[1 if inside[a] else 0].extend([(ab, b, c), (ab, c, ac)])
    return _used(whole, sides[0]), _used(whole, sides[1])


def refined(surface: Surface, axis: int, at: ArrayLike) -> Surface:
    """``surface`` with edges along the planes where coordinate ``axis`` is one of ``at``: finer, of the same shape."""
    for value in np.asarray(at, float):
        surface = join(*split(surface, below(axis, value)))
    return surface


def sharpened(surface: Surface, region: Field, size: float, axes: tuple[int, int] = (1, 2)) -> Surface:
    """``surface`` with triangles of ``size`` across ``axes`` in and around a ``region``, so that cuts there are
    sharp."""
    near, surface = split(surface, grown(region, 0.015))
    for axis in axes:
        low, high = near.points[:, axis].min(), near.points[:, axis].max()
        near = refined(near, axis, np.arange(low + size / 2, high, size))
    return join(surface, near)


def _roots(points: Array, value: Array, edges: Faces, field: Field) -> Array:
    """The points at which ``field`` vanishes along each edge, by bisection on the chord."""
    lower, upper = np.zeros(len(edges)), np.ones(len(edges))
    start, along = points[edges[:, 0]], points[edges[:, 1]] - points[edges[:, 0]]
    sign = np.sign(value[edges[:, 0]])
    for _ in range(12):
        middle = (lower + upper) / 2
        same = np.sign(field(start + middle[:, None] * along) + TIE) == sign if len(edges) else np.zeros(0, bool)
        lower, upper = np.where(same, middle, lower), np.where(same, upper, middle)
    return np.clip((lower + upper) / 2, 0.001, 0.999)


def _used(surface: Surface, faces: Sequence) -> Surface:
    """``surface`` with only ``faces`` and the points they use."""
    if not len(faces):
        return Surface(np.zeros((0, 3)), np.zeros((0, 3)), np.zeros((0, 3), np.int64))
    used, inverse = np.unique(np.asarray(faces, np.int64), return_inverse=True)
    return Surface(surface.points[used], surface.normals[used], inverse.reshape(-1, 3))


def by_material(*looks: Mapping[str, Surface]) -> dict[str, Surface]:
    """All ``looks`` as one: one surface per material, in the order materials first appear."""
    names = dict.fromkeys(name for look in looks for name in look)
    return {name: join(*(look[name] for look in looks if name in look)) for name in names}


def painted(surface: Surface, coats: Iterable[tuple[str, Field]], rest: str) -> dict[str, Surface]:
    """``surface`` cut into materials: each coat covers the inside of its field, ``rest`` the remainder."""
    looks = []
    for name, region in coats:
        inside, surface = split(surface, region)
        looks.append({name: inside})
    looks.append({rest: surface})
    return by_material(*(look for look in looks if all(len(s.faces) for s in look.values())))


def polygon(corners: ArrayLike, radius: float = 0.0, axes: tuple[int, int] = (0, 2)) -> Field:
    """Signed distance to a polygon with corners rounded by ``radius``, seen along the axis not in ``axes``."""
    import shapely

    shape = shapely.Polygon(corners).buffer(-radius) if radius else shapely.Polygon(corners)

    def distance(points: Array) -> Array:
        flat = shapely.points(np.asarray(points)[:, list(axes)])
        away = shapely.distance(flat, shape.exterior)
        return np.where(shapely.contains(shape, flat), -away, away) - radius

    return distance


def both(*fields: Field, blend: float = 0.0) -> Field:
    """The intersection of regions; ``blend`` rounds the corners where they meet."""

    def value(points: Array) -> Array:
        result = fields[0](points)
        for field in fields[1:]:
            other = field(points)
            h = np.clip(blend - np.abs(result - other), 0, None)
            result = np.maximum(result, other) + (h * h / (4 * blend) if blend else 0)
        return result

    return value


def both_sides(field: Field) -> Field:
    """The region ``field`` of the left side, on the right side too."""
    return lambda p: field(np.column_stack([p[:, 0], np.abs(p[:, 1]), p[:, 2]]))


def below(axis: int, value: float) -> Field:
    """Where coordinate ``axis`` is less than ``value``."""
    return lambda p: p[:, axis] - value


def grown(field: Field, by: float) -> Field:
    """The region ``field`` with its border moved outward ``by`` metres."""
    return lambda p: field(p) - by


def seam(surface: Surface, fields: Sequence[Field], half_width: float) -> tuple[Surface, Surface]:
    """``surface`` without thin lines around each region, and those lines."""
    lines: list[Surface] = []
    for field in fields:
        # two cuts on one-sided fields: a cut on |field| would miss lines thinner than a triangle
        within, surface = split(surface, grown(field, half_width))
        within, line = split(within, grown(field, -half_width))
        surface, lines = join(surface, within), [*lines, line]
    return surface, join(*lines)


def curve(xs: ArrayLike, ys: ArrayLike) -> Callable[[Array], Array]:
    """The monotone interpolant through (xs, ys), constant beyond its ends; ``xs`` in either order."""
    xs, ys = np.asarray(xs, float), np.asarray(ys, float)
    order = np.argsort(xs)
    spline = PchipInterpolator(xs[order], ys[order])
    return lambda x: spline(np.clip(x, xs.min(), xs.max()))


# ---------------------------------------------------------------- collision hulls


def outer_hull(points: Array, angle: float = 14.0) -> Surface:
    """A convex polytope with few vertices that contains ``points``; its planes are ``angle`` degrees apart."""
    normals = _spread_normals(points, angle)
    support = np.round((points @ normals.T).max(0) + 1e-4, 9)
    inner = np.append(points.min(0) / 2 + points.max(0) / 2, 0)[:3]
    corners = HalfspaceIntersection(np.column_stack([normals, -support]), inner).intersections
    corners = np.unique(np.round(corners, 5), axis=0)
    return convex(corners, crease=180.0)  # one vertex per corner


def _spread_normals(points: Array, angle: float) -> Array:
    """Normals of the exact hull's facets, largest first, none closer than ``angle`` to a previous one."""
    points = np.round(points, 9)
    hull = ConvexHull(points)
    a, b, c = (points[hull.simplices[:, k]] for k in range(3))
    area = np.linalg.norm(np.cross(b - a, c - a), axis=1)
    chosen = np.concatenate([np.eye(3), -np.eye(3)])
    order = np.argsort(-np.round(area, 7), kind="stable")  # equal areas are common: mirror images
    for normal in np.round(hull.equations[order, :3], 9):
        if (chosen @ normal).max() < np.cos(np.radians(angle)) - TIE:
            chosen = np.vstack([chosen, normal])
    return chosen
