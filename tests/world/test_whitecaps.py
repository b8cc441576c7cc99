"""Whitecaps: their cover against Monahan's formula, the wind of a sea, and the fading of foam."""

import numpy as np
import pytest

from vehsim.world.water.sea import sea_state, together, wind_of
from vehsim.world.water.water import wave
from vehsim.world.water.whitecaps import LIFE, Breaking, Folding, Whitecaps, carried_from

PLACE = np.array([40_000.0, -30_000.0])
"""Far from where breaking is calibrated."""


def square(side=60, spacing=30.0):
    axis = spacing * np.arange(side)
    xy = PLACE + np.stack(np.meshgrid(axis, axis), axis=-1).reshape(-1, 2)
    index = np.arange(side**2).reshape(side, side)
    a, b, c, d = (part.ravel() for part in (index[:-1, :-1], index[:-1, 1:], index[1:, 1:], index[1:, :-1]))
    return xy, np.concatenate([np.column_stack([a, b, c]), np.column_stack([a, c, d])])


@pytest.mark.parametrize("wind", [8.0, 10.0, 12.6, 15.0, 18.0])
@pytest.mark.parametrize("sea", [(2.0, None, 11), (6.0, None, 12), (1.2, 4.5, 13), (4.0, 11.0, 14)])
def test_they_cover_what_monahan_measured(wind, sea):
    height, period, seed = sea
    xy, triangles = square()
    breaking = Breaking(sea_state(height, period, seed), np.array([wind, 0.0]))
    caps = Whitecaps(breaking, xy, triangles, 1 / 8)
    foam = np.stack([caps.at(k) for k in (0, 64, 128)])  # farther apart than they last
    expected = 3.84e-6 * wind**3.41
    assert expected / 1.5 < foam.mean() < 1.5 * expected
    assert expected / 1.6 < (foam > 0.5).mean() < 1.6 * expected


def test_the_wind_of_a_fully_developed_sea_is_pierson_and_moskowitzs():
    """Their U at 10 m for a significant height of 2.5 m is 10.1 m/s. A swell has no wind of its own."""
    assert sea_state(2.5).wind == pytest.approx(10.1, rel=0.02)
    assert wind_of(2.0, 6.0) > 1.5 * wind_of(2.0, 7.2)
    assert wind_of(1.0, 12.0) < 1.0
    assert together(sea_state(2.5), wave(1.0, 150.0), choppiness=0.5).wind == sea_state(2.5).wind


def test_waves_without_wind_and_flat_swell_do_not_break():
    calm = np.zeros(2)
    assert Breaking(wave(1.0, 20.0), calm).least == np.inf
    assert Breaking(wave(0.2, 150.0), np.array([15.0, 0.0])).least == np.inf
    xy, triangles = square(8)
    assert not Whitecaps(Breaking(wave(1.0, 20.0), calm), xy, triangles, 0.1).at(5).any()


def test_folding_is_how_close_the_waters_places_come():
    """One minus the determinant of the gradient of Gerstner's map, by differences."""
    waves = together(sea_state(1.0, seed=3), wave(0.5, 14.0), choppiness=0.0)
    h, t = 1e-4, 3.7
    xy = np.random.default_rng(0).uniform(-50, 50, (40, 2))

    def place(rest):
        theta = rest @ waves.number.T + waves.phase - waves.omega * t
        return rest - np.sin(theta) @ (waves.amplitude[:, None] * waves.along)

    columns = [(place(xy + h * e) - place(xy - h * e)) / (2 * h) for e in np.eye(2)]
    determinant = columns[0][:, 0] * columns[1][:, 1] - columns[0][:, 1] * columns[1][:, 0]
    assert Folding(waves, xy).at(t) == pytest.approx(1 - determinant, abs=2e-5)


@pytest.mark.parametrize("flow", [0.0, np.array([1.5, -0.5])])
def test_foam_is_the_same_whatever_was_asked_before(flow):
    xy, triangles = square(20, 1.0)
    breaking = Breaking(sea_state(2.0, seed=2), np.array([16.0, 0.0]))
    frames = (0, 3, 40, 41, 90)
    one = Whitecaps(breaking, xy, triangles, 1 / 24, flow)
    in_order = {k: one.at(k).copy() for k in range(91)}
    assert max(foam.max() for foam in in_order.values()) > 0.5
    for k in frames:
        assert (Whitecaps(breaking, xy, triangles, 1 / 24, flow).at(k) == in_order[k]).all()


def test_foam_appears_at_once_and_fades_in_its_life():
    xy, triangles = square(30, 2.0)
    caps = Whitecaps(Breaking(sea_state(2.0, seed=2), np.array([14.0, 0.0])), xy, triangles, 1 / 24)
    caps._carry = carried_from(xy, triangles, 0.0)
    foam = np.stack([caps.at(k).copy() for k in range(240)])
    change = np.diff(foam, axis=0)
    assert change.min() == pytest.approx(-1 / 24 / LIFE) and change.max() > 10 / 24 / LIFE


def test_foam_drifts_with_the_current():
    """What is linear in space is carried exactly."""
    xy, triangles = square(12, 2.0)
    way = np.array([0.7, -0.4])
    moved = carried_from(xy, triangles, way) @ (xy[:, 0] - PLACE[0] + 3 * (xy[:, 1] - PLACE[1]))
    inside = (np.abs(xy - PLACE - 11.0) < 9.0).all(axis=1)
    origin = xy - PLACE - way
    assert moved[inside] == pytest.approx((origin @ [1.0, 3.0])[inside])


@pytest.mark.parametrize("wind", [14.0, 18.0])
def test_there_are_hardly_any_in_the_shelter_of_a_mole(wind):
    """Where it leaves 0.25 to 0.65 of the waves, 3 % of the foam of the open sea was left: the patches in which crests
    break did not know of it."""
    waves = together(
        sea_state(1.5, 5.0, 21, heading=-np.pi / 2), choppiness=0.0, moles=[np.array([[-20.0, 0.0], [20.0, 0.0]])]
    )
    xy = square(60, 0.5)[0] - PLACE + np.array([-15.0, -40.0])  # behind the middle of the mole
    breaking = Breaking(waves, np.array([0.0, -wind]))
    behind, before = (
        breaking.born(Folding(waves, places).at(np.arange(40.0)) + breaking.unevenness(places)).mean()
        for places in (xy, xy + np.array([0.0, 60.0]))
    )
    assert 0.6 < waves.share(xy).max() < 0.66
    assert behind < 5e-3 * before
