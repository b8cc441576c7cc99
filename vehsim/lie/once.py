"""Expressions that are built once: to build one again takes ten times as long as to insert other arguments."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any

import casadi as ca


def built_once(method: Callable[..., Any]) -> Callable[..., Any]:
    """Let ``method(self, x, ...)`` build its expression, or tuple of expressions, once per object and argument sizes.

    Every call with ``SX`` columns, or numbers that become them, inserts its arguments into what the first call built.
    Symbols that belong to the object itself stay what they are.
    """

    @functools.wraps(method)
    def call(self: Any, *arguments: Any) -> Any:
        if any(isinstance(a, ca.MX) for a in arguments):
            return method(self, *arguments)
        columns = [a if isinstance(a, ca.SX) else ca.SX(a) for a in arguments]
        shapes = tuple(column.shape for column in columns)
        kept = self.__dict__.setdefault("_built", {})
        key = (method.__qualname__, shapes)
        if key not in kept:
            symbols = [ca.SX.sym(f"x{i}", *shape) for i, shape in enumerate(shapes)]
            made = method(self, *symbols)
            results = [ca.SX(x) for x in made] if isinstance(made, tuple) else [ca.SX(made)]
            name = method.__name__.strip("_")
            built = ca.Function(name, symbols, results, {"allow_free": True})
            own = built.free_sx() if built.has_free() else []
            kept[key] = ca.Function(name, [*symbols, *own], results) if own else built, own
        built, own = kept[key]
        return built(*columns, *own)

    return call
