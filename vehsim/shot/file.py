"""The whole shot file as one model, and everything wrong with a file's shape as problems a person can mend."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from difflib import get_close_matches
from functools import cache
from typing import Annotated, Any

from annotated_types import Len
from pydantic import BeforeValidator, Field, ValidationError

from vehsim.errors import Problem
from vehsim.shot.model import (
    MAX_CAMERAS,
    Array,
    CameraTable,
    CutTable,
    ExportTable,
    Header,
    Name,
    RenderTable,
    Table,
    Text,
    shipped_or_path,
)
from vehsim.shot.motions import Motion
from vehsim.shot.world_tables import WorldTable

DIALECT = "http://json-schema.org/draft-07/schema#"
"""What editors of TOML read most widely; nothing of a later draft is needed."""
SCHEMA_FILE = "vehsim.schema.json"
SCHEMA_LINE = f"#:schema ./{SCHEMA_FILE}"
"""The first line of a shot file by which an editor finds its schema beside it."""
MAX_VEHICLES = 100
MAX_CUTS = 1000

WORDS = {
    "bool_type": "neither true nor false",
    "dict_type": "not a table",
    "finite_number": "not a finite number",
    "float_type": "not a number",
    "greater_than": "it should be greater than {gt:g}",
    "greater_than_equal": "it should be at least {ge:g}",
    "int_type": "not a whole number",
    "less_than": "it should be less than {lt:g}",
    "less_than_equal": "it should be at most {le:g}",
    "list_type": "not an array",
    "literal_error": "it should be {expected}",
    "model_attributes_type": "not a table",
    "model_type": "not a table",
    "multiple_of": "not a multiple of {multiple_of:g}",
    "string_pattern_mismatch": "not a name: letters, digits and _, no digit first, at most 100",
    "string_too_long": "longer than {max_length} characters",
    "string_too_short": "empty",
    "string_type": "not a text",
    "too_long": "{actual_length} given, at most {max_length} wanted",
    "too_short": "{actual_length} given, at least {min_length} wanted",
}
"""What is wrong with a value, by pydantic's types of errors, in words for people who never heard of it."""


def _one_or_several(value: Any) -> Any:
    """``[camera]`` is a list of one ``[[camera]]``."""
    return [value] if isinstance(value, dict) else value


class VehicleTable(Table):
    """``[[vehicle]]``"""

    name: Name
    """a name of letters, digits and underscores, one of its own for every vehicle"""
    asset: Annotated[Text, shipped_or_path("vehicle")]
    """a shipped vehicle's name, or the path of a vehicle's folder relative to the shot file"""
    variants: dict[str, Text] = Field(default={})
    """a table of the asset's variant sets and the variants to show, such as { livery = "red" }"""
    motion: Motion
    """a table [vehicle.motion] with method = "plan", "simulate", "integrate", "sinusoid" or "clip\""""


class ShotFile(Table):
    """A shot file."""

    shot: Header
    """a table [shot] with schema and name"""
    world: WorldTable = WorldTable()
    """a table [world]"""
    vehicle: Annotated[list[VehicleTable], Array, Len(1, MAX_VEHICLES)]
    """one or more [[vehicle]] tables"""
    camera: Annotated[list[CameraTable], BeforeValidator(_one_or_several), Array, Len(0, MAX_CAMERAS)] = Field(
        default=[CameraTable()]
    )
    """a table [camera], or several [[camera]]"""
    cut: Annotated[list[CutTable], Array, Len(0, MAX_CUTS)] = Field(default=[])
    """[[cut]] tables with frame and camera: which camera is seen from which frame on"""
    render: RenderTable = RenderTable()
    """a table [render]"""
    export: ExportTable = ExportTable()
    """a table [export]"""
    sweep: dict[str, Any] | None = None
    """a table [sweep]: keys of this file and the values they take, one clip for each"""


def schema() -> dict[str, Any]:
    """The JSON schema of a shot file, for editors."""
    shape = _shape()
    cameras = shape["properties"]["camera"]
    several = {"anyOf": [cameras["items"], cameras], "description": cameras["description"]}
    head = {"$schema": DIALECT, "$id": "urn:vehsim:shot:1", "title": "vehsim shot file"}
    properties = {**shape["properties"], "camera": several}
    return {**head, **shape, "title": head["title"], "properties": properties}


@cache
def _shape() -> dict[str, Any]:
    """The same of what validation sees, where ``[camera]`` is a list already."""
    return ShotFile.model_json_schema(by_alias=True)


def parse(data: Any) -> tuple[ShotFile | None, list[Problem]]:
    """The file as a model, and what is wrong with its shape.

    With problems the model is what is left without them, so that it can be checked too, or None.
    """
    try:
        return ShotFile.model_validate(data), []
    except ValidationError as error:
        wrong = error.errors(include_url=False)
        problems = list(_problems(wrong))
    try:
        return ShotFile.model_validate(_without(data, wrong)), problems
    except ValidationError:
        return None, problems


def dotted(place: tuple[int | str, ...]) -> str:
    """``("vehicle", 0, "name")`` as ``vehicle[0].name``."""
    parts = (f"[{part}]" if isinstance(part, int) else f".{part}" for part in place)
    return "".join(parts).lstrip(".") or "file"


def _problems(errors: Any) -> Iterator[Problem]:
    """One problem per error of pydantic's."""
    root = _shape()
    for error in errors:
        place, description, keys = _locate(root, error["loc"])
        key, value = dotted(place), error["input"]
        match error["type"]:
            case "extra_forbidden":
                yield Problem(key, "unknown key", _suggest(str(place[-1]), keys), value)
            case "missing":
                yield Problem(key, "missing", f"give {description}")
            case "union_tag_not_found" | "union_tag_invalid":
                tag, value = error["ctx"]["discriminator"].strip("'"), error["ctx"].get("tag")
                message = "missing" if value is None else f"no such {tag}"
                yield Problem(f"{key}.{tag}", message, f"give {_tags(root, place)}", value)
            case kind:
                text = WORDS.get(kind, error["msg"].removeprefix("Value error, ")).format_map(error.get("ctx", {}))
                yield Problem(key, text[0].lower() + text[1:], f"give {description}", value)


def _locate(root: Mapping[str, Any], location: tuple[int | str, ...]) -> tuple[tuple[int | str, ...], str, list[str]]:
    """Where an error is in the file (without pydantic's union tags), what belongs there, and the keys beside it."""
    place: list[int | str] = []
    node: Mapping[str, Any] = root
    description, keys = "a shot file", list(root["properties"])
    for part in location:
        node = _resolve(node, root)
        if isinstance(part, str) and part in node.get("discriminator", {}).get("mapping", {}):
            node = {"$ref": node["discriminator"]["mapping"][part]}
            continue
        if "oneOf" in node and "discriminator" not in node:  # a value of several forms, whose tag pydantic names
            node = {}
            continue
        keys = list(node.get("properties", {}))
        place.append(part)
        node = node.get("items", {}) if isinstance(part, int) else _below(node, part)
        description = node.get("description", description)
    return tuple(place), _asked(description), keys


def _below(node: Mapping[str, Any], key: str) -> Mapping[str, Any]:
    """What a table's schema says of a key."""
    found: Mapping[str, Any] = node.get("properties", {}).get(key) or node.get("additionalProperties") or {}
    return found


def _asked(description: str) -> str:
    """A key's description on one line, without what holds when it is left out."""
    return re.sub(r"; [^;]* unless given$", "", " ".join(description.split()))


def _tags(root: Mapping[str, Any], place: tuple[int | str, ...]) -> str:
    """The names a table with several forms may take: ``"plan", "simulate" or "clip"``."""
    node: Mapping[str, Any] = root
    for part in place:
        node = _resolve(node, root)
        node = node.get("items", {}) if isinstance(part, int) else node.get("properties", {}).get(part, {})
    tags = {reference: tag for tag, reference in node["discriminator"]["mapping"].items()}
    names = [f'"{tags[form["$ref"]]}"' for form in node["oneOf"]]
    return f"{', '.join(names[:-1])} or {names[-1]}"


def _resolve(node: Mapping[str, Any], root: Mapping[str, Any]) -> Mapping[str, Any]:
    """Follow references, and of "this or nothing" take this."""
    while True:
        choices = [choice for choice in node.get("anyOf", []) if choice.get("type") != "null"]
        if "$ref" in node:
            node = root["$defs"][node["$ref"].rpartition("/")[2]]
        elif len(choices) == 1:
            node = choices[0]
        else:
            return node


def _suggest(key: str, known: list[str]) -> str:
    close = get_close_matches(key, known, n=1)
    return f"did you mean {close[0]!r}?" if close else f"known keys: {', '.join(known) or '(none)'}"


def _without(data: Any, errors: Any) -> Any:
    """The data without its unknown keys, and without the top tables that have other errors."""
    bad = set()
    for error in errors:
        place, _, _ = _locate(_shape(), error["loc"])
        bad.add(place if error["type"] == "extra_forbidden" else place[:1])

    def keep(value: Any, place: tuple[int | str, ...]) -> Any:
        if isinstance(value, dict):
            return {k: keep(v, (*place, k)) for k, v in value.items() if (*place, k) not in bad}
        if isinstance(value, list):
            return [keep(v, (*place, i)) for i, v in enumerate(value)]
        return value

    return keep(data, ())
