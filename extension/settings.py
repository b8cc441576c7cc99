"""What a scene stores: the shot, its vehicles, and the marks, which are empties in a collection of each vehicle."""

import bpy
from bpy.props import (
    BoolProperty,
    CollectionProperty,
    EnumProperty,
    FloatProperty,
    IntProperty,
    PointerProperty,
    StringProperty,
)

from . import preferences

CHARACTERS = [
    (name, name.title(), f"Drive {how}")
    for name, how in (
        ("calm", "calmly"),
        ("normal", "as a careful professional"),
        ("brisk", "briskly"),
        ("stunt", "as hard as the vehicle can"),
    )
]


class VEHSIM_PG_mark(bpy.types.PropertyGroup):
    """What an empty requests; its place and the direction of its X axis are the vehicle's."""

    frame: IntProperty(
        name="Frame", description="The frame at which the vehicle is here; orders the mark if the frame is free"
    )
    free_frame: BoolProperty(name="Free Frame", description="The planner chooses the frame")
    free_heading: BoolProperty(
        name="Free Heading", description="The nose may point anywhere; if off, it points along the empty's X axis"
    )
    use_speed: BoolProperty(name="Set Speed", description="Arrive with this speed; if off, with any speed")
    speed: FloatProperty(name="Speed", description="0: at rest", min=0.0, max=1000.0, unit="VELOCITY")
    hold: IntProperty(name="Hold", description="Frames to stay here, at rest", min=0)
    on_ground: BoolProperty(name="On Ground", description="A flying vehicle lands on what is below the empty")
    tolerance: FloatProperty(
        name="Tolerance", description="Permitted distance along each axis", min=0.0, subtype="DISTANCE", unit="LENGTH"
    )


class VEHSIM_PG_vehicle(bpy.types.PropertyGroup):
    """A vehicle of the shot."""

    name: StringProperty(name="Name", description="Letters, digits and underscores", default="vehicle")
    asset: StringProperty(
        name="Vehicle",
        description="A vehicle of vehsim, or a folder with a vehicle.toml",
        default="car",
        search=lambda self, context, text: preferences.names(context, "vehicles"),
        search_options={"SUGGESTION"},
    )
    character: EnumProperty(name="Character", items=CHARACTERS, default="normal")
    marks: PointerProperty(type=bpy.types.Collection)
    result: PointerProperty(type=bpy.types.Collection)


class VEHSIM_PG_problem(bpy.types.PropertyGroup):
    """What vehsim said about the shot."""

    key: StringProperty()
    message: StringProperty()
    remedy: StringProperty()
    severity: StringProperty()


class VEHSIM_PG_shot(bpy.types.PropertyGroup):
    """The shot of a scene."""

    name: StringProperty(name="Shot", description="Letters, digits and underscores", default="shot")
    terrain: StringProperty(
        name="Terrain",
        description="A terrain of vehsim, or a mesh or height map; leave empty for none",
        search=lambda self, context, text: preferences.names(context, "terrains"),
        search_options={"SUGGESTION"},
    )
    more: PointerProperty(
        name="More",
        description="A Blender text with other tables of the shot file, such as [world] or [[vehicle]] with limits",
        type=bpy.types.Text,
    )
    folder: StringProperty(name="Folder", description="Where the files go", default="//vehsim", subtype="DIR_PATH")
    vehicles: CollectionProperty(type=VEHSIM_PG_vehicle)
    active: IntProperty()
    problems: CollectionProperty(type=VEHSIM_PG_problem)
    delivery: StringProperty(description="The folder of the newest result")
    edited: BoolProperty(description="Whether the newest result follows edited curves")

    @property
    def vehicle(self):
        """The chosen vehicle, or None."""
        return self.vehicles[self.active] if 0 <= self.active < len(self.vehicles) else None


CLASSES = (VEHSIM_PG_mark, VEHSIM_PG_vehicle, VEHSIM_PG_problem, VEHSIM_PG_shot)


def attach():
    bpy.types.Object.vehsim = PointerProperty(type=VEHSIM_PG_mark)
    bpy.types.Scene.vehsim = PointerProperty(type=VEHSIM_PG_shot)


def detach():
    del bpy.types.Scene.vehsim, bpy.types.Object.vehsim
