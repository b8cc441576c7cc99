"""TOML files: plain tables, nested as deeply as a person would, with numbers that a machine holds."""

from __future__ import annotations

import re
import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from vehsim.errors import Problem, ShotError

MAX_BYTES = 50_000_000
MAX_DEPTH = 50
"""Tables and arrays inside each other."""
_HEADER = re.compile(r"^\s*(\[\[?)\s*([\w.\-\" ]+?)\s*\]")
_KEY = re.compile(r"^\s*([\w.\-]+)\s*=")
LARGEST = 2**63
"""TOML's whole numbers have 64 bits."""


def read_toml(path: Path) -> tuple[dict[str, Any], str]:
    """The file's data and text. Raises ``ShotError``."""

    def refuse(message: str, remedy: str) -> ShotError:
        return ShotError([Problem("file", message, remedy, file=str(path))])

    try:
        if path.stat().st_size > MAX_BYTES:
            raise refuse(f"larger than {MAX_BYTES // 1_000_000} MB", "give a smaller file")
        text = path.read_text(encoding="utf-8-sig")
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
        raise ShotError([Problem(problem.key, problem.message, problem.mend, file=str(path))])
    return data, text


def too_large(data: Any) -> Problem | None:
    """What is nested too deeply, or a whole number of more than 64 bits; None for all that can be worked with."""
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
    """Line numbers by dotted key, as far as a glance at the text gives them: headers, and keys that begin a line."""
    lines: dict[str, int] = {}
    counts: dict[str, int] = {}
    table = ""
    for number, line in enumerate(text.splitlines(), start=1):
        if header := _HEADER.match(line):
            table = _table(header[2].replace('"', ""), header[1] == "[[", counts)
            lines.setdefault(table, number)
        elif key := _KEY.match(line):
            lines.setdefault(f"{table}.{key[1]}".lstrip("."), number)
    return lines


def _table(name: str, is_entry: bool, counts: dict[str, int]) -> str:
    """A header's dotted key with the places of its lists: ``vehicle.motion.mark`` is ``vehicle[0].motion.mark[2]``."""
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
    """The line of ``key``, or of the nearest table around it."""
    while key and key not in lines:
        key = key[: max(key.rfind("."), key.rfind("["), 0)]
    return lines.get(key)
