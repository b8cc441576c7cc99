"""A vehicle of two plain hulls, a body and a rotor disc, and a separate cache for this run."""

from __future__ import annotations

import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from vehsim.rig.rig import Rig

sys.path.insert(0, str(Path(__file__).parent))  # hulls.py, which several tests share

BODY = np.array([[x, y, z] for x in (-3.0, 2.5) for y in (-0.9, 0.9) for z in (0.0, 2.2)])
ANGLES = 2 * np.pi * np.arange(16) / 16
DISC = np.array([[5.35 * np.cos(a), 5.35 * np.sin(a), z] for z in (2.9, 3.1) for a in ANGLES])


@pytest.fixture(scope="session", autouse=True)
def cache(tmp_path_factory):
    with pytest.MonkeyPatch.context() as patch:
        folder = tmp_path_factory.mktemp("cache")
        patch.setenv("VEHSIM_CACHE", str(folder))
        yield folder


@pytest.fixture(scope="session")
def hulls():
    return [BODY, DISC]


@pytest.fixture(scope="session")
def vehicle(tmp_path_factory):
    """The part of a vehicle that `World.clearance` uses: a rig whose asset contains the hulls."""
    from pxr import Usd, UsdGeom, UsdPhysics
    from scipy.spatial import ConvexHull

    file = tmp_path_factory.mktemp("vehicle") / "hulls.usda"
    stage = Usd.Stage.CreateNew(str(file))
    UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.z)
    stage.SetDefaultPrim(UsdGeom.Xform.Define(stage, "/v").GetPrim())
    for name, points in (("body", BODY), ("disc", DISC)):
        mesh = UsdGeom.Mesh.Define(stage, f"/v/{name}")
        faces = ConvexHull(points).simplices
        mesh.CreatePointsAttr(points.tolist())
        mesh.CreateFaceVertexCountsAttr([3] * len(faces))
        mesh.CreateFaceVertexIndicesAttr(faces.ravel().tolist())
        UsdPhysics.CollisionAPI.Apply(mesh.GetPrim())
    stage.Save()
    return SimpleNamespace(name="hulls", rig=Rig(asset=file, root=""))
