"""Tyre marks on the stage, against what a sliding wheel does in closed form, and in pictures."""

from __future__ import annotations

from dataclasses import replace
from fractions import Fraction
from itertools import pairwise

import numpy as np
import pytest
from PIL import Image
from pxr import Usd, UsdGeom, UsdShade

import vehsim
from vehsim.cameras.camera import CameraRig
from vehsim.cameras.framing import solve_camera
from vehsim.delivery.take import RenderSettings, Take, UsdSettings
from vehsim.exporters.pictures.render import StageRenderer
from vehsim.exporters.pictures.tyre_marks import strip
from vehsim.exporters.usd.exporter import write_usd
from vehsim.exporters.usd.scenery.driven import GROUNDS
from vehsim.exporters.usd.scenery.tyre_marks import LOOKS, ROWS, marks_of
from vehsim.exporters.usd.stage import TYRE_MARK, Ribbon, StageReader
from vehsim.world.ground.placing import place_on_terrain
from vehsim.world.terrain.terrain import Terrain

LEVEL = vehsim.World(Terrain("level", np.zeros((3, 3)), (-100.0, -100.0), (100.0, 100.0)))
TYRE, RADIUS, AXLE, HALF = 0.191, 0.32, 1.3, 0.77


def rolling_ground():
    x = np.arange(-40.0, 41.0)
    X, Y = np.meshgrid(x, x)
    return vehsim.World(Terrain("dunes", 0.5 * np.sin(X / 6) + 0.4 * np.cos(Y / 8), (-40.0, -40.0), (1.0, 1.0)))


def braked(world=LEVEL, surface="asphalt", aside=0.0, seconds=1.5, name="drift_car"):
    """A car that slides with its wheels locked from 10 m/s; ``aside``: its angle to the way, rad."""
    vehicle = vehsim.load_vehicle(name, {"surface": surface})
    step = vehicle.largest_step
    rows = np.tile([0.0, 8000.0, 8000.0, 0.0], (round(seconds / step) + 1, 1))
    twist = (0, 10 * np.cos(aside), 10 * np.sin(aside))
    state = vehsim.State(twist=twist, joint_rates=(0, 0, 0))
    clip = vehsim.simulate(vehicle, None, rows, state, seconds, step=step)
    return place_on_terrain(clip, world)


def exported(folder, clip, world=LEVEL, **settings):
    take = Take(
        "shot", {"car": clip}, world, (), Fraction(24), (1001, int(clip.end_frame)), usd=UsdSettings(**settings)
    )
    write_usd(take, folder, lambda what, done: None)
    return Usd.Stage.Open(str(folder / "shot.usda"))


def ribbons(stage):
    return {p.GetName(): UsdGeom.Mesh(p) for p in stage.Traverse() if p.HasAttribute(TYRE_MARK)}


def rows_of(mesh, frame):
    return np.array(mesh.GetPointsAttr().Get(frame), float).reshape(-1, 2, 3)


def test_a_locked_wheel_marks_its_way_with_the_width_of_its_tyre(tmp_path):
    clip = braked(seconds=0.9)
    stage = exported(tmp_path, clip)
    found = ribbons(stage)
    assert sorted(found) == ["car_fl_0", "car_fr_0", "car_rl_0", "car_rr_0"]
    at = clip.resample()
    for name, x, y in (("car_fl_0", AXLE, HALF), ("car_rr_0", -AXLE, -HALF)):
        rows = rows_of(found[name], clip.end_frame)
        assert np.linalg.norm(rows[:, 0] - rows[:, 1], axis=1) == pytest.approx(TYRE, abs=1e-3)
        middle = rows.mean(axis=1)
        assert middle[0, :2] == pytest.approx([x, y], abs=2e-3)
        assert middle[-1, 0] - middle[0, 0] == pytest.approx(at.positions[-1, 0] - at.positions[0, 0], abs=0.05)
        assert np.abs(middle[:, 1] - y).max() < 2e-3


def test_marks_grow_with_their_tyres(tmp_path):
    clip = braked(seconds=0.9)
    stage = exported(tmp_path, clip)
    at, last = clip.resample(), int(clip.end_frame)
    for mesh in ribbons(stage).values():
        whole = rows_of(mesh, last)
        for k in (0, 5, 17):
            rows = rows_of(mesh, float(at.frames[k]))
            ahead = at.positions[k, 0] - at.positions[0, 0]
            made = whole[:, 0, 0] - whole[0, 0, 0] <= ahead + 2e-3
            assert rows[made] == pytest.approx(whole[made], abs=1e-6)
            tip = rows[~made][:, 0, 0] - whole[0, 0, 0]
            assert tip == pytest.approx(np.full(len(tip), ahead), abs=5e-3)  # they wait where the tyre is


def test_a_tyre_that_slides_sideways_marks_the_length_of_its_contact(tmp_path):
    stage = exported(tmp_path, braked(aside=np.pi / 2))
    rows = rows_of(ribbons(stage)["car_rl_0"], 1031)
    assert np.linalg.norm(rows[2:8, 0] - rows[2:8, 1], axis=1) == pytest.approx(RADIUS / 2, abs=0.02)


def test_marks_lie_on_the_ground(tmp_path):
    world = rolling_ground()
    stage = exported(tmp_path, braked(world), world)
    found = ribbons(stage)
    ends = np.concatenate([rows_of(mesh, 1037).reshape(-1, 3) for mesh in found.values()])
    assert ends[:, 2] - world.height(ends[:, :2]) == pytest.approx(0.006, abs=1e-4)
    assert np.ptp(ends[:, 2]) > 0.2


def test_opacity_is_slip_times_load(tmp_path):
    """All wheels are locked above 3 m/s: the slip is one, and braking shifts load to the front."""
    clip = braked(seconds=0.5)
    stage, look = exported(tmp_path, clip), LOOKS["asphalt"]
    found = ribbons(stage)
    for name in ("fl", "rl"):
        load = clip.resample().channels[f"load_{name}"]
        opacity = np.array(found[f"car_{name}_0"].GetDisplayOpacityAttr().Get()).reshape(-1, 2)[:, 0]
        speed = clip.resample().twists[:, 1]
        slip = speed / np.hypot(speed, 3)
        dense = clip.at(np.linspace(0, 0.5, 25)).channels[f"load_{name}"]
        share = (slip * load / dense.mean() - look.least) / (look.most - look.least)
        expected = look.opacity * np.clip(share, 0, 1)
        assert opacity[2::2] == pytest.approx(expected[1:], abs=0.03)


def test_rolling_tyres_mark_gravel_and_snow_only():
    def tracks(surface):
        vehicle = vehsim.load_vehicle("drift_car", {"surface": surface})
        clip = vehsim.simulate(vehicle, LEVEL, np.zeros(4), vehsim.State(twist=(0, 8, 0)), 0.5, step=1 / 1200)
        return sorted(name for name, _ in marks_of(clip, LEVEL.terrain, (1001, 1013)))

    assert tracks("asphalt") == tracks("ice") == []
    assert tracks("gravel") == tracks("snow") == ["fl", "fr", "rl", "rr"]
    car = vehsim.simulate(vehsim.load_vehicle("car"), LEVEL, np.zeros(2), vehsim.State(twist=(0, 8, 0)), 0.5)
    assert not list(marks_of(car, LEVEL.terrain, (1001, 1013)))


def test_long_slides_are_cut_so_that_samples_do_not_grow_with_their_square(tmp_path):
    clip = braked(surface="ice", seconds=4.0)
    stage = exported(tmp_path, clip)
    pieces = [mesh for name, mesh in ribbons(stage).items() if name.startswith("car_fl")]
    assert len(pieces) > 3
    for first, second in pairwise(pieces):
        assert len(rows_of(first, 1097)) <= ROWS and first.GetPointsAttr().GetNumTimeSamples() <= ROWS
        assert rows_of(first, 1097)[-1] == pytest.approx(rows_of(second, 1097)[0], abs=1e-6)


def test_they_can_be_left_out(tmp_path):
    assert not ribbons(exported(tmp_path, braked(seconds=0.3), tyre_marks=False))


def test_their_material_reads_opacity_from_a_picture(tmp_path):
    stage = exported(tmp_path, braked(seconds=0.3, surface="wet asphalt"))
    mesh = ribbons(stage)["car_fl_0"]
    material, _ = UsdShade.MaterialBindingAPI(mesh.GetPrim()).ComputeBoundMaterial()
    surface = material.ComputeSurfaceSource()[0]
    image = UsdShade.Shader(surface.GetInput("opacity").GetConnectedSources()[0][0].source.GetPrim())
    file = image.GetInput("file").Get().resolvedPath
    with Image.open(file) as picture:
        alpha = np.asarray(picture)[..., 3] / 255
    st = np.array(UsdGeom.PrimvarsAPI(mesh).GetPrimvar("st").Get())
    opacity = np.array(mesh.GetDisplayOpacityAttr().Get())
    read = alpha[::-1][np.clip((st[:, 1] * 64).astype(int), 0, 63), 32]
    assert read == pytest.approx(opacity, abs=0.01)
    assert alpha[0, 0] < 0.02 * alpha[0, 32] and alpha[-1].max() == 0


@pytest.mark.parametrize("origin", [0.0, 60_000.0])
def test_pictures_show_them(tmp_path, origin):
    """A camera above sees a dark band where the wheels slid, and light ground beside it."""
    heights = np.zeros((3, 3))
    world = vehsim.World(Terrain("level", heights, (origin - 100.0, -100.0), (100.0, 100.0)))
    clip = braked()
    clip = place_on_terrain(replace(clip, positions=clip.positions + np.array([origin, 0, 0])), world)
    rig = CameraRig("above", "static", position=(origin + 4.0, 0.01, 12.0), look_at=(origin + 4.0, 0, 0))
    camera = solve_camera(rig, {"car": clip}, world, (1001, 1037))
    take = Take("shot", {"car": clip}, world, (camera,), Fraction(24), (1001, 1037), RenderSettings((320, 240)))
    write_usd(take, tmp_path, lambda what, done: None)
    stage = StageReader(tmp_path / "shot.usda")
    view = stage.camera("above", 1037)
    with StageRenderer(stage, (320, 240)) as renderer:
        picture = renderer.render("above", 1037).astype(float)

    def seen(x, y):
        away = (np.array([origin + x, y, 0.0]) - stage.origin - view.T_wc[:3, 3]) @ view.T_wc[:3, :3]
        column = 160 + 160 * away[0] / -away[2] / view.half_width
        row = 120 - 160 * away[1] / -away[2] / view.half_width
        return round(row), round(column)

    for y in (HALF, -HALF):  # behind the car, where its rear wheels slid
        marked, beside = seen(0.8, y), seen(0.8, y - np.sign(y) * 0.5)
        assert picture[marked].mean() < 0.6 * picture[beside].mean()
    ahead = seen(9.0, HALF), seen(9.0, HALF / 2)
    assert picture[ahead[0]].mean() == pytest.approx(picture[ahead[1]].mean(), rel=0.2)


@pytest.mark.parametrize("surface", ["gravel", "snow", "ice"])
def test_pictures_show_marks_on_bright_ground(surface):
    """Marks are darker than the ground that they are on: on snow, they were lighter than usual ground, and not seen."""
    rows = np.array([((x, 0.1, 0.0), (x, -0.1, 0.0)) for x in (0.0, 1.0)])
    ribbon = Ribbon(rows, np.full((2, 2), LOOKS[surface].opacity), np.array(LOOKS[surface].colour))
    albedo = GROUNDS[surface].paint().mean(axis=(0, 1))
    _, light = strip(ribbon, np.array([0.0, 0.0, 2.0]), (100.0, 200.0), albedo)
    assert light.min() < 0.95
