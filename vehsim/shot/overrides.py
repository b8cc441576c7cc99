"""Overrides of a shot file: ``world.wind=[0,3,0]`` and the like, written into its data."""

from __future__ import annotations

import re
import tomllib
from collections.abc import Sequence
from typing import Any

from vehsim.errors import Problem, ShotError

_STEP = re.compile(r"([A-Za-z0-9_\-]+)((?:\[\d+\])*)$")


def apply_overrides(data: Any, overrides: Sequence[str]) -> None:
    """Write ``world.wind=[0,3,0]`` and the like into ``data``. Values are TOML; bare words are text.

    ``vehicle[0].motion.cost`` and ``vehicle.heli.motion.cost`` refer to a list's entry by index or by name.
    """
    for override in overrides:
        key, equals, text = override.partition("=")
        if not equals or not key.strip():
            raise ShotError([Problem("--set", "not KEY=VALUE", "give it as world.wind=[0,3,0]", override)])
        assign(data, key.strip(), _value(text))


def assign(data: Any, key: str, value: Any) -> None:
    """Write ``value`` under a key such as ``vehicle.heli.motion.cost``. Raises ``ShotError``."""
    *parents, last = _steps(key)
    table: Any = data
    for step in parents:
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
            raise ShotError([Problem("--set", "not a key", "give it as vehicle[0].motion.cost=time", key)])
        steps += [found[1], *map(int, re.findall(r"\d+", found[2]))]
    return steps


def _enter(table: Any, step: str | int, key: str) -> Any:
    """The table one step down; missing tables are created, list entries are not."""
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
    return ShotError([Problem("--set", f"there is no {step!r}", "name tables and entries of the shot file", key)])


def _value(text: str) -> Any:
    try:
        return tomllib.loads(f"value = {text}")["value"]
    except (ValueError, RecursionError):
        return text.strip()
