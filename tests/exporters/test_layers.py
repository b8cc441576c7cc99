"""Samples for motion blur, few keys, value clips, versions and single files: each reads as the same motion."""

from __future__ import annotations

from fractions import Fraction

import numpy as np
import pytest

import vehsim
from vehsim.delivery.take import Take, UsdSettings
from vehsim.errors import InputError
from vehsim.exporters.usd.exporter import write_usd
from vehsim.exporters.usd.readback import world_matrices
from vehsim.exporters.usd.sampling import clip_at, fewest, fewest_poses
from vehsim.vehicles import load_vehicle

FRAMES = (1001, 1025)


@pytest.fixture(scope="module")
def weave():
    """A second of a car that weaves at 12 m/s, its wheels at 37 rad/s."""
    t = np.linspace(0, 1, 241)
    controls = np.column_stack([200 * np.ones_like(t), 0.5 * np.cos(9 * t)])
    return vehsim.simulate(load_vehicle("car"), None, controls, vehsim.State(twist=(0.0, 12.0, 0.0)), 1.0)


def take_of(clip, fps=Fraction(24), **settings):
    return Take("shot", {"it": clip}, vehsim.World(), (), fps, FRAMES, usd=UsdSettings(**settings))


def write(clip, folder, **settings):
    from pxr import Usd

    write_usd(take_of(clip, **settings), folder, lambda what, done: None)
    return Usd.Stage.Open(str(folder / "shot.usda"))


def chord_error(stage, clip, path, frames, point):
    """Distance, m, of a point of a prim from its path when matrices at its samples are interpolated linearly."""
    prim = stage.GetPrimAtPath(path)
    exact = world_matrices(prim, frames)[:, :3] @ point
    moved = (prim, stage.GetPrimAtPath("/shot/vehicles/it"))
    times = sorted({time for p in moved for attribute in p.GetAttributes() for time in attribute.GetTimeSamples()})
    samples = world_matrices(prim, np.array(times))[:, :3] @ point
    return np.linalg.norm(np.stack([np.interp(frames, times, samples[:, k]) for k in range(3)], 1) - exact, axis=1)


def test_an_open_shutter_holds_chords_to_a_millimetre(weave, tmp_path):
    stage = write(weave, tmp_path, shutter=(-0.25, 0.25))
    within = (np.arange(1001, 1026)[:, None] + np.linspace(-0.25, 0.25, 41)).ravel()
    rim = np.array([0.32, 0.0, 0.0, 1.0])
    assert chord_error(stage, weave, "/shot/vehicles/it/wheel_rl", within, rim).max() < 1.2e-3
    plain = write(weave, tmp_path / "plain")
    assert chord_error(plain, weave, "/shot/vehicles/it/wheel_rl", within, rim).max() > 0.05
    spins = stage.GetPrimAtPath("/shot/vehicles/it/wheel_rl").GetAttribute("xformOp:rotateY:spin").GetTimeSamples()
    per_frame = np.histogram(spins, np.arange(1000.5, 1026))[0]
    assert 3 < per_frame.max() <= 18
    assert (spins[0], spins[-1]) == (1000.75, 1025.25)


def test_no_wheel_turns_backwards_between_samples(weave, tmp_path):
    stage = write(weave, tmp_path, shutter=(-0.5, 0.5), thin=0.002)
    for corner in ("wheel_rl", "wheel_rr", "steer_fl/wheel_fl", "steer_fr/wheel_fr"):
        spin = stage.GetPrimAtPath(f"/shot/vehicles/it/{corner}").GetAttribute("xformOp:rotateY:spin")
        assert (np.diff([spin.Get(time) for time in spin.GetTimeSamples()]) > 0).all()


def test_a_rotor_too_fast_for_its_samples_warns(tmp_path):
    heli = load_vehicle("helicopter")
    clip = vehsim.simulate(heli, None, [18639.0, 0, 0, 0], vehsim.State(position=(0, 0, 20)), 1.0)
    with pytest.warns(UserWarning, match="main_rotor: .* mm off its path .* as its disc"):
        write(clip, tmp_path, shutter=(-0.5, 0.5))


def test_shutter_of_the_cameras(toys, make_take, tmp_path):
    from dataclasses import replace

    from pxr import Usd, UsdGeom

    take = make_take(toys.clip(toys.asset(tmp_path / "in" / "toy.usda")))
    write_usd(replace(take, usd=UsdSettings(shutter=(-0.25, 0.25))), tmp_path / "out", toys.silent)
    stage = Usd.Stage.Open(str(tmp_path / "out" / "shot.usda"))
    camera = UsdGeom.Camera(stage.GetPrimAtPath("/shot/cameras/chase"))
    assert (camera.GetShutterOpenAttr().Get(), camera.GetShutterCloseAttr().Get()) == (-0.25, 0.25)


def test_thinned_keys_stay_within_their_tolerance(weave, tmp_path):
    stage = write(weave, tmp_path, thin=0.003)
    frames = np.arange(FRAMES[0], FRAMES[1] + 1.0)
    prim = stage.GetPrimAtPath("/shot/vehicles/it")
    motion = prim.GetVariantSets().GetVariantSet("motion")
    assert (motion.GetVariantSelection(), set(motion.GetVariantNames())) == ("exact", {"exact", "thinned"})
    rims = np.array([[x, 0.0, z, 1.0] for x, z in ((0.32, 0), (-0.32, 0), (0, 0.32), (0, -0.32))])

    def points():
        """Points (p, n, 3) of the body's corners, and of the rims of a sliding wheel and of one that steers too."""
        corners = np.array([[x, y, z, 1.0] for x in (-0.8, 3.4) for y in (-0.9, 0.9) for z in (0.0, 1.3)])
        of = {"": corners, "/wheel_rr": rims, "/steer_fl/wheel_fl": rims}
        matrices = {p: world_matrices(stage.GetPrimAtPath(f"{prim.GetPath()}{p}"), frames)[:, :3] for p in of}
        return np.concatenate([np.einsum("nij,pj->pni", matrices[p], each) for p, each in of.items()])

    exact = points()
    motion.SetVariantSelection("thinned")
    assert 1e-4 < np.linalg.norm(points() - exact, axis=2).max() < 0.003
    assert len(prim.GetAttribute("xformOp:translate").GetTimeSamples()) < 25


def fewest_by_force(frames, values, tolerance):
    """The smallest number of samples whose chords are valid, by trying all subsets."""
    from itertools import combinations

    n = len(frames)
    for k in range(n - 1):
        for inner in combinations(range(1, n - 1), k):
            chosen = [0, *inner, n - 1]
            if np.abs(np.interp(frames, frames[chosen], values[chosen]) - values).max() <= tolerance + 1e-12:
                return k + 2
    return n


def test_fewest_keys_are_the_fewest():
    rng = np.random.default_rng(2)
    for _ in range(12):
        frames, values = np.arange(10.0), np.cumsum(rng.normal(size=10))
        chosen = fewest(frames, values, 0.6)
        assert np.abs(np.interp(frames, frames[chosen], values[chosen]) - values).max() <= 0.6 + 1e-12
        assert len(chosen) == fewest_by_force(frames, values, 0.6)


def test_few_orientations_slerp_within_their_angle():
    from scipy.spatial.transform import Rotation, Slerp

    t = np.linspace(0, 3, 73)
    q = Rotation.from_euler("ZYX", np.stack([t, 0.4 * np.sin(2 * t), 0.2 * t**2], 1))
    chosen = fewest_poses(t, q.as_quat(scalar_first=True), 0.01)
    error = (Slerp(t[chosen], q[chosen])(t).inv() * q).magnitude().max()
    assert error <= 0.01 and len(chosen) < 40


def test_a_clip_is_extrapolated_beyond_its_ends(weave):
    before, first = clip_at(weave, np.array([1000.75, 1001.0])), weave.at(0.0)
    assert before.positions[0, 0] == pytest.approx(first.positions[0, 0] - 12.0 * 0.25 / 24, abs=1e-3)
    assert np.diff(before.channels["roll_rl"])[0] == pytest.approx(12.0 / 0.32 * 0.25 / 24, rel=0.02)


def test_value_clips_read_as_one_layer(weave, tmp_path):
    from pxr import Sdf

    one, many = write(weave, tmp_path / "one"), write(weave, tmp_path / "many", clip_frames=10)
    frames = np.arange(FRAMES[0], FRAMES[1] + 0.1, 0.25)
    for path in ("/shot/vehicles/it", "/shot/vehicles/it/steer_fl/wheel_fl"):
        a, b = (world_matrices(stage.GetPrimAtPath(path), frames) for stage in (one, many))
        assert np.array_equal(a, b)
    layers = tmp_path / "many" / "layers"
    assert {path.name for path in layers.glob("it.anim.1*")} == {f"it.anim.{n}.usdc" for n in (1001, 1011, 1021)}
    held = []
    layer = Sdf.Layer.FindOrOpen(str(layers / "it.anim.usdc"))
    layer.Traverse("/", lambda path: held.extend(layer.ListTimeSamplesForPath(path)))
    assert held == []


def test_rational_rates_are_kept_exactly(weave, tmp_path):
    from dataclasses import replace

    stage = write(replace(weave, fps="24000/1001"), tmp_path, fps=Fraction(24000, 1001))
    assert Fraction(stage.GetTimeCodesPerSecond()).limit_denominator(1001) == Fraction(24000, 1001)
    assert stage.GetRootLayer().customLayerData["frameRate"] == "24000/1001"


def test_layers_only(weave, tmp_path):
    """One file per vehicle. It replaces an earlier one, is replaced by a whole delivery, and replaces one, whose report
    stays up to date."""
    from pxr import Usd

    def files(folder):
        return {path.relative_to(folder).as_posix() for path in folder.rglob("*") if path.is_file()}

    take = take_of(weave, layer_only=True)
    for _ in range(2):
        folder = take.export(tmp_path)
        assert files(folder) == {"layers/it.anim.usdc"}
    stage = Usd.Stage.Open(str(folder / "layers" / "it.anim.usdc"))
    assert stage.GetPrimAtPath("/it/steer_fl/wheel_fl").GetChildren(), "the asset itself is referenced"
    take_of(weave).export(tmp_path)
    assert {"shot.usda", "report.json"} < files(folder)
    take.export(tmp_path)
    assert files(folder) == {"layers/it.anim.usdc", "report.json"}
    (folder / "report.json").rename(folder / "notes.json")
    with pytest.raises(InputError, match="not written by vehsim"):
        take.export(tmp_path)


@pytest.mark.parametrize("to", ["png", "mp4", "flat"])
def test_layers_only_refuses_pictures_before_any_work(weave, tmp_path, to):
    with pytest.raises(InputError, match=f"(png|{to}).*layer_only omits"):
        take_of(weave, layer_only=True).export(tmp_path, to=("usd", to))
    assert not list(tmp_path.iterdir())


def test_versions_are_never_overwritten_and_latest_follows(weave, tmp_path):
    from pxr import Usd

    take = take_of(weave, versions=True)
    assert take.export(tmp_path).name == "v001"
    before = {path: path.read_bytes() for path in (tmp_path / "shot" / "v001").rglob("*") if path.is_file()}
    assert take.export(tmp_path).name == "v002"
    assert {path: path.read_bytes() for path in before} == before
    latest = Usd.Stage.Open(str(tmp_path / "shot" / "latest.usda"))
    assert latest.GetRootLayer().subLayerPaths[0] == "./v002/shot.usda"
    assert latest.GetPrimAtPath("/shot/vehicles/it/wheel_rl")
    assert (latest.GetStartTimeCode(), latest.GetEndTimeCode()) == FRAMES
    with pytest.raises(InputError, match="contains versions, which are never removed"):
        take_of(weave).export(tmp_path)
    plain = take_of(weave).export(tmp_path / "plain")
    with pytest.raises(InputError, match="contains other files than versions"):
        take.export(tmp_path / "plain")
    assert (plain / "shot.usda").is_file()
    assert not [path for path in (tmp_path / "shot").iterdir() if path.name.startswith(".")]


def test_packaged_and_flat_files_contain_the_same_shot(weave, tmp_path):
    from pxr import Usd

    folder = take_of(weave).export(tmp_path, to=("usd", "usdz", "flat"))
    frames = np.arange(FRAMES[0], FRAMES[1] + 1.0)
    whole = Usd.Stage.Open(str(folder / "shot.usda"))
    reference = world_matrices(whole.GetPrimAtPath("/shot/vehicles/it/wheel_rl"), frames)
    alone = take_of(weave).export(tmp_path / "alone", to=("usdz", "flat"))
    assert not (alone / "shot.usda").exists()
    for name in ("shot.usdz", "shot.flat.usdc"):
        stage = Usd.Stage.Open(str(alone / name))
        found = world_matrices(stage.GetPrimAtPath("/shot/vehicles/it/wheel_rl"), frames)
        assert np.array_equal(found, reference), name


def test_twenty_vehicles_add_one_asset_and_twenty_layers(toys, make_take, tmp_path):
    """Without payloads the stage has their motion and boxes, and none of their geometry."""
    from pxr import Usd, UsdGeom

    clip = toys.clip(toys.asset(tmp_path / "in" / "toy.usda"))
    folder = make_take(*[clip] * 20).export(tmp_path / "out")
    asset = folder / "assets" / "toy" / "toy.usda"
    assert [path.name for path in folder.rglob("toy.usda")] == ["toy.usda"]
    assert len(list((folder / "layers").glob("toy*"))) == 20
    whole, unloaded = (
        Usd.Stage.Open(str(folder / "shot.usda"), how) for how in (Usd.Stage.LoadAll, Usd.Stage.LoadNone)
    )
    assert asset.as_posix() not in {layer.realPath for layer in unloaded.GetUsedLayers()}
    assert len(unloaded.FindLoadable("/shot/vehicles")) == 20
    frames = np.arange(FRAMES[0], FRAMES[1] + 1.0)
    for path in ("/shot/vehicles/toy0", "/shot/vehicles/toy19"):
        loaded, light = (stage.GetPrimAtPath(path) for stage in (whole, unloaded))
        assert np.array_equal(world_matrices(light, frames), world_matrices(loaded, frames))
        cache = UsdGeom.BBoxCache(1001, ["default", "render"], useExtentsHint=False)
        box = cache.ComputeUntransformedBound(loaded).ComputeAlignedRange()
        low, high, *_ = UsdGeom.ModelAPI(light).GetExtentsHint()
        assert np.allclose([low, high], [box.GetMin(), box.GetMax()])


def test_cameras_see_the_same_in_any_units(toys, make_take, tmp_path):
    """Lens over distance is the same, and the camera's target is where the vehicle is."""
    from dataclasses import replace

    from pxr import Usd, UsdGeom

    take = make_take(toys.clip(toys.asset(tmp_path / "in" / "toy.usda")))
    seen = []
    for name, settings in (("ours", UsdSettings()), ("theirs", UsdSettings(up_axis="Y", meters_per_unit=0.01))):
        write_usd(replace(take, usd=settings), tmp_path / name, toys.silent)
        stage = Usd.Stage.Open(str(tmp_path / name / "shot.usda"))
        lens = UsdGeom.Camera(stage.GetPrimAtPath("/shot/cameras/chase")).GetCamera(1010)
        body = UsdGeom.XformCache(1010).GetLocalToWorldTransform(stage.GetPrimAtPath("/shot/vehicles/toy0"))
        frustum = lens.frustum
        view = frustum.ComputeViewMatrix() * frustum.ComputeProjectionMatrix()
        seen.append(np.array(view.Transform(body.ExtractTranslation())))
    assert seen[0] == pytest.approx(seen[1], abs=1e-5)
