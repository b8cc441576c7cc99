"""Matrices of an asset's prims for values of a rig's channels, as USD composes them.

The prims' own ops are multiplied here, among them an animation of the asset's own, so that what USD composes from a
written layer can be compared with it. `linkage` gives rigid poses of parts without USD.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from vehsim.rig.ops import PIVOT, drive_op, open_rig, pivot_of, place_op
from vehsim.rig.parts import Y_UP_TO_Z_UP

if TYPE_CHECKING:
    from vehsim.rig.rig import Rig

Array = NDArray[np.float64]


def posed(
    rig: Rig,
    poses: Array,
    channels: Mapping[str, Array],
    frames: Array,
    rate: float,
    paths: Iterable[str] = (),
) -> dict[str, Array]:
    """World matrices (n, 4, 4) in metres, Z up, by path below the root prim: of the root "", the driven prims, and
    ``paths``.

    ``poses`` (n, 4, 4) of the rig root, ``channels`` (n,) rad or m, ``frames`` (n,) at ``rate`` per second, at which
    the asset's own animation goes on by its own clock.
    """
    from pxr import UsdGeom

    stage, root = open_rig(rig.asset, rig)
    scale = UsdGeom.GetStageMetersPerUnit(stage)
    turn = Y_UP_TO_Z_UP if UsdGeom.GetStageUpAxis(stage) == UsdGeom.Tokens.y else np.eye(4)
    by_prim: dict[str, list[tuple[str, str, Array]]] = {}
    for channel, drive in rig.drives.items():
        op, factor = drive_op(drive.op, scale)
        turned = _op_matrices(drive.op, channels[channel] * factor * drive.factor)
        pivot = pivot_of(rig, channel, root, scale)
        if pivot is not None:
            turned = _shift(pivot) @ turned @ _shift(-pivot)
        by_prim.setdefault(drive.prim, []).append((channel, op, turned))

    codes = frames * stage.GetTimeCodesPerSecond() / rate
    above = poses @ turn @ np.diag([scale, scale, scale, 1.0])
    worlds = {"": above @ _local_matrices(rig, root, root, by_prim.get("", []), codes)}
    for path in [*by_prim, *paths]:
        steps = path.split("/") if path else []
        for k in range(len(steps)):
            below, parent = "/".join(steps[: k + 1]), "/".join(steps[:k])
            if below not in worlds:
                prim = root.GetPrimAtPath(below)
                reset = UsdGeom.Xformable(prim).GetResetXformStack()
                start = np.broadcast_to(np.eye(4), worlds[""].shape) if reset else worlds[parent]
                worlds[below] = start @ _local_matrices(rig, root, prim, by_prim.get(below, []), codes)
    wanted = {"", *by_prim, *paths}
    return {path: world for path, world in worlds.items() if path in wanted}


def _local_matrices(rig: Rig, root: Any, prim: Any, driven: list[tuple[str, str, Array]], codes: Array) -> Array:
    """Local matrices ((n,) 4, 4) of a prim of the asset at time ``codes`` (n,), with driven ops inserted into its
    order: (channel, op, matrices, which contain the drive's pivot)."""
    from pxr import UsdGeom

    xformable = UsdGeom.Xformable(prim)
    if not xformable:
        return np.eye(4)
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
