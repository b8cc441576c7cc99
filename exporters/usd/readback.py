"""Open the written shot and compare it with the clips: an opinion that is hidden by another is an error."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from vehsim.errors import ExportError
from vehsim.exporters.usd.metadata import Z_UP_METRES, Units
from vehsim.exporters.usd.sampling import clip_at, frames_of
from vehsim.lie import quaternions
from vehsim.rig.ops import drive_op, open_rig, scalar_op
from vehsim.rig.posed import posed

if TYPE_CHECKING:
    from vehsim.cameras.camera import Camera
    from vehsim.clip.clip import Clip
    from vehsim.rig.tolerances import Tolerances

Array = NDArray[np.float64]

TOLERANCE = 1e-5
"""Largest permitted difference of any entry of a world matrix, m or 1."""


def check_readback(
    path: Path,
    clips: Mapping[str, Clip],
    cameras: Mapping[str, Camera] = MappingProxyType({}),
    units: Units = Z_UP_METRES,
) -> None:
    """Compare the composed stage with ``clips`` and ``cameras`` by prim path, at every frame with samples.

    Raises ``ExportError`` naming the first prim and frame that differ by more than `TOLERANCE`.
    """
    from pxr import Usd, UsdGeom

    stage = Usd.Stage.Open(str(path))
    expected: dict[str, tuple[Array, Array]] = {}
    for prim_path, clip in clips.items():
        for part, matrices in expected_matrices(clip, stage.GetTimeCodesPerSecond()).items():
            expected[f"{prim_path}{'/' if part else ''}{part}"] = (frames_of(clip), matrices)
    for prim_path, camera in cameras.items():
        pose = _pose_matrices(camera.positions, camera.orientations)
        expected[prim_path] = (np.asarray(camera.frames, float), pose)
    to_metres = np.linalg.inv(units.matrix)
    for prim_path, (frames, matrices) in expected.items():
        prim = stage.GetPrimAtPath(prim_path)
        if not prim:
            raise ExportError(
                "not there when read back", "is the asset's prim deactivated?", key=prim_path, file=path.name
            )
        found = to_metres @ world_matrices(prim, frames)
        if prim.IsA(UsdGeom.Camera):  # it keeps its own axes and size
            found[:, :3, :3] /= np.linalg.norm(found[:, :3, :3], axis=1, keepdims=True)
        difference = np.abs(found - matrices).max(axis=(1, 2))
        worst = int(np.argmax(~(difference <= TOLERANCE)))
        if not difference[worst] <= TOLERANCE:
            raise ExportError(
                f"at frame {frames[worst]:g} its world matrix differs from the clip's by {difference[worst]:.3g}",
                "a stronger opinion (an instance, a variant, animation of the asset's own) hides ours",
                key=prim_path,
                file=path.name,
            )


def check_curves(path: Path, prim_path: str, clip: Clip, tolerances: Tolerances, units: Units = Z_UP_METRES) -> None:
    """Compare a layer of curves with its clip at eighths of every frame: the root's pose, and each channel.

    Raises ``ExportError`` naming the first part and frame beyond the tolerances.
    """
    from pxr import Usd, UsdGeom

    stage, rig = Usd.Stage.Open(str(path)), clip.vehicle.rig
    assert rig is not None
    first, last = max(stage.GetStartTimeCode(), clip.start_frame), min(stage.GetEndTimeCode(), clip.end_frame)
    at = clip_at(clip, np.arange(round((last - first) * 8) + 1) / 8 + first)
    frames, expected = frames_of(at), expected_matrices(at, stage.GetTimeCodesPerSecond())[""]
    found = np.linalg.inv(units.matrix) @ world_matrices(stage.GetPrimAtPath(prim_path), frames)
    turned = np.linalg.inv(expected[:, :3, :3]) @ found[:, :3, :3] - np.eye(3)
    off = {
        prim_path: np.maximum(
            np.linalg.norm(found[:, :3, 3] - expected[:, :3, 3], axis=1) / tolerances.distance,
            np.linalg.norm(turned, axis=(1, 2)) / np.sqrt(2) / tolerances.angle,
        )
    }
    scale = UsdGeom.GetStageMetersPerUnit(open_rig(rig.asset, rig)[0])
    for channel, drive in rig.drives.items():
        op, factor = drive_op(drive.op, scale)
        attribute = stage.GetPrimAtPath(f"{prim_path}{'/' if drive.prim else ''}{drive.prim}").GetAttribute(
            scalar_op(op)
        )
        shown = Usd.AttributeQuery(attribute) if attribute else None
        values = np.zeros(len(frames)) if shown is None else np.array([shown.Get(frame) for frame in frames.tolist()])
        error = np.abs(values / (factor * drive.factor) - at.channels[channel])
        off[f"{prim_path}/{drive.prim}"] = error / tolerances.channels[channel]
    for part, errors in off.items():
        worst = int(errors.argmax())
        if not errors[worst] <= 1.01:
            raise ExportError(
                f"at frame {frames[worst]:g} its curve is {errors[worst]:.3g} times the tolerance from the clip",
                "report this as a bug, or leave out export.curves",
                key=part,
                file=path.name,
            )


def world_matrices(prim: Any, frames: Array) -> Array:
    """World matrices (n, 4, 4) of a prim at ``frames``, for column vectors, as USD composes them."""
    from pxr import UsdGeom

    cache = UsdGeom.XformCache()
    matrices = np.empty((len(frames), 4, 4))
    for k, frame in enumerate(frames.tolist()):
        cache.SetTime(frame)
        matrices[k] = np.array(cache.GetLocalToWorldTransform(prim)).T
    return matrices


def expected_matrices(clip: Clip, codes_per_second: float = 24.0) -> dict[str, Array]:
    """Expected matrices from the clip: part path below the rig root ("" is the root) -> world matrices (n, 4, 4).

    From the source asset, not the copy: it shares no code with the layer's writer but the place of an op in its order.
    """
    rig = clip.vehicle.rig
    assert rig is not None
    return posed(rig, clip.matrices(), clip.channels, frames_of(clip), codes_per_second)


def _pose_matrices(positions: Array, orientations: Array) -> Array:
    """Matrices (n, 4, 4) of poses; quaternions w, x, y, z."""
    poses = np.tile(np.eye(4), (len(positions), 1, 1))
    poses[:, :3, :3] = quaternions.matrices(orientations)
    poses[:, :3, 3] = positions
    return poses
