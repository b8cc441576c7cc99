"""``method = "sinusoid"`` in a shot: every vehicle works or is refused by `check`, and suggested frames work."""

import re
import warnings

import numpy as np
import pytest

import vehsim
from vehsim import simulate
from vehsim.errors import ShotError, SolveError
from vehsim.shot.shot import Shot

VEHICLES = ("boat", "car", "helicopter", "hopper", "simple_car", "snakeboard", "truck", "tumbler", "two_wheeled")
TOO_EARLY = re.compile(r"mark\[(\d+)\]\.frame = \d+: too early; use (\d+)")


def shot(asset, *marks, obstacles=(), others=(), **motion):
    motion = {"method": "sinusoid", "mark": list(marks), **motion}
    return {
        "shot": {"schema": 1, "name": "s", "fps": 24},
        "world": {"obstacle": list(obstacles)},
        "vehicle": [{"name": "v", "asset": asset, "motion": motion}, *others],
    }


def errors(data):
    return [problem for problem in Shot.from_dict(data).check() if problem.severity == "error"]


@pytest.mark.parametrize("asset", VEHICLES)
def test_every_vehicle_works_or_is_refused(asset):
    heading = 0 if asset == "hopper" else 20
    data = shot(
        asset, {"frame": 1001, "position": [0, 0, 0]}, {"frame": "free", "position": [6, 1, 0], "heading": heading}
    )
    wrong = errors(data)
    if asset in ("car", "hopper", "simple_car", "truck"):
        assert not wrong
        clip = Shot.from_dict(data).solve().clips["v"]
        np.testing.assert_allclose(clip.positions[-1, :2], [6, 1], atol=1e-4)
    else:
        assert [problem.key for problem in wrong] == ["vehicle[0].motion.method"]


def test_a_steering_column_is_turned_by_the_torque_of_its_motion():
    """simple_car has no rate control: its column has inertia. Replayed, its controls give the same motion."""
    data = shot(
        "simple_car",
        {"frame": 1001, "position": [0, 0, 0]},
        {"frame": "free", "position": [6, 1, 0], "heading": 10},
        manoeuvre=2,
    )
    clip = Shot.from_dict(data).solve().clips["v"]
    vehicle = clip.vehicle
    for k, control in enumerate(vehicle.controls):
        assert control.lower * (1 + 1e-6) <= clip.controls[:, k].min()
        assert clip.controls[:, k].max() <= control.upper * (1 + 1e-6)

    def controls(t, state):
        return [np.interp(t, clip.times, clip.controls[:, k]) for k in range(2)]

    played = simulate(vehicle, None, controls, duration=clip.duration, step=1 / 480)
    np.testing.assert_allclose(played.positions[-1], clip.positions[-1], atol=0.05)


@pytest.mark.parametrize("asset", ["truck", "car", "simple_car"])
def test_two_equal_marks_are_a_stop(asset):
    """A sweep of zero amplitude, or a leg of zero length, must not raise an unreadable error."""
    data = shot(asset, {"frame": 1001, "position": [0, 0, 0]}, {"frame": 1030, "position": [0, 0, 0]})
    np.testing.assert_allclose(Shot.from_dict(data).solve().clips["v"].positions, 0.0, atol=1e-9)


def test_a_leg_of_round_off_is_left_out():
    """A quarter turn on the spot, with a leg of 1e-18 s: its integrals were singular."""
    data = shot(
        "simple_car",
        {"frame": 1001, "position": [0, 0, 0], "heading": 180.0},
        {"frame": "free", "position": [0, 0, 0], "heading": 90.0},
    )
    clip = Shot.from_dict(data).solve().clips["v"]
    np.testing.assert_allclose(clip.positions[-1], 0.0, atol=1e-6)


def goals(count, seed=5):
    random = np.random.default_rng(seed)
    for k in range(count):
        asset = ("truck", "hopper", "car")[k % 3]
        marks, frame = [{"frame": 1001, "position": [0, 0, 0]}], 1001
        for _ in range(2 if asset == "truck" else 1):
            frame += int(random.integers(2, 200))
            mark = {"frame": frame, "position": [*random.uniform(-4, 4, 2).tolist(), 0.0]}
            frame += mark.setdefault("hold", int(random.integers(0, 5)) * (asset != "hopper"))
            turn = float(random.uniform(-180, 180)) if asset != "car" else float(random.uniform(-30, 30))
            marks.append(mark | ({"pitch": turn} if asset == "hopper" else {"heading": turn}))
        yield pytest.param(asset, marks, id=f"{asset}-{k}")


@pytest.mark.parametrize("asset, marks", list(goals(6)))
def test_a_suggested_frame_works(asset, marks):
    """Whether `check` or the export suggests it, for every mark at once: it works the first time."""
    data = shot(asset, *marks, **({"manoeuvre": 6} if asset == "car" else {}))
    messages = "; ".join(map(str, errors(data)))
    if not messages:
        try:
            Shot.from_dict(data).solve()
            return
        except SolveError as error:
            messages = str(error)
    named = TOO_EARLY.findall(messages)
    assert named, messages
    for k, frame in named:
        data["vehicle"][0]["motion"]["mark"][int(k)]["frame"] = int(frame)
    take = Shot.from_dict(data).solve()
    assert take.clips["v"].end_frame == data["vehicle"][0]["motion"]["mark"][-1]["frame"] + marks[-1]["hold"]


def test_speed_is_limited_where_legs_join():
    """A car bends at its limit of the steering rate, and goes on at its limit of the speed: without a jump."""
    marks = [
        {"frame": 1001, "position": [-5.2, -16.131, 0], "heading": -112.325},
        {"frame": "free", "position": [-8.55, -26.473, 0], "heading": -126.878},
    ]
    take = Shot.from_dict(shot("car", *marks, limits={"speed": 1.23, "steering": 28.295}, manoeuvre=18)).solve()
    assert "bend" in take.report["vehicles"]["v"]["manoeuvres"][0]["label"]
    (row,) = (row for row in take.report["audit"]["v"] if row["key"] == "limits.speed")
    assert row["met"] and row["value"] < 1.23 * 1.001
    clip = take.clips["v"]
    speed = np.hypot(*clip.twists[:, 1:].T)
    assert np.abs(np.diff(speed) / np.diff(clip.times)).max() < 5.0  # m/s^2; it was 23


def test_a_hopper_keeps_clear_of_obstacles_but_not_of_the_ground():
    """With an obstacle anywhere, it failed because it stands on the ground."""
    marks = [
        {"frame": 1001, "position": [0, 0, 0.9]},
        {"frame": "free", "position": [3, 0, 0.9], "pitch": 360, "joints": {"psi": -2 * np.pi}},
    ]
    cone = {"shape": "cone", "centre": [2, 1.5, 0]}
    data = shot("hopper", *marks, obstacles=[cone])
    data["world"]["terrain"] = "flat"
    take = Shot.from_dict(data).solve()
    (row,) = (row for row in take.report["audit"]["v"] if row["key"] == "clearance")
    assert row["met"] and row["value"] > 0.09


def test_a_moving_obstacle_is_waited_for():
    """A car crosses the bay for ten seconds: at the suggested frame it has gone."""
    crossing = {
        "method": "simulate",
        "start": {"position": [4.0, -14.0, 0], "heading": 90, "velocity": [0, 1.2, 0]},
        "duration": 25.0,
    }
    data = shot(
        "car",
        {"frame": 1001, "position": [-8, 0, 0]},
        {"frame": 1600, "position": [16, 0, 0]},
        obstacles=[{"shape": "vehicle", "vehicle": "other"}],
        others=[{"name": "other", "asset": "car", "motion": crossing}],
        manoeuvre=1,
    )
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        with pytest.raises(SolveError, match=r"too (close to a moving obstacle|early); use \d+") as raised:
            Shot.from_dict(data).solve()
        (frame,) = re.findall(r"use (\d+)", str(raised.value))
        data["vehicle"][0]["motion"]["mark"][1]["frame"] = int(frame)
        assert Shot.from_dict(data).solve().clips["v"].end_frame == int(frame)


@pytest.mark.parametrize(
    "joints, limits, key",
    [
        ({"sigma": 5.0}, {}, "mark[1].joints.sigma"),
        ({"sigma": 0.5}, {"steering": 20}, "mark[1].joints.sigma"),
        ({"psi": 1.0}, {}, "mark[1].joints.psi"),
        ({}, {"hitch": 30}, "limits.hitch"),
    ],
)
def test_check_refuses_impossible_marks(joints, limits, key):
    marks = {"frame": 1001, "position": [0, 0, 0]}, {"frame": "free", "position": [6, 1, 0], "joints": joints}
    data = shot("car", *marks, limits=limits)
    (problem,) = errors(data)
    assert problem.key == f"vehicle[0].motion.{key}" and problem.remedy
    with pytest.raises(ShotError):
        Shot.from_dict(data).solve()


def test_impossible_leg_extensions_are_refused():
    marks = {"frame": 1001, "position": [0, 0, 0], "joints": {"stretch": 2.0}}, {"frame": "free", "position": [1, 0, 0]}
    (problem,) = errors(shot("hopper", *marks))
    assert problem.key == "vehicle[0].motion.mark[0].joints.stretch"


def test_an_unknown_manoeuvre_number_is_named():
    marks = {"frame": 1001, "position": [0, 0, 0]}, {"frame": "free", "position": [6, 1, 0]}
    with pytest.raises(SolveError, match="manoeuvre = 30: there are 3 between these marks"):
        Shot.from_dict(shot("truck", *marks, manoeuvre=30)).solve()


def test_options_that_trailers_ignore_warn():
    marks = {"frame": 1001, "position": [0, 0, 0]}, {"frame": "free", "position": [6, 0, 0]}
    (problem,) = Shot.from_dict(shot("truck", *marks, cycles=2)).check()
    assert (problem.key, problem.severity) == ("vehicle[0].motion.cycles", "warning")


def test_the_shipped_cars_turn_alike():
    """simple_car is recognised by its constraints, like the car with a rate for its steering."""
    from vehsim.sinusoids.manoeuvres.rigs import rigged

    simple = rigged(vehsim.load_vehicle("simple_car"))
    assert simple.limits["steering_rate"] == pytest.approx(0.7)


def test_a_hop_is_not_held():
    """It is in the air until it lands, and moves then."""
    marks = {"frame": 1001, "position": [0, 0, 0]}, {"frame": "free", "position": [2, 0, 0], "hold": 3}
    (problem,) = errors(shot("hopper", *marks))
    assert problem.key.endswith("mark[1].hold") and "ends as it lands" in problem.message


def test_a_character_makes_no_manoeuvre_fail():
    """Marks that leave too little time for it are driven as a stunt, with a warning."""
    marks = [{"frame": 1001, "position": [6, 0, 0]}, {"frame": "free", "position": [0, -2.3, 0]}]
    frames = []
    for character in ("normal", "stunt"):
        data = shot("car", *marks)
        data["vehicle"][0]["motion"]["character"] = character
        frames.append(Shot.from_dict(data).solve().frames[1])
    assert frames[1] < frames[0]
    with pytest.warns(UserWarning, match="driven as stunt: the marks leave too little time for normal"):
        take = Shot.from_dict(shot("car", marks[0], marks[1] | {"frame": frames[1]})).solve()
    assert take.frames[1] == frames[1]
