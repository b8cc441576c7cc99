"""Volume, centre and inertia of convex hulls compared with closed forms, and vehicles that are weighed."""

from __future__ import annotations

import numpy as np
import pytest

from vehsim.rig.hulls import hull_moments
from vehsim.vehicles import State, load_vehicle

CORNERS = np.array([(x, y, z) for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (-0.5, 0.5)])


def test_a_turned_box_in_closed_form():
    sides, place = np.array([2.0, 3.0, 0.7]), np.array([10.0, -20.0, 5.0])
    turn = np.linalg.qr(np.random.default_rng(3).normal(size=(3, 3)))[0]
    volume, centre, inertia = hull_moments([(CORNERS * sides) @ turn.T + place])[0]
    principal = volume / 12 * (sides @ sides - sides**2)
    assert volume == pytest.approx(sides.prod())
    assert centre == pytest.approx(place)
    np.testing.assert_allclose(inertia, turn @ np.diag(principal) @ turn.T, rtol=1e-9)


def test_a_simplex_in_closed_form():
    volume, centre, inertia = hull_moments([np.array([(0.0, 0, 0), (1, 0, 0), (0, 1, 0), (0, 0, 1)])])[0]
    assert volume == pytest.approx(1 / 6)
    assert centre == pytest.approx([0.25] * 3)
    np.testing.assert_allclose(np.diag(inertia), 2 * (1 / 60 - 1 / 96), rtol=1e-9)


@pytest.mark.parametrize("points", [CORNERS * [1, 1, 0], CORNERS[:3], CORNERS[:1]])
def test_flat_meshes_have_no_volume(points):
    assert hull_moments([points])[0][0] == 0.0


@pytest.mark.broken_stages
def test_a_vehicle_with_a_flat_part_is_weighed(tmp_path):
    """A decal without thickness has no mass, with a warning."""
    from pxr import Gf, Usd, UsdGeom

    stage = Usd.Stage.CreateNew(str(tmp_path / "it.usda"))
    UsdGeom.SetStageUpAxis(stage, "Z")
    UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    stage.SetDefaultPrim(UsdGeom.Xform.Define(stage, "/it").GetPrim())
    for name, points, faces in (
        ("body", CORNERS, [0, 1, 3, 2, 4, 6, 7, 5, 0, 4, 5, 1, 2, 3, 7, 6, 0, 2, 6, 4, 1, 5, 7, 3]),
        ("decal", np.array([(0, 0, 0.5), (1, 0, 0.5), (1, 1, 0.5), (0, 1, 0.5)]), [0, 1, 2, 3]),
    ):
        UsdGeom.Xform.Define(stage, f"/it/{name}")
        mesh = UsdGeom.Mesh.Define(stage, f"/it/{name}/mesh")
        mesh.CreatePointsAttr([Gf.Vec3f(*map(float, p)) for p in points])
        mesh.CreateFaceVertexCountsAttr([4] * (len(faces) // 4))
        mesh.CreateFaceVertexIndicesAttr(faces)
    stage.Save()
    text = 'model = "rigid_body"\nasset = "it.usda"\n[physics]\ndensity = 60.0\n'
    (tmp_path / "vehicle.toml").write_text(text)
    with pytest.warns(UserWarning, match=r"physics.density: decal is flat"):
        vehicle = load_vehicle(tmp_path)
    for twist, energy in (((0, 0, 0, 1, 0, 0), 60 / 2), ((0, 0, 1, 0, 0, 0), 10 / 2)):
        assert vehicle.energy(State(twist=twist))[0] == pytest.approx(energy)
    assert vehicle.rig.origin == pytest.approx((0, 0, 0), abs=1e-9)
