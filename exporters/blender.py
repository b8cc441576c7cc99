"""Open an exported stage in Blender: give its motion native curves, write Alembic, or render a still with Cycles.

Inside Blender, vehsim is not needed: this file runs in a Python with the module `bpy` or in Blender itself (``blender
--background --python blender.py -- STAGE ...``). The exporters `blend`, `abc` and `cycles` run it in a
separate process.

Blender's importer reads matrices from the file at every frame. `bake` replaces that by curves on location and rotation
with the numbers of the stage: an accumulated angle stays one, so that no wheel turns backwards between keys.
"""

from __future__ import annotations

import argparse
import itertools
import math
import os
import re
import shutil
import subprocess
import sys
import warnings
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from fractions import Fraction
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from vehsim.delivery.take import Take
    from vehsim.runtime.progress import Progress

CACHED = "TRANSFORM_CACHE"
"""The constraint that Blender's USD importer adds to a moving object: it reads the file at every frame."""
PRIM, AFTER = "vehsim_prim", "vehsim_after"
"""Custom properties of a moving object: the path of its prim, and the constant matrix (16,) from the prim to it."""
NUMBERED = r"\.\d{3}$"
"""The end of a name that Blender changed because another object, of any kind, has it."""
SUN = 4.0
"""Factor by which Blender's USD importer makes a sun too bright: UsdLux's normalised intensity is its irradiance."""
SECONDS = 240
"""Longest time for rendering a still, s, before denoising."""
SAMPLES = 40
"""Samples per pixel of a picture by Cycles."""
SAME = 1e-3
"""Largest difference of a matrix entry from the stage, for a place up to a metre from the origin."""
FINEST = 16
"""Samples of every frame of a motion that no curves of location and rotation can show."""
APART = math.radians(30.0)
"""Largest rotation between two samples of Alembic."""
TURN = math.radians(5.0)
"""Largest rotation between two quaternion keys: Blender interpolates their components linearly."""
DISPLAY_COLOUR = "displayColor"
"""Name of USD's colour of meshes without a material, as primvar and as attribute in Blender."""
WATER = "/env/water/surface"
"""End of the path of a stage's water."""
HOLES = ((9.0, 0.9), (24.0, 0.8), (57.0, 0.35))
"""Holes in foam: their number along a tile of the water's texture coordinates, and how much they matter."""
THREADED = (0.8, 1.35)
"""Where the sum of foam and of the rank of a place in its threads, each from 0 to 1, begins to be white, and is so."""
WAVES = "vehsim:waves:"
"""Start of the names of the attributes of the water's surface that hold its waves."""
SHADED, BANDS = 48, 2.0
"""Number of the steepest waves that shading shows where the mesh is too coarse; they fade in bands, so many an octave.
"""
CHOP = 1000
"""Number of the first band of waves that no mesh carries."""
PIXEL, VISIBLE = 1 / 1500, (8.0, 1.0)
"""Angle of a pixel, rad, and from how many pixels a wave on a wave is visible, and on how many it is not."""
HAZE, LOW = 2000.0, 0.01
"""Distance at which haze leaves 37 % of the water, m, by its square: near water stays dark. And how far above the
horizon, rad, the sky is that it looks like."""
HIDING = ("hide_render", "hide_viewport")
"""Properties that hide an object, in renders and in viewports."""
MERGED = 0.01
"""Keys closer than this, in frames, become one in Blender."""


def open_stage(stage: str | Path, fps: Fraction | None = None) -> Any:
    """A new scene with everything in ``stage``; returns the scene. ``fps``: its exact rate, which Blender would
    round."""
    import bpy

    bpy.ops.wm.read_factory_settings(use_empty=True)
    scene = bpy.context.scene
    scene.world = bpy.data.worlds.new("sky")  # without a world, Blender drops the stage's dome light
    bpy.ops.wm.usd_import(filepath=str(Path(stage).resolve()), set_frame_range=True)
    for light in bpy.data.lights:
        light.energy /= SUN if light.type == "SUN" else 1.0
    _show_display_colours(bpy.data.meshes)
    _let_panes_through(bpy.data.materials)
    opened = read_stage(stage)
    _hide_empty_points(bpy.data.objects, opened)
    for prim in opened.Traverse():
        if str(prim.GetPath()).endswith(WATER):
            colours = prim.GetAttribute(f"primvars:{DISPLAY_COLOUR}").Get()
            rough = prim.GetAttribute("primvars:roughness").Get()
            for material in bpy.data.materials:
                if material.use_nodes and _is_water(nodes := _Nodes(material.node_tree)):
                    white = _thread_foam(nodes, colours[0], colours[-1])
                    if prim.HasAttribute(f"{WAVES}number"):
                        _shade_distant_waves(nodes, prim, white, (rough[0], rough[-1]))
                    _haze_over(nodes, scene.world.node_tree)
    if fps is not None:
        scene.render.fps = -(-fps.numerator // fps.denominator)
        scene.render.fps_base = float(scene.render.fps / fps)
    return scene


def _let_panes_through(materials: Iterable[Any]) -> None:
    """Make what is translucent so by its alpha: Blender 5.3 imports opacity as transmission through a solid, in which
    the single faces of windscreens are black."""
    trees = [material.node_tree for material in materials if material.use_nodes]
    for node in (node for tree in trees for node in tree.nodes if node.type == "BSDF_PRINCIPLED"):
        through, alpha = node.inputs["Transmission Weight"], node.inputs["Alpha"]
        if through.default_value > 0 and not (through.is_linked or alpha.is_linked):
            alpha.default_value, through.default_value = 1 - through.default_value, 0.0


def _show_display_colours(meshes: Iterable[Any]) -> None:
    """Give meshes without a material one with their ``displayColor``, which Blender imports but does not show."""
    import bpy

    bare = [mesh for mesh in meshes if not mesh.materials and DISPLAY_COLOUR in mesh.attributes]
    if not bare:
        return
    material = bpy.data.materials.new(DISPLAY_COLOUR)
    material.use_nodes = True
    tree = material.node_tree
    colour = tree.nodes.new("ShaderNodeAttribute")
    colour.attribute_name = DISPLAY_COLOUR
    (shader,) = (node for node in tree.nodes if node.type == "BSDF_PRINCIPLED")
    tree.links.new(colour.outputs["Color"], shader.inputs["Base Color"])
    for mesh in bare:
        mesh.materials.append(material)


class _Nodes:
    """Makes nodes in a material's ``tree``."""

    def __init__(self, tree: Any) -> None:
        self.tree = tree

    def of(self, kind: str) -> list[Any]:
        return [node for node in self.tree.nodes if node.type == kind]

    def made(self, kind: str, **settings: Any) -> Any:
        node = self.tree.nodes.new(f"ShaderNode{kind}")
        for key, value in settings.items():
            setattr(node, key, value)
        return node

    def put(self, node: Any, *values: Any, output: Any = 0) -> Any:
        """An output of it, with its inputs set to numbers or linked to other outputs."""
        for socket, value in zip(node.inputs, values, strict=False):
            if hasattr(value, "is_linked"):
                self.tree.links.new(value, socket)
            else:
                socket.default_value = value
        return node.outputs[output]

    def math(self, operation: str, *values: Any, clamp: bool = False) -> Any:
        return self.put(self.made("Math", operation=operation, use_clamp=clamp), *values)

    def vector(self, operation: str, *values: Any, output: Any = 0) -> Any:
        return self.put(self.made("VectorMath", operation=operation), *values, output=output)

    def ramp(self, value: Any, low: Any, high: Any, first: float = 0.0, last: float = 1.0, **settings: Any) -> Any:
        """From ``first`` at ``low`` to ``last`` at ``high``."""
        return self.put(self.made("MapRange", **settings), value, low, high, first, last)


def _is_water(nodes: _Nodes) -> bool:
    """Whether these are the nodes of the water's material, as Blender imports it."""
    named = {node.attribute_name for node in nodes.of("ATTRIBUTE")}
    return {DISPLAY_COLOUR, "roughness"} <= named and bool(nodes.of("UVMAP") and nodes.of("BSDF_PRINCIPLED"))


def _thread_foam(nodes: _Nodes, clear: Sequence[float], foam: Sequence[float]) -> Any:
    """Divide the water's foam, which the mesh has per point, into threads around holes; returns how white it is, 0 to
    1, before that. ``clear``, ``foam``: the colours."""
    (colour,) = (node for node in nodes.of("ATTRIBUTE") if node.attribute_name == DISPLAY_COLOUR)
    (places,), (surface,) = nodes.of("UVMAP"), nodes.of("BSDF_PRINCIPLED")
    height: Any = 0.0
    for cells, weight in HOLES:
        edges = nodes.made("TexVoronoi", voronoi_dimensions="2D", feature="DISTANCE_TO_EDGE")
        edges.inputs["Scale"].default_value = cells
        nodes.tree.links.new(places.outputs[0], edges.inputs["Vector"])
        height = nodes.math("ADD", height, nodes.ramp(edges.outputs["Distance"], 0.0, 0.4, 0.0, weight))
    most = sum(weight for _, weight in HOLES)
    rank = nodes.ramp(height, 0.15 * most, 0.85 * most, 1.0, 0.0)
    red = nodes.put(nodes.made("SeparateColor"), colour.outputs["Color"])
    white = nodes.ramp(red, clear[0], foam[0])
    dense = nodes.ramp(nodes.math("ADD", white, rank), *THREADED, interpolation_type="SMOOTHSTEP")
    shown = nodes.math("MULTIPLY", dense, nodes.math("MULTIPLY", white, 4.0, clamp=True))
    mixed = nodes.made("Mix", data_type="RGBA")
    nodes.tree.links.new(shown, mixed.inputs[0])
    mixed.inputs[6].default_value, mixed.inputs[7].default_value = (*clear, 1.0), (*foam, 1.0)
    nodes.tree.links.new(mixed.outputs[2], surface.inputs["Base Color"])
    return white


def _shade_distant_waves(nodes: _Nodes, prim: Any, white: Any, rough: tuple[float, float]) -> None:
    """Tilt the water's normals by the waves of the prim that its mesh does not carry, and make it as rough as those
    that are too short for a picture. ``white``: of foam, 0 to 1; ``rough``: roughness of clear water and of foam."""
    import numpy as np

    given = {name: prim.GetAttribute(f"{WAVES}{name}").Get() for name in ("amplitude", "number", "phase", "turn")}
    tile, carried, meshed = (prim.GetAttribute(f"{WAVES}{name}").Get() for name in ("tile", "carried", "meshed"))
    amplitude, number, phase, turn = (np.array(values, float) for values in given.values())
    steepness, length = (amplitude * np.hypot(*number.T)) ** 2 / 2, 2 * np.pi / np.hypot(*number.T)
    cell, share = (nodes.made("Attribute", attribute_name=name).outputs["Fac"] for name in ("cell", "share"))
    if not prim.HasAttribute("primvars:share"):
        share = nodes.made("Value").outputs[0]
        share.default_value = 1.0
    place = nodes.put(nodes.made("SeparateXYZ"), nodes.of("UVMAP")[0].outputs[0])
    time = nodes.made("Value")
    time.outputs[0].driver_add("default_value").driver.expression = "frame"
    at = nodes.put(nodes.made("CombineXYZ"), place, place.node.outputs[1], time.outputs[0])
    towards = nodes.put(nodes.made("SeparateXYZ"), nodes.made("NewGeometry").outputs["Incoming"], output="Z")
    away = nodes.made("CameraData").outputs["View Distance"]
    pixel = nodes.math("DIVIDE", nodes.math("MULTIPLY", away, PIXEL), nodes.math("MAXIMUM", towards, 1e-3))
    slopes: Any = (0.0, 0.0, 0.0)
    unseen: Any = 0.0
    kept = np.argsort(-steepness)[:SHADED]
    bands = np.round(BANDS * np.log2(length)) + CHOP * (np.arange(len(length)) >= meshed)
    for band in np.unique(bands):
        here = np.flatnonzero(bands == band)
        middle = float(np.exp((steepness[here] * np.log(length[here])).sum() / steepness[here].sum()))
        missing = nodes.ramp(cell, middle / carried[1], middle / carried[0]) if band < CHOP else 1.0
        drawn = [k for k in here if k in kept]
        tilt: Any = (0.0, 0.0, 0.0)
        for k in drawn:
            way = nodes.vector("DOT_PRODUCT", at, (*(tile * number[k]), -turn[k]), output="Value")
            swing = nodes.math("SINE", nodes.math("ADD", way, phase[k] % (2 * np.pi)))
            tilt = nodes.vector("MULTIPLY_ADD", swing, (*(amplitude[k] * number[k]), 0.0), tilt)
        clear = nodes.ramp(pixel, middle / VISIBLE[0], middle / VISIBLE[1], 1.0, 0.0)
        part = nodes.math("MULTIPLY", missing, clear)
        if drawn:
            slopes = nodes.vector("MULTIPLY_ADD", tilt, part, slopes)
        drawn_share = steepness[drawn].sum() / steepness[here].sum()
        left = nodes.math("SUBTRACT", missing, nodes.math("MULTIPLY", part, drawn_share))
        left = nodes.math("MULTIPLY", left, nodes.math("SUBTRACT", 2.0, left))  # 1 - (1 - left)^2
        unseen = nodes.math("MULTIPLY_ADD", left, float(steepness[here].sum()), unseen)
    (surface,) = nodes.of("BSDF_PRINCIPLED")
    ripples = surface.inputs["Normal"].links[0].from_socket
    tilted = nodes.vector("MULTIPLY_ADD", slopes, share, ripples)
    nodes.tree.links.new(nodes.vector("NORMALIZE", tilted), surface.inputs["Normal"])
    unseen = nodes.math("MULTIPLY", unseen, nodes.math("MULTIPLY", share, share))
    clear = nodes.math("POWER", nodes.math("ADD", unseen, rough[0] ** 4), 0.25)
    foamy = nodes.ramp(white, 0.0, 1.0, *rough)
    nodes.tree.links.new(nodes.math("MAXIMUM", clear, foamy), surface.inputs["Roughness"])


def _haze_over(nodes: _Nodes, sky: Any) -> None:
    """Hide distant water behind the sky at the horizon, of the nodes ``sky`` of the world."""
    pictures = [node for node in sky.nodes if node.type == "TEX_ENVIRONMENT"]
    if not pictures:
        return
    (surface,), (end,) = nodes.of("BSDF_PRINCIPLED"), nodes.of("OUTPUT_MATERIAL")
    (light,) = (node for node in sky.nodes if node.type == "BACKGROUND")
    flat = nodes.vector(
        "MULTIPLY_ADD", nodes.made("NewGeometry").outputs["Incoming"], (-1.0, -1.0, 0.0), (0.0, 0.0, LOW)
    )
    turned = nodes.made("Mapping")
    for turn in pictures[0].inputs["Vector"].links:
        for socket in turn.from_node.inputs[1:]:
            turned.inputs[socket.name].default_value = socket.default_value
    picture = nodes.made("TexEnvironment", image=pictures[0].image)
    nodes.put(picture, nodes.put(turned, nodes.vector("NORMALIZE", flat)))
    hazy = nodes.put(nodes.made("Emission"), picture.outputs["Color"], light.inputs["Strength"].default_value)
    away = nodes.made("CameraData").outputs["View Distance"]
    far = nodes.math("DIVIDE", away, HAZE)
    clear = nodes.math("EXPONENT", nodes.math("MULTIPLY", nodes.math("MULTIPLY", far, far), -1.0))
    mixed = nodes.put(nodes.made("MixShader"), clear, hazy, surface.outputs["BSDF"])
    nodes.tree.links.new(mixed, end.inputs["Surface"])


def _hide_empty_points(imported: Iterable[Any], opened: Any) -> None:
    """Hide points, such as spray, at the frames at which there are none: Cycles 5.0 crashes on them, in renders and in
    viewports."""
    for found in imported:
        if found.type != "POINTCLOUD":
            continue
        counts = {0.0: len(found.data.points)}
        for cache in (modifier for modifier in found.modifiers if modifier.type == "MESH_SEQUENCE_CACHE"):
            points = opened.GetPrimAtPath(cache.object_path).GetAttribute("points")
            counts = {time: len(points.Get(time)) for time in points.GetTimeSamples()}
        changes = [next(times) for _, times in itertools.groupby(counts, key=lambda time: counts[time] > 0)]
        for path in HIDING if 0 in counts.values() else ():
            _curve(found, path, 0, [_Key(time, float(not counts[time]), held=True) for time in changes])


# ---------------------------------------------------------------- native curves


def bake(scene: Any, stage: str | Path, motion: str | None = None) -> None:
    """Make ``scene``, into which ``stage`` was imported, independent of the file: native curves, camera, cuts, look.

    ``motion``: the variant of the set "motion" to read, where a prim has it.
    """
    import bpy

    opened = read_stage(stage)
    scene.frame_set(scene.frame_start)
    give_curves(scene, opened, bpy.data.objects, motion)
    _set_scene(scene, opened)
    scene.frame_set(scene.frame_start)


def give_curves(scene: Any, opened: Any, imported: Iterable[Any], motion: str | None = None) -> dict[Any, str]:
    """Replace the file by native curves that have the keys of the stage ``opened``: the handles of its splines, or
    straight lines between its samples. Returns the prim's path of each moving object.

    ``imported``: the objects that Blender imported from it. An object gets the constant part of its prim's ops as
    parent inverse, and curves for the rest; ops that one object cannot show get empties above it. What no curves of
    location and rotation can show is sampled. Each moving object has the constant matrix from its prim to itself as
    the custom property `AFTER`, and the prim's path as `PRIM`.
    """
    start = scene.frame_current
    objects = {found: next(_caches(found)).object_path for found in imported if any(_caches(found))}
    shown = {found: _world(found) for found in imported}
    axes = _axes(opened, start, shown)
    # what follows the prim's ops: the importer may merge a mesh into the prim above it
    own = {found: _settled(_inverse(axes @ _at(opened, path, start)) @ shown[found]) for found, path in objects.items()}
    places = {}
    for found in objects:
        carrier = found.parent
        while carrier is not None and carrier not in objects:
            carrier = carrier.parent
        before, root = (_inverse(own[carrier]), objects[carrier]) if carrier else (axes, "/")
        if found.parent is not None:  # it stands still on its carrier
            before = _settled(_inverse(shown[found.parent]) @ (shown[carrier] if carrier else _identity())) @ before
        places[found] = before, root, own[found]
    for prim in opened.Traverse():
        variants = prim.GetVariantSet("motion")
        if motion and motion in variants.GetVariantNames():
            variants.SetVariantSelection(motion)
    for found, (before, root, after) in places.items():
        for constraint in list(_caches(found)):
            found.constraints.remove(constraint)
        found[PRIM], found[AFTER] = objects[found], [float(x) for x in after.ravel()]
        runs = _runs(_prims(opened, root, objects[found]), before, after)
        if runs is not None:
            _author(found, *runs)
    frames = round(opened.GetStartTimeCode()), round(opened.GetEndTimeCode())
    for found, (before, root, after) in sorted(places.items(), key=lambda item: objects[item[0]].count("/")):
        path = objects[found]

        def world(time: float, path: str = path, after: Any = after) -> Any:
            return axes @ _at(opened, path, time) @ after

        def local(time: float, path: str = path, root: str = root, around: Any = (before, after)) -> Any:
            return around[0] @ _inverse(_at(opened, root, time)) @ _at(opened, path, time) @ around[1]

        if not _agrees(scene, frames, found, world):
            _author_samples(frames, found, local)
        if found.type == "CAMERA":
            _author_lens(found, opened.GetPrimAtPath(path))
    return objects


@dataclass
class _Run:
    """Ops of a prim that one object can show: a constant matrix, then translations, then up to three rotations.

    ``moves`` and ``turns``: the axes ("X", "XYZ"; "Q" for a quaternion), the outermost first, and the animated
    attribute of each.
    """

    before: Any
    moves: list[tuple[str, Any]] = field(default_factory=list)
    turns: list[tuple[str, Any]] = field(default_factory=list)

    def takes(self, kind: str, axes: str) -> bool:
        """Whether an animated op fits behind those that the run has."""
        moved, turned = ("".join(each for each, _ in ops) for ops in (self.moves, self.turns))
        if kind == "translate":
            return not turned and not {*moved} & {*axes}
        return not turned or ("Q" not in turned + axes and not {*turned} & {*axes})


def _runs(prims: Sequence[Any], before: Any, after: Any) -> tuple[list[_Run], Any] | None:
    """The ops of ``prims``, outermost first, as runs, and the constant matrix behind them; ``before`` and ``after``
    are constant matrices around them. None if curves of location and rotation cannot show an op."""
    from pxr import UsdGeom

    runs: list[_Run] = []
    constant = before
    for prim in prims:
        if not prim.IsA(UsdGeom.Xformable):
            continue
        if UsdGeom.Xformable(prim).GetResetXformStack():
            return None
        for op in UsdGeom.Xformable(prim).GetOrderedXformOps():
            if not op.MightBeTimeVarying():
                constant = constant @ _matrix(op.GetOpTransform(0))
                continue
            name = op.GetOpName().split(":")[1]
            kind = "translate" if name.startswith("translate") else "rotate"
            axes = "Q" if name == "orient" else name.removeprefix(kind) or "XYZ"
            axes = axes[::-1] if kind == "rotate" else axes  # USD applies the first axis of rotateXYZ first
            if op.GetOpName().startswith("!") or not {*axes} <= {*"XYZQ"}:
                return None
            if not runs or not _is_identity(constant) or not runs[-1].takes(kind, axes):
                runs.append(_Run(constant))
                constant = _identity()
            (runs[-1].moves if kind == "translate" else runs[-1].turns).append((axes, op.GetAttr()))
    return runs, constant @ after


def _author(found: Any, runs: Sequence[_Run], after: Any) -> None:
    """Give an object its runs: the last one itself if only a scale follows it, the others on empties above it."""
    size = after.diagonal()[:3].tolist()
    scaled = _is_identity(after / [*size, 1.0]) if min(size) > 0 else False
    above, last = (runs[:-1], runs[-1]) if runs and scaled else (runs, None)
    parent = found.parent
    for k, run in enumerate(above):
        parent = _hang(_empty(found, k), parent, run.before)
        _author_run(parent, run)
    if last is None:
        _hang(found, parent, after)
    else:
        _author_run(_hang(found, parent, last.before), last)
        found.scale = size


def _hang(found: Any, parent: Any, matrix: Any) -> Any:
    """Parent an object with a constant matrix before its own location, rotation and scale, which become zero."""
    from mathutils import Matrix

    if parent is None and not _is_identity(matrix):
        parent = _empty(found, "axes")
        parent.matrix_basis, matrix = Matrix(matrix.tolist()), _identity()
    found.parent, found.matrix_parent_inverse = parent, Matrix(matrix.tolist())
    found.matrix_basis = Matrix.Identity(4)
    return found


def _author_run(found: Any, run: _Run) -> None:
    for axes, attribute in run.moves:
        for k, axis in enumerate(axes):
            _curve(found, "location", "XYZ".index(axis), _keys(attribute, k if len(axes) > 1 else None))
    turned = "".join(axes for axes, _ in run.turns)
    if turned == "Q":
        found.rotation_mode = "QUATERNION"
        _author_quaternions(found, run.turns[0][1])
        return
    order = turned + "".join(axis for axis in "ZYX" if axis not in turned)
    found.rotation_mode = order[::-1]  # Blender first names the axis that it applies first
    for axes, attribute in run.turns:
        for axis in axes:
            index = "XYZ".index(axis)
            keys = _keys(attribute, index if len(axes) > 1 else None, math.radians(1.0))
            _curve(found, "rotation_euler", index, keys)


def _author_quaternions(found: Any, attribute: Any) -> None:
    from mathutils import Quaternion

    keys: list[tuple[float, Any]] = []
    for time in attribute.GetTimeSamples():
        value = attribute.Get(time)
        turn = Quaternion((value.GetReal(), *value.GetImaginary()))
        if keys:
            early, last = keys[-1]
            turn.make_compatible(last)
            count = math.ceil(last.rotation_difference(turn).angle / TURN)
            shares = [k / count for k in range(1, count)]
            keys += [(early + share * (time - early), last.slerp(turn, share)) for share in shares]
        keys.append((time, turn))
    for k in range(4):
        _curve(found, "rotation_quaternion", k, [_Key(time, turn[k]) for time, turn in keys])


def _author_samples(frames: tuple[int, int], found: Any, local: Callable[[float], Any]) -> None:
    """Keys at `FINEST` times of every frame: of ``local``, the matrix on the object's parent at a time."""
    from mathutils import Matrix

    found.animation_data_clear()
    found.matrix_parent_inverse, found.rotation_mode = Matrix.Identity(4), "QUATERNION"
    poses: list[Any] = []
    for k in range((frames[1] - frames[0]) * FINEST + 1):
        time = frames[0] + k / FINEST
        place, turn, size = Matrix(local(time).tolist()).decompose()
        if poses:
            turn.make_compatible(poses[-1][2])
        poses.append((time, place, turn, size))
    for path, which, count in (("location", 1, 3), ("rotation_quaternion", 2, 4), ("scale", 3, 3)):
        for k in range(count):
            _curve(found, path, k, [_Key(pose[0], pose[which][k]) for pose in poses])


def _author_lens(found: Any, prim: Any) -> None:
    """The focal length of a cut between lenses, in the unit of the importer's film back."""
    attribute = prim.GetAttribute("focalLength")
    if attribute and attribute.ValueMightBeTimeVarying():
        scale = found.data.sensor_width / prim.GetAttribute("horizontalAperture").Get()
        _curve(found.data, "lens", 0, _keys(attribute, None, scale))


@dataclass
class _Key:
    """A key: its handles are at (time, value) ``before`` and ``after`` it; without them, a straight line follows, or
    the value is ``held`` until the next key."""

    time: float
    value: float
    before: tuple[float, float] | None = None
    after: tuple[float, float] | None = None
    held: bool = False


def _keys(attribute: Any, component: int | None, factor: float = 1.0) -> list[_Key]:
    """The keys of an attribute, or of one component of it: the knots of its spline, or its samples."""
    if not attribute.HasSpline():
        values = ((time, attribute.Get(time)) for time in attribute.GetTimeSamples())
        return [_Key(time, factor * (value if component is None else value[component])) for time, value in values]
    keys = []
    for knot in attribute.GetSpline().GetKnots().values():
        time, value = knot.GetTime(), factor * knot.GetValue()
        tangents = (
            (-knot.GetPreTanWidth(), knot.GetPreTanSlope()),
            (knot.GetPostTanWidth(), knot.GetPostTanSlope()),
        )
        before, after = ((time + width, value + factor * slope * width) for width, slope in tangents)
        keys.append(_Key(time, value, before, after))
    return keys


def _apart(keys: Sequence[_Key]) -> list[_Key]:
    """The keys without those that Blender would merge: a jump, as in a cut, becomes a held key and the one after it."""
    groups: list[list[_Key]] = []
    for key in keys:
        if groups and key.time - groups[-1][0].time < MERGED:
            groups[-1].append(key)
        else:
            groups.append([key])
    apart: list[_Key] = []
    for first, *_, last in ([group[0], *group] for group in groups):
        if first is not last:
            time, value = last.time - 2 * MERGED, first.value
            while apart and apart[-1].time > time - MERGED:
                apart.pop()
            if apart:  # on the straight line that ends at the jump
                early = apart[-1]
                value = early.value + (time - early.time) / (first.time - early.time) * (value - early.value)
            apart.append(_Key(time, value, held=True))
        apart.append(last)
    return apart


def _curve(found: Any, path: str, index: int, keys: Sequence[_Key]) -> None:
    """One native curve with these keys."""
    smooth = keys[0].after is not None
    keys = keys if smooth else _apart(keys)
    found.keyframe_insert(path, index=-1 if path in ("lens", *HIDING) else index, frame=keys[0].time)
    (curve,) = [each for each in _curves(found) if each.data_path == path and each.array_index == index]
    points = curve.keyframe_points
    points.add(len(keys) - len(points))
    points.foreach_set("co", [x for key in keys for x in (key.time, key.value)])
    for point, key in zip(points, keys, strict=True):
        point.interpolation = "CONSTANT" if key.held else "BEZIER" if smooth else "LINEAR"
        point.handle_left_type = point.handle_right_type = "FREE" if smooth else "VECTOR"
    if smooth:
        points.foreach_set("handle_left", [x for key in keys for x in key.before or ()])
        points.foreach_set("handle_right", [x for key in keys for x in key.after or ()])
    curve.update()


def _empty(found: Any, suffix: Any) -> Any:
    import bpy

    empty = bpy.data.objects.new(f"{found.name}.{suffix}", None)
    empty.empty_display_size = 0.1
    found.users_collection[0].objects.link(empty)
    return empty


def _agrees(scene: Any, frames: tuple[int, int], found: Any, world: Callable[[float], Any]) -> bool:
    """Whether an object stands where ``world`` puts it, on frames and between them."""
    first, last = frames
    for time in sorted({float(first), first + 0.375, (first + last) / 2 + 0.125, float(last)}):
        scene.frame_set(int(time // 1), subframe=time % 1)
        matrix = world(time)
        if abs(_world(found) - matrix).max() > SAME * (1.0 + abs(matrix[:3, 3]).max()):
            return False
    return True


# ---------------------------------------------------------------- the stage and the scene


def read_stage(path: str | Path) -> Any:
    """The stage, read by Blender's own USD."""
    load_usd()
    from pxr import Usd

    return Usd.Stage.Open(str(Path(path).resolve()))


def load_usd() -> None:
    """Make Blender's own USD importable: the module bpy does not."""
    import bpy

    version = f"python{sys.version_info.major}.{sys.version_info.minor}"
    home = Path(bpy.utils.resource_path("LOCAL")) / "python" / "lib" / version / "site-packages"
    if str(home) not in sys.path:
        sys.path.append(str(home))


def _prims(stage: Any, root: str, path: str) -> list[Any]:
    """The prims below ``root`` down to ``path``."""
    steps = path.split("/")[1:]
    paths = ["/" + "/".join(steps[: k + 1]) for k in range(len(steps))]
    return [stage.GetPrimAtPath(each) for each in paths if root == "/" or each.startswith(f"{root}/")]


def _at(stage: Any, path: str, time: float) -> Any:
    """World matrix of a prim at a time, in the stage's axes and units."""
    from pxr import UsdGeom

    prim = stage.GetPrimAtPath(path)
    return _matrix(UsdGeom.XformCache(time).GetLocalToWorldTransform(prim)) if path != "/" else _identity()


def _axes(stage: Any, time: float, shown: dict[Any, Any]) -> Any:
    """The importer's matrix from the stage's axes and units to metres, Z up: that of a root prim."""
    from pxr import UsdGeom

    for found, matrix in shown.items():
        prim = stage.GetPrimAtPath(f"/{re.sub(NUMBERED, '', found.name)}")
        if found.parent is None and prim and prim.IsA(UsdGeom.Xformable):
            return matrix @ _inverse(_at(stage, str(prim.GetPath()), time))
    return _identity()


def _set_scene(scene: Any, stage: Any) -> None:
    """Camera, cuts as markers bound to cameras, size, motion blur and renderer, as the stage requests."""
    from pxr import UsdGeom, UsdRender

    _set_look(scene)
    settings = UsdRender.Settings.GetStageRenderSettings(stage)
    targets = settings.GetCameraRel().GetTargets() if settings else []
    if not targets:
        return
    camera, cameras, render = UsdGeom.Camera(stage.GetPrimAtPath(targets[0])), _cameras(), scene.render
    scene.camera = cameras.get(targets[0].name)
    render.resolution_x, render.resolution_y = settings.GetResolutionAttr().Get()
    render.resolution_percentage = 100
    opens, closes = camera.GetShutterOpenAttr().Get() or 0.0, camera.GetShutterCloseAttr().Get() or 0.0
    render.use_motion_blur = closes > opens
    if closes > opens:
        middle = (opens + closes) / 2
        render.motion_blur_shutter = closes - opens
        render.motion_blur_position = "CENTER" if abs(middle) < 1e-6 else "START" if middle > 0 else "END"
    frames, names = (camera.GetPrim().GetAttribute(f"vehsim:cut:{what}") for what in ("frames", "cameras"))
    if frames and names:
        for frame, name in zip(frames.Get(), names.Get(), strict=True):
            scene.timeline_markers.new(name, frame=frame).camera = cameras.get(name)


def _set_look(scene: Any) -> None:
    """Cycles, denoised, with a filmic look."""
    render, cycles = scene.render, scene.cycles
    render.engine = "CYCLES"
    render.image_settings.file_format = "PNG"
    cycles.device, cycles.samples, cycles.time_limit = "CPU", SAMPLES, SECONDS
    cycles.use_adaptive_sampling, cycles.adaptive_threshold = True, 0.04
    cycles.use_denoising, cycles.denoiser = True, "OPENIMAGEDENOISE"
    scene.view_settings.view_transform, scene.view_settings.look = "AgX", "AgX - Medium High Contrast"
    scene.view_settings.exposure = 0.35


def _cameras() -> dict[str, Any]:
    """Camera objects by their prims' names."""
    import bpy

    return {re.sub(NUMBERED, "", found.name): found for found in bpy.data.objects if found.type == "CAMERA"}


def _matrix(matrix: Any) -> Any:
    """USD's matrix, for row vectors, as an array (4, 4) for column vectors, as Blender has them."""
    import numpy as np

    return np.array(matrix).T


def _identity() -> Any:
    import numpy as np

    return np.eye(4)


def _inverse(matrix: Any) -> Any:
    import numpy as np

    return np.linalg.inv(matrix)


def _is_identity(matrix: Any) -> bool:
    return bool(abs(matrix - _identity()).max() < 1e-6)


def _settled(matrix: Any) -> Any:
    """The identity instead of a matrix that differs from it by the rounding of Blender's single precision."""
    return _identity() if abs(matrix - _identity()).max() < SAME else matrix


def _world(found: Any) -> Any:
    import bpy
    import numpy as np

    return np.array(found.evaluated_get(bpy.context.evaluated_depsgraph_get()).matrix_world)


def still(scene: Any, path: str | Path, frame: int, camera: str | None, size: Sequence[int], samples: int) -> None:
    """A picture by Cycles, denoised. ``camera``: by name; default: the stage's only one, or its cut."""
    import bpy

    cameras = _cameras()
    name = camera or ("cut" if "cut" in cameras else min(cameras, default=None))
    if name not in cameras:
        raise SystemExit(f"camera {name!r}: not in the stage; choose one of {', '.join(sorted(cameras))}")
    scene.camera = cameras[name]
    scene.frame_set(frame)
    _set_look(scene)
    render = scene.render
    render.filepath = str(Path(path).resolve())
    render.resolution_x, render.resolution_y, render.resolution_percentage = size[0], size[1], 100
    scene.cycles.samples = samples
    bpy.ops.render.render(write_still=True)


def alembic(scene: Any, path: str | Path) -> None:
    """Everything in the scene as Alembic, in metres, Y up. Alembic keeps matrices, so a frame gets as many samples as
    its fastest rotation needs."""
    import bpy

    frames = range(scene.frame_start, scene.frame_end)
    moving = [found for found in bpy.data.objects if found.animation_data and found.animation_data.action]
    turning = [curve for found in moving for curve in _curves(found) if curve.data_path.startswith("rotation_")]
    # a component of a quaternion changes by at most half the angle
    changes = (abs(c.evaluate(f + 1) - c.evaluate(f)) * (1 + ("quat" in c.data_path)) for c in turning for f in frames)
    fastest = max(changes, default=0.0)
    count = min(2 ** math.ceil(math.log2(max(fastest / APART, 1.0))), FINEST)
    motion = (curve for found in moving for curve in _curves(found) if curve.data_path not in HIDING)
    points = (point for curve in motion for point in curve.keyframe_points)
    if any(point.interpolation == "CONSTANT" for point in points):  # a cut takes as long as one sample
        count = FINEST
    span = {"start": scene.frame_start, "end": scene.frame_end, "xsamples": count}
    bpy.ops.wm.alembic_export(filepath=str(Path(path).resolve()), **span)


def _caches(found: Any) -> Iterator[Any]:
    return (constraint for constraint in found.constraints if constraint.type == CACHED)


def _curves(found: Any) -> Iterator[Any]:
    for layer in found.animation_data.action.layers:
        for strip in layer.strips:
            for bag in strip.channelbags:
                yield from bag.fcurves


def main(arguments: Sequence[str]) -> None:
    parser = argparse.ArgumentParser(prog="blender.py", description=__doc__)
    parser.add_argument("stage")
    parser.add_argument("--bake", metavar="FILE.blend", help="native curves, saved here")
    parser.add_argument("--alembic", metavar="FILE.abc", help="the scene as Alembic")
    parser.add_argument("--motion", help="the variant to bake where a vehicle has it: exact, thinned or curves")
    parser.add_argument("--still", metavar="FILE.png", help="a picture rendered by Cycles")
    parser.add_argument("--frame", type=int, help="of the still; the middle one when left out")
    parser.add_argument("--camera")
    parser.add_argument("--fps", type=Fraction, help="the stage's exact rate, such as 24000/1001")
    parser.add_argument("--size", default="1920x1080")
    parser.add_argument("--samples", type=int, default=SAMPLES)
    given = parser.parse_args(arguments)
    scene = open_stage(given.stage, given.fps)
    if given.bake or given.alembic:
        bake(scene, given.stage, given.motion)
    if given.bake:
        import bpy

        bpy.ops.wm.save_as_mainfile(filepath=str(Path(given.bake).resolve()))
    if given.alembic:
        alembic(scene, given.alembic)
    if given.still:
        frame = given.frame if given.frame is not None else (scene.frame_start + scene.frame_end) // 2
        size = [int(side) for side in given.size.split("x")]
        still(scene, given.still, frame, given.camera, size, given.samples)


def write_blend(take: Take, folder: Path, progress: Progress) -> Sequence[Path]:
    """``<shot>.blend``: the stage as Blender imports it, with native curves."""
    progress("blend: curves", 0.0)
    path = folder / f"{take.name}.blend"
    motion = ["--motion", "curves"] if take.usd.curves is not None else []
    _run(folder / f"{take.name}.usda", "--bake", str(path), "--fps", str(take.fps), *motion)
    return [path]


def write_alembic(take: Take, folder: Path, progress: Progress) -> Sequence[Path]:
    """``<shot>.abc``: geometry, motion and cameras of the stage. Warns of spray, which Blender does not export."""
    from pxr import Usd, UsdGeom

    from vehsim.intake.usd import is_drawn

    progress("abc: samples", 0.0)
    path, stage = folder / f"{take.name}.abc", folder / f"{take.name}.usda"
    _run(stage, "--alembic", str(path), "--fps", str(take.fps))
    opened = Usd.Stage.Open(str(stage))  # a prim does not keep its stage open
    if any(prim.IsA(UsdGeom.Points) and is_drawn(prim) for prim in opened.Traverse()):
        warnings.warn(f"{path.name}: spray is left out; Blender exports no points", stacklevel=2)
    return [path]


def write_still(take: Take, folder: Path, progress: Progress) -> Sequence[Path]:
    """``<shot>.cycles.png``: the frame in the middle, 1920 x 1080, by Cycles."""
    progress("cycles: still", 0.0)
    path = folder / f"{take.name}.cycles.png"
    _run(folder / f"{take.name}.usda", "--still", str(path))
    return [path]


def _run(*arguments: Any) -> None:
    """Run this file in a separate process: Blender has global state, and its own numpy."""
    from vehsim.errors import ExportError

    command = [*_blender(), *map(str, arguments)]
    answer = subprocess.run(command, capture_output=True, text=True)
    if answer.returncode != 0:
        last = (answer.stderr.strip() or answer.stdout.strip()).splitlines()[-1:] or ["no message"]
        raise ExportError(f"Blender failed: {last[0]}", f"run {' '.join(command)} to see all messages")


def _blender() -> list[str]:
    """The program that runs this file: ``VEHSIM_BLENDER``, a Blender or a Python with the module bpy; else Blender on
    the path."""
    program = os.environ.get("VEHSIM_BLENDER") or shutil.which("blender")
    if program is None:
        from vehsim.errors import InputError

        raise InputError(
            "Blender is not on the path",
            "install Blender 5.0 or newer, or set VEHSIM_BLENDER to it or to the Python of an environment with bpy",
        )
    if Path(program).name.startswith("python"):
        return [program, __file__]
    return [program, "--background", "--factory-startup", "--python-exit-code", "1", "--python", __file__, "--"]


EXPORTERS = {
    "blend": ((".blend",), write_blend, "native curves; needs Blender 5"),
    "abc": ((".abc",), write_alembic, "Alembic; needs Blender 5"),
    "cycles": ((), write_still, "a still rendered by Cycles; needs Blender 5"),
}
"""By name: the endings of its files, what writes them, and what it makes."""


def __getattr__(name: str) -> Any:
    """Make the exporters only when vehsim requests them, because there is no vehsim inside Blender."""
    if name not in EXPORTERS:
        raise AttributeError(name)
    from vehsim.delivery.exporters import Exporter

    endings, write, makes = EXPORTERS[name]
    return Exporter(name, endings, write, ("usd",), makes=makes, ready=_blender)


if __name__ == "__main__":
    main(sys.argv[sys.argv.index("--") + 1 :] if "--" in sys.argv else sys.argv[1:])
