"""The character of a plan: its costs, defaults that may be exceeded, and how a motion eases in and out of rest."""

from __future__ import annotations

import math
import re
import warnings
from dataclasses import replace
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np
import pytest

import vehsim
from vehsim.errors import InputError
from vehsim.planning import Mark, Plan, look_at, planner
from vehsim.planning.blocks import blocks_of
from vehsim.planning.certify import refine_and_certify
from vehsim.planning.constraints.mark_constraints import imbalance
from vehsim.planning.costs import RunningCosts
from vehsim.planning.problem.solver import Patience
from vehsim.planning.problem.transcription import transcribe
from vehsim.planning.request.character import control_rates, traits_of
from vehsim.planning.request.request import make_request
from vehsim.planning.trim import steady, trim
from vehsim.vehicles.definition.character import CHARACTERS, Character, Trait
from vehsim.world.obstacles import moving

CAR, HELICOPTER = vehsim.load_vehicle("car"), vehsim.load_vehicle("helicopter")
STILL = (0.0, 0.0, 0.0)


def drive(character: str = "normal", last: int = 220, ease: bool | None = None, **options: object) -> Plan:
    """A car from rest to rest over 40 m."""
    marks = [
        Mark(1, position=(0, 0, 0), heading=0, velocity=STILL, ease=ease),
        Mark(last, position=(40, 0, 0), heading=0, velocity=STILL, ease=ease),
    ]
    return vehsim.plan(CAR, marks=marks, segments=32, character=character, **options)  # type: ignore[arg-type]


def fly(character: str, last: int = 400, **options: object) -> Plan:
    """A helicopter from hover to hover over 100 m."""
    ends = [(1, (0, 0, 20)), (last, (100, 0, 25))]
    marks = [Mark(frame, position=place, velocity=STILL) for frame, place in ends]
    return vehsim.plan(HELICOPTER, marks=marks, segments=32, character=character, **options)  # type: ignore[arg-type]


def rates_at_ends(plan: Plan, character: str) -> float:
    """The largest rate of a control in an eighth of a frame at either end, over its largest rate."""
    clip = plan.clip
    seconds = 1 / float(clip.fps) / 8
    at = clip.at([0, seconds, clip.duration - seconds, clip.duration]).controls
    most = control_rates(traits_of(clip.vehicle, character, "effort"), clip.vehicle)
    return float(np.abs(np.array([at[1] - at[0], at[3] - at[2]]) / seconds / most).max())


def tilt(plan: Plan) -> float:
    """The largest tilt, deg."""
    q = plan.clip.orientations
    return math.degrees(np.arccos(1 - 2 * (q[:, 1] ** 2 + q[:, 2] ** 2)).max())


@pytest.mark.parametrize("character", ["calm", "normal", "brisk"])
def test_controls_are_in_balance_and_at_no_rate_where_a_car_rests(character: str) -> None:
    made = drive(character, last=320)
    assert made.success and not [row for row in made.audit if row.met is False]
    assert rates_at_ends(made, character) < 0.01
    assert np.abs(made.clip.controls[[0, -1], 0]).max() < 0.01 * CAR.controls[0].upper


def test_a_helicopter_eases_in_and_out_of_hover_within_its_character() -> None:
    made = fly("normal")
    assert made.success and not [row for row in made.audit if row.met is False]
    assert rates_at_ends(made, "normal") < 0.01
    assert tilt(made) < 25 * 1.1


COURSES: dict[str, tuple[int, tuple[float, float, float], float]] = {
    "boat": (481, (40.0, -10.0, 0.0), -20.0),
    "car": (261, (45.0, 8.0, 0.0), 0.0),
    "helicopter": (301, (60.0, 40.0, 10.0), 120.0),
    "simple_car": (261, (45.0, 8.0, 0.0), 0.0),
    "snakeboard": (169, (5.0, 1.5, 0.0), 40.0),
    "truck": (401, (45.0, 3.0, 0.0), 0.0),
    "two_wheeled": (151, (3.0, 1.0, 0.0), 40.0),
}
"""Vehicle -> the frame, place and heading of a last mark that is not too early."""


@pytest.mark.parametrize("name", COURSES)
def test_every_planned_vehicle_eases_in_and_out_of_rest(name: str) -> None:
    vehicle, (frame, place, heading) = vehsim.load_vehicle(name), COURSES[name]
    marks = [
        Mark(1, position=(0, 0, 0), heading=0, velocity=STILL),
        Mark(frame, position=place, heading=heading, velocity=STILL),
    ]
    made = vehsim.plan(vehicle, marks=marks, segments=48, character="normal")
    assert made.success and not [str(row) for row in made.audit if row.met is False]
    assert rates_at_ends(made, "normal") <= 0.01
    # in balance: thrusts and torques are those of hover or rest; the boat's outboard may point anywhere
    scale = np.array([c.scale for c in made.clip.vehicle.controls])
    rest = trim(vehicle, STILL) if name == "helicopter" else np.zeros(len(scale))
    acts = [name != "boat" or c.name != "steering" for c in made.clip.vehicle.controls]
    assert np.abs((made.clip.controls[[0, -1]] - rest) / scale)[:, acts].max() < 0.01


@pytest.mark.parametrize(("name", "size"), [("boat", 1.5), ("car", 1.0), ("helicopter", 3.0), ("truck", 1.5)])
def test_a_loop_that_starts_at_rest_also_ends_gently(name: str, size: float) -> None:
    """Its last mark says nothing of a rest: a car's torque changed at its largest rate on the last frame."""
    marks = [
        Mark(1, position=(0, 0, 30), heading=0, velocity=STILL),
        Mark("free", position=(20 * size, 6 * size, 30), velocity=STILL),
        Mark("free"),
    ]
    made = vehsim.plan(vehsim.load_vehicle(name), marks=marks, loop=True)
    assert made.success and made.character == "normal"
    assert rates_at_ends(made, "normal") <= 0.01
    eases = {row.key.split(".")[0] for row in made.audit if ".ease." in row.key}
    assert eases == {"mark[0]", "mark[1]", "mark[2]"}


def test_a_motion_well_within_its_character_is_not_solved_again(monkeypatch: pytest.MonkeyPatch) -> None:
    """Its soft limits would change it by less than a millimetre."""
    car = vehsim.load_vehicle("car")
    marks = [
        Mark(1, position=(0, 0, 0), heading=0, velocity=(0, 0, 0)),
        Mark(400, position=(40, 12, 0), heading=30, velocity=(0, 0, 0)),
    ]
    calm = vehsim.plan(car, None, marks)
    monkeypatch.setattr(planner, "CALM", 0.0)
    again = vehsim.plan(car, None, marks)
    assert calm.success and again.success
    assert calm.iterations < again.iterations
    np.testing.assert_allclose(calm.clip.positions, again.clip.positions, atol=1e-3)


def test_the_default_is_normal() -> None:
    marks = [Mark(1, position=(0, 0, 0), heading=0, velocity=STILL), Mark(193, position=(30, 0, 0), velocity=STILL)]
    default, normal, stunt = (
        vehsim.plan(vehsim.load_vehicle("car"), marks=marks, segments=32, **options)
        for options in ({}, {"character": "normal"}, {"character": "stunt"})
    )
    np.testing.assert_array_equal(default.clip.controls, normal.clip.controls)
    assert rates_at_ends(default, "normal") <= 0.01 < rates_at_ends(stunt, "normal")


@pytest.mark.parametrize(("frame", "suitable"), [(145, "stunt"), (193, "brisk")])
def test_a_hurried_flight_is_planned_in_few_iterations_in_a_character_that_suits(frame: int, suitable: str) -> None:
    """Eased in and out, it would be harder than a stunt; each of eight solves took its 200 iterations and failed."""
    marks = [Mark(1, position=(0, 0, 10), velocity=STILL), Mark(frame, position=(60, 0, 10), velocity=STILL)]
    with pytest.warns(UserWarning, match=f"driven as {suitable}: the marks leave too little time for normal"):
        made = vehsim.plan(HELICOPTER, marks=marks)
    assert made.success and made.iterations < 300
    assert np.linalg.norm(made.clip.positions[-1] - marks[-1].position) < 1e-3
    if suitable == "stunt":
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            stunt = vehsim.plan(HELICOPTER, marks=marks, character="stunt")
        np.testing.assert_array_equal(made.clip.controls, stunt.clip.controls)


def test_marks_on_hills_that_need_a_stunt_are_recognised_in_few_iterations(monkeypatch: pytest.MonkeyPatch) -> None:
    """With the costs of a character, two solves took their 200 iterations and failed, only to be thrown away."""
    tried, runs = [], []
    attempt, begun = planner._attempt, planner.Run

    def attempted(request: Any, *others: Any, **options: Any) -> Plan:
        tried.append(request.traits.name)
        return attempt(request, *others, **options)

    def run(*arguments: Any) -> Any:
        runs.append(begun(*arguments))
        return runs[-1]

    monkeypatch.setattr(planner, "_attempt", attempted)
    monkeypatch.setattr(planner, "Run", run)
    marks = [
        Mark(1, position=STILL, heading=0, velocity=STILL),
        Mark(121, position=(30, 8, 0), heading=0, velocity=STILL),
    ]
    with pytest.warns(UserWarning, match="driven as stunt: the marks leave too little time for normal"):
        made = vehsim.plan(CAR, vehsim.World("hills"), marks)
    assert made.success and tried == ["normal", "stunt"]
    assert sum(one.iterations for one in runs) < 200


def test_a_lap_that_is_too_fast_for_a_character_exceeds_it_as_little_as_it_can() -> None:
    """A stunt costs nothing at constant speed: it went at 55 m/s, with 10 g."""
    marks = [
        Mark(frame=1001, position=(0, 0, 0), heading=20),
        Mark(frame=1121, position=(40, 25, 0)),
        Mark(frame=1241, position=(10, 50, 0)),
        Mark(frame=1361),
    ]
    with pytest.warns(UserWarning, match="beyond normal: character.acceleration"):
        plan = vehsim.plan(CAR, None, marks, loop=True)
    assert plan.success and "driven as" not in plan.message
    way = plan.clip.at(np.arange(0, plan.duration, 1 / 24)).positions
    assert np.linalg.norm(np.diff(way, 2, axis=0), axis=1).max() * 24**2 < 15


@pytest.mark.parametrize(
    ("name", "turn", "last"),
    [("car", (1140, 25, 15), 1280), ("drift_car", (1140, 25, 15), 1280), ("truck", (1180, 20, -20), 1360)],
)
def test_a_lap_without_a_stop_is_driven_within_its_limits_at_once(
    name: str, turn: tuple[int, float, float], last: int
) -> None:
    """Motions without limits went up to 6000 m/s: from there, the car reversed the whole lap, at twice its limits, the
    `drift_car` took four times as long, and the truck failed."""
    frame, x, y = turn
    marks = [Mark(1001, position=(0, 0, 0), heading=0), Mark(frame, position=(x, y, 0)), Mark(last)]
    made = vehsim.plan(vehsim.load_vehicle(name), None, marks, loop=True)
    assert made.success and made.character == "brisk" and made.iterations < 250
    assert made.clip.twists[:, 1].min() > 0 and planner._largest_ratio(made.audit) < 1.2


def test_comparison_with_a_stunt_changes_no_motion_that_suits(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(planner, "AT_ONCE", Patience(0))
    usual = drive("normal")
    monkeypatch.setattr(planner, "QUICK", Patience(1))
    compared = drive("normal")
    assert compared.iterations > usual.iterations
    np.testing.assert_array_equal(compared.clip.controls, usual.clip.controls)
    np.testing.assert_array_equal(compared.clip.positions, usual.clip.positions)


def test_marks_that_are_much_too_early_are_met_with_a_warning() -> None:
    marks = [Mark(1, position=(0, 0, 20), velocity=STILL), Mark(170, position=(100, 0, 25), velocity=STILL)]
    with pytest.warns(UserWarning, match="too little time for normal|beyond normal: character.bank|no normal motion"):
        made = vehsim.plan(HELICOPTER, marks=marks, segments=32, character="normal")
    assert made.success


def test_a_plan_that_fails_in_its_character_becomes_a_stunt(monkeypatch: pytest.MonkeyPatch) -> None:
    tried: list[str] = []

    def certified(run: Any, iterate: Any) -> Any:
        tried.append(iterate.request.traits.name)
        done = refine_and_certify(run, iterate)
        spoiled = replace(done.solution, success=False)
        return done if iterate.request.traits.name == "stunt" else replace(done, solution=spoiled)

    monkeypatch.setattr(planner, "refine_and_certify", certified)
    with pytest.warns(UserWarning, match="not in character: no normal motion was found"):
        made = drive("normal")
    assert made.success and tried[0] == "normal" and tried[-1] == "stunt"


def test_a_stunt_does_not_ease() -> None:
    assert rates_at_ends(drive("stunt"), "normal") > 0.01
    assert abs(drive("stunt").clip.controls[0, 0]) > 500


def test_ease_of_a_mark_overrides_its_character() -> None:
    assert rates_at_ends(drive("stunt", ease=True), "stunt") < 0.01
    abrupt = drive("normal", ease=False)
    assert abrupt.success and abs(abrupt.clip.controls[0, 0]) > 100


def test_marks_that_need_a_stunt_succeed_in_every_character_with_a_remark() -> None:
    with pytest.warns(UserWarning, match="driven as stunt: the marks leave too little time for normal"):
        assert drive("normal", 130).success
    with pytest.warns(UserWarning, match=r"beyond brisk: .*character.control_rates.torque: [\d.]+ N m/s, 2420 allowed"):
        made = drive("brisk", 165)
    assert made.success
    (row,) = (row for row in made.audit if row.key == "character.control_rates.torque")
    assert row.met is False and row.severity == "warning" and row.value is not None and row.value > 2420


def test_a_worse_guess_is_not_blamed_on_the_marks(monkeypatch: pytest.MonkeyPatch) -> None:
    """The normal car turned round where a brisk one reversed, gently enough for a normal one: now it reverses too."""
    monkeypatch.setattr(planner, "reversing", lambda request: None)
    still = (0.0, 0.0, 0.0)
    marks = [
        Mark(1001, position=still, heading=0, velocity=still),
        Mark(1241, position=(-14, 1.5, 0), heading=0, velocity=still),
    ]
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        made = vehsim.plan(vehsim.load_vehicle("car"), vehsim.World("flat"), marks)
    assert made.success and made._iterate is not None and made._iterate.request.traits.name == "normal"
    assert np.linalg.norm(np.diff(made.clip.positions, axis=0), axis=1).sum() < 14.5


def test_a_car_reverses_behind_a_moving_obstacle_instead_of_turning_round() -> None:
    """A path around the place where it would meet the other car leads in a full circle, which no normal car drives."""
    start = vehsim.State(position=(-6, -12, 0), orientation=(math.sqrt(0.5), 0, 0, math.sqrt(0.5)), twist=(0, 4, 0))
    other = vehsim.simulate(vehsim.load_vehicle("car"), None, start=start, duration=6.5)
    still = (0.0, 0.0, 0.0)
    marks = [
        Mark(1001, position=still, heading=0, velocity=still),
        Mark(1241, position=(-14, 1.5, 0), heading=0, velocity=still),
    ]
    world = vehsim.World("flat", obstacles=[moving("other", other)])
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        made = vehsim.plan(vehsim.load_vehicle("car"), world, marks, clearance=0.7)
    assert made.success and made._iterate is not None and made._iterate.request.traits.name == "normal"
    assert np.linalg.norm(np.diff(made.clip.positions, axis=0), axis=1).sum() < 16.0


@pytest.mark.parametrize(
    "start, heading, speed, goal", [((-9, -16, 0), 90, 3, (-18, -2, 0)), ((-8, 20, 0), -90, 5, (-16, 0, 0))]
)
def test_a_car_waits_for_a_moving_obstacle_instead_of_turning_round(start, heading, speed, goal) -> None:
    """Both reverse to a goal 16 to 18 m behind; paths around the places where the cars would meet are 45 m long."""
    turned = (math.cos(math.radians(heading) / 2), 0, 0, math.sin(math.radians(heading) / 2))
    begins = vehsim.State(position=start, orientation=turned, twist=(0, speed, 0))
    other = vehsim.simulate(vehsim.load_vehicle("car"), None, start=begins, duration=14.0, fps=24, start_frame=1)
    still = (0.0, 0.0, 0.0)
    marks = [Mark(1, position=still, heading=0, velocity=still), Mark(289, position=goal, heading=0, velocity=still)]
    world = vehsim.World("flat", obstacles=[moving("other", other)])
    made = vehsim.plan(vehsim.load_vehicle("car"), world, marks, clearance=0.5)
    assert made.success, made.message
    length = np.linalg.norm(np.diff(made.clip.positions, axis=0), axis=1).sum()
    assert length < 1.05 * math.dist(still, goal)


def test_the_earliest_frame_is_the_same_in_every_character() -> None:
    messages = []
    for character in CHARACTERS:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            made = drive(character, 60)
        assert not made.success and made.reason == "refused"
        messages.append(made.message)
    assert len(set(messages)) == 1


def test_a_limit_of_the_users_own_stands_in_place_of_the_characters_and_holds() -> None:
    made = fly("normal", 400, limits={"bank": math.radians(12)})
    assert made.success and tilt(made) < 12.1
    assert not [row for row in made.audit if row.key == "character.bank"]


def test_costs_of_the_users_own_stand_in_place_of_the_characters() -> None:
    marks = [Mark(1, position=(0, 0, 0)), Mark(99, position=(9, 0, 0))]
    request = make_request(CAR, None, marks, fps=24, segments=8, cost={"effort": 4, "easing": 0}, character="normal")
    (costs,) = (b for b in blocks_of(request, None, None) if isinstance(b, RunningCosts))  # type: ignore[arg-type]
    assert costs.weights["easing"] == 0
    assert costs.weights["smoothness"] == 4 * CAR.character.response.normal**2


def test_a_name_that_is_no_character_is_refused() -> None:
    with pytest.raises(InputError, match="character = 'norml': unknown; did you mean 'normal'"):
        drive("norml")


@pytest.mark.parametrize("key", ["limits", "costs"])
def test_what_no_plan_knows_is_refused(key: str) -> None:
    odd = replace(CAR, character=Character(**{key: {"wobble": Trait(1, 2, 3, "nowhere")}}))
    with pytest.raises(InputError, match=rf"character.{key}.wobble"):
        traits_of(odd, "normal", "effort")


@pytest.mark.parametrize(
    ("character", "distance", "last", "climb"),
    [
        ("calm", 300, 721, 0),
        ("normal", 300, 721, 0),
        ("brisk", 300, 721, 0),
        ("normal", 100, 361, 0),
        ("normal", 150, 601, 15),
        ("normal", 60, 193, 0),
        ("normal", 8, 121, 0),
    ],
)
def test_helicopters_hold_their_height_between_marks(character: str, distance: int, last: int, climb: int) -> None:
    """Without their costs they would rise or sink by 1.5 to 20 m, because this saves a little effort."""
    ends = [(1, (0, 0, 20)), (last, (distance, 0, 20 + climb))]
    marks = [Mark(frame, position=place, velocity=STILL) for frame, place in ends]
    options: dict[str, Any] = {"marks": marks, "segments": 32, "character": character}
    heights = vehsim.plan(HELICOPTER, **options).clip.positions[:, 2]
    assert heights.min() > 19.5 and heights.max() < 21.25 + climb
    free = vehsim.plan(HELICOPTER, **options, cost={"effort": 1.0, "level": 0.0, "distance": 0.0}).clip.positions[:, 2]
    assert max(20 - free.min(), free.max() - 20 - climb) > 1.5


@pytest.mark.parametrize("heading", [0.0, -10.0, -60.0])
@pytest.mark.parametrize(("character", "last"), [("calm", 2009), ("calm", "free"), ("normal", 1529), ("brisk", "free")])
def test_helicopters_fly_the_direct_way(character: str, last: int | str, heading: float) -> None:
    """To a place behind: circles of up to 324 m took less effort than slow flight; brisk ones of 120 m are quick."""
    marks = [
        Mark(1001, position=(0, 0, 20), heading=0, velocity=(0, 0, 0)),
        Mark(last, position=(-60, 0, 20), heading=heading, velocity=(0, 0, 0)),
    ]
    plan = vehsim.plan(vehsim.load_vehicle("helicopter"), None, marks, character=character)
    assert plan.success, plan.message
    way = plan.clip.at(np.linspace(0, plan.clip.times[-1], 1000)).positions
    assert np.linalg.norm(np.diff(way, axis=0), axis=1).sum() < (1.8 if character == "brisk" else 1.6) * 60


@pytest.mark.parametrize(("distance", "rise", "seconds"), [(0, 60, 30), (100, 50, 26), (0, -60, 30), (100, -50, 26)])
def test_the_planner_climbs_and_descends_as_pilots_do(distance: int, rise: int, seconds: int) -> None:
    """Slowest when calm; above the rate at which a slow helicopter sinks into its own wake, half of the speed that its
    rotor induces in hover. Without a change of the cost of height, each took over 40 s, in every character."""
    marks = [
        Mark(1, position=(0, 0, 100), velocity=STILL),
        Mark("free", position=(distance, 0, 100 + rise), velocity=STILL),
    ]
    made = [vehsim.plan(HELICOPTER, marks=marks, segments=32, character=name) for name in reversed(CHARACTERS)]
    durations = [plan.duration for plan in made]
    assert all(plan.success for plan in made)
    assert durations == sorted(durations) and durations[-1] < seconds
    disc = math.pi * 5.35**2  # m^2
    induced = math.sqrt(1900 * 9.81 / (2 * 1.225 * disc))
    for plan in made[1:]:  # a stunt may plunge
        velocities = np.gradient(plan.clip.positions, plan.clip.times, axis=0)
        slow = np.linalg.norm(velocities[:, :2], axis=1) < induced
        assert velocities[slow, 2].min() > -induced / 2
    assert np.abs(velocities[:, 2]).max() < 1.1 * HELICOPTER.character.limits["climb"].calm


def test_the_time_to_a_given_frame_is_used_evenly() -> None:
    """Marks before a given frame, where a climb saves no time: its vertical speed squared is the cost."""
    free = Mark("free", position=(60, 0, 60))
    marks = [Mark(1, position=(0, 0, 20), velocity=STILL), free, Mark(721, position=(200, 0, 30), velocity=STILL)]
    heights = vehsim.plan(HELICOPTER, marks=marks, segments=32, character="brisk").clip
    assert np.abs(np.gradient(heights.positions[:, 2], heights.times)).max() < 3.5


@pytest.mark.parametrize(
    ("places", "hurried"),
    [
        ({1085: (15, 4, 0), 1285: (40, 0, 0)}, ", most of all mark[1]"),
        ({1200: (15, 4, 0), 1306: (40, 0, 0)}, ", most of all mark[2]"),
        ({"free": (24, 4, 0), 1110: (30, 0, 0), 1400: (60, 0, 0)}, ", most of all mark[2]"),
        ({1110: (30, 0, 0)}, ""),
    ],
    ids=["first", "last", "after a free one", "only one"],
)
def test_the_mark_that_leaves_too_little_time_is_named(places: dict[Any, Any], hurried: str) -> None:
    """Only marks with a given frame can be moved to a later one."""
    marks = [Mark(1001, position=(0, 0, 0), heading=0, velocity=STILL)]
    for frame, place in places.items():
        marks.append(Mark(frame, position=place, **({} if frame == "free" else {"velocity": STILL})))
    with pytest.warns(UserWarning, match="driven as"):
        message = vehsim.plan(vehsim.load_vehicle("car"), None, marks).message
    assert f"too little time for normal{hurried}; give later frames" in message


@pytest.mark.parametrize("character", ["brisk", "stunt", "permitted"])
def test_only_a_stunt_brakes_with_the_handbrake(character: str) -> None:
    """Unless the vehicle permits it: it then shares the work with the brake, which takes less effort."""
    permitted = {"character": {"stunt_controls": []}} if character == "permitted" else {}
    car = vehsim.load_vehicle("rally_car", permitted)
    marks = [
        Mark(1, position=(0, 0, 0), heading=0, velocity=(15, 0, 0)),
        Mark(111, position=(40, 0, 0), velocity=STILL),
    ]
    plan = vehsim.plan(car, marks=marks, character="stunt" if character == "stunt" else "brisk")
    assert plan.success and "driven as" not in plan.message
    used = plan.clip.controls[:, car.control_names.index("handbrake")].max()
    assert used == 0.0 if character == "brisk" else used > 500.0


@pytest.mark.parametrize(
    ("table", "message"),
    [
        ("[character]\nstunt_controls = ['hand']", "stunt_controls.hand"),
        ("[character.control_rates]\nthrottle = { calm = 1.0, normal = 2.0, brisk = 3.0, source = 'a' }", "throttle"),
        ("[character]\nresponse = { calm = 1.0, normal = -2.0, brisk = 3.0, source = 'a' }", "response.normal"),
        ("[character.limits]\nspeed = { calm = 1.0, normal = 2.0, brisk = 3.0 }", "speed.source"),
    ],
)
def test_a_wrong_character_of_a_vehicle_is_refused(tmp_path: Path, table: str, message: str) -> None:
    physics = "mass = 1000.0\nwheel_inertia = 2.0\nyaw_inertia = 2000.0\nwheel_radius = 0.3\nwheelbase = 2.5\n"
    text = f'schema = 1\nmodel = "car"\n[physics]\n{physics}half_track = 0.7\n{table}\n'
    (tmp_path / "vehicle.toml").write_text(text)
    with pytest.raises(InputError, match=message):
        vehsim.load_vehicle(tmp_path)


def test_traits_of_shipped_vehicles_rise_from_calm_to_brisk() -> None:
    for name in ("helicopter", "car", "simple_car", "truck", "boat", "two_wheeled"):
        traits = vehsim.load_vehicle(name).character
        for trait in (*traits.limits.values(), *traits.control_rates.values()):
            assert 0 < trait.calm < trait.normal < trait.brisk and trait.source
        assert traits.response.calm > traits.response.normal > traits.response.brisk > 0


@pytest.mark.parametrize("name", ["drift_car", "rally_car", "truck"])
def test_a_parked_car_is_in_balance(name: str) -> None:
    """The weight of a body on springs is part of the Lagrangian: plans were to balance 9.81 m/s^2 at rest."""
    vehicle = vehsim.load_vehicle(name)
    transcription = transcribe(vehicle)
    v = transcription.symbols("x", "c0")
    symbols, off = [v["x"], v["c0"], *transcription.air.values()], imbalance(transcription, v["x"], v["c0"])
    law = ca.Function("off", symbols, [off])
    assert np.abs(law(*(np.zeros(symbol.shape[0]) for symbol in symbols))).max() < 1e-9
    assert steady(vehicle, STILL).holds


def test_a_look_that_turns_a_flight_too_fast_is_named_with_how_fast() -> None:
    """At 12 m/s, 9 m beside the way, it asks for 12 / 9 rad/s; the message named the time between the marks only."""
    marks = [Mark(frame, position=(x, 0, 30), velocity=(12, 0, 0)) for frame, x in ((1, 0), (61, 30), (121, 60))]
    told = r"driven as brisk: look_at \(30, 9, 30\) turns the heading by (.*) deg/s at frame 61, 22 allowed as normal"
    with pytest.warns(UserWarning, match=told) as caught:
        made = vehsim.plan(HELICOPTER, marks=marks, segments=64, terms=[look_at((30, 9, 30))])
    assert made.success
    (said,) = (match for each in caught if (match := re.search(told, str(each.message))))
    assert float(said.group(1)) == pytest.approx(np.degrees(12 / 9), rel=0.02)


def test_a_boat_turns_round_rather_than_back_up_all_the_way() -> None:
    """Behind it, 46 m away: without the cost of its character, it never goes ahead."""
    boat, rest = vehsim.load_vehicle("boat"), (0.0, 0.0, 0.0)
    marks = [
        Mark(1, position=rest, heading=0, velocity=rest),
        Mark(1201, position=(-45, 8, 0), heading=60, velocity=rest),
    ]

    def astern(**asked: Any) -> float:
        plan = vehsim.plan(boat, None, marks, **asked)
        assert plan.success and plan.character == "normal"
        return float(np.trapezoid(np.maximum(-plan.clip.twists[:, -2], 0.0), plan.clip.times))

    assert astern() < 25 < 45 < astern(cost={"effort": 1.0, "course": 0.0})


def test_a_harder_character_is_explained_by_what_the_marks_give():
    """Free frames leave all the time; a hold at the first mark is no frame to meet, and marks at rest are no speed."""
    from vehsim.planning.planner import NONE_FOUND, TOO_NEAR, TOO_SOON, _why_harder
    from vehsim.planning.request.request import make_request

    car, rest = vehsim.load_vehicle("car"), (0, 0, 0)

    def why(second, loop=False):
        first = Mark(1, position=(0, 0, 0), velocity=rest, hold=24)
        marks = [first, second, Mark("free")] if loop else [first, second]
        return _why_harder(make_request(car, None, marks, fps=24, segments=64, loop=loop))

    assert why(Mark(90, position=(40, 0, 0), velocity=rest)) == TOO_SOON
    assert why(Mark("free", position=(40, 0, 0), velocity=rest)) == NONE_FOUND
    assert why(Mark("free", position=(40, 0, 0), velocity=rest), loop=True) == NONE_FOUND
    assert why(Mark("free", position=(40, 0, 0), velocity=(20, 0, 0))) == TOO_NEAR
