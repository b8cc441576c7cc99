"""Cars on tyres start from the motion of the same car without slip."""

import math
from dataclasses import replace

import casadi as ca
import numpy as np
import pytest

import vehsim
from vehsim import Mark, World
from vehsim.planning import refine
from vehsim.planning.problem.solver import Patience
from vehsim.runtime.progress import Watching
from vehsim.vehicles.definition.gripping import gripping
from vehsim.world.obstacles.obstacles import box, cone
from vehsim.world.terrain.terrain import Terrain

REST = (0.0, 0.0, 0.0)
WHEELBASE = 2.6


def drive(x, y, heading, seconds):
    """Marks at rest at frame 0 and after some seconds."""
    return [
        Mark(frame=0, position=(0, 0, 0), heading=0, velocity=REST),
        Mark(frame=round(24 * seconds), position=(x, y, 0), heading=heading, velocity=REST),
    ]


@pytest.mark.parametrize("name", ["drift_car", "rally_car"])
def test_without_slip_axles_do_not_move_sideways_and_wheels_roll(name):
    car = vehsim.load_vehicle(name)
    same = gripping(car)
    assert same.joints == car.joints and same.control_names == car.control_names
    r, u, xi = ca.SX.sym("r", len(car.joints)), ca.SX.sym("u", len(car.joints)), ca.SX.sym("xi", 3)
    w_r, w_xi = same.constraints(r)
    rows = ca.Function("rows", [r, u, xi], [w_r @ u + w_xi @ xi])
    rolling = ca.Function("rolling", [r, xi], [ca.densify(car.rolling(r, xi))])
    for sigma in (-0.6, 0.0, 0.3):
        joints = np.where(np.array(car.joints) == "sigma", sigma, 0.0)
        turn = 8.0 * sigma / WHEELBASE  # of a single track whose rear axle moves straight ahead at 8 m/s
        twist = np.array([turn, 8.0, 1.3 * turn])
        assert np.abs(np.array(rows(joints, rolling(joints, twist), twist))).max() < 1e-12
        aside = twist + np.array([0.0, 0.0, 1.0])
        assert np.abs(np.array(rows(joints, rolling(joints, aside), aside))).max() > 0.5


def test_wheels_that_never_slip_have_no_such_car():
    assert gripping(vehsim.load_vehicle("car")) is None
    assert gripping(vehsim.load_vehicle("boat")) is None


@pytest.mark.parametrize(("x", "y", "heading", "seconds"), [(50, 27, -64, 14.5), (62, 19, 38, 13.4)])
def test_marks_aside_and_turned_are_driven_normally(x, y, heading, seconds):
    """From paths alone, these ended as a stunt after 334 iterations and as brisk after 193."""
    plan = vehsim.plan(vehsim.load_vehicle("drift_car"), None, drive(x, y, heading, seconds))
    assert plan.success and plan.character == "normal"
    assert plan.iterations < 120
    slip = max(np.abs(plan.clip.channels[f"slip_angle_{wheel}"]).max() for wheel in ("fl", "rl"))
    assert slip < math.radians(4)


def test_a_sharp_curve_in_little_time_is_brisk():
    """This was not solved within minutes."""
    plan = vehsim.plan(vehsim.load_vehicle("drift_car"), None, drive(60, 10, 90, 10))
    assert plan.success and plan.character == "brisk" and plan.iterations < 150


def test_a_mark_behind_is_driven_to_in_reverse():
    plan = vehsim.plan(vehsim.load_vehicle("drift_car"), None, drive(-24.2, -6, 33, 13.8))
    assert plan.success and plan.character == "normal"
    assert plan.clip.twists[:, 1].max() < 0.1  # forwards, it would cost eight times as much
    assert plan.cost < 1.0


def test_a_car_on_tyres_turns_around_cones_between_houses():
    """Without slip it took 102 iterations, more than were allowed, and with 128 segments more than 200; from paths, no
    motion was found in minutes."""
    houses = [
        box("a", (14, 12, 0), (20, 12, 9)),
        box("b", (14, -10, 0), (20, 12, 12)),
        box("c", (44, 4, 0), (14, 40, 12)),
    ]
    cones = [cone("one", (26, 2, 0)), cone("two", (28, -2, 0))]
    marks = [
        Mark(frame=1, position=(-12, 1, 0), heading=0, velocity=REST),
        Mark(frame="free", position=(31, 30, 0), heading=90, velocity=REST),
    ]
    world, car = World(obstacles=[*houses, *cones]), vehsim.load_vehicle("drift_car")
    plan = vehsim.plan(car, world, marks, clearance=0.4, character="brisk", segments=128)
    assert plan.success and plan.character == "brisk" and plan.iterations < 300


def plane(ahead, aside):
    """Ground that rises by ``ahead`` m per metre along x and by ``aside`` along y."""
    x = np.arange(-80.0, 81.0)
    heights = ahead * x[None, :] + aside * x[:, None]
    return World(terrain=Terrain("plane", heights, (-80.0, -80.0), (1.0, 1.0)))


@pytest.mark.parametrize("slope", [(0.0, 0.2), (0.1, 0.0)], ids=["across", "up"])
def test_cars_on_tyres_come_to_rest_on_slopes(slope):
    """Where tyres at rest held nothing, these were stunts."""
    plan = vehsim.plan(vehsim.load_vehicle("drift_car"), plane(*slope), drive(25, 3, 0, 10))
    assert plan.success and plan.character == "normal" and plan.order == 4
    speeds = np.linalg.norm(plan.clip.twists[:, 1:], axis=1)
    assert speeds[[0, -1]].max() < 1e-6


@pytest.mark.parametrize("stops", [{}, {"velocity": REST, "hold": 48}])
def test_it_drives_a_loop(stops):
    """The motion without slip was moved off the loop's last mark, which has no place of its own: it took 36 s, or ended
    as a stunt."""
    marks = [
        Mark(1, position=(0, 0, 0)),
        Mark(200, position=(25, 15, 0)),
        Mark(400, position=(0, 30, 0), **stops),
        Mark(700 if stops else 600),
    ]
    plan = vehsim.plan(vehsim.load_vehicle("drift_car"), None, marks, loop=True)
    assert plan.success and plan.character == "normal"
    assert plan.iterations < 150
    assert np.allclose(plan.clip.positions[0], plan.clip.positions[-1], atol=1e-6)


def test_it_holds_across_a_slope_on_its_way():
    """The hold was refused; with slips on 64 segments, the motion costs half as much again as without slip."""
    first, last = drive(45, 3, 0, 16.6)
    between = Mark(frame=169, position=(20, 0, 0), heading=0, velocity=REST, hold=24)
    plan = vehsim.plan(vehsim.load_vehicle("drift_car"), plane(0.0, 0.1), [first, between, last])
    assert plan.success and plan.character == "normal" and plan.order == 4
    held = plan.clip.at(np.arange(169, 194) / 24)
    assert np.ptp(held.positions, axis=0).max() < 1e-3


def test_a_motion_not_refined_on_few_segments_is_refined_from_order_2_on_more(monkeypatch):
    """Refined from 64 segments of order 2, a drive over hills took 54 CPU s and 256 segments."""
    plan = vehsim.plan(vehsim.load_vehicle("car"), None, drive(20, 0, 0, 6), segments=16, refine=False)
    unrefined = replace(plan._iterate, request=replace(plan._iterate.request, refine=True), rung=0)
    asked = []

    def solved_on(run, iterate, segments, order, patience=None):
        asked.append((segments, order))
        return replace(iterate, note="; not refined"), segments > 16

    monkeypatch.setattr(refine, "_solved_on", solved_on)
    climbed, found = refine._climb(plan._run, replace(unrefined, rung=-1))
    assert not found and asked == [(16, 4)]
    climbed, found = refine._climb(plan._run, climbed)
    assert found and asked[1:] == [(32, 2), (32, 4)] and not climbed.note


def test_a_refined_solve_without_patience_says_so(monkeypatch):
    """It said that a time limit was reached, which was not given."""
    monkeypatch.setattr(refine, "BRIEF", Patience(1))
    plan = vehsim.plan(vehsim.load_vehicle("drift_car"), None, drive(25, 3, 0, 10))
    assert plan.success and plan.order == 2
    assert "not refined to 64 segments of order 4: no solution within the iterations allowed" in plan.message


@pytest.mark.parametrize("name", ["drift_car", "rally_car"])
def test_iterates_of_a_car_on_tyres_are_drawn_on_the_ground(name):
    """Those without slip too, as in the live page."""
    drawn = []
    progress = Watching(lambda what, done: None, lambda name, motion: drawn.append(motion()))
    car, world = vehsim.load_vehicle(name), World(terrain="hills")
    marks = [Mark(frame=0, position=(-60, 20, 0), heading=20, velocity=REST), Mark(frame=240, position=(-35, 27, 0))]
    assert vehsim.plan(car, world, marks, progress=progress).success
    assert all(set(car.channels) <= set(clip.channels) for clip in drawn) and len(drawn) > 5
    assert np.ptp(drawn[-1].channels["roll_fl"]) > 30  # rad
