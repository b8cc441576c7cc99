"""Traps of assets, and of software that reads them."""

from __future__ import annotations

import json
import struct

import numpy as np
import pytest

from vehsim.errors import InputError
from vehsim.exporters.checks.validate import validate_stage
from vehsim.exporters.usd.exporter import write_usd
from vehsim.rig.ops import rig_problems
from vehsim.rig.rig import Drive, Rig
from vehsim.vehicles.library.imported import ready_asset


def made_by_blender(stage):
    """Mark the root prim as Blender's exporter does."""
    stage.GetDefaultPrim().SetCustomDataByKey("Blender:generated", True)


def test_a_layer_over_a_blender_asset_has_a_second_root(tmp_path, toys, make_take):
    """Blender's importer leaves out lone roots with its mark, and their motion; the mark may have any value."""
    from pxr import Usd

    write_usd(
        make_take(toys.clip(toys.asset(tmp_path / "a" / "toy.usda", edit=made_by_blender))), tmp_path, toys.silent
    )
    write_usd(make_take(toys.clip(toys.asset(tmp_path / "b" / "toy.usda"))), tmp_path / "plain", toys.silent)
    layers = [Usd.Stage.Open(str(folder / "layers" / "toy0.anim.usdc")) for folder in (tmp_path, tmp_path / "plain")]
    roots = [[prim.GetName() for prim in layer.GetPseudoRoot().GetChildren()] for layer in layers]
    assert roots == [["toy0", "blender_keeps_the_root"], ["toy0"]]
    shot = Usd.Stage.Open(str(tmp_path / "shot.usda"))
    assert not [prim for prim in shot.Traverse() if prim.GetName() == "blender_keeps_the_root"]


def test_skinned_parts_are_refused(tmp_path):
    """Skinning overrides the transform of a mesh's prim: an op there would have no visible effect."""
    from pxr import Sdf, Usd, UsdGeom, UsdSkel

    stage = Usd.Stage.CreateNew(str(tmp_path / "skinned.usda"))
    UsdGeom.SetStageUpAxis(stage, "Z")
    UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    stage.SetDefaultPrim(UsdGeom.Xform.Define(stage, "/cart").GetPrim())
    UsdSkel.Root.Define(stage, "/cart/rig")
    skeleton = UsdSkel.Skeleton.Define(stage, "/cart/rig/bones")
    skeleton.CreateJointsAttr(["axle"])
    for name, skinned in (("hung", False), ("wheel", True)):
        UsdGeom.Xform.Define(stage, f"/cart/rig/{name}")
        mesh = UsdGeom.Mesh.Define(stage, f"/cart/rig/{name}/mesh")
        mesh.CreatePointsAttr([(1, 0, 0), (-1, 1, 0), (-1, -1, 0), (0, 0, 1)])
        mesh.CreateFaceVertexCountsAttr([3] * 4)
        mesh.CreateFaceVertexIndicesAttr([0, 2, 1, 0, 1, 3, 1, 2, 3, 2, 0, 3])
        mesh.CreateExtentAttr([(-1, -1, 0), (1, 1, 1)])
        if skinned:
            binding = UsdSkel.BindingAPI.Apply(mesh.GetPrim())
            binding.CreateSkeletonRel().SetTargets([Sdf.Path("/cart/rig/bones")])
            binding.CreateJointIndicesPrimvar(False, 1).Set([0] * 4)
            binding.CreateJointWeightsPrimvar(False, 1).Set([1.0] * 4)
    stage.Save()
    drives = {"a": Drive("rig/hung", "rotateZ"), "b": Drive("rig/wheel", "rotateZ"), "whole": Drive("rig", "rotateZ")}
    problems = list(rig_problems(Rig(asset=tmp_path / "skinned.usda", root="", drives=drives)))
    assert [problem.key for problem in problems] == ["channels.b"] and "is skinned to joints" in problems[0].message


def glb(path, **more):
    """A cart with a wheel, with node names as in glTF; ``more``: further content of its JSON."""
    import trimesh

    scene = trimesh.Scene()
    scene.add_geometry(trimesh.creation.box((2, 1, 1)), node_name="Körper Haupt", geom_name="body")
    scene.add_geometry(
        trimesh.creation.box((1, 1, 1)), node_name="Rad (vorn) 1²", geom_name="wheel", parent_node_name="Körper Haupt"
    )
    data = scene.export(file_type="glb")
    (length,) = struct.unpack_from("<I", data, 12)
    text = json.dumps({**json.loads(data[20 : 20 + length]), **more}).encode()
    text += b" " * (-len(text) % 4)
    body = struct.pack("<I4s", len(text), b"JSON") + text + data[20 + length :]
    path.write_bytes(struct.pack("<4sII", b"glTF", 2, 12 + len(body)) + body)
    return {"asset": path.name}


def test_names_keep_their_letters(tmp_path):
    from pxr import Usd

    asset, _ = ready_asset(tmp_path / "vehicle.toml", glb(tmp_path / "Käfer 1.glb"))
    stage = Usd.Stage.Open(str(asset))
    names = [str(prim.GetPath()) for prim in stage.Traverse() if prim.GetTypeName() == "Xform"]
    assert "/Käfer_1/Körper_Haupt/Rad__vorn__1_" in names, names


def test_animation_in_a_glb_is_ignored_with_a_warning(tmp_path):
    with pytest.warns(UserWarning, match="has 1 animations and 2 skins; only its rest pose is read"):
        ready_asset(tmp_path / "vehicle.toml", glb(tmp_path / "bobbing.glb", animations=[{}], skins=[{}, {}]))


def test_too_many_parts_are_refused_before_they_are_converted(tmp_path, monkeypatch):
    """The limit counts nodes, and primitives of meshes; a USD vehicle has the same limit."""
    from vehsim.rig.parts import read_parts

    monkeypatch.setenv("VEHSIM_CACHE", str(tmp_path / "cache"))
    data = glb(tmp_path / "cart.glb")
    asset, _ = ready_asset(tmp_path / "vehicle.toml", data)
    monkeypatch.setenv("VEHSIM_READ_PARTS", "2")
    assert len(read_parts(asset)) == 2
    monkeypatch.setenv("VEHSIM_READ_PARTS", "1")
    with pytest.raises(InputError, match=r"2 parts, at most 1; join .*VEHSIM_READ_PARTS=4"):
        read_parts(asset)
    primitives = [{"attributes": {}}] * 3
    meshes = [{"primitives": primitives}, {"primitives": primitives}]
    for name, more in (("nodes", {}), ("primitives", {"meshes": meshes, "nodes": [{"mesh": 0}, {"mesh": 1}]})):
        with pytest.raises(InputError, match=f"{name}.glb: asset: {6 if more else 2} parts, at most 1"):
            ready_asset(tmp_path / "vehicle.toml", glb(tmp_path / f"{name}.glb", **more))
    assert not list((tmp_path / "cache" / "vehicles").glob("nodes-*"))


def test_hulls_of_all_parts_are_one_entry_of_the_cache(tmp_path, monkeypatch):
    """Storing looks at all entries of its kind: one for each part took 79 of 101 CPU s for 5,000 parts."""
    from vehsim.rig.parts import moments, read_parts, solids

    asset, _ = ready_asset(tmp_path / "vehicle.toml", glb(tmp_path / "cart.glb"))
    monkeypatch.setenv("VEHSIM_CACHE", str(tmp_path / "cache"))
    assert sum(volume for _, volume, _, _ in moments(read_parts(asset))) == pytest.approx(3.0)
    with pytest.warns(UserWarning, match="no mesh carries"):
        assert len(solids(asset)) == 2
    kinds = [file.name.partition("-")[0] for file in (tmp_path / "cache").iterdir()]
    assert kinds.count("hull_faces") == kinds.count("hulls") == 1


def test_a_scaled_root_has_the_right_unit(tmp_path, toys, make_take):
    """Blender writes centimetres as a scale of 100 on the root: our factor of 0.01 compensates it."""
    from pxr import Gf, UsdGeom

    def as_blender_does(stage):
        UsdGeom.Xformable(stage.GetDefaultPrim()).AddScaleOp().Set(Gf.Vec3f(100.0))
        for prim in stage.GetDefaultPrim().GetChildren():
            for op in UsdGeom.Xformable(prim).GetOrderedXformOps() if prim.IsA(UsdGeom.Xformable) else ():
                op.Set(op.Get() / 100)
            for mesh in (UsdGeom.Mesh(child) for child in prim.GetChildren() if child.IsA(UsdGeom.Mesh)):
                points = np.array(mesh.GetPointsAttr().Get()) / 100
                mesh.GetPointsAttr().Set([Gf.Vec3f(*point) for point in points.tolist()])
                mesh.GetExtentAttr().Set([Gf.Vec3f(*points.min(0).tolist()), Gf.Vec3f(*points.max(0).tolist())])

    asset = toys.asset(tmp_path / "in" / "toy.usda", 0.01, edit=as_blender_does)
    write_usd(make_take(toys.clip(asset)), tmp_path, toys.silent)
    assert [str(issue) for issue in validate_stage(tmp_path / "shot.usda")] == []


def test_warnings_on_the_command_line_show_no_source_lines(monkeypatch, capsys):
    import warnings

    from vehsim.cli import commands as cli

    monkeypatch.setattr(warnings, "formatwarning", warnings.formatwarning)
    monkeypatch.setattr(cli, "app", lambda **_: 0)
    cli.run([])
    assert warnings.formatwarning(UserWarning("look"), UserWarning, "a.py", 3) == "warning: look\n"
