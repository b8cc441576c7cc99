"""The water's surface in a shot: a mesh whose points move, with normals, foam and the wakes of floating vehicles.

One layer, ``layers/water.usdc``. `water_grid.py` lays its grid, `wake.py` computes wakes and their foam,
`pictures/water.py` draws the surface in the preview.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from functools import partial
from itertools import repeat
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from vehsim.exporters.usd.metadata import author_origin, author_stage_metadata
from vehsim.exporters.usd.scenery.distant_waves import (
    author_waves,
    carried,
    distant_waves,
    first_frame,
    unseen_slopes,
)
from vehsim.exporters.usd.scenery.spray import Drops, Spray, author_spray
from vehsim.exporters.usd.scenery.wake import Floating, Foam, Raised, Wake, clip_matrices
from vehsim.exporters.usd.scenery.water_grid import Grid, lay_grid
from vehsim.exporters.usd.scenery.water_material import (
    TILE,
    author_coordinates,
    author_foam,
    bind_material,
    patches,
    set_foam,
)
from vehsim.exporters.usd.scenery.waterline import warn_of_coarse, waterline
from vehsim.exporters.usd.stage import WATER_ROWS
from vehsim.world.water.hull_mesh import wetted
from vehsim.world.water.water import Water, Waves

if TYPE_CHECKING:
    from vehsim.clip.clip import Clip
    from vehsim.delivery.take import Take
    from vehsim.world.water.whitecaps import Breaking, Whitecaps

Array = NDArray[np.float64]

BEYOND = 10.0
"""Width within which a liquid solver's water falls to its level beyond its grid, m."""
RESOLVED = 1.6
"""Cells longer than this show less of a surface whose waves are unknown, so that distant water is not jagged, m."""
LOWERED = "lowered"
"""Primvar: by how much the surface was lowered to be hidden inside a hull, m."""


def write_water(take: Take, folder: Path, progress: Callable[[float], object] = lambda share: None) -> list[Path]:
    """Write ``layers/water.usdc`` below ``folder`` if the take's world has water; returns the files, the layer
    first. ``progress`` receives the share of the frames that are done."""
    from pxr import Sdf, Usd, UsdGeom, Vt

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
    mesh = UsdGeom.Mesh.Define(stage, "/water/surface")
    mesh.CreateSubdivisionSchemeAttr(UsdGeom.Tokens.none)
    mesh.SetNormalsInterpolation(UsdGeom.Tokens.vertex)
    sizes = np.repeat([4, 3], [len(faces) for faces in grid.faces]).astype(np.int32)
    mesh.CreateFaceVertexCountsAttr(Vt.IntArray.FromNumpy(sizes))
    corners = np.concatenate([faces.ravel() for faces in grid.faces]).astype(np.int32)
    mesh.CreateFaceVertexIndicesAttr(Vt.IntArray.FromNumpy(corners))
    rows = mesh.GetPrim().CreateAttribute(WATER_ROWS, Sdf.ValueTypeNames.IntArray, variability=Sdf.VariabilityUniform)
    rows.Set(Vt.IntArray.FromNumpy(grid.stored.astype(np.int32)))
    primvars = UsdGeom.PrimvarsAPI(mesh)
    for name in ("foam", LOWERED):
        primvars.CreatePrimvar(name, Sdf.ValueTypeNames.HalfArray, UsdGeom.Tokens.vertex)
    primvars.CreatePrimvar("normals", Sdf.ValueTypeNames.Normal3hArray, UsdGeom.Tokens.vertex)
    points, extent = mesh.CreatePointsAttr(), mesh.CreateExtentAttr()
    author_foam(mesh)
    near = author_coordinates(mesh, grid.xy)
    waves = distant_waves(take, grid, near)
    if waves is not None:
        author_waves(mesh, waves, TILE)
    picture = bind_material(stage, mesh, folder)
    rest = np.column_stack([grid.xy, np.full(len(grid.xy), water.level)])
    origin = author_origin(mesh, rest.mean(axis=0))
    _set_points(points.Set, extent.Set, rest - origin)
    frames = np.arange(take.frames[0], take.frames[1] + 1, dtype=float)
    frames = frames if take.usd.moving_water else frames[:1]
    spray: list[Drops] = []
    slopes = unseen_slopes(water, grid)
    for k, (frame, shown) in enumerate(zip(frames.tolist(), surfaces(take, grid, frames), strict=True)):
        place, normals, foam, lowered, drops = shown
        progress(k / len(frames))
        spray += [] if drops is None else [drops]
        points_at, extent_at = (partial(layer.SetTimeSample, each.GetPath(), frame) for each in (points, extent))
        _set_points(points_at, extent_at, place - origin)
        halves = Vt.Vec3hArray.FromNumpy(normals.astype(np.float16))
        layer.SetTimeSample("/water/surface.primvars:normals", frame, halves)
        for name, values in (("foam", foam), (LOWERED, lowered)):
            halves = Vt.HalfArray.FromNumpy(values.astype(np.float16))
            layer.SetTimeSample(f"/water/surface.primvars:{name}", frame, halves)
        set_foam(layer, "/water/surface", frame, patches(grid.xy.T, foam, grid.cells), slopes)
    if take.usd.spray:
        author_spray(stage, frames, spray, rest.mean(axis=0))
    layer.Save()
    return [path, picture]


def _set_points(points: Callable[[Any], Any], extent: Callable[[Any], Any], place: Array) -> None:
    """Set points (n, 3) and their extent, at a frame, or as the default: the water at rest."""
    from pxr import Vt

    single = place.astype(np.float32)
    points(Vt.Vec3fArray.FromNumpy(single))
    ends = [(column.min(), column.max()) for column in single.T]  # a reduction along the first axis is slow
    extent(Vt.Vec3fArray.FromNumpy(np.array(ends).T.copy()))


class Shown(NamedTuple):
    """The surface in a frame: ``points`` (n, 3) m, unit ``normals`` (n, 3), ``foam`` (n,), how far the points were
    `LOWERED` (n,) m, and the spray above, if it was wanted."""

    points: Array
    normals: Array
    foam: Array
    lowered: Array
    drops: Drops | None


def surfaces(take: Take, grid: Grid, frames: Array) -> Iterator[Shown]:
    """The surface for every frame, in their order; without wakes and foam if the take's water does not move."""
    water, fps, xy = take.world.water, float(take.fps), grid.xy
    assert water is not None
    afloat = floating(take, frames)
    warn_of_coarse(afloat, grid, frames)
    stirring = afloat if take.usd.moving_water else {}
    wake = Wake(stirring, frames, fps) if stirring else None
    trails = Foam(stirring, xy, frames, fps)
    wakes: Iterable[Raised | None] = repeat(None, len(frames)) if wake is None else wake.heights()
    start = first_frame(take)
    breaking = _breaking(take) if take.usd.moving_water else None
    sea, whitecaps = _undisturbed(water, grid), None if breaking is None else _whitecaps(take, grid, breaking)
    spray = Spray(afloat, water, breaking, grid, take.world.wind, start, fps) if take.usd.spray else None
    for k, (frame, raised) in enumerate(zip(frames.tolist(), wakes, strict=True)):
        points = sea((frame - start) / fps)
        drops = None if spray is None else spray.at(frame, points)
        if raised is not None:
            points[:, 2] += raised(points[:, :2])
        normals = grid.normals(points)
        foam = trails.at(k)
        if whitecaps is not None:
            foam = np.maximum(foam, whitecaps.at(round(frame - start)))
        line = waterline(afloat, points, grid, frame)
        points, normals, foam = line.of(points), line.of(normals), line.of(np.clip(foam, 0.0, 1.0))
        points[:, 2] -= line.lowered
        yield Shown(points, normals, foam, line.lowered, drops)


def _breaking(take: Take) -> Breaking | None:
    """How the waves of a take break; None if they do not."""
    from vehsim.world.water.whitecaps import Breaking

    waves = None if take.world.water is None else take.world.water.surface
    breaking = Breaking(waves, take.world.wind[:2]) if isinstance(waves, Waves) else None
    return breaking if breaking is not None and np.isfinite(breaking.least) else None


def _whitecaps(take: Take, grid: Grid, breaking: Breaking) -> Whitecaps:
    """The whitecaps of a take on its grid."""
    from vehsim.world.water.whitecaps import Whitecaps

    water = take.world.water
    assert water is not None
    flow: Array | float = 0.0
    if water.current is not None:
        flow = water.current.velocity(np.column_stack([grid.xy, np.zeros(len(grid.xy))]), 0.0)[:, :2]
    return Whitecaps(breaking, grid.xy, grid.triangles, 1 / float(take.fps), flow)


def _undisturbed(water: Water, grid: Grid) -> Callable[[float], Array]:
    """The water's own surface as a function of time [s]: places (n, 3) m of the points of a grid.

    As in Gerstner's waves, points move horizontally, so that crests are sharp; phases are computed once. Each wave
    fades where the mesh cannot carry it: by the points that there are for it along and across the rows.
    """
    waves, xy = water.surface, grid.xy
    if water.grids is not None:
        inside = np.clip(xy, water.grids.lower, water.grids.upper)
        share = np.maximum(0.0, 1.0 - np.hypot(*(xy - inside).T) / BEYOND) * np.minimum(1.0, RESOLVED / grid.cells)
        return lambda t: np.column_stack([xy, water.level + share * (water.height(inside, t) - water.level)])
    if not isinstance(waves, Waves):
        return lambda t: np.column_stack([xy, water.height(xy, t)])
    theta, left = xy @ waves.number.T + waves.phase, carried(waves, grid)
    cos, sin = left * np.cos(theta), left * np.sin(theta)

    def at(t: float) -> Array:
        turn = np.exp(1j * waves.omega * t) * waves.amplitude  # cos(theta - w t), sin(theta - w t)
        shift = waves.choppiness * waves.along
        z = cos @ turn.real + sin @ turn.imag
        drift = sin @ (turn.real[:, None] * shift) - cos @ (turn.imag[:, None] * shift)
        sheltered = waves.share(xy - waves.share(xy) * drift)
        return np.column_stack([xy - sheltered * drift, water.level + sheltered[:, 0] * z])

    return at


def floating(take: Take, frames: Array) -> dict[str, Floating]:
    """The floating vehicles of a take, and their immersion on ``frames``."""
    from vehsim.world.water.buoyancy import Afloat
    from vehsim.world.water.gliding import boat_of

    found: dict[str, Floating] = {}
    for name, clip in take.clips.items():
        boat = boat_of(clip.vehicle)
        if boat is None or not len(clip):
            continue
        afloat = Afloat(boat, take.world)
        height, _ = afloat.floating()
        points, _ = afloat.mesh.quadratic
        low = points[points[:, 2] < -height + 0.15]  # the hull near and below its waterline
        x0, x1 = float(low[:, 0].min()), float(low[:, 0].max())
        centre = (x0 + x1) / 2 + float(boat.origin[0])
        hull = afloat.mesh.points + boat.origin, afloat.mesh.faces
        wet = _borne(afloat, clip, frames)
        found[name] = Floating(clip, afloat.rest_volume, x1 - x0, float(np.ptp(low[:, 1])), centre, hull, wet)
    return found


def _borne(afloat: Any, clip: Clip, frames: Array) -> Array:
    """Share (n,) of a vehicle's weight on the water on frames, 0 to 1."""
    times = (frames - clip.start_frame) / float(clip.fps)
    T_wr = clip_matrices(clip, frames)
    points, faces = afloat.mesh.quadratic
    local = points + afloat.vehicle.origin
    wet = []
    for t, pose in zip(times.tolist(), T_wr, strict=True):
        world = local @ pose[:3, :3].T + pose[:3, 3]
        depth = afloat.water.height(world[:, :2], t) - world[:, 2]
        volume = wetted(np.column_stack([local, depth]), faces).volume(pose[2, :3])
        wet.append(float(np.clip(volume / afloat.rest_volume, 0.0, 1.0)))
    return np.array(wet)
