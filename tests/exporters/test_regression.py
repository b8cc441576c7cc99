"""The regression check detects damage as a supervisor would, passes a re-rendering, and shows the changes."""

from __future__ import annotations

import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from vehsim.cli.commands import run
from vehsim.errors import InputError
from vehsim.exporters.compare.compare import compare_folders
from vehsim.exporters.compare.pytest_plugin import RenderRegression
from vehsim.exporters.pictures.frames import render_stage
from vehsim.exporters.pictures.passes import prim_colours, read_depth
from vehsim.exporters.usd.exporter import write_usd

FRAMES, SIZE, PASSES = (1004, 1016), (320, 180), ("depth", "segmentation")
TOY = "/shot/vehicles/toy0"


@pytest.fixture(scope="module")
def approved(tmp_path_factory, toys, bumpy):
    """A delivered shot in ``shot/`` and its approved pictures in ``renders/``."""
    from fractions import Fraction

    from vehsim.cameras.camera import CameraRig
    from vehsim.cameras.framing import solve_camera
    from vehsim.delivery.take import RenderSettings, Take
    from vehsim.world.world import World

    folder = tmp_path_factory.mktemp("approved")
    clips, world = {"toy0": toys.clip(toys.asset(folder / "in" / "toy.usda"))}, World(bumpy)
    camera = solve_camera(CameraRig(), clips, world, toys.frames, SIZE[0] / SIZE[1])
    take = Take("shot", clips, world, (camera,), Fraction(24), toys.frames, RenderSettings(size=SIZE))
    write_usd(take, folder / "shot", toys.silent)
    render_stage(folder / "shot" / "shot.usda", folder / "renders", frames=FRAMES, size=SIZE, passes=PASSES)
    return folder


def changed(approved: Path, folder: Path, damage: Any) -> set[str]:
    """The passes that fail after ``damage`` is applied to a copy of the stage."""
    from pxr import Usd

    shutil.copytree(approved / "shot", folder / "shot")
    path = folder / "shot" / "shot.usda"
    stage = Usd.Stage.Open(str(path))
    damage(stage)
    stage.GetRootLayer().Save()
    render_stage(path, folder / "renders", frames=FRAMES, size=SIZE, passes=PASSES)
    found = compare_folders(folder / "renders", approved / "renders")
    assert len(found) == len(FRAMES) * (1 + len(PASSES))
    return {comparison.kind for comparison in found if comparison.fails()}


def move(axis: int, far: float) -> Any:
    def damage(stage: Any) -> None:
        attribute = stage.GetPrimAtPath(TOY).GetAttribute("xformOp:translate")
        places = {time: attribute.Get(time) for time in attribute.GetTimeSamples()}  # before the first one hides them
        for time, place in places.items():
            place[axis] += far
            attribute.Set(place, time)
        assert len(attribute.GetTimeSamples()) == len(places) > 1

    return damage


def without_rotor(stage: Any) -> None:
    stage.GetPrimAtPath(f"{TOY}/rotor").SetActive(False)


def repaint(stage: Any) -> None:
    stage.GetPrimAtPath(f"{TOY}/materials/paint/surface").GetAttribute("inputs:diffuseColor").Set((0.6, 0.1, 0.05))


def one_frame_late(stage: Any) -> None:
    from pxr import Sdf

    prim = stage.GetPrimAtPath(TOY)
    reference = prim.GetMetadata("references").GetAddedOrExplicitItems()[0]
    prim.GetReferences().SetReferences([Sdf.Reference(reference.assetPath, layerOffset=Sdf.LayerOffset(1.0))])


def brighten(stage: Any) -> None:
    attribute = stage.GetPrimAtPath("/shot/lights/sun").GetAttribute("inputs:intensity")
    attribute.Set(1.5 * attribute.Get())


@pytest.mark.parametrize(
    ("damage", "seen"),
    [
        (move(0, 0.01), {"depth"}),
        (move(1, 0.01), {"depth"}),
        (move(2, 0.01), {"depth"}),
        (without_rotor, {"colour", "depth", "segmentation"}),
        (repaint, {"colour"}),
        (one_frame_late, {"colour", "depth", "segmentation"}),
        (brighten, {"colour"}),
    ],
    ids=["1 cm ahead", "1 cm aside", "1 cm up", "missing part", "wrong colour", "one frame late", "brighter sun"],
)
def test_damage_fails_the_affected_passes(approved, tmp_path, damage, seen):
    found = changed(approved, tmp_path, damage)
    assert found >= seen
    if seen == {"colour"}:
        assert found == seen, "depth and segmentation know no light"


def test_rendering_again_gives_the_same_bytes(approved, tmp_path):
    shutil.copytree(approved / "shot", tmp_path / "elsewhere")
    stage = tmp_path / "elsewhere" / "shot.usda"
    render_stage(stage, tmp_path / "again", frames=FRAMES, size=SIZE, passes=PASSES, processes=2)
    for comparison in compare_folders(tmp_path / "again", approved / "renders"):
        assert comparison.picture.read_bytes() == comparison.reference.read_bytes()
        assert comparison.changed == 0.0


def test_depth_is_in_metres_and_segmentation_identifies_prims(approved):
    """Compared with rays: the ground's height and the camera's pose give the depth of every ground pixel."""
    import json

    from PIL import Image

    from vehsim.exporters.usd.stage import StageReader

    name = "shot.chase.{}1004"
    depth = read_depth(approved / "renders" / "chase" / "depth" / f"{name.format('depth.')}.tif")
    with Image.open(approved / "renders/chase/segmentation" / f"{name.format('segmentation.')}.png") as image:
        colours = np.asarray(image)
    legend = json.loads((approved / "renders/chase/segmentation/legend.json").read_text())
    of_path = {path: tuple(bytes.fromhex(colour[1:])) for colour, path in legend.items()}
    assert {tuple(colour) for colour in colours.reshape(-1, 3).tolist()} <= {*of_path.values(), (0, 0, 0)}
    stage = StageReader(approved / "shot" / "shot.usda")
    pose, half, *_ = stage.camera("chase", 1004)
    ground = next(colour for path, colour in of_path.items() if path.startswith("/shot/env/terrain"))
    rows, columns = np.nonzero((colours == ground).all(axis=2))
    x = ((columns + 0.5) / SIZE[0] * 2 - 1) * half
    y = (1 - (rows + 0.5) / SIZE[1] * 2) * half * SIZE[1] / SIZE[0]
    z = depth[rows, columns].astype(float)
    places = np.stack([x * z, y * z, -z], axis=1) @ pose[:3, :3].T + pose[:3, 3]
    x, y = places[:, 0], places[:, 1]
    inside = (np.abs(x) < 39) & (np.abs(y) < 39)
    height = 1.5 * np.sin(x / 7) * np.cos(y / 9)  # the bumpy terrain's, which facets of 2 m follow to 2 cm
    assert inside.sum() > 500 and np.abs(places[:, 2] - height)[inside].max() < 0.03
    body = (colours == of_path[f"{TOY}/body/body"]).all(axis=2)
    centre = stage.matrices(1004)[TOY][:3, 3] - pose[:3, 3]
    assert body.sum() > 100 and abs(np.median(depth[body]) + centre @ pose[:3, 2]) < 2.5


def test_a_prims_colour_does_not_depend_on_other_prims():
    paths = [f"/shot/part{k}" for k in range(3000)]
    colours = prim_colours(paths)
    assert len(np.unique(colours, axis=0)) == 3000 and colours.any(axis=1).all()
    assert (prim_colours(paths[:7]) == colours[:7]).all()


def test_unknown_passes_are_named(approved, tmp_path):
    with pytest.raises(InputError, match="choose from depth, segmentation"):
        render_stage(approved / "shot" / "shot.usda", tmp_path, frames=[1004], passes=["albedo"])


def test_burned_in_text_is_only_in_the_upper_band(approved, tmp_path):
    from PIL import Image

    stage, name = approved / "shot" / "shot.usda", "chase/shot.chase.1004.png"
    render_stage(stage, tmp_path, frames=[1004], size=SIZE, burn_in=True)
    with Image.open(tmp_path / name) as burned, Image.open(approved / "renders" / name) as plain:
        different = (np.asarray(burned) != np.asarray(plain)).any(axis=2)
    assert different[:22].mean() > 0.9 and not different[22:].any()
    assert (np.asarray(burned)[:22, -60:] > 200).any(), "the frame's number"


def test_report_shows_before_after_difference_and_flicker(approved, tmp_path):
    path = tmp_path / "renders"
    shutil.copytree(approved / "renders", path)
    from PIL import Image

    Image.fromarray(np.zeros((180, 320, 3), np.uint8)).save(path / "chase" / "shot.chase.1004.png")
    (path / "chase" / "depth" / "shot.chase.depth.1016.tif").unlink()
    assert run(["compare", str(path), str(approved / "renders"), "--out", str(tmp_path / "report")]) == 1
    page = (tmp_path / "report" / "index.html").read_text()
    assert page.count('class="row"') == 2 and "was not rendered" in page
    for word in ("before", "after", "difference", "flicker"):
        assert f"<figcaption>{word}</figcaption>" in page
    shown = [part.split('"')[0] for part in page.split('src="')[1:]]
    assert len(shown) == 10 and all((tmp_path / "report" / name).is_file() for name in shown)


def test_an_invalid_depth_file_is_named(tmp_path):
    (tmp_path / "a.tif").write_bytes(b"not a picture")
    with pytest.raises(InputError, match="render it again"):
        read_depth(tmp_path / "a.tif")


# ---------------------------------------------------------------- the plugin, as a studio's own project has it

PROJECT = """
def test_looks(render_regression):
    render_regression({stage!r}, frames=[1004], size=(160, 90))

def test_pictures_of_another_renderer(render_regression):
    render_regression({pictures!r})
"""


def pytest_in(project: Path, capsys: Any, *options: str) -> tuple[int, str]:
    """Run the project's tests in this process, with the project's own plugins and configuration."""
    code = pytest.main(["-q", "-p", "no:cacheprovider", "--rootdir", str(project), *options, str(project / "tests")])
    return int(code), capsys.readouterr().out


def test_the_plugin_is_available_without_configuration(tmp_path):
    command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", "--fixtures", str(tmp_path)]
    answer = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True)
    assert "render_regression" in answer.stdout, answer.stdout + answer.stderr


def test_the_plugin_works_in_a_separate_project(approved, tmp_path, capsys):
    """Nothing approved: fails. Approved: passes. Damaged: fails, with a report. Approved again: passes."""
    from pxr import Usd

    project, stage, pictures = tmp_path / "project", tmp_path / "shot", tmp_path / "pictures"
    (project / "tests").mkdir(parents=True)
    shutil.copytree(approved / "shot", stage)
    shutil.copytree(approved / "renders", pictures)
    text = PROJECT.format(stage=str(stage / "shot.usda"), pictures=str(pictures))
    (project / "tests" / "test_look.py").write_text(text)
    (project / "pytest.ini").write_text("[pytest]\n")

    code, output = pytest_in(project, capsys)
    assert code == 1 and output.count("no reference pictures") >= 2 and "--update-renders" in output
    code, output = pytest_in(project, capsys, "--update-renders")
    assert code == 0 and "9 reference pictures written" in output  # three passes of one frame; two frames of three
    references = project / "tests" / "render_references" / "test_look" / "test_looks" / "shot"
    before = {path: (path.read_bytes(), path.stat().st_mtime_ns) for path in references.rglob("*.*")}
    code, output = pytest_in(project, capsys)
    assert code == 0 and "2 passed" in output and not (project / "render_report").exists()

    usd = Usd.Stage.Open(str(stage / "shot.usda"))
    repaint(usd)
    usd.GetRootLayer().Save()
    code, output = pytest_in(project, capsys, "--render-report", str(tmp_path / "shown"))
    page = tmp_path / "shown" / "test_look" / "test_looks" / "shot" / "index.html"
    assert code == 1 and "1 failed, 1 passed" in output and str(page) in output and page.is_file()
    code, output = pytest_in(project, capsys, "--update-renders")
    assert code == 0 and "1 reference pictures written" in output
    after = {path: (path.read_bytes(), path.stat().st_mtime_ns) for path in references.rglob("*.*")}
    assert {path.name for path in before if before[path] != after[path]} == {"shot.chase.1004.png"}


def test_missing_renders_fail_and_are_removed_by_an_update(approved, tmp_path):
    def check(update: bool) -> RenderRegression:
        return RenderRegression(tmp_path / "references", tmp_path / "report", tmp_path / "renders", update)

    shutil.copytree(approved / "renders", tmp_path / "pictures")
    check(True)(tmp_path / "pictures")
    check(False)(tmp_path / "pictures")
    (tmp_path / "pictures" / "chase" / "shot.chase.1016.png").unlink()
    shutil.copy(tmp_path / "pictures/chase/shot.chase.1004.png", tmp_path / "pictures/chase/shot.chase.1099.png")
    with pytest.raises(AssertionError, match=r"(?s)1016.png: was not rendered.*1099.png: has no reference"):
        check(False)(tmp_path / "pictures")
    check(True)(tmp_path / "pictures")
    check(False)(tmp_path / "pictures")


def test_a_prim_that_vanished_is_named(approved, tmp_path):
    """Its colour is only in the legend that an update keeps beside the references."""
    from pxr import Usd

    def check(update: bool) -> RenderRegression:
        return RenderRegression(tmp_path / "references", tmp_path / "report", tmp_path / "renders", update)

    shutil.copytree(approved / "shot", tmp_path / "shot")
    path = tmp_path / "shot" / "shot.usda"
    look = {"frames": [1004], "size": SIZE}
    check(True)(path, **look)
    stage = Usd.Stage.Open(str(path))
    without_rotor(stage)
    stage.GetRootLayer().Save()
    with pytest.raises(AssertionError, match=r"segmentation; /shot/vehicles/toy0/rotor/rotor is missing"):
        check(False)(path, **look)
    check(True)(path, **look)
    check(False)(path, **look)


def test_allowed_applies_to_colour_only(approved, tmp_path):
    shutil.copytree(approved / "renders", tmp_path / "pictures")
    check = RenderRegression(tmp_path / "references", tmp_path / "report", tmp_path / "renders", update=True)
    check(tmp_path / "pictures")
    check.update = False
    from PIL import Image

    for kind, suffix in (("", ".png"), ("segmentation/", ".png")):
        path = tmp_path / "pictures" / "chase" / f"{kind}shot.chase.{kind.replace('/', '.')}1004{suffix}"
        with Image.open(path) as image:
            pixels = np.array(image)
        pixels[:3, :100] = 255 - pixels[:3, :100]
        Image.fromarray(pixels).save(path)
        with pytest.raises(AssertionError):
            check(tmp_path / "pictures")
        if not kind:
            check(tmp_path / "pictures", allowed=0.01)
    with pytest.raises(AssertionError, match="segmentation"):
        check(tmp_path / "pictures", allowed=0.01)
