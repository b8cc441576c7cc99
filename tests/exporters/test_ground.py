"""The look of terrain without one: coloured by slope, and painted once per terrain."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from vehsim.exporters.usd.scenery import ground
from vehsim.world.terrain.terrain import Terrain


@pytest.fixture
def painted(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> list[float]:
    """The steepness of each terrain whose colours are computed, in an empty cache."""
    monkeypatch.setenv("VEHSIM_CACHE", str(tmp_path / "cache"))
    calls = []
    colours = ground._relief_colours

    def counted(terrain: Terrain) -> np.ndarray:
        calls.append(float(np.ptp(terrain.heights)))
        return colours(terrain)

    monkeypatch.setattr(ground, "_relief_colours", counted)
    return calls


def ramp(rise: float) -> Terrain:
    """Ground that is level for X < 0 and rises by ``rise`` m per m for X > 0."""
    x = np.linspace(-10, 10, 41)
    return Terrain("ramp", np.tile(np.maximum(rise * x, 0.0), (41, 1)), origin=(-10.0, -10.0), cell=(0.5, 0.5))


def picture(terrain: Terrain, folder: Path) -> np.ndarray:
    from PIL import Image

    asset, files = ground.write_ground(terrain, folder)
    assert all(file.is_file() for file in (asset, *files))
    return np.asarray(Image.open(files[1]), float)


def test_colours_are_those_of_the_terrain_and_painted_once(painted: list[float], tmp_path: Path) -> None:
    steep, flat = (picture(ramp(rise), tmp_path / f"{rise}") for rise in (1.5, 0.01))
    middle = steep.shape[1] // 2
    red, blue = (steep[:, middle + 20 :, k].mean() - steep[:, : middle - 20, k].mean() for k in (0, 2))
    assert red < -10 and blue < 0, "rock is darker than sand"
    assert abs(np.diff([half.mean() for half in np.split(flat, 2, axis=1)])[0]) < 8
    again = picture(ramp(1.5), tmp_path / "again")
    np.testing.assert_array_equal(again, steep)
    assert painted == [15.0, 0.1]


def test_level_ground_has_stones_and_no_seams() -> None:
    """It is loose stones, not a smooth road: texels differ from those beside them, also across the picture's edge."""
    colours = ground._level_colours()
    light = colours.mean(axis=2) / colours.mean()
    assert 0.08 < np.std(light - (np.roll(light, 3, 0) + np.roll(light, -3, 0)) / 2) < 0.3
    for axis in (0, 1):
        steps = np.abs(light - np.roll(light, 1, axis)).mean(axis=1 - axis)
        assert steps[0] < 1.5 * np.median(steps)
