"""GeoTIFF files by window. The files are written here after the TIFF 6.0 and BigTIFF descriptions, with tiles,
predictors and byte orders that Pillow cannot write; LZW and PackBits come from libtiff."""

from __future__ import annotations

import itertools
import struct
import subprocess
import sys
import zlib
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from vehsim.errors import InputError
from vehsim.intake.tiff import read_tiff, read_tiff_header
from vehsim.world.terrain.terrain import Terrain

RNG = np.random.default_rng(0)
WINDOW = (13, 101, 40, 117)


def pixels_of(kind):
    """Numbers of all magnitudes, with both signs if the kind has them."""
    if kind[0] == "f":
        return (RNG.normal(size=(150, 130)) * 10.0 ** RNG.integers(-3, 4, (150, 130))).astype(kind)
    return RNG.integers(np.iinfo(kind).min, np.iinfo(kind).max, (150, 130), endpoint=True).astype(kind)


def differences(part, predictor, order):
    """What a predictor leaves of a strip or tile, as bytes."""
    if predictor == 2:
        part = np.diff(part, axis=1, prepend=part.dtype.type(0)).astype(part.dtype)
    if predictor == 3:
        planes = part.astype(part.dtype.newbyteorder(">")).view(np.uint8).reshape(*part.shape, -1).swapaxes(1, 2)
        row = planes.reshape(len(part), -1)
        return np.diff(row, axis=1, prepend=np.uint8(0)).astype(np.uint8).tobytes()
    return part.astype(part.dtype.newbyteorder(order)).tobytes()


def write_tiff(path, heights, tile=None, rows=None, deflate=False, predictor=1, order="<", **more):
    """Write heights in tiles, or in strips of some ``rows``."""
    parts, (height, width) = [], tile or (rows or len(heights), heights.shape[1])
    for top, left in itertools.product(range(0, heights.shape[0], height), range(0, heights.shape[1], width)):
        part = heights[top : top + height, left : left + width]
        if tile:
            part = np.pad(part, ((0, height - part.shape[0]), (0, width - part.shape[1])))
        content = differences(part, predictor, order)
        parts.append(zlib.compress(content) if deflate else content)
    about = {259: ("H", [8 if deflate else 1]), 317: ("H", [predictor])}
    about |= {322: ("H", [width]), 323: ("H", [height])} if tile else {278: ("L", [height])}
    write_parts(path, heights.shape, heights.dtype, parts, about, order=order, **more)


def write_parts(path, shape, kind, parts, tags, order="<", big=False, places=None):
    """A TIFF of encoded ``parts`` and more ``tags``; ``places`` are their offsets after the first, and lengths, if they
    are not in turn."""
    offsets = np.concatenate([[0], np.cumsum([len(each) for each in parts])[:-1]])
    offsets, counts = (offsets, [len(each) for each in parts]) if places is None else places
    number, first = "Q" if big else "L", 324 if 322 in tags else 273
    entries = {
        256: ("L", [shape[1]]), 257: ("L", [shape[0]]), 258: ("H", [8 * kind.itemsize]), 262: ("H", [1]),
        277: ("H", [1]), 339: ("H", ["uif".index(kind.kind) + 1]),
        first: (number, [16 + int(each) for each in offsets]),
        (325 if 322 in tags else 279): (number, list(counts)),
        **tags,
    }  # fmt: skip
    types, content = {"H": 3, "L": 4, "d": 12, "Q": 16, "s": 2}, b"".join(parts)
    at = 16 + len(content) + len(content) % 2
    inline, entry = (8, "HHQ8s") if big else (4, "HHL4s")
    after = at + (8 if big else 2) + len(entries) * struct.calcsize("=" + entry) + inline
    table, data = b"", b""
    for tag, (form, values) in sorted(entries.items()):
        count = len(values[0]) if form == "s" else len(values)
        raw = struct.pack(f"{order}{count}{form}", *values)
        if len(raw) > inline:
            raw, data = struct.pack(order + number, after + len(data)), data + raw
        table += struct.pack(order + entry, tag, types[form], count, raw)
    head = struct.pack(order + ("HHHQ" if big else "HL"), *((43, 8, 0, at) if big else (42, at)))
    count = struct.pack(order + ("Q" if big else "H"), len(entries))
    with path.open("wb") as file:
        file.write({"<": b"II", ">": b"MM"}[order] + head)
        file.seek(16)
        file.write(content)
        file.seek(at)
        file.write(count + table + bytes(inline) + data)


@pytest.mark.parametrize("kind", ["u1", "u2", "i2", "i4", "u4", "f4", "f8"])
@pytest.mark.parametrize("layout", [{"tile": (32, 48)}, {"rows": 7}, {}], ids=["tiles", "strips", "one strip"])
@pytest.mark.parametrize("code", ["plain", "deflate", "sums"])
@pytest.mark.parametrize(("order", "big"), [("<", False), (">", False), ("<", True), (">", True)])
def test_a_window_is_the_slice_of_what_was_written(tmp_path, kind, layout, code, order, big):
    heights, file = pixels_of(kind), tmp_path / "t.tif"
    predictor = 1 if code != "sums" else 3 if kind[0] == "f" else 2
    write_tiff(file, heights, **layout, deflate=code != "plain", predictor=predictor, order=order, big=big)
    assert read_tiff_header(file).shape == heights.shape
    first, last, left, right = WINDOW
    np.testing.assert_array_equal(read_tiff(file, WINDOW), heights[first:last, left:right])
    np.testing.assert_array_equal(read_tiff(file, (0, 150, 0, 130)), heights)


@pytest.mark.parametrize("compression", ["tiff_lzw", "packbits", "tiff_adobe_deflate", "raw", "zstd", "lzma"])
@pytest.mark.parametrize("kind", ["u1", "u2", "i4", "f4"])
def test_windows_of_what_libtiff_wrote(tmp_path, compression, kind):
    heights = np.repeat(pixels_of(kind), 200, axis=0)  # many strips
    Image.fromarray(heights).save(tmp_path / "t.tif", compression=compression)
    np.testing.assert_array_equal(read_tiff(tmp_path / "t.tif", (9_990, 10_450, 3, 129)), heights[9_990:10_450, 3:129])


def large(path, kind, side=60_000, tile=512, big=True):
    """A square raster of tiles, of which all but one, of sevens, are zeros, stored once."""
    across = -(-side // tile)
    zeros, sevens = (zlib.compress(np.full((tile, tile), value, kind).tobytes(), 9) for value in (0, 7))
    offsets, counts = np.zeros(across**2, int), np.full(across**2, len(zeros))
    offsets[100 * across + 90], counts[100 * across + 90] = len(zeros), len(sevens)
    tags = {259: ("H", [8]), 322: ("H", [tile]), 323: ("H", [tile])}
    tags |= {33550: ("d", (1.0, 1.0, 0.0)), 33922: ("d", (0.0, 0.0, 0.0, 0.0, side, 0.0))}
    write_parts(path, (side, side), np.dtype(kind), [zeros, sevens], tags, big=big, places=(offsets, counts.tolist()))


PROGRAM = """
import resource, sys
from pathlib import Path
from vehsim.world.terrain.terrain import Terrain
heights = Terrain.load(Path(sys.argv[1])).heights
from vehsim.intake.reader import _Process
_Process._kept.end()
status = Path("/proc/self/status").read_text()
own = int(status.partition("VmHWM:")[2].split()[0])  # kB; ru_maxrss would include the process that started this one
most = max(own, resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss)
print(*heights.shape, int(heights.sum()), most // 1000)
"""


@pytest.mark.skipif(not Path("/proc/self/status").exists(), reason="memory is read from /proc")
@pytest.mark.parametrize("big", [False, True], ids=["TIFF", "BigTIFF"])
def test_a_raster_of_14_gb_is_read_by_window(tmp_path, big):
    large(tmp_path / "t.tif", "f4", big=big)
    west, north = 90 * 512 + 0.5, 60_000 - 100 * 512 - 0.5  # of the tile of sevens
    (tmp_path / "t.toml").write_text(f"crop = [{west - 100}, {north - 900}, {west + 900}, {north + 100}]\n")
    done = subprocess.run([sys.executable, "-c", PROGRAM, str(tmp_path / "t.tif")], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    rows, columns, total, megabytes = map(int, done.stdout.split())
    assert (rows, columns, total) == (1001, 1001, 7 * 512**2)
    assert megabytes < 400


def test_a_single_uncompressed_strip_may_be_larger_than_the_memory(tmp_path):
    """A file of 14.4 GB without blocks on the disk, but for a row of ones."""
    side = 60_000
    tags = {259: ("H", [1]), 278: ("L", [side])}
    write_parts(
        tmp_path / "t.tif", (side, side), np.dtype("f4"), [], tags, big=True, places=(np.array([10**6]), [4 * side**2])
    )
    with (tmp_path / "t.tif").open("r+b") as file:
        file.seek(10**6 + 16 + 4 * side * 50_000)
        file.write(np.ones(side, np.float32).tobytes())
        file.truncate(10**6 + 16 + 4 * side**2)
    found = read_tiff(tmp_path / "t.tif", (49_990, 50_010, 30_000, 31_000))
    np.testing.assert_array_equal(found, np.arange(20)[:, None] * np.ones(1000) == 10)


def test_tiles_that_gdal_left_out_are_zero_or_missing(tmp_path):
    """GDAL's SPARSE_OK: no offset and no bytes; missing heights if the file names their value, else zeros."""
    heights = np.full((64, 64), 5.0, np.float32)
    about = {259: ("H", [1]), 322: ("H", [32]), 323: ("H", [32])}
    part = heights[:32, :32].tobytes()
    places = (np.array([-16, 0, 0, 0]), [0, len(part), len(part), len(part)])
    for tags, missing in (({}, 0.0), ({42113: ("s", [b"-9999\0"])}, np.nan)):
        write_parts(tmp_path / "t.tif", heights.shape, heights.dtype, [part], about | tags, places=places)
        found = read_tiff(tmp_path / "t.tif", (16, 48, 16, 48))
        expected = heights[16:48, 16:48].astype(float)
        expected[:16, :16] = missing
        np.testing.assert_array_equal(found, expected)


def test_missing_heights_are_found_although_gdal_rounds_their_value(tmp_path):
    heights = np.full((6, 7), 12.0, np.float32)
    heights[2, 3] = np.finfo(np.float32).min
    tags = {259: ("H", [1]), 278: ("L", [6]), 42113: ("s", [b"-3.40282346638529e+38\0"])}
    write_parts(tmp_path / "t.tif", heights.shape, heights.dtype, [heights.tobytes()], tags)
    (tmp_path / "t.toml").write_text("cell = 2")
    with pytest.warns(UserWarning, match="1 of 42 heights are missing"):
        assert np.ptp(Terrain.load(tmp_path / "t.tif").heights) == 0


# ---------------------------------------------------------------- broken and hostile files


@pytest.mark.parametrize(
    ("tags", "words"),
    [
        ({322: ("L", [2**31]), 323: ("L", [2**31])}, ["more than 1,000,000,000 pixels", "tiles"]),
        ({322: ("L", [0])}, ["of none"]),
        ({324: ("L", [2**32 - 1] * 4)}, ["beyond the end of the file"]),
        ({325: ("L", [2**32 - 1] * 4)}, ["beyond the end of the file"]),
        ({324: ("L", [16])}, ["cannot be read"]),
        ({259: ("H", [8])}, ["cannot be read"]),
        ({259: ("H", [9999])}, ["cannot be read"]),
        ({259: ("H", [5])}, ["cannot be read"]),
        ({277: ("H", [3])}, ["more than one band"]),
        ({339: ("H", [6])}, ["format 6"]),
        ({258: ("H", [12])}, ["12 bits"]),
        ({33550: ("s", [b"wide\0"])}, ["cannot be read"]),
    ],
)
def test_hostile_tags_are_refused(tmp_path, tags, words):
    parts = [RNG.integers(0, 256, 32 * 32 * 4).astype(np.uint8).tobytes() for _ in range(4)]
    about = {259: ("H", [1]), 322: ("L", [32]), 323: ("L", [32])} | tags
    write_parts(tmp_path / "t.tif", (64, 64), np.dtype("f4"), parts, about)
    with pytest.raises(InputError) as caught:
        read_tiff_header(tmp_path / "t.tif")
        read_tiff(tmp_path / "t.tif", (0, 64, 32, 64))
    assert all(word in str(caught.value) for word in ["t.tif", *words]), str(caught.value)


def test_a_file_cut_anywhere_is_refused_or_read(tmp_path):
    heights = pixels_of("f4")
    write_tiff(tmp_path / "t.tif", heights, tile=(64, 64), deflate=True, predictor=3)
    content = (tmp_path / "t.tif").read_bytes()
    refused = 0
    for length in RNG.integers(0, len(content), 40):
        (tmp_path / "cut.tif").write_bytes(content[:length])
        try:
            np.testing.assert_array_equal(read_tiff(tmp_path / "cut.tif", WINDOW), heights[13:101, 40:117])
        except InputError:
            refused += 1
    assert refused >= 39
