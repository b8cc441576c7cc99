"""Pictures show the stage: the camera equals USD's to the pixel, with the stage's light and materials, without
guides."""

from __future__ import annotations

import subprocess
import sys
from operator import methodcaller

import numpy as np
import pytest

from vehsim.errors import InputError
from vehsim.exporters.pictures.frames import render_stage
from vehsim.exporters.pictures.render import (
    SHADOW_REACH,
    StageRenderer,
    shadow_reach,
    spans_of_casters,
)
from vehsim.exporters.usd.metadata import author_points
from vehsim.exporters.usd.scenery.finishes import FINISHES, coordinates
from vehsim.exporters.usd.scenery.finishes import picture as tile_of
from vehsim.exporters.usd.stage import StageReader
from vehsim.shot import Shot
from vehsim.world.world import World

SIZE = (320, 180)
AXES = np.array([1.0, 0, 0]), np.array([0, 0, 1.0])


@pytest.fixture
def new_stage(tmp_path):
    """A stage on disk with a camera 10 m back from the origin, looking along +Y; add to it and save."""
    from pxr import Gf, Usd, UsdGeom

    stage = Usd.Stage.CreateNew(str(tmp_path / "plain.usda"))
    UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    UsdGeom.SetStageUpAxis(stage, "Z")
    stage.SetStartTimeCode(1)
    stage.SetEndTimeCode(3)
    stage.SetFramesPerSecond(24)
    stage.SetTimeCodesPerSecond(24)
    stage.SetDefaultPrim(UsdGeom.Xform.Define(stage, "/top").GetPrim())
    camera = UsdGeom.Camera.Define(stage, "/top/main")
    camera.CreateFocalLengthAttr(0.35)
    camera.CreateHorizontalApertureAttr(0.36)
    camera.CreateVerticalApertureAttr(0.36 * SIZE[1] / SIZE[0])
    camera.CreateClippingRangeAttr(Gf.Vec2f(0.1, 500))
    camera.AddTranslateOp().Set(Gf.Vec3d(0, -10, 0))
    camera.AddRotateXOp().Set(90.0)
    return stage


def quad(stage, path, centre, half, colour, texture=None):
    """A square facing -Y, its lower left corner st (0, 0)."""
    from pxr import Gf, Sdf, UsdGeom, UsdShade

    x, y, z = centre
    mesh = UsdGeom.Mesh.Define(stage, path)
    mesh.CreateSubdivisionSchemeAttr("none")
    points = [(x + i * half, y, z + j * half) for i, j in ((-1, -1), (1, -1), (1, 1), (-1, 1))]
    mesh.CreatePointsAttr([Gf.Vec3f(*point) for point in points])
    mesh.CreateFaceVertexCountsAttr([4])
    mesh.CreateFaceVertexIndicesAttr([0, 1, 2, 3])
    mesh.CreateExtentAttr([Gf.Vec3f(*points[0]), Gf.Vec3f(*points[2])])
    material = UsdShade.Material.Define(stage, f"{path}_material")
    shader = UsdShade.Shader.Define(stage, f"{path}_material/surface")
    shader.CreateIdAttr("UsdPreviewSurface")
    emissive = shader.CreateInput("emissiveColor", Sdf.ValueTypeNames.Color3f)
    emissive.Set(Gf.Vec3f(1.0))
    diffuse = shader.CreateInput("diffuseColor", Sdf.ValueTypeNames.Color3f)
    diffuse.Set(Gf.Vec3f(*colour))
    if texture:
        st = UsdGeom.PrimvarsAPI(mesh).CreatePrimvar("st", Sdf.ValueTypeNames.TexCoord2fArray, "vertex")
        st.Set([(0, 0), (1, 0), (1, 1), (0, 1)])
        image = UsdShade.Shader.Define(stage, f"{path}_material/image")
        image.CreateIdAttr("UsdUVTexture")
        image.CreateInput("file", Sdf.ValueTypeNames.Asset).Set(texture)
        diffuse.ConnectToSource(image.CreateOutput("rgb", Sdf.ValueTypeNames.Float3))
    material.CreateSurfaceOutput().ConnectToSource(shader.CreateOutput("surface", Sdf.ValueTypeNames.Token))
    UsdShade.MaterialBindingAPI.Apply(mesh.GetPrim()).Bind(material)
    return mesh


def picture(stage, frame=1):
    stage.GetRootLayer().Save()
    with StageRenderer(StageReader(stage.GetRootLayer().realPath), SIZE) as renderer:
        return renderer.render("main", frame).astype(float)


def centroid(mask):
    rows, columns = np.nonzero(mask)
    return columns.mean() + 0.5, rows.mean() + 0.5


@pytest.mark.parametrize("place", [(0.0, 0.0, 0.0), (3.0, 2.0, -1.5), (-4.0, 5.0, 2.0)])
@pytest.mark.parametrize("offset", [(0.0, 0.0), (0.05, -0.02)])
def test_a_point_is_drawn_at_the_pixel_that_usd_computes(new_stage, place, offset):
    """Also if the film back is shifted."""
    from pxr import Gf, UsdGeom

    camera = UsdGeom.Camera(new_stage.GetPrimAtPath("/top/main"))
    camera.CreateHorizontalApertureOffsetAttr(offset[0])
    camera.CreateVerticalApertureOffsetAttr(offset[1])
    quad(new_stage, "/top/spot", place, 0.3, (1, 0, 0))
    image = picture(new_stage)
    red = (image[..., 0] > 120) & (image[..., 1] < 60)
    frustum = UsdGeom.Camera(new_stage.GetPrimAtPath("/top/main")).GetCamera(1).frustum
    ndc = (frustum.ComputeViewMatrix() * frustum.ComputeProjectionMatrix()).Transform(Gf.Vec3d(*place))
    expected = (ndc[0] + 1) / 2 * SIZE[0], (1 - ndc[1]) / 2 * SIZE[1]
    assert np.allclose(centroid(red), expected, atol=0.5)


def test_motion_in_the_stage_is_visible_in_the_picture(new_stage):
    from pxr import Gf, UsdGeom

    mover = UsdGeom.Xform.Define(new_stage, "/top/mover")
    op = mover.AddTranslateOp()
    mover.AddScaleOp().Set(Gf.Vec3f(2.0))  # scale in the moving prim itself is baked, not lost
    op.Set(Gf.Vec3d(-3, 0, 0), 1)
    op.Set(Gf.Vec3d(3, 0, 0), 3)
    quad(new_stage, "/top/mover/spot", (0, 0, 0), 0.2, (1, 0, 0))
    places = []
    for frame in (1, 2, 3):
        image = picture(new_stage, frame)
        red = (image[..., 0] > 120) & (image[..., 1] < 60)
        places.append(centroid(red)[0])
        assert red.sum() == pytest.approx((0.8 / 10 * 35 / 36 * SIZE[0]) ** 2, rel=0.12)
    pixels = 3 / 10 * 35 / 36 * SIZE[0]
    assert np.allclose(places, [SIZE[0] / 2 - pixels, SIZE[0] / 2, SIZE[0] / 2 + pixels], atol=0.5)


def test_a_texture_stands_upright(new_stage, tmp_path):
    """USD counts v from the bottom of an image, OpenGL from its first row."""
    from PIL import Image

    corners = np.zeros((64, 64, 3), np.uint8)
    corners[:32, :32] = (255, 0, 0)  # top left
    corners[32:, 32:] = (0, 0, 255)  # bottom right
    Image.fromarray(corners).save(tmp_path / "corners.png")
    quad(new_stage, "/top/card", (0, 0, 0), 2.0, (1, 1, 1), "./corners.png")
    image = picture(new_stage)
    middle_x, middle_y = SIZE[0] // 2, SIZE[1] // 2
    assert image[middle_y - 25, middle_x - 25].argmax() == 0
    assert image[middle_y + 25, middle_x + 25].argmax() == 2
    assert image[middle_y - 25, middle_x + 25].max() < 60


def test_guides_proxies_and_hidden_prims_are_not_drawn(new_stage):
    from pxr import UsdGeom

    quad(new_stage, "/top/far", (40, 40, 0), 0.1, (0.5, 0.5, 0.5))
    empty = picture(new_stage)
    for purpose in ("guide", "proxy"):
        quad(new_stage, f"/top/{purpose}", (0, 0, 0), 1.0, (1, 0, 0)).CreatePurposeAttr(purpose)
    hidden = quad(new_stage, "/top/hidden", (1, 0, 0), 1.0, (1, 0, 0))
    UsdGeom.Imageable(hidden).MakeInvisible()
    assert (picture(new_stage) == empty).all()


def test_the_sun_shines_from_the_stages_direction(new_stage):
    """Two slopes facing west and east; the low sun in the east (+X) lights the one facing it."""
    from pxr import Gf, UsdGeom, UsdLux

    for x in (-2.0, 2.0):
        slope = UsdGeom.Xform.Define(new_stage, f"/top/slope{'we'[x > 0]}")
        slope.AddTranslateOp().Set(Gf.Vec3d(x, 0, 0))
        slope.AddRotateZOp().Set(50.0 if x > 0 else -50.0)
        card = quad(new_stage, f"{slope.GetPath()}/card", (0, 0, 0), 1.0, (0.5, 0.5, 0.5))
        card.GetPrim().GetStage().GetPrimAtPath(f"{card.GetPath()}_material/surface").GetAttribute(
            "inputs:emissiveColor"
        ).Set(Gf.Vec3f(0))
    sun = UsdLux.DistantLight.Define(new_stage, "/top/sun")
    sun.CreateIntensityAttr(3.0)
    sun.AddRotateXYZOp().Set(Gf.Vec3f(70.0, 0.0, 90.0))  # shines along -X and down by 20 degrees
    image = picture(new_stage).mean(axis=2)
    offset = round(2 / 10 * 35 / 36 * SIZE[0])
    west, east = (image[SIZE[1] // 2, SIZE[0] // 2 + side * offset] for side in (-1, 1))
    assert east > 1.4 * west


def test_the_sky_is_brightest_at_the_stages_glow(new_stage, tmp_path):
    from pxr import UsdLux

    from vehsim.exporters.usd.scenery.lighting import write_sky

    write_sky(tmp_path / "sky.png", azimuth=90.0, elevation=10.0)
    dome = UsdLux.DomeLight.Define(new_stage, "/top/sky")
    dome.CreateTextureFileAttr("./sky.png")
    dome.AddRotateXOp().Set(90.0)
    quad(new_stage, "/top/far", (40, 40, 0), 0.1, (0.5, 0.5, 0.5))
    image = picture(new_stage).sum(axis=2)
    # The camera looks along +Y, where the glow is; 10 degrees up is row 90 - tan(10) * 35 / 36 * 320.
    row = round(SIZE[1] / 2 - np.tan(np.radians(10)) * 35 / 36 * SIZE[0])
    assert image[row, SIZE[0] // 2] > image[row, 5] + 20
    assert image[row, SIZE[0] // 2] > image[5, SIZE[0] // 2] + 20
    turned = new_stage.GetPrimAtPath("/top/main")
    turned.GetAttribute("xformOpOrder").Set(["xformOp:translate", "xformOp:rotateZ", "xformOp:rotateX"])
    turned.CreateAttribute("xformOp:rotateZ", turned.GetAttribute("xformOp:rotateX").GetTypeName()).Set(30.0)
    image = picture(new_stage).sum(axis=2)  # rotated left by 30 degrees: the glow is on the right now
    assert image[row, -5:].mean() > image[row, :5].mean() + 20


def test_frames_are_numbered_by_camera_and_the_same_every_time(tmp_path, toys, make_take):
    from vehsim.exporters.usd.exporter import write_usd

    clip = toys.clip(toys.asset(tmp_path / "in" / "toy.usda"))
    write_usd(make_take(clip), tmp_path, toys.silent)
    seen = []
    a = render_stage(
        tmp_path / "shot.usda", tmp_path / "a", frames=[1001, 1010], size=(160, 90), progress=lambda *x: seen.append(x)
    )
    b = render_stage(tmp_path / "shot.usda", tmp_path / "b", camera="chase", frames=[1001, 1010], size=(160, 90))
    names = [str(path.relative_to(tmp_path / "a")) for path in a]
    assert names == ["chase/shot.chase.1001.png", "chase/shot.chase.1010.png"]
    assert [x.read_bytes() for x in a] == [x.read_bytes() for x in b]
    assert a[0].read_bytes() != a[1].read_bytes()
    assert [done for _, done in seen] == [0.0, 0.5]


def test_a_take_in_empty_space_is_drawn(tmp_path, toys, make_take):
    from vehsim.exporters.usd.exporter import write_usd

    clip = toys.clip(toys.asset(tmp_path / "in" / "toy.usda"))
    write_usd(make_take(clip, world=World()), tmp_path, toys.silent)
    with StageRenderer(StageReader(tmp_path / "shot.usda"), SIZE) as renderer:
        image = renderer.render("chase", 1010).astype(float)
    red = (image[..., 0] > 1.6 * image[..., 1]) & (image[..., 0] > 60)
    assert 50 < red.sum() < SIZE[0] * SIZE[1] / 4


def test_haze_in_empty_space_equals_that_of_wide_ground(new_stage):
    """A small red mover 40 m away stays red: there is no edge of the ground to hide."""
    from pxr import Gf, UsdGeom

    mover = UsdGeom.Xform.Define(new_stage, "/top/mover")
    translate = mover.AddTranslateOp()
    translate.Set(Gf.Vec3d(0, 30, 0), 1)
    translate.Set(Gf.Vec3d(0.1, 30, 0), 3)
    quad(new_stage, "/top/mover/quad", (0, 0, 0), 6.0, (0.8, 0.02, 0.02))
    new_stage.GetRootLayer().Save()
    with StageRenderer(StageReader(new_stage.GetRootLayer().realPath), SIZE) as renderer:
        red, green, _ = renderer.render("main", 1)[SIZE[1] // 2, SIZE[0] // 2].astype(float)
    assert red > 2.0 * green


def test_haze_does_not_depend_on_the_size_of_faces(new_stage):
    """Corners far behind the camera counted as far ahead: ground of two large faces was in haze at the camera."""
    from pxr import Gf, UsdGeom, Vt

    mesh, pictures = UsdGeom.Mesh.Define(new_stage, "/top/ground"), []
    mesh.CreateDisplayColorAttr([Gf.Vec3f(0.4, 0.02, 0.02)])
    for pieces in (1, 200):
        line = np.linspace(-1500, 1500, pieces + 1)
        points = np.stack([*np.meshgrid(line, line), np.full((pieces + 1,) * 2, -1.5)], axis=-1).reshape(-1, 3)
        row, column = np.divmod(np.arange(pieces**2), pieces)
        corners = (row * (pieces + 1) + column)[:, None] + [0, 1, pieces + 2, pieces + 1]
        mesh.CreatePointsAttr(Vt.Vec3fArray.FromNumpy(points.astype(np.float32)))
        mesh.CreateFaceVertexCountsAttr([4] * pieces**2)
        mesh.CreateFaceVertexIndicesAttr(Vt.IntArray.FromNumpy(corners.astype(np.int32).ravel()))
        new_stage.GetRootLayer().Save()
        with StageRenderer(StageReader(new_stage.GetRootLayer().realPath), SIZE, samples=1) as renderer:
            pictures.append(renderer.render("main", 1)[SIZE[1] // 2 + 2 :].astype(float))  # below the horizon
    large, small = pictures
    assert np.abs(large - small).mean() < 2
    for picture in pictures:
        far, near = (picture[rows].reshape(-1, 3).mean(axis=0) for rows in (slice(2), slice(-4, None)))
        assert near[0] / near[1] > 1.5 * far[0] / far[1]


def test_a_picture_is_complete_or_absent(new_stage, tmp_path, monkeypatch):
    from PIL import Image

    def half(self, path, **options):
        path.write_bytes(b"half a pict")
        raise OSError("no space left")

    new_stage.GetRootLayer().Save()
    monkeypatch.setattr(Image.Image, "save", half)
    with pytest.raises(OSError, match="no space left"):
        render_stage(tmp_path / "plain.usda", tmp_path / "out", frames=[1], processes=1)
    assert list((tmp_path / "out" / "main").iterdir()) == []


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"camera": "b"}, "choose one of main"),
        ({"size": (100_000, 90)}, "16 to 8192"),
        ({"size": (0, 90)}, "16 to"),
        ({"frames": [3, 4]}, "1 to 3"),
    ],
)
def test_invalid_render_requests_are_refused(new_stage, tmp_path, options, message):
    new_stage.GetRootLayer().Save()
    with pytest.raises(InputError, match=message):
        render_stage(tmp_path / "plain.usda", tmp_path / "out", **options)
    assert not (tmp_path / "out").exists()


def test_a_missing_stage_is_named(tmp_path):
    with pytest.raises(InputError, match=r"gone\.usda: asset: no such file"):
        render_stage(tmp_path / "gone.usda", tmp_path)


def test_glass_and_blur_let_the_sun_through(new_stage):
    """MuJoCo lets a geom of any opacity cast a full shadow: a rotor's blur would darken the whole vehicle."""
    from pxr import Sdf

    quad(new_stage, "/top/solid", (0, 0, 1), 1, (1, 1, 1))
    quad(new_stage, "/top/blur", (3, 0, 1), 1, (1, 1, 1))
    shader = new_stage.GetPrimAtPath("/top/blur_material/surface")
    shader.CreateAttribute("inputs:opacity", Sdf.ValueTypeNames.Float).Set(0.2)
    new_stage.GetRootLayer().Save()
    stage = StageReader(new_stage.GetRootLayer().realPath)
    with StageRenderer(stage, SIZE) as renderer:
        casts = dict(zip((shape.name for shape in stage.shapes), renderer._model.geom_castshadow.tolist(), strict=True))
    assert casts == {"/top/solid": True, "/top/blur": False}


@pytest.mark.parametrize("opacity", [0.3, 0.5, 0.8])
def test_glass_is_visible_against_the_sky_unless_hidden(new_stage, opacity):
    """Translucent surfaces write no depth: a sky drawn wherever there is none would erase rotors' blur. The last one
    casts a shadow."""
    from pxr import Sdf

    plain = picture(new_stage)
    quad(new_stage, "/top/blur", (0, 0, 0), 1.5, (1, 0, 0))
    shader = new_stage.GetPrimAtPath("/top/blur_material/surface")
    shader.CreateAttribute("inputs:opacity", Sdf.ValueTypeNames.Float).Set(opacity)
    glass = picture(new_stage)
    assert np.allclose(centroid(np.abs(glass - plain).max(axis=-1) > 15), (SIZE[0] / 2, SIZE[1] / 2), atol=0.5)
    row, column = SIZE[1] // 2, SIZE[0] // 2
    through = glass[row, column, 1:] / plain[row, column, 1:]
    assert np.allclose(through, 1 - opacity, atol=0.03)  # of red glass, green and blue of the sky
    quad(new_stage, "/top/wall", (0, -2, 0), 1.5, (0, 1, 0))
    assert picture(new_stage)[row, column, 0] < 60


def test_glass_has_its_texture_before_the_sky(new_stage, tmp_path):
    from PIL import Image
    from pxr import Sdf

    Image.fromarray(np.repeat(np.uint8([[[255, 0, 0], [0, 0, 255]]]), 2, axis=0)).save(tmp_path / "halves.png")
    plain = picture(new_stage)
    quad(new_stage, "/top/pane", (0, 0, 0), 2, (1, 1, 1), "halves.png")
    shader = new_stage.GetPrimAtPath("/top/pane_material/surface")
    shader.CreateAttribute("inputs:opacity", Sdf.ValueTypeNames.Float).Set(0.5)
    changed = picture(new_stage) - plain
    row, columns = SIZE[1] // 2, (SIZE[0] // 2 - 30, SIZE[0] // 2 + 30)
    left, right = (changed[row, column] for column in columns)
    assert left[0] > 30 > left[2] + 60 and right[2] > right[0] + 60


def test_frames_are_the_same_from_one_process_or_two(new_stage, tmp_path):
    """Frames rendered in another interpreter are bit for bit those of one process."""
    quad(new_stage, "/top/quad", (0, 0, 0), 1.0, (0.8, 0.2, 0.1))
    new_stage.GetRootLayer().Save()
    path = new_stage.GetRootLayer().realPath
    one = render_stage(path, tmp_path / "one", size=(64, 36), processes=1)
    two = render_stage(path, tmp_path / "two", size=(64, 36), processes=2)
    assert len(one) == 3 and [a.name for a in one] == [b.name for b in two]
    assert all(a.read_bytes() == b.read_bytes() for a, b in zip(one, two, strict=True))


@pytest.mark.parametrize(
    ("serve", "message"),
    [(methodcaller("close"), "ended with code 0"), (methodcaller("send", "ValueError: no"), "ValueError: no")],
    ids=["it ends", "it fails"],
)
def test_a_failing_render_process_is_an_error(new_stage, tmp_path, monkeypatch, serve, message):
    from vehsim.errors import ExportError
    from vehsim.exporters.pictures import frames

    quad(new_stage, "/top/quad", (0, 0, 0), 1.0, (0.8, 0.2, 0.1))
    new_stage.GetRootLayer().Save()
    monkeypatch.setattr(frames, "_serve", serve)
    with pytest.raises(ExportError, match=f"render process failed: .*{message}"):
        frames.render_stage(new_stage.GetRootLayer().realPath, tmp_path / "two", size=(64, 36), processes=2)


def test_a_script_without_a_guard_renders_on_several_processes(new_stage, tmp_path):
    """Processes do not import the calling script, which would render again."""
    quad(new_stage, "/top/quad", (0, 0, 0), 1.0, (0.8, 0.2, 0.1))
    new_stage.GetRootLayer().Save()
    script = tmp_path / "script.py"
    script.write_text(
        "from vehsim.exporters.pictures.frames import render_stage\nprint('once')\n"
        f"render_stage({new_stage.GetRootLayer().realPath!r}, {str(tmp_path / 'out')!r}, size=(64, 36), processes=2)\n"
    )
    answer = subprocess.run([sys.executable, str(script)], capture_output=True, text=True, check=True)
    assert answer.stdout == "once\n" and not answer.stderr
    assert len(list((tmp_path / "out").rglob("*.png"))) == 3


def test_the_horizon_continues_past_the_edge_of_the_ground(tmp_path):
    """There is no brown band between level ground and its horizon; the light does not change."""
    from vehsim.exporters.usd.scenery.lighting import write_sky
    from vehsim.exporters.usd.scenery.shading import light_for
    from vehsim.exporters.usd.stage import Sky

    write_sky(tmp_path / "sky.png", azimuth=40.0, elevation=22.0)
    sky = Sky(np.ones(3), tmp_path / "sky.png", np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]]))
    open_sky, grounded = light_for(None, sky), light_for(None, sky, grounded=True)
    for name in ("sun", "ambient", "sky", "bounce", "haze"):
        assert np.array_equal(getattr(open_sky, name), getattr(grounded, name))
    size = grounded.skybox.shape[1]
    middle, slope = size // 2, size / 2 * np.tan(np.radians(1.0))
    for face in (0, 1, 4, 5):  # those about the horizon; 1 degree above it, 5 below, 30 below
        up, down, deep = (int(middle + degrees * slope) for degrees in (-1, 5, 30))
        before, after = (light.skybox[face, :, middle].astype(int) for light in (open_sky, grounded))
        assert np.array_equal(before[:up], after[:up])
        assert np.abs(after[down] - after[up]).max() <= 12 < 40 < np.abs(before[down] - before[up]).max()
        assert np.abs(before[deep] - after[deep]).max() <= 2


@pytest.mark.parametrize("interpolation", ["faceVarying", "uniform"])
def test_edges_follow_the_meshs_normals(interpolation, new_stage, tmp_path):
    """A box as Blender writes it: eight points, a normal at each corner of each face. MuJoCo 4.0 ignores those."""
    from pxr import Gf, Sdf, Usd, UsdGeom

    corners = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], float) * (0.6, 1.8, 0.5)
    faces = [[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]]
    normals = [(-1, 0, 0), (1, 0, 0), (0, -1, 0), (0, 1, 0), (0, 0, -1), (0, 0, 1)]

    def box(stage, points, indices, interpolation, normals):
        mesh = UsdGeom.Mesh.Define(stage, "/top/box")
        mesh.CreateSubdivisionSchemeAttr("none")
        mesh.CreatePointsAttr([Gf.Vec3f(*point) for point in points])
        mesh.CreateFaceVertexCountsAttr([4] * 6)
        mesh.CreateFaceVertexIndicesAttr(indices)
        mesh.CreateExtentAttr([Gf.Vec3f(-0.6, -1.8, -0.5), Gf.Vec3f(0.6, 1.8, 0.5)])
        mesh.CreateNormalsAttr([Gf.Vec3f(*normal) for normal in normals])
        mesh.SetNormalsInterpolation(interpolation)
        UsdGeom.XformCommonAPI(mesh).SetRotate(Gf.Vec3f(25, 0, 35))
        st = UsdGeom.PrimvarsAPI(mesh).CreatePrimvar("st", Sdf.ValueTypeNames.TexCoord2fArray, "faceVarying")
        st.Set([(0, 0), (1, 0), (1, 1), (0, 1)] * 6)  # without, MuJoCo looks at the angle between faces itself
        return picture(stage)

    each = np.repeat(normals, 4, axis=0).astype(float).tolist()
    some = each if interpolation == "faceVarying" else normals
    new_stage.GetRootLayer().Export(str(tmp_path / "other.usda"))
    other = Usd.Stage.Open(str(tmp_path / "other.usda"))
    split = box(other, corners[np.ravel(faces)].tolist(), range(24), "vertex", each)
    shared = box(new_stage, corners.tolist(), np.ravel(faces).tolist(), interpolation, some)
    assert (shared == split).all() and len(np.unique(split.reshape(-1, 3), axis=0)) > 3


def test_the_sky_has_clouds_and_far_hills_only_where_there_is_land(tmp_path):
    from PIL import Image

    from vehsim.exporters.usd.scenery.lighting import clouds, latlong_directions, write_sky

    directions = latlong_directions(512, 256)
    cover, light = clouds(directions, np.array([0.6, 0.6, 0.53]))
    up = directions[..., 2]
    assert 0.08 < (cover[(up > 0.08) & (up < 0.5)] > 0.2).mean() < 0.6 and cover[up < 0].max() == 0
    assert light.min() >= 0.25 and light.max() <= 1
    land, sea = (tmp_path / name for name in ("land.png", "sea.png"))
    write_sky(land, 40.0, 22.0, hills=True)
    write_sky(sea, 40.0, 22.0)
    with Image.open(land) as one, Image.open(sea) as other:
        changed = (np.asarray(one) != np.asarray(other)).any(axis=2).any(axis=1)
    degrees = 90.0 - (np.arange(512) + 0.5) / 512 * 180.0
    assert changed.any() and np.abs(degrees[changed]).max() < 9.0


def test_concrete_lies_on_obstacles_to_scale():
    """Texture coordinates are metres divided by the tile's side, on every side of a box; joints are a metre apart."""
    import io

    from PIL import Image

    rng = np.random.default_rng(4)
    for axis in range(3):
        normals = np.tile(np.eye(3)[axis] * [-1, 1, -1], (5, 1))
        corners = rng.normal(size=(5, 3, 3))
        corners[..., axis] = 2.0
        st = coordinates(corners, normals, "concrete")
        lengths = [np.linalg.norm(np.diff(x, axis=1), axis=2) for x in (corners, st * FINISHES["concrete"].tile)]
        assert np.allclose(*lengths)
    with Image.open(io.BytesIO(tile_of("concrete", (0.4, 0.4, 0.4)))) as image:
        shade = np.asarray(image, float).mean(axis=2)
    rows = shade.mean(axis=1)
    assert set(np.argsort(rows)[:4]) == {0, 127, 128, 255}


@pytest.mark.parametrize("finish", ["concrete", "bands"])
def test_finishes_keep_their_scale_and_tiles_at_utm_coordinates(finish):
    """To 1 mm in single precision, and whole tiles away from where a mesh at the origin would have them."""
    tile, far = np.array(FINISHES[finish].tile), np.array([500_000.25, 4_212_000.5, 130.0])
    fits = FINISHES[finish].fits  # the obstacle's height
    for axis in range(2 if fits else 3):
        corners = np.random.default_rng(axis).uniform(0, 30, (9, 3, 3)) + far
        corners[..., axis] = far[axis]
        st = coordinates(corners, np.tile(np.eye(3)[axis], (9, 1)), finish).astype(np.float32)
        tiles = (np.delete(corners, axis, axis=2) / tile - st)[..., : 1 if fits else 2]
        assert np.abs(tiles - np.round(tiles)).max() * tile.max() < 1e-3
        assert np.ptp(np.round(tiles), axis=(0, 1)).max() == 0


def test_pictures_are_the_same_at_utm_coordinates(new_stage):
    """Renderers use single precision, which has steps of 0.5 m there: both pictures are drawn near the origin."""
    from pxr import Gf, UsdGeom

    quad(new_stage, "/top/left", (-1, 2, 1), 0.4, (1, 0, 0))
    mover = UsdGeom.Xform.Define(new_stage, "/top/mover")
    translate = mover.AddTranslateOp()
    translate.Set(Gf.Vec3d(1, 0, 0), 1)
    translate.Set(Gf.Vec3d(3, 0, 0), 3)
    quad(new_stage, "/top/mover/right", (0, 0, 0), 0.5, (0, 1, 0))
    near = picture(new_stage, 2)
    top = UsdGeom.Xformable(new_stage.GetPrimAtPath("/top"))
    top.AddTranslateOp().Set(Gf.Vec3d(500_000, 4_212_000, 0))
    assert np.abs(picture(new_stage, 2) - near).max() <= 1


def test_distant_helicopters_are_not_lost_in_haze(new_stage):
    """On ground 200 m wide, haze ended at 120 m whatever the camera's distance."""
    from pxr import Gf, UsdGeom

    quad(new_stage, "/top/ground", (0, 300, -100), 100.0, (0.2, 0.2, 0.2))
    mover = UsdGeom.Xform.Define(new_stage, "/top/mover")
    translate = mover.AddTranslateOp()
    translate.Set(Gf.Vec3d(0, 200, 0), 1)
    translate.Set(Gf.Vec3d(0.1, 200, 0), 3)
    quad(new_stage, "/top/mover/quad", (0, 0, 0), 20.0, (0.8, 0.02, 0.02))
    red, green, _ = picture(new_stage)[SIZE[1] // 2, SIZE[0] // 2]
    assert red > 1.3 * green


def mirrored(new_stage, folder, lean, metallic=1.0, roughness=0.02):
    """The colours (3,) of a leaning mirror in a picture, below a sky that is blue above and red below the horizon."""
    from PIL import Image
    from pxr import Sdf, UsdGeom, UsdLux

    sky = np.zeros((64, 128, 3), np.uint8)
    sky[:32], sky[32:] = (40, 80, 200), (200, 40, 40)
    Image.fromarray(sky).save(folder / "sky.png")
    dome = UsdLux.DomeLight.Define(new_stage, "/top/sky")
    dome.CreateTextureFileAttr("./sky.png")
    dome.AddRotateXOp().Set(90.0)
    lying = UsdGeom.Xform.Define(new_stage, "/top/lying")
    lying.AddRotateXOp().Set(lean)
    quad(new_stage, "/top/lying/card", (0, 0, 0), 1.5, (1, 1, 1))
    shader = new_stage.GetPrimAtPath("/top/lying/card_material/surface")
    shader.GetAttribute("inputs:emissiveColor").Set((0, 0, 0))
    for name, value in (("roughness", roughness), ("metallic", metallic)):
        shader.CreateAttribute(f"inputs:{name}", Sdf.ValueTypeNames.Float).Set(value)
    new_stage.Save()
    with StageRenderer(StageReader(new_stage.GetRootLayer().realPath), SIZE) as renderer:
        picture = renderer.render("main", 1).astype(float)
    middle = SIZE[1] // 2, SIZE[0] // 2
    return picture[middle], picture[5, 5]


def test_a_mirror_shows_the_sky_behind_the_camera(new_stage, tmp_path):
    """It leans back, so that the camera sees the zenith in it."""
    seen, sky = mirrored(new_stage, tmp_path, -45.0)
    assert seen == pytest.approx(sky, abs=6)


def test_a_mirror_that_leans_forward_shows_the_ground(new_stage, tmp_path):
    """Not the lower half of the sky, which the ground hides."""
    seen, sky = mirrored(new_stage, tmp_path, 45.0)
    assert abs(seen - sky).max() > 40 and np.ptp(seen) < 0.5 * seen.max()


def test_rough_metal_mirrors_nothing(new_stage, tmp_path):
    """What it scatters, the lights have."""
    seen, sky = mirrored(new_stage, tmp_path, -45.0, roughness=0.9)
    assert abs(seen - sky).max() > 40


@pytest.mark.parametrize("scope", ["vehicles", "scenery"])
def test_shadows_are_as_fine_for_a_vehicle_at_rest(scope, new_stage):
    """The shadow map covers four times the camera's distance of 10 m, not the whole ground."""
    quad(new_stage, "/top/ground", (0, 300, -100), 200.0, (0.2, 0.2, 0.2))
    quad(new_stage, f"/top/{scope}/one", (0, 0, 0), 1.0, (0.8, 0.02, 0.02))
    new_stage.Save()
    stage = StageReader(new_stage.GetRootLayer().realPath)
    assert not stage.groups
    reach = shadow_reach(stage, spans_of_casters(stage, AXES))
    assert reach == (pytest.approx(40.0) if scope == "vehicles" else SHADOW_REACH[1])


def test_shadows_are_finer_in_the_pictures_of_a_closer_camera(new_stage):
    """A wide shot of the same vehicle does not make the close one coarse."""
    from pxr import Gf, UsdGeom

    far = UsdGeom.Camera.Define(new_stage, "/top/wide")
    far.AddTranslateOp().Set(Gf.Vec3d(0, -25, 0))
    quad(new_stage, "/top/ground", (0, 300, -100), 200.0, (0.2, 0.2, 0.2))
    quad(new_stage, "/top/vehicles/one", (0, 0, 0), 1.0, (0.8, 0.02, 0.02))
    new_stage.Save()
    stage = StageReader(new_stage.GetRootLayer().realPath)
    casters = spans_of_casters(stage, AXES)
    assert [shadow_reach(stage, casters, [name]) for name in ("main", "wide")] == pytest.approx([40.0, 100.0])


def test_ground_casts_no_shadow_where_an_obstacle_has_its_foot_below_it(new_stage):
    """It did, and spots of its own shadow were on it far away."""
    from pxr import UsdGeom

    quad(new_stage, "/top/ground", (0, 0, 0), 1.0, (0.2, 0.2, 0.2))
    ground = [(-900, -900, 0), (900, -900, 0), (900, 900, 0), (-900, 900, 0)]
    UsdGeom.Mesh(new_stage.GetPrimAtPath("/top/ground")).GetPointsAttr().Set(ground)
    quad(new_stage, "/top/env/obstacles/wall", (4, 0, 0), 1.0, (0.8, 0.02, 0.02))
    new_stage.Save()
    stage = StageReader(new_stage.GetRootLayer().realPath)
    assert np.allclose(spans_of_casters(stage, AXES), [[3, -1], [5, 1]])


def test_a_high_sun_casts_no_specks_on_far_hills(tmp_path):
    """Rounding did: five times as many pixels were in the shadow of nothing."""
    from scipy.ndimage import median_filter

    marks = [
        {"frame": 1001, "position": [0, 0, 0], "heading": 0, "velocity": [0, 0, 0]},
        {"frame": 1097, "position": [20, 3, 0]},
    ]
    shot = Shot.from_dict(
        {
            "shot": {"schema": 1, "name": "noon"},
            "world": {"terrain": "hills"},
            "render": {"mood": "noon"},
            "vehicle": [{"name": "car", "asset": "car", "motion": {"method": "plan", "mark": marks}}],
            "camera": [{"name": "chase", "rig": "chase", "target": "car"}],
        }
    )
    stage = StageReader(shot.solve().export(tmp_path) / "noon.usda")
    pictures = []
    for shadows in (True, False):
        with StageRenderer(stage, (640, 360), shadows, samples=1) as renderer:
            pictures.append(renderer.render("chase", 1060).mean(axis=2))
    shade = pictures[0] < 0.75 * pictures[1]
    assert shade.sum() > 1000  # the car's own
    assert (shade & ~median_filter(shade, 7)).sum() < 0.2 * shade.sum()  # at its edges; it was 0.39


def test_the_shadow_map_covers_no_more_than_what_casts_shadows(new_stage):
    """Ground casts none: without hills, the map is as fine as the vehicles' paths permit. Texels of a map of 88 m were
    6 cm wide, which showed beside a parked car."""
    from pxr import Gf, UsdGeom

    quad(new_stage, "/top/ground", (0, 0, 0), 1.0, (0.2, 0.2, 0.2))
    ground = [(-900, -900, -9), (900, -900, -9), (900, 900, -9), (-900, 900, -9)]
    UsdGeom.Mesh(new_stage.GetPrimAtPath("/top/ground")).GetPointsAttr().Set(ground)
    mover = UsdGeom.Xform.Define(new_stage, "/top/mover")
    translate = mover.AddTranslateOp()
    translate.Set(Gf.Vec3d(-30, 0, 0), 1)
    translate.Set(Gf.Vec3d(10, 0, 0), 3)
    quad(new_stage, "/top/mover/quad", (0, 0, 0), 1.0, (0.8, 0.02, 0.02))
    quad(new_stage, "/top/wall", (4, 0, -6), 1.0, (0.8, 0.02, 0.02))
    new_stage.Save()
    stage = StageReader(new_stage.GetRootLayer().realPath)
    casters = spans_of_casters(stage, AXES)
    size = 2**0.5
    assert np.allclose(casters, [[-30 - size, -7], [10 + size, size]])
    assert shadow_reach(stage, casters) == pytest.approx(20 + size + 1)


@pytest.mark.parametrize("place", [(10.0, -20.0, 3.0), (500_223.25, 4_212_445.5, 150.0)])
def test_points_far_from_the_origin_keep_their_place(place):
    from pxr import Gf, Usd, UsdGeom

    points = np.add(place, [[0, 0, 0], [7.125, 0, 0], [7.125, 3.3, 1]])
    stage = Usd.Stage.CreateInMemory()
    mesh = UsdGeom.Mesh.Define(stage, "/mesh")
    author_points(mesh, points)
    T = UsdGeom.XformCache().GetLocalToWorldTransform(mesh.GetPrim())
    there = np.array([T.Transform(Gf.Vec3d(*point)) for point in mesh.GetPointsAttr().Get()])
    np.testing.assert_allclose(there, points, atol=1e-3)
    assert mesh.GetOrderedXformOps() == [] or place[0] > 1e5


def test_an_opengl_without_shaders_draws_no_mirrors_and_says_so(new_stage, tmp_path, monkeypatch):
    from OpenGL.GL import shaders

    def fail(*_args):
        raise shaders.ShaderCompilationError("no GLSL")

    monkeypatch.setattr(shaders, "compileShader", fail)
    with pytest.warns(UserWarning, match="cannot draw what paint, chrome and glass mirror"):
        seen, sky = mirrored(new_stage, tmp_path, -45.0)
    assert np.abs(seen - sky).max() > 40
