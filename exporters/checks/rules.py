"""Our own rules for stages: time, motion, units and composition; each issue has a fix.

A rule is a function of the composed stage that yields issues. `validate.py` runs USD's and other validators.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from vehsim.intake.usd import DRAWN, key_times

Array = NDArray[np.float64]

MOST_FRAMES = 20_000
"""Number of frames at most on which a spline is read."""
ROLLS, SWINGS, WITHIN = 90.0, 1.0, 32
"""Degrees between two keys of a spline from which a part rolls, degrees by which it may turn back between them, and
the number of places at which it is read there."""


@dataclass(frozen=True)
class Issue:
    """A fault of a stage. ``severity`` is "error" or "warning"; ``site`` a prim, property or layer."""

    severity: str
    rule: str
    site: str
    message: str
    remedy: str

    def __str__(self) -> str:
        return f"{self.severity}: {self.site}: {self.message} [{self.rule}]; {self.remedy}"


def _time_metadata(stage: Any) -> Iterator[Issue]:
    """A moving stage has a time range, and plays at the rate for which it was made."""
    layer = stage.GetRootLayer()
    if not any(key_times(attribute) for attribute in _animated(stage)):
        return
    for key in ("timeCodesPerSecond", "framesPerSecond", "startTimeCode", "endTimeCode"):
        if not layer.pseudoRoot.HasInfo(key):
            yield Issue("error", "time", layer.identifier, f"{key} is not authored", f"set {key} on the root layer")
    if stage.GetTimeCodesPerSecond() != stage.GetFramesPerSecond():
        message = f"timeCodesPerSecond {stage.GetTimeCodesPerSecond():g} is not framesPerSecond "
        remedy = "author the same value for both, so that a time code is a frame"
        yield Issue("warning", "time", layer.identifier, f"{message}{stage.GetFramesPerSecond():g}", remedy)


def _sample_range(stage: Any) -> Iterator[Issue]:
    """No sample is farther outside the playback range than a shutter opens; reported once per layer."""
    if not stage.HasAuthoredTimeCodeRange():
        return
    start, end = stage.GetStartTimeCode(), stage.GetEndTimeCode()
    outside: dict[Any, list[Any]] = defaultdict(list)
    for attribute in _animated(stage):
        times = key_times(attribute)
        if times and (times[0] < start - 1 or times[-1] > end + 1):
            layer = attribute.GetPropertyStack(times[0])[0].layer
            outside[layer].append((attribute.GetPath(), times[0], times[-1]))
    for layer, found in outside.items():
        path, first, last = found[0]
        more = f" and {len(found) - 1} more" if len(found) > 1 else ""
        message = f"keys {first:g}..{last:g} of {layer.GetDisplayName()} leave the stage's {start:g}..{end:g}"
        remedy = "widen startTimeCode and endTimeCode, offset the layer, or cut the keys"
        if (rate := _rate(layer)) and rate != stage.GetTimeCodesPerSecond():
            message += f": USD scales the layer's {rate:g} time codes per second to the stage's "
            message += f"{stage.GetTimeCodesPerSecond():g}"
            remedy = "export the layer again at the stage's rate, or fix the timeCodesPerSecond that is wrong"
        yield Issue("warning", "range", f"{path}{more}", message, remedy)


def _finite_values(stage: Any) -> Iterator[Issue]:
    """No transform, point or lens is NaN or infinite."""
    for attribute in _animated(stage):
        times: list[float | None] = [*key_times(attribute)] or [None]
        for time in times:
            value = attribute.Get() if time is None else attribute.Get(time)
            if value is not None and not np.isfinite(_numbers(value)).all():
                at = "" if time is None else f" at time code {time:g}"
                remedy = "export it again from finite motion"
                yield Issue("error", "finite", str(attribute.GetPath()), f"not a finite number{at}", remedy)
                break


def _quaternion_signs(stage: Any) -> Iterator[Issue]:
    """Neighbouring quaternions lie in one hemisphere: software that interpolates linearly would rotate them the long
    way."""
    for attribute in _animated(stage):
        if not str(attribute.GetTypeName()).startswith("quat"):
            continue
        times = key_times(attribute)
        if len(times) > 1:
            values = np.array([_numbers(attribute.Get(time)) for time in times])
            flips = np.flatnonzero((values[1:] * values[:-1]).sum(axis=1) < 0)
            if len(flips):
                message = f"changes sign after time code {times[flips[0]]:g}"
                remedy = "negate the quaternions after it"
                yield Issue("warning", "sign", str(attribute.GetPath()), message, remedy)


def _backward_spins(stage: Any) -> Iterator[Issue]:
    """No wheel or rotor turns backwards: angles are unwrapped, no spin is left to slerp, and no spline swings back
    between keys that go on."""
    for attribute in _animated(stage):
        name, times = attribute.GetName(), key_times(attribute)
        if len(times) < 3:
            continue
        site = str(attribute.GetPath())
        if name.startswith(("xformOp:rotateX", "xformOp:rotateY", "xformOp:rotateZ")) and len(name.split(":")[1]) == 7:
            read = times
            if not attribute.GetTimeSamples():  # a spline: between its knots, a wheel may stop and roll back
                frames = np.arange(np.ceil(times[0]), min(times[-1], times[0] + MOST_FRAMES) + 1)
                read = np.union1d(times, frames[frames <= times[-1]]).tolist()
                if swing := _swing(attribute, times):
                    remedy = "shorten its tangents there, or give them the slope of its motion"
                    message = "turns back by {:.4g} degrees between its keys at time codes {:g} and {:g}".format(*swing)
                    yield Issue("warning", "spin", site, message, remedy)
            if back := [*_jumps(read, _angles(attribute, read)), *_wrapped_steps(times, _angles(attribute, times))]:
                after, step = min(back)
                message = f"turns back by {step:.4g} degrees after time code {after:g}"
                yield Issue("error", "spin", site, message, "unwrap its angles: let them continue beyond 360")
        elif str(attribute.GetTypeName()).startswith("quat"):
            q = np.array([_numbers(attribute.Get(time)) for time in times])
            q /= np.linalg.norm(q, axis=1, keepdims=True)
            turns = 2 * np.degrees(np.arccos(np.clip(np.abs((q[1:] * q[:-1]).sum(axis=1)), 0, 1)))
            if (fast := np.flatnonzero(turns > 150)).size > 1:
                message = f"turns {turns[fast[0]]:.0f} degrees from time code {times[fast[0]]:g} to the next"
                remedy = "spin by a scalar rotate op with running degrees: slerp goes the short way round"
                yield Issue("warning", "spin", site, message, remedy)


def _angles(attribute: Any, times: Sequence[float]) -> Array:
    return np.array([float(attribute.Get(time)) for time in times])


def _jumps(times: Sequence[float], values: Array) -> list[tuple[float, float]]:
    """Where angles (n,), degrees, jump back between forward steps, and by how much: they were wrapped. A reversed
    propeller continues to turn back."""
    steps = np.diff(values)
    signs = np.sign(steps * np.median(steps))
    alone = np.concatenate([[1], signs[:-1]]) + np.concatenate([signs[1:], [1]]) > 0
    return [(times[k], abs(steps[k])) for k in np.flatnonzero((np.abs(steps) > 180) & (signs < 0) & alone).tolist()]


def _swing(attribute: Any, times: Sequence[float]) -> tuple[float, float, float] | None:
    """By how many degrees a spline turns back between two of its knots at ``times``, and these; None if it does not.

    Only knots count that turn on by `ROLLS` at least, and go on before and after: slower parts may swing back there.
    Before its first angle and beyond its last one, the part may swing.
    """
    angles = _angles(attribute, times)
    steps = np.diff(angles)
    ways = np.sign(np.concatenate([steps[:1], steps, steps[-1:]]))
    for k, step in enumerate(steps):
        if abs(step) < ROLLS or not (ways[k : k + 3] == ways[k + 1]).all():
            continue
        inside = np.linspace(times[k], times[k + 1], WITHIN + 1)[:-1]  # a knot may end one value and begin another
        low = angles[0] if k == 0 else -np.inf * step
        high = angles[-1] if k == len(steps) - 1 else np.inf * step
        turned = np.sign(step) * np.clip(_angles(attribute, inside.tolist()), *sorted((low, high)))
        if (back := float((np.maximum.accumulate(turned) - turned).max())) > SWINGS:
            return back, times[k], times[k + 1]
    return None


def _wrapped_steps(times: Sequence[float], values: Array) -> list[tuple[float, float]]:
    """Where angles (n,), degrees, turn back only because they stay within one turn, and by how much: with whole turns
    added to them, the rate changes less than half as much. ``times`` (n,); not equally spaced: none."""
    steps = np.diff(values)
    if np.ptp(values) > 360 or np.ptp(np.diff(times)) > 1e-6:
        return []
    full = steps.copy()
    for k in range(1, len(full)):
        full[k] += 360 * np.round((full[k - 1] - full[k]) / 360)
    wrapped = np.flatnonzero(np.abs(full - steps) > 180)
    smoother = 2 * np.abs(np.diff(full)).sum() < np.abs(np.diff(steps)).sum()
    return [(times[k], abs(steps[k])) for k in wrapped.tolist()] if smoother and len(wrapped) > 1 else []


def _invertible(stage: Any) -> Iterator[Issue]:
    """No transform is singular, also between its keys: its content could not be placed, lit or picked."""
    from pxr import UsdGeom

    start = stage.GetStartTimeCode()
    for prim in stage.Traverse():
        if prim.IsA(UsdGeom.Xformable) and prim.GetAuthoredPropertyNames():
            flat = _flattened(UsdGeom.Xformable(prim), start)
            if flat == start:
                yield Issue("error", "scale", str(prim.GetPath()), "its transform cannot be inverted", "fix its scale")
            elif flat is not None:
                message = f"its transform cannot be inverted at time code {flat:g}"
                remedy = "key its visibility to hide it, else keep its scale above zero"
                yield Issue("warning", "scale", str(prim.GetPath()), message, remedy)


def _flattened(xformable: Any, start: float) -> float | None:
    """A time code at which the local transform of a prim is singular, ``start`` first; None if there is none.

    Where its ops that scale have keys, these are read, and splines between them; where the transform is mirrored from
    one to the next, the place between, unless it jumps there.
    """
    from pxr import UsdGeom

    def shape(time: float) -> Array:
        return np.array(xformable.GetLocalTransformation(time))[:3, :3]

    def flat(time: float, within: float = 1e-9) -> bool:
        matrix = shape(time)
        if not np.isfinite(matrix).all():
            return False  # the rule of finite values reports it
        sizes = np.linalg.svd(matrix, compute_uv=False)
        return bool(not sizes[-1] > within * max(sizes[0], 1e-30))

    times = [start]
    for op in xformable.GetOrderedXformOps():
        if op.GetOpType() == UsdGeom.XformOp.TypeTransform or "scale" in op.GetOpName():
            keys = key_times(op.GetAttr())
            if len(keys) > 1 and not op.GetAttr().GetTimeSamples():
                keys = [t for a, b in pairwise(keys) for t in np.linspace(a, b, WITHIN + 1).tolist()]
            times += keys[:MOST_FRAMES]
    if found := [time for time in times if flat(time)]:
        return found[0]
    times = sorted(set(times))
    mirrored = [bool(np.linalg.det(shape(time)) < 0) for time in times]
    for a, b, before, after in zip(times, times[1:], mirrored, mirrored[1:], strict=False):
        while before != after and b - a > 1e-9 * max(1.0, abs(a)):
            middle = (a + b) / 2
            a, b = (middle, b) if (np.linalg.det(shape(middle)) < 0) == before else (a, middle)
        if before != after and flat(a, 1e-4):
            return a
    return None


def _op_orders(stage: Any) -> Iterator[Issue]:
    """Every op in an xformOpOrder exists: USD skips missing ones, with a warning at every evaluation."""
    for prim in stage.Traverse():
        order = prim.GetAttribute("xformOpOrder")
        for name in (order.Get() if order else None) or []:
            op = name.removeprefix("!invert!")
            if op != "!resetXformStack!" and not prim.HasAttribute(op):
                remedy = "author the op, or take it out of the order"
                yield Issue(
                    "error", "ops", str(prim.GetPath()), f"xformOpOrder names {op}, which does not exist", remedy
                )


def _believable_sizes(stage: Any) -> Iterator[Issue]:
    """A model is between a centimetre and a hundred kilometres large; otherwise its unit is wrong."""
    from pxr import Kind, Usd, UsdGeom

    metres = UsdGeom.GetStageMetersPerUnit(stage)
    cache = UsdGeom.BBoxCache(Usd.TimeCode(stage.GetStartTimeCode()), DRAWN, useExtentsHint=True)
    prims = iter(stage.Traverse())
    for prim in prims:
        if not Kind.Registry.IsA(Usd.ModelAPI(prim).GetKind(), Kind.Tokens.component):
            continue
        prims.PruneChildren()
        bound = cache.ComputeWorldBound(prim).ComputeAlignedRange()
        size = 0.0 if bound.IsEmpty() else metres * max(bound.GetSize())
        if size and not 0.01 <= size <= 1e5:
            remedy = "fix metersPerUnit where it was made, or scale the prim"
            yield Issue("warning", "scale", str(prim.GetPath()), f"{size:.3g} m large", remedy)


def _dead_overs(stage: Any) -> Iterator[Issue]:
    """Every opinion is visible: none on a prim that nothing defines, none below an instance.

    A layer that consists only of overs is meant for sublayering, and is checked there.
    """
    from pxr import Usd

    if not any(prim.IsDefined() for prim in stage.GetPseudoRoot().GetAllChildren()):
        return
    prims = iter(Usd.PrimRange.Stage(stage, Usd.PrimAllPrimsPredicate))
    for prim in prims:
        if not prim.IsDefined() and not prim.IsAbstract():
            prims.PruneChildren()
            layer = prim.GetPrimStack()[0].layer.GetDisplayName() if prim.GetPrimStack() else "no layer"
            remedy = "fix its path, or the reference that should define it"
            yield Issue(
                "error",
                "dead over",
                str(prim.GetPath()),
                f"{layer} has an opinion on it, but nothing defines it",
                remedy,
            )
        elif prim.IsInstance():
            for node in _nodes_above(prim):
                for layer in node.layerStack.layers:
                    spec = layer.GetPrimAtPath(node.path)
                    if spec and spec.nameChildren:
                        what = (
                            f"{layer.GetDisplayName()} has an opinion on {spec.nameChildren[0].name} inside an instance"
                        )
                        remedy = "set instanceable = false on it, or author the opinion in the referenced layer"
                        yield Issue("error", "dead over", str(prim.GetPath()), what, remedy)


def _nodes_above(instance: Any) -> Iterator[Any]:
    """The places of opinions on an instance that its prototype does not share: its own, and those of its ancestors."""

    from pxr import Pcp

    def walk(node: Any) -> Iterator[Any]:
        if node.arcType == Pcp.ArcTypeRoot or node.IsDueToAncestor():
            yield node
        for child in node.children:
            yield from walk(child)

    yield from walk(instance.GetPrimIndex().rootNode)


def _foreign_units(stage: Any) -> Iterator[Issue]:
    """A referenced layer in other units is scaled by the prim that references it, because USD does not convert."""
    from pxr import Usd

    direct = Usd.PrimCompositionQuery.Filter()
    direct.arcTypeFilter = Usd.PrimCompositionQuery.ArcTypeFilter.ReferenceOrPayload
    direct.dependencyTypeFilter = Usd.PrimCompositionQuery.DependencyTypeFilter.Direct
    for prim in stage.Traverse():
        if not (prim.HasAuthoredReferences() or prim.HasAuthoredPayloads()):
            continue
        for arc in Usd.PrimCompositionQuery(prim, direct).GetCompositionArcs():
            theirs, ours = arc.GetTargetLayer(), arc.GetIntroducingLayer()
            if not all(layer and layer.pseudoRoot.HasInfo("metersPerUnit") for layer in (theirs, ours)):
                continue
            ratio = theirs.pseudoRoot.GetInfo("metersPerUnit") / ours.pseudoRoot.GetInfo("metersPerUnit")
            if np.isclose(ratio, 1.0):
                continue
            source = Usd.Stage.Open(theirs)  # a prim is valid only while its stage is held
            scale = _scale(prim) / _scale(source.GetPrimAtPath(arc.GetTargetPrimPath()))
            if not np.isclose([scale, scale * _scale(prim.GetParent())], ratio, rtol=1e-3).any():
                message = (
                    f"references {theirs.GetDisplayName()}, whose unit is {ratio:g} times ours, scaled by {scale:g}"
                )
                yield Issue("warning", "units", str(prim.GetPath()), message, f"scale the prim by {ratio:g}")


class _Shared(NamedTuple):
    """Metadata that a stage's sublayers share with it: its value, and what to do about a layer with another one.

    ``effect``: what USD does about the layer's value, in words.
    """

    own: Any
    remedy: str
    effect: Callable[[Any], str] = lambda theirs: ""


def _foreign_sublayers(stage: Any) -> Iterator[Issue]:
    """A sublayer has the unit and up axis of the stage, because USD converts neither, and its rate, to keep frames."""
    from pxr import UsdGeom

    root = stage.GetRootLayer()
    rate = stage.GetTimeCodesPerSecond()
    shared: dict[str, _Shared] = {
        "metersPerUnit": _Shared(
            UsdGeom.GetStageMetersPerUnit(stage),
            "export the layer again in the stage's unit, or reference it below a prim that scales it",
        ),
        "upAxis": _Shared(
            str(UsdGeom.GetStageUpAxis(stage)),
            "export the layer again with the stage's up axis, or reference it below a prim that turns it",
        ),
        "timeCodesPerSecond": _Shared(
            rate,
            "export the layer again at the stage's rate, unless its motion should keep its duration",
            lambda theirs: f": USD moves its keys to {rate / theirs:.6g} times their time codes",
        ),
    }
    for layer in stage.GetLayerStack(includeSessionLayers=False):
        if layer == root:
            continue
        for key, (own, remedy, effect) in shared.items():
            if not layer.pseudoRoot.HasInfo(key) or _same(theirs := layer.pseudoRoot.GetInfo(key), own):
                continue
            differs = f"has {key} {_word(theirs)}, the stage {_word(own)}{effect(theirs)}"
            message = f"sublayer {layer.GetDisplayName()} {differs}"
            yield Issue("warning", "sublayer", root.GetDisplayName(), message, remedy)


def _same(a: Any, b: Any) -> bool:
    return bool(a == b if isinstance(a, str) else np.isclose(a, b))


def _word(value: Any) -> str:
    return value if isinstance(value, str) else f"{value:.6g}"


def _rate(layer: Any) -> float | None:
    return layer.timeCodesPerSecond if layer.HasTimeCodesPerSecond() else None


def _scale(prim: Any) -> float:
    from pxr import UsdGeom

    if not prim or not prim.IsA(UsdGeom.Xformable):
        return 1.0
    return (
        float(abs(np.linalg.det(np.array(UsdGeom.Xformable(prim).GetLocalTransformation())[:3, :3])) ** (1 / 3)) or 1.0
    )


OWN_RULES: tuple[Callable[[Any], Iterator[Issue]], ...] = (
    _time_metadata,
    _sample_range,
    _finite_values,
    _quaternion_signs,
    _backward_spins,
    _invertible,
    _op_orders,
    _believable_sizes,
    _dead_overs,
    _foreign_units,
    _foreign_sublayers,
)


def _animated(stage: Any) -> Iterator[Any]:
    """The attributes that determine motion and shape."""
    from pxr import UsdGeom

    for prim in stage.Traverse():
        for attribute in prim.GetAuthoredAttributes():
            name = attribute.GetName()
            moves, lens = name.startswith("xformOp:"), prim.IsA(UsdGeom.Camera) and ":" not in name
            if moves or lens or name == UsdGeom.Tokens.points:
                yield attribute


def _numbers(value: Any) -> Any:
    """Any USD value as an array of numbers; empty if it is not numeric."""
    if hasattr(value, "imaginary"):
        return np.array([value.real, *value.imaginary], float)
    try:
        return np.asarray(value, float).ravel()
    except (TypeError, ValueError):
        return np.empty(0)
