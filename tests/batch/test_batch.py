"""Batches by the command line: the same bytes from any number of workers, resuming by content, and the JSON log."""

from __future__ import annotations

import json
import os
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

import vehsim
from tests.shots import driven
from vehsim.batch import export_batch, load_shots
from vehsim.batch.inputs import fingerprint, is_finished
from vehsim.cli import commands as cli

FIVE = '"vehicle.car.motion.duration" = [0.25, 0.3, 0.35, 0.4, 0.45]'
Content = Callable[[Path], dict[str, str]]
Write = Callable[..., Path]


def test_one_worker_two_workers_and_dask_give_the_same_bytes(write: Write, tmp_path: Path, content: Content) -> None:
    pytest.importorskip("distributed", reason='needs the extra: pip install "vehsim[dask]"')
    shots = load_shots(write(sweep=FIVE))
    for name, how in {"one": {}, "two": {"workers": 2}, "dask": {"workers": 2, "dask": "local"}}.items():
        outcomes = export_batch(shots, tmp_path / name, ["usd", "npz"], **how)  # type: ignore[arg-type]  # values of one type each
        assert [outcome.state for outcome in outcomes] == ["done"] * 5
    assert content(tmp_path / "one") == content(tmp_path / "two") == content(tmp_path / "dask")
    assert len([path for path in content(tmp_path / "one") if path.endswith("report.json")]) == 5


def test_finished_clips_are_kept_and_others_made_again(write: Write, tmp_path: Path, content: Content) -> None:
    shots, out = load_shots(write(sweep=FIVE)), tmp_path / "out"
    export_batch(shots, out, ["npz", "csv"], workers=2)
    before, dates = content(out), {path: path.stat().st_ino for path in out.iterdir()}
    broken = out / "drive_duration1" / "car.npz"
    broken.write_bytes(broken.read_bytes()[:-1] + b"?")
    (out / "drive_duration2" / "car.csv").unlink()
    (out / "drive_duration3" / "report.json").write_text('{"files": {}, "solved"')
    outcomes = export_batch(shots, out, ["npz", "csv"], workers=2, resume=True)
    assert [outcome.state for outcome in outcomes] == ["skipped", "done", "done", "done", "skipped"]
    assert content(out) == before
    same = {path.name for path in out.iterdir() if path.stat().st_ino == dates[path]}
    assert same >= {"drive_duration0", "drive_duration4"}


@pytest.mark.parametrize("year", [1971, 2099])
def test_clock_changes_do_not_affect_resuming(write: Write, tmp_path: Path, content: Content, year: int) -> None:
    """Finished clips are recognised by content: dates in the distant past or future neither save nor cause work."""
    shot, out = write(sweep=FIVE), tmp_path / "out"
    export_batch(load_shots(shot), out, ["npz"])
    before = content(out)
    (out / "drive_duration1" / "car.npz").write_bytes(b"")
    then = (year - 1970) * 31_557_600.0
    for path in (shot, *out.rglob("*"), out):
        os.utime(path, (then, then))
    outcomes = export_batch(load_shots(shot), out, ["npz"], resume=True)
    assert [outcome.state for outcome in outcomes] == ["skipped", "done", "skipped", "skipped", "skipped"]
    assert content(out) == before


def test_every_input_of_a_clip_is_in_its_hash(write: Write, tmp_path: Path) -> None:
    import shutil

    from vehsim.vehicles import load_vehicle

    home = load_vehicle("car").rig.asset.parent  # type: ignore[union-attr]  # a car has a rig
    shutil.copytree(home, tmp_path / "mine")
    (shot,) = load_shots(write(asset="mine"))
    first = fingerprint(shot, ["npz"])
    assert fingerprint(shot, ["npz"]) == first
    seen = {first, fingerprint(shot, ["npz", "csv"]), fingerprint(shot, ["npz"], draft=True)}
    seen.add(fingerprint(load_shots(tmp_path / "drive.toml", ["shot.start_frame=1"])[0], ["npz"]))
    toml = tmp_path / "mine" / "vehicle.toml"
    toml.write_text(toml.read_text() + "\n# a word\n")
    seen.add(fingerprint(load_shots(tmp_path / "drive.toml")[0], ["npz"]))
    assert len(seen) == 5


def test_an_obstacles_mesh_is_in_the_hash(write: Write, tmp_path: Path) -> None:
    path = write(more='[[world.obstacle]]\nshape = "mesh"\npath = "wall.obj"\nposition = [9, 9, 0]\n')
    seen = set()
    for height in (1, 2):
        corners = "".join(f"v {x} {y} {z}\n" for x, y, z in ((0, 0, 0), (1, 0, 0), (0, 1, 0), (0, 0, height)))
        (tmp_path / "wall.obj").write_text(f"{corners}f 1 3 2\nf 1 2 4\nf 2 3 4\nf 3 1 4\n")
        seen.add(fingerprint(load_shots(path)[0], ["npz"]))
    assert len(seen) == 2


def test_a_delivery_by_other_exporters_does_not_count_as_finished(write: Write, tmp_path: Path) -> None:
    (shot,) = load_shots(write())
    shot.solve().export(tmp_path / "out", ["npz"])
    assert not is_finished(tmp_path / "out" / "drive", fingerprint(shot, ["npz"]))


def test_an_unchecked_shot_is_checked_before_it_is_solved(write: Write, tmp_path: Path) -> None:
    path = write()
    path.write_text(path.read_text().replace('name = "drive"', 'name = "drive"\nhandles = 8', 1))
    (outcome,) = export_batch(load_shots(path), tmp_path / "out", ["npz"])
    assert (outcome.state, outcome.kind) == ("failed", "ShotError")
    assert "handles need an end" in outcome.message


def test_summary_and_exit_code(write: Write, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    good, bad = write("good", sweep='"shot.start_frame" = [1, 2]'), write("bad", duration=-1)
    out = tmp_path / "out"
    arguments = ["export", str(bad), str(good), "--out", str(out), "--to", "npz", "--workers", "2"]
    assert cli.run(arguments) == 1
    assert capsys.readouterr().out.count("npz of frames") == 2
    summary = json.loads((out / "summary.json").read_text())
    assert [(clip["name"], clip["state"]) for clip in summary["clips"]] == [
        ("good_start_frame0", "done"),
        ("good_start_frame1", "done"),
    ]
    assert "duration = -1" in summary["refused"][0]
    assert cli.run([*arguments, "--resume"]) == 1
    assert capsys.readouterr().out.count("already finished") == 2
    assert json.loads((out / "summary.json").read_text()) == summary


def test_a_failed_plan_is_reported_once(write: Write, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """It is reported as an error, without a warning before it."""
    import warnings
    from types import SimpleNamespace

    from vehsim import planning
    from vehsim.errors import FailedPlan

    def fail(*args: object, **more: object) -> SimpleNamespace:
        warnings.warn("car: plan failed: no way there", FailedPlan, stacklevel=1)
        return SimpleNamespace(
            success=False, message="no way there", reason="not solved", possible={}, possible_clearance=None
        )

    path = write()
    simulated = path.read_text().partition("method")[0]
    marks = "".join(f"[[vehicle.motion.mark]]\nframe = {k}\nposition = [{k - 1001}, 0, 0]\n" for k in (1001, 1025))
    path.write_text(f'{simulated}method = "plan"\n{marks}')
    monkeypatch.setattr(planning, "plan", fail)
    (outcome,) = export_batch(load_shots(path), tmp_path / "out", ["npz"])
    assert outcome.message.startswith("car: no plan was found: no way there")
    assert outcome.warnings == ()


def test_the_json_log(write: Write, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = write(sweep='"shot.start_frame" = [1, 2]')
    assert cli.run(["export", str(path), "--out", str(tmp_path / "out"), "--to", "usd", "--log", "json"]) == 0
    output = capsys.readouterr()
    events = [json.loads(line) for line in output.out.splitlines()]
    assert events[0]["event"] == "batch"
    assert [event["clip"] for event in events if event["event"] == "done"] == [
        "drive_start_frame0",
        "drive_start_frame1",
    ]
    assert {"planning", "baking"} <= {event["state"] for event in events if event["event"] == "progress"}
    assert all("time" in event and "elapsed" in event for event in events)
    assert output.err == ""


def test_the_json_log_contains_refused_shots(write: Write, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """With the line in the file; a foreign folder stops only its own shot."""
    out = tmp_path / "out"
    (out / "taken").mkdir(parents=True)
    (out / "taken" / "notes.txt").write_text("mine")
    shots = [str(write(name, duration=d)) for name, d in {"good": 0.25, "bad": -1, "taken": 0.25}.items()]
    assert cli.run(["export", *shots, "--out", str(out), "--to", "npz", "--log", "json"]) == 1
    events = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    refused = {Path(event["source"]).stem: event for event in events if event["event"] == "refused"}
    assert set(refused) == {"bad", "taken"}
    assert (refused["bad"]["line"], refused["bad"]["key"]) == (10, "vehicle[0].motion.duration")
    problem = refused["bad"]["problem"]
    assert (problem["value"], problem["line"]) == (-1, 10) and "0" in problem["message"] and problem["remedy"]
    assert "was not written by vehsim" in refused["taken"]["message"]
    assert [event["clip"] for event in events if event["event"] == "done"] == ["good"]
    assert (out / "taken" / "notes.txt").read_text() == "mine"


def test_the_batch_survives_its_log_reader_exiting(write: Write, tmp_path: Path) -> None:
    """As in ``vehsim export ... --log json | head -1``."""
    import subprocess
    import sys

    arguments = ["export", str(write()), "--out", str(tmp_path / "out"), "--to", "npz", "--log", "json"]
    command = [sys.executable, "-m", "vehsim", *arguments]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE)
    assert process.stdout is not None and process.stderr is not None
    process.stdout.readline()
    process.stdout.close()
    assert process.stderr.read() == b""
    assert process.wait() == 0
    assert (tmp_path / "out" / "drive" / "car.npz").exists()


def test_one_valid_shot_among_invalid_ones_has_a_summary(write: Write, tmp_path: Path) -> None:
    out = tmp_path / "out"
    arguments = ["export", str(write("good")), str(write("bad", duration=-1)), "--out", str(out), "--to", "npz"]
    assert cli.run(arguments) == 1
    summary = json.loads((out / "summary.json").read_text())
    assert [clip["name"] for clip in summary["clips"]] == ["good"] and len(summary["refused"]) == 1


def test_deliveries_contain_no_time(write: Write, tmp_path: Path, content: Content) -> None:
    """Clocks with another time, or running backwards, change no byte."""
    import subprocess
    import sys

    path = write()
    code = (
        "import sys, time\n"
        "from vehsim.cli import commands\n"
        "offset = float(sys.argv.pop(1)); real = time.time\n"
        "time.time = lambda: real() + offset\n"
        "sys.exit(commands.run(sys.argv[1:]))\n"
    )
    for offset in ("-1e9", "1e8"):
        arguments = ["export", str(path), "--out", str(tmp_path / offset), "--to", "usd,npz,csv"]
        subprocess.run([sys.executable, "-c", code, offset, *arguments], check=True, capture_output=True)
    assert content(tmp_path / "-1e9") == content(tmp_path / "1e8")


def test_the_live_table_counts_states() -> None:
    from rich.console import Console

    from vehsim.batch.screen import _Table
    from vehsim.batch.task import Outcome, Task

    tasks = [Task(name, {}, "", f"{name}.toml", "out", ("usd",), "") for name in ("a", "b", "c", "d")]
    console = Console(record=True, width=120, force_terminal=True)
    table = _Table(tasks, console)
    table.tell("a", "planning", "iteration [3]", 0.5)
    table.tell("b", "rendering", "frames: chase 7", 0.2)
    table.end(Outcome("c", "failed", "SolveError", "no way [there]"))
    console.print(table)
    text = console.export_text()
    assert "1 of 4: 1 queued, 1 planning, 1 rendering, 1 failed" in text
    assert "iteration [3]" in text
    assert "c.toml: no way [there]" in text


def test_an_asset_is_read_once_for_all_clips(write: Write, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Reading a car's meshes takes longer than driving it: no clip reads what another has read."""
    from vehsim.rig import parts

    (first, second) = load_shots(write(sweep='"vehicle.car.motion.duration" = [0.25, 0.3]'))
    export_batch([first], tmp_path / "out", ["usd"])
    reads: list[object] = []
    monkeypatch.setattr(parts, "read_parts", lambda *args: reads.append(args))
    second.check()
    assert export_batch([second], tmp_path / "out", ["usd"])[0].state == "done"
    assert reads == []


def test_recordings_are_driven_again_in_a_batch(tmp_path: Path) -> None:
    """``method = "sticks"`` with several tables: each clip is its recording; a changed table is made again."""
    pushes = {"a": 500.0, "b": -300.0}
    for name, push in pushes.items():
        (tmp_path / f"{name}.csv").write_text(f"frame,control.torque [N m]\n1001,{push}\n1013,{push}\n")
    shot, sweep = tmp_path / "drive.toml", '[sweep]\n"vehicle.car.motion.file" = ["a.csv", "b.csv"]\n'
    header = driven().partition("method")[0]
    shot.write_text(f'{header}method = "sticks"\nfile = "a.csv"\n{sweep}')
    shots, out = load_shots(shot), tmp_path / "out"
    assert [outcome.state for outcome in export_batch(shots, out, ["npz"], workers=2)] == ["done"] * 2
    paths = [out / one.name / "car.npz" for one in shots]
    car = vehsim.load_vehicle("car")
    for path, push in zip(paths, pushes.values(), strict=True):
        clip = vehsim.Clip.load(path, car)
        assert np.sign(clip.positions[-1, 0]) == np.sign(push) and (clip.controls[:-1, 0] == push).all()
    before = [path.read_bytes() for path in paths]
    (tmp_path / "b.csv").write_text("frame,control.torque [N m]\n1001,-400\n1013,-400\n")
    states = [outcome.state for outcome in export_batch(load_shots(shot), out, ["npz"], workers=2, resume=True)]
    assert states == ["skipped", "done"]
    assert paths[0].read_bytes() == before[0] and paths[1].read_bytes() != before[1]
