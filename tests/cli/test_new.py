"""`vehsim new`: a first shot of any vehicle, which exports unchanged and hits its marks."""

from __future__ import annotations

import tomllib
import warnings
from pathlib import Path

import numpy as np
import pytest

from vehsim import Shot
from vehsim.cli import commands as cli
from vehsim.cli.new import METHODS
from vehsim.shot.schema.shot_file import SCHEMA_FILE, SCHEMA_LINE
from vehsim.vehicles import available

ELSEWHERE = Path(__file__).parents[1] / "assets_elsewhere"
OWN = sorted(path.parent for path in ELSEWHERE.glob("*/vehicle.toml"))


def new(folder: Path, *words: str, code: int = 0) -> Path:
    assert cli.run(["new", str(folder / "first"), *words]) == code
    return folder / "first.toml"


def solved(path: Path) -> Shot:
    """The take of a file that passes its check without warnings, with every mark of it measured."""
    shot = Shot.load(path)
    assert [str(problem) for problem in shot.check()] == []
    with warnings.catch_warnings():
        warnings.filterwarnings("error", "first")  # nothing is wrong with the motion
        take = shot.solve()
    motion = shot.file.vehicle[0].motion
    (clip,) = take.clips.values()
    marks = getattr(motion, "mark", None) or ()
    for mark in marks:
        when = clip.frames[-1] if mark.frame == "free" else mark.frame
        at = clip.at([(when - clip.start_frame) / float(clip.fps)])
        np.testing.assert_allclose(at.positions[0][:2], mark.position[:2], atol=1e-3)
        w, x, y, z = at.orientations[0]
        yaw = np.degrees(np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z)))
        assert abs((yaw - mark.heading + 180) % 360 - 180) < 0.05
        if getattr(mark, "velocity", None):
            assert np.linalg.norm(at.twists[0]) < 1e-3
    spread = np.ptp(clip.positions[:, :2], axis=0).max()
    length = np.ptp(np.linalg.norm(clip.orientations - clip.orientations[0], axis=1))
    assert spread > 1.0 or length > 0.5  # it moves, or turns over
    return take


@pytest.mark.parametrize("vehicle", [*available(), *map(str, OWN)], ids=lambda vehicle: Path(vehicle).name)
def test_every_vehicle_gets_a_shot_that_hits_its_marks(tmp_path: Path, vehicle: str) -> None:
    solved(new(tmp_path, "--vehicle", vehicle))


@pytest.mark.parametrize(
    "vehicle, method",
    [
        *(
            (name, "simulate")
            for name in ("boat", "car", "drift_car", "helicopter", "simple_car", "snakeboard", "two_wheeled")
        ),
        ("car", "sinusoid"),
        ("tumbler", "integrate"),
    ],
)
def test_every_suitable_method_gives_a_valid_shot(tmp_path: Path, vehicle: str, method: str) -> None:
    path = new(tmp_path, "--vehicle", vehicle, "--method", method)
    assert tomllib.loads(path.read_text())["vehicle"][0]["motion"]["method"] == method
    solved(path)


def test_a_car_on_springs_is_driven_and_brakes(tmp_path: Path) -> None:
    (clip,) = solved(new(tmp_path, "--vehicle", "rally_car")).clips.values()
    pitch, roll = (np.degrees(clip.channels[name]) for name in ("pitch", "roll"))
    assert pitch.min() < -0.3 and pitch[-1] > 0.3  # it squats, then dives
    assert 1 < roll.max() < 4


@pytest.mark.parametrize("vehicle", ["car", "helicopter", "boat", "hopper", "truck", "two_wheeled"])
@pytest.mark.parametrize("terrain", ["hills", "canyon"])
def test_a_new_shot_finds_room_on_a_terrain(tmp_path: Path, vehicle: str, terrain: str) -> None:
    path = new(tmp_path, "--vehicle", vehicle, "--terrain", terrain)
    shot = Shot.load(path)
    assert [str(problem) for problem in shot.check()] == []
    table = tomllib.loads(path.read_text())
    assert table["world"]["terrain"] == terrain
    for mark in table["vehicle"][0]["motion"]["mark"]:
        ground = float(shot.world.height([mark["position"][:2]])[0])
        above = table["world"].get("water", {}).get("level", mark["position"][2]) - ground
        assert above > -1e-3 and (vehicle not in ("car", "truck", "two_wheeled") or above < 2e-3)


def test_nothing_is_overwritten(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "first.toml"
    path.write_text("mine")
    assert new(tmp_path, "--vehicle", "car", code=2).read_text() == "mine"
    assert "exists and is not overwritten" in capsys.readouterr().err
    path.unlink()
    path.symlink_to(tmp_path / "elsewhere.toml")
    new(tmp_path, "--vehicle", "car", code=2)
    assert not (tmp_path / "elsewhere.toml").exists()


@pytest.mark.parametrize(
    "words, says",
    [
        (["my-shot", "--vehicle", "car"], "try 'my_shot'"),
        (["3d", "--vehicle", "car"], "try '_3d'"),
        (["a", "--vehicle", "cra"], "did you mean 'car'"),
        (["a", "--vehicle", "car", "--terrain", "hill"], "did you mean 'hills'"),
        (["a", "--vehicle", "car", "--method", "fly"], "choose one of plan"),
        (["a", "--vehicle", "tumbler", "--method", "plan"], "has no controls; choose simulate"),
        (["a", "--vehicle", "hopper", "--method", "plan"], "choose sinusoid"),
        (["a", "--vehicle", "helicopter", "--method", "sinusoid"], "not a system that is steered by sinusoids"),
        (["none/a", "--vehicle", "car"], "no such folder"),
        (["a"], "--vehicle"),
    ],
)
def test_invalid_requests_are_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], words: list[str], says: str
) -> None:
    monkeypatch.chdir(tmp_path)
    assert cli.run(["new", *words]) == 2
    output = capsys.readouterr().err
    assert says in output and "Traceback" not in output
    assert list(tmp_path.iterdir()) == []


def test_own_vehicles_are_named_relative_to_the_shot(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "kart").symlink_to(ELSEWHERE / "kart")
    (tmp_path / "shots").mkdir()
    monkeypatch.chdir(tmp_path)
    assert cli.run(["new", "shots/first", "--vehicle", "kart", "--method", "simulate"]) == 0
    assert Shot.load("shots/first.toml").check() == []


def test_an_editor_finds_the_schema_beside_it(tmp_path: Path) -> None:
    assert SCHEMA_LINE not in new(tmp_path, "--vehicle", "tumbler").read_text()
    (tmp_path / "first.toml").unlink()
    (tmp_path / SCHEMA_FILE).touch()
    assert new(tmp_path, "--vehicle", "tumbler").read_text().startswith(f"{SCHEMA_LINE}\n")


@pytest.mark.parametrize("method", METHODS)
def test_the_shell_completes_its_options(method: str) -> None:
    from vehsim.cli import choices

    ((name, output),) = choices.method(method[:-1])
    assert name == method and output
    assert "snakeboard" in dict(choices.vehicle(""))


def test_the_middle_mark_can_be_uncommented(tmp_path: Path) -> None:
    path = new(tmp_path, "--vehicle", "car")
    lines = path.read_text().splitlines()
    k = next(i for i, line in enumerate(lines) if line.startswith("# [[vehicle.motion.mark]]"))
    lines[k : k + 3] = [line.removeprefix("# ") for line in lines[k : k + 3]]
    path.write_text("\n".join(lines))
    assert len(Shot.load(path).file.vehicle[0].motion.mark) == 3
    assert [str(problem) for problem in Shot.load(path).check()] == []
