"""Water for animators: wakes compared with Kelvin's, the mesh with the water, size, foam, and the preview."""

import re
import warnings
from dataclasses import replace
from fractions import Fraction
from types import SimpleNamespace

import numpy as np
import pytest
from pxr import Sdf, Usd, UsdGeom, UsdShade

import vehsim
from vehsim.cameras.camera import CameraRig
from vehsim.cameras.framing import solve_camera
from vehsim.clip.clip import Clip
from vehsim.delivery.take import RenderSettings, Take, UsdSettings
from vehsim.exporters.checks.validate import validate_stage
from vehsim.exporters.pictures.passes import prim_colours
from vehsim.exporters.pictures.render import StageRenderer
from vehsim.exporters.pictures.water import places_of
from vehsim.exporters.usd.scenery import distant_waves, wake, water_grid
from vehsim.exporters.usd.scenery import water as authored
from vehsim.exporters.usd.scenery.wake import Floating, Foam, Wake
from vehsim.exporters.usd.scenery.water_material import PERIOD, TILE
from vehsim.exporters.usd.scenery.waterline import warn_of_coarse
from vehsim.exporters.usd.stage import StageReader
from vehsim.exporters.web.scene import _stirred
from vehsim.world.water.sea import sea_state, together
from vehsim.world.water.water import Waves, wave
from vehsim.world.world import Water, World

BOAT = vehsim.load_vehicle("boat")
FPS = 24


def straight(speed, seconds, start=(-10.0, 0.0, 0.0)):
    """A boat that goes straight on along X."""
    times = np.arange(int(seconds * FPS) + 1) / FPS
    n = len(times)
    positions = np.array(start) + np.outer(times, [speed, 0, 0])
    twists = np.tile([0.0, 0, 0, speed, 0, 0], (n, 1))
    empty, channels = np.zeros((n, 0)), {name: np.zeros(n) for name in BOAT.channels}
    quaternions = np.tile([1.0, 0, 0, 0], (n, 1))
    return Clip(BOAT, times, positions, quaternions, twists, empty, empty, np.zeros((n, 2)), channels, Fraction(FPS))


def afloat(clip):
    return {"boat": Floating(clip, 1.65, 5.0, 1.8, 0.0)}


@pytest.fixture(scope="module")
def shown(tmp_path_factory):
    """A take of a second in a wave, exported."""
    clip = straight(6.0, 1.0, (-3.0, 0.0, 0.0))
    world = World(water=Water(0.3, wave(0.3, 9.0, heading=2.0, choppiness=0.6)))
    rig = CameraRig(name="low", rig="static", position=(0.0, -9.0, 1.4))
    frames = (1001, 1025)
    camera = solve_camera(rig, {"boat": clip}, world, frames)
    take = Take("sea", {"boat": clip}, world, (camera,), Fraction(FPS), frames, RenderSettings((320, 180)))
    return take, take.export(tmp_path_factory.mktemp("sea")) / "sea.usda"


def test_a_vehicle_at_rest_makes_no_waves():
    clip = straight(0.0, 1.0)
    xy = np.random.default_rng(1).uniform(-40, 20, (500, 2))
    assert max(np.abs(raised(xy)).max() for raised in Wake(afloat(clip), clip.frames, FPS).heights()) < 1e-9


def test_a_wake_has_kelvins_wavelength_and_wedge():
    """Transverse waves behind it are 2 pi U^2 / g long, and beyond 19.5 degrees there is hardly any wave."""
    speed = 4.0
    clip = straight(speed, 12.0, (-24.0, 0.0, 0.0))
    *_, raised = Wake(afloat(clip), clip.frames, FPS).heights()
    bow = clip.positions[-1, 0]
    behind = np.arange(5.0, 28.0, 0.2)
    line = raised(np.column_stack([bow - behind, 0 * behind]))
    spectrum = np.abs(np.fft.rfft((line - line.mean()) * np.hanning(len(line)), 4096))
    length = 1 / (np.fft.rfftfreq(4096, 0.2)[10:][spectrum[10:].argmax()])
    assert length == pytest.approx(2 * np.pi * speed**2 / 9.81, rel=0.12)
    x, y = np.meshgrid(np.arange(8.0, 25.0, 0.5), np.arange(-20.0, 20.5, 0.5))
    heights = raised(np.column_stack([bow - x.ravel(), y.ravel()])).reshape(x.shape)
    angle = np.degrees(np.arctan2(np.abs(y), x))
    assert np.sqrt((heights[angle > 28] ** 2).mean()) < 0.15 * np.sqrt((heights[angle < 20] ** 2).mean())


def turning(speed, seconds, radius):
    """A boat that turns in a circle."""
    clip = straight(speed, seconds)
    angle = speed / radius * np.asarray(clip.times)
    places = np.column_stack([radius * np.sin(angle), radius * (1 - np.cos(angle)), 0 * angle])
    quaternions = np.column_stack([np.cos(angle / 2), 0 * angle, 0 * angle, np.sin(angle / 2)])
    return replace(clip, positions=places, orientations=quaternions)


def way_of(clip):
    """The way of a boat on every third frame."""
    places, velocities, headings = wake.clip_places(clip, clip.frames[::3].astype(float))
    return wake._Way(afloat(clip)["boat"], places[:, :2], 1 / 3 * velocities, headings)


@pytest.mark.parametrize(
    "clip", [straight(8.0, 40.0), turning(8.0, 40.0, 60.0), straight(3.0, 20.0)], ids=["long", "circle", "slow"]
)
def test_a_box_that_follows_has_the_waves_of_one_around_the_whole_way(clip):
    way = way_of(clip)
    whole, following = wake._whole([way]), wake._following(way, wake.MOST, FPS / 3)
    places, headings, last = way.places, way.headings, len(way.places) - 1
    along, aside = np.meshgrid(np.arange(-60.0, 8.0, 0.7), np.arange(-25.0, 25.5, 0.7))
    ahead = np.array([np.cos(headings[last]), np.sin(headings[last])])
    xy = places[last] + np.outer(along.ravel(), ahead) + np.outer(aside.ravel(), [-ahead[1], ahead[0]])
    *_, wanted = wake._Waves(whole, [way], 3 / FPS).heights()
    *_, found = wake._Waves(following, [way], 3 / FPS).heights()
    if np.ptp(places[:, 0]) > 300:
        assert np.ptp(following.lower[:, 0]) > 100 and following.shape[1] < 0.9 * whole.shape[1]
    assert np.abs(found(xy) - wanted(xy)).max() < 0.03 * np.abs(wanted(xy)).max()


def test_the_end_of_a_wake_that_is_kept_does_not_pop(monkeypatch):
    """From frame to frame, the waves that pass a fixed point change no faster than those of the whole wake."""
    monkeypatch.setattr(wake, "SEEN", 6.0)
    way = way_of(straight(8.0, 24.0))
    xy = np.column_stack([np.arange(0.0, 200.0, 1.0), np.full(200, 4.0)])
    seen = [
        np.array([raised(xy) for raised in wake._Waves(box, [way], 3 / FPS).heights()])
        for box in (wake._whole([way]), wake._following(way, wake.MOST, FPS / 3))
    ]
    far = (way.places[:-1, :1] - xy[:, 0]) > 70.0  # about the end of what is kept
    whole, kept = (np.abs(np.diff(heights, axis=0))[far].max() for heights in seen)
    assert kept < 1.3 * whole, (kept, whole)
    assert np.abs(seen[1][-1][:20]).max() < 1e-9 < np.abs(seen[0][-1][:20]).max()  # left behind


def test_boats_far_apart_have_boxes_of_their_own():
    near, far = straight(6.0, 2.0), straight(6.0, 2.0, (4990.0, 0.0, 0.0))
    both = {"near": afloat(near)["boat"], "far": afloat(far)["boat"]}
    *_, raised = Wake(both, near.frames.astype(float), FPS).heights()
    *_, single = Wake({"near": both["near"]}, near.frames.astype(float), FPS).heights()
    xy = np.column_stack([np.linspace(-15, 2, 200), np.full(200, 1.0)])
    assert np.abs(raised(xy) - single(xy)).max() < 0.05 * np.abs(single(xy)).max()
    assert np.abs(raised(xy + np.array([5000, 0])) - raised(xy)).max() < 0.01 * np.abs(single(xy)).max()


def test_foam_lies_behind_and_fades():
    clip = straight(7.0, 4.0, (0.0, 0.0, 0.0))
    xy = np.column_stack([np.tile(np.linspace(-10, 40, 101), 2), np.repeat([0.0, 1.0], 101)])
    foam = Foam(afloat(clip), xy, clip.frames, FPS)
    white = foam.at(len(clip) - 1)
    ahead, near, far = (white[np.abs(xy[:, 0] - x).argmin()] for x in (35.0, 22.0, 4.0))
    assert ahead == 0 and near > 0.5 and 0 < far < near
    assert white[xy[:, 0] > 28.0 + 2.5].max() == 0  # the bow's end; also beside the path


def test_a_vehicle_in_the_air_leaves_no_wake():
    clip = straight(7.0, 2.0, (0.0, 0.0, 3.0))
    frames = clip.frames.astype(float)
    take = Take("sea", {"boat": clip}, World(water=0.0), (), Fraction(FPS), (1001, 1049))
    grid = water_grid.lay_grid(take)
    assert (authored.floating(take, frames)["boat"].wet == 0).all()
    for points, _, foam, lowered, drops in authored.surfaces(take, grid, frames[[0, 20, 48]]):
        assert np.abs(points[:, 2]).max() < 1e-9 and foam.max() == lowered.max() == len(drops.widths) == 0


def warned(metres, shown=1.0):
    """What is said of a boat that goes straight for ``metres``, of which ``shown`` are in the take."""
    clip = straight(20.0, metres / 20.0, (0.0, 0.0, 0.0))
    frames = clip.frames[: max(2, int(shown * len(clip)))].astype(float)
    take = Take("sea", {"boat": clip}, World(water=0.0), (), Fraction(FPS), (1001, int(frames[-1])))
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        warn_of_coarse(authored.floating(take, frames), water_grid.lay_grid(take), frames)
    return [str(one.message) for one in caught]


def test_water_that_is_too_coarse_for_a_hull_is_named_with_what_to_do():
    """The remedy helps: no part of the way is too long."""
    (says,) = warned(1400.0)
    assert re.match(
        r"boat: pictures may show water inside its hull, because .* every [\d.]+ m there and the hull", says
    )
    longest = int(says.split("about ")[1].split(" m")[0])
    assert 100 < longest < 1400
    assert not warned(0.97 * longest) and warned(1.2 * longest)
    assert not warned(1400.0, shown=0.97 * longest / 1400.0)


@pytest.mark.parametrize("roll", [0.0, 0.35])
@pytest.mark.parametrize("seconds", [1.0, 10.0, 16.0])  # the longer the way, the larger the cells
def test_the_mesh_follows_the_waterline_and_lies_at_the_bottom_inside(seconds, roll):
    clip = straight(6.0, seconds, (-3.0, 0.0, 0.0))
    lying = np.tile([np.cos(roll / 2), np.sin(roll / 2), 0, 0], (len(clip), 1))
    frames = clip.start_frame, clip.start_frame + len(clip) - 1
    take = Take("sea", {"boat": replace(clip, orientations=lying)}, World(water=0.0), (), Fraction(FPS), frames)
    grid = water_grid.lay_grid(take)
    hull = authored.floating(take, clip.frames)["boat"].hull
    for k in (7, 12):
        (shown,) = authored.surfaces(take, grid, clip.frames[[k]].astype(float))
        T_wr = take.clips["boat"].matrices()[k]
        above = shown.points + shown.lowered[:, None] * (0, 0, 1)
        own = (above - T_wr[:3, 3]) @ T_wr[:3, :3]
        near = np.flatnonzero(np.abs(own).max(axis=1) < 8)
        inside = np.full(len(own), -9.0)
        inside[near] = _inside(hull, own[near])

        sunk = np.flatnonzero(shown.lowered > 0)
        bottom = (shown.points[sunk] - T_wr[:3, 3]) @ T_wr[:3, :3]
        assert len(sunk) > 5 and inside[sunk].min() > 0 and np.abs(_inside(hull, bottom)).max() < 0.031
        assert np.delete(inside, sunk).max() < 0.031
        for faces in grid.faces:  # no cell is on both sides of the skin
            crossed = (inside[faces] > 1e-5).any(axis=1) & (inside[faces] < -1e-5).any(axis=1)
            assert not crossed.any(), faces[crossed]


def _inside(hull, places):
    """Distances (n,) m of places (n, 3) from a hull's skin, positive inside, by another method: winding numbers."""
    import igl

    skin = np.array(hull[0], float), np.array(hull[1], np.int64)
    away = np.sqrt(igl.point_mesh_squared_distance(np.ascontiguousarray(places), *skin)[0])
    return away * [1 if igl.winding_number(*skin, place) > 0.5 else -1 for place in places]


def test_water_itself_has_no_wet_lines(shown, monkeypatch):
    """Where MuJoCo draws the water, the picture is the same without wet lines: distant crests once were dark
    slivers."""
    from vehsim.exporters.pictures import water as water_view

    pictures = []
    for share in (0.0, 1.0):
        monkeypatch.setattr(water_view, "WETNESS", share)
        with StageRenderer(StageReader(shown[1]), (320, 180), samples=1) as renderer:
            pictures.append(renderer.render("low", 1005).astype(int))
            prims = renderer.passes("low", 1005, ["segmentation"])["segmentation"]
            water = prim_colours(renderer.prims)[renderer.prims.index("/sea/env/water/surface")]
    changed, of_water = (pictures[0] != pictures[1]).any(axis=2), (prims == water).all(axis=2)
    assert of_water.mean() > 0.3 and not (changed & of_water).any()
    assert changed.sum() > 50


def test_points_lie_on_the_waters_surface(shown):
    """Ahead of the wake, every point is on the water's surface at its time, with the water's normal."""
    take, path = shown
    stage = StageReader(path)
    for frame in (1001, 1019):
        points, normals, foam, _ = stage.water_at(frame)
        t = (frame - 1001) / FPS
        far = (points[:, 0] > 6.5) & (points[:, 0] < 8.5) & (np.abs(points[:, 1]) < 5)
        assert far.sum() > 20
        surface = take.world.water.height(points[far, :2], t)
        assert np.abs(points[far, 2] - surface).max() < 0.02
        assert np.abs(normals[far] - take.world.water.normal(points[far, :2], t)).max() < 0.1
        assert foam.min() >= 0 and foam.max() <= 1
    assert foam.max() > 0.3


def test_it_is_small_and_valid_and_reaches_the_horizon(shown):
    take, path = shown
    assert not validate_stage(path)
    seconds = (take.frames[1] - take.frames[0] + 1) / FPS
    assert (path.parent / "layers" / "water.usdc").stat().st_size < 10e6 * seconds + 1e6
    stage = Usd.Stage.Open(str(path))
    mesh = UsdGeom.Mesh(stage.GetPrimAtPath("/sea/env/water/surface"))
    low, high = np.array(mesh.GetExtentAttr().Get())
    assert low[:2].max() < -5000 and high[:2].min() > 5000
    assert mesh.GetNormalsInterpolation() == UsdGeom.Tokens.vertex


def test_a_flat_stage_shares_the_waters_file(shown, toys):
    from vehsim.exporters.usd.packaged import write_flat

    take, path = shown
    written = write_flat(take, path.parent, toys.silent)
    water = path.parent / "layers" / "water.usdc"
    assert {water.resolve(), (path.parent / "assets/water/ripples.png").resolve()} < {
        file.resolve() for file in written
    }
    assert written[0].stat().st_size < 0.2 * water.stat().st_size
    surfaces = []
    for file in (path, written[0]):
        stage = Usd.Stage.Open(str(file))
        mesh = UsdGeom.Mesh(stage.GetPrimAtPath("/sea/env/water/surface"))
        surfaces.append([mesh.GetPointsAttr().Get(frame) for frame in (1001, 1019)])
        assert stage.GetPrimAtPath("/sea/vehicles/boat/outboard").GetChildren(), "the rest is flat"
    assert surfaces[0] == surfaces[1]
    flat = Sdf.Layer.FindOrOpen(str(written[0]))
    arcs = []
    flat.Traverse("/", lambda at: arcs.append(at) if at.IsPrimPath() and _refers(flat.GetPrimAtPath(at)) else None)
    assert arcs == ["/sea/env/water"]


def _refers(prim):
    return prim.hasReferences or prim.hasPayloads


def test_the_size_does_not_depend_on_the_frame_rate():
    clip = straight(6.0, 1.0)
    take = Take("sea", {"boat": clip}, World(water=0.0), (), Fraction(24), (1001, 1025))
    fast = water_grid.lay_grid(replace(take, fps=Fraction(120)))
    for grid, fps in ((water_grid.lay_grid(take), 24), (fast, 120)):
        assert len(grid.xy) * water_grid.BYTES_A_POINT * fps <= water_grid.BYTES_A_SECOND


def test_the_preview_moves_and_its_hulls_are_wet(shown):
    with StageRenderer(StageReader(shown[1]), (320, 180)) as renderer:
        first, again, later = (renderer.render("low", frame).astype(float) for frame in (1005, 1005, 1015))
    assert np.abs(first - again).mean() < 0.1  # a graphics card repeats a frame with other bytes
    lower = slice(120, 180)
    assert np.abs(first[lower] - later[lower]).mean() > 2
    blue = first[lower].reshape(-1, 3).mean(axis=0)
    assert blue[2] > blue[0]


def test_a_picture_does_not_depend_on_what_was_drawn_before(shown):
    """Smaller copies of the texture blend its unused texels into water seen at a grazing angle."""
    with StageRenderer(StageReader(shown[1]), (320, 180), samples=1) as renderer:
        alone, again, *_, after = (renderer.render("low", frame) for frame in (1025, 1025, 1001, 1013, 1025))
    assert (after == alone).all() or (again != alone).any()  # a graphics card repeats a frame with other bytes


def test_a_long_lens_sees_water_between_the_places_of_its_net(shown, monkeypatch):
    """It was black there."""
    stage = StageReader(shown[1])
    view, down = stage.camera("low", 1001), np.eye(4)
    down[:3, 3] = 700.0, 13.0, 30.0
    monkeypatch.setattr(StageReader, "camera", lambda *_: view._replace(T_wc=down, half_width=0.01))
    with StageRenderer(stage, (320, 180)) as renderer:
        assert renderer.render("low", 1001).reshape(-1, 3).mean(axis=0).max() > 30


def test_wet_lines_darken_objects_just_above_the_water(shown):
    from vehsim.exporters.pictures.water import WaterView
    from vehsim.exporters.usd.scenery.shading import light_for

    stage = StageReader(shown[1])
    view = WaterView(stage, light_for(stage.sun(), stage.sky()))
    points, *_ = stage.water_at(stage.frames[0])
    middle = points[np.linalg.norm(points[:, :2] - [0, 8], axis=1).argmin()]
    places = middle + np.array([[[0, 0, 0.0], [0, 0, 0.06], [0, 0, 0.4]]])
    wet = view.wet(np.full((1, 3, 3), 200, np.uint8), places, np.full((1, 3), 5.0))
    assert wet[0, 0, 0] == wet[0, 2, 0] == 200 and wet[0, 1, 0] < 150


def test_foam_is_in_primvars_that_any_renderer_reads(shown):
    """UsdPreviewSurface reads colour and roughness from primvars, which agree with the preview's foam."""
    from vehsim.exporters.usd.scenery.water_material import CLEAR, FOAM, ROUGH, SHADES, TILE, patches

    stage = Usd.Stage.Open(str(shown[1]))
    prim = stage.GetPrimAtPath("/sea/env/water/surface")
    primvars = UsdGeom.PrimvarsAPI(prim)
    foam = np.array(primvars.GetPrimvar("foam").Get(1020), float)
    assert foam.max() > 0.3
    rest = TILE * np.array(primvars.GetPrimvar("st").Get(), float)
    white = patches(rest.T, foam, water_grid.lay_grid(shown[0]).cells)
    assert (white[foam == 0] == 0).all() and white.mean() == pytest.approx(foam.mean(), rel=0.4)
    colour = np.array(primvars.GetPrimvar("displayColor").ComputeFlattened(1020))
    rough = np.array(primvars.GetPrimvar("roughness").ComputeFlattened(1020))
    assert np.abs((colour - CLEAR) / (FOAM - CLEAR) - white[:, None]).max() < 0.8 / SHADES
    cells, (least, most) = water_grid.lay_grid(shown[0]).cells, (9.0 / share for share in (2.6, 1.0))
    step, shows = (ROUGH[1] - ROUGH[0]) / SHADES, cells < least
    assert np.abs(rough - ROUGH[0] - white * (ROUGH[1] - ROUGH[0]))[shows].max() < 0.8 * step
    # further away, where the mesh does not show the wave, its mean square slope makes the water rough
    slopes = (np.pi * 0.3 / 9.0) ** 2 / 2
    assert np.abs(rough - (ROUGH[0] ** 4 + slopes) ** 0.25)[(white == 0) & (cells > most)].max() < 0.8 * step
    surface = UsdShade.MaterialBindingAPI(prim).ComputeBoundMaterial()[0].ComputeSurfaceSource()[0]
    for port, reader in (("diffuseColor", "UsdPrimvarReader_float3"), ("roughness", "UsdPrimvarReader_float")):
        source = UsdShade.Shader(surface.GetInput(port).GetConnectedSources()[0][0].source.GetPrim())
        assert source.GetIdAttr().Get() == reader
        assert primvars.HasPrimvar(source.GetInput("varname").Get())


@pytest.mark.parametrize("foam", [0.05, 0.3, 0.6, 0.9])
def test_foam_is_as_dense_from_near_as_from_afar_and_has_soft_edges(foam):
    """Over a whole tile its mean is the foam itself, which distant water shows; much of it is thin."""
    from vehsim.exporters.usd.scenery.water_material import LACE_SIDE, patches

    x, y = np.moveaxis(np.indices((400, 400)) * LACE_SIDE / 400, 0, 0).reshape(2, -1)
    near, afar = (patches(np.stack([x, y]), np.full(x.size, foam), size) for size in (0.01, 100.0))
    assert np.ptp(afar) == 0 and near.mean() == pytest.approx(afar.mean(), abs=0.07)
    white, thin = near > 0.1 * near.max(), near < 0.9 * near.max()
    assert near.max() <= 1 and (thin & white).sum() > 0.25 * white.sum()


def test_foam_is_not_stretched_where_the_mesh_moved_to_a_hull(shown):
    """Water moves by at most choppiness times amplitude; points at the hull moved further."""
    from vehsim.exporters.pictures.water import WaterView
    from vehsim.exporters.usd.scenery.shading import light_for

    stage = StageReader(shown[1])
    view = WaterView(stage, light_for(stage.sun(), stage.sky()))
    place = stage.water_at(stage.frames[0])[0][:, :2]
    rest, anchors = (at - np.median(at - place, axis=0) for at in (TILE * stage.water_st(), view._anchors()))
    most = 0.6 * 0.3 / 2
    assert np.linalg.norm(place - rest, axis=1).max() > 2 * most
    assert np.linalg.norm(place - anchors, axis=1).max() < 1.3 * most


def test_water_shows_less_of_a_vehicles_shade(tmp_path, monkeypatch):
    """Below a boat that leaves the water: one afloat has its shade under water."""
    from vehsim.exporters.pictures import render

    clip = straight(6.0, 0.1, (-1.0, 0.0, 0.5))
    rig = CameraRig(name="low", rig="static", position=(0.0, -9.0, 1.4))
    world, frames = World(water=Water(0.0)), (1001, 1002)
    camera = solve_camera(rig, {"boat": clip}, world, frames)
    take = Take("sea", {"boat": clip}, world, (camera,), Fraction(FPS), frames, RenderSettings((320, 180)))
    stage, seen = take.export(tmp_path) / "sea.usda", []
    for share in (0.0, 0.5, 1.0):
        monkeypatch.setattr(render, "ON_WATER", share)
        with StageRenderer(StageReader(stage), (320, 180)) as renderer:
            seen.append(renderer.render("low", 1001).astype(float))
    clear, shown, dark = seen
    lost = (clear - dark) > 10
    assert lost.sum() > 100
    assert (clear - shown)[lost].sum() == pytest.approx(0.5 * (clear - dark)[lost].sum(), rel=0.1)


def test_calm_water_mirrors_what_stands_in_it(tmp_path, monkeypatch):
    """A red wall: the water in front of it gets redder; water beside it and the wall itself stay as they are."""
    from dataclasses import replace

    from vehsim.exporters.pictures.water import WaterView
    from vehsim.world.obstacles.obstacles import box

    wall = replace(box("wall", (0, 4, -1), (6, 1, 3)), finish="paint", colour=(0.9, 0.1, 0.1))
    clip, frames = straight(6.0, 0.1, (40.0, 40.0, 0.0)), (1001, 1002)
    world = World(water=Water(0.0), obstacles=[wall])
    rig = CameraRig(name="low", rig="static", position=(0.0, -9.0, 1.4), look_at=(0.0, 4.0, 0.0))
    camera = solve_camera(rig, {"boat": clip}, world, frames)
    take = Take("sea", {"boat": clip}, world, (camera,), Fraction(FPS), frames, RenderSettings((320, 180)))
    stage, seen = take.export(tmp_path) / "sea.usda", []
    for nothing in (False, True):
        if nothing:
            monkeypatch.setattr(WaterView, "_things", lambda *_: (np.zeros(0, int), np.zeros((3, 0))))
        with StageRenderer(StageReader(stage), (320, 180)) as renderer:
            seen.append(renderer.render("low", 1001).astype(float))
    redder = (seen[0] - seen[1]) @ (1.0, -0.5, -0.5)
    red = seen[1] @ (1.0, -0.5, -0.5) > 60
    foot = np.flatnonzero(red[:, 160]).max()
    assert redder[foot + 8 : foot + 25, 150:170].mean() > 15
    assert np.abs(redder[:, :40]).mean() < 1 and np.abs(redder[: foot - 3]).max() < 3


def test_ripples_have_zero_mean_and_repeat():
    import io

    from PIL import Image

    from vehsim.exporters.usd.scenery.water_material import STEEP, ripples

    with Image.open(io.BytesIO(ripples())) as picture:
        normal = np.asarray(picture, float) / 127.5 - 1
    assert np.abs(np.linalg.norm(normal, axis=2) - 1).max() < 0.02
    slopes = normal[..., :2] / normal[..., 2:]
    assert np.abs(slopes.mean(axis=(0, 1))).max() < 0.005
    assert slopes.std(axis=(0, 1)) == pytest.approx([STEEP, STEEP], rel=0.05)
    for axis in (0, 1):  # a seam would be steeper than what lies between texels elsewhere
        steps = np.abs(np.diff(normal, axis=axis, append=normal.take([0], axis)))
        assert steps.take(-1, axis).mean() < 1.5 * steps.mean()


def calm(tmp_path):
    """A calm sea with a view to its horizon."""
    clip = straight(0.0, 0.1, (-60.0, 0.0, 0.0))
    world = World(water=Water(0.0))
    camera = solve_camera(
        CameraRig(name="low", rig="static", position=(0.0, -9.0, 3.0)), {"boat": clip}, world, (1001, 1002)
    )
    take = Take("sea", {"boat": clip}, world, (camera,), Fraction(FPS), (1001, 1002), RenderSettings((320, 180)))
    return StageReader(take.export(tmp_path) / "sea.usda")


def test_water_is_as_bright_with_shadows_as_without(tmp_path):
    """MuJoCo clamps the light of each of its passes at 1 and adds what casts shadows in a pass of its own."""
    stage = calm(tmp_path)
    lower = slice(150, 180)
    seen = []
    for shadows in (True, False):
        with StageRenderer(stage, (320, 180), shadows=shadows) as renderer:
            seen.append(renderer.render("low", 1001)[lower].astype(float))
    assert seen[0].mean() > 20
    assert np.abs(seen[0] - seen[1]).max() <= 4


def test_the_sea_is_darker_than_the_sky_at_its_horizon(tmp_path):
    """Waves too distant to be distinguished mirror the sky higher up, not at its horizon; nothing is clipped to
    grey."""
    with StageRenderer(calm(tmp_path), (320, 180)) as renderer:
        picture = renderer.render("low", 1001).astype(float)
        depth = renderer.passes("low", 1001, ["depth"])["depth"]
    rim = int(np.flatnonzero(np.median(depth, axis=1) > 0)[0])  # the first row of water
    sky, sea = (
        np.median(picture[rows].reshape(-1, 3), axis=0) for rows in (slice(rim - 6, rim - 2), slice(rim + 3, rim + 7))
    )
    assert (sea < sky - 12).all()
    assert sea[2] > sea[0] + 4  # blue, where it was the sky's grey


def test_depth_is_converted_to_world_places():
    """A plane ten metres ahead, seen by a camera that looks along X."""
    near, far = 0.5, 1000.0
    depth = np.full((3, 5), near * (far - 10.0) / (10.0 * (far - near)))
    eye, forward, up = np.array([1.0, 2.0, 3.0]), np.array([1.0, 0, 0]), np.array([0, 0, 1.0])
    places, distance = places_of(depth, eye, forward, up, (0.5, 0.3), (near, far))
    assert distance == pytest.approx(np.full((3, 5), 10.0))
    assert places[1, 2] == pytest.approx([11.0, 2.0, 3.0])
    assert places[2, 4] == pytest.approx([11.0, 2.0 - 0.8 * 5.0, 3.0 + 2 / 3 * 3.0])
    shifted, _ = places_of(depth, eye, forward, up, (0.5, 0.3), (near, far), shift=(0.1, -0.2))
    assert shifted - places == pytest.approx(np.broadcast_to([0.0, -1.0, -2.0], places.shape))  # right is -Y


def test_at_utm_coordinates_it_keeps_its_points_and_its_pictures(tmp_path):
    """Single precision resolves 0.5 m there."""
    far = np.array([500_000.25, 4_212_000.5, 0.0])
    clip = straight(6.0, 0.25, far)
    world = World(water=Water(0.0, wave(0.3, 9.0, heading=2.0, choppiness=0.6)))
    take = Take("sea", {"boat": clip}, world, (), Fraction(FPS), (1001, 1007), RenderSettings((320, 180)))
    grid = water_grid.lay_grid(take)
    stage = StageReader(take.export(tmp_path) / "sea.usda")
    on, places = stage.water_net.of, authored.surfaces(take, grid, np.arange(1001.0, 1008.0))
    for frame, surface in zip(range(1001, 1008), places, strict=True):
        points = stage.water_at(frame)[0] + stage.origin
        assert np.abs(points - on(surface.points)).max() < 1e-3
    nearby = on(grid.xy) - TILE * stage.water_st()
    assert np.abs(nearby - PERIOD * np.round(nearby[0] / PERIOD)).max() < 1e-3


def test_the_surface_has_an_extent_at_every_frame_and_a_rest_pose(shown):
    """Readers that query without a time get calm water, not an empty mesh."""
    stage = Usd.Stage.Open(str(shown[1]))  # a prim is valid only while its stage is held
    mesh = UsdGeom.Mesh(stage.GetPrimAtPath("/sea/env/water/surface"))
    for when in (Usd.TimeCode.Default(), 1001, 1013, 1025):
        points, extent = (np.array(attribute.Get(when)) for attribute in (mesh.GetPointsAttr(), mesh.GetExtentAttr()))
        assert (extent == [points.min(axis=0), points.max(axis=0)]).all()
    assert np.ptp(np.array(mesh.GetPointsAttr().Get())[:, 2]) == 0.0


def test_still_water_has_waves_but_no_wakes_nor_foam(shown):
    """Its points lie on the sea itself; those of moving water, behind a boat at 6 m/s, do not."""
    take, _ = shown
    grid, frames = water_grid.lay_grid(take), np.arange(1001.0, 1026.0)
    takes = (replace(take, usd=UsdSettings(moving_water=moves)) for moves in (False, True))
    (*_, still), (*_, moving) = (authored.surfaces(each, grid, frames) for each in takes)
    assert not still.foam.any() and moving.foam.max() > 0.5
    near = (grid.cells < 0.5) & (still.lowered == 0) & (moving.lowered == 0)
    off = [each.points[near, 2] - take.world.water.height(each.points[near, :2], 1.0) for each in (still, moving)]
    assert np.abs(off[0]).max() < 0.01 < 0.05 < np.abs(off[1]).max()


def test_a_boat_that_was_planned_has_a_wake_like_one_that_was_simulated(shown):
    """It moves in the plane, and left the water untouched."""
    take, world = shown[0], World(water=Water(0.3))
    marks = [vehsim.Mark(1001 + 12 * k, position=(3.0 * k - 3.0, 0, 0), velocity=(6.0, 0, 0)) for k in range(3)]
    plan = vehsim.plan(BOAT, world, marks, segments=12, character="stunt")
    assert plan.success and plan.clip.twists.shape[1] == 3
    frames = np.arange(1001.0, 1026.0)
    both = {"plan": plan.clip, "simulation": straight(6.0, 1.0, (-3.0, 0.0, 0.3))}
    takes = [replace(take, world=world, clips={"boat": clip}) for clip in both.values()]
    own, other = (authored.floating(each, frames)["boat"] for each in takes)
    assert (own.volume, own.length, own.beam, own.centre) == (other.volume, other.length, other.beam, other.centre)
    assert 0.5 < own.wet.min() <= own.wet.max() < 1.0  # it planes
    grid = water_grid.lay_grid(takes[1])
    (*_, planned), (*_, simulated) = (authored.surfaces(each, grid, frames) for each in takes)
    assert planned.foam.max() > 0.4
    assert np.abs(planned.foam - simulated.foam).mean() < 0.1 * simulated.foam.mean()
    later = replace(plan.clip, positions=plan.clip.positions + np.array([0.0, 1.0, 0.0]))
    moved = replace(takes[0], clips={"boat": later})
    assert _stirred(moved) != _stirred(takes[0])  # the page draws its water again


def test_each_wave_fades_by_its_own_length():
    """Cells of 3 m carry a wave of 40 m as it is, and none of one of 4 m."""
    xy = np.column_stack([np.linspace(0, 400, 4001), np.zeros(4001)])
    sea = together(wave(2.0, 40.0), wave(0.5, 4.0), choppiness=0.0)
    for cell, waves in ((0.5, sea), (3.0, wave(2.0, 40.0))):
        steps = np.full(xy.shape, [cell, 0.0]), np.full(xy.shape, [0.0, cell])
        grid = SimpleNamespace(xy=xy, steps=steps)
        shown = authored._undisturbed(Water(surface=sea), grid)(1.3)
        np.testing.assert_allclose(shown[:, 2], Water(surface=waves).height(xy, 1.3), atol=1e-9)


def test_the_water_that_is_shown_is_sheltered_by_moles():
    """Behind a mole, the mesh is on the surface that hulls feel, and lower than before it."""
    x, y = np.meshgrid(np.linspace(-60, 60, 61), np.linspace(-20, 20, 21))
    xy = np.column_stack([x.ravel(), y.ravel()])
    mole = np.array([[0.0, -60.0], [0.0, 60.0]])
    water = Water(surface=together(wave(1.5, 20.0), choppiness=0.8, moles=[mole]))
    grid = SimpleNamespace(xy=xy, steps=(np.full(xy.shape, [0.1, 0.0]), np.full(xy.shape, [0.0, 0.1])))
    shown = np.array([authored._undisturbed(water, grid)(t) for t in (0.0, 0.9, 1.8)])
    for t, points in zip((0.0, 0.9, 1.8), shown, strict=True):
        clear = np.abs(points[:, 0]) > 3  # the mole itself is a step
        np.testing.assert_allclose(points[clear, 2], water.height(points[clear, :2], t), atol=0.02)
    before, behind = (np.std(shown[:, of, 2]) for of in (xy[:, 0] < -5, xy[:, 0] > 20))
    assert behind < 0.35 * before


def seas(count, spacing=25.0, seed=3):
    """A take of ``count`` boats on one sea of 2 m."""
    clips = {
        f"boat{k}": straight(3.0, 2.0, (spacing * (k % 5), spacing * (k // 5), 0.0)) for k in range(count)
    }  # fmt: skip
    return Take("sea", clips, World(water=Water(surface=sea_state(2.0, seed=seed))), (), Fraction(FPS), (1001, 1049))


@pytest.mark.parametrize("seed", [1, 3, 11])
def test_a_distant_sea_has_its_relief(seed):
    """Significant height over the simulated one, in rings around the boat; once 0.25 and 0.07 of it were left, later
    0.975 far away. Of waves that have enough cells there, nothing is lost."""
    take = seas(1, seed=seed)
    grid = water_grid.lay_grid(take)
    distance = np.linalg.norm(grid.xy - take.clips["boat0"].positions.mean(axis=0)[:2], axis=1)
    sea = take.world.water.surface
    for near, far, least in ((0, 20, 0.998), (35, 50, 0.995), (80, 150, 0.98)):
        ring = (distance > near) & (distance < far)
        length = 2 * np.pi / np.hypot(*sea.number.T)
        carried = length > distant_waves.CARRIED[1] * grid.cells[ring].max()
        long = Waves(sea.amplitude[carried], sea.number[carried], sea.phase[carried], sea.choppiness)
        for waves, kept in ((sea, least), (long, 0.998)):
            water, mesh, simulated = Water(surface=waves), [], []
            shown = authored._undisturbed(water, grid)
            for t in (0.0, 1.7, 3.1):
                points = shown(t)[ring]
                mesh.append(points[:, 2])
                simulated.append(water.height(points[:, :2], t))
            assert kept < np.std(mesh) / np.std(simulated) < 1.01


def test_the_stage_has_its_waves_as_numbers(tmp_path):
    """Their sum at the mesh's rest places is the water's surface, behind a mole and at any frame."""
    clip = straight(0.0, 0.1)
    mole = np.array([[20.0, -30.0], [20.0, 30.0]])
    sea = together(sea_state(0.8, seed=4), wave(0.3, 30.0), choppiness=0.0, moles=[mole])
    take = Take("sea", {"boat": clip}, World(water=Water(surface=sea)), (), Fraction(FPS), (1001, 1002))
    stage = StageReader(take.export(tmp_path, to=("usd",)) / "sea.usda")
    waves, rest = stage.water_waves(), TILE * stage.water_st()
    near = np.hypot(*rest.T) < 200
    theta = rest[near] @ waves.number.T + waves.phase
    for frame in (1001, 1002):
        every = np.cos(theta - waves.turn * frame) * waves.amplitude
        height = waves.share[near] * every[:, : waves.meshed].sum(axis=1)
        expected = take.world.water.height(rest[near], (frame - 1001) / FPS)
        np.testing.assert_allclose(height, expected, atol=2e-3)
    assert waves.share.min() < 0.8
    lengths = waves.lengths
    chop = lengths[waves.meshed :]
    assert len(chop) and chop.min() > 1.5 and chop.max() < lengths[: waves.meshed].min()


def test_shading_shows_the_waves_that_the_mesh_does_not(tmp_path, monkeypatch):
    """From a mast, a swell has rows up to the haze; nothing is added to those that the mesh has."""
    clip = straight(0.0, 0.1)
    world = World(water=Water(surface=wave(0.9, 22.0)))
    rig = CameraRig(name="mast", rig="static", position=(-150.0, 0.0, 40.0))
    camera = solve_camera(rig, {"boat": clip}, world, (1001, 1002))
    take = Take("sea", {"boat": clip}, world, (camera,), Fraction(FPS), (1001, 1002), RenderSettings((640, 360)))
    stage = StageReader(take.export(tmp_path, to=("usd",)) / "sea.usda")
    pictures = []
    for _ in range(2):
        with StageRenderer(stage, (640, 360)) as renderer:
            pictures.append(renderer.render("mast", 1001).astype(float).mean(axis=2))
            depth = renderer.passes("mast", 1001, ["depth"])["depth"]
        monkeypatch.setattr(StageReader, "water_waves", lambda self: None)
    added, far = (pictures[0] - pictures[1])[:, 300:340], np.where(depth > 0, depth, np.inf)[:, 300:340]
    assert np.abs(added[far < 240]).max() < 1
    beyond = (far > 360) & (far < 460)
    assert beyond.sum() > 500 and added[beyond].std() > 4


def test_twenty_boats_share_a_sea_as_fine_as_ones():
    one, twenty = (water_grid.lay_grid(seas(count)) for count in (1, 20))
    assert twenty.cells.min() < 1.1 * one.cells.min()


def test_a_grid_covers_its_boats_and_is_closed():
    grid = water_grid.lay_grid(seas(3))
    corners = grid.xy[grid.triangles]
    a, b = (corners[:, k] - corners[:, 0] for k in (1, 2))
    areas = (a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]) / 2
    assert areas.min() > -1e-9  # counter-clockwise from above
    outer = grid.distances[-1]
    assert areas.sum() == pytest.approx(np.pi * outer**2 + 4 * grid.half * outer, rel=2e-3)
    edges = np.sort(np.concatenate([grid.triangles[:, [k, (k + 1) % 3]] for k in range(3)]), axis=1)
    _, uses = np.unique(edges, axis=0, return_counts=True)
    assert set(uses) == {1, 2} and (uses == 1).sum() == grid.counts[-1]  # open only at the horizon
    net = water_grid.Net.over(grid.stored)
    assert (net.of(grid.xy).reshape(*net.shape, 2)[:, 0] == net.of(grid.xy).reshape(*net.shape, 2)[:, -1]).all()


def test_whitecaps_are_on_the_stage(tmp_path):
    """In the foam that renderers read; as much as Monahan measured, at different frames."""
    clip = straight(0.0, 4.0)
    world = World(water=Water(surface=sea_state(1.5, seed=5)), wind=(0.0, 15.0, 0.0))
    take = Take("sea", {"boat": clip}, world, (), Fraction(FPS), (1001, 1097))
    stage = Usd.Stage.Open(str(take.export(tmp_path) / "sea.usda"))
    foam = UsdGeom.PrimvarsAPI(stage.GetPrimAtPath("/sea/env/water/surface")).GetPrimvar("foam")
    white = [np.mean(foam.Get(frame)) for frame in range(1001, 1098, 12)]
    assert 1 / 1.5 < np.mean(white) / (3.84e-6 * 15.0**3.41) < 1.5


def test_whitecaps_do_not_depend_on_the_frames_asked_for():
    clip = straight(0.0, 3.0, (0.0, 0.0, 20.0))  # its wake would depend on them
    world = World(water=Water(surface=sea_state(1.5, seed=5)), wind=(0.0, 15.0, 0.0))
    take = Take("sea", {"boat": clip}, world, (), Fraction(FPS), (1001, 1073))
    grid, frames = water_grid.lay_grid(take), np.arange(1001.0, 1074.0)
    whole, end = (list(authored.surfaces(take, grid, asked)) for asked in (frames, frames[60:]))
    for one, other in zip(whole[60:], end, strict=True):
        assert (one[2] == other[2]).all()
    assert whole[-1][2].max() > 0.5


def test_water_flows_with_the_points_of_its_surface(shown):
    """Beside the pixels' own geometry: where the surface's points are seen one frame later and earlier, from the stage
    and a pinhole camera. Bound: 0.05 pixel."""
    take, path = shown
    frame, (width, height) = 1010, take.render.size
    stage = StageReader(path)
    renderer = StageRenderer(stage, (width, height))
    try:
        passes = renderer.passes("low", frame, ["flow", "normals", "depth"])
        flow, normals, depth = (passes[kind].astype(float) for kind in ("flow", "normals", "depth"))
    finally:
        renderer.close()
    here, upright = stage.water_at(frame)[:2]

    def seen(points, at):
        """Columns and rows of pixels' centres, and depths, of points (n, 3) at a frame."""
        view = stage.camera("low", at)
        own = (points - view.T_wc[:3, 3]) @ view.T_wc[:3, :3]
        x, y = (own[:, :2] / -own[:, 2:] / view.half_width).T
        return (x + 1) * width / 2 - 0.5, height / 2 - y * width / 2 - 0.5, -own[:, 2]

    column, row, away = seen(here, frame)
    there = (column > 1) & (column < width - 2) & (row > 1) & (row < height - 2) & (away > 1) & (away < 15)
    there &= np.abs(here[:, 1]) > 3.5  # not at the boat
    x, y = column[there], row[there]
    i, j = np.floor(y).astype(int), np.floor(x).astype(int)
    u, v = (x - j)[:, None], (y - i)[:, None]

    def between(image):
        image = image.reshape(height, width, -1)
        upper = (1 - u) * image[i, j] + u * image[i, j + 1]
        return (1 - v) * upper + v * ((1 - u) * image[i + 1, j] + u * image[i + 1, j + 1])

    visible = np.abs(between(depth)[:, 0] - away[there]) < 0.1
    assert visible.sum() > 150
    found = between(flow)[visible]
    for k, step in enumerate((1, -1)):
        columns, rows, _ = seen(stage.water_at(frame + step)[0][there][visible], frame + step)
        expected = np.stack([columns - x[visible], y[visible] - rows], axis=1)
        off = np.linalg.norm(found[:, 2 * k : 2 * k + 2] - expected, axis=1)
        still, _, _ = seen(here[there][visible], frame + step)
        assert np.abs(columns - still).max() > 0.2, "the waves move it, not only the camera"
        assert np.quantile(off, 0.99) < 0.05, (step, off.max())
    assert np.quantile(np.abs(between(normals)[visible] - upright[there][visible]).max(axis=1), 0.99) < 0.05
