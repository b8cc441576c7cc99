"""Obstacles in a world: polygons, ellipses, boxes, balls, cones, meshes, and moving vehicles.

An obstacle is a solid between two heights. It has convex `parts` in the plane, seen from above, for vehicles on wheels;
convex `hulls` for flying vehicles; and a mesh for pictures. `plane.py` holds the geometry.
"""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from vehsim.clip.interpolant import spatial
from vehsim.errors import InputError
from vehsim.lie.quaternions import yaw_of
from vehsim.runtime.cache import Stamp, kept_arrays, stamp
from vehsim.world.obstacles.concave import convex_pieces
from vehsim.world.obstacles.plane import Ellipse, Shape, convex_hull, convex_parts, placed, simple_polygon

if TYPE_CHECKING:
    from vehsim.clip.clip import Clip

Array = NDArray[np.float64]

BEVEL = 0.06
"""Width of the bevel along a prism's upper edge, m, which catches the light."""
SIDES = 64
"""Sides of the prism that replaces an elliptic cylinder where hulls are necessary; it contains the cylinder."""
ROUNDNESS = 3
"""Subdivisions of the icosahedron that represents a ball: 1280 faces, 0.5 % larger than the ball."""


FINISHES = ("concrete", "paint", "stripes", "facade", "bands")
"""What covers an obstacle: concrete in panels of 1 m, plain paint, warning stripes of 0.25 m, a house's front with
storeys of 3 m, or the bands of a traffic cone."""
THINNEST, FLATTEST = 1e-4, 1e-6
"""Smallest thickness of an obstacle, m, and relative to its length: thinner ones have no usable convex hull."""


@dataclass(frozen=True, eq=False)
class Obstacle:
    """``name``; ``parts``: convex shapes in the plane; ``bottom, top`` m; ``hulls``: convex point sets (n, 3) m.

    ``points`` (n, 3) m and ``faces`` (m, 3) are its mesh. ``finish``: what covers it in pictures, one of `FINISHES`;
    ``colour``: red, green and blue from 0 to 1, sRGB; default: that of the finish, or one of four paints in turn.
    """

    name: str
    parts: tuple[Shape, ...]
    bottom: float
    top: float
    hulls: tuple[Array, ...]
    points: Array
    faces: NDArray[np.int64]
    finish: str = "concrete"
    colour: tuple[float, float, float] | None = None
    moves: ClassVar[bool] = False

    def __post_init__(self) -> None:
        if self.finish not in FINISHES:
            remedy = f"choose one of {', '.join(FINISHES)}"
            raise InputError("unknown", remedy, key="finish", value=self.finish, subject=f"obstacle {self.name!r}")
        for hull in self.hulls:
            thick = _thickness(hull)
            if not thick >= max(THINNEST, FLATTEST * float(np.ptp(hull, axis=0).max())):
                remedy = f"make it at least {THINNEST:g} m thick and {FLATTEST:g} of its length"
                raise InputError(f"only {thick:.3g} m thick", remedy, key="shape", subject=f"obstacle {self.name!r}")

    def shapes_at(self, seconds: Array) -> Sequence[Shape]:
        """The parts, polygons (k, 2), or one per time (n, k, 2); ``seconds`` (n,) since frame 0."""
        return self.parts

    @cached_property
    def content_hash(self) -> str:
        """A hash of the obstacle's content."""
        content = repr((self.name, self.bottom, self.top)).encode()
        return hashlib.sha256(content + self.points.tobytes() + self.faces.tobytes()).hexdigest()


@dataclass(frozen=True, eq=False)
class Moving:
    """Another vehicle in motion: the hulls of ``clip.vehicle`` along ``clip``; before and after the clip it stands."""

    name: str
    clip: Clip
    moves: ClassVar[bool] = True

    @cached_property
    def outline(self) -> Array:
        """The vehicle seen from above, (k, 2) m in its root's frame."""
        return footprint(self.clip.vehicle)

    @cached_property
    def hulls(self) -> tuple[Array, ...]:
        """Convex point sets (n, 3) m in the rig root's frame."""
        return hulls_of(self.clip.vehicle)

    @property
    def bottom(self) -> float:
        """The lowest point over its whole motion, m."""
        return float(self.clip.positions[:, 2].min() + min(hull[:, 2].min() for hull in self.hulls))

    @property
    def top(self) -> float:
        """The highest point over its whole motion, m."""
        return float(self.clip.positions[:, 2].max() + max(hull[:, 2].max() for hull in self.hulls))

    @property
    def is_static(self) -> bool:
        """Whether it never moves."""
        poses = np.hstack([self.clip.positions, self.clip.orientations])
        return bool(np.ptp(poses, axis=0).max() < 0.01)

    def poses_at(self, seconds: Array) -> tuple[Array, Array]:
        """Positions (n, 3) m and orientations (n, 4) at ``seconds`` (n,) since frame 0."""
        times, place = np.unique(self._times(seconds), return_inverse=True)
        motion = self.clip.at(times)
        return motion.positions[place], motion.orientations[place]

    def channels_at(self, seconds: Array) -> dict[str, Array]:
        """The channels (n,) of its rig at ``seconds`` (n,) since frame 0."""
        times, place = np.unique(self._times(seconds), return_inverse=True)
        return {name: values[place] for name, values in self.clip.at(times).channels.items()}

    def motion_at(self, seconds: Array) -> tuple[Array, Array, Array, Array]:
        """Times of its clip (n,) s, positions, velocities in world axes and angular ones in body axes, (n, 3) each."""
        times, place = np.unique(self._times(seconds), return_inverse=True)
        motion = self.clip.at(times)
        omega, velocity = spatial(motion)
        return times[place], motion.positions[place], velocity[place], omega[place]

    def _times(self, seconds: Array) -> Array:
        """Times of its clip (n,) s at ``seconds`` (n,) since frame 0."""
        first = self.clip.start_frame / float(self.clip.fps)
        return np.asarray(np.clip(seconds - first, *self.clip.times[[0, -1]]))

    def shapes_at(self, seconds: Array) -> Sequence[Shape]:
        """The vehicle's outline at each time, [(n, k, 2)]; ``seconds`` (n,) since frame 0."""
        positions, orientations = self.poses_at(seconds)
        return [placed(self.outline, positions[:, :2], yaw_of(orientations))]

    @cached_property
    def content_hash(self) -> str:
        """A hash of the obstacle's content."""
        clip = self.clip
        arrays = (clip.times, clip.positions, clip.orientations, clip.joints, *self.hulls)
        return hashlib.sha256(self.name.encode() + b"".join(a.tobytes() for a in arrays)).hexdigest()


def polygon(name: str, points: ArrayLike, height: float = 1.0, base: float = 0.0) -> Obstacle:
    """A prism over a simple polygon (k, 2) m, convex or not, in either sense; from ``base`` m, ``height`` m high."""
    try:
        outline = simple_polygon(points)
        parts = convex_parts(outline)
    except ValueError as error:
        remedy = "give each corner once, in order around the polygon"
        raise InputError(str(error), remedy, key="points", subject=f"obstacle {name!r}") from None
    return _prism(name, tuple(parts), outline, parts, height, base)


def ellipse(
    name: str, centre: ArrayLike, radii: ArrayLike, heading: float = 0.0, height: float = 1.0, base: float = 0.0
) -> Obstacle:
    """An upright elliptic cylinder: ``centre`` (2,), ``radii`` (2,) m, its first axis turned by ``heading`` degrees."""
    middle, size = _numbers(name, "centre", centre, 2), _numbers(name, "radii", radii, 2)
    if (size <= 0).any():
        raise InputError(
            "not positive", "give two lengths in m", key="radii", value=radii, subject=f"obstacle {name!r}"
        )
    shape = Ellipse(middle, size, _turned(heading))
    outline = shape.outline(SIDES)
    return _prism(name, (shape,), outline, [outline], height, base)


def box(name: str, centre: ArrayLike, size: ArrayLike, heading: float = 0.0) -> Obstacle:
    """An upright box: ``centre`` (3,) m of its bottom, ``size`` (3,) m along its own axes, ``heading`` degrees."""
    middle, sides = _numbers(name, "centre", centre, 3), _numbers(name, "size", size, 3)
    if (sides <= 0).any():
        raise InputError(
            "not positive", "give three lengths in m", key="size", value=size, subject=f"obstacle {name!r}"
        )
    corners = np.array([(-0.5, -0.5), (0.5, -0.5), (0.5, 0.5), (-0.5, 0.5)]) * sides[:2]
    outline = middle[:2] + corners @ _turned(heading).T
    return _prism(name, (outline,), outline, [outline], float(sides[2]), float(middle[2]))


def sphere(name: str, centre: ArrayLike, radius: float) -> Obstacle:
    """A ball: ``centre`` (3,) m, ``radius`` m. Its hull has flat faces and contains it; so does its part in the
    plane."""
    import trimesh

    middle = _numbers(name, "centre", centre, 3)
    if not (np.isfinite(radius) and radius > 0):
        raise InputError("not a radius", "give a length in m", key="radius", value=radius, subject=f"obstacle {name!r}")
    ball = trimesh.creation.icosphere(subdivisions=ROUNDNESS, radius=1.0)
    inner = float((ball.face_normals * ball.triangles_center).sum(axis=1).min())
    points = middle + np.asarray(ball.vertices) * (radius / inner)
    disc = Ellipse(middle[:2], np.full(2, float(radius)), np.eye(2))
    low, high = float(middle[2] - radius), float(middle[2] + radius)
    return Obstacle(name, (disc,), low, high, (points,), points, np.asarray(ball.faces, np.int64))


def cone(name: str, centre: ArrayLike, radius: float = 0.2, height: float = 0.75, tip: float = 0.03) -> Obstacle:
    """An upright cone, by default the size of a traffic cone: ``centre`` (3,) m of its bottom, its ``radius`` and
    ``height`` m, and the radius ``tip`` m of its top. Its hull has flat faces and contains it."""
    middle = _numbers(name, "centre", centre, 3)
    for key, value in (("radius", radius), ("height", height), ("tip", tip)):
        if not (np.isfinite(value) and value > 0):
            raise InputError("not a length", "give one in m", key=key, value=value, subject=f"obstacle {name!r}")
    bottom, top = (Ellipse(middle[:2], np.full(2, float(r)), np.eye(2)) for r in (radius, tip))
    low, high = float(middle[2]), float(middle[2] + height)
    rings = ((bottom.outline(SIDES), low), (top.outline(SIDES), high))
    points = np.vstack([np.column_stack([ring, np.full(SIDES, z)]) for ring, z in rings])
    here, fan = np.arange(SIDES), np.arange(1, SIDES - 1)
    after, first = np.roll(here, -1), np.zeros_like(fan)
    faces = [(here, after, after + SIDES), (here, after + SIDES, here + SIDES)]
    faces += [(first, fan + 1, fan), (first + SIDES, fan + SIDES, fan + 1 + SIDES)]
    around = bottom if radius >= tip else top
    triangles = np.vstack([np.column_stack(corners) for corners in faces]).astype(np.int64)
    return Obstacle(name, (around,), low, high, (points,), points, triangles, finish="bands")


def mesh(
    name: str, path: str | Path, position: ArrayLike = (0, 0, 0), heading: float = 0.0, scale: float = 1.0
) -> Obstacle:
    """A mesh file (OBJ, STL, PLY, GLB, USD), Z up: each of its connected bodies is replaced by its convex hull, or by
    several if it is concave."""
    from scipy.spatial import QhullError

    points, faces = _read_mesh(Path(path))
    turn = np.eye(3)
    turn[:2, :2] = _turned(heading)
    points = scale * points @ turn.T + _numbers(name, "position", position, 3)
    try:
        hulls = tuple(hull for body in _bodies(points, faces) for hull in convex_pieces(*body, name))
    except QhullError:
        remedy = "close it, or give a box or polygon instead"
        raise InputError(
            "a flat body has no interior", remedy, key="mesh", value=path, subject=f"obstacle {name!r}"
        ) from None
    parts = tuple(convex_hull(hull[:, :2]) for hull in hulls)
    return Obstacle(name, parts, float(points[:, 2].min()), float(points[:, 2].max()), hulls, points, faces)


def moving(name: str, clip: Clip) -> Moving:
    """A moving vehicle. Raises ``InputError`` for one without an asset, whose size is unknown."""
    if clip.vehicle.rig is None:
        remedy = "load a vehicle with an asset"
        raise InputError(f"{clip.vehicle.name} has no asset", remedy, subject=f"obstacle {name!r}")
    return Moving(name, clip)


def footprint(vehicle: Any) -> Array:
    """A vehicle's collision hulls seen from above, as one convex polygon (k, 2) m in the rig root's frame.

    Without an asset it is a point (1, 2).
    """
    return np.zeros((1, 2)) if vehicle.rig is None else _read_footprint(*asset_of(vehicle)).copy()


def vertical_reach(vehicle: Any) -> tuple[float, float]:
    """Lowest and highest point of a vehicle's collision hulls relative to its root, m."""
    if vehicle.rig is None:
        return 0.0, 1e-3
    z = np.concatenate([hull[:, 2] for hull in hulls_of(vehicle)])
    return float(z.min()), float(z.max())


def hulls_of(vehicle: Any) -> tuple[Array, ...]:
    """The collision hulls (n, 3) m of a vehicle's asset, in its rig root's frame; none without an asset."""
    return () if vehicle.rig is None else _read_hulls(*asset_of(vehicle))


def asset_of(vehicle: Any) -> tuple[Path, str | None, Stamp]:
    """The file, its root prim, and the time and size of its last change: the key of what is read from it."""
    return Path(vehicle.rig.asset), vehicle.rig.root or None, stamp(vehicle.rig.asset)


@lru_cache(maxsize=32)
def _read_hulls(asset: Path, root: str | None, written: Stamp) -> tuple[Array, ...]:
    from vehsim.rig.parts import collision_hulls

    return tuple(collision_hulls(asset, root))


@lru_cache(maxsize=32)
def _read_footprint(asset: Path, root: str | None, written: Stamp) -> Array:
    return seen_from_above(np.vstack(_read_hulls(asset, root, written)))


def seen_from_above(points: Array) -> Array:
    """The outline (k, 2) of points (n, 3), convex and counter-clockwise."""
    flat = points[:, :2]
    return kept_arrays("footprint", [flat], lambda: [convex_hull(flat)])[0]


def check_obstacles(obstacles: Sequence[Obstacle | Moving]) -> tuple[Obstacle | Moving, ...]:
    """The obstacles, each with a different name."""
    names: set[str] = set()
    for obstacle in obstacles:
        if not isinstance(obstacle, Obstacle | Moving):
            remedy = "make one with vehsim.world.obstacles: polygon, ellipse, box, mesh or moving"
            raise InputError("not an obstacle", remedy, key="obstacles", value=obstacle)
        if obstacle.name in names:
            raise InputError("a name is used twice", "give each its own", key="obstacles", value=obstacle.name)
        names.add(obstacle.name)
    return tuple(obstacles)


def _thickness(points: Array) -> float:
    """The smallest extent of points (n, 3) m over all directions."""
    centred = points - points.mean(axis=0)
    return float(np.ptp(centred @ np.linalg.svd(centred, full_matrices=False)[2].T, axis=0).min())


def _prism(
    name: str, parts: tuple[Shape, ...], outline: Array, pieces: Sequence[Array], height: float, base: float
) -> Obstacle:
    """A solid over ``outline`` (k, 2), which is the union of convex ``pieces``."""
    if not (np.isfinite([height, base]).all() and height > 0):
        remedy = "give a height above zero and a finite base, in m"
        raise InputError("not a height", remedy, key="height", value=height, subject=f"obstacle {name!r}")
    levels = (base, base + height)
    hulls = tuple(np.vstack([np.column_stack([piece, np.full(len(piece), z)]) for z in levels]) for piece in pieces)
    bevel = min(BEVEL, height / 4, float(np.linalg.norm(np.roll(outline, -1, axis=0) - outline, axis=1).min()) / 4)
    rings = ((outline, base), (outline, levels[1] - bevel), (_inset(outline, bevel), levels[1]))
    points = np.vstack([np.column_stack([ring, np.full(len(ring), z)]) for ring, z in rings])
    return Obstacle(name, parts, *levels, hulls, points, _prism_faces(outline, pieces))


def _inset(outline: Array, by: float) -> Array:
    """The outline (k, 2) with its edges moved inwards."""
    step = np.roll(outline, -1, axis=0) - outline
    step /= np.linalg.norm(step, axis=1, keepdims=True)
    inward = np.column_stack([-step[:, 1], step[:, 0]])
    before = np.roll(inward, 1, axis=0)
    along = (inward + before) / np.maximum(1 + (inward * before).sum(axis=1, keepdims=True), 0.2)
    return np.asarray(outline + by * along)


def _prism_faces(outline: Array, pieces: Sequence[Array]) -> NDArray[np.int64]:
    """Triangles of the prism's sides, bevel, bottom and top, outwards; the rings of corners follow each other."""
    k = len(outline)
    faces = []
    for i in range(2 * k):
        j = i + 1 if (i + 1) % k else i + 1 - k
        faces += [(i, j, k + j), (i, k + j, k + i)]
    for piece in pieces:
        corner = [int(np.argmin(((outline - p) ** 2).sum(axis=1))) for p in piece]
        for a, b in pairwise(corner[1:]):
            faces += [(corner[0], b, a), (2 * k + corner[0], 2 * k + a, 2 * k + b)]
    return np.array(faces, np.int64)


def _read_mesh(path: Path) -> tuple[Array, NDArray[np.int64]]:
    """Vertices (n, 3) m, merged, and triangles (m, 3) of a mesh file."""
    from vehsim.intake.meshes import read_triangles

    points, faces = read_triangles(path)
    import igl

    welded, _, _, faces = igl.remove_duplicate_vertices(points, faces, 1e-7)
    return welded, faces


def _bodies(points: Array, faces: NDArray[np.int64]) -> list[tuple[Array, NDArray[np.int64]]]:
    """The vertices and faces of each connected body."""
    import igl

    label = igl.vertex_components(faces)[faces[:, 0]]
    bodies = []
    for k in np.unique(label):
        used, own = np.unique(faces[label == k], return_inverse=True)
        bodies.append((points[used], own.reshape(-1, 3)))
    return bodies


def _turned(degrees: float) -> Array:
    """Rotation (2, 2) by an angle in degrees."""
    c, s = np.cos(np.deg2rad(degrees)), np.sin(np.deg2rad(degrees))
    return np.array([[c, -s], [s, c]])


def _numbers(name: str, key: str, value: ArrayLike, size: int) -> Array:
    try:
        numbers = np.array(value, dtype=float)
    except (TypeError, ValueError):
        numbers = np.empty(0)
    if numbers.shape != (size,) or not np.isfinite(numbers).all():
        raise InputError("not numbers", f"give {size} finite ones", key=key, value=value, subject=f"obstacle {name!r}")
    return numbers
