"""Read arrays of numbers from NPY and NPZ files: headers are checked before data is read, and no code is executed."""

from __future__ import annotations

import math
import zipfile
from collections.abc import Collection
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from vehsim.intake.gate import MAX_BYTES, reading, refuse

NUMBERS = "biuf"
"""Accepted kinds of arrays: booleans, integers and real numbers."""


def read_array(path: Path, key: str) -> NDArray[Any]:
    """The array of an ``.npy`` file. Raises ``InputError``."""
    with reading(path, key), path.open("rb") as file:
        _check_header(path, key, file, path.stat().st_size)
        file.seek(0)
        return np.asarray(np.lib.format.read_array(file, allow_pickle=False))


def read_arrays(path: Path, key: str, wanted: Collection[str]) -> dict[str, NDArray[Any]]:
    """The ``wanted`` arrays that an ``.npz`` file contains, by name. Raises ``InputError``."""
    found: dict[str, NDArray[Any]] = {}
    with reading(path, key, f"give an .npz of {', '.join(wanted)}"), zipfile.ZipFile(path) as archive:
        for name in wanted:
            if f"{name}.npy" in archive.namelist():
                with archive.open(f"{name}.npy") as member:
                    _check_header(path, name, member, archive.getinfo(f"{name}.npy").file_size)
                with archive.open(f"{name}.npy") as member:
                    found[name] = np.asarray(np.lib.format.read_array(member, allow_pickle=False))
    return found


def _check_header(path: Path, key: str, file: Any, size: int) -> None:
    """Raise ``InputError`` unless the header announces numbers, at most as many as the ``size`` of the file permits."""
    shape, dtype = _header(file)
    if dtype.kind not in NUMBERS:
        raise refuse(path, key, "not an array of numbers", "save it as floats", str(dtype))
    if (needed := math.prod(shape) * dtype.itemsize) > min(size, MAX_BYTES):
        raise refuse(path, key, f"announces {needed:,} bytes and holds {size:,}", "save it again", shape)


def _header(file: BinaryIO) -> tuple[tuple[int, ...], np.dtype[Any]]:
    version = np.lib.format.read_magic(file)
    read = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
    shape, _, dtype = read(file)
    return tuple(shape), dtype
