"""The split screen: the frames of several cameras in one picture each, side by side, with their captions.

This module combines finished pictures; `frames.py` renders them, `film.py` makes films.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from vehsim.delivery.take import PANEL_GAP
from vehsim.exporters.pictures.burn_in import captioned
from vehsim.exporters.pictures.passes import picture_path

if TYPE_CHECKING:
    from vehsim.delivery.take import Take

NAME = "side_by_side"
"""The folder of its frames, and the name of its film in place of a camera."""
NONE = 1e-6
"""Share of its greatest energy up to which a vehicle starts with none."""


def write_split(take: Take, folder: Path, cameras: Sequence[str], frames: Sequence[int]) -> list[Path]:
    """Write ``frames/side_by_side/<shot>.side_by_side.<frame>.png`` from the cameras' frames below ``folder``."""
    from PIL import Image

    (folder / "frames" / NAME).mkdir(parents=True, exist_ok=True)
    written = []
    for frame in frames:
        panels = []
        for camera in cameras:
            with Image.open(picture_path(folder / "frames", take.name, camera, frame)) as picture:
                panels.append(captioned(picture.convert("RGB"), caption(take, camera, frame)))
        wide = Image.new("RGB", take.render.size)
        for k, panel in enumerate(panels):
            wide.paste(panel, (k * (panel.width + PANEL_GAP), 0))
        path = picture_path(folder / "frames", take.name, NAME, frame)
        wide.save(path, compress_level=2)
        written.append(path)
    return written


def caption(take: Take, camera: str, frame: float) -> str:
    """A camera's caption; ``{NAME}`` is replaced by that vehicle's current energy, in % of its initial energy, or in J
    if it starts with none."""
    text = take.render.captions.get(camera, "")
    for name, clip in take.clips.items():
        if f"{{{name}}}" in text:
            energy = clip.energy["kinetic"] + clip.energy["potential"]
            now, none = np.interp(frame, clip.frames, energy), abs(energy[0]) <= NONE * np.abs(energy).max()
            text = text.replace(f"{{{name}}}", f"{now:.0f} J" if none else f"{now / energy[0]:.0%}")
    return text
