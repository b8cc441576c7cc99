"""Cheap shots for batches: a car driven for a quarter of a second, as tables, many of them from one sweep."""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from pathlib import Path

import pytest

SHOT = """
[shot]
schema = 1
name = "{name}"
[[vehicle]]
name = "car"
asset = "{asset}"
[vehicle.motion]
method = "simulate"
duration = {duration}
commands = [{{ frame = 1001, torque = 500 }}]
"""


@pytest.fixture
def write(tmp_path: Path) -> Callable[..., Path]:
    """Write a shot file: ``write(name, sweep=...)``."""

    def shot(name: str = "drive", sweep: str = "", duration: float = 0.25, asset: str = "car", more: str = "") -> Path:
        path = tmp_path / f"{name}.toml"
        table = f"[sweep]\n{sweep}\n" if sweep else ""
        path.write_text(SHOT.format(name=name, duration=duration, asset=asset) + table + more)
        return path

    return shot


@pytest.fixture
def content() -> Callable[[Path], dict[str, str]]:
    """Everything below a folder: path -> hash, hidden files and folders too."""

    def read(folder: Path) -> dict[str, str]:
        return {
            path.relative_to(folder).as_posix(): hashlib.sha256(path.read_bytes()).hexdigest() if path.is_file() else ""
            for path in folder.rglob("*")
        }

    return read
