"""Exporters: their definition, their discovery through entry points, and their order."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Any, Literal

from vehsim.delivery.earlier import SIGN, Keep, record
from vehsim.delivery.folders import drop_empty_folders, new_version, newest, replacing, versions
from vehsim.errors import ExportError, InputError
from vehsim.runtime.progress import Progress
from vehsim.runtime.registry import entries


@dataclass(frozen=True)
class Exporter:
    """Writes a take. ``write(take, folder, progress)`` returns the files that it wrote below ``folder``.

    ``needs`` names exporters whose files this one reads from ``folder`` (for example, pictures are rendered from the
    USD). The take runs them first, and deletes their files afterwards if they were not requested.
    """

    name: str
    suffixes: tuple[str, ...]
    write: Callable[[Any, Path, Progress], Sequence[Path]]
    needs: tuple[str, ...] = ()
    latest: Callable[[Path, Path], None] | None = None
    """``latest(version, home)`` updates the link files in ``home`` to its newest version"""
    keep: Keep | None = None
    """``keep(earlier, new, vehicles)``: files of a new delivery, with the content that also shows an earlier one's
    vehicles"""
    makes: str = ""
    """The product in a few words: shown by ``vehsim export --help``"""
    state: Literal["baking", "rendering"] = "baking"
    """What a batch calls its work"""
    every_frame: bool = False
    """Whether it renders every frame of every camera, which takes minutes for a long shot"""
    ready: Callable[[], object] = lambda: None
    """Raises ``InputError`` if a program or package that it runs is missing; called before anything is solved"""


GROUP = "vehsim.exporters"
"""Entry points of this group are `Exporter` objects; a studio's package can add its own."""
REPORT_GROUP = "vehsim.reports"
"""Entry points of this group are functions ``(take, folder, files) -> Path`` that report what was delivered."""


def exporter_names() -> list[str]:
    return sorted({entry.name for entry in entries(GROUP)})


def find_exporter(name: str) -> Exporter:
    """The exporter called ``name``. Raises ``InputError``."""
    for entry in entries(GROUP):
        if entry.name == name:
            exporter: Exporter = entry.load()
            return exporter
    raise InputError("no such exporter", f"choose from {', '.join(exporter_names())}", key="to", value=name)


def exporter_for(path: Path) -> Exporter:
    """The exporter that writes files with ``path``'s suffix. Raises ``InputError``."""
    for name in exporter_names():
        exporter = find_exporter(name)
        if path.suffix in exporter.suffixes:
            return exporter
    raise InputError(
        f"no exporter writes {path.suffix!r} files", f"name one with to=: {', '.join(exporter_names())}", file=path
    )


def in_order(names: Sequence[str]) -> list[Exporter]:
    """The exporters called ``names``, each after those that it needs. Raises ``InputError``."""
    ordered: dict[str, Exporter] = {}

    def add(name: str, chain: tuple[str, ...]) -> None:
        if name in chain:
            raise ExportError(f"exporters need each other in a cycle: {' -> '.join((*chain, name))}")
        exporter = find_exporter(name)
        for needed in exporter.needs:
            add(needed, (*chain, name))
        ordered.setdefault(name, exporter)

    for name in names:
        add(name, ())
    return list(ordered.values())


def check_ready(names: Sequence[str], layer_only: bool) -> None:
    """Raise ``InputError`` if exporters are not `ready`, or need the shot's stage but only the layers will be
    written."""
    for exporter in in_order(names):
        exporter.ready()
        if layer_only and exporter.needs:
            raise InputError(
                "made from the shot's stage, which export.layer_only omits",
                "leave out one",
                key="to",
                value=exporter.name,
            )


def write_files(
    take: Any,
    folder: Path,
    names: Sequence[str],
    progress: Progress,
    instead: Mapping[str, Exporter] = MappingProxyType({}),
    starting: Callable[[Exporter], None] = lambda exporter: None,
) -> dict[str, list[Path]]:
    """Run the exporters in ``folder``; return the files of each of ``names``, and delete those that were only needed.

    ``instead``: exporters to use in place of those found, by name; ``starting`` is called with each before it runs.
    """
    exporters = [instead.get(exporter.name, exporter) for exporter in in_order(names)]
    written: dict[str, list[Path]] = {}
    for i, exporter in enumerate(exporters):
        starting(exporter)

        def report(what: str, done: float, before: int = i) -> None:
            progress(what, (before + min(max(done, 0.0), 1.0)) / len(exporters))

        written[exporter.name] = [Path(path) for path in exporter.write(take, folder, report)]
    kept = {name: sorted(set(written[name])) for name in names}
    for path in {path for paths in written.values() for path in paths} - {p for paths in kept.values() for p in paths}:
        path.unlink(missing_ok=True)
    drop_empty_folders(folder)
    return kept


def delivering(target: Path, versioned: bool, overwrite: bool = True) -> AbstractContextManager[Path]:
    """A hidden folder that is renamed when the block ends without an error: `replacing` ``target``, or its
    `new_version`."""
    if versioned:
        return new_version(target)
    exporters = map(find_exporter, exporter_names())
    return replacing(target, overwrite, {exporter.name: exporter.keep for exporter in exporters if exporter.keep})


def point_at_newest(home: Path) -> Path:
    """Update every exporter's link files in ``home`` to the newest version that it wrote; returns the newest of all.

    Warns if that version shows another motion than the newest of all.
    """
    found = versions(home)
    reports = {version: record(version / SIGN)["solved"] for version in found}
    for exporter in map(find_exporter, exporter_names()):
        own = [version for version in found if exporter.name in reports[version].get("exporters", ())]
        if exporter.latest is None or not own:
            continue
        exporter.latest(own[-1], home)
        if reports[own[-1]].get("content") != reports[found[-1]].get("content"):
            message = f"latest still shows {own[-1].name}: {found[-1].name} has another motion"
            warnings.warn(
                f"{home}: {message}, which was not exported to {exporter.name}; export {exporter.name} again",
                stacklevel=3,
            )
    return newest(home)
