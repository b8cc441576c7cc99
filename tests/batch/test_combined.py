"""One shot exported by several commands: what each delivered stays, and no file disagrees with another in silence."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from vehsim import Clip, cli

Write = Callable[..., Path]
Content = Callable[[Path], dict[str, str]]


@pytest.fixture
def export(write: Write, tmp_path: Path) -> Callable[..., int]:
    """Run ``vehsim export`` on the one shot: exporters, then options."""
    shot = write()
    return lambda to, *options: cli.run(["export", str(shot), "--out", str(tmp_path / "out"), "--to", to, *options])


def files(folder: Path) -> set[str]:
    return {path.relative_to(folder).as_posix() for path in folder.rglob("*") if path.is_file()}


def test_a_table_added_later_leaves_stage_and_pictures(
    export: Callable[..., int], tmp_path: Path, content: Content, capsys: pytest.CaptureFixture[str]
) -> None:
    drive = tmp_path / "out" / "drive"
    small = ["--set", "render.size=[64,36]", "--set", "render.every=3"]
    assert export("usd,png", *small) == 0
    before = content(drive)
    assert export("csv") == 0  # the look of pictures is no matter of the motion
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
        assert "finished before" in capsys.readouterr().out
    (drive / "car.npz").write_bytes(b"")
    assert export("csv", "--resume") == 0
    assert "finished before" in capsys.readouterr().out
    assert export("npz,usd", "--resume") == 0
    assert "frames 1001 to 1007" in capsys.readouterr().out
    assert Clip.load(drive / "car.npz")
    assert export("csv,npz", "--resume") == 0
    assert "frames 1001 to 1007" in capsys.readouterr().out


def test_another_motion_sets_the_old_one_apart(
    export: Callable[..., int], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    drive = tmp_path / "out" / "drive"
    export("usd,npz")
    old = files(drive)
    stage = (drive / "drive.usda").read_bytes()
    assert export("csv", "--set", "vehicle.car.motion.duration=0.5") == 0
    said = capsys.readouterr().err
    assert "npz, usd show the shot as it was: moved to" in said and said.count("as it was") == 1
    assert files(drive) == {"car.csv", "report.json"} | {f"earlier/1/{name}" for name in old}
    assert (drive / "earlier" / "1" / "drive.usda").read_bytes() == stage
    assert cli.run(["validate", str(drive / "earlier" / "1" / "drive.usda")]) == 0  # it travelled as a whole
    assert export("usd,npz", "--set", "vehicle.car.motion.duration=0.5") == 0
    assert "as it was" not in capsys.readouterr().err
    assert files(drive) == {"car.csv"} | old | {f"earlier/1/{name}" for name in old}
    table = np.genfromtxt(drive / "car.csv", delimiter=",", names=True)
    assert np.allclose(Clip.load(drive / "car.npz").resample().positions[:, 0], table["worldpositionx_m"], atol=1e-6)


def test_versions_keep_every_export_by_itself(export: Callable[..., int], tmp_path: Path) -> None:
    drive = tmp_path / "out" / "drive"
    export("npz", "--set", "export.versions=true")
    export("csv", "--set", "export.versions=true")
    assert files(drive / "v001") == {"car.npz", "report.json"}
    assert files(drive / "v002") == {"car.csv", "report.json"}


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


def test_a_delivery_is_audited_whatever_was_added_last(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
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
