"""Runs seeds one after another in one process, and prints a line of JSON for each."""

from __future__ import annotations

import json
import os
import shutil
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from tools.hostile_files.__main__ import SLOW
from tools.hostile_files.cases import Case, make_case

BAD = ("Traceback", "unexpected:", "an error in vehsim", "cannot read files in another process")
"""What no user may read."""


def main(out: Path, seeds: list[int]) -> None:
    lines = os.fdopen(os.dup(1), "w")
    for seed in seeds:
        folder = out / "cases" / str(seed)
        shutil.rmtree(folder, ignore_errors=True)
        case = make_case(seed, folder / "case")
        result = {"seed": seed, "words": case.words, "command": case.command, **run_case(case, folder)}
        if not result["findings"]:
            shutil.rmtree(folder, ignore_errors=True)
        lines.write(json.dumps(result) + "\n")
        lines.flush()


def run_case(case: Case, folder: Path) -> dict[str, Any]:
    """Run a case's command in its folder: exit code, processor time, and what must not have happened."""
    from vehsim.cli import commands

    before, began = listing(folder), processor_seconds()
    os.chdir(case.folder)
    with captured(folder.parent.parent / "said.txt") as output:
        code = commands.run(case.command)
    os.chdir("/")
    seconds, text = processor_seconds() - began, output.read_text(encoding="utf-8", errors="replace")
    findings = [f"{word}: {text[-500:]}" for word in BAD if word in text][:1]
    if code not in (0, 1, 2):
        findings.append(f"exit code {code}")
    if seconds > SLOW:
        findings.append(f"hangs: {seconds:.1f} s")
    if changed := sorted(map(str, {path for path in listing(folder) ^ before if "case/out" not in str(path)})):
        findings.append(f"files outside --out: {', '.join(changed[:3])}")
    if case.good and not any((case.folder / "out" / "good").glob("*")):
        findings.append(f"the good shot is not delivered: {text[-500:]}")
    if code and not text.strip():
        findings.append(f"says nothing with exit code {code}")
    return {"exit": code, "seconds": round(seconds, 2), "said": text[-300:], "findings": findings}


def listing(folder: Path) -> set[tuple[str, int, int]]:
    """All below a folder with size and date."""
    found = set()
    for path in folder.rglob("*"):
        stat = path.lstat()
        if not path.is_dir() or path.is_symlink():
            found.add((str(path.relative_to(folder)), stat.st_size, stat.st_mtime_ns))
    return found


def processor_seconds() -> float:
    """Processor time of this process, its finished children, and the children that run."""
    total = sum(os.times()[:4])
    for stat in Path("/proc").glob("[0-9]*/stat"):
        with suppress(OSError, ValueError, IndexError):
            fields = stat.read_text().rpartition(")")[2].split()
            if int(fields[1]) == os.getpid():
                total += (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")
    return total


@contextmanager
def captured(file: Path) -> Iterator[Path]:
    """Redirect everything that is printed in this block, also by libraries, to a file."""
    sys.stdout.flush()
    sys.stderr.flush()
    kept = os.dup(1), os.dup(2)
    with file.open("wb") as into:
        os.dup2(into.fileno(), 1)
        os.dup2(into.fileno(), 2)
    try:
        yield file
    finally:
        sys.stdout.flush()
        sys.stderr.flush()
        for number, copy in enumerate(kept, start=1):
            os.dup2(copy, number)
            os.close(copy)


if __name__ == "__main__":
    main(Path(sys.argv[1]), [int(seed) for seed in sys.argv[2:]])
