"""Render-farm jobs: valid templates, steps that survive accidents, and the bytes of ``vehsim export``."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from vehsim.batch import export_batch, load_shots
from vehsim.batch.steps import _share, run_step
from vehsim.cli import commands as cli
from vehsim.errors import ExportError, InputError

PICTURES = "[render]\nsize = [64, 36]\nevery = 2\nsamples = 1\n"


def write_job(shot: Path, template: Path, to: str, *more: str) -> Path:
    arguments = ["job", str(shot), "--template", str(template), "--out", str(template.parent / "farm"), "--to", to]
    assert cli.run([*arguments, *more]) == 0
    return template.with_name(f"{template.stem}.clips.json")


@pytest.mark.parametrize("to, steps", [("npz", ["Plan", "Bake"]), ("usd,mp4", ["Plan", "Bake", "Render", "Deliver"])])
def test_templates_check(write: Callable[..., Path], tmp_path: Path, to: str, steps: list[str]) -> None:
    pytest.importorskip("openjd.cli")
    write_job(write(sweep='"shot.start_frame" = [1, 2, 3]'), tmp_path / "job.json", to)
    command = [str(Path(sys.executable).with_name("openjd")), "check", str(tmp_path / "job.json")]
    answer = subprocess.run(command, capture_output=True, text=True)
    assert answer.returncode == 0, answer.stdout + answer.stderr
    template = json.loads((tmp_path / "job.json").read_text())
    assert [step["name"] for step in template["steps"]] == steps
    after = [[other["dependsOn"] for other in step.get("dependencies", [])] for step in template["steps"]]
    assert after == [[], *([name] for name in steps[:-1])]


def test_the_farm_delivers_what_export_does(write: Callable[..., Path], tmp_path: Path, content: Callable) -> None:  # type: ignore[type-arg]
    """Run by an engine of Open Job Description: frames in three chunks, and films."""
    pytest.importorskip("openjd.cli")
    shot, to = write(more=PICTURES), "usd,png,mp4,npz"
    write_job(shot, tmp_path / "job.json", to, "--chunks", "3")
    binaries = Path(sys.executable).parent
    command = [str(binaries / "openjd"), "run", str(tmp_path / "job.json"), "--step", "Deliver", "--run-dependencies"]
    own = os.environ | {"TMPDIR": str(tmp_path)}  # the engine's shared folder may be another user's
    answer = subprocess.run(
        [*command, "-p", f"Vehsim={binaries / 'vehsim'}"], capture_output=True, text=True, cwd=tmp_path, env=own
    )
    assert answer.returncode == 0, answer.stdout[-3000:] + answer.stderr
    export_batch(load_shots(shot), tmp_path / "here", to.split(","))
    expected = {path: digest for path, digest in content(tmp_path / "here").items() if path != "summary.json"}
    assert content(tmp_path / "farm") == expected


def test_steps_require_complete_previous_steps(write: Callable[..., Path], tmp_path: Path) -> None:
    clips = write_job(write(more=PICTURES), tmp_path / "job.json", "png")
    with pytest.raises(ExportError, match="run the step 'plan'"):
        run_step("bake", clips, 0)
    run_step("plan", clips, 0)
    run_step("bake", clips, 0)
    stage = tmp_path / "farm" / ".job" / "drive" / "bake" / "drive.usda"
    stage.write_bytes(stage.read_bytes()[:-10])
    with pytest.raises(ExportError, match="run the step 'bake'"):
        run_step("render", clips, 0, (1, 2))
    run_step("bake", clips, 0)
    run_step("render", clips, 0, (1, 2))
    with pytest.raises(ExportError, match=r"frames\.2of2"):
        run_step("deliver", clips, 0, (1, 2))
    assert not (tmp_path / "farm" / "drive").exists()
    run_step("render", clips, 0, (2, 2))
    run_step("deliver", clips, 0, (1, 2))
    assert [path.name for path in (tmp_path / "farm").iterdir()] == ["drive"]
    run_step("deliver", clips, 0, (1, 2))  # again: it is done


def test_steps_make_versions_as_export_does(write: Callable[..., Path], tmp_path: Path) -> None:
    more = "[export]\nversions = true\n"
    for seconds in (0.25, 0.3):  # other inputs, so another version
        clips = write_job(write(more=more, duration=seconds), tmp_path / "job.json", "usd")
        for step in ("plan", "bake", "bake"):  # done again, it finds itself done
            run_step(step, clips, 0)
    home = tmp_path / "farm" / "drive"
    assert sorted(path.name for path in home.iterdir()) == ["latest.car.usda", "latest.usda", "v001", "v002"]
    assert "./v002/drive.usda" in (home / "latest.usda").read_text()


def test_steps_refuse_missing_clips(write: Callable[..., Path], tmp_path: Path) -> None:
    clips = write_job(write(), tmp_path / "job.json", "npz")
    with pytest.raises(InputError, match="no clip 1"):
        run_step("plan", clips, 1)


@pytest.mark.parametrize("count", [1, 3, 7])
def test_chunks_cover_every_frame_in_order(count: int) -> None:
    frames = list(range(1001, 1020, 2))
    shares = [_share(frames, k, count) for k in range(1, count + 1)]
    assert [frame for share in shares for frame in share] == frames
    assert max(map(len, shares)) - min(map(len, shares)) <= 1
