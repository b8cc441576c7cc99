"""Poses of a rig's parts for values of its channels: forward kinematics, in the rig root's frame.

Each drive is a screw at rest. A part moves by the product of the screws of all drives on it and on the parts that carry
it, those nearest the root first (the product of exponentials).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from vehsim.lie.quaternions import matrices, quaternions
from vehsim.rig.ops import bounds, frames_of
from vehsim.rig.rig import Rig

Array = NDArray[np.float64]
Motions = tuple[Array, Array]
"""Rotations (n, 3, 3) and translations (n, 3) m."""


@dataclass(frozen=True, eq=False)
class Screw:
    """A drive at rest, in the rig root's frame: how the ``channel`` moves ``prim`` and all parts below it.

    A turn about ``axis`` (3,) through ``pivot`` (3,) m, or a slide along ``axis``, which has the length of the drive's
    factor.
    """

    channel: str
    prim: str
    axis: Array
    pivot: Array
    slides: bool

    def at(self, values: Array) -> Motions:
        """The motion at values (n,) of the channel, rad or m."""
        if self.slides:
            return np.tile(np.eye(3), (len(values), 1, 1)), values[:, None] * self.axis
        factor = float(np.linalg.norm(self.axis))
        x, y, z = self.axis / factor
        cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
        angles = (factor * values)[:, None, None]
        sine, cosine = np.sin(angles), np.cos(angles)
        R = np.eye(3) + sine * cross + (1 - cosine) * (cross @ cross)
        return R, self.pivot - R @ self.pivot


def screws(rig: Rig, path: str) -> tuple[Screw, ...]:
    """The drives that move the part at ``path``, the outermost first."""
    frames, found = frames_of(rig), []
    for name, drive in rig.drives.items():
        if drive.prim not in frames or not f"{path}/".startswith(f"{drive.prim}/"):
            continue
        T_rp = frames[drive.prim]
        centre = bounds(rig, drive.prim).mean(axis=0) if drive.pivot == "centre" else drive.pivot
        pivot = T_rp[:3, 3] if centre is None else np.asarray(centre, float)
        axis = drive.factor * T_rp[:3, "XYZ".index(drive.op[-1])]
        found.append(Screw(name, drive.prim, axis, pivot, drive.op.startswith("translate")))
    return tuple(sorted(found, key=lambda screw: screw.prim.count("/")))


def moved(rig: Rig, path: str, channels: Mapping[str, Array], count: int) -> Motions:
    """How the part at ``path`` moves from its rest in the root's frame, (count, ...); missing channels rest at zero."""
    R, p = np.tile(np.eye(3), (count, 1, 1)), np.zeros((count, 3))
    for screw in screws(rig, path):
        turn, slide = screw.at(np.asarray(channels.get(screw.channel, np.zeros(count)), float))
        R, p = R @ turn, p + (R @ slide[..., None])[..., 0]
    return R, p


def part_poses(
    rig: Rig, path: str, channels: Mapping[str, Array], positions: Array, orientations: Array
) -> tuple[Array, Array]:
    """Poses (n, 3) m and (n, 4) that carry the part at ``path`` from its rest in the root's frame into the world, at
    poses of the root."""
    if not path:
        return positions, orientations
    R, p = moved(rig, path, channels, len(positions))
    R_wr = matrices(orientations)
    return positions + (R_wr @ p[..., None])[..., 0], quaternions(R_wr @ R)
