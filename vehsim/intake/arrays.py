"""Read arrays of numbers from NPY and NPZ files: headers are checked before data is read, and no code is executed."""

from __future__ import annotations

import math
import zipfile
from collections.abc import Collection
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from vehsim.intake.foreign import MAX_BYTES, reading, refuse
from vehsim.intake.reader import Answer, read_cached, read_in_process

Arrays = dict[str, NDArray[Any]]

Window = tuple[int, int, int, int]

NUMBERS = "biuf"
"""Accepted kinds of arrays: booleans, integers and real numbers."""


def read_shape(path: Path, key: str) -> tuple[int, ...]:
    """The shape of the array of an ``.npy`` file, from its header. Raises ``InputError``."""
    return tuple(read_in_process(shape, path, key)[0])


def read_array(path: Path, key: str, window: Window | None = None) -> NDArray[Any]:
    """The array of an ``.npy`` file, or only the ``window`` of a two-dimensional one: its first and last row and
    column, the last ones excluded. Raises ``InputError``."""
    return read_in_process(array, path, key, key, window)[1][0]


def read_arrays(path: Path, key: str, wanted: Collection[str] | None = None, kinds: str = NUMBERS) -> Arrays:
    """The ``wanted`` arrays that an ``.npz`` file contains, by name; by default all. ``kinds``: those accepted. Raises
    ``InputError``."""
    names, found = read_cached(arrays, path, key, key, None if wanted is None else list(wanted), kinds)
    return dict(zip(names, found, strict=True))


def shape(path: Path) -> Answer:
    """The shape of the array of an ``.npy`` file. It runs in the reader process."""
    with path.open("rb") as file:
        return list(_header(file)[0]), []


def array(path: Path, key: str, window: Window | None) -> Answer:
    """The array of an ``.npy`` file, or a window of it. It runs in the reader process."""
    with path.open("rb") as file:
        _check_header(path, key, file, path.stat().st_size, NUMBERS)
        if window is not None:
            mapped = np.load(path, mmap_mode="r", allow_pickle=False)
            return {}, [np.array(mapped[window[0] : window[1], window[2] : window[3]])]
        file.seek(0)
        return {}, [np.asarray(np.lib.format.read_array(file, allow_pickle=False))]


def arrays(path: Path, key: str, wanted: Collection[str] | None, kinds: str) -> Answer:
    """Names and arrays of an ``.npz`` file. It runs in the reader process."""
    names, found = [], []
    remedy = "export it again" if wanted is None else f"give an .npz of {', '.join(wanted)}"
    with reading(path, key, remedy), zipfile.ZipFile(path) as archive:
        there = [name.removesuffix(".npy") for name in archive.namelist() if name.endswith(".npy")]
        for name in there if wanted is None else [name for name in wanted if name in there]:
            with archive.open(f"{name}.npy") as member:
                _check_header(path, name, member, archive.getinfo(f"{name}.npy").file_size, kinds)
            with archive.open(f"{name}.npy") as member:
                found.append(np.asarray(np.lib.format.read_array(member, allow_pickle=False)))
            names.append(name)
    return names, found


def _check_header(path: Path, key: str, file: Any, size: int, kinds: str) -> None:
    """Raise ``InputError`` unless the header announces numbers, at most as many as the ``size`` of the file permits."""
    shape, dtype = _header(file)
    if dtype.kind not in kinds:
        raise refuse(path, key, "not an array of numbers", "save it as floats", str(dtype))
    if (needed := math.prod(shape) * dtype.itemsize) > min(size, MAX_BYTES):
        raise refuse(path, key, f"announces {needed:,} bytes and holds {size:,}", "save it again", shape)


def _header(file: BinaryIO) -> tuple[tuple[int, ...], np.dtype[Any]]:
    version = np.lib.format.read_magic(file)
    read = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
    shape, _, dtype = read(file)
    return tuple(shape), dtype
