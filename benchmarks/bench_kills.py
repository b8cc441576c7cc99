"""Fifty kills in a batch of 200 clips: ``python benchmarks/bench_kills.py [kills] [clips] [seed]``.

A batch is killed (kill -9, itself or one of its workers, at random instants) and resumed until it ends; its folder must
then contain the bytes of an undisturbed batch, and nothing else. Kills are so frequent that all happen before the end.
"""

from __future__ import annotations

import hashlib
import os
import random
import signal
import subprocess
import sys
import tempfile
import time
from contextlib import suppress
from pathlib import Path

from vehsim.runtime.processes import NAME

CLOSE = 0.6
"""Largest time between kills while clips are running, s: about four clips finish in that time."""
SHOT = """
[shot]
schema = 1
name = "drive"
[[vehicle]]
name = "car"
asset = "car"
[vehicle.motion]
method = "simulate"
commands = [{{ frame = 1001, torque = 500 }}]
[sweep]
"vehicle.car.motion.duration" = {{ from = 0.5, to = 4.0, count = {count} }}
"""


def content(folder: Path) -> dict[str, str]:
    files = (path for path in folder.rglob("*") if path.is_file())
    return {path.relative_to(folder).as_posix(): hashlib.sha256(path.read_bytes()).hexdigest() for path in files}


def start(folder: Path, out: str) -> subprocess.Popen[bytes]:
    command = [sys.executable, "-m", "vehsim", "export", str(folder / "drive.toml"), "--out", str(folder / out)]
    options = ["--to", "usd,npz,csv", "--workers", "2", "--resume", "--quiet"]
    return subprocess.Popen([*command, *options], start_new_session=True)


def workers_of(process: subprocess.Popen[bytes]) -> list[int]:
    """The batch's worker processes, without the fork server and multiprocessing's helper."""
    found, above = [], [process.pid]
    while above:
        pid = above.pop()
        with suppress(OSError):
            children = list(map(int, Path(f"/proc/{pid}/task/{pid}/children").read_text().split()))
            above += children
            found += [child for child in children if Path(f"/proc/{child}/comm").read_text().strip() == NAME]
    return found


def main(kills: int = 50, clips: int = 200, seed: int = 1) -> int:
    chance = random.Random(seed)
    with tempfile.TemporaryDirectory(prefix="bench-") as name:
        folder = Path(name)
        (folder / "drive.toml").write_text(SHOT.format(count=clips))
        begin = time.monotonic()
        code = start(folder, "undisturbed").wait()
        print(f"undisturbed: exit code {code}, {time.monotonic() - begin:.0f} s", flush=True)
        whole = single = starts = 0
        while True:
            process, starts = start(folder, "killed"), starts + 1
            while process.poll() is None and whole + single < kills:
                if chance.random() < 0.9:  # most kills happen while clips are running, some while the batch starts
                    while process.poll() is None and not workers_of(process):
                        time.sleep(0.02)
                time.sleep(chance.uniform(0.0, CLOSE))
                workers = workers_of(process)
                if workers and chance.random() < 0.5:
                    os.kill(chance.choice(workers), signal.SIGKILL)
                    single += 1
                elif process.poll() is None:
                    os.killpg(process.pid, signal.SIGKILL)
                    whole += 1
            if process.wait() == 0:  # the batch ended before the kill
                break
        same = content(folder / "undisturbed") == content(folder / "killed")
        spent, took = f"of {kills} kills {whole} of batches and {single} of workers", time.monotonic() - begin
        print(f"{spent}, {starts} starts, {took:.0f} s in all")
        print("byte-identical to the undisturbed batch" if same else "DIFFERENT")
        return 0 if same else 1


if __name__ == "__main__":
    sys.exit(main(*map(int, sys.argv[1:])))
