"""The op through which a channel moves a prim of a rig, and checks that the prim can be moved.

This module knows USD prims and op orders, not motion: the exporter writes ops with it, and checks use it before
solving. A channel becomes one op with a suffix in the prim's own ``xformOpOrder``, after the prim's placement
and before the ops that shape its mesh, with values in the prim's own units.
"""

from __future__ import annotations

import warnings
from collections.abc import Iterable, Iterator, Mapping, Sequence
from difflib import get_close_matches
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from vehsim.errors import ExportError, InputError, Problem
from vehsim.intake.usd import complaints, open_stage
from vehsim.rig.rig import DISC_PITCH, DISC_ROLL, HITCH_PITCH, HITCH_ROLL
from vehsim.runtime.cache import Stamp, made_of, stamp
from vehsim.runtime.code import code

if TYPE_CHECKING:
    from vehsim.rig.parts import Part, Recalled
    from vehsim.rig.rig import Drive, Rig

Array = NDArray[np.float64]

SHEAR = 1e-3
"""Largest relative difference of scale perpendicular to a spin's axis."""
PIVOT = "_vehsim_pivot"
SENSES = {
    "roll_": ("rolling forward is a rotation about the axis to the left", (0.0, 1.0, 0.0)),
    "steer_": ("steering to the left is a rotation about the axis up", (0.0, 0.0, 1.0)),
    "travel_": ("positive travel of a wheel is up", (0.0, 0.0, 1.0)),
    HITCH_PITCH: ("nose down is a rotation about the axis to the left", (0.0, 1.0, 0.0)),
    HITCH_ROLL: ("left side up is a rotation about the axis ahead", (1.0, 0.0, 0.0)),
    DISC_PITCH: ("a disc that tilts forward is a rotation about the axis to the left", (0.0, 1.0, 0.0)),
    DISC_ROLL: ("a disc that tilts to the right is a rotation about the axis ahead", (1.0, 0.0, 0.0)),
}
"""Prefix of a channel -> the meaning of its positive values in every model, and their axis (3,) in the rig root's
frame."""
CARRIES_WHEEL = ("steer_", "travel_")
"""Prefixes of channels that carry a wheel with its own static rotation, such as a roll at which it was modelled."""
TILTED = np.radians(20.0)
"""Largest tilt of the axis on which a wheel steers or travels, rad, without a warning: more than any kingpin's."""
OFF_CENTRE = 0.05
"""Largest distance of a wheel's axis from its middle, as a share of its radius, without a warning."""


def open_rig(asset: Path, rig: Rig) -> tuple[Any, Any]:
    """The asset's stage and the rig's root prim on it."""
    stage = open_stage(asset)
    path = prim_path(rig.root)
    root = stage.GetPrimAtPath(path) if path else stage.GetDefaultPrim()
    if not root:
        raise ExportError(
            f"no {path or 'defaultPrim'}", "author it or fix the vehicle's `root` key", file=made_of(rig.asset)
        )
    return stage, root


def prim_path(root: str) -> str:
    return root if not root or root.startswith("/") else f"/{root}"


def driven_prim(rig: Rig, root: Any, channel: str) -> Any:
    """The prim that ``channel`` drives. Raises ``ExportError`` with the names of existing prims."""
    from pxr import Sdf, UsdGeom

    name = rig.drives[channel].prim
    valid = Sdf.Path.IsValidPathString(name) and not name.startswith("/")
    prim = root.GetPrimAtPath(name) if valid else None
    place: Any = {"key": f"channels.{channel}.prim", "value": name, "file": made_of(rig.asset)}
    if prim and not prim.IsActive():
        raise ExportError("deactivated in the asset", "activate it, or leave the channel out", **place)
    if prim and prim.IsA(UsdGeom.Xformable):
        return prim
    known = xformables(root)
    close = [path for path in known if path.rpartition("/")[2] == name.rpartition("/")[2]]
    close = close or get_close_matches(name, known, n=1)
    hint = f"did you mean {close[0]!r}?" if close else f"choose one of {', '.join(known[:20])}"
    raise ExportError("no such Xform below the rig root", hint, **place)


def xformables(root: Any) -> list[str]:
    """Paths of the Xforms below ``root``, also inside instances."""
    from pxr import Usd, UsdGeom

    skip = len(str(root.GetPath())) + 1
    prims = Usd.PrimRange(root, Usd.TraverseInstanceProxies())
    return [name for prim in prims if prim.IsA(UsdGeom.Xform) and (name := str(prim.GetPath())[skip:])]


def instances_above(root: Any, prim: Any) -> list[str]:
    """Paths below ``root`` ("" is the root) of the instances that contain ``prim``: USD drops overs below them."""
    found = []
    above = prim.GetParent()
    while above and above.GetPath().HasPrefix(root.GetPath()):
        if above.IsInstance():
            found.append(str(above.GetPath())[len(str(root.GetPath())) + 1 :])
        above = above.GetParent()
    return found[::-1]


def op_order(prim: Any) -> list[str]:
    from pxr import UsdGeom

    return list(UsdGeom.Xformable(prim).GetXformOpOrderAttr().Get() or [])


def drive_op(op: str, metres_per_unit: float = 1.0) -> tuple[str, float]:
    """The full op name of a drive ("rotateZ" -> "xformOp:rotateZ:spin") and the factor from rad or m to its unit.

    A drive that slides is a vector along its axis ("translateZ" -> "xformOp:translate:slideZ"): USD before 25.2 has no
    ops with one number for it.
    """
    if op.startswith("rotate"):
        return f"xformOp:{op}:spin", 180.0 / np.pi
    return f"xformOp:translate:slide{op[-1]}", 1.0 / metres_per_unit


def slide_axis(op: str) -> int | None:
    """The axis of the vectors of a drive's full op name; None if its values are numbers."""
    _, slides, axis = op.partition("xformOp:translate:slide")
    return "XYZ".index(axis) if slides else None


def scalar_op(op: str) -> str:
    """A drive's full op name with one number instead of a vector ("xformOp:translateZ:slide"), for splines."""
    return op if slide_axis(op) is None else f"xformOp:translate{op[-1]}:slide"


def pivot_op(channel: str) -> str:
    """The op of a drive's own pivot, with a name that no asset uses."""
    return f"xformOp:translate:{channel}{PIVOT}"


def replaced_ops(prim: Any, drives: Iterable[Drive]) -> list[Any]:
    """The prim's own animated ops that move it as one of its ``drives`` does: ours replaces their motion, and they keep
    their first value."""
    from pxr import UsdGeom

    kinds = {"rotate": ("rotate", "orient", "transform"), "translate": ("translate", "transform")}
    moved = tuple(kind for drive in drives for kind in kinds[drive.op[:-1]])
    ours = {drive_op(drive.op)[0] for drive in drives}
    return [
        op
        for op in UsdGeom.Xformable(prim).GetOrderedXformOps()
        if op.MightBeTimeVarying()
        and op.GetOpName().split(":")[1].startswith(moved)
        and op.GetOpName() not in ours
        and not op.IsInverseOp()
    ]


def place_op(rig: Rig, channel: str, root: Any, order: list[str]) -> list[str]:
    """``order`` of the driven prim with the op of ``channel``, and its pivot's around it.

    The op goes after the prim's placement and before the scale that shapes its mesh: USD applies the last op first, so
    an op after a scale would rotate the unscaled shape and shear it. An op that steers or lifts a wheel goes before the
    wheel's own static rotations and its spin, where it is more upright there: a wheel that was modelled at some roll
    angle steers about the same axis as one that was not.
    """
    drive = rig.drives[channel]
    prim, (op, _) = root.GetPrimAtPath(drive.prim) if drive.prim else root, drive_op(drive.op)
    if op in order:
        return order
    own_pivots = [k for k, name in enumerate(order) if name.startswith("!invert!") and not name.endswith(PIVOT)]
    end = own_pivots[0] if own_pivots else len(order)
    while end > 0 and _kind(order[end - 1]) == "scale":
        end -= 1
    if channel.startswith(CARRIES_WHEEL):
        end = _most_upright(root, prim, drive, order, end)
    pivot = pivot_op(channel)
    return [*order[:end], *([op] if drive.pivot is None else [pivot, op, f"!invert!{pivot}"]), *order[end:]]


def _kind(op: str) -> str:
    """ "scale" of "xformOp:scale:units"; "" of a reset."""
    return op.partition(":")[2].partition(":")[0]


def _most_upright(root: Any, prim: Any, drive: Drive, order: list[str], end: int) -> int:
    """The place among the rotations before ``end`` at which the drive's axis is closest to the vertical."""
    start = end
    while start > 0 and _kind(order[start - 1]).startswith(("rotate", "orient")):
        start -= 1
    while end > start and order[end - 1].endswith(":spin"):
        end -= 1
    axis = "XYZ".index(drive.op[-1])

    def upright(place: int) -> float:
        direction = _to_space_after(root, prim, order[:place])[:3, axis]
        return round(float(abs(direction[2]) / np.linalg.norm(direction)), 6)

    return max(range(start, end + 1), key=lambda place: (upright(place), place))


def pivot_of(rig: Rig, channel: str, root: Any, metres_per_unit: float) -> Array | None:
    """The drive's pivot (3,) in the space and units of its op; None: the prim's own pivot."""
    drive = rig.drives[channel]
    if drive.pivot is None:
        return None
    prim = root.GetPrimAtPath(drive.prim)
    T_ra = _to_op_space(rig, channel, root, prim)
    point = bounds(rig, drive.prim).mean(axis=0) if drive.pivot == "centre" else np.asarray(drive.pivot, float)
    return np.asarray((np.linalg.inv(T_ra) @ [*point, 1.0])[:3])


def rig_problems(rig: Rig) -> list[Problem]:
    """The problems, under keys ``channels.NAME``, of drives that cannot move their prim as a rigid part.

    The result is cached as long as neither a file of the asset nor these checks change.
    """
    from vehsim.rig.parts import recalled

    def found() -> Recalled:
        with complaints(rig.asset):
            return [problem.as_dict() for problem in _problems_of(rig)], [], []

    problems, _, _ = recalled("rig_problems", rig.asset, (code((Path(__file__),)), repr(rig)), found)
    return [Problem(**problem) for problem in problems]


def _problems_of(rig: Rig) -> Iterator[Problem]:
    try:
        _, root = open_rig(rig.asset, rig)
    except ExportError as error:
        yield error.problem
        return
    yield from _replaced(rig, root)
    for channel, drive in rig.drives.items():
        try:
            prim = driven_prim(rig, root, channel)
            if skinned := _skinned_from_elsewhere(prim):
                message = f"{drive.prim}: its mesh {skinned} is skinned to joints, which do not follow the prim"
                remedy = "parent the part to its bone (Blender: parent type Bone) instead of skinning it"
                yield Problem(f"channels.{channel}", message, remedy)
                continue
            T_ra = _to_op_space(rig, channel, root, prim)
            linear = T_ra[:3, :3]
            sizes = np.linalg.norm(linear, axis=0)
            if np.linalg.matrix_rank(linear / max(sizes.max(), 1e-30), tol=1e-6) < 3:
                message = f"{drive.prim}: its transform cannot be inverted"
                yield Problem(f"channels.{channel}", message, "fix the scale of it and its parents")
                continue
            yield from _wrong_way(channel, drive, linear / sizes)
            if drive.op.startswith("rotate"):
                yield from _turning(rig, channel, drive, T_ra)
        except (ExportError, InputError) as error:
            yield error.problem.seen_from(f"channels.{channel}", remedy="fix its vehicle.toml or the asset")


def _replaced(rig: Rig, root: Any) -> Iterator[Problem]:
    """Warn of the asset's own animation of driven prims."""
    for path, drives in drives_by_prim(rig).items():
        prim = root.GetPrimAtPath(path) if path else root
        for op in replaced_ops(prim, drives.values()) if prim else ():
            message = f"{path}: its own animation of {op.GetOpName()} is replaced: it stays at its first value"
            remedy = "remove its keys, or drive another prim"
            yield Problem(f"channels.{next(iter(drives))}", message, remedy, severity="warning")


def drives_by_prim(rig: Rig) -> dict[str, dict[str, Drive]]:
    """Path of a driven prim -> its channels with their drives."""
    found: dict[str, dict[str, Drive]] = {}
    for channel, drive in rig.drives.items():
        found.setdefault(drive.prim, {})[channel] = drive
    return found


def _skinned_from_elsewhere(prim: Any) -> str:
    """The first mesh at or below ``prim`` that is bound to a skeleton elsewhere: skinning overrides its transform."""
    from pxr import Usd, UsdGeom, UsdSkel

    for below in Usd.PrimRange(prim, Usd.TraverseInstanceProxies()):
        if below.IsA(UsdGeom.Mesh) and below.HasAttribute("primvars:skel:jointIndices"):
            skeleton = UsdSkel.BindingAPI(below).GetInheritedSkeleton()
            if skeleton and not skeleton.GetPath().HasPrefix(prim.GetPath()):
                return str(below.GetName())
    return ""


def _turning(rig: Rig, channel: str, drive: Drive, T_ra: Array) -> Iterator[Problem]:
    """Check that a spin does not shear its part and that its axis passes through the part.

    ``T_ra`` (4, 4): from the op's space to the rig root's frame.
    """
    axis = "XYZ".index(drive.op[-1])
    j, k = (axis + 1) % 3, (axis + 2) % 3
    sizes = np.linalg.norm(T_ra[:3, :3], axis=0)
    unit = T_ra[:3, :3] / sizes
    skew = max(abs(unit[:, j] @ unit[:, k]), abs(unit[:, axis] @ unit[:, j]), abs(unit[:, axis] @ unit[:, k]))
    if abs(sizes[j] / sizes[k] - 1) > SHEAR or skew > SHEAR:
        scales = ", ".join(f"{size:.4g}" for size in sizes)
        yield Problem(
            f"channels.{channel}",
            f"{drive.prim}: rotated about {drive.op[-1]}, it would shear: a scale of {scales} follows the spin",
            "apply that scale to the meshes, or move it behind the rotation, last in xformOpOrder",
        )
        return
    low, high = bounds(rig, drive.prim)
    if drive.pivot == "centre" or not np.isfinite(low).all():
        return
    direction = unit[:, axis]
    middle, half = (low + high) / 2, (high - low) / 2
    off = middle - (T_ra[:3, 3] if drive.pivot is None else np.asarray(drive.pivot, float))
    off = off - direction * (off @ direction)
    radius = float(half[2])
    if channel.startswith("roll_") and OFF_CENTRE * radius < np.linalg.norm(off) <= radius:
        away = float(np.linalg.norm(off))
        message = (
            f"{drive.prim}: it rolls about an axis {away:.2g} m from the middle of a wheel of radius {radius:.2g} m"
        )
        yield Problem(
            f"channels.{channel}",
            f"{message}; it would rise by up to {2 * away:.2g} m",
            'give the channel pivot = "centre", or move the pivot to the hub',
            severity="warning",
        )
    elif drive.pivot is None and np.linalg.norm(off) > max(1.2 * float(np.linalg.norm(half)), 1e-6):
        yield Problem(
            f"channels.{channel}",
            f"{drive.prim}: no pivot: it would swing about an axis {np.linalg.norm(off):.3g} m from its middle",
            'give the channel pivot = "centre", or a point [x, y, z] in m, or set the pivot in the asset',
        )


def _wrong_way(channel: str, drive: Drive, axes: Array) -> Iterator[Problem]:
    """Check for a wheel that would roll backwards, steer the wrong way or sink.

    ``axes`` (3, 3): the axes of the op's space in the rig root's frame, as unit columns.
    """
    axis = axes[:, "XYZ".index(drive.op[-1])] * np.sign(drive.factor)
    if drive.op.startswith("rotate"):
        axis = axis * np.sign(np.linalg.det(axes))  # a mirror reverses rotations
    for prefix, (meaning, wanted) in SENSES.items():
        along = float(axis @ np.asarray(wanted))
        if channel.startswith(prefix) and prefix in CARRIES_WHEEL and 0.5 <= along < np.cos(TILTED):
            tilt = np.degrees(np.arccos(along))
            message = f"{drive.prim}: {drive.op} acts along an axis {tilt:.0f} degrees from upright"
            remedy = "move the static rotation of the wheel to a prim below, or to an op of its own (rotateXYZ, orient)"
            yield Problem(f"channels.{channel}", message, remedy, severity="warning")
        if channel.startswith(prefix) and along < 0.5:
            remedy = f"factor = {-drive.factor:g}" if along < -0.5 else "choose the op along its axle, or fix forward"
            goes = ", ".join(f"{x:.2g}" for x in np.round(axis, 2) + 0.0)
            yield Problem(
                f"channels.{channel}",
                f"{drive.prim}: {drive.op} acts along [{goes}] of the vehicle; {meaning}, {list(wanted)}",
                remedy,
            )


def bounds(rig: Rig, path: str) -> Array:
    """Lower and upper corner (2, 3) of a part and all parts that it carries, in the rig root's frame, m."""
    inside = [part for part in parts_of(rig) if part.path == path or part.path.startswith(f"{path}/")]
    points = [part.points @ part.T_rp[:3, :3].T + part.T_rp[:3, 3] for part in inside]
    points = [cloud for cloud in points if len(cloud)] or _own_points(rig, path)
    if not points:
        return np.full((2, 3), np.nan)
    cloud = np.concatenate(points)
    return np.stack([cloud.min(axis=0), cloud.max(axis=0)])


def _own_points(rig: Rig, path: str) -> list[Array]:
    """The points (n, 3) of a mesh that is driven directly and has no transform of its own."""
    from vehsim.rig.parts import read_mesh

    try:
        return [read_mesh(rig.asset, rig.root or None, path)[0]]
    except InputError:
        return []


def parts_of(rig: Rig) -> Sequence[Part]:
    """The parts of a rig's asset, read once."""
    found: Sequence[Part] = _read(Path(rig.asset), rig.root or None, stamp(rig.asset))
    return found


def frames_of(rig: Rig) -> Mapping[str, Array]:
    """The frames ``T_rp`` (4, 4) of a rig's parts at rest, by path. They are cached, so that USD need not be loaded."""
    found: Mapping[str, Array] = _read_frames(Path(rig.asset), rig.root or None, stamp(rig.asset))
    return found


@lru_cache(maxsize=8)
def _read_frames(asset: Path, root: str | None, written: Stamp) -> Any:
    from vehsim.rig.parts import solids

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of hulls, which do not count here
        return {solid.path: solid.T_rp for solid in solids(asset, root)}


@lru_cache(maxsize=8)
def _read(asset: Path, root: str | None, written: Stamp) -> Any:
    from vehsim.rig.parts import read_parts

    return read_parts(asset, root)


def _to_op_space(rig: Rig, channel: str, root: Any, prim: Any) -> Array:
    """(4, 4) from the space of a channel's op to the rig root's frame, at the asset's first time."""
    op, _ = drive_op(rig.drives[channel].op)
    order = place_op(rig, channel, root, op_order(prim))
    return _to_space_after(root, prim, [name for name in order[: order.index(op)] if not name.endswith(PIVOT)])


def _to_space_after(root: Any, prim: Any, ops: Sequence[str]) -> Array:
    """(4, 4) from the space after the first ``ops`` of a prim to the rig root's frame, at the asset's first time."""
    from pxr import Usd, UsdGeom

    from vehsim.rig.parts import Y_UP_TO_Z_UP

    stage = root.GetStage()
    turn = Y_UP_TO_Z_UP if UsdGeom.GetStageUpAxis(stage) == UsdGeom.Tokens.y else np.eye(4)
    matrix = turn @ np.diag([UsdGeom.GetStageMetersPerUnit(stage)] * 3 + [1.0])
    chain = [prim]
    while chain[-1] != root:
        chain.append(chain[-1].GetParent())
    when = Usd.TimeCode.EarliestTime()
    for step in chain[:0:-1]:
        matrix = matrix @ np.array(UsdGeom.Xformable(step).GetLocalTransformation(when)).T if _moves(step) else matrix
    own = {o.GetOpName(): np.array(o.GetOpTransform(when)).T for o in UsdGeom.Xformable(prim).GetOrderedXformOps()}
    for name in ops:
        matrix = matrix @ own.get(name, np.eye(4))
    return np.asarray(matrix)


def _moves(prim: Any) -> bool:
    from pxr import UsdGeom

    return bool(prim.IsA(UsdGeom.Xformable))
