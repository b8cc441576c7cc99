"""Values that a command line accepts: for shell completion and for ``vehsim export --help``.

The names come from the modules that define them. Heavy imports are late, because the shell waits for completion.
"""

from __future__ import annotations

import os
import re
import sys
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from typer.core import TyperCommand

from vehsim.errors import InputError

Completions = list[tuple[str, str]]
"""A completion function: returns values and short descriptions. If there are none, the shell completes file names."""

# ---------------------------------------------------------------- what there is


def exporters() -> list[tuple[str, str, str]]:
    """Name, product and required exporters of every installed exporter."""
    from vehsim.delivery.exporters import exporter_names, find_exporter

    found = [find_exporter(name) for name in exporter_names()]
    return [(one.name, one.makes, f"needs {', '.join(one.needs)}" if one.needs else "") for one in found]


def costs() -> list[tuple[str, str]]:
    """Name and meaning of every cost."""
    from vehsim.planning.terms import COSTS

    return [(name, _first_line(law)) for name, law in COSTS.items()]


def limits() -> list[tuple[str, str, str]]:
    """Name, unit in a shot file, and meaning of every limit."""
    from vehsim.planning.terms import LIMITS
    from vehsim.vehicles.definition.quantities import in_degrees

    return [(name, in_degrees(limit.unit)[1], limit.meaning) for name, limit in LIMITS.items()]


def _first_line(law: Any) -> str:
    return (law.__doc__ or "").partition("\n")[0].rstrip(".")


class WithChoices(TyperCommand):
    """A command whose help also lists exporters, costs and limits; the lists are made when the help is requested."""

    def format_help(self, ctx: Any, formatter: Any) -> None:
        super().format_help(ctx, formatter)
        print_choices()


def print_choices() -> None:
    """Print exporters, costs and limits in the style of the help."""
    from rich import box
    from rich.console import Console
    from rich.panel import Panel
    from rich.table import Table

    tables: list[tuple[str, Iterable[Sequence[str]]]] = [
        ("Exporters: --to usd,csv", exporters()),
        (r"Costs: cost = ... in \[vehicle.motion]", costs()),
        (r"Limits: limits = { ... } in \[vehicle.motion]", limits()),
    ]
    console = Console(file=sys.stdout, highlight=False)
    for title, rows in tables:
        table = Table(show_header=False, box=box.SIMPLE, padding=(0, 1), expand=True, show_edge=False)
        for row in rows:
            table.add_row(f"[bold cyan]{row[0]}[/]", *row[1:])
        console.print(Panel(table, title=title, title_align="left", border_style="dim"))


# ---------------------------------------------------------------- what the shell completes


def vehicle(incomplete: str) -> Completions:
    from vehsim.assets import described

    return _starting(incomplete, {name: _heading(file) for name, file in described("vehicle").items()})


def terrain(incomplete: str) -> Completions:
    from vehsim.assets import described

    return _starting(incomplete, {name: _heading(file) for name, file in described("terrain").items()})


def method(incomplete: str) -> Completions:
    from vehsim.cli.new import METHODS

    return _starting(incomplete, {name: (make.__doc__ or "").rstrip(".") for name, make in METHODS.items()})


def exporter_list(incomplete: str) -> Completions:
    """Complete the last of several comma-separated exporters; names already given are not offered again."""
    before, comma, last = incomplete.rpartition(",")
    taken = before.split(",")
    return [
        (f"{before}{comma}{name}", makes)
        for name, makes, _ in exporters()
        if name.startswith(last) and name not in taken
    ]


def override(incomplete: str) -> Completions:
    """Complete ``--set KEY=VALUE``: values of keys that take names, such as ``vehicle.car.motion.cost=``."""
    key, equals, value = incomplete.partition("=")
    if not equals:
        return []
    values = {"cost": lambda: dict(costs()), "terrain": lambda: dict(terrain("")), "asset": lambda: dict(vehicle(""))}
    find = values.get(key.rpartition(".")[2])
    return [(f"{key}={name}", meaning) for name, meaning in _starting(value, find())] if find else []


def shot_file(incomplete: str) -> Completions:
    """Shot files in the typed folder."""
    folder, typed = _folder(incomplete)
    found = [path for path in folder.glob("*.toml") if path.name.startswith(typed) and "[shot]" in _text(path)]
    return [(f"{incomplete[: len(incomplete) - len(typed)]}{path.name}", _heading(path)) for path in sorted(found)]


def vehicle_of_shots(incomplete: str) -> Completions:
    """Names of the vehicles in the shot files on the command line."""
    tables = [table for path in _typed(".toml") for table in _tables(path).get("vehicle", [])]
    return _starting(incomplete, {str(table.get("name")): str(table.get("asset", "")) for table in tables})


def camera_of_stage(incomplete: str) -> Completions:
    """Names of the cameras of the stages on the command line."""
    from pxr import UsdGeom

    from vehsim.intake.usd import SUFFIXES, open_stage

    try:
        stages = [open_stage(path, load=False) for path in _typed(*SUFFIXES)]
    except InputError:  # not a stage: offer nothing
        return []
    cameras = [prim for stage in stages for prim in stage.Traverse() if prim.IsA(UsdGeom.Camera)]
    return _starting(incomplete, {prim.GetName(): str(prim.GetPath()) for prim in cameras})


def _typed(*suffixes: str) -> list[Path]:
    """The files with these suffixes on the command line, in the form that the completion scripts of each shell provide.

    Parsing stops at an option without its value, so the command's context does not hold its arguments.
    """
    words = os.environ.get("COMP_WORDS") or os.environ.get("_TYPER_COMPLETE_ARGS") or ""
    paths = [Path(word).expanduser() for word in words.split()]
    return [path for path in paths if path.suffix in suffixes and path.is_file()]


def _starting(incomplete: str, names: Mapping[str, str]) -> Completions:
    return [(name, meaning) for name, meaning in names.items() if name.startswith(incomplete)]


def _folder(incomplete: str) -> tuple[Path, str]:
    """The folder that was typed so far, and the beginning of a name in it."""
    head, slash, typed = incomplete.rpartition("/")
    return Path(f"{head}{slash}" or ".").expanduser(), typed


def _heading(path: Path) -> str:
    """The comment at the start of a TOML file, if there is one."""
    return next(_comments(_text(path)), "")


def _comments(text: str) -> Iterator[str]:
    for line in text.splitlines():
        if not re.match(r"#(?!:)", line):
            return
        yield line.lstrip("# ").rstrip(" .")


def _text(path: Path) -> str:
    try:
        short = path.is_file() and path.stat().st_size < 1_000_000
        return path.read_text(encoding="utf-8", errors="replace") if short else ""
    except OSError:
        return ""


def _tables(path: Path) -> dict[str, Any]:
    import tomllib

    try:
        return tomllib.loads(_text(path)) if path.suffix == ".toml" else {}
    except tomllib.TOMLDecodeError:
        return {}
