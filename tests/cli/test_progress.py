"""Without a terminal: a plain line every few seconds, so that a log shows the current work; and pipes that close."""

from __future__ import annotations

import json
import re
import subprocess
import sys
import threading
from pathlib import Path
from typing import Any

import pytest

from tests.shots import driven
from vehsim.batch import screen
from vehsim.cli import arguments as _arguments
from vehsim.cli import commands as cli


@pytest.fixture
def eager(monkeypatch: pytest.MonkeyPatch) -> None:
    """Make every line appear as if seconds had passed since the last one."""
    monkeypatch.setattr(screen, "PAUSE", 0.0)
    monkeypatch.setattr(screen, "CHANGE", 0.01)


def write(folder: Path, name: str = "drive") -> str:
    path = folder / f"{name}.toml"
    path.write_text(driven(name))
    return str(path)


@pytest.mark.usefixtures("eager")
def test_an_export_shows_its_current_work(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.run(["export", write(tmp_path), "--out", str(tmp_path / "out"), "--to", "usd,npz"]) == 0
    output = capsys.readouterr().err
    assert re.search(r"^drive  car: simulate  \d+ s$", output, re.MULTILINE)
    assert re.search(r"^drive  usd: reading back  \d+ s$", output, re.MULTILINE)


@pytest.mark.usefixtures("eager")
def test_a_batch_shows_how_many_are_done(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    shots = [write(tmp_path, "one"), write(tmp_path, "two")]
    assert cli.run(["export", *shots, "--out", str(tmp_path / "out"), "--to", "npz", "--workers", "1"]) == 0
    output = capsys.readouterr().err
    assert re.search(r"^0 of 2 done; one  .*  \d+ s$", output, re.MULTILINE)
    assert re.search(
        r"^1 of 2 done(; two  .*)?  \d+ s$", output, re.MULTILINE
    )  # the second may be done too soon to say


@pytest.mark.usefixtures("eager")
@pytest.mark.parametrize("option", [["--quiet"], ["--log", "json"]])
def test_quiet_and_json_print_no_progress_lines(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], option: list[str]
) -> None:
    assert cli.run(["export", write(tmp_path), "--out", str(tmp_path / "out"), "--to", "npz", *option]) == 0
    out, err = capsys.readouterr()
    assert err == ""
    events = [json.loads(line)["event"] for line in out.splitlines()]
    assert ("progress" in events) is ("json" in option)


@pytest.mark.usefixtures("eager")
def test_no_line_follows_the_end(capsys: pytest.CaptureFixture[str]) -> None:
    begun, free = threading.Event(), threading.Event()

    def line() -> tuple[str, str]:
        begun.set()
        free.wait()
        return "", "late"

    with screen.ticking(line):
        begun.wait()
        threading.Timer(0.2, free.set).start()  # the end comes first
    assert capsys.readouterr().err.startswith("late")  # and is waited for


@pytest.mark.usefixtures("eager")
def test_pictures_are_counted(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.run(["export", write(tmp_path), "--out", str(tmp_path), "--quiet"]) == 0
    render = ["render", str(tmp_path / "drive" / "drive.usda"), "--size", "64x36", "--frames", "1001-1002"]
    assert cli.run([*render, "--out", str(tmp_path / "more")]) == 0
    assert re.search(r"^frames: chase 1002  50%  \d+ s$", capsys.readouterr().err, re.MULTILINE)
    assert cli.run([*render, "--out", str(tmp_path / "quiet"), "--quiet"]) == 0
    assert capsys.readouterr().err == ""


@pytest.mark.usefixtures("eager")
def test_other_commands_show_their_progress(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """A thread prints it, because the functions that they call report no progress."""
    load = _arguments.load_all

    def slow(*given: Any) -> Any:
        for _ in range(1000):
            if output := capsys.readouterr().err:
                break
            threading.Event().wait(0.01)
        assert re.fullmatch(r"(checking  \d+ s\n)+", output)
        return load(*given)

    monkeypatch.setattr(_arguments, "load_all", slow)
    assert cli.run(["check", write(tmp_path)]) == 0


def test_short_work_prints_no_progress(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    for pause in ("PAUSE", "CHANGE"):  # also on a busy machine
        monkeypatch.setattr(screen, pause, 600.0)
    assert cli.run(["check", write(tmp_path)]) == 0
    assert capsys.readouterr().err == ""


@pytest.mark.parametrize("command", [["vehicles"], ["terrains"], ["schema"], ["--help"], ["check"]])
def test_no_traceback_if_the_output_reader_exits(tmp_path: Path, command: list[str]) -> None:
    """As in ``vehsim vehicles | head -1``: the pipe is closed before the first line is printed."""
    shots = [write(tmp_path)] * (command == ["check"])
    words = [sys.executable, "-u", "-m", "vehsim", *command, *shots]
    process = subprocess.Popen(words, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    assert process.stdout is not None and process.stderr is not None
    process.stdout.close()
    output = process.stderr.read()
    process.wait()
    process.stderr.close()
    assert "Traceback" not in output and "BrokenPipe" not in output
