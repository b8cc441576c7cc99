"""Waves behind moles: against Sommerfeld's exact solution, and what follows from it for the sea and for a hull."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.special import fresnel

from vehsim.errors import InputError
from vehsim.world.water.sea import sea_state, together
from vehsim.world.water.shelter import Shelter
from vehsim.world.water.water import Water, wave

LENGTH = 20.0
NUMBER = 2 * np.pi / LENGTH
ENDLESS = np.array([[0.0, 0.0], [0.0, 1e5]])
RING = 60.0 * np.array([[np.cos(a), np.sin(a)] for a in np.radians(np.linspace(20, 340, 41))])
"""Open towards positive X."""


def shelter(*lines, heading=0.0):
    return Shelter(lines, np.array([1.0]), np.array([[NUMBER * np.cos(heading), NUMBER * np.sin(heading)]]))


def sommerfeld(radius, angle):
    """Height behind half a rigid breakwater along the angle 0, of waves of height 1 that meet it square (Penney and
    Price 1952, eq. 12)."""

    def part(s):
        sine, cosine = fresnel(s)
        return (1 + 1j) / 2 * ((cosine + 0.5) - 1j * (sine + 0.5))

    size = 2 * np.sqrt(NUMBER * radius / np.pi)
    total = 0.0
    for sign, turned in ((1, angle - np.pi / 2), (-1, angle + np.pi / 2)):
        total += part(sign * size * np.sin(turned / 2)) * np.exp(-1j * NUMBER * radius * np.cos(turned))
    return abs(total)


@pytest.mark.parametrize("radius", [2 * LENGTH, 5 * LENGTH, 10 * LENGTH])
@pytest.mark.parametrize("degrees", [15, 30, 45, 60, 75, 90, 105])
def test_half_a_breakwater_shelters_as_sommerfeld_says(radius, degrees):
    """Within 0.11 at two lengths; Kirchhoff's integral leaves out what the wall itself reflects."""
    angle = np.radians(degrees)
    place = radius * np.array([[np.sin(angle), np.cos(angle)]])
    found = shelter(ENDLESS).of(np.array([NUMBER, 0.0]), place)[0]
    assert abs(found - min(sommerfeld(radius, angle), 1.0)) < 0.11 * np.sqrt(2 * LENGTH / radius)


def test_at_the_edge_of_the_shadow_half_is_left():
    places = np.array([[50.0, 0.0], [500.0, 0.0]])
    np.testing.assert_allclose(shelter(ENDLESS).of(np.array([NUMBER, 0.0]), places), 0.5, atol=1e-3)


def test_a_turned_mole_shelters_alike_and_before_it_nothing_changes():
    turn = 0.8
    turned = np.array([[np.cos(turn), np.sin(turn)], [-np.sin(turn), np.cos(turn)]])
    places = np.random.default_rng(3).uniform(-200, 200, (200, 2))
    one = shelter(ENDLESS).of(np.array([NUMBER, 0.0]), places)
    other = shelter(ENDLESS @ turned).of(np.array([NUMBER, 0.0]) @ turned, places @ turned)
    np.testing.assert_allclose(one, other, atol=1e-9)
    np.testing.assert_array_equal(one[places[:, 0] <= 0], 1.0)


def test_points_along_a_straight_mole_change_nothing():
    mole = np.array([[0.0, -40.0], [0.0, 40.0]])
    split = np.array([[0.0, y] for y in np.linspace(-40, 40, 9)])
    places = np.random.default_rng(3).uniform(-200, 200, (200, 2))
    number = NUMBER * np.array([np.cos(0.3), np.sin(0.3)])
    np.testing.assert_allclose(shelter(mole).of(number, places), shelter(split).of(number, places), atol=1e-9)


def test_a_ring_is_entered_by_its_gap_only():
    inside = np.array([[0.0, 0.0], [-40.0, 0.0], [0.0, 45.0]])
    through = shelter(RING).of(np.array([-NUMBER, 0.0]), inside)
    assert through[0] > 0.6 and through[2] < 0.25
    behind = shelter(RING).of(np.array([NUMBER, 0.0]), np.concatenate([inside, [[200.0, 0.0]]]))
    assert behind.max() < 0.35


def sheltered(choppiness=0.7):
    sea = sea_state(1.0, 5.0, 3, heading=np.pi)
    return together(sea, wave(0.5, LENGTH, np.pi), choppiness=choppiness, moles=[RING])


def test_grid_and_points_and_slopes_agree():
    water = Water(surface=sheltered())
    x, y = np.linspace(-55, 30, 30), np.linspace(-50, 50, 40)
    heights, _ = water.grid(x, y, 3.0)
    xy = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
    np.testing.assert_allclose(heights.ravel(), water.height(xy, 3.0), atol=1e-4)
    points = np.column_stack([xy, np.full(len(xy), np.inf)])
    np.testing.assert_allclose(water.at(points, 3.0).height, water.height(xy, 3.0), atol=1e-12)
    ahead, behind = (water.height(xy + np.array([d, 0.0]), 3.0) for d in (1e-4, -1e-4))
    normal, clear = water.normal(xy, 3.0), np.hypot(*xy.T) < 45
    np.testing.assert_allclose((-normal[:, 0] / normal[:, 2])[clear], ((ahead - behind) / 2e-4)[clear], atol=0.06)


def test_the_sea_inside_is_as_high_as_the_shelter_says():
    """Root mean square over time of the height at places, over that without the mole."""
    xy = np.array([[-20.0, 0.0], [0.0, 45.0], [-30.0, -35.0]])
    calm, rough = (
        sheltered(0.0),
        together(sea_state(1.0, 5.0, 3, heading=np.pi), wave(0.5, LENGTH, np.pi), choppiness=0),
    )
    times = np.arange(0, 200, 0.25)
    inside, outside = (np.std([each.heights(xy, t) for t in times], axis=0) for each in (calm, rough))
    np.testing.assert_allclose(inside / outside, calm.share(xy)[:, 0], rtol=1e-9)
    assert calm.share(xy)[0, 0] > 2 * calm.share(xy)[1, 0]


def test_a_mole_is_part_of_the_waters_hash_and_must_be_a_line():
    assert sheltered().content_hash != together(sea_state(1.0, 5.0, 3, heading=np.pi), choppiness=0.7).content_hash
    for line in (np.zeros((1, 2)), np.zeros((2, 2)), np.array([[0.0, np.nan], [1.0, 0.0]])):
        with pytest.raises(InputError):
            shelter(line)
