"""Grain on the ground near the camera stays in place, has no effect on the mean, and is only where it can be seen."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from vehsim.exporters.pictures.grain import FADES, STRONGEST, _looked_up, grained, strengths_of
from vehsim.exporters.pictures.surfaces import Material
from vehsim.exporters.usd.stage import Shape

SIZE = (64, 48)


def from_above(eye, height, pixel=0.002):
    """Grey ground as seen by a camera ``height`` m above ``eye`` (2,) that looks straight down; ``pixel`` at distance
    1."""
    w, h = SIZE
    x = pixel * (np.arange(w) - w / 2)[:, None] * (1.0, 0.0, 0.0)
    y = pixel * (np.arange(h) - h / 2)[:, None] * (0.0, 1.0, 0.0)
    grey, strength = np.full((h, w, 3), 128, np.uint8), np.full((h, w), 0.1, np.float32)
    rays = (np.array([0.0, 0.0, -1.0]), x, y)
    return grained(grey, strength, np.full((h, w), float(height)), rays, np.array([*eye, height])).astype(float)


@pytest.mark.parametrize("steps", [(5, 0), (0, 9), (-11, 7)])
def test_grain_stays_in_place_while_the_camera_moves(steps):
    height, pixel = 4.0, 0.002
    one = from_above((100.0003, -50.0003), height)
    other = from_above((100.0003 + steps[0] * pixel * height, -50.0003 + steps[1] * pixel * height), height)
    right, up = steps
    h, w = one.shape[:2]
    before = one[max(up, 0) : h + min(up, 0), max(right, 0) : w + min(right, 0)]
    after = other[max(-up, 0) : h + min(-up, 0), max(-right, 0) : w + min(-right, 0)]
    assert np.mean(np.abs(before - after) > 1) < 0.02  # single texels at the edge of two
    assert one.std() > 5


def test_grain_keeps_the_mean_and_averages_out_where_pixels_are_wide():
    rng = np.random.default_rng(0)
    u, v = rng.uniform(-3, 3, (2, 200_000)).astype(np.float32)
    spread = []
    for texels in (1, 4, 32, 256):
        grain = _looked_up(u, v, np.full(u.shape, texels, np.float32))
        assert abs(grain.mean()) < 0.01
        spread.append(grain.std())
    assert spread[0] == pytest.approx(1.0, abs=0.02)
    assert all(a > b for a, b in pairwise(spread))
    assert spread[-1] < 0.02


def test_grain_repeats_without_a_seam():
    u = np.linspace(0.9, 1.1, 4001, dtype=np.float32)
    grain = _looked_up(u, np.full_like(u, 0.3), np.ones_like(u))
    steps = np.abs(np.diff(grain))
    assert steps[1990:2010].max() <= steps.max()
    assert np.allclose(_looked_up(u, u, np.ones_like(u)), _looked_up(u + 1, u - 2, np.ones_like(u)), atol=1.5)


def test_distant_ground_and_the_sky_are_as_they_were():
    grey = np.full((8, 8, 3), 90, np.uint8)
    rays = (np.array([0.0, 0.0, -1.0]), np.zeros((8, 3)), np.zeros((8, 3)))
    strength = np.full((8, 8), 0.1, np.float32)
    for distance in (FADES[1] + 1.0, np.inf):
        assert np.array_equal(grained(grey, strength, np.full((8, 8), distance), rays, np.zeros(3)), grey)
    assert np.array_equal(grained(grey, 0 * strength, np.full((8, 8), 5.0), rays, np.zeros(3)), grey)


@pytest.fixture
def texture(tmp_path):
    """A function that writes a texture of noise with a given contrast."""
    from PIL import Image

    def texture(contrast):
        noise = np.random.default_rng(1).uniform(-1, 1, (64, 64))
        path = tmp_path / f"ground{contrast}.png"
        Image.fromarray(np.uint8(128 * (1 + contrast * np.kron(noise, np.ones((4, 4)))))).save(path)
        return path

    return texture


def test_only_wide_standing_textured_ground_has_grain_as_strong_as_its_texture(texture):
    points = np.array([[0.0, 0, 0], [100, 0, 0], [0, 100, 0]])
    plain = Material(colour=(0.5, 0.5, 0.5), opacity=1.0, roughness=1.0, metallic=0.0)
    ground = Shape("/ground", "", points, np.array([[0, 1, 2]]), points, np.array([[0, 1, 2]]), None, None, plain)
    faint, strong, rough = (
        replace(ground, surface=replace(plain, texture=texture(contrast))) for contrast in (0.03, 0.06, 0.9)
    )
    assert strengths_of([ground, replace(strong, group="/car"), replace(strong, points=points / 10)]) == [0, 0, 0]
    assert strengths_of([replace(strong, name="/shot/env/obstacles/house/house")]) == [0]  # its wall looked woven
    a, b, c = strengths_of([faint, strong, rough])
    assert a > 0
    assert 1.5 < b / a < 2.7
    assert c == STRONGEST
