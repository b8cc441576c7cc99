"""What an asset contains is cached by content, and never taken from another file or a layer without a file."""

import os
import subprocess
import sys
import warnings
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from pxr import Ar, Gf, Usd, UsdGeom

import vehsim
from tests.parts.test_reading import CUBE, add_cube, new_stage
from vehsim.rig import ops, parts
from vehsim.rig.ops import rig_problems
from vehsim.rig.parts import read_parts, solids
from vehsim.rig.rig import Drive, Rig
from vehsim.runtime.files import making_folder

ALONE = """
import sys, vehsim
from vehsim.world.obstacles.obstacles import ellipse
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
    monkeypatch.setattr(parts, "_read", lambda *args: (opened.append(args), read(*args))[1])
    return opened


def write(path: Path, size: float, inner: float = 1.0) -> Path:
    """A rig of a body and a wheel, in a layer that is closed afterwards."""
    stage = new_stage()
    UsdGeom.Xform.Define(stage, "/rig/body").AddRotateXYZOp().Set((10, 20, 30))
    add_cube(stage, "/rig/body/skin", size=size)
    UsdGeom.Xform.Define(stage, "/rig/body/wheel").AddTranslateOp().Set((2, 0, -1))
    add_cube(stage, "/rig/body/wheel/tyre", size=inner)
    stage.GetRootLayer().Export(str(path))
    return path


def reach(asset: Path) -> float:
    return max(float(np.abs(hull).max()) for solid in solids(asset) for hull in solid.hulls)


def test_cached_solids_equal_those_read(tmp_path, reads):
    asset = write(tmp_path / "rig.usda", 1.0)
    fresh, kept = solids(asset), solids(asset)
    assert len(reads) == 1 and [s.path for s in fresh] == ["body", "body/wheel"]
    for a, b in zip(fresh, kept, strict=True):
        assert (a.name, a.path, a.T_rp.tolist(), len(a.hulls)) == (b.name, b.path, b.T_rp.tolist(), len(b.hulls))
        assert all(np.array_equal(x, y) for x, y in zip(a.hulls, b.hulls, strict=True))
    with pytest.raises(vehsim.errors.InputError, match="no such prim"):
        solids(asset, "/other")  # the entry for one root is not used for another


def test_cached_parts_equal_those_read(tmp_path, reads):
    asset = write(tmp_path / "rig.usda", 1.0, 0.5)
    fresh, kept = read_parts(asset), read_parts(asset)
    assert len(reads) == 1 and [part.parent for part in fresh] == [None, "body"]
    wanted, _ = parts._read(asset, None)
    for a, b in zip([*fresh, *kept], [*wanted, *wanted], strict=True):
        assert (a.name, a.path, a.parent, a.rgba) == (b.name, b.path, b.parent, b.rgba)
        for name in ("T_pr", "T_rp", "points", "faces"):
            array, known = getattr(a, name), getattr(b, name)
            assert array.dtype == known.dtype and np.array_equal(array, known)
        assert all(np.array_equal(x, y) for x, y in zip(a.collision, b.collision, strict=True))
    write(asset, 3.0)
    assert np.abs(read_parts(asset)[0].points).max() > 1.5 * np.abs(fresh[0].points).max()


def test_cached_problems_of_a_rig_equal_those_found(tmp_path, monkeypatch):
    """Also for other drives of the same asset, and once it has changed."""
    asset, found = write(tmp_path / "rig.usda", 1.0), []
    search = ops._problems_of
    monkeypatch.setattr(ops, "_problems_of", lambda rig: (found.append(rig), search(rig))[1])
    right, wrong = (Rig(asset, "", drives={"lift": Drive(prim, "translateZ")}) for prim in ("body/wheel", "body/whel"))
    (first,), (again,) = rig_problems(wrong), rig_problems(wrong)
    assert first == again == next(search(wrong)) and "whel" in str(first) and len(found) == 1
    assert rig_problems(right) == rig_problems(right) == [] and len(found) == 2
    write(asset, 2.0)
    assert rig_problems(wrong) == [first] and len(found) == 3


def test_an_asset_that_changed_is_read_again(tmp_path, reads):
    asset = write(tmp_path / "rig.usda", 1.0)
    before = reach(asset)
    write(asset, 3.0)
    assert reach(asset) > 1.5 * before and len(reads) == 2
    write(asset, 1.0)
    assert reach(asset) == before and len(reads) == 2


def referring(path: Path, to: str) -> Path:
    """A rig with its own mesh, and a reference."""
    stage = new_stage()
    add_cube(stage, "/rig/own")
    stage.GetDefaultPrim().GetReferences().AddReference(to)
    stage.GetRootLayer().Export(str(path))
    return path


@pytest.mark.broken_stages
def test_referenced_files_are_part_of_the_key(tmp_path, reads):
    """Also if it was missing; the same file elsewhere refers to other files."""
    asset = referring(tmp_path / "rig.usda", "./body.usda")
    sizes = [reach(asset), reach(asset)]
    assert len(reads) == 2  # something is missing
    for size in (2.0, 4.0):
        write(tmp_path / "body.usda", size)
        sizes += [reach(asset), reach(asset)]
    assert len(reads) == 4 and sizes[0] == sizes[1] < sizes[2] == sizes[3] < sizes[4] == sizes[5]
    (tmp_path / "other").mkdir()
    write(tmp_path / "other" / "body.usda", 2.0)
    assert reach(referring(tmp_path / "other" / "rig.usda", "./body.usda")) == sizes[2] and len(reads) == 5
    (tmp_path / "body.usda").unlink()
    assert reach(asset) == sizes[0]


@pytest.mark.broken_stages
def test_files_found_by_a_resolver_are_not_cached(tmp_path, reads, monkeypatch):
    """It may find another file later, without notice."""
    (tmp_path / "library").mkdir()
    write(tmp_path / "library" / "body.usda", 2.0)
    asset, context = (
        referring(tmp_path / "rig.usda", "body.usda"),
        Ar.DefaultResolverContext([str(tmp_path / "library")]),
    )
    with Ar.ResolverContextBinder(context):
        monkeypatch.setattr(Usd.Stage, "Open", partial(Usd.Stage.Open, pathResolverContext=context))
        sizes = [reach(asset), reach(asset)]
        write(tmp_path / "body.usda", 1.0)
        sizes.append(reach(asset))
    assert len(reads) == 3 and sizes[0] == sizes[1] > sizes[2]


def test_files_written_during_reading_are_not_cached(tmp_path, reads, monkeypatch):
    body, read = write(tmp_path / "body.usda", 2.0), parts._read
    asset = referring(tmp_path / "rig.usda", "./body.usda")

    def written_after(*given):
        found = read(*given)
        write(body, 4.0)
        return found

    monkeypatch.setattr(parts, "_read", written_after)
    before = reach(asset)
    monkeypatch.setattr(parts, "_read", read)
    assert reach(asset) > before and reach(asset) > before and len(reads) == 2


def test_files_dated_in_the_future_are_cached(tmp_path, reads):
    """Clocks of two machines differ."""
    asset = write(tmp_path / "rig.usda", 1.0)
    os.utime(asset, (asset.stat().st_mtime + 1e6,) * 2)
    assert reach(asset) == reach(asset) and len(reads) == 1


def test_layers_open_in_memory_are_not_cached(tmp_path, reads):
    """A layer being edited differs from its file."""
    asset = write(tmp_path / "rig.usda", 1.0)
    stage = Usd.Stage.Open(str(asset))
    stage.GetPrimAtPath("/rig/body/skin").GetAttribute("points").Set([10 * Gf.Vec3f(*p) for p in CUBE.tolist()])
    edited = reach(asset)
    del stage
    assert reach(asset) < edited and len(reads) == 2


def test_warnings_are_repeated_from_the_cache(tmp_path, reads):
    stage = new_stage()
    add_cube(stage, "/rig/box", collides=False)
    stage.GetRootLayer().Export(str(tmp_path / "rig.usda"))
    for _ in range(2):
        with pytest.warns(UserWarning, match=r"no mesh carries UsdPhysics.CollisionAPI"):
            solids(tmp_path / "rig.usda")
    assert len(reads) == 1


def test_a_damaged_entry_is_made_again(tmp_path, cache, reads):
    asset = write(tmp_path / "rig.usda", 1.0)
    before = reach(asset)
    (entry,) = cache.glob("solids-*")
    entry.write_bytes(entry.read_bytes()[:-9])
    with pytest.warns(UserWarning, match="damaged"):
        assert reach(asset) == before
    with warnings.catch_warnings(action="error"):
        assert reach(asset) == before and len(reads) == 2


def test_a_plan_with_a_cached_vehicle_does_not_load_usd():
    for known in (False, True):
        output = subprocess.run([sys.executable, "-c", ALONE], capture_output=True, text=True, check=True)
        assert output.stdout.startswith("True ["), output.stdout + output.stderr
        assert known <= (output.stdout.strip() == "True []")


def test_a_folder_is_made_whole_or_not_at_all_and_the_first_one_stays(tmp_path):
    folder = tmp_path / "made"
    with making_folder(folder) as slower:
        slower.mkdir()
        (slower / "file").write_text("slower")
        with making_folder(folder) as faster:
            faster.mkdir()
            (faster / "file").write_text("faster")
            assert not folder.exists()
    assert (folder / "file").read_text() == "faster"
    with pytest.raises(ZeroDivisionError), making_folder(tmp_path / "broken") as beside:
        beside.mkdir()
        raise ZeroDivisionError
    assert [path.name for path in tmp_path.iterdir() if path.name != "cache"] == ["made"]
