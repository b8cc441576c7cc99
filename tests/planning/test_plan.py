"""Plans compared with closed forms, replays, independent execution and certified clearance."""

import warnings

import casadi as ca
import numpy as np
import pytest

import vehsim
from vehsim import Mark, State
from vehsim.errors import InputError
from vehsim.integrators import Integrator
from vehsim.lie import SO3xR3
from vehsim.planning.problem.elements import NonlinearProgram
from vehsim.planning.request.request import make_request
from vehsim.planning.trim import leans, trim, upright
from vehsim.vehicles import Control, Holonomic

REST = (0.0, 0.0, 0.0)


def tug(gravity=0.0, limit=np.inf):
    """A body with forces along its own axes and three torques."""
    names = ("tx", "ty", "tz", "fx", "fy", "fz")
    return Holonomic(
        name="tug",
        group=SO3xR3,
        inertia=(3.0, 4.0, 5.0, 10.0, 10.0, 10.0),
        controls=tuple(Control(n, -limit, limit, 10.0) for n in names),
        wrench=lambda c: c,
        gravity=gravity,
    )


@pytest.fixture(scope="module")
def helicopter():
    return vehsim.load_vehicle("helicopter")


@pytest.fixture(scope="module")
def flight(helicopter):
    """The helicopter in free space, rest to rest, with a free goal frame: solved once, used by many tests."""
    marks = [
        Mark(1001, position=(0, 0, 30), heading=0, velocity=REST),
        Mark("free", position=(120, 40, 35), heading=40, velocity=REST),
    ]
    return vehsim.plan(helicopter, None, marks, segments=32)


def test_least_effort_between_rests_is_the_cubic():
    """Closed form: position 3s^2 - 2s^3 with force linear in time, and cost 12 m^2 d^2 / T^3."""
    distance, T = 6.0, 3.0
    upright = (1, 0, 0, 0)  # a given attitude, so that rest does not require balance
    marks = [
        Mark(1, position=REST, orientation=upright, velocity=REST),
        Mark(73, position=(distance, 0, 0), orientation=upright, velocity=REST),
    ]
    plan = vehsim.plan(
        tug(), None, marks, segments=16, cost={"effort": 1.0, "smoothness": 0.0}, refine=False, character="stunt"
    )
    assert plan.success
    s = plan.clip.times / T
    np.testing.assert_allclose(plan.clip.positions[:, 0], distance * (3 * s**2 - 2 * s**3), atol=2e-2)
    np.testing.assert_allclose(plan.clip.controls[:, 3], 10 * 6 * distance / T**2 * (1 - 2 * s), atol=1e-6)
    assert plan.cost == pytest.approx(12 * distance**2 / T**3, rel=1e-8)  # Galerkin weights make it exact
    np.testing.assert_allclose(plan.clip.orientations, np.tile([1, 0, 0, 0], (17, 1)), atol=1e-9)


def test_least_time_is_bang_bang():
    """Closed form: T = 2 sqrt(m d / F) for a force bounded by F."""
    marks = [
        Mark(1, position=REST, orientation=(1, 0, 0, 0), velocity=REST),
        Mark("free", position=(8, 0, 0), orientation=(1, 0, 0, 0), velocity=REST),
    ]
    plan = vehsim.plan(
        tug(limit=20.0), None, marks, fps=2400, segments=64, cost={"time": 1.0, "smoothness": 0.0}, character="stunt"
    )
    assert plan.duration == pytest.approx(2 * np.sqrt(10 * 8 / 20.0), rel=0.01)


def test_plan_meets_its_marks(flight, helicopter):
    clip = flight.clip
    assert flight.success and flight.defect < 1e-8
    np.testing.assert_allclose(clip.positions[[0, -1]], [(0, 0, 30), (120, 40, 35)], atol=1e-7)
    np.testing.assert_allclose(clip.twists[[0, -1]], 0, atol=1e-7)
    T = clip.matrices()[-1]
    assert np.arctan2(T[1, 0], T[0, 0]) == pytest.approx(np.deg2rad(40), abs=1e-7)
    assert np.arccos(T[2, 2]) == pytest.approx(leans(helicopter), abs=1e-5)


def test_free_mark_lands_on_a_whole_frame(flight):
    assert flight.clip.frames[-1] == flight.clip.end_frame
    assert flight.clip.resample().frames[-1] == flight.clip.end_frame


def test_controls_stay_in_their_bounds(flight, helicopter):
    for column, control in zip(flight.clip.controls.T, helicopter.controls, strict=True):
        slack = 1e-6 * control.scale
        assert control.lower - slack <= column.min() and column.max() <= control.upper + slack


def test_plan_replays_through_the_integrator(helicopter):
    """One definition at order 2: the forward step from the first state under the plan's controls reproduces the
    plan."""
    goal = Mark("free", position=(120, 40, 35), heading=40, velocity=REST)
    marks = [Mark(1001, position=(0, 0, 30), heading=0, velocity=REST), goal]
    flight = vehsim.plan(helicopter, None, marks, segments=32, refine=False)
    assert flight.order == 2
    step = flight.clip.times[1]
    integrator = Integrator(helicopter, step)
    replay = integrator.rollout(flight.clip.state(0), flight.clip.controls)
    # an unstable vehicle amplifies the solver's tolerance with time: compare one second, then step by step
    first = int(1 / step)
    np.testing.assert_allclose(replay.positions[:first], flight.clip.positions[:first], atol=1e-8)
    for k in range(len(flight.clip) - 1):
        state = integrator.step(flight.clip.state(k), flight.clip.controls[k], flight.clip.controls[k + 1])
        np.testing.assert_allclose(state.position, flight.clip.positions[k + 1], atol=1e-8)


def test_a_refined_plan_is_whole_segments_of_order_four(flight):
    """One refinement suffices, and costs no nodes: its segments have no inner ones."""
    assert (flight.order, flight.segments, len(flight.clip)) == (4, 32, 33)
    assert flight.executed.final < 0.02


def test_an_easy_plan_makes_nothing_twice(monkeypatch):
    """Marks of one shape share their equations, the clip is built once, and a motion that is found needs no proof that
    there is one."""
    from vehsim.planning import planner, trajectory
    from vehsim.planning.constraints import mark_constraints

    counts = dict.fromkeys(("build_clip", "mark_element", "refusals"), 0)

    def count(module, name):
        work = getattr(module, name)

        def counted(*given, **options):
            counts[name] += 1
            return work(*given, **options)

        monkeypatch.setattr(module, name, counted)

    count(trajectory, "build_clip")
    count(mark_constraints, "mark_element")
    count(planner, "refusals")
    marks = [
        Mark(1, position=REST, heading=0, velocity=REST),
        Mark(145, position=(25, 6, 0), heading=20, velocity=REST),
    ]
    assert vehsim.plan(vehsim.load_vehicle("car_lie"), None, marks, segments=32, character="stunt").success
    assert counts == {"build_clip": 1, "mark_element": 1, "refusals": 0}


@pytest.mark.parametrize("name, heading, order", [("helicopter_lie", 20, [4]), ("boat", 150, [4, 2, 4])])
def test_easy_problems_are_solved_at_once(name, heading, order, monkeypatch):
    """With the same motion as on few segments first; what is not easy goes on there, as if nothing had been tried."""
    from vehsim.planning import planner, solve
    from vehsim.planning.problem.solver import Patience

    solved, answer = [], solve._answer

    def note(run, iterate, *more):
        solved.append(iterate.layout.order)
        return answer(run, iterate, *more)

    monkeypatch.setattr(solve, "_answer", note)
    if name == "boat":  # in ten iterations it is not easy
        monkeypatch.setattr(planner, "AT_ONCE", Patience(10))
    height = 30 if name != "boat" else 0
    vehicle = vehsim.load_vehicle(name, {"skeg": 0.0} if name == "boat" else None)  # with its skeg it needs 14 s
    marks = [Mark(1, position=(0, 0, height), heading=0, velocity=REST)]
    marks.append(Mark(241, position=(16, 3, height), heading=heading, velocity=REST))
    made = [vehsim.plan(vehicle, None, marks, segments=32, character="stunt")]
    assert solved == order
    monkeypatch.setattr(planner, "AT_ONCE", Patience(0))
    made.append(vehsim.plan(vehicle, None, marks, segments=32, character="stunt"))
    assert all(plan.success and plan.order == 4 and plan.segments == 32 for plan in made)
    np.testing.assert_allclose(made[0].clip.positions, made[1].clip.positions, atol=1e-4)


def test_patience_ends_early_if_constraints_are_missed_by_far():
    from vehsim.planning.problem.solver import EARLY, ENDLESS, Patience

    patience = Patience(20, early=1e-2)
    assert next(k for k in range(1, 30) if patience.ends(k, 0.1)) == EARLY
    assert next(k for k in range(1, 30) if patience.ends(k, 1e-3)) == 21
    assert not any(ENDLESS.ends(k, 0.1) for k in range(1000))


def test_patience_goes_on_where_constraints_are_nearly_met():
    """One iteration before its end, a solve was given up for three others."""
    from vehsim.planning.problem.solver import Patience

    patience = Patience(20, near=1e-2)
    assert next(k for k in range(1, 60) if patience.ends(k, 1e-3)) == 31
    assert next(k for k in range(1, 60) if patience.ends(k, 0.1)) == 21
    assert not patience.ends(25, 1e-3) and patience.ends(25, 0.1)


@pytest.mark.parametrize(("ratio", "found"), [(1.005, "near"), (1.05, "begun")])
def test_a_motion_near_a_stunt_takes_the_place_of_an_unfinished_one_if_it_is_as_good(ratio, found, monkeypatch):
    """The unfinished one was solved again from its guess, which took as long as all the rest."""
    from types import SimpleNamespace

    from vehsim.planning import planner

    def motion(cost, success):
        return SimpleNamespace(success=success, solution=SimpleNamespace(cost=cost), request=SimpleNamespace(traits=0))

    begun, near, stunt = motion(0.0, False), motion(ratio, True), motion(1.0, True)
    monkeypatch.setattr(planner, "solve", lambda *_: motion(1.0, False))
    monkeypatch.setattr(planner, "without_character", lambda *_: stunt)
    monkeypatch.setattr(planner, "nearby", lambda *_: near)
    monkeypatch.setattr(planner, "_is_too_hard", lambda *_: False)
    monkeypatch.setattr(planner, "_pressed", lambda *_: False)
    made = planner._quickly(None, begun, None)
    assert made == {"near": (near, None), "begun": (begun, stunt)}[found]


def test_executed_motion_ends_where_planned(flight):
    assert flight.executed.final < 0.1 and flight.executed.mean <= flight.executed.largest


def test_helicopter_flies_nose_first(flight):
    moving = np.linalg.norm(flight.clip.twists[:, 3:5], axis=1) > 4
    forward, sideways = flight.clip.twists[moving, 3], np.abs(flight.clip.twists[moving, 4])
    assert np.all(forward > 0) and np.mean(sideways / forward) < 0.3


def test_marks_between_are_met_in_order(helicopter):
    marks = [
        Mark(1001, position=(0, 0, 30), velocity=(10, 0, 0)),
        Mark("free", position=(60, 20, 35), tolerance=0.5),
        Mark(1197, position=(120, 0, 30), velocity=(10, 0, 0)),
    ]
    plan = vehsim.plan(helicopter, None, marks, segments=32)
    assert plan.success and plan.clip.end_frame == 1197
    nearest = np.abs(plan.clip.positions - [60, 20, 35]).max(axis=1)
    assert nearest.min() <= 0.5 + 1e-6
    at = int(np.argmin(nearest))
    assert plan.clip.frames[at] == round(plan.clip.frames[at])
    np.testing.assert_allclose(np.linalg.norm(plan.clip.twists[[0, -1], 3:], axis=1), 10, atol=1e-6)


def test_hold_stands_still(helicopter):
    marks = [
        Mark(1, position=(0, 0, 30), heading=0, velocity=REST, hold=12),
        Mark(157, position=(30, 0, 30), heading=0, velocity=REST),
    ]
    plan = vehsim.plan(helicopter, None, marks, segments=32)
    assert plan.success
    held = plan.clip.resample()
    np.testing.assert_allclose(held.positions[:13], np.tile([0, 0, 30], (13, 1)), atol=1e-7)
    assert np.linalg.norm(held.positions[40] - [0, 0, 30]) > 0.01


def test_rest_is_in_balance(flight, helicopter):
    """No jump in acceleration where a motion starts or ends: the knot's controls just carry the vehicle."""
    np.testing.assert_allclose(flight.clip.controls[0], trim(helicopter, REST), atol=1e-3)
    np.testing.assert_allclose(flight.clip.orientations[0], upright(helicopter, [0.0])[0], atol=1e-8)


def test_speed_limit_holds(helicopter):
    marks = [Mark(1, position=(0, 0, 30), velocity=REST), Mark("free", position=(80, 0, 30), velocity=REST)]
    plan = vehsim.plan(helicopter, None, marks, segments=32, limits={"speed": 9.0})
    assert plan.success
    assert np.linalg.norm(plan.clip.twists[:, 3:], axis=1).max() <= 9.0 + 1e-5


def test_replan_is_the_plan_of_the_new_marks(flight):
    marks = [
        Mark(1001, position=(0, 0, 30), heading=0, velocity=REST),
        Mark("free", position=(121, 41, 35), heading=40, velocity=REST),
    ]
    again = flight.replan(marks)
    assert again.success
    np.testing.assert_allclose(again.clip.positions[-1], (121, 41, 35), atol=1e-7)


@pytest.mark.parametrize(
    ("name", "frame", "before", "moved"),
    [
        ("truck", "free", (-40.0, 0.0, 0.0), ("free", (40.0, 0.0, 0.0), 0.0)),
        ("car", 1301, (40.0, 0.0, 0.0), (1160, (40.0, 0.0, 0.0), 0.0)),
        ("helicopter", 1301, (60.0, 10.0, 0.0), (1301, (60.0, 80.0, 0.0), 180.0)),
    ],
)
def test_a_replan_of_a_mark_that_moved_far_is_a_fresh_plan(name, frame, before, moved):
    """A truck drove on round for 130 m where the mark was 40 m ahead; a car braked at twice what is `normal`."""
    vehicle, first = vehsim.load_vehicle(name), Mark(1001, position=REST, heading=0, velocity=REST)
    plan = vehsim.plan(vehicle, None, [first, Mark(frame, position=before, heading=0, velocity=REST)])
    marks = [first, Mark(moved[0], position=moved[1], heading=moved[2], velocity=REST)]
    again, fresh = plan.replan(marks), vehsim.plan(vehicle, None, marks)
    assert again.success and again.character == fresh.character
    assert again.cost < 1.01 * fresh.cost


def test_a_replan_over_hills_of_a_mark_that_moved_far_is_a_fresh_plan(helicopter):
    """From the old motion, it cost 27 % more and took ten times as long."""
    world, first = vehsim.World(terrain="hills"), Mark(1001, position=(0, 0, 15), heading=0, velocity=REST)
    plan = vehsim.plan(helicopter, world, [first, Mark(1301, position=(80, 20, 15), velocity=REST)], clearance=4)
    marks = [first, Mark(1301, position=(40, 40, 14), velocity=REST)]
    again, fresh = plan.replan(marks), vehsim.plan(helicopter, world, marks, clearance=4)
    assert again.success and again.cost < 1.01 * fresh.cost


def test_replans_of_marks_that_face_along_their_legs_start_warm(helicopter, monkeypatch):
    """Marks at rest get headings along their legs: a replan must not treat them as other marks."""
    from vehsim.planning import planner

    marks = [Mark(1, position=(0, 0, 30), velocity=REST), Mark(121, position=(40, 0, 30), velocity=REST)]
    plan = vehsim.plan(helicopter, None, marks, segments=16, refine=False)
    monkeypatch.setattr(planner, "_solve", None)  # a cold start would call it
    again = plan.replan([marks[0], Mark(121, position=(40, 1, 30), velocity=REST)])
    assert again.success and again.iterations < plan.iterations
    np.testing.assert_allclose(again.clip.positions[-1], (40, 1, 30), atol=1e-7)
    assert again.replan(marks).success


def test_car_plans_too():
    """The same transcription for a nonholonomic vehicle: no wheel slips, the mark is met."""
    car = vehsim.load_vehicle("car")
    marks = [
        Mark(1, position=REST, heading=0, velocity=REST, joints=None),
        Mark("free", position=(25, 8, 0), heading=30, velocity=REST),
    ]
    plan = vehsim.plan(car, None, marks, segments=32)
    assert plan.success and plan.executed.final < 0.1
    np.testing.assert_allclose(plan.clip.positions[-1, :2], (25, 8), atol=1e-6)
    axle = plan.clip.positions + _turn(plan.clip.orientations, car.origin)
    side = np.diff(axle, axis=0)
    heading = plan.clip.orientations[:-1] + plan.clip.orientations[1:]
    heading /= np.linalg.norm(heading, axis=1, keepdims=True)
    assert np.abs(_turn(heading * [1, -1, -1, -1], side)[:, 1]).max() < 1e-3


def _turn(q, v):
    t = 2 * np.cross(q[:, 1:], np.broadcast_to(v, (len(q), 3)))
    return v + q[:, :1] * t + np.cross(q[:, 1:], t)


def test_unreachable_mark_fails_with_a_message():
    marks = [Mark(1, position=REST, heading=0, velocity=REST), Mark(25, position=(500, 0, 0))]
    with pytest.warns(UserWarning, match="plan failed"):
        plan = vehsim.plan(tug(limit=10.0), None, marks, segments=16, max_iterations=60)
    assert not plan.success
    assert "mark[1].frame: frames 1 to 25 need 500 m" in plan.message and "; use " in plan.message


def test_wind_without_drag_warns():
    helicopter = vehsim.load_vehicle("helicopter_lie")
    marks = [Mark(1, position=(0, 0, 30), velocity=REST), Mark(97, position=(20, 0, 30), velocity=REST)]
    with pytest.warns(UserWarning, match="no drag"):
        vehsim.plan(helicopter, vehsim.World(wind=(0, 3, 0)), marks, segments=16, refine=False)


@pytest.mark.parametrize(
    ("marks", "message"),
    [
        ([Mark(1, position=REST)], "at least two"),
        ([Mark("free", position=REST), Mark(9, position=REST)], r"mark\[0\].frame"),
        ([Mark(1), Mark(9, position=REST)], r"mark\[0\].position"),
        ([Mark(9, position=REST), Mark(3, position=REST)], r"mark\[1\].frame = 3: not after"),
        ([Mark(1, position=(0, 0, np.nan)), Mark(9, position=REST)], r"mark\[0\].position"),
        ([Mark(1, position=REST), Mark(9, position=(1, 2))], r"mark\[1\].position"),
        ([Mark(1, position=REST, velocity=REST, speed=1), Mark(9)], "drop one"),
        ([Mark(1, position=REST, hold=3), Mark(9)], "hold"),
    ],
)
def test_wrong_marks_are_named(marks, message):
    with pytest.raises(InputError, match=message):
        vehsim.plan(tug(), None, marks, segments=16)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"cost": "effrt"}, "did you mean 'effort'"),
        ({"cost": {"effort": -1}}, "zero or more"),
        ({"cost": {"time": 0}}, "no weight above zero"),
        ({"limits": {"sped": 3}}, "did you mean 'speed'"),
        ({"limits": {"speed": 0}}, "positive"),
        ({"segments": 1}, "segments = 1"),
        ({"clearance": -1}, "clearance"),
        ({"guess": np.zeros((4, 2))}, "guess"),
    ],
)
def test_wrong_options_are_named(options, message):
    marks = [Mark(1, position=REST), Mark(9, position=(1, 0, 0))]
    with pytest.raises(InputError, match=message), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        vehsim.plan(tug(), None, marks, **{"segments": 8, **options})


def test_elements_agree_with_whole_problem_derivatives(helicopter):
    """Scattered element derivatives equal CasADi's own of the assembled problem."""
    from vehsim.planning.problem.elements import Element

    rng = np.random.default_rng(0)
    y, p = ca.SX.sym("y", 3), ca.SX.sym("p", 2)
    one = Element("a", y, {"p": p}, f=p[0] * y[0] ** 2 * y[2] + ca.sin(y[1]), g=ca.vertcat(y[0] * y[1], ca.exp(y[2])))
    two = Element("b", y[:2], {"q": p[:1]}, g=y[0] * y[1] ** 2)
    problem = NonlinearProgram(9)
    own = problem.parameter("own", 2, 5)
    columns = rng.permuted(np.tile(np.arange(9), (5, 1)), axis=1)[:, :3].T
    columns[1, ::2] = columns[0, ::2]  # it may use a variable twice
    problem.add(one, columns, {"p": own})
    problem.add(two, rng.permuted(np.tile(np.arange(9), (4, 1)), axis=1)[:, :2].T)
    assert problem.parameters == 11
    functions = problem.functions()
    x, q = ca.MX.sym("x", 9), ca.MX.sym("q", 11)
    f, g = functions["nlp"](x, q)
    lam = ca.MX.sym("lam", g.shape[0])
    whole = ca.Function(
        "w", [x, q, lam], [ca.gradient(f, x), ca.jacobian(g, x), ca.triu(ca.hessian(2 * f + ca.dot(lam, g), x)[0])]
    )
    at = (rng.standard_normal(9), rng.standard_normal(11), rng.standard_normal(g.shape[0]))
    expected = [np.array(e) for e in whole(*at)]
    gradient = functions["grad_f"](*at[:2])[1]
    assert gradient.is_dense()  # IPOPT's interface reads it as dense
    np.testing.assert_allclose(np.array(gradient), expected[0], atol=1e-13)
    np.testing.assert_allclose(np.array(functions["jac_g"](*at[:2])[1]), expected[1], atol=1e-13)
    np.testing.assert_allclose(np.array(functions["hess_lag"](*at[:2], 2.0, at[2])), expected[2], atol=1e-13)


def test_derivatives_through_inner_expressions_are_those_of_the_whole():
    from vehsim.planning.problem.elements import Element

    y, p, m, last = ca.SX.sym("y", 3), ca.SX.sym("p", 2), ca.SX.sym("m", 2), ca.SX.sym("last")
    inner, later = ca.vertcat(y[0] * y[1] ** 2 + p[1], ca.sin(y[2]) * y[0]), m[0] ** 2 * y[1] + m[1] * p[0]
    g, f = ca.vertcat(m[0] * m[1] * y[2], ca.exp(m[0]) + last * m[1], y[0] * last**2), y[0] ** 2
    plain = ca.substitute(ca.substitute(g, last, later), m, inner)
    elements = (
        Element("a", y, {"p": p}, f=f, g=g, inner=[(m, inner), (last, later)]),
        Element("b", y, {"p": p}, f=f, g=plain),
    )
    made = []
    for element in elements:
        problem = NonlinearProgram(4)
        problem.add(element, np.array([[0, 1, 2], [3, 2, 0]]).T)
        made.append(problem.functions())
    chance = np.random.default_rng(3)
    x, given, lam = chance.normal(size=4), chance.normal(size=2), chance.normal(size=6)
    for name, more in (("nlp", ()), ("grad_f", ()), ("jac_g", ()), ("hess_lag", (2.0, lam))):
        for ours, whole in zip(*(_all(functions[name](x, given, *more)) for functions in made), strict=True):
            np.testing.assert_allclose(np.array(ours), np.array(whole), atol=1e-13, err_msg=name)


def _all(results):
    return results if isinstance(results, tuple) else (results,)


def test_state_is_untouched_by_planning(helicopter):
    """The first state of a plan is a state that the integrator accepts and returns."""
    state = State(position=(1, 2, 3), twist=np.arange(6) / 10)
    integrator = Integrator(helicopter, 0.01)
    phase = integrator.start(state, np.zeros(4))
    np.testing.assert_allclose(integrator.state(phase, np.zeros(4)).position, (1, 2, 3), atol=1e-12)


def test_car_meets_velocity_marks_in_both_components():
    car = vehsim.load_vehicle("car")
    marks = [Mark(1, position=REST, velocity=(5, 0, 0)), Mark(121, position=(30, 30, 0), velocity=(0, 5, 0))]
    plan = vehsim.plan(car, None, marks, segments=32)
    assert plan.success
    planar = np.column_stack([plan.clip.twists[:, 1:3], np.zeros(len(plan.clip))])
    velocity = _turn(plan.clip.orientations, planar)
    np.testing.assert_allclose(velocity[[0, -1]], [(5, 0, 0), (0, 5, 0)], atol=1e-6)


def test_marks_of_a_car_share_their_height():
    car = vehsim.load_vehicle("car")
    with pytest.raises(InputError, match="keeps its height"):
        vehsim.plan(car, None, [Mark(1, position=(0, 0, 3)), Mark(50, position=(9, 0, 0))], segments=8)


def test_free_heading_is_nose_first(helicopter):
    marks = [Mark(1, position=(0, 0, 10), velocity=REST), Mark(145, position=(20, 0, 10), velocity=REST)]
    plan = vehsim.plan(helicopter, None, marks, segments=32)
    heading = 2 * np.degrees(np.arctan2(plan.clip.orientations[:, 3], plan.clip.orientations[:, 0]))
    assert plan.success and np.abs(heading).max() < 15


@pytest.mark.parametrize(("name", "away", "seconds"), [("car", 75, 25), ("truck", 60, 35), ("two_wheeled", 5, 15)])
def test_a_drive_of_free_duration_does_not_crawl(name, away, seconds):
    """If standing costs no effort, time has a cost too."""
    marks = [Mark(1, position=REST, heading=0, velocity=REST), Mark("free", position=(away, 0, 0), velocity=REST)]
    plan = vehsim.plan(vehsim.load_vehicle(name), None, marks, segments=32, refine=False)
    assert plan.success and plan.duration < seconds


def test_time_has_a_cost_if_the_duration_is_free():
    """Not for vehicles that must carry their weight, nor between marks at frames; an explicit weight applies
    instead."""
    free, fixed = [Mark(1, position=REST), Mark("free", position=(9, 0, 0))], [Mark(1, position=REST), Mark(9)]
    boat, helicopter = vehsim.load_vehicle("boat"), vehsim.load_vehicle("helicopter")
    weights = [
        make_request(v, None, m, fps=24, segments=8).weights["time"] for v in (boat, helicopter) for m in (free, fixed)
    ]
    assert weights == [1.0, 0.0, 0.0, 0.0]
    assert make_request(boat, None, free, fps=24, segments=8, cost={"effort": 1, "time": 0}).weights["time"] == 0


def test_interrupt_stops_the_solve_and_is_raised(helicopter):
    """Ctrl-C within IPOPT: raised at once, neither swallowed nor turned into a result."""
    import os
    import signal

    marks = [Mark(1, position=(0, 0, 30), velocity=REST), Mark("free", position=(80, 0, 30), velocity=REST)]
    seen = []

    def progress(text, fraction):
        seen.append(text)
        if len(seen) == 3:
            os.kill(os.getpid(), signal.SIGINT)

    handler = signal.getsignal(signal.SIGINT)
    with pytest.raises(KeyboardInterrupt):
        vehsim.plan(helicopter, None, marks, segments=32, progress=progress)
    assert len(seen) <= 5 and signal.getsignal(signal.SIGINT) is handler


@pytest.mark.parametrize("fps", [0, -24, "x", np.nan])
def test_wrong_frame_rates_are_named(fps):
    with pytest.raises(InputError, match="fps"):
        vehsim.plan(tug(), None, [Mark(1, position=REST), Mark(9, position=(1, 0, 0))], segments=8, fps=fps)


def test_a_name_is_not_a_vehicle():
    with pytest.raises(InputError, match="load_vehicle"):
        vehsim.plan("helicopter", None, [Mark(1, position=REST), Mark(9, position=(1, 0, 0))])


def test_a_vehicle_that_rests_without_controls_needs_no_solver(monkeypatch):
    monkeypatch.setattr("vehsim.planning.trim._balancer", lambda vehicle: pytest.fail("solved"))
    assert not trim(vehsim.load_vehicle("truck"), REST).any()
