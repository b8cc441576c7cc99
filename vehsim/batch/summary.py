"""``summary.json``: every clip of a batch and what became of it, for machines.

The same batch gives the same bytes, however often it was interrupted: nothing in it is a time, a machine or a process.
Those are in the log (``--log json``).
"""

from __future__ import annotations

import json
import os
from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

from vehsim import __version__
from vehsim.batch.task import Outcome, Task
from vehsim.delivery import clean_up, owner
from vehsim.errors import ExportError

NAME = "summary.json"


def write_summary(out: Path, tasks: Sequence[Task], outcomes: Mapping[str, Outcome], refused: Sequence[str]) -> Path:
    """Write ``out/summary.json``. ``refused``: what was wrong with shots that were never begun."""
    summary = {
        "schema": 1,
        "vehsim": __version__,
        "clips": [_clip(task, outcomes.get(task.name)) for task in tasks],
        "refused": list(refused),
    }
    path = out / NAME
    write_whole(path, json.dumps(summary, indent=1, sort_keys=True) + "\n")
    return path


def _clip(task: Task, outcome: Outcome | None) -> dict[str, Any]:
    clip: dict[str, Any] = {"name": task.name, "source": task.source, "inputs": task.inputs}
    if outcome is None:
        return clip | {"state": "unfinished"}
    if outcome.state == "failed":
        return clip | {"state": "failed", "error": {"kind": outcome.kind, "message": outcome.message}}
    return clip | {"state": "done", "folder": task.name, "to": list(task.to)}


def write_whole(path: Path, text: str) -> None:
    """Write beside, have it on the disk, then move into place. Raises ``ExportError``."""
    beside = path.with_name(f".{path.name}.{owner()}.partial")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        clean_up(path)
        with beside.open("x", encoding="utf-8") as file:
            file.write(text)
            file.flush()
            os.fsync(file.fileno())
        beside.replace(path)
    except OSError as error:
        raise ExportError(f"{path}: could not be written: {error.strerror}; mend that and export again") from error
    finally:
        with suppress(OSError):
            beside.unlink()
