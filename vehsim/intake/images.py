"""Read pictures as arrays; their size and mode are checked before they are decompressed."""

from __future__ import annotations

from collections.abc import Collection
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vehsim.intake.gate import reading, refuse


def read_picture(
    path: Path, modes: Collection[str], most: int, remedy: str
) -> tuple[NDArray[np.float64], str, dict[int, Any]]:
    """A picture of one channel (rows, columns), its mode, and the tags of a TIFF. Raises ``InputError``.

    ``modes``: the accepted ones of Pillow's; ``remedy``: the fix for others; ``most`` pixels.
    """
    from PIL import Image

    with reading(path, "picture"), Image.open(path) as image:
        if image.width * image.height > most:
            raise refuse(path, "size", f"more than {most:,} pixels", "crop or resample it", image.size)
        if image.mode not in modes:
            raise refuse(path, "mode", "not a picture of one channel", remedy, image.mode)
        return np.asarray(image, dtype=float), image.mode, dict(getattr(image, "tag_v2", {}))
