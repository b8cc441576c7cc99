"""Flow and normals of every pixel against rays that are cast here into the toy's boxes, moved by the clip's poses."""

from __future__ import annotations

import numpy as np
import pytest
from PIL import Image
from pxr import Gf, Sdf, Usd, UsdGeom, UsdShade
from scipy.spatial.transform import Rotation

from vehsim.errors import InputError
from vehsim.exporters.pictures.frames import render_stage
from vehsim.exporters.pictures.passes import prim_colours
from vehsim.exporters.usd.exporter import write_usd
from vehsim.rig.rig import Drive

OpenEXR = pytest.importorskip("OpenEXR")
SIZE, FRAME = (240, 136), 1012
BOXES = {"body/body": ((2.0, 1.0, 0.6), (0.0, 0.0, 0.5)), "rotor/rotor": ((2.4, 0.2, 0.05), (0.2, 0.0, 1.2))}


def planes(path):
    with OpenEXR.File(str(path), separate_channels=True) as file:
        return {name: np.array(channel.pixels) for name, channel in file.channels().items()}


@pytest.fixture(scope="module")
def rendered(tmp_path_factory, toys):
    from fractions import Fraction

    from vehsim.cameras.camera import CameraRig
    from vehsim.cameras.framing import solve_camera
    from vehsim.delivery.take import RenderSettings, Take
    from vehsim.world.terrain.terrain import Terrain
    from vehsim.world.world import World

    folder = tmp_path_factory.mktemp("flow")
    clip = toys.clip(toys.asset(folder / "in" / "toy.usda"))
    world = World(Terrain("flat", np.zeros((9, 9)), (-80.0, -80.0), (20.0, 20.0)))
    camera = solve_camera(CameraRig(fill=0.6), {"toy0": clip}, world, toys.frames, 16 / 9)
    take = Take("shot", {"toy0": clip}, world, (camera,), Fraction(24), toys.frames, RenderSettings(size=SIZE))
    write_usd(take, folder, toys.silent)
    kinds = ["flow", "normals", "segmentation"]
    render_stage(folder / "shot.usda", folder / "out", frames=[1001, FRAME], size=SIZE, passes=kinds)
    return clip, camera, folder / "out" / "chase"


def poses(clip, camera, frame):
    """Poses (4, 4) of both boxes and the camera."""
    k = frame - 1001
    root, found = clip.matrices()[k], {}
    for part, (_, centre) in BOXES.items():
        own = np.eye(4)
        own[:3, 3] = centre
        if part.startswith("rotor"):
            own[:3, :3] = Rotation.from_euler("z", clip.channels["rotor"][k]).as_matrix()
        found[part] = root @ own
    view = np.eye(4)
    view[:3, :3] = Rotation.from_quat(camera.orientations[k], scalar_first=True).as_matrix()
    view[:3, 3] = camera.positions[k]
    return found, view


def pixels(points, view, camera):
    """Pixels (n, 2) of world points (n, 3): u to the right, v up."""
    own = (points - view[:3, 3]) @ view[:3, :3]
    return own[:, :2] / -own[:, 2:] * SIZE[0] * camera.lens_mm / camera.aperture_mm[0]


def hits(view, pose, half, camera, rows, columns):
    """The first points (n, 3) of rays on a box, world axes, and their outward normals."""
    scale = camera.aperture_mm[0] / camera.lens_mm / SIZE[0]
    own = np.stack([(columns + 0.5 - SIZE[0] / 2) * scale, (SIZE[1] / 2 - rows - 0.5) * scale, -np.ones(len(rows))], 1)
    rays = own @ view[:3, :3].T @ pose[:3, :3]
    eye = (view[:3, 3] - pose[:3, 3]) @ pose[:3, :3]
    enter = (-np.sign(rays) * half - eye) / rays
    axis = enter.argmax(axis=1)
    along = enter[np.arange(len(rows)), axis]
    normals = np.zeros((len(rows), 3))
    normals[np.arange(len(rows)), axis] = -np.sign(rays[np.arange(len(rows)), axis])
    return (eye + along[:, None] * rays) @ pose[:3, :3].T + pose[:3, 3], normals @ pose[:3, :3].T


def test_flow_is_exact_to_the_poses(rendered):
    """The rotor turns 95 degrees per frame."""
    clip, camera, folder = rendered
    flow = planes(folder / "flow" / f"shot.chase.flow.{FRAME}.exr")
    normal = planes(folder / "normals" / f"shot.chase.normals.{FRAME}.exr")
    with Image.open(folder / "segmentation" / f"shot.chase.segmentation.{FRAME}.png") as image:
        colours = np.asarray(image)
    here, view = poses(clip, camera, FRAME)
    for part, (half, _) in BOXES.items():
        colour = prim_colours([f"/shot/vehicles/toy0/{part}"])[0]
        rows, columns = np.nonzero((colours == colour).all(axis=2))
        points, normals = hits(view, here[part], np.array(half), camera, rows, columns)
        assert len(rows) > 60 and np.isfinite(points).all()
        for name, step in (("forward", 1), ("backward", -1)):
            there, other = poses(clip, camera, FRAME + step)
            moved = (points - here[part][:3, 3]) @ here[part][:3, :3] @ there[part][:3, :3].T + there[part][:3, 3]
            expected = pixels(moved, other, camera) - pixels(points, view, camera)
            found = np.stack([flow[f"{name}.{axis}"][rows, columns] for axis in "uv"], axis=1)
            off = np.linalg.norm(found - expected, axis=1)
            assert np.linalg.norm(expected, axis=1).max() > 2 and np.mean(off < 5e-5) > 0.99, (part, name, off.max())
        found = np.stack([normal[f"N.{axis}"][rows, columns] for axis in "XYZ"], axis=1)
        assert np.mean(np.abs(found - normals).max(axis=1) < 1e-3) > 0.97


def test_the_ground_moves_with_the_camera_and_the_sky_with_its_rotation(rendered):
    clip, camera, folder = rendered
    flow = planes(folder / "flow" / f"shot.chase.flow.{FRAME}.exr")
    with Image.open(folder / "segmentation" / f"shot.chase.segmentation.{FRAME}.png") as image:
        colours = np.asarray(image).astype(int).sum(axis=2)
    _, view = poses(clip, camera, FRAME)
    _, other = poses(clip, camera, FRAME + 1)
    rows, columns = np.nonzero(np.ones(SIZE[::-1], bool))
    scale = camera.aperture_mm[0] / camera.lens_mm / SIZE[0]
    own = np.stack([(columns + 0.5 - SIZE[0] / 2) * scale, (SIZE[1] / 2 - rows - 0.5) * scale, -np.ones(len(rows))], 1)
    rays = own @ view[:3, :3].T
    found = np.stack([flow["forward.u"], flow["forward.v"]], axis=-1).reshape(-1, 2)
    at = np.zeros(3) + other[:3, 3]
    sky = (colours == 0).ravel()
    expected = pixels(at + rays[sky], other, camera) - pixels(view[:3, 3] + rays[sky], view, camera)
    assert sky.sum() > 100 and np.abs(found[sky] - expected).max() < 0.01
    below = rays[:, 2] < -0.05
    points = view[:3, 3] - rays[below] * view[2, 3] / rays[below, 2:]
    expected = pixels(points, other, camera) - pixels(points, view, camera)
    assert np.mean(np.linalg.norm(found[below] - expected, axis=1) < 0.05) > 0.5, "all pixels but the toy's"


def over(path, frames):
    """A new stage over the shot's beside it."""
    stage = Usd.Stage.CreateNew(str(path))
    stage.GetRootLayer().subLayerPaths = ["shot.usda"]
    stage.SetStartTimeCode(frames[0])
    stage.SetEndTimeCode(frames[1])
    stage.SetFramesPerSecond(24)
    stage.SetTimeCodesPerSecond(24)
    UsdGeom.SetStageUpAxis(stage, "Z")
    UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    stage.SetDefaultPrim(stage.GetPrimAtPath("/shot"))
    return stage


def test_glass_has_the_flow_of_its_part(tmp_path, toys, make_take):
    """A body of glass: its own flow in the second layer, that of what is behind in the first."""
    take = make_take(clip := toys.clip(toys.asset(tmp_path / "in" / "toy.usda")))
    write_usd(take, tmp_path, toys.silent)
    stage = over(tmp_path / "glass.usda", toys.frames)
    material = UsdShade.Material.Define(stage, "/shot/glass")
    surface = UsdShade.Shader.Define(stage, "/shot/glass/surface")
    surface.CreateIdAttr("UsdPreviewSurface")
    surface.CreateInput("opacity", Sdf.ValueTypeNames.Float).Set(0.3)
    material.CreateSurfaceOutput().ConnectToSource(surface.CreateOutput("surface", Sdf.ValueTypeNames.Token))
    body = stage.GetPrimAtPath("/shot/vehicles/toy0/body/body")
    UsdShade.MaterialBindingAPI.Apply(body).Bind(material)
    stage.Save()
    render_stage(tmp_path / "glass.usda", tmp_path / "out", frames=[FRAME], size=SIZE, passes=["flow"])
    camera, part = take.cameras[0], "body/body"
    flow = planes(tmp_path / "out" / camera.name / "flow" / f"glass.{camera.name}.flow.{FRAME}.exr")
    here, view = poses(clip, camera, FRAME)
    for name, step in (("forward", 1), ("backward", -1)):
        found = np.stack([flow[f"translucent.{name}.{axis}"] for axis in "uv"], axis=-1)
        behind = np.stack([flow[f"{name}.{axis}"] for axis in "uv"], axis=-1)
        rows, columns = np.nonzero(np.isfinite(found[..., 0]))
        points, _ = hits(view, here[part], np.array(BOXES[part][0]), camera, rows, columns)
        there, other = poses(clip, camera, FRAME + step)
        moved = (points - here[part][:3, 3]) @ here[part][:3, :3] @ there[part][:3, :3].T + there[part][:3, 3]
        expected = pixels(moved, other, camera) - pixels(points, view, camera)
        off = np.linalg.norm(found[rows, columns] - expected, axis=1)
        assert len(rows) > 200 and np.linalg.norm(expected, axis=1).max() > 2
        assert np.mean(off < 1e-3) > 0.99, (name, off.max())
        assert np.isfinite(behind).all() and np.abs(behind - found)[rows, columns].max() > 0.5


def test_translucent_discs_and_spray_have_flow_of_their_own(tmp_path, toys, make_take):
    """Through them, the first layer shows what is behind. The expected flow is that of points where rays meet the
    disc's plane, moved by the rotor's pose, and of drops moved by their velocities."""
    rotor = {"rotor": Drive("rotor", "rotateZ", disc=True)}
    clip = toys.clip(toys.asset(tmp_path / "in" / "toy.usda"), drives=rotor)
    take = make_take(clip)
    write_usd(take, tmp_path, toys.silent)
    stage = over(tmp_path / "disc.usda", toys.frames)
    stage.GetPrimAtPath("/shot/vehicles/toy0").GetVariantSets().SetSelection("rotor", "disc")
    camera = take.cameras[0]
    here, view = poses(clip, camera, FRAME)
    drop = view[:3, 3] + view[:3, :3] @ [1.5, 1.0, -8.0]
    speed = np.array([3.0, -2.0, 4.0])
    points = UsdGeom.Points.Define(stage, "/shot/spray")
    points.CreatePointsAttr([Gf.Vec3f(*drop.tolist())])
    points.CreateVelocitiesAttr([Gf.Vec3f(*speed.tolist())])
    points.CreateWidthsAttr([0.1])
    stage.Save()
    render_stage(tmp_path / "disc.usda", tmp_path / "out", frames=[FRAME], size=SIZE, passes=["flow"])
    flow = planes(tmp_path / "out" / camera.name / "flow" / f"disc.{camera.name}.flow.{FRAME}.exr")
    scale = camera.aperture_mm[0] / camera.lens_mm / SIZE[0]
    for name, step in (("forward", 1), ("backward", -1)):
        found = np.stack([flow[f"translucent.{name}.{axis}"] for axis in "uv"], axis=-1)
        behind = np.stack([flow[f"{name}.{axis}"] for axis in "uv"], axis=-1)
        there, other = poses(clip, camera, FRAME + step)
        u, v = pixels(drop[None], view, camera)[0]
        expected = pixels(drop[None] + speed * step / 24, other, camera)[0] - (u, v)
        row, column = int(SIZE[1] / 2 - v), int(SIZE[0] / 2 + u)
        assert np.abs(found[row, column] - expected).max() < 0.01
        seen = np.isfinite(found[..., 0])
        seen[row - 8 : row + 9, column - 8 : column + 9] = False
        rows, columns = np.nonzero(seen)
        own = np.stack([(columns + 0.5 - SIZE[0] / 2) * scale, (SIZE[1] / 2 - rows - 0.5) * scale], axis=1)
        rays = np.column_stack([own, -np.ones(len(own))]) @ view[:3, :3].T
        part = here["rotor/rotor"]
        eye, turned = (view[:3, 3] - part[:3, 3]) @ part[:3, :3], rays @ part[:3, :3]
        across = eye - turned * (eye[2] / turned[:, 2])[:, None]
        radius = np.linalg.norm(across[:, :2], axis=1)
        assert len(rows) > 200 and radius.min() > 0.1 * 2.408 * 0.95 and radius.max() < 2.408 * 1.05
        rigid = there["rotor/rotor"]
        moved = pixels(across @ rigid[:3, :3].T + rigid[:3, 3], other, camera)
        at = pixels(across @ part[:3, :3].T + part[:3, 3], view, camera)
        off = np.linalg.norm(found[rows, columns] - (moved - at), axis=1)
        assert np.mean(off < 0.05) > 0.99 and np.linalg.norm(moved - at, axis=1).max() > 20, off.max()
        assert np.isfinite(behind).all() and np.abs(behind - found)[rows, columns].max() > 5


def test_nothing_moves_before_the_first_frame(rendered):
    flow = planes(rendered[2] / "flow" / "shot.chase.flow.1001.exr")
    assert not flow["backward.u"].any() and np.abs(flow["forward.u"]).max() > 1


def test_without_openexr_the_remedy_is_named(rendered, tmp_path, monkeypatch):
    import sys

    monkeypatch.setitem(sys.modules, "OpenEXR", None)
    with pytest.raises(InputError, match=r"vehsim\[exr\]"):
        render_stage(rendered[2].parents[1] / "shot.usda", tmp_path, frames=[1001], size=SIZE, passes=["flow"])
