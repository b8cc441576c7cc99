"""Vehicles darken the ground below them as bodies hide the sky: against closed-form view factors, and in pictures."""

from __future__ import annotations

import numpy as np
import pytest

from vehsim.exporters.pictures import contact_shade
from vehsim.exporters.pictures.contact_shade import FADES, STRENGTH, Shade, Shades
from vehsim.exporters.pictures.render import StageRenderer
from vehsim.exporters.usd.metadata import author_points
from vehsim.exporters.usd.stage import StageReader

SIZE = (160, 90)


def hidden(shade, *place):
    """The share of the sky that is hidden at ``place``, without the fade and the strength."""
    at = np.round((np.array(place, float) - shade.lower) / shade.cell).astype(int)
    return float(shade.hidden[tuple(at)])


@pytest.mark.parametrize(("directions", "within"), [((8, 32), 0.035), (None, 0.08)])
@pytest.mark.parametrize("height", [0.2, 0.4, 0.8])
def test_a_square_plate_hides_as_much_as_its_view_factor(height, directions, within, monkeypatch):
    """Howell, configuration factor B-4 (element to parallel rectangle), for the four quarters of the plate."""
    import trimesh

    for name, count in zip(("RINGS", "SPOKES"), directions or (), strict=False):
        monkeypatch.setattr(contact_shade, name, count)
    plate = trimesh.creation.box((2.0, 2.0, 0.02))
    plate.apply_translation((0, 0, height))
    x = 1.0 / height
    factor = 4 / (2 * np.pi) * 2 * x / np.sqrt(1 + x * x) * np.arctan(x / np.sqrt(1 + x * x))
    assert hidden(Shade.of(plate.vertices, plate.faces), 0, 0, 0) == pytest.approx(factor, abs=within)


@pytest.mark.parametrize("away", [0.4, 0.8, 1.2, 1.6])
def test_a_resting_ball_hides_as_much_as_its_view_factor(away):
    """A ball of radius 1 above a level element: 1 / D^3 at a distance D of its centre (Howell, B-43)."""
    import trimesh

    ball = trimesh.creation.icosphere(subdivisions=4)
    shade = Shade.of(ball.vertices, ball.faces)
    on_axes = [hidden(shade, *place, -1) for place in ((away, 0), (-away, 0), (0, away), (0, -away))]
    assert np.mean(on_axes) == pytest.approx((1 + away**2) ** -1.5, abs=0.06)


def test_shade_ends_above_the_vehicles_underside():
    import trimesh

    box = trimesh.creation.box((4.0, 2.0, 1.0))
    shade = Shade.of(box.vertices, box.faces)
    low = -0.5
    ground = shade.at(np.array([[2.2, 0, low]]))[0]
    assert 0 < ground < STRENGTH
    assert shade.at(np.array([[2.2, 0, low + FADES[1] + 0.01]]))[0] == 0
    assert shade.at(np.array([[9.0, 0, low]]))[0] == 0


def test_an_obstacle_shades_ground_at_any_height_as_far_as_it_is_high():
    """On a slope, its base is in the ground. Cells that fit a kerb's length of 40 m were higher than the kerb."""
    import trimesh

    for size in ((40.0, 0.6, 0.15), (40.0, 8.0, 9.0)):
        box = trimesh.creation.box(size)
        shade = Shade.of(box.vertices, box.faces, standing=True)
        near, far = (shade.at(np.array([[0, size[1] / 2 + share * size[2], -size[2] / 2]]))[0] for share in (0.5, 4.0))
        assert 0.05 < near < 0.5 * STRENGTH  # at most half of the sky is behind a wall
        assert far == 0
        assert 0 < shade.at(np.array([[0, size[1] / 2 + 0.5 * size[2], 0]]))[0] <= near


@pytest.fixture
def new_stage(tmp_path):
    """A function that makes a stage of two frames in metres, Z up, with a prim that moves for each of ``names``."""
    from pxr import Gf, Usd, UsdGeom

    def new_stage(file, *names):
        stage = Usd.Stage.CreateNew(str(tmp_path / file))
        UsdGeom.SetStageMetersPerUnit(stage, 1.0)
        UsdGeom.SetStageUpAxis(stage, "Z")
        stage.SetStartTimeCode(1)
        stage.SetEndTimeCode(2)
        stage.SetFramesPerSecond(24)
        stage.SetTimeCodesPerSecond(24)
        stage.SetDefaultPrim(UsdGeom.Xform.Define(stage, "/top").GetPrim())
        for name in names:
            moved = UsdGeom.Xform.Define(stage, f"/top/{name}").AddTranslateOp()
            moved.Set(Gf.Vec3d(0, 0, 0), 1)
            moved.Set(Gf.Vec3d(0.01, 0, 0), 2)
        return stage

    return new_stage


@pytest.fixture
def add_box():
    from pxr import Gf, UsdGeom, Vt

    def add_box(stage, path, size, centre):
        import trimesh

        box = trimesh.creation.box(size)
        points = np.asarray(box.vertices) + centre
        mesh = UsdGeom.Mesh.Define(stage, path)
        mesh.CreateSubdivisionSchemeAttr("none")
        author_points(mesh, points)
        mesh.CreateExtentAttr([Gf.Vec3f(*map(float, end)) for end in (points.min(axis=0), points.max(axis=0))])
        mesh.CreateFaceVertexCountsAttr(Vt.IntArray.FromNumpy(np.full(len(box.faces), 3, np.int32)))
        mesh.CreateFaceVertexIndicesAttr(Vt.IntArray.FromNumpy(np.asarray(box.faces, np.int32).ravel()))

    return add_box


@pytest.fixture
def draw(new_stage, add_box):
    """A picture of a box ``height`` m above the ground that moves, or stands as an obstacle, and its segmentation."""
    from pxr import Gf, UsdGeom

    def draw(height, path="a"):
        stage = new_stage(f"box_{height:g}.usda", "a")
        camera = UsdGeom.Camera.Define(stage, "/top/main")
        camera.CreateFocalLengthAttr(0.35)
        camera.CreateHorizontalApertureAttr(0.36)
        camera.CreateVerticalApertureAttr(0.36 * SIZE[1] / SIZE[0])
        camera.CreateClippingRangeAttr(Gf.Vec2f(0.1, 500))
        camera.AddTranslateOp().Set(Gf.Vec3d(0, -12, 4))
        camera.AddRotateXOp().Set(72.0)
        add_box(stage, "/top/ground", (60, 60, 0.2), (0, 0, -0.1))
        add_box(stage, f"/top/{path}/box", (2, 2, 1), (0, 0, 0.5 + height))
        stage.GetRootLayer().Save()
        with StageRenderer(StageReader(stage.GetRootLayer().realPath), SIZE) as renderer:
            picture = renderer.render("main", 1).astype(float).mean(axis=2)
            return picture, renderer.passes("main", 1, ["segmentation"])

    return draw


@pytest.mark.parametrize("path", ["a", "env/obstacles/a"])
def test_what_touches_the_ground_darkens_it_but_not_itself(path, draw, monkeypatch):
    resting, seen = draw(0.0, path)
    monkeypatch.setattr(StageRenderer, "_shaded", lambda self, picture, *rest: picture)
    plain, _ = draw(0.0, path)
    ground = (seen["segmentation"] == seen["segmentation"][-1, 0]).all(axis=2)
    change = plain - resting
    assert change.min() >= 0
    below = np.flatnonzero(~ground[:, SIZE[0] // 2]).max() + 2  # the ground in front of the box
    assert change[below, SIZE[0] // 2] > 0.2 * plain[below, SIZE[0] // 2]
    assert change[-1].max() < 2  # and none near the camera
    top = np.flatnonzero(~ground[:, SIZE[0] // 2])
    assert change[top[: len(top) // 2], SIZE[0] // 2].max() < 2


def test_a_vehicle_high_above_the_ground_darkens_nothing(draw, monkeypatch):
    flying, _ = draw(6.0)
    monkeypatch.setattr(StageRenderer, "_shaded", lambda self, picture, *rest: picture)
    plain, _ = draw(6.0)
    assert np.array_equal(flying, plain)


def test_vehicles_of_one_shape_share_their_shade(new_stage, add_box):
    stage = new_stage("two.usda", "a", "b", "c")
    for name, size in (("a", 1), ("b", 1), ("c", 2)):
        add_box(stage, f"/top/{name}/box", (size, 1, 1), (0, 0, 0))
    stage.GetRootLayer().Save()
    assert not Shades(StageReader(stage.GetRootLayer().realPath)).bodies  # in empty space
    add_box(stage, "/top/ground", (9, 9, 1), (0, 0, -2))
    stage.GetRootLayer().Save()
    shades = Shades(StageReader(stage.GetRootLayer().realPath))
    assert shades.bodies == ["/top/a", "/top/b", "/top/c"]
    assert shades["/top/a"] is shades["/top/b"] is not None
    assert shades["/top/c"] is not shades["/top/a"]


@pytest.mark.parametrize(("parked", "path"), [(True, "a"), (False, "a"), (False, "env/obstacles/a")])
def test_what_stands_still_has_a_shade_if_it_has_a_mass_or_is_an_obstacle(parked, path, new_stage, add_box):
    """A parked car has one as a moving car has; a hill does not."""
    from pxr import UsdGeom, UsdPhysics

    stage = new_stage("still.usda")
    body = UsdGeom.Xform.Define(stage, f"/top/{path}").GetPrim()
    if parked:
        UsdPhysics.MassAPI.Apply(body)
    add_box(stage, "/top/ground", (60, 60, 0.2), (0, 0, -0.1))
    add_box(stage, f"/top/{path}/box", (2, 2, 1), (0, 0, 0.5))
    stage.GetRootLayer().Save()
    shaded = parked or path != "a"
    assert Shades(StageReader(stage.GetRootLayer().realPath)).bodies == [f"/top/{path}"] * shaded


def test_a_trailer_takes_its_shade_with_it(new_stage, add_box):
    """A truck's shade showed its trailer as on the first frame, beside it when it was turned. What only spins or
    springs has none of its own, and neither has what is far above the ground, such as a crane."""
    from pxr import Gf, UsdGeom

    stage = new_stage("truck.usda", "truck")
    movers = (("trailer", (-2, 0, 0), 90.0, 0), ("wheel", (1, 0, 0.3), 0.0, 0.2), ("crane", (0, 0, 1), 90.0, 0))
    for name, place, turn, rise in movers:
        part = UsdGeom.Xform.Define(stage, f"/top/truck/{name}")
        moved, turned = part.AddTranslateOp(), part.AddRotateZOp()
        for frame in (1, 2):
            moved.Set(Gf.Vec3d(*place) + Gf.Vec3d(0, 0, rise * (frame - 1)), frame)
            turned.Set(turn * (frame - 1), frame)
    add_box(stage, "/top/ground", (60, 60, 0.2), (0, 0, -0.1))
    add_box(stage, "/top/truck/box", (4, 2, 1), (0, 0, 0.5))
    add_box(stage, "/top/truck/trailer/box", (8, 2, 1), (-5, 0, 0.5))
    add_box(stage, "/top/truck/wheel/box", (0.6, 0.2, 0.6), (0, 0, 0))
    add_box(stage, "/top/truck/crane/box", (3, 0.2, 0.2), (1.5, 0, 0.2))
    stage.GetRootLayer().Save()
    reader = StageReader(stage.GetRootLayer().realPath)
    shades = Shades(reader)
    assert shades.bodies == ["/top/truck", "/top/truck/trailer"]
    places = {"truck": (0, 0), "straight": (-7, 0), "turned": (-2, -5)}

    def lost(place, frame):
        poses = reader.matrices(frame)
        frames = [(shades[body], shades.frame(body, poses)) for body in shades.bodies]
        return max(shade.at((np.array([[*places[place], 0.0]]) - T[:3, 3]) @ T[:3, :3])[0] for shade, T in frames)

    assert lost("truck", 1) == pytest.approx(lost("truck", 2), abs=0.02)
    assert lost("straight", 1) == pytest.approx(lost("turned", 2), abs=0.02)
    assert min(lost("straight", 1), lost("truck", 1)) > 0.7 and max(lost("straight", 2), lost("turned", 1)) < 0.1
