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
Header = tuple[tuple[int, ...], bool, np.dtype[Any]]
"""Shape, whether columns are stored one after the other, and type of an array."""

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
        size = path.stat().st_size
        if window is not None:
            shape, fortran, dtype = _check_header(path, key, file, size, NUMBERS, size)
            return {}, [_window_of(path, file.tell(), shape, fortran, dtype, window)]
        _check_header(path, key, file, size, NUMBERS)
        file.seek(0)
        return {}, [np.asarray(np.lib.format.read_array(file, allow_pickle=False))]


def _window_of(
    path: Path, offset: int, shape: tuple[int, ...], fortran: bool, dtype: np.dtype[Any], window: Window
) -> NDArray[Any]:
    """A window of the array at an ``offset``. Only its rows (in Fortran's order: columns) are mapped, because the
    reader process has less address space than a raster may need."""
    if fortran:
        return _window_of(path, offset, shape[::-1], False, dtype, (*window[2:], *window[:2])).T
    first, last, left, right = window
    start = offset + first * shape[1] * dtype.itemsize
    rows = np.memmap(path, dtype, "r", start, (last - first, shape[1]))
    return np.array(rows[:, left:right])


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


def _check_header(path: Path, key: str, file: Any, size: int, kinds: str, most: int = MAX_BYTES) -> Header:
    """The header. Raises ``InputError`` unless it announces numbers that have at most ``most`` bytes and as many as the
    ``size`` of the file permits."""
    shape, fortran, dtype = _header(file)
    if dtype.kind not in kinds:
        raise refuse(path, key, "not an array of numbers", "save it as floats", str(dtype))
    if (needed := math.prod(shape) * dtype.itemsize) > min(size, most):
        raise refuse(path, key, f"announces {needed:,} bytes and holds {size:,}", "save it again", shape)
    return shape, fortran, dtype


def _header(file: BinaryIO) -> Header:
    version = np.lib.format.read_magic(file)
    read = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
    shape, fortran, dtype = read(file)
    return tuple(shape), fortran, dtype
