"""Read TOML files: plain tables with bounded nesting and numbers that fit a machine."""

from __future__ import annotations

import io
import re
import tomllib
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

from vehsim.errors import Problem, ShotError, VehsimError

MAX_BYTES = 5_000_000
"""The largest accepted file: one of this size, full of whole numbers, takes 5 s to read."""
MAX_DEPTH = 50
"""Largest depth of tables and arrays."""
_HEADER = re.compile(r"^\s*(\[\[?)([\w.\-\" \t]+)\]")
_PART = r"""(?:[\w\-]++|"[^"\n]*+"|'[^'\n]*+')[ \t]*+\.[ \t]*+"""
_LONG_KEY = re.compile(rf"""(?<![\w.\-"'])(?:{_PART}){{{MAX_DEPTH + 1}}}""")
"""The start of a key of too many parts: the time to read it grows with their square."""
_KEY = re.compile(r"^\s*([\w.\-]+)\s*=")
LARGEST = 2**63
"""TOML's integers have 64 bits."""


def read_toml(path: Path) -> tuple[dict[str, Any], str]:
    """The file's data and text. Raises ``ShotError``."""

    def refuse(message: str, remedy: str) -> ShotError:
        return ShotError([Problem("file", message, remedy, file=str(path))])

    try:
        if path.is_fifo() and path.parts[:2] != ("/", "dev"):  # a shell's <(...) is below /dev
            raise refuse("a named pipe", "give the path of a TOML file")
        with path.open("rb") as file:
            content = file.read(MAX_BYTES + 1)  # not its stated size: that of a device is 0
        if len(content) > MAX_BYTES:
            raise refuse(f"larger than {MAX_BYTES // 1_000_000} MB", "give a smaller file")
        text = io.TextIOWrapper(io.BytesIO(content), encoding="utf-8-sig").read()
        if found := _LONG_KEY.search(text):
            line = text.count("\n", 0, found.start()) + 1
            message = f"nested too deeply: a key of more than {MAX_DEPTH} parts in line {line}"
            raise refuse(message, f"nest at most {MAX_DEPTH} tables and arrays")
        data = tomllib.loads(text)
    except FileNotFoundError:
        raise refuse("no such file", "give the path of a TOML file") from None
    except OSError as error:
        raise refuse(f"cannot be read: {error.strerror}", "give the path of a TOML file") from None
    except UnicodeDecodeError:
        raise refuse("not UTF-8 text", "save it as UTF-8") from None
    except RecursionError:
        raise refuse("nested too deeply", f"nest at most {MAX_DEPTH} tables and arrays") from None
    except (ValueError, TypeError, AttributeError) as error:  # TOML errors, integers with thousands of digits
        raise refuse(f"not TOML: {error}", "fix the syntax there") from None
    if problem := too_large(data):
        raise ShotError([replace(problem, file=str(path))])
    return data, text


def too_large(data: Any) -> Problem | None:
    """A problem if data is nested too deeply or has an integer of more than 64 bits; else None."""
    left = [("", data, 0)]
    while left:
        key, value, depth = left.pop()
        if depth > MAX_DEPTH:
            key = f"{key[:60]}..." if len(key) > 60 else key
            return Problem(key or "file", "nested too deeply", f"nest at most {MAX_DEPTH} tables and arrays")
        if isinstance(value, dict):
            left += [(f"{key}.{name}".lstrip("."), below, depth + 1) for name, below in value.items()]
        elif isinstance(value, list | tuple):
            left += [(f"{key}[{i}]", below, depth + 1) for i, below in enumerate(value)]
        elif isinstance(value, int) and not -LARGEST <= value < LARGEST:
            return Problem(key or "file", "a whole number of more than 64 bits", "give a smaller number")
    return None


def lines_of(text: str) -> dict[str, int]:
    """Line numbers by dotted key, from a simple scan of the text: headers, and keys at the start of a line."""
    lines: dict[str, int] = {}
    counts: dict[str, int] = {}
    table = ""
    for number, line in enumerate(text.splitlines(), start=1):
        if header := _HEADER.match(line):
            table = _table(header[2].replace('"', "").strip(), header[1] == "[[", counts)
            lines.setdefault(table, number)
        elif key := _KEY.match(line):
            lines.setdefault(f"{table}.{key[1]}".lstrip("."), number)
    return lines


@contextmanager
def lines_in(path: Path) -> Iterator[None]:
    """Add line numbers to the problems raised in this context about keys of the TOML file ``path``."""
    try:
        yield
    except VehsimError as error:
        lines = lines_of(path.read_text(encoding="utf-8-sig"))
        error.problems = [
            replace(each, line=line_of(each.key, lines)) if each.file == str(path) and each.line is None else each
            for each in error.problems
        ]
        raise


def _table(name: str, is_entry: bool, counts: dict[str, int]) -> str:
    """A header's dotted key with list indices: ``vehicle.motion.mark`` is ``vehicle[0].motion.mark[2]``."""
    place = ""
    parts = name.split(".")
    for i, part in enumerate(parts):
        place = f"{place}.{part.strip()}".lstrip(".")
        if is_entry and i == len(parts) - 1:
            counts[place] = counts.get(place, -1) + 1
        if place in counts:
            place = f"{place}[{counts[place]}]"
    return place


def line_of(key: str, lines: Mapping[str, int]) -> int | None:
    """The line of ``key``, or of the closest table around it."""
    while key and key not in lines:
        key = key[: max(key.rfind("."), key.rfind("["), 0)]
    return lines.get(key)
