"""How files are refused, and two rules for all of them: size is bounded, and no reader's exception escapes."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from vehsim.errors import InputError

MAX_BYTES = 4_000_000_000
"""The largest accepted file."""


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
        if (size := path.stat().st_size) > MAX_BYTES:
            raise refuse(path, key, f"{size / 1e9:.1f} GB, at most {MAX_BYTES / 1e9:g}", "give a smaller file")
        yield
    except InputError:
        raise
    except Exception as error:
        lines = str(error).strip().splitlines()
        said = f"{type(error).__name__}: {lines[-1][:300]}" if lines else type(error).__name__
        raise refuse(path, key, f"cannot be read ({said})", remedy) from error
