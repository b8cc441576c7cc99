"""The USD exporter: from a take to a shot stage, an animation layer per vehicle and copies of the assets.

This module writes the shot stage, in order. `animation.py` writes the animation layer, `packing.py` collects assets,
`scenery/lighting.py` writes lights, `scenery/ground.py` ground without a look of its own; then `readback.py` opens the
result and compares it with the clips.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from vehsim.cameras.cuts import CUT
from vehsim.delivery.exporters import Exporter
from vehsim.delivery.take import Take
from vehsim.errors import ExportError
from vehsim.exporters.usd.animation import write_animation
from vehsim.exporters.usd.keeping import keep_vehicles
from vehsim.exporters.usd.metadata import (
    Z_UP_METRES,
    Units,
    author_corrections,
    author_stage_metadata,
    correct_units,
    samples,
)
from vehsim.exporters.usd.packing import Pack
from vehsim.exporters.usd.physics import author_mass
from vehsim.exporters.usd.readback import check_curves, check_readback
from vehsim.exporters.usd.sampling import clip_at
from vehsim.exporters.usd.scenery.guides import author_guides
from vehsim.exporters.usd.scenery.lighting import author_lights
from vehsim.exporters.usd.scenery.obstacle_meshes import author_obstacles
from vehsim.exporters.usd.scenery.tyre_marks import author_tyre_marks
from vehsim.exporters.usd.scenery.water import write_water
from vehsim.exporters.usd.value_clips import split_into_clips
from vehsim.exporters.usd.versions import write_latest
from vehsim.rig.blocking import write_over
from vehsim.rig.tolerances import curve_tolerances
from vehsim.runtime.progress import Progress

if TYPE_CHECKING:
    from vehsim.cameras.camera import Camera
    from vehsim.clip.clip import Clip

LAYERS = {"exact": "{}.anim.usdc", "thinned": "{}.thinned.usdc", "curves": "{}.curves.usda"}
"""Form of a vehicle's motion -> its layer. Splines are text: few numbers, and a binary layer of its own version."""


def write_usd(take: Take, folder: Path, progress: Progress) -> Sequence[Path]:
    """Write ``<shot>.usda``, ``layers/`` and ``assets/`` below ``folder``; returns every file written.

    Raises ``ExportError`` naming prim and frame if the composed stage differs from the clips.
    """
    from pxr import Kind, Tf, Usd, UsdGeom

    if not Tf.IsValidIdentifier(take.name):
        raise ExportError("not a USD prim name", "use letters, digits and _ only", key="shot.name", value=take.name)
    for name, clip in take.clips.items():
        _check_finite(name, clip)
    settings = take.usd
    units = Units(settings.up_axis, settings.meters_per_unit)
    keep = settings.assets == "keep" or settings.layer_only
    pack = Pack(folder, keep=keep, beyond=settings.outside == "copy")
    clips = {name: _whole_frames(clip, take) for name, clip in take.clips.items()}
    layers: dict[str, dict[str, Path]] = {}
    for done, name in enumerate(clips):
        progress(f"usd: {name}", done / (len(clips) + 2))
        layers[name] = write_layers(take, name, pack, units)
    if settings.layer_only:
        for name, clip in clips.items():
            check_readback(layers[name]["exact"], {f"/{name}": clip}, {}, units)
        return pack.written
    path = folder / f"{take.name}.usda"
    stage = Usd.Stage.CreateNew(str(path))
    root = UsdGeom.Xform.Define(stage, f"/{take.name}").GetPrim()
    stage.SetDefaultPrim(root)
    author_stage_metadata(stage.GetRootLayer(), take.fps, take.frames, units)
    _model(root, Kind.Tokens.assembly, take.name, path.name)
    for scope in ("vehicles", "env", "cameras", "lights", "guides"):
        grouped = scope in ("vehicles", "env")
        prim = (UsdGeom.Xform if grouped else UsdGeom.Scope).Define(stage, root.GetPath().AppendChild(scope)).GetPrim()
        if grouped:
            Usd.ModelAPI(prim).SetKind(Kind.Tokens.group)
        if scope in ("env", "lights", "guides") and units.corrections():  # their content is in metres, Z up
            prim.SetTypeName("Xform")
            author_corrections(UsdGeom.Xform(prim), units.corrections())

    for name, clip in clips.items():
        prim = UsdGeom.Xform.Define(stage, f"/{take.name}/vehicles/{name}").GetPrim()
        _reference_layers(prim, layers[name], path, pack)
        author_bounds(prim, take.frames)
        author_mass(prim, clip.vehicle, units)
        _model(prim, Kind.Tokens.component, clip.vehicle.name, pack.relative(layers[name]["exact"], path))
    progress("usd: environment", len(clips) / (len(clips) + 2))
    _author_terrain(stage, f"/{take.name}/env", take, pack, path)
    with _layer_of(stage, f"/{take.name}/env/obstacles", take, pack, path, Z_UP_METRES) as layer:
        author_obstacles(layer, "/obstacles", take, pack)
    if settings.tyre_marks:
        with _layer_of(stage, f"/{take.name}/env/tyre_marks", take, pack, path, Z_UP_METRES) as layer:
            author_tyre_marks(layer, "/tyre_marks", take, pack)
    at = len(clips) / (len(clips) + 2)
    if water := write_water(take, folder, lambda share: progress("usd: water", at + share / (len(clips) + 2))):
        prim = UsdGeom.Xform.Define(stage, f"/{take.name}/env/water").GetPrim()
        prim.GetPayloads().AddPayload(pack.relative(water[0], path))
        author_bounds(prim, take.frames)
        _model(prim, Kind.Tokens.component, "water", pack.relative(water[0], path))
        pack.written.extend(water)
    with _layer_of(stage, f"/{take.name}/cameras", take, pack, path, units) as layer:
        for camera in take.cameras:
            author_camera(layer, f"/cameras/{camera.name}", camera, units, settings.shutter)
        if take.cuts:
            author_cuts(layer.GetPrimAtPath(f"/cameras/{CUT}"), take.cuts)
    author_render(stage, take)
    author_lights(stage, f"/{take.name}/lights", take, pack, path)
    with _layer_of(stage, f"/{take.name}/guides", take, pack, path, Z_UP_METRES) as layer:
        author_guides(layer, "/guides", take, clips)
    for name, blocking in take.blockings.items():
        clip, layer = clips[name], folder / "layers" / f"{name}.blocking.usdc"
        pack.written.append(write_over(blocking, clip.frames, clip.positions, clip.matrices()[:, :3, :3], layer))
    stage.GetRootLayer().Save()
    pack.written.append(path)

    progress("usd: reading back", (len(clips) + 1) / (len(clips) + 2))
    check_readback(path, _prims(take, _shown(take, clips)), _cameras(take), units)
    return pack.written


@contextmanager
def _layer_of(stage: Any, prim_path: str, take: Take, pack: Pack, shot: Path, units: Units) -> Iterator[Any]:
    """A stage for the prims below a prim of the shot: bulky numbers go into a separate binary layer.

    The prims of ``/shot/cameras`` are authored below ``/cameras``; without prims there is no layer.
    """
    from pxr import Usd, UsdGeom

    name = prim_path.rpartition("/")[2]
    path = pack.folder / "layers" / f"{name}.usdc"
    layer = Usd.Stage.CreateNew(str(path))
    author_stage_metadata(layer.GetRootLayer(), take.fps, take.frames, units)
    layer.SetDefaultPrim(UsdGeom.Scope.Define(layer, f"/{name}").GetPrim())
    yield layer
    if layer.GetDefaultPrim().GetChildren():
        layer.GetRootLayer().Save()
        pack.written.append(path)
        prim = stage.GetPrimAtPath(prim_path) or stage.DefinePrim(prim_path, "Xform")
        prim.GetReferences().AddReference(pack.relative(path, shot))
    else:
        path.unlink(missing_ok=True)


def _whole_frames(clip: Clip, take: Take) -> Clip:
    """The clip on the whole frames that it shares with the take."""
    clip = replace(clip, fps=take.fps)
    first, last = max(take.frames[0], clip.start_frame), min(take.frames[1], clip.end_frame)
    return clip_at(clip, np.arange(first, last + 1, dtype=float))


def write_layers(take: Take, name: str, pack: Pack, units: Units) -> dict[str, Path]:
    """The animation layer of a vehicle, "exact"; with thinned keys and with curves, if requested, a layer of each."""
    settings = take.usd
    clip = replace(take.clips[name], fps=take.fps)
    forms: dict[str, dict[str, Any]] = {"exact": {"shutter": settings.shutter}}
    if settings.thin is not None:
        forms["thinned"] = {"thin": settings.thin}
    rig = clip.vehicle.rig
    tolerances = None if settings.curves is None or rig is None else curve_tolerances(rig, *settings.curves)
    if tolerances is not None:
        earlier = take.retouches and take.retouches / "layers" / LAYERS["curves"].format(name)
        forms["curves"] = {"shutter": settings.shutter, "curves": tolerances, "earlier": earlier}
    layers = {}
    for form, how in forms.items():
        layer = pack.folder / "layers" / LAYERS[form].format(name)
        layers[form] = write_animation(clip, name, pack, layer, take.fps, take.frames, units, **how)
        pack.written.append(layer)
        if settings.clip_frames is not None and form != "curves":
            pack.written.extend(split_into_clips(layer, settings.clip_frames))
    if tolerances is not None:
        check_curves(layers["curves"], f"/{name}", clip, tolerances, units)
    return layers


def _reference_layers(prim: Any, layers: Mapping[str, Path], shot: Path, pack: Pack) -> None:
    """Reference the animation; several layers become variants of the set ``motion``, of which "exact" is selected."""
    if len(layers) == 1:
        prim.GetReferences().AddReference(pack.relative(layers["exact"], shot))
        return
    variants = prim.GetVariantSets().AddVariantSet("motion")
    for variant, layer in reversed(list(layers.items())):
        variants.AddVariant(variant)
        variants.SetVariantSelection(variant)
        with variants.GetVariantEditContext():
            prim.GetReferences().AddReference(pack.relative(layer, shot))


def _shown(take: Take, clips: Mapping[str, Clip]) -> Mapping[str, Clip]:
    """The poses to read back: the clips on whole frames and, with an open shutter, at its opening and closing."""
    if take.usd.shutter is None:
        return clips
    shown = {}
    for name, clip in clips.items():
        frames = np.unique(np.round(clip.frames[:, None] + [*take.usd.shutter, 0.0], 9).ravel())
        shown[name] = clip_at(replace(take.clips[name], fps=take.fps), frames)
    return shown


def _prims(take: Take, clips: Mapping[str, Clip]) -> dict[str, Clip]:
    return {f"/{take.name}/vehicles/{name}": clip for name, clip in clips.items()}


def _cameras(take: Take) -> dict[str, Camera]:
    return {f"/{take.name}/cameras/{camera.name}": camera for camera in take.cameras}


def _check_finite(name: str, clip: Clip) -> None:
    """Refuse values that are not finite."""
    for what, values in {"positions": clip.positions, "orientations": clip.orientations, **clip.channels}.items():
        bad = ~np.isfinite(np.reshape(values, (len(clip.times), -1))).all(axis=1)
        if bad.any():
            raise ExportError(
                f"not a finite number at frame {clip.frames[bad.argmax()]:g}", "fix the clip", key=f"{name}.{what}"
            )


def _model(prim: Any, kind: str, name: str, identifier: str) -> None:
    """Author ``kind`` and ``assetInfo`` so that pipelines know what a prim is and where it comes from."""
    from pxr import Sdf, Usd

    model = Usd.ModelAPI(prim)
    model.SetKind(kind)
    model.SetAssetName(name)
    model.SetAssetIdentifier(Sdf.AssetPath(identifier))


def author_bounds(prim: Any, frames: tuple[int, int]) -> None:
    """Author ``extentsHint`` on a prim with a payload, at ``frames[0]``: tools draw its box where it is not loaded."""
    from pxr import UsdGeom

    cache = UsdGeom.BBoxCache(frames[0], UsdGeom.Imageable.GetOrderedPurposeTokens(), useExtentsHint=True)
    model = UsdGeom.ModelAPI.Apply(prim)
    model.SetExtentsHint(model.ComputeExtentsHint(cache))


def _author_terrain(stage: Any, scope: str, take: Take, pack: Pack, shot: Path) -> None:
    """Reference the terrain's look, or a ground authored from its heights if it has none.

    A look that says what it shows gets the surface on which the vehicles drive, if that is another one.
    """
    from pxr import Kind, UsdGeom

    from vehsim.exporters.usd.scenery.driven import surface_of
    from vehsim.exporters.usd.scenery.ground import author_surface, level_ground, write_ground
    from vehsim.world.terrain.terrain import Terrain

    terrain, name = take.world.terrain, "terrain"
    middle = level_ground(take)
    if middle is not None:
        terrain, name = Terrain.load("flat"), "ground"
    if terrain is None:
        return
    surface = surface_of(take)
    if terrain.look is not None:
        asset = pack.add(terrain.look, terrain.name)
    else:
        asset, files = write_ground(terrain, pack.folder / "assets", surface)
        pack.written.extend(files)
    xform = UsdGeom.Xform.Define(stage, f"{scope}/{name}")
    xform.GetPrim().GetPayloads().AddPayload(pack.relative(asset, shot))
    if middle is not None and middle.any():
        xform.AddTranslateOp().Set((*middle.tolist(), 0.0))
    if surface is not None and terrain.shows not in (None, surface):
        file = pack.folder / "assets" / "surfaces" / f"{surface.replace(' ', '_')}.png"
        place = f"{scope}/materials/{file.stem}"
        author_surface(stage, place, xform.GetPrim(), file, pack.relative(file, shot), surface)
        pack.written.append(file)
    author_bounds(xform.GetPrim(), take.frames)
    correct_units(xform, asset)
    _model(xform.GetPrim(), Kind.Tokens.component, terrain.name, pack.relative(asset, shot))


def author_camera(
    stage: Any,
    prim_path: str,
    camera: Camera,
    units: Units = Z_UP_METRES,
    shutter: tuple[float, float] | None = None,
) -> None:
    """A camera with its lens in tenths of the stage unit, as USD requires: 35 mm on a metre stage is 0.35."""
    from pxr import Gf, Sdf, UsdGeom

    mm = 1e-3 / (UsdGeom.GetStageMetersPerUnit(stage) * 0.1)
    prim = UsdGeom.Camera.Define(stage, prim_path)
    prim.CreateProjectionAttr(UsdGeom.Tokens.perspective)
    lens = np.asarray(camera.lens_mm) * mm
    focal = prim.CreateFocalLengthAttr(float(lens.flat[0]))
    if np.ptp(lens) > 0:  # a cut between lenses
        for frame, value in zip(camera.frames, lens, strict=True):
            focal.Set(float(value), float(frame))
    prim.CreateHorizontalApertureAttr(camera.aperture_mm[0] * mm)
    prim.CreateVerticalApertureAttr(camera.aperture_mm[1] * mm)
    prim.CreateClippingRangeAttr(Gf.Vec2f(*(float(x) / units.metres for x in camera.clip_range)))
    if shutter is not None:
        prim.CreateShutterOpenAttr(shutter[0])
        prim.CreateShutterCloseAttr(shutter[1])
    spec = stage.GetRootLayer().GetPrimAtPath(prim_path)
    frames = np.asarray(camera.frames, float)
    with Sdf.ChangeBlock():
        samples(spec, "xformOp:translate", Sdf.ValueTypeNames.Double3, frames, units.points(camera.positions))
        samples(spec, "xformOp:orient", Sdf.ValueTypeNames.Quatd, frames, units.views(camera.orientations))
    prim.GetXformOpOrderAttr().Set(["xformOp:translate", "xformOp:orient"])


def author_cuts(camera: Any, cuts: Sequence[tuple[int, str]]) -> None:
    """The cut list on the camera that it makes: first frames, and the cameras that it shows from them on."""
    from pxr import Sdf, Vt

    frames, names = zip(*cuts, strict=True)
    camera.CreateAttribute("vehsim:cut:frames", Sdf.ValueTypeNames.IntArray).Set(Vt.IntArray(frames))
    camera.CreateAttribute("vehsim:cut:cameras", Sdf.ValueTypeNames.StringArray).Set(Vt.StringArray(names))


def author_render(stage: Any, take: Take) -> None:
    """Render settings, and a product per rendered camera, below ``/Render``: any renderer then finds camera, size and
    motion blur."""
    from pxr import Gf, UsdGeom, UsdRender

    settings = take.render
    names = [camera.name for camera in take.cameras if settings.cameras is None or camera.name in settings.cameras]
    if not names:
        return
    UsdGeom.Scope.Define(stage, "/Render")
    colour = UsdRender.Var.Define(stage, "/Render/colour")
    colour.CreateSourceNameAttr("Ci")
    common = UsdRender.Settings.Define(stage, "/Render/settings")
    products = [UsdRender.Product.Define(stage, f"/Render/{name}_picture") for name in names]
    for product, name in zip(products, names, strict=True):
        product.CreateProductNameAttr(f"{take.name}.{name}.####.exr")
        product.CreateOrderedVarsRel().SetTargets([colour.GetPath()])
    for base, name in [(common, names[0]), *zip(products, names, strict=True)]:
        base.CreateCameraRel().SetTargets([f"/{take.name}/cameras/{name}"])
        base.CreateResolutionAttr(Gf.Vec2i(*settings.panel(len(names))))
        base.CreateAspectRatioConformPolicyAttr(UsdRender.Tokens.adjustApertureHeight)
        base.CreateDisableMotionBlurAttr(take.usd.shutter is None)
    common.CreateProductsRel().SetTargets([product.GetPath() for product in products])
    stage.SetMetadata("renderSettingsPrimPath", "/Render/settings")


exporter = Exporter(
    name="usd",
    suffixes=(".usd", ".usda", ".usdc"),
    write=write_usd,
    latest=write_latest,
    keep=keep_vehicles,
    makes="the shot stage, layers and assets",
)
