"""Read the report of a delivery, which may have been changed since it was written."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from vehsim.delivery.earlier import SIGN
from vehsim.delivery.folders import newest
from vehsim.errors import InputError
from vehsim.intake.foreign import reading, refuse
from vehsim.intake.tables import NAME, NOT_A_NAME

REMEDY = "export the shot again"


@contextmanager
def reading_report(folder: Path) -> Iterator[dict[str, Any]]:
    """A context in which the ``report.json`` of a delivery is read: its data, of which only ``shot``, a name, is
    checked. Any exception in it becomes an ``InputError`` of the report, because that may contain anything."""
    path = folder / SIGN
    if not path.is_file():
        version = newest(folder)
        if version != folder:
            raise InputError(f"holds versions: no {SIGN} in it", f"give one of them: {version}", file=folder)
        raise InputError(f"not a delivery: no {SIGN} in it", "give a folder that vehsim export wrote", file=folder)
    with reading(path, "report", REMEDY):
        report = json.loads(path.read_text(encoding="utf-8"))
        if not re.fullmatch(NAME, report["shot"]):
            raise refuse(path, "shot", NOT_A_NAME, REMEDY, report["shot"])
        yield report
