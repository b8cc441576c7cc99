"""The extension for Blender, installed and used in Blender without windows: marks to curves, an edit back to motion."""

from __future__ import annotations

import importlib.util
import json
import os
import subprocess
import sys
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import vehsim

ROOT = Path(__file__).parents[2]
KART = ROOT / "tests" / "assets_elsewhere" / "kart" / "kart.obj"
MADE = ROOT / ".blender" / "bin" / "python"
BLENDER = os.environ.get("VEHSIM_BLENDER", str(MADE) if MADE.exists() else "")
needs_blender = pytest.mark.skipif(
    not Path(BLENDER).name.startswith("python"),
    reason="needs Blender's module bpy: run make blender, or set VEHSIM_BLENDER to a Python that has it",
)


@pytest.fixture(scope="module")
def archive(tmp_path_factory: pytest.TempPathFactory) -> Path:
    spec = importlib.util.spec_from_file_location("build_extension", ROOT / "tools" / "build_extension.py")
    assert spec and spec.loader
    tool = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(tool)
    return Path(tool.build(tmp_path_factory.mktemp("extension")))


@pytest.fixture(scope="module")
def found(archive: Path, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    """What `in_blender.py` found."""
    folder = tmp_path_factory.mktemp("scene")
    environment = os.environ | {"VEHSIM_CACHE_GB": "1", "VEHSIM_CACHE": str(folder / "cache")}
    environment.pop("VEHSIM_BLENDER", None)
    command = [BLENDER, Path(__file__).with_name("in_blender.py"), archive, sys.executable, folder, KART]
    answer = subprocess.run(list(map(str, command)), capture_output=True, text=True, env=environment)
    lines = [line for line in answer.stdout.splitlines() if line.startswith("SAYS")]
    assert lines, answer.stdout[-3000:] + answer.stderr[-3000:]
    return json.loads(lines[0][4:]) | {"folder": folder}


def test_the_archive_has_one_version_and_the_same_bytes(archive: Path) -> None:
    assert archive.name == f"vehsim-{vehsim.__version__}.zip"
    with zipfile.ZipFile(archive) as opened:
        manifest = opened.read("blender_manifest.toml").decode()
        assert {"__init__.py", "blender.py", "LICENSE"} <= set(opened.namelist())
        assert all(info.date_time[0] == 1980 for info in opened.infolist())
    assert f'version = "{vehsim.__version__}"' in manifest and 'blender_version_min = "5.0.0"' in manifest


def errors(job: dict[str, Any]) -> list[dict[str, str]]:
    return [problem for problem in job["problems"] if problem["severity"] == "error"]


@needs_blender
def test_it_names_what_is_missing_then_connects(found: dict[str, Any]) -> None:
    assert "preferences" in found["unconnected"]
    assert found["version"] == f"vehsim {vehsim.__version__}"
    assert "helicopter" in found["known"]["vehicles"] and "canyon" in found["known"]["terrains"]


@needs_blender
def test_errors_of_a_check_are_in_the_panel(found: dict[str, Any]) -> None:
    (problem,) = errors(found["check"])
    assert problem["key"] == "vehicle[0].motion.mark[1].frame" and problem["severity"] == "error"
    shown = " ".join(found["panel of errors"])
    assert all(problem[name] in shown for name in ("key", "message", "remedy"))


@needs_blender
def test_what_cannot_be_solved_names_its_vehicle(found: dict[str, Any]) -> None:
    (problem,) = errors(found["too early"])
    assert problem["message"].startswith("car: no plan was found: mark[1].frame = 36 is too early")


@needs_blender
def test_a_cancelled_solve_leaves_the_scene_as_it_was(found: dict[str, Any]) -> None:
    assert found["cancelled"]["problems"] == [] and found["objects after cancel"] == 4, "marks"


@needs_blender
def test_marks_become_native_curves(found: dict[str, Any]) -> None:
    assert errors(found["solve"]) == [] and found["range"] == [1, 61]
    assert any(0 < share < 1 for _, share in found["solve"]["said"])
    poses = np.array(found["solved"])
    assert poses[0, :3, 3] == pytest.approx([0, 0, 0], abs=2e-3)
    assert poses[-1, :2, 3] == pytest.approx([12, 1], abs=2e-3)
    speeds = 24 * np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1)
    assert speeds[[0, -1]] == pytest.approx(5, abs=0.15)
    assert max(found["keys"].values()) < 30, "few keys"


@needs_blender
def test_an_edited_curve_comes_back_as_motion_on_the_same_objects(found: dict[str, Any]) -> None:
    solved, edited, made = (np.array(found[name])[:, :3, 3] for name in ("solved", "edited", "retouched"))
    assert np.abs(edited - solved).max() > 0.09, "the test edits"
    assert np.linalg.norm(made - edited, axis=1).max() < 0.03
    untouched = np.linalg.norm(edited - solved, axis=1) < 1e-4
    assert np.linalg.norm(made - solved, axis=1)[untouched].max() < 0.012
    assert found["same object"] and not any("." in name for name in found["names"])
    assert max(found["keys after"].values()) < 40


@needs_blender
def test_a_scene_that_blender_exports_is_an_edit(
    found: dict[str, Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Blender puts another root above all prims, and an Xform above every mesh."""
    from vehsim.cli import commands as cli
    from vehsim.exporters.usd.readback import world_matrices

    monkeypatch.setenv("VEHSIM_CACHE", str(found["folder"] / "cache"))
    monkeypatch.setenv("VEHSIM_CACHE_GB", "1")
    folder = found["folder"] / "vehsim"
    arguments = ["--edit", str(found["folder"] / "scene.usdc"), "--shot", str(folder / "solved.toml")]
    with pytest.warns(UserWarning, match="wheel"):
        assert cli.run(["retouch", str(folder / "solved" / "shot"), *arguments, "--out", str(tmp_path)]) == 0
    from pxr import Usd

    stage = Usd.Stage.Open(str(tmp_path / "shot" / "shot.usda"))
    made = world_matrices(stage.GetPrimAtPath("/shot/vehicles/car"), np.arange(1.0, 62.0))
    assert np.abs(made - np.array(found["retouched"])).max() < 3e-3


@needs_blender
def test_a_loaded_asset_with_other_axes_moves_and_comes_back_unchanged(found: dict[str, Any]) -> None:
    """The kart is Y up, in centimetres; its marks are at 5 m/s, and its curves are not edited."""
    poses = np.array(found["kart"])
    assert poses[0, :3, 3] == pytest.approx([0, 9, 0], abs=2e-3)
    assert poses[48, :2, 3] == pytest.approx([10, 10], abs=2e-3)
    assert any(each["message"].startswith("kart: the edit changes nothing") for each in found["retouch"]["problems"])


@needs_blender
def test_an_edit_of_a_wheel_is_reported(found: dict[str, Any]) -> None:
    assert any("wheel" in each["message"] for each in found["retouch"]["problems"])


@needs_blender
def test_a_bake_has_a_key_on_every_frame(found: dict[str, Any]) -> None:
    assert np.abs(np.array(found["baked"]) - np.array(found["retouched"])).max() < 3e-3
    assert max(found["keys baked"].values()) == 61


@needs_blender
def test_the_exported_delivery_has_the_edit(found: dict[str, Any]) -> None:
    from pxr import Usd, UsdGeom

    assert errors(found["export"]) == []
    stage = Usd.Stage.Open(str(found["folder"] / "delivery" / "shot" / "shot.usda"))
    shown = UsdGeom.Xformable(stage.GetPrimAtPath("/shot/vehicles/car"))
    places = [shown.ComputeLocalToWorldTransform(frame).ExtractTranslation() for frame in range(1, 62)]
    assert np.abs(np.array(places) - np.array(found["retouched"])[:, :3, 3]).max() < 2e-3
    assert (found["folder"] / "delivery" / "shot" / "car.csv").is_file()
    assert (found["folder"] / "delivery" / "shot" / "shot.blend").is_file(), "made by the Blender that runs"


@needs_blender
def test_wheels_whose_meshes_share_a_name_are_told_apart(found: dict[str, Any]) -> None:
    """Blender names the objects "tyre", "tyre.001" and so on, and others when they are imported again."""
    first, again = found["twins"]
    assert first == again and sorted(first) == ["/van", "/van/tyre", "/van/tyre#1", "/van/tyre#2"]
    wheels = [first[place].split("/")[2] for place in sorted(first)[1:]]
    assert wheels == ["left", "middle", "right"]


@needs_blender
def test_work_ends_with_the_file_and_nothing_stays_registered(found: dict[str, Any]) -> None:
    assert found["ended"] and not found["left"]


@needs_blender
def test_a_result_that_cannot_be_shown_is_a_problem(found: dict[str, Any]) -> None:
    assert "cannot be shown" in found["not shown"]["message"] and "renamed" in found["not shown"]["message"]
