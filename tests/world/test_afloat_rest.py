"""Boats at rest on calm water: they cost nothing, and wake when something changes."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hulls import box, floating
from test_contact import block as block  # a fixture
from test_hydro import HULLS, boat_folder, coefficients

import vehsim
from vehsim import World
from vehsim.simulation import Mover, simulate, simulate_together
from vehsim.vehicles import State
from vehsim.world.contact.contact import Contact
from vehsim.world.obstacles.obstacles import moving
from vehsim.world.terrain.terrain import Terrain
from vehsim.world.water.buoyancy import Afloat
from vehsim.world.water.water import Water, wave
from vehsim.world.wind import Gusts

ASIDE = State(position=(0.0, -4.0, 0.3), twist=(0, 0, 0, 0, 3.0, 0))
"""A block that comes from starboard."""


def test_a_boat_at_rest_costs_nothing_until_its_engine_starts(monkeypatch: pytest.MonkeyPatch) -> None:
    """The water is not evaluated in between. A simulation that is continued meanwhile has the same bytes."""
    boat, evaluated, motion = vehsim.load_vehicle("boat"), [], Afloat._motion

    def noted(self: Afloat, t: float, *given: Any) -> Any:
        evaluated.append(t)
        return motion(self, t, *given)

    def run(duration: float, after: Any = None) -> Any:
        return simulate(boat, World(water=0.0), engine, duration=duration, step=1 / 48, after=after)

    def engine(t: float, state: State) -> Any:
        return [0.0 if t < 2.0 else 2000.0, 0.0]

    monkeypatch.setattr(Afloat, "_motion", noted)
    whole = run(2.5)
    still = (whole.times > 0.5) & (whole.times < 1.95)
    assert not whole.twists[still].any() and whole.twists[-1, 3] > 0.2
    assert not [t for t in evaluated if 0.5 < t < 1.95] and max(evaluated) > 2.4
    assert run(2.5, run(1.0)).to_bytes() == whole.to_bytes()


def test_a_boat_at_rest_on_a_beach_in_waves_is_looked_at_sixty_times_a_second(monkeypatch: pytest.MonkeyPatch) -> None:
    """Its steps are four times as short; a simulation that is continued at any of them has the same bytes."""
    x = np.arange(-60.0, 61.0, 2.0)
    beach = Terrain("beach", np.tile(0.1 * (x - 10), (len(x), 1)), (-60, -60), (2, 2))
    world = World(beach, water=Water(surface=wave(0.06, 4.0)), contact=Contact(0.4, 0.1, 1.5))
    start = State(position=(6.5104, 0, 0.1536), orientation=(1, 0, 9.13e-4, 0))
    boat, evaluated, motion = vehsim.load_vehicle("boat"), [], Afloat._motion

    def noted(self: Afloat, t: float, *given: Any) -> Any:
        evaluated.append(t)
        return motion(self, t, *given)

    def run(duration: float, after: Any = None) -> Any:
        return simulate(boat, world, (0.0, 0.0), start, duration=duration, after=after)

    monkeypatch.setattr(Afloat, "_motion", noted)
    whole = run(1.5)
    assert not whole.twists[whole.times > 1.0].any()
    assert 25 < len([t for t in evaluated if 1.0 < t <= 1.5]) < 35
    assert run(1.5, run(1.205)).to_bytes() == whole.to_bytes()


def test_a_dropped_boat_rests_within_a_tenth_of_a_millimetre_of_where_it_floats() -> None:
    """A box that bobs, with damping."""
    raft = floating(box(2.0, 1.0, 0.5), 500.0, (52.0, 177.0, 208.0), added_mass=(100.0,) * 6, damping=(800.0,) * 3)
    world = World(water=0.0)
    clip = simulate(raft, world, None, State(position=(0, 0, 0.1)), duration=30.0, step=1 / 24)
    height, _ = Afloat(raft, world).floating()
    assert not clip.twists[-24:].any() and abs(clip.positions[-1, 2] - height) < 1e-4


def test_a_raft_that_drifts_away_slowly_rests_a_centimetre_too_early_at_most() -> None:
    """Its speed falls by a factor of e in 7.5 s: it took half a minute to be slow enough."""
    raft = floating(box(2.0, 1.0, 0.5), 500.0, (52.0, 177.0, 208.0), added_mass=(100.0,) * 6, damping=(80.0,) * 3)
    start = State(position=(0, 0, Afloat(raft, World(water=0.0)).floating()[0]), twist=(0, 0, 0, 0.003, 0, 0))
    clip = simulate(raft, World(water=0.0), None, start, duration=12.0, step=1 / 24)
    assert not clip.twists[-24:].any() and 0.0 < 0.003 * 600 / 80 - clip.positions[-1, 0] < 0.01


def test_a_boat_in_gusts_does_not_rest() -> None:
    world = World(water=0.0, wind=(4, 0, 0), gusts=Gusts(0.5))
    assert simulate(vehsim.load_vehicle("boat"), world, None, duration=0.6, step=1 / 48).twists[1:].any(axis=1).all()


def test_a_hull_without_stability_is_not_kept_upright() -> None:
    """A tall box, whose heel of a hundred-thousandth grows until it lies on its side."""
    tall = floating(box(1.0, 0.5, 2.0), 500.0, (177.0, 208.0, 52.0), damping=(60.0,) * 3)
    afloat = Afloat(tall, World(water=0.0))
    start = State(position=(0, 0, afloat.floating()[0]), orientation=(1, 1e-5, 0, 0))
    assert not afloat.stable(start)
    clip = simulate(tall, World(water=0.0), None, start, duration=20.0, step=1 / 24)
    assert clip.matrices()[-1, 2, 2] < 0.5
    assert afloat.stable(clip.state(-1))


def test_a_boat_with_the_memory_of_its_waves_rests(tmp_path: Any) -> None:
    """It forgets them: its wrench at rest is that of a boat which never moved."""
    replace(coefficients(HULLS[0]), height=0.267).save(tmp_path / "hull.hydro.npz")
    boat = vehsim.load_vehicle(boat_folder(tmp_path, "hull.hydro.npz"))
    world = World(water=0.0)
    clip = simulate(boat, world, None, duration=2.0, step=1 / 48)
    assert not clip.twists[clip.times > 0.5].any()
    moved = Afloat(boat, world)
    state = replace(clip.state(-1), twist=np.array([0, 0, 0, 0, 0, 0.5]))
    moved.wrench(0.0, state, np.zeros(2))
    moved.wrench(0.5, state, np.zeros(2))
    at_rest = clip.state(-1)
    soon, later = (moved.wrench(t, at_rest, np.zeros(2)) for t in (0.6, 60.0))
    fresh = Afloat(boat, world).wrench(0.0, at_rest, np.zeros(2))
    assert np.abs(later - fresh).max() < 1e-4 * np.abs(soon - fresh).max()


def test_a_floating_boat_wakes_before_an_obstacle_hits_it(block: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    """The blow is that on a boat that never rests."""
    boat = vehsim.load_vehicle("boat")
    ram = simulate(block(gravity=0.0), None, None, ASIDE, duration=2.0, step=1 / 24)
    world = World(water=0.0, contact=Contact(0.3, 0.1, 3.0), obstacles=[moving("ram", replace(ram, start_frame=1025))])
    clip = simulate(boat, world, None, duration=2.0, step=1 / 24)
    assert not clip.twists[(clip.times > 0.5) & (clip.times < 1.0)].any() and clip.twists[-1, 4] > 0.5
    monkeypatch.setattr(Afloat, "steady", False)
    awake = simulate(boat, world, None, duration=2.0, step=1 / 24)
    (hit, *_), (expected, *_) = clip.events, awake.events
    assert hit["time"] == pytest.approx(expected["time"], abs=1e-4)
    assert hit["impulse"] == pytest.approx(expected["impulse"], rel=1e-3)
    np.testing.assert_allclose(clip.positions[-1], awake.positions[-1], atol=1e-3)


def test_a_floating_boat_wakes_when_another_boat_hits_it() -> None:
    boat = vehsim.load_vehicle("boat")
    other = State(position=(0.0, -8.0, 0.05), orientation=(np.sqrt(0.5), 0, 0, np.sqrt(0.5)), twist=(0, 0, 0, 4, 0, 0))
    movers = {"still": Mover(boat), "fast": Mover(boat, None, other)}
    clips = simulate_together(movers, World(water=0.0, contact=Contact(0.3, 0.1, 2.0)), 1.15, step=1 / 24)
    hit, *_ = clips["still"].events
    times, twists = clips["still"].times, clips["still"].twists
    assert hit["time"] > 0.6 and not twists[(times > 0.5) & (times < hit["time"] - 0.05)].any()
    assert twists[-1, 4] > 0.1
