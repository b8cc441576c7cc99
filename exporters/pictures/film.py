"""The mp4 exporter: the frames of each camera as H.264."""

from __future__ import annotations

from collections.abc import Sequence
from fractions import Fraction
from pathlib import Path

import numpy as np

from vehsim.delivery.exporters import Exporter
from vehsim.delivery.take import Take
from vehsim.errors import ExportError
from vehsim.exporters.pictures.split import NAME as SPLIT
from vehsim.runtime.progress import Progress

QUALITY = "17"
"""x264's constant rate factor: visually lossless."""


def write_films(take: Take, folder: Path, progress: Progress) -> Sequence[Path]:
    """Write ``<shot>.<camera>.mp4`` from the frames in ``folder``; returns the files written."""
    written = []
    wanted = take.render.cameras
    shown = [camera.name for camera in take.cameras if wanted is None or camera.name in wanted]
    for name in [*shown, SPLIT] if take.render.layout == "side-by-side" else shown:
        pictures = sorted(
            (folder / "frames" / name).glob(f"{take.name}.{name}.*.png"),
            key=lambda path: int(path.stem.rsplit(".", 1)[1]),
        )
        if not pictures:
            raise ExportError(
                f"camera {name!r} has no frames to make a film of", "export png as well", subject=take.name
            )
        path = folder / f"{take.name}.{name}.mp4"
        written.append(write_film(pictures, path, take.fps / take.render.every, progress))
    return written


def write_film(pictures: Sequence[Path], path: Path, fps: Fraction, progress: Progress | None = None) -> Path:
    """Encode ``pictures`` at ``fps`` as H.264, yuv420p with even sides, Rec. 709, ready for streaming.

    One encoder thread, no time stamps and no processor-specific shortcuts of x264 (with those, one film in twenty
    differs), so that the same pictures give the same bytes.
    """
    import av
    from PIL import Image

    with Image.open(pictures[0]) as first:
        width, height = first.width - first.width % 2, first.height - first.height % 2
    with av.open(str(path), "w", options={"movflags": "+faststart", "fflags": "+bitexact"}) as container:
        stream = container.add_stream("libx264", rate=fps)
        stream.width, stream.height, stream.pix_fmt = width, height, "yuv420p"
        stream.options = {"crf": QUALITY, "preset": "veryfast", "threads": "1", "flags": "+bitexact"}
        stream.options |= {"x264-params": "cpu-independent=1"}
        context = stream.codec_context
        context.color_range, context.colorspace = 1, 1  # limited range, Rec. 709
        context.color_primaries, context.color_trc = 1, 1
        for k, picture in enumerate(pictures):
            if progress and k % 12 == 0:
                progress(f"film: {path.name}", k / len(pictures))
            with Image.open(picture) as image:
                pixels = np.asarray(image.convert("RGB"))[:height, :width]
            frame = av.VideoFrame.from_ndarray(np.ascontiguousarray(pixels), format="rgb24")
            frame = frame.reformat(format="yuv420p", dst_colorspace="ITU709")
            frame.pts = k
            container.mux(stream.encode(frame))
        container.mux(stream.encode())
    return path


exporter = Exporter(
    name="mp4",
    suffixes=(".mp4",),
    write=write_films,
    needs=("usd", "png"),
    makes="a film of each camera",
    state="rendering",
)
