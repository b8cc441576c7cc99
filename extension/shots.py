"""A scene's marks as a shot file."""

import json
import math
import re
import tomllib
from fractions import Fraction
from pathlib import Path

import bpy

CURVES = {"tolerance": 0.001}
"""How closely the native curves follow the motion, m."""
DIGITS = 5
"""Decimals of numbers from Blender, which stores single precision."""


def shot_of(scene):
    """The data of a scene's shot file. Raises ``ValueError`` if the text with more tables is not TOML."""
    own = scene.vehsim
    vehicles = [_vehicle(scene, vehicle) for vehicle in own.vehicles]
    frames = [mark["frame"] for each in vehicles for mark in each["motion"]["mark"] if mark["frame"] != "free"]
    shot = {
        "shot": {
            "schema": 1,
            "name": own.name,
            "fps": str(rate(scene)),
            "start_frame": min(frames, default=scene.frame_start),
        },
        "world": {"terrain": path_or_name(own.terrain)} if own.terrain else {},
        "vehicle": vehicles,
        "export": {"curves": CURVES},
    }
    return _merged(shot, tomllib.loads(own.more.as_string())) if own.more else shot


def rate(scene):
    """The exact frame rate."""
    return Fraction(scene.render.fps) / Fraction(scene.render.fps_base).limit_denominator(10_000)


def marks_of(vehicle):
    """The empties of a vehicle, in the order of their marks in the shot file."""
    empties = [found for found in vehicle.marks.objects if found.type == "EMPTY"] if vehicle.marks else []
    return sorted(empties, key=lambda found: (found.vehsim.frame, found.name))


def folder_of(scene):
    """The folder of a scene's files."""
    folder = scene.vehsim.folder
    if folder.startswith("//") and not bpy.data.is_saved:
        return Path(bpy.app.tempdir or bpy.utils.resource_path("USER")) / "vehsim"
    return Path(bpy.path.abspath(folder)).resolve()


def write_shot(scene):
    """Write ``<shot>.toml``, and return its path."""
    path = folder_of(scene) / f"{identifier(scene.vehsim.name)}.toml"
    text = to_toml(shot_of(scene))
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text, encoding="utf-8")
    return path


def identifier(text):
    """The text as a name that shot files and USD permit."""
    name = re.sub(r"\W", "_", text, flags=re.ASCII)
    return name if re.match(r"[A-Za-z_]", name) else f"_{name}"


def path_or_name(text):
    """An absolute path, or the name of something that vehsim knows."""
    return text if re.fullmatch(r"\w+", text) else str(Path(bpy.path.abspath(text)).resolve())


def to_toml(table, name=""):
    """A table as TOML: its values, then its tables."""

    def is_tables(value):
        return isinstance(value, dict) or (isinstance(value, list) and value and isinstance(value[0], dict))

    lines = [f"{key} = {_toml(value)}" for key, value in table.items() if not is_tables(value)]
    for key, value in table.items():
        below = f"{name}.{key}" if name else key
        if isinstance(value, dict):
            lines += ["", f"[{below}]", to_toml(value, below)]
        elif is_tables(value):
            for each in value:
                lines += ["", f"[[{below}]]", to_toml(each, below)]
    return "\n".join(lines)


def _vehicle(scene, vehicle):
    marks = [_mark(scene, found) for found in marks_of(vehicle)]
    motion = {"method": "plan", "character": vehicle.character, "mark": marks}
    return {"name": vehicle.name, "asset": path_or_name(vehicle.asset), "motion": motion}


def _mark(scene, found):
    """A mark as a table; the empty's X axis is the nose."""
    own, pose, metres = found.vehsim, found.matrix_world, scene.unit_settings.scale_length
    mark = {
        "frame": "free" if own.free_frame else own.frame,
        "position": [round(x * metres, DIGITS) for x in pose.translation],
    }
    if not own.free_heading:
        mark["heading"] = round(math.degrees(math.atan2(pose[1][0], pose[0][0])), DIGITS)
    if own.on_ground:
        mark["on_ground"] = True
    elif own.use_speed:
        mark |= {"speed": round(own.speed * metres, DIGITS)} if own.speed else {"velocity": [0.0, 0.0, 0.0]}
    if own.hold:
        mark["hold"] = own.hold
    if own.tolerance:
        mark["tolerance"] = round(own.tolerance * metres, DIGITS)
    return mark


def _merged(table, more):
    """The table with the values of another; entries of a list with the same name are merged."""
    both = dict(table)
    for key, value in more.items():
        own = both.get(key)
        if isinstance(value, dict) and isinstance(own, dict):
            both[key] = _merged(own, value)
        elif key == "vehicle" and isinstance(value, list):
            named = {each.get("name"): each for each in value}
            both[key] = [_merged(each, named.pop(each["name"], {})) for each in own] + list(named.values())
        else:
            both[key] = value
    return both


def _toml(value):
    if isinstance(value, dict):
        return "{ " + ", ".join(f"{key} = {_toml(each)}" for key, each in value.items()) + " }"
    if isinstance(value, list):
        return "[" + ", ".join(map(_toml, value)) + "]"
    return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")
