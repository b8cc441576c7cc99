"""What can be hit of an asset is kept by its content: never what another file, or nobody's file, says."""

import subprocess
import sys
import warnings
from pathlib import Path

import numpy as np
import pytest
from pxr import Gf, Usd, UsdGeom

import vehsim
from tests.parts.test_reading import CUBE, add_cube, new_stage
from vehsim import parts
from vehsim.parts import solids

ALONE = """
import sys, vehsim
from vehsim.world.obstacles import ellipse
vehicle, world = vehsim.load_vehicle("car"), vehsim.World(obstacles=[ellipse("e", (4, 3), (1, 1))])
marks = [vehsim.Mark(1001, position=(0, 0, 0), heading=0), vehsim.Mark(1049, position=(8, 0, 0), heading=0)]
plan = vehsim.plan(vehicle, world, marks, segments=16, clearance=0.3)
print(plan.success, [name for name in sys.modules if name.split(".")[0] == "pxr"])
"""


@pytest.fixture(autouse=True)
def cache(tmp_path, monkeypatch):
    folder = tmp_path / "cache"
    monkeypatch.setenv("VEHSIM_CACHE", str(folder))
    return folder


@pytest.fixture
def reads(monkeypatch):
    """The assets that were opened."""
    opened, read = [], parts._read
    monkeypatch.setattr(parts, "_read", lambda *asked: (opened.append(asked), read(*asked))[1])
    return opened


def write(path: Path, size: float, inner: float = 1.0) -> Path:
    """A rig of a body and a wheel, by a layer that nobody holds afterwards."""
    stage = new_stage()
    UsdGeom.Xform.Define(stage, "/rig/body").AddRotateXYZOp().Set((10, 20, 30))
    add_cube(stage, "/rig/body/skin", size=size)
    UsdGeom.Xform.Define(stage, "/rig/body/wheel").AddTranslateOp().Set((2, 0, -1))
    add_cube(stage, "/rig/body/wheel/tyre", size=inner)
    stage.GetRootLayer().Export(str(path))
    return path


def reach(asset: Path) -> float:
    return max(float(np.abs(hull).max()) for solid in solids(asset) for hull in solid.hulls)


def test_what_is_kept_is_what_was_read(tmp_path, reads):
    asset = write(tmp_path / "rig.usda", 1.0)
    fresh, kept = solids(asset), solids(asset)
    assert len(reads) == 1 and [s.path for s in fresh] == ["body", "body/wheel"]
    for a, b in zip(fresh, kept, strict=True):
        assert (a.name, a.path, a.T_rp.tolist(), len(a.hulls)) == (b.name, b.path, b.T_rp.tolist(), len(b.hulls))
        assert all(np.array_equal(x, y) for x, y in zip(a.hulls, b.hulls, strict=True))
    with pytest.raises(vehsim.errors.InputError, match="no such prim"):
        solids(asset, "/other")  # what is kept for one root is not another's


def test_an_asset_that_changed_is_read_again(tmp_path, reads):
    asset = write(tmp_path / "rig.usda", 1.0)
    before = reach(asset)
    write(asset, 3.0)
    assert reach(asset) > 1.5 * before and len(reads) == 2
    write(asset, 1.0)
    assert reach(asset) == before and len(reads) == 2


def test_what_refers_to_other_files_is_read_each_time(tmp_path, reads):
    """As it is now: also where the other file was missing, and where it says what is missing in its turn."""
    stage = Usd.Stage.CreateInMemory()
    UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    UsdGeom.SetStageUpAxis(stage, "Z")
    stage.SetDefaultPrim(UsdGeom.Xform.Define(stage, "/rig").GetPrim())
    add_cube(stage, "/rig/own")
    stage.GetDefaultPrim().GetReferences().AddReference("./body.usda")
    stage.GetRootLayer().Export(str(tmp_path / "rig.usda"))
    sizes = [reach(tmp_path / "rig.usda")]
    for size in (2.0, 4.0):
        write(tmp_path / "body.usda", size)
        sizes.append(reach(tmp_path / "rig.usda"))
    assert len(reads) == 3 and sizes[0] < sizes[1] < sizes[2]


def test_what_somebody_holds_is_not_kept(tmp_path, reads):
    """A layer being edited is not its file."""
    asset = write(tmp_path / "rig.usda", 1.0)
    stage = Usd.Stage.Open(str(asset))
    stage.GetPrimAtPath("/rig/body/skin").GetAttribute("points").Set([10 * Gf.Vec3f(*p) for p in CUBE.tolist()])
    edited = reach(asset)
    del stage
    assert reach(asset) < edited and len(reads) == 2


def test_warnings_are_heard_each_time(tmp_path, reads):
    stage = new_stage()
    add_cube(stage, "/rig/box", collides=False)
    stage.GetRootLayer().Export(str(tmp_path / "rig.usda"))
    for _ in range(2):
        with pytest.warns(UserWarning, match=r"no mesh carries UsdPhysics.CollisionAPI"):
            solids(tmp_path / "rig.usda")
    assert len(reads) == 2


def test_a_damaged_entry_is_made_again(tmp_path, cache, reads):
    asset = write(tmp_path / "rig.usda", 1.0)
    before = reach(asset)
    (entry,) = cache.glob("solids-*")
    entry.write_bytes(entry.read_bytes()[:-9])
    with pytest.warns(UserWarning, match="damaged"):
        assert reach(asset) == before
    with warnings.catch_warnings(action="error"):
        assert reach(asset) == before and len(reads) == 2


def test_a_plan_of_a_vehicle_that_is_known_needs_no_usd():
    for known in (False, True):
        said = subprocess.run([sys.executable, "-c", ALONE], capture_output=True, text=True, check=True)
        assert said.stdout.startswith("True ["), said.stdout + said.stderr
        assert known <= (said.stdout.strip() == "True []")
