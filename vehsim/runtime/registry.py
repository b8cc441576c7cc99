"""Names that shot files can use: what ships, what installed packages add as entry points, and what a script adds."""

from __future__ import annotations

import importlib
import importlib.metadata
import importlib.util
import traceback
import warnings
from collections.abc import Iterator, Mapping, MutableMapping
from functools import cache
from pathlib import Path
from typing import Any, Generic, TypeVar

from vehsim.errors import InputError

T = TypeVar("T")


@cache
def _installed() -> Any:
    """All entry points. Finding them takes about 20 ms, so they are read once."""
    return importlib.metadata.entry_points()


@cache
def entries(group: str) -> tuple[importlib.metadata.EntryPoint, ...]:
    """The entry points of a group."""
    return tuple(_installed().select(group=group))


def extensions() -> list[Path]:
    """The files and folders of the installed packages that add to vehsim through entry points."""
    groups = [group for group in _installed().groups if group.startswith("vehsim.")]
    names = {entry.module.partition(".")[0] for group in groups for entry in entries(group)} - {"vehsim"}
    specs = [importlib.util.find_spec(name) for name in sorted(names)]
    origins = [Path(spec.origin) for spec in specs if spec is not None and spec.origin is not None]
    return [origin.parent if origin.name == "__init__.py" else origin for origin in origins]


def whose_error(error: BaseException) -> str:
    """Whose error an unexpected exception is: that of the installed package through whose code it came, with its entry
    points there, else vehsim's own."""
    added = [entry for group in _installed().groups if group.startswith("vehsim.") for entry in entries(group)]
    added = [entry for entry in added if entry.module.partition(".")[0] != "vehsim"]
    for frame, _ in traceback.walk_tb(error.__traceback__):
        package = str(frame.f_globals.get("__name__")).partition(".")[0]
        if own := [entry for entry in added if entry.module.partition(".")[0] == package]:
            called = frame.f_code.co_qualname
            exact = [entry for entry in own if called == entry.attr or called.startswith(f"{entry.attr}.")]
            names = ", ".join(f"{entry.group} {entry.name!r}" for entry in exact or own)
            name = own[0].dist.name if own[0].dist else package
            return f"an error in the package {name}, which registers {names}"
    return "an error in vehsim"


class Registry(MutableMapping[str, T], Generic[T]):
    """A mapping of names to registered objects.

    ``shipped``: our own entries; a text "module:name" is imported at its first use. ``group``: the group of entry
    points through which other packages add theirs. A package cannot replace a shipped name: its entry point is ignored
    with a warning. A script can set and delete entries of its own. Raises ``InputError`` for an entry point that does
    not load.
    """

    def __init__(self, group: str, shipped: Mapping[str, T | str]):
        self.group = group
        self._shipped = dict(shipped)
        self._added: dict[str, T] = {}

    @property
    def has_additions(self) -> bool:
        """Whether a script has added entries."""
        return bool(self._added)

    def loadable(self) -> Iterator[tuple[str, T]]:
        """Names and values; a package that does not load gives a warning and is left out."""
        for name in self:
            try:
                yield name, self[name]
            except InputError as error:
                warnings.warn(str(error), stacklevel=2)

    def __getitem__(self, name: str) -> T:
        if name in self._added:
            return self._added[name]
        if name in self._shipped:
            value = self._shipped[name]
            if not isinstance(value, str):
                return value
            module, _, attribute = value.partition(":")
            own: T = getattr(importlib.import_module(module), attribute)
            return own
        entry = self._entries()[name]
        try:
            loaded: T = entry.load()
        except Exception as error:  # of another package
            package = entry.dist.name if entry.dist else entry.module
            message = f"the package {package} does not load: {type(error).__name__}: {error}"
            raise InputError(message, "fix the package or uninstall it", key=self.group, value=name) from error
        return loaded

    def __setitem__(self, name: str, value: T) -> None:
        self._added[name] = value

    def __delitem__(self, name: str) -> None:
        del self._added[name]

    def __iter__(self) -> Iterator[str]:
        return iter({**self._shipped, **self._entries(), **self._added})

    def __len__(self) -> int:
        return sum(1 for _ in self)

    def __contains__(self, name: object) -> bool:
        return name in self._added or name in self._shipped or name in self._entries()

    def _entries(self) -> dict[str, importlib.metadata.EntryPoint]:
        found = {}
        for entry in entries(self.group):
            if entry.name in self._shipped:
                message = f"{self.group}: {entry.value} registers {entry.name!r}, which vehsim ships; it is ignored"
                warnings.warn(f"{message}; give it another name", stacklevel=3)
            else:
                found[entry.name] = entry
        return found
