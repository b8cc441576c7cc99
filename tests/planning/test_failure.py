"""Failure is a result: which mark, by how much, and the remedy; time limits are kept; failed refinements are left
out."""

import math
import os
import re
import signal
import time
import warnings
from contextlib import suppress
from dataclasses import replace
from itertools import count
from threading import Thread
from types import SimpleNamespace

import casadi as ca
import numpy as np
import pytest

import vehsim
from tests.planning.test_plan import REST, tug
from vehsim import Mark, Shot
from vehsim.errors import InputError, ShotError, SolveError
from vehsim.lie.quaternions import yaw_of
from vehsim.planning import look_at, stay
from vehsim.planning.constraints.mark_constraints import MarkConstraint, _amount
from vehsim.planning.constraints.path_constraints import PathConstraint
from vehsim.planning.deadline import MORE, Deadline
from vehsim.planning.explain import elastic
from vehsim.planning.explain.bounds import strength
from vehsim.planning.explain.earliest import first_frame
from vehsim.planning.explain.feasibility import refusals
from vehsim.planning.iterate import Why
from vehsim.planning.problem.elements import Element, NonlinearProgram
from vehsim.planning.problem.solver import Solver
from vehsim.planning.request import ranges
from vehsim.planning.request.marks import Gate
from vehsim.planning.request.request import make_request
from vehsim.planning.terms import Constraint
from vehsim.world.obstacles.obstacles import box, ellipse
from vehsim.world.terrain.terrain import Terrain

CAR_ASIDE = [Mark(1, position=REST, heading=0, velocity=REST), Mark(49, position=(0, 6, 0), heading=0, velocity=REST)]


def messages_of(marks, vehicle=None, **options):
    request = make_request(vehicle or tug(), None, marks, fps=24, segments=16, **options)
    return [str(refusal) for refusal in refusals(request)]


@pytest.mark.parametrize(
    ("marks", "limits", "expected"),
    [
        # 26 m in 20 frames at 22 m/s: 28.4 frames
        (
            [Mark(1040, position=REST), Mark(1060, position=(26, 0, 0))],
            {"speed": 22},
            "mark[1].frame: frames 1040 to 1060 need 31.2 m/s, limit 22; (earliest|use) 10(69|70)",
        ),
        # rest to rest over 16 m at 4 m/s^2: 2 sqrt(16 / 4) = 4 s
        (
            [Mark(1, position=REST, velocity=REST), Mark(49, position=(16, 0, 0), velocity=REST)],
            {"acceleration": 4},
            "mark[1].frame: frames 1 to 49 need 16 m in 2 s, more than 4 m/s^2 can do; .*(9[7-9]|10[0-9]).*",
        ),
        (
            [Mark(1, position=REST), Mark(25, position=(0, 0, 9))],
            {"climb": 3},
            "mark[1].frame: frames 1 to 25 need 9 m/s up or down, limit 3; (earliest|use) 7[3-5]",
        ),
        (
            [Mark(1, position=REST, heading=170), Mark(13, position=REST, heading=-100)],
            {"turn_rate": np.deg2rad(45)},
            "mark[1].frame: frames 1 to 13 need 180 deg/s, limit 45; (earliest|use) (49|5[0-4])",
        ),
        (
            [Mark(1, position=REST, speed=9), Mark(25)],
            {"speed": 8},
            "mark[0].speed: 9 m/s, limit 8; use at most 8 m/s, or raise limits.speed",
        ),
        (
            [Mark(1, position=REST), Mark(25, position=(0, 0, 9))],
            {"ceiling": 8},
            "mark[1].position: 9 m high, ceiling 8; put it below 8 m, or raise limits.ceiling",
        ),
    ],
)
def test_bounds_name_mark_amount_and_remedy(marks, limits, expected):
    (message,) = messages_of(marks, limits=limits)
    assert re.fullmatch(expected.replace("[1].", r"\[1\].").replace("[0].", r"\[0\].").replace("^", r"\^"), message)


def test_several_limits_of_a_leg_are_one_message():
    """They were repeated with the same remedy."""
    (message,) = messages_of(
        [Mark(1, position=REST, heading=0), Mark(25, position=(30, 0, 9), heading=90)],
        limits={"speed": 20, "climb": 3, "turn_rate": np.deg2rad(45)},
    )
    needed = "31.3 m/s, limit 20, and 9 m/s up or down, limit 3, and 90 deg/s, limit 45"
    assert message.startswith(f"mark[1].frame: frames 1 to 25 need {needed}; ")


def test_what_may_be_loosened_names_its_keys():
    car, marks = vehsim.load_vehicle("car"), CAR_ASIDE
    world = vehsim.World(obstacles=[box("tower", (40, 40, 1), (2, 2, 2))])
    limits = {"grip": 0.5, "joints": {"sigma": 0.3}}
    given = dict(fps=24, segments=8)
    assert make_request(car, None, marks, **given).loosen == "loosen marks"
    assert make_request(car, world, marks, **given).loosen == "loosen marks or clearance"
    request = make_request(car, world, marks, limits=limits, terms=[stay(within=(-9, -9, 9, 9))], **given)
    assert request.loosen == "loosen marks, clearance, limits.grip, limits.joints.sigma or 'stay'"


def test_a_mark_outside_a_stay_is_named():
    helicopter, low = vehsim.load_vehicle("helicopter"), (20, 0, 20)
    stays = (ranges.stay((1050, 1150), above=25), ranges.stay(within=(-5, -5, 45, 5)))
    ends = [Mark(1001, position=(0, 0, 30), velocity=REST), Mark(1201, position=(40, 0, 30), velocity=REST)]
    expected = [
        ({"frame": 1101}, ["mark[1].position: 5 m outside what 'stay' allows for frames 1050 to 1150; "
                           "move z to at least 25, or loosen 'stay'"]),
        ({"frame": 1101, "tolerance": 2.0},
         ["mark[1].position: 3 m outside what 'stay' allows for frames 1050 to 1150; "
          "move z to at least 23, or loosen 'stay'"]),
        ({"frame": 1101, "gate": Gate((1, 0, 0), radius=6)}, []),
        ({"frame": 1160}, []),
    ]  # fmt: skip
    for given, messages in expected:
        marks = [ends[0], Mark(position=low, **given), ends[1]]
        found = refusals(make_request(helicopter, None, marks, fps=24, segments=64, terms=stays))
        assert [str(refusal) for refusal in found] == messages
    aside = [ends[0], Mark(1201, position=(40, 9, 30), velocity=REST)]
    found = refusals(make_request(helicopter, None, aside, fps=24, segments=64, terms=stays[1:]))
    assert str(found[0]).startswith("mark[1].position: 4 m outside what 'stay' allows; move y to at most 5, or")


def test_misses_are_reported_in_the_marks_units():
    """Too short a bend: degrees; and a solve that hardly converges still finds a frame that is late enough."""
    car, helicopter = vehsim.load_vehicle("car"), vehsim.load_vehicle("helicopter")
    turn = [Mark(1, position=REST, heading=0, speed=12), Mark(73, position=(35, 10, 0), heading=90, speed=8)]
    with pytest.warns(UserWarning, match=r"mark\[1\].heading is missed by \d+(\.\d+)? deg$"):
        vehsim.plan(car, None, turn, segments=16, limits={"acceleration": 5})  # only an earliest frame is known
    tight = [turn[0], Mark("free", position=(6, 1, 0), heading=90, speed=8)]
    with pytest.warns(
        UserWarning, match=r"m/s; mark\[1\].heading is missed by .* m; loosen marks, limits.acceleration or 'stay'$"
    ):
        vehsim.plan(car, None, tight, segments=16, limits={"acceleration": 5}, terms=[stay(within=(-1, -3, 8, 4))])
    level = [Mark(1, position=(0, 0, 20), velocity=REST), Mark(101, position=(40, 0, 20), velocity=REST)]
    with pytest.warns(UserWarning, match=r"mark\[1\].frame = 101 is too early; use 2\d\d"):
        late = vehsim.plan(helicopter, None, level, segments=12, limits={"bank": np.deg2rad(10)})
    assert "loosen" not in late.message  # the message has a remedy already
    assert _amount("heading", np.array([0.6, 0.8])) == "143 deg"
    assert _amount("orientation", np.array([0, 0, 0.5])) == "60 deg"


def test_a_mark_missed_near_an_obstacle_comes_with_a_possible_clearance():
    """Wind pushes the boat onto the jetty: it cannot come to rest there without coming closer just before."""
    jetty = box("jetty", (0, 3.0, -0.9), (16, 2.4, 1.5))
    world = vehsim.World(wind=(0, 7, 0), water=0.0, obstacles=[jetty])
    marks = [
        Mark(1, position=(-20, -10, 0), heading=0, velocity=REST),
        Mark(337, position=(0, 0, 0), heading=0, velocity=REST),
    ]
    boat = vehsim.load_vehicle("boat")
    with pytest.warns(UserWarning, match=r"velocity is missed by .* m/s; a motion was found with clearance = \d"):
        failed = vehsim.plan(boat, world, marks, clearance=0.5, segments=32)
    assert 0 <= failed.possible_clearance < 0.5
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        made = vehsim.plan(boat, world, marks, clearance=failed.possible_clearance, segments=32)
    assert made.success and made.clearance >= failed.possible_clearance - 1e-3


@pytest.mark.parametrize("holds", [(0, 0), (0, 24), (24, 0)])
def test_a_mark_missed_in_the_open_comes_with_later_frames(monkeypatch, holds):
    """As for a slide that no relaxed problem shows to be too early: more time is tried before nothing is named."""
    for search in ("too_early", "_by_leg"):
        monkeypatch.setattr(elastic, search, lambda run, guess: Why())
    helicopter = vehsim.load_vehicle("helicopter_lie")

    def planned(frame):
        ends = (1 - holds[0], (0, 0, 20), holds[0]), (frame, (40, 0, 20), holds[1])
        marks = [Mark(at, position=place, velocity=REST, hold=still) for at, place, still in ends]
        return vehsim.plan(helicopter, None, marks, segments=12, limits={"bank": np.deg2rad(20)}, character="stunt")

    with pytest.warns(UserWarning, match=r"missed by .*; a motion was found with mark\[1\].frame = \d+$"):
        failed = planned(130)
    assert failed.possible["mark[1]"] in [math.ceil(130 + share * (129 + holds[0])) for share in (0.1, 0.25, 0.5)]
    assert planned(failed.possible["mark[1]"]).success


def test_the_earliest_frame_of_a_slide_is_one_that_its_controls_repeat():
    """On snow, a coarse motion is found earlier than one from which its controls do not lead astray.

    On some processors no slide is found at all, and no frame is offered.
    """
    car = vehsim.load_vehicle("drift_car", parameters={"surface": "snow"})
    parked = [box(name, (x, 0, 0), (4.3, 1.8, 1.2)) for name, x in (("behind", -5.5), ("ahead", 5.5))]
    world = vehsim.World(obstacles=parked)

    def planned(frame):
        marks = [
            Mark(1001, position=(-2, 24, 0), heading=-90, velocity=REST, joints={"sigma": 0.0}),
            Mark(frame, position=(0, 0, 0), heading=0, velocity=REST),
        ]
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            return vehsim.plan(car, world, marks, clearance=0.2, segments=48, character="stunt")

    failed = planned(1097)
    offered = failed.possible.get("mark[1]")
    assert not failed.success and (offered is None or planned(offered).success)


def test_feasible_marks_are_not_refused():
    """Slightly inside every bound, and free marks, which have no frame that could be too early."""
    assert not messages_of([Mark(1, position=REST), Mark(30, position=(26, 0, 0))], limits={"speed": 22})
    assert not messages_of([Mark(1, position=REST), Mark("free", position=(999, 0, 0))], limits={"speed": 22})
    assert not messages_of([Mark(1, position=REST), Mark(25, position=(23, 0, 0), tolerance=1.5)], limits={"speed": 22})
    assert not messages_of([Mark(1, position=REST, velocity=REST), Mark(97, position=(15.9, 0, 0), velocity=REST)],
                    limits={"acceleration": 4})  # fmt: skip


def test_strength_is_the_controls_at_their_corners():
    assert strength(tug(limit=10.0)) == pytest.approx(np.sqrt(3) * 10 / 10)
    assert strength(tug(limit=10.0, gravity=9.81)) == pytest.approx(np.sqrt(3) + 9.81)
    car = vehsim.load_vehicle("car")
    braking = 4000 / 0.32 / (1350 + 2.4 / 0.32**2)
    assert strength(tug()) == np.inf and braking <= strength(car) <= 1.03 * braking


def test_a_failure_is_explained_in_the_same_words_however_slow_the_machine_is(monkeypatch):
    """Without a time limit the clock has no influence: if it advances ten minutes per call, the message is the same."""

    def message():
        with pytest.warns(UserWarning, match="plan failed"):
            return vehsim.plan(vehsim.load_vehicle("car"), None, CAR_ASIDE, segments=12).message

    expected, clock = message(), count(0.0, 600.0)
    monkeypatch.setattr(time, "monotonic", lambda: next(clock))
    assert message() == expected and "too early; use" in expected


def test_failed_solves_report_the_violation_and_the_remedy():
    with pytest.warns(
        UserWarning, match=r"mark\[1\].frame = 49 is too early; use 1\d\d; .*mark\[1\].position is missed by"
    ):
        plan = vehsim.plan(vehsim.load_vehicle("car"), None, CAR_ASIDE, segments=12)
    assert not plan.success and np.all(np.isfinite(plan.clip.positions))


def test_time_limits_are_kept():
    helicopter = vehsim.load_vehicle("helicopter")
    marks = [Mark(1, position=(0, 0, 30), velocity=REST), Mark("free", position=(90, 40, 40), velocity=REST)]
    vehsim.plan(helicopter, None, marks, segments=256, refine=False)  # builds the problem
    began = time.process_time()  # CPU time, because the machine may be busy
    with pytest.warns(UserWarning, match="time limit") as heard:
        plan = vehsim.plan(helicopter, None, marks, segments=256, time_limit=1e-3)
    assert [one.filename for one in heard] == [__file__]  # at the line of the caller
    assert not plan.success and plan.iterations <= 3 and time.process_time() - began < 20
    assert len(plan.clip) > 2


def test_a_deadline_reserves_time_to_certify_and_starts_nothing_too_long(monkeypatch):
    now = [100.0]
    monkeypatch.setattr("vehsim.planning.deadline.time", SimpleNamespace(monotonic=lambda: now[0]))
    deadline = Deadline(110.0)

    def finish():
        now[0] += 2.0

    deadline.rehearse(finish)
    assert deadline.solving == 110.0 - MORE * 2.0 and not deadline.late
    deadline.guessed = 9.0  # building a problem may take half of it, and 5 s remain
    assert not deadline.hopeless
    deadline.guessed = 11.0
    assert deadline.hopeless and not deadline.late and not Deadline().hopeless
    now[0] += 1.0
    # 20 ms per node; from a motion half of that, so 4 s are enough for 400
    deadline.solved(now[0] - 1.0, 50, over=False)
    assert deadline.allows(390) and not deadline.cut and not deadline.allows(410) and deadline.cut
    assert not deadline.late
    deadline.solved(now[0], 50, over=True)
    assert deadline.late and not deadline.allows(1) and not Deadline().late and Deadline().allows(10**9)


def test_work_after_certification_is_measured_too(monkeypatch):
    """Wheels are placed on the terrain at the end, which takes seconds: a share of the motion is used to estimate
    it."""
    from vehsim.planning import iterate, trajectory

    now, deadlines, place = [0.0], [], trajectory.placed

    def slowly(clip, world, **options):
        now[0] += clip.duration
        return place(clip, world, **options)

    monkeypatch.setattr("vehsim.planning.deadline.time", SimpleNamespace(monotonic=lambda: now[0]))
    monkeypatch.setattr(trajectory, "placed", slowly)
    monkeypatch.setattr(iterate, "Deadline", lambda end: deadlines.append(Deadline(end)) or deadlines[-1])
    marks = [Mark(1, position=REST, heading=0, velocity=REST), Mark(73, position=(12, 1, 0), velocity=REST)]
    with warnings.catch_warnings(record=True) as heard:  # no warnings about the tyres of the initial guess
        vehsim.plan(vehsim.load_vehicle("car"), vehsim.World("hills"), marks, segments=16, time_limit=1e6)
    assert len([one for one in heard if "tyre" in str(one.message)]) <= 1
    assert deadlines[0].kept == pytest.approx(3.0)  # a second on a clip of a second: three here


@pytest.mark.parametrize("hills", [False, True])
def test_out_of_time_while_loading_returns_the_initial_guess_and_the_cause(tmp_path, monkeypatch, hills):
    """Neither a route nor distances are computed: the result is the straight path, whose clearance was not measured."""
    monkeypatch.setenv("VEHSIM_CACHE", str(tmp_path))
    monkeypatch.setattr("vehsim.planning.guesses.astar.guess_drive", lambda *args: pytest.fail("sought a path"))
    if hills:
        bumps = Terrain("bumps", np.random.default_rng(0).uniform(0, 3, (30, 30)))
        vehicle, world, took = vehsim.load_vehicle("helicopter"), vehsim.World(bumps), "measuring distances to the ter"
    else:
        world = vehsim.World(obstacles=[ellipse("e", (9, 9), (1, 1))])
        vehicle, took = vehsim.load_vehicle("car"), "path"
    z = 20.0 * hills
    marks = [Mark(1, position=(0, 0, z), velocity=REST), Mark(73, position=(20, 4, z), velocity=REST)]
    with pytest.warns(UserWarning, match=rf"time limit reached before solving began \(.*{took}.*\): .*initial guess"):
        plan = vehsim.plan(vehicle, world, marks, segments=16, time_limit=1e-9)
    assert not plan.success and np.isnan(plan.clearance) and plan.iterations == 0
    off = plan.clip.positions[:, :2] @ [-4, 20] / np.hypot(20, 4)
    assert np.abs(off).max() < 0.1 and not [file for file in tmp_path.iterdir() if file.name.startswith("distance")]


def test_a_solver_stops_before_an_iteration_that_would_end_too_late(monkeypatch):
    """Iterations of one second each and 4.5 seconds: four are completed, the fifth is not started."""
    from vehsim.planning.problem.solver import _Callback

    class Watched:
        watch, violations = None, staticmethod(np.zeros_like)

    now, watched = [0.0], Watched()
    monkeypatch.setattr("vehsim.planning.problem.solver.time", SimpleNamespace(monotonic=lambda: now[0]))
    callback, stops = _Callback(watched, 1, 1, 1), []
    callback.begin(4.5)
    while not stops or not stops[-1]:
        now[0] += 1.0
        stop = np.zeros(1)
        callback.eval_buffer([memoryview(np.zeros(1))] * 3, [memoryview(stop)])
        stops.append(stop[0])
    assert len(stops) == 4 and callback.out_of_time


def test_with_little_time_a_plan_has_a_lower_order(monkeypatch):
    """No time for the last refinement: fewer segments, at order 2; and the message says what was left out."""

    def allows(self, nodes):
        self.cut |= nodes > 100
        return nodes <= 100

    monkeypatch.setattr(Deadline, "allows", allows)
    marks = [Mark(1, position=REST, velocity=REST), Mark(73, position=(6, 2, 0), heading=90, velocity=REST)]
    plan = vehsim.plan(tug(), None, marks, segments=128, time_limit=1e6)
    assert plan.success and (plan.segments, plan.order) == (64, 2), plan.message
    assert "not refined to 128 segments of order 4: time limit reached" in plan.message


def test_nothing_is_built_after_the_time_limit(monkeypatch):
    """A plan found just before its deadline is not refined: it is returned unchanged."""
    from vehsim.planning import refine

    made = []
    monkeypatch.setattr(Deadline, "late", property(lambda self: self.a_node > 0))
    monkeypatch.setattr(refine, "prolongate", lambda *given: made.append(given))
    marks = [Mark(1, position=REST, velocity=REST), Mark(73, position=(6, 2, 0), heading=90, velocity=REST)]
    plan = vehsim.plan(tug(), None, marks, segments=8, time_limit=1e6, character="stunt")
    assert plan.success and not made and "not refined to 8 segments of order 4: time limit reached" in plan.message


@pytest.mark.parametrize("character", ["stunt", "normal"])
def test_nothing_is_solved_again_after_the_time_limit(monkeypatch, character):
    """Out of time: neither for violated inactive constraints nor to move free marks to whole frames."""
    from vehsim.planning import solve
    from vehsim.planning.constraints.obstacle_clearance import ObstacleClearance

    solves, once = [], solve._solve_active
    monkeypatch.setattr(solve, "_solve_active", lambda *given: (solves.append(given), once(*given))[1])
    monkeypatch.setattr(ObstacleClearance, "violated", lambda self, solved: replace(self))
    car, world = vehsim.load_vehicle("car"), vehsim.World(obstacles=[ellipse("e", (9, 9), (1, 1))])
    marks = [Mark(1, position=REST, heading=0, velocity=REST), Mark("free", position=(20, 4, 0), velocity=REST)]
    monkeypatch.setattr(Deadline, "late", property(lambda self: self.a_node > 0))
    with pytest.warns(UserWarning, match="iterations allowed"):
        plan = vehsim.plan(car, world, marks, segments=16, max_iterations=1, character=character)
    assert not plan.success and len(solves) == 1


def test_a_refinement_out_of_time_keeps_the_coarser_plan(monkeypatch):
    """The finer solve fails: the coarser plan is returned, and the message says so."""
    from vehsim.planning import planner, refine
    from vehsim.planning.problem.solver import Patience

    solve = refine.solve

    def failing(run, iterate, patience):
        solved = solve(run, iterate, patience)
        fine = solved.layout.order > 2
        return replace(solved, solution=replace(solved.solution, success=False)) if fine else solved

    monkeypatch.setattr(refine, "solve", failing)
    monkeypatch.setattr(planner, "AT_ONCE", Patience(0))
    marks = [Mark(1, position=REST, velocity=REST), Mark(73, position=(6, 2, 0), heading=90, velocity=REST)]
    plan = vehsim.plan(tug(), None, marks, segments=8, character="stunt")
    assert plan.success and plan.order == 2 and "not refined to 8 segments of order 4" in plan.message


def test_shots_report_what_bounds_rule_out():
    marks = [
        {"frame": 1040, "position": [0, 0, 30], "velocity": [0, 0, 0]},
        {"frame": 1060, "position": [26, 0, 30]},
    ]
    motion = {"method": "plan", "limits": {"speed": 22}, "mark": marks}
    shot = {"shot": {"schema": 1, "name": "late"}, "vehicle": [{"name": "v", "asset": "helicopter", "motion": motion}]}
    with pytest.raises(ShotError, match=r"mark\[1\].frame = 1060: frames 1040 to 1060 need 31.2 m/s, limit 22; "):
        Shot.from_dict(shot).solve()


@pytest.mark.parametrize(
    ("extra", "message"),
    [
        ({"look": [{"at": [0, 0, 0], "frames": [990, 1030]}]}, "frames = 990: before the first mark"),
        ({"look": [{"at": [0, 0, 0], "axis": "z"}]}, "z cannot be level"),
        ({"stay": [{"above": 9, "below": 3}]}, "above less than below"),
        ({"limits": {"steering": 20}}, "limits.steering.*no joint 'sigma'"),
        ({"limits": {"joints": {"wheel": 1}}}, "limits.joints.wheel.*no such joint"),
        ({"limits": {"joints": 3}}, "limits.joints.*not a table"),
        ({"solver": "snopt"}, "solver.*not available in this build of CasADi; choose one of ipopt"),
        ({"time_limit": -1}, "time_limit"),
    ],
)
def test_wrong_tables_of_shots_are_named(extra, message):
    marks = [
        {"frame": 1001, "position": [0, 0, 30], "velocity": [0, 0, 0]},
        {"frame": 1100, "position": [26, 0, 30]},
    ]
    motion = {"method": "plan", "mark": marks, **extra}
    shot = {"shot": {"schema": 1, "name": "wrong"}, "vehicle": [{"name": "v", "asset": "helicopter", "motion": motion}]}
    with pytest.raises(ShotError, match=message):
        Shot.from_dict(shot).solve()


class Stop(KeyboardInterrupt):
    """An exception that a user's program raises at a signal."""


def stop(number, frame):
    raise Stop


@pytest.fixture
def stopping():
    before = signal.signal(signal.SIGINT, stop)
    yield
    assert signal.getsignal(signal.SIGINT) is stop
    signal.signal(signal.SIGINT, before)


TUG_ASIDE = [Mark(1, position=REST, velocity=REST), Mark(73, position=(6, 2, 0), velocity=REST)]


def interrupting():
    """A law that is interrupted, and loses the exception as CasADi's wrappers do, which clear it."""

    def law(knot):
        with suppress(Stop):
            os.kill(os.getpid(), signal.SIGINT)
            time.sleep(0.05)
        return knot.position[0]

    return Constraint("here", law, -100.0, 100.0)


def test_an_interrupt_that_casadi_swallows_is_raised_later(stopping):
    """As its handler raised it; before the next solve, or at the end."""
    with pytest.raises(Stop):
        vehsim.plan(tug(), None, TUG_ASIDE, segments=8, terms=[interrupting()])
    assert vehsim.plan(tug(), None, TUG_ASIDE, segments=8, refine=False).success  # afterwards it is forgotten


def test_an_interrupt_in_a_plan_within_a_plan_ends_both(stopping):
    def law(knot):
        with suppress(Stop):
            vehsim.plan(tug(), None, TUG_ASIDE, segments=8, terms=[interrupting()])
        return knot.position[0]

    with pytest.raises(Stop):
        vehsim.plan(tug(), None, TUG_ASIDE, segments=8, terms=[Constraint("here", law, -100.0, 100.0)])


def test_an_interrupt_whose_handler_returns_stops_nothing():
    interrupts, texts = [], []

    def progress(text, fraction):
        texts.append(text)
        if len(texts) == 3:
            os.kill(os.getpid(), signal.SIGINT)

    before = signal.signal(signal.SIGINT, lambda number, frame: interrupts.append(number))
    try:
        plan = vehsim.plan(tug(), None, TUG_ASIDE, segments=8, terms=[interrupting()], progress=progress)
    finally:
        signal.signal(signal.SIGINT, before)
    assert plan.success and len(interrupts) >= 2


def test_a_plan_in_another_thread_does_not_affect_an_interrupt(stopping):
    """It belongs to the main thread."""
    plans = []

    def law(knot):
        with suppress(Stop):
            os.kill(os.getpid(), signal.SIGINT)
            time.sleep(0.05)
        thread = Thread(target=lambda: plans.append(vehsim.plan(tug(), None, TUG_ASIDE, segments=8)))
        thread.start()
        thread.join()
        return knot.position[0]

    with pytest.raises(Stop):
        vehsim.plan(tug(), None, TUG_ASIDE, segments=8, terms=[Constraint("here", law, -100.0, 100.0)])
    assert plans and all(plan.success for plan in plans)


def test_exceptions_of_the_progress_callback_are_raised():
    """It is not reported as a time limit."""

    def progress(text, fraction):
        raise ValueError(text)

    with pytest.raises(ValueError, match="iteration"):
        vehsim.plan(tug(), None, TUG_ASIDE, segments=8, progress=progress)


def test_a_broken_motion_is_reported_with_its_frame(monkeypatch):
    monkeypatch.setattr(Deadline, "late", property(lambda self: self.a_node > 0))
    marks = [Mark(1001, position=(0, 0, 10), velocity=(0, 0, 0)), Mark(1097, position=(20, 5, 10), velocity=(0, 0, 0))]
    with pytest.warns(UserWarning, match="plan failed"):
        plan = vehsim.plan(vehsim.load_vehicle("helicopter"), None, marks, segments=24, max_iterations=2)
    found = re.search(r"the motion at frame (\d+), off by", plan.message)
    assert found and 1001 <= int(found[1]) < 1097


def test_marks_that_are_too_early_are_named_among_obstacles_too(monkeypatch):
    """Retries end elsewhere; what the first path misses is what an animator can fix."""
    monkeypatch.setattr("vehsim.planning.fallbacks.RETRIES", ((1.2, 0.3),))
    world = vehsim.World(obstacles=[box("tower", (15, 12, 0), (4, 4, 40))])
    marks = [Mark(1001, position=(0, 0, 10), velocity=REST), Mark(1081, position=(30, 0, 10), velocity=REST)]
    with pytest.warns(UserWarning, match=r"mark\[1\]\.frame = 1081 is too early; use 11[3-6]\d"):
        plan = vehsim.plan(
            vehsim.load_vehicle("helicopter"), world, marks, segments=16, limits={"bank": np.radians(20)}
        )
    assert not plan.success and len(plan.clip)


def test_the_earliest_frame_is_found_without_a_missed_mark(monkeypatch):
    """The problem that may miss marks is not solved, the one that may be late is; feasible marks are not reported as
    late."""
    monkeypatch.setattr(elastic, "_missed", lambda run, guess: ("", None))
    monkeypatch.setattr("vehsim.planning.fallbacks.RETRIES", ())
    with pytest.warns(UserWarning, match=r": mark\[1\].frame = 49 is too early; use \d+$") as heard:
        vehsim.plan(vehsim.load_vehicle("car"), None, CAR_ASIDE, segments=12)
    frame = int(re.search(r"use (\d+)", str(heard[0].message))[1])
    assert vehsim.plan(vehsim.load_vehicle("car"), None, [CAR_ASIDE[0], replace(CAR_ASIDE[1], frame=frame)]).success
    with pytest.warns(
        UserWarning, match=r"iterations allowed: all constraints are met, but the cost is not minimal yet"
    ):
        vehsim.plan(tug(), None, TUG_ASIDE, segments=16, max_iterations=1, character="stunt")


def test_marks_in_rock_and_without_a_route_are_named():
    """By mark, at its own key; the clearance of a route is that requested plus what the vehicle needs."""
    x, y = np.meshgrid(np.arange(0, 120.0, 2), np.arange(0, 60.0, 2))
    basin = (np.abs(x - 30) < 22) | (np.abs(x - 90) < 22)
    world = vehsim.World(Terrain("basins", np.where(basin & (np.abs(y - 30) < 22), 0.0, 60.0), (0, 0), (2, 2)))

    def refusal(*goal, **options):
        marks = [Mark(1, position=(30, 30, 10), velocity=REST), Mark(97, position=goal)]
        with pytest.raises((InputError, SolveError)) as caught:
            vehsim.plan(vehsim.load_vehicle("helicopter"), world, marks, segments=16, **options)
        return str(caught.value)

    assert refusal(60, 30, 10).startswith("mark[1].position = [60.0, 30.0, 10.0]: lies 50.0 m inside the rock; raise")
    lid = {"ceiling": 40}
    assert refusal(90, 30, 50, limits=lid).startswith("mark[1].position = [90.0, 30.0, 50.0]: lies above the ceiling")
    assert refusal(90, 30, 10, limits=lid) == (
        "no path from mark[0] to mark[1] with 1 m clearance and 5.4 m for the helicopter itself below the ceiling of "
        "40 m; widen the gap to 14 m, raise the ceiling or lower the clearance"
    )


def test_a_robot_reverses_where_turning_round_takes_too_long():
    """The goal is behind it and its turn rate is limited; it was told that the frame is too early."""
    robot = vehsim.load_vehicle("two_wheeled")
    goal = (1.8 * math.cos(math.radians(158.7 + 180)), 1.8 * math.sin(math.radians(158.7 + 180)), 0)
    marks = [
        vehsim.Mark(1, position=REST, heading=151.9, velocity=REST),
        vehsim.Mark(165, position=goal, velocity=REST, hold=24),
    ]
    limits = {"acceleration": 0.278, "turn_rate": math.radians(56), "speed": 0.626}
    plan = vehsim.plan(robot, None, marks, segments=12, limits=limits)
    assert plan.success
    half = plan.clip.at([3.0])
    ahead = np.array([math.cos(float(yaw_of(half.orientations)[0])), math.sin(float(yaw_of(half.orientations)[0]))])
    assert ahead @ np.subtract(goal, half.positions[0])[:2] < 0


def test_a_car_that_must_change_direction_at_every_mark_finds_its_way():
    """Back, forward, and a quarter turn in its own length, with holds: straight paths and all in reverse both fail."""
    h = -33.489
    marks = [
        Mark(1, position=(0.934, 16.624, 0), heading=h, velocity=REST),
        Mark(407, position=(-5.171, 20.663, 0), heading=h, velocity=REST, hold=12, joints={"sigma": 0.0}),
        Mark(807, position=(0.885, 16.657, 0), heading=h, velocity=REST, hold=30, tolerance=0.351),
        Mark(1336, position=(5.879, 7.887, 0), heading=-87.196, velocity=REST, hold=3),
    ]
    car, limits = vehsim.load_vehicle("car"), {"acceleration": 1.239}
    assert vehsim.plan(car, None, marks, segments=36, fps=60, limits=limits, clearance=0.5).success


def test_a_car_reverses_to_pass_a_gate_behind_it_forwards():
    marks = [
        Mark(101, position=(14.279, -11.282, 0), heading=-8.785, velocity=REST, hold=12),
        Mark(
            332, position=(4.325, -11.207, 0), heading=-25.496, speed=1.093, gate=Gate((0.9026, -0.4304, 0), radius=1)
        ),
    ]
    limits = {"steering_rate": math.radians(24.641)}
    plan = vehsim.plan(vehsim.load_vehicle("car"), None, marks, segments=12, limits=limits)
    _, ahead, aside = plan.clip.twists[-1]
    assert plan.success and ahead > 0 and math.hypot(ahead, aside) == pytest.approx(1.093, abs=1e-3)


def test_the_worst_violation_of_a_mark_has_its_unit():
    """It was "mark[0].heading, off by 1" where the vehicle points to the side."""
    car, marks = vehsim.load_vehicle("car"), [Mark(1, position=(0, 0, 0), heading=0), Mark(49, position=(9, 0, 0))]
    rows = MarkConstraint(marks, 0)
    labels = ["position"] * 2 + ["heading"] * 2 + ["speed"]
    use, off = SimpleNamespace(element=SimpleNamespace(labels=labels)), np.array([3.0, 4.0, 1.0, 0.0, 2.0])
    assert [rows.amount(use, k, off) for k in (0, 2, 4)] == ["5 m", "90 deg", "2 m/s"]
    with pytest.warns(UserWarning, match=r"worst violation: .*, off by [\d.e+-]+( m| deg| m/s)?;"):
        vehsim.plan(car, None, [marks[0], replace(marks[1], position=(9, 9, 0), heading=180)], max_iterations=2)


def test_rows_of_a_range_are_named_with_their_frames():
    """They were numbered: look_at[3]."""
    marks = [Mark(1001, position=(0, 0, 0), heading=0, velocity=(0, 0, 0)), Mark(1097, position=(20, 0, 0))]
    terms = [look_at((60, 0, 0), (1030, 1060)), stay((1030, 1060), within=(-1, -5, 19, 5))]
    plan = vehsim.plan(vehsim.load_vehicle("car"), None, marks, segments=12, terms=terms)
    iterate, named = plan._iterate, {}
    for use in iterate.problem.uses:
        if isinstance(block := iterate.blocks[use.owner], PathConstraint):
            named[block.constraint.name] = [block.describe(use, k, 0, iterate) for k in (0, use.count - 1)]
    for name in ("look_at", "stay"):
        assert named[name] == [f"{name} at frame 1030", f"{name} at frame 1060"]


def test_only_marks_with_a_position_have_a_first_frame():
    """The planner adds marks without one where a stay begins and ends."""
    terms = [stay((20, 40), within=(-50, -50, 50, 50))]
    request = make_request(vehsim.load_vehicle("car"), None, CAR_ASIDE, fps=24, segments=16, terms=terms)
    assert [mark.position is None for mark in request.marks] == [False, True, True, False]
    assert all(first_frame(request, i, i + 1, 41) is None for i in range(3))


@pytest.mark.parametrize("velocity, remedy", [(None, "earliest 1069"), (REST, "use 1[01][0-9][0-9]")])
def test_only_a_proven_frame_is_called_the_earliest(velocity, remedy):
    """26 m at 22 m/s take 28.4 frames; from rest more, and the fastest motion that is found proves nothing."""
    marks = [vehsim.Mark(1040, position=REST, velocity=velocity), vehsim.Mark(1060, position=(26, 0, 0))]
    request = make_request(vehsim.load_vehicle("helicopter"), None, marks, fps=24, segments=8, limits={"speed": 22})
    (refusal,) = refusals(request)
    assert re.fullmatch(remedy, refusal.remedy)


def test_the_least_time_of_a_landing_is_one_that_its_thrust_allows():
    """Without clearance, the landing's cone gave no number, and the initial guess was called a motion."""
    heli = vehsim.load_vehicle("helicopter")
    marks = [
        vehsim.Mark(1, position=(-30, 0, 30), heading=0, velocity=REST),
        vehsim.Mark(121, position=REST, heading=0, on_ground=True),
    ]
    found = first_frame(make_request(heli, vehsim.World("flat"), marks, fps=24, segments=64), 0, 1, 2)
    assert found is not None and 120 < found < 145


def test_a_solve_that_yields_no_number_meets_nothing():
    x = ca.SX.sym("x")
    problem = NonlinearProgram(1)
    problem.add(Element("bad", x, g=x / (x - x), lower=0.0, upper=np.inf, f=x**2), np.array([[0]]))
    found = Solver(problem).solve(np.ones(1), -np.ones(1), np.ones(1), np.zeros(0))
    assert not found.success and found.violation == math.inf
