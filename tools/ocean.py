"""The sea of an exported stage beside Blender's Ocean modifier: one camera, frame, boat, light and significant height.

``python tools/ocean.py STAGE FRAME HEIGHT WIND HEADING OUT``, run by the Python of an environment with bpy. HEIGHT: the
significant height of the stage's sea, m; WIND m/s; HEADING deg: where its waves run. Writes OUT/vehsim.png and
OUT/ocean.png, both by Cycles. Prints the time that the modifier takes, and the height of its waves.
"""

from __future__ import annotations

import importlib.util
import math
import sys
import time
from pathlib import Path
from typing import Any

import bpy
import numpy as np

SIZE, SAMPLES = (960, 540), 24
TILE, TILES, RESOLUTION = 300, 5, 16
"""Side of the modifier's tile, m; how many lie side by side; it has (16 RESOLUTION)^2 points."""
CHOPPINESS, FOAM = 0.9, 0.15
"""Of the modifier: as the stage's sea, and the coverage that it calls 0.15."""


def exporter() -> Any:
    """vehsim's module that runs in Blender."""
    path = Path(__file__).parents[1] / "exporters" / "blender.py"
    spec = importlib.util.spec_from_file_location("vehsim_blender", path)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module  # its dataclasses look it up
    spec.loader.exec_module(module)
    return module


def ocean(frame: int, fps: float, height: float, wind: float, heading: float) -> Any:
    """An Ocean modifier with the spectrum of a full sea, scaled to the significant height."""
    bpy.ops.mesh.primitive_plane_add(size=1)
    plane = bpy.context.object
    waves = plane.modifiers.new("Ocean", "OCEAN")
    waves.geometry_mode, waves.spectrum = "GENERATE", "PIERSON_MOSKOWITZ"
    waves.spatial_size, waves.size = TILE, 1.0
    waves.repeat_x = waves.repeat_y = TILES
    waves.resolution = waves.viewport_resolution = RESOLUTION
    waves.wind_velocity, waves.wave_direction = wind, math.radians(heading)
    waves.wave_alignment, waves.depth, waves.random_seed = 0.5, 200.0, 5
    waves.choppiness, waves.use_foam, waves.foam_layer_name = CHOPPINESS, True, "foam"
    waves.foam_coverage = FOAM
    waves.time = (frame - bpy.context.scene.frame_start) / fps
    natural = 4 * points(plane)[:, 2].std()
    waves.wave_scale *= height / natural
    began = time.process_time()
    waves.time += 1 / fps
    z = points(plane)[:, 2]
    taken = time.process_time() - began
    print(f"Ocean: {len(z)} points, {taken:.2f} CPU s a frame, height {natural:.2f} m, scaled to {4 * z.std():.2f} m")
    low = np.array(plane.bound_box).mean(axis=0)
    plane.location = (-low[0], -low[1], 0.0)
    return plane


def points(made: Any) -> Any:
    """The evaluated points (n, 3)."""
    bpy.context.view_layer.update()
    mesh = made.evaluated_get(bpy.context.evaluated_depsgraph_get()).data
    found = np.empty(3 * len(mesh.vertices))
    mesh.vertices.foreach_get("co", found)
    return found.reshape(-1, 3)


def material() -> Any:
    """Water as in vehsim's stages, with ripples, white where the modifier has foam."""
    made = bpy.data.materials.new("ocean")
    made.use_nodes = True
    nodes, links = made.node_tree.nodes, made.node_tree.links
    surface = nodes["Principled BSDF"]
    surface.inputs["IOR"].default_value = 1.333
    foam = nodes.new("ShaderNodeVertexColor")
    foam.layer_name = "foam"
    for name, dry, white in (
        ("Base Color", (0.010, 0.032, 0.038, 1), (0.78, 0.8, 0.8, 1)),
        ("Roughness", (0.06,) * 3 + (1,), (0.85,) * 3 + (1,)),
    ):
        mix = nodes.new("ShaderNodeMix")
        mix.data_type = "RGBA"
        links.new(foam.outputs["Color"], mix.inputs["Factor"])
        mix.inputs[6].default_value, mix.inputs[7].default_value = dry, white
        links.new(mix.outputs[2], surface.inputs[name])
    bump, noise = nodes.new("ShaderNodeBump"), nodes.new("ShaderNodeTexNoise")
    place = nodes.new("ShaderNodeTexCoord")
    noise.inputs["Scale"].default_value, noise.inputs["Detail"].default_value = 1.2, 6.0
    bump.inputs["Distance"].default_value = 0.12
    links.new(place.outputs["Object"], noise.inputs["Vector"])
    links.new(noise.outputs["Fac"], bump.inputs["Height"])
    links.new(bump.outputs["Normal"], surface.inputs["Normal"])
    return made


def main(stage: str, frame: int, height: float, wind: float, heading: float, out: Path) -> None:
    vehsim = exporter()
    scene = vehsim.open_stage(stage)
    vehsim.still(scene, out / "vehsim.png", frame, None, SIZE, SAMPLES)
    for found in bpy.data.objects:
        if found.type in {"MESH", "POINTCLOUD"} and is_water(found):
            found.hide_render = True
    made = ocean(frame, scene.render.fps / scene.render.fps_base, height, wind, heading)
    made.data.materials.append(material())
    vehsim.still(scene, out / "ocean.png", frame, None, SIZE, SAMPLES)


def is_water(found: Any) -> bool:
    """Whether an object is below the stage's prim of the water."""
    while found is not None:
        if found.name.split(".")[0] == "water":
            return True
        found = found.parent
    return False


if __name__ == "__main__":
    path, at, *numbers, folder = sys.argv[1:]
    main(path, int(at), *map(float, numbers), Path(folder))
