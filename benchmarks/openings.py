"""How long `vehsim live` takes to show a solved shot, for every example: CPU time from the start of the process.

``python -m benchmarks.openings`` writes ``RESULTS.openings.md`` beside this file. Each example is solved first, if its
motion is not in the cache yet.
"""

from __future__ import annotations

import asyncio
import json
import os
import re
import signal
import subprocess
import sys
from pathlib import Path

from websockets.asyncio.client import connect

from benchmarks.machine import calibration, headed

EXAMPLES = Path(__file__).parents[1] / "examples"
TARGET = 3.0
"""CPU time asked, s."""
HEAD = """\
# Opening solved shots, measured

CPU time of `vehsim live` from the start of its process until it has sent the scene, with imports; the motion is in the
cache. *Loop*: a million additions in Python at that moment, which shows how fast the machine was. The target is
{target:g} s.

| example | opened, s | scene, MB | loop, ms |
|---|---|---|---|
"""


def spent(pid: int) -> float:
    """CPU time of a process, s."""
    return sum(map(int, Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()[11:13])) / os.sysconf(
        "SC_CLK_TCK"
    )


async def opened(path: Path, solved: bool) -> tuple[float, int]:
    """CPU time, s, and bytes of the scene; with ``solved`` of the first scene, else when the shot is solved."""
    command = [sys.executable, "-m", "vehsim", "live", str(path), "--no-browser", "--port", "0"]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
    assert process.stdout is not None
    try:
        url = next(found[0] for line in process.stdout if (found := re.search(r"http://\S+", line)))
        size = 0
        async with connect(url.replace("http", "ws") + "socket", max_size=None, ping_timeout=None) as socket:
            async for raw in socket:
                text = raw[4 : 4 + int.from_bytes(raw[:4], "little")] if isinstance(raw, bytes) else raw
                told = json.loads(text)
                if told["kind"] == "scene":
                    size = len(raw)
                    if solved:
                        break
                if told["kind"] == "state" and told["solved"]:
                    break
        return spent(process.pid), size
    finally:
        process.send_signal(signal.SIGINT)
        process.wait()


def main() -> None:
    rows = []
    for path in sorted(EXAMPLES.glob("*.toml")):
        asyncio.run(opened(path, solved=False))
        cpu, size = asyncio.run(opened(path, solved=True))
        missed, speed = " (missed)" * (cpu > TARGET), 1e3 * calibration()[0]
        rows.append(f"| {path.stem} | {cpu:.1f}{missed} | {size / 1e6:.1f} | {speed:.0f} |")
        print(rows[-1], flush=True)
    text = headed(HEAD.format(target=TARGET) + "\n".join(rows) + "\n")
    Path(__file__).with_name("RESULTS.openings.md").write_text(text, encoding="utf-8")


if __name__ == "__main__":
    signal.signal(signal.SIGINT, signal.default_int_handler)  # servers inherit it, also from a background job
    main()
