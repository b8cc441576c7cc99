"""Errors a user can act on. Each names what is wrong, where, and how to mend it."""

from __future__ import annotations

from dataclasses import dataclass


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
    """One thing wrong with an input: printed as ``file: key = value: what; mend``."""

    key: str
    message: str
    mend: str
    value: object = None
    file: str = ""

    def __str__(self) -> str:
        where = f"{self.file}: " if self.file else ""
        value = f" = {self.value!r}" if self.value is not None else ""
        return f"{where}{self.key}{value}: {self.message}; {self.mend}"


class ShotError(InputError):
    """Everything wrong with a shot file, at once."""

    def __init__(self, problems: list[Problem]):
        self.problems = problems
        super().__init__("\n".join(str(problem) for problem in problems))
