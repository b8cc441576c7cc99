"""Runs in Blender's Python: marks to curves, an edit back, and what the panel shows. Prints what it found as JSON.

``python in_blender.py EXTENSION.zip PYTHON FOLDER ASSET``: PYTHON runs vehsim; ASSET is a car of one's own.
"""

import json
import os
import sys
import time
from pathlib import Path

archive, python, folder, asset = sys.argv[1], sys.argv[2], Path(sys.argv[3]), sys.argv[4]
os.environ["BLENDER_USER_RESOURCES"] = str(folder / "user")

import bpy  # noqa: E402

bpy.ops.wm.read_factory_settings(use_empty=True)
bpy.ops.extensions.package_install_files(filepath=archive, repo="user_default", enable_on_install=True)
PACKAGE = "bl_ext.user_default.vehsim"
jobs, motion, panels = (sys.modules[f"{PACKAGE}.{name}"] for name in ("jobs", "motion", "panels"))
preferences = bpy.context.preferences.addons[PACKAGE].preferences
scene, own, found = bpy.context.scene, bpy.context.scene.vehsim, {}


class Layout:
    """Stands for Blender's layout: every property and operator that a panel shows must exist."""

    def __init__(self, shown):
        self.shown = shown

    def prop(self, data, name, **_):
        self.shown.append(data.bl_rna.properties[name].name)

    def operator(self, name, **_):
        package, _, rest = name.partition(".")
        getattr(bpy.ops, package).__getattr__(rest).get_rna_type()
        self.shown.append(name)

    def operator_menu_enum(self, name, of, **_):
        assert of in getattr(bpy.ops.vehsim, name.partition(".")[2]).get_rna_type().properties
        self.shown.append(name)

    def label(self, text="", icon="NONE"):
        bpy.types.UILayout.bl_rna.functions["label"].parameters["icon"].enum_items[icon]
        self.shown.append(text)

    def progress(self, text="", factor=0.0):
        self.shown.append(text)

    def template_list(self, kind, _, data, items, where, active, **more):
        for item in getattr(data, items):
            getattr(panels, kind).draw_item(None, bpy.context, self, data, item, 0, where, active)

    def row(self, **_):
        return self

    column = box = row
    separator = lambda self: None


def panel():
    """The texts and buttons of the panels."""
    shown = []
    for kind in panels.CLASSES:
        if issubclass(kind, bpy.types.Panel) and getattr(kind, "poll", lambda _: True)(bpy.context):
            kind.draw(type("Drawn", (), {"layout": Layout(shown)})(), bpy.context)
    return shown


def finished(until=lambda job: False):
    """Poll the job as Blender's timer does, until it ends; what it said, and the problems."""
    said = []
    while (job := jobs.running) is not None:
        if job.poll() is not None:
            if [job.text, job.share] not in said[-1:]:
                said.append([job.text, job.share])
            if until(job):
                bpy.ops.vehsim.cancel()
                until = lambda job: False
            time.sleep(0.05)
    problems = [
        {name: getattr(each, name) for name in ("key", "message", "remedy", "severity")} for each in own.problems
    ]
    return {"said": said, "problems": problems, "succeeded": job is None and said != [] and own.delivery}


def places(thing):
    """World matrices on every frame."""
    matrices = []
    for frame in range(scene.frame_start, scene.frame_end + 1):
        scene.frame_set(frame)
        shown = thing.evaluated_get(bpy.context.evaluated_depsgraph_get())
        matrices.append([list(row) for row in shown.matrix_world])
    return matrices


def curves(thing):
    (bag,) = [bag for layer in thing.animation_data.action.layers for bag in layer.strips[0].channelbags]
    return {f"{curve.data_path}[{curve.array_index}]": curve for curve in bag.fcurves}


def keys(thing):
    return {name: len(curve.keyframe_points) for name, curve in curves(thing).items()}


def blender_path(thing):
    """The prim that an imported object follows; "" if it stands still."""
    return next((each.object_path for each in thing.constraints if hasattr(each, "object_path")), "")


# ---------------------------------------------------------------- without vehsim, then connected
bpy.ops.wm.save_as_mainfile(filepath=str(folder / "scene.blend"))
try:
    bpy.ops.vehsim.check()
except RuntimeError as error:
    found["unconnected"] = str(error)
preferences.program = python
bpy.ops.vehsim.connect()
found["version"], found["known"] = preferences.version, json.loads(preferences.known)


# ---------------------------------------------------------------- marks, a check, a solve
def add_marks(*marks):
    for frame, place in marks:
        scene.frame_set(frame)
        scene.cursor.location = place
        bpy.ops.vehsim.add_mark()
        bpy.context.object.vehsim.use_speed, bpy.context.object.vehsim.speed = True, 5.0
    return bpy.context.object


bpy.ops.vehsim.add_vehicle(asset="simple_car")
own.vehicle.name = "car"
bpy.ops.vehsim.load_vehicle(filepath=asset)
add_marks((1, (0, 9, 0)), (49, (10, 10, 0)))
own.active = 0
more = bpy.data.texts.new("more")
more.write("".join(f'[[vehicle]]\nname = "{name}"\nmotion = {{ segments = 12 }}\n' for name in ("car", "kart")))
own.more = more
last = add_marks((1, (0, 0, 0)), (61, (12, 1, 0)))
last.vehsim.free_heading, last.vehsim.frame = True, 3
bpy.context.view_layer.update()
bpy.ops.vehsim.check()
found["check"], found["panel of errors"] = finished(), panel()
last.vehsim.frame = 36
bpy.ops.vehsim.solve()
found["too early"] = finished()
last.vehsim.frame = 61
bpy.ops.vehsim.solve()
found["cancelled"] = finished(until=lambda job: job.share > 0)
found["objects after cancel"] = len(bpy.data.objects)
bpy.ops.vehsim.solve()
found["solve"], found["panel"] = finished(), panel()
car = motion.root_of(own.vehicle)
found["range"], found["keys"], found["solved"] = [scene.frame_start, scene.frame_end], keys(car), places(car)

# ---------------------------------------------------------------- an edit, sent back
lamp = bpy.data.objects.new("lamp", bpy.data.lights.new("lamp", "POINT"))
scene.collection.objects.link(lamp)
lamp.parent = car
wheel = next(found for found in own.vehicle.result.objects if found.name.startswith("wheel"))
y, values = curves(car)["location[1]"], {}
for frame in range(8, 55):
    share = (frame - 8) / 46
    values[frame] = y.evaluate(frame) + 0.1 * (16 * share**2 * (1 - share) ** 2) ** 1.5
for frame, value in values.items():
    y.keyframe_points.insert(frame, value)
curves(wheel)[next(name for name in curves(wheel) if name.startswith("rotation"))].keyframe_points[0].co[1] += 1.0
found["edited"] = places(car)
bpy.ops.wm.usd_export(filepath=str(folder / "scene.usdc"), export_animation=True, export_materials=False)
bpy.ops.vehsim.retouch()
found["retouch"] = finished()
again = motion.root_of(own.vehicle)
found["same object"] = again == car and lamp.parent == car
found["retouched"], found["keys after"] = places(car), keys(car)
found["kart"] = places(motion.root_of(own.vehicles[1]))
found["names"] = sorted(each.name for each in own.vehicle.result.objects)

# ---------------------------------------------------------------- bake, export
bpy.ops.vehsim.bake(motion="exact")
found["baked"], found["keys baked"] = places(car), keys(car)
bpy.ops.vehsim.export(directory=str(folder / "delivery"), to="usd,csv,blend")
found["export"] = finished()

# ---------------------------------------------------------------- wheels whose meshes share a name
wheel = """    def Xform "{}" {{
        double3 xformOp:rotateXYZ.timeSamples = {{ 1: (0, 0, 0), 9: (90, 0, 0) }}
        uniform token[] xformOpOrder = ["xformOp:rotateXYZ"]
        def Mesh "tyre" {{
            int[] faceVertexCounts = [3]
            int[] faceVertexIndices = [0, 1, 2]
            point3f[] points = [(0, 0, 0), (1, 0, 0), (0, 1, 0)]
        }}
    }}
"""
twins = folder / "twins.usda"
wheels = "".join(wheel.format(name) for name in ("left", "middle", "right"))
twins.write_text(f'#usda 1.0\n(\n    upAxis = "Z"\n)\ndef Xform "van" {{\n{wheels}}}\n')
found["twins"] = []
for _ in range(2):
    imported = motion._import(scene, twins)
    motion.mark_places(imported)
    found["twins"].append({each[motion.PLACE]: blender_path(each) for each in imported})

# ---------------------------------------------------------------- another file, switched off
own.vehicle.name = "renamed"  # its result has the earlier name
job = jobs.Job(scene, "look", [python, "-c", ""], folder, lambda job: motion.show(scene, own.vehicle, folder, "exact"))
jobs.start(job)
found["not shown"] = finished()["problems"][-1]
job = jobs.Job(scene, "wait", [python, "-c", "import time; time.sleep(3600)"], folder, print)
jobs.start(job)
bpy.ops.wm.open_mainfile(filepath=str(folder / "scene.blend"))
found["ended"] = jobs.running is None and job.process.returncode is not None
bpy.ops.preferences.addon_disable(module=PACKAGE)
found["left"] = hasattr(bpy.types.Scene, "vehsim")
print("SAYS" + json.dumps(found))
