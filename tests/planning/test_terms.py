"""Costs, limits and users' terms: compared with closed forms, and satisfied by the resulting motion."""

import json
from dataclasses import replace

import casadi as ca
import numpy as np
import pytest

import vehsim
from tests.planning.test_plan import REST, tug
from vehsim import Mark
from vehsim.errors import InputError
from vehsim.planning import Constraint, Cost
from vehsim.planning.problem.elements import Element, NonlinearProgram, SpatialField, second_order
from vehsim.planning.terms import SLACK, check_limits
from vehsim.world.terrain.terrain import Terrain

UPRIGHT = (1, 0, 0, 0)
ACROSS = [
    Mark(1, position=REST, orientation=UPRIGHT, velocity=REST),
    Mark(73, position=(6, 0, 0), velocity=REST, orientation=UPRIGHT),
]


@pytest.fixture(scope="module")
def car():
    return vehsim.load_vehicle("car")


def test_a_users_effort_cost_equals_the_built_in_one():
    """Effort written by hand, as a law of a segment: the same optimum to the last digit."""
    effort = Cost("mine", lambda s: s.h / 3 * (ca.sumsqr(s.c0) + ca.dot(s.c0, s.c1) + ca.sumsqr(s.c1)))
    mine = vehsim.plan(
        tug(), None, ACROSS, segments=8, cost={"smoothness": 1e-3}, terms=[effort], refine=False, character="stunt"
    )
    ours = vehsim.plan(
        tug(), None, ACROSS, segments=8, cost={"smoothness": 1e-3, "effort": 1}, refine=False, character="stunt"
    )
    assert mine.success and mine.cost == pytest.approx(ours.cost, rel=1e-9)
    np.testing.assert_allclose(mine.clip.positions, ours.clip.positions, atol=1e-8)


def test_laws_can_use_the_time():
    """The integral of t over the motion is T^2/2 for any motion; with free legs T varies."""
    clock = Cost("clock", lambda k: k.t, integral=True)
    marks = [
        ACROSS[0],
        Mark("free", position=(3, 0, 0)),
        Mark(73, position=(6, 0, 0), velocity=REST, orientation=UPRIGHT),
    ]
    plan = vehsim.plan(tug(), None, marks, segments=8, terms=[clock], refine=False)
    bare = vehsim.plan(tug(), None, marks, segments=8, refine=False)
    assert plan.cost - bare.cost == pytest.approx(3.0**2 / 2, rel=1e-6)


@pytest.mark.parametrize("over", ["knots", "everywhere"])
def test_the_vehicle_stays_behind_a_moving_wall(over):
    """A constraint of time and place: x stays below a wall that moves away at constant speed."""
    wall = Constraint("wall", lambda k: k.position[0] - 1.0 - 2.0 * k.t, upper=0.0, over=over)
    straight = Constraint("straight", lambda k: k.position[0] - 1.0 - 2.0 * k.t, upper=50.0)
    marks = [Mark(1, position=REST, orientation=UPRIGHT, velocity=(6, 0, 0)), Mark(73, position=(6, 0, 0))]
    bound = vehsim.plan(tug(), None, marks, segments=12, terms=[wall], refine=False)
    free = vehsim.plan(tug(), None, marks, segments=12, terms=[straight], refine=False)
    ahead = [p.clip.positions[:, 0] - 1 - 2 * p.clip.times for p in (bound, free)]
    assert bound.success and ahead[0].max() <= 1e-7 < 0.5 < ahead[1].max()


def test_a_constraint_applies_only_in_its_frames():
    slow = Constraint("slow", lambda k: k.velocity[0], upper=1.0, frames=(25, 49))
    plan = vehsim.plan(tug(), None, ACROSS, segments=12, terms=[slow], refine=False)
    inside = (plan.clip.frames >= 25 - 1e-6) & (plan.clip.frames <= 49 + 1e-6)
    assert plan.success and plan.clip.twists[inside, 3].max() <= 1 + 1e-6 < 2 < plan.clip.twists[~inside, 3].max()


@pytest.mark.parametrize(
    ("law", "message"),
    [
        (lambda k: k.posision[0], "cannot be evaluated"),
        (lambda k: ca.SX.eye(2), "give a column"),
        (lambda k: 1 / 0, "cannot be evaluated"),
    ],
)
def test_laws_that_fail_are_named(law, message):
    with pytest.raises(InputError, match=f"'mine'.*{message}"):
        vehsim.plan(tug(), None, ACROSS, segments=8, terms=[Constraint("mine", law, upper=0.0)])


def test_least_acceleration_limit_is_the_trapezoid():
    """Closed form: from rest to rest, d in T, needs at least 4 d / T^2; slightly above, the force switches once."""
    need = 4 * 6.0 / 3.0**2
    plan = vehsim.plan(tug(), None, ACROSS, segments=24, limits={"acceleration": 1.05 * need}, refine=False)
    assert plan.success
    assert np.abs(np.diff(plan.clip.twists[:, 3]) / np.diff(plan.clip.times)).max() <= 1.05 * need + 1e-6
    with pytest.warns(UserWarning, match=r"frames 1 to 73 need 6 m in 3 s, more than 2.53 m/s\^2.* 7[5-7]"):
        assert not vehsim.plan(tug(), None, ACROSS, segments=24, limits={"acceleration": 0.95 * need}).success


def test_g_load_is_what_the_crew_feels():
    helicopter = vehsim.load_vehicle("helicopter")
    marks = [Mark(1, position=(0, 0, 30), velocity=REST), Mark("free", position=(30, 0, 45), velocity=REST)]
    cost = {"effort": 0.02, "time": 1.0}
    plans = [vehsim.plan(helicopter, None, marks, segments=24, cost=cost, limits=limits, refine=False)
             for limits in ({}, {"g_load": 1.08})]  # fmt: skip
    loads = []
    for plan in plans:
        assert plan.success
        velocity = vehsim.clip.interpolant.rotate(plan.clip.orientations, plan.clip.twists[:, 3:])
        felt = np.diff(velocity, axis=0) / np.diff(plan.clip.times)[:, None] + [0, 0, 9.81]
        loads.append(np.linalg.norm(felt, axis=1).max() / 9.81)
    assert loads[1] <= 1.08 * (1 + SLACK) < loads[0]  # between knots


def test_steering_is_limited_in_degrees_of_the_wheel(car):
    marks = [
        Mark(1, position=REST, heading=0, velocity=REST),
        Mark("free", position=(20, 14, 0), heading=90, velocity=REST),
    ]
    limits = {"steering": np.deg2rad(12), "steering_rate": np.deg2rad(15), "joint_rates": {"psi": [-1.0, 20.0]}}
    plan = vehsim.plan(car, None, marks, segments=24, limits=limits, refine=False)
    free = vehsim.plan(car, None, marks, segments=24, refine=False)
    angle, loose = (np.arctan(p.clip.joints[:, 1]) for p in (plan, free))
    assert plan.success and np.abs(angle).max() <= np.deg2rad(12) + 1e-6 < np.abs(loose).max()
    rate = plan.clip.joint_rates[:, 1] / (1 + plan.clip.joints[:, 1] ** 2)
    assert np.abs(rate).max() <= np.deg2rad(15) + 1e-6
    assert plan.clip.joint_rates[:, 0].max() <= 20 + 1e-6


def test_joint_limits_of_a_shot_narrow_the_vehicles(car):
    marks = [
        Mark(1, position=REST, heading=0, velocity=REST),
        Mark("free", position=(20, 14, 0), heading=90, velocity=REST),
    ]
    plan = vehsim.plan(car, None, marks, segments=24, limits={"joints": {"sigma": [-0.1, 0.3]}}, refine=False)
    assert plan.success
    assert plan.clip.joints[:, 1].min() >= -0.1 - 1e-6 and plan.clip.joints[:, 1].max() <= 0.3 + 1e-6


@pytest.mark.parametrize(
    ("limits", "message"),
    [
        ({"steering": 0.3}, "no joint 'sigma'"),
        ({"joints": {"sgma": 0.3}}, "did you mean|choose one of"),
        ({"joint_rates": {"psi": [3, 1]}}, r"not a bound; give a number above zero, or \[low, high\]"),
    ],
)
def test_wrong_joint_limits_are_named(limits, message):
    with pytest.raises(InputError, match=message):
        check_limits(limits, ("psi", "phi"))


def test_energy_is_work_over_weight():
    """Lifted straight up at constant speed, as least effort does: the work is the weight times the height."""
    start = Mark(1, position=REST, orientation=UPRIGHT, velocity=(0, 0, 3))
    marks = [start, Mark(97, position=(0, 0, 12), orientation=UPRIGHT, velocity=(0, 0, 3))]
    costs = []
    for weight in (0.0, 1e-3):
        cost = {"effort": 1.0, "energy": weight}
        costs.append(vehsim.plan(tug(gravity=9.81), None, marks, segments=8, cost=cost, refine=False).cost)
    # speeds below 0.2 m/s of climb count quadratically
    assert (costs[1] - costs[0]) / 1e-3 == pytest.approx(4.0 * (np.sqrt(3.0**2 + 0.04) - 0.2), rel=1e-3)


def test_models_of_a_distance_field_equal_its_derivatives():
    """Value, gradient and Hessian compared with CasADi's derivatives of the spline, inside the box and beyond it."""
    x, y = np.meshgrid(np.arange(0, 41, 2.0), np.arange(0, 31, 2.0))
    field = vehsim.World(
        terrain=Terrain("waves", 3 * np.sin(x / 5) * np.cos(y / 4), (0.0, 0.0), (2.0, 2.0))
    ).distance_field()
    points = np.random.default_rng(0).uniform(field.lower - 4, field.upper + 4, (60, 3))
    at = ca.MX.sym("at", 3)
    bend, slope = ca.hessian(field.function(at), at)
    entries = [bend[i, j] for i, j in ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))]
    whole = ca.Function("whole", [at], [ca.vertcat(field.function(at), slope, *entries)])
    expected = np.array([np.array(whole(point)).ravel() for point in points]).T
    np.testing.assert_allclose(np.array(field.models(60)(points.T)), expected, atol=1e-10)
    assert np.array(field.models(60, 1)(points.T))[4:].any() == False  # noqa: E712


def test_second_order_models_differentiate_like_the_function():
    """An element with a function's second-order models has the derivatives of the element with the function inside."""

    def bowl(count, order):
        p = ca.SX.sym("p", 3)
        value = ca.sin(p[0]) * p[1] + ca.exp(p[2] * p[0])
        bend, slope = ca.hessian(value, p)
        rows = ca.vertcat(value, slope, *(bend[i, j] for i, j in ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))))
        return ca.Function("bowl", [p], [rows]).map(count)

    y, q, models = ca.SX.sym("y", 3), ca.SX.sym("q"), ca.SX.sym("models", 13, 2)
    points = ca.horzcat(y + ca.sin(y), ca.vertcat(y[1] * y[2], y[0], y[2] ** 2))
    value = second_order(points, models)
    seen = Element(
        "seen", y, {"q": q}, f=q * ca.sum1(value) ** 2, g=value * y[0], space=SpatialField(points, models, bowl)
    )
    values = ca.vertcat(*(bowl(1, 2)(points[:, k])[0] for k in range(2)))
    plain = Element("plain", y, {"q": q}, f=q * ca.sum1(values) ** 2, g=values * y[0])
    rng = np.random.default_rng(0)
    at, lam = (rng.standard_normal(5), [0.7]), rng.standard_normal(4)
    answers = []
    for element in (seen, plain):
        problem = NonlinearProgram(5)
        problem.add(element, np.array([[0, 4], [1, 2], [3, 0]]))
        f = problem.functions()
        answers.append(
            [
                np.array(v)
                for v in (*f["nlp"](*at), f["grad_f"](*at)[1], f["jac_g"](*at)[1], f["hess_lag"](*at, 1.3, lam))
            ]
        )
    for ours, theirs in zip(*answers, strict=True):
        np.testing.assert_allclose(ours, theirs, atol=1e-12)


@pytest.mark.parametrize("solver", ["sqpmethod", "fatrop"])
def test_other_solvers_find_the_same(solver):
    plans = [
        vehsim.plan(tug(), None, ACROSS, segments=8, refine=False, solver=s, character="stunt")
        for s in ("ipopt", solver)
    ]
    assert plans[1].success
    np.testing.assert_allclose(plans[1].clip.positions, plans[0].clip.positions, atol=1e-4)


def test_missing_solvers_are_named():
    with pytest.raises(
        InputError, match="solver = 'snopt': not available in this build of CasADi; choose one of ipopt"
    ):
        vehsim.plan(tug(), None, ACROSS, segments=8, solver="snopt")


def test_a_users_constraint_is_audited():
    """By its law alone, on the finished clip; as data that a file can hold."""
    from vehsim.audit import audit, missed, track_of_clip
    from vehsim.requests import Ask

    wall = Constraint("wall", lambda k: k.position[0] - 1.0 - 2.0 * k.t, upper=0.0)
    pair = Constraint("pair", lambda k: [k.velocity[0], k.controls[0]], lower=(-9, -50), upper=(9, 50), frames=(5, 20))
    free = Constraint("free", lambda k: k.power, upper=1e6)
    plan = vehsim.plan(tug(), None, ACROSS, segments=8, terms=[wall, pair, free])
    rows = {row.key: row for row in plan.audit if row.measure == "law"}
    assert plan.success and list(rows) == ["wall", "pair[0]", "pair[1]"] and all(row.met for row in rows.values())
    asks = [Ask.from_dict(ask) for ask in json.loads(json.dumps([ask.as_dict() for ask in plan.asks]))]
    ahead = replace(plan.clip, positions=plan.clip.positions + np.array([2.0, 0, 0]))
    assert "wall" in {row.key for row in missed(audit(track_of_clip(ahead), asks))}
    track = track_of_clip(plan.clip)
    assert rows["wall"].value == pytest.approx(
        (track.positions[:, 0] - 1 - 2 * (track.frames - 1) / 24).max(), abs=1e-6
    )
