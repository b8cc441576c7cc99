"""Read pictures as arrays; their size and mode are checked before they are decompressed."""

from __future__ import annotations

import io
import zipfile
from collections.abc import Collection
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from vehsim.intake.gate import reading, refuse
from vehsim.intake.reader import Answer, read_cached, read_in_process

Colours = NDArray[np.uint8]

MAX_PIXELS = 150_000_000
"""The largest accepted picture."""


def read_picture(
    path: Path, modes: Collection[str], most: int, remedy: str
) -> tuple[NDArray[np.float64], str, dict[int, Any]]:
    """A picture of one channel (rows, columns), its mode, and the numbers among the tags of a TIFF. Raises
    ``InputError``.

    ``modes``: the accepted ones of Pillow's; ``remedy``: the fix for others; ``most`` pixels.
    """
    facts, (pixels,) = read_cached(one_channel, path, "picture", list(modes), most, remedy)
    return np.asarray(pixels, float), facts["mode"], {int(tag): value for tag, value in facts["tags"].items()}


def one_channel(path: Path, modes: Collection[str], most: int, remedy: str) -> Answer:
    """The pixels of a picture of one channel. It runs in the reader process."""
    from PIL import Image

    with Image.open(path) as image:
        if image.width * image.height > most:
            raise refuse(path, "size", f"more than {most:,} pixels", "crop or resample it", image.size)
        if image.mode not in modes:
            raise refuse(path, "mode", "not a picture of one channel", remedy, image.mode)
        tags = {tag: list(map(float, value)) for tag, value in _tags(image).items()}
        return {"mode": image.mode, "tags": tags}, [np.asarray(image)]


def _tags(image: Any) -> dict[int, tuple[Any, ...]]:
    """The tags of a TIFF that contain several numbers."""
    numbers = dict(getattr(image, "tag_v2", {})).items()
    return {tag: value for tag, value in numbers if isinstance(value, tuple) and not isinstance(value[0], str | bytes)}


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
