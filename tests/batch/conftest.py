"""Cheap shots for batches: a car driven for a quarter of a second, as tables, many of them from one sweep."""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from functools import partial
from pathlib import Path

import pytest

from tests.shots import driven
from vehsim.batch import export_batch, load_shots


def write_shot(
    folder: Path, name: str = "drive", sweep: str = "", duration: float = 0.25, asset: str = "car", more: str = ""
) -> Path:
    path = folder / f"{name}.toml"
    table = f"[sweep]\n{sweep}\n" if sweep else ""
    path.write_text(driven(name, asset, duration) + table + more)
    return path


def content_of(folder: Path) -> dict[str, str]:
    return {
        path.relative_to(folder).as_posix(): hashlib.sha256(path.read_bytes()).hexdigest() if path.is_file() else ""
        for path in folder.rglob("*")
    }


@pytest.fixture
def write(tmp_path: Path) -> Callable[..., Path]:
    """Write a shot file: ``write(name, sweep=...)``."""
    return partial(write_shot, tmp_path)


@pytest.fixture
def content() -> Callable[[Path], dict[str, str]]:
    """Everything below a folder: path -> hash, hidden files and folders too."""
    return content_of


@pytest.fixture(scope="session")
def undisturbed(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[str, str]]:
    """A shot file of twelve clips, and the content of its undisturbed batch (usd, npz)."""
    folder = tmp_path_factory.mktemp("undisturbed")
    shot = write_shot(folder, sweep='"vehicle.car.motion.duration" = { from = 0.25, to = 1.0, count = 12 }')
    outcomes = export_batch(load_shots(shot), folder / "out", ["usd", "npz"])
    assert {outcome.state for outcome in outcomes} == {"done"}
    return shot, content_of(folder / "out")
