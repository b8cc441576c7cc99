"""Preferences: the program that runs vehsim, and the names that it knows."""

import json
import os
import subprocess
import sys
from pathlib import Path

import bpy
from bpy.props import StringProperty

PATIENCE = 60
"""Longest time for a command that Blender waits for, s."""


class VEHSIM_AP_preferences(bpy.types.AddonPreferences):
    bl_idname = __package__

    program: StringProperty(
        name="vehsim", description="The command vehsim, or the Python in which it is installed", subtype="FILE_PATH"
    )
    version: StringProperty()
    known: StringProperty(description="Names of vehicles and terrains, as JSON")

    def draw(self, context):
        self.layout.prop(self, "program")
        row = self.layout.row()
        row.label(text=self.version or "Not connected", icon="CHECKMARK" if self.version else "ERROR")
        row.operator("vehsim.connect")


class VEHSIM_OT_connect(bpy.types.Operator):
    """Ask vehsim for its version, and for the vehicles and terrains that it knows"""

    bl_idname = "vehsim.connect"
    bl_label = "Connect"

    def execute(self, context):
        own = of(context)
        own.version = own.known = ""
        try:
            version, schema = run(context, "--version"), json.loads(run(context, "schema"))
        except Failed as error:
            self.report({"ERROR"}, str(error))
            return {"CANCELLED"}
        tables = schema["$defs"]
        known = {
            "vehicles": _choices(tables["VehicleTable"]["properties"]["asset"]),
            "terrains": _choices(tables["WorldTable"]["properties"]["terrain"]),
        }
        own.version, own.known = version.strip(), json.dumps(known)
        return {"FINISHED"}


class Failed(Exception):
    """vehsim did not start, or ended with an error; the text says why."""


def of(context):
    return context.preferences.addons[__package__].preferences


def names(context, kind):
    """The known names of a kind: "vehicles" or "terrains"."""
    return json.loads(of(context).known or "{}").get(kind, [])


def command(context, *arguments):
    """The command line that runs vehsim. Raises ``Failed``."""
    program = bpy.path.abspath(of(context).program)
    if not program:
        raise Failed("Set the program vehsim in the preferences of this extension")
    module = ["-m", "vehsim"] if Path(program).name.startswith("python") else []
    return [program, *module, *map(str, arguments)]


def environment():
    """Blender's, without what would send vehsim's Python to Blender's modules. vehsim's exporters use this Blender."""
    own = {"VEHSIM_BLENDER": bpy.app.binary_path or sys.executable}  # as a module, bpy has no program
    return own | {name: value for name, value in os.environ.items() if name not in ("PYTHONPATH", "PYTHONHOME")}


def run(context, *arguments):
    """The output of a short command. Raises ``Failed``."""
    try:
        done = subprocess.run(
            command(context, *arguments),
            capture_output=True,
            text=True,
            encoding="utf-8",
            stdin=subprocess.DEVNULL,
            timeout=PATIENCE,
            env=environment(),
        )
    except (OSError, subprocess.TimeoutExpired) as error:
        raise Failed(f"vehsim did not answer: {error}") from error
    if done.returncode:
        raise Failed((done.stderr.strip() or "vehsim ended with an error").splitlines()[-1])
    return done.stdout


def _choices(schema):
    return [name for each in schema["anyOf"] for name in each.get("enum", ())]


CLASSES = (VEHSIM_AP_preferences, VEHSIM_OT_connect)
