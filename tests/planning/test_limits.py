"""Limits, looks, heights and users' constraints apply at every instant of the clip, not only at knots."""

import warnings
from dataclasses import replace

import casadi as ca
import numpy as np
import pytest

import vehsim
from vehsim import Mark, World
from vehsim.audit import audit
from vehsim.audit.scene import Scene, WorldScene
from vehsim.audit.track import track_of_clip
from vehsim.clip.interpolant import rotate, spatial
from vehsim.errors import InputError
from vehsim.planning import Constraint, look_at, stay
from vehsim.planning.explain.bounds import SPEEDS, gripping
from vehsim.planning.explain.feasibility import refusals
from vehsim.planning.problem.stage import between_view
from vehsim.planning.problem.transcription import transcribe
from vehsim.planning.request.request import make_request
from vehsim.requests import Ask
from vehsim.vehicles.definition.surfaces import SURFACES
from vehsim.world.ground.slope import relief_of
from vehsim.world.terrain.terrain import Terrain

REST = (0.0, 0.0, 0.0)
QUICK = {"effort": 0.02, "time": 1.0}
WITHIN = 1.006


def rest(frame, position, **keys):
    return Mark(frame, position=position, velocity=REST, **keys)


FLIGHT = [rest(1, (0, 0, 30), heading=0), rest("free", (120, 40, 45), heading=40)]
DRIVE = [rest(1, REST, heading=0), rest("free", (20, 14, 0), heading=90)]


def measured(clip):
    """The largest values of all limited quantities, by numpy on the clip, 16 times per frame.

    Accelerations are differences over a 64th of a frame.
    """
    frame = 1 / float(clip.fps)
    motion = clip.at(np.linspace(0, clip.duration, max(int(clip.duration / frame) * 16, 500)))
    omega, velocity = spatial(motion)
    up = rotate(motion.orientations, np.tile([0.0, 0.0, 1.0], (len(motion), 1)))[:, 2]
    span = frame / 64
    begins = np.linspace(0, clip.duration - span, 6000)
    gain = (spatial(clip.at(begins + span))[1] - spatial(clip.at(begins))[1]) / span
    found = {
        "speed": np.linalg.norm(velocity, axis=1),
        "climb": np.abs(velocity[:, 2]),
        "ceiling": motion.positions[:, 2],
        "turn_rate": np.linalg.norm(omega, axis=1),
        "bank": np.arccos(np.clip(up, -1, 1)),
        "acceleration": np.linalg.norm(gain, axis=1),
        "grip": np.linalg.norm(gain[:, :2], axis=1) / 9.81,
        "g_load": np.linalg.norm(gain / 9.81 + [0, 0, 1], axis=1),
    }
    if "sigma" in clip.vehicle.joints:
        k = clip.vehicle.joints.index("sigma")
        found["steering"] = np.abs(np.arctan(motion.joints[:, k]))
        found["steering_rate"] = np.abs(motion.joint_rates[:, k] / (1 + motion.joints[:, k] ** 2))
    for k, name in enumerate(clip.vehicle.joints):
        found[f"joint_rates.{name}"] = np.abs(motion.joint_rates[:, k])
        found[f"joints.{name}"] = np.abs(motion.joints[:, k])
    return {name: float(values.max()) for name, values in found.items()}


def flat(limits):
    """``{"joints.sigma": 0.2}`` of ``{"joints": {"sigma": 0.2}}``."""
    return {
        f"{key}.{name}" if name else key: bound
        for key, value in limits.items()
        for name, bound in (value.items() if isinstance(value, dict) else [("", value)])
    }


@pytest.mark.parametrize("segments", [15, 48])
@pytest.mark.parametrize(
    "limits",
    [
        {"acceleration": 3.0},
        {"g_load": 1.15},
        {"speed": 14.0, "climb": 2.0},
        {"bank": 0.25, "ceiling": 45.2},
        {"turn_rate": 0.4},
    ],
    ids=lambda limits: "-".join(limits),
)
def test_flights_keep_their_limits_at_every_instant(limits, segments):
    plan = vehsim.plan(
        vehsim.load_vehicle("helicopter"), None, FLIGHT, segments=segments, cost=QUICK, limits=limits, character="stunt"
    )
    assert plan.success, plan.message
    found = measured(plan.clip)
    for name, bound in limits.items():
        assert found[name] <= WITHIN * bound
        assert found[name] >= 0.9 * bound  # the limit is active


def test_a_ceiling_below_zero_holds():
    """Heights have no natural zero: a terrain may lie below it."""
    helicopter = vehsim.load_vehicle("helicopter")
    marks = [rest(1, (0, 0, -35), heading=0), rest(200, (120, 40, -35))]
    options = {"segments": 16, "cost": {"effort": 1.0}, "character": "stunt"}
    free = vehsim.plan(helicopter, None, marks, **options)
    assert measured(free.clip)["ceiling"] > -34.5
    plan = vehsim.plan(helicopter, None, marks, **options, limits={"ceiling": -34.9})
    assert plan.success, plan.message
    assert -34.95 < measured(plan.clip)["ceiling"] < -34.889
    with pytest.raises(InputError, match="give a height in m"):
        vehsim.plan(helicopter, None, marks, limits={"ceiling": -np.inf})


@pytest.mark.parametrize("segments", [11, 32])
@pytest.mark.parametrize(
    ("name", "limits"),
    [
        ("car", {"acceleration": 2.0, "steering": 0.25, "steering_rate": 0.3}),
        ("car", {"grip": 0.2}),
        ("simple_car", {"speed": 4.0, "steering_rate": 0.2, "joints": {"sigma": 0.3}}),
        ("simple_car", {"joint_rates": {"sigma": 0.15}, "turn_rate": 0.4}),
        ("boat", {"speed": 3.0, "turn_rate": 0.3}),
    ],
)
def test_drives_keep_their_limits_at_every_instant(name, limits, segments):
    cost = {"effort": 0.05, "time": 1.0}
    plan = vehsim.plan(vehsim.load_vehicle(name), None, DRIVE, segments=segments, cost=cost, limits=limits)
    assert plan.success, plan.message
    found = measured(plan.clip)
    for key, bound in flat(limits).items():
        assert found[key] <= WITHIN * bound, key


@pytest.mark.parametrize("segments", [13, 24])
def test_ranges_are_kept_between_knots(segments):
    tower = np.array([10.0, 30.0, 20.0])
    marks = [rest(1, (-20, 0, 20)), rest(193, (40, 0, 20))]
    terms = [look_at(tower, (49, 121), within=6.0), stay((49, 145), above=21.0, below=21.5)]
    plan = vehsim.plan(vehsim.load_vehicle("helicopter"), None, marks, segments=segments, refine=False, terms=terms)
    assert plan.success, plan.message
    motion = plan.clip.at(np.linspace(48 / 24, 120 / 24, 900))
    way = (tower - motion.positions)[:, :2]
    nose = rotate(motion.orientations, np.tile([1.0, 0.0, 0.0], (len(motion), 1)))[:, :2]
    cosine = np.sum(way * nose, axis=1) / np.linalg.norm(way, axis=1) / np.linalg.norm(nose, axis=1)
    assert np.degrees(np.arccos(cosine)).max() <= 6.03
    heights = plan.clip.at(np.linspace(48 / 24, 144 / 24, 900)).positions[:, 2]
    assert heights.min() >= 21.0 - 1e-3 and heights.max() <= 21.5 + 1e-3


def test_a_users_constraint_binds_between_knots_and_in_time():
    """A wall that moves away: the vehicle stays behind it at every instant, within the slack; and an acceleration."""
    wall = Constraint("wall", lambda k: k.position[0] - 1.0 - 3.0 * k.t, upper=0.0, slack=1e-4)
    ease = Constraint("ease", lambda k: k.acceleration[0], lower=-1.5, upper=1.5, slack=1e-3)
    marks = [rest(1, REST, heading=0), rest("free", (30, 2, 0), heading=0)]
    cost = {"effort": 0.05, "time": 1.0}
    plan = vehsim.plan(vehsim.load_vehicle("car"), None, marks, segments=9, terms=[wall, ease], cost=cost)
    assert plan.success, plan.message
    times = np.linspace(0, plan.duration, 2000)
    motion = plan.clip.at(times)
    assert (motion.positions[:, 0] - 1 - 3 * times).max() <= 2e-4
    speed = spatial(motion)[1][:, 0]
    assert np.abs(np.diff(speed) / np.diff(times)).max() <= 1.5 + 3e-3


def test_violations_are_reported_in_the_users_units():
    """A law that vanishes at all knots and that no motion can satisfy between them: where, by how much, the bound."""
    ripple = Constraint("ripple", lambda k: ca.sin(4 * ca.pi * k.t), upper=0.5)
    marks = [DRIVE[0], rest(97, (20, 4, 0))]
    with pytest.warns(UserWarning, match=r"ripple is (1|0\.99\d*) at frame \d+\.\d, requested 0\.5"):
        assert not vehsim.plan(
            vehsim.load_vehicle("car"), None, marks, segments=8, terms=[ripple], refine=False
        ).success


def test_views_between_knots_equal_the_clips():
    """The values that laws receive between knots are those of the clip's interpolant."""
    plan = vehsim.plan(vehsim.load_vehicle("helicopter"), None, FLIGHT, segments=12, cost=QUICK, refine=False)
    t, layout, x = transcribe(plan.clip.vehicle), plan._iterate.layout, plan._iterate.x
    v, s = t.symbols("x", "x1", "c0", "c1", "h"), ca.SX.sym("s")
    view = between_view(t, v, s)
    seen = ca.Function("seen", [*v.values(), s], [view.position, view.velocity, view.omega, view.rotation])
    k, share = 4, 0.37
    given = (layout.knot(k), layout.knot(k + 1), layout.control(k), layout.control(k + 1), layout.duration(k))
    position, velocity, omega, rotation = (np.asarray(out) for out in seen(*(x[i.ravel()] for i in given), share))
    clip = plan.clip.at([plan.clip.times[k] + share * (plan.clip.times[k + 1] - plan.clip.times[k])])
    turning, moving = spatial(clip)
    np.testing.assert_allclose(position.ravel(), clip.positions[0], atol=1e-9)
    np.testing.assert_allclose(velocity.ravel(), moving[0], atol=1e-9)
    np.testing.assert_allclose(omega.ravel(), turning[0], atol=1e-5)
    np.testing.assert_allclose(rotation, clip.matrices()[0, :3, :3], atol=1e-6)


@pytest.mark.parametrize("segments", [8, 32])
def test_a_free_mark_waits_for_the_frame_that_a_limit_allows(segments):
    """At its limit it takes 96.15 frames: frame 96 is infeasible, and 97 is feasible."""
    car = vehsim.load_vehicle("car")
    marks = [Mark(0, position=(0, 0, 0), heading=0), Mark("free", position=(9.0386, 0, 0))]
    plan = vehsim.plan(car, None, marks, segments=segments, limits={"speed": 2.256})
    assert plan.success and plan.duration * 24 == pytest.approx(97)


@pytest.mark.parametrize("name", ["helicopter", "boat"])
def test_what_has_no_tyres_has_no_grip(name):
    marks = [Mark(1, position=(0, 0, 0)), Mark(100, position=(9, 0, 0))]
    with pytest.raises(InputError, match=f"limits.grip: {name} does not stand on tyres; limit g_load"):
        vehsim.plan(vehsim.load_vehicle(name), None, marks, limits={"grip": 0.9})


@pytest.mark.parametrize("surface, friction", [("asphalt", 1.0), ("gravel", 0.54), ("snow", 0.35)])
def test_grip_is_that_of_the_surface(surface, friction):
    """In a bend on the limit, the car needs as much friction as its surface gives, and no more."""
    car = vehsim.load_vehicle("car", {"surface": surface})
    plan = vehsim.plan(car, None, DRIVE, cost=QUICK, limits={"grip": 0.5}, character="stunt", segments=32)
    assert plan.success, plan.message
    assert 0.8 * 0.5 * friction < measured(plan.clip)["grip"] <= 0.5 * friction * WITHIN


def sloping(rise):
    """Ground that rises by ``rise`` (2,) m/m along X and Y."""
    x = np.arange(-120, 121, 10.0)
    return World(Terrain("slope", rise[0] * x + rise[1] * x[:, None], (x[0], x[0]), (10.0, 10.0)))


def friction(clip, rise):
    """Forces (n,) of the ground along it over those across it, by differences of the velocity, as vectors in space."""
    span = 1 / float(clip.fps) / 64
    begins = np.linspace(0, clip.duration - span, 6000)
    gain = ((spatial(clip.at(begins + span))[1] - spatial(clip.at(begins))[1]) / span)[:, :2]
    force = np.column_stack([gain, gain @ rise + 9.81])
    normal = np.array([*np.negative(rise), 1.0]) / np.sqrt(1 + np.dot(rise, rise))
    across = force @ normal
    return np.linalg.norm(force - across[:, None] * normal, axis=1) / across


@pytest.mark.parametrize("surface, rise", [("asphalt", (0.0, 0.3)), ("gravel", (-0.2, 0.1)), ("snow", (0.1, -0.05))])
def test_grip_counts_slopes(surface, rise):
    """The limit is active, and holds by an independent measure."""
    car = vehsim.load_vehicle("car", {"surface": surface})
    options = {"cost": QUICK, "limits": {"grip": 0.7}, "character": "stunt", "segments": 32}
    plan = vehsim.plan(car, sloping(rise), DRIVE, **options)
    assert plan.success, plan.message
    bound = 0.7 * SURFACES[surface].friction
    assert 0.95 * bound < friction(plan.clip, rise).max() <= bound * WITHIN
    (ask,) = [row for row in plan.audit if row.key == "limits.grip"]
    assert ask.value <= 1.01 * bound


def test_the_audit_measures_grip_on_slopes():
    """Of a car that rests there: the slope; where the ground is not known, it is not measured."""
    car, rise = vehsim.load_vehicle("car"), (0.3, -0.4)
    marks = [rest(1, REST, heading=0), rest(25, REST, heading=0)]
    clip = vehsim.plan(car, sloping(rise), marks, segments=4).clip
    wanted = {"planar": True, "relief": [[-30.0, -30.0], [30.0, 30.0]]}
    asks = [Ask("limits.grip", "grip", 1, 25, wanted, upper=upper, unit="g") for upper in (0.499, 0.501)]
    rows = audit(track_of_clip(clip), asks, WorldScene(sloping(rise), car))
    assert [row.met for row in rows] == [False, True]
    assert rows[0].value == pytest.approx(0.5, abs=1e-6)
    (row,) = audit(track_of_clip(clip), asks[:1], Scene())
    assert row.value is None and row.met is None


@pytest.mark.parametrize("rise, refused", [(0.34, False), (0.36, True)])
def test_rest_on_ground_that_is_too_steep_for_the_grip_is_refused(rise, refused):
    car = vehsim.load_vehicle("car", {"surface": "snow"})
    marks = [rest(1, REST, heading=0), rest(145, (12, 0, 0))]
    request = make_request(car, sloping((rise, 0.0)), marks, fps=24, segments=8, limits={"grip": 1.0})
    told = "to rest on the slope there, tyres need 0.36 g; limits.grip = 1 on snow is 0.35; move it to gentler ground"
    assert [str(refusal) for refusal in refusals(request)] == (
        [f"mark[{k}].position: {told}" for k in (0, 1)] if refused else []
    )


@pytest.mark.parametrize("tolerance", [0.0, 2.0, 15.0])
@pytest.mark.parametrize("rise, slides", [(0.2, False), (0.22, True)])
def test_rest_on_a_slope_where_real_tyres_slide_is_warned_of(tolerance, rise, slides):
    """As motion beyond their grip is: without `limits.grip`, wheels without slip hold the car anywhere."""
    car = vehsim.load_vehicle("car", {"surface": "ice"})
    marks = [rest(1, REST, heading=0, tolerance=tolerance, hold=9), Mark(145, position=(12, 0, 0))]
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        request = make_request(car, sloping((rise, 0.0)), marks, fps=24, segments=8)
    assert not refusals(request)
    told = "mark[0].position: tyres on ice slide on a slope of 22 %, but wheels never slip here; move it to a slope of"
    assert [str(each.message)[: len(told)] for each in caught] == [told] * slides


@pytest.mark.parametrize("name", ["drift_car", "rally_car"])
@pytest.mark.parametrize("rise, slides", [(0.21, False), (0.36, True)])
def test_rest_on_a_slope_where_slipping_tyres_slide_is_warned_of_at_once(name, rise, slides):
    """It planned for a minute before it failed."""
    car = vehsim.load_vehicle(name, {"surface": "ice"})
    marks = [rest(1, REST, heading=0), Mark(145, position=(12, 0, 0))]
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        make_request(car, sloping((rise, 0.0)), marks, fps=24, segments=8)
    told = (
        "mark[0].position: tyres on ice slide on a slope of 36 %: it cannot stay at rest there; "
        "move it to a slope of at most 22 %"
    )
    assert [str(each.message) for each in caught] == [told] * slides


@pytest.mark.parametrize("name", ["drift_car", "rally_car"])
@pytest.mark.parametrize(
    "rise, told",
    [
        (0.1, ""),  # friction that is rounded near its peak leaves 0.011 mm/s
        (0.2, "on a slope of 20 %, the {} creeps by 4.7 mm during the hold, although it brakes"),
        (0.3, "on a slope of 30 %, the {} slides down, although it brakes"),
    ],
)
def test_a_hold_on_ice_is_refused_where_tyres_creep_visibly(name, rise, told):
    car = vehsim.load_vehicle(name, {"surface": "ice"})
    marks = [rest(1, REST, heading=0, hold=24), Mark(145, position=(12, 0, 0))]
    request = make_request(car, sloping((rise, 0.0)), marks, fps=24, segments=8)
    remedy = ": its tyres on ice grip too little; hold on a slope of at most 16 %"
    assert [str(each) for each in refusals(request)] == [f"mark[0].hold: {told.format(name)}{remedy}"] * bool(told)


@pytest.mark.parametrize(
    "place, tolerance, refused", [(-20, 0, True), (-20, 10, True), (-20, 22, False), (30, 0, False), (30, 50, False)]
)
def test_a_tolerance_may_reach_ground_on_which_tyres_hold(place, tolerance, refused):
    """A slope of 50 % that ends at x = 0."""
    x = np.arange(-120, 121, 2.5)
    world = World(Terrain("edge", np.tile(0.5 * np.minimum(x, 0), (9, 1)), (x[0], -120.0), (2.5, 30.0)))
    marks = [rest(1, (place, 0, 0), heading=0, tolerance=tolerance), Mark("free", position=(40, 0, 0))]
    request = make_request(vehsim.load_vehicle("car"), world, marks, fps=24, segments=8, limits={"grip": 0.4})
    assert [refusal.key for refusal in refusals(request)] == ["position"] * refused


@pytest.mark.parametrize("grip, surface", [(0.9, "ice"), (0.5, "asphalt")])
def test_check_knows_how_fast_tyres_can_drive(grip, surface):
    """From rest to rest on level ground, in closed form."""
    car, way = vehsim.load_vehicle("car", {"surface": surface}), 40.0
    least = 2 * np.sqrt(way / (grip * SURFACES[surface].friction * 9.81)) * 24
    for frames, refused in ((0.99 * least, True), (least, False)):
        marks = [rest(1, REST, heading=0), rest(1 + int(np.ceil(frames)), (way, 0, 0))]
        request = make_request(car, None, marks, fps=24, segments=8, limits={"grip": grip})
        told = [str(refusal) for refusal in refusals(request)]
        assert [f"more than limits.grip = {grip} on {surface} can do; use " in each for each in told] == [
            True
        ] * refused


@pytest.mark.parametrize("terrain, grip", [("level", 0.3), ("slope", 0.2), ("ridge", 0.3)])
def test_motion_at_the_limit_of_grip_is_not_refused(terrain, grip):
    """The fastest motion, also downhill and over a ridge."""
    world = {"level": None, "slope": sloping((-0.2, 0.0)), "ridge": ridge()}[terrain]
    marks = [rest(1, (-30, 0, 0), heading=0), Mark("free", position=(30, 0, 0))]
    options = {"cost": {"time": 1, "smoothness": 1e-3}, "character": "stunt", "segments": 24}
    plan = vehsim.plan(vehsim.load_vehicle("car"), world, marks, limits={"grip": grip}, **options)
    assert plan.success, plan.message
    done = replace(marks[1], frame=int(plan.clip.end_frame))
    request = make_request(plan.clip.vehicle, world, [marks[0], done], fps=24, limits={"grip": grip}, segments=24)
    assert not refusals(request)


def test_the_bound_of_grip_is_that_of_forces():
    """Of random forces of the ground, as vectors in space, none within the cone of friction exceeds it."""
    chance, grip, count = np.random.default_rng(5), 0.4, 100_000
    relief = relief_of(ridge().terrain, np.array([(-40.0, -40.0), (40.0, 40.0)]))
    speed, (turn, aside) = chance.uniform(0, 25, count), chance.uniform(0, 2 * np.pi, (2, count))
    ways = np.column_stack([np.cos(turn), np.sin(turn)])
    slopes, lifts = relief.followed(chance.uniform(-30, 30, (count, 2)), speed[:, None] * ways)
    gain = chance.uniform(0, 25, count)[:, None] * np.column_stack([np.cos(aside), np.sin(aside)])
    force = np.column_stack([gain, np.sum(gain * slopes, axis=1) + lifts + 9.81])
    normal = np.column_stack([-slopes, np.ones(count)]) / np.sqrt(1 + np.sum(slopes**2, axis=1))[:, None]
    across = np.sum(force * normal, axis=1)
    holds = np.linalg.norm(force - across[:, None] * normal, axis=1) <= grip * across
    share = np.linalg.norm(gain, axis=1)[holds] / np.interp(speed[holds], SPEEDS, gripping(grip, relief).gain)
    assert 0.7 < share.max() <= 1


def ridge():
    """A ridge ``4 exp(-x^2 / 225)`` m."""
    heights = 4 * np.exp(-(np.linspace(-4, 4, 49) ** 2))
    return World(Terrain("ridge", np.tile(heights, (49, 1)), (-60.0, -60.0), (2.5, 2.5)))


def test_tyres_that_carry_less_on_a_crest_hold_less():
    """A bend on top of a ridge, by second differences of the way over it: its slope alone would allow 0.78 g."""
    marks = [rest(1, (-25, -8, 0)), Mark("free", position=(0, 6, 0), heading=0), rest("free", (25, -8, 0))]
    options = {"segments": 48, "cost": QUICK, "character": "stunt", "limits": {"grip": 0.5}}
    plan = vehsim.plan(vehsim.load_vehicle("car"), ridge(), marks, **options)
    assert plan.success, plan.message
    step = 1 / 24 / 16
    times = np.linspace(step, plan.duration - step, 6000)
    x = np.array([plan.clip.at(times + d).positions[:, 0] for d in (-step, 0, step)])
    z = 4 * np.exp(-((x / 15) ** 2))
    level = np.diff([spatial(plan.clip.at(times + d))[1] for d in (-step, step)], axis=0)[0][:, :2] / 2 / step
    force = np.column_stack([level, (z[0] - 2 * z[1] + z[2]) / step**2 + 9.81])
    slope = -8 * x[1] / 225 * np.exp(-((x[1] / 15) ** 2))
    across = (force[:, 2] - slope * force[:, 0]) / np.hypot(1, slope)
    along = np.sqrt(np.sum(force**2, axis=1) - across**2)
    assert across.min() < 0.75 * 9.81
    assert 0.97 * 0.5 < (along / across).max() < 1.03 * 0.5


def test_a_users_law_of_the_slope_holds():
    """Over a ridge, a car climbs and descends no faster than allowed."""
    gentle = Constraint("gentle", lambda k: ca.dot(k.slope, k.velocity[0:2]), lower=-0.5, upper=0.5, slack=5e-3)
    marks = [rest(1, (-30, 0, 0), heading=0), rest("free", (30, 0, 0), heading=0)]
    options = {"segments": 24, "cost": QUICK, "character": "stunt"}
    car, fastest = vehsim.load_vehicle("car"), []
    for terms in ([], [gentle]):
        plan = vehsim.plan(car, ridge(), marks, terms=terms, **options)
        assert plan.success, plan.message
        motion = plan.clip.at(np.linspace(0, plan.duration, 2000))
        x, speed = motion.positions[:, 0], spatial(motion)[1][:, 0]
        fastest.append(np.abs(8 * x / 225 * np.exp(-((x / 15) ** 2)) * speed).max())
    assert fastest[0] > 3 and fastest[1] == pytest.approx(0.5, rel=0.03)
