"""Shot files as text: TOML in, overrides applied, and the line on which a key stands."""

from __future__ import annotations

import re
import tomllib
from collections.abc import Mapping, Sequence
from typing import Any

from vehsim.errors import Problem, ShotError

_HEADER = re.compile(r"^\s*(\[\[?)\s*([\w.\-\" ]+?)\s*\]")
_KEY = re.compile(r"^\s*([\w.\-]+)\s*=")
_STEP = re.compile(r"([A-Za-z0-9_\-]+)((?:\[\d+\])*)$")


def apply_overrides(data: Any, overrides: Sequence[str]) -> None:
    """Write ``world.wind=[0,3,0]`` and the like into ``data``. Values are TOML; bare words are text.

    ``vehicle[0].motion.cost`` and ``vehicle.heli.motion.cost`` name a list's entry by place or by name.
    """
    for override in overrides:
        key, equals, text = override.partition("=")
        if not equals or not key.strip():
            raise ShotError([Problem("--set", "not KEY=VALUE", "write it like world.wind=[0,3,0]", override)])
        assign(data, key.strip(), _value(text))


def assign(data: Any, key: str, value: Any) -> None:
    """Write ``value`` under a key such as ``vehicle.heli.motion.cost``. Raises ``ShotError``."""
    *way, last = _steps(key)
    table: Any = data
    for step in way:
        table = _enter(table, step, key)
    try:
        table[last if isinstance(table, dict) else int(last)] = value
    except (TypeError, ValueError, IndexError):
        raise _nowhere(key, last) from None


def _steps(key: str) -> list[str | int]:
    steps: list[str | int] = []
    for part in key.split("."):
        found = _STEP.match(part)
        if not found:
            raise ShotError([Problem("--set", "not a key", "write it like vehicle[0].motion.cost=time", key)])
        steps += [found[1], *map(int, re.findall(r"\d+", found[2]))]
    return steps


def _enter(table: Any, step: str | int, key: str) -> Any:
    """The table one step down; tables that are not there yet are made, list entries are not."""
    if isinstance(table, dict) and isinstance(step, str):
        return table.setdefault(step, {})
    if isinstance(table, dict) and step == 0:
        return table  # [camera] is a list of one
    if isinstance(table, list):
        if isinstance(step, int) and step < len(table):
            return table[step]
        for entry in table:
            if isinstance(entry, dict) and entry.get("name") == step:
                return entry
    raise _nowhere(key, step)


def _nowhere(key: str, step: object) -> ShotError:
    return ShotError([Problem("--set", f"{step!r} leads nowhere", "name tables and entries of the shot file", key)])


def _value(text: str) -> Any:
    try:
        return tomllib.loads(f"value = {text}")["value"]
    except (ValueError, RecursionError):
        return text.strip()


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
