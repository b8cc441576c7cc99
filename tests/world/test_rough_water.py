"""Hulls other than the boat's, dropped and thrown about: they stay finite, come to rest, and conserve energy."""

from __future__ import annotations

import numpy as np
import pytest
from hulls import box, floating, join, sphere
from scipy.spatial.transform import Rotation

import vehsim
from vehsim.vehicles import State
from vehsim.world.water.buoyancy import Afloat
from vehsim.world.water.sea import sea_state
from vehsim.world.water.water import wave
from vehsim.world.world import Water, World

ROUND = sphere(1.0, 3)
FLEET = {
    "trimaran": (join(box(12, 1.2, 1.2), box(6, 0.6, 0.8, (0, 3.5, 0.2)), box(6, 0.6, 0.8, (0, -3.5, 0.2))), 8e3),
    "catamaran": (join(box(8, 0.8, 1, (0, 1.5, 0)), box(8, 0.8, 1, (0, -1.5, 0))), 3.5e3),
    "tug": ((ROUND[0] * [6.0, 2.6, 2.2], ROUND[1]), 60e3),
    "raft of planks": (join(*(box(4, 0.3, 0.15, (0, y, 0)) for y in np.linspace(-1.2, 1.2, 6))), 400.0),
}


def afloat(name):
    """A hull of the fleet, its mass spread over its box, with resistance and added mass to match its size."""
    (points, faces), mass = FLEET[name]
    size = np.ptp(points, axis=0)
    inertia = mass / 12 * (size @ size - size**2)
    return floating(
        (points, faces), mass, inertia, impact=1.0, planing=0.2, damping=np.array([0.3, 1.0, 2.0]) * mass,
        quadratic=np.array([0.05, 0.5, 0.0]) * mass, added_mass=[*(0.4 * inertia), 0.05 * mass, 0.5 * mass, mass],
    )  # fmt: skip


@pytest.mark.parametrize("name", [*FLEET, "boat"])
def test_dropped_from_five_metres(name):
    """It falls freely, hits the water at an angle, only loses energy there, and floats as Archimedes' law says."""
    body = vehsim.load_vehicle("boat") if name == "boat" else afloat(name)
    world = World(water=0.0)
    rest = Afloat(body, world).floating()[0] - body.origin[2]
    q = Rotation.from_euler("xyz", (0.15, 0.2, 0.4)).as_quat(scalar_first=True)
    start = State(position=(0, 0, rest + 5.0), orientation=q, twist=(0.1, 0, 0.1, 2.0, 0, 0))
    clip = vehsim.simulate(body, world, None, start, duration=10.0, step=1 / 24)
    assert np.isfinite(clip.positions).all() and np.isfinite(clip.twists).all()
    falling = clip.times < 0.5
    height = np.diff(clip.positions[falling, 2], 2) * 24**2
    assert body.mass is not None or height == pytest.approx(-9.81, rel=0.03)  # the boat's wind brakes it
    assert np.linalg.norm(clip.twists[:, 3:], axis=1).max() < np.hypot(2.0, np.sqrt(2 * 9.81 * 5.5)) + 1.0
    assert clip.positions[-1, 2] == pytest.approx(rest, abs=0.06)
    assert np.abs(np.delete(clip.twists[-1], 3)).max() < 0.3  # the remaining horizontal motion is ignored
    assert clip.matrices()[-1, 2, 2] > 0.95  # upright


@pytest.mark.parametrize("name", ["trimaran", "raft of planks"])
def test_steep_waves_leave_it_finite(name):
    """Waves near breaking, about as long as the hull: it stays on them."""
    water = Water(surface=wave(1.0, 8.0, 0.5, choppiness=0.7))
    clip = vehsim.simulate(afloat(name), World(water=water), None, duration=4.0, step=1 / 24)
    above = clip.positions[:, 2] - np.array(
        [water.height(p[None, :2], t)[0] for p, t in zip(clip.positions, clip.times, strict=True)]
    )
    assert np.isfinite(clip.twists).all() and np.abs(above).max() < 2.5


def test_a_boat_under_way_in_a_six_metre_sea():
    """A part of the ten-minute measurement (docs/derivations.md): no gap, no flight, no dive, upright."""
    boat, water = vehsim.load_vehicle("boat"), Water(surface=sea_state(6.0, seed=11, choppiness=0.4))
    clip = vehsim.simulate(boat, World(water=water), (1800.0, 0.0), duration=6.0, step=1 / 24)
    above = np.array([p[2] - water.height(p[None, :2], t)[0] for p, t in zip(clip.positions, clip.times, strict=True)])
    assert np.isfinite(clip.twists).all() and above.min() > -1.0 and above.max() < 3.0
    assert np.ptp(clip.positions[:, 2]) > 1.0
    assert clip.matrices()[:, 2, 2].min() > 0.5
