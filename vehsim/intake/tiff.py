"""Read heights from GeoTIFF files by window: only the strips or tiles that meet the window are read and decompressed.

Pillow reads the tags and decompresses: each strip or tile is given to it as a TIFF of its own, whose pixels are bytes.
Pillow itself would decode the whole picture, no 64-bit floats, and compressed big-endian floats wrongly.
"""

from __future__ import annotations

import io
import warnings
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from vehsim.intake.arrays import Window
from vehsim.intake.foreign import refuse
from vehsim.intake.reader import Answer, read_cached

WIDTH, LENGTH, BITS, COMPRESSION, PHOTOMETRIC, FILL_ORDER = 256, 257, 258, 259, 262, 266
STRIP_OFFSETS, SAMPLES, STRIP_ROWS, STRIP_BYTES, PREDICTOR = 273, 277, 278, 279, 317
TILE_WIDTH, TILE_LENGTH, TILE_OFFSETS, TILE_BYTES, FORMAT, JPEG_TABLES = 322, 323, 324, 325, 339, 347
PIXEL_SCALE, TIE_POINT, GDAL_NODATA = 33550, 33922, 42113
UNCOMPRESSED, SUMS, FLOAT_SUMS = 1, 2, 3
"""Values of ``COMPRESSION`` and ``PREDICTOR``."""
LONG = 4
"""Type of a tag: unsigned 32-bit numbers."""
KINDS = {1: "u", 2: "i", 3: "f"}
"""NumPy's kind of number by the value of ``FORMAT``."""
NUMBERS = ("u1", "u2", "u4", "i1", "i2", "i4", "f2", "f4", "f8")
MOST = 1_000_000_000
"""The most pixels of a strip or tile, which is decompressed at once."""
Pair = tuple[int, int]


@dataclass(frozen=True)
class TiffHeader:
    """Rows and columns, GeoTIFF's pixel scale and tie point, and GDAL's value for missing pixels."""

    shape: Pair
    scale: list[float] | None
    tie: list[float] | None
    nodata: float | None


def read_tiff_header(path: Path) -> TiffHeader:
    """What a TIFF of one band contains. Raises ``InputError``."""
    facts, _ = read_cached(header, path, "heights")
    return TiffHeader(**facts | {"shape": tuple(facts["shape"])})


def read_tiff(path: Path, window: Window) -> NDArray[np.float64]:
    """The pixels (rows, columns) of a window of a TIFF: its first and last row and column, the last ones excluded.
    Raises ``InputError``."""
    return np.asarray(read_cached(pixels, path, "heights", window)[1][0], float)


def header(path: Path) -> Answer:
    """The arguments of `TiffHeader`. It runs in the reader process."""
    with path.open("rb") as file:
        tags = _tags(file)
        layout = _Layout.of(path, tags)
        numbers = {"scale": PIXEL_SCALE, "tie": TIE_POINT}
        placed = {name: list(map(float, tags[tag])) if tag in tags else None for name, tag in numbers.items()}
        return {"shape": layout.shape, "nodata": _nodata(tags, layout.kind), **placed}, []


def pixels(path: Path, window: Window) -> Answer:
    """The pixels of a window, NaN where GDAL left out a strip or tile. It runs in the reader process."""
    first, last, left, right = window
    with path.open("rb") as file:
        tags = _tags(file)
        layout, size = _Layout.of(path, tags), path.stat().st_size
        missing = 0 if _nodata(tags, layout.kind) is None else np.nan
        found = np.full((last - first, right - left), missing, np.result_type(layout.kind, np.float32))
        for (top, start), shape, (offset, count) in layout.segments(window):
            if not count:
                continue
            if offset + count > size:
                raise refuse(path, "heights", "a strip or tile lies beyond the end of the file", "export it again")
            file.seek(offset)
            part = layout.decoded(tags, file.read(count), shape)
            rows = slice(max(top, first), min(top + shape[0], last))
            columns = slice(max(start, left), min(start + shape[1], right))
            found[_less(rows, first), _less(columns, left)] = part[_less(rows, top), _less(columns, start)]
    return {}, [found]


def _less(span: slice, by: int) -> slice:
    return slice(span.start - by, span.stop - by)


def _tags(file: BinaryIO) -> Any:
    """The tags of the first picture: Pillow's ``ImageFileDirectory_v2``."""
    from PIL.TiffImagePlugin import ImageFileDirectory_v2

    order = file.read(2)
    version = int.from_bytes(file.read(2), "big" if order == b"MM" else "little")
    start = (b"II+\0" if version == 43 else b"II*\0") + file.read(12 if version == 43 else 4)
    if order not in (b"II", b"MM") or version not in (42, 43):
        raise ValueError("not a TIFF")
    tags = ImageFileDirectory_v2(start, prefix=order)
    file.seek(tags.next)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # Pillow calls tags EXIF
        tags.load(file)
    if not {LENGTH, WIDTH} <= set(tags):
        raise ValueError("it ends before its tags")
    return tags


def _nodata(tags: Any, kind: np.dtype[Any]) -> float | None:
    """GDAL's value for missing pixels, a text with fewer digits than the floats of that ``kind`` have."""
    try:
        value = float(str(tags.get(GDAL_NODATA)).strip("\0 "))
    except ValueError:
        return None
    with np.errstate(over="ignore"):
        return float(kind.type(value)) if kind.kind == "f" else value


@dataclass(frozen=True)
class _Layout:
    """Where a TIFF has its pixels: ``shape`` rows and columns of numbers of a ``kind``, in strips or tiles of ``part``
    rows and columns, at ``offsets`` and with ``counts`` of bytes, row by row.

    Of uncompressed strips, each row counts as one, because a large file may be a single strip.
    """

    shape: Pair
    kind: np.dtype[Any]
    part: Pair
    offsets: Sequence[int]
    counts: Sequence[int]
    tiled: bool
    strip: int
    """Rows of a strip as the file has it."""

    @classmethod
    def of(cls, path: Path, tags: Any) -> _Layout:
        """The layout. Raises ``InputError``."""
        rows, columns = tags[LENGTH], tags[WIDTH]
        bits, form = tags.get(BITS, (1,)), tags.get(FORMAT, (1,))
        if tags.get(SAMPLES, 1) != 1 or len(bits) != 1:
            raise refuse(path, "heights", "more than one band", "export one band", tags.get(SAMPLES, 1))
        number = f"{KINDS.get(form[0])}{bits[0] / 8:g}"
        if number not in NUMBERS:
            remedy = "save 32-bit floats, such as with gdal_translate -ot Float32"
            raise refuse(path, "heights", f"pixels of {bits[0]} bits, format {form[0]}", remedy)
        tiled = TILE_OFFSETS in tags
        strip = min(tags.get(STRIP_ROWS, rows), rows)
        by_row = tags.get(COMPRESSION, UNCOMPRESSED) == UNCOMPRESSED
        part = (tags[TILE_LENGTH], tags[TILE_WIDTH]) if tiled else (1 if by_row else strip, columns)
        if not (min(rows, columns, strip, *part) > 0 and part[0] * part[1] <= MOST):
            remedy = "save it in tiles, such as with gdal_translate -co TILED=YES, or as an .npy"
            raise refuse(path, "heights", f"a strip or tile of more than {MOST:,} pixels, or of none", remedy, part)
        offsets, counts = (TILE_OFFSETS, TILE_BYTES) if tiled else (STRIP_OFFSETS, STRIP_BYTES)
        kind = np.dtype(number).newbyteorder(">" if tags.prefix == b"MM" else "<")
        return cls((rows, columns), kind, part, tags[offsets], tags[counts], tiled, strip)

    def segments(self, window: Window) -> Iterator[tuple[Pair, Pair, Pair]]:
        """First row and column, rows and columns, and offset and bytes in the file of each strip or tile that meets the
        window. GDAL leaves out those without content: no bytes."""
        (height, width), (first, last, left, right) = self.part, window
        across = -(-self.shape[1] // width)
        for row in range(first // height, -(-last // height)):
            top = row * height
            rows = height if self.tiled else min(height, self.shape[0] - top)
            for column in range(left // width, -(-right // width)):
                yield (top, column * width), (rows, width), self._place(row * across + column)

    def _place(self, k: int) -> Pair:
        if self.tiled or self.part[0] == self.strip:
            return self.offsets[k], self.counts[k]
        strip, row = divmod(k, self.strip)
        length = self.part[1] * self.kind.itemsize
        return self.offsets[strip] + row * length, length if self.counts[strip] else 0

    def decoded(self, tags: Any, content: bytes, shape: Pair) -> NDArray[Any]:
        """The pixels of a strip or tile of ``shape`` rows and columns."""
        rows, columns = shape
        if tags.get(COMPRESSION, UNCOMPRESSED) == UNCOMPRESSED:
            return np.frombuffer(content, self.kind, rows * columns).reshape(shape)
        plain = _decompressed(tags, content, (rows, columns * self.kind.itemsize))
        predictor = tags.get(PREDICTOR, 1)
        if predictor == FLOAT_SUMS:  # sums along each row of bytes; first all highest bytes, then all second ones
            planes = np.cumsum(plain, axis=1, dtype=np.uint8).reshape(rows, self.kind.itemsize, columns)
            return np.ascontiguousarray(planes.swapaxes(1, 2)).view(self.kind.newbyteorder(">"))[..., 0]
        numbers = plain.view(self.kind)
        if predictor == SUMS:
            return np.cumsum(numbers, axis=1, dtype=self.kind.newbyteorder("="))
        return numbers


def _decompressed(tags: Any, content: bytes, shape: Pair) -> NDArray[np.uint8]:
    """The bytes of a strip or tile, as a picture of ``shape`` rows and columns."""
    from PIL.TiffImagePlugin import ImageFileDirectory_v2, TiffImageFile

    own = ImageFileDirectory_v2()
    given = {tag: tags[tag] for tag in (COMPRESSION, FILL_ORDER, JPEG_TABLES) if tag in tags}
    numbers = {LENGTH: shape[0], WIDTH: shape[1], STRIP_ROWS: shape[0], BITS: 8, PHOTOMETRIC: 1}
    places = {STRIP_OFFSETS: 0, STRIP_BYTES: len(content)}  # `save` adds the length of the tags to the offset
    for tag, value in (given | numbers | places).items():
        own.tagtype[tag] = LONG if tag in numbers | places else tags.tagtype[tag]
        own[tag] = value
    file = io.BytesIO()
    own.save(file)
    file.write(content)
    file.seek(0)
    with TiffImageFile(file) as picture:
        return np.array(picture)
