"""The command line: exit codes, one message per problem, no traceback, and no files changed by wrong input."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import pytest

from tests.shots import driven
from vehsim.cli import commands as cli
from vehsim.cli import doctor
from vehsim.cli.arguments import frames_in
from vehsim.runtime import machine_code

PATIENCE = 600.0
"""Time limit on a busy machine, s: only a failing test waits that long."""


def write(folder: Path, name: str = "drive", duration: float = 0.25, more: str = "") -> str:
    path = folder / f"{name}.toml"
    path.write_text(driven(name, duration=duration) + more)
    return str(path)


def test_export_writes_a_folder_per_shot(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    shots = [write(tmp_path, "one"), write(tmp_path, "two")]
    assert cli.run(["export", *shots, "--out", str(tmp_path / "out"), "--to", "npz,csv"]) == 0
    assert {path.name for path in (tmp_path / "out" / "one").iterdir()} == {"car.npz", "car.csv", "report.json"}
    assert json.loads((tmp_path / "out" / "two" / "report.json").read_text())["shot"] == "two"
    assert capsys.readouterr().out.count("npz, csv of frames 1001 to 1007") == 2


def test_overrides_reach_the_take(tmp_path: Path) -> None:
    arguments = ["export", write(tmp_path), "--out", str(tmp_path), "--to", "npz", "--set", "shot.start_frame=1"]
    assert cli.run([*arguments, "--set", "vehicle.car.motion.duration=0.5"]) == 0
    report = json.loads((tmp_path / "drive" / "report.json").read_text())
    assert report["frames"] == [1, 13]


@pytest.mark.parametrize(
    "arguments, says",
    [
        (["--set", "world.wind=[0,nan,0]"], "world.wind[1]"),
        (["--set", "world.wnd=3"], "did you mean 'wind'"),
        (["--set", "nonsense"], "not KEY=VALUE"),
        (["--set", "vehicle[3].name=x"], "there is no"),
        (["--only", "cra"], "did you mean 'car'"),
        (["--to", "usd,pgn"], "no such exporter"),
        (["--to", ""], "names no exporter"),
        (["--to", " , "], "names no exporter"),
        (["--quality", "best"], "'best'"),
        (["--colour"], "--colour"),
    ],
)
def test_wrong_input_exits_with_2_and_touches_nothing(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], arguments: list[str], says: str
) -> None:
    shot = write(tmp_path)
    assert cli.run(["export", shot, "--out", str(tmp_path / "out"), *arguments]) == 2
    output = capsys.readouterr().err
    assert says in output
    assert "Traceback" not in output
    assert [path.name for path in tmp_path.iterdir()] == ["drive.toml"]


def test_a_bad_shot_does_not_stop_the_others(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    bad = write(tmp_path, "bad", duration=-1)
    arguments = ["export", bad, write(tmp_path, "good"), str(tmp_path / "none.toml"), "--to", "npz"]
    assert cli.run([*arguments, "--out", str(tmp_path / "out")]) == 1
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == ["good", "summary.json"]
    output = capsys.readouterr().err
    assert "vehicle[0].motion.duration = -1" in output
    assert "none.toml" in output


@pytest.mark.parametrize("where", ["vehsim.shot.Shot.check", "vehsim.batch.task.prepare"])
def test_an_unexpected_error_in_one_shot_leaves_the_others(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, where: str
) -> None:
    """End of file too, which click treats as the end of a dialogue."""
    from pydoc import locate

    shots = [write(tmp_path, "good"), *(write(tmp_path, name) for name in ("odd", "ended"))]
    name, _, last = where.rpartition(".")
    works = locate(where)

    def fails(shot: Any, *rest: Any, **more: Any) -> Any:
        if shot.name != "good":
            raise {"odd": AssertionError, "ended": EOFError}[shot.name]("not foreseen")
        return works(shot, *rest, **more)

    monkeypatch.setattr(locate(name), last, fails)
    assert cli.run(["export", *shots, "--out", str(tmp_path / "out"), "--to", "npz"]) == 1
    output = capsys.readouterr().err
    assert f"{shots[1]}: unexpected: AssertionError: not foreseen; this is an error in vehsim" in output
    assert f"{shots[2]}: unexpected: EOFError" in output
    assert (tmp_path / "out" / "good" / "car.npz").exists()
    code = cli.run(["check", shots[1], shots[2]])
    assert code == (1 if "check" in where else 0)


def test_end_of_file_is_not_an_interrupt(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    def ends() -> None:
        raise EOFError("No data left in file")

    monkeypatch.setattr("vehsim.vehicles.available", ends)
    assert cli.run(["vehicles"]) == 1
    assert "unexpected: EOFError: No data left in file" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("shell", "code", "says"),
    [
        ("{vehsim} schema | head -1", "0 0", "the first line of a shot file"),
        ("{vehsim} vehicles >&-", "0", ""),
        ("{vehsim} vehicles >&- 2>&-", "0", ""),
        ("{vehsim} vehicles > /dev/full", "1", "the output could not be printed: No space left on device"),
        ("{vehsim} check none.toml > /dev/full", "2", "none.toml"),
        ("{vehsim} check none.toml 2> /dev/full", "2", ""),
    ],
)
def test_output_readers_may_exit(shell: str, code: str, says: str) -> None:
    command = shell.format(vehsim=f"'{sys.executable}' -m vehsim") + '; echo "${PIPESTATUS[@]}" >&9'
    with tempfile.TemporaryFile("w+") as codes:
        result = subprocess.run(
            ["bash", "-c", f"exec 9>&{codes.fileno()}; {command}"],
            capture_output=True, text=True, timeout=120, pass_fds=[codes.fileno()],
        )  # fmt: skip
        codes.seek(0)
        assert codes.read().split() == code.split()
    assert says in result.stderr and (says or not result.stderr)
    assert not any(word in result.stderr for word in ("Traceback", "Exception", "unexpected"))


def test_two_shots_with_one_name_are_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "copies").mkdir()
    shots = [write(tmp_path), write(tmp_path / "copies")]
    assert cli.run(["check", *shots]) == 2
    assert "a name of its own" in capsys.readouterr().err


def test_failures_during_the_work_exit_with_1(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """A valid shot without enough time to find a plan."""
    path = tmp_path / "far.toml"
    marks = "".join(
        f"[[vehicle.motion.mark]]\nframe = {frame}\nposition = [{x}, 0, 10]\nvelocity = [0, 0, 0]\n"
        for frame, x in ((1001, 0), (1097, 20))
    )
    head = driven("far").partition("[[vehicle]]")[0]
    vehicle = "[[vehicle]]\nname = 'h'\nasset = 'helicopter'\n"
    motion = "[vehicle.motion]\nmethod = 'plan'\nsegments = 8\ntime_limit = 0.001\n"
    path.write_text(head + vehicle + motion + marks)
    assert cli.run(["export", str(path), "--out", str(tmp_path / "out"), "--to", "npz"]) == 1
    assert "no plan was found" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_foreign_folders_are_refused_before_any_work(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "out" / "drive").mkdir(parents=True)
    (tmp_path / "out" / "drive" / "mine.txt").touch()
    assert cli.run(["export", write(tmp_path), "--out", str(tmp_path / "out"), "--to", "npz"]) == 2
    assert "was not written by vehsim" in capsys.readouterr().err


def test_a_missing_blender_is_reported_before_any_work(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.delenv("VEHSIM_BLENDER", raising=False)
    monkeypatch.setenv("PATH", str(tmp_path))
    monkeypatch.setattr("vehsim.shot.Shot.solve", lambda *_, **__: pytest.fail("it was solved"))
    shot = write(tmp_path)
    assert cli.run(["export", shot, "--out", str(tmp_path / "out"), "--to", "usd,blend"]) == 2
    assert "VEHSIM_BLENDER" in capsys.readouterr().err


def test_quiet_prints_only_errors(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    shot = write(tmp_path, more="[world]\nwind = [0, 3, 0]\n")
    assert cli.run(["export", shot, "--out", str(tmp_path), "--to", "npz", "--quiet"]) == 0
    assert cli.run(["check", shot, "--quiet"]) == 0
    assert capsys.readouterr() == ("", "")
    assert cli.run(["check", shot]) == 0
    assert "has no drag" in capsys.readouterr().err


def test_dry_run_writes_nothing(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.run(["export", write(tmp_path), "--out", str(tmp_path / "out"), "--dry-run"]) == 0
    assert "car (car, simulate)" in capsys.readouterr().out
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("command", ["vehicles", "terrains", "schema", "--version"])
def test_listings_of_vehicles_and_terrains(command: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.run([command]) == 0
    assert capsys.readouterr().out


def test_schema_is_json(capsys: pytest.CaptureFixture[str]) -> None:
    cli.run(["schema"])
    assert json.loads(capsys.readouterr().out)["required"] == ["shot", "vehicle"]


def test_doctor_says_whether_there_is_machine_code(monkeypatch: pytest.MonkeyPatch) -> None:
    assert "llvmlite" in doctor._machine_code().found
    monkeypatch.setitem(sys.modules, "llvmlite.binding", None)
    machine_code._llvm.cache_clear()
    without = doctor._machine_code()
    machine_code._llvm.cache_clear()
    assert without.good and without.found.startswith("none, so that plans and simulations take longer (")


def test_unexpected_errors_are_short(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.delenv("VEHSIM_DEBUG", raising=False)
    monkeypatch.setattr("vehsim.cli.doctor.examine", lambda: 1 / 0)
    assert cli.run(["doctor"]) == 1
    output = capsys.readouterr().err
    assert "ZeroDivisionError" in output
    assert "VEHSIM_DEBUG=1" in output
    monkeypatch.setenv("VEHSIM_DEBUG", "1")
    with pytest.raises(ZeroDivisionError):
        cli.run(["doctor"])


@pytest.mark.parametrize(
    "text, frames",
    [("1001-1100x10", list(range(1001, 1101, 10))), ("7", [7]), ("-40--38", [-40, -39, -38]), ("-2-1", [-2, -1, 0, 1])],
)
def test_frame_ranges(text: str, frames: list[int]) -> None:
    assert frames_in(text) == frames


@pytest.mark.parametrize(
    "option", [["--frames", "9-1"], ["--frames", "a"], ["--frames", "5-"], ["--size", "100000x10"], ["--size", "960"]]
)
def test_render_refuses_frames_and_sizes(tmp_path: Path, capsys: pytest.CaptureFixture[str], option: list[str]) -> None:
    stage = tmp_path / "stage.usda"
    stage.write_text("#usda 1.0")
    assert cli.run(["render", str(stage), "--out", str(tmp_path / "out"), *option]) == 2
    assert option[0] in capsys.readouterr().err
    assert not (tmp_path / "out").exists()
    stage.unlink()  # no stage of ours: tests hold everything they leave against USD's rules


@pytest.mark.parametrize("command", [["validate"], ["render", "--out", "out"]])
def test_missing_stages(tmp_path: Path, command: list[str]) -> None:
    assert cli.run([*command, str(tmp_path / "none.usda")]) == 2


@pytest.mark.parametrize("command", [["validate"], ["render", "--out", "out"]])
@pytest.mark.parametrize("name, says", [("shot.toml", "not USD"), ("folder", "a folder"), ("empty.usda", "not USD")])
def test_an_invalid_stage_is_reported_in_one_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], command: list[str], name: str, says: str
) -> None:
    (tmp_path / "shot.toml").write_text("[shot]")
    (tmp_path / "folder").mkdir()
    (tmp_path / "empty.usda").touch()
    assert cli.run([*command, str(tmp_path / name)]) == 2
    output = capsys.readouterr().err
    assert says in output and output.count("\n") == 1
    (tmp_path / "empty.usda").unlink()


def test_validate_takes_the_stages_in_a_folder(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "shot" / "layers").mkdir(parents=True)
    files = [tmp_path / "shot" / name for name in ("a.usda", "layers/b.usda")]
    for file in files:
        file.write_text("#usda 1.0")  # without a default prim
    (tmp_path / "shot" / "report.json").write_text("{}")
    assert cli.run(["validate", "--quiet", str(tmp_path / "shot")]) == 1
    output = capsys.readouterr().err
    assert all(f"{file}: error" in output for file in files) and "report.json" not in output
    for file in files:
        file.unlink()


@pytest.mark.parametrize("below", ["", "more/"])
def test_out_must_be_a_folder(tmp_path: Path, capsys: pytest.CaptureFixture[str], below: str) -> None:
    shot = write(tmp_path)
    assert cli.run(["export", shot, "--to", "npz", "--out", f"{shot}/{below}"]) == 2
    assert "is a file; give a folder" in capsys.readouterr().err


def test_an_interrupt_anywhere_has_our_exit_code(tmp_path: Path) -> None:
    """Under ``python -m``, a KeyboardInterrupt that passed through an ``exec`` ends Python by signal, even if
    caught."""
    (tmp_path / "struck.py").write_text(
        "import os, signal, sys\n"
        "from vehsim.cli import arguments, commands\n"
        "signal.signal(signal.SIGINT, signal.default_int_handler)\n"
        "def strike(*given):\n"
        "    exec('os.kill(os.getpid(), signal.SIGINT)\\nwhile True: pass')\n"
        "arguments.exporters_in = strike\n"
        "sys.exit(commands.run(['export', 'shot.toml']))\n"
    )
    command = [sys.executable, "-m", "struck"]
    result = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=PATIENCE)
    assert (result.returncode, "Traceback" in result.stderr) == (130, False)


def test_an_interrupt_waits_until_usd_modules_are_loaded() -> None:
    """They print exceptions raised while they load, and continue half loaded: the command would never see them."""
    from vehsim.runtime.signals import raising

    module = {"__name__": "pxr.Something"}
    before = signal.signal(signal.SIGINT, raising(InterruptedError))
    try:
        with pytest.raises(InterruptedError):
            exec("import signal; signal.raise_signal(signal.SIGINT); loaded = True", module)
            time.sleep(10.0)
        assert module["loaded"] is True
    finally:
        signal.signal(signal.SIGINT, before)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_an_interrupted_export_leaves_nothing(tmp_path: Path, number: int) -> None:
    """It is stopped while writing, when its hidden folder exists."""
    shot = write(tmp_path, duration=1)
    code = (
        "import sys, time, pathlib, vehsim.delivery.take as d\n"
        "from vehsim.cli import commands\n"
        "def slow(take, folder, *rest, **options):\n"
        f"    (folder / 'half').touch(); pathlib.Path({str(tmp_path / 'started')!r}).touch(); time.sleep(60)\n"
        "d.write_files = slow\n"
        "sys.exit(commands.run(sys.argv[1:]))\n"
    )
    arguments = [sys.executable, "-c", code, "export", shot, "--out", str(tmp_path / "out"), "--to", "npz"]
    process = subprocess.Popen(
        arguments,
        stderr=subprocess.PIPE,
        text=True,
        preexec_fn=lambda: signal.signal(number, signal.SIG_DFL),  # under nohup, SIGHUP is ignored
    )
    while not (tmp_path / "started").exists():
        assert process.poll() is None, process.communicate()[1]
        time.sleep(0.05)
    assert any((tmp_path / "out").iterdir())
    os.kill(process.pid, number)
    _, output = process.communicate(timeout=PATIENCE)
    assert process.returncode == 130
    assert "Traceback" not in output
    assert not (tmp_path / "out").exists()


def test_what_the_check_warned_of_is_not_repeated_by_the_solve(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The check has its line; the solve finds the height of the mark again."""
    (tmp_path / "high.toml").write_text(
        '[shot]\nschema = 1\nname = "high"\n[world]\nterrain = "flat"\n[[vehicle]]\nname = "car"\nasset = "car"\n'
        '[vehicle.motion]\nmethod = "plan"\ncharacter = "stunt"\n[[vehicle.motion.mark]]\nframe = 1001\n'
        "position = [0, 0, 3]\nheading = 0\n[[vehicle.motion.mark]]\nframe = 1081\nposition = [20, 0, 0]\n"
    )
    assert cli.run(["export", str(tmp_path / "high.toml"), "--out", str(tmp_path), "--to", "npz"]) == 0
    assert capsys.readouterr().err.replace("\n", " ").count("stands on the ground") == 1
