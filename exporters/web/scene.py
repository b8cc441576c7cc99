"""A stage and its take as one block of bytes for the page: geometry, materials, and the motion on whole frames.

The page decodes it in `page/viewer.js`. Everything that is drawn comes from the composed stage, as for pictures; names,
paths, marks and curves come from the take. Units are metres and frames, Z up.
"""

from __future__ import annotations

import io
import json
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from vehsim.audit.scene import can_hit, distances
from vehsim.constants import GRAVITY
from vehsim.exporters.pictures.render import HAZE, bounds_of, haze_end
from vehsim.exporters.usd.sampling import clip_at
from vehsim.exporters.usd.scenery.distant_waves import DistantWaves, distant_waves
from vehsim.exporters.usd.scenery.driven import surface_of
from vehsim.exporters.usd.scenery.ground import level_ground
from vehsim.exporters.usd.scenery.lighting import encode_srgb
from vehsim.exporters.usd.scenery.shading import DEFAULT_SUN, below_horizon, dome_mean, exposure_of, sky_image
from vehsim.exporters.usd.scenery.tyre_marks import marks_of
from vehsim.exporters.usd.scenery.water import surfaces
from vehsim.exporters.usd.scenery.water_grid import Grid, Net, covers, lay_grid
from vehsim.exporters.usd.scenery.water_material import CLEAR, FOAM, ROUGH, TILE, patches, ripples
from vehsim.exporters.usd.stage import Material, Shape, StageReader
from vehsim.intake.images import read_colours
from vehsim.lie.quaternions import matrices, quaternions, yaw_of
from vehsim.planning.request.marks import Gate
from vehsim.planning.trim import flies
from vehsim.rig.linkage import part_poses
from vehsim.shot.world.obstacle_tables import with_vehicles
from vehsim.world.water.gliding import boat_of

if TYPE_CHECKING:
    from vehsim.cameras.camera import Camera
    from vehsim.clip.clip import Clip
    from vehsim.delivery.take import Take

Array = NDArray[np.float64]

LARGEST_TEXTURE = 2048
"""Longest side of a texture, px; larger ones are reduced."""
JPEG_QUALITY = 88
WATER_SAMPLES = 4_000_000
"""Points of the water's surface over all frames; a longer shot shows a coarser surface."""
WATER_WAVES = 48
"""Number of the steepest waves that the page's shading shows where the surface is too coarse."""
WATER_STEP = 1e-3
"""Resolution of the water's points, m."""
READABLE = {".jpg": "image/jpeg", ".jpeg": "image/jpeg"}
"""Pictures that a page shows as they are."""


class Packing:
    """Arrays side by side in one block; a header refers to them by place."""

    def __init__(self) -> None:
        self._chunks: list[bytes] = []
        self._size = 0

    def array(self, values: Any, kind: str) -> dict[str, Any]:
        """Add ``values`` as a type of numpy, such as "f4"; returns the reference for the header."""
        return {"kind": kind, **self.content(np.ascontiguousarray(values, np.dtype(kind).newbyteorder("<")).tobytes())}

    def content(self, content: bytes) -> dict[str, Any]:
        """Add bytes as they are; returns the reference for the header."""
        place = {"at": self._size, "size": len(content)}
        self._chunks.append(content + b"\0" * (-len(content) % 8))
        self._size += len(self._chunks[-1])
        return place

    def block(self, header: dict[str, Any]) -> bytes:
        """The length of the header in four bytes, the header as JSON, then the arrays from a multiple of eight."""
        text = json.dumps(header, allow_nan=False, separators=(",", ":")).encode()
        text += b" " * (-(4 + len(text)) % 8)
        return len(text).to_bytes(4, "little") + text + b"".join(self._chunks)


def scene_block(take: Take, stage: StageReader) -> bytes:
    """Everything that the page shows of ``take``, whose stage is ``stage``.

    The page draws in single precision: all positions in blocks are relative to the stage's ``origin``.
    """
    pack, frames = Packing(), _frames(take)
    surfaces = list(dict.fromkeys(shape.surface for shape in stage.shapes))
    textures = list(dict.fromkeys(surface.texture for surface in surfaces if surface.texture))
    header = {
        "kind": "scene",
        "name": take.name,
        "origin": stage.origin.tolist(),
        "fps": float(take.fps),
        "frames": list(take.frames),
        "picture": list(take.render.panel(len(take.render.cameras or take.cameras))),
        "textures": [_texture(pack, path) for path in textures],
        "materials": [_material(surface, textures) for surface in surfaces],
        "shapes": [_shape(pack, shape, stage.groups, surfaces) for shape in stage.shapes],
        "light": _light(pack, stage),
        **_motion(pack, take, group_poses(stage, frames), stage),
        "cameras": list(_cameras(pack, stage, take, frames)),
        "water": None if stage.water is None else _water(pack, take, stage),
        "tyreMarks": list(_tyre_marks(pack, stage)),
    }
    return pack.block(header)


def movable(take: Take) -> list[str]:
    """The paths of all prims of a take's stage that its vehicles could move."""
    found = []
    for name, clip in take.clips.items():
        root, drives = f"/{take.name}/vehicles/{name}", clip.vehicle.rig.drives if clip.vehicle.rig else {}
        found += [root, *(f"{root}/{drive.prim}" for drive in drives.values())]
    return found


def _dressed(take: Take) -> list[Any]:
    """The assets and the variants of a take's vehicles."""
    return [clip.vehicle.rig and (clip.vehicle.rig.asset, clip.vehicle.rig.variants) for clip in take.clips.values()]


def _marks_ground(take: Take) -> bool:
    """Whether tyres of a take's vehicles slide and leave marks."""
    return any(True for clip in take.clips.values() for _ in marks_of(clip, take.world.terrain, take.frames))


class Kinematics:
    """How the stage's moving prims follow from clips: new motion is shown without writing a stage again.

    A prim of a vehicle is carried by the vehicle's drives; its place on them is measured on the stage at the first
    frame.
    """

    def __init__(self, take: Take, stage: StageReader) -> None:
        self.groups, self.stage = stage.groups, stage
        self._take = take
        first = np.array([float(take.frames[0])])
        poses = group_poses(stage, first)[:, 0]
        self._at = [_vehicle_of(take, group) for group in stage.groups]
        self._rest: list[Array] = []
        for (name, path), pose in zip(self._at, poses, strict=True):
            self._rest.append(_matrices(pose[None])[0])
            if name is not None:
                carrier = _carried(clip_at(take.clips[name], first), path)[0]
                carrier[:3, 3] -= stage.origin
                self._rest[-1] = np.linalg.inv(carrier) @ self._rest[-1]

    def can_show(self, take: Take) -> bool:
        """Whether only the vehicles' motion differs from that of the stage, and nothing there was made from it."""
        return (
            list(take.clips) == list(self._take.clips)
            and take.frames == self._take.frames
            and all(name is not None for name, _ in self._at)
            and [camera.name for camera in take.cameras] == [camera.name for camera in self._take.cameras]
            and take.world.content_hash == self._take.world.content_hash
            and take.world.looks == self._take.world.looks
            and take.render == self._take.render
            and _dressed(take) == _dressed(self._take)
            and (level_ground(take) is None) == (level_ground(self._take) is None)
            and surface_of(take) == surface_of(self._take)
            and not self.stage.tyre_marks
            and not _marks_ground(take)
        )

    def moved_by(self, vehicle: str) -> list[int]:
        """The indices of a vehicle's prims."""
        return [k for k, (name, _) in enumerate(self._at) if name == vehicle]

    def poses(self, take: Take, which: Iterable[int]) -> Array:
        """Poses (groups, frames, 7) of some prims; those that no vehicle carries stay where the stage shows them."""
        frames, found = _frames(take), []
        for k in which:
            name, _ = self._at[k]
            if name is None:
                T = np.stack([self.stage.matrices(frame)[self.groups[k]] for frame in frames.tolist()])
            else:
                T = self._carry(k, clip_at(take.clips[name], frames))
            found.append(_poses(T))
        return np.stack(found) if found else np.zeros((0, len(frames), 7))

    def carried(self, name: str, clip: Clip) -> list[tuple[int, Array]]:
        """The index of each prim of a vehicle, and its poses (n, 7) at the samples of a clip."""
        return [(k, _poses(self._carry(k, clip))) for k in self.moved_by(name)]

    def _carry(self, k: int, clip: Clip) -> Array:
        """Matrices (n, 4, 4) of a prim of a vehicle at the samples of a clip."""
        T = _carried(clip, self._at[k][1])
        T[:, :3, 3] -= self.stage.origin
        return T @ self._rest[k]


def draft_block(take: Take, kinematics: Kinematics, names: Sequence[str], kind: str = "draft") -> bytes:
    """The poses and the paths of some vehicles of a take: ``kind`` "draft" while a handle is dragged, "iterate" of a
    solve, or "preview" of a solve if there is no motion yet."""
    pack, clips = Packing(), {name: clip_at(take.clips[name], _frames(take)) for name in names}
    header = {
        "kind": kind,
        "groups": [one for name, clip in clips.items() for one in _poses_of(pack, kinematics.carried(name, clip))],
        "paths": list(_paths(pack, clips, kinematics.stage)),
    }
    return pack.block(header)


def live_block(clip: Clip, kinematics: Kinematics, name: str, behind: float) -> bytes:
    """The last sample of a clip, of a vehicle that is driven now; ``behind`` s: how late the simulation is."""
    pack, now = Packing(), clip.at(clip.times[-1:])
    header = {
        "kind": "live",
        "vehicle": name,
        "frame": float(now.frames[0]),
        "behind": round(behind, 2),
        "place": (now.positions[0] - kinematics.stage.origin).tolist(),
        "heading": float(np.degrees(yaw_of(now.orientations)[0])),
        "groups": _poses_of(pack, kinematics.carried(name, now)),
    }
    return pack.block(header)


def compared_block(take: Take, kinematics: Kinematics, others: Mapping[str, tuple[str, Clip]]) -> bytes:
    """Other motions of a take's vehicles, to be drawn beside its own; ``others``: name -> vehicle and clip."""
    pack, found = Packing(), []
    for name, (vehicle, whole) in others.items():
        clip = clip_at(whole, _frames(take))
        found.append(
            {
                "name": name,
                "vehicle": vehicle,
                "groups": _poses_of(pack, kinematics.carried(vehicle, clip)),
                "points": pack.array(clip.positions - kinematics.stage.origin, "f4"),
                "curves": list(_curves(pack, take, vehicle, clip)),
            }
        )
    return pack.block({"kind": "compared", "motions": found})


def _poses_of(pack: Packing, carried: Iterable[tuple[int, Array]]) -> list[dict[str, Any]]:
    return [{"index": k, "poses": pack.array(poses, "f4")} for k, poses in carried]


def motion_block(take: Take, kinematics: Kinematics) -> bytes:
    """Everything that a new motion changes in a scene, if `Kinematics.can_show` it."""
    pack, frames = Packing(), _frames(take)
    cameras = [
        {"name": camera.name, "poses": pack.array(poses, "f4"), "lens": pack.array(lens, "f4")}
        for camera in take.cameras
        for poses, lens in [_camera(camera, frames, kinematics.stage.origin)]
    ]
    poses = kinematics.poses(take, range(len(kinematics.groups)))
    return pack.block({"kind": "motion", **_motion(pack, take, poses, kinematics.stage), "cameras": cameras})


@dataclass(frozen=True)
class DrawnWater:
    """The moving surface of a take's water: its ``block`` for the page, and what it was made of."""

    block: bytes
    grid: Grid
    origin: Array
    content: str

    def shows(self, take: Take, stage: StageReader) -> bool:
        """Whether it is also that of another take, whose flying vehicles and cameras may move where it is fine."""
        same = np.array_equal(self.origin, stage.origin) and self.content == _stirred(take)
        return same and covers(self.grid, take)


def _stirred(take: Take) -> str:
    """A hash of what moves a take's water: waves, wind and what floats."""
    afloat = {name: clip for name, clip in take.clips.items() if boat_of(clip.vehicle) is not None}
    return replace(take, name="", clips=afloat, cameras=(), world=take.world.with_only(())).content_hash


def draw_water(take: Take, stage: StageReader, progress: Callable[[float], object]) -> DrawnWater:
    """The moving surface of a take's water, computed without writing a stage; ``stage`` gives the origin.

    ``progress`` receives the share of the frames that are done.
    """
    grid, frames, pack = lay_grid(take), _frames(take), Packing()
    net = Net.over(grid.stored)

    def shown() -> Iterator[tuple[Array, Array]]:
        for k, surface in enumerate(surfaces(take, grid, frames)):
            progress(k / len(frames))
            yield net.of(surface.points - stage.origin), net.of(surface.foam)

    waves, on = distant_waves(take, grid), net.of
    waves = None if waves is None else waves._replace(cell=on(waves.cell), share=on(waves.share))
    surface = _surface(pack, net.shape, net.of(grid.xy), shown(), frames, waves)
    block = pack.block({"kind": "water", **surface})
    return DrawnWater(block, grid, stage.origin, _stirred(take))


def _motion(pack: Packing, take: Take, poses: Array, stage: StageReader) -> dict[str, Any]:
    """What changes when a take is solved again. ``poses`` (groups, frames, 7): x, y, z, then the quaternion
    x, y, z, w."""
    frames = _frames(take)
    clips = {name: clip_at(clip, frames) for name, clip in take.clips.items()}
    return {
        "groups": [
            {"vehicle": _vehicle_of(take, group)[0], "poses": pack.array(pose, "f4")}
            for group, pose in zip(stage.groups, poses, strict=True)
        ],
        "paths": list(_paths(pack, clips, stage)),
        "marks": [_placed(mark, -stage.origin) for mark in marks_shown(take)],
        "unplaced": list(_unplaced(take)),
        "notes": [_placed(note, -stage.origin) for note in take.report.get("shot", {}).get("note", [])],
        "curves": [curve for name, clip in clips.items() for curve in _curves(pack, take, name, clip)],
    }


def _paths(pack: Packing, clips: Mapping[str, Clip], stage: StageReader) -> Iterator[dict[str, Any]]:
    for name, clip in clips.items():
        yield {"name": name, "points": pack.array(clip.positions - stage.origin, "f4")}


def _frames(take: Take) -> Array:
    return np.arange(take.frames[0], take.frames[1] + 1, dtype=float)


def _vehicle_of(take: Take, group: str) -> tuple[str | None, str]:
    """The vehicle that moves a prim, None for none, and the prim's path below it."""
    prefix = f"/{take.name}/vehicles/"
    if not group.startswith(prefix):
        return None, ""
    name, _, path = group.removeprefix(prefix).partition("/")
    return name, path


def _carried(clip: Clip, path: str) -> Array:
    """Matrices (n, 4, 4) that carry the prim at ``path`` from its rest in the root's frame into the world."""
    T = np.tile(np.eye(4), (len(clip), 1, 1))
    assert clip.vehicle.rig is not None
    T[:, :3, 3], turn = part_poses(clip.vehicle.rig, path, clip.channels, clip.positions, clip.orientations)
    T[:, :3, :3] = matrices(turn)
    return T


def _camera(camera: Camera, frames: Array, origin: Array) -> tuple[Array, Array]:
    """Poses (n, 7), relative to ``origin`` (3,) m, and lens (n, 3) of a take's camera.

    It has a sample on every whole frame.
    """
    at = np.clip(np.searchsorted(camera.frames, frames - 1e-6), 0, len(camera.frames) - 1)
    lens = np.broadcast_to(camera.lens_mm, camera.frames.shape)[at]
    half = camera.aperture_mm[0] / (2 * lens)
    turn = np.roll(camera.orientations[at], -1, axis=1)
    return np.column_stack([camera.positions[at] - origin, turn]), np.column_stack([half, 0 * half, 0 * half])


def group_poses(stage: StageReader, frames: Array) -> Array:
    """Poses (groups, frames, 7) of the stage's moving prims."""
    matrices = [stage.matrices(frame) for frame in frames.tolist()]
    if not stage.groups:
        return np.zeros((0, len(frames), 7))
    return np.stack([_poses(np.stack([each[group] for each in matrices])) for group in stage.groups])


def _poses(T: Array) -> Array:
    """Positions and quaternions x, y, z, w (n, 7) of matrices (n, 4, 4)."""
    return np.column_stack([T[:, :3, 3], np.roll(quaternions(T[:, :3, :3]), -1, axis=1)])


def _matrices(poses: Array) -> Array:
    """The inverse of `_poses`."""
    T = np.tile(np.eye(4), (len(poses), 1, 1))
    T[:, :3, :3], T[:, :3, 3] = matrices(np.roll(poses[:, 3:], 1, axis=1)), poses[:, :3]
    return T


def _shape(pack: Packing, shape: Shape, groups: tuple[str, ...], surfaces: list[Material]) -> dict[str, Any]:
    """A mesh with one vertex per pair of point and normal (and texture coordinates)."""
    corners = [shape.faces, shape.face_normals]
    if shape.uvs is not None and shape.face_uvs is not None:
        corners.append(shape.face_uvs)
    used, faces = _distinct([each.ravel() for each in corners])
    normals = np.zeros((len(used[0]), 4))
    normals[:, :3] = np.round(127 * shape.normals[used[1]])
    return {
        "name": shape.name,
        "group": groups.index(shape.group) if shape.group else -1,
        "material": surfaces.index(shape.surface),
        "double": not shape.closed,
        "points": pack.array(shape.points[used[0]], "f4"),
        "normals": pack.array(normals, "i1"),
        "uvs": None if shape.uvs is None else pack.array(shape.uvs[used[2]], "f4"),
        "faces": pack.array(faces, "u4"),
    }


def _distinct(columns: Sequence[NDArray[np.integer]]) -> tuple[list[NDArray[np.integer]], NDArray[np.integer]]:
    """The distinct tuples of columns (n,) of indices, column by column, in their order; and which of them each is.

    As one number each, they are sorted ten times faster than as rows.
    """
    sizes = [int(column.max(initial=0)) + 1 for column in columns]
    packed, which = np.unique(np.ravel_multi_index(columns, sizes), return_inverse=True)
    return list(np.unravel_index(packed, sizes)), which


def _material(surface: Material, textures: list[Path]) -> dict[str, Any]:
    return {
        "colour": list(surface.colour),
        "opacity": surface.opacity,
        "roughness": surface.roughness,
        "metallic": surface.metallic,
        "emission": surface.emission,
        "texture": None if surface.texture is None else textures.index(surface.texture),
    }


def _texture(pack: Packing, path: Path) -> dict[str, Any]:
    """A texture as a browser reads it: its own file if that is a JPEG of moderate size, else encoded again."""
    from PIL import Image

    pixels = read_colours(path)
    if path.suffix.lower() in READABLE and max(pixels.shape) <= LARGEST_TEXTURE:
        return {"type": READABLE[path.suffix.lower()], **pack.content(path.read_bytes())}
    image = Image.fromarray(pixels)
    image.thumbnail((LARGEST_TEXTURE, LARGEST_TEXTURE))
    return _jpeg(pack, image)


def _jpeg(pack: Packing, image: Any) -> dict[str, Any]:
    file = io.BytesIO()
    image.save(file, "jpeg", quality=JPEG_QUALITY)
    return {"type": "image/jpeg", **pack.content(file.getvalue())}


def _light(pack: Packing, stage: StageReader) -> dict[str, Any]:
    """The stage's own lights, exposed as the pictures are: white in full sun is just above display white."""
    from PIL import Image

    sky, key = stage.sky(), stage.sun() or DEFAULT_SUN
    image = sky_image(sky)
    exposure = exposure_of(key, dome_mean(image))
    grounded = stage.water is None and any(not shape.group for shape in stage.shapes)
    shown = encode_srgb((below_horizon(image) if grounded else image) * exposure)
    horizon = shown[int(image.shape[0] * 0.49)].mean(axis=0) / 255.0
    lower, upper = bounds_of(stage)
    return {
        "direction": key.direction.tolist(),
        "sun": (key.colour * exposure).tolist(),
        "sky": _jpeg(pack, Image.fromarray(shown)),
        "R_wd": (np.eye(3) if sky is None else sky.R_wd).tolist(),
        "haze": {"colour": horizon.tolist(), "start": HAZE[0], "end": haze_end(stage)},
        "bounds": [lower.tolist(), upper.tolist()],
        "grounded": grounded,
    }


def _cameras(pack: Packing, stage: StageReader, take: Take, frames: Array) -> Iterator[dict[str, Any]]:
    """The stage's cameras, in the take's order; shift and half of the picture's width at distance 1, for each frame."""
    order = [camera.name for camera in take.cameras]
    for name in sorted(stage.cameras, key=lambda each: (each not in order, order.index(each) if each in order else 0)):
        views = [stage.camera(name, frame) for frame in frames.tolist()]
        yield {
            "name": name,
            "poses": pack.array(_poses(np.stack([view.T_wc for view in views])), "f4"),
            "lens": pack.array([(view.half_width, *view.shift) for view in views], "f4"),
            "near": views[0].clip[0],
        }


def _water(pack: Packing, take: Take, stage: StageReader) -> dict[str, Any]:
    """The stage's surface, and how it looks."""
    frames = _frames(take)
    drawn = frames if take.usd.moving_water else frames[:1]
    shown = ((points, foam) for points, _, foam, _ in map(stage.water_at, drawn.tolist()))
    return {
        **_surface(pack, stage.water_net.shape, TILE * stage.water_st(), shown, frames, stage.water_waves()),
        "ripples": {"type": "image/png", **pack.content(ripples())},
        "tile": TILE,
        "clear": CLEAR.tolist(),
        "white": FOAM.tolist(),
        "rough": ROUGH[0],
    }


def _surface(
    pack: Packing,
    shape: tuple[int, int],
    rest: Array,
    shown: Iterable[tuple[Array, Array]],
    frames: Array,
    waves: DistantWaves | None,
) -> dict[str, Any]:
    """A moving surface in steps of `WATER_STEP`, as second differences over time, which compress to a few bits.

    ``shown``: its points (n, 3) m and foam (n,) on a net of ``shape``, at ``frames``; ``rest`` (n, 2) m: the points at
    rest; ``waves``: those that shading adds.
    """
    rows, cols = shape
    count = len(frames)
    halvings = (2**k for k in range(7))  # columns are a multiple of 16, and one more
    every = next(k for k in halvings if -(-rows // k) * -(-cols // k) * count <= WATER_SAMPLES or k == 64)
    chosen = np.arange(rows * cols).reshape(rows, cols)[::every, ::every]
    fewer = [
        (points[chosen.ravel()], patches(rest[chosen.ravel()].T, foam[chosen.ravel()], np.inf))
        for points, foam in shown
    ]
    points, foam = (np.stack(each) for each in zip(*fewer, strict=True))
    moved = points - points[0]
    bends = np.diff(moved, n=2, axis=0, prepend=np.zeros((2, *moved.shape[1:])))
    step = max(WATER_STEP, float(np.abs(bends).max()) / 30_000)  # they are stored in 16 bits
    steps = np.round(moved / step).astype(np.int32)
    shaded = (
        {}
        if waves is None
        else _shaded(pack, waves, np.column_stack([rest, waves.cell, waves.share])[chosen.ravel()], frames)
    )
    return {
        **shaded,
        "shape": list(chosen.shape),
        "step": step,
        "start": pack.array(points[0], "f4"),
        "bends": pack.array(np.diff(steps, n=2, axis=0, prepend=np.zeros((2, *moved.shape[1:]), np.int32)), "i2"),
        "foam": pack.array(np.round(255 * foam), "u1"),
    }


def _shaded(pack: Packing, waves: DistantWaves, places: Array, frames: Array) -> dict[str, Any]:
    """The steepest waves for the page's shading, and the ``places`` (n, 4) of the surface's points: at rest, the length
    of the cells there, m, and the share that moles leave."""
    steepest = np.argsort(-waves.steepness, kind="stable")[:WATER_WAVES]
    step = frames[1] - frames[0] if len(frames) > 1 else 1.0
    only = np.arange(len(waves.amplitude)) >= waves.meshed
    rows = np.column_stack(
        [waves.number, waves.phase - waves.turn * frames[0], waves.turn * step, waves.amplitude, only]
    )
    return {
        "waves": rows[steepest].tolist(),
        "carried": waves.carried.tolist(),
        "places": pack.array(places, "f4"),
    }


def _tyre_marks(pack: Packing, stage: StageReader) -> Iterator[dict[str, Any]]:
    """Ribbons as they are in the end, with the frame on which each row is made."""
    for ribbon, made in stage.tyre_marks_made():
        yield {
            "rows": pack.array(ribbon.rows, "f4"),
            "opacity": pack.array(ribbon.opacity, "f4"),
            "made": pack.array(made, "f4"),
            "colour": ribbon.colour.tolist(),
        }


def _placed(one: Mapping[str, Any], by: Array) -> dict[str, Any]:
    """A mark or note whose position, if it has one, is moved ``by`` (3,) m."""
    if (place := one.get("position")) is None:
        return {**one}
    return {**one, "position": (np.asarray(place, float) + by[: len(place)]).tolist()}


def marks_shown(take: Take) -> Iterator[dict[str, Any]]:
    """The marks with a place: vehicle, index, frame, position; heading in degrees where the motion passes.
    ``grounded``: the ground gives the height, not the mark."""
    for name, marks in take.report.get("marks", {}).items():
        clip = take.clips[name]
        grounded = clip.vehicle.group.planar and take.world.terrain is not None
        for k, mark in enumerate(marks):
            if mark.get("position") is None:
                continue
            place = np.array(mark["position"], float)
            frame = mark["frame"]
            if not isinstance(frame, int | float):  # the planner's choice
                away = np.linalg.norm(clip.positions[:, : len(place)] - place, axis=1)
                frame = float(clip.frames[away.argmin()])
            there = clip_at(clip, np.array([float(frame)]))
            given = 2 if grounded else len(place)
            yield {
                "vehicle": name,
                "index": k,
                "frame": float(frame),
                "position": [*place[:given].tolist(), *there.positions[0, given:].tolist()],
                "grounded": grounded,
                "heading": float(np.degrees(yaw_of(there.orientations)[0])),
                "gate": None if mark.get("gate") is None else _opening(Gate(**mark["gate"])),
            }


def _unplaced(take: Take) -> Iterator[dict[str, Any]]:
    """The marks with a frame but without a place, such as of a heading only: vehicle, index and frame."""
    for table in take.report.get("shot", {}).get("vehicle", []):
        for k, mark in enumerate((table.get("motion") or {}).get("mark") or [] if table["name"] in take.clips else []):
            if mark.get("position") is None and isinstance(mark.get("frame"), int | float):
                yield {"vehicle": table["name"], "index": k, "frame": float(mark["frame"])}


def _opening(gate: Gate) -> dict[str, Any]:
    """The border of a gate around its centre: closed ``points`` (n, 3) m in axes along its direction, its width and its
    height, which are turned by ``heading`` and up by ``tilt``, in degrees."""
    if gate.size is None:
        turn = np.linspace(0.0, 2 * np.pi, 49)
        across, up = gate.radius * np.column_stack([np.cos(turn), np.sin(turn)]).T  # type: ignore[operator]  # without a size it has one
    else:
        across, up = np.array([[-1, 1, 1, -1, -1], [-1, -1, 1, 1, -1]]) * np.reshape(gate.size, (2, 1)) / 2
    x, y, z = gate.direction
    return {
        "points": np.column_stack([0 * up, across, up]).tolist(),
        "heading": float(np.degrees(np.arctan2(y, x))),
        "tilt": float(np.degrees(np.arctan2(z, np.hypot(x, y)))),
    }


def _curves(pack: Packing, take: Take, name: str, clip: Clip) -> Iterator[dict[str, Any]]:
    """Speed, load, clearance and controls on whole frames, each with its lower and upper limit or None."""
    motion = _motion_table(take, name)
    limits = motion.get("limits", {})
    velocity = _slopes(clip.times, clip.positions)
    load = np.linalg.norm(_slopes(clip.times, velocity) + np.array([0.0, 0.0, GRAVITY]), axis=1) / GRAVITY
    table: dict[str, tuple[Array, str, float | None, float | None]] = {
        "speed": (np.linalg.norm(velocity, axis=1), "m/s", None, limits.get("speed")),
        "g_load": (load, "g", None, limits.get("g_load")),
    }
    world = with_vehicles(take.world, take.clips, _avoided(take), name)
    if can_hit(clip.vehicle, world):
        table["clearance"] = distances(clip, world), "m", motion.get("clearance"), None
    released = None if flies(clip.vehicle) else 0.0  # a bound there, such as that of a brake, limits nothing
    table |= {
        control.name: (
            values,
            control.unit,
            *(end if end != released else None for end in (control.lower, control.upper)),
        )
        for control, values in zip(clip.vehicle.controls, clip.controls.T, strict=False)
    }
    for curve, (values, unit, *bounds) in table.items():
        low, high = (bound if bound is not None and np.isfinite(bound) else None for bound in bounds)
        yield {
            "vehicle": name, "name": curve, "unit": unit, "low": low, "high": high, "values": pack.array(values, "f4"),
        }  # fmt: skip


def _slopes(times: Array, values: Array) -> Array:
    return np.gradient(values, times, axis=0, edge_order=2) if len(times) > 2 else np.zeros_like(values)


def _motion_table(take: Take, name: str) -> dict[str, Any]:
    """What the shot file gives as a vehicle's motion; empty if there is no shot file."""
    vehicles = take.report.get("shot", {}).get("vehicle", ())
    found: dict[str, Any] = next((table for table in vehicles if table.get("name") == name), {})
    motion: dict[str, Any] = found.get("motion", {})
    return motion


def _avoided(take: Take) -> set[str]:
    """The vehicles that are obstacles for the others."""
    tables = take.report.get("shot", {}).get("world", {}).get("obstacle", ())
    return {table["vehicle"] for table in tables if table.get("shape") == "vehicle"}
