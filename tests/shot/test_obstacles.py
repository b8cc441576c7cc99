"""Obstacles from the shot file to stage, strobe and figures; problems of a table are reported at its key."""

import copy
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from pxr import Usd, UsdGeom

from vehsim import Shot, load_vehicle
from vehsim.errors import ShotError, SolveError
from vehsim.exporters.checks.validate import validate_stage
from vehsim.exporters.pictures.strobe import strobe_frames

SHOT = {
    "shot": {"schema": 1, "name": "yard", "fps": 24},
    "world": {
        "terrain": "flat",
        "obstacle": [
            {"shape": "polygon", "name": "wedge", "points": [[8, -3], [12, -2], [11, 1]], "height": 1.5},
            {"shape": "ellipse", "centre": [16, 5], "radii": [2, 1], "heading": 30},
            {"shape": "box", "name": "crate", "centre": [15, -5, 0], "size": [2, 1, 1]},
        ],
    },
    "vehicle": [
        {
            "name": "car",
            "asset": "car",
            "motion": {
                "method": "plan",
                "segments": 48,
                "clearance": 0.4,
                "mark": [
                    {"frame": 1001, "position": [0, 0, 0], "heading": 0, "velocity": [0, 0, 0]},
                    {"frame": "free", "position": [24, 0, 0], "heading": 0, "velocity": [0, 0, 0]},
                ],
            },
        }
    ],
}


@pytest.fixture(scope="module")
def delivery(tmp_path_factory) -> Path:
    take = Shot.from_dict(SHOT | {"render": {"size": [160, 90], "samples": 0}}).solve()
    return take.export(tmp_path_factory.mktemp("yard"), to=("usd", "strobe", "figures"))


def problems(change) -> dict[str, str]:
    data = copy.deepcopy(SHOT)
    change(data)
    try:
        found = Shot.from_dict(data).check()
    except ShotError as error:
        found = error.problems
    return {problem.key: f"{problem.message}; {problem.remedy}" for problem in found}


def test_standing_obstacles_are_in_the_stage(delivery):
    stage = Usd.Stage.Open(str(delivery / "yard.usda"))
    group = stage.GetPrimAtPath("/yard/env/obstacles")
    names = {prim.GetName() for prim in group.GetChildren()}
    assert names == {"wedge", "ellipse_1", "crate", "materials"}
    mesh = UsdGeom.Mesh(stage.GetPrimAtPath("/yard/env/obstacles/wedge/wedge"))
    points = np.array(mesh.GetPointsAttr().Get())
    np.testing.assert_allclose(points.max(axis=0), [12, 1, 1.5], atol=1e-6)
    assert not validate_stage(delivery / "yard.usda")


def test_the_strobe_is_one_picture_without_temporary_files(delivery):
    from PIL import Image

    with Image.open(delivery / "yard.strobe.png") as picture:
        assert picture.size == (160, 90)
        assert np.asarray(picture).std() > 5
    assert not list(delivery.glob(".*"))


def test_poses_of_a_strobe_do_not_overlap():
    """From rest to rest over 60 m: evenly in time, without those of the first and last second."""
    times = np.linspace(0, 10, 241)
    positions = np.column_stack([30 * (1 - np.cos(np.pi * times / 10)), *np.zeros((2, 241))])
    clip = SimpleNamespace(
        vehicle=load_vehicle("car"), times=times, positions=positions, start_frame=1, end_frame=241, fps=24
    )
    frames = strobe_frames(clip, (1, 241))
    assert frames[0] == 1 and frames[-1] == 241
    assert np.diff(positions[np.array(frames) - 1, 0]).min() > 4.3  # the car's length


def test_figures_show_path_obstacles_and_controls(delivery):
    top = (delivery / "figures" / "car.top.svg").read_text()
    assert top.count("<polygon") >= 3 + 5 and "path of the root" in top
    controls = (delivery / "figures" / "car.controls.svg").read_text()
    assert "torque" in controls and "steering_rate" in controls
    assert not (delivery / "figures" / "car.side.svg").exists()  # it stays on level ground


@pytest.mark.parametrize(
    "change, key, words",
    [
        (lambda d: d["world"]["obstacle"].append({"shape": "pyramid"}), "world.obstacle[3].shape", 'give "polygon"'),
        (lambda d: d["world"]["obstacle"].append({"name": "a"}), "world.obstacle[3].shape", "missing"),
        (
            lambda d: d["world"]["obstacle"][0].update(points=[[0, 9], [1, 10], [1, 9], [0, 11]]),
            "world.obstacle[0].points",
            "its edges cross or touch each other at",
        ),
        (lambda d: d["world"]["obstacle"][2].update(name="wedge"), "world.obstacle[2].name", "used twice"),
        (lambda d: d["world"]["obstacle"][2].update(radius=1), "world.obstacle[2].radius", "unknown key"),
        (
            lambda d: d["world"]["obstacle"].append({"shape": "vehicle", "vehicle": "truk"}),
            "world.obstacle[3].vehicle",
            "no such vehicle",
        ),
        (
            lambda d: d["world"]["obstacle"].append({"shape": "mesh", "path": "none.obj"}),
            "world.obstacle[3].path",
            "no such file",
        ),
        (
            lambda d: d["world"]["obstacle"][2].update(centre=[24, 0, 0]),
            "vehicle[0].motion.mark[1].position",
            "in obstacle 'crate'",
        ),
        (
            lambda d: d["world"]["obstacle"][2].update(centre=[15, -5, 0.5]),
            "world.obstacle[2].centre",
            "obstacle 'crate' hangs 0.5 m above the ground, half of its height",
        ),
        (
            lambda d: d["world"]["obstacle"].append({"shape": "cone", "centre": [2, 9, 2], "height": 4}),
            "world.obstacle[3].centre",
            "if it stands, give z = 0",
        ),
    ],
)
def test_problems_are_reported_at_their_key(change, key, words):
    found = problems(change)
    assert words in found.get(key, ""), found


def test_a_valid_shot_has_no_problems():
    assert problems(lambda data: None) == {}


def test_another_vehicle_on_the_path_is_avoided():
    """Another car stands in the way; it is not a mesh of the world, and the plan goes around it."""
    data = copy.deepcopy(SHOT)
    data["world"]["obstacle"] = [{"shape": "vehicle", "vehicle": "parked"}]
    start = {"position": [12.0, 0.2, 0.0], "heading": 90.0}
    data["vehicle"].append(
        {"name": "parked", "asset": "car", "motion": {"method": "simulate", "duration": 1.0, "start": start}}
    )
    take = Shot.from_dict(data).solve()
    assert list(take.clips) == ["car", "parked"] and not take.world.obstacles
    way = take.clips["car"].positions
    beside = np.abs(way[:, 0] - 12).argmin()
    assert abs(way[beside, 1] - 0.2) > 2.15 + 0.9 + 0.4


def test_a_left_out_vehicle_that_others_avoid_is_named() -> None:
    data = copy.deepcopy(SHOT)
    data["vehicle"].append({**copy.deepcopy(data["vehicle"][0]), "name": "other"})
    data["world"]["obstacle"].append({"shape": "vehicle", "vehicle": "other"})
    (problem,) = Shot.from_dict(data).only(["car"]).check()
    assert (problem.key, problem.value) == ("world.obstacle[3].vehicle", "other")
    assert str(problem).endswith("left out, but the others avoid it; add --only other")


def apart(other: dict, clearance: float) -> Shot:
    """A planned car and another vehicle that cross; each is an obstacle for the other."""
    marks = [
        {"frame": 1001, "position": [0, 0, 0], "heading": 0, "velocity": [0, 0, 0]},
        {"frame": 1193, "position": [30, 0, 0], "velocity": [0, 0, 0]},
    ]
    first = {"method": "plan", "segments": 16, "clearance": clearance, "mark": marks}
    return Shot.from_dict(
        {
            "shot": {"schema": 1, "name": "apart"},
            "world": {"obstacle": [{"shape": "vehicle", "vehicle": name} for name in ("first", "second")]},
            "vehicle": [
                {"name": "first", "asset": "car", "motion": first},
                {"name": "second", "asset": "car", "motion": other},
            ],
        }
    )


def test_a_plan_keeps_clear_of_a_simulated_vehicle_that_the_file_names_later():
    """Both were delivered, with exit code 0, while one drove through the other."""
    start = {"position": [15, -12, 0], "heading": 90, "velocity": [0, 3, 0]}
    take = apart({"method": "simulate", "duration": 8, "start": start}, 1.0).solve()
    clearance = {row["key"]: row for row in take.report["audit"]["first"]}["clearance"]
    assert clearance["met"]
    assert clearance["value"] >= 0.99


def test_a_clearance_that_a_later_plan_does_not_keep_is_refused():
    """The first vehicle's clearance was measured against nothing that was solved after it."""
    marks = [
        {"frame": 1001, "position": [-1, 4, 0], "heading": 0, "velocity": [0, 0, 0]},
        {"frame": 1193, "position": [29, 4, 0], "velocity": [0, 0, 0]},
    ]
    second = {"method": "plan", "segments": 16, "clearance": 0.5, "mark": marks}
    with pytest.raises(SolveError, match=r"first: clearance: 1\.98\d* m.*give the motion of second a clearance of 3 m"):
        apart(second, 3.0).solve(cached=False)
    marks[0]["position"][1] = marks[1]["position"][1] = 6
    take = apart(second | {"clearance": 3.0}, 3.0).solve(cached=False)
    assert {row["key"]: row["met"] for row in take.report["audit"]["first"]}["clearance"]


def test_contact_in_the_handles_is_warned_of():
    """The clearance of a plan ends with its last mark: two cars that met in the handles were delivered silently."""
    rest = {"frame": 1001, "position": [0, 0, 0], "heading": 0, "velocity": [4, 0, 0]}
    marks = [rest, {"frame": 1097, "position": [16, 0, 0], "heading": 0, "velocity": [4, 0, 0]}]
    start = {"position": [20, -24.5, 0], "heading": 90, "velocity": [0, 3.5, 0]}
    shot = Shot.from_dict(
        {
            "shot": {"schema": 1, "name": "met", "start_frame": 1001, "end_frame": 1097, "handles": 48},
            "world": {"obstacle": [{"shape": "vehicle", "vehicle": "other"}]},
            "vehicle": [
                {"name": "car", "asset": "car", "motion": {"method": "plan", "segments": 16, "mark": marks}},
                {"name": "other", "asset": "car", "motion": {"method": "simulate", "start": start}},
            ],
        }
    )
    with pytest.warns(UserWarning, match=r"car: contact: -\d\.\d+ m, -0\.05 required, at frame 11[0-4]\d") as said:
        take = shot.solve()
    assert len([warning for warning in said if "car: contact" in str(warning.message)]) == 1
    assert {row["key"]: row["met"] for row in take.report["audit"]["car"]}["clearance"]
