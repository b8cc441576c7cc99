"""The strobe exporter: one still with many poses of a motion, as under a stroboscope.

The poses are the shipped animation itself, referenced many times with time offsets into a stage beside the shot, so
light, shadows and ground equal the film's. This module chooses the poses and a view.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from vehsim.cameras.camera import Camera
from vehsim.cameras.framing import look_at, vehicle_outline
from vehsim.delivery.exporters import Exporter
from vehsim.delivery.take import Take
from vehsim.exporters.usd.metadata import author_stage_metadata
from vehsim.lie.quaternions import quaternions
from vehsim.runtime.progress import Progress
from vehsim.world.obstacles.plane import distance

if TYPE_CHECKING:
    from vehsim.clip.clip import Clip

Array = NDArray[np.float64]

POSES = (5, 24)
"""Least and greatest number of poses of a vehicle."""
SPACING = 1.5
"""Typical distance between poses, in lengths of the vehicle."""
ELEVATIONS = (28.0, 40.0, 55.0, 72.0)
"""Elevations of the view, degrees, tried in turn until the ground hides little."""
SEEN = 0.97
"""Share of the motion that must be visible; otherwise a higher view is used."""
LENS, APERTURE = 50.0, 36.0
"""Focal length, mm: long enough that near and far poses have similar sizes."""
FRAMING = 1.12
"""Width of the view relative to the motion."""


def write_strobe(take: Take, folder: Path, progress: Progress) -> Sequence[Path]:
    """Write ``<shot>.strobe.png``; returns it."""
    from PIL import Image

    from vehsim.exporters.pictures.render import StageRenderer
    from vehsim.exporters.usd.stage import StageReader

    progress("strobe", 0.0)
    size = take.render.size
    camera = strobe_camera(take.clips, take.world, take.frames, size[0] / size[1])
    stage_path = folder / f".{take.name}.strobe.usda"
    try:
        _write_stage(take, stage_path, camera)
        settings = {"size": size, "shadows": take.render.shadows, "samples": take.render.samples}
        with StageRenderer(StageReader(stage_path), **settings) as renderer:
            picture = renderer.render("strobe", take.frames[0])
    finally:
        stage_path.unlink(missing_ok=True)
    path = folder / f"{take.name}.strobe.png"
    Image.fromarray(picture).save(path, compress_level=6)
    return [path]


def strobe_frames(clip: Clip, frames: tuple[int, int]) -> list[int]:
    """Evenly spaced whole frames, as many as there is room for; without overlapping poses, as at the start and the end,
    if enough remain."""
    span = max(clip.start_frame, frames[0]), min(clip.end_frame, frames[1])
    distance = np.append(0.0, np.linalg.norm(np.diff(clip.positions, axis=0), axis=1).cumsum())
    length = float(np.ptp(vehicle_outline(clip.vehicle), axis=0).max())
    count = int(np.clip(distance[-1] / (SPACING * max(length, 1e-3)) + 1, *POSES))
    even = sorted({round(frame) for frame in np.linspace(*span, count)})
    gone = np.interp((np.array(even) - clip.start_frame) / float(clip.fps), clip.times, distance)
    apart, last = even[:1], gone[0]
    for frame, here in zip(even[1:-1], gone[1:-1], strict=True):
        if here - last > length and gone[-1] - here > length:
            apart.append(frame)
            last = here
    apart += even[-1:]
    return apart if len(apart) >= POSES[0] else even


def strobe_camera(clips: Mapping[str, Clip], world: Any, frames: tuple[int, int], aspect: float) -> Camera:
    """A still camera that sees every pose of every clip, from the side where the ground hides least."""
    corners = np.concatenate([_corners(clip, strobe_frames(clip, frames)) for clip in clips.values()])
    aperture = (APERTURE, APERTURE / aspect)
    best: tuple[float, Array, Array] = (-np.inf, np.zeros(3), np.eye(3))
    for elevation in ELEVATIONS:
        for azimuth in _azimuths(corners):
            place, rotation = _framed(corners, azimuth, elevation, aperture)
            seen = _seen(place, corners, world)
            if seen > best[0] + 1e-9:
                best = (seen, place, rotation)
        if best[0] >= SEEN:
            break
    _, place, rotation = best
    return Camera("strobe", np.array([float(frames[0])]), place[None], quaternions(rotation)[None], LENS, aperture)


def _corners(clip: Clip, frames: Sequence[int]) -> Array:
    """Points (n, 3) of the vehicle's outline at ``frames``."""
    motion = clip.at((np.array(frames, float) - clip.start_frame) / float(clip.fps))
    outline = vehicle_outline(clip.vehicle)
    T_wr = motion.matrices()
    return np.asarray((np.einsum("nij,kj->nki", T_wr[:, :3, :3], outline) + T_wr[:, None, :3, 3]).reshape(-1, 3))


def _azimuths(corners: Array) -> Array:
    """Viewing directions, degrees: first perpendicular to the motion's length, then rotated from there."""
    flat = corners[:, :2] - corners[:, :2].mean(axis=0)
    long = np.linalg.svd(flat, full_matrices=False)[2][0]
    across = np.degrees(np.arctan2(long[0], -long[1]))
    return np.asarray(across + np.array([25.0, -25.0, 155.0, 205.0, 0.0, 180.0, 55.0, -55.0, 125.0, 235.0]))


def _framed(corners: Array, azimuth: float, elevation: float, aperture: tuple[float, float]) -> tuple[Array, Array]:
    """Position (3,) and rotation R_wc (3, 3) of a camera whose view just contains all ``corners`` along a direction."""
    a, e = np.radians([azimuth, -elevation])
    forward = np.array([np.cos(a) * np.cos(e), np.sin(a) * np.cos(e), np.sin(e)])
    rotation = look_at(np.zeros((1, 3)), forward[None])[0]
    own = corners @ rotation
    half = np.array([aperture[0], aperture[1]]) / (2 * LENS * FRAMING)
    place = np.zeros(3)
    for k in (0, 1):  # the planes of the view through the outermost corners meet at the camera
        right = (own[:, k] + half[k] * own[:, 2]).max()
        left = (-own[:, k] + half[k] * own[:, 2]).max()
        place[k] = (right - left) / 2
        place[2] = max(place[2] if k else -np.inf, (right + left) / (2 * half[k]))
    return rotation @ place, rotation


def _seen(place: Array, corners: Array, world: Any) -> float:
    """Share of ``corners`` with a line of sight clear of the ground and of standing obstacles."""
    points = corners[:: max(1, len(corners) // 200)] + np.array([0, 0, 0.3])
    share = np.linspace(0.02, 0.98, 80)[:, None, None]
    line = place + share * (points - place)
    flat = line[..., :2].reshape(-1, 1, 2)
    ground = np.asarray(world.height(flat[:, 0]))
    for obstacle in world.obstacles:
        for part in getattr(obstacle, "parts", ()):
            ground = np.where(distance(flat, part) <= 0, np.maximum(ground, obstacle.top), ground)
    ground = ground.reshape(line.shape[:2])
    return float((ground < line[..., 2]).all(axis=0).mean())


def _write_stage(take: Take, path: Path, camera: Camera) -> None:
    """The shot's stage with each vehicle many times: its animation with an offset that moves each frame to the
    first."""
    from pxr import Sdf, Usd, UsdGeom

    from vehsim.exporters.usd.exporter import author_camera

    stage = Usd.Stage.CreateNew(str(path))
    layer = stage.GetRootLayer()
    layer.subLayerPaths = [f"./{take.name}.usda"]
    author_stage_metadata(layer, take.fps, (take.frames[0], take.frames[0]))
    root = f"/{take.name}"
    stage.SetDefaultPrim(stage.GetPrimAtPath(root))
    for other in take.cameras:
        stage.OverridePrim(f"{root}/cameras/{other.name}").SetActive(False)
    for name, clip in take.clips.items():
        stage.OverridePrim(f"{root}/vehicles/{name}").SetActive(False)
        for frame in strobe_frames(clip, take.frames):
            pose = UsdGeom.Xform.Define(stage, f"{root}/vehicles/{name}_{frame}".replace("-", "_"))
            offset = Sdf.LayerOffset(take.frames[0] - frame)
            pose.GetPrim().GetReferences().AddReference(f"./layers/{name}.anim.usdc", offset)
    author_camera(stage, f"{root}/cameras/{camera.name}", camera)
    layer.Save()


exporter = Exporter(name="strobe", suffixes=(), write=write_strobe, needs=("usd",), makes="one still with many poses")
