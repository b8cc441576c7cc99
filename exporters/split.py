"""The split screen: the frames of several cameras as one picture each, side by side, with their captions.

What belongs here puts finished pictures together; `frames.py` renders them, `film.py` makes films of them.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from vehsim.exporters.lettering import captioned
from vehsim.take import PANEL_GAP

if TYPE_CHECKING:
    from vehsim.take import Take

NAME = "side_by_side"
"""The folder of its frames, and what its film is called, as if it were a camera."""


def write_split(take: Take, folder: Path, cameras: Sequence[str], frames: Sequence[int]) -> list[Path]:
    """Write ``frames/side_by_side/<shot>.side_by_side.<frame>.png`` from the cameras' frames below ``folder``."""
    from PIL import Image

    (folder / "frames" / NAME).mkdir(parents=True, exist_ok=True)
    written = []
    for frame in frames:
        panels = []
        for camera in cameras:
            with Image.open(folder / "frames" / camera / f"{take.name}.{camera}.{frame:04d}.png") as picture:
                panels.append(captioned(picture.convert("RGB"), caption(take, camera, frame)))
        wide = Image.new("RGB", take.render.size)
        for k, panel in enumerate(panels):
            wide.paste(panel, (k * (panel.width + PANEL_GAP), 0))
        path = folder / "frames" / NAME / f"{take.name}.{NAME}.{frame:04d}.png"
        wide.save(path, compress_level=2)
        written.append(path)
    return written


def caption(take: Take, camera: str, frame: float) -> str:
    """A camera's caption; ``{NAME}`` in it is the energy of that vehicle now, in % of what it had at first."""
    text = take.render.captions.get(camera, "")
    for name, clip in take.clips.items():
        if f"{{{name}}}" in text:
            energy = clip.energy["kinetic"] + clip.energy["potential"]
            now = np.interp(frame, clip.frames, energy) / energy[0]
            text = text.replace(f"{{{name}}}", f"{now:.0%}")
    return text
