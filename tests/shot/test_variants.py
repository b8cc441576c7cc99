"""Variants of an asset, chosen in the shot file and visible in the stage."""

from __future__ import annotations

import textwrap

import pytest
from pxr import Usd, UsdValidation

from vehsim import Shot

SHOT = """
[shot]
schema = 1
name = "parked"
[[vehicle]]
name = "robot"
asset = "two_wheeled"
variants = {variants}
[vehicle.motion]
method = "simulate"
duration = 0.1
"""


def shot(tmp_path, variants: str) -> Shot:
    path = tmp_path / "parked.toml"
    path.write_text(textwrap.dedent(SHOT).replace("{variants}", variants))
    return Shot.load(path)


@pytest.mark.parametrize(("variants", "livery"), [("{}", "orange"), ('{ livery = "teal" }', "teal")])
def test_chosen_livery_is_what_the_stage_shows(tmp_path, variants, livery):
    folder = shot(tmp_path, variants).solve().export(tmp_path / "out")
    stage = Usd.Stage.Open(str(folder / "parked.usda"))
    robot = stage.GetPrimAtPath("/parked/vehicles/robot")
    assert robot.GetVariantSet("livery").GetVariantSelection() == livery
    colour = stage.GetPrimAtPath(f"{robot.GetPath()}/materials/shell/surface").GetAttribute("inputs:diffuseColor").Get()
    assert tuple(colour) == pytest.approx({"orange": (0.78, 0.79, 0.80), "teal": (0.012, 0.19, 0.20)}[livery])
    validators = UsdValidation.ValidationRegistry().GetOrLoadAllValidators()
    assert not UsdValidation.ValidationContext(validators).Validate(stage)


@pytest.mark.parametrize("world", ["", "[world.water]\nlevel = 0\n"])
def test_a_boat_shows_its_livery_in_the_plane_and_in_water(tmp_path, world):
    path = tmp_path / "parked.toml"
    path.write_text(SHOT.replace("two_wheeled", "boat").replace("{variants}", '{ livery = "red" }') + world)
    folder = Shot.load(path).solve().export(tmp_path / "out")
    stage = Usd.Stage.Open(str(folder / "parked.usda"))
    assert stage.GetPrimAtPath("/parked/vehicles/robot").GetVariantSet("livery").GetVariantSelection() == "red"


@pytest.mark.parametrize(
    ("variants", "key", "remedy"),
    [
        ('{ livery = "orage" }', "vehicle[0].variants.livery", "did you mean 'orange'?"),
        ('{ coat = "red" }', "vehicle[0].variants.coat", "choose one of livery"),
    ],
)
def test_unknown_variants_are_named_with_a_remedy(tmp_path, variants, key, remedy):
    (problem,) = (p for p in shot(tmp_path, variants).check() if p.severity == "error")
    assert (problem.key, problem.remedy) == (key, remedy)
    assert problem.line
