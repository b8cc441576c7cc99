"""A vehicle's animation layer: only what moves, as overs on the asset's own prims.

The layer's default prim is the vehicle's root. The asset is its payload, so the layer works referenced (as in the shot)
and sublayered, and a shot opened without payloads has the motion alone. Translate and orient pose the root. A channel
becomes one scalar op with accumulated degrees (or asset units) on the prim that it drives: as a quaternion, a rotor
would turn backwards.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import nullcontext
from dataclasses import dataclass, replace
from fractions import Fraction
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from vehsim.errors import ExportError
from vehsim.exporters.usd.curves import Curve, fit, fit_positions, fit_rotations, instants, quiet, sampled_frames
from vehsim.exporters.usd.metadata import Z_UP_METRES, Units, author_stage_metadata, samples, unit_corrections
from vehsim.exporters.usd.packing import Pack
from vehsim.exporters.usd.rotors import author_rotors
from vehsim.exporters.usd.sampling import PLACE, TURN, Shutter, clip_at, fewest_together
from vehsim.exporters.usd.tyres import author_tyres
from vehsim.rig.ops import drive_op as drive_op
from vehsim.rig.ops import (
    driven_prim,
    drives_by_prim,
    instances_above,
    op_order,
    pivot_of,
    pivot_op,
    place_op,
    prim_path,
    replaced_ops,
    scalar_op,
    slide_axis,
)
from vehsim.rig.ops import open_rig as open_rig
from vehsim.rig.tolerances import Tolerances, reaches

if TYPE_CHECKING:
    from vehsim.clip.clip import Clip
    from vehsim.rig.rig import Rig

Array = NDArray[np.float64]
RESET = "!resetXformStack!"


@dataclass(frozen=True)
class RigOps:
    """Where motion enters an asset: op orders per prim path below the root ("" is the root), and op names.

    ``orders[path]``: the prim's new xformOpOrder. ``channels``: channel -> (path, op name, factor from SI to op units).
    ``translate`` and ``orient`` are the root's pose ops; ``constants[path]`` its constant ops: the root's corrections
    for foreign units, pivots of drives; ``replaced[path]``: its animated ops (name, type, value), which keep their
    first value; ``freed``: the instances whose instancing is switched off so that their parts can move.
    """

    orders: Mapping[str, list[str]]
    channels: Mapping[str, tuple[str, str, float]]
    translate: str
    orient: str
    constants: Mapping[str, list[tuple[str, Any]]]
    replaced: Mapping[str, list[tuple[str, Any, Any]]]
    freed: tuple[str, ...] = ()

    def with_scalars(self) -> RigOps:
        """The same with a number instead of a vector for parts that slide, as splines need."""
        orders = {path: [scalar_op(op) for op in order] for path, order in self.orders.items()}
        channels = {name: (path, scalar_op(op), factor) for name, (path, op, factor) in self.channels.items()}
        return replace(self, orders=orders, channels=channels)

    @property
    def corrections(self) -> list[tuple[str, Any]]:
        return self.constants.get("", [])


def write_animation(
    clip: Clip,
    name: str,
    pack: Pack,
    path: Path,
    fps: Fraction,
    frames: tuple[int, int],
    units: Units = Z_UP_METRES,
    shutter: tuple[float, float] | None = None,
    thin: float | None = None,
    curves: Tolerances | None = None,
    earlier: Path | None = None,
) -> Path:
    """Write ``clip`` as the animation layer ``path`` of a vehicle called ``name``.

    Samples are on whole frames; an open ``shutter`` (frames from, to) adds those for motion blur; ``thin`` (m) omits
    all samples that linear interpolation between the others replaces; ``curves`` writes splines within these
    tolerances instead of samples. Where those of the layer ``earlier`` still show the motion, their keys stay.
    """
    from pxr import Sdf, Tf

    rig = clip.vehicle.rig
    if rig is None:
        raise ExportError(
            "has no rig (USD asset) to animate", "give it one in its vehicle.toml", subject=f"vehicle {name!r}"
        )
    if not Tf.IsValidIdentifier(name):
        raise ExportError("not a USD prim name", "use letters, digits and _ only", key="vehicle.name", value=name)
    # other channels rest as in the asset
    moving = [channel for channel in rig.drives if np.any(clip.channels[channel])]
    ops = rig_ops(rig.asset, rig, units, moving)
    asset = pack.reference(rig, path)
    motion: _Motion | _Curves = _Motion(clip, name, frames, shutter, thin)
    if curves is not None:
        motion, ops = _Curves(clip, frames, shutter, curves, _splines_of(earlier)), ops.with_scalars()

    path.parent.mkdir(parents=True, exist_ok=True)
    layer = Sdf.Layer.CreateNew(str(path))
    with Sdf.ChangeBlock():
        author_stage_metadata(layer, fps, frames, units)
        layer.defaultPrim = name
        root = Sdf.PrimSpec(layer, name, Sdf.SpecifierDef, "Xform")
        target = prim_path(rig.root if rig.source is None else rig.source_root)
        root.payloadList.prependedItems = [Sdf.Payload(asset, target or Sdf.Path())]
        for variant_set, variant in rig.variants.items():
            root.variantSelections[variant_set] = variant
        motion.author_pose(root, ops, units)
        for channel, (below, op, factor) in ops.channels.items():
            spec = Sdf.CreatePrimInLayer(layer, root.path.AppendPath(below)) if below else root
            motion.author_channel(spec, channel, op, factor)
            _author_constants(spec, ops.constants.get(below, []))
            _author_first_values(spec, ops.replaced.get(below, []))
            if below:
                _author_order(spec, ops.orders[below])
        author_rotors(root, rig)
        author_tyres(root, *_on_whole_frames(clip, frames))
        for below in ops.freed:
            spec = Sdf.CreatePrimInLayer(layer, root.path.AppendPath(below)) if below else root
            spec.instanceable = False
        _keep_root_in_blender(layer, rig)
    with quiet() if curves is not None else nullcontext():
        layer.Save()
    return path


def _on_whole_frames(clip: Clip, frames: tuple[int, int]) -> tuple[Clip, Array]:
    """The clip on the whole frames that it shares with the delivery, and these frames (n,)."""
    whole = np.arange(max(frames[0], clip.start_frame), min(frames[1], clip.end_frame) + 1, dtype=float)
    return clip_at(clip, whole), whole


def _keep_root_in_blender(layer: Any, rig: Rig) -> None:
    """Add a second root beside one that Blender saved: Blender's importer skips a lone root marked as its own, even if
    it moves, and no stronger opinion removes the mark."""
    from pxr import Sdf

    stage, prim = open_rig(rig.asset, rig)
    if stage and prim.HasCustomDataKey("Blender:generated"):
        beside = Sdf.PrimSpec(layer, "blender_keeps_the_root", Sdf.SpecifierDef)
        beside.documentation = "a second root: without it, Blender's importer skips a single root that Blender wrote"


def rig_ops(asset: Path, rig: Rig, units: Units, moving: Sequence[str]) -> RigOps:
    """Fit the motion into the asset's own op orders, so that its pivots, scales and resets survive.

    ``moving``: the channels with motion. An order never names an op without values.
    """
    from pxr import UsdGeom

    stage, root = open_rig(asset, rig)
    scale = UsdGeom.GetStageMetersPerUnit(stage)
    own = op_order(root)
    reset, own = ([RESET], own[1:]) if own[:1] == [RESET] else ([], own)
    translate, orient = (_free_name(root, name) for name in ("xformOp:translate", "xformOp:orient"))
    standing = _wrapped(rig, root)  # the layer references the asset itself, so it repeats the wrapper's ops
    corrections = unit_corrections(asset, units)
    constants: dict[str, list[tuple[str, Any]]] = {"": [*corrections, *standing]}
    orders = {"": [*reset, translate, orient, *(name for name, _ in corrections), *own]}
    channels, freed = {}, []
    for channel in moving:
        drive = rig.drives[channel]
        prim = driven_prim(rig, root, channel)
        op, factor = drive_op(drive.op, scale)
        order = orders.get(drive.prim, op_order(prim))
        if op in order and drive.prim in orders:
            raise ExportError(
                f"{drive.op} on {drive.prim!r} is driven twice", key=f"channels.{channel}", file=rig.asset
            )
        pivot = pivot_of(rig, channel, root, scale)
        if pivot is not None:
            constants.setdefault(drive.prim, []).append((pivot_op(channel), pivot.tolist()))
        orders[drive.prim] = place_op(rig, channel, root, order)
        channels[channel] = (drive.prim, op, factor * drive.factor)
        freed += [path for path in instances_above(root, prim) if path not in freed]
    replaced = {
        path: _first_values(replaced_ops(root.GetPrimAtPath(path) if path else root, moved))
        for path, drives in drives_by_prim(rig).items()
        if (moved := [drive for channel, drive in drives.items() if channel in channels])
    }
    return RigOps(orders, channels, translate, orient, constants, replaced, tuple(freed))


class _Motion:
    """A clip as attributes: the frames of each of them, and their values."""

    def __init__(
        self, clip: Clip, name: str, frames: tuple[int, int], shutter: tuple[float, float] | None, thin: float | None
    ) -> None:
        assert clip.vehicle.rig is not None
        self.clip, self.name = clip, name
        self.on_whole, self.whole = _on_whole_frames(clip, frames)
        self.shutter = None if shutter is None else Shutter(clip, shutter, (int(self.whole[0]), int(self.whole[-1])))
        self.reach = reaches(clip.vehicle.rig) if shutter is not None or thin is not None else {}
        self.few = (
            {} if thin is None else fewest_together(self.whole, self.on_whole, clip.vehicle.rig, self.reach, thin)
        )

    def _at(self, frames: Array) -> Clip:
        return self.on_whole if frames is self.whole else clip_at(self.clip, frames)

    def author_pose(self, root: Any, ops: RigOps, units: Units) -> None:
        from pxr import Sdf

        frames = self.whole if self.shutter is None else self.shutter.pose_frames(self.reach[""], self.name)
        at = self._at(frames)
        positions, orientations = units.points(at.positions), units.poses(at.orientations)
        some, other = (self.few.get(what, slice(None)) for what in (PLACE, TURN))
        samples(root, ops.translate, Sdf.ValueTypeNames.Double3, frames[some], positions[some])
        samples(root, ops.orient, Sdf.ValueTypeNames.Quatd, frames[other], orientations[other])
        _author_constants(root, ops.constants.get("", []))
        _author_order(root, ops.orders[""])

    def author_channel(self, spec: Any, channel: str, op: str, factor: float) -> None:
        from pxr import Sdf

        turns = ":rotate" in op
        reach = self.reach.get(channel, 1.0)
        frames = self.whole
        if self.shutter is not None:
            frames = self.shutter.channel_frames(channel, 1.0, reach, turns, self.name)
        values, some = self._at(frames).channels[channel] * factor, self.few.get(channel, slice(None))
        axis = slide_axis(op)
        if axis is None:
            samples(spec, op, Sdf.ValueTypeNames.Double, frames[some], values[some])
        else:
            samples(spec, op, Sdf.ValueTypeNames.Double3, frames[some], np.outer(values, np.eye(3)[axis])[some])


class _Curves:
    """A clip as splines: a translation along each axis and three rotations for the pose, one spline per channel. Raises
    ``ExportError`` if this USD has no splines."""

    def __init__(
        self,
        clip: Clip,
        frames: tuple[int, int],
        shutter: tuple[float, float] | None,
        tolerances: Tolerances,
        earlier: Mapping[str, Curve],
    ) -> None:
        from pxr import Sdf, Usd

        if not hasattr(Sdf.AttributeSpec, "SetSpline"):
            version = ".".join(map(str, Usd.GetVersion()[1:]))
            remedy = "leave it out, or use USD 25.8 or newer"
            raise ExportError(f"USD {version} has no splines", remedy, key="export.curves")
        opens, closes = (np.floor(shutter[0]), np.ceil(shutter[1])) if shutter is not None else (0.0, 0.0)
        first, last = max(frames[0], clip.start_frame), min(frames[1], clip.end_frame)
        self.frames = instants(first + min(opens, 0.0), last + max(closes, 0.0))
        self.at = clip_at(clip, self.frames)
        self.tolerances, self.earlier = tolerances, earlier

    def author_pose(self, root: Any, ops: RigOps, units: Units) -> None:
        from pxr import Sdf

        positions, q = units.points(self.at.positions), units.poses(self.at.orientations)
        order = list(ops.orders[""])
        places = [ops.translate.replace("translate", f"translate{axis}") for axis in "XYZ"]
        before = [self._before(root, name) for name in places]
        placed = fit_positions(self.frames, positions, self.tolerances.distance / units.metres, before)
        for name, curve in zip(places, placed, strict=True):
            _author_curve(root, name, curve)
        angle = self.tolerances.angle
        about = lambda axis: self._before(root, ops.orient.replace("orient", f"rotate{axis}"))
        turned = fit_rotations(self.frames, q, angle, about)
        turns = [ops.orient]
        if turned is None:
            frames = sampled_frames(self.frames, q, angle)
            rows = np.searchsorted(self.frames, frames)
            samples(root, ops.orient, Sdf.ValueTypeNames.Quatd, frames, q[rows])
        else:
            turns = [ops.orient.replace("orient", f"rotate{axis}") for axis in turned[0]]
            for name, curve in zip(turns, turned[1], strict=True):
                _author_curve(root, name, curve)
        k = order.index(ops.translate)
        _author_constants(root, ops.constants.get("", []))
        _author_order(root, [*order[:k], *places, *turns, *order[k + 2 :]])

    def author_channel(self, spec: Any, channel: str, op: str, factor: float) -> None:
        values, tolerance = self.at.channels[channel], self.tolerances.channels[channel]
        _author_curve(spec, op, fit(self.frames, values * factor, tolerance * abs(factor), self._before(spec, op)))

    def _before(self, spec: Any, op: str) -> Curve | None:
        return self.earlier.get(str(spec.path.AppendProperty(op)))


def _splines_of(path: Path | None) -> dict[str, Curve]:
    """Path of an op -> the curve of its spline, in the layer ``path``; none if there is no such layer."""
    from pxr import Sdf

    if path is None or not path.is_file():
        return {}
    with quiet():
        layer = Sdf.Layer.OpenAsAnonymous(str(path))
    found: dict[str, Curve] = {}

    def visit(op: Any) -> None:
        attribute = layer.GetAttributeAtPath(op) if op.IsPropertyPath() else None
        if attribute and attribute.HasSpline() and (curve := Curve.of(attribute.GetSpline())):
            found[str(op)] = curve

    layer.Traverse("/", visit)
    return found


def _author_curve(prim: Any, name: str, curve: Curve) -> None:
    """A spline, or a default if nothing moves."""
    from pxr import Sdf

    spec = Sdf.AttributeSpec(prim, name, Sdf.ValueTypeNames.Double)
    if len(curve.frames) == 1:
        spec.default = float(curve.values[0])
    else:
        spec.SetSpline(curve.spline())


def _wrapped(rig: Rig, root: Any) -> list[tuple[str, Any]]:
    """The constant ops with which a foreign asset's wrapper turns it upright."""
    if rig.source is None:
        return []
    spec = root.GetStage().GetRootLayer().GetPrimAtPath(root.GetPath())
    return [(p.name, p.default) for p in spec.properties if p.name.startswith("xformOp:")]


def _author_constants(prim: Any, ops: list[tuple[str, Any]]) -> None:
    from pxr import Gf, Sdf

    for op, value in ops:
        vector = not isinstance(value, float | int)
        kind = Sdf.ValueTypeNames.Double3 if vector else Sdf.ValueTypeNames.Double
        if op not in prim.attributes:
            Sdf.AttributeSpec(prim, op, kind).default = Gf.Vec3d(*value) if vector else value


def _first_values(ops: Sequence[Any]) -> list[tuple[str, Any, Any]]:
    """Name, type and first value of each op."""
    from pxr import Usd

    attributes = [op.GetAttr() for op in ops]
    return [(a.GetName(), a.GetTypeName(), a.Get(Usd.TimeCode.EarliestTime())) for a in attributes]


def _author_first_values(prim: Any, ops: Sequence[tuple[str, Any, Any]]) -> None:
    """Hide the asset's keys below a default, which is their first value."""
    from pxr import Sdf

    for name, kind, value in ops:
        if name not in prim.attributes:
            Sdf.AttributeSpec(prim, name, kind).default = value


def _author_order(prim: Any, order: list[str]) -> None:
    from pxr import Sdf, Vt

    spec = prim.attributes.get("xformOpOrder")
    if spec is None:
        spec = Sdf.AttributeSpec(prim, "xformOpOrder", Sdf.ValueTypeNames.TokenArray, Sdf.VariabilityUniform)
    spec.default = Vt.TokenArray(order)


def _free_name(prim: Any, name: str) -> str:
    """An op name that the asset's root does not use itself."""
    return f"{name}:motion" if prim.HasAttribute(name) else name
