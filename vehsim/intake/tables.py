"""Tables of a file as strict models: each key is described below it, and each message says how to fix the error.

This module is common to shot files, ``vehicle.toml`` and ``terrain.toml``; their keys are in `vehsim.shot`,
`vehsim.vehicles` and `vehsim.world.terrain`.
"""

from __future__ import annotations

import ast
import inspect
import re
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from copy import deepcopy
from dataclasses import dataclass, replace
from difflib import get_close_matches
from functools import cache, lru_cache
from itertools import pairwise
from pathlib import Path
from typing import Annotated, Any

from annotated_types import Len
from pydantic import AfterValidator, BaseModel, BeforeValidator, ConfigDict, Field, ValidationError

from vehsim.errors import Problem, ShotError
from vehsim.intake.toml import line_of, lines_of, read_toml
from vehsim.runtime.cache import Stamp, stamp

NAME = "[A-Za-z_][A-Za-z0-9_]{0,99}"
"""The pattern of names of shots and of what is in them."""
NOT_A_NAME = "not a name: letters, digits and _, no digit first, at most 100"
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
    "string_pattern_mismatch": NOT_A_NAME,
    "string_too_long": "longer than {max_length} characters",
    "string_too_short": "empty",
    "string_type": "not a text",
    "too_long": "{actual_length} given, at most {max_length} wanted",
    "too_short": "{actual_length} given, at least {min_length} wanted",
}
"""Messages by pydantic's types of errors, without pydantic's vocabulary."""


LISTED = 100
"""The largest number of problems of one file that are listed: to explain each takes milliseconds."""


def describe(schema: dict[str, Any], model: type[BaseModel]) -> None:
    """Describe each key in a model's JSON schema.

    Sources are read when a schema is requested; pydantic's own ``use_attribute_docstrings`` reads them at every import.
    """
    for key, text in _docstrings(model).items():
        schema["properties"][model.model_fields[key].alias or key]["description"] = text


def _docstrings(model: type) -> dict[str, str]:
    """Key -> the text below it in the source, including base classes; empty if no sources are installed."""
    texts: dict[str, str] = {}
    for base in reversed(model.__mro__[: model.__mro__.index(Table)]):
        for key, below in pairwise(_classes(base.__module__).get(base.__name__, ())):
            match key, below:
                case ast.AnnAssign(target=ast.Name(name)), ast.Expr(ast.Constant(str(text))):
                    texts[name] = inspect.cleandoc(text)
    return texts


@cache
def _classes(module: str) -> dict[str, Sequence[ast.stmt]]:
    """The bodies of a module's classes by name; empty if its source is not installed."""
    try:
        source = inspect.getsource(sys.modules[module])
    except (OSError, TypeError):  # TypeError: of an interactive session
        return {}
    return {node.name: node.body for node in ast.walk(ast.parse(source)) if isinstance(node, ast.ClassDef)}


class Table(BaseModel):
    """A table of the file: unknown keys and values of another type are errors."""

    model_config = ConfigDict(strict=True, extra="forbid", frozen=True, json_schema_extra=describe)


@dataclass(frozen=True)
class InSchema:
    """Changes a value's JSON schema: ``shape`` receives the schema of its type.

    It is called when a schema is requested, so that names can come from the module that defines them.
    """

    shape: Callable[[dict[str, Any]], dict[str, Any]]

    def __get_pydantic_json_schema__(self, core: Any, handler: Callable[[Any], dict[str, Any]]) -> dict[str, Any]:
        return self.shape(handler(core))


def table_of(keys: Mapping[str, Mapping[str, Any]]) -> dict[str, Any]:
    """The JSON schema of a table with exactly these keys."""
    return {"type": "object", "properties": dict(keys), "additionalProperties": False}


def _whole(value: float) -> float:
    if not abs(value) <= 1e9:
        raise ValueError("beyond 1e9")
    return value


def _from_tuple(value: Any) -> Any:
    """Convert tuples of Python callers to lists, as TOML gives."""
    return list(value) if isinstance(value, tuple) else value


Number = Annotated[float, Field(allow_inf_nan=False), AfterValidator(_whole)]
Positive = Annotated[Number, Field(gt=0)]
NotNegative = Annotated[Number, Field(ge=0)]
Metre = Annotated[Number, Field(ge=-1e7, le=1e7)]
"""A position, m: northings of UTM coordinates reach 10,000 km."""
Array = BeforeValidator(_from_tuple)
Point = Annotated[list[Metre], Array, Len(3, 3)]
PLACE = "place"
"""The ``format`` in the JSON schema of values that are places in the world: pages offer to drag them."""
DIRECTION = "direction"
"""The ``format`` of directions of what is at the place that the table around them gives: pages offer to turn them."""
AT = InSchema(lambda own: own | {"format": PLACE})
TOWARDS = InSchema(lambda own: own | {"format": DIRECTION})
Place = Annotated[Point, AT]
Text = Annotated[str, Field(min_length=1, max_length=4096)]
Name = Annotated[str, Field(pattern=f"^{NAME}$")]


def read_table(path: Path, model: type[Table]) -> dict[str, Any]:
    """The data of a TOML file that is a ``model``. Raises ``ShotError`` with everything that is wrong and its lines."""
    return deepcopy(_read(path, model, stamp(path) if path.is_file() else None))


@lru_cache(maxsize=256)
def _read(path: Path, model: type[Table], written: Stamp | None) -> dict[str, Any]:
    data, text = read_toml(path)
    try:
        model.model_validate(data)
    except ValidationError as error:
        lines = lines_of(text)
        found = problems_of(error.errors(include_url=False), _shape(model))
        raise ShotError([replace(each, file=str(path), line=line_of(each.key, lines)) for each in found]) from None
    return data


@cache
def _shape(model: type[Table]) -> dict[str, Any]:
    return model.model_json_schema(by_alias=True)


def dotted(place: tuple[int | str, ...]) -> str:
    """``("vehicle", 0, "name")`` as ``vehicle[0].name``."""
    parts = (f"[{part}]" if isinstance(part, int) else f".{part}" for part in place)
    return "".join(parts).lstrip(".") or "file"


def problems_of(errors: Any, root: Mapping[str, Any]) -> Iterator[Problem]:
    """One problem per error of pydantic's, at most `LISTED`; ``root``: the JSON schema of the whole file."""
    if len(errors) > LISTED:
        yield Problem("file", f"{len(errors)} problems, of which {LISTED} are listed", "fix these, then check again")
    for error in errors[:LISTED]:
        place, description, keys = locate(root, error["loc"])
        key, value = dotted(place), error["input"]
        match error["type"]:
            case "extra_forbidden":
                yield Problem(key, "unknown key", suggestion(str(place[-1]), keys), value)
            case "missing":
                yield Problem(key, "missing", f"give {description}")
            case "union_tag_not_found" | "union_tag_invalid":
                tag, value = error["ctx"]["discriminator"].strip("'"), error["ctx"].get("tag")
                message = "missing" if value is None else f"no such {tag}"
                yield Problem(f"{key}.{tag}", message, f"give {_tags(root, place)}", value)
            case "literal_error" if _lists(description, error["ctx"]["expected"]):
                yield Problem(key, "unknown", f"give {description}", value)
            case kind:  # a validator's own error comes along as an object
                context = error.get("ctx", {})
                text = str(context.get("error") or WORDS.get(kind, error["msg"]).format_map(context))
                bound = context.get("le", context.get("ge"))
                fixes = () if bound is None else ((key, bound),)
                yield Problem(key, text[0].lower() + text[1:], f"give {description}", value, fixes=fixes)


def _lists(description: str, expected: str) -> bool:
    """Whether a description names every text that pydantic expects."""
    names = re.findall(r"'([^']+)'", expected)
    return bool(names) and all(re.search(rf"[\"']{re.escape(name)}[\"']", description) for name in names)


def locate(root: Mapping[str, Any], location: tuple[int | str, ...]) -> tuple[tuple[int | str, ...], str, list[str]]:
    """The place of an error in the file (without pydantic's union tags), the expected content, and the keys
    beside it."""
    place: list[int | str] = []
    node: Mapping[str, Any] = root
    description, keys = "a table", list(root["properties"])
    for part in location:
        node = _resolve(node, root)
        if isinstance(part, str) and part in node.get("discriminator", {}).get("mapping", {}):
            node = {"$ref": node["discriminator"]["mapping"][part]}
            continue
        if "oneOf" in node and "discriminator" not in node:  # a value of several forms; pydantic names the tag
            node = {}
            continue
        keys = list(node.get("properties", {}))
        place.append(part)
        node = node.get("items", {}) if isinstance(part, int) else _below(node, part)
        description = node.get("description", description)
    return tuple(place), _one_line(description), keys


def _below(node: Mapping[str, Any], key: str) -> Mapping[str, Any]:
    """A table's schema for a key."""
    found = node.get("properties", {}).get(key) or node.get("additionalProperties")
    return found if isinstance(found, Mapping) else {}


def _one_line(description: str) -> str:
    """A key's description on one line, without its default."""
    return re.sub(r"; default: .*$", "", " ".join(description.split()))


def _tags(root: Mapping[str, Any], place: tuple[int | str, ...]) -> str:
    """The names that a table with several forms may have: ``"plan", "simulate" or "clip"``."""
    node: Mapping[str, Any] = root
    for part in place:
        node = _resolve(node, root)
        node = node.get("items", {}) if isinstance(part, int) else node.get("properties", {}).get(part, {})
    tags = {reference: tag for tag, reference in node["discriminator"]["mapping"].items()}
    names = [f'"{tags[form["$ref"]]}"' for form in node["oneOf"]]
    return f"{', '.join(names[:-1])} or {names[-1]}"


def _resolve(node: Mapping[str, Any], root: Mapping[str, Any]) -> Mapping[str, Any]:
    """Follow references; of "this or null" choose this."""
    while True:
        choices = [choice for choice in node.get("anyOf", []) if choice.get("type") != "null"]
        if "$ref" in node:
            node = root["$defs"][node["$ref"].rpartition("/")[2]]
        elif len(choices) == 1:
            node = choices[0]
        else:
            return node


def suggestion(key: str, known: list[str]) -> str:
    """The remedy for an unknown key."""
    close = get_close_matches(key, known, n=1)
    return f"did you mean {close[0]!r}?" if close else f"known keys: {', '.join(known) or '(none)'}"
