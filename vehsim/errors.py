"""Errors a user can act on. They are data: what is wrong, where, and how to fix it; `str` makes the printed line.

Code that handles an error reads its fields, or moves a `Problem` to another key with ``dataclasses.replace`` and
`below`. Messages are never parsed.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from os import PathLike, fspath
from typing import Any, Literal, Self


@dataclass(frozen=True)
class Problem:
    """One thing that is wrong: printed as ``file:line: subject: key = value: message; remedy``, empty fields left out.

    ``key``: dotted, as in a shot file, or an argument's name; ``remedy``: what to do; ``value``: the key's value, None
    if there is none to show; ``subject``: what the key belongs to if there is no file, such as a vehicle's name.
    """

    key: str
    message: str
    remedy: str = ""
    value: object = None
    file: str = ""
    line: int | None = None
    severity: Literal["error", "warning", "fault"] = "error"
    """"fault" means an error of vehsim itself: the input may be right."""
    subject: str = ""
    fixes: tuple[tuple[str, Any], ...] = ()
    """Keys, each with a value, that would do together, for programs that offer to set them; none if none are known."""

    def __str__(self) -> str:
        warning = "warning: " if self.severity == "warning" else ""
        return f"{warning}{self._with_place(self.said)}"

    @property
    def said(self) -> str:
        """The message and the remedy."""
        return "; ".join(filter(None, (self.message, self.remedy)))

    def as_dict(self) -> dict[str, Any]:
        """Its fields as JSON data, without the empty ones; a value that JSON does not have as text."""
        fields = {name: getattr(self, name) for name in self.__dataclass_fields__}
        is_json = isinstance(self.value, bool | int | str) or (
            isinstance(self.value, float) and math.isfinite(self.value)
        )
        plain = self.value if is_json else _short(self.value)
        kept = {name: value for name, value in fields.items() if value not in ("", None, ())}
        return kept | ({} if self.value is None else {"value": plain})

    def below(self, key: str, **changes: Any) -> Problem:
        """This problem with its keys below another: ``below("mark[0]")`` of ``hold`` is ``mark[0].hold``."""
        return replace(self.fixed_below(key), key=f"{key}.{self.key}" if self.key else key, **changes)

    def fixed_below(self, key: str) -> Problem:
        """This problem with the keys of its fixes below another."""
        return replace(self, fixes=tuple((f"{key}.{name}", value) for name, value in self.fixes))

    def seen_from(self, key: str, value: object = None, remedy: str = "") -> Problem:
        """This problem as seen from ``key``, which names the file in which it was found: its own place and key become
        part of the message, unless they only repeat ``value``. ``remedy`` is used if it has none."""
        repeats = value is not None and not self.file and _short(self.value) == _short(value)
        own = replace(self, key="", value=None) if repeats else self
        return Problem(key, own._with_place(self.message), self.remedy or remedy, value, severity=self.severity)

    def _with_place(self, text: str) -> str:
        line = f":{self.line}" if self.line is not None else ""
        value = f" = {_short(self.value)}" if self.value is not None else ""
        return ": ".join(filter(None, (self.file and f"{self.file}{line}", self.subject, f"{self.key}{value}", text)))


class VehsimError(Exception):
    """Base class of all errors that vehsim raises on purpose. ``problems``: everything that is wrong, one or more.

    ``key``, ``value``, ``message`` and ``remedy`` are those of the first `Problem`.
    """

    problems: list[Problem]

    def __init__(
        self,
        message: str,
        remedy: str = "",
        *,
        key: str = "",
        value: object = None,
        subject: str = "",
        file: str | PathLike[str] = "",
        line: int | None = None,
    ) -> None:
        self.problems = [Problem(key, message, remedy, value, fspath(file), line, subject=subject)]
        super().__init__(message)

    @classmethod
    def of(cls, *problems: Problem) -> Self:
        """The error of existing problems."""
        error = cls.__new__(cls)
        error.problems = list(problems)
        return error

    def __str__(self) -> str:
        return "\n".join(map(str, self.problems))

    def __reduce__(self) -> Any:
        return _again, (type(self), self.problems, {k: v for k, v in vars(self).items() if k != "problems"})

    @property
    def problem(self) -> Problem:
        """The first problem."""
        return self.problems[0]

    @property
    def key(self) -> str:
        return self.problem.key

    @property
    def value(self) -> object:
        return self.problem.value

    @property
    def message(self) -> str:
        return self.problem.message

    @property
    def remedy(self) -> str:
        return self.problem.remedy


class InputError(VehsimError):
    """Wrong input: a file, key or value to fix. The CLI exits with 2 and touches nothing."""


class SolveError(VehsimError):
    """A motion could not be found, integrated or certified. The CLI exits with 1.

    ``reason``: that of a failed plan, `vehsim.planning.Plan.reason`, or None.
    """

    reason: str | None = None

    def __init__(self, message: str, remedy: str = "", *, reason: str | None = None, **place: Any) -> None:
        super().__init__(message, remedy, **place)
        if reason is not None:
            self.reason = reason


class FailedPlan(UserWarning):
    """A plan came back without success."""


class Caution(UserWarning):
    """A warning about a key of the input, as data: its ``problem``."""

    def __init__(self, problem: Problem) -> None:
        super().__init__(str(replace(problem, severity="error")))
        self.problem = replace(problem, severity="warning")


class OutsideTerrain(UserWarning):
    """A vehicle drives beyond the borders of the terrain."""


class ExportError(VehsimError):
    """A file could not be written, or does not read back as written. The CLI exits with 1."""


class ShotError(InputError):
    """Everything that is wrong with a shot file, or with a file that it names."""

    def __init__(self, problems: Sequence[Problem]):
        Exception.__init__(self)
        self.problems = list(problems)


def _again(kind: type[VehsimError], problems: list[Problem], more: dict[str, Any]) -> VehsimError:
    """The error received from another process."""
    error = kind.of(*problems)
    vars(error).update(more)
    return error


def _short(value: object, length: int = 80) -> str:
    """A value as shown in a message: one short line; arrays as lists, paths as text."""
    value = value.tolist() if hasattr(value, "tolist") else fspath(value) if isinstance(value, PathLike) else value
    try:
        text = repr(value)
    except (ValueError, RecursionError):  # for example integers of thousands of digits, or deeply nested lists
        text = f"<{type(value).__name__}>"
    return text if len(text) <= length else f"{text[: length - 3]}..."
