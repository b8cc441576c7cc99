"""Read a USD stage for a renderer: meshes in rigid groups, materials, lights, cameras, poses by frame.

Everything comes from the composed stage, never from a clip, so that pictures show the delivery. Results are plain
arrays in metres, Z up; `pictures/render.py` draws them.
"""

from __future__ import annotations

import warnings
from collections.abc import Collection, Iterator
from dataclasses import dataclass
from fractions import Fraction
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from vehsim.errors import InputError
from vehsim.exporters.pictures.surfaces import Material as Material
from vehsim.exporters.pictures.surfaces import read_surface as read_surface
from vehsim.exporters.pictures.surfaces import surfaces_of
from vehsim.exporters.usd.metadata import local_origin
from vehsim.exporters.usd.scenery.distant_waves import DistantWaves, read_waves
from vehsim.exporters.usd.scenery.water_grid import Net
from vehsim.intake.foreign import reason_of
from vehsim.intake.polygons import has_polygons, polygons
from vehsim.intake.usd import is_drawn, triangulate
from vehsim.rig.parts import Y_UP_TO_Z_UP

Array = NDArray[np.float64]
Ints = NDArray[np.int64]

WATER_ROWS = "vehsim:rows"
"""Attribute of the water's surface: the number of points of each of its rows, see `water_grid`."""
TYRE_MARK = "vehsim:tyre_mark"
"""Attribute of the ribbons of tyre marks: their points come in rows of a left and a right end."""


@dataclass(frozen=True)
class Shape:
    """Triangles of one material, in the frame of their ``group``: the path of the prim that moves them, "" is the
    world.

    ``points`` (n, 3) m, ``faces`` (m, 3); ``normals`` (k, 3) by ``face_normals`` (m, 3); ``uvs`` (j, 2) by
    ``face_uvs``. ``closed``: its back is never visible.
    """

    name: str
    group: str
    points: Array
    faces: Ints
    normals: Array
    face_normals: Ints
    uvs: Array | None
    face_uvs: Ints | None
    surface: Material
    closed: bool = True


class View(NamedTuple):
    """A camera's view: its pose ``T_wc`` (4, 4), half its width and its ``shift`` to the right and up at distance 1,
    and (near, far) m."""

    T_wc: Array
    half_width: float
    shift: tuple[float, float]
    clip: tuple[float, float]


@dataclass(frozen=True)
class Sun:
    """A distant light: ``direction`` (3,) of its rays; ``colour`` linear, times intensity; ``angle``: its width in
    degrees."""

    direction: Array
    colour: Array
    angle: float = 0.53


@dataclass(frozen=True)
class Sky:
    """A dome light: ``colour`` linear, times intensity; ``texture`` latitude-longitude; ``R_wd`` dome to world."""

    colour: Array
    texture: Path | None
    R_wd: Array


class Ribbon(NamedTuple):
    """A tyre mark: rows (k, 2, 3) m of its left and right ends, its opacity (k, 2), and its linear colour (3,)."""

    rows: Array
    opacity: Array
    colour: Array


class StageReader:
    """An exported stage, open for rendering.

    ``shapes`` are fixed in their group; ``groups`` are the paths of the moving prims; ``cameras`` are the paths of the
    stage's cameras by name. Far from the stage's origin, where renderers' single precision is too coarse, all positions
    are relative to ``origin`` (3,) m. Raises ``InputError`` if the stage cannot be read.
    """

    def __init__(self, path: str | Path, moving: Collection[str] = ()) -> None:
        """``moving``: paths of prims that are groups also if they stand still."""
        from pxr import Tf, Usd, UsdGeom

        self.path = Path(path)
        if not self.path.is_file():
            raise InputError("no such file", "give a stage (.usd, .usda, .usdc, .usdz)", file=path)
        try:
            self._stage = Usd.Stage.Open(str(path))
        except Tf.ErrorException as error:
            raise InputError(f"not readable as USD: {reason_of(error)}", "give a stage", file=path) from None
        self._convert = _to_metres_z_up(self._stage)
        self._metres = UsdGeom.GetStageMetersPerUnit(self._stage)
        self._cache = UsdGeom.XformCache()
        self._movers: dict[Any, str] = {}
        self._made: dict[str, tuple[float, Ribbon]] = {}
        self._moving = frozenset(moving)
        self.water: str | None = None
        self.spray: str | None = None
        self.tyre_marks: list[str] = []
        self.fps = Fraction(self._stage.GetFramesPerSecond()).limit_denominator(1001)
        self.frames = (int(self._stage.GetStartTimeCode()), int(self._stage.GetEndTimeCode()))
        self.cameras = {
            prim.GetName(): str(prim.GetPath()) for prim in self._stage.Traverse() if prim.IsA(UsdGeom.Camera)
        }
        self.origin = self._local_origin()
        self._convert = _moved(-self.origin) @ self._convert
        self.shapes = tuple(self._read_shapes())
        self.groups = tuple(sorted({shape.group for shape in self.shapes} - {""}))
        self._relax = {group: np.linalg.inv(_stretch(self._world(group))) for group in self.groups}

    # ------------------------------------------------------------ by frame

    def matrices(self, frame: float) -> dict[str, Array]:
        """Rigid poses T_wg (4, 4) of every group at a time code."""
        self._cache.SetTime(frame)
        poses = {}
        for group in self.groups:
            pose = self._world(group) @ self._relax[group]
            if not np.abs(pose[:3, :3] @ pose[:3, :3].T - np.eye(3)).max() < 1e-4:
                warnings.warn(f"{group}: its scale changes over time; drawn as at the first frame", stacklevel=2)
                u, _, v = np.linalg.svd(pose[:3, :3])
                pose[:3, :3] = u @ v
            poses[group] = pose
        return poses

    def vehicles(self, frame: float) -> list[Array]:
        """Places (3,) m of the vehicles of an exported shot at a time code, also of those at rest."""
        self._cache.SetTime(frame)
        scope = self._stage.GetPrimAtPath(f"{self._stage.GetDefaultPrim().GetPath()}/vehicles")
        return [self._world(str(prim.GetPath()))[:3, 3] for prim in (scope.GetChildren() if scope else ())]

    def camera(self, name: str, frame: float) -> View:
        """What a camera sees at a time code."""
        from pxr import UsdGeom

        prim = self._stage.GetPrimAtPath(self.cameras[name])
        lens = UsdGeom.Camera(prim).GetCamera(frame)
        self._cache.SetTime(frame)
        pose = self._world(str(prim.GetPath()))
        pose[:3, :3] /= np.linalg.norm(pose[:3, :3], axis=0)
        shift = lens.horizontalApertureOffset / lens.focalLength, lens.verticalApertureOffset / lens.focalLength
        clip = lens.clippingRange.min * self._metres, lens.clippingRange.max * self._metres
        return View(pose, lens.horizontalAperture / (2 * lens.focalLength), shift, clip)

    @cached_property
    def water_net(self) -> Net:
        """A regular net over the points of the water's surface."""
        return Net.over(np.array(self._stage.GetPrimAtPath(self.water).GetAttribute(WATER_ROWS).Get(), int))

    def water_st(self) -> Array:
        """Texture coordinates (n, 2) of the water's surface on its `water_net`."""
        from pxr import UsdGeom

        st = UsdGeom.PrimvarsAPI(self._stage.GetPrimAtPath(self.water)).GetPrimvar("st").Get()
        return self.water_net.of(np.array(st, float))

    def water_waves(self) -> DistantWaves | None:
        """The waves of the water's surface, with ``cell`` and ``share`` on its `water_net`; None if unknown."""
        from pxr import UsdGeom

        waves = read_waves(UsdGeom.Mesh(self._stage.GetPrimAtPath(self.water)))
        on = self.water_net.of
        return None if waves is None else waves._replace(cell=on(waves.cell), share=on(waves.share))

    def water_at(self, frame: float) -> tuple[Array, Array, Array, Array]:
        """Points (n, 3) m, unit normals (n, 3), foam (n,) of the water's surface on its `water_net` at a time code, and
        by how much (n,) m it was lowered there inside a hull."""
        from pxr import UsdGeom

        prim = self._stage.GetPrimAtPath(self.water)
        self._cache.SetTime(frame)
        T_ws = self._world(str(prim.GetPath()))
        primvars = UsdGeom.PrimvarsAPI(prim)
        points = np.array(UsdGeom.Mesh(prim).GetPointsAttr().Get(frame), float) @ T_ws[:3, :3].T + T_ws[:3, 3]
        normals = np.array(primvars.GetPrimvar("normals").Get(frame), float) @ np.linalg.inv(T_ws[:3, :3])
        given = [primvars.GetPrimvar(name).Get(frame) for name in ("foam", "lowered")]
        foam, lowered = (np.zeros(len(points)) if values is None else np.array(values, float) for values in given)
        on = self.water_net.of
        points, normals, foam, lowered = on(points), on(normals), on(foam), on(lowered)
        normals /= np.linalg.norm(normals, axis=1, keepdims=True)
        return points, normals, foam, lowered * np.linalg.norm(T_ws[:3, 2])

    def spray_at(self, frame: float) -> tuple[Array, Array, Array]:
        """Places (n, 3) m, velocities (n, 3) m/s and widths (n,) m of the stage's points at a time code."""
        from pxr import UsdGeom

        points = UsdGeom.Points(self._stage.GetPrimAtPath(self.spray))
        self._cache.SetTime(frame)
        T_wp = self._world(str(points.GetPath()))
        given = [each.Get(frame) for each in (points.GetPointsAttr(), points.GetVelocitiesAttr())]
        places, velocities = (np.array(each or [], float).reshape(-1, 3) @ T_wp[:3, :3].T for each in given)
        velocities = velocities if len(velocities) == len(places) else np.zeros_like(places)
        widths = np.array(points.GetWidthsAttr().Get(frame) or [], float)
        widths = np.broadcast_to(widths if widths.size else [0.02], len(places))
        return places + T_wp[:3, 3], velocities, widths * np.linalg.norm(T_wp[:3, 2])

    def tyre_marks_at(self, frame: float) -> list[Ribbon]:
        """The tyre marks on the ground at a time code."""
        found = []
        for path in self.tyre_marks:
            if path not in self._made or self._made[path][0] > frame:
                ribbon, ends = self._tyre_mark(path, frame)
                if frame >= ends:
                    self._made[path] = ends, ribbon
            else:
                ribbon = self._made[path][1]
            if np.ptp(ribbon.rows[:, 0], axis=0).any():
                found.append(ribbon)
        return found

    def tyre_marks_made(self) -> Iterator[tuple[Ribbon, Array]]:
        """The complete tyre marks, each with the time codes (k,) at which its rows are made."""
        from pxr import UsdGeom

        for path in self.tyre_marks:
            points = UsdGeom.Mesh(self._stage.GetPrimAtPath(path)).GetPointsAttr()
            times = np.array(points.GetTimeSamples())
            moving = np.stack([np.array(points.Get(time), float) for time in times.tolist()])
            placed = (moving == moving[-1]).all(axis=2).reshape(len(times), -1, 2).all(axis=2)
            yield self._tyre_mark(path, times[-1])[0], times[placed.argmax(axis=0)]

    def _tyre_mark(self, path: str, frame: float) -> tuple[Ribbon, float]:
        """A tyre mark at a time code, and the time code at which it is complete."""
        from pxr import UsdGeom

        mesh = UsdGeom.Mesh(self._stage.GetPrimAtPath(path))
        points = mesh.GetPointsAttr()
        self._cache.SetTime(frame)
        T_wm = self._world(path)
        rows = np.array(points.Get(frame), float) @ T_wm[:3, :3].T + T_wm[:3, 3]
        opacity = np.array(UsdGeom.PrimvarsAPI(mesh).GetPrimvar("displayOpacity").Get(), float)
        colour = np.array(mesh.GetDisplayColorAttr().Get()[0], float)
        ends = max(points.GetTimeSamples(), default=-np.inf)
        return Ribbon(rows.reshape(-1, 2, 3), opacity.reshape(-1, 2), colour), ends

    # ------------------------------------------------------------ once

    def sun(self) -> Sun | None:
        """The stage's first distant light."""
        from pxr import UsdLux

        for prim in self._stage.Traverse():
            if prim.IsA(UsdLux.DistantLight):
                direction = self._world(str(prim.GetPath()))[:3, :3] @ (0.0, 0.0, -1.0)
                angle = float(UsdLux.DistantLight(prim).GetAngleAttr().Get())
                return Sun(direction / np.linalg.norm(direction), _light_colour(prim), angle)
        return None

    def sky(self) -> Sky | None:
        """The stage's first dome light."""
        from pxr import UsdLux

        for prim in self._stage.Traverse():
            if prim.IsA(UsdLux.DomeLight):
                file = UsdLux.DomeLight(prim).GetTextureFileAttr().Get()
                texture = Path(file.resolvedPath) if file and file.resolvedPath else None
                R_wd = self._world(str(prim.GetPath()))[:3, :3]
                return Sky(_light_colour(prim), texture, R_wd / np.linalg.norm(R_wd, axis=0))
        return None

    def _local_origin(self) -> Array:
        """The point (3,) m to which positions refer: near the first camera, or else the first prim that moves."""
        from pxr import UsdGeom

        self._cache.SetTime(self.frames[0])
        for prim in (*map(self._stage.GetPrimAtPath, self.cameras.values()), *self._stage.Traverse()):
            if prim.IsA(UsdGeom.Camera) or self._mover(prim):
                return local_origin(self._world(str(prim.GetPath()))[:3, 3])
        return np.zeros(3)

    def _world(self, path: str) -> Array:
        matrix = self._cache.GetLocalToWorldTransform(self._stage.GetPrimAtPath(path))
        return np.asarray(self._convert @ np.array(matrix).T)

    def _read_shapes(self) -> Iterator[Shape]:
        from pxr import Usd, UsdGeom

        skipped = []
        self._cache.SetTime(self.frames[0])
        prims = iter(Usd.PrimRange(self._stage.GetPseudoRoot(), Usd.TraverseInstanceProxies()))
        for prim in prims:
            if not prim.IsA(UsdGeom.Imageable):
                continue
            imageable = UsdGeom.Imageable(prim)
            if imageable.ComputeVisibility(self.frames[0]) == UsdGeom.Tokens.invisible:
                prims.PruneChildren()
            elif not is_drawn(prim):
                continue
            elif prim.HasAttribute(WATER_ROWS):
                self.water = str(prim.GetPath())
            elif prim.HasAttribute(TYRE_MARK):
                self.tyre_marks.append(str(prim.GetPath()))
            elif prim.IsA(UsdGeom.Points):
                self.spray = str(prim.GetPath())
            elif has_polygons(prim):
                yield from self._read_mesh(prim)
            elif prim.IsA(UsdGeom.Gprim) or prim.IsA(UsdGeom.PointInstancer):
                skipped.append(f"{prim.GetPath()} ({prim.GetTypeName()})")
        if skipped:
            warnings.warn(
                f"{self.path}: only meshes and simple shapes are drawn; left out: {', '.join(skipped[:10])}",
                stacklevel=3,
            )

    def _read_mesh(self, prim: Any) -> Iterator[Shape]:
        """The shapes of a mesh, one per material, in the frame of the prim that moves it."""
        from pxr import UsdGeom

        group = self._mover(prim)
        world = self._world(str(prim.GetPath()))
        to_group = np.eye(4) if not group else np.linalg.inv(_rigid_part(self._world(group)))
        local = to_group @ world
        shape = UsdGeom.Gprim(prim)
        geometry = _Geometry.read(prim, self.frames[0])
        if geometry is None:
            return
        left_handed = shape.GetOrientationAttr().Get() == UsdGeom.Tokens.leftHanded
        flip = left_handed != (np.linalg.det(local[:3, :3]) < 0)
        for name, chosen, surface in surfaces_of(prim, len(geometry.counts), self.frames[0]):
            yield geometry.shape(name, group, local, chosen, surface, flip, bool(shape.GetDoubleSidedAttr().Get()))

    def _mover(self, prim: Any) -> str:
        """The path of the closest prim at or above ``prim`` that is a body with a mass, such as a parked car, or whose
        transform changes over time; "" for none."""
        from pxr import UsdGeom, UsdPhysics

        path = prim.GetPath()
        if path not in self._movers:
            if prim.IsPseudoRoot():
                self._movers[path] = ""
            elif (
                str(path) in self._moving
                or prim.HasAPI(UsdPhysics.MassAPI)
                or (prim.IsA(UsdGeom.Xformable) and UsdGeom.Xformable(prim).TransformMightBeTimeVarying())
            ):
                self._movers[path] = str(path)
            else:
                self._movers[path] = self._mover(prim.GetParent())
        return self._movers[path]


@dataclass(frozen=True)
class _Geometry:
    """A mesh as authored: polygons with normals and texture coordinates per face corner."""

    points: Array
    counts: Ints
    indices: Ints
    normals: tuple[Array, Ints] | None
    uvs: tuple[Array, Ints] | None
    flat: bool

    @staticmethod
    def read(prim: Any, time: float) -> _Geometry | None:
        from pxr import UsdGeom

        found = polygons(prim, time, prim.GetStage().GetRootLayer().realPath)
        if found is None:
            warnings.warn(f"{prim.GetPath()}: an empty mesh; not drawn", stacklevel=4)
            return None
        points, counts, indices, own = found
        if own is not None:
            return _Geometry(points, counts, indices, (own, np.arange(len(own))), None, flat=False)
        mesh = UsdGeom.Mesh(prim)
        if counts.sum() != len(indices) or indices.min() < 0 or indices.max() >= len(points):
            raise InputError(
                f"its faces do not fit its {len(points)} points", "export the mesh again", key=str(prim.GetPath())
            )
        primvars = UsdGeom.PrimvarsAPI(prim)
        normal = primvars.GetPrimvar("normals")
        if normal and normal.HasValue():
            normals = _corners(normal.ComputeFlattened(time), normal.GetInterpolation(), counts, indices)
        else:
            values = mesh.GetNormalsAttr().Get(time)
            normals = _corners(values, mesh.GetNormalsInterpolation(), counts, indices)
        st = primvars.GetPrimvar("st")
        uvs = _corners(st.ComputeFlattened(time), st.GetInterpolation(), counts, indices) if st else None
        smooth = mesh.GetSubdivisionSchemeAttr().Get() != UsdGeom.Tokens.none
        return _Geometry(points, counts, indices, normals, uvs, flat=not smooth)

    def shape(
        self, name: str, group: str, local: Array, chosen: Ints, surface: Material, flip: bool, double: bool
    ) -> Shape:
        """The triangles of the ``chosen`` faces, with points and normals transformed to their group by ``local``."""
        holes = np.setdiff1d(np.arange(len(self.counts)), chosen)
        corner = triangulate(self.counts, np.arange(len(self.indices)), holes)
        corner = corner[:, ::-1] if flip else corner
        faces = self.indices[corner]
        used, faces = np.unique(faces, return_inverse=True)
        faces = faces.reshape(-1, 3)
        points = self.points[used] @ local[:3, :3].T + local[:3, 3]
        if self.normals is not None:
            cofactor = np.linalg.inv(local[:3, :3]).T
            normals, face_normals = self.normals[0] @ cofactor.T, self.normals[1][corner]
        else:
            normals, face_normals = _computed_normals(points, faces, self.flat)
        normals = normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
        uvs, face_uvs = (self.uvs[0], self.uvs[1][corner]) if self.uvs is not None else (None, None)
        closed = not double or _is_closed(points, faces)
        return Shape(name, group, points, faces, normals, face_normals, uvs, face_uvs, surface, closed)


def _corners(values: Any, interpolation: str, counts: Ints, indices: Ints) -> tuple[Array, Ints] | None:
    """A primvar as values and, per face corner, the index of its value; None if it does not fit the mesh."""
    if values is None or not len(values):
        return None
    array = np.array(values, float)
    by_corner = {
        "vertex": indices,
        "varying": indices,
        "faceVarying": np.arange(len(indices)),
        "uniform": np.repeat(np.arange(len(counts)), counts),
        "constant": np.zeros(len(indices), np.int64),
    }[str(interpolation)]
    return (array, by_corner) if by_corner.max() < len(array) else None


def _computed_normals(points: Array, faces: Ints, flat: bool) -> tuple[Array, Ints]:
    """Normals for a mesh without normals: per face for polygons, per vertex for subdivision surfaces."""
    a, b, c = (points[faces[:, k]] for k in range(3))
    face_normals = np.cross(b - a, c - a)
    if flat:
        return face_normals, np.repeat(np.arange(len(faces))[:, None], 3, axis=1)
    normals = np.zeros_like(points)
    for k in range(3):
        np.add.at(normals, faces[:, k], face_normals)
    return normals, faces


def _is_closed(points: Array, faces: Ints) -> bool:
    """Whether every edge has a face on both sides, with coincident points merged."""
    _, weld = np.unique(np.round(points, 6), axis=0, return_inverse=True)
    welded = weld.reshape(-1)[faces]
    edges = np.sort(np.concatenate([welded[:, [0, 1]], welded[:, [1, 2]], welded[:, [2, 0]]]), axis=1)
    _, count = np.unique(edges, axis=0, return_counts=True)
    return bool((count >= 2).all())


def _light_colour(prim: Any) -> Array:
    """Linear colour of a light times its intensity and exposure."""
    from pxr import UsdLux

    light = UsdLux.LightAPI(prim)
    strength = light.GetIntensityAttr().Get() * 2.0 ** light.GetExposureAttr().Get()
    return np.array(light.GetColorAttr().Get(), float) * strength


def _rigid_part(matrix: Array) -> Array:
    """The rigid part of an affine matrix, with the stretch removed on the right."""
    return np.asarray(matrix @ np.linalg.inv(_stretch(matrix)))


def _stretch(matrix: Array) -> Array:
    """The symmetric stretch S (4, 4) of an affine matrix M = R S, by polar decomposition; mirrors stay in it."""
    u, s, v = np.linalg.svd(matrix[:3, :3])
    stretch = np.eye(4)
    stretch[:3, :3] = v.T @ np.diag(s) @ v
    if np.linalg.det(u @ v) < 0:
        stretch[:3, :3] *= -1.0
    return stretch


def _moved(by: Array) -> Array:
    """The translation (4, 4) ``by`` (3,) m."""
    T = np.eye(4)
    T[:3, 3] = by
    return T


def _to_metres_z_up(stage: Any) -> Array:
    from pxr import UsdGeom

    scale = UsdGeom.GetStageMetersPerUnit(stage)
    turn = Y_UP_TO_Z_UP if UsdGeom.GetStageUpAxis(stage) == UsdGeom.Tokens.y else np.eye(4)
    return np.asarray(turn @ np.diag([scale, scale, scale, 1.0]))
