"""Guides show properties of the motion: forces, controls, contacts and wind. They are not rendered."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from vehsim.exporters.usd.exporter import write_usd
from vehsim.world.world import World

pytest.importorskip("pxr")


def guides(folder):
    from pxr import Usd

    stage = Usd.Stage.Open(str(folder / "shot.usda"))
    return stage, {prim.GetName(): prim for prim in stage.GetPrimAtPath("/shot/guides").GetChildren()}


def write(tmp_path, toys, make_take, **more):
    clip = toys.clip(toys.asset(tmp_path / "in" / "toy.usda"))
    clip = replace(clip, controls=np.linspace(0, 5, len(clip))[:, None], **more)
    write_usd(make_take(clip, world=World(wind=(0, 3, 0))), tmp_path, toys.silent)
    return clip, *guides(tmp_path)


def test_all_guides_are_of_purpose_guide(tmp_path, toys, make_take):
    from pxr import UsdGeom

    event = {"kind": "contact", "with": "dock", "time": 0.5, "place": [1.0, 2.0, 3.0], "speed": 1.0, "impulse": 40.0}
    _, _, prims = write(tmp_path, toys, make_take, events=(event,))
    assert set(prims) == {"toy0_path", "toy0_force", "toy0_contacts", "wind"}
    assert {UsdGeom.Imageable(prim).ComputePurpose() for prim in prims.values()} == {"guide"}


def test_controls_and_speed_are_attributes_of_the_path(tmp_path, toys, make_take):
    clip, _, prims = write(tmp_path, toys, make_take)
    lift = prims["toy0_path"].GetAttribute("vehsim:controls:lift")
    assert [lift.Get(frame) for frame in clip.frames] == pytest.approx(clip.controls[:, 0])
    assert lift.GetDocumentation() == "N"
    speed = prims["toy0_path"].GetAttribute("vehsim:speed").Get(1012)
    assert speed == pytest.approx(np.hypot(12.0, 2.0), rel=1e-3)  # 12 m/s round the bend, 2 m/s up


def test_the_force_arrow_points_into_the_bend_and_carries_the_weight(tmp_path, toys, make_take):
    """Closed form: 12 m/s on a radius of 12 m is 12 m/s^2 to the centre, and 1 g upwards."""
    from pxr import UsdGeom

    clip, _, prims = write(tmp_path, toys, make_take)
    k = 12
    root, tip = np.array(UsdGeom.BasisCurves(prims["toy0_force"]).GetPointsAttr().Get(clip.frames[k]))[:2]
    inwards = np.array([0.0, 12.0, clip.positions[k, 2]]) - clip.positions[k]
    expected = (12.0 * inwards / 12.0 + np.array([0, 0, 9.80665])) * (2.0 / 9.80665)
    assert np.allclose(root, clip.positions[k], atol=1e-5)
    assert np.allclose(tip - root, expected, atol=0.02)


def test_at_utm_coordinates_they_are_where_the_motion_is(tmp_path, toys, make_take):
    """Single precision resolves 0.5 m there."""
    from pxr import Gf, UsdGeom

    far = np.array([500_000.25, 4_212_000.5, 130.0])
    event = {"kind": "contact", "with": "dock", "time": 0.5, "place": far, "speed": 1.0, "impulse": 40.0}
    places = toys.clip(toys.asset(tmp_path / "in" / "toy.usda")).positions + far
    clip, _, prims = write(tmp_path, toys, make_take, events=(event,), positions=places)

    def points(name, frame):
        T = UsdGeom.XformCache(frame).GetLocalToWorldTransform(prims[name])
        given = UsdGeom.PointBased(prims[name]).GetPointsAttr().Get(frame)
        return np.array([T.Transform(Gf.Vec3d(*map(float, point))) for point in given])

    assert np.abs(points("toy0_path", 1001) - clip.positions).max() < 1e-3
    assert np.abs(points("toy0_contacts", 1001) - far).max() < 1e-3
    for frame, place in zip(clip.frames.tolist(), clip.positions, strict=True):
        assert np.abs(points("toy0_force", frame)[0] - place).max() < 1e-3


def test_contacts_have_place_frame_and_impulse(tmp_path, toys, make_take):
    from pxr import UsdGeom

    event = {"kind": "contact", "with": "dock", "time": 0.5, "place": [1.0, 2.0, 3.0], "speed": 1.0, "impulse": 40.0}
    _, _, prims = write(tmp_path, toys, make_take, events=(event,))
    points = UsdGeom.Points(prims["toy0_contacts"])
    assert np.allclose(points.GetPointsAttr().Get(), [[1, 2, 3]])
    primvars = UsdGeom.PrimvarsAPI(points)
    assert (primvars.GetPrimvar("frame").Get()[0], primvars.GetPrimvar("impulse").Get()[0]) == (1013.0, 40.0)


def test_wind_arrows_are_as_long_as_half_a_second_of_it(tmp_path, toys, make_take):
    from pxr import UsdGeom

    _, _, prims = write(tmp_path, toys, make_take)
    curves = UsdGeom.BasisCurves(prims["wind"])
    points = np.array(curves.GetPointsAttr().Get()).reshape(-1, 5, 3)
    assert np.allclose(points[:, 1] - points[:, 0], (0.0, 1.5, 0.0), atol=1e-5)


def test_extents_equal_usds_to_the_bit_and_the_text_layer_has_no_samples(tmp_path, toys, make_take):
    from pxr import Sdf, UsdGeom

    event = {"kind": "contact", "with": "dock", "time": 0.5, "place": [1.1, 2.3, 3.7], "speed": 1.0, "impulse": 40.0}
    _, stage, prims = write(tmp_path, toys, make_take, events=(event,))
    for prim in prims.values():
        guide = UsdGeom.Boundable(prim)
        for time in (1001.0, 1013.0):
            assert list(guide.GetExtentAttr().Get(time)) == list(guide.ComputeExtentFromPlugins(guide, time)), prim
    sampled = []
    text = stage.GetRootLayer()

    def note(path):
        spec = text.GetObjectAtPath(path)
        sampled.extend([path] * (isinstance(spec, Sdf.AttributeSpec) and bool(text.ListTimeSamplesForPath(path))))

    text.Traverse("/", note)
    assert not sampled
    for scope in ("cameras", "guides"):
        assert (tmp_path / "layers" / f"{scope}.usdc").is_file()
