"""Open an exported stage in Blender: bake its motion to native keys, or render a still with Cycles.

Inside Blender, vehsim is not needed: this file runs in a Python with the module `bpy` or in Blender itself (``blender
--background --python blender.py -- STAGE ...``). The exporters `blend` and `cycles` run it in a separate process.
"""

from __future__ import annotations

import argparse
import os
import re
import shutil
import subprocess
import sys
from collections.abc import Iterator, Sequence
from fractions import Fraction
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from vehsim.delivery.exporters import Progress
    from vehsim.delivery.take import Take

CACHED = "TRANSFORM_CACHE"
"""The constraint that Blender's USD importer adds to a moving object: it reads the file at every frame."""
SUN = 4.0
"""Factor by which Blender's USD importer makes a sun too bright: UsdLux's normalised intensity is its irradiance."""
SECONDS = 240
"""Longest time for rendering a still, s, before denoising."""


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
    if fps is not None:
        scene.render.fps = -(-fps.numerator // fps.denominator)
        scene.render.fps_base = float(scene.render.fps / fps)
    return scene


def bake(scene: Any) -> None:
    """Replace the file by native keys on every frame: location, rotation and scale, with linear interpolation."""
    import bpy

    moving = [(found, list(_caches(found))) for found in bpy.data.objects if any(_caches(found))]
    poses: dict[str, list[Any]] = {found.name: [] for found, _ in moving}
    frames = range(scene.frame_start, scene.frame_end + 1)
    for frame in frames:
        scene.frame_set(frame)
        for found, _ in moving:
            above = found.parent.matrix_world if found.parent else None
            local = above.inverted() @ found.matrix_world if above else found.matrix_world
            poses[found.name].append((found.matrix_parent_inverse.inverted() @ local).decompose())
    for found, caches in moving:
        for constraint in caches:
            found.constraints.remove(constraint)
        found.rotation_mode = "QUATERNION"
        last = None
        for frame, (place, turn, size) in zip(frames, poses[found.name], strict=True):
            if last is not None:
                turn.make_compatible(last)
            found.location, found.rotation_quaternion, found.scale, last = place, turn, size, turn
            for path in ("location", "rotation_quaternion", "scale"):
                found.keyframe_insert(path, frame=frame)
        for curve in _curves(found):
            for key in curve.keyframe_points:
                key.interpolation = "LINEAR"
    scene.frame_set(scene.frame_start)


def still(scene: Any, path: str | Path, frame: int, camera: str | None, size: Sequence[int], samples: int) -> None:
    """A picture by Cycles, denoised. ``camera``: by name; default: the stage's only one, or its cut."""
    import bpy

    # Blender calls the second object of a name, of any kind, "pad.001"
    cameras = {re.sub(r"\.\d{3}$", "", found.name): found for found in bpy.data.objects if found.type == "CAMERA"}
    name = camera or ("cut" if "cut" in cameras else min(cameras, default=None))
    if name not in cameras:
        raise SystemExit(f"camera {name!r}: not in the stage; choose one of {', '.join(sorted(cameras))}")
    scene.camera = cameras[name]
    scene.frame_set(frame)
    render = scene.render
    render.engine, render.filepath = "CYCLES", str(Path(path).resolve())
    render.resolution_x, render.resolution_y, render.resolution_percentage = size[0], size[1], 100
    render.image_settings.file_format = "PNG"
    cycles = scene.cycles
    cycles.device, cycles.samples, cycles.time_limit = "CPU", samples, SECONDS
    cycles.use_adaptive_sampling, cycles.adaptive_threshold = True, 0.04
    cycles.use_denoising, cycles.denoiser = True, "OPENIMAGEDENOISE"
    scene.view_settings.view_transform, scene.view_settings.look = "AgX", "AgX - Medium High Contrast"
    scene.view_settings.exposure = 0.35
    bpy.ops.render.render(write_still=True)


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
    parser.add_argument("--bake", metavar="FILE.blend", help="native keys, saved here")
    parser.add_argument("--still", metavar="FILE.png", help="a picture by Cycles")
    parser.add_argument("--frame", type=int, help="of the still; the middle one when left out")
    parser.add_argument("--camera")
    parser.add_argument("--fps", type=Fraction, help="the stage's exact rate, such as 24000/1001")
    parser.add_argument("--size", default="1920x1080")
    parser.add_argument("--samples", type=int, default=40)
    given = parser.parse_args(arguments)
    scene = open_stage(given.stage, given.fps)
    if given.bake:
        import bpy

        bake(scene)
        bpy.ops.wm.save_as_mainfile(filepath=str(Path(given.bake).resolve()))
    if given.still:
        frame = given.frame if given.frame is not None else (scene.frame_start + scene.frame_end) // 2
        size = [int(side) for side in given.size.split("x")]
        still(scene, given.still, frame, given.camera, size, given.samples)


def write_blend(take: Take, folder: Path, progress: Progress) -> Sequence[Path]:
    """``<shot>.blend``: the stage as Blender imports it, with native keys."""
    progress("blend: keys", 0.0)
    path = folder / f"{take.name}.blend"
    _run(folder / f"{take.name}.usda", "--bake", str(path), "--fps", str(take.fps))
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


def __getattr__(name: str) -> Any:
    """Make the exporters only when vehsim requests them, because there is no vehsim inside Blender."""
    if name in ("blend", "cycles"):
        from vehsim.delivery.exporters import Exporter

        if name == "blend":
            return Exporter(name, (".blend",), write_blend, ("usd",), makes="native keys; needs Blender 5")
        return Exporter(name, (), write_still, ("usd",), makes="a still by Cycles; needs Blender 5")
    raise AttributeError(name)


if __name__ == "__main__":
    main(sys.argv[sys.argv.index("--") + 1 :] if "--" in sys.argv else sys.argv[1:])
