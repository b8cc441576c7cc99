"""Attributes of a package that are imported at first use: public names and submodules."""

from __future__ import annotations

import importlib
import sys
from collections.abc import Callable, Mapping, Sequence
from types import MappingProxyType
from typing import Any


def attach(
    package: str, names: Mapping[str, str] = MappingProxyType({}), elsewhere: Sequence[str] = ()
) -> tuple[Callable[[str], Any], Callable[[], list[str]]]:
    """Return ``__getattr__`` and ``__dir__`` for ``package``, which then offers ``names`` and its public submodules.

    ``names``: attribute -> module that defines it. ``elsewhere``: submodules whose files are outside the package's
    folder, as in a checkout.
    """

    def getattribute(name: str) -> Any:
        if name in names:
            return getattr(importlib.import_module(names[name]), name)
        if not name.startswith("_"):
            try:
                return importlib.import_module(f"{package}.{name}")
            except ModuleNotFoundError as error:
                if error.name != f"{package}.{name}":  # the module exists; one of its imports does not
                    raise
        raise AttributeError(f"module {package!r} has no attribute {name!r}", name=name, obj=sys.modules[package])

    def directory() -> list[str]:
        from pkgutil import iter_modules

        module = sys.modules[package]
        public = getattr(module, "__all__", vars(module))
        special = (name for name in vars(module) if name.startswith("__"))
        submodules = (entry.name for entry in iter_modules(module.__path__) if not entry.name.startswith("_"))
        return sorted({*public, *special, *names, *elsewhere, *submodules})

    return getattribute, directory
