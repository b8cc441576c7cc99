"""The distance field: how far every point is from the rock, smooth enough for an optimiser and a route.

Exact signed distances to the terrain's triangles on a grid become a cubic B-spline that passes through them: C2, cheap,
and the same in numpy and in CasADi. Fields are cached by content. Hulls are measured in `scene.py`, not here.
"""

from __future__ import annotations

import hashlib
import io
import os
import tempfile
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from vehsim._cache import cache_folder as cache_folder
from vehsim.errors import InputError, Problem
from vehsim.world.terrain import Terrain

Array = NDArray[np.float64]
Progress = Callable[[str, float], None]

VERSION = 2
"""Part of every cached field's name: raise it when the same terrain would give another field."""
POINTS = 1_200_000
"""Grid points a field has at most unless its spacing is given: about three seconds on two cores."""
FINEST = 0.5
"""Smallest spacing chosen by itself, m."""
HEADROOM, DEPTH = 12.0, 4.0
"""How far the field's box reaches above the highest and below the lowest rock, m."""

SEAL = 32
"""Bytes of checksum that end a cached field: a power cut can leave a file of the right size full of zeros."""
BLEND = 1e-3
"""Rounds the distance beyond the box at its border, m, so that it has derivatives there."""


@dataclass(frozen=True, eq=False)
class DistanceField:
    """Signed distance to the terrain, m: positive in the air, negative in the rock.

    ``distances`` (nx, ny, nz) m stand ``spacing`` m apart from ``lower`` (3,) on; between them is a cubic B-spline.
    Beyond the box the value is the nearest box point's, less the distance outside through the sides or the bottom, so
    that no optimiser gains by leaving there. Through the top nothing is subtracted: distance to the ground only grows.
    """

    distances: NDArray[np.float32]
    lower: Array
    spacing: float

    @property
    def upper(self) -> Array:
        """(3,) m: the far corner of the box."""
        return self.lower + self.spacing * (np.array(self.distances.shape) - 1)

    def crop(self, lower: ArrayLike, upper: ArrayLike) -> DistanceField:
        """The field of a smaller box that holds ``lower..upper`` (3,) m: quicker to hand to an optimiser."""
        shape = np.array(self.distances.shape)
        first = np.floor((np.asarray(lower, float) - self.lower) / self.spacing).astype(int) - 2
        last = np.ceil((np.asarray(upper, float) - self.lower) / self.spacing).astype(int) + 3
        first = np.clip(first, 0, shape - 4)
        last = np.clip(last, first + 4, shape)
        part = tuple(slice(a, b) for a, b in zip(first, last, strict=True))
        return DistanceField(self.distances[part], self.lower + self.spacing * first, self.spacing)

    @cached_property
    def _coefficients(self) -> Array:
        """B-spline coefficients (nx + 2, ny + 2, nz + 2); mirrored ends."""
        from scipy.ndimage import spline_filter

        return np.pad(spline_filter(self.distances.astype(float), order=3, mode="mirror"), 1, mode="reflect")

    def value(self, points: ArrayLike) -> Array:
        """Signed distance (n,) m at ``points`` (n, 3) m."""
        from scipy.ndimage import map_coordinates

        points = np.asarray(points, dtype=float).reshape(-1, 3)
        inside = np.clip(points, self.lower, self.upper)
        index = (inside - self.lower) / self.spacing + 1
        spline = map_coordinates(self._coefficients, index.T, order=3, prefilter=False, mode="nearest")
        outside = points - inside
        outside[:, 2] = np.minimum(outside[:, 2], 0)
        return np.asarray(spline - (np.sqrt(np.sum(outside**2, axis=1) + BLEND**2) - BLEND))

    def models(self, count: int, order: int = 2) -> Any:
        """A casadi ``Function``, points (3, count) -> value, gradient, Hessian (xx, yy, zz, xy, xz, yz) (10, count).

        Derivatives up to ``order``, zeros beyond. Two or three us a point, where differentiating `function` takes 35:
        coefficients are gathered for all at once.
        """
        import casadi

        place, evaluate, table = self._kernels[order]
        points = casadi.MX.sym("points", 3, count)
        gathered = casadi.reshape(table.get_nz(False, casadi.vec(place.map(count)(points))), 64, count)
        known = evaluate.map(count)(points, gathered)
        beyond = casadi.DM.zeros(10 - known.shape[0], count)
        return casadi.Function("models", [points], [casadi.vertcat(known, beyond)])

    @cached_property
    def _kernels(self) -> list[Any]:
        """By order: where a point's 64 coefficients stand, what they give there, and the table of all of them."""
        import casadi

        shape = self._coefficients.shape
        strides = (1, shape[0], shape[0] * shape[1])
        near = [sum(s * i for s, i in zip(strides, at, strict=True)) for at in np.ndindex(4, 4, 4)]
        point, coefficients = casadi.SX.sym("point", 3), casadi.SX.sym("c", 64)
        inside = casadi.fmin(casadi.fmax(point, self.lower), self.upper)
        index = (inside - self.lower) / self.spacing
        first = casadi.fmax(casadi.fmin(casadi.floor(index), casadi.DM(shape) - 4), 0)
        place = casadi.Function("place", [point], [casadi.dot(first, casadi.DM(strides)) + casadi.DM(near)])
        values = _second_order(self, point, inside, index - first, coefficients)
        table = casadi.MX(casadi.DM(self._coefficients.ravel(order="F")))
        rows = [casadi.cse(values[:rows]) for rows in (1, 4, 10)]
        return [(place, casadi.Function("evaluate", [point, coefficients], [row]), table) for row in rows]

    @cached_property
    def function(self) -> Any:
        """``distance``: a casadi ``Function``, point (3,) m -> signed distance m; it agrees with `value`."""
        import casadi

        shape = np.array(self._coefficients.shape)
        knots = [(np.arange(n + 4) - 3.0).tolist() for n in shape]
        coefficients = self._coefficients.ravel(order="F").tolist()
        spline = casadi.Function.bspline("spline", knots, coefficients, [3, 3, 3], 1, {"lookup_mode": ["exact"] * 3})
        point = casadi.MX.sym("point", 3)
        inside = casadi.fmin(casadi.fmax(point, self.lower), self.upper)
        outside = point - inside
        outside = casadi.vertcat(outside[0], outside[1], casadi.fmin(outside[2], 0))
        beyond = casadi.sqrt(casadi.sumsqr(outside) + BLEND**2) - BLEND
        return casadi.Function("distance", [point], [spline((inside - self.lower) / self.spacing) - beyond])


def _second_order(field: DistanceField, point: Any, inside: Any, share: Any, coefficients: Any) -> Any:
    """Value, gradient and Hessian (10,) of the spline in the cell with these 64 coefficients, less what is beyond."""
    import casadi

    t = casadi.SX.sym("t")
    basis = casadi.vertcat((1 - t) ** 3, 3 * t**3 - 6 * t**2 + 4, -3 * t**3 + 3 * t**2 + 3 * t + 1, t**3) / 6
    orders = [basis, casadi.jacobian(basis, t), casadi.jacobian(casadi.jacobian(basis, t), t)]
    weights = casadi.Function("weights", [t], orders)
    # a point beyond the box sees its nearest point in it, which does not move along with it
    moves = casadi.if_else(inside == point, 1 / field.spacing, 0)
    along = [[w * moves[a] ** order for order, w in enumerate(weights(share[a]))] for a in range(3)]
    cube = casadi.reshape(coefficients, 16, 4)  # of `np.ndindex(4, 4, 4)`: z runs fastest, then y
    parts = {}
    for i, j, k in (
        (0, 0, 0),
        (1, 0, 0),
        (0, 1, 0),
        (0, 0, 1),
        (2, 0, 0),
        (0, 2, 0),
        (0, 0, 2),
        (1, 1, 0),
        (1, 0, 1),
        (0, 1, 1),
    ):
        plane = casadi.reshape(cube @ along[0][i], 4, 4)
        parts[i, j, k] = casadi.dot(along[2][k], plane @ along[1][j])
    outside = point - inside
    outside = casadi.vertcat(outside[0], outside[1], casadi.fmin(outside[2], 0))
    beyond = casadi.sqrt(casadi.sumsqr(outside) + BLEND**2) - BLEND
    bend, slope = casadi.hessian(beyond, point)
    upper = casadi.vertcat(bend[0, 0], bend[1, 1], bend[2, 2], bend[0, 1], bend[0, 2], bend[1, 2])
    return casadi.vertcat(*parts.values()) - casadi.vertcat(beyond, slope, upper)


def distance_field(
    terrain: Terrain,
    spacing: float | None = None,
    box: ArrayLike | None = None,
    progress: Progress | None = None,
) -> DistanceField:
    """The field of ``terrain``, from the cache or built now.

    ``spacing`` m between grid points (chosen by `POINTS` when None); ``box`` (2, 3) m restricts the field to a part of
    the terrain; ``progress`` is told what is done and the fraction. Raises ``InputError``.
    """
    lower, upper = _box(terrain, box)
    volume = float(np.prod(np.maximum(upper - lower, 1e-9)))
    step = max(FINEST, (volume / POINTS) ** (1 / 3)) if spacing is None else float(spacing)
    shape = np.maximum(np.ceil((upper - lower) / step).astype(int) + 1, 4) if step > 0 else np.zeros(3, int)
    if not np.isfinite(step) or step <= 0 or np.prod(shape, dtype=float) > 20 * POINTS:
        mend = "give a spacing of about a metre"
        raise InputError(str(Problem("spacing", "not a spacing for this terrain", mend, spacing, terrain.name)))
    key = hashlib.sha256(
        repr((VERSION, terrain.content_hash, lower.tolist(), shape.tolist(), step)).encode()
    ).hexdigest()
    file = cache_folder() / f"distance-{key[:32]}.npy"
    distances = _read(file, tuple(shape.tolist()))
    if distances is None:
        distances = _measure(terrain, lower, shape, step, progress)
        _write(file, distances)
    return DistanceField(distances, lower, step)


def _box(terrain: Terrain, box: ArrayLike | None) -> tuple[Array, Array]:
    """The corners (3,), (3,) of the field's box."""
    lower, upper = terrain.lower - np.array([0, 0, DEPTH]), terrain.upper + np.array([0, 0, HEADROOM])
    if box is None:
        return lower, upper
    wanted = np.asarray(box, dtype=float)
    if wanted.shape != (2, 3) or not np.isfinite(wanted).all() or (wanted[1] <= wanted[0]).any():
        mend = "give its lower and upper corner, each x, y, z in metres"
        raise InputError(str(Problem("box", "not a box", mend, wanted.tolist(), terrain.name)))
    lower, upper = np.maximum(lower, wanted[0]), np.minimum(upper, wanted[1])
    if (upper <= lower).any():
        mend = f"the terrain reaches from {terrain.lower} to {terrain.upper}"
        raise InputError(str(Problem("box", "lies beside the terrain", mend, wanted.tolist(), terrain.name)))
    return lower, upper


def _measure(
    terrain: Terrain, lower: Array, shape: NDArray[np.int64], step: float, progress: Progress | None
) -> NDArray[np.float32]:
    """Exact signed distances (nx, ny, nz) m on the grid."""
    import igl

    vertices, faces = np.ascontiguousarray(terrain.vertices), np.ascontiguousarray(terrain.faces)
    tree = igl.AABB()
    tree.init(vertices, faces)
    x, y, z = (lower[k] + step * np.arange(shape[k]) for k in range(3))
    distances = np.empty(tuple(shape), dtype=np.float32)
    slabs = np.array_split(np.arange(shape[0]), min(16, shape[0]))
    for done, slab in enumerate(slabs):
        points = np.stack(np.meshgrid(x[slab], y, z, indexing="ij"), axis=-1).reshape(-1, 3)
        squared, _, _ = tree.squared_distance(vertices, faces, points)
        ground = np.repeat(terrain.height(points[:: shape[2], :2]), shape[2])
        signed = np.where(points[:, 2] >= ground, 1.0, -1.0) * np.sqrt(squared)
        distances[slab] = signed.reshape(len(slab), shape[1], shape[2])
        if progress is not None:
            progress("measuring distances to the terrain", (done + 1) / len(slabs))
    return distances


def _read(file: Path, shape: tuple[int, ...]) -> NDArray[np.float32] | None:
    """The cached array, or None when there is none or it is damaged."""
    if not file.exists():
        return None
    try:
        content = file.read_bytes()
        body, seal = content[:-SEAL], content[-SEAL:]
        if hashlib.sha256(body).digest() != seal:
            raise ValueError("its checksum does not match")
        array = np.load(io.BytesIO(body), allow_pickle=False)
        if array.shape != shape or array.dtype != np.float32 or not np.isfinite(array).all():
            raise ValueError("not what was written")
    except (OSError, ValueError, EOFError) as error:
        warnings.warn(f"{file}: damaged cache entry ({error}), measuring again", stacklevel=2)
        return None
    return np.asarray(array)


def _write(file: Path, array: NDArray[np.float32]) -> None:
    """Write beside, with a checksum, then move into place: readers and other writers never see half a file."""
    body = io.BytesIO()
    np.save(body, array)
    try:
        file.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.NamedTemporaryFile(dir=file.parent, prefix=file.stem, suffix=".part", delete=False) as beside:
            beside.write(body.getvalue() + hashlib.sha256(body.getvalue()).digest())
            beside.flush()
            os.fsync(beside.fileno())
        os.replace(beside.name, file)
    except OSError as error:
        warnings.warn(f"{file}: the distance field could not be cached ({error})", stacklevel=2)
