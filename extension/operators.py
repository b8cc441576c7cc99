"""What the buttons do."""

import json
from pathlib import Path

import bpy
from bpy.props import EnumProperty, StringProperty

from . import jobs, motion, preferences, shots

UNDOABLE = frozenset({"REGISTER", "UNDO"})
SIZE = 2.0
"""Length of a mark's axes, m."""


class Idle:
    """A button for which no job may be at work."""

    @classmethod
    def poll(cls, context):
        return jobs.running is None


class Solved(Idle):
    """A button that also needs a result."""

    @classmethod
    def poll(cls, context):
        delivery = context.scene.vehsim.delivery
        return super().poll(context) and bool(delivery) and Path(delivery).is_dir()


class VEHSIM_OT_add_vehicle(Idle, bpy.types.Operator):
    """Add a vehicle to the shot"""

    bl_idname = "vehsim.add_vehicle"
    bl_label = "Add Vehicle"
    bl_options = UNDOABLE

    asset: StringProperty(name="Vehicle", default="car")

    def execute(self, context):
        own = context.scene.vehsim
        taken, name, k = {each.name for each in own.vehicles}, shots.identifier(Path(self.asset).stem), 1
        while (chosen := name if k == 1 else f"{name}{k}") in taken:
            k += 1
        vehicle = own.vehicles.add()
        vehicle.name, vehicle.asset = chosen, self.asset
        vehicle.marks = bpy.data.collections.new(f"{chosen} marks")
        context.scene.collection.children.link(vehicle.marks)
        own.active = len(own.vehicles) - 1
        return {"FINISHED"}


class VEHSIM_OT_remove_vehicle(Idle, bpy.types.Operator):
    """Remove the chosen vehicle from the shot. Its marks and objects stay in the scene"""

    bl_idname = "vehsim.remove_vehicle"
    bl_label = "Remove Vehicle"
    bl_options = UNDOABLE

    def execute(self, context):
        own = context.scene.vehsim
        own.vehicles.remove(own.active)
        own.active = max(0, own.active - 1)
        return {"FINISHED"}


class VEHSIM_OT_load_vehicle(Idle, bpy.types.Operator):
    """Add a vehicle of your own: a vehicle.toml, or an asset (USD, GLB, OBJ), for which vehsim writes a first one"""

    bl_idname = "vehsim.load_vehicle"
    bl_label = "Load Vehicle"

    filepath: StringProperty(subtype="FILE_PATH")
    filter_glob: StringProperty(default="*.toml;*.usd;*.usda;*.usdc;*.usdz;*.glb;*.gltf;*.obj", options={"HIDDEN"})

    def invoke(self, context, event):
        context.window_manager.fileselect_add(self)
        return {"RUNNING_MODAL"}

    def execute(self, context):
        path = Path(bpy.path.abspath(self.filepath))
        folder = path.parent
        if path.suffix != ".toml":
            folder = shots.folder_of(context.scene) / "vehicles" / shots.identifier(path.stem)
            try:
                if not (folder / "vehicle.toml").exists():
                    preferences.run(context, "inspect", path, "--write", folder)
            except preferences.Failed as error:
                self.report({"ERROR"}, str(error))
                return {"CANCELLED"}
        return bpy.ops.vehsim.add_vehicle(asset=str(folder))


class VEHSIM_OT_add_mark(Idle, bpy.types.Operator):
    """Add a mark of the chosen vehicle at the 3D cursor, on the current frame"""

    bl_idname = "vehsim.add_mark"
    bl_label = "Add Mark"
    bl_options = UNDOABLE

    @classmethod
    def poll(cls, context):
        return super().poll(context) and context.scene.vehsim.vehicle is not None

    def execute(self, context):
        scene, vehicle = context.scene, context.scene.vehsim.vehicle
        mark = bpy.data.objects.new(f"{vehicle.name} mark", None)
        mark.empty_display_type, mark.empty_display_size = "ARROWS", SIZE
        mark.matrix_world = scene.cursor.matrix
        mark.vehsim.frame = scene.frame_current
        if vehicle.marks is None:
            vehicle.marks = bpy.data.collections.new(f"{vehicle.name} marks")
            scene.collection.children.link(vehicle.marks)
        mark.vehsim.use_speed = not vehicle.marks.objects  # the first one: at rest
        vehicle.marks.objects.link(mark)
        for each in context.selected_objects:
            each.select_set(False)
        mark.select_set(True)
        context.view_layer.objects.active = mark
        return {"FINISHED"}


class VEHSIM_OT_check(Idle, bpy.types.Operator):
    """Report what is wrong with the shot, without solving it"""

    bl_idname = "vehsim.check"
    bl_label = "Check"

    def execute(self, context):
        return _start(self, context, "check", _shot_file, lambda shot: ("check", shot), _nothing)


class VEHSIM_OT_solve(Idle, bpy.types.Operator):
    """Solve the motion through the marks in the background, and put it on the vehicles' curves"""

    bl_idname = "vehsim.solve"
    bl_label = "Solve"

    def execute(self, context):
        out = shots.folder_of(context.scene) / "solved"
        return _start(
            self, context, "solve", _shot_file, lambda shot: ("export", shot, "--out", out), _shows(out, edited=False)
        )


class VEHSIM_OT_retouch(Solved, bpy.types.Operator):
    """Send the edited curves to vehsim, and get the nearest motion that the vehicles can make"""

    bl_idname = "vehsim.retouch"
    bl_label = "Send Edit"

    def execute(self, context):
        out = shots.folder_of(context.scene) / "retouched"
        return _start(
            self,
            context,
            "retouch",
            _edit_file,
            lambda edit: _retouch(context.scene, edit, out),
            _shows(out, edited=True),
        )


class VEHSIM_OT_export(Solved, bpy.types.Operator):
    """Write the newest result as a delivery"""

    bl_idname = "vehsim.export"
    bl_label = "Export Delivery"

    directory: StringProperty(subtype="DIR_PATH")
    to: StringProperty(name="Outputs", description="Exporters of vehsim, such as usd,usdz,glb,mp4", default="usd")

    def invoke(self, context, event):
        context.window_manager.fileselect_add(self)
        return {"RUNNING_MODAL"}

    def execute(self, context):
        scene, out = context.scene, Path(bpy.path.abspath(self.directory))

        def arguments(_):
            edit, shot = motion.edit_file(scene), _solved_shot(scene)
            what = _retouch(scene, edit, out) if scene.vehsim.edited else ("export", shot, "--out", out)
            return (*what, "--to", self.to)

        return _start(self, context, "export", _nothing, arguments, _nothing)


class VEHSIM_OT_bake(Solved, bpy.types.Operator):
    """Put the newest result on the curves again: few keys to edit, or a key on every frame"""

    bl_idname = "vehsim.bake"
    bl_label = "Bake"
    bl_options = UNDOABLE

    motion: EnumProperty(
        name="Keys",
        items=[
            ("exact", "Every Frame", "A key on every frame"),
            ("curves", "Few", "Few keys with handles, to edit"),
        ],
    )

    def execute(self, context):
        own = context.scene.vehsim
        for vehicle in own.vehicles:
            if vehicle.result is not None:
                motion.show(context.scene, vehicle, Path(own.delivery), self.motion)
        return {"FINISHED"}


class VEHSIM_OT_cancel(bpy.types.Operator):
    """Stop the work in the background; the earlier result stays"""

    bl_idname = "vehsim.cancel"
    bl_label = "Cancel"

    @classmethod
    def poll(cls, context):
        return jobs.running is not None

    def execute(self, context):
        jobs.running.cancel()
        return {"FINISHED"}


def _start(operator, context, what, prepare, arguments, finish):
    """Start a job: ``prepare`` writes the file that it needs, from which ``arguments`` makes the command."""
    scene = context.scene
    scene.vehsim.problems.clear()
    try:
        command = preferences.command(context, *arguments(prepare(scene)), "--log", "json")
        jobs.start(jobs.Job(scene, what, command, shots.folder_of(scene), finish))
    except (preferences.Failed, ValueError, OSError) as error:
        jobs.add_problem(scene, {"message": str(error)}, "error")
        operator.report({"ERROR"}, str(error))
        return {"CANCELLED"}
    return {"FINISHED"}


def _nothing(_):
    return None


def _shot_file(scene):
    return shots.write_shot(scene)


def _edit_file(scene):
    path = motion.edit_file(scene)
    path.parent.mkdir(parents=True, exist_ok=True)
    motion.write_edit(scene, path)
    return path


def _solved_shot(scene):
    """The shot file of the solved motion; marks may have moved since."""
    return shots.folder_of(scene) / "solved.toml"


def _retouch(scene, edit, out):
    """The arguments of a retouch of the solved motion: every edit starts from it, and replaces earlier edits."""
    solved = shots.folder_of(scene) / "solved" / shots.identifier(scene.vehsim.name)
    return "retouch", solved, "--edit", edit, "--shot", _solved_shot(scene), "--out", out


def _shows(out, edited):
    """Put the result of a job on the curves."""

    def finish(job):
        scene = job.scene
        own, delivery = scene.vehsim, out / shots.identifier(scene.vehsim.name)
        if not edited:
            shot = shots.folder_of(scene) / f"{delivery.name}.toml"
            _solved_shot(scene).write_bytes(shot.read_bytes())
            motion.fit_range(scene, delivery)
        own.delivery, own.edited = str(delivery), edited
        for vehicle in own.vehicles:
            if vehicle.result is not None or not edited:  # a vehicle may have been added since
                motion.show(scene, vehicle, delivery, "curves")
        for name, said in _edits(delivery):
            jobs.add_problem(scene, {"key": name, "message": said}, "warning")

    return finish


def _edits(delivery):
    """What became of the edit of each vehicle, from the report of a delivery."""
    report = json.loads((delivery / "report.json").read_text(encoding="utf-8"))
    for name, solved in report["solved"]["vehicles"].items():
        for first, last in solved.get("edit", {}).get("solved_again", ()):
            yield name, f"frames {first} to {last} were solved again"


CLASSES = (
    VEHSIM_OT_add_vehicle,
    VEHSIM_OT_remove_vehicle,
    VEHSIM_OT_load_vehicle,
    VEHSIM_OT_add_mark,
    VEHSIM_OT_check,
    VEHSIM_OT_solve,
    VEHSIM_OT_retouch,
    VEHSIM_OT_export,
    VEHSIM_OT_bake,
    VEHSIM_OT_cancel,
)
