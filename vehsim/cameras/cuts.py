"""A cut list: several cameras joined into one."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from vehsim.cameras.camera import Camera
from vehsim.errors import InputError
from vehsim.lie.quaternions import continuous

Array = NDArray[np.float64]

CUT = "cut"
"""The name of the camera that a shot's cut list makes."""
JUMP = 1e-3
"""Duration of a cut, in frames: USD interpolates linearly between samples."""


def cut(name: str, cameras: Mapping[str, Camera], cuts: Sequence[tuple[float, str]]) -> Camera:
    """One camera from several: from each frame of ``cuts`` (frame, camera's name) on, it equals that camera.

    It jumps half a frame earlier, so that motion blur on either side does not span the cut. Raises ``InputError`` for
    unknown cameras, frames out of order and different film backs.
    """
    if not cuts or any(late[0] <= early[0] for early, late in pairwise(cuts)):
        raise InputError(
            "not one after the other",
            "give frames in rising order",
            key="frames",
            value=[frame for frame, _ in cuts],
            subject=f"cut {name!r}",
        )
    for _, used in cuts:
        if used not in cameras:
            raise InputError(
                "no such camera",
                f"choose one of {', '.join(cameras)}",
                key="camera",
                value=used,
                subject=f"cut {name!r}",
            )
    used_cameras = [cameras[used] for _, used in cuts]
    if len({camera.aperture_mm for camera in used_cameras}) > 1:
        raise InputError(
            "its cameras' film backs differ", "give all the same aperture_width_mm", subject=f"cut {name!r}"
        )
    pieces: list[tuple[Array, Array, Array, Array]] = []
    for k, camera in enumerate(used_cameras):
        begin = camera.frames[0] if k == 0 else cuts[k][0] - 0.5
        end = camera.frames[-1] if k == len(cuts) - 1 else cuts[k + 1][0] - 0.5 - JUMP
        inside = camera.frames[(camera.frames > begin) & (camera.frames < end)]
        frames = np.unique(np.concatenate([[begin], inside, [end]]))
        lens = np.interp(frames, camera.frames, np.broadcast_to(camera.lens_mm, camera.frames.shape))
        pieces.append((frames, *_between(camera, frames), lens))
    frames, positions, orientations, lens = (np.concatenate(parts) for parts in zip(*pieces, strict=True))
    first = used_cameras[0]
    return Camera(name, frames, positions, continuous(orientations), lens, first.aperture_mm, first.clip_range)


def within(cuts: Sequence[tuple[int, str]], first: int, last: int) -> tuple[tuple[int, str], ...]:
    """The cuts that a shot from frame ``first`` to ``last`` shows: it begins with the camera of the last one before."""
    begun = [one for one in cuts if one[0] <= last] or list(cuts[:1])
    before = sum(frame <= first for frame, _ in begun)
    return tuple(begun[max(0, before - 1) :])


def shown_of(name: str, cuts: Sequence[tuple[int, str]], last: int) -> list[tuple[int, int]]:
    """The frames (first, last) that ``cuts`` show of a camera, in a shot up to frame ``last``."""
    return [(begin, end - 1) for (begin, used), (end, _) in pairwise([*cuts, (last + 1, "")]) if used == name]


def _between(camera: Camera, frames: Array) -> tuple[Array, Array]:
    """Positions and orientations of a camera at any ``frames`` within its own."""
    from scipy.spatial.transform import Rotation, Slerp

    if len(camera.frames) == 1:
        return np.repeat(camera.positions, len(frames), axis=0), np.repeat(camera.orientations, len(frames), axis=0)
    positions = np.stack([np.interp(frames, camera.frames, column) for column in camera.positions.T], axis=1)
    turns = Slerp(camera.frames, Rotation.from_quat(camera.orientations, scalar_first=True))(frames)
    return positions, turns.as_quat(scalar_first=True)
