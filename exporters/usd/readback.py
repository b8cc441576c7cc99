"""Open the written shot and compare it with the clips: an opinion that is hidden by another is an error."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from vehsim.errors import ExportError
from vehsim.exporters.usd.metadata import Z_UP_METRES, Units
from vehsim.exporters.usd.sampling import clip_at, frames_of
from vehsim.lie import quaternions
from vehsim.rig.ops import PIVOT, drive_op, open_rig, pivot_of, place_op, scalar_op
from vehsim.rig.parts import Y_UP_TO_Z_UP

if TYPE_CHECKING:
    from vehsim.cameras.camera import Camera
    from vehsim.clip.clip import Clip
    from vehsim.rig.rig import Rig

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


def check_curves(
    path: Path, prim_path: str, clip: Clip, tolerances: tuple[float, float], units: Units = Z_UP_METRES
) -> None:
    """Compare a layer of curves with its clip at eighths of every frame: the root's pose, and each channel.

    ``tolerances``: m and degrees. Raises ``ExportError`` naming the first part and frame beyond them.
    """
    from pxr import Usd, UsdGeom

    stage, rig = Usd.Stage.Open(str(path)), clip.vehicle.rig
    assert rig is not None
    first, last = max(stage.GetStartTimeCode(), clip.start_frame), min(stage.GetEndTimeCode(), clip.end_frame)
    at = clip_at(clip, np.arange(round((last - first) * 8) + 1) / 8 + first)
    frames, expected = frames_of(at), expected_matrices(at, stage.GetTimeCodesPerSecond())[""]
    found = np.linalg.inv(units.matrix) @ world_matrices(stage.GetPrimAtPath(prim_path), frames)
    turned = np.linalg.inv(expected[:, :3, :3]) @ found[:, :3, :3] - np.eye(3)
    metres, angle = tolerances[0] * 1.01, np.radians(tolerances[1]) * 1.01
    off = {
        prim_path: np.maximum(
            np.linalg.norm(found[:, :3, 3] - expected[:, :3, 3], axis=1) / metres,
            np.linalg.norm(turned, axis=(1, 2)) / np.sqrt(2) / angle,
        )
    }
    scale = UsdGeom.GetStageMetersPerUnit(open_rig(rig.asset, rig)[0])
    for channel, drive in rig.drives.items():
        op, factor = drive_op(drive.op, scale)
        attribute = stage.GetPrimAtPath(f"{prim_path}{'/' if drive.prim else ''}{drive.prim}").GetAttribute(
            scalar_op(op)
        )
        values = np.array([attribute.Get(frame) for frame in frames.tolist()]) if attribute else np.zeros(len(frames))
        error = np.abs(values / (factor * drive.factor) - at.channels[channel])
        off[f"{prim_path}/{drive.prim}"] = error / (angle if drive.op.startswith("rotate") else metres)
    for part, errors in off.items():
        worst = int(errors.argmax())
        if not errors[worst] <= 1:
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

    It reads the source asset, not the copy, and multiplies the ops itself, so it shares no code with the export.
    """
    from pxr import UsdGeom

    rig = clip.vehicle.rig
    assert rig is not None
    stage, root = open_rig(rig.asset, rig)
    scale = UsdGeom.GetStageMetersPerUnit(stage)
    turn = Y_UP_TO_Z_UP if UsdGeom.GetStageUpAxis(stage) == UsdGeom.Tokens.y else np.eye(4)
    pose = clip.matrices() @ turn @ np.diag([scale, scale, scale, 1.0])
    by_prim: dict[str, list[tuple[str, str, Array]]] = {}
    for channel, drive in rig.drives.items():
        op, factor = drive_op(drive.op, scale)
        turned = _op_matrices(drive.op, clip.channels[channel] * factor * drive.factor)
        pivot = pivot_of(rig, channel, root, scale)
        if pivot is not None:
            turned = _shift(pivot) @ turned @ _shift(-pivot)
        by_prim.setdefault(drive.prim, []).append((channel, op, turned))

    # the asset's own animation continues below ours, by its own clock
    codes = frames_of(clip) * stage.GetTimeCodesPerSecond() / codes_per_second
    worlds = {"": pose @ _local_matrices(rig, root, root, by_prim.get("", []), codes)}
    for path in by_prim:
        world = worlds[""]
        prim = root
        for step in path.split("/") if path else ():
            prim = prim.GetChild(step)
            below = str(prim.GetPath())[len(str(root.GetPath())) + 1 :]
            xformable = UsdGeom.Xformable(prim)
            start = np.broadcast_to(np.eye(4), world.shape) if xformable.GetResetXformStack() else world
            world = start @ _local_matrices(rig, root, prim, by_prim.get(below, []), codes)
        worlds[path] = world
    return worlds


def _local_matrices(rig: Rig, root: Any, prim: Any, driven: list[tuple[str, str, Array]], codes: Array) -> Array:
    """Local matrices ((n,) 4, 4) of a prim of the asset at time ``codes`` (n,), with driven ops inserted into its
    order: (channel, op, matrices, which contain the drive's pivot)."""
    from pxr import UsdGeom

    xformable = UsdGeom.Xformable(prim)
    replaced = {rig.drives[channel].op[:-1] for channel, _, _ in driven}  # what rotates or slides does not by itself
    own = {op.GetOpName(): _own_matrices(op, codes, replaced) for op in xformable.GetOrderedXformOps()}
    order = [name for name in xformable.GetXformOpOrderAttr().Get() or [] if name in own]
    moving = {}
    for channel, op, matrices in driven:
        order = [name for name in place_op(rig, channel, root, order) if not name.endswith(PIVOT)]
        moving[op] = matrices
    matrix = np.eye(4)
    for name in order:
        matrix = matrix @ (moving[name] if name in moving else own[name])
    return matrix


def _own_matrices(op: Any, codes: Array, replaced: Collection[str]) -> Array:
    from pxr import Usd

    if not op.MightBeTimeVarying():
        return np.array(op.GetOpTransform(0)).T
    kind = op.GetOpName().split(":")[1]
    turns, slides = kind.startswith(("rotate", "orient", "transform")), kind.startswith(("translate", "transform"))
    if ("rotate" in replaced and turns) or ("translate" in replaced and slides):
        return np.array(op.GetOpTransform(Usd.TimeCode.EarliestTime())).T
    return np.array([np.array(op.GetOpTransform(code)).T for code in codes.tolist()])


def _shift(offset: Array) -> Array:
    matrix = np.eye(4)
    matrix[:3, 3] = offset
    return matrix


def _op_matrices(op: str, values: Array) -> Array:
    """Matrices (n, 4, 4) of "rotateX|Y|Z" by degrees or "translateX|Y|Z" by lengths."""
    axis = "XYZ".index(op[-1])
    matrices = np.tile(np.eye(4), (len(values), 1, 1))
    if op.startswith("translate"):
        matrices[:, axis, 3] = values
        return matrices
    j, k = (axis + 1) % 3, (axis + 2) % 3
    angle = np.radians(values)
    matrices[:, j, j] = matrices[:, k, k] = np.cos(angle)
    matrices[:, k, j] = np.sin(angle)
    matrices[:, j, k] = -np.sin(angle)
    return matrices


def _pose_matrices(positions: Array, orientations: Array) -> Array:
    """Matrices (n, 4, 4) of poses; quaternions w, x, y, z."""
    poses = np.tile(np.eye(4), (len(positions), 1, 1))
    poses[:, :3, :3] = quaternions.matrices(orientations)
    poses[:, :3, 3] = positions
    return poses
