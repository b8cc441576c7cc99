"""The look of terrain without one: coloured by slope, and painted once per terrain."""

from __future__ import annotations

from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest

import vehsim
from vehsim import Take, World
from vehsim.exporters.usd.scenery import ground
from vehsim.exporters.usd.scenery.driven import GROUNDS, Ground
from vehsim.exporters.usd.stage import Shape, StageReader
from vehsim.vehicles.definition.surfaces import SurfaceName
from vehsim.world.terrain.terrain import Terrain


@pytest.fixture
def painted(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> list[float]:
    """The steepness of each terrain whose colours are computed, in an empty cache."""
    monkeypatch.setenv("VEHSIM_CACHE", str(tmp_path / "cache"))
    calls = []
    colours = ground._relief_colours

    def counted(terrain: Terrain, look: Ground) -> np.ndarray:
        calls.append(float(np.ptp(terrain.heights)))
        return colours(terrain, look)

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


@pytest.mark.parametrize("surface", [*GROUNDS])
def test_level_ground_has_no_seams(surface: SurfaceName) -> None:
    """Texels across the picture's edge differ as much as those beside each other."""
    colours = GROUNDS[surface].paint()
    assert colours.min() >= 0 and colours.max() <= 1
    light = colours.mean(axis=2) / colours.mean()
    for axis in (0, 1):
        steps = np.abs(light - np.roll(light, 1, axis)).mean(axis=1 - axis)
        assert steps[0] < 1.5 * np.median(steps)


def test_gravel_has_stones() -> None:
    """It is loose stones, not a smooth road: texels differ from those beside them."""
    colours = GROUNDS["gravel"].paint()
    light = colours.mean(axis=2) / colours.mean()
    assert 0.08 < np.std(light - (np.roll(light, 3, 0) + np.roll(light, -3, 0)) / 2) < 0.3


def ground_of(folder: Path, surface: str, terrain: str | None, vehicle: str = "rally_car") -> list[Shape]:
    """The ground in the stage of a shot with a car on a ``surface``."""
    world, parameters = World(terrain), {"surface": surface} if vehicle == "rally_car" else None
    clip = vehsim.simulate(vehsim.load_vehicle(vehicle, parameters), world, duration=0.05)
    take = Take("shot", {"it": clip}, world, (), Fraction(24), (1001, 1002))
    shapes = StageReader(take.export(folder) / "shot.usda").shapes
    found = [shape for shape in shapes if "/env/ground" in shape.name or "/env/terrain" in shape.name]
    assert found
    return found


@pytest.mark.parametrize("terrain", [None, "flat"])
@pytest.mark.parametrize(
    ("surface", "shown"),
    [("asphalt", "flat_ground.jpg"), *((name, f"{name.replace(' ', '_')}.png") for name in GROUNDS)],
)
def test_level_ground_shows_what_vehicles_drive_on(
    surface: str, shown: str, terrain: str | None, tmp_path: Path
) -> None:
    """On gravel, snow and ice, a car drove over slabs of concrete."""
    for shape in ground_of(tmp_path, surface, terrain):
        assert shape.surface.texture is not None and shape.surface.texture.name == shown


def test_a_look_that_does_not_say_what_it_shows_is_kept(tmp_path: Path) -> None:
    textures = [
        {shape.surface.texture and shape.surface.texture.name for shape in ground_of(tmp_path / s, s, "hills")}
        for s in ("asphalt", "snow")
    ]
    assert textures[0] == textures[1]


def test_surfaces_are_told_apart() -> None:
    """Snow is brighter than ice, ice than gravel, gravel than wet asphalt; ice is the bluest."""
    means = {surface: look.paint().mean(axis=(0, 1)) for surface, look in GROUNDS.items()}
    bright = sorted(means, key=lambda surface: -float(means[surface].mean()))
    assert bright == ["snow", "ice", "gravel", "wet asphalt"]
    assert max(means, key=lambda surface: means[surface][2] / means[surface][0]) == "ice"


def test_snow_lies_on_relief_but_not_on_its_rock(tmp_path: Path) -> None:
    from PIL import Image

    shown = {}
    for surface in (None, "snow"):
        _, files = ground.write_ground(ramp(1.5), tmp_path / str(surface), surface)
        shown[surface] = np.asarray(Image.open(files[1]), float).mean(axis=2)
    middle = shown[None].shape[1] // 2
    brighter = shown["snow"] - shown[None]
    assert brighter[:, : middle - 20].mean() > 50 and abs(brighter[:, middle + 20 :].mean()) < 15
