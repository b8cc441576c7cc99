"""What the command line tells a new user: help, completion, the schema and the height of the ground."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tomllib
from pathlib import Path

import numpy as np
import pytest

from vehsim.assets import shipped
from vehsim.batch.sweep import load_shots
from vehsim.cli import arguments as _arguments
from vehsim.cli import choices
from vehsim.cli import commands as cli
from vehsim.delivery.exporters import exporter_names
from vehsim.planning.terms import COSTS, LIMITS
from vehsim.shot.schema.shot_file import SCHEMA_LINE, schema
from vehsim.world.terrain.terrain import Terrain

EXAMPLES = Path(__file__).parents[2] / "examples"
PATIENCE = 600.0
"""Time limit on a busy machine, s: only a failing test waits that long."""


# ---------------------------------------------------------------- help


def test_help_of_export_lists_all_exporters_costs_and_limits(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", "160")
    assert cli.run(["export", "--help"]) == 0
    output = capsys.readouterr().out
    for name, makes, needs in choices.exporters():
        assert makes and name in exporter_names()
        assert f"{name} " in output and makes in output and needs in output
    for name, meaning in choices.costs():
        assert name in COSTS and meaning and meaning in output
    for name, unit, meaning in choices.limits():
        assert name in LIMITS and meaning and "rad" not in unit and f" {unit} " in output and meaning in output
    assert {name for name, _, _ in choices.exporters()} == set(exporter_names())
    assert {name for name, _ in choices.costs()} == set(COSTS)


# ---------------------------------------------------------------- completion


def complete(*words: str, folder: Path | None = None) -> list[str]:
    """The completions that a shell would offer for the last of these words."""
    typed = " ".join(("vehsim", *words)).rstrip() + (" " if not words[-1] else "")
    environment = os.environ | {
        "_VEHSIM_COMPLETE": "complete_bash",
        "COMP_WORDS": typed,
        "COMP_CWORD": str(len(words)),
    }
    command = [sys.executable, "-c", "import sys; sys.argv = ['vehsim']; from vehsim.__main__ import main; main()"]
    answer = subprocess.run(command, env=environment, cwd=folder, capture_output=True, text=True, timeout=PATIENCE)
    assert answer.stderr == ""
    return answer.stdout.split()


def test_exporters_are_completed_in_a_list() -> None:
    assert complete("export", "--to", "fi") == ["figures"]
    assert complete("export", "--to", "usd,m") == ["usd,mp4"]
    assert "usd,usd" not in complete("job", "--to", "usd,")


def test_terrains_vehicles_and_costs_are_completed() -> None:
    assert complete("height", "--terrain", "") == list(shipped("terrain"))
    assert complete("check", "--set", "world.terrain=ca") == ["world.terrain=canyon"]
    assert complete("check", "--set", "vehicle[0].motion.cost=ti") == ["vehicle[0].motion.cost=time"]
    assert complete("export", "--set", "shot.fps=") == []


def test_shot_files_and_their_vehicles_are_completed(tmp_path: Path) -> None:
    (tmp_path / "flight.toml").write_text('[shot]\nname = "x"\n[[vehicle]]\nname = "heli"\nasset = "helicopter"\n')
    (tmp_path / "pyproject.toml").write_text("[project]\n")
    (tmp_path / "broken.toml").write_text("[shot]\nname =")
    assert complete("check", "", folder=tmp_path) == ["broken.toml", "flight.toml"]
    assert complete("check", f"{tmp_path}/fl") == [f"{tmp_path}/flight.toml"]
    assert complete("export", "flight.toml", "broken.toml", "--only", "", folder=tmp_path) == ["heli"]
    assert complete("check", "none/", folder=tmp_path) == []


def test_cameras_of_a_stage_are_completed(tmp_path: Path) -> None:
    (tmp_path / "shot.usda").write_text(
        '#usda 1.0\n(\n defaultPrim = "s"\n metersPerUnit = 1\n upAxis = "Z"\n)\n'
        'def Xform "s" {\n def Camera "wide" {\n}\n def Camera "close" {\n}\n def Xform "other" {\n}\n}\n'
    )
    assert complete("render", "shot.usda", "--camera", "", folder=tmp_path) == ["wide", "close"]
    (tmp_path / "shot.usda").write_text("nothing")
    assert complete("render", "shot.usda", "--camera", "", folder=tmp_path) == []
    (tmp_path / "shot.usda").unlink()  # not one of our stages


# ---------------------------------------------------------------- the schema


def test_the_schema_names_its_dialect_and_the_line_to_paste(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.run(["schema"]) == 0
    output = capsys.readouterr()
    assert list(json.loads(output.out))[:3] == ["$schema", "$id", "title"]
    assert SCHEMA_LINE in output.err


def fits(value: object, shape: dict, root: dict) -> bool:
    """Whether a value fits a JSON schema; it supports the part of draft 7 that ours uses."""
    if "$ref" in shape:
        return fits(value, root["$defs"][shape["$ref"].rpartition("/")[2]], root)
    for word, some in (("anyOf", any), ("oneOf", lambda each: sum(each) == 1)):
        if word in shape and not some([fits(value, one, root) for one in shape[word]]):
            return False
    if "enum" in shape and value not in shape["enum"]:
        return False
    if "const" in shape and value != shape["const"]:
        return False
    kinds = {"object": dict, "array": list, "string": str, "number": int | float, "integer": int, "boolean": bool}
    if "type" in shape and not (shape["type"] != "null" and isinstance(value, kinds[shape["type"]])):
        return False
    if isinstance(value, list):
        return all(fits(item, shape.get("items", {}), root) for item in value)
    if not isinstance(value, dict):
        return True
    if not set(shape.get("required", ())) <= set(value):
        return False
    known, others = shape.get("properties", {}), shape.get("additionalProperties", True)
    if others is False and not set(value) <= set(known):
        return False
    rest = others if isinstance(others, dict) else {}
    return all(fits(each, known.get(key, rest), root) for key, each in value.items())


@pytest.mark.parametrize("path", sorted(EXAMPLES.glob("*.toml")), ids=lambda path: path.stem)
def test_examples_fit_the_schema(path: Path) -> None:
    assert fits(tomllib.loads(path.read_text()), schema(), schema())


@pytest.mark.parametrize(
    "keys, value, right",
    [
        (("vehicle", 0, "motion", "cost"), "efort", False),
        (("vehicle", 0, "motion", "cost"), {"efort": 1}, False),
        (("vehicle", 0, "motion", "cost"), {"time": 1}, True),
        (("vehicle", 0, "motion", "limits"), {"sped": 3}, False),
        (("vehicle", 0, "motion", "limits"), {"speed": 3, "joints": {"sigma": 0.3}}, True),
        (("vehicle", 0, "motion", "solver"), "ipotp", False),
        (("vehicle", 0, "asset"), "../my/car", True),
        (("world", "terrain"), "scans/quarry.obj", True),
        (("world", "terrain"), 3, False),
        (("camera", "rig"), "chaise", False),
        (("camera",), [{"name": "a"}, {"name": "b", "rig": "orbit"}], True),
        (("shot", "fsp"), 24, False),
    ],
)
def test_the_schema_distinguishes_valid_from_invalid_shots(
    keys: tuple[str | int, ...], value: object, right: bool
) -> None:
    data: dict = tomllib.loads((EXAMPLES / "car_obstacles.toml").read_text())
    table = data
    for key in keys[:-1]:
        table = table[key]
    table[keys[-1]] = value
    assert fits(data, schema(), schema()) is right


# ---------------------------------------------------------------- long films


@pytest.mark.parametrize(
    "change, to, draft, says",
    [
        ([], "usd,mp4", False, "--to strobe,figures, or --quality draft"),
        ([], "png", False, "about 649 pictures"),
        ([], "usd,csv,strobe,figures", False, None),
        ([], "mp4", True, None),  # a quarter of the pixels
        (["render.every=8"], "mp4", False, None),
        (["render.size=[96,54]"], "mp4", False, None),
        (["render.size=[3840,2160]"], "mp4", True, "--to strobe,figures"),
        (["shot.end_frame=1020"], "mp4", False, None),
        (["vehicle.heli.motion.mark[1].frame='free'", "render.size=[1920,1080]"], "mp4", False, "pictures"),
    ],
)
def test_a_long_render_is_announced(change: list[str], to: str, draft: bool, says: str | None) -> None:
    shot = next(iter(load_shots(EXAMPLES / "canyon_flight.toml", change)))
    hint = _arguments.film_hint([shot], to.split(","), draft)
    assert hint is None if says is None else says in str(hint)


def test_the_hint_is_one_line_printed_before_the_work(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("vehsim.batch.run.run", lambda tasks, **options: (None for _ in ()))
    words = ["export", str(EXAMPLES / "canyon_flight.toml"), "--out", str(tmp_path), "--to", "mp4"]
    assert cli.run(words) == 0
    assert capsys.readouterr().err.count("--to strobe,figures") == 1
    assert cli.run([*words, "--quiet"]) == 0
    assert capsys.readouterr().err == ""


# ---------------------------------------------------------------- height


def test_height_and_slope_of_a_plane(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    x, y = np.meshgrid(np.arange(-10.0, 11.0), np.arange(-10.0, 11.0))
    np.save(tmp_path / "plane.npy", 3 + 0.3 * x - 0.3 * y)
    (tmp_path / "plane.toml").write_text("cell = [1, 1]\norigin = [-10, -10]\n")
    assert cli.run(["height", "0", "0", "-10", "10", "--terrain", str(tmp_path / "plane.npy"), "--water", "4"]) == 0
    first, second = capsys.readouterr().out.splitlines()
    slope = np.degrees(np.arctan(0.3 * np.sqrt(2)))
    assert first == f"0 0: 3.000 m, slope {slope:.1f} deg, rising towards heading -45 deg, 1.00 m of water"
    assert second.startswith("-10 10: -3.000 m") and second.endswith("7.00 m of water")


def test_heights_are_the_terrain_s_own(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.run(["height", "12.5,-33", "-7,20.25", "--terrain", "hills"]) == 0
    output = [float(line.partition(": ")[2].partition(" ")[0]) for line in capsys.readouterr().out.splitlines()]
    assert output == pytest.approx(Terrain.load("hills").height([(12.5, -33), (-7, 20.25)]), abs=5e-4)


@pytest.mark.parametrize(
    "words, says",
    [
        (["0", "500", "--terrain", "canyon"], "it covers x -110 to 291.8"),
        (["1", "--terrain", "flat"], "give x and y"),
        (["a", "b", "--terrain", "flat"], "give numbers"),
        (["0", "nan", "--terrain", "flat"], "not finite"),
        (["0", "0", "--terrain", "hill"], "did you mean 'hills'"),
    ],
)
def test_height_refuses_invalid_points(words: list[str], says: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.run(["height", *words]) == 2
    assert says in capsys.readouterr().err
