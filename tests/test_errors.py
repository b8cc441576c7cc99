"""Errors are data: each has key, value, message and remedy, and its printed line is composed of them."""

from __future__ import annotations

import pickle
import re
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import vehsim
from vehsim import Mark, Shot, World
from vehsim.assets import described
from vehsim.errors import ExportError, FailedPlan, InputError, Problem, ShotError, SolveError, VehsimError
from vehsim.integrators.integrator import Integrator
from vehsim.lie.groups import SE3
from vehsim.pilots.controllers import PILOTS
from vehsim.sinusoids.manoeuvres.rigs import rigged
from vehsim.sinusoids.steering import TooFast
from vehsim.vehicles import load_vehicle
from vehsim.world.obstacles.obstacles import box
from vehsim.world.water.water import Water

CAR = load_vehicle("car")
HELICOPTER = load_vehicle("helicopter")


def line_of(problem: Problem) -> str:
    """The printed line, composed independently of `Problem`."""
    line = problem.message
    value = "" if problem.value is None else f" = {problem.value!r}"
    if problem.key:
        line = f"{problem.key}{value}: {line}"
    if problem.subject:
        line = f"{problem.subject}: {line}"
    if problem.file and problem.line is not None:
        line = f"{problem.file}:{problem.line}: {line}"
    elif problem.file:
        line = f"{problem.file}: {line}"
    if problem.severity == "warning":
        line = f"warning: {line}"
    return f"{line}; {problem.remedy}" if problem.remedy else line


def caught(call: Callable[[], Any]) -> VehsimError:
    with pytest.raises(VehsimError) as error:
        call()
    assert str(error.value) == "\n".join(map(line_of, error.value.problems))
    for problem in error.value.problems:
        assert problem.message and not re.search(r"^\W|\W$", problem.message.rstrip(")]'\"")), problem
    return error.value


def plan(limits: Any = None, **changed: Any) -> Any:
    """A short drive that ``changed`` arguments or marks spoil."""
    mark = {key: changed.pop(key) for key in ("hold", "frame") if key in changed}
    marks = [Mark(1001, position=(0, 0, 0), heading=0.0), Mark(**{"frame": 1049, "position": (9, 0, 0)} | mark)]
    return vehsim.plan(CAR, None, marks, limits=limits, **{"segments": 16} | changed)


@pytest.mark.parametrize(
    ("changed", "reason"),
    [
        ({}, None),
        ({"frame": 1002}, "refused"),
        ({"time_limit": 1e-3}, "time limit"),
        ({"max_iterations": 1, "character": "stunt"}, "not solved"),
    ],
)
def test_failed_plans_give_the_reason_as_data(changed: dict[str, Any], reason: str | None) -> None:
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        made = plan(**changed)
    assert made.reason == reason and made.success is (reason is None)
    assert any(warning.category is FailedPlan for warning in caught) is not made.success


def test_a_shot_passes_on_the_reason_of_its_failed_plan(tmp_path: Path) -> None:
    marks = "".join(
        f"[[vehicle.motion.mark]]\nframe = {frame}\nposition = [{x}, 0, 0]\n" for frame, x in ((1001, 0), (1049, 9))
    )
    head = SHOT.partition("[world]")[0] + '[[vehicle]]\nname = "car"\nasset = "car"\n[vehicle.motion]\n'
    (tmp_path / "shot.toml").write_text(f'{head}method = "plan"\nsegments = 16\ntime_limit = 1e-3\n{marks}')
    error = caught(lambda: Shot.load(tmp_path / "shot.toml").solve(cached=False))
    assert isinstance(error, SolveError) and error.reason == "time limit" and error.problem.subject == "car"


CALLS: dict[str, tuple[Callable[[], Any], str, Any, str, str]] = {
    "wind": (lambda: World(wind=(0, 200, 0)), "world.wind", (0, 200, 0), "not a wind", "give x, y, z in m/s"),
    "terrain": (lambda: World(terrain="canyonn"), "terrain", "canyonn", "no such terrain", "did you mean 'canyon'?"),
    "obstacles": (lambda: World(obstacles=["a"]), "obstacles", "a", "not an obstacle", "make one with"),  # type: ignore[list-item]
    "obstacle": (lambda: box("a", (0, 0, 0), (1, 0, 1)), "size", (1, 0, 1), "not positive", "give three lengths in m"),
    "water": (lambda: Water(level=float("inf")), "water.level", float("inf"), "not a height", "give metres"),
    "vehicle": (lambda: load_vehicle("helicoptre"), "vehicle", "helicoptre", "no such vehicle", "did you mean 'heli"),
    "fps": (
        lambda: vehsim.simulate(CAR, None, (0, 0), duration=1, fps=0),
        "fps",
        0,
        "not a frame rate",
        "give a positive number",
    ),
    "duration": (
        lambda: vehsim.simulate(CAR, None, (0, 0), duration=-1),
        "duration",
        -1,
        "must be positive",
        "give a number of seconds",
    ),
    "integrator": (lambda: Integrator(CAR, 0.0), "step", 0.0, "must be a positive number", ""),
    "order": (lambda: Integrator(CAR, 0.1, order=3), "order", 3, "unknown", "choose one of"),
    "map": (lambda: Integrator(CAR, 0.1, difference_map="x"), "difference_map", "x", "unknown", "choose one of"),
    "pilot": (
        lambda: PILOTS["hover"](HELICOPTER, position=[1, 2]),
        "position",
        [1, 2],
        "of the wrong shape",
        "give three numbers",
    ),
    "clip": (
        lambda: vehsim.simulate(CAR, None, (0, 0), duration=0.1).at(9.0),
        "clip",
        None,
        "is outside",
        "use times",
    ),
    "group": (
        lambda: vehsim.vehicles.Holonomic(
            name="brick", group=SE3, inertia=np.ones((2, 2)), controls=(), wrench=lambda c: c
        ),
        "inertia",
        None,
        "of shape (2, 2)",
        "SE3 needs (6, 6)",
    ),
    "sinusoids": (
        lambda: rigged(HELICOPTER),
        "",
        None,
        "not a system that is steered by sinusoids",
        "give a car",
    ),
    "segments": (lambda: plan(segments=1), "segments", 1, "out of range", "give at least 2 per leg"),
    "cost": (lambda: plan(cost={"effort": -1}), "cost.effort", -1, "not a weight", "give a number"),
    "limit": (lambda: plan(limits={"sped": 3}), "limits", "sped", "unknown", "did you mean 'speed'?"),
    "mark": (lambda: plan(hold=-2), "mark[1].hold", -2, "negative", "give zero or more"),
    "time limit": (lambda: plan(time_limit=0), "time_limit", 0, "not a time", "give seconds"),
    "exporter": (
        lambda: vehsim.simulate(CAR, None, (0, 0), duration=0.1).export("x.usda", to="uds"),
        "to",
        "uds",
        "no such exporter",
        "choose from",
    ),
}


@pytest.mark.parametrize("name", CALLS)
def test_calls_report_errors_as_data(name: str) -> None:
    call, key, value, message, remedy = CALLS[name]
    error = caught(call)
    assert isinstance(error, InputError)
    assert (error.key, error.value) == (key, value)
    assert error.message.find(message) >= 0 and error.remedy.startswith(remedy)


SHOTS: dict[str, tuple[str, str, str, Any, str, str]] = {
    "unknown key": ("fps = 24", "fsp = 24", "shot.fsp", 24, "unknown key", "did you mean 'fps'?"),
    "range": ("duration = 1", "duration = -1", "vehicle[0].motion.duration", -1, "greater than 0", "give the duration"),
    "terrain": ('"canyon"', '"canyno"', "world.terrain", "canyno", "no such terrain", "did you mean 'canyon'?"),
    "vehicle": ('asset = "car"', 'asset = "cra"', "vehicle[0].asset", "cra", "no such vehicle", "did you mean 'car'?"),
    "control": ("torque", "troque", "vehicle[0].motion.commands[0].troque", 500, "no such control", "did you mean"),
    "obstacle": (
        "[1, 1, 1]",
        "[1e-6, 1, 40]",
        "world.obstacle[0].shape",
        "box",
        "only 1e-06 m thick",
        "make it at least",
    ),
}
SHOT = """[shot]
schema = 1
name = "small"
fps = 24

[world]
terrain = "canyon"
[[world.obstacle]]
shape = "box"
centre = [0, 0, 0]
size = [1, 1, 1]

[[vehicle]]
name = "car"
asset = "car"
[vehicle.motion]
method = "simulate"
duration = 1
commands = [{ frame = 1001, torque = 500 }]
"""


@pytest.mark.parametrize("name", SHOTS)
def test_shot_files_report_errors_as_data(name: str, tmp_path: Path) -> None:
    before, after, key, value, message, remedy = SHOTS[name]
    path = tmp_path / "shot.toml"
    path.write_text(SHOT.replace(before, after))
    error = caught(lambda: Shot.load(path).solve())
    assert isinstance(error, ShotError)
    (problem,) = (problem for problem in error.problems if problem.severity == "error" and problem.key == key)
    assert problem.value == value and message in problem.message and problem.remedy.startswith(remedy)
    last = "shape" if name == "obstacle" else after
    changed = next(i for i, line in enumerate(path.read_text().splitlines(), 1) if last in line)
    assert (problem.file, problem.line) == (str(path), changed)


@pytest.mark.parametrize(
    ("before", "after", "key", "value", "message", "remedy"),
    [
        (
            "mass = ",
            "mass = -",
            "physics.mass",
            -1350.0,
            "it should be greater than 0",
            "give a number above zero, in kg",
        ),
        ('model = "car"', 'model = "cra"', "model", "cra", "unknown", "choose one of"),
        ("[physics]", 'modle = "car"\n[physics]', "modle", "car", "unknown key", "did you mean 'model'?"),
        ('op = "rotateY"', 'op = "rotateY"\nfactor = 0', "channels.", 0, "nothing would move", "give a number"),
        ("[physics]", "meters_per_unit = 0\n[physics]", "meters_per_unit", 0, "greater than 0", "give metres"),
        ("[physics]", "[physics]\nwings = 2", "physics.wings", 2, "unknown key", "known keys"),
    ],
)
def test_vehicle_files_report_errors_as_data(
    tmp_path: Path, before: str, after: str, key: str, value: Any, message: str, remedy: str
) -> None:
    source = described("vehicle")["car"].parent
    text = (source / "vehicle.toml").read_text()
    text = re.sub(r'(?m)^asset = "(.*?)"', lambda m: f'asset = "{source / m[1]}"', text)
    assert before in text
    (tmp_path / "vehicle.toml").write_text(text.replace(before, after, 1))
    error = caught(lambda: load_vehicle(tmp_path))
    assert isinstance(error, InputError) and error.problem.file == str(tmp_path / "vehicle.toml")
    named = text.replace(before, after, 1).splitlines()[(error.problem.line or 0) - 1]
    assert named.startswith(f"{error.key.rpartition('.')[2]} = ")
    assert error.key.startswith(key) and error.value == value
    assert message in error.message and error.remedy.startswith(remedy)


@pytest.mark.parametrize(
    ("line", "key", "value", "message", "remedy"),
    [
        ("cell = 0", "cell", 0, "it should be greater than 0", "give the spacing of the heights in m"),
        ("cell = [1, 2, 3]", "cell", [1, 2, 3], "3 given, at most 2 wanted", "give the spacing of the heights in m"),
        ("cell = 'wide'", "cell", "wide", "not a number", "give the spacing of the heights in m"),
        ("origin = [1, nan]", "origin[1]", None, "not a finite number", "give [x, y] of the first height"),
        ("range = 4", "range", 4, "not an array", "give [low, high]"),
        ("schema = 2", "schema", 2, "it should be at most 1", "give 1, the version"),
        ("look = 3", "look", 3, "not a text", "give a USD file"),
        ("look = 'none.usda'", "look", "none.usda", "no such file", "put the USD file there"),
        ("higths = 'a.npz'", "higths", "a.npz", "unknown key", "did you mean 'heights'?"),
    ],
)
@pytest.mark.parametrize("beside", [False, True])
def test_terrain_files_report_errors_as_data(
    tmp_path: Path, beside: bool, line: str, key: str, value: Any, message: str, remedy: str
) -> None:
    np.save(tmp_path / "a.npy", np.zeros((4, 4)))
    path = tmp_path / ("a.toml" if beside else "terrain.toml")
    path.write_text(f"# heights\nheights = 'a.npy'\n{line}\n")
    error = caught(lambda: World(terrain=str(tmp_path / "a.npy" if beside else path)))
    problem = error.problem
    assert (problem.key, problem.file, problem.line) == (key, str(path), 3)
    assert value is None or problem.value == value
    assert message in problem.message and problem.remedy.startswith(remedy)


def test_a_terrain_file_names_its_heights(tmp_path: Path) -> None:
    (tmp_path / "terrain.toml").write_text("cell = 1.0\n")
    error = caught(lambda: World(terrain=str(tmp_path)))
    assert (error.key, error.message) == ("heights", "missing") and "heights.npz" in error.remedy


def test_one_error_contains_all_problems_of_a_file(tmp_path: Path) -> None:
    (tmp_path / "terrain.toml").write_text("schema = 1\nheights = 3\ncell = -1\n")
    error = caught(lambda: World(terrain=str(tmp_path)))
    assert [(problem.key, problem.line) for problem in error.problems] == [("heights", 2), ("cell", 3)]


FULL = Problem("mark[0].hold", "a hold requires rest", "give velocity = [0, 0, 0]", 5, "a.toml", 7, "warning", "car")


@pytest.mark.parametrize(
    ("problem", "line"),
    [
        (FULL, "warning: a.toml:7: car: mark[0].hold = 5: a hold requires rest; give velocity = [0, 0, 0]"),
        (Problem("fps", "missing"), "fps: missing"),
        (Problem("fps", "missing", "give one"), "fps: missing; give one"),
        (Problem("", "out of time"), "out of time"),
        (Problem("", "out of time", subject="car"), "car: out of time"),
        (Problem("at", "not a state", value=np.zeros(2)), "at = [0.0, 0.0]: not a state"),
        (Problem("path", "no such file", value=Path("a/b")), "path = 'a/b': no such file"),
        (Problem("n", "too many", value=[1] * 100), f"n = [{'1, ' * 25}1...: too many"),
    ],
)
def test_the_printed_line_omits_empty_fields(problem: Problem, line: str) -> None:
    assert str(problem) == line
    assert str(InputError.of(problem, problem)) == f"{line}\n{line}"


def test_a_problem_moves_to_another_key() -> None:
    hold = Problem("hold", "a hold requires rest", "give velocity = [0, 0, 0]", 5)
    assert hold.below("mark[0]") == Problem("mark[0].hold", hold.message, hold.remedy, 5)
    assert Problem("", "wrong").below("mark[0]").key == "mark[0]"
    seen = FULL.seen_from("vehicle[0].asset", "car", "see vehsim vehicles")
    assert (seen.key, seen.value, seen.remedy, seen.severity) == ("vehicle[0].asset", "car", FULL.remedy, "warning")
    assert seen.message == "a.toml:7: car: mark[0].hold = 5: a hold requires rest" and not seen.file
    assert Problem("a", "wrong").seen_from("b", remedy="look there").remedy == "look there"
    repeated = Problem("vehicle", "no such vehicle", value="cra").seen_from("vehicle[0].asset", "cra")
    assert str(repeated) == "vehicle[0].asset = 'cra': no such vehicle"


@pytest.mark.parametrize(
    "error",
    [
        InputError("not a wind", "give three numbers", key="wind", value=3, file=Path("a.toml"), line=2, subject="car"),
        SolveError("stuck", subject="car"),
        ExportError("could not be written", "free some space", file="out"),
        ShotError([FULL, Problem("fps", "missing", "give one")]),
        TooFast("beyond its limits", 2.5),
    ],
)
def test_errors_can_be_sent_between_processes(error: VehsimError) -> None:
    other = pickle.loads(pickle.dumps(error))
    assert type(other) is type(error) and other.problems == error.problems and str(other) == str(error)
    assert vars(other) == vars(error)


@pytest.mark.parametrize(
    ("value", "plain"),
    [(3, 3), (2.5, 2.5), ("x", "x"), (True, True), (0, 0), (float("nan"), "nan"), ([1, 2], "[1, 2]"), ({}, "{}")],
)
def test_a_problem_is_json_data(value: object, plain: object) -> None:
    import json

    data = Problem("mark[0].frame", "too early", "give a later frame", value, file="a.toml", line=3).as_dict()
    assert json.loads(json.dumps(data, allow_nan=False)) == {
        "key": "mark[0].frame",
        "value": plain,
        "message": "too early",
        "remedy": "give a later frame",
        "file": "a.toml",
        "line": 3,
        "severity": "error",
    }
    assert "value" not in Problem("key", "missing").as_dict()
