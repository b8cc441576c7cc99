"""The parameters of a vehicle: what its model takes, checked by the types of the model's function.

A table gives numbers in place of those of a ``vehicle.toml``: ``load_vehicle(name, parameters)`` and
``[vehicle.parameters]`` of a shot file.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import cache
from types import MappingProxyType
from typing import Annotated, Any, Literal, get_args, get_origin, get_type_hints

import numpy as np
from annotated_types import Ge, Gt, Len
from pydantic import Field, ValidationError, create_model

from vehsim.errors import InputError, Problem
from vehsim.intake.tables import Array, Table, problems_of
from vehsim.vehicles.definition.quantities import Unit, With, Without
from vehsim.vehicles.library.file import (
    IN_RANGE,
    ActuatorTable,
    BoundsTable,
    CharacterTable,
    ControlTable,
    Quantity,
    ReplacedTrait,
    SuspensionTable,
    VehicleFile,
    merged,
)

COUNTS = {1: "one number", 2: "two numbers", 3: "three numbers"}
PHYSICS = "physics"
TOPS = ("top_speed", "top_turn_rate")
BESIDE = ("controls", "actuators", "joints", "character", "suspension", *TOPS)
"""Keys of a ``vehicle.toml`` beside ``physics`` whose numbers can be replaced, under the same names."""


@cache
def physics_table(factory: Callable[..., Any]) -> type[Table]:
    """The table ``[physics]`` of a model's function: a key for every keyword, with its range and unit."""
    hints = get_type_hints(factory, include_extras=True)
    fields: dict[str, Any] = {}
    for key, one in inspect.signature(factory).parameters.items():
        if one.kind is one.KEYWORD_ONLY:
            hint = hints.get(key, Any)
            required = one.default is one.empty
            fields[key] = (
                Annotated[_checked(hint), Field(description=_words(hint))],
                Field() if required else Field(default=one.default),
            )
    return create_model("Physics", __base__=Table, **fields)


def check_physics(factory: Callable[..., Any], table: Mapping[str, Any]) -> None:
    """Raise ``InputError`` with everything that is wrong with a complete ``[physics]``."""
    _check(physics_table(factory), table, f"{PHYSICS}.")


def check_parameters(factory: Callable[..., Any], parameters: Mapping[str, Any]) -> None:
    """Raise ``InputError`` with everything that is wrong with numbers that replace those of a ``vehicle.toml``."""
    _check(_replacing(factory), parameters, "parameters.")


def check_effect(factory: Callable[..., Any], own: Mapping[str, Any], parameters: Mapping[str, Any]) -> None:
    """Raise ``InputError`` for each of ``parameters`` that changes nothing, because of another number (`With`,
    `Without`). ``own``: the ``[physics]`` that they replace."""
    hints = get_type_hints(factory, include_extras=True)
    defaults = {key: one.default for key, one in inspect.signature(factory).parameters.items()}
    idle = []
    for key, value in parameters.items():
        if key not in hints or np.array_equal(value, own.get(key, defaults[key])):
            continue
        for rule in (each for each in _parts(hints[key])[1] if isinstance(each, With | Without)):
            other = parameters.get(rule.key, own.get(rule.key, defaults[rule.key]))
            if isinstance(rule, With) and not np.any(other):
                message, remedy = f"changes nothing while {rule.key} is 0", f"give {rule.key} too, or leave it out"
                idle.append(Problem(f"parameters.{key}", message, remedy, value))
            if isinstance(rule, Without) and np.any(other):
                message, remedy = (
                    f"changes nothing while {rule.key} is above 0",
                    f"leave it out, or give {rule.key} = 0",
                )
                idle.append(Problem(f"parameters.{key}", message, remedy, value))
    if idle:
        raise InputError.of(*idle)


def replaced(data: Mapping[str, Any], parameters: Mapping[str, Any]) -> dict[str, Any]:
    """The data of a ``vehicle.toml`` with ``parameters`` in place of its own."""
    beside = {key: value for key, value in parameters.items() if key in BESIDE}
    if "character" in beside:
        beside["character"] = _sourced(beside["character"])
    physics = {key: value for key, value in parameters.items() if key not in BESIDE}
    return merged(data, {**beside, **({PHYSICS: physics} if physics else {})})


def _sourced(character: Mapping[str, Any]) -> dict[str, Any]:
    """The numbers of ``character`` with a source: by default, that they are parameters."""
    source = {"source": "given as a parameter"}
    found = dict(character)
    for key in character.keys() - {"stunt_controls"}:
        table = character[key]
        if key == "response":
            found[key] = {**source, **table}
        else:
            found[key] = {name: {**source, **row} for name, row in table.items()}
    return found


def in_unit(data: Mapping[str, Any], kind: str, name: str) -> str:
    """The unit of a control or joint in words, as the data of a ``vehicle.toml`` state it."""
    unit = data.get(kind, {}).get(name, {}).get("unit", "")
    return "without a unit" if unit == "1" else f"in {unit or 'SI units'}"


def blamed(problem: Problem, parameters: Mapping[str, Any], data: Mapping[str, Any] = MappingProxyType({})) -> Problem:
    """A problem of a ``vehicle.toml`` with ``data``, under the key of ``parameters`` if its value is from there, with
    its unit."""
    inside = problem.key.removeprefix("parameters.").split(".")
    if inside[0] in ("controls", "joints") and len(inside) > 2:
        problem = replace(problem, remedy=problem.remedy.replace("in SI units", in_unit(data, *inside[:2])))
    path = problem.key.removeprefix(f"{PHYSICS}.").split(".")
    node: Any = parameters
    for name in path[:2] if path[0] in BESIDE else path[:1]:
        if not isinstance(node, Mapping) or name not in node:
            return problem
        node = node[name]
    return replace(problem, key=".".join(("parameters", *path)), file="", line=None)


@cache
def _replacing(factory: Callable[..., Any]) -> type[Table]:
    """The table of parameters: the keys of ``[physics]`` and the tables beside it, none of them required."""
    shape = physics_table(factory)
    fields: dict[str, Any] = {
        key: (Annotated[field.annotation, *field.metadata, Field(description=field.description)], None)
        for key, field in shape.model_fields.items()
    }
    fields["density"] = (Annotated[Quantity, Field(description="kg/m^3, or a table of part = kg/m^3")], None)
    for key, rows in (("controls", ControlTable), ("actuators", ActuatorTable), ("joints", BoundsTable)):
        fields[key] = (Annotated[dict[str, rows], Field(description=words_of(VehicleFile, key))], {})  # type: ignore[valid-type]  # types made at run time
    words = words_of(VehicleFile, "character")
    fields["character"] = (Annotated[CharacterTable[ReplacedTrait], Field(description=words)], CharacterTable())
    fields["suspension"] = (
        Annotated[SuspensionTable, Field(description=words_of(VehicleFile, "suspension"))],
        SuspensionTable(),
    )
    for key in TOPS:
        top = VehicleFile.model_fields[key]
        fields[key] = (Annotated[top.annotation, *top.metadata, Field(description=words_of(VehicleFile, key))], None)
    return create_model("Parameters", __base__=Table, **fields)


def words_of(table: type[Table], key: str) -> str:
    """The description of a table's key."""
    return str(table.model_json_schema()["properties"][key]["description"])


def _check(shape: type[Table], table: Mapping[str, Any], prefix: str) -> None:
    try:
        shape.model_validate(table)
    except ValidationError as error:
        found = problems_of(error.errors(include_url=False), shape.model_json_schema())
        raise InputError.of(*(_prefixed(each, prefix) for each in found)) from None


def _prefixed(problem: Problem, prefix: str) -> Problem:
    return replace(problem, key=f"{prefix}{problem.key}")


def _checked(hint: Any) -> Any:
    """The type that pydantic checks: lists as TOML and Python give them, finite numbers, their ranges, names."""
    base, ranges = _parts(hint)
    if get_origin(base) is Literal:
        return base
    if get_origin(base) is Sequence or get_origin(base) is list:
        (entry,) = get_args(base)
        return Annotated[list[_checked(entry)], Array, *ranges]  # type: ignore[misc]  # a type made at run time
    return Annotated[float, Field(allow_inf_nan=False), IN_RANGE, *ranges] if base is float else Quantity


def _parts(hint: Any) -> tuple[Any, list[Any]]:
    """A type and its annotations."""
    return (get_args(hint)[0], list(get_args(hint)[1:])) if get_origin(hint) is Annotated else (hint, [])


def _words(hint: Any) -> str:
    """A type in words: "a number above zero, in kg"."""
    base, ranges = _parts(hint)
    if rules := [one for one in ranges if isinstance(one, With | Without)]:
        plain = Annotated[base, *(one for one in ranges if one not in rules)]  # type: ignore[valid-type]  # a type made at run time
        effect = [f"{'without' if isinstance(one, With) else 'with'} {one.key}" for one in rules]
        return f"{_words(plain)}, no effect {' and '.join(effect)}"
    if get_origin(base) is Literal:
        return f"one of {', '.join(map(repr, get_args(base)))}"
    if get_origin(base) in (Sequence, list):
        (entry,) = get_args(base)
        what, _, rest = _words(entry).partition(",")
        length = next((one.min_length for one in ranges if isinstance(one, Len)), 0)
        if get_origin(_parts(entry)[0]) in (Sequence, list):
            text = f"a list of rows, each of {what}"
        else:
            text = what.replace("a number", COUNTS.get(length, f"{length} numbers" if length else "a list of numbers"))
        return f"{text},{rest}"
    limit = "".join(
        " above zero" if isinstance(one, Gt) else " of at least zero" if isinstance(one, Ge) else "" for one in ranges
    )
    unit = next((one.name for one in ranges if isinstance(one, Unit)), None)
    return f"a number{limit}, {'in SI units' if unit is None else f'in {unit}' if unit else 'without a unit'}"
