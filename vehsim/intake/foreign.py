"""Errors for refused files, and the limits of all reading: size, time and memory are bounded; any exception of a
library becomes an `InputError`; a library that crashes ends only the reader process (`reader.py`)."""

from __future__ import annotations

import math
import os
import re
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from vehsim.errors import InputError

MAX_BYTES = 4_000_000_000
"""The largest accepted file, except those of which a part is read."""
BY_WINDOW = (".npy", ".tif", ".tiff")
"""Suffixes of files that may be larger than the memory, because a window of them is read."""
LIMITS = {
    "VEHSIM_READ_SECONDS": 15.0,
    "VEHSIM_READ_GB": 8.0,
    "VEHSIM_READ_PRIMS": 200_000.0,
    "VEHSIM_READ_PARTS": 10_000.0,
}
"""Default limits for reading one file, by the environment variable that changes them: processor time, s; address space
of the reader process, GB; prims of a stage, instances included; parts of a vehicle."""


def limit(variable: str) -> float:
    """The value of a limit of `LIMITS`. Raises ``InputError`` if the environment's is not a number above zero."""
    given = os.environ.get(variable)
    if given is None:
        return LIMITS[variable]
    try:
        value = float(given)
    except ValueError:
        value = math.nan
    if not 0 < value < math.inf:
        raise InputError(
            "not a number above zero", f"give one, such as {LIMITS[variable]:g}", key=variable, value=given
        )
    return value


def raise_limit(variable: str, instead: str = "give a smaller file") -> str:
    """The remedy for a file beyond a limit."""
    return f"{instead}, or raise the limit: {variable}={4 * limit(variable):g}"


def check_parts(count: int, file: Path | str) -> None:
    """Raise ``InputError`` if a vehicle has more parts than its reading, hulls and animation are made for."""
    if count > (most := limit("VEHSIM_READ_PARTS")):
        remedy = raise_limit("VEHSIM_READ_PARTS", "join the parts that do not move on their own")
        raise refuse(file, "asset", f"{count:,} parts, at most {most:,.0f}", remedy)


def refuse(file: Path | str, key: str, message: str, remedy: str, value: object = None) -> InputError:
    """The error for a refused file."""
    return InputError(message, remedy, key=key, value=value, file=file)


@contextmanager
def reading(path: Path | str, key: str, remedy: str = "export the file again") -> Iterator[None]:
    """A context for reading ``path``: any library's exception becomes an ``InputError`` of the file's ``key``."""
    path = Path(path)
    try:
        if not path.is_file():
            raise refuse(
                path, key, "a folder" if path.is_dir() else "no such file", "put the file there or correct the path"
            )
        if (size := path.stat().st_size) > MAX_BYTES and path.suffix.lower() not in BY_WINDOW:
            raise refuse(path, key, f"{size / 1e9:.1f} GB, at most {MAX_BYTES / 1e9:g}", "give a smaller file")
        yield
    except InputError:
        raise
    except MemoryError as error:
        message = f"takes more than {limit('VEHSIM_READ_GB'):g} GB to read"
        raise refuse(path, key, message, raise_limit("VEHSIM_READ_GB")) from error
    except Exception as error:
        reason = ": ".join(filter(None, (type(error).__name__, reason_of(error))))
        raise refuse(path, key, f"cannot be read ({reason})", remedy) from error


def reason_of(error: Exception) -> str:
    """The last line of an error's message, without what only a programmer can use: addresses of objects, quotes around
    all of it; in USD's errors the place in its sources, and the open stage."""
    lines = [line for line in str(error).splitlines() if any(map(str.isalnum, line))]
    last = lines[-1] if lines else ""
    last = re.sub(
        r".* in file \S+ : | <[\w.]+ object at 0x\w+>| on stage with rootLayer .*?(?='?\s*$)", "", last
    ).strip()
    quoted = re.fullmatch("'(.*)'", last)
    return (quoted[1] if quoted else last)[:300]
