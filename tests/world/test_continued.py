"""A simulation that is continued has the same bytes as one run through, whatever it left in the water, in contacts, in
actuators or in a pilot. The first part is saved and read in between."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from test_contact import block as block  # a fixture
from test_hydro import HULLS, boat_folder, coefficients

import vehsim
from vehsim.clip import Clip
from vehsim.errors import InputError
from vehsim.pilots import FlyTo, FollowPath
from vehsim.simulation import Mover, simulate, simulate_together
from vehsim.vehicles import State
from vehsim.world.contact.contact import Contact
from vehsim.world.obstacles.obstacles import box, moving
from vehsim.world.terrain.terrain import Terrain
from vehsim.world.water.water import Water, Waves
from vehsim.world.wind import Gusts
from vehsim.world.world import World

SWELL = Waves(np.array([0.4, 0.15]), np.array([[-0.5, 0.3], [0.4, 1.2]]), np.array([0.0, 1.0]), choppiness=0.8)


def kept(clip: Clip) -> Clip:
    """The clip, as it is saved and read."""
    return Clip.from_bytes(clip.to_bytes(ending=True), clip.vehicle)


def is_the_same(run: Callable[..., Clip], first: float, whole: float) -> Clip:
    """Compare ``run(duration, after)`` in one, and in two pieces; returns the clip."""
    through = run(whole, None)
    assert run(whole, kept(run(first, None))).to_bytes() == through.to_bytes()
    return through


def helm(t: float, state: State) -> Any:
    return [3000 * np.sin(t), 0.25 * np.cos(2 * t)]


def test_a_boat_on_waves() -> None:
    boat, world = vehsim.load_vehicle("boat"), World(water=Water(0.0, SWELL), wind=(3, 1, 0))
    is_the_same(lambda t, after: simulate(boat, world, helm, duration=t, step=1 / 48, after=after), 0.7, 1.5)


def test_a_boat_that_falls_into_the_water() -> None:
    """Continued while it slams: the next step depends on the last forces."""
    boat, world = vehsim.load_vehicle("boat"), World(water=0.4)
    start = State(position=(0, 0, 1.3), twist=(0, 0, 0, 8, 0, 0))
    is_the_same(
        lambda t, after: simulate(boat, world, [3000.0, 0.1], start, duration=t, step=1 / 24, after=after), 0.5, 0.9
    )


def test_a_boat_with_the_memory_of_the_waves_it_radiates(tmp_path: Any) -> None:
    replace(coefficients(HULLS[0]), height=0.267).save(tmp_path / "hull.hydro.npz")
    boat = vehsim.load_vehicle(boat_folder(tmp_path, "hull.hydro.npz"))
    world = World(water=Water(0.0, SWELL))
    is_the_same(lambda t, after: simulate(boat, world, helm, duration=t, step=1 / 48, after=after), 0.7, 1.2)


@pytest.mark.filterwarnings("ignore:car")  # it does not arrive
def test_a_car_under_commands_and_under_a_pilot() -> None:
    car = vehsim.load_vehicle("car")
    is_the_same(lambda t, after: simulate(car, None, [300.0, 0.1], duration=t, after=after), 1.0, 2.5)
    is_the_same(lambda t, after: simulate(car, None, helm, duration=t, order=4, after=after), 0.5, 1.0)
    pilot = FollowPath(car, [(0, 0), (15, 0), (20, 15)], speed=6)
    world = World(terrain="flat")
    is_the_same(lambda t, after: simulate(car, world, pilot, duration=t, everywhere=True, after=after), 1.3, 2.5)


@pytest.mark.filterwarnings("ignore:helicopter")  # it does not arrive
def test_a_helicopter_with_a_pilot_in_gusts() -> None:
    heli, world = vehsim.load_vehicle("helicopter"), World(wind=(6, 0, 0), gusts=Gusts(0.2))
    pilot, start = FlyTo(heli, (20, 5, 32), speed=5), State(position=(0, 0, 30))
    is_the_same(lambda t, after: simulate(heli, world, pilot, start, duration=t, step=1 / 96, after=after), 0.5, 1.0)


@pytest.mark.parametrize("first", [0.2, 1.2], ids=["sliding", "resting"])
def test_a_block_on_a_slope(block: Any, first: float) -> None:
    """It slides until friction holds it, and rests; its grip and its rest are carried."""
    terrain = Terrain("slope", np.tile(-0.15 * np.arange(-20, 21), (41, 1)), (-10.0, -10.0), (0.5, 0.5))
    world = World(terrain=terrain, contact=Contact(friction=0.4, restitution=0.3, speed=2.0))
    pitch = np.arctan(0.3) / 2
    start = State(position=(0, 0, 0.215), orientation=(np.cos(pitch), 0, np.sin(pitch), 0), twist=(0, 0, 0, 0.4, 0, 0))
    clip = is_the_same(lambda t, after: simulate(block(), world, None, start, duration=t, after=after), first, 1.4)
    moves = np.abs(np.diff(clip.positions, axis=0)).max(axis=1) > 0
    assert moves[: int(0.2 * 240)].all() and not moves[int(1.2 * 240) :].any()


def test_a_boat_that_slides_up_a_beach() -> None:
    """Its water is evaluated less often than its contact, and continues in between."""
    x = np.arange(-60.0, 61.0, 2.0)
    beach = Terrain("beach", np.tile(0.1 * (x - 10), (len(x), 1)), (-60, -60), (2, 2))
    boat, world = vehsim.load_vehicle("boat"), World(beach, water=0.0, contact=Contact(0.4, 0.1, 1.5))
    start = State(position=(4.8, 0, 0), twist=(0, 0, 0, 1.0, 0, 0))
    clip = is_the_same(
        lambda t, after: simulate(boat, world, [0.0, 0.0], start, duration=t, step=1 / 48, after=after), 0.4, 0.5
    )
    assert clip.events[0]["time"] < 0.4 and clip.twists[-1, 3] > 0.3


@pytest.mark.parametrize("first", [0.2, 0.5], ids=["settling", "resting"])
def test_a_boat_that_rests_on_a_beach_in_waves(first: float) -> None:
    """Whether its contacts hold it follows from those of its last evaluation."""
    x = np.arange(-60.0, 61.0, 2.0)
    beach = Terrain("beach", np.tile(0.1 * (x - 10), (len(x), 1)), (-60, -60), (2, 2))
    water = Water(surface=Waves(np.array([0.04]), np.array([[1.57, 0.0]]), np.zeros(1)))
    boat, world = vehsim.load_vehicle("boat"), World(beach, water=water, contact=Contact(0.4, 0.1, 1.5))
    start = State(position=(6.5104, 0, 0.1536), orientation=(1, 0, 9.13e-4, 0))
    clip = is_the_same(
        lambda t, after: simulate(boat, world, [0.0, 0.0], start, duration=t, step=1 / 48, after=after), first, 0.7
    )
    assert not clip.twists[clip.times > 0.4].any()


def test_boats_that_meet_in_waves_at_a_wall() -> None:
    boat = vehsim.load_vehicle("boat")
    world = World(
        water=Water(0.0, SWELL), contact=Contact(friction=0.3), obstacles=[box("wall", (6.5, 0, 0), (1, 20, 4))]
    )
    starts = {"one": 0.0, "two": -9.0}

    def run(duration: float, after: Any) -> dict[str, Clip]:
        movers = {
            name: Mover(boat, [3000.0, 0.0], State(position=(x, 0, -0.1), twist=(0, 0, 0, 6, 0, 0)))
            for name, x in starts.items()
        }
        return simulate_together(movers, world, duration, step=1 / 48, after=after)

    through = run(0.6, None)
    pieces = run(0.6, {name: kept(clip) for name, clip in run(0.5, None).items()})
    assert any(event["time"] < 0.5 for event in through["one"].events)
    for name, clip in through.items():
        assert pieces[name].to_bytes() == clip.to_bytes()


def test_blocks_of_which_one_rests_while_the_other_slides_to_it(block: Any) -> None:
    """Continued while one rests, and after it was woken."""
    world = World(contact=Contact(0.05, 0.1, 2.0), obstacles=[box("floor", (0, 0, -1), (40, 40, 1))])
    starts = {"still": (0.0, 0.0), "slider": (-2.8, 3.0)}

    def run(duration: float, after: Any) -> dict[str, Clip]:
        movers = {
            name: Mover(block(), None, State(position=(x, 0, 0.2), twist=(0, 0, 0, speed, 0, 0)))
            for name, (x, speed) in starts.items()
        }
        return simulate_together(movers, world, duration, step=1 / 24, after=after)

    through = run(1.0, None)["still"]
    assert not through.twists[(through.times > 0.4) & (through.times < 0.55)].any() and through.twists[-1, 3] > 1
    for first in (0.5, 0.75):
        pieces = run(1.0, {name: kept(clip) for name, clip in run(first, None).items()})
        assert pieces["still"].to_bytes() == through.to_bytes()


def test_other_controls_act_from_there_on() -> None:
    boat, world = vehsim.load_vehicle("boat"), World(water=0.0)
    first = simulate(boat, world, [3000.0, 0.0], duration=1.0, step=1 / 48)
    turned = simulate(boat, world, [3000.0, 0.3], duration=2.0, step=1 / 48, after=first)
    np.testing.assert_array_equal(turned.positions[: len(first)], first.positions)
    np.testing.assert_array_equal(turned.commands["steering"][len(first) - 1 :][:2], [0.0, 0.3])
    assert 0 < turned.controls[len(first), 1] < 0.05  # its actuator follows from where it was


def test_what_cannot_be_continued_is_refused() -> None:
    car = vehsim.load_vehicle("car")
    first = simulate(car, None, [300.0, 0.1], duration=1.0)
    for clip in (replace(first, positions=first.positions + 1), Clip.from_bytes(first.to_bytes())):
        with pytest.raises(InputError, match="cannot be continued"):
            simulate(car, None, [300.0, 0.1], duration=2.0, after=clip)
    with pytest.raises(InputError, match="longer duration"):
        simulate(car, None, [300.0, 0.1], duration=0.5, after=first)


def test_what_differs_from_the_earlier_call_is_named() -> None:
    boat, other = vehsim.load_vehicle("boat"), vehsim.load_vehicle("boat", {"mass": 900.0})
    water, car = World(water=0.0), vehsim.load_vehicle("car")
    first = simulate(boat, water, [3000.0, 0.0], duration=0.25, step=1 / 48)
    rolled = simulate(car, None, [300.0, 0.1], duration=0.25)

    def go_on(
        vehicle: Any = boat, world: Any = water, controls: Any = (3000.0, 0.0), clip: Any = first, **new: Any
    ) -> Any:
        return simulate(vehicle, world, controls, duration=0.5, after=clip, **{"step": 1 / 48, **new})

    assert len(go_on()) == 25
    changes: dict[str, dict[str, Any]] = {
        "vehicle": {"vehicle": car, "world": None, "controls": [300.0, 0.1]},
        "vehicle.parameters.mass": {"vehicle": other},
        "step": {"step": 1 / 96},
        "fps": {"fps": 12},
        "start_frame": {"start_frame": 1},
        "start.position": {"start": State(position=(1, 0, 0))},
        "actuators": {"actuators": False},
        "world": {"world": None},
        "controls": {"vehicle": car, "world": None, "controls": helm, "clip": rolled, "step": 1 / 240},
        "world.wind": {"world": World(water=0.0, wind=(3, 0, 0))},
        "world.water": {"world": World(water=Water(0.0, SWELL))},
        "world.gusts": {"world": World(water=0.0, gusts=Gusts(0.2))},
        "world.contact": {"world": World(water=0.0, contact=Contact())},
        "world.terrain": {"world": World("flat", water=0.0)},
        "world.obstacle.wall": {"world": World(water=0.0, obstacles=[box("wall", (90, 0, 0), (1, 1, 1))])},
        "world.moving": {"world": World(water=0.0, obstacles=[moving("ferry", first)])},
    }
    for key, change in changes.items():
        with pytest.raises(InputError, match="to be continued has") as error:
            go_on(**change)
        assert error.value.key == key
    movers = {name: Mover(boat, [0.0, 0.0], State(position=(x, 0, 0))) for name, x in (("one", 0.0), ("two", 20.0))}
    both = simulate_together(movers, water, 0.25, step=1 / 48)
    windy = World(water=0.0, wind=(3, 0, 0))
    for wrong, place, clips, key in (
        (movers, water, {"one": both["one"]}, "after"),
        (dict(reversed(movers.items())), water, both, "movers"),
        (movers, windy, both, "world.wind"),
    ):
        with pytest.raises(InputError) as error:
            simulate_together(wrong, place, 0.5, step=1 / 48, after=clips)
        assert error.value.key == key
