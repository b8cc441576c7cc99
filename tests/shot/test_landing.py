"""Landings in shot files: on a pad, at the frame; the stage contains the pad, the report the position."""

import numpy as np
import pytest
from pxr import Usd, UsdGeom

from vehsim import Shot
from vehsim.exporters.checks.review import review
from vehsim.exporters.checks.validate import validate_stage


def shot(**last):
    mark = {"frame": 193, "position": [30, 0, 25], "heading": 0, "on_ground": True} | last
    start = {"frame": 1, "position": [0, 0, 10], "heading": 0, "velocity": [0, 0, 0]}
    motion = {"method": "plan", "segments": 48, "clearance": 1.0, "mark": [start, mark]}
    obstacles = [
        {"shape": "box", "name": "pad", "centre": [30, 0, -1], "size": [10, 10, 3]},
        {"shape": "sphere", "name": "balloon", "centre": [14, 12, 9], "radius": 3},
    ]
    return Shot.from_dict({
        "shot": {"schema": 1, "name": "hop", "fps": 24, "start_frame": 1},
        "world": {"terrain": "flat", "obstacle": obstacles},
        "vehicle": [{"name": "heli", "asset": "helicopter", "motion": motion}],
    })  # fmt: skip


def test_a_landing_from_file_to_stage(tmp_path):
    take = shot().solve()
    clip = take.clips["heli"]
    assert clip.end_frame == 193
    assert clip.positions[-1] == pytest.approx([30, 0, 2], abs=1e-4)
    assert take.report["marks"]["heli"][-1]["position"] == pytest.approx([30, 0, 2], abs=1e-4)
    folder = take.export(tmp_path, to=("usd",))
    assert not validate_stage(folder / "hop.usda")
    stage = Usd.Stage.Open(str(folder / "hop.usda"))
    ball = next(p for p in Usd.PrimRange(stage.GetPrimAtPath("/hop/env/obstacles/balloon")) if p.IsA(UsdGeom.Mesh))
    points = np.array(UsdGeom.Mesh(ball).GetPointsAttr().Get())
    radius = np.linalg.norm(points - [14, 12, 9], axis=1)
    assert radius.min() >= 3.0 - 1e-6 and radius.max() < 3.04


@pytest.mark.parametrize("heading, wind", [(180, [0, 0, 0]), (60, [-3, 5, 0])])
def test_a_landing_comes_down_upright_without_a_turn(heading, wind):
    """It turned by 19 degrees per second and slid by 0.9 m/s in the last 0.3 m, see `slide`."""
    data = shot(heading=heading, frame=265).file.model_dump(mode="json", by_alias=True, exclude_unset=True)
    data["world"]["wind"] = wind
    windy = Shot.from_dict(data)
    rows = review(windy.solve().clips["heli"], windy.world)
    (slide,) = (row for row in rows if row["name"] == "slide")
    assert slide["inside"] and slide["worst"] > 0.1


@pytest.mark.parametrize("height", [2.0, 1.6])
def test_a_landing_mark_may_be_at_the_height_of_the_ground(height):
    """As an animator gives it: the pad's own height, or slightly less."""
    assert not shot(position=[30, 0, height]).check()


@pytest.mark.parametrize(
    "wrong, complaint",
    [
        ({"position": [30, 0, 1]}, "inside the ground or an obstacle; raise it to 2.00 m, where it stands on top"),
        ({"speed": 2.0}, "the vehicle stands still at this mark; drop speed"),
        ({"tolerance": 1.0}, "drop speed, tolerance and gate"),
    ],
)
def test_impossible_landings_are_reported(wrong, complaint):
    assert any(complaint in f"{problem.message}; {problem.remedy}" for problem in shot(**wrong).check())


def test_a_landing_in_the_ground_is_raised_by_its_fix():
    """On a hill, to where it stands on the higher of its feet."""
    world, mark = {"terrain": "hills"}, {"position": [40, 0, -3], "heading": 0, "on_ground": True}
    data = shot(**mark).file.model_dump(mode="json", by_alias=True, exclude_unset=True)
    data["world"] = world
    (problem,) = [found for found in Shot.from_dict(data).check() if found.severity == "error"]
    assert problem.key.endswith("mark[1].position") and problem.value == [40, 0, -3]
    ((key, place),) = problem.fixes
    assert key == problem.key and f"{place[2]:.2f} m" in problem.remedy
    data["vehicle"][0]["motion"]["mark"][1]["position"] = place
    assert not [found for found in Shot.from_dict(data).check() if found.severity == "error"]


def test_a_valid_landing_has_no_problems():
    assert not shot().check()


@pytest.mark.parametrize("velocity", [None, [0, 0, 0], [3, 0, 0]])
def test_a_mark_without_a_heading_is_checked_for_obstacles(velocity):
    """At rest 0.3 m above the pad, no heading keeps 1 m; in motion its attitude is unknown."""
    mark = {"position": [30, 0, 2.3], "heading": None, "on_ground": False, "velocity": velocity}
    found = shot(**mark).check()
    if velocity == [0, 0, 0]:
        assert "at any heading" in str(found[0]) and found[0].key.endswith("mark[1].position")
    else:
        assert not found
