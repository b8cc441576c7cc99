"""`vehsim retouch`: the curves of a delivery are edited in USD, and come back as a motion of the vehicle."""

from __future__ import annotations

import json
from collections.abc import Iterable
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from vehsim.cli import commands as cli
from vehsim.errors import SolveError
from vehsim.shot.shot import Shot

SHOT = """
[shot]
schema = 1
name = "drive"
[[vehicle]]
name = "car"
asset = "car"
[vehicle.motion]
method = "simulate"
duration = 4
step = 0.01
start = { velocity = [6, 0, 0] }
commands = [{ frame = 1001, torque = 50 }]
[export]
curves = { tolerance = 0.001, angle = 0.05 }
"""
PRIM = "/drive/vehicles/car"
pytestmark = pytest.mark.broken_stages  # an animator's layer over a delivery states no unit and no range


@pytest.fixture(scope="module")
def delivery(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("retouch")
    (folder / "shot.toml").write_text(SHOT)
    assert cli.run(["export", str(folder / "shot.toml"), "--out", str(folder / "out"), "--quiet"]) == 0
    return folder / "out" / "drive"


def positions(stage: Path, frames: Iterable[int], prim: str = PRIM) -> np.ndarray:
    from pxr import Usd, UsdGeom

    opened = Usd.Stage.Open(str(stage))
    shown = UsdGeom.Xformable(opened.GetPrimAtPath(prim))
    places = [shown.ComputeLocalToWorldTransform(int(frame)).ExtractTranslation() for frame in frames]
    return np.array(places)


def over(delivery: Path, path: Path, variant: str) -> object:
    """A stage over the delivery, as an animator would save it."""
    from pxr import Sdf, Usd

    layer = Sdf.Layer.CreateNew(str(path))
    layer.subLayerPaths = [str(delivery / "drive.usda")]
    stage = Usd.Stage.Open(layer)
    stage.SetTimeCodesPerSecond(24)
    stage.SetFramesPerSecond(24)
    for prim in stage.GetPrimAtPath("/drive/vehicles").GetChildren():
        prim.GetVariantSets().SetSelection("motion", variant)
    return stage


def bump(frame: float) -> float:
    share = np.clip((frame - 1030) / 40, 0, 1)
    return float(0.3 * (16 * share**2 * (1 - share) ** 2) ** 1.5)


def bend(track: Any) -> None:
    """Add the bump to a curve."""
    from pxr import Ts

    spline = Ts.Spline("double")
    for frame in range(1001, 1098, 4):
        knot = Ts.Knot("double")
        knot.SetTime(frame)
        knot.SetValue(float(track.Get(frame)) + bump(frame))
        knot.SetNextInterpolation(Ts.InterpCurve)
        slope = (bump(frame + 1) - bump(frame - 1)) / 2
        for side in ("Pre", "Post"):
            getattr(knot, f"Set{side}TanWidth")(4 / 3)
            getattr(knot, f"Set{side}TanSlope")(slope)
        spline.SetKnot(knot)
    track.SetSpline(spline)


@pytest.mark.parametrize("variant", ["exact", "curves"])
def test_edited_curves_come_back_as_motion(delivery: Path, tmp_path: Path, variant: str) -> None:
    from pxr import Gf, Usd

    stage = over(delivery, tmp_path / "edited.usda", variant)
    assert isinstance(stage, Usd.Stage)
    prim = stage.GetPrimAtPath(PRIM)
    if variant == "exact":
        track = prim.GetAttribute("xformOp:translate")
        places = {frame: track.Get(frame) for frame in range(1001, 1098)}
        for frame, place in places.items():
            track.Set(Gf.Vec3d(place[0], place[1] + bump(frame), place[2]), frame)
    else:
        track = prim.GetAttribute("xformOp:translateY")
        bend(track)
    stage.GetRootLayer().Save()

    arguments = ["retouch", str(delivery), "--edit", str(tmp_path / "edited.usda"), "--out", str(tmp_path / "new")]
    assert cli.run(arguments) == 0
    frames = range(1001, 1098)
    before, wanted = (positions(path, frames) for path in (delivery / "drive.usda", tmp_path / "edited.usda"))
    made = positions(tmp_path / "new" / "drive" / "drive.usda", frames)
    assert np.linalg.norm(made - wanted, axis=1).max() < 0.03
    touched = np.array([bump(frame) > 1e-3 for frame in frames])
    assert np.linalg.norm(made - before, axis=1)[~touched].max() < 0.01
    report = json.loads((tmp_path / "new" / "drive" / "report.json").read_text())
    edit = report["solved"]["vehicles"]["car"]["edit"]
    ((first, last),) = edit["touched"]
    assert 1030 <= first < last <= 1070
    assert cli.run(["audit", str(tmp_path / "new" / "drive"), "--quiet"]) == 0


def test_a_stage_without_the_vehicle_is_refused(
    delivery: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "other.usda").write_text('#usda 1.0\n(timeCodesPerSecond = 24)\ndef Xform "box" {}\n')
    arguments = ["retouch", str(delivery), "--edit", str(tmp_path / "other.usda"), "--out", str(tmp_path / "new")]
    assert cli.run(arguments) == cli.WRONG_INPUT
    assert f"edit {PRIM}" in capsys.readouterr().err.replace("\n", " ")
    assert not (tmp_path / "new").exists()


def test_files_of_the_shot_that_are_not_found_from_here_say_so(
    delivery: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The paths of a report are relative to the working folder of the export."""
    report = json.loads((delivery / "report.json").read_text())
    report["solved"]["shot"]["world"] = {"terrain": "ground/hill.npy"}
    (tmp_path / "report.json").write_text(json.dumps(report))
    arguments = ["retouch", str(tmp_path), "--edit", str(delivery / "drive.usda"), "--out", str(tmp_path / "new")]
    assert cli.run(arguments) == cli.WRONG_INPUT
    told = capsys.readouterr().err.replace("\n", " ")
    assert "world.terrain = 'ground/hill.npy'" in told and "relative to the working folder" in told and "--shot" in told


def test_a_folder_without_a_report_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.run(["retouch", str(tmp_path), "--edit", "edited.usda", "--out", str(tmp_path)]) == cli.WRONG_INPUT
    assert "no report.json" in capsys.readouterr().err


def test_a_folder_of_versions_names_the_newest(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for name in ("v001", "v002"):
        (tmp_path / name).mkdir()
    assert cli.run(["retouch", str(tmp_path), "--edit", "edited.usda", "--out", str(tmp_path)]) == cli.WRONG_INPUT
    told = capsys.readouterr().err.replace("\n", "")
    assert "holds versions" in told and str(tmp_path / "v002") in told


def test_edits_of_other_prims_are_named(delivery: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """A wheel, a camera and a part that does not move are edited; the root is not, and wheels on splines are theirs."""
    from pxr import Gf, Usd, UsdGeom

    stage = over(delivery, tmp_path / "edited.usda", "curves")
    assert isinstance(stage, Usd.Stage)
    for path in (f"{PRIM}/steer_fl/wheel_fl", f"{PRIM}/body", "/drive/cameras/chase"):
        moved = UsdGeom.Xformable(stage.GetPrimAtPath(path)).AddTranslateOp(opSuffix="aside")
        moved.Set(Gf.Vec3d(0, 0, 0), 1001)
        moved.Set(Gf.Vec3d(0, 0.01, 0), 1040)
    stage.GetRootLayer().Save()
    arguments = ["retouch", str(delivery), "--edit", str(tmp_path / "edited.usda"), "--out", str(tmp_path / "new")]
    assert cli.run([*arguments, "--log", "json"]) == 0
    events = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    assert events[-1]["event"] == "done"
    said = [event["message"] for event in events if event["event"] == "warning"]
    outside, parts = [message for message in said if "also moves" in message]
    assert outside.startswith("the edit also moves /drive/cameras/chase (by 10 mm at frame 1040), without effect")
    assert parts.startswith(
        "car: the edit also moves steer_fl/wheel_fl (by 10 mm at frame 1040), body (by 10 mm at frame 1040), without "
    )


@pytest.mark.parametrize("moved", [False, True])
def test_only_edits_beyond_the_motion_are_warned_of(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], moved: bool
) -> None:
    """The car stands from frame 1097 on: its delivered curves, which go on to the last frame, are no edit."""
    from pxr import Usd

    (tmp_path / "shot.toml").write_text(SHOT.replace('name = "drive"', 'name = "drive"\nend_frame = 1121'))
    assert cli.run(["export", str(tmp_path / "shot.toml"), "--out", str(tmp_path / "out"), "--quiet"]) == 0
    stage = over(tmp_path / "out" / "drive", tmp_path / "edited.usda", "exact")
    assert isinstance(stage, Usd.Stage)
    track = stage.GetPrimAtPath(PRIM).GetAttribute("xformOp:translate")
    for frame, place in [(frame, track.Get(frame)) for frame in range(1001, 1122)]:
        track.Set(place + (type(place)(0, 0.1, 0) if moved and frame >= 1110 else type(place)()), frame)
    stage.GetRootLayer().Save()
    capsys.readouterr()
    edit = ["--edit", str(tmp_path / "edited.usda"), "--out", str(tmp_path / "new"), "--log", "json"]
    assert cli.run(["retouch", str(tmp_path / "out" / "drive"), *edit]) == 0
    events = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    said = [event["message"] for event in events if event["event"] == "warning" and "beyond" in event["message"]]
    place = "car: the edit moves in frames 1110 to 1121, beyond the motion, which goes from 1001 to 1097"
    assert said == ([f"{place}; they are ignored"] if moved else [])


def test_motion_through_handles_is_no_edit(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """A planned car comes and goes through the handles: its root and its wheels there are as they were delivered."""
    from pxr import Usd

    plan = """
method = "plan"
segments = 12
mark = [{ frame = 1001, position = [0, 0, 0], velocity = [6, 0, 0] }, { frame = 1049, position = [12, 0.5, 0] }]
"""
    start, stop = SHOT.index("method"), SHOT.index("[export]")
    text = (SHOT[:start] + plan + SHOT[stop:]).replace('"drive"', '"drive"\nend_frame = 1049\nhandles = 6')
    (tmp_path / "shot.toml").write_text(text)
    assert cli.run(["export", str(tmp_path / "shot.toml"), "--out", str(tmp_path / "out"), "--quiet"]) == 0
    stage = over(tmp_path / "out" / "drive", tmp_path / "edited.usda", "exact")
    assert isinstance(stage, Usd.Stage)
    track = stage.GetPrimAtPath(PRIM).GetAttribute("xformOp:translate")
    for frame, place in [(frame, track.Get(frame)) for frame in range(995, 1056)]:
        track.Set(place, frame)
    stage.GetRootLayer().Save()
    capsys.readouterr()
    edit = ["--edit", str(tmp_path / "edited.usda"), "--out", str(tmp_path / "new"), "--log", "json"]
    assert cli.run(["retouch", str(tmp_path / "out" / "drive"), *edit]) == 0
    events = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    said = [event["message"] for event in events if event["event"] == "warning" and "the edit" in event["message"]]
    assert said == ["car: the edit changes nothing: its curves are those of the solved motion"]


BESIDE = """
[world]
terrain = "flat"
[[vehicle]]
name = "handle"
asset = "tumbler"
[vehicle.motion]
method = "integrate"
duration = 2
start = { position = [0, 9, 3], spin = [63, 5, 41] }
[[vehicle]]
name = "truck"
asset = "truck"
[vehicle.motion]
method = "sinusoid"
limits = { speed = 3 }
mark = [{ frame = 1001, position = [0, -20, 0] }, { frame = "free", position = [-6, -20, 0] }]
"""


def test_vehicles_that_the_edit_leaves_alone_stay_as_they_are(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Also one that cannot be retouched, and a truck that dives when it brakes."""
    from pxr import Usd

    (tmp_path / "shot.toml").write_text(SHOT + BESIDE)
    assert cli.run(["export", str(tmp_path / "shot.toml"), "--out", str(tmp_path / "out"), "--quiet"]) == 0
    stage = over(tmp_path / "out" / "drive", tmp_path / "edited.usda", "exact")
    assert isinstance(stage, Usd.Stage)
    track = stage.GetPrimAtPath(PRIM).GetAttribute("xformOp:translate")
    for frame, place in [(frame, track.Get(frame)) for frame in range(1001, 1098)]:
        track.Set(place + type(place)(0, bump(frame), 0), frame)
    stage.GetRootLayer().Save()
    capsys.readouterr()
    edit = ["--edit", str(tmp_path / "edited.usda"), "--out", str(tmp_path / "new"), "--log", "json"]
    assert cli.run(["retouch", str(tmp_path / "out" / "drive"), *edit]) == 0
    events = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    said = [event["message"] for event in events if event["event"] == "warning"]
    assert not [message for message in said if "without effect" in message]
    report = json.loads((tmp_path / "new" / "drive" / "report.json").read_text())
    about = report["solved"]["vehicles"]
    assert len(about["car"]["edit"]["touched"]) == 1
    assert "edit" not in about["handle"]


def test_a_refused_retouch_is_an_event_with_its_problem(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    arguments = ["retouch", str(tmp_path), "--edit", "edited.usda", "--out", str(tmp_path), "--log", "json"]
    assert cli.run(arguments) == cli.WRONG_INPUT
    last = json.loads(capsys.readouterr().out.splitlines()[-1])
    assert last["event"] == "failed" and "no report.json" in last["problems"][0]["message"]


def test_a_check_logs_problems_as_data(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "shot.toml").write_text(SHOT.replace("torque = 50", "torque = true"))
    assert cli.run(["check", str(tmp_path / "shot.toml"), "--log", "json"]) == cli.WRONG_INPUT
    (event,) = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    assert event["event"] == "refused" and event["problem"]["key"].startswith("vehicle[0].motion.commands")


def test_curves_of_an_open_shutter_go_on_for_a_frame(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Curves of a delivery with motion blur have keys a frame before and after the shot: they are no edit."""
    from pxr import Usd

    (tmp_path / "shot.toml").write_text(SHOT + "shutter = [-0.25, 0.25]\n")
    assert cli.run(["export", str(tmp_path / "shot.toml"), "--out", str(tmp_path / "out"), "--quiet"]) == 0
    stage = over(tmp_path / "out" / "drive", tmp_path / "edited.usda", "curves")
    assert isinstance(stage, Usd.Stage)
    prim = stage.GetPrimAtPath(PRIM)
    keys = [*prim.GetAttribute("xformOp:translateX").GetSpline().GetKnots().keys()]
    assert (min(keys), max(keys)) == (1000, 1098)
    bend(prim.GetAttribute("xformOp:translateY"))
    stage.GetRootLayer().Save()
    capsys.readouterr()
    edit = ["--edit", str(tmp_path / "edited.usda"), "--out", str(tmp_path / "new"), "--log", "json"]
    assert cli.run(["retouch", str(tmp_path / "out" / "drive"), *edit]) == 0
    events = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    assert not [event for event in events if event["event"] == "warning" and "beyond" in event["message"]]


def moved(delivery: Path, path: Path, later: int = 0, by: float = 1.0, prim: str = PRIM, last: int = 1097) -> Path:
    """An edit of a delivery: its vehicle is moved aside in frames 1030 to 1070, or ``later`` ones."""
    from pxr import Usd

    stage = over(delivery, path, "exact")
    assert isinstance(stage, Usd.Stage)
    track = stage.GetPrimAtPath(prim).GetAttribute("xformOp:translate")
    for frame, place in [(frame, track.Get(frame)) for frame in range(1001, last + 1)]:
        track.Set(place + type(place)(0, by * bump(frame - later), 0), frame)
    stage.GetRootLayer().Save()
    return path


def retouched(delivery: Path, edit: Path, out: Path, *more: str) -> Path:
    assert cli.run(["retouch", str(delivery), "--edit", str(edit), "--out", str(out), "--quiet", *more]) == 0
    return out / delivery.name


def test_a_retouched_delivery_is_retouched_again(delivery: Path, tmp_path: Path) -> None:
    """Each edit starts from the delivery of the one before, which keeps what the new one does not touch."""
    frames = np.arange(1001, 1098)
    first = retouched(delivery, moved(delivery, tmp_path / "e1.usda"), tmp_path / "r1")
    second = retouched(first, moved(first, tmp_path / "e2.usda", 12, -0.5), tmp_path / "r2")
    third = retouched(second, moved(second, tmp_path / "e3.usda", -15, 0.3), tmp_path / "r3")
    places = [positions(folder / "drive.usda", frames) for folder in (delivery, first, second, third)]
    for (before, after), (later, by) in zip(pairwise(places), [(0, 1.0), (12, -0.5), (-15, 0.3)], strict=True):
        wanted = np.array([by * bump(frame - later) for frame in frames])
        assert np.abs((after - before)[:, 1] - wanted).max() < 0.03
    about = json.loads((third / "report.json").read_text())["solved"]
    assert [Path(edit["usd"]).name for edit in about["shot"]["vehicle"][0]["edit"]] == ["e1.usda", "e2.usda", "e3.usda"]
    assert about["vehicles"]["car"]["edit"]["round"] == 3
    assert [edit["round"] for edit in about["vehicles"]["car"]["edit"]["earlier"]] == [1, 2]
    again = Shot.from_dict(about["shot"], Path()).solve().clips["car"]
    assert again.at((frames - 1001) / 24).positions == pytest.approx(places[-1], abs=1e-9)


def test_a_retouched_delivery_is_retouched_again_from_its_shot_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The shot file does not know the first edit, whose path counts from the working folder of the first retouch."""
    monkeypatch.chdir(tmp_path)
    Path("shots").mkdir()
    Path("shots/shot.toml").write_text(SHOT)
    assert cli.run(["export", "shots/shot.toml", "--out", "out", "--quiet"]) == 0
    solved = tmp_path / "out" / "drive"
    first = retouched(solved, moved(solved, Path("e1.usda")), tmp_path / "r1")
    edit = moved(first, tmp_path / "e2.usda", 12, -0.5)
    second = retouched(first, edit, tmp_path / "r2", "--shot", "shots/shot.toml")
    monkeypatch.chdir("shots")
    other = retouched(first, edit, tmp_path / "r3", "--shot", "shot.toml")
    frames = range(1001, 1098)
    made = [positions(folder / "drive.usda", frames) for folder in (first, second, other)]
    assert np.ptp((made[1] - made[0])[:, 1]) > 0.1 and np.array_equal(made[1], made[2])
    given = json.loads((other / "report.json").read_text())["solved"]["shot"]["vehicle"][0]["edit"]
    assert [edit["usd"] for edit in given] == ["../e1.usda", "../e2.usda"]


def test_a_retouch_from_the_file_of_an_earlier_one_is_refused(
    delivery: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    first = retouched(delivery, moved(delivery, tmp_path / "edited.usda"), tmp_path / "r1")
    edit = moved(first, tmp_path / "edited.usda", 12)
    assert cli.run(["retouch", str(first), "--edit", str(edit), "--out", str(tmp_path / "r2")]) == cli.WRONG_INPUT
    assert "save the new edit under another name" in capsys.readouterr().err.replace("\n", " ")


def test_an_edit_of_another_vehicle_comes_after_those_of_the_first(tmp_path: Path) -> None:
    """The second delivery has the motion of the first, although its file names the other vehicle before."""
    start = SHOT.index("[[vehicle]]")
    car, rest = SHOT[start : SHOT.index("[export]")], SHOT[SHOT.index("[export]") :]
    beside = car.replace('name = "car"', 'name = "beside"').replace("velocity", "position = [0, 9, 0], velocity")
    (tmp_path / "shot.toml").write_text(SHOT[:start] + beside + car + rest)
    assert cli.run(["export", str(tmp_path / "shot.toml"), "--out", str(tmp_path / "out"), "--quiet"]) == 0
    solved = tmp_path / "out" / "drive"
    first = retouched(solved, only(moved(solved, tmp_path / "e1.usda"), "car"), tmp_path / "r1")
    both = moved(first, tmp_path / "e2.usda", prim="/drive/vehicles/beside")
    second = retouched(first, only(both, "beside"), tmp_path / "r2")
    edits = [table["edit"] for table in json.loads((second / "report.json").read_text())["solved"]["shot"]["vehicle"]]
    assert [[edit.get("round") for edit in own] for own in edits] == [[2], [None]]
    at = range(1001, 1098)
    before, after = (positions(folder / "drive.usda", at) for folder in (first, second))
    assert np.array_equal(before, after)


def only(edit: Path, vehicle: str) -> Path:
    """The edit as another tool exports it: with one vehicle."""
    from pxr import Usd

    layer = Usd.Stage.Open(str(edit)).Flatten()
    layer.pseudoRoot.SetInfo("upAxis", "Z")
    layer.pseudoRoot.SetInfo("metersPerUnit", 1.0)
    for name in [child.name for child in layer.GetPrimAtPath("/drive/vehicles").nameChildren]:
        if name != vehicle:
            del layer.GetPrimAtPath("/drive/vehicles").nameChildren[name]
    alone = edit.with_name(f"{edit.stem}_{vehicle}.usda")
    assert layer.Export(str(alone))
    return alone


def test_rounds_of_edits_rise(delivery: Path, tmp_path: Path) -> None:
    edit = moved(delivery, tmp_path / "e1.usda")
    table = f'[[vehicle.edit]]\nusd = "{edit}"\nprim = "{PRIM}"\nround = 2\n'
    text = SHOT.replace("[vehicle.motion]", f"{table}{table}[vehicle.motion]")
    (tmp_path / "shot.toml").write_text(text)
    (problem,) = Shot.load(tmp_path / "shot.toml").check()
    assert problem.key == "vehicle[0].edit" and "rounds do not rise" in problem.message

    first = f'marks = {{ usd = "{edit}", prim = "{PRIM}", edit = true }}\n'  # in round 1
    for number, wrong in ((1, 1), (2, 0)):
        later = table.replace("round = 2", f"round = {number}")
        plan = PLAN.replace("mark = [", f"{first}mark = [") + later + SHOT[SHOT.index("[export]") :]
        (tmp_path / "shot.toml").write_text(SHOT[: SHOT.index("method")] + plan)
        shot = Shot.load(tmp_path / "shot.toml")
        assert len(shot.check()) == wrong and shot.last_round == number


PLAN = """
method = "plan"
segments = 12
mark = [
    { frame = 1001, position = [0, 0, 0], velocity = [0, 0, 0] }, { frame = 1121, position = [12, 0, 0], heading = 0 },
]
"""


def test_a_motion_beyond_its_character_is_warned_of(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """The plan keeps to it; an edit that throws the car aside does not."""
    text = SHOT[: SHOT.index("method")] + PLAN + SHOT[SHOT.index("[export]") :]
    (tmp_path / "shot.toml").write_text(text)
    export = ["export", str(tmp_path / "shot.toml"), "--out", str(tmp_path / "out"), "--log", "json"]
    assert cli.run(export) == 0
    assert "; beyond" not in capsys.readouterr().out
    solved = tmp_path / "out" / "drive"
    edit = moved(solved, tmp_path / "edited.usda", 0, 4.0, last=1121)
    arguments = ["retouch", str(solved), "--edit", str(edit), "--out", str(tmp_path / "new"), "--log", "json"]
    assert cli.run(arguments) == 0
    events = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    (said,) = [event["message"] for event in events if event["event"] == "warning" and "beyond" in event["message"]]
    assert said.startswith("car: retouched; beyond normal: character.") and " allowed, at frame " in said
    about = json.loads((tmp_path / "new" / "drive" / "report.json").read_text())["solved"]
    assert said.endswith(": " + "; ".join(about["vehicles"]["car"]["edit"]["beyond"]))


def test_a_vehicle_without_a_motion_is_named_as_in_the_shot(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def refused(clip: Any, *given: Any, **options: Any) -> None:
        raise SolveError("no motion leads back", "edit less", subject=clip.vehicle.name)

    (tmp_path / "shot.toml").write_text(SHOT.replace('name = "car"', 'name = "bot"'))
    assert cli.run(["export", str(tmp_path / "shot.toml"), "--out", str(tmp_path / "out"), "--quiet"]) == 0
    solved = tmp_path / "out" / "drive"
    monkeypatch.setattr("vehsim.planning.retouch.retouch", refused)
    edit = moved(solved, tmp_path / "edited.usda", prim="/drive/vehicles/bot")
    assert cli.run(["retouch", str(solved), "--edit", str(edit), "--out", str(tmp_path / "new")]) == cli.FAILED
    assert "bot: no motion leads back" in capsys.readouterr().err.replace("\n", " ")
