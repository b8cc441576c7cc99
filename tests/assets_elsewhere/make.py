"""Save the assets of this folder with Blender (bpy 5.0): vehicles as in other people's scenes, each with its traps.

Run it with a Python that has bpy, then with one that has usd-core: ``python tests/assets_elsewhere/make.py``. Its files
are committed.

- ``pickup``: USD, Y up, centimetres, nose along +Z; wheels are instances of one asset, nested below axles, the chassis
  comes by payload; a variant set ``paint``.
- ``gyro``: GLB, a tree of nodes, nose along Blender's -Y; a rotor on a mast, one on the tail.
- ``kart``: OBJ in centimetres, every vertex in world coordinates, so that no wheel has a pivot.
- ``crawler``: USD, Z up, a scene whose parts hang on the bones of an armature, with their own bobbing animation.
"""

from __future__ import annotations

import math
import sys
from pathlib import Path

try:
    import bpy
except ImportError:  # the second run, which assembles the pickup
    bpy = None

HERE = Path(__file__).resolve().parent


def fresh() -> None:
    bpy.ops.wm.read_factory_settings(use_empty=True)


def paint(name: str, colour: tuple[float, float, float]):
    material = bpy.data.materials.get(name) or bpy.data.materials.new(name)
    material.use_nodes = True
    material.node_tree.nodes["Principled BSDF"].inputs["Base Color"].default_value = (*colour, 1.0)
    material.node_tree.nodes["Principled BSDF"].inputs["Roughness"].default_value = 0.45
    return material


def finish(name: str, material, parent=None):
    made = bpy.context.object
    made.name = made.data.name = name
    made.data.materials.append(material)
    if parent is not None:
        made.parent = parent
    return made


def box(name: str, at, size, material, parent=None, bevel: float = 0.0):
    bpy.ops.mesh.primitive_cube_add(size=1.0, location=at)
    made = bpy.context.object
    made.scale = size
    bpy.ops.object.transform_apply(location=False, rotation=False, scale=True)
    if bevel:
        modifier = made.modifiers.new("bevel", "BEVEL")
        modifier.width, modifier.segments = bevel, 2
    return finish(name, material, parent)


def wheel(name: str, at, radius: float, width: float, material, parent=None, vertices: int = 24):
    """A tyre with a spoke that makes its rotation visible; its axle is its own Z, aligned with Blender's X."""
    bpy.ops.mesh.primitive_cylinder_add(vertices=vertices, radius=radius, depth=width, location=at)
    made = finish(name, material, parent)
    made.rotation_euler = (0.0, math.pi / 2, 0.0)
    bpy.ops.mesh.primitive_cube_add(size=1.0, location=(0.0, 0.0, 0.0))
    spoke = finish(f"{name}_spoke", paint("rim", (0.7, 0.7, 0.72)), made)
    spoke.scale = (radius * 1.5, radius * 0.25, width * 1.1)
    return made


def save_usd(path: Path, up: str = "Y", metres: float = 1.0, animated: bool = False) -> None:
    """Nose along Blender's -Y, which becomes +Z when Y is up."""
    bpy.ops.wm.usd_export(
        filepath=str(path),
        export_animation=animated,
        convert_orientation=up == "Y",
        export_global_forward_selection="NEGATIVE_Z" if up == "Y" else "Y",
        export_global_up_selection=up,
        convert_scene_units="CENTIMETERS" if metres == 0.01 else "METERS",
        convert_world_material=False,
        relative_paths=True,
    )


def pickup(folder: Path) -> None:
    """A pickup as a studio would publish it: chassis and wheel are assets of their own."""
    fresh()
    red, glass = paint("paint", (0.5, 0.03, 0.02)), paint("glass", (0.03, 0.05, 0.06))
    bed = box("chassis", (0, 0, 0.62), (1.8, 4.6, 0.42), red, bevel=0.08)
    box("cab", (0, -0.35, 0.55), (1.6, 1.7, 0.75), glass, bed, bevel=0.15)
    box("hood", (0, -1.6, 0.25), (1.7, 1.2, 0.25), red, bed, bevel=0.08)
    save_usd(folder / "chassis.usdc", metres=0.01)
    fresh()
    wheel("wheel", (0, 0, 0), 0.38, 0.28, paint("rubber", (0.02, 0.02, 0.022)))
    save_usd(folder / "wheel.usdc", metres=0.01)


def assemble_pickup(folder: Path) -> None:
    from pxr import Kind, Sdf, Usd, UsdGeom

    stage = Usd.Stage.CreateNew(str(folder / "pickup.usda"))
    UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.y)
    UsdGeom.SetStageMetersPerUnit(stage, 0.01)
    root = UsdGeom.Xform.Define(stage, "/pickup")
    stage.SetDefaultPrim(root.GetPrim())
    Usd.ModelAPI(root).SetKind(Kind.Tokens.component)
    UsdGeom.Xform.Define(stage, "/pickup/geo").GetPrim()
    body = UsdGeom.Xform.Define(stage, "/pickup/geo/body").GetPrim()
    body.GetPayloads().AddPayload("./chassis.usdc")
    for axle, z in (("front", 150.0), ("rear", -150.0)):
        across = UsdGeom.Xform.Define(stage, f"/pickup/geo/axle_{axle}")
        across.AddTranslateOp().Set((0.0, 38.0, z))
        for side, x in (("left", 80.0), ("right", -80.0)):
            hub = UsdGeom.Xform.Define(stage, f"/pickup/geo/axle_{axle}/{side}")
            hub.AddTranslateOp().Set((x, 0.0, 0.0))
            placed = UsdGeom.Xform.Define(stage, f"/pickup/geo/axle_{axle}/{side}/wheel").GetPrim()
            placed.GetReferences().AddReference("./wheel.usdc")
            placed.SetInstanceable(True)
    variants = root.GetPrim().GetVariantSets().AddVariantSet("paint")
    colours = {"red": (0.5, 0.03, 0.02), "blue": (0.02, 0.08, 0.4)}
    shader = next(p.GetPath() for p in stage.Traverse() if p.GetTypeName() == "Shader" and "paint" in str(p.GetPath()))
    for name, colour in colours.items():
        variants.AddVariant(name)
        variants.SetVariantSelection(name)
        with variants.GetVariantEditContext():
            stage.OverridePrim(shader).CreateAttribute("inputs:diffuseColor", Sdf.ValueTypeNames.Color3f).Set(colour)
    variants.SetVariantSelection("red")
    stage.Save()


def gyro(folder: Path) -> None:
    fresh()
    white, dark = paint("shell", (0.75, 0.76, 0.78)), paint("rotor", (0.05, 0.05, 0.06))
    cabin = box("cabin", (0, 0, 1.1), (1.3, 2.2, 1.3), white, bevel=0.3)
    box("boom", (0, 2.6, 0.25), (0.25, 3.4, 0.25), white, cabin)
    box("fin", (0, 4.2, 0.7), (0.08, 0.5, 1.0), paint("fin", (0.7, 0.1, 0.02)), cabin)
    for name, x in (("left", 0.8), ("right", -0.8)):
        box(f"skid_{name}", (x, 0, -1.05), (0.08, 2.4, 0.08), dark, cabin)
    mast = box("mast", (0, 0, 0.85), (0.12, 0.12, 0.5), dark, cabin)
    hub = box("main_rotor", (0, 0, 0.3), (0.25, 7.6, 0.03), dark, mast)
    box("blade_across", (0, 0, 0), (7.6, 0.25, 0.03), dark, hub)
    box("tail_rotor", (0.12, 4.2, 0.7), (0.03, 0.12, 1.5), dark, cabin)
    file = str(folder / "gyro.glb")
    bpy.ops.export_scene.gltf(filepath=file, export_format="GLB", export_yup=True, export_apply=True)


def kart(folder: Path) -> None:
    fresh()
    box("frame", (0, 0, 0.2), (0.9, 1.9, 0.12), paint("steel", (0.05, 0.25, 0.08)), bevel=0.03)
    box("seat", (0, 0.3, 0.45), (0.5, 0.45, 0.4), paint("seat", (0.02, 0.02, 0.02)))
    for name, x, y in (("fl", 0.5, -0.65), ("fr", -0.5, -0.65), ("rl", 0.5, 0.65), ("rr", -0.5, 0.65)):
        made = wheel(f"tyre_{name}", (x, y, 0.14), 0.14, 0.16, paint("rubber", (0.02, 0.02, 0.022)), vertices=16)
        for spoke in list(made.children):
            bpy.data.objects.remove(spoke)
    bpy.ops.wm.obj_export(
        filepath=str(folder / "kart.obj"),
        global_scale=100.0,
        forward_axis="NEGATIVE_Z",
        up_axis="Y",
        export_materials=True,
        export_object_groups=False,
        apply_modifiers=True,
    )


def crawler(folder: Path) -> None:
    """A rover whose wheels ride on bones; the body bone bobs by its own animation, the wheels hang below it."""
    fresh()
    scene = bpy.context.scene
    scene.frame_start, scene.frame_end, scene.render.fps = 1, 48, 24
    bpy.ops.object.armature_add(location=(0, 0, 0))
    rig = bpy.context.object
    rig.name = rig.data.name = "rig"
    bpy.ops.object.mode_set(mode="EDIT")
    bones = rig.data.edit_bones
    bones[0].name, bones[0].head, bones[0].tail = "chassis", (0, 0, 0.5), (0, 0, 0.9)
    for name, x, y in (("fl", 0.7, -0.9), ("fr", -0.7, -0.9), ("rl", 0.7, 0.9), ("rr", -0.7, 0.9)):
        bone = bones.new(f"wheel_{name}")
        bone.head, bone.tail, bone.parent = (x, y, 0.35), (x + math.copysign(0.3, x), y, 0.35), bones["chassis"]
    bpy.ops.object.mode_set(mode="OBJECT")

    def hang(made, bone: str) -> None:
        world = made.matrix_world.copy()
        made.parent, made.parent_type, made.parent_bone = rig, "BONE", bone
        bpy.context.view_layer.update()
        made.matrix_world = world

    yellow = paint("hull", (0.8, 0.5, 0.02))
    hang(box("body", (0, 0, 0.75), (1.0, 1.9, 0.5), yellow, bevel=0.06), "chassis")
    hang(box("mast", (0.3, -0.6, 1.25), (0.08, 0.08, 0.5), yellow), "chassis")
    for name, x, y in (("fl", 0.7, -0.9), ("fr", -0.7, -0.9), ("rl", 0.7, 0.9), ("rr", -0.7, 0.9)):
        made = wheel(f"tyre_{name}", (x, y, 0.35), 0.35, 0.25, paint("rubber", (0.02, 0.02, 0.022)))
        bpy.context.view_layer.update()
        hang(made, f"wheel_{name}")
    pose = rig.pose.bones["chassis"]
    for frame in range(1, 49, 6):
        pose.location = (0.0, 0.03 * math.sin(2 * math.pi * (frame - 1) / 24), 0.0)
        pose.keyframe_insert("location", frame=frame)
    save_usd(folder / "crawler.usdc", up="Z", animated=True)


def main() -> None:
    wanted = sys.argv[1:] or ["pickup", "gyro", "kart", "crawler"]
    if bpy is None:
        return assemble_pickup(HERE / "pickup")
    for make in (pickup, gyro, kart, crawler):
        if make.__name__ in wanted:
            folder = HERE / make.__name__
            folder.mkdir(exist_ok=True)
            make(folder)


if __name__ == "__main__":
    main()
