"""Motion as sparse splines: within its tolerance of the clip at 64 instants of every frame, never turning back."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from pxr import Sdf, Ts, Usd, UsdGeom
from scipy.spatial.transform import Rotation

import vehsim
from vehsim.delivery.take import UsdSettings
from vehsim.errors import ExportError
from vehsim.exporters.usd.curves import Curve, count_keys, fit, fit_rotations, instants
from vehsim.exporters.usd.exporter import write_usd
from vehsim.exporters.usd.readback import world_matrices
from vehsim.rig.edited import parts_moved
from vehsim.rig.rig import Drive
from vehsim.rig.tolerances import curve_tolerances, reaches
from vehsim.vehicles import load_vehicle

TOLERANCE, ANGLE = 0.001, 0.05


def curved(take, folder, toys, **settings):
    """The stage with the curves of every vehicle."""
    write_usd(replace(take, usd=UsdSettings(curves=(TOLERANCE, ANGLE), **settings)), folder, toys.silent)
    stage = Usd.Stage.Open(str(folder / "shot.usda"))
    for prim in stage.GetPrimAtPath("/shot/vehicles").GetChildren():
        assert prim.GetVariantSets().GetVariantSelection("motion") == "exact"
        prim.GetVariantSets().SetSelection("motion", "curves")
    return stage


@pytest.mark.parametrize(
    ("up", "metres", "asset"), [("Z", 1.0, ("Z", 1.0)), ("Y", 0.01, ("Z", 1.0)), ("Z", 1.0, ("Y", 0.01))]
)
def test_curves_are_within_their_tolerance_at_64_instants(tmp_path, toys, make_take, up, metres, asset):
    """Poses are computed here from the clip's interpolant, not from the samples."""
    axis = "Z" if asset[0] == "Z" else "Y"
    clip = toys.clip(toys.asset(tmp_path / "in" / "toy.usda", asset[1], asset[0]), spin_axis=axis)
    stage = curved(make_take(clip), tmp_path, toys, up_axis=up, meters_per_unit=metres)
    prim, frames = stage.GetPrimAtPath("/shot/vehicles/toy0"), instants(1001, 1024)
    at = clip.at((frames - 1001) / 24)
    to_metres = np.diag([metres] * 3 + [1.0])
    if up == "Y":
        to_metres = np.array([[1, 0, 0, 0], [0, 0, -1, 0], [0, 1, 0, 0], [0, 0, 0, 1.0]]) @ to_metres
    found = to_metres @ world_matrices(prim, frames)
    assert np.linalg.norm(found[:, :3, 3] - at.positions, axis=1).max() < TOLERANCE * 1.0001
    own = np.eye(3) if asset[0] == "Z" else np.array([[1.0, 0, 0], [0, 0, -1.0], [0, 1.0, 0]])
    turned = Rotation.from_matrix(found[:, :3, :3] @ own.T / np.cbrt(np.linalg.det(found[:, :3, :3]))[:, None, None])
    error = (turned.inv() * Rotation.from_quat(at.orientations, scalar_first=True)).magnitude()
    assert np.degrees(error.max()) < ANGLE * 1.0001
    spin = stage.GetPrimAtPath("/shot/vehicles/toy0/rotor").GetAttribute(f"xformOp:rotate{axis}:spin")
    degrees = np.array([spin.Get(frame) for frame in frames.tolist()])
    assert np.abs(degrees - np.degrees(at.channels["rotor"])).max() < ANGLE and (np.diff(degrees) > 0).all()
    assert not spin.GetTimeSamples() and len(spin.GetSpline().GetKnots()) == 2, "a constant rate needs two keys"


@pytest.mark.parametrize("factor", [1.0, -2.0])
def test_without_an_angle_a_part_may_move_its_rim_by_the_tolerance(tmp_path, toys, make_take, factor):
    """The rotor is a box of 2.4 x 0.2 m. An explicit angle holds for it too, and needs more keys."""
    drive = Drive("rotor", "rotateZ", factor=factor)
    clip = toys.clip(toys.asset(tmp_path / "in" / "toy.usda"), drives={"rotor": drive})
    clip.channels["rotor"][:] = 8 * np.sin(9 * clip.times)
    distance, frames = 0.01, instants(1001, 1024)
    wanted = factor * clip.at((frames - 1001) / 24).channels["rotor"]
    keys, errors = [], []
    for angle in (ANGLE, None):
        take = replace(make_take(clip), usd=UsdSettings(curves=(distance, angle)))
        write_usd(take, tmp_path / str(angle), toys.silent)
        layer = Sdf.Layer.FindOrOpen(str(tmp_path / str(angle) / "layers" / "toy0.curves.usda"))
        spline = layer.GetAttributeAtPath("/toy0/rotor.xformOp:rotateZ:spin").GetSpline()
        keys.append(len(spline.GetKnots()))
        errors.append(np.abs(np.radians([spline.Eval(frame) for frame in frames.tolist()]) - wanted).max())
    assert errors[0] <= np.radians(ANGLE) and keys[1] < keys[0]
    assert np.radians(ANGLE) < errors[1] <= distance / np.hypot(1.2, 0.1)


def test_reaches_follow_an_asset_that_changes(tmp_path, toys):
    """They are cached; the box of 2 x 1 m is made half as long in the same file."""
    file = tmp_path / "toy.usda"
    rig = toys.clip(toys.asset(file)).vehicle.rig
    before = reaches(rig)
    assert before == reaches(rig) and abs(before["rotor"] - np.hypot(2.4, 0.2)) < 1e-6
    file.write_text(file.read_text().replace("2.4", "1.2"))
    assert abs(reaches(rig)["rotor"] - np.hypot(1.2, 0.2)) < 1e-6


def test_what_a_tolerance_permits_is_no_edit_of_a_part(tmp_path, toys, make_take):
    clip = toys.clip(toys.asset(tmp_path / "in" / "toy.usda"))
    clip.channels["rotor"][:] = 8 * np.sin(9 * clip.times)
    write_usd(replace(make_take(clip), usd=UsdSettings(curves=(0.02, None))), tmp_path, toys.silent)
    edited = Usd.Stage.Open(str(tmp_path / "shot.usda"))
    prim = edited.GetPrimAtPath("/shot/vehicles/toy0")
    prim.GetVariantSets().SetSelection("motion", "curves")
    edited.GetRootLayer().Save()
    frames = np.arange(1001.0, 1025.0)
    channels = clip.at((frames - 1001) / 24).channels

    def moved(curves):
        rig = clip.vehicle.rig
        return parts_moved(tmp_path / "shot.usda", str(prim.GetPath()), rig, channels, frames, 24.0, curves)

    assert [part.path for part in moved(None)] == ["rotor"], "its curve is more than 0.2 degrees off"
    tolerances = curve_tolerances(clip.vehicle.rig, 0.02, None)
    assert not moved(tolerances)
    spline = prim.GetChild("rotor").GetAttribute("xformOp:rotateZ:spin").GetSpline()
    for knot in spline.GetKnots().values():
        knot.SetValue(knot.GetValue() + 3.0)
        spline.SetKnot(knot)
    prim.GetChild("rotor").GetAttribute("xformOp:rotateZ:spin").SetSpline(spline)
    edited.GetRootLayer().Save()
    assert [part.path for part in moved(tolerances)] == ["rotor"]


def test_a_usd_without_splines_is_named(tmp_path, toys, make_take, monkeypatch):
    monkeypatch.delattr(Sdf.AttributeSpec, "SetSpline")
    monkeypatch.setattr(Usd, "GetVersion", lambda: (0, 24, 3))
    with pytest.raises(ExportError, match=r"export.curves.*USD 24.3 has no splines; leave it out, or use USD 25.8"):
        curved(make_take(toys.clip(toys.asset(tmp_path / "in" / "toy.usda"))), tmp_path, toys)


def test_a_part_that_slides_has_a_curve_of_numbers(tmp_path, toys, make_take):
    drive = Drive("body", "translateZ", factor=-2.0)
    clip = toys.clip(toys.asset(tmp_path / "in" / "toy.usda", 0.01), drives={"lift": drive})
    clip.channels["lift"][:] = np.sin(np.linspace(0, 3, len(clip.times)))
    stage = curved(make_take(clip), tmp_path, toys)
    body, frames = stage.GetPrimAtPath("/shot/vehicles/toy0/body"), instants(1001, 1024)
    spline = body.GetAttribute("xformOp:translateZ:slide").GetSpline()
    slid = np.array([spline.Eval(frame) for frame in frames.tolist()])
    wanted = -200 * clip.at((frames - 1001) / 24).channels["lift"]  # cm
    assert np.abs(slid - wanted).max() < 100 * TOLERANCE
    whole = np.arange(1001.0, 1025.0)
    exact = clip.matrices() @ [0, 0, 0.5, 1] - 2.0 * clip.channels["lift"][:, None] * clip.matrices()[:, :, 2]
    assert np.abs(world_matrices(body, whole)[:, :3, 3] - exact[:, :3]).max() < 3 * TOLERANCE


def test_a_car_needs_few_keys_and_its_wheels_never_turn_back(tmp_path, toys, make_take):
    """It starts, brakes to a standstill and starts again; the report counts the keys."""
    t = np.linspace(0, 4, 961)
    drive = np.select([t < 1, t < 2.4, t < 2.8], [400.0, -400.0, 0.0], 300.0)
    car = load_vehicle("car")
    controls = np.column_stack([drive, 0.2 * np.sin(2 * t)])
    clip = vehsim.simulate(car, None, controls, vehsim.State(twist=(0.0, 6.0, 0.0)), 4.0)
    take = replace(make_take(clip), frames=(1001, 1097), usd=UsdSettings(curves=(TOLERANCE, ANGLE)))
    folder = take.export(tmp_path)
    stage = Usd.Stage.Open(str(folder / "shot.usda"))
    stage.GetPrimAtPath("/shot/vehicles/toy0").GetVariantSets().SetSelection("motion", "curves")
    frames = instants(1001, 1097)
    at = clip.at((frames - 1001) / 24)
    for channel in ("roll_rl", "roll_fr"):
        prim = stage.GetPrimAtPath(f"/shot/vehicles/toy0/{car.rig.drives[channel].prim}")
        spline = prim.GetAttribute("xformOp:rotateY:spin").GetSpline()
        rolled = np.radians([spline.Eval(frame) for frame in frames.tolist()])
        assert np.degrees(np.abs(rolled - at.channels[channel]).max()) < ANGLE * 1.0001
        forward = np.diff(at.channels[channel]) >= 0
        assert forward.sum() > 1000 and (np.diff(rolled)[forward] > -np.radians(ANGLE) / 64).all()
    counted = json.loads((folder / "report.json").read_text())["vehicles"]["toy0"]["curves"]
    assert counted["keys"]["/toy0.xformOp:translateX"] == len(
        stage.GetPrimAtPath("/shot/vehicles/toy0").GetAttribute("xformOp:translateX").GetSpline().GetKnots()
    )
    assert counted["share_of_samples"]["spins"] < 0.1 and counted["share_of_samples"]["others"] < 0.2


def test_a_monotone_channel_has_a_monotone_curve():
    """Standing, then accelerating: a cubic within the tolerance would swing back first."""
    frames = instants(1001, 1101)
    t = (frames - 1001) / 24
    values = np.where(t < 2, 0.0, 900.0 * (t - 2) ** 2) + np.where(t > 3, 200.0 * np.sin(np.minimum(t - 3, 0.5)), 0)
    curve = fit(frames, values, 2.0)
    fine = curve(np.linspace(1001, 1101, 100_001))
    assert np.abs(curve(frames) - values).max() <= 2.0 and np.diff(fine).min() >= -1e-9
    assert (fine[:48_000] == 0.0).all() and len(curve.frames) < 20


def test_a_channel_that_grows_fast_does_not_swing_back_first():
    """One cubic from the start to 40 degrees is within two degrees of t^6, and swings back by two."""
    frames = instants(1001, 1049)
    curve = fit(frames, 40.0 * ((frames - 1001) / 48) ** 6, 2.0)
    assert np.diff(curve(np.linspace(1001, 1049, 50_001))).min() >= -1e-9 and len(curve.frames) < 10


def test_widths_of_tangents_save_keys():
    """A cubic with two free widths has an error of order six in its length, one with widths of a third of order four:
    4,096 times the precision takes 4 and 8 times the keys."""
    frames = instants(1001, 1241)
    values = 1000.0 * np.sin((frames - 1001) / 40)
    curves = [fit(frames, values, tolerance) for tolerance in (64.0**-1, 64.0**-3)]
    for curve, tolerance in zip(curves, (64.0**-1, 64.0**-3), strict=True):
        assert np.abs(curve(frames) - values).max() <= tolerance
        slopes = 25.0 * np.cos((curve.frames - 1001) / 40)
        assert np.abs(curve.slopes - slopes[:, None]).max() < 1e-3, "the same slope on both sides"
        both = curve.widths[:-1, 1] + curve.widths[1:, 0]
        assert (both <= np.diff(curve.frames) * (1 + 1e-12)).all()
        spline, between = curve.spline(), np.linspace(1001, 1241, 997)
        assert np.abs([spline.Eval(frame) for frame in between.tolist()] - curve(between)).max() < 1e-8
    assert len(curves[1].frames) < 5 * len(curves[0].frames)


def edited_turns(frames):
    """A wheel's angle in degrees, before and after an edit about frame 1101 that turns it by 300 more."""
    t = (frames - 1001) / 24
    values = 2000.0 * t + 900.0 * np.sin(t) + 40.0 * np.sin(5 * t)
    return values, values + 150.0 * (1 + np.tanh((frames - 1101) / 3))


def test_keys_stay_where_an_earlier_curve_shows_the_motion():
    """Behind the edit the wheel has turned farther; its keys stay on their frames, with their tangents."""
    frames, tolerance = instants(1001, 1241), 0.05
    values, more = edited_turns(frames)
    earlier = fit(frames, values, tolerance)
    made, anew = fit(frames, more, tolerance, earlier), fit(frames, more, tolerance)
    assert np.abs(made(frames) - more).max() <= tolerance and (np.diff(made(frames)) > 0).all()
    for curve, same in ((made, True), (anew, False)):
        behind = [(c.frames > 1130) & (c.frames < 1241) for c in (earlier, curve)]
        assert (set(earlier.frames[behind[0]]) == set(curve.frames[behind[1]])) is same
    kept = np.isin(made.frames, earlier.frames) & ((made.frames < 1065) | (made.frames > 1140))
    rows = np.searchsorted(earlier.frames, made.frames[kept])
    assert np.array_equal(made.slopes[kept], earlier.slopes[rows])
    assert np.array_equal(made.widths[kept], earlier.widths[rows])
    assert np.abs(made.slopes[1:-1, 0] - made.slopes[1:-1, 1]).max() < 1e-5, "one slope per key, also at the seams"
    assert len(made.frames) <= len(anew.frames) + 4


def test_a_delivery_that_retouches_another_keeps_its_keys(tmp_path, toys, make_take):
    """A coarser tolerance needs fewer keys; those of the retouched delivery show the motion too, so they stay."""
    take = make_take(toys.clip(toys.asset(tmp_path / "in" / "toy.usda")))
    coarse = replace(take, usd=UsdSettings(curves=(20 * TOLERANCE, 20 * ANGLE)))
    curved(take, tmp_path / "before", toys)
    write_usd(coarse, tmp_path / "anew", toys.silent)
    write_usd(replace(coarse, retouches=tmp_path / "before"), tmp_path / "kept", toys.silent)
    before, anew, kept = (
        count_keys(Sdf.Layer.FindOrOpen(str(tmp_path / name / "layers" / "toy0.curves.usda")))
        for name in ("before", "anew", "kept")
    )
    assert kept == before and sum(anew.values()) < sum(before.values())


def test_keys_of_a_coarse_curve_do_not_stay_under_a_finer_tolerance():
    frames = instants(1001, 1241)
    values, _ = edited_turns(frames)
    coarse = fit(frames, values, 5.0)
    assert np.abs(fit(frames, values, 0.05, coarse)(frames) - values).max() <= 0.05


def test_a_curve_is_read_from_its_spline():
    frames = instants(1001, 1241)
    curve = fit(frames, edited_turns(frames)[0], 0.05)
    read = Curve.of(curve.spline())
    for part in ("frames", "values", "slopes", "widths"):
        assert np.array_equal(getattr(read, part), getattr(curve, part))
    jump = curve.spline()
    knot = jump.GetKnot(float(curve.frames[3]))
    knot.SetPreValue(0.0)
    jump.SetKnot(knot)
    held = curve.spline()
    knot = held.GetKnot(float(curve.frames[3]))
    knot.SetNextInterpolation(Ts.InterpHeld)
    held.SetKnot(knot)
    assert Curve.of(jump) is None and Curve.of(held) is None


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_somersaults_about_any_axis_avoid_gimbal_lock(axis):
    frames = instants(1001, 1049)
    t = (frames - 1001) / 48
    angles = np.stack([0.3 * np.sin(3 * t + k) for k in range(3)], axis=1)
    angles[:, axis] += 2 * np.pi * t
    q = Rotation.from_euler("XYZ", angles).as_quat(scalar_first=True)
    axes, curves = fit_rotations(frames, q, np.radians(ANGLE))
    turned = Rotation.from_euler(axes, np.stack([c(frames) for c in curves], 1), degrees=True)
    error = (turned.inv() * Rotation.from_quat(q, scalar_first=True)).magnitude()
    assert np.degrees(error.max()) <= ANGLE * 1.0001 and axes[1] != "XYZ"[axis]
    assert sum(len(c.frames) for c in curves) < 0.4 * 3 * 49


def test_a_tumbling_body_keeps_sampled_orientations(tmp_path, toys, make_take):
    """It turns once about each of its axes, through gimbal lock of every order; the samples are within the
    tolerance."""
    clip = toys.clip(toys.asset(tmp_path / "in" / "toy.usda"), drives={"rotor": Drive("rotor", "rotateZ")})
    axis, share = np.divmod(np.arange(24), 8)
    vectors = np.zeros((24, 3))
    vectors[np.arange(24), axis] = share / 8 * 2 * np.pi
    half = np.linalg.norm(vectors, axis=1, keepdims=True) / 2
    turned = np.concatenate([np.cos(half), vectors / 2 * np.sinc(half / np.pi)], axis=1)
    turned[8:] *= -1.0
    turned[16:] *= -1.0
    twists = np.zeros((24, 6))
    twists[np.arange(24), axis] = 6 * np.pi
    clip = replace(clip, orientations=turned, twists=twists)
    stage = curved(make_take(clip), tmp_path, toys)
    prim, frames = stage.GetPrimAtPath("/shot/vehicles/toy0"), instants(1001, 1024)
    assert [op.GetOpName() for op in UsdGeom.Xformable(prim).GetOrderedXformOps()][3] == "xformOp:orient"
    found = Rotation.from_matrix(world_matrices(prim, frames)[:, :3, :3])
    at = clip.at((frames - 1001) / 24)
    error = (found.inv() * Rotation.from_quat(at.orientations, scalar_first=True)).magnitude()
    assert np.degrees(error.max()) < ANGLE * 1.0001
