"""Generate tables of the documentation from their definitions: keys of shot files, and characters of vehicles.

The prose of a page is written by hand. The text between ``<!-- keys: MarkTable -->`` and ``<!-- end -->`` is the
`table` of that model; the text after ``<!-- character: helicopter -->`` is the `traits` of that vehicle, that after
``<!-- actuators -->`` the `actuators` of all. ``python -m vehsim.shot.reference docs/shot-file.md docs/character.md``
updates these pages.
"""

from __future__ import annotations

import json
import re
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from vehsim.errors import InputError
from vehsim.shot.schema.shot_file import schema
from vehsim.vehicles.definition.quantities import in_degrees

_BLOCK = re.compile(r"(<!-- keys: (\w+)(?: without ([\w, ]+))? -->\n).*?(<!-- end -->)", re.DOTALL)
_TRAITS = re.compile(r"(<!-- character: (\w+) -->\n).*?(<!-- end -->)", re.DOTALL)
_ACTUATORS = re.compile(r"(<!-- actuators -->\n).*?(<!-- end -->)", re.DOTALL)
_DEFAULT = re.compile(r"(.*); default: (.*)")
_CODE = re.compile(r'("[^"]*"(?:\.\.\.)?|\{[^}]*\}|\[\[[^]]*\]\]|\[[^]]*\])')


def with_tables(page: str) -> str:
    """The page (Markdown) with its key tables generated from the models."""
    page = _ACTUATORS.sub(lambda m: f"{m[1]}{actuators()}{m[2]}", page)
    page = _TRAITS.sub(lambda m: f"{m[1]}{traits(m[2])}{m[3]}", page)
    return _BLOCK.sub(lambda m: f"{m[1]}{table(m[2], (m[3] or '').replace(' ', '').split(','))}{m[4]}", page)


def traits(vehicle: str) -> str:
    """The characters of a vehicle as a Markdown table, angles in degrees."""
    from vehsim.planning.terms import LIMITS
    from vehsim.vehicles import load_vehicle
    from vehsim.vehicles.definition.character import REVIEW_UNITS

    loaded = load_vehicle(vehicle)
    units = {control.name: f"{control.unit}/s" for control in loaded.controls}
    rows = [("response", "s", loaded.character.response)]
    rows += [(f"weight of {name}", "1", trait) for name, trait in loaded.character.costs.items()]
    rows += [(name, LIMITS[name].unit, trait) for name, trait in loaded.character.limits.items()]
    rows += [(f"rate of {name}", units[name], trait) for name, trait in loaded.character.control_rates.items()]
    rows += [(name, REVIEW_UNITS[name], trait) for name, trait in loaded.character.review.items()]
    text = "| | calm | normal | brisk | unit | source |\n|---|---|---|---|---|---|\n"
    for name, unit, trait in rows:
        factor, shown = in_degrees(unit)
        all_three = (factor * trait.calm, factor * trait.normal, factor * trait.brisk)
        values = " | ".join(f"{value:.4g}" if value < 1e4 else f"{value:.0f}" for value in all_three)
        text += f"| {name} | {values} | {shown} | {trait.source} |\n"
    for control in (control for control in loaded.controls if control.name in loaded.character.stunt_controls):
        text += f"| {control.name} | 0 | 0 | 0 | {control.unit} | our choice: only a stunt uses it |\n"
    return text


def actuators() -> str:
    """The actuators of the shipped vehicles as a Markdown table, angles in degrees."""
    from vehsim.vehicles import available, load_vehicle

    text = "| vehicle | control | rate | lag, s | source |\n|---|---|---|---|---|\n"
    for name in available():
        for control in load_vehicle(name).controls:
            if not (actuator := control.actuator).ideal:
                factor, unit = in_degrees(f"{control.unit}/s")
                shown = unit.replace("/s/s", "/s^2")
                rate = f"{factor * actuator.rate:.5g} {shown}"
                text += f"| `{name}` | {control.name} | {rate} | {actuator.lag:g} | {actuator.source} |\n"
    return text


def table(model: str, without: list[str] | None = None) -> str:
    """A model's keys as a Markdown table: key, what to give, default.

    ``model`` is the name of a table in `vehsim schema`; ``without`` names keys to leave out. Raises ``InputError``.
    """
    known = {**schema()["$defs"], "ShotFile": schema()}
    if model not in known:
        raise InputError("no such table", f"choose one of {', '.join(sorted(known))}", key="keys", value=model)
    required = known[model].get("required", ())
    rows = [
        f"| `{key}` | {what} | {default} |\n"
        for key, field in known[model]["properties"].items()
        if key not in (without or ())
        for what, default in [_described(field, key in required)]
    ]
    return "".join(["| key | what to give | default |\n|---|---|---|\n", *rows])


def _described(field: Mapping[str, Any], required: bool) -> tuple[str, str]:
    """What to give, and the default."""
    text, default = " ".join(field.get("description", "").split()), field.get("default")
    stated = _DEFAULT.fullmatch(text)
    if stated:
        return _marked(stated[1]), _marked(stated[2])
    if required or default is None:
        return _marked(text), "required" if required else "none"
    return _marked(text), f"`{json.dumps(_plain(default))}`" if default not in ({}, []) else "none"


def _marked(text: str) -> str:
    """A description with its TOML set as code."""
    return _CODE.sub(r"`\1`", text).replace("|", "\\|")


def _plain(value: Any) -> Any:
    """Whole numbers without their .0."""
    if isinstance(value, list):
        return [_plain(item) for item in value]
    return int(value) if isinstance(value, float) and value.is_integer() else value


if __name__ == "__main__":
    for name in sys.argv[1:]:
        Path(name).write_text(with_tables(Path(name).read_text(encoding="utf-8")), encoding="utf-8")
