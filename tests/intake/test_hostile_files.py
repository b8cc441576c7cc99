"""A sample of the hostile files of `tools/hostile_files`; `make hostile-files` runs 20,000."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from tools.hostile_files.__main__ import main, read
from tools.hostile_files.cases import KINDS, make_case

pytestmark = pytest.mark.broken_stages


def test_no_hostile_file_does_harm(tmp_path: Path) -> None:
    assert main(["--seeds", "0-39", "--out", str(tmp_path)]) == 0
    results = read(tmp_path / "results.jsonl")
    assert [result["seed"] for result in results] == list(range(40))
    assert {result["exit"] for result in results} == {0, 1, 2}
    assert main(["--seeds", "0-39", "--out", str(tmp_path)]) == 0
    assert len(read(tmp_path / "results.jsonl")) == 40  # finished seeds are not run again


def test_harm_is_found(tmp_path: Path) -> None:
    """A tool that finds nothing may look at nothing: it is given a command that does everything wrong."""
    program = (
        "import os, sys; from pathlib import Path; from vehsim.cli import commands\n"
        "def wrong(arguments):\n"
        "    Path('../escaped').write_text(''); print('Traceback'); return 3\n"
        "commands.run = wrong\n"
        "from tools.hostile_files.runner import run_case; from tools.hostile_files.cases import make_case\n"
        f"case = make_case(1, Path({str(tmp_path)!r}) / 'a' / 'b' / 'case'); case.good = True\n"
        "found = run_case(case, case.folder.parent)['findings']\n"
        "print(len(found), *found)"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert done.stdout.startswith("4 ")
    for finding in ("Traceback", "exit code 3", "files outside --out: ", "the good shot is not delivered"):
        assert finding in done.stdout


def test_the_same_seed_gives_the_same_files(tmp_path: Path) -> None:
    words = set()
    for seed in range(60):
        one, other = (make_case(seed, tmp_path / name / str(seed)) for name in "ab")
        words.add(one.words[0])
        assert one.command == other.command and one.words == other.words
        for path in (tmp_path / "a" / str(seed)).rglob("*"):
            if path.is_file() and not path.is_symlink():
                same = tmp_path / "b" / path.relative_to(tmp_path / "a")
                assert path.read_bytes() == same.read_bytes() or path.suffix in (".npz", ".usdz", ".json")
    assert len(words) > len(KINDS) / 2
