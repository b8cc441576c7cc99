"""Blender shows the exported motion at every frame and between frames: opened as it is, and baked to its own keys."""

from __future__ import annotations

import json
import os
import subprocess
from pathlib import Path

import numpy as np
import pytest

from vehsim.exporters import blender
from vehsim.exporters.usd.exporter import write_usd

MADE = Path(__file__).parents[2] / ".blender" / "bin" / "python"
"""The Python with Blender's module that `make blender` installs."""
PYTHON = os.environ.get("VEHSIM_BLENDER", str(MADE) if MADE.exists() else "")
needs_blender = pytest.mark.skipif(
    not Path(PYTHON).name.startswith("python"),
    reason="needs Blender's module bpy: run make blender, or set VEHSIM_BLENDER to a Python that has it",
)
WHERE = """
import json, sys
sys.path.insert(0, {folder!r})
import blender, bpy
scene = {scene}
found = {{}}
for time in {times}:
    scene.frame_set(int(time // 1), subframe=time % 1)
    graph = bpy.context.evaluated_depsgraph_get()
    for name in {names}:
        found[f"{{name}} {{time}}"] = [list(row) for row in bpy.data.objects[name].evaluated_get(graph).matrix_world]
rate = scene.render.fps / scene.render.fps_base
print("SAYS" + json.dumps([found, rate, scene.frame_start, scene.frame_end]))
"""
NAMES = {"toy0": "/shot/vehicles/toy0", "rotor": "/shot/vehicles/toy0/rotor", "chase": "/shot/cameras/chase"}
TIMES = [1001.0, 1001.5, 1010.0, 1012.5, 1024.0]


def poses(scene: str) -> tuple[dict[str, np.ndarray], float, int, int]:
    folder = str(Path(blender.__file__).parent)
    program = WHERE.format(folder=folder, scene=scene, times=TIMES, names=list(NAMES))
    answer = subprocess.run([PYTHON, "-c", program], capture_output=True, text=True)
    lines = [line for line in answer.stdout.splitlines() if line.startswith("SAYS")]
    assert lines, answer.stdout[-2000:] + answer.stderr[-2000:]
    found, rate, first, last = json.loads(lines[0][4:])
    return {key: np.array(matrix) for key, matrix in found.items()}, rate, first, last


@pytest.fixture
def shot(tmp_path, toys, make_take):
    take = make_take(toys.clip(toys.asset(tmp_path / "in" / "toy.usda")))
    write_usd(take, tmp_path, toys.silent)
    return take, tmp_path / "shot.usda"


@needs_blender
@pytest.mark.parametrize("baked", [False, True])
def test_matrices_in_blender_match_the_stage(shot, tmp_path, toys, baked):
    from pxr import Usd, UsdGeom

    take, path = shot
    scene = f"blender.open_stage({str(path)!r})"
    if baked:
        blender.write_blend(take, tmp_path, toys.silent)
        scene = f"(bpy.ops.wm.open_mainfile(filepath={str(tmp_path / 'shot.blend')!r}), bpy.context.scene)[1]"
    found, rate, first, last = poses(scene)
    assert (rate, first, last) == (24.0, 1001, 1024)
    stage = Usd.Stage.Open(str(path))
    for time in TIMES:
        cache = UsdGeom.XformCache(time)
        for name, prim in NAMES.items():
            expected = np.array(cache.GetLocalToWorldTransform(stage.GetPrimAtPath(prim))).T
            size = max(1.0, np.abs(expected[:3, 3]).max())  # Blender stores single precision
            tolerance = 1e-5 if not baked or time % 1 == 0 else 2e-2  # keys rotate along other chords than the reader
            assert np.abs(found[f"{name} {time}"] - expected).max() < tolerance * size, (name, time)


@needs_blender
def test_a_layer_over_a_blender_asset_moves_in_blender(tmp_path, toys, make_take):
    """Blender's importer leaves out a lone root that Blender wrote."""

    def marked(stage):
        stage.GetDefaultPrim().SetCustomDataByKey("Blender:generated", True)

    write_usd(make_take(toys.clip(toys.asset(tmp_path / "a" / "toy.usda", edit=marked))), tmp_path, toys.silent)
    layer, folder = str(tmp_path / "layers" / "toy0.anim.usdc"), str(Path(blender.__file__).parent)
    program = f"""import sys; sys.path.insert(0, {folder!r}); import blender, bpy
scene, found = blender.open_stage({layer!r}), bpy.data.objects["rotor"]
for frame in (1001, 1024):
    scene.frame_set(frame)
    print("SAYS", *found.matrix_world.translation)"""
    output = subprocess.run([PYTHON, "-c", program], capture_output=True, text=True).stdout
    first, last = (np.array(line.split()[1:], float) for line in output.splitlines() if line.startswith("SAYS"))
    assert np.linalg.norm(last - first) > 5


@needs_blender
def test_cycles_renders_the_stage_alone(shot, tmp_path):
    from PIL import Image
    from pxr import Usd, UsdGeom

    _, path = shot
    stage = Usd.Stage.Open(str(path))
    UsdGeom.Xform.Define(stage, "/shot/env/chase")  # in Blender the camera of that name is then called chase.001
    stage.GetRootLayer().Save()
    picture = tmp_path / "still.png"
    blender._run(path, "--still", picture, "--size", "64x36", "--samples", "4", "--camera", "chase")
    with Image.open(picture) as image:
        pixels = np.asarray(image.convert("RGB"), float)
    assert pixels.shape == (36, 64, 3) and 20 < pixels.mean() < 235 and pixels.std() > 5


@needs_blender
def test_the_suns_strength_in_blender_equals_its_irradiance(shot):
    """Blender's own importer multiplies it by four."""
    program = f"import sys; sys.path.insert(0, {str(Path(blender.__file__).parent)!r}); import blender, bpy; "
    program += f"blender.open_stage({str(shot[1])!r}); print('SAYS', bpy.data.objects['sun'].data.energy)"
    answer = subprocess.run([PYTHON, "-c", program], capture_output=True, text=True)
    line = next(line for line in answer.stdout.splitlines() if line.startswith("SAYS"))
    from pxr import Usd, UsdLux

    stage = Usd.Stage.Open(str(shot[1]))
    sun = UsdLux.DistantLight(stage.GetPrimAtPath("/shot/lights/sun"))
    assert float(line.split()[1]) == pytest.approx(sun.GetIntensityAttr().Get(), rel=1e-6)


def test_without_blender_its_exporters_name_the_remedy(shot, tmp_path, toys, monkeypatch):
    from vehsim.errors import InputError

    monkeypatch.delenv("VEHSIM_BLENDER", raising=False)
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(InputError, match="VEHSIM_BLENDER"):
        blender.write_blend(shot[0], tmp_path, toys.silent)


def test_the_suns_light_does_not_depend_on_its_size(shot):
    """Renderers take a sun's intensity for that of its disc unless it is normalised: Cycles then rendered dusk."""
    from pxr import Usd, UsdLux

    stage = Usd.Stage.Open(str(shot[1]))
    assert UsdLux.DistantLight(stage.GetPrimAtPath("/shot/lights/sun")).GetNormalizeAttr().Get() is True
