"""An Open Job Description template: the batch's steps, their dependencies, and the frames in chunks.

Render farms with https://github.com/OpenJobDescription run it; `steps.py` does the work of each task.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from vehsim.batch.steps import draws
from vehsim.batch.summary import write_whole
from vehsim.batch.task import Task
from vehsim.errors import InputError

SUFFIX = ".clips.json"


def write_job(path: Path, tasks: Sequence[Task], chunks: int = 4, name: str = "vehsim") -> tuple[Path, Path]:
    """Write the template ``path`` and, beside it, the numbered list of clips for its tasks. Returns both files.

    ``chunks``: number of tasks that share the frames of a clip. Raises ``InputError``, ``ExportError``.
    """
    if path.suffix != ".json" or path.name.endswith(SUFFIX):
        raise InputError("the template is JSON", "give a name that ends in .json", file=path)
    if not tasks:
        raise InputError("no clips", "give shots", file=path)
    clips = path.with_name(f"{path.stem}{SUFFIX}")
    rows = [asdict(task) | {"resume": True} for task in tasks]
    write_whole(clips, json.dumps({"clips": rows}, default=str, indent=1) + "\n")
    write_whole(path, json.dumps(template(tasks, clips.name, chunks, name), indent=2) + "\n")
    return path, clips


def template(tasks: Sequence[Task], clips: str, chunks: int, name: str) -> dict[str, Any]:
    """The template as data, with ``clips`` a file beside it.

    Its steps: measure (for terrains that are planned in), plan, bake, and with pictures render and deliver.
    """
    every = f"0-{len(tasks) - 1}"
    first_on = {task.field: i for i, task in reversed(list(enumerate(tasks))) if task.field is not None}
    steps = []
    if first_on:
        steps.append(_step("Measure", "measure", sorted(first_on.values())))
    steps.append(_step("Plan", "plan", every, after=["Measure"] if first_on else []))
    steps.append(_step("Bake", "bake", every, after=["Plan"]))
    if draws(tasks[0].to):
        steps.append(_step("Render", "render", every, after=["Bake"], parts=True))
        steps.append(_step("Deliver", "deliver", every, after=["Render"]))
    return {
        "specificationVersion": "jobtemplate-2023-09",
        "name": name,
        "description": f"{len(tasks)} clips to {tasks[0].out}",
        "parameterDefinitions": [
            {
                "name": "Clips",
                "type": "PATH",
                "objectType": "FILE",
                "dataFlow": "IN",
                "default": clips,
                "description": "The list of clips that vehsim job wrote beside this template.",
            },
            {"name": "Vehsim", "type": "STRING", "default": "vehsim", "description": "The command on the workers."},
            {
                "name": "Chunks",
                "type": "INT",
                "minValue": 1,
                "default": chunks,
                "description": "Tasks that share the frames of a clip.",
            },
        ],
        "steps": steps,
    }


def _step(name: str, step: str, clips: Any, after: Sequence[str] = (), parts: bool = False) -> dict[str, Any]:
    arguments = ["step", step, "{{Param.Clips}}", "--clip", "{{Task.Param.Clip}}"]
    definitions: list[dict[str, Any]] = [{"name": "Clip", "type": "INT", "range": clips}]
    if parts:
        arguments += ["--part", "{{Task.Param.Part}}"]
        definitions.append({"name": "Part", "type": "INT", "range": "1-{{Param.Chunks}}"})
    arguments += ["--parts", "{{Param.Chunks}}"]
    described: dict[str, Any] = {
        "name": name,
        "parameterSpace": {"taskParameterDefinitions": definitions},
        "script": {"actions": {"onRun": {"command": "{{Param.Vehsim}}", "args": arguments}}},
    }
    return described | ({"dependencies": [{"dependsOn": other} for other in after]} if after else {})
