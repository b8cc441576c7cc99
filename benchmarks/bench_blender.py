"""Check that Blender places everything where the stage does, at every frame and halfway between frames.

``python benchmarks/bench_blender.py STAGE...`` opens exported stages in Blender (`VEHSIM_BLENDER`: a Python with bpy),
reads the world matrix of everything with a transform, and compares it with OpenUSD's own. It prints a table for
docs/blender.md; the exit code is 1 if a matrix differs by 1e-5 or a prim is missing.
"""

from __future__ import annotations

import os
import re
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np

TOLERANCE = 1e-5
"""Tolerance of matrix entries, relative to the distance from the origin: Blender stores single precision."""
INSIDE = """
import json, re, sys
import numpy as np
sys.path.insert(0, sys.argv[1])
import blender, bpy
scene = blender.open_stage(sys.argv[2])
for found in bpy.data.objects:  # points that move are nothing to a matrix, and slow
    for modifier in list(found.modifiers):
        found.modifiers.remove(modifier)
def path(found):
    own = re.sub(r"[.][0-9]{3}$", "", found.name)
    return (path(found.parent) if found.parent else "") + "/" + own
times = np.arange(scene.frame_start, scene.frame_end + 0.25, 0.5)
found = [found for found in scene.objects]
matrices = np.empty((len(times), len(found), 4, 4))
for k, time in enumerate(times):
    scene.frame_set(int(time // 1), subframe=float(time % 1))
    graph = bpy.context.evaluated_depsgraph_get()
    for j, each in enumerate(found):
        matrices[k, j] = each.evaluated_get(graph).matrix_world
np.savez(sys.argv[3], times=times, matrices=matrices, paths=[path(each) for each in found],
         kinds=[each.type for each in found])
"""


def in_blender(stage: Path) -> dict[str, np.ndarray]:
    """``times`` (n,), ``paths`` (m,), ``kinds`` (m,) and ``matrices`` (n, m, 4, 4) of all objects."""
    from vehsim.exporters import blender

    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "matrices.npz"
        command = [
            os.environ["VEHSIM_BLENDER"],
            "-c",
            INSIDE,
            str(Path(blender.__file__).parent),
            str(stage),
            str(file),
        ]
        answer = subprocess.run(command, capture_output=True, text=True)
        if not file.is_file():
            sys.exit(f"{stage}: Blender failed: {answer.stderr[-2000:]}")
        return dict(np.load(file))


def find(stage: Any, path: str, kind: str) -> Any:
    """The prim of an object. Blender merges an Xform and its only mesh into one object with the mesh's name."""
    from pxr import Usd, UsdGeom

    from vehsim.intake.usd import is_drawn

    def inside(prim: Any) -> Any:  # Blender omits guides and proxies
        children = prim.GetFilteredChildren(Usd.TraverseInstanceProxies())
        return [child for child in children if is_drawn(child)]

    prim = stage.GetPrimAtPath(path)
    if prim and (kind != "MESH" or prim.IsA(UsdGeom.Mesh)):
        return prim
    above, _, name = path.rpartition("/")
    meshes = [mesh for child in inside(stage.GetPrimAtPath(above)) for mesh in inside(child) if len(inside(child)) == 1]
    return next((mesh for mesh in meshes if mesh.GetName() == name), prim)


def compare(stage_path: Path) -> tuple[str, bool]:
    """A row of the table, and whether everything agrees."""
    from pxr import Usd, UsdGeom

    seen = in_blender(stage_path)
    stage = Usd.Stage.Open(str(stage_path))
    worst, where, missing = {0.0: 0.0, 0.5: 0.0}, "", []
    prims = []
    for path, kind in zip(seen["paths"], seen["kinds"], strict=True):
        prim = find(stage, str(path), str(kind))
        if not prim:
            missing.append(str(path))
        prims.append(prim)
    for time, matrices in zip(seen["times"], seen["matrices"], strict=True):
        cache = UsdGeom.XformCache(float(time))
        for prim, path, matrix in zip(prims, seen["paths"], matrices, strict=True):
            if not prim or prim.GetTypeName() == "DomeLight":
                continue
            expected = np.array(cache.GetLocalToWorldTransform(prim)).T
            size = max(1.0, float(np.abs(expected[:3, 3]).max()))
            off = float(np.abs(matrix - expected).max()) / size
            if off > max(worst.values()):
                where = str(path)
            worst[time % 1] = max(worst[time % 1], off)
    moving = int((np.ptp(seen["matrices"], axis=0).max(axis=(1, 2)) > 1e-9).sum())
    good = max(worst.values()) < TOLERANCE and not missing
    name = re.sub(r"\.\w+$", "", stage_path.name)
    frames = f"{seen['times'][0]:g} to {seen['times'][-1]:g}"
    row = f"| {name} | {frames} | {len(prims)} ({moving} move) | {worst[0.0]:.1e} | {worst[0.5]:.1e} |"
    if not good:
        row += f" {where} {missing[:8]}"
    return row, good


def main(stages: list[str]) -> int:
    print("| example | frames | objects | worst at whole frames | worst half way |\n|---|---|---|---|---|")
    good = True
    for stage in stages:
        row, fine = compare(Path(stage))
        print(row, flush=True)
        good = good and fine
    return 0 if good else 1


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
