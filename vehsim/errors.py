"""Errors a user can act on. Each names what is wrong, where, and how to mend it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal


class VehsimError(Exception):
    """Base of all errors vehsim raises on purpose."""


class InputError(VehsimError):
    """Wrong input: a file, key or value somebody has to mend. The CLI exits with 2 and touches nothing."""


class SolveError(VehsimError):
    """A motion could not be found, integrated or certified. The CLI exits with 1."""


class ExportError(VehsimError):
    """Something could not be written, or what was written does not read back. The CLI exits with 1."""


@dataclass(frozen=True)
class Problem:
    """One thing wrong with an input: printed as ``file:line: key = value: message; mend``."""

    key: str
    message: str
    mend: str
    value: object = None
    file: str = ""
    line: int | None = None
    severity: Literal["error", "warning", "fault"] = "error"
    """a fault is vehsim's own: nothing in the input is known to be wrong"""

    def __str__(self) -> str:
        line = f":{self.line}" if self.line is not None else ""
        where = f"{self.file}{line}: " if self.file else ""
        value = f" = {_short(self.value)}" if self.value is not None else ""
        warning = "warning: " if self.severity == "warning" else ""
        return f"{warning}{where}{self.key}{value}: {self.message}; {self.mend}"


class ShotError(InputError):
    """Everything wrong with a shot file, or with a file that it names, at once."""

    def __init__(self, problems: Sequence[Problem]):
        self.problems = list(problems)
        super().__init__("\n".join(str(problem) for problem in self.problems))


def _short(value: object, length: int = 80) -> str:
    """A value as it is shown in a message: one line, never pages."""
    try:
        text = repr(value)
    except (ValueError, RecursionError):  # an integer of thousands of digits, lists nested beyond reason
        text = f"<{type(value).__name__}>"
    return text if len(text) <= length else f"{text[: length - 3]}..."
