"""What the page offers to change: every number, switch, choice and place of the shot file, from the file's own models.

Settings and handles are read from the JSON schema of the shot file and the file's data; there is no other list of keys.
"""

from __future__ import annotations

import json
import math
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from typing import Any

from vehsim.intake.tables import DIRECTION, PLACE
from vehsim.runtime.cache import kept
from vehsim.runtime.code import code, version

KINDS = ("number", "integer", "boolean")
KEY = re.compile(r"([^.\[\]]+)|\[(\d+)\]")
"""A part of a dotted key: a name, or an index in brackets."""
DECIMALS = 3
"""Decimals of what is dragged: mm, and thousandths of a degree."""
Change = tuple[str, Any]
"""A dotted key and its new value."""


@dataclass(frozen=True)
class Setting:
    """One value: its dotted ``key``, the present ``value`` or None, the ``default``, and what it may be."""

    key: str
    table: str
    """What its table is called on the page, such as ``vehicle car, motion, mark 2 at 1085``."""
    kind: str
    """number, integer, boolean or choice"""
    value: Any
    default: Any
    about: str
    low: float | None = None
    high: float | None = None
    choices: tuple[str, ...] = ()


@dataclass(frozen=True)
class Handle:
    """A place in the file that can be dragged, or a direction there that can be turned."""

    key: str
    """Its dotted key, such as ``world.obstacle[0].centre``."""
    place: tuple[float, float, float]
    """Where it is, m: of corners their mean."""
    heading: float | None
    """The angle in degrees if the file gives one that turns with it, or its default."""
    turns: bool
    """Whether its table has a heading."""
    vehicle: int | None
    """The index of the vehicle that it belongs to; None: of none."""
    mark: int | None
    """The index of its mark; None: it is no mark."""
    obstacle: int | None
    """The index of its obstacle; None: it is none."""
    value: Any
    """As in the file."""
    on: str | None = None
    """Of a direction, the key of the place that it is at; None: this is a place itself."""
    tilt: float | None = None
    """Of a direction, its angle above the horizon in degrees."""

    def moved(
        self,
        place: Sequence[float],
        heading: float | None = None,
        frame: int | None = None,
        tilt: float | None = None,
    ) -> list[Change]:
        """What changes in the file when it is at ``place`` (3,) m, which a direction does not change; ``heading``,
        ``frame`` and ``tilt``: None to leave them."""
        if self.tilt is not None and self.heading is not None:
            turned = self.heading if heading is None else heading, self.tilt if tilt is None else tilt
            return [(self.key, _towards(*turned, math.hypot(*self.value)))]
        table, by = self.key.rpartition(".")[0], [b - a for a, b in zip(self.place, place, strict=True)]
        found: list[Change] = [(self.key, _shifted(self.value, by))]
        if _width(self.value) == 2 and by[2]:
            found.append((f"{table}.base", round(place[2], DECIMALS)))
        given = {"heading": None if heading is None else round(heading, DECIMALS), "frame": frame}
        return found + [(f"{table}.{name}", value) for name, value in given.items() if value is not None]


def handles(data: Mapping[str, Any]) -> list[Handle]:
    """The places that a valid shot file gives, and the directions at them, in its order."""
    found: list[Handle] = []
    for leaf in _leaves("", _schema(), data):
        value = leaf.table.get(leaf.name, leaf.about.get("default"))
        if value is None or not (form := _dragged(leaf.forms)):
            continue
        if form == DIRECTION:
            around = leaf.key.rsplit(".", 2)[0]
            found += [_direction(leaf.key, value, at) for at in found if at.key.rpartition(".")[0] == around]
            continue
        height, turns = leaf.table.get("base", 0.0), leaf.keys.get("heading")
        heading = leaf.table.get("heading", turns.get("default") if turns else None)
        part = {name: int(number) for name, number in re.findall(r"(\w+)\[(\d+)\]", leaf.key)}
        x, y, z = (*_mean(value), height)[:3]
        owners = part.get("vehicle"), part.get("mark"), part.get("obstacle")
        found.append(Handle(leaf.key, (x, y, z), heading, turns is not None, *owners, value))
    return found


def _dragged(forms: Sequence[Mapping[str, Any]]) -> str | None:
    """The format of values that can be dragged, or None."""
    return next((form["format"] for form in forms if form.get("format") in (PLACE, DIRECTION)), None)


def _direction(key: str, value: Sequence[float], at: Handle) -> Handle:
    """The handle of a direction (3,) of any length at a place."""
    level = math.hypot(*value[:2])
    heading, tilt = math.degrees(math.atan2(value[1], value[0])), math.degrees(math.atan2(value[2], level))
    return Handle(key, at.place, heading, True, at.vehicle, None, None, value, on=at.key, tilt=tilt)


def _towards(heading: float, tilt: float, length: float) -> list[float]:
    """The direction (3,) of angles in degrees; it has at least unit length, so that its decimals suffice."""
    yaw, pitch, length = math.radians(heading), math.radians(tilt), max(length, 1.0)
    level = length * math.cos(pitch)
    return [round(x, DECIMALS) for x in (level * math.cos(yaw), level * math.sin(yaw), length * math.sin(pitch))]


def _mean(value: Any) -> tuple[float, ...]:
    """A point, or the mean of corners."""
    if isinstance(value[0], list):
        return tuple(sum(column) / len(value) for column in zip(*value, strict=True))
    return tuple(value)


def _width(value: Any) -> int:
    return len(value[0] if isinstance(value[0], list) else value)


def _shifted(value: Any, by: Sequence[float]) -> Any:
    """A point or corners, moved ``by`` (3,) m."""
    if isinstance(value[0], list):
        return [_shifted(point, by) for point in value]
    return [round(a + b, DECIMALS) for a, b in zip(value, by, strict=False)]


def settings(data: Mapping[str, Any], variants: Sequence[Mapping[str, list[str]]] = ()) -> list[Setting]:
    """Those of the tables that a shot file has. ``variants``: variant set -> variants, of each vehicle in order."""
    found = [
        _setting(leaf.key, _title(leaf.key, data), leaf.about, leaf.forms[0], leaf.table.get(leaf.name))
        for leaf in _leaves("", _schema(), data)
        if leaf.forms and _kind(leaf.forms[0])
    ]
    for k, sets in enumerate(variants):
        given = data["vehicle"][k].get("variants", {})
        for name, choices in sets.items():
            key, value = f"vehicle[{k}].variants.{name}", given.get(name)
            found.append(
                Setting(key, _title(key, data), "choice", value, None, "a variant of the asset", choices=tuple(choices))
            )
    return found


@cache
def _schema() -> dict[str, Any]:
    def make() -> bytes:
        from vehsim.shot.schema.shot_file import ShotFile

        return json.dumps(ShotFile.model_json_schema(by_alias=True)).encode()

    made: dict[str, Any] = json.loads(kept("schema", (code(), version("pydantic")), make))
    return made


@dataclass(frozen=True)
class _Leaf:
    """A key of a table of the file that is no table itself."""

    key: str
    """Dotted."""
    name: str
    about: Mapping[str, Any]
    """Its schema in its table."""
    forms: Sequence[Mapping[str, Any]]
    """The schemas that its value may have."""
    table: Mapping[str, Any]
    """The table's data."""
    keys: Mapping[str, Mapping[str, Any]]
    """The schemas of all keys of the table."""


def _leaves(key: str, node: Mapping[str, Any], data: Any) -> Iterator[_Leaf]:
    """Those of a table, its own before those of tables in it, or of each table in a list."""
    if isinstance(data, list):
        for k, one in enumerate(data):
            yield from _leaves(f"{key}[{k}]", node, one)
        return
    if not isinstance(data, Mapping):  # an error that the check explains
        return
    for form in _forms(node, data):
        if form.get("type") == "array":
            yield from _leaves(key, form["items"], data)
        below: list[tuple[str, Mapping[str, Any], Any]] = []
        for name, child in form.get("properties", {}).items():
            place, value = f"{key}.{name}".lstrip("."), data.get(name)
            forms = list(_forms(child, value))
            if not _dragged(forms) and (
                isinstance(value, dict | list) or (value is None and "default" in child and _is_open(forms))
            ):
                below += [(place, one, value or {}) for one in forms]
                continue
            yield _Leaf(place, name, child, forms, data, form["properties"])
        for table in below:
            yield from _leaves(*table)


def _is_open(forms: list[Mapping[str, Any]]) -> bool:
    """Whether a table that is not given has only keys that may be left out, such as limits."""
    if len(forms) != 1 or "properties" not in forms[0]:
        return False
    return not forms[0].get("required")


def _forms(node: Mapping[str, Any], data: Any) -> Iterator[Mapping[str, Any]]:
    """The forms that a value may have, without references; of a table with a tag such as ``method``, the chosen one."""
    if "$ref" in node:
        yield from _forms(_schema()["$defs"][node["$ref"].rpartition("/")[2]], data)
    elif "discriminator" in node:
        tag = node["discriminator"]
        chosen = tag["mapping"].get(data.get(tag["propertyName"])) if isinstance(data, dict) else None
        if chosen:
            yield from _forms({"$ref": chosen}, data)
    elif "anyOf" in node or "oneOf" in node:
        for one in node.get("anyOf", node.get("oneOf")):
            yield from _forms(one, data)
    elif node.get("type") != "null":
        yield node


def _kind(node: Mapping[str, Any]) -> str:
    if "enum" in node:
        return "choice"
    return node["type"] if node.get("type") in KINDS else ""


def named(key: str, data: Any) -> str:
    """A dotted key as the page says it: with the title of its table if that is one of a list."""
    table, _, name = key.rpartition(".")
    return f"{_title(key, data)}: {name}" if table.find("[") > 0 else key


def _title(key: str, data: Any) -> str:
    """What the table of a dotted key is called: tables in lists by their names, or else by number and frame."""
    found: list[str] = []
    for name, index in KEY.findall(key.rpartition(".")[0]):
        if name:
            data = data.get(name) if isinstance(data, Mapping) else None
            found.append(name)
            continue
        data = data[int(index)] if isinstance(data, list) and int(index) < len(data) else {}
        frame = f" at {data['frame']}" if isinstance(data, Mapping) and "frame" in data else ""
        own = data.get("name") if isinstance(data, Mapping) else None
        found[-1] += f" {own or int(index) + 1}{frame}"
    return ", ".join(found) or "file"


def _setting(key: str, table: str, about: Mapping[str, Any], node: Mapping[str, Any], value: Any) -> Setting:
    default = about.get("default")
    return Setting(
        key=key,
        table=table,
        kind=_kind(node),
        value=value,
        default=default if isinstance(default, bool | int | float | str) else None,
        about=about.get("description", node.get("description", "")),
        low=node.get("minimum", node.get("ge", node.get("gt"))),
        high=node.get("maximum", node.get("le", node.get("lt"))),
        choices=tuple(map(str, node.get("enum", ()))),
    )
