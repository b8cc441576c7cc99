"""Read pictures as arrays; their size and mode are checked before they are decompressed."""

from __future__ import annotations

import io
import zipfile
from collections.abc import Collection
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from vehsim.intake.arrays import Window
from vehsim.intake.foreign import reading, refuse
from vehsim.intake.reader import Answer, read_cached, read_in_process

MAX_RASTER = 1_000_000_000
"""The largest picture of which a window is read: it is decoded whole, in the reader process."""
Colours = NDArray[np.uint8]

MAX_PIXELS = 150_000_000
"""The largest accepted picture."""


@dataclass(frozen=True)
class PictureHeader:
    """Rows and columns of a picture of one channel, and its mode."""

    shape: tuple[int, int]
    mode: str


def read_header(path: Path, modes: Collection[str], remedy: str) -> PictureHeader:
    """What a picture of one channel contains. Raises ``InputError``.

    ``modes``: the accepted ones of Pillow's; ``remedy``: the fix for others.
    """
    facts, _ = read_cached(header, path, "picture", list(modes), remedy)
    rows, columns = facts["shape"]
    return PictureHeader((rows, columns), facts["mode"])


def read_pixels(path: Path, window: Window) -> NDArray[np.float64]:
    """The pixels (rows, columns) of a window of a picture: its first and last row and column, the last ones excluded.
    Raises ``InputError``."""
    return np.asarray(read_cached(pixels, path, "picture", window)[1][0], float)


def header(path: Path, modes: Collection[str], remedy: str) -> Answer:
    """Size and mode of a picture of one channel. It runs in the reader process."""
    from PIL import Image

    Image.MAX_IMAGE_PIXELS = None  # `pixels` has a limit of its own
    with Image.open(path) as image:
        if image.mode not in modes:
            raise refuse(path, "mode", "not a picture of one channel", remedy, image.mode)
        return {"shape": [image.height, image.width], "mode": image.mode}, []


def pixels(path: Path, window: Window) -> Answer:
    """The pixels of a window of a picture. It runs in the reader process."""
    from PIL import Image

    Image.MAX_IMAGE_PIXELS = None
    with Image.open(path) as image:
        if image.width * image.height > MAX_RASTER:
            remedy = "give a part of it, or a TIFF or .npy, of which only a window is read"
            raise refuse(path, "size", f"more than {MAX_RASTER:,} pixels", remedy, image.size)
        first, last, left, right = window
        return {}, [np.asarray(image.crop((left, first, right, last)))]


def read_colours(path: Path) -> Colours:
    """A texture as colours (rows, columns, 3) in display space, also one inside a package: ``a.usdz[b.png]``. Raises
    ``InputError``."""
    file, _, inside = str(path).partition("[")
    given = Path(file), "RGB", inside.rstrip("]")
    read_cached(decodes, given[0], "texture", *given[1:])
    with reading(file, "texture"):
        return _decoded(*given)


def read_frame(path: Path, mode: str | None = None) -> NDArray[Any]:
    """A rendered picture in a mode of Pillow's, by default its own. Raises ``InputError``."""
    return read_in_process(decoded, path, "picture", mode)[1][0]


def decodes(path: Path, mode: str, inside: str) -> Answer:
    """Whether a picture can be read, as an answer without content. It runs in the reader process."""
    _decoded(path, mode, inside)
    return {}, []


def decoded(path: Path, mode: str | None) -> Answer:
    """The pixels of a picture. It runs in the reader process."""
    with reading(path, "picture", "render it again"):
        return {}, [_decoded(path, mode)]


def _decoded(path: Path, mode: str | None, inside: str = "") -> NDArray[Any]:
    from PIL import Image

    with Image.open(_opened(path, inside)) as image:
        if image.width * image.height > MAX_PIXELS:
            raise refuse(path, "size", f"more than {MAX_PIXELS:,} pixels", "give a smaller picture", image.size)
        return np.asarray(image if mode is None else image.convert(mode))


def _opened(path: Path, inside: str) -> Path | BinaryIO:
    """A file, or a file inside a package."""
    if not inside:
        return path
    with zipfile.ZipFile(path) as package:
        return io.BytesIO(package.read(inside))
