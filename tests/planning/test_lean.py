"""A helicopter that leans against its tail rotor is checked, and guessed, in the pose of its balance."""

import re
from dataclasses import replace

import numpy as np
import pytest

import vehsim
from vehsim import Mark
from vehsim.errors import InputError
from vehsim.planning.request.marks_near_obstacles import marks_too_near
from vehsim.planning.trim import steady, upright
from vehsim.world.obstacles.obstacles import moving

REST = (0.0, 0.0, 0.0)
ROTORS = {
    "rotor_radius": 5.35,
    "solidity": 0.0625,
    "tail_radius": 0.93,
    "tail_solidity": 0.13,
    "tail_height": 0.67,
    "hub_stiffness": 20000.0,
    "drag_angular": [2900.0, 2900.0, 600.0],
    "fin_area": 1.5,
    "fin_behind": 6.0,
    "fin_height": 0.6,
    "controls": {"yaw": {"lower": -1000.0, "upper": 3000.0, "scale": 1500.0}},
    "actuators": {"yaw": {"rate": 4000.0}},
}


def helicopter(asset):
    """A helicopter that hovers level, or one that leans against its tail rotor by 2.6 degrees."""
    return vehsim.load_vehicle("helicopter", parameters=ROTORS) if asset == "leaning" else vehsim.load_vehicle(asset)


@pytest.mark.parametrize(
    "asset, needed, wrong",
    [
        ("helicopter_lie", 0.3, "in obstacle 'other' at any heading at frame 200"),
        # where both lean alike, one disc is above the other: 10.4 sin(2.55 deg) less their thickness
        ("leaning", 0.3, "only 0.29 m from obstacle 'other' at any heading at frame 200"),
        ("leaning", 0.28, ""),
    ],
)
def test_a_mark_in_the_way_of_another_vehicle_is_refused_with_its_frame(asset, needed, wrong):
    """A helicopter that ends 10.4 m beside another: their rotors, 10.7 m wide, overlap at any heading."""
    heli = helicopter(asset)
    hover = [vehsim.Mark(frame, position=(0, 0, 20), heading=0, velocity=REST) for frame in (1, 25)]
    goes = vehsim.plan(heli, None, hover, segments=8).clip
    world = vehsim.World(obstacles=[moving("other", goes)])
    start = vehsim.Mark(1, position=(-40, 0, 20), velocity=REST)
    for place, expected in ((10.4, wrong), (14.0, "")):
        marks = [start, vehsim.Mark(200, position=(place * 0.6, place * 0.8, 20), velocity=REST)]
        found = [message for _, message, _ in marks_too_near(heli, world, marks, needed, 24)]
        assert found == [expected] * bool(expected)
        assert not list(marks_too_near(heli, world, marks, needed))


@pytest.mark.parametrize("asset, wind", [("helicopter_lie", REST), ("leaning", REST), ("leaning", (6.0, -3.0, 1.0))])
def test_a_helicopter_stays_where_it_is_upright(asset, wind):
    """Its simulation, which does not know of balances, moves less than 1 mm in a second, at any heading."""
    heli, still = helicopter(asset), (0.0, 0.0, 0.0)
    headings = np.linspace(-3, 3, 20)
    for heading, turn in zip(headings, upright(heli, headings, wind), strict=True):
        c, s = np.cos(heading), np.sin(heading)
        felt = (c * wind[0] + s * wind[1], c * wind[1] - s * wind[0], wind[2])
        state = vehsim.State((0.0, 0.0, 20.0), tuple(turn))
        clip = vehsim.simulate(heli, vehsim.World(wind=wind), steady(heli, still, felt).controls, state, 1.0)
        assert np.ptp(clip.positions, axis=0).max() < 1e-3


@pytest.mark.parametrize("asset, into", [("helicopter_lie", 2.47), ("leaning", 1.73)])
def test_a_mark_too_near_to_rock_is_refused_at_any_heading(asset, into):
    """In the canyon, 4 m from a wall: less than half the rotor. Tolerance and landings reduce the clearance."""
    heli, world = helicopter(asset), vehsim.World("canyon")

    def found(mark, clearance, *others, world=world):
        start = Mark(1, position=(0, 0, 30), velocity=REST)
        return [(i, message) for i, message, _ in marks_too_near(heli, world, [start, mark, *others], clearance, 24)]

    near = Mark(200, position=(36, 0, 28.8), velocity=REST)
    assert found(near, 0.5) == [(1, f"the vehicle reaches {into} m into rock at any heading")]
    # at the best of 720 headings, with the hulls where they are there
    yaw = np.linspace(0, 2 * np.pi, 720, endpoint=False)
    gaps = world.clearance(heli, np.repeat([near.position], len(yaw), axis=0), upright(heli, yaw))
    assert gaps.max() == pytest.approx(-into, abs=0.01)
    assert found(near, 0.5, world=vehsim.World("canyon", wind=(2, 2, 0)))
    assert found(replace(near, position=(24, 0, 26.4)), 0.5) == []
    free = replace(near, position=(32, 0, 28))
    ((_, message),) = found(free, 5.0)
    gap = float(re.fullmatch(r"only (.*) m from rock at any heading", message)[1])
    assert found(free, gap + 0.03) and found(free, gap - 0.03) == []
    assert found(replace(free, tolerance=0.2), gap + 0.3) == []
    assert found(free, gap + 0.3, Mark(300, position=(32, 0, 26), velocity=REST, on_ground=True)) == []
    with pytest.raises(InputError, match=r"mark\[1\].position = .*into rock at any heading"):
        vehsim.plan(heli, world, [Mark(1, position=(0, 0, 30), velocity=REST), near])
