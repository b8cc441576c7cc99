"""``summary.json``: every clip of a batch and its outcome, for programs.

The same batch gives the same bytes, however often it was interrupted: it contains no time, machine or process. The log
has those (``--log json``).
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from vehsim.batch.task import Outcome, Task
from vehsim.delivery.folders import clean_up
from vehsim.errors import ExportError
from vehsim.runtime.code import version
from vehsim.runtime.files import write_file

NAME = "summary.json"


def write_summary(out: Path, tasks: Sequence[Task], outcomes: Mapping[str, Outcome], refused: Sequence[str]) -> Path:
    """Write ``out/summary.json``. ``refused``: the errors of shots that were never started."""
    summary = {
        "schema": 1,
        "vehsim": version("vehsim"),
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
        error: dict[str, Any] = {"kind": outcome.kind, "message": outcome.message}
        error |= {"problems": list(outcome.problems)} if outcome.problems else {}
        return clip | {"state": "failed", "error": error}
    return clip | {"state": "done", "folder": task.name, "to": list(task.to)}


def write_whole(path: Path, text: str) -> None:
    """Write atomically and flush to the disk. Raises ``ExportError``."""
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        clean_up(path)
        write_file(path, text, durable=True)
    except OSError as error:
        raise ExportError(f"could not be written: {error.strerror}", "fix that and export again", file=path) from error
