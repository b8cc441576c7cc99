"""Mass, centre of mass and inertia of a vehicle's prim, as a physics engine reads them."""

from __future__ import annotations

from fractions import Fraction

import numpy as np
import pytest
from pxr import Gf, Usd, UsdGeom, UsdPhysics

import vehsim
from vehsim.delivery.take import Take, UsdSettings
from vehsim.exporters.usd.exporter import write_usd
from vehsim.vehicles import load_vehicle


def stage_of(name, folder, **settings):
    vehicle = load_vehicle(name)
    controls = np.zeros(len(vehicle.controls))
    state = vehsim.State(position=(0.0, 0.0, 50.0 * (vehicle.group.dim == 6)))
    clip = vehsim.simulate(vehicle, None, controls, state, 0.125)
    write_usd(
        Take("shot", {"it": clip}, vehsim.World(), (), Fraction(24), (1001, 1004), usd=UsdSettings(**settings)),
        folder,
        lambda what, done: None,
    )
    return Usd.Stage.Open(str(folder / "shot.usda"))


@pytest.mark.parametrize("settings", [{}, {"up_axis": "Y", "meters_per_unit": 0.01}])
def test_a_helicopter_has_its_mass_where_its_equations_put_it(tmp_path, settings):
    stage = stage_of("helicopter", tmp_path, **settings)
    prim = stage.GetPrimAtPath("/shot/vehicles/it")
    metres = settings.get("meters_per_unit", 1.0)
    physics = UsdPhysics.MassAPI(prim)
    assert prim.HasAPI(UsdPhysics.MassAPI) and physics.GetMassAttr().Get() == pytest.approx(1900.0)
    T_wp = UsdGeom.XformCache(1001).GetLocalToWorldTransform(prim)
    to_metres = np.diag([metres] * 3) if not settings else metres * np.array([[1, 0, 0], [0, 0, -1], [0, 1.0, 0]])
    centre = to_metres @ np.array(T_wp.Transform(Gf.Vec3d(*physics.GetCenterOfMassAttr().Get())))
    root = to_metres @ np.array(T_wp.ExtractTranslation())
    assert centre - root == pytest.approx([0.0, 0.0, 1.45], abs=1e-5)
    moments = np.array(physics.GetDiagonalInertiaAttr().Get()) * metres**2
    assert moments == pytest.approx([1300.0, 4700.0, 4200.0])  # about nose, side and top
    axes = Gf.Matrix3d(physics.GetPrincipalAxesAttr().Get()) * T_wp.RemoveScaleShear().ExtractRotationMatrix()
    for found, expected in zip(np.array(axes), np.eye(3), strict=True):
        along = to_metres @ found / metres
        assert np.abs(along) == pytest.approx(expected, abs=1e-5)


def test_vehicles_of_several_bodies_have_their_mass(tmp_path):
    for name, mass in (("car", 1350.0), ("truck", 7200.0 + 9000.0)):
        stage = stage_of(name, tmp_path / name)
        physics = UsdPhysics.MassAPI(stage.GetPrimAtPath("/shot/vehicles/it"))
        assert physics.GetMassAttr().Get() == pytest.approx(mass)
        assert not physics.GetDiagonalInertiaAttr().HasAuthoredValue()
