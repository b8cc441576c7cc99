"""What a measurement was made on: date, commit, processor, load, and the machine's own speed by a fixed loop.

Divide times by the speeds to compare two machines, or two days.
"""

from __future__ import annotations

import os
import platform
import subprocess
import time
from collections.abc import Callable
from datetime import UTC, datetime
from pathlib import Path

import numpy as np

ROOT = Path(__file__).resolve().parents[1]


def headed(text: str) -> str:
    """A page of results with `heading` below its title."""
    title, _, rest = text.partition("\n\n")
    return "\n".join([title, "", *heading(), rest])


def heading() -> list[str]:
    """Lines of Markdown that describe the machine now."""
    python, floats = calibration()
    return [
        f"Measured {datetime.now(UTC):%Y-%m-%d %H:%M} UTC at commit {_commit()} on {_processor()}, {os.cpu_count()}",
        f"cores, load {os.getloadavg()[0]:.1f}, Python {platform.python_version()}. The machine's own speed in",
        f"CPU time: a loop of a million additions in Python {python * 1e3:.1f} ms, a product of matrices (400, 400) "
        f"{floats * 1e3:.2f} ms.",
        "",
    ]


def calibration() -> tuple[float, float]:
    """CPU seconds of the two fixed loops, the best of five: a million additions in Python; a product of matrices."""
    matrix = np.random.default_rng(0).normal(size=(400, 400))
    return _best(_additions), _best(lambda: matrix @ matrix)


def _additions() -> int:
    total = 0
    for k in range(1_000_000):
        total += k
    return total


def _best(work: Callable[[], object]) -> float:
    times = []
    for _ in range(5):
        begin = time.process_time()
        work()
        times.append(time.process_time() - begin)
    return min(times)


def _commit() -> str:
    """The short hash, with a star if files differ from it; "unknown" outside a repository."""
    try:
        short = _git("rev-parse", "--short", "HEAD")
        return short + ("*" if _git("status", "--porcelain", "--untracked-files=no") else "")
    except (OSError, subprocess.CalledProcessError):
        return "unknown"


def _git(*words: str) -> str:
    return subprocess.run(["git", "-C", str(ROOT), *words], capture_output=True, text=True, check=True).stdout.strip()


def _processor() -> str:
    info = Path("/proc/cpuinfo")
    lines = info.read_text(encoding="utf-8").splitlines() if info.is_file() else []
    names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.processor() or platform.machine()
