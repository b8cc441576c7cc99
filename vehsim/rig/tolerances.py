"""How far the curves of a vehicle may be from its motion, and how far the points of a part are from its axis."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from vehsim.intake.usd import dependencies
from vehsim.rig.parts import read_parts
from vehsim.runtime.cache import content_of, kept

if TYPE_CHECKING:
    from vehsim.rig.rig import Rig

ANGLE = 0.05
"""Default of the largest angle from the motion, degrees."""


class Tolerances(NamedTuple):
    """Largest errors of a vehicle's curves: the root's ``distance`` m and ``angle`` rad, and those of each channel, rad
    or m."""

    distance: float
    angle: float
    channels: Mapping[str, float]


def curve_tolerances(rig: Rig, distance: float, angle: float | None) -> Tolerances:
    """What ``export.curves`` permits: ``distance`` m, ``angle`` degrees.

    Without an ``angle``, it is `ANGLE`, and a part may turn as far as moves its outermost point by ``distance``, if
    that is farther: an angle that is visible on a rotor is not on the wheel of a snakeboard.
    """
    reach = reaches(rig) if angle is None else {}
    root = float(np.radians(ANGLE if angle is None else angle))
    channels = {}
    for channel, drive in rig.drives.items():
        turned = max(root, distance / max(reach[channel], distance)) if channel in reach else root
        channels[channel] = (turned if drive.op.startswith("rotate") else distance) / abs(drive.factor)
    return Tolerances(distance, root, channels)


def reaches(rig: Rig) -> dict[str, float]:
    """Distance, m, of the outermost point from the rig's root ("") and from each channel's axis or pivot.

    Cached by the content of the asset's files, because an edit is solved in little more time than they are read.
    """
    made_of = [(str(file), content_of(file)) for file in dependencies(rig.asset)[0]]
    drives = sorted((channel, asdict(drive)) for channel, drive in rig.drives.items())
    key = str(rig.asset), rig.root, made_of, str(drives)
    found: dict[str, float] = json.loads(kept("reaches-1", key, lambda: json.dumps(_reaches(rig)).encode()))
    return found


def _reaches(rig: Rig) -> dict[str, float]:
    parts = {part.path: part for part in read_parts(rig.asset, rig.root or None)}
    clouds = {path: p.points @ p.T_rp[:3, :3].T + p.T_rp[:3, 3] for path, p in parts.items() if len(p.points)}
    found = {"": max((float(np.linalg.norm(cloud, axis=1).max()) for cloud in clouds.values()), default=1.0)}
    for channel, drive in rig.drives.items():
        below = [c for path, c in clouds.items() if path == drive.prim or path.startswith(f"{drive.prim}/")]
        if not below:
            continue
        cloud = np.concatenate(below)
        part = parts.get(drive.prim)
        hub = part.T_rp[:3, 3] if part is not None and drive.pivot is None else (cloud.min(0) + cloud.max(0)) / 2
        axis = np.eye(3)["XYZ".index(drive.op[-1])] if part is None else part.T_rp[:3, "XYZ".index(drive.op[-1])]
        off = cloud - hub
        found[channel] = float(np.linalg.norm(off - (off @ axis)[:, None] * axis, axis=1).max())
    return found
