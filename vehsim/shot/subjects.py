"""Errors and warnings about one vehicle of a shot, named as the shot names it: two cars are told apart."""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace

from vehsim.errors import Caution, Problem, VehsimError


@contextmanager
def naming(name: str, model: str, key: str = "") -> Iterator[None]:
    """Give errors and warnings the subject ``name`` where they have none, or that of the vehicle's ``model``; keys of
    errors' fixes are below ``key``."""
    caught: list[warnings.WarningMessage] = []
    try:
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            yield
    except VehsimError as error:
        error.problems = [_named(problem.fixed_below(key), name, model) for problem in error.problems]
        raise
    finally:
        for w in caught:
            message: Warning = w.message  # type: ignore[assignment]  # always an instance when recorded
            if isinstance(message, Caution):
                message = Caution(_named(message.problem, name, model))
            elif issubclass(w.category, UserWarning):  # not a library's warning on this occasion
                message = w.category(f"{name}: {str(message).removeprefix(f'{model}: ')}")
            warnings.warn_explicit(message, w.category, w.filename, w.lineno)


def _named(problem: Problem, name: str, model: str) -> Problem:
    return replace(problem, subject=name) if problem.subject in ("", model) and not problem.file else problem
