"""vehsim in Blender: place marks, solve in the background, edit the curves, and send the edit back.

Blender never imports vehsim: its own Python runs the commands in a process beside Blender, and files go between them.
"""

from . import jobs, operators, panels, preferences, settings

CLASSES = (*settings.CLASSES, *preferences.CLASSES, *operators.CLASSES, *panels.CLASSES)


def register():
    import bpy

    for kind in CLASSES:
        bpy.utils.register_class(kind)
    settings.attach()
    bpy.app.handlers.load_pre.append(jobs.end)


def unregister():
    import bpy

    jobs.end()
    bpy.app.handlers.load_pre.remove(jobs.end)
    settings.detach()
    for kind in reversed(CLASSES):
        bpy.utils.unregister_class(kind)
