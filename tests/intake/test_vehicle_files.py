"""Invalid values in a vehicle.toml are refused with file, line, key and remedy, all at once."""

from __future__ import annotations

import os
import random
import re
import shutil
from pathlib import Path

import pytest

from tests.shots import driven
from vehsim import Shot
from vehsim.assets import shipped
from vehsim.cli import commands as cli
from vehsim.errors import InputError, ShotError
from vehsim.rig.parts import read_parts
from vehsim.vehicles import load_vehicle

pytestmark = pytest.mark.broken_stages

CAR = shipped("vehicle")["car"].parent


def vehicle(folder: Path, change: tuple[str, str] = ("", ""), of: Path = CAR) -> Path:
    """A copy of a shipped vehicle with some text of its vehicle.toml replaced."""
    folder = folder / "it"
    shutil.copytree(of, folder)
    text = (folder / "vehicle.toml").read_text()
    assert change[0] in text
    (folder / "vehicle.toml").write_text(text.replace(*change, 1))
    return folder


BROKEN = {
    "empty": b"",
    "begun": b"#usda 1.0\n(",
    "zeros": b"PXR-USDC" + bytes(80),
    "ones": b"\xff" * 100,
    "bare": b"#usda 1.0\n",
}
WRONG = [
    (("origin = [-1.3, 0.0, 0.0]", "origin = [nan, 0.0, 0.0]"), r"vehicle.toml:\d+: origin\[0\] = nan: not a finite"),
    (("origin = [-1.3, 0.0, 0.0]", 'origin = "rear"'), r"origin = 'rear': not an array; give three numbers, m"),
    (("origin = [-1.3, 0.0, 0.0]", "origin = [1, 2]"), r"origin = \[1, 2\]: 2 given, at least 3 wanted"),
    (("scale = 1000.0", "scale = 0"), r"controls.torque.scale = 0: it should be greater than 0"),
    (("scale = 1000.0", "scale = nan"), r"controls.torque.scale = nan: not a finite number"),
    (("lower = -4000.0", 'lower = "low"'), r"vehicle.toml:\d+: controls.torque.lower = 'low': not a number; give its"),
    (("lower = -4000.0", "lower = nan"), r"controls.torque.lower = nan: not a number"),
    (("lower = -4000.0", "lower = 9000"), r"controls.torque.lower = 9000: above upper; swap them"),
    (("lower = -0.7", "lower = 0.8"), r"joints.sigma.lower = 0.8: not below upper; swap them"),
    (("mass = 1350.0", "mass = 1e308"), r"physics.mass = 1e\+308: beyond 1e\+12; give SI units"),
    (("mass = 1350.0", "mass = nan"), r"physics.mass = nan: not a finite number; give SI units"),
    (
        ("mass = 1350.0", "mass = -3"),
        r"physics.mass = -3: it should be greater than 0; give a number above zero, in kg",
    ),
    (
        ("wheel_radius = 0.32", "wheel_radius = 0"),
        r"physics.wheel_radius = 0: it should be greater than 0; give a number above zero, in m",
    ),
    (("mass = 1350.0", "mass = { a = 1 }"), r"physics.mass = {'a': 1}: not a number; give"),
    (("mass = 1350.0", f"mass = {'9' * 400}"), r"physics.mass: a whole number of more than 64 bits"),
    (('op = "rotateY"', 'op = "rotateY"\npivot = [nan, 0, 0]'), r"channels.roll_rl.pivot = .*: neither a place nor"),
    (('op = "rotateY"', "op = 3"), r"channels.roll_rl.op = 3: unknown; give \"rotateX\""),
    (('op = "rotateY"', 'op = "rotateY"\nfactor = inf'), r"channels.roll_rl.factor = inf: not a finite number"),
    (("frequency = 1.5", "frequency = 0"), r"suspension.frequency = 0: it should be greater than 0"),
    (("[suspension]", "suspension = 3\n[suspensions]"), r"suspension|suspensions"),
    (("schema = 1", "schema = 2"), r"schema = 2: it should be at most 1"),
    (("schema = 1", "schema = 1\nvariants = 3"), r"variants = 3: not a table"),
    (("schema = 1", "schema = 1\nforward = []"), r"forward = \[\]: it should be"),
    (("schema = 1", "schema = 1\nroot = 3"), r"root = 3: not a text"),
    (("top_speed = 55.0", "top_speed = 0"), r"top_speed = 0: it should be greater than 0; give a speed"),
    (("schema = 1", "schema = 1\noffset = [1, 2, inf]"), r"offset\[2\] = inf: not a finite number"),
    (('model = "car"', "model = 7"), r"model = 7: not a text"),
    (('model = "car"', 'model = "cars"'), r"model = 'cars': unknown; choose one of"),
    (('asset = "car.usdc"', 'asset = "car.usdc"\nmodle = "car"'), r"modle = 'car': unknown key; did you mean 'model'"),
]


def test_a_file_that_was_read_is_read_again_when_it_changes(tmp_path: Path) -> None:
    """And what one reader changes in its data, another does not see."""
    from vehsim.vehicles.library.file import read_vehicle

    path = vehicle(tmp_path) / "vehicle.toml"
    read_vehicle(path)["origin"][0] = 5.0
    assert read_vehicle(path)["origin"] == [-1.3, 0.0, 0.0]
    path.write_text(path.read_text().replace("origin = [-1.3, 0.0, 0.0]", "origin = [-1.2, 0.0, 0.0]"))
    assert read_vehicle(path)["origin"] == [-1.2, 0.0, 0.0]


@pytest.mark.parametrize(("change", "says"), WRONG, ids=[str(k) for k in range(len(WRONG))])
def test_invalid_values_are_refused(change: tuple[str, str], says: str, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=says) as refused:
        load_vehicle(vehicle(tmp_path, change))
    assert "vehicle.toml" in str(refused.value) and "; " in str(refused.value)


def test_all_problems_are_reported_at_once(tmp_path: Path) -> None:
    folder = vehicle(tmp_path, ("mass = 1350.0", "mass = nan"))
    text = (folder / "vehicle.toml").read_text().replace("scale = 0.3", "scale = 0")
    (folder / "vehicle.toml").write_text(text)
    with pytest.raises(ShotError) as refused:
        load_vehicle(folder)
    assert [problem.key for problem in refused.value.problems] == ["physics.mass", "controls.steering_rate.scale"]


def test_check_refuses_it_and_other_shots_continue(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    vehicle(tmp_path, ("mass = 1350.0", "mass = 1e308"))
    for name, asset in (("bad", "it"), ("good", "car")):
        (tmp_path / f"{name}.toml").write_text(driven(name, asset))
    assert cli.run(["check", str(tmp_path / "bad.toml")]) == 2
    assert "physics.mass = 1e+308" in capsys.readouterr().err
    shots = [str(tmp_path / f"{name}.toml") for name in ("bad", "good")]
    assert cli.run(["export", *shots, "--to", "npz", "--out", str(tmp_path / "out")]) == 1
    assert (tmp_path / "out" / "good" / "car.npz").is_file()


@pytest.mark.parametrize("name", ["car", "helicopter", "boat", "hopper"])
def test_odd_vehicle_files_load_or_are_refused(name: str, tmp_path: Path) -> None:
    """Each key in turn gets an unusual value; seeded."""
    chance = random.Random(name)
    odd = [
        "nan",
        "-inf",
        "0",
        "-1",
        "1e308",
        "true",
        '"text"',
        "[]",
        "[[1]]",
        "{}",
        "{ a = 1 }",
        "1979-05-27",
        "9" * 400,
    ]
    folder = vehicle(tmp_path, of=shipped("vehicle")[name].parent)
    lines = (folder / "vehicle.toml").read_text().splitlines()
    keys = [k for k, line in enumerate(lines) if re.match(r"\w+ = ", line)]
    refused = 0
    for k in keys:
        key, value = lines[k].partition(" = ")[0], chance.choice(odd)
        changed = [*lines[:k], f"{key} = {value}", *lines[k + 1 :]]
        (folder / "vehicle.toml").write_text("\n".join(changed))
        try:
            load_vehicle(folder)
        except InputError as error:
            assert "vehicle.toml" in str(error) and "; " in str(error), (key, value, error)
            refused += 1
    assert refused > len(keys) / 2


@pytest.mark.parametrize("content", BROKEN.values(), ids=BROKEN)
@pytest.mark.parametrize("extra", ["", 'forward = "-X"\n'])
def test_a_corrupt_asset_is_refused_and_other_shots_continue(
    content: bytes, extra: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = vehicle(tmp_path, ("schema = 1\n", f"schema = 1\n{extra}"))
    (folder / "car.usdc").write_bytes(content)
    for name, asset in (("bad", "it"), ("good", "car")):
        (tmp_path / f"{name}.toml").write_text(driven(name, asset))
    shots = [str(tmp_path / f"{name}.toml") for name in ("bad", "good")]
    assert cli.run(["check", shots[0]]) == 2
    output = capsys.readouterr().err
    assert "it/" in output and "unexpected" not in output
    assert cli.run(["export", *shots, "--to", "npz", "--out", str(tmp_path / "out")]) == 1
    assert (tmp_path / "out" / "good" / "car.npz").is_file()


def test_an_edit_with_the_same_size_and_date_is_noticed(tmp_path: Path) -> None:
    """Within one process, which remembers what it has read."""
    folder = vehicle(tmp_path)
    file = folder / "vehicle.toml"
    before = load_vehicle(folder)
    date = file.stat()
    file.write_text(file.read_text().replace("upper = 2500.0", "upper = 2600.0"))
    os.utime(file, ns=(date.st_atime_ns, date.st_mtime_ns))
    assert file.stat().st_mtime_ns == date.st_mtime_ns and file.stat().st_size == date.st_size
    assert before.controls[0].upper == 2500.0 and load_vehicle(folder).controls[0].upper == 2600.0


def test_a_delivery_is_remade_after_such_an_edit(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = vehicle(tmp_path)
    (tmp_path / "shot.toml").write_text(driven("shot", "it"))
    command = ["export", str(tmp_path / "shot.toml"), "--to", "npz", "--out", str(tmp_path / "out"), "--resume"]
    assert cli.run(command) == cli.run(command) == 0
    assert "already finished" in capsys.readouterr().out
    date = (folder / "vehicle.toml").stat()
    text = (folder / "vehicle.toml").read_text().replace("mass = 1350.0", "mass = 1360.0")
    (folder / "vehicle.toml").write_text(text)
    os.utime(folder / "vehicle.toml", ns=(date.st_atime_ns, date.st_mtime_ns))
    assert cli.run(command) == 0
    assert "npz of frames" in capsys.readouterr().out


@pytest.mark.parametrize("seed", range(8))
def test_changed_bytes_of_an_asset_are_wrong_input(seed: int, tmp_path: Path) -> None:
    """USD reads values on demand: corruption may appear long after the stage was opened."""
    chance, file = random.Random(seed), vehicle(tmp_path) / "car.usdc"
    content = bytearray(file.read_bytes())
    for _ in range((1, 8, 64)[seed % 3]):
        content[chance.randrange(len(content))] = chance.randrange(256)
    file.write_bytes(content)
    (tmp_path / "shot.toml").write_text(driven("shot", "it"))
    for problem in Shot.load(tmp_path / "shot.toml").check():
        assert problem.key and problem.message and problem.remedy


def test_a_corrupt_value_is_wrong_input(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from pxr import Tf

    def corrupt(*given: object) -> None:
        raise Tf.ErrorException("Attempted to unpack unsupported type")

    monkeypatch.setattr("vehsim.rig.parts.mesh_of", corrupt)
    folder = vehicle(tmp_path)
    with pytest.raises(InputError, match=r"car.usdc: asset: not readable as USD \(.*\); export it again"):
        read_parts(folder / "car.usdc")
    (tmp_path / "shot.toml").write_text(driven("shot", "it"))
    assert any("not readable as USD" in str(problem) for problem in Shot.load(tmp_path / "shot.toml").check())


def test_of_very_many_problems_the_first_are_listed(tmp_path: Path) -> None:
    """Each explanation takes milliseconds, so a file of nothing but unknown keys would take minutes."""
    folder = tmp_path / "it"
    folder.mkdir()
    (folder / "vehicle.toml").write_text('model = "car"\n' + "".join(f"unknown_key_{k} = 1\n" for k in range(5000)))
    with pytest.raises(InputError) as raised:
        load_vehicle(folder)
    assert len(raised.value.problems) == 101
    assert raised.value.problems[0].message == "5000 problems, of which 100 are listed"
