"""Shots without a terrain: ground below wheels, shadows wherever something casts them, and clear distant obstacles."""

from __future__ import annotations

from fractions import Fraction

import numpy as np
import pytest

import vehsim
from vehsim import State, Take, World
from vehsim.cameras.camera import CameraRig
from vehsim.cameras.framing import solve_camera
from vehsim.delivery.take import RenderSettings
from vehsim.exporters.pictures.render import HAZE, StageRenderer, haze_end
from vehsim.exporters.usd.stage import StageReader
from vehsim.world.obstacles.obstacles import box

FRAMES, SIZE = (1001, 1003), (320, 180)


def stage_of(folder, vehicle, place=(0.0, 0.0, 0.0), **world):
    start = State(position=place)
    vehicle = vehsim.load_vehicle(vehicle) if isinstance(vehicle, str) else vehicle
    clip = vehsim.simulate(vehicle, World(**world), start=start, duration=0.1)
    camera = solve_camera(CameraRig(), {"it": clip}, World(**world), FRAMES, SIZE[0] / SIZE[1])
    settings = RenderSettings(size=SIZE, mood="noon")
    take = Take("shot", {"it": clip}, World(**world), (camera,), Fraction(24), FRAMES, settings)
    return StageReader(take.export(folder) / "shot.usda")


@pytest.mark.parametrize("place", [(0.0, 0.0, 0.0), (5021.0, -733.0, 0.0)])
@pytest.mark.parametrize("vehicle", ["car", "rally_car", "snakeboard"])
def test_level_ground_is_shown_below_what_rolls(vehicle, place, tmp_path):
    """The picture's ground is a surface of the stage around the vehicle, at the height of its wheels."""
    stage = stage_of(tmp_path, vehicle, place)
    points = np.concatenate([shape.points for shape in stage.shapes if "/env/ground" in shape.name])
    assert not points[:, 2].any()
    assert (points[:, :2].min(axis=0) < np.array(place)[:2] - HAZE[1]).all()
    assert (points[:, :2].max(axis=0) > np.array(place)[:2] + HAZE[1]).all()


@pytest.mark.parametrize(("vehicle", "world"), [("helicopter", {}), ("boat", {}), ("boat", {"water": 0.0})])
def test_what_flies_or_floats_has_no_ground(vehicle, world, tmp_path):
    stage = stage_of(tmp_path, vehicle, (0.0, 0.0, 9.0) if vehicle == "helicopter" else (0.0, 0.0, 0.0), **world)
    assert not [shape.name for shape in stage.shapes if "/env/ground" in shape.name]


@pytest.mark.parametrize(
    ("bottom", "height", "world", "shown"),
    [
        (0.0, 20.0, {}, True),
        (0.05, 20.0, {}, True),  # it stands on the ground as well as somebody placed it
        (12.0, 20.0, {}, False),  # it hangs in the air
        (0.0, -5.0, {}, False),  # the flight passes below z = 0
        (0.0, 20.0, {"water": 0.0}, False),
    ],
)
def test_obstacles_that_a_flight_passes_stand_on_ground(bottom, height, world, shown, tmp_path):
    """Towers on z = 0 hung in a void."""
    tower = box("tower", (9.0, 9.0, bottom), (4.0, 4.0, 15.0))
    stage = stage_of(tmp_path, "helicopter", (0.0, 0.0, height), obstacles=[tower], **world)
    assert any("/env/ground" in shape.name for shape in stage.shapes) == shown


def test_a_boat_among_pontoons_has_no_ground(tmp_path):
    pontoon = box("pontoon", (9.0, 9.0, 0.0), (4.0, 4.0, 1.0))
    boat = vehsim.load_vehicle("boat").planar
    shapes = stage_of(tmp_path, boat, obstacles=[pontoon]).shapes
    assert not any("/env/ground" in shape.name for shape in shapes)


def test_a_terrain_replaces_the_level_ground(tmp_path):
    names = [shape.name for shape in stage_of(tmp_path, "car", terrain="flat").shapes]
    assert any("/env/terrain" in name for name in names) and not any("/env/ground" in name for name in names)


def test_obstacles_are_no_ground_whose_edge_haze_hides(tmp_path):
    """Haze ended at 60 m in a city of 100 m, so that towers had no windows."""
    obstacles = [box(f"tower{k}", (90.0 * k, 0.0, 0.0), (10.0, 10.0, 40.0)) for k in (0, 1)]
    assert haze_end(stage_of(tmp_path, "helicopter", (45.0, -20.0, 20.0), obstacles=obstacles)) == HAZE[1]


@pytest.mark.parametrize("side", [(1, 1), (1, -1), (-1, 1), (-1, -1)])
def test_a_vehicle_casts_a_shadow_at_the_corner_of_a_scene(side, tmp_path):
    """The shadow map is a square that turns with the light; in a wide scene it covers a part, which must be chosen in
    its own axes. Chosen in others, a helicopter on the roof of the last tower of a city had no shadow."""
    towers = [
        box(f"t{k}", (*(180.0 * np.array(side) * share), 0.0), (8.0, 8.0, 30.0)) for k, share in enumerate((0.5, 1))
    ]
    stage = stage_of(tmp_path, "car", obstacles=towers)
    bright = {}
    for shadows in (True, False):
        with StageRenderer(stage, SIZE, shadows, samples=1) as renderer:
            bright[shadows] = renderer.render("chase", 1002).astype(float).mean(axis=2)
    darker = bright[True] < 0.9 * bright[False]
    assert darker[SIZE[1] // 3 :].sum() > 300
