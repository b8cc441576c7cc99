"""The water's surface in a shot: a mesh whose points move, with normals, foam and the wakes of floating vehicles.

One layer, ``layers/water.usdc``. Its grid is fine around the vehicles' paths and coarser towards the horizon. The grid
is fixed in the world, so that it does not slide over the surface; it has as many points as `BYTES_A_SECOND` permits.
`wake.py` computes wakes and foam, `pictures/water.py` draws the surface in the preview.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from vehsim.exporters.usd.metadata import author_stage_metadata
from vehsim.exporters.usd.scenery.wake import Floating, Foam, Wake, clip_matrices, clip_places
from vehsim.exporters.usd.scenery.water_material import author_coordinates, author_foam, bind_material, set_foam
from vehsim.exporters.usd.stage import WATER_GRID
from vehsim.world.water.hull_mesh import wetted

if TYPE_CHECKING:
    from vehsim.clip.clip import Clip
    from vehsim.delivery.take import Take

Array = NDArray[np.float64]

BYTES_A_SECOND = 8e6
"""Bytes per second of motion: 80 MB for ten seconds, at any frame rate."""
BYTES_A_POINT = 12 + 6 + 2 + 2
"""Bytes per point: points in float, normals, foam and `LOWERED` in half precision."""
MOST_POINTS = 20_000
FINE_BORDER = 6.0
"""Margin of the fine grid around the vehicles' paths and the nearest cameras, m."""
SEEN = 30.0
"""Cameras closer than this to a path extend the fine grid, m."""
HORIZON = 1500.0
"""Distance of the surface's edge beyond the fine grid, m."""
BEYOND = 10.0
"""Width within which a liquid solver's water falls to its level beyond its grid, m."""
GROWTH = 1.32
"""Ratio of neighbouring cells beyond the fine grid."""
CARRIED = (2.0, 4.0)
"""Cells per wave: from the second on, the mesh carries a wave as it is; below the first, it shows none of it."""
RESOLVED = 1.6
"""Cells longer than this show less of a surface whose waves are unknown, so that distant water is not jagged, m."""
LOWERED = "lowered"
"""Primvar: by how much the surface was lowered to be hidden inside a hull, m."""
SKIN = 0.03
"""Depth of lowered water below a hull's skin, m."""
FALLS = 8
"""Number of steps in which water is lowered inside a hull."""


@dataclass(frozen=True)
class Grid:
    """Points ``origin + u e_u + v e_v``: ``u`` (cols,), ``v`` (rows,) m; ``axes`` (2, 2) rows are e_u, e_v."""

    u: Array
    v: Array
    origin: Array
    axes: Array

    @property
    def xy(self) -> Array:
        """(rows * cols, 2) m, row after row."""
        across = np.stack(np.meshgrid(self.u, self.v), axis=-1).reshape(-1, 2)
        return np.asarray(self.origin + across @ self.axes)

    @property
    def cells(self) -> Array:
        """The longer side (n,) m of the cell about each point."""
        across = np.meshgrid(np.gradient(self.u), np.gradient(self.v))
        return np.maximum(*across).ravel()

    @property
    def shape(self) -> tuple[int, int]:
        return len(self.v), len(self.u)

    def shape_of(self, points: Array) -> tuple[Array, Array]:
        """Unit normals (n, 3) of points (n, 3) that the grid moved to, and the curvature (n,) of their height."""
        net: Any = points.reshape(*self.shape, 3)
        along_v, along_u = (np.gradient(net, at, axis=axis) for axis, at in enumerate((self.v, self.u)))
        normals = np.cross(along_u, along_v).reshape(-1, 3)
        curvature = np.gradient(along_u[..., 2], self.u, axis=1) + np.gradient(along_v[..., 2], self.v, axis=0)
        return normals / np.linalg.norm(normals, axis=1, keepdims=True), curvature.ravel()


def write_water(take: Take, folder: Path) -> list[Path]:
    """Write ``layers/water.usdc`` below ``folder`` if the take's world has water; returns the files, the layer
    first."""
    from pxr import Gf, Sdf, Usd, UsdGeom, Vt

    water = take.world.water
    if water is None:
        return []
    path = folder / "layers" / "water.usdc"
    path.parent.mkdir(parents=True, exist_ok=True)
    stage = Usd.Stage.CreateNew(str(path))
    layer = stage.GetRootLayer()
    author_stage_metadata(layer, take.fps, take.frames)
    stage.SetDefaultPrim(UsdGeom.Xform.Define(stage, "/water").GetPrim())
    grid = lay_grid(take)
    rows, cols = grid.shape
    mesh = UsdGeom.Mesh.Define(stage, "/water/surface")
    mesh.CreateSubdivisionSchemeAttr(UsdGeom.Tokens.none)
    mesh.SetNormalsInterpolation(UsdGeom.Tokens.vertex)
    faces = quads(rows, cols)
    mesh.CreateFaceVertexCountsAttr(Vt.IntArray.FromNumpy(np.full(len(faces), 4, np.int32)))
    mesh.CreateFaceVertexIndicesAttr(Vt.IntArray.FromNumpy(faces.astype(np.int32).ravel()))
    mesh.GetPrim().CreateAttribute(WATER_GRID, Sdf.ValueTypeNames.Int2).Set(Gf.Vec2i(rows, cols))
    primvars = UsdGeom.PrimvarsAPI(mesh)
    for name in ("foam", LOWERED):
        primvars.CreatePrimvar(name, Sdf.ValueTypeNames.HalfArray, UsdGeom.Tokens.vertex)
    primvars.CreatePrimvar("normals", Sdf.ValueTypeNames.Normal3hArray, UsdGeom.Tokens.vertex)
    points, extent = mesh.CreatePointsAttr(), mesh.CreateExtentAttr()
    author_foam(mesh)
    author_coordinates(mesh, grid.xy)
    picture = bind_material(stage, mesh, folder)
    _set_points(points.Set, extent.Set, np.column_stack([grid.xy, np.full(len(grid.xy), water.level)]))
    frames = np.arange(take.frames[0], take.frames[1] + 1, dtype=float)
    for frame, (place, normals, foam, lowered) in zip(frames.tolist(), surfaces(take, grid, frames), strict=True):
        points_at, extent_at = (partial(layer.SetTimeSample, each.GetPath(), frame) for each in (points, extent))
        _set_points(points_at, extent_at, place)
        halves = Vt.Vec3hArray.FromNumpy(normals.astype(np.float16))
        layer.SetTimeSample("/water/surface.primvars:normals", frame, halves)
        for name, values in (("foam", foam), (LOWERED, lowered)):
            halves = Vt.HalfArray.FromNumpy(values.astype(np.float16))
            layer.SetTimeSample(f"/water/surface.primvars:{name}", frame, halves)
        set_foam(layer, "/water/surface", frame, place, foam)
    layer.Save()
    return [path, picture]


def _set_points(points: Callable[[Any], Any], extent: Callable[[Any], Any], place: Array) -> None:
    """Set points (n, 3) and their extent, at a frame, or as the default: the water at rest."""
    from pxr import Vt

    single = place.astype(np.float32)
    points(Vt.Vec3fArray.FromNumpy(single))
    extent(Vt.Vec3fArray.FromNumpy(np.stack([single.min(axis=0), single.max(axis=0)])))


def surfaces(take: Take, grid: Grid, frames: Array) -> Iterator[tuple[Array, Array, Array, Array]]:
    """Points (n, 3) m, unit normals (n, 3), foam (n,) and how far they were `LOWERED` (n,) m, for every frame."""
    water, fps, xy = take.world.water, float(take.fps), grid.xy
    assert water is not None
    afloat = floating(take, frames)
    wake = Wake(afloat, water.level, frames, fps) if afloat else None
    foam = Foam(afloat, xy, frames, fps)
    raised = wake.heights() if wake is not None else iter(np.zeros((len(frames), 1, 1)))
    start = min((clip.start_frame for clip in take.clips.values()), default=take.frames[0])
    sea = _undisturbed(water, xy, grid.cells)
    for k, (frame, field) in enumerate(zip(frames.tolist(), raised, strict=True)):
        points = sea((frame - start) / fps)
        if wake is not None:
            points[:, 2] += wake.at(field, points[:, :2])
        normals, curvature = grid.shape_of(points)
        steep = np.hypot(normals[:, 0], normals[:, 1]) / normals[:, 2]
        white = np.clip(foam.step(k, curvature, steep), 0.0, 1.0)
        lowered = _into_hulls(afloat, points, grid.cells, frame)
        points[:, 2] -= lowered
        yield points, normals, white, lowered


def _undisturbed(water: Any, xy: Array, cells: Array) -> Callable[[float], Array]:
    """The water's own surface as a function of time [s]: places (n, 3) m of the points with rest positions (n, 2), on
    a mesh with ``cells`` (n,) m.

    As in Gerstner's waves, points move horizontally, so that crests are sharp; phases are computed once. Each wave
    fades where the mesh cannot carry it.
    """
    from vehsim.world.water.water import Waves

    waves = water.surface
    if water.grids is not None:
        inside = np.clip(xy, water.grids.lower, water.grids.upper)
        share = np.maximum(0.0, 1.0 - np.hypot(*(xy - inside).T) / BEYOND) * np.minimum(1.0, RESOLVED / cells)
        return lambda t: np.column_stack([xy, water.level + share * (water.height(inside, t) - water.level)])
    if not isinstance(waves, Waves):
        return lambda t: np.column_stack([xy, water.height(xy, t)])
    theta = xy @ waves.number.T + waves.phase
    least, most = CARRIED
    wavelengths = 2 * np.pi / np.hypot(*waves.number.T)
    carried = np.clip((wavelengths / cells[:, None] - least) / (most - least), 0.0, 1.0)
    cos, sin = carried * np.cos(theta), carried * np.sin(theta)
    direction = waves.number / np.hypot(*waves.number.T)[:, None]

    def at(t: float) -> Array:
        turn = np.exp(1j * waves.omega * t) * waves.amplitude  # cos(theta - w t), sin(theta - w t)
        shift = waves.choppiness * direction
        z = cos @ turn.real + sin @ turn.imag
        drift = sin @ (turn.real[:, None] * shift) - cos @ (turn.imag[:, None] * shift)
        return np.column_stack([xy - drift, water.level + z])

    return at


def floating(take: Take, frames: Array) -> dict[str, Floating]:
    """The floating vehicles of a take, and their immersion on ``frames``."""
    from vehsim.world.water.buoyancy import Afloat

    found: dict[str, Floating] = {}
    for name, clip in take.clips.items():
        if getattr(clip.vehicle, "hull", None) is None or not len(clip):
            continue
        afloat = Afloat(clip.vehicle, take.world)
        height, _ = afloat.floating()
        points, _ = afloat.mesh.quadratic
        low = points[points[:, 2] < -height + 0.15]  # the hull near and below its waterline
        x0, x1 = float(low[:, 0].min()), float(low[:, 0].max())
        centre = (x0 + x1) / 2 + float(clip.vehicle.origin[0])
        hull = afloat.mesh.points + clip.vehicle.origin, afloat.mesh.faces
        wet = _borne(afloat, clip, frames)
        found[name] = Floating(clip, afloat.rest_volume, x1 - x0, float(np.ptp(low[:, 1])), centre, hull, wet)
    return found


def _borne(afloat: Any, clip: Clip, frames: Array) -> Array:
    """Share (n,) of a vehicle's weight on the water on frames, 0 to 1."""
    if clip.twists.shape[1] != 6:
        return np.ones(len(frames))
    times = (frames - clip.start_frame) / float(clip.fps)
    T_wr = clip_matrices(clip, frames)
    points, faces = afloat.mesh.quadratic
    local = points + clip.vehicle.origin
    wet = []
    for t, pose in zip(times.tolist(), T_wr, strict=True):
        world = local @ pose[:3, :3].T + pose[:3, 3]
        depth = afloat.water.height(world[:, :2], t) - world[:, 2]
        volume = wetted(np.column_stack([local, depth]), faces).volume(pose[2, :3])
        wet.append(float(np.clip(volume / afloat.rest_volume, 0.0, 1.0)))
    return np.array(wet)


def lay_grid(take: Take) -> Grid:
    """A grid along the vehicles' path: even near them, growing towards the horizon."""
    places = [_on_take(clip, take) for clip in take.clips.values()] or [np.zeros((1, 2))]
    path = np.concatenate(places)
    eyes = [camera.positions[:, :2] for camera in take.cameras]
    near = [
        eye
        for eye in eyes
        if np.linalg.norm(eye[:, None] - path[None, :: max(1, len(path) // 50)], axis=2).min() < SEEN
    ]
    seen = np.concatenate([path, *(eye[:: max(1, len(eye) // 50)] for eye in near)])
    middle = path.mean(axis=0)
    spread = np.linalg.svd(path - middle, full_matrices=False)[2][0] if np.ptp(path) > 1.0 else np.array([1.0, 0.0])
    axes = np.array([spread, [-spread[1], spread[0]]])
    local = (seen - middle) @ axes.T
    low, high = local.min(axis=0) - FINE_BORDER, local.max(axis=0) + FINE_BORDER
    count = min(MOST_POINTS, int(BYTES_A_SECOND / BYTES_A_POINT / float(take.fps)))
    spacing = 0.2
    while True:
        u, v = (_graded(low[k], high[k], spacing) for k in range(2))
        if len(u) * len(v) <= count:
            return Grid(u, v, middle, axes)
        spacing *= 1.03


def _graded(low: float, high: float, spacing: float) -> Array:
    """Coordinates from ``HORIZON`` before ``low`` to ``HORIZON`` after ``high``: even between, growing outside."""
    inner = np.linspace(low, high, max(2, int(np.ceil((high - low) / spacing)) + 1))
    steps: list[float] = []
    reach = 0.0
    while reach < HORIZON:
        steps.append((inner[1] - inner[0]) * GROWTH ** (len(steps) + 1))
        reach += steps[-1]
    outer = np.cumsum(steps)
    return np.concatenate([low - outer[::-1], inner, high + outer])


def _on_take(clip: Clip, take: Take) -> Array:
    frames = np.arange(take.frames[0], take.frames[1] + 1, dtype=float)
    return clip_places(clip, frames)[0][:, :2]


def _into_hulls(afloat: dict[str, Floating], points: Array, cells: Array, frame: float) -> Array:
    """Depth (n,) m by which the surface's points (n, 3) must be lowered to be hidden below the bottoms of hulls.

    Points within a cell of a hull's skin stay, so that the waterline on it is the water's own.
    """
    import igl

    lowered = np.zeros(len(points))
    for vehicle in afloat.values():
        if vehicle.hull is None:
            continue
        corners, faces = vehicle.hull
        T_wr = clip_matrices(vehicle.clip, np.array([frame]))[0]
        R_wr, own = T_wr[:3, :3], (points - T_wr[:3, 3]) @ T_wr[:3, :3]
        near = np.flatnonzero(((own > corners.min(axis=0)) & (own < corners.max(axis=0))).all(axis=1))
        if not len(near):
            continue
        depth = np.sqrt(igl.point_mesh_squared_distance(own[near], corners, faces)[0])
        deep = depth > cells[near]
        near, depth = near[deep], depth[deep]
        # Summed triangle by triangle: signed_distance's own, fast winding number was wrong on one machine.
        inside = np.array([igl.winding_number(corners, faces, point) > 0.5 for point in own[near]], bool)
        near, depth = near[inside], depth[inside]
        for _ in range(FALLS):  # moving by the distance to the nearest skin keeps a point inside
            if not len(near):
                break
            lowered[near] += np.maximum(depth - SKIN, 0.0)
            below = own[near] - lowered[near, None] * R_wr[2]
            depth = np.sqrt(igl.point_mesh_squared_distance(below, corners, faces)[0])
    return lowered


def quads(rows: int, cols: int) -> NDArray[np.int64]:
    """(m, 4) corners of the cells, counter-clockwise from above."""
    index = np.arange(rows * cols).reshape(rows, cols)
    return np.stack([index[:-1, :-1], index[:-1, 1:], index[1:, 1:], index[1:, :-1]], axis=-1).reshape(-1, 4)
