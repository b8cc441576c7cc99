"""What the page offers to change: every number, switch and choice of the shot file, from the file's own models.

A setting is read from the JSON schema of the shot file and the file's data; there is no other list of keys.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from typing import Any

KINDS = ("number", "integer", "boolean")


@dataclass(frozen=True)
class Setting:
    """One value: its dotted ``key``, the present ``value`` or None, the ``default``, and what it may be."""

    key: str
    kind: str
    """number, integer, boolean or choice"""
    value: Any
    default: Any
    about: str
    low: float | None = None
    high: float | None = None
    choices: tuple[str, ...] = ()


def settings(data: Mapping[str, Any], variants: Sequence[Mapping[str, list[str]]] = ()) -> list[Setting]:
    """Those of the tables that a shot file has. ``variants``: variant set -> variants, of each vehicle in order."""
    found = list(_below("", _schema(), data))
    for k, sets in enumerate(variants):
        given = data["vehicle"][k].get("variants", {})
        for name, choices in sets.items():
            key, value = f"vehicle[{k}].variants.{name}", given.get(name)
            found.append(Setting(key, "choice", value, None, "a variant of the asset", choices=tuple(choices)))
    return found


@cache
def _schema() -> dict[str, Any]:
    from vehsim.shot.schema.shot_file import ShotFile

    return ShotFile.model_json_schema(by_alias=True)


def _below(key: str, node: Mapping[str, Any], data: Any) -> Iterator[Setting]:
    """The settings of a table, or of each table in a list."""
    if isinstance(data, list):
        for k, one in enumerate(data):
            yield from _below(f"{key}[{k}]", node, one)
        return
    if not isinstance(data, Mapping):  # an error that the check explains
        return
    for form in _forms(node, data):
        if form.get("type") == "array":
            yield from _below(key, form["items"], data)
        for name, child in form.get("properties", {}).items():
            place, value = f"{key}.{name}".lstrip("."), data.get(name)
            forms = list(_forms(child, value))
            if isinstance(value, dict | list) or (value is None and "default" in child and _is_open(forms)):
                for one in forms:
                    yield from _below(place, one, value or {})
                continue
            yield from (_setting(place, child, one, value) for one in forms[:1] if _kind(one))


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


def _setting(key: str, about: Mapping[str, Any], node: Mapping[str, Any], value: Any) -> Setting:
    default = about.get("default")
    return Setting(
        key=key,
        kind=_kind(node),
        value=value,
        default=default if isinstance(default, bool | int | float | str) else None,
        about=about.get("description", node.get("description", "")),
        low=node.get("minimum", node.get("ge", node.get("gt"))),
        high=node.get("maximum", node.get("le", node.get("lt"))),
        choices=tuple(map(str, node.get("enum", ()))),
    )
