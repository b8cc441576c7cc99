"""Audit a delivery from its files: the composed stage, and the asks in its ``report.json``.

Poses, collision meshes, terrain and obstacles are read from the stage at eighths of a frame. libigl measures distances
between points on the vehicle's meshes and the triangles of the surroundings, independently of the planner's code.
"""

from __future__ import annotations

import hashlib
import warnings
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import fields, replace
from fractions import Fraction
from functools import cached_property, lru_cache
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from vehsim.audit import PER_FRAME, Row, Scene, Track, audit, missed, not_shown, track_of_poses
from vehsim.audit.scene import rolling_wheels
from vehsim.delivery.reports import reading_report
from vehsim.errors import ExportError, InputError
from vehsim.exporters.usd.metadata import Units
from vehsim.intake.polygons import has_polygons, polygons
from vehsim.intake.usd import dependencies, is_drawn
from vehsim.requests import Ask
from vehsim.rig.ops import scalar_op, slide_axis
from vehsim.runtime.progress import Progress, silent

if TYPE_CHECKING:
    from vehsim.clip.clip import Clip

Array = NDArray[np.float64]
Ints = NDArray[np.int64]

SPACING = 0.2
"""Largest distance between points on a vehicle's meshes, m."""
DISTANCES = ("clearance", "stands")
"""Measures of distances between hulls."""
TREAD = 0.15
"""Largest height above the lowest point of a wheel at which the ground may touch it, m."""
RIM = 0.03
"""Largest distance between points on a wheel's tread, m: a crest of the ground may touch it between its vertices."""
STEP = 0.5
"""The ground of a terrain with overhangs is sought from this height above a point downwards, m."""
SLICE = 32
"""Number of frames whose points are measured at once: more need more memory and are no faster."""
CELL = 0.5
"""Points on a vehicle's meshes are grouped into balls of this size, m."""


def stage_of(folder: Path, name: str) -> Path | None:
    """The stage of a delivery in any of its forms; None if there is none."""
    found = [folder / f"{name}{suffix}" for suffix in (".usda", ".flat.usdc", ".usdz")]
    return next((path for path in found if path.is_file()), None)


def root_in_prim(clip: Clip) -> Array:
    """``T_rp`` (4, 4): from a vehicle's prim to its rig root's frame, with the asset's axes and units."""
    from vehsim.exporters.usd.readback import expected_matrices

    first = replace(clip.at(clip.times[:1]), energy={})
    return np.asarray(np.linalg.inv(first.matrices()[0]) @ expected_matrices(first)[""][0])


def joints_in_rig(clip: Clip) -> dict[str, dict[str, Any]]:
    """How the rig shows a clip's joints: joint -> the ``prim`` below the root, its ``op``, the op's rising ``values``
    (k,), and the ``joint``'s (k,) that these stand for.
    """
    from pxr import UsdGeom

    from vehsim.rig.ops import drive_op, open_rig
    from vehsim.vehicles.definition.joint_channels import readings

    rig = clip.vehicle.rig
    assert rig is not None
    metres_per_unit = UsdGeom.GetStageMetersPerUnit(open_rig(rig.asset, rig)[0])
    found = {}
    for joint, (channel, values, at) in readings(clip.vehicle, clip.joints).items():
        drive = rig.drives[channel]
        op, factor = drive_op(drive.op, metres_per_unit)
        shown = values * factor * drive.factor
        order = np.argsort(shown)
        found[joint] = {"prim": drive.prim, "op": op, "values": shown[order].tolist(), "joint": at[order].tolist()}
    return found


def wheels_in_rig(clip: Clip) -> dict[str, dict[str, Any]]:
    """How the rig shows the wheels that roll: prim below the root -> the ``op`` that turns it, its ``turn`` forwards
    per unit of the op, rad, and in the prim's own axes and units its ``centre`` (3,) and ``axle`` (3,) to the left.
    """
    from vehsim.exporters.usd.readback import expected_matrices
    from vehsim.rig.ops import drive_op

    rig = clip.vehicle.rig
    assert rig is not None
    first = replace(clip.at(clip.times[:1]), energy={})
    rest = replace(first, channels={name: np.zeros(1) for name in first.channels})
    T_rw, T_wp, found = np.linalg.inv(first.matrices()[0]), expected_matrices(rest), {}
    for wheel in rolling_wheels(rig):
        drive, T_pr = rig.drives[wheel["channel"]], np.linalg.inv(T_rw @ T_wp[wheel["prim"]][0])
        op, units = drive_op(drive.op)
        found[wheel["prim"]] = {
            "prim": wheel["prim"],
            "op": op,
            "turn": wheel["gain"] / (units * drive.factor),
            "centre": _moved(T_pr, np.array([wheel["centre"]]))[0].tolist(),
            "axle": (T_pr[:3, :3] @ wheel["axle"]).tolist(),
        }
    return found


class Delivered:
    """A stage opened for auditing. Times are whole frames and eighths of frames between ``first`` and ``last``."""

    def __init__(self, path: Path, fps: Fraction, frames: tuple[int, int]) -> None:
        from pxr import Usd, UsdGeom

        self.stage = Usd.Stage.Open(str(path))
        self.root = self.stage.GetDefaultPrim()
        units = Units(str(UsdGeom.GetStageUpAxis(self.stage)), UsdGeom.GetStageMetersPerUnit(self.stage))
        self.to_metres = np.linalg.inv(units.matrix)
        self.fps, self.frames = fps, frames
        self._cache = UsdGeom.XformCache()

    def vehicle(self, name: str) -> Any:
        """A vehicle's prim. Raises ``InputError``."""
        prim = self.stage.GetPrimAtPath(f"{self.root.GetPath()}/vehicles/{name}")
        if not prim:
            raise InputError("no such vehicle in the stage", subject=name, file=self.stage.GetRootLayer().realPath)
        return prim

    def world_matrix(self, prim: Any, frame: float) -> Array:
        """A prim's world matrix (4, 4) at a frame, in metres, Z up, for column vectors."""
        self._cache.SetTime(frame)
        return np.asarray(self.to_metres @ np.array(self._cache.GetLocalToWorldTransform(prim)).T)

    def track(self, name: str, T_rp: Array, joints: Mapping[str, Mapping[str, Any]] = MappingProxyType({})) -> Track:
        """The motion of a vehicle's rig root, and of the ``joints`` that `joints_in_rig` found in its rig."""
        first, last = self.frames
        frames = first + np.arange((last - first) * PER_FRAME + 1) / PER_FRAME
        prim = self.vehicle(name)
        T_wp = np.array([self.world_matrix(prim, frame) for frame in frames.tolist()])
        shown = {joint: self._joint(prim, how, frames) for joint, how in joints.items()}
        return track_of_poses(frames, self.fps, T_wp @ np.linalg.inv(T_rp), shown)

    def _joint(self, root: Any, how: Mapping[str, Any], frames: Array) -> Array:
        """A joint (n,) at ``frames``, from the op that shows it; one without values rests at zero."""
        values = self.op(root, how, frames)
        return _through(np.array(how["values"], float), np.array(how["joint"], float), values)

    def op(self, root: Any, how: Mapping[str, Any], frames: Array) -> Array:
        """The values (n,) at ``frames`` of the ``op`` of a ``prim`` below a vehicle's; one without values is zero."""
        prim, axis = root.GetPrimAtPath(how["prim"]) if how["prim"] else root, slide_axis(how["op"])
        op = prim.GetAttribute(how["op"])
        if axis is None or not op:  # the variant of curves has numbers
            op, axis = prim.GetAttribute(scalar_op(how["op"])), None
        values = np.array([op.Get(frame) if op else 0.0 for frame in frames.tolist()], float)
        return values if axis is None else values[:, axis]

    def meshes(self, scope: Any) -> Iterable[Any]:
        """The meshes and shapes at and below a prim, including instances."""
        from pxr import Usd

        for prim in Usd.PrimRange(scope, Usd.TraverseInstanceProxies()) if scope else ():
            if has_polygons(prim):
                yield prim

    def triangles(self, prim: Any, frame: float) -> tuple[Array, Ints]:
        """A mesh's points (n, 3) m in its own prim's units and its faces (m, 3), fanned."""
        found = polygons(prim, frame, self.stage.GetRootLayer().realPath)
        if found is None:
            return np.zeros((0, 3)), np.zeros((0, 3), np.int64)
        points, counts, corners, _ = found
        starts = np.cumsum(counts) - counts
        faces = [
            np.column_stack([corners[s], corners[s + k], corners[s + k + 1]])
            for k in range(1, int(counts.max(initial=2)) - 1)
            for s in [starts[counts > k + 1]]
        ]
        return points, np.vstack([np.zeros((0, 3), int), *faces]).astype(np.int64)


class StageScene(Scene):
    """A vehicle's surroundings in a stage, read from the stage alone; moving obstacles count in their current pose.

    The vehicle is its collision meshes, or all its meshes if it has none, in the stage's poses. On the ground, walls
    and roofs of a terrain with overhangs count where it is in them; its distance outside is measured on the clip only.
    """

    def __init__(
        self,
        delivered: Delivered,
        name: str,
        moving: Sequence[str] = (),
        progress: Progress = silent,
        wheels: Mapping[str, Mapping[str, Any]] = MappingProxyType({}),
    ) -> None:
        self.delivered, self.name, self._wheels = delivered, name, wheels
        self._others, self._progress = moving, progress

    @cached_property
    def _own(self) -> list[_Cloud]:
        return [_Cloud.of(self.delivered, prim) for prim in _collision(self.delivered, self._root)]

    @cached_property
    def _moving(self) -> list[_Body]:
        return [_Body(self.delivered, self.delivered.vehicle(other)) for other in self._others]

    @cached_property
    def reach(self) -> float:  # type: ignore[override]  # a property of `Scene`
        first = float(self.delivered.frames[0])
        base = self.delivered.world_matrix(self._root, first)[:3, 3]
        corners = np.vstack([cloud.placed(first, cloud.points) for cloud in self._own])
        return float(np.linalg.norm(corners - base, axis=1).max())

    @cached_property
    def fastest(self) -> float:  # type: ignore[override]  # as `reach`
        return max((body.fastest for body in self._moving), default=0.0)

    @property
    def _root(self) -> Any:
        return self.delivered.vehicle(self.name)

    @cached_property
    def _terrain(self) -> _Ground | None:
        return _Ground.of(self.delivered)

    @cached_property
    def _standing(self) -> list[_Solid]:
        scope = self.delivered.stage.GetPrimAtPath(f"{self.delivered.root.GetPath()}/env/obstacles")
        return [_Solid.of(self.delivered, prim) for prim in self.delivered.meshes(scope)]

    def wheel_gap(self, track: Track, prims: Sequence[str]) -> Array:
        if self._terrain is None:
            return super().wheel_gap(track, prims)
        treads = self._treads(prims)
        frames = track.frames.tolist()
        poses: list[list[Array]] = [[] for _ in treads]  # (k, 4, 4) of every wheel: a cache of matrices holds one frame
        for frame in frames:
            for tread, found in zip(treads, poses, strict=True):
                found.append(np.array([self.delivered.world_matrix(mesh, frame) for mesh, _ in tread]))
        gaps = np.array(
            [
                _gaps(self._terrain, np.array(found), [points for _, points in tread])
                for tread, found in zip(treads, poses, strict=True)
            ]
        )
        return np.asarray(np.take_along_axis(gaps, np.abs(gaps).argmax(axis=0)[None], axis=0)[0])

    def wheel(self, track: Track, wheel: Mapping[str, Any]) -> tuple[Array, Array, Array]:
        how = self._wheels.get(wheel["prim"])
        if how is None:
            return super().wheel(track, wheel)
        prim = self._root.GetPrimAtPath(wheel["prim"])
        T_wp = np.array([self.delivered.world_matrix(prim, frame) for frame in track.frames.tolist()])
        axles = T_wp[:, :3, :3] @ np.asarray(how["axle"])
        turned = how["turn"] * self.delivered.op(self._root, how, track.frames)
        return _moved(T_wp, np.array([how["centre"]]))[:, 0], axles / np.linalg.norm(axles, axis=1)[:, None], turned

    def _treads(self, prims: Sequence[str]) -> list[list[tuple[Any, Array]]]:
        """For each wheel its meshes with the points (n, 3), in their own units, that can touch the ground."""
        first = float(self.delivered.frames[0])
        found = []
        for path in prims:
            wheel = self._root.GetPrimAtPath(path) if path else self._root
            meshes = [mesh for mesh in self.delivered.meshes(wheel) if is_drawn(mesh)]
            worlds = [self.delivered.world_matrix(mesh, first) for mesh in meshes]
            sizes = [max(float(np.cbrt(abs(np.linalg.det(world[:3, :3])))), 1e-12) for world in worlds]
            own = [
                _spread_bytes(points.tobytes(), faces.tobytes(), round(RIM / size, 9))
                for mesh, size in zip(meshes, sizes, strict=True)
                for points, faces in [self.delivered.triangles(mesh, first)]
            ]
            tread = _tread(np.vstack([_moved(world, points) for world, points in zip(worlds, own, strict=True)]))
            chosen = np.split(tread, np.cumsum([len(points) for points in own])[:-1])
            found.append(
                [(mesh, points[part]) for mesh, points, part in zip(meshes, own, chosen, strict=True) if part.any()]
            )
        return found

    def away(self, track: Track, obstacles_only: bool) -> Array:
        found = np.empty(len(track.frames))
        for k, frame in enumerate(track.frames.tolist()):
            self._progress(f"{self.name}: distances at frame {frame:g}", k / len(found))
            found[k] = self._at(frame, obstacles_only)
        return found

    def swept(self, track: Track) -> None:
        return None  # poses of parts are found frame by frame

    def _at(self, frame: float, obstacles_only: bool) -> float:
        solids: list[_Solid | _Ground] = [*self._standing, *(body.at(frame) for body in self._moving)]
        if self._terrain is not None and not obstacles_only:
            solids.append(self._terrain)
        walls = self._terrain if obstacles_only and self._terrain is not None and self._terrain.overhangs else None
        if not solids and walls is None:
            return np.inf
        centres = np.vstack([cloud.placed(frame, cloud.centres) for cloud in self._own])
        radii = np.concatenate([cloud.radii for cloud in self._own])
        nearest = np.inf
        for solid in solids:
            away = solid.away(centres)
            near = away - radii < min(nearest, float((away + radii).min()))
            if near.any():
                nearest = min(nearest, float(solid.away(self._within(frame, near)).min()))
        if walls is not None:
            near = walls.away(centres) < radii
            nearest = min(nearest, float(walls.in_walls(self._within(frame, near)).min(initial=np.inf)))
        return nearest

    def _within(self, frame: float, chosen: NDArray[np.bool_]) -> Array:
        """The vehicle's points (n, 3) m in ``chosen`` balls at a frame."""
        pieces = np.split(chosen, np.cumsum([len(cloud.radii) for cloud in self._own])[:-1])
        own = zip(self._own, pieces, strict=True)
        return np.vstack([cloud.placed(frame, cloud.within(some)) for cloud, some in own])


def _gaps(ground: _Ground, poses: Array, meshes: Sequence[Array]) -> Array:
    """Height (n,) m above the ground of the lowest point of a wheel, whose ``meshes`` have ``poses`` (n, k, 4, 4)."""
    found = np.empty(len(poses))
    for start in range(0, len(poses), SLICE):
        some = poses[start : start + SLICE]
        points = np.concatenate([_moved(some[:, k], own) for k, own in enumerate(meshes)], axis=1)
        lowest = points[:, :, 2].min(axis=1)
        low = points[:, :, 2] < lowest[:, None] + TREAD
        high = points[low]
        heights = high[:, 2] - ground.height(high)
        counts = low.sum(axis=1)
        found[start : start + SLICE] = np.minimum.reduceat(heights, np.cumsum(counts) - counts)
    return found


def _tread(points: Array) -> NDArray[np.bool_]:
    """The points (n,) of a wheel that can touch the ground: those near its largest radius, about its axis of
    symmetry."""
    middle = (points.min(axis=0) + points.max(axis=0)) / 2
    _, axes = np.linalg.eigh(np.cov((points - middle).T))
    spread = [np.linalg.norm((points - middle) @ np.delete(axes, k, axis=1), axis=1) for k in range(3)]
    radius = min(spread, key=lambda r: float(r.max()))
    return np.asarray(radius > 0.85 * radius.max())


class _Cloud:
    """Points on a vehicle's mesh, in balls around ``centres`` (k, 3) of ``radii`` (k,) m; points in the prim's own
    coordinates."""

    def __init__(self, delivered: Delivered, prim: Any, points: Array) -> None:
        self.delivered, self.prim = delivered, prim
        first = delivered.world_matrix(prim, float(delivered.frames[0]))
        cells = np.floor(_moved(first, points) / CELL).astype(int)
        _, self.cell = np.unique(cells, axis=0, return_inverse=True)
        self.cell = self.cell.ravel()
        self.points = points
        counts = np.bincount(self.cell)[:, None]
        self.centres = np.column_stack([np.bincount(self.cell, points[:, k]) for k in range(3)]) / counts
        scale = np.linalg.norm(first[:3, :3], axis=0).max()
        self.radii = np.zeros(len(counts))
        np.maximum.at(self.radii, self.cell, scale * np.linalg.norm(points - self.centres[self.cell], axis=1))

    @classmethod
    def of(cls, delivered: Delivered, prim: Any) -> _Cloud:
        frame = float(delivered.frames[0])
        points, faces = delivered.triangles(prim, frame)
        scale = float(np.cbrt(abs(np.linalg.det(delivered.world_matrix(prim, frame)[:3, :3]))))
        return cls(delivered, prim, _spread(points, faces, SPACING / max(scale, 1e-12)))

    def placed(self, frame: float, points: Array) -> Array:
        """Points (n, 3) of the prim in the world at a frame, m."""
        return _moved(self.delivered.world_matrix(self.prim, frame), points)

    def within(self, chosen: NDArray[np.bool_]) -> Array:
        """The points in some of the balls."""
        return self.points[chosen[self.cell]]


class _Blind(Scene):
    """A scene without distances, which cost more than all other measures."""

    def __init__(self, scene: Scene) -> None:
        self.scene = scene

    def wheel_gap(self, track: Track, prims: Sequence[str]) -> Array:
        return self.scene.wheel_gap(track, prims)

    def wheel(self, track: Track, wheel: Mapping[str, Any]) -> tuple[Array, Array, Array]:
        return self.scene.wheel(track, wheel)


class _Solid:
    """A closed mesh."""

    def __init__(self, points: Array, faces: Ints) -> None:
        import igl

        self.points, self.faces = np.ascontiguousarray(points), np.ascontiguousarray(faces)
        self.tree = igl.AABB()
        self.tree.init(self.points, self.faces)
        self.low, self.high = points.min(axis=0), points.max(axis=0)

    @classmethod
    def of(cls, delivered: Delivered, prim: Any) -> _Solid:
        frame = float(delivered.frames[0])
        points, faces = delivered.triangles(prim, frame)
        return cls(_moved(delivered.world_matrix(prim, frame), points), faces)

    def away(self, points: Array) -> Array:
        """Signed distances (n,) m of points (n, 3)."""
        import igl

        points = np.ascontiguousarray(points)
        squared = np.asarray(self.tree.squared_distance(self.points, self.faces, points)[0])
        distance = np.sqrt(np.maximum(squared, 0.0))
        within = np.flatnonzero(((points > self.low) & (points < self.high)).all(axis=1))
        if len(within):
            turns = np.asarray(igl.winding_number(self.points, self.faces, np.ascontiguousarray(points[within])))
            distance[within[np.abs(turns) > 0.5]] *= -1
        return distance


class _Ground:
    """The terrain's mesh. Points below it are inside; with overhangs, those whose first face above looks up."""

    def __init__(self, points: Array, faces: Ints) -> None:
        import igl

        self.points, self.faces = np.ascontiguousarray(points), np.ascontiguousarray(faces)
        self.flat = np.ascontiguousarray(points * [1.0, 1.0, 0.0])
        self.plan = igl.AABB()
        self.plan.init(self.flat, self.faces)
        self.up = _upward(self.points, self.faces)
        self.overhangs = bool((self.up < 0).any())
        self.level = bool(np.ptp(points[:, 2]) == 0)

    @cached_property
    def tree(self) -> Any:
        """For distances in space."""
        import igl

        tree = igl.AABB()
        tree.init(self.points, self.faces)
        return tree

    @classmethod
    def of(cls, delivered: Delivered) -> _Ground | None:
        scope, frame = delivered.stage.GetPrimAtPath(f"{delivered.root.GetPath()}/env/terrain"), delivered.frames[0]
        found, count = [], 0
        for prim in delivered.meshes(scope):
            points, faces = delivered.triangles(prim, float(frame))
            if not len(faces):
                continue
            found.append((_moved(delivered.world_matrix(prim, float(frame)), points), faces + count))
            count += len(points)
        if not found:
            return None
        return _ground_of(np.vstack([p for p, _ in found]).tobytes(), np.vstack([f for _, f in found]).tobytes())

    def height(self, points: Array) -> Array:
        """Height (n,) m of the ground below or above points (n, 3); beyond the border, that of the border."""
        if not self.overhangs:
            return self._seen_from_above(points)
        lift = np.array([0.0, 0.0, STEP])
        rise, up = self._first(points + lift, -1.0)
        return np.where(up > 0, points[:, 2] + STEP - rise, self._seen_from_above(points))

    def _first(self, points: Array, direction: float) -> tuple[Array, Array]:
        """Distance (n,) m from points (n, 3) straight up (1) or down (-1) to the first face, and its entry of ``up``,
        (n,); 0 for none."""
        rays = np.tile([0.0, 0.0, direction], (len(points), 1))
        hit, rise, _ = self.tree.intersect_ray_first(self.points, self.faces, np.ascontiguousarray(points), rays)
        return np.asarray(rise), np.where(np.asarray(hit) >= 0, self.up[hit], 0.0)

    def _seen_from_above(self, points: Array) -> Array:
        """Height (n,) m of the face that is nearest to points (n, 3) in the plane."""
        if self.level:
            return np.full(len(points), self.points[0, 2])
        at = np.ascontiguousarray(points * [1.0, 1.0, 0.0])
        _, face, place = self.plan.squared_distance(self.flat, self.faces, at)
        a, b, c = (self.points[self.faces[np.ravel(face), k]] for k in range(3))
        u, v, w = (b - a)[:, :2], (c - a)[:, :2], (np.asarray(place) - a)[:, :2]
        area = u[:, 0] * v[:, 1] - u[:, 1] * v[:, 0]
        safe = np.where(np.abs(area) > 1e-12, area, 1.0)
        s = (w[:, 0] * v[:, 1] - w[:, 1] * v[:, 0]) / safe
        t = (u[:, 0] * w[:, 1] - u[:, 1] * w[:, 0]) / safe
        return np.asarray(a[:, 2] + s * (b - a)[:, 2] + t * (c - a)[:, 2])

    def away(self, points: Array) -> Array:
        """Signed distances (n,) m of points (n, 3): below the ground minus their depth."""
        if self.overhangs:
            rise, up = self._first(points, 1.0)
            above = np.where(up > 0, -np.maximum(rise, 1e-9), points[:, 2] - self.points[:, 2].min())
        else:
            above = points[:, 2] - self._seen_from_above(points)
        squared = np.asarray(self.tree.squared_distance(self.points, self.faces, np.ascontiguousarray(points))[0])
        return np.where(above < 0, above, np.sqrt(np.maximum(squared, 0.0)))

    def in_walls(self, points: Array) -> Array:
        """Minus the distance (n,) m to the surface of points (n, 3) in rock that rises more than `STEP` above them, as
        for a vehicle that drives through a wall; inf for others, also in the ground on which it stands."""
        found = np.full(len(points), np.inf)
        if len(points):
            rise, up = self._first(points, 1.0)
            inside = (up > 0) & (rise > STEP)
            rock = np.ascontiguousarray(points[inside])
            found[inside] = -np.sqrt(np.asarray(self.tree.squared_distance(self.points, self.faces, rock)[0]))
        return found


@lru_cache(maxsize=2)
def _ground_of(points: bytes, faces: bytes) -> _Ground:
    """The ground of a mesh, given as bytes: a process often measures several deliveries on one terrain."""
    return _Ground(np.frombuffer(points).reshape(-1, 3), np.frombuffer(faces, np.int64).reshape(-1, 3))


def _upward(points: Array, faces: Ints) -> Array:
    """For each face the direction in which it looks, (m,): 1 up, -1 down, 0 sideways; the whole looks up."""
    import igl

    _, place = np.unique(points, axis=0, return_inverse=True)
    joined = place.ravel()[faces]
    edges = joined[:, [0, 1, 2]].astype(np.int64) * len(points) + joined[:, [1, 2, 0]]
    turned = np.ones(len(faces))
    if len(np.unique(edges)) < edges.size:  # two faces run along an edge in the same direction
        whole = np.flatnonzero((joined != np.roll(joined, 1, axis=1)).all(axis=1))
        none = np.zeros((0, 3), np.int64), np.zeros(0, np.int64)
        oriented, body = igl.bfs_orient(np.ascontiguousarray(joined[whole])) if len(whole) else none  # it would crash
        turned[whole] = np.where((oriented == joined[whole]).all(axis=1), 1.0, -1.0)
    else:
        whole, body = np.arange(len(faces)), np.zeros(len(faces), int)
    a, b, c = (points[faces[:, k]] for k in range(3))
    up = turned * np.cross(b - a, c - a)[:, 2]
    volume = up * ((a + b + c)[:, 2] / 3 - points[:, 2].min() + 1.0)
    up[whole] *= np.where(np.bincount(body, volume[whole])[body] < 0, -1.0, 1.0)
    flat = 1e-9 * np.linalg.norm(np.cross(b - a, c - a), axis=1)
    return np.asarray(np.where(np.abs(up) > flat, np.sign(up), 0.0))


class _Body:
    """Another vehicle in its pose in the stage: the convex hull of each of its collision meshes."""

    def __init__(self, delivered: Delivered, root: Any) -> None:
        self.delivered, first = delivered, float(delivered.frames[0])
        self.parts = [(prim, *_hull(delivered.triangles(prim, first)[0])) for prim in _collision(delivered, root)]
        first, last = delivered.frames
        places = np.array(
            [
                np.vstack([_moved(delivered.world_matrix(prim, frame), points) for prim, points, _ in self.parts])
                for frame in range(first, last + 1)
            ]
        )
        steps = np.linalg.norm(np.diff(places, axis=0), axis=2)
        self.fastest = float(steps.max(initial=0.0)) * float(delivered.fps)

    def at(self, frame: float) -> _Solid:
        points, faces, count = [], [], 0
        for prim, own, triangles in self.parts:
            points.append(_moved(self.delivered.world_matrix(prim, frame), own))
            faces.append(triangles + count)
            count += len(own)
        return _Solid(np.vstack(points), np.vstack(faces))


def _through(x: Array, y: Array, at: Array) -> Array:
    """The monotone curve through ``y`` (n,) at rising ``x`` (n,), straight beyond its ends."""
    from vehsim.clip.interpolant import monotone

    inside = np.clip(at, x[0], x[-1])
    slope = np.where(at < x[0], (y[1] - y[0]) / (x[1] - x[0]), (y[-1] - y[-2]) / (x[-1] - x[-2]))
    return np.asarray(monotone(x, y, inside) + slope * (at - inside))


def _collision(delivered: Delivered, root: Any) -> list[Any]:
    """A vehicle's collision meshes; all its meshes if it has none."""
    from pxr import UsdPhysics

    every = list(delivered.meshes(root))
    return [prim for prim in every if prim.HasAPI(UsdPhysics.CollisionAPI)] or every


def _spread(points: Array, faces: Ints, spacing: float) -> Array:
    """The points of a mesh, and additional ones on triangles longer than ``spacing``."""
    a, b, c = np.moveaxis(points[faces], 1, 0)
    longest = np.sqrt(np.max([np.sum(side**2, axis=1) for side in (b - a, c - a, c - b)], axis=0))
    parts = np.ceil(longest / spacing).astype(int)
    more = [points]
    for n in np.unique(parts[parts > 1]).tolist():
        i, j = np.meshgrid(np.arange(n + 1), np.arange(n + 1))
        inside, some = i + j <= n, parts == n
        right, up = i[inside, None, None] / n * (b - a)[some], j[inside, None, None] / n * (c - a)[some]
        more.append((a[some] + right + up).reshape(-1, 3))
    return np.unique(np.vstack(more), axis=0)


def _hull(points: Array) -> tuple[Array, Ints]:
    from scipy.spatial import ConvexHull

    hull = ConvexHull(points)
    inside = points.mean(axis=0)
    corners = points[hull.simplices]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    flipped = np.sum(normal * (corners[:, 0] - inside), axis=1) < 0
    faces = np.where(flipped[:, None], hull.simplices[:, ::-1], hull.simplices)
    return points, faces.astype(np.int64)


@lru_cache(maxsize=16)
def _spread_bytes(points: bytes, faces: bytes, spacing: float) -> Array:
    """`_spread`, of arrays as bytes: wheels often are one mesh, and are measured again after an edit."""
    return _spread(np.frombuffer(points).reshape(-1, 3), np.frombuffer(faces, np.int64).reshape(-1, 3), spacing)


def _moved(matrix: Array, points: Array) -> Array:
    """Points (n, 3) moved by a matrix (4, 4), or (k, n, 3) by each of (k, 4, 4)."""
    return np.asarray(points @ np.swapaxes(matrix[..., :3, :3], -1, -2) + matrix[..., None, :3, 3])


def audit_stage(
    path: Path, report: Mapping[str, Any], distances: bool = True, progress: Progress = silent
) -> dict[str, list[Row]]:
    """Measure the stage at ``path`` against the asks of a ``report.json``; rows by vehicle.

    ``distances``: also measure those to terrain and obstacles; otherwise rows that need them have ``met`` None. Raises
    ``InputError`` for a report without asks.
    """
    try:
        first, last = map(int, report["frames"])
        delivered = Delivered(path, Fraction(report["fps"]), (first, last))
        requests = {name: [_ask(row) for row in rows] for name, rows in report["audit"].items()}
        roots = {name: np.array(report["vehicles"][name]["T_rp"], float) for name in requests}
        joints = {name: report["vehicles"][name].get("joints", {}) for name in requests}
        wheels = {name: report["vehicles"][name].get("wheels", {}) for name in requests}
        moving = {name: _moving(report["vehicles"][name], first, last) for name in requests}
    except (KeyError, TypeError, ValueError, IndexError) as error:
        raise InputError(f"report.json holds no asks ({error!r})", "export the shot again", file=path.parent) from None
    avoided = [obstacle["vehicle"] for obstacle in _obstacles(report) if obstacle.get("shape") == "vehicle"]
    rows: dict[str, list[Row]] = {}
    for name, asks in requests.items():
        others = [other for other in avoided if other != name and other in requests]
        scene = StageScene(delivered, name, others, progress, wheels[name])
        progress(f"{name}: reading the stage", 0.0)
        whole = delivered.track(name, roots[name], joints[name])
        start, end = moving[name]
        motion = whole.between(start, end)  # a cut-off motion's velocities are not those of the still frames around it
        rows[name] = []
        for ask in asks:
            track = motion if start <= ask.first and ask.last <= end else whole
            (row,) = audit(track, [ask], scene if distances else _Blind(scene))
            rows[name].append(row if distances or row.measure not in DISTANCES else not_shown(ask))
    return rows


def _moving(vehicle: Mapping[str, Any], first: int, last: int) -> tuple[float, float]:
    """First and last frame of a vehicle's motion; in the other frames of the shot it stands still."""
    start, end = vehicle.get("motion", (first, last))
    return float(start), float(end)


def with_stage(path: Path, report: Mapping[str, Any]) -> dict[str, list[dict[str, Any]]]:
    """The rows of a report's ``audit``, each with the measurement on the stage at ``path`` under ``stage``.

    Distances are not measured again: whole frames have been read back, and between them the stage follows the clip.
    Raises ``ExportError`` if the stage misses what the clip meets; warns of other misses that only the stage shows.
    """
    found, wrong = {}, []
    for name, rows in audit_stage(path, report, distances=False).items():
        for request, row in zip(report["audit"][name], rows, strict=True):
            if row.met is False and row.severity == "warning" and request["met"] is None:
                warnings.warn(f"{name}: {row}", stacklevel=2)
        found[name] = [
            {**request, "stage": {key: getattr(row, key) for key in ("value", "frame", "met")}}
            for request, row in zip(report["audit"][name], rows, strict=True)
        ]
        wrong += [f"{name}: {row}" for row in missed(rows)]
    if wrong:
        raise ExportError(f"the composed stage misses requests: {'; '.join(wrong[:3])}", file=path.name)
    return found


def _ask(row: Mapping[str, Any]) -> Ask:
    return Ask(**{field.name: row[field.name] for field in fields(Ask)})


def _obstacles(report: Mapping[str, Any]) -> Sequence[Mapping[str, Any]]:
    found: Sequence[Mapping[str, Any]] = report["solved"]["shot"].get("world", {}).get("obstacle", ())
    return found


def audit_delivery(folder: Path, progress: Progress = silent) -> dict[str, list[Row]]:
    """Audit the content of a delivery's folder. Raises ``InputError`` for a folder that is not a delivery."""
    with reading_report(folder) as report:
        path = _stage_in(folder, report)
        return audit_stage(path, report, progress=progress)


def changed_files(folder: Path) -> list[str]:
    """The files of a delivery's stage, relative to its folder, whose content is not the one that was exported.

    A spoiled sample between two marks may miss no request, so that no measurement shows it. Raises ``InputError``.
    """
    with reading_report(folder) as report:
        path = _stage_in(folder, report)
        used = {Path(file).resolve() for file in dependencies(path)[0]}
        digests = {name: digest for name, digest in report["files"].items() if (folder / name).resolve() in used}
        return sorted(name for name, digest in digests.items() if _digest(folder / name) != digest)


def _stage_in(folder: Path, report: Mapping[str, Any]) -> Path:
    """The stage of a delivery's folder. Raises ``InputError`` if there is none, or if it cannot be read."""
    path = stage_of(folder, report["shot"])
    if path is None:
        raise InputError("no stage in it", "export with --to usd, flat or usdz", file=folder)
    dependencies(path)
    return path


def _digest(path: Path) -> str:
    with path.open("rb") as content:
        return hashlib.file_digest(content, "sha256").hexdigest()
