"""A vehicle without an asset gets one: parts at the given places, driven by its channels, valid USD."""

import runpy
from pathlib import Path

import numpy as np
import pytest

import vehsim
from vehsim.errors import InputError
from vehsim.vehicles.primitives import Box, Wheel, default_parts, with_primitives

ROOT = Path(__file__).parents[2]


@pytest.fixture
def cart():
    return runpy.run_path(str(ROOT / "examples" / "own_vehicle.py"))["cart"]


def test_the_tutorial_fits_in_sixty_lines_and_its_cart_rolls(cart):
    assert len((ROOT / "examples" / "own_vehicle.py").read_text().splitlines()) < 60
    clip = vehsim.simulate(cart, None, [20.0, 3.0], duration=2.0)
    # both wheels' angles and the yaw agree: theta = rho (right - left) / (2 b)
    yaw = np.unwrap(2 * np.arctan2(clip.orientations[:, 3], clip.orientations[:, 0]))
    rolled = 0.25 / 0.8 * (clip.channels["roll_right"] - clip.channels["roll_left"])
    np.testing.assert_allclose(yaw, rolled, atol=2e-3)
    assert yaw[-1] > 0.1


def test_parts_stand_where_they_were_put_and_faces_look_outwards(cart, tmp_path):
    from pxr import Usd, UsdGeom

    parts = {"bed": Box((2, 1, 0.5), at=(0, 0, 1)), "wheel": Wheel(0.3, 0.1, (0.5, 0, -0.2), parent="bed")}
    vehicle = with_primitives(cart, tmp_path, parts)
    stage = Usd.Stage.Open(str(vehicle.rig.asset))
    bed = UsdGeom.Mesh(stage.GetPrimAtPath("/cart/bed/bed_shape"))
    assert UsdGeom.Xformable(stage.GetPrimAtPath("/cart/bed/wheel")).GetLocalTransformation()[3][0] == 0.5
    for path in ("/cart/bed/bed_shape", "/cart/bed/wheel/wheel_shape", "/cart/bed/wheel/wheel_mark"):
        mesh = UsdGeom.Mesh(stage.GetPrimAtPath(path))
        points, normals = (np.array(a.Get()) for a in (mesh.GetPointsAttr(), mesh.GetNormalsAttr()))
        counts = np.array(mesh.GetFaceVertexCountsAttr().Get())
        starts = np.concatenate([[0], np.cumsum(counts)[:-1]])
        middles = np.array([points[s : s + n].mean(0) for s, n in zip(starts, counts, strict=True)])
        assert np.all(np.sum(middles * normals[starts], axis=1) > 0), path
    np.testing.assert_allclose(np.array(bed.GetExtentAttr().Get()), [[-1, -0.5, -0.25], [1, 0.5, 0.25]])


def test_default_parts_show_every_channel_and_export_validates(cart, tmp_path):
    from vehsim.exporters.checks.validate import validate_stage

    vehicle = with_primitives(cart, tmp_path / "assets")
    assert set(vehicle.rig.drives) == set(cart.channels) <= set(default_parts(cart))
    path = vehsim.simulate(vehicle, None, [30.0, 0.0], duration=0.5).export(tmp_path / "cart.usda")
    assert not validate_stage(path)


@pytest.mark.parametrize(
    ("parts", "message"),
    [
        ({"a": Wheel(0.1, channel="spin")}, "channel = 'spin': unknown; cart has roll_left, roll_right"),
        ({"a": Box((1, 1, 1), parent="b")}, "parent = 'b'"),
        ({"a": Box((1, 1, 1), parent="b"), "b": Box((1, 1, 1), parent="a")}, "form a cycle"),
    ],
)
def test_wrong_parts_are_named(cart, tmp_path, parts, message):
    with pytest.raises(InputError, match=message):
        with_primitives(cart, tmp_path, parts)
