"""Blocking: the rough motion that an animator gave a USD prim, read as poses and keys; planned motion written over it.

The prim may be in any stage: either up axis, any unit, below animated parents, with pivots, scales and its own ops. The
prim's world pose is read; the written layer gives it another world pose.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from fractions import Fraction
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from vehsim.errors import InputError
from vehsim.intake.usd import key_times, open_stage

if TYPE_CHECKING:
    from vehsim.rig.rig import Rig

Array = NDArray[np.float64]

STILL = 1e-3
"""A pose that moves less than this per frame, m and rad, is held."""
SHORTEST_HOLD = 3
"""Frames."""
CURVED = 0.05
"""A key is placed where linear motion between its neighbours would deviate from the blocking by this share of its
travel."""
ALONG = 0.97
"""A prim moves along an axis if this share of its way lies along it."""
STOPPED = 0.1
"""A pose is a stop where the speed falls to this share of the speeds that it reaches before and after."""
SHEARED = 1e-14
"""A matrix whose columns have equal lengths and right angles, up to this share, is a rotation times a number."""
MAX_FRAMES = 100_000
NOSES = {"X": (1.0, 0.0, 0.0), "Y": (0.0, 1.0, 0.0), "Z": (0.0, 0.0, 1.0)}
OP = "xformOp:transform:vehsim"


@dataclass(frozen=True)
class Blocking:
    """A prim's motion on whole ``frames`` (n,): ``positions`` (n, 3) m and ``rotations`` R_wr (n, 3, 3), Z up, nose X.

    ``keys``: the frames of its keys, each with the number of frames for which it is held. ``moves_along``: the prim's
    own axis along which it always moves, if its nose is across that.
    """

    path: Path
    prim: str
    forward: str
    frames: Array
    positions: Array
    rotations: Array
    keys: tuple[tuple[int, int], ...]
    moves_along: str | None = None

    @property
    def headings(self) -> Array:
        """Yaw of the nose from world X (n,), rad, unwrapped."""
        return np.unwrap(np.arctan2(self.rotations[:, 1, 0], self.rotations[:, 0, 0]))

    def velocities(self, fps: Fraction) -> Array:
        """World axes (n, 3), m/s."""
        if len(self.frames) < 2:
            return np.zeros((1, 3))
        return np.gradient(self.positions, axis=0) * float(fps)

    def index(self, frame: float) -> int:
        """The sample index of a whole frame. Raises ``InputError`` outside the blocking."""
        k = round(frame - self.frames[0])
        if not 0 <= k < len(self.frames):
            ends = f"{self.frames[0]:.0f} to {self.frames[-1]:.0f}"
            raise InputError(f"frame {frame:g}: the blocking goes from {ends}", "choose frames of it")
        return k

    def departure(self, frames: Array, positions: Array, rotations: Array) -> dict[str, Any]:
        """Distance of motion on ``frames`` (k,) from the blocking, in metres and degrees, and where it is greatest."""
        inside = np.isin(frames, self.frames)
        if not inside.any():
            return {}
        here = [self.index(frame) for frame in frames[inside]]
        metres = np.linalg.norm(positions[inside] - self.positions[here], axis=1)
        traces = np.einsum("nij,nij->n", rotations[inside], self.rotations[here])
        degrees = np.degrees(np.arccos(np.clip((traces - 1) / 2, -1, 1)))
        worst, most = int(metres.argmax()), int(degrees.argmax())
        return {
            "mean": float(metres.mean()),
            "largest": float(metres[worst]),
            "largest_frame": float(frames[inside][worst]),
            "largest_turn": float(degrees[most]),
            "largest_turn_frame": float(frames[inside][most]),
        }


def read_blocking(path: str | Path, prim: str, fps: Fraction, forward: str = "X") -> Blocking:
    """The blocking of ``prim`` in a USD stage whose time codes are frames at ``fps``.

    ``forward``: the prim's axis that points to the nose: "X", "-X", "Y", "-Y", "Z" or "-Z". Raises ``InputError`` for a
    missing stage or prim, one that does not move, or another frame rate.
    """
    stage, xformable = _open(Path(path), prim)
    rate = Fraction(stage.GetTimeCodesPerSecond()).limit_denominator(1001)
    if rate != fps:
        raise InputError(f"it has {float(rate):g} time codes per second, the shot {float(fps):g} frames", file=path)
    times = _key_times(xformable)
    if not times:
        raise InputError("it does not move", "add keys, or give marks", key=prim, file=path)
    first, last = int(np.ceil(times[0] - 1e-6)), int(np.floor(times[-1] + 1e-6))
    if last - first >= MAX_FRAMES:
        raise InputError(f"{last - first + 1} frames", f"at most {MAX_FRAMES} are read", key=prim, file=path)
    frames = np.arange(first, max(last, first) + 1, dtype=float)
    (matrices,) = _world_matrices(stage, [xformable.GetPrim()], frames)
    metres, up = _stage_frame(stage)
    positions = metres * matrices[:, :3, 3] @ up.T
    rotations = up @ nearest_rotations(matrices[:, :3, :3]) @ _nose(forward, up)
    keys = _keys(times, frames, positions, rotations)
    along = _moves_along(positions, rotations, _nose(forward, up))
    return Blocking(Path(path), prim, forward, frames, positions, rotations, keys, along)


def _moves_along(positions: Array, rotations: Array, R_pr: Array) -> str | None:
    """`Blocking.moves_along`, from R of the root frame to the prim's own axes."""
    steps = np.diff(positions, axis=0)[:, :2]
    across = float(np.einsum("ni,ni->", steps, rotations[:-1, :2, 1]))
    if abs(across) <= ALONG * np.linalg.norm(steps, axis=1).sum():
        return None
    axis = R_pr[:, 1] * np.sign(across)
    k = int(np.abs(axis).argmax())
    return "-" * bool(axis[k] < 0) + "XYZ"[k]


def read_edit(path: str | Path, prim: str, fps: Fraction, rig: Rig) -> Blocking:
    """The motion of a vehicle's root from its ``prim`` in a delivery, or in a stage over it, in which it was edited.

    A stage that states no up axis or unit has those of the layers below it, which is how the animator saw it.
    Raises ``InputError`` as `read_blocking` does.
    """
    edited = read_blocking(path, prim, fps)
    stage, xformable = _open(Path(path), prim)
    T_pr = np.asarray(np.linalg.inv(prim_in_root(rig)), float)
    T_wr = rigid_poses(stage, xformable.GetPrim(), edited.frames, T_pr)
    return replace(edited, positions=T_wr[:, :3, 3], rotations=T_wr[:, :3, :3], keys=())


def rigid_poses(stage: Any, prim: Any, frames: Array, after: Array | None = None) -> Array:
    """World poses (n, 4, 4) of a prim in metres, Z up, without its scale; ``after`` (4, 4): a matrix behind the
    prim's own."""
    return rigid_poses_of(stage, [prim], frames, after)[0]


def rigid_poses_of(stage: Any, prims: Sequence[Any], frames: Array, after: Array | None = None) -> Array:
    """The same poses (m, n, 4, 4) of several prims."""
    metres, up = _frame_of_layers(stage)
    to_metres = np.eye(4)
    to_metres[:3, :3] = metres * up
    poses = to_metres @ _world_matrices(stage, prims, frames) @ (np.eye(4) if after is None else after)
    poses[..., :3, :3] = nearest_rotations(poses[..., :3, :3])
    return np.asarray(poses)


def moves(prim: Any) -> bool:
    """Whether a prim or one above it has keys."""
    from pxr import UsdGeom

    return bool(_key_times(UsdGeom.Xformable(prim)))


def prim_in_root(rig: Rig) -> Array:
    """``T_rp`` (4, 4): from the root prim of a rig's asset, with its axes, units and own ops, to the rig root."""
    from pxr import UsdGeom

    from vehsim.rig.ops import open_rig
    from vehsim.rig.parts import Y_UP_TO_Z_UP

    stage, root = open_rig(rig.asset, rig)
    scale = UsdGeom.GetStageMetersPerUnit(stage)
    turn = Y_UP_TO_Z_UP if UsdGeom.GetStageUpAxis(stage) == UsdGeom.Tokens.y else np.eye(4)
    own = np.array(UsdGeom.Xformable(root).GetLocalTransformation()).T
    return np.asarray(turn @ np.diag([scale, scale, scale, 1.0]) @ own)


def write_over(blocking: Blocking, frames: Array, positions: Array, rotations: Array, path: Path) -> Path:
    """Write a layer to be sublayered over the blocking's stage: its prim then has the given motion and its own scale.

    ``frames`` (n,) time codes; ``positions`` (n, 3) m and ``rotations`` R_wr (n, 3, 3), Z up, nose X. One op replaces
    the prim's own ops, in the space of its parent, which may be animated.
    """
    from pxr import Gf, Sdf, Usd, UsdGeom, Vt

    stage, xformable = _open(blocking.path, blocking.prim)
    metres, up = _stage_frame(stage)
    world = np.tile(np.eye(4), (len(frames), 1, 1))
    world[:, :3, :3] = up.T @ rotations @ _nose(blocking.forward, up).T
    world[:, :3, 3] = positions @ up / metres
    (parents,) = _world_matrices(stage, [xformable.GetPrim().GetParent()], frames)
    reset = xformable.GetResetXformStack()
    local = world if reset else np.linalg.inv(parents) @ world
    start = np.array(xformable.GetLocalTransformation(float(frames[0]))).T
    local[:, :3, :3] = nearest_rotations(local[:, :3, :3]) @ _stretch(start[:3, :3])
    layer = Sdf.Layer.CreateNew(str(path))
    over = Sdf.CreatePrimInLayer(layer, blocking.prim)
    about = {
        "timeCodesPerSecond": stage.GetTimeCodesPerSecond(),
        "framesPerSecond": stage.GetFramesPerSecond(),
        "metersPerUnit": metres,
        "upAxis": UsdGeom.GetStageUpAxis(stage),
        "startTimeCode": float(frames[0]),
        "endTimeCode": float(frames[-1]),
    }
    for key, value in about.items():
        layer.pseudoRoot.SetInfo(key, value)
    layer.defaultPrim = blocking.prim.split("/")[1]
    with Sdf.ChangeBlock():
        track = Sdf.AttributeSpec(over, OP, Sdf.ValueTypeNames.Matrix4d)
        order = Sdf.AttributeSpec(over, "xformOpOrder", Sdf.ValueTypeNames.TokenArray, Sdf.VariabilityUniform)
        order.default = Vt.TokenArray(["!resetXformStack!"] * reset + [OP])
        for frame, matrix in zip(frames.tolist(), local, strict=True):
            layer.SetTimeSample(track.path, frame, Gf.Matrix4d(matrix.T.tolist()))
    layer.Save()
    _check_over(layer, blocking, frames, world, Usd)
    return path


def _check_over(layer: Any, blocking: Blocking, frames: Array, world: Array, Usd: Any) -> None:
    """Check that the composed prim has the written motion."""
    from pxr import Sdf

    from vehsim.errors import ExportError

    both = Sdf.Layer.CreateAnonymous(".usda")
    both.timeCodesPerSecond = layer.timeCodesPerSecond  # by default 24, to which sublayers would be stretched
    both.subLayerPaths = [layer.identifier, str(blocking.path.resolve())]
    stage = Usd.Stage.Open(both)
    (shown,) = _world_matrices(stage, [stage.GetPrimAtPath(blocking.prim)], frames)
    off = np.linalg.norm(shown[:, :3, 3] - world[:, :3, 3], axis=1)
    size = 1.0 + float(np.abs(world[:, :3, 3]).max())
    if off.max() > 1e-6 * size:
        frame = frames[off.argmax()]
        raise ExportError(
            f"over {blocking.path.name} the motion does not show at frame {frame:g}",
            "a stronger opinion moves the prim or one of its parents",
            key=blocking.prim,
        )


def _open(path: Path, prim: str) -> tuple[Any, Any]:
    from pxr import Sdf, UsdGeom

    stage = open_stage(path)
    if not Sdf.Path.IsValidPathString(prim) or not Sdf.Path(prim).IsAbsolutePath():
        raise InputError("not a prim's path", "give one such as /World/heli", key=prim, file=path)
    found = stage.GetPrimAtPath(prim)
    if not found:
        from difflib import get_close_matches

        known = [str(other.GetPath()) for other in stage.Traverse() if other.IsA(UsdGeom.Xformable)]
        near = get_close_matches(prim, known, 3) or known[:8]
        raise InputError("no such prim", f"choose one of {', '.join(near)}", key=prim, file=path)
    if not found.IsA(UsdGeom.Xformable):
        raise InputError(f"a {found.GetTypeName() or 'prim'} cannot move", "choose an Xform", key=prim, file=path)
    return stage, UsdGeom.Xformable(found)


def _stage_frame(stage: Any) -> tuple[float, Array]:
    """Metres per unit, and R from the stage's axes to Z up."""
    from pxr import UsdGeom

    return _frame(UsdGeom.GetStageMetersPerUnit(stage), UsdGeom.GetStageUpAxis(stage))


def _frame_of_layers(stage: Any) -> tuple[float, Array]:
    """The same, from the strongest layer that states them."""
    from pxr import UsdGeom

    def said(key: str, otherwise: Callable[[Any], Any]) -> Any:
        tops = (layer.pseudoRoot for layer in stage.GetLayerStack(False))
        found = next((top for top in tops if top.HasInfo(key)), None)
        return otherwise(stage) if found is None else found.GetInfo(key)

    metres = said(UsdGeom.Tokens.metersPerUnit, UsdGeom.GetStageMetersPerUnit)
    return _frame(metres, said(UsdGeom.Tokens.upAxis, UsdGeom.GetStageUpAxis))


def _frame(metres: float, axis: str) -> tuple[float, Array]:
    return metres, np.eye(3) if axis == "Z" else np.array([[1.0, 0, 0], [0, 0, -1.0], [0, 1.0, 0]])


def _nose(forward: str, up: Array) -> Array:
    """R from the root frame (X nose, Z up) to the prim's own axes, with the stage's up axis."""
    sign, axis = (-1.0, forward[1:]) if forward.startswith("-") else (1.0, forward)
    if axis not in NOSES:
        raise InputError("not an axis", "choose one of X, -X, Y, -Y, Z, -Z", key="forward", value=forward)
    nose, top = sign * np.array(NOSES[axis]), up.T @ (0.0, 0.0, 1.0)
    if abs(float(nose @ top)) > 0.5:
        raise InputError(
            "that is the stage's up axis", "choose the axis of the prim's nose", key="forward", value=forward
        )
    return np.column_stack([nose, np.cross(top, nose), top])


def _world_matrices(stage: Any, prims: Sequence[Any], frames: Array) -> Array:
    """Column-vector matrices (m, n, 4, 4) from prims to the world of their stage.

    Raises ``InputError`` for transforms that are not numbers.
    """
    from pxr import UsdGeom

    cache, matrices = UsdGeom.XformCache(), np.empty((len(prims), len(frames), 4, 4))
    for k, frame in enumerate(frames.tolist()):
        cache.SetTime(frame)
        for matrix, prim in zip(matrices, prims, strict=True):
            matrix[k] = cache.GetLocalToWorldTransform(prim)
    matrices = matrices.swapaxes(-1, -2)
    wrong = np.argwhere(~np.isfinite(matrices).all(axis=(-1, -2)))
    for j, k in wrong[:1].tolist():
        said = f"its transform is not a number at frame {frames[k]:g}"
        file = stage.GetRootLayer().identifier
        raise InputError(said, "fix its keys", key=str(prims[j].GetPath()), file=file)
    return matrices


def nearest_rotations(matrices: Array) -> Array:
    """The closest rotation to each matrix (..., 3, 3)."""
    found = np.array(matrices, float)
    square = np.swapaxes(found, -1, -2) @ found
    size = np.trace(square, axis1=-2, axis2=-1) / 3
    off = np.abs(square - size[..., None, None] * np.eye(3)).max(axis=(-2, -1))
    turned = (off <= SHEARED * size) & (np.linalg.det(found) > 0)  # rotations and scales, as usual
    found[turned] /= np.sqrt(size[turned])[..., None, None]
    u, _, v = np.linalg.svd(found[~turned])
    u[..., -1] *= np.sign(np.linalg.det(u @ v))[..., None]
    found[~turned] = u @ v
    return found


def _stretch(matrix: Array) -> Array:
    """A matrix (3, 3) without its rotation: scale and shear, in the prim's own axes."""
    return np.asarray(nearest_rotations(matrix[None])[0].T @ matrix)


def _key_times(xformable: Any) -> list[float]:
    """The times at which the prim or an ancestor has a key: samples, or knots of a spline."""
    from pxr import UsdGeom

    times: set[float] = set()
    prim = xformable.GetPrim()
    while prim and not prim.IsPseudoRoot():
        if prim.IsA(UsdGeom.Xformable):
            for op in UsdGeom.Xformable(prim).GetOrderedXformOps():
                times.update(key_times(op.GetAttr()))
            if UsdGeom.Xformable(prim).GetResetXformStack():
                break
        prim = prim.GetParent()
    return sorted(times)


def _keys(times: Sequence[float], frames: Array, positions: Array, rotations: Array) -> tuple[tuple[int, int], ...]:
    """Key frames and the length of their holds: the animator's own, or found in motion baked frame by frame."""
    whole = sorted({round(time) for time in times if frames[0] <= round(time) <= frames[-1]})
    baked = len(whole) > 8 and len(whole) > 0.8 * len(frames)
    first = int(frames[0])
    found = _found(positions, rotations) if baked else [key - first for key in whole]
    keys: list[tuple[int, int]] = []  # sample, hold
    for k in found:
        if keys and _same(positions, rotations, keys[-1][0], k):
            keys[-1] = (keys[-1][0], k - keys[-1][0])
        else:
            keys.append((k, 0))
    return tuple((k + first, hold) for k, hold in keys)


def _same(positions: Array, rotations: Array, i: int, j: int) -> bool:
    """Whether the pose is the same at samples i and j and between them."""
    span = slice(i, j + 1)
    moved = np.linalg.norm(positions[span] - positions[i], axis=1).max()
    turned = np.linalg.norm(rotations[span] - rotations[i], axis=(1, 2)).max()
    return bool(moved < STILL and turned < STILL)


def _found(positions: Array, rotations: Array) -> list[int]:
    """Samples that describe baked motion: both ends of every hold, stops, and the points where the path between bends
    most."""
    count = len(positions)
    step = np.linalg.norm(np.diff(positions, axis=0), axis=1)
    still = (step < STILL) & (np.linalg.norm(np.diff(rotations, axis=0), axis=(1, 2)) < STILL)
    edges = np.flatnonzero(np.diff(np.concatenate([[False], still, [False]]).astype(int)))
    holds = [(int(a), int(b)) for a, b in edges.reshape(-1, 2) if b - a >= SHORTEST_HOLD]
    stepped = len(holds) > 1 and all(late[0] - early[1] == 1 for early, late in pairwise(holds))
    if stepped:  # blocked with held keys: poses to reach, not to stay in
        return sorted({0, *(a for a, _ in holds)})
    rests = {k for hold in holds for k in hold} | _stops(positions, rotations, holds)
    chosen = {0, count - 1, *rests}
    tolerance = CURVED * max(float(step.sum()), STILL)
    spans = list(pairwise(sorted(chosen)))
    while spans:
        i, j = spans.pop()
        if j - i < 2:
            continue
        between, chord = positions[i : j + 1] - positions[i], positions[j] - positions[i]
        share = np.linspace(0.0, 1.0, j - i + 1)
        if {i, j} <= rests:  # eased at both ends: the path counts, not its timing
            share = np.clip(between @ chord / max(float(chord @ chord), STILL**2), 0.0, 1.0)
        off = np.linalg.norm(between - share[:, None] * chord, axis=1)
        worst = int(off.argmax())
        if off[worst] > tolerance:
            chosen.add(i + worst)
            spans += [(i, i + worst), (i + worst, j)]
    return sorted(chosen)


def _stops(positions: Array, rotations: Array, holds: Sequence[tuple[int, int]]) -> set[int]:
    """Samples without a hold at which the motion nearly stops, as with eased keys; also its ends if it rests there."""
    from scipy.signal import find_peaks

    count = len(positions)
    if count < 3:
        return set()
    moves = np.gradient(positions, axis=0), np.gradient(rotations, axis=0).reshape(count, 9)
    speed = np.sqrt(sum(np.sum(move**2, axis=1) for move in moves))
    found, facts = find_peaks(-speed, prominence=STILL)
    slow = speed[found] <= STOPPED / (1 - STOPPED) * facts["prominences"]
    stops = {int(k) for k in found[slow] if not any(a - 2 <= k <= b + 2 for a, b in holds)}
    return stops | {k for k in (0, count - 1) if speed[k] <= STOPPED * speed.max()}
