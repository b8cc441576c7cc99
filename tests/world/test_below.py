"""The ground below a flying vehicle: its height, and what its rotors feel of it in simulation and plans."""

import math

import casadi as ca
import numpy as np
import pytest

import vehsim
from vehsim.constants import GRAVITY
from vehsim.integrators import continuous
from vehsim.planning.constraints.mark_constraints import mark_element
from vehsim.planning.problem.transcription import transcribe
from vehsim.planning.trim import steady
from vehsim.vehicles.models.rotor import Rotor
from vehsim.world.ground.below import above_ground, above_marks
from vehsim.world.obstacles import box

WEIGHT = 1900.0 * GRAVITY


@pytest.fixture(scope="module")
def heli():
    return vehsim.load_vehicle("helicopter")


def heights(vehicle, world, places, around=None):
    return above_ground(vehicle, world, around).ground.heights(np.asarray(places, float))


def tail_force(height):
    """N, that balances the torque in a level hover with the centre of mass ``height`` m above the ground."""
    main = Rotor(5.35, 40.8, 0.0625, 0.01, 1.15)
    return float(ca.evalf(ca.SX(main.power(WEIGHT, 0.0, 1e-6, height + 1.61)))) / 40.8 / 6.35


def test_terrain_water_and_obstacles_are_ground(heli):
    """Smoothed over a rotor's size, which a hill's slope survives."""
    hills, rng = vehsim.World("hills"), np.random.default_rng(3)
    places = rng.uniform(-80, 80, (40, 2))
    off = heights(heli, hills, places, [[-80, -80], [80, 80]]) - hills.height(places)
    assert np.abs(off).max() < 0.5 and np.abs(off).mean() < 0.1
    assert heights(heli, vehsim.World(water=4.0), [[3, 5]]) == pytest.approx([4.0])
    roof = vehsim.World("flat", obstacles=[box("roof", (0, 0, 0), (20, 20, 20))])
    found = heights(heli, roof, [[0, 0], [4, 3], [20, 0]], [[0, 0, 25.0]])
    assert found == pytest.approx([20, 20, 0], abs=1e-6)


def test_walls_and_what_is_above_are_no_ground(heli):
    wall, beam = box("wall", (8, 0, 0), (1, 40, 40)), box("beam", (0, 0, 30), (20, 20, 1))
    world = vehsim.World("flat", obstacles=[wall, beam])
    assert heights(heli, world, [[0, 0], [7, 0], [8, 0]], [[0, 0, 5.0]]) == pytest.approx([0, 0, 0], abs=1e-6)
    assert heights(heli, world, [[0, 0]], [[0, 0, 40.0]]) == pytest.approx([31.0], abs=1e-6)


def test_where_nothing_is_below_there_is_no_ground(heli):
    roof = vehsim.World(obstacles=[box("roof", (0, 0, 0), (30, 30, 20))])
    over, beside = heights(heli, roof, [[0, 0], [40, 0]])
    assert over == pytest.approx(20.0) and beside < -20
    assert above_ground(heli, vehsim.World()) is heli
    assert above_ground(vehsim.load_vehicle("helicopter_lie"), vehsim.World("flat")).ground is None


def test_a_plan_keeps_its_vehicle_while_other_obstacles_move(heli):
    marks = np.array([[0.0, 0, 12], [60, 0, 12]])
    pad, walls = box("pad", (60, 0, 0), (14, 14, 2)), [box("wall", (30, y, 0), (2, 10, 20)) for y in (0.0, 3.0)]
    first, second = (above_marks(heli, vehsim.World("flat", obstacles=[pad, wall]), marks) for wall in walls)
    assert first is second
    assert first.ground.heights(np.array([[60.0, 0], [30, 0]])) == pytest.approx([2, 0], abs=1e-6)


@pytest.mark.parametrize("name", ["flat", "hills"])
def test_a_hover_near_the_ground_needs_less_tail_rotor(heli, name):
    """Its tail force balances the torque of the main rotor in ground effect, as momentum theory and Hayden say."""
    world = vehsim.World(name)
    place = np.array([0.0, 0.0, float(world.height([[0.0, 0.0]])[0]) + 1.0])
    forces = []
    for z in (0.0, 40.0):
        at = place + np.array([0, 0, z])
        pilot = vehsim.pilots.Hover(heli, tuple(at))
        clip = vehsim.simulate(heli, world, pilot, start=vehsim.State(position=at), duration=15.0, step=1 / 60)
        forces.append(clip.controls[-1, 1])
    assert forces[1] == pytest.approx(steady(heli, (0.0, 0.0, 0.0)).controls[1], rel=1e-3)
    assert forces[0] / forces[1] == pytest.approx(tail_force(1.0 + 1.45) / tail_force(math.inf), abs=0.015)


def test_plan_and_simulation_feel_the_same_ground(heli):
    """The controls of a plan near a pad lead along it in simulation; without ground, the nose turns."""
    pad = box("pad", (24, 0, 0), (16, 16, 2))
    world = vehsim.World(water=0.0, obstacles=[pad])
    marks = [
        vehsim.Mark(frame=1001, position=(0, 0, 6.0), heading=0.0, velocity=(0, 0, 0)),
        vehsim.Mark(frame=1241, position=(24, 0, 3.5), heading=0.0, velocity=(0, 0, 0)),
    ]
    plan = vehsim.plan(heli, world, marks, segments=40, clearance=0.4)
    assert plan.success
    clip = plan.clip

    def turned(world):
        made = vehsim.simulate(
            heli, world, clip.controls, clip.state(0), clip.duration, step=1 / 96, actuators=False
        )  # fmt: skip
        w, x, y, z = made.orientations[-1]
        return abs(math.degrees(math.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))))

    assert turned(world) < 2.0
    assert turned(vehsim.World()) > 60.0
    assert clip.controls[-1, 1] < 0.95 * clip.controls[0, 1]


def test_plans_look_up_the_ground_below_instead_of_writing_it_out(heli):
    """The same balance at a mark, with a twentieth of the operations; all elements share what looks it up."""
    t = transcribe(above_ground(heli, vehsim.World("hills")))
    assert t.ground.cells(7) is t.ground.cells(7)
    mark = vehsim.Mark(frame=1, position=(12.0, -7, 30), velocity=(0, 0, 0))
    looked_up, written = (mark_element(t, mark, everywhere=everywhere) for everywhere in (False, True))
    assert looked_up.hessian[0].n_instructions() < 0.1 * written.hessian[0].n_instructions()
    rng = np.random.default_rng(0)
    for _ in range(5):
        y, p = rng.uniform(-1, 1, written.y.shape[0]), rng.uniform(0, 1, written.given)
        place = np.asarray(looked_up.points(y, p))
        models = np.concatenate([p, place.ravel(), np.asarray(t.ground.cells(1)(place)).ravel()])
        for a, b in zip(looked_up.value(y, models), written.value(y, p), strict=True):
            np.testing.assert_allclose(np.array(a), np.array(b), atol=1e-9)


def test_executed_controls_look_up_the_ground_below(heli, monkeypatch):
    """The same motion as by the equations with the whole relief written out."""
    vehicle = above_ground(heli, vehsim.World("hills"))
    ground = float(vehicle.ground.heights([[12.0, -7.0]])[0])
    law, whole = continuous.local_equations(vehicle)[0], continuous.equations_of_motion(vehicle)
    assert law.n_instructions() < 0.2 * whole.n_instructions()
    g = np.asarray(vehicle.group.from_pose(np.array([12.0, -7, ground + 4, 1, 0, 0, 0]))).ravel()
    still = steady(vehicle, (0.0, 0.0, 0.0)).controls
    controls, steps = np.tile(still, (4, 1)) * np.array([[1.0], [1.02], [1.0], [0.99]]), np.full(3, 0.4)
    states = [g, np.zeros(len(vehicle.joints)), np.zeros(6)]
    found = continuous.execute(vehicle, *states, controls, steps, np.zeros(3))
    monkeypatch.setattr(continuous, "local_equations", lambda own: (whole, None))
    monkeypatch.setattr(continuous, "_rk4_step", continuous._rk4_step.__wrapped__)
    for a, b in zip(found, continuous.execute(vehicle, *states, controls, steps, np.zeros(3)), strict=True):
        np.testing.assert_allclose(a, b, atol=1e-9)


def test_a_flight_below_everything_has_no_ground(recwarn, heli):
    """Only infinite depths were known there, whose differences are no numbers."""
    world = vehsim.World(obstacles=[box("tower", (9.0, 9.0, 0.0), (4.0, 4.0, 15.0))])
    found = above_ground(heli, world, np.array([[0.0, 0.0, -5.0]]))
    assert found.ground is None or (np.asarray(found.ground.heights([[9.0, 9.0], [0.0, 0.0]])) < -40).all()
    assert not recwarn.list
