"""The npz exporter: each vehicle's clip bit for bit, to be loaded again with ``Clip.load``."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from vehsim.delivery.exporters import Exporter
from vehsim.delivery.take import Take
from vehsim.runtime.progress import Progress


def write_npz(take: Take, folder: Path, progress: Progress) -> Sequence[Path]:
    """Write ``<vehicle>.npz`` per vehicle, at the clip's own samples; returns the files written."""
    return [clip.save(folder / f"{name}.npz") for name, clip in take.clips.items()]


exporter = Exporter(name="npz", suffixes=(".npz",), write=write_npz, makes="each motion in full, for Clip.load")
