"""The panel in the sidebar of the 3D view."""

import textwrap

import bpy

from . import jobs, shots

WIDTH, LETTER = 300, 7.0
"""Width of the sidebar where there is no window, and of a letter, pixels."""


class VEHSIM_UL_vehicles(bpy.types.UIList):
    def draw_item(self, context, layout, data, item, icon, active_data, active_property, index=0, flt_flag=0):
        layout.prop(item, "name", text="", emboss=False, icon="AUTO")
        layout.prop(item, "asset", text="", emboss=False)


class Side:
    bl_space_type, bl_region_type, bl_category = "VIEW_3D", "UI", "vehsim"


class VEHSIM_PT_shot(Side, bpy.types.Panel):
    bl_label = "Shot"

    def draw(self, context):
        layout, own = self.layout, context.scene.vehsim
        layout.use_property_split = True
        for name in ("name", "terrain", "folder", "more"):
            layout.prop(own, name)
        layout.separator()
        row = layout.row()
        row.template_list("VEHSIM_UL_vehicles", "", own, "vehicles", own, "active", rows=3)
        column = row.column(align=True)
        column.operator("vehsim.add_vehicle", text="", icon="ADD")
        column.operator("vehsim.remove_vehicle", text="", icon="REMOVE")
        column.operator("vehsim.load_vehicle", text="", icon="FILE_FOLDER")
        if own.vehicle is not None:
            layout.prop(own.vehicle, "asset")
            layout.prop(own.vehicle, "character")


class VEHSIM_PT_marks(Side, bpy.types.Panel):
    bl_label = "Marks"

    @classmethod
    def poll(cls, context):
        return context.scene.vehsim.vehicle is not None

    def draw(self, context):
        layout, vehicle = self.layout, context.scene.vehsim.vehicle
        layout.use_property_split = True
        layout.operator("vehsim.add_mark", icon="EMPTY_ARROWS")
        marks, mark = shots.marks_of(vehicle), context.object
        for found in marks:
            own = found.vehsim
            row = layout.row()
            row.label(text=found.name, icon="RADIOBUT_ON" if found == mark else "RADIOBUT_OFF")
            row.label(text="free" if own.free_frame else str(own.frame))
        if mark in marks:
            own = mark.vehsim
            layout.separator()
            for name, shown in (
                ("frame", True),
                ("free_frame", True),
                ("free_heading", True),
                ("on_ground", True),
                ("use_speed", not own.on_ground),
                ("speed", own.use_speed and not own.on_ground),
                ("hold", True),
                ("tolerance", True),
            ):
                if shown:
                    layout.prop(own, name)


class VEHSIM_PT_motion(Side, bpy.types.Panel):
    bl_label = "Motion"

    def draw(self, context):
        layout, own, job = self.layout, context.scene.vehsim, jobs.running
        if job is not None:
            layout.progress(text=f"{job.what}: {job.text}", factor=job.share)
            layout.operator("vehsim.cancel", icon="CANCEL")
        row = layout.row(align=True)
        row.operator("vehsim.check")
        row.operator("vehsim.solve", icon="PLAY")
        if own.delivery:
            layout.operator("vehsim.retouch", icon="FCURVE")
            row = layout.row(align=True)
            row.operator_menu_enum("vehsim.bake", "motion")
            row.operator("vehsim.export", icon="EXPORT")
        for problem in own.problems:
            box = layout.box()
            box.alert = problem.severity != "warning"
            box.label(text=problem.key or "vehsim", icon="ERROR" if box.alert else "INFO")
            column = box.column(align=True)
            for line in (*_lines(context, problem.message), *_lines(context, problem.remedy)):
                column.label(text=line)


def _lines(context, text):
    """The text in lines that fit into the sidebar: labels are cut off."""
    pixels = context.region.width if context.region else WIDTH
    scale = context.preferences.system.ui_scale or 1.0  # 0 without windows
    return textwrap.wrap(text, max(20, int(pixels / (LETTER * scale))))


CLASSES = (VEHSIM_UL_vehicles, VEHSIM_PT_shot, VEHSIM_PT_marks, VEHSIM_PT_motion)
