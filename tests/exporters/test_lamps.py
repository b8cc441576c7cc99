"""Lamps light what is in front of them in the dark, and nothing by day; stars are points."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from tests.shots import driven
from vehsim.exporters.pictures.lamps import DARK, Lamp, haloed, lamps_of, lit
from vehsim.exporters.pictures.render import StageRenderer
from vehsim.exporters.pictures.surfaces import Material
from vehsim.exporters.usd.scenery.lighting import MOODS, encode_srgb, latlong_directions, to_srgb, write_sky
from vehsim.exporters.usd.scenery.shading import light_for
from vehsim.exporters.usd.stage import Shape, Sky, StageReader, Sun
from vehsim.shot import Shot

WHITE, RED = (0.9, 0.9, 0.85), (0.4, 0.01, 0.01)
UPRIGHT = np.eye(3)[[0, 2, 1]] * [1, 1, -1]


def plates(*middles, colour=WHITE, facing=(1.0, 0, 0)):
    """Glowing plates of a square decimetre around ``middles``."""
    square = 0.05 * np.array([(0, -1, -1), (0, 1, -1), (0, 1, 1), (0, -1, 1)])
    points = np.concatenate([square + middle for middle in middles])
    faces = np.concatenate([4 * k + np.array([(0, 1, 2), (0, 2, 3)]) for k in range(len(middles))])
    normals = np.array([facing])
    surface = Material(colour=colour, emission=0.2)
    return Shape("lamp", "/car", points, faces, normals, np.zeros_like(faces), None, None, surface)


def night(folder, mood="night"):
    mood = MOODS[mood]
    write_sky(folder / "sky.png", 40.0, mood.elevations[0], mood)
    sky = Sky(np.full(3, mood.dome_intensity), folder / "sky.png", UPRIGHT)
    return light_for(Sun(np.array([0.0, 0, -1]), mood.sun_intensity * np.array(mood.sun_colour)), sky), sky


PAIR = (2.0, 0.7, 0.6), (2.0, -0.7, 0.6)


@pytest.mark.parametrize(
    ("shape", "beam"),
    [
        (plates(*PAIR), True),
        (plates(*PAIR, colour=RED), False),
        (plates(*PAIR, facing=(0.0, 0, 1)), True),
        (plates(*PAIR, facing=(0.0, 0, 0.1)), False),
    ],
)
def test_white_lamps_that_face_one_way_have_a_beam(shape, beam):
    """The mean of the unit normals of a lamp that shines all round is short."""
    lamp = Lamp.of(shape, np.eye(3))
    assert bool(lamp.beam) == beam
    assert lamp.spots[np.argsort(-lamp.spots[:, 1])] == pytest.approx(np.array(PAIR))


def test_beams_are_level_on_a_vehicle_that_stands_on_a_slope():
    """The mean normal of a lens leans back; its beam does not, in the vehicle's frame or any other."""
    leaning = plates(*PAIR, facing=(0.8, 0.0, 0.6))
    assert Lamp.of(leaning, np.eye(3)).ahead == pytest.approx([1, 0, 0])
    y_up = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])
    assert Lamp.of(plates(*PAIR, facing=(0.8, 0.6, 0.0)), y_up).ahead == pytest.approx([1, 0, 0])


def lit_ground(folder, nearest, lamp=None):
    """The brightness of level grey ground, by x from -20 to 40 m, before a wall ``nearest`` m from the lamps."""
    light, _ = night(folder)
    x, y = np.meshgrid(np.arange(-20.0, 40.0, 0.25), np.arange(-3.0, 3.0, 0.25))
    places, picture = np.dstack([x, y, np.zeros_like(x)]), np.full((*x.shape, 3), 40, np.uint8)
    lamp = lamp or Lamp.of(plates(*PAIR), np.eye(3))
    whole = slice(None), slice(None)
    shown = lit(
        picture, places, [lamp], {"/car": np.eye(4)}, light, lambda _: whole, lambda *_: np.full((192, 768), nearest)
    )
    return dict(zip(x[0].tolist(), shown[len(x) // 2].mean(axis=1), strict=True))


def test_a_beam_lights_the_ground_ahead_and_stops_at_a_wall(tmp_path):
    free, walled = lit_ground(tmp_path, np.inf), lit_ground(tmp_path, 6.0)
    assert free[-5.0] == free[-15.0] == 40
    assert free[6.0] > 65 and free[6.0] > free[15.0] > free[25.0] > 40
    assert walled[6.0] == free[6.0] and walled[15.0] == 40


def test_a_tail_lamp_throws_a_pool_of_light_on_the_ground(tmp_path):
    """As large as a car's. It is seen a metre behind the lamp, and gone five metres behind it."""
    lamp = Lamp.of(plates((-2.0, 0.7, 0.7), (-2.0, -0.7, 0.7), colour=RED, facing=(-1.0, 0, 0)), np.eye(3))
    shown = lit_ground(tmp_path, np.inf, replace(lamp, glow=6.5 * lamp.glow))
    assert shown[-3.0] > shown[-4.0] > 40.3
    assert shown[-7.0] == shown[5.0] == 40


def test_a_night_is_dark_but_shows_what_is_seen_from_above(tmp_path):
    """Dark paint (albedo 0.1) in the light from above."""
    bright = {}
    for mood in MOODS:
        light, _ = night(tmp_path, mood)
        above = light.ambient + light.sky - light.sun * light.direction[2]
        bright[mood] = float((to_srgb(np.full(3, 0.1)) * above).mean())
    assert 0.19 < bright["night"] < 0.25 < min(level for mood, level in bright.items() if mood != "night")


def test_lamps_are_lit_at_night_only(tmp_path):
    stage = SimpleNamespace(shapes=[plates(*PAIR)], frames=(1, 2), matrices=lambda _: {"/car": np.eye(4)})
    for mood in MOODS:
        light, _ = night(tmp_path, mood)
        assert bool(lamps_of(stage, light)) == (light.level < DARK) == (mood == "night")


def test_a_halo_shows_a_lamp_that_is_seen():
    """It is round, as bright as white in its middle, and nothing where something hides the lamp."""
    picture = np.zeros((90, 160, 3), np.uint8)
    sight = (np.zeros(3), np.array([1.0, 0, 0]), np.array([0, 0, 1.0])), (0.5, 0.5 * 90 / 160), (0.0, 0.0), (0.1, 100.0)
    lamp = Lamp.of(plates((10.0, 0, 0), facing=(-1.0, 0, 0)), np.eye(3))
    for depth, seen in ((50.0, True), (5.0, False)):
        shown = haloed(picture, np.full((90, 160), depth), [lamp], {"/car": np.eye(4)}, sight)
        assert bool(shown.any()) == seen
    bright = haloed(picture, np.full((90, 160), 50.0), [lamp], {"/car": np.eye(4)}, sight).mean(axis=2)
    assert bright[44:46, 79:81].min() > 200 and (bright == bright[::-1, ::-1]).all()


def test_stars_are_points_where_the_sky_has_them(tmp_path):
    light, _ = night(tmp_path)
    assert len(light.stars.directions) > 1000
    assert np.linalg.norm(light.stars.directions, axis=1) == pytest.approx(1.0)
    from PIL import Image

    dark = np.full((64, 128, 3), 0.01)
    dark[20, 40] = 0.2
    Image.fromarray(encode_srgb(dark)).save(tmp_path / "one.png")
    found = light_for(Sun(np.array([0.0, 0, -1]), np.full(3, 0.05)), Sky(np.ones(3), tmp_path / "one.png", UPRIGHT))
    (star,) = found.stars.directions
    assert star == pytest.approx(latlong_directions(128, 64)[20, 40])
    assert np.ptp(found.image) < 0.001 and np.ptp(found.skybox) <= 1


@pytest.mark.parametrize("mood", ["noon", "night"])
def test_a_picture_does_not_depend_on_what_was_drawn_before(tmp_path, mood):
    """A lamp's beam has a view of its own."""
    (tmp_path / "drive.toml").write_text(driven() + f'[camera]\nrig = "chase"\n[render]\nmood = "{mood}"\n')
    stage = StageReader(Shot.load(tmp_path / "drive.toml").solve().export(tmp_path, to=("usd",)) / "drive.usda")
    with StageRenderer(stage, (320, 180)) as renderer:
        assert bool(renderer._lamps) == (mood == "night")
        alone, *_, after = (renderer.render("chase", frame) for frame in (1007, 1001, 1004, 1007))
    assert (after == alone).all()
