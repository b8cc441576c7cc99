"""One shot exported by several commands: the files of each stay, and files that disagree are set apart with a
warning."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pxr import Usd, UsdGeom

from vehsim import Clip
from vehsim.cli import commands as cli

Write = Callable[..., Path]
Content = Callable[[Path], dict[str, str]]


@pytest.fixture
def export(write: Write, tmp_path: Path) -> Callable[..., int]:
    """Run ``vehsim export`` on the one shot: exporters, then options."""
    shot = write()
    return lambda to, *options: cli.run(["export", str(shot), "--out", str(tmp_path / "out"), "--to", to, *options])


def files(folder: Path) -> set[str]:
    return {path.relative_to(folder).as_posix() for path in folder.rglob("*") if path.is_file()}


def test_adding_a_table_later_keeps_stage_and_pictures(
    export: Callable[..., int], tmp_path: Path, content: Content, capsys: pytest.CaptureFixture[str]
) -> None:
    drive = tmp_path / "out" / "drive"
    small = ["--set", "render.size=[64,36]", "--set", "render.every=3"]
    assert export("usd,png", *small) == 0
    before = content(drive)
    assert export("csv") == 0  # render settings do not affect the motion
    after = content(drive)
    assert {name: after[name] for name in before if name != "report.json"} == {
        name: before[name] for name in before if name != "report.json"
    }
    assert after.keys() - before.keys() == {"car.csv"}
    report = json.loads((drive / "report.json").read_text())
    assert report["files"].keys() == files(drive) - {"report.json"}
    assert all(after[name] == digest for name, digest in report["files"].items())
    assert "earlier" not in capsys.readouterr().err


def test_resume_knows_what_each_exporter_delivered(
    export: Callable[..., int], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    drive = tmp_path / "out" / "drive"
    export("npz,usd")
    export("csv")
    capsys.readouterr()
    for to in ("csv", "npz,usd"):
        assert export(to, "--resume") == 0
        assert "already finished" in capsys.readouterr().out
    (drive / "car.npz").write_bytes(b"")
    assert export("csv", "--resume") == 0
    assert "already finished" in capsys.readouterr().out
    assert export("npz,usd", "--resume") == 0
    assert "frames 1001 to 1007" in capsys.readouterr().out
    assert Clip.load(drive / "car.npz")
    assert export("csv,npz", "--resume") == 0
    assert "frames 1001 to 1007" in capsys.readouterr().out


def test_files_of_an_older_motion_are_set_apart(
    export: Callable[..., int], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    drive = tmp_path / "out" / "drive"
    export("usd,npz")
    old = files(drive)
    stage = (drive / "drive.usda").read_bytes()
    assert export("csv", "--set", "vehicle.car.motion.duration=0.5") == 0
    output = capsys.readouterr().err
    assert "npz, usd show an older version of the shot: moved to" in output and output.count("older version") == 1
    assert files(drive) == {"car.csv", "report.json"} | {f"earlier/1/{name}" for name in old}
    assert (drive / "earlier" / "1" / "drive.usda").read_bytes() == stage
    assert cli.run(["validate", str(drive / "earlier" / "1" / "drive.usda")]) == 0  # it was moved as a whole
    assert export("usd,npz", "--set", "vehicle.car.motion.duration=0.5") == 0
    assert "as it was" not in capsys.readouterr().err
    assert files(drive) == {"car.csv"} | old | {f"earlier/1/{name}" for name in old}
    table = np.genfromtxt(drive / "car.csv", delimiter=",", names=True)
    assert np.allclose(Clip.load(drive / "car.npz").resample().positions[:, 0], table["worldpositionx_m"], atol=1e-6)


def test_versions_keep_every_export_separate(export: Callable[..., int], tmp_path: Path) -> None:
    drive = tmp_path / "out" / "drive"
    export("npz", "--set", "export.versions=true")
    export("csv", "--set", "export.versions=true")
    assert files(drive / "v001") == {"car.npz", "report.json"}
    assert files(drive / "v002") == {"car.csv", "report.json"}


def test_latest_is_the_newest_version_with_a_stage(
    export: Callable[..., int], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """A version with tables only has no stage: `latest` then shows the same motion, or a warning says otherwise."""
    drive, versions = tmp_path / "out" / "drive", ["--set", "export.versions=true"]
    export("usd", *versions)
    export("csv", *versions)
    assert "./v001/drive.usda" in (drive / "latest.usda").read_text()
    assert "latest" not in capsys.readouterr().err
    export("csv", *versions, "--set", "vehicle.car.motion.duration=0.5")
    assert (
        "latest still shows v001: v003 has another motion, which was not exported to usd; export usd again"
        in capsys.readouterr().err
    )
    export("usd", *versions, "--set", "vehicle.car.motion.duration=0.5")
    assert "./v004/drive.usda" in (drive / "latest.usda").read_text()
    (drive / "latest.usda").write_text("#usda 1.0")  # another machine was slower
    export("csv", *versions, "--set", "vehicle.car.motion.duration=0.5")
    assert "./v004/drive.usda" in (drive / "latest.usda").read_text()
    assert "latest" not in capsys.readouterr().err


PAIR = """
[shot]
schema = 1
name = "drive"
[world]
terrain = "flat"
[[vehicle]]
name = "one"
asset = "car"
motion = { method = "simulate", duration = 0.5, start = { velocity = [4, 0, 0] } }
[[vehicle]]
name = "two"
asset = "truck"
motion = { method = "simulate", duration = 1, start = { position = [0, 9, 0], velocity = [2, 0, 0] } }
"""


def place(stage: Any, vehicle: str, frame: float) -> Any:
    prim = stage.GetPrimAtPath(f"/drive/vehicles/{vehicle}")
    return UsdGeom.XformCache(frame).GetLocalToWorldTransform(prim).ExtractTranslation()


def test_exporting_one_vehicle_again_keeps_the_others(
    tmp_path: Path, content: Content, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "drive.toml").write_text(PAIR)
    drive, export = tmp_path / "drive", ["export", str(tmp_path / "drive.toml"), "--out", str(tmp_path), "--to"]
    assert cli.run([*export, "usd,npz,csv"]) == 0
    before = content(drive)
    faster = ["--set", "vehicle.one.motion.start.velocity=[6,0,0]"]
    assert cli.run([*export, "usd,npz", "--only", "one", *faster]) == 0
    output = capsys.readouterr().err
    after = content(drive)
    assert "csv show an older version of the shot" in output and "npz" not in output  # the old table of the first
    changed = {name for name in before if after.get(name) != before[name]}
    assert changed == {"report.json", "layers/one.anim.usdc", "layers/cameras.usdc",
                       "layers/guides.usdc", "one.npz", "one.csv"}  # fmt: skip
    assert after["drive.usda"] == before["drive.usda"]  # which shows both
    assert after["earlier/1/one.csv"] == before["one.csv"]

    stage = Usd.Stage.Open(str(drive / "drive.usda"))
    gone = {name: place(stage, name, 1025)[0] - place(stage, name, 1001)[0] for name in ("one", "two")}
    assert gone == pytest.approx({"one": 3.0, "two": 2.0}, abs=0.1)  # the first stops after half a second
    del stage
    assert cli.run(["validate", str(drive / "drive.usda"), "--quiet"]) == 0
    assert cli.run(["audit", str(drive)]) == 0
    measured = capsys.readouterr().out
    assert "one: shot.end_frame" in measured and "two: shot.end_frame" in measured
    report = json.loads((drive / "report.json").read_text())
    assert report["files"].keys() == {name for name in files(drive) if not name.startswith(("report", "earlier"))}
    assert all(after[name] == digest for name, digest in report["files"].items())

    slow = ["--set", "world.wind=[0,3,0]"]  # another world: the deliveries no longer belong together
    assert cli.run([*export, "usd", "--only", "one", *slow]) == 0
    assert not Usd.Stage.Open(str(drive / "drive.usda")).GetPrimAtPath("/drive/vehicles/two")
    assert (drive / "earlier" / "2" / "two.npz").is_file()


PLANNED = """
[shot]
schema = 1
name = "drive"
[[vehicle]]
name = "car"
asset = "car"
[vehicle.motion]
method = "plan"
segments = 8
[[vehicle.motion.mark]]
frame = 1001
position = [0, 0, 0]
velocity = [0, 0, 0]
[[vehicle.motion.mark]]
frame = 1049
position = [6, 0, 0]
velocity = [0, 0, 0]
"""


def test_a_delivery_is_audited_after_any_later_export(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "drive.toml").write_text(PLANNED)
    export = ["export", str(tmp_path / "drive.toml"), "--out", str(tmp_path), "--to"]
    assert cli.run([*export, "usd"]) == 0
    first = json.loads((tmp_path / "drive" / "report.json").read_text())
    assert cli.run(["audit", str(tmp_path / "drive")]) == 0
    rows = capsys.readouterr().out.partition("ok ")[2]
    assert cli.run([*export, "csv"]) == 0
    capsys.readouterr()
    assert cli.run(["audit", str(tmp_path / "drive")]) == 0
    assert capsys.readouterr().out.partition("ok ")[2] == rows
    last = json.loads((tmp_path / "drive" / "report.json").read_text())
    assert (last["audit"], last["vehicles"]) == (first["audit"], first["vehicles"])
