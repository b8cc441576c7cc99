"""All problems of a shot are reported at once, with file, line, key, value and remedy, before any work."""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from vehsim import Shot
from vehsim.errors import ShotError

Find = Callable[[dict[str, Any]], dict[str, str]]


def put(data: dict[str, Any], key: str, value: Any) -> dict[str, Any]:
    """``put(data, "vehicle.0.name", ...)`` writes into the data."""
    *way, last = key.split(".")
    table: Any = data
    for step in way:
        table = table[int(step)] if isinstance(table, list) else table.setdefault(step, {})
    table[int(last) if isinstance(table, list) else last] = value
    return data


def test_valid_shots_have_no_problems(small: dict[str, Any], planned: dict[str, Any], keys_of: Find) -> None:
    assert keys_of(small) == {}
    assert keys_of(planned) == {}


def test_a_wrong_obstacle_does_not_take_the_ground_away(planned: dict[str, Any], keys_of: Find) -> None:
    """The world without its wrong keys has no terrain: marks that stand on it are not checked then."""
    put(planned, "world.terrain", "canyon")
    put(planned, "world.obstacle", [{"shape": "sphere", "radius": 5.0, "position": [0, 0, 0]}])
    planned["vehicle"][0]["motion"]["mark"][-1] |= {"on_ground": True, "position": [0, 0, 60]}
    assert set(keys_of(planned)) == {"world.obstacle[0].centre", "world.obstacle[0].position"}


def test_every_span_outside_the_motion_is_named(planned: dict[str, Any], keys_of: Find) -> None:
    motion = planned["vehicle"][0]["motion"]
    first, last = 1001, 1400
    motion["mark"][-1]["frame"] = last
    motion["look"] = [{"at": [30, 10, 0], "frames": frames} for frames in ([first, last], [last, last + 50])]
    motion["stay"] = [{"above": 1.0, "frames": [first - 9, last]}]
    found = keys_of(planned)
    assert set(found) == {"vehicle[0].motion.look[1].frames", "vehicle[0].motion.stay[0].frames"}
    assert "after the last mark" in found["vehicle[0].motion.look[1].frames"]


@pytest.mark.parametrize(
    "key, value, where, says",
    [
        ("shot.fpss", 24, "shot.fpss", "did you mean 'fps'"),
        ("wrld", {}, "wrld", "did you mean 'world'"),
        ("vehicle.0.motion.duraton", 1.0, "vehicle[0].motion.duraton", "did you mean 'duration'"),
        ("shot.schema", 2, "shot.schema", "1, the version"),
        ("shot.schema", True, "shot.schema", "not a whole number"),
        ("shot.name", "../evil", "shot.name", "letters, digits and underscores"),
        ("shot.fps", 0, "shot.fps", "between 0 and"),
        ("shot.fps", True, "shot.fps", "not a frame rate"),
        ("shot.fps", "1e999999999", "shot.fps", "not a frame rate"),
        ("shot.fps", "24/0", "shot.fps", "denominator of zero"),
        ("shot.start_frame", 1001.0, "shot.start_frame", "not a whole number"),
        ("shot.end_frame", 1_001_000, "shot.end_frame", "1000000 frames"),
        ("shot.end_frame", 1000, "shot.end_frame", "before the first frame"),
        ("shot.handles", 8, "shot.handles", "give shot.end_frame"),
        ("world.wind", [0, math.nan, 0], "world.wind[1]", "finite"),
        ("world.wind", [0, math.inf, 0], "world.wind[1]", "finite"),
        ("world.wind", [0, "3", 0], "world.wind[1]", "not a number"),
        ("world.wind", [0, True, 0], "world.wind[1]", "not a number"),
        ("world.wind", [0, 200, 0], "world.wind", "more than 150 m/s"),
        ("world.wind", [120, 120, 0], "world.wind", "more than 150 m/s"),
        ("world", 3, "world", "not a table"),
        ("vehicle.0.name", "my car", "vehicle[0].name", "not a name"),
        ("world.wind", [0, 3], "world.wind", "at least 3"),
        ("world.terrain", "canyn", "world.terrain", "canyon"),
        ("world.terrain", "missing.obj", "world.terrain", "no such terrain or file; give one of canyon,"),
        ("world.terrain", "hill", "world.terrain", "no such terrain or file; did you mean 'hills'?"),
        ("vehicle", [], "vehicle", "one or more [[vehicle]]"),
        ("vehicle.0.asset", "caar", "vehicle[0].asset", "did you mean 'car'"),
        ("vehicle.0.motion", {"method": "sinusoid"}, "vehicle[0].motion.mark", "missing"),
        ("vehicle.0.motion", {"method": "teleport"}, "vehicle[0].motion.method", 'give "plan"'),
        ("vehicle.0.motion", {}, "vehicle[0].motion.method", "missing"),
        ("vehicle.0.motion", {"method": "clip", "path": "none.npz"}, "vehicle[0].motion.path", "no such file"),
        ("vehicle.0.motion.duration", -1.0, "vehicle[0].motion.duration", "greater than 0"),
        ("vehicle.0.motion.duration", 90_000.0, "vehicle[0].motion.duration", "100000 frames"),
        ("vehicle.0.motion.step", 0.0, "vehicle[0].motion.step", "0.00001 to 0.1"),
        ("vehicle.0.motion.commands.0.torqe", 1.0, "vehicle[0].motion.commands[0].torqe", "did you mean 'torque'"),
        ("vehicle.0.motion.commands.0.torque", 1e6, "vehicle[0].motion.commands[0].torque", "-4000 to 2500 N m"),
        ("vehicle.0.motion.commands", [{"torque": 1.0}], "vehicle[0].motion.commands[0]", "no frame"),
        ("vehicle.0.motion.start", {"joints": {"sgma": 1}}, "vehicle[0].motion.start.joints.sgma", "'sigma'"),
        ("vehicle.0.motion.pilot", {"name": "hoover"}, "vehicle[0].motion.pilot.name", "did you mean 'hover'"),
        ("camera", {"rig": "chasse"}, "camera[0].rig", "did you mean 'chase'"),
        ("camera", {"target": "cat"}, "camera[0].target", "did you mean 'car'"),
        ("camera", {"lens": 35}, "camera[0].lens", "did you mean 'lens_mm'"),
        ("camera", [{"name": "a"}, {"name": "a"}], "camera[1].name", "used twice"),
        ("camera", [{"name": "a"}, {"name": "A"}], "camera[1].name", "used twice"),
        ("camera", {"rig": "static", "position": [1, 2, 3], "look_at": [1, 2, 3]}, "camera[0].look_at", "give another"),
        ("camera", {"framing": [0, 2]}, "camera[0].framing[1]", "at most 0.9"),
        ("cut", [{"frame": 1001, "camera": "chas"}], "cut[0].camera", "did you mean 'chase'"),
        ("cut", [{"frame": 9, "camera": "chase"}, {"frame": 9, "camera": "chase"}], "cut[1].frame", "in order"),
        ("render", {"cameras": ["chas"]}, "render.cameras[0]", "did you mean 'chase'"),
        ("render", {"size": [100_000, 540]}, "render.size[0]", "16 to 8192"),
        ("render", {"size": [961, 540]}, "render.size[0]", "even"),
        ("render", {"every": 0}, "render.every", "at least 1"),
    ],
)
def test_one_problem_names_key_and_remedy(
    small: dict[str, Any], keys_of: Find, key: str, value: Any, where: str, says: str
) -> None:
    problems = keys_of(put(small, key, value))
    assert where in problems, problems
    assert says in problems[where]


@pytest.mark.parametrize(
    "pilot, key, says",
    [
        ({"points": [[0, 0]]}, "points", "at least two points"),
        ({"points": [[0, 0, 0], [9, 0, 0]]}, "points", "two numbers"),
        ({"points": [[5, 5], [5, 5]]}, "points", "two places"),
        ({"points": [[0, 0], [9]]}, "pilot", "rows of one length"),
        ({"points": [[0, 0], [9, 0]], "speed": -1}, "speed", "positive"),
        ({"name": "hover", "position": [0, 0, 9]}, "pilot", "not a helicopter"),
    ],
)
def test_a_pilots_objections_are_reported_by_check(
    small: dict[str, Any], keys_of: Find, pilot: dict[str, Any], key: str, says: str
) -> None:
    small["vehicle"][0]["motion"] = {"method": "simulate", "duration": 1.0, "pilot": {"name": "follow_path"} | pilot}
    place = "vehicle[0].motion.pilot" + ("" if key == "pilot" else f".{key}")
    assert says in keys_of(small)[place]


def test_names_differ_in_more_than_their_case(small: dict[str, Any], keys_of: Find) -> None:
    small["vehicle"].append(small["vehicle"][0] | {"name": "CAR"})
    assert "used twice" in keys_of(small)["vehicle[1].name"]


def test_wheels_may_touch_the_ground(planned: dict[str, Any], keys_of: Find) -> None:
    planned["vehicle"][0]["asset"] = "car"
    marks = planned["vehicle"][0]["motion"]["mark"]
    marks[0]["position"], marks[1]["position"] = [0.0, 0.0, 0.0], [20.0, 0.0, 0.0]
    assert keys_of(planned) == {}


@pytest.mark.parametrize(
    "key, value, where, says",
    [
        ("position", [180.0, 130.0, 2.0], "mark[1].position", "inside rock"),
        ("position", [400.0, 0.0, 2.0], "mark[1].position", "outside the terrain, which ends at x = 291.8"),
        ("position", [0.0, -300.0, 200.0], "mark[1].position", "outside the terrain, which ends at y = -101"),
        ("frame", 1001, "mark[1].frame", "not after frame 1001"),
        ("frame", 900, "mark[1].frame", "outside the shot"),
        ("frame", 1003, "mark[1].frame", "m/s"),
        ("frame", 2_001_000, "mark", "at most 100000"),
        ("frame", 1100.5, "mark[1].frame", "neither a whole frame nor 'free'"),
        ("frame", "fre", "mark[1].frame", "neither a whole frame nor 'free'"),
        ("position", [math.nan, 0, 0], "mark[1].position[0]", "finite"),
        ("orientation", [2, 0, 0, 0], "mark[1].orientation", "length is not 1"),
        ("hold", 10, "mark[1].hold", "velocity = [0, 0, 0]"),
        ("joints", {"psi": 1}, "mark[1].joints.psi", "no such joint"),
    ],
)
def test_marks(planned: dict[str, Any], keys_of: Find, key: str, value: Any, where: str, says: str) -> None:
    planned["vehicle"][0]["motion"]["mark"][1][key] = value
    problems = keys_of(planned)
    assert f"vehicle[0].motion.{where}" in problems, problems
    assert says in problems[f"vehicle[0].motion.{where}"]


def test_a_vehicle_on_the_ground_may_hold_without_a_velocity(planned: dict[str, Any], keys_of: Find) -> None:
    """It is at rest: no velocity is necessary."""
    mark = planned["vehicle"][0]["motion"]["mark"][1]
    mark |= {"on_ground": True, "hold": 10, "heading": 0.0}
    mark.pop("velocity", None)
    assert not [key for key in keys_of(planned) if "hold" in key]


def test_a_hold_with_an_orientation_suggests_its_heading(planned: dict[str, Any], keys_of: Find) -> None:
    """Roll and pitch follow from balance."""
    mark = planned["vehicle"][0]["motion"]["mark"][1]
    mark |= {"orientation": [math.sqrt(0.75), 0, 0, 0.5], "hold": 10, "velocity": [0, 0, 0]}
    mark.pop("heading", None)
    assert "give heading = 60 instead of orientation" in keys_of(planned)["vehicle[0].motion.mark[1].hold"]


@pytest.mark.parametrize("hold", [0, 10])
def test_landing_on_uneven_ground_is_a_warning_with_its_key(planned: dict[str, Any], hold: int) -> None:
    """A hold is two marks: it was said of both."""
    mark = planned["vehicle"][0]["motion"]["mark"][1]
    ground = float(Shot.from_dict(planned).world.height([(20.0, 0.0)])[0])
    mark |= {"position": [20.0, 0.0, ground + 1.0], "heading": 0.0, "on_ground": True, "hold": hold}
    mark.pop("velocity", None)
    with warnings.catch_warnings():
        warnings.simplefilter("error")  # a problem, not a warning without a place
        (problem,) = [p for p in Shot.from_dict(planned).check() if p.key.endswith("on_ground")]
    assert problem.key == "vehicle[0].motion.mark[1].on_ground" and problem.severity == "warning"
    assert "stands up to" in problem.message


def test_mark_nearer_to_rock_than_the_clearance(planned: dict[str, Any], keys_of: Find) -> None:
    """The root is in free air, the rotor is not: only the vehicle's hulls show it."""
    motion = planned["vehicle"][0]["motion"]
    ground = float(Shot.from_dict(planned).world.height([(0.0, 0.0)])[0])
    motion["mark"][0]["position"] = [0.0, 0.0, ground + 0.5]
    motion["clearance"] = 2.0
    assert "clearance of 2 m" in keys_of(planned)["vehicle[0].motion.mark[0].position"]


@pytest.mark.parametrize("key, value, name", [("cost", "tyme", "cost.tyme"), ("limits", {"sped": 3}, "limits.sped")])
def test_costs_and_limits_are_known(planned: dict[str, Any], keys_of: Find, key: str, value: Any, name: str) -> None:
    planned["vehicle"][0]["motion"][key] = value
    assert "did you mean" in keys_of(planned)[f"vehicle[0].motion.{name}"]


def test_excessive_wind_is_reported_once_at_its_key(tmp_path: Path) -> None:
    path = tmp_path / "windy.toml"
    path.write_text(
        "[shot]\nschema = 1\nname = 'windy'\n[world]\nterrain = 'flat'\nwind = [0, 160, 0]\n[[vehicle]]\n"
        "name = 'c'\nasset = 'car'\n[vehicle.motion]\nmethod = 'simulate'\nduration = 1\n"
    )
    with pytest.raises(ShotError) as error:
        Shot.load(path)
    assert [(problem.key, problem.line) for problem in error.value.problems] == [("world.wind", 6)]


def test_wind_without_drag_is_a_warning(small: dict[str, Any]) -> None:
    (problem,) = Shot.from_dict(put(small, "world.wind", [0, 3, 0])).check()
    assert (problem.key, problem.severity) == ("world.wind", "warning")


def test_all_problems_at_once_with_file_and_line(tmp_path: Path) -> None:
    path = tmp_path / "bad.toml"
    path.write_text(
        "[shot]\nschema = 1\nname = 'bad'\nfpss = 24\n\n[world]\nterrain = 'canyon'\n\n[[vehicle]]\nname = 'h'\n"
        "asset = 'helicopter'\n[vehicle.motion]\nmethod = 'plan'\n[[vehicle.motion.mark]]\nframe = 1001\n"
        "position = [0, 0, 30]\n[[vehicle.motion.mark]]\nframe = 1000\nposition = [0, 90, 3]\n\n[render]\nevery = 0\n"
    )
    with pytest.raises(ShotError) as error:
        Shot.load(path)
    assert {(problem.key, problem.line) for problem in error.value.problems} == {
        ("shot.fpss", 4),
        ("render.every", 22),
        ("vehicle[0].motion.mark[1].frame", 18),
        ("vehicle[0].motion.mark[1].position", 19),
    }
    assert all(str(problem).startswith(f"{path}:") for problem in error.value.problems)


@pytest.mark.parametrize("content", [b"\xff\xfe", b"a = ", b"a = [" * 2000, b"a = " + b"9" * 5000, b""])
def test_invalid_shot_files(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "bad.toml"
    path.write_bytes(content)
    with pytest.raises(ShotError) as error:
        Shot.load(path)
    assert str(path) in str(error.value)


@pytest.mark.parametrize("name", ["none.toml", "."])
def test_missing_files_and_folders(tmp_path: Path, name: str) -> None:
    with pytest.raises(ShotError, match="give the path of a TOML file"):
        Shot.load(tmp_path / name)
