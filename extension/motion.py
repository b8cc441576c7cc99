"""Solved motion as native curves of objects, and edited objects as motion in a USD file."""

import math
import re

import bpy
from mathutils import Matrix

from . import blender
from .shots import folder_of, identifier, rate

PLACE = "vehsim_place"
"""Custom property of an object: its path in the vehicle's layer, with the names that Blender shows; of an empty that
its curves need, that path, a dot and a number, which no prim's name has."""


def show(scene, vehicle, delivery, motion):
    """Put a delivered motion, "curves" or "exact", on the objects of a vehicle, which are imported the first time.

    Objects of an earlier result keep their names, materials, children and constraints, and get new curves.
    """
    layer = delivery / "layers" / f"{vehicle.name}.anim.usdc"
    imported = _import(scene, layer)
    mark_places(imported)
    present = set(bpy.data.objects)
    keys = layer if motion == "exact" else layer.with_name(f"{vehicle.name}.curves.usda")
    frame = scene.frame_current
    stage = blender.read_stage(keys)
    scene.frame_set(round(stage.GetStartTimeCode()))
    blender.give_curves(scene, stage, imported)
    added = [found for found in bpy.data.objects if found not in present]
    for found in imported:
        above, k = found.parent, 0
        while above in added:
            above[PLACE] = f"{found[PLACE]}.{k}"
            above, k = above.parent, k + 1
    if vehicle.result is None:
        vehicle.result = bpy.data.collections.new(vehicle.name)
    if vehicle.result.name not in scene.collection.children:
        scene.collection.children.link(vehicle.result)
    _adopt(vehicle.result, [*imported, *added])
    scene.frame_set(frame)


def fit_range(scene, delivery):
    """Make the scene's range cover the motion of a delivery."""
    stage = blender.read_stage(delivery / f"{delivery.name}.usda")
    scene.frame_start, scene.frame_end = round(stage.GetStartTimeCode()), round(stage.GetEndTimeCode())


def root_of(vehicle):
    """The object with the curves of a vehicle's root: its own, or an empty above it. None before it is solved."""
    moving = [found for found in vehicle.result.objects if blender.PRIM in found] if vehicle.result else []
    root = min(moving, key=lambda found: found[blender.PRIM].count("/"), default=None)
    while root is not None and root.parent is not None and not (root.animation_data and root.animation_data.action):
        root = root.parent
    return root


def write_edit(scene, path):
    """Write the motion of all moving objects of the vehicles, as the scene evaluates them, on every whole frame."""
    blender.load_usd()
    from pxr import Gf, Usd, UsdGeom

    stage = Usd.Stage.CreateInMemory()
    UsdGeom.SetStageMetersPerUnit(stage, scene.unit_settings.scale_length)
    UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.z)
    stage.SetTimeCodesPerSecond(float(rate(scene)))
    stage.SetFramesPerSecond(float(rate(scene)))
    tracks = []
    for vehicle in scene.vehsim.vehicles:
        frames = _keyed(scene, vehicle)
        for found in vehicle.result.objects if vehicle.result else ():
            if blender.PRIM in found:
                place = f"/{identifier(scene.vehsim.name)}/vehicles{found[blender.PRIM]}"
                shown = UsdGeom.Xform.Define(stage, place)
                shown.SetResetXformStack(True)
                after = Matrix([found[blender.AFTER][4 * k : 4 * k + 4] for k in range(4)])
                tracks.append((found, frames, after.inverted(), shown.AddTransformOp()))
                shown.SetXformOpOrder(shown.GetOrderedXformOps(), True)
    frame = scene.frame_current
    stage.SetStartTimeCode(scene.frame_start)
    stage.SetEndTimeCode(scene.frame_end)
    for time in range(scene.frame_start, scene.frame_end + 1):
        scene.frame_set(time)
        graph = bpy.context.evaluated_depsgraph_get()
        for found, frames, before, op in tracks:
            if time in frames:
                matrix = found.evaluated_get(graph).matrix_world @ before
                op.Set(Gf.Matrix4d([list(column) for column in matrix.transposed()]), time)
    scene.frame_set(frame)
    stage.Export(str(path))


def _keyed(scene, vehicle):
    """The frames between the first and the last key of a vehicle's root: it may move for a part of the shot."""
    root = root_of(vehicle)
    if root is None or root.animation_data is None or root.animation_data.action is None:
        return range(scene.frame_start, scene.frame_end + 1)
    first, last = root.animation_data.action.frame_range
    return range(math.floor(first), math.ceil(last) + 1)


def _import(scene, layer):
    """The objects of a layer, in the unit of the scene, which Blender's importer takes for a metre."""
    before, view = set(bpy.data.objects), bpy.context.view_layer
    active = view.active_layer_collection
    view.active_layer_collection = view.layer_collection  # another one may be excluded, and is then not evaluated
    bpy.ops.wm.usd_import(filepath=str(layer), set_frame_range=False, scale=1.0 / scene.unit_settings.scale_length)
    view.active_layer_collection = active
    return [found for found in bpy.data.objects if found not in before]


def mark_places(imported):
    """Give every object its `PLACE`. An Xform with a single mesh becomes one object with the mesh's name, so wheels may
    share a name: Blender numbers them in the order of their prims."""
    places = {}
    for found in sorted(imported, key=lambda found: (_depth(found), found.name)):
        above = found.parent[PLACE] if found.parent in places else ""
        place = f"{above}/{re.sub(blender.NUMBERED, '', found.name)}"
        twins = sum(other == place for other in places.values())
        places[found] = place
        found[PLACE] = f"{place}#{twins}" if twins else place


def _depth(found):
    return 0 if found.parent is None else 1 + _depth(found.parent)


def _adopt(collection, made):
    """Give new motion to the objects of an earlier result with the same places; keep the others that are new."""
    known = {found[PLACE]: found for found in collection.objects if PLACE in found}
    if _prims(known) != _prims(found[PLACE] for found in made):  # another vehicle
        known = {}
    kept = {found: known.get(found[PLACE], found) for found in made}
    for found in made:
        for holder in list(found.users_collection):
            holder.objects.unlink(found)
        if kept[found] is found:
            collection.objects.link(found)
    for found, old in kept.items():
        parent = kept.get(found.parent, found.parent)
        if old is found:
            inverse = found.matrix_parent_inverse.copy()
            found.parent = parent
            found.matrix_parent_inverse = inverse
        elif blender.PRIM in found or blender.PRIM in old or "." in found[PLACE]:
            _give_motion(found, old, parent)
    stale = [found for found in collection.objects if PLACE in found and found not in kept.values()]
    gone = stale + [found for found, old in kept.items() if old is not found]
    data = {found.data for found in gone if found.data}
    bpy.data.batch_remove(gone)
    bpy.data.batch_remove([each for each in data if not each.users])


def _prims(places):
    return {place for place in places if "." not in place}


def _give_motion(found, old, parent):
    """Move the curves and the place of an object to an older one."""
    for name in (blender.PRIM, blender.AFTER):
        if name in found:
            old[name] = found[name]
        else:
            old.pop(name, None)
    earlier = old.animation_data.action if old.animation_data else None
    old.animation_data_clear()
    if earlier is not None and not earlier.users:
        bpy.data.actions.remove(earlier)
    old.parent, old.matrix_parent_inverse = parent, found.matrix_parent_inverse
    old.rotation_mode, old.matrix_basis = found.rotation_mode, found.matrix_basis
    if found.animation_data and found.animation_data.action:
        motion, slot = found.animation_data.action, found.animation_data.action_slot
        old.animation_data_create().action = motion
        old.animation_data.action_slot = slot


def edit_file(scene):
    """Where the edited motion goes."""
    return folder_of(scene) / "edited.usda"
