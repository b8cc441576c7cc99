"""Checks of a shot's cut list and of the cameras to render."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from vehsim.errors import Problem
from vehsim.shot.checks import check_names, did_you_mean
from vehsim.shot.schema.shot_file import ShotFile


def check_cuts(file: ShotFile, cuts: Sequence[tuple[int, str]]) -> Iterator[Problem]:
    """The cut list is in order, its cameras exist and have the same film back; the cameras to render, and
    those with captions, exist."""
    from vehsim.cameras.cuts import CUT

    cameras = {camera.name: camera for camera in file.camera}
    edited = file.render.cuts is not None
    if edited and file.cut:
        yield Problem("render.cuts", "there are [[cut]] tables too", "give one of the two", file.render.cuts)
    used: list[str] = []
    for i, (frame, name) in enumerate(cuts):
        frame_key, camera_key = ("render.cuts",) * 2 if edited else (f"cut[{i}].frame", f"cut[{i}].camera")
        if name not in cameras:
            yield Problem(camera_key, "no such camera", did_you_mean(name, cameras), name)
            continue
        used.append(name)
        if i and frame <= cuts[i - 1][0]:
            yield Problem(
                frame_key, f"not after the cut before it, at {cuts[i - 1][0]}", "give the cuts in order", frame
            )
        if cameras[name].aperture_width_mm != cameras[used[0]].aperture_width_mm:
            message = f"its film back differs from that of {used[0]!r}"
            yield Problem(camera_key, message, "give both the same aperture_width_mm", name)
    if cuts and CUT in cameras:
        i = list(cameras).index(CUT)
        yield Problem(f"camera[{i}].name", "the name is reserved for the cut list", "choose another", CUT)
    names = [*cameras, CUT] if cuts else [*cameras]
    for i, name in enumerate(file.render.cameras or []):
        if name not in names:
            yield Problem(f"render.cameras[{i}]", "no such camera", did_you_mean(name, names), name)
    captions = file.render.captions
    yield from check_names("render.captions", captions, names, "camera")
    shown = file.render.cameras or ([CUT] if cuts else names)
    for name in (name for name in captions if name in names and name not in shown):
        message = "its camera is not rendered, so it is not shown"
        yield Problem(
            f"render.captions.{name}", message, "name it in render.cameras", captions[name], severity="warning"
        )
