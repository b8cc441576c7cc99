"""Blender shows the exported motion at every frame and between frames: opened as it is, and baked to its own keys."""

from __future__ import annotations

import json
import os
import subprocess
import warnings
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pxr import Usd, UsdGeom
from scipy.spatial.transform import Rotation

from vehsim.exporters import blender
from vehsim.exporters.usd.exporter import write_usd
from vehsim.exporters.usd.readback import world_matrices
from vehsim.exporters.usd.scenery.water_material import TILE, author_coordinates, author_foam, bind_material, set_foam

MADE = Path(__file__).parents[2] / ".blender" / "bin" / "python"
"""The Python with Blender's module that `make blender` installs."""
PYTHON = os.environ.get("VEHSIM_BLENDER", str(MADE) if MADE.exists() else "")
needs_blender = pytest.mark.skipif(
    not Path(PYTHON).name.startswith("python"),
    reason="needs Blender's module bpy: run make blender, or set VEHSIM_BLENDER to a Python that has it",
)


@pytest.fixture(autouse=True)
def exporters_use_it(monkeypatch):
    if PYTHON:
        monkeypatch.setenv("VEHSIM_BLENDER", PYTHON)


FOLDER = str(Path(blender.__file__).parent)
PROGRAM = """
import json, sys
sys.path.insert(0, {folder!r})
import blender, bpy
{opening}
found, about = {{}}, None
for time in {times}:
    scene.frame_set(int(time // 1), subframe=time % 1)
    graph = bpy.context.evaluated_depsgraph_get()
    for name in {names}:
        matrix = bpy.data.objects[name].evaluated_get(graph).matrix_world
        found.setdefault(name, []).append([list(row) for row in matrix])
{more}
print("SAYS" + json.dumps([found, about]))
"""
OPEN_BLEND = "bpy.ops.wm.open_mainfile(filepath={path!r})\nscene = bpy.context.scene"
RANGE = "about = scene.render.fps / scene.render.fps_base, scene.frame_start, scene.frame_end"
NAMES = {"toy0": "/shot/vehicles/toy0", "rotor": "/shot/vehicles/toy0/rotor", "chase": "/shot/cameras/chase"}
OPEN_ALEMBIC = """
bpy.ops.wm.read_factory_settings(use_empty=True)
scene = bpy.context.scene
scene.render.fps = 24
bpy.ops.wm.alembic_import(filepath={path!r}, as_background_job=False)
"""
TIMES = [1001.0, 1001.5, 1010.0, 1012.5, 1024.0]


def matrices(opening: str, names: Iterable[str], times: Iterable[float], more: str = "") -> tuple[Any, Any]:
    """Matrices (n, 4, 4) in Blender at ``times`` (n,) frames by object's name, and what ``more`` finds out ``about``
    the ``scene`` that ``opening`` opens."""
    program = PROGRAM.format(folder=FOLDER, opening=opening, names=list(names), times=list(times), more=more)
    answer = subprocess.run([PYTHON, "-c", program], capture_output=True, text=True)
    lines = [line for line in answer.stdout.splitlines() if line.startswith("SAYS")]
    assert lines, answer.stdout[-2000:] + answer.stderr[-2000:]
    found, about = json.loads(lines[0][4:])
    return {name: np.array(rows) for name, rows in found.items()}, about


def eighths(first: int, last: int) -> list[float]:
    return (np.arange(first * 8, last * 8 + 1) / 8).tolist()


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
    opening = f"scene = blender.open_stage({str(path)!r})"
    if baked:
        blender.write_blend(take, tmp_path, toys.silent)
        opening = OPEN_BLEND.format(path=str(tmp_path / "shot.blend"))
    found, about = matrices(opening, NAMES, TIMES, RANGE)
    assert about == [24.0, 1001, 1024]
    stage = Usd.Stage.Open(str(path))
    for k, time in enumerate(TIMES):
        cache = UsdGeom.XformCache(time)
        for name, prim in NAMES.items():
            expected = np.array(cache.GetLocalToWorldTransform(stage.GetPrimAtPath(prim))).T
            size = max(1.0, np.abs(expected[:3, 3]).max())  # Blender stores single precision
            tolerance = 1e-5 if not baked else 2e-5  # curves of single precision
            assert np.abs(found[name][k] - expected).max() < tolerance * size, (name, time)


ABOUT = """
render = scene.render
kinds = {{}}
for found_object in bpy.data.objects:
    data = found_object.animation_data
    for layer in data.action.layers if data else ():
        for curve in layer.strips[0].channelbags[0].fcurves:
            points = curve.keyframe_points
            kinds[f"{{found_object.name}} {{curve.data_path}}"] = [points[0].interpolation, len(points)]
about = {{
    "kinds": kinds,
    "camera": scene.camera.name, "size": [render.resolution_x, render.resolution_y], "engine": render.engine,
    "blur": [render.use_motion_blur, render.motion_blur_shutter, render.motion_blur_position],
    "markers": [[marker.frame, marker.camera.name] for marker in scene.timeline_markers],
    "lens": [(scene.frame_set(f), round(bpy.data.objects["cut"].data.lens, 3))[1] for f in {frames}]
    if "cut" in bpy.data.objects else [],
}}
"""


def opened(path, names, first, last, frames=()):
    """Matrices (8 n + 1, 4, 4) by object's name, kinds and numbers of keys by curve, and what the scene renders."""
    opening = OPEN_BLEND.format(path=str(path))
    found, about = matrices(opening, names, eighths(first, last), ABOUT.format(frames=list(frames)))
    return found, about.pop("kinds"), about


@needs_blender
@pytest.mark.parametrize("settings", [{}, {"curves": (0.001, 0.05), "up_axis": "Y", "meters_per_unit": 0.01}])
def test_a_fast_car_in_a_blend_follows_the_clip_at_eighths_of_a_frame(tmp_path, toys, make_take, settings):
    """At 40 m/s, a wheel turns 37 degrees in an eighth of a frame; matrices are computed here from the clip."""
    import vehsim
    from vehsim.delivery.take import UsdSettings
    from vehsim.vehicles import load_vehicle

    t = np.linspace(0, 1, 241)
    car = load_vehicle("car")
    controls = np.column_stack([200 * np.ones_like(t), 0.05 * np.cos(9 * t)])
    clip = vehsim.simulate(car, None, controls, vehsim.State(twist=(0.0, 40.0, 0.0)), 1.0)
    take = replace(make_take(clip), usd=UsdSettings(shutter=(-0.25, 0.25), **settings))
    write_usd(take, tmp_path, toys.silent)
    blender.write_blend(take, tmp_path, toys.silent)
    found, kinds, about = opened(tmp_path / "shot.blend", ["toy0", "steer_fl", "wheel_fl", "wheel_rr"], 1001, 1024)
    at = clip.at(np.arange(23 * 8 + 1) / 192)
    metres = settings.get("meters_per_unit", 1.0)
    poses = at.matrices()
    for name, joint, hub in (("fl", "roll_fl", (1.3, 0.77, 0.32)), ("rr", "roll_rr", (-1.3, -0.77, 0.32))):
        steer = at.channels[f"steer_{name}"] if name == "fl" else np.zeros(len(poses))
        angles = np.stack([steer, at.channels[joint]], axis=1)
        expected = poses[:, :3, :3] @ Rotation.from_euler("ZY", angles).as_matrix()
        turned = found[f"wheel_{name}"][:, :3, :3]
        turned = turned / np.linalg.norm(turned, axis=1, keepdims=True)
        rest = turned[0].T @ expected[0]  # the stage's up axis and the model's own axes
        assert np.abs(turned @ rest - expected).max() < 2e-3, name
        rolled = np.unwrap(np.arctan2(-(turned @ rest)[:, 2, 0], (turned @ rest)[:, 2, 2]))
        assert np.degrees(np.diff(rolled)).min() > 30.0, "it never turns back"
        places = poses[:, :3, :3] @ hub + poses[:, :3, 3]
        assert np.abs(found[f"wheel_{name}"][:, :3, 3] - places).max() < 2.5e-3  # samples follow chords, within 1 mm
    assert metres == 1.0 or kinds["wheel_rr rotation_euler"][0] == "BEZIER"
    assert kinds["wheel_rr rotation_euler"][1] < 15 if settings else kinds["wheel_rr rotation_euler"][0] == "LINEAR"
    assert about["camera"] == "chase" and about["size"] == [160, 90] and about["engine"] == "CYCLES"
    assert about["blur"] == [True, 0.5, "CENTER"] and about["markers"] == []


@needs_blender
def test_alembic_follows_the_clip_at_eighths_of_a_frame(tmp_path, toys, make_take):
    """The same car, read back by Blender's importer of Alembic: matrices, which need samples within frames."""
    from pxr import Usd, UsdGeom

    import vehsim
    from vehsim.vehicles import load_vehicle

    t = np.linspace(0, 0.4, 97)
    controls = np.column_stack([200 * np.ones_like(t), 0.05 * np.cos(9 * t)])
    clip = vehsim.simulate(load_vehicle("car"), None, controls, vehsim.State(twist=(0.0, 40.0, 0.0)), 0.4)
    take = replace(make_take(clip), frames=(1001, 1010))
    write_usd(take, tmp_path, toys.silent)
    stage = Usd.Stage.Open(str(tmp_path / "shot.usda"))
    UsdGeom.Points.Define(stage, "/shot/marks").CreatePurposeAttr("guide")  # of a plan, and no spray
    stage.Save()
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        (path,) = blender.write_alembic(take, tmp_path, toys.silent)
    first, last = 1001, 1010
    opening = OPEN_ALEMBIC.format(path=str(path))
    found, _ = matrices(opening, ["toy0", "wheel_rr", "chase"], eighths(first, last))
    at = clip.at(np.arange((last - first) * 8 + 1) / 192)
    poses = at.matrices()
    turned = poses[:, :3, :3] @ Rotation.from_euler("Y", at.channels["roll_rr"][:, None]).as_matrix()
    places = poses[:, :3, :3] @ (-1.3, -0.77, 0.32) + poses[:, :3, 3]
    assert np.abs(found["toy0"][:, :3, 3] - poses[:, :3, 3]).max() < 2.5e-3  # samples follow chords
    assert np.abs(found["wheel_rr"][:, :3, 3] - places).max() < 2.5e-3
    assert np.abs(found["wheel_rr"][:, :3, :3] - turned).max() < 4e-3
    views = take.cameras[0].positions[: last - first + 1]
    assert np.abs(found["chase"][::8, :3, 3] - views).max() < 1e-4


@needs_blender
def test_a_blend_has_the_cuts_of_the_shot(tmp_path, toys, make_take):
    from vehsim.cameras.camera import CameraRig
    from vehsim.cameras.cuts import CUT, cut
    from vehsim.cameras.framing import solve_camera

    take = make_take(toys.clip(toys.asset(tmp_path / "in" / "toy.usda")))
    wide = solve_camera(CameraRig("wide", "static", lens_mm=20.0), take.clips, take.world, take.frames, 16 / 9)
    cuts = ((1001, "chase"), (1012, "wide"))
    cameras = {"chase": take.cameras[0], "wide": wide}
    take = replace(take, cameras=(*cameras.values(), cut(CUT, cameras, cuts)), cuts=cuts)
    take = replace(take, render=replace(take.render, cameras=(CUT,)))
    write_usd(take, tmp_path, toys.silent)
    blender.write_blend(take, tmp_path, toys.silent)
    _, _, about = opened(tmp_path / "shot.blend", ["cut"], 1001, 1002, frames=(1001, 1011, 1012, 1024))
    assert about["camera"] == "chase", "the marker of the first piece switches it"
    assert about["markers"] == [[1001, "chase"], [1012, "wide"]]
    assert about["lens"] == [35.0, 35.0, 20.0, 20.0] and about["blur"][0] is False
    # the camera "cut" stays with its first piece until it jumps, half a frame before the cut
    from pxr import Usd, UsdGeom

    stage = Usd.Stage.Open(str(tmp_path / "shot.usda"))
    prim = stage.GetPrimAtPath("/shot/cameras/cut")
    times = eighths(1010, 1013)
    wanted = np.array([np.array(UsdGeom.XformCache(t).GetLocalToWorldTransform(prim)).T for t in times])
    blender.write_alembic(take, tmp_path, toys.silent)
    for reading, file in ((OPEN_BLEND, "shot.blend"), (OPEN_ALEMBIC, "shot.abc")):
        found, _ = matrices(reading.format(path=str(tmp_path / file)), ["cut"], times)
        assert np.abs(found["cut"] - wanted).max() < 1e-3, file


@needs_blender
def test_pivots_scales_and_animated_parents_keep_native_curves(tmp_path, toys, make_take):
    """An op between constants gets an empty; the matrices are those of the stage."""
    from pxr import Gf, Usd, UsdGeom

    from vehsim.rig.rig import Drive

    def edit(stage):
        rotor = UsdGeom.Xformable(stage.GetPrimAtPath("/toy/rotor"))
        rotor.AddRotateXYZOp().Set(Gf.Vec3f(10, 20, 30))
        rotor.AddTranslateOp(opSuffix="pivot").Set(Gf.Vec3d(0.3, 0.1, 0.0))
        rotor.AddTranslateOp(opSuffix="pivot", isInverseOp=True)
        rotor.AddScaleOp().Set(Gf.Vec3f(1.0, 1.0, 1.5))
        for set_time in (stage.SetFramesPerSecond, stage.SetTimeCodesPerSecond):
            set_time(24)
        stage.SetStartTimeCode(1001)
        stage.SetEndTimeCode(1024)
        body = UsdGeom.Xformable(stage.GetPrimAtPath("/toy/body"))
        squash = body.AddScaleOp()
        for frame in (1001, 1024):
            squash.Set(Gf.Vec3f(1.0, 1.0, 1.0 + (frame - 1001) / 23), frame)

    clip = toys.clip(toys.asset(tmp_path / "in" / "toy.usda", edit=edit), drives={"rotor": Drive("rotor", "rotateZ")})
    take = make_take(clip)
    write_usd(take, tmp_path, toys.silent)
    blender.write_blend(take, tmp_path, toys.silent)
    names = {"rotor": "/shot/vehicles/toy0/rotor", "body": "/shot/vehicles/toy0/body"}
    found, kinds, _ = opened(tmp_path / "shot.blend", list(names), 1001, 1024)
    stage = Usd.Stage.Open(str(tmp_path / "shot.usda"))
    for name, path in names.items():
        expected = world_matrices(stage.GetPrimAtPath(path), 1001 + np.arange(23 * 8 + 1) / 8)
        assert np.abs(found[name] - expected).max() < 1e-3, name
    assert kinds["rotor.0 rotation_euler"] == ["LINEAR", 24]


@needs_blender
def test_a_layer_over_a_blender_asset_moves_in_blender(tmp_path, toys, make_take):
    """Blender's importer leaves out a lone root that Blender wrote."""

    def marked(stage):
        stage.GetDefaultPrim().SetCustomDataByKey("Blender:generated", True)

    write_usd(make_take(toys.clip(toys.asset(tmp_path / "a" / "toy.usda", edit=marked))), tmp_path, toys.silent)
    layer = str(tmp_path / "layers" / "toy0.anim.usdc")
    found, _ = matrices(f"scene = blender.open_stage({layer!r})", ["rotor"], [1001.0, 1024.0])
    first, last = found["rotor"][:, :3, 3]
    assert np.linalg.norm(last - first) > 5


def stage_of_faces(path, *names):
    """A new stage with a triangle of each name, and their meshes."""
    from pxr import Usd, UsdGeom

    stage = Usd.Stage.CreateNew(str(path))
    UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.z)
    UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    stage.SetDefaultPrim(UsdGeom.Xform.Define(stage, "/toy").GetPrim())
    faces = [UsdGeom.Mesh.Define(stage, f"/toy/{name}") for name in names]
    for face in faces:
        face.CreatePointsAttr([(0, 0, 0), (1, 0, 0), (0, 1, 0)])
        face.CreateFaceVertexCountsAttr([3])
        face.CreateFaceVertexIndicesAttr([0, 1, 2])
    return stage, faces


@needs_blender
def test_meshes_without_a_material_show_their_display_colour(tmp_path):
    from pxr import Gf, UsdShade

    stage, faces = stage_of_faces(tmp_path / "bare.usda", "bare", "dressed")
    for face in faces:
        face.CreateDisplayColorAttr([Gf.Vec3f(0.8, 0.1, 0.1)])
    paint = UsdShade.Material.Define(stage, "/toy/paint")
    shader = UsdShade.Shader.Define(stage, "/toy/paint/shader")
    shader.CreateIdAttr("UsdPreviewSurface")
    paint.CreateSurfaceOutput().ConnectToSource(shader.ConnectableAPI(), "surface")
    UsdShade.MaterialBindingAPI.Apply(face.GetPrim()).Bind(paint)
    stage.Save()
    opening = f"scene = blender.open_stage({str(tmp_path / 'bare.usda')!r})"
    more = """about = {}
for mesh in bpy.data.meshes:
    links = [link for material in mesh.materials if material.node_tree for link in material.node_tree.links]
    nodes = [link.from_node for link in links if link.to_socket.name == "Base Color"]
    about[mesh.name] = [node.attribute_name for node in nodes if node.type == "ATTRIBUTE"]"""
    assert matrices(opening, [], [1.0], more)[1] == {"bare": ["displayColor"], "dressed": []}


@needs_blender
def test_one_sees_through_panes(tmp_path):
    """Blender 5.3 imports opacity as transmission through a solid: windscreens, which are single faces, were black."""
    from pxr import Sdf, UsdShade

    stage, (face,) = stage_of_faces(tmp_path / "pane.usda", "pane")
    glass = UsdShade.Material.Define(stage, "/toy/glass")
    shader = UsdShade.Shader.Define(stage, "/toy/glass/shader")
    shader.CreateIdAttr("UsdPreviewSurface")
    shader.CreateInput("opacity", Sdf.ValueTypeNames.Float).Set(0.45)
    glass.CreateSurfaceOutput().ConnectToSource(shader.ConnectableAPI(), "surface")
    UsdShade.MaterialBindingAPI.Apply(face.GetPrim()).Bind(glass)
    stage.Save()
    opening = f"scene = blender.open_stage({str(tmp_path / 'pane.usda')!r})"
    more = """about = {}
for node in bpy.data.materials["glass"].node_tree.nodes:
    if node.type == "BSDF_PRINCIPLED":
        about = {key: node.inputs[key].default_value for key in ("Alpha", "Transmission Weight")}"""
    seen = matrices(opening, [], [1.0], more)[1]
    assert seen == pytest.approx({"Alpha": 0.45, "Transmission Weight": 0.0})


def flat_water(path, half):
    """A stage with a square of water, and its mesh of four points."""
    stage = Usd.Stage.CreateNew(str(path))
    UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.z)
    UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    stage.SetDefaultPrim(UsdGeom.Xform.Define(stage, "/sea").GetPrim())
    mesh = UsdGeom.Mesh.Define(stage, "/sea/env/water/surface")
    xy = half * np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]])
    mesh.CreatePointsAttr([(x, y, 0.0) for x, y in xy.tolist()])
    mesh.CreateFaceVertexCountsAttr([4])
    mesh.CreateFaceVertexIndicesAttr([0, 1, 2, 3])
    author_foam(mesh)
    author_coordinates(mesh, xy)
    bind_material(stage, mesh, path.parents[1])
    return stage, mesh


def pictures_of_water(place, tilt, picture):
    """A script for Blender that renders frames 1 and 2 below a white sky, from a place, tilted up from straight down by
    an angle, rad."""
    return f"""
seen = bpy.data.objects.new("seen", bpy.data.cameras.new("seen"))
scene.collection.objects.link(seen)
seen.location, seen.rotation_euler, scene.camera = {place}, ({tilt}, 0, 0), seen
scene.world.use_nodes = True
scene.world.node_tree.nodes["Background"].inputs[0].default_value = (1, 1, 1, 1)
scene.render.engine, scene.render.resolution_x, scene.render.resolution_y = "CYCLES", 96, 96
scene.cycles.device, scene.cycles.samples, scene.view_settings.view_transform = "CPU", 16, "Raw"
for frame in (1, 2):
    scene.frame_set(frame)
    scene.render.filepath = {str(picture)!r} + str(frame)
    bpy.ops.render.render(write_still=True)
about = None"""


@needs_blender
def test_foam_has_threads_and_holes_in_blender(tmp_path):
    """The stage has it per point of the water's mesh: here four points with as much of it, seen from above."""
    from PIL import Image

    path, picture = tmp_path / "layers" / "sea.usda", tmp_path / "foam"
    stage, _ = flat_water(path, 3.0)
    for frame, foam in ((1, 0.0), (2, 0.5)):
        set_foam(stage.GetRootLayer(), "/sea/env/water/surface", frame, np.full(4, foam), np.zeros(4))
    stage.Save()
    render = pictures_of_water((0, 0, 6), 0.0, picture)
    matrices(f"scene = blender.open_stage({str(path)!r})", [], [], render)
    clear, foamy = (np.asarray(Image.open(f"{picture}{k}.png").convert("L"), float) / 255 for k in (1, 2))
    assert clear.max() < 0.3
    assert 0.2 < (foamy > 0.5).mean() < 0.7 and (foamy < 0.3).mean() > 0.2


@needs_blender
def test_blender_shades_the_waves_that_the_mesh_is_too_coarse_to_show(tmp_path):
    """A flat square in one cell has the stripes of a wave, which move with the frames."""
    from PIL import Image

    from vehsim.exporters.usd.scenery.distant_waves import DistantWaves, author_waves

    path, picture = tmp_path / "layers" / "sea.usda", tmp_path / "waves"
    stage, mesh = flat_water(path, 30.0)
    for frame in (1, 2):
        set_foam(stage.GetRootLayer(), "/sea/env/water/surface", frame, np.zeros(4), np.zeros(4))
    wave = np.array([0.12]), np.array([[0.0, 2 * np.pi / 6]]), np.zeros(1), np.array([np.pi])  # half a length a frame
    author_waves(mesh, DistantWaves(*wave, np.full(4, 60.0), np.ones(4), np.array([2.0, 2.5]), 1), TILE)
    stage.Save()
    matrices(f"scene = blender.open_stage({str(path)!r})", [], [], pictures_of_water((0, -22, 12), 1.1, picture))
    first, second = (np.asarray(Image.open(f"{picture}{k}.png").convert("L"), float)[30:].mean(axis=1) for k in (1, 2))
    trend = (first + second) / 2
    assert (first - trend).std() > 3
    assert np.corrcoef(first - trend, second - trend)[0, 1] < -0.9  # the crests are where the troughs were


@needs_blender
def test_cycles_renders_the_stage_alone(shot, tmp_path):
    from PIL import Image
    from pxr import Usd, UsdGeom

    _, path = shot
    stage = Usd.Stage.Open(str(path))
    UsdGeom.Xform.Define(stage, "/shot/env/chase")  # in Blender the camera of that name is then called chase.001
    spray = UsdGeom.Points.Define(stage, "/shot/env/spray")  # none of it is in the air at that frame
    for attribute in (spray.CreatePointsAttr(), spray.CreateVelocitiesAttr()):
        attribute.Set([], stage.GetStartTimeCode())
        attribute.Set([(0.0, 0.0, 0.0)], stage.GetEndTimeCode())
    stage.GetRootLayer().Save()
    picture = tmp_path / "still.png"
    blender._run(path, "--still", picture, "--size", "64x36", "--samples", "4", "--camera", "chase")
    with Image.open(picture) as image:
        pixels = np.asarray(image.convert("RGB"), float)
    assert pixels.shape == (36, 64, 3) and 20 < pixels.mean() < 235 and pixels.std() > 5
    # the same scene, saved and opened again: Blender's own render, before and with the spray
    baked, first, last = tmp_path / "shot.blend", int(stage.GetStartTimeCode()), int(stage.GetEndTimeCode())
    blender._run(path, "--bake", baked)
    rendered = f"""
points = bpy.data.objects["spray"]
about = [[(scene.frame_set(t), points.hide_render, points.hide_viewport)[1:] for t in ({first}, {last - 1}, {last})]]
scene.render.resolution_x, scene.render.resolution_y, scene.cycles.samples = 64, 36, 1
for frame in ({first}, {last}):
    scene.frame_set(frame)
    about.append(list(bpy.ops.render.render()))"""
    _, about = matrices(OPEN_BLEND.format(path=str(baked)), [], [], rendered)
    assert about == [[[True, True], [True, True], [False, False]], ["FINISHED"], ["FINISHED"]]


@needs_blender
def test_the_suns_strength_in_blender_equals_its_irradiance(shot):
    """Blender's own importer multiplies it by four."""
    opening = f"scene = blender.open_stage({str(shot[1])!r})"
    _, energy = matrices(opening, [], [], "about = bpy.data.objects['sun'].data.energy")
    from pxr import Usd, UsdLux

    stage = Usd.Stage.Open(str(shot[1]))
    sun = UsdLux.DistantLight(stage.GetPrimAtPath("/shot/lights/sun"))
    assert energy == pytest.approx(sun.GetIntensityAttr().Get(), rel=1e-6)


def test_without_blender_its_exporters_name_the_remedy(shot, tmp_path, toys, monkeypatch):
    from vehsim.errors import InputError

    monkeypatch.delenv("VEHSIM_BLENDER", raising=False)
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(InputError, match="VEHSIM_BLENDER"):
        blender.write_blend(shot[0], tmp_path, toys.silent)


def test_alembic_without_the_spray_says_so(shot, tmp_path, toys, monkeypatch):
    from pxr import Usd, UsdGeom

    monkeypatch.setattr(blender, "_run", lambda *arguments: None)
    take, path = shot[0], tmp_path / f"{shot[0].name}.usda"
    Usd.Stage.Open(str(shot[1])).Export(str(path))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        blender.write_alembic(take, tmp_path, toys.silent)
    stage = Usd.Stage.Open(str(path))
    UsdGeom.Points.Define(stage, f"/{take.name}/env/water/spray")
    stage.Save()
    with pytest.warns(UserWarning, match="spray is left out"):
        blender.write_alembic(take, tmp_path, toys.silent)


def test_the_suns_light_does_not_depend_on_its_size(shot):
    """Renderers take a sun's intensity for that of its disc unless it is normalised: Cycles then rendered dusk."""
    from pxr import Usd, UsdLux

    stage = Usd.Stage.Open(str(shot[1]))
    assert UsdLux.DistantLight(stage.GetPrimAtPath("/shot/lights/sun")).GetNormalizeAttr().Get() is True
