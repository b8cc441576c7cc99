"""Read a table of numbers from a CSV file: columns by the names in its first line."""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from vehsim.intake.foreign import reading, refuse
from vehsim.intake.reader import Answer, read_cached

REMEDY = "give a line of column names, then lines of numbers, separated by commas"


def read_columns(path: Path, key: str, needed: str) -> dict[str, NDArray[np.float64]]:
    """The columns (n,) of a table with at least one row and a column ``needed``. Raises ``InputError``."""
    names, (values,) = read_cached(columns, path, key, key)
    if needed not in names:
        raise refuse(path, key, f"no column {needed!r}", "add it", names[:20])
    return dict(zip(names, values, strict=True))


def columns(path: Path, key: str) -> Answer:
    """Names of the columns and their values (columns, n). It runs in the reader process."""
    with reading(path, key, REMEDY), path.open(newline="", encoding="utf-8-sig") as file:
        rows = csv.reader(file)
        names = [name.strip() for name in next(rows, [])]
        if not names or len(set(names)) < len(names):
            raise refuse(path, key, "a name of a column is missing or used twice", REMEDY, names[:20])
        numbers = []
        for number, row in enumerate(rows, 1):
            if not row:
                continue
            if len(row) != len(names):
                raise refuse(path, key, f"row {number} has {len(row)} of {len(names)} values", REMEDY)
            for name, text in zip(names, row, strict=True):
                try:
                    value = float(text)
                except ValueError:
                    value = np.nan
                if not np.isfinite(value):
                    raise refuse(path, key, f"row {number}, column {name!r}: not a number", REMEDY, text)
                numbers.append(value)
        if not numbers:
            raise refuse(path, key, "no rows", REMEDY)
        return names, [np.array(numbers).reshape(-1, len(names)).T.copy()]
