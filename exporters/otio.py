"""The otio exporter: the cut list as an OpenTimelineIO timeline, for editorial.

A clip per piece of the cut; without a cut list, one clip per camera, each on a track of its own. OpenTimelineIO is an
optional dependency.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any

from vehsim.delivery.exporters import Exporter
from vehsim.delivery.take import Take
from vehsim.errors import InputError
from vehsim.runtime.progress import Progress


def opentimelineio() -> Any:
    """The module, an optional dependency. Raises ``InputError``."""
    try:
        import opentimelineio
    except ImportError:
        raise InputError("needs OpenTimelineIO", "pip install 'vehsim[otio]'", key="to", value="otio") from None
    return opentimelineio


def write_otio(take: Take, folder: Path, progress: Progress) -> Sequence[Path]:
    """Write ``<shot>.otio``; returns the file. Each clip refers to the pictures that `png` writes for its camera.

    Raises ``InputError`` without OpenTimelineIO.
    """
    otio = opentimelineio()
    progress("otio: timeline", 0.0)
    rate, (first, last) = float(take.fps), take.frames

    def time(frame: int) -> Any:
        return otio.opentime.RationalTime(frame, rate)

    def clip(camera: str, begin: int, end: int) -> Any:
        media = otio.schema.ImageSequenceReference(
            target_url_base=f"frames/{camera}/",
            name_prefix=f"{take.name}.{camera}.",
            name_suffix=".png",
            start_frame=first,
            frame_step=take.render.every,
            frame_zero_padding=4,
            rate=rate,
            available_range=otio.opentime.TimeRange(time(first), time(last + 1 - first)),
        )
        shown = otio.opentime.TimeRange(time(begin), time(end - begin))
        return otio.schema.Clip(name=camera, media_reference=media, source_range=shown)

    timeline = otio.schema.Timeline(take.name, global_start_time=time(first))
    pieces = [(max(frame, first), name) for frame, name in take.cuts]
    if pieces:
        pieces[0] = first, pieces[0][1]  # a cut list starts with its first camera
    tracks = [pieces] if pieces else [[(first, camera.name)] for camera in take.cameras]
    for k, track in enumerate(tracks):
        row = otio.schema.Track(name="cut" if pieces else track[0][1], kind=otio.schema.TrackKind.Video)
        for (begin, name), (end, _) in pairwise([*track, (last + 1, "")]):
            row.append(clip(name, begin, end))
        row.enabled = k == 0
        timeline.tracks.append(row)
    path = folder / f"{take.name}.otio"
    otio.adapters.write_to_file(timeline, str(path))
    return [path]


exporter = Exporter(
    name="otio",
    suffixes=(".otio",),
    write=write_otio,
    makes="the cut list for editorial",
    ready=opentimelineio,
)
