"""What an edited stage moves in addition to the roots of vehicles, which are all that a retouch reads."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vehsim.intake.usd import open_stage
from vehsim.rig.blocking import rigid_poses

Array = NDArray[np.float64]
MOVED, TURNED = 2e-3, 0.2
"""Distance, m, and angle, degrees, above which a prim counts as moved."""


def others_moved(edited: Path, delivered: Path, roots: Mapping[str, str], degrees: float = 0.0) -> list[str]:
    """Paths of delivered prims that ``edited`` poses otherwise, the topmost ones: below the root of a vehicle relative
    to it, elsewhere in the world.

    ``roots``: delivered path of each vehicle's root -> its path in ``edited``; ``degrees``: how far the curves of the
    delivery may turn away from its samples. Only prims that both stages have are compared.
    """
    stages = open_stage(delivered), open_stage(edited)
    first, last = stages[0].GetStartTimeCode(), stages[0].GetEndTimeCode()
    whole = np.arange(np.ceil(first), np.floor(last) + 1)
    poses = tuple(_Poses(stage) for stage in stages)
    found: list[str] = []
    for path, root in _placed(stages[0], roots):
        other = _counterpart(stages[1], path, root, roots)
        if other is None or any(path.startswith(f"{above}/") for above in found):
            continue
        pairs = (poses[0], path, root), (poses[1], other, roots[root] if root else "")
        frames = whole if any(of.varies(prim, above) for of, prim, above in pairs) else whole[:1]
        before, after = (of.relative(prim, above, frames) for of, prim, above in pairs)
        metres = np.linalg.norm(after[:, :3, 3] - before[:, :3, 3], axis=1)
        traces = np.einsum("nij,nij->n", after[:, :3, :3], before[:, :3, :3])
        angles = np.degrees(np.arccos(np.clip((traces - 1) / 2, -1.0, 1.0)))
        if metres.max() > MOVED or angles.max() > TURNED + 2 * degrees:
            found.append(path)
    return found


class _Poses:
    """Rigid poses of a stage's prims in metres, Z up; each is read once per frame."""

    def __init__(self, stage: Any) -> None:
        self._stage = stage
        self._known: dict[tuple[str, int], Array] = {}

    def varies(self, path: str, root: str) -> bool:
        """Whether a prim, or one between it and ``root``, has keys."""
        from pxr import UsdGeom

        prim = self._stage.GetPrimAtPath(path)
        while prim and not prim.IsPseudoRoot() and str(prim.GetPath()) != root:
            if prim.IsA(UsdGeom.Xformable) and UsdGeom.Xformable(prim).TransformMightBeTimeVarying():
                return True
            prim = prim.GetParent()
        return False

    def relative(self, path: str, root: str, frames: Array) -> Array:
        """Poses (n, 4, 4) of a prim relative to ``root``; in the world if that is empty."""
        pose = self._world(path, frames)
        return np.linalg.inv(self._world(root, frames)) @ pose if root else pose

    def _world(self, path: str, frames: Array) -> Array:
        key = path, len(frames)
        if key not in self._known:
            self._known[key] = rigid_poses(self._stage, self._stage.GetPrimAtPath(path), frames)
        return self._known[key]


def _placed(stage: Any, roots: Mapping[str, str]) -> Iterator[tuple[str, str]]:
    """Paths of the prims that can be posed, and the root of the vehicle to which each belongs, "" for none."""
    from pxr import UsdGeom

    for prim in stage.Traverse():
        path = str(prim.GetPath())
        root = next((root for root in roots if path.startswith(f"{root}/")), "")
        above = path in roots or any(root.startswith(f"{path}/") for root in roots)
        if prim.IsA(UsdGeom.Xformable) and not above:
            yield path, root


def _counterpart(stage: Any, path: str, root: str, roots: Mapping[str, str]) -> str | None:
    """The same prim of the edited stage: at the same place, or the only one of its name below the vehicle's root."""
    from pxr import Usd, UsdGeom

    wanted = roots[root] + path[len(root) :] if root else path
    prim = stage.GetPrimAtPath(wanted)
    if not prim and root:
        name = path.rpartition("/")[2]
        below = Usd.PrimRange(stage.GetPrimAtPath(roots[root]))
        named = [each for each in below if each.GetName() == name and each.IsA(UsdGeom.Xformable)]
        prim = named[0] if len(named) == 1 else None
    return str(prim.GetPath()) if prim and prim.IsA(UsdGeom.Xformable) else None
