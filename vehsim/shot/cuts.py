"""Checks of a shot's cut list and of the cameras to render."""

from __future__ import annotations

from collections.abc import Iterator

from vehsim.errors import Problem
from vehsim.shot.checks import did_you_mean
from vehsim.shot.schema.shot_file import ShotFile


def check_cuts(file: ShotFile) -> Iterator[Problem]:
    """The cut list is in order, its cameras exist and have the same film back; the cameras to render exist."""
    from vehsim.cameras.cuts import CUT

    cameras = {camera.name: camera for camera in file.camera}
    used: list[str] = []
    for i, piece in enumerate(file.cut):
        if piece.camera not in cameras:
            yield Problem(f"cut[{i}].camera", "no such camera", did_you_mean(piece.camera, cameras), piece.camera)
            continue
        used.append(piece.camera)
        if i and piece.frame <= file.cut[i - 1].frame:
            message = f"not after the cut before it, at {file.cut[i - 1].frame}"
            yield Problem(f"cut[{i}].frame", message, "give the cuts in order", piece.frame)
        if cameras[piece.camera].aperture_width_mm != cameras[used[0]].aperture_width_mm:
            message = f"its film back differs from that of {used[0]!r}"
            yield Problem(f"cut[{i}].camera", message, "give both the same aperture_width_mm", piece.camera)
    if file.cut and CUT in cameras:
        i = list(cameras).index(CUT)
        yield Problem(f"camera[{i}].name", "the name is reserved for the cut list", "choose another", CUT)
    names = [*cameras, CUT] if file.cut else [*cameras]
    for i, name in enumerate(file.render.cameras or []):
        if name not in names:
            yield Problem(f"render.cameras[{i}]", "no such camera", did_you_mean(name, names), name)
