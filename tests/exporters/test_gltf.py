"""The GLB read back by a reader written here from glTF's specification, by trimesh, by Blender and by three.js in a
browser, at eighths of a frame."""

from __future__ import annotations

import asyncio
import base64
import json
import os
import struct
import subprocess
import warnings
from dataclasses import replace
from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest
from pxr import Usd, UsdGeom
from scipy.spatial.transform import Rotation, Slerp

import vehsim
from tests.browser import at as page_at
from tests.browser import browser
from vehsim.delivery.take import UsdSettings
from vehsim.exporters.gltf import write_glb
from vehsim.exporters.usd.exporter import write_usd
from vehsim.vehicles import load_vehicle

MADE = Path(__file__).parents[2] / ".blender" / "bin" / "python"
PYTHON = os.environ.get("VEHSIM_BLENDER", str(MADE) if MADE.exists() else "")
Y_UP = np.array([[1.0, 0, 0], [0, 0, 1.0], [0, -1.0, 0]])


class Read:
    """glTF 2.0, section 3: nodes, accessors, and samplers with LINEAR interpolation."""

    def __init__(self, path):
        content = path.read_bytes()
        magic, version, size, length, kind = struct.unpack_from("<4sIII4s", content)
        assert (magic, version, size, kind) == (b"glTF", 2, len(content), b"JSON")
        self.tree = json.loads(content[20 : 20 + length])
        binary, kind = struct.unpack_from("<I4s", content, 20 + length)
        assert kind == b"BIN\0" and binary == self.tree["buffers"][0]["byteLength"]
        self.binary = content[28 + length :]
        self.index = {node["name"]: k for k, node in enumerate(self.tree["nodes"])}
        assert len(self.index) == len(self.tree["nodes"]), "names are unique"
        self.parent = {child: k for k, node in enumerate(self.tree["nodes"]) for child in node.get("children", ())}

    def array(self, index):
        accessor = self.tree["accessors"][index]
        view = self.tree["bufferViews"][accessor["bufferView"]]
        kind = {5126: "<f4", 5125: "<u4", 5123: "<u2"}[accessor["componentType"]]
        width = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4}[accessor["type"]]
        start = view.get("byteOffset", 0) + accessor.get("byteOffset", 0)
        values = np.frombuffer(self.binary, kind, accessor["count"] * width, start).astype(float)
        return values.reshape(-1, width) if width > 1 else values

    def local(self, index, seconds):
        """Matrices (n, 4, 4) of a node."""
        node, matrices = self.tree["nodes"][index], np.tile(np.eye(4), (len(seconds), 1, 1))
        if "matrix" in node:
            return matrices @ np.array(node["matrix"]).reshape(4, 4).T
        parts = {"translation": node.get("translation", [0, 0, 0]), "rotation": node.get("rotation", [0, 0, 0, 1])}
        parts = {path: np.tile(value, (len(seconds), 1)) for path, value in parts.items()}
        for animation in self.tree.get("animations", ()):
            for channel in animation["channels"]:
                if channel["target"]["node"] != index:
                    continue
                sampler = animation["samplers"][channel["sampler"]]
                assert sampler["interpolation"] == "LINEAR"
                times, values = self.array(sampler["input"]), self.array(sampler["output"])
                at = np.clip(seconds, times[0], times[-1])
                if channel["target"]["path"] == "rotation":
                    parts["rotation"] = Slerp(times, Rotation.from_quat(values))(at).as_quat()
                else:
                    parts["translation"] = np.stack([np.interp(at, times, column) for column in values.T], axis=1)
        matrices[:, :3, :3] = Rotation.from_quat(parts["rotation"]).as_matrix()
        matrices[:, :3, 3] = parts["translation"]
        return matrices

    def shown(self, name, seconds):
        """Whether a node has its full size; a channel of its scale steps between 0 and 1."""
        for channel in self.tree["animations"][0]["channels"]:
            if channel["target"] == {"node": self.index[name], "path": "scale"}:
                sampler = self.tree["animations"][0]["samplers"][channel["sampler"]]
                assert sampler["interpolation"] == "STEP"
                times, values = self.array(sampler["input"]), self.array(sampler["output"])
                assert values.tolist() == [[0] * 3, [1] * 3]
                return bool(seconds >= times[1] - 1e-6)
        return True

    def triangles(self, name):
        """Corners (n, 3, 3) and colours (n, 3, 4) of a mesh without indices."""
        (primitive,) = self.tree["meshes"][self.tree["nodes"][self.index[name]]["mesh"]]["primitives"]
        points, colours = (self.array(primitive["attributes"][key]) for key in ("POSITION", "COLOR_0"))
        return points.reshape(-1, 3, 3), colours.reshape(-1, 3, 4)

    def world(self, name, seconds):
        index = self.index[name]
        matrices = self.local(index, seconds)
        while index in self.parent:
            index = self.parent[index]
            matrices = self.local(index, seconds) @ matrices
        return matrices


@pytest.fixture(scope="module")
def fast(tmp_path_factory):
    """A car at 40 m/s, whose wheels turn 298 degrees per frame, as clip, folder and GLB."""
    from vehsim.cameras.camera import CameraRig
    from vehsim.cameras.framing import solve_camera
    from vehsim.delivery.take import RenderSettings, Take

    t, folder = np.linspace(0, 1, 241), tmp_path_factory.mktemp("fast")
    controls = np.column_stack([200 * np.ones_like(t), 0.05 * np.cos(9 * t)])
    clip = vehsim.simulate(load_vehicle("car"), None, controls, vehsim.State(twist=(0.0, 40.0, 0.0)), 1.0)
    camera = solve_camera(CameraRig(), {"it": clip}, vehsim.World(), (1001, 1025), 16 / 9)
    settings = UsdSettings(up_axis="Y", meters_per_unit=0.01)
    size = RenderSettings(size=(160, 90))
    take = Take("shot", {"it": clip}, vehsim.World(), (camera,), Fraction(24), (1001, 1025), size, settings)
    write_usd(take, folder, lambda what, done: None)
    (path,) = write_glb(take, folder, lambda what, done: None)
    return clip, camera, path


def test_moving_parts_follow_the_clip_at_eighths_of_a_frame(fast):
    clip, camera, path = fast
    read, seconds = Read(path), np.arange(24 * 8 + 1) / 192
    at = clip.at(seconds)
    poses = at.matrices()
    found = read.world("it", seconds)
    assert np.abs(found[:, :3, 3] - poses[:, :3, 3] @ Y_UP.T).max() < 2.5e-3  # samples follow chords
    for name, hub in (("fl", (1.3, 0.77, 0.32)), ("rr", (-1.3, -0.77, 0.32))):
        steer = at.channels["steer_fl"] if name == "fl" else np.zeros(len(seconds))
        angles = np.stack([steer, at.channels[f"roll_{name}"]], axis=1)
        expected = Y_UP @ poses[:, :3, :3] @ Rotation.from_euler("ZY", angles).as_matrix()
        found = read.world(f"wheel_{name}", seconds)
        assert np.abs(found[:, :3, :3] - expected).max() < 4e-3, "as frames of straight lines between samples"
        places = (poses[:, :3, :3] @ hub + poses[:, :3, 3]) @ Y_UP.T
        assert np.abs(found[:, :3, 3] - places).max() < 2.5e-3
        own = np.linalg.inv(read.world("it", seconds)) @ found
        rolled = np.unwrap(np.arctan2(own[:, 0, 2], own[:, 2, 2]))
        assert np.degrees(np.diff(rolled)).min() > 30, "it never turns back"
    view, whole = read.world("chase", np.arange(25) / 24), Rotation.from_quat(camera.orientations, scalar_first=True)
    assert np.abs(view[:, :3, 3] - camera.positions @ Y_UP.T).max() < 1e-5
    assert np.abs(view[:, :3, :3] - Y_UP @ whole.as_matrix()).max() < 1e-5
    lens = read.tree["cameras"][0]["perspective"]
    assert lens["yfov"] == pytest.approx(2 * np.arctan(20.25 / 35 / 2), rel=1e-5)
    times = [read.tree["accessors"][s["input"]] for s in read.tree["animations"][0]["samplers"]]
    assert all(t["min"] == [0.0] and t["max"] == pytest.approx([1.0]) for t in times)
    assert read.tree["scenes"][0]["extras"] == {"fps": "24", "frames": [1001, 1025]}


def test_geometry_and_materials_are_those_of_the_stage(fast):
    """Every drawn point at the first frame, by trimesh, against the composed stage."""
    import trimesh

    _, _, path = fast
    scene = trimesh.load(path)
    stage = Usd.Stage.Open(str(path.with_name("shot.usda")))
    tyre = next(prim for prim in stage.Traverse() if prim.GetName() == "wheel_rl_tyre")
    cache = UsdGeom.XformCache(1001)
    points = np.array(UsdGeom.Mesh(tyre).GetPointsAttr().Get(), float)
    matrix = np.array(cache.GetLocalToWorldTransform(tyre)).T
    expected = 0.01 * (points @ matrix[:3, :3].T + matrix[:3, 3])  # centimetres, Y up already
    T_wn, name = scene.graph[next(node for node in scene.graph.nodes_geometry if "wheel_rl_tyre" in node)]
    mesh = scene.geometry[name]
    found = mesh.vertices @ T_wn[:3, :3].T + T_wn[:3, 3]
    for each, other in ((found, expected), (expected, found)):
        assert max(np.linalg.norm(other - point, axis=1).min() for point in each[::7]) < 1e-5
    normals = mesh.vertex_normals
    assert np.abs(np.linalg.norm(normals, axis=1) - 1).max() < 1e-3
    paint = Read(path).tree["materials"]
    assert all(set(each["pbrMetallicRoughness"]) >= {"baseColorFactor"} for each in paint)
    assert any(each.get("alphaMode") == "BLEND" for each in paint), "the windscreen"


def test_colours_textures_and_rest(tmp_path, toys, make_take):
    """The linear colour of the toy's paint; a toy at rest has no animation."""
    take = make_take(toys.clip(toys.asset(tmp_path / "in" / "toy.usda"), still=True))
    folder = take.export(tmp_path / "out", to=("glb",))
    assert {path.name for path in folder.iterdir()} == {"shot.glb", "report.json"}
    read = Read(folder / "shot.glb")
    colours = [each["pbrMetallicRoughness"]["baseColorFactor"] for each in read.tree["materials"]]
    assert pytest.approx([0.8, 0.1, 0.05, 1.0], abs=1e-6) in colours
    assert "animations" not in read.tree


def test_a_changing_lens_is_named(tmp_path, toys, make_take):
    take = make_take(toys.clip(toys.asset(tmp_path / "in" / "toy.usda")))
    lens = np.linspace(35, 50, len(take.cameras[0].frames))
    take = replace(take, cameras=(replace(take.cameras[0], lens_mm=lens),))
    with pytest.warns(UserWarning, match="chase: glTF keeps only its first lens"):
        take.export(tmp_path / "out", to=("glb",))


@pytest.mark.skipif(not Path(PYTHON).name.startswith("python"), reason="needs Blender's module bpy: run make blender")
def test_blender_reads_the_same_motion(fast):
    clip, _, path = fast
    program = f"""
import bpy, json
bpy.ops.wm.read_factory_settings(use_empty=True)
bpy.context.scene.render.fps = 24
bpy.ops.import_scene.gltf(filepath={str(path)!r})
found = []
for k in range(24 * 8 + 1):
    bpy.context.scene.frame_set(k // 8, subframe=k % 8 / 8)
    graph = bpy.context.evaluated_depsgraph_get()
    matrix = bpy.data.objects["wheel_rr"].evaluated_get(graph).matrix_world
    found.append([list(row) for row in matrix])
print("SAYS" + json.dumps(found))
"""
    answer = subprocess.run([PYTHON, "-c", program], capture_output=True, text=True)
    lines = [line for line in answer.stdout.splitlines() if line.startswith("SAYS")]
    assert lines, answer.stdout[-2000:] + answer.stderr[-2000:]
    found = np.array(json.loads(lines[0][4:]))
    at = clip.at(np.arange(24 * 8 + 1) / 192)
    places = at.matrices()[:, :3, :3] @ (-1.3, -0.77, 0.32) + at.positions
    off = np.linalg.norm(found[:, :3, 3] - places, axis=1)
    assert min(off.max(), np.linalg.norm(found[8:, :3, 3] - places[:-8], axis=1).max()) < 4e-3


def test_tyre_marks_show_from_the_frame_on_which_they_are_made(tmp_path):
    from tests.exporters.test_tyre_marks import LEVEL, TYRE, braked, exported
    from vehsim.delivery.take import Take
    from vehsim.exporters.usd.scenery.tyre_marks import ABOVE, LOOKS

    clip = braked()
    exported(tmp_path, clip)
    frames = (1001, int(clip.end_frame))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        (path,) = write_glb(Take("shot", {"car": clip}, LEVEL, (), Fraction(24), frames), tmp_path, lambda *_: None)
    read = Read(path)
    at = clip.at((np.arange(1001, frames[1] + 1) - clip.start_frame) / 24)
    hubs = {y: at.positions[:, 0] + x for x in (1.3, -1.3) for y in (0.77, -0.77)}
    starts = [clip.positions[0, 0] + x for x in (1.3, -1.3)]
    names = [name for name in read.index if name.startswith("tyre_marks_")]
    assert len(names) > 20
    (root,) = {read.parent[read.index[name]] for name in names}
    assert np.array_equal(read.local(root, [0.0])[0, :3, :3], Y_UP), "marks are Z up, below the node that turns them"
    for k, frame in enumerate(range(1001, frames[1] + 1)):
        shown = [name for name in names if read.shown(name, (frame - 1001) / 24)]
        assert shown == [name for name in names if int(name.rpartition("_")[2]) <= frame]
        if not shown or at.twists[k, 1] < 1.0:  # in its last centimetres a tyre hardly slides
            continue
        corners = np.concatenate([read.triangles(name)[0] for name in shown])
        assert np.abs(corners[..., 2] - ABOVE).max() < 1e-6
        for y, x in hubs.items():
            own = corners[np.abs(corners[:, 0, 1] - y) < 0.2]
            ends = own[..., 0].min(), own[..., 0].max()
            assert ends == pytest.approx((min(starts), x[k] + 2.6), abs=0.02), "from its start up to the tyre"
            normal = np.cross(own[:, 1] - own[:, 0], own[:, 2] - own[:, 0])
            assert normal[:, 2].min() > 0, "its front is above"
            ways = [(start, start + x[k] - x[0]) for start in starts]  # of the rear and of the front tyre
            assert normal[:, 2].sum() / 2 == pytest.approx(TYRE * sum(b - a for a, b in ways), rel=0.02)
    colours = np.concatenate([read.triangles(name)[1] for name in names])
    look = LOOKS["asphalt"]
    assert np.abs(colours[..., :3] - look.colour).max() < 1e-7
    assert colours[..., 3].min() == 0 and colours[..., 3].max() == pytest.approx(look.opacity, rel=1e-5)


PAGE = """<!doctype html><meta charset="utf-8"><body><script>{three}</script><script>
const content = Uint8Array.from(atob("{glb}"), c => c.charCodeAt(0)).buffer;
new GLTF.GLTFLoader().parse(content, "", file => {{
  const mixer = new GLTF.AnimationMixer(file.scene);
  mixer.clipAction(file.animations[0]).play();
  window.found = {{ clips: file.animations.length, drawn: 0 }};
  file.scene.traverse(each => {{ 
    if (each.isMesh) found.drawn += (each.geometry.index ?? each.geometry.attributes.position).count / 3;
  }});
  for (const seconds of {seconds}) {{
    mixer.setTime(seconds);
    file.scene.updateMatrixWorld(true);
    for (const name of {names})
      (found[name] ??= []).push(file.scene.getObjectByName(name).matrixWorld.toArray());
  }}
  window.done = true;
}}, error => {{ window.found = {{ error: String(error) }}; window.done = true; }});
</script>"""


def played(path, seconds, names, folder):
    """What three.js' own loader and mixer show of a GLB: its number of ``clips`` and of triangles ``drawn``, and world
    matrices (4, 4), by columns, of each name at ``seconds`` (n,)."""
    pytest.importorskip("websockets", reason='needs the extra: pip install "vehsim[live]"')
    browser()
    page, three = folder / "page.html", Path(__file__).with_name("gltf.min.js").read_text(encoding="utf-8")
    glb = base64.b64encode(path.read_bytes()).decode()
    text = PAGE.format(three=three, glb=glb, seconds=json.dumps(list(seconds)), names=json.dumps(list(names)))
    page.write_text(text, encoding="utf-8")

    async def play():
        async with page_at(page.as_uri(), folder / "profile") as opened:
            await opened.until("window.done === true")
            return await opened.value("window.found")

    found = asyncio.run(play())
    assert found.get("error") is None and found["clips"] == 1
    return found


def test_a_browser_shows_tyre_marks_from_their_frames(tmp_path):
    """Also an eighth of a frame before each frame, when its marks are not there yet."""
    from tests.exporters.test_tyre_marks import LEVEL, braked, exported
    from vehsim.delivery.take import Take

    clip = braked()
    exported(tmp_path, clip)
    frames = (1001, int(clip.end_frame))
    (path,) = write_glb(Take("shot", {"car": clip}, LEVEL, (), Fraction(24), frames), tmp_path, lambda *_: None)
    names = [name for name in Read(path).index if name.startswith("tyre_marks_")]
    times = np.sort(np.concatenate([np.arange(frames[1] - 1001), np.arange(frames[1] - 1001) + 0.875]))
    found = played(path, ((times + 1e-3) / 24).tolist(), names, tmp_path)
    for name in names:
        sizes = np.cbrt(np.linalg.det(np.array(found[name]).reshape(-1, 4, 4)[:, :3, :3]))
        assert np.allclose(sizes, 1001 + times >= int(name.rpartition("_")[2]), atol=1e-6), name
    assert len(names) > 20


def test_a_browser_plays_the_motion_of_the_stage(fast, tmp_path):
    """Against matrices of the composed stage, on frames and eighths of frames."""
    _, _, path = fast
    frames = np.array([0.0, 3.0, 7.125, 12.0, 12.5, 18.875, 23.0])
    prims = {
        "it": "/shot/vehicles/it",
        "wheel_rr": "/shot/vehicles/it/wheel_rr",
        "wheel_fl": "/shot/vehicles/it/steer_fl/wheel_fl",
        "chase": "/shot/cameras/chase",
    }
    found = played(path, (frames / 24).tolist(), prims, tmp_path)
    stage = Usd.Stage.Open(str(path.with_name("shot.usda")))
    for name, prim in prims.items():
        for frame, matrix in zip(frames, found[name], strict=True):
            read = np.array(matrix).reshape(4, 4).T
            world = np.array(UsdGeom.XformCache(1001 + frame).GetLocalToWorldTransform(stage.GetPrimAtPath(prim))).T
            axes = world[:3, :3] / np.linalg.norm(world[:3, :3], axis=0)  # centimetres, Y up
            assert np.abs(read[:3, 3] - 0.01 * world[:3, 3]).max() < 5e-4, (name, frame)
            assert np.abs(read[:3, :3] - axes).max() < 1e-3, (name, frame)
    drawn = [prim for prim in stage.Traverse() if prim.IsA(UsdGeom.Mesh)]
    drawn = [mesh for mesh in drawn if UsdGeom.Imageable(mesh).ComputePurpose() in ("default", "render")]
    counts = [np.array(UsdGeom.Mesh(mesh).GetFaceVertexCountsAttr().Get()) - 2 for mesh in drawn]
    assert found["drawn"] == sum(int(each.sum()) for each in counts), "each triangle once, no proxies"
