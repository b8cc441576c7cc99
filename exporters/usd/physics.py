"""Mass, centre of mass and inertia on a vehicle's prim, as UsdPhysics states them."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from vehsim.lie.quaternions import quaternions
from vehsim.rig.ops import open_rig
from vehsim.rig.parts import Y_UP_TO_Z_UP
from vehsim.vehicles.definition.inertia import known_inertia

if TYPE_CHECKING:
    from vehsim.exporters.usd.metadata import Units
    from vehsim.vehicles.definition.vehicle import Vehicle


def author_mass(prim: Any, vehicle: Vehicle, units: Units) -> None:
    """Apply ``PhysicsMassAPI`` with what the vehicle's equations use: kg, and kg times the stage's unit squared.

    One rigid body has all three. A vehicle of several bodies, or in the plane, has a mass only.
    """
    from pxr import Gf, UsdGeom, UsdPhysics

    if vehicle.rig is None or (known := known_inertia(vehicle)) is None:
        return
    mass, matrix = known
    physics = UsdPhysics.MassAPI.Apply(prim)
    physics.CreateMassAttr(mass)
    if matrix is None:
        return
    # the prim's own space is that of its asset, below the op that converts its unit
    stage, _ = open_rig(vehicle.rig.asset, vehicle.rig)
    turn = Y_UP_TO_Z_UP[:3, :3] if UsdGeom.GetStageUpAxis(stage) == UsdGeom.Tokens.y else np.eye(3)
    centre = turn.T @ np.asarray(vehicle.rig.origin) / UsdGeom.GetStageMetersPerUnit(stage)
    physics.CreateCenterOfMassAttr(Gf.Vec3f(*centre.tolist()))
    if np.allclose(matrix[3:, 3:], mass * np.eye(3)) and not matrix[3:, :3].any():
        moments, axes = np.linalg.eigh(matrix[:3, :3])
        if np.allclose(matrix[:3, :3], np.diag(np.diag(matrix[:3, :3]))):
            moments, axes = np.diag(matrix[:3, :3]), np.eye(3)  # in the order of the vehicle's own axes
        axes = axes * np.sign(np.linalg.det(axes))
        q = quaternions((turn.T @ axes)[None])[0].tolist()
        physics.CreateDiagonalInertiaAttr(Gf.Vec3f(*(moments / units.metres**2).tolist()))
        physics.CreatePrincipalAxesAttr(Gf.Quatf(q[0], *q[1:]))
