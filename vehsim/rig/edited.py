"""What an edited stage moves in addition to the roots of vehicles, which are all that a retouch reads."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from vehsim.intake.usd import open_stage
from vehsim.rig.blocking import nearest_rotations, rigid_poses_of
from vehsim.rig.ops import open_rig
from vehsim.rig.posed import posed

if TYPE_CHECKING:
    from vehsim.rig.rig import Rig
    from vehsim.rig.tolerances import Tolerances

Array = NDArray[np.float64]
MOVED, TURNED = 2e-3, 0.2
"""Distance, m, and angle, degrees, above which a prim counts as moved."""
STILL = 1e-9
"""Change of an entry of a pose up to which a part stands still on its vehicle: one frame is enough for it."""


@dataclass(frozen=True)
class Moved:
    """A prim that an edit moves: its ``path``, and by how many ``metres`` and ``degrees`` at the ``frame`` of most."""

    path: str
    frame: float
    metres: float
    degrees: float

    def __str__(self) -> str:
        amounts = [f"{1000 * self.metres:.3g} mm"] * (self.metres > MOVED)
        amounts += [f"{self.degrees:.3g} degrees"] * (self.degrees > TURNED)
        return f"{self.path} (by {' and '.join(amounts)} at frame {self.frame:g})"


def others_moved(edited: Path, delivered: Path, vehicles: Collection[str]) -> list[Moved]:
    """The topmost prims of a ``delivered`` stage, outside ``vehicles``, that ``edited`` poses otherwise in the world.

    ``vehicles``: the paths of their roots. Only prims that both stages have are compared.
    """
    stages = open_stage(delivered), open_stage(edited)
    first, last = stages[0].GetStartTimeCode(), stages[0].GetEndTimeCode()
    whole = np.arange(np.ceil(first), np.floor(last) + 1)
    shared = [path for path in _placed(stages[0], vehicles) if _can_move(stages[1].GetPrimAtPath(path))]
    pairs = {path: [stage.GetPrimAtPath(path) for stage in stages] for path in shared}
    moving = [path for path, prims in pairs.items() if any(map(_varies, prims))]
    shown: dict[str, list[Array]] = {path: [] for path in pairs}
    for paths, at in ((moving, whole), ([path for path in pairs if path not in moving], whole[:1])):
        for k, stage in enumerate(stages):
            poses = rigid_poses_of(stage, [pairs[path][k] for path in paths], at)
            for path, pose in zip(paths, poses, strict=True):
                shown[path].append(pose)
    found: list[Moved] = []
    for path, (before, after) in shown.items():
        if not _below(path, found):
            found += _apart(path, whole[: len(before)], before, after)
    return found


def parts_moved(
    edited: Path,
    root: str,
    rig: Rig,
    channels: Mapping[str, Array],
    frames: Array,
    rate: float,
    curves: Tolerances | None = None,
) -> list[Moved]:
    """The topmost prims below a vehicle's ``root`` that ``edited`` poses otherwise, relative to it, than ``channels``
    (n,), rad or m, at ``frames`` (n,), of which there are ``rate`` per second.

    ``curves``: how far the delivered curves may be from the motion. Paths are those below the asset's root. In a
    stage that another tool wrote, a part is the only prim of its name below ``root``.
    """
    stage, (_asset, asset_root) = open_stage(edited), open_rig(rig.asset, rig)  # a prim does not keep its stage open
    above = stage.GetPrimAtPath(root)
    parts = {path: prim for path in _parts(asset_root) if (prim := _counterpart(above, path)) is not None}
    still = np.tile(np.eye(4), (len(frames), 1, 1))
    expected = {path: _rigid(world) for path, world in posed(rig, still, channels, frames, rate, parts).items()}
    to_root = np.linalg.inv(expected[""])
    wanted = {path: np.broadcast_to(to_root @ expected[path], (len(frames), 4, 4)) for path in parts}
    moving = [
        path for path, prim in parts.items() if np.ptp(wanted[path], axis=0).max() > STILL or _varies(prim, above)
    ]
    shown: dict[str, Array] = {}
    for paths, at in ((moving, frames), ([path for path in parts if path not in moving], frames[:1])):
        carrier, *poses = rigid_poses_of(stage, [above, *(parts[path] for path in paths)], at)
        shown |= {path: np.linalg.inv(carrier) @ pose for path, pose in zip(paths, poses, strict=True)}
    found: list[Moved] = []
    for path in parts:
        if _below(path, found):
            continue
        own = shown[path]
        found += _apart(path, frames, wanted[path][: len(own)], own, *_loose(rig, path, curves))
    return found


def _loose(rig: Rig, path: str, curves: Tolerances | None) -> tuple[float, float]:
    """How far curves may move, m, and turn, degrees, a part relative to the root: they and those that carry it."""
    if curves is None:
        return 0.0, 0.0
    carriers = [c for c, drive in rig.drives.items() if path == drive.prim or path.startswith(f"{drive.prim}/")]
    turned = [abs(rig.drives[c].factor) * curves.channels[c] for c in carriers if rig.drives[c].op.startswith("rotate")]
    return curves.distance * len(carriers), float(np.degrees(curves.angle + sum(turned)))


def _apart(
    path: str, frames: Array, before: Array, after: Array, metres_more: float = 0.0, degrees_more: float = 0.0
) -> Iterator[Moved]:
    """How far poses (n, 4, 4) are apart, if by more than `MOVED` and ``metres_more``, or `TURNED` and
    ``degrees_more``."""
    most, widest = MOVED + metres_more, TURNED + degrees_more
    metres = np.linalg.norm(after[:, :3, 3] - before[:, :3, 3], axis=1)
    traces = np.einsum("nij,nij->n", after[:, :3, :3], before[:, :3, :3])
    angles = np.degrees(np.arccos(np.clip((traces - 1) / 2, -1.0, 1.0)))
    amount = metres / most + angles / widest
    worst = int(np.argmax(amount > 0.999 * amount.max()))  # the first of equal ones
    if metres.max() > most or angles.max() > widest:
        yield Moved(path, float(frames[worst]), float(metres[worst]), float(angles[worst]))


def _below(path: str, found: Collection[Moved]) -> bool:
    return any(path.startswith(f"{above.path}/") for above in found)


def _rigid(matrices: Array) -> Array:
    poses = np.array(matrices)
    poses[..., :3, :3] = nearest_rotations(poses[..., :3, :3])
    return poses


def _can_move(prim: Any) -> bool:
    from pxr import UsdGeom

    return bool(prim and prim.IsA(UsdGeom.Xformable))


def _varies(prim: Any, within: Any = None) -> bool:
    """Whether a prim or one above it has keys; with ``within``, a prim above, whether it may move relative to that."""
    from pxr import UsdGeom

    while prim and not prim.IsPseudoRoot() and prim != within:
        own = UsdGeom.Xformable(prim)
        if _can_move(prim) and (own.TransformMightBeTimeVarying() or (within and own.GetResetXformStack())):
            return True
        prim = prim.GetParent()
    return False


def _placed(stage: Any, vehicles: Collection[str]) -> Iterator[str]:
    """Paths of the prims outside ``vehicles`` that can be posed, without those that carry vehicles."""
    prims = iter(stage.Traverse())
    for prim in prims:
        path = str(prim.GetPath())
        if path in vehicles:
            prims.PruneChildren()
        elif _can_move(prim) and not any(vehicle.startswith(f"{path}/") for vehicle in vehicles):
            yield path


def _parts(root: Any) -> Iterator[str]:
    """Paths below an asset's root of the prims that can be posed, also inside instances, the topmost first."""
    from pxr import Usd, UsdGeom

    skip = len(str(root.GetPath())) + 1
    for prim in Usd.PrimRange(root, Usd.TraverseInstanceProxies()):
        if prim != root and prim.IsA(UsdGeom.Xformable):
            yield str(prim.GetPath())[skip:]


def _counterpart(root: Any, path: str) -> Any:
    """The prim at ``path`` below ``root``, or the only one of its name there; None if there is neither."""
    from pxr import Usd

    prim = root.GetPrimAtPath(path)
    if not prim:
        name = path.rpartition("/")[2]
        named = [each for each in Usd.PrimRange(root) if each.GetName() == name and _can_move(each)]
        prim = named[0] if len(named) == 1 else None
    return prim if _can_move(prim) else None
