"""What bounds rule out: never a feasible motion, always the named one, for every vehicle that can be planned."""

import re
import warnings
from dataclasses import replace

import numpy as np
import pytest

import vehsim
from tests.planning.test_plan import REST, tug
from vehsim import Mark, Shot
from vehsim.constants import AIR
from vehsim.errors import InputError
from vehsim.planning.explain.bounds import Ball, push_of, slips, strength, thrust_ball
from vehsim.planning.explain.feasibility import refusals
from vehsim.planning.request import ranges
from vehsim.planning.request.request import make_request

VEHICLES = ["helicopter", "boat", "car", "simple_car", "truck", "two_wheeled", "snakeboard"]
# the snakeboard swings its joints: no frame is found for it
NAMED = [name for name in VEHICLES if name != "snakeboard"]


def ends(name, x, frame, **last):
    z = 30.0 * (name == "helicopter")
    return [Mark(1001, position=(0, 0, z), velocity=REST), Mark(frame, position=(x, 0, z), **last)]


def refused(name, marks, **options):
    request = make_request(vehsim.load_vehicle(name), None, marks, fps=24, segments=32, **options)
    return [str(refusal) for refusal in refusals(request)]


@pytest.mark.parametrize("name", VEHICLES)
@pytest.mark.parametrize(("x", "frame", "last"), [(60.0, 1010, {"velocity": REST}), (200.0, 1025, {})])
def test_check_refuses_marks_that_are_too_far_apart_in_time(name, x, frame, last):
    data = {
        "shot": {"schema": 1, "name": "far"},
        "vehicle": [{"name": "v", "asset": name, "motion": {"method": "plan", "mark": []}}],
    }
    for mark in ends(name, x, frame, **last):
        table = {"frame": mark.frame, "position": list(mark.position)}
        data["vehicle"][0]["motion"]["mark"].append(table | ({"velocity": [0, 0, 0]} if mark.velocity else {}))
    (problem,) = (found for found in Shot.from_dict(data).check() if found.severity == "error")
    assert problem.key == "vehicle[0].motion.mark[1].frame"
    assert re.search(r"^(earliest 1\d\d\d|not before 1\d\d\d|use 1\d\d\d)$", problem.remedy), problem


@pytest.mark.parametrize("name", NAMED)
def test_the_suggested_frame_works(name):
    marks = ends(name, 60.0, 1010, velocity=REST)
    (message,) = refused(name, marks)
    frame = int(re.search(r"earliest (\d+)$|; use (\d+)$", message).expand(r"\1\2"))
    plan = vehsim.plan(vehsim.load_vehicle(name), None, [marks[0], replace(marks[1], frame=frame)], segments=32)
    assert plan.success, plan.message


@pytest.mark.parametrize("name", VEHICLES)
def test_planned_motions_are_not_refused(name):
    """The fastest possible motions, also with the velocities at their midpoints."""
    vehicle = vehsim.load_vehicle(name)
    marks = [replace(mark, heading=0.0) for mark in ends(name, 8.0, "free", velocity=REST)]
    segments = 64 if name == "snakeboard" else 32
    plan = vehsim.plan(vehicle, None, marks, segments=segments, cost={"time": 1, "smoothness": 1e-3})
    assert plan.success
    clip = plan.clip.resample()
    done = replace(marks[1], frame=clip.end_frame)
    assert refused(name, [marks[0], done]) == []
    middle = len(clip.times) // 2
    velocity = np.gradient(clip.positions, clip.times, axis=0)[middle]
    there = Mark(
        int(clip.frames[middle]), position=tuple(clip.positions[middle]), speed=float(np.linalg.norm(velocity))
    )
    assert refused(name, [marks[0], there, done]) == []


def test_the_ball_bound_is_that_of_the_double_integrator():
    """Level, from rest to rest, with thrust that also carries the weight; from a speed, the braking distance."""
    helicopter = vehsim.load_vehicle("helicopter")
    ball, still = thrust_ball(helicopter), np.zeros(3)
    draughty = thrust_ball(helicopter, 50.0)
    across = (3.0 + AIR / 2 * 1.5) * 50**2 + 3.76 * 50  # N, of fuselage and fin, and of the blades' H-force
    assert draughty.radius == pytest.approx(ball.radius + across / 1900, rel=0.02)
    level = np.sqrt(ball.radius**2 - 9.81**2)
    quickest = 2 * np.sqrt(60 / level)
    for share, ruled in ((0.95, True), (1.02, False)):
        assert ball.rules_out(np.array([60.0, 0, 0]), 0.0, share * quickest, still, still) == ruled
    free = Ball(np.zeros(3), 4.0)  # stops from 20 m/s in 50 m and 5 s
    assert not free.rules_out(np.array([50.0, 0, 0]), 0.1, 5.0, np.array([20.0, 0, 0]), still)
    assert free.rules_out(np.array([40.0, 0, 0]), 0.1, 4.5, np.array([20.0, 0, 0]), still)
    assert not free.rules_out(np.array([40.0, 0, 0]), 0.1, 4.5, np.inf, np.inf)


def test_motions_with_one_acceleration_in_each_half_are_recognised():
    """Those are found without a search; integrated in closed form, they are possible exactly inside the ball."""
    random, ball, seconds = np.random.default_rng(3), Ball(np.array([0.0, 0.0, -9.81]), 15.0), 3.0
    found = []
    for _ in range(200):
        start, *halves = random.normal(size=(3, 3)) * [[3.0], [8.0], [8.0]] + [[0] * 3, ball.centre, ball.centre]
        middle = start + halves[0] * seconds / 2
        end = middle + halves[1] * seconds / 2
        displacement = (start + 2 * middle + end) * seconds / 4
        inside = all(np.linalg.norm(half - ball.centre) <= ball.radius for half in halves)
        assert ball._leads(displacement, seconds, start, end) == inside
        assert not (inside and ball.rules_out(displacement, 0.0, seconds, start, end))
        found.append(inside)
    assert 20 < sum(found) < 180
    assert ball._leads(np.array([10.0, 0, 0]), seconds, 4.0, np.inf)  # at 10 / 3 m/s all the way
    assert not ball._leads(np.array([90.0, 0, 0]), seconds, 4.0, 4.0)


def test_strength_is_force_over_inertia():
    robot, boat = vehsim.load_vehicle("two_wheeled"), vehsim.load_vehicle("boat").planar
    assert 80 / 17.2 <= strength(robot) <= 1.1 * 80 / 17.2
    assert push_of(boat, (0.0, 0.0, 0.0), 0.0).most < push_of(boat, (0.0, 15.0, 0.0), 0.0).most < 6
    assert strength(tug()) == np.inf


@pytest.mark.parametrize(
    ("name", "given", "says"),
    [
        ("car", {"heading": 0, "velocity": (0, 5, 0)}, "velocity: 90 degrees off its heading: .* within 19.3"),
        ("two_wheeled", {"heading": 0, "velocity": (0, 1, 0)}, "velocity: 90 .* rolls straight ahead or back"),
        ("car", {"joints": {"sigma": 1.5}}, r"mark\[1\].joints.sigma = 1.5: outside -0.7 to 0.7; keep it inside"),
        ("car", {"heading": 10, "velocity": (-5, -1, 0)}, None),
        ("boat", {"heading": 0, "velocity": (0, 1, 0)}, None),
    ],
)  # fmt: skip
def test_impossible_states_at_a_mark_are_reported(name, given, says):
    found = refused(name, ends(name, 20.0, 1200, **given))
    assert found == [] if says is None else len(found) == 1 and re.search(says, found[0])


def test_a_heading_that_contradicts_a_look_is_reported():
    marks = [replace(mark, heading=90.0) for mark in ends("helicopter", 60.0, 1201, velocity=REST)]
    looks = [ranges.look_at((500, 0, 0), (1190, 1201), within=3)]
    (message,) = refused("helicopter", marks, terms=looks)
    assert message.startswith("mark[1].heading: 90 degrees off the direction that 'look_at' requires; give heading = 0")
    assert slips(vehsim.load_vehicle("boat").planar)[0]


def test_a_default_heading_is_dropped_before_the_plan_fails():
    """Moving a metre takes less time than turning to face it."""
    marks = [
        Mark(1001, position=(0, 0, 30), heading=180, velocity=REST),
        Mark(1061, position=(1, 0, 30), velocity=REST),
        Mark(1165, position=(30, 0, 30), heading=0, velocity=REST),
    ]
    with pytest.warns(UserWarning, match="headings at rest do not point along the path"):
        plan = vehsim.plan(vehsim.load_vehicle("helicopter"), None, marks, segments=32)
    assert plan.success and abs(plan.clip.resample().positions[60, 0] - 1) < 1e-3


@pytest.mark.parametrize(
    ("name", "frame"), [("helicopter", 1101), ("car", 1101), ("boat", "free"), ("two_wheeled", 1151)]
)
def test_two_segments_are_replaced_by_enough(name, frame, capfd):
    with pytest.warns(UserWarning, match="with 16 segments, because 2 are too few"):
        plan = vehsim.plan(vehsim.load_vehicle(name), None, ends(name, 20.0, frame, velocity=REST), segments=2)
    assert plan.success and "overconstrained" not in capfd.readouterr().err


@pytest.mark.parametrize("name", ["helicopter", "car"])
def test_plans_keep_the_top_speed_unless_a_limit_allows_more(name):
    vehicle = vehsim.load_vehicle(name)
    marks = [replace(mark, velocity=None) for mark in ends(name, 40.0, "free")]
    with pytest.warns(UserWarning, match=f"limited to the top speed of the {name}"):
        plan = vehsim.plan(vehicle, None, marks, segments=16)
    speeds = np.linalg.norm(plan.clip.twists[:, -3 if name == "helicopter" else 1 :], axis=1)
    assert plan.success and speeds.max() < 1.01 * vehicle.top_speed
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert vehsim.plan(vehicle, None, marks, segments=16, limits={"speed": 10}).duration > 3.9
    fast = ends(name, 40.0, 1101, velocity=(1.2 * vehicle.top_speed, 0, 0))
    assert "limits.speed can allow more" in refused(name, fast)[0]
    assert refused(name, fast, limits={"speed": 2 * vehicle.top_speed}) == []


def test_a_boat_whose_start_is_free_does_not_spin_into_its_heading():
    """Its least effort was to start at 18 rad/s, and executed controls ended 9 m off at any number of segments."""
    marks = [Mark(1, position=(18.528, 11.804, 0), heading=-104), Mark("free", position=(7.2, 1.2, 0), velocity=REST)]
    boat = vehsim.load_vehicle("boat")
    plan = vehsim.plan(boat, None, marks, segments=12, character="stunt")
    assert plan.success and np.abs(plan.clip.twists[:, 0]).max() < 1.01 * boat.top_turn_rate
    assert plan.executed.final < 0.05


WINDY = [
    ((-3.8, 4.0, 0.0), -5.33, (-57.4, 14.1, 0.0), 80.92, 1760),
    ((-5.0, 3.0, 0.0), 45.0, (40.0, -20.0, 0.0), 100.0, 1600),
]


@pytest.mark.parametrize(("wind", "away", "goal", "heading", "frame"), WINDY)
def test_a_boat_in_wind_goes_where_its_controls_lead_or_fails(wind, away, goal, heading, frame):
    """On 24 segments the optimiser exploits the discretisation; the plan starts again on more."""
    marks = [Mark(1001, position=(0, 0, 0), heading=away, velocity=REST)]
    marks.append(Mark(frame, position=goal, heading=heading, velocity=REST))
    plan = vehsim.plan(vehsim.load_vehicle("boat"), vehsim.World(wind=wind), marks, segments=24)
    assert plan.success and plan.executed.final < 0.5, plan.message


def test_controls_that_end_elsewhere_are_a_failure(monkeypatch):
    from vehsim.planning import trajectory
    from vehsim.planning.certificates import Executed

    monkeypatch.setattr(trajectory, "executed", lambda *given: Executed(9.0, 28.0, 28.04))
    marks = ends("car", 20.0, 1151, velocity=REST)
    with pytest.warns(
        UserWarning, match=r"plan failed: .*the controls end 28 m from the planned end, more than 0\.\d+ m"
    ):
        plan = vehsim.plan(vehsim.load_vehicle("car"), None, marks, segments=16, character="stunt")
    assert not plan.success
    monkeypatch.setattr(trajectory, "executed", lambda *given: Executed(0.1, 0.2, 0.2))
    with pytest.warns(UserWarning, match=r"the controls end 0.2 m from the planned end$"):
        assert vehsim.plan(vehsim.load_vehicle("car"), None, marks, segments=16, character="stunt").success


def test_a_mark_outside_the_terrain_is_reported():
    world, helicopter = vehsim.World("hills"), vehsim.load_vehicle("helicopter")
    for goal in ((150.0, 0.0, 2.0), (150.0, 0.0, 200.0)):  # below and above what the border's height goes on at
        marks = [Mark(1001, position=(0, 0, 90), velocity=REST), Mark(1201, position=goal)]
        with pytest.raises(
            InputError, match=r"mark\[1\].position = .*: outside the terrain, which ends at x = 120; move"
        ):
            vehsim.plan(helicopter, world, marks)
    landing = replace(marks[1], position=(0, -200, 90), heading=0, on_ground=True)
    with pytest.raises(InputError, match=r"outside the terrain, which ends at y = -120"):
        vehsim.plan(helicopter, world, [marks[0], landing])
    car = [Mark(1001, position=(110, 0, 0), heading=0, velocity=REST), Mark(1101, position=(130, 0, 0), heading=0)]
    with pytest.warns(
        UserWarning, match=r"mark\[1\].position = .*: outside the terrain, which ends at x = 120; the ground there"
    ):
        make_request(vehsim.load_vehicle("car"), world, car, fps=24, segments=16)
    start = vehsim.State(position=(0, 130, float(world.height([(0.0, 130.0)])[0])))
    with pytest.warns(UserWarning, match="outside the terrain, which ends at y = 120"):
        vehsim.simulate(vehsim.load_vehicle("car"), world, [0.0, 0.0], start=start, duration=0.1)
