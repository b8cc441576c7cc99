"""The USD exporter: a take in, a shot stage, an animation layer per vehicle and copies of the assets out.

What belongs here is the shot stage and the order of work. The animation layer is written in `animation.py`, assets are
gathered in `packing.py`, lights in `lighting.py`, ground without a look of its own in `ground.py`; `readback.py` then
opens what was written and compares it with the clips.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from vehsim.errors import ExportError
from vehsim.exporters.animation import write_animation
from vehsim.exporters.guides import author_guides
from vehsim.exporters.lighting import author_lights
from vehsim.exporters.metadata import author_stage_metadata, correct_units, samples
from vehsim.exporters.obstacles import author_obstacles
from vehsim.exporters.packing import Pack
from vehsim.exporters.readback import check_readback
from vehsim.take import Exporter, Progress, Take

if TYPE_CHECKING:
    from vehsim.cameras import Camera
    from vehsim.clip import Clip


def write_usd(take: Take, folder: Path, progress: Progress) -> Sequence[Path]:
    """Write ``<shot>.usda``, ``layers/`` and ``assets/`` below ``folder``; returns every file written.

    Raises ``ExportError`` naming prim and frame when the composed stage does not read back as the clips say.
    """
    from pxr import Kind, Tf, Usd, UsdGeom

    if not Tf.IsValidIdentifier(take.name):
        raise ExportError(f"shot name {take.name!r}: not a USD prim name; use letters, digits and _ only")
    for name, clip in take.clips.items():
        _check_finite(name, clip)
    pack = Pack(folder)
    clips = {name: clip.resample(take.fps) for name, clip in take.clips.items()}
    path = folder / f"{take.name}.usda"
    stage = Usd.Stage.CreateNew(str(path))
    root = UsdGeom.Xform.Define(stage, f"/{take.name}").GetPrim()
    stage.SetDefaultPrim(root)
    author_stage_metadata(stage.GetRootLayer(), take.fps, take.frames)
    _model(root, Kind.Tokens.assembly, take.name, path.name)
    for scope in ("vehicles", "env", "cameras", "lights", "guides"):
        grouped = scope in ("vehicles", "env")
        prim = (UsdGeom.Xform if grouped else UsdGeom.Scope).Define(stage, root.GetPath().AppendChild(scope)).GetPrim()
        if grouped:
            Usd.ModelAPI(prim).SetKind(Kind.Tokens.group)

    for done, (name, clip) in enumerate(clips.items()):
        progress(f"usd: {name}", done / (len(clips) + 2))
        layer = folder / "layers" / f"{name}.anim.usdc"
        pack.written.append(write_animation(clip, name, pack, layer, take.fps, take.frames))
        prim = UsdGeom.Xform.Define(stage, f"/{take.name}/vehicles/{name}").GetPrim()
        prim.GetReferences().AddReference(pack.relative(layer, path))
        _model(prim, Kind.Tokens.component, clip.vehicle.name, pack.relative(layer, path))
    progress("usd: environment", len(clips) / (len(clips) + 2))
    _author_terrain(stage, f"/{take.name}/env/terrain", take, pack, path)
    author_obstacles(stage, f"/{take.name}/env/obstacles", take)
    for camera in take.cameras:
        author_camera(stage, f"/{take.name}/cameras/{camera.name}", camera)
    author_lights(stage, f"/{take.name}/lights", take, pack, path)
    author_guides(stage, f"/{take.name}/guides", take, clips)
    stage.GetRootLayer().Save()
    pack.written.append(path)

    progress("usd: reading back", (len(clips) + 1) / (len(clips) + 2))
    check_readback(path, take.name, clips, take.cameras)
    return pack.written


def _check_finite(name: str, clip: Clip) -> None:
    """Nothing that is not a number gets into a stage."""
    for what, values in {"positions": clip.positions, "orientations": clip.orientations, **clip.channels}.items():
        bad = ~np.isfinite(np.reshape(values, (len(clip.times), -1))).all(axis=1)
        if bad.any():
            raise ExportError(
                f"{name}.{what}: not a finite number at frame {clip.frames[bad.argmax()]:g}; mend the clip"
            )


def _model(prim: Any, kind: str, name: str, identifier: str) -> None:
    """Author ``kind`` and ``assetInfo`` so that pipelines can tell what a prim is and where it came from."""
    from pxr import Sdf, Usd

    model = Usd.ModelAPI(prim)
    model.SetKind(kind)
    model.SetAssetName(name)
    model.SetAssetIdentifier(Sdf.AssetPath(identifier))


def _author_terrain(stage: Any, prim_path: str, take: Take, pack: Pack, shot: Path) -> None:
    """Reference the terrain's look, or a ground authored from its heights when it has none."""
    from pxr import Kind, UsdGeom

    from vehsim.exporters.ground import write_ground

    terrain = take.world.terrain
    if terrain is None:
        return
    if terrain.look is not None:
        asset = pack.add(terrain.look, terrain.name)
    else:
        asset, files = write_ground(terrain, pack.folder / "assets")
        pack.written.extend(files)
    xform = UsdGeom.Xform.Define(stage, prim_path)
    xform.GetPrim().GetReferences().AddReference(pack.relative(asset, shot))
    correct_units(xform, asset)
    _model(xform.GetPrim(), Kind.Tokens.component, terrain.name, pack.relative(asset, shot))


def author_camera(stage: Any, prim_path: str, camera: Camera) -> None:
    """A camera with its lens in tenths of the stage unit, as USD wants it: 35 mm on a metre stage is 0.35."""
    from pxr import Gf, Sdf, UsdGeom

    mm = 1e-3 / (UsdGeom.GetStageMetersPerUnit(stage) * 0.1)
    prim = UsdGeom.Camera.Define(stage, prim_path)
    prim.CreateProjectionAttr(UsdGeom.Tokens.perspective)
    prim.CreateFocalLengthAttr(camera.lens_mm * mm)
    prim.CreateHorizontalApertureAttr(camera.aperture_mm[0] * mm)
    prim.CreateVerticalApertureAttr(camera.aperture_mm[1] * mm)
    prim.CreateClippingRangeAttr(Gf.Vec2f(*camera.clip_range))
    spec = stage.GetRootLayer().GetPrimAtPath(prim_path)
    frames = np.asarray(camera.frames, float)
    with Sdf.ChangeBlock():
        samples(spec, "xformOp:translate", Sdf.ValueTypeNames.Double3, frames, camera.positions)
        samples(spec, "xformOp:orient", Sdf.ValueTypeNames.Quatd, frames, camera.orientations)
    prim.GetXformOpOrderAttr().Set(["xformOp:translate", "xformOp:orient"])


exporter = Exporter(name="usd", suffixes=(".usd", ".usda", ".usdc"), write=write_usd)
