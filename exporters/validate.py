"""Is a stage sound? Every validator USD brings, and rules of our own for motion; each issue says how to mend it."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from vehsim.exporters.stage import reason_of


@dataclass(frozen=True)
class Issue:
    """One thing wrong with a stage. ``severity`` is "error" or "warning"; ``site`` a prim, property or layer."""

    severity: str
    rule: str
    site: str
    message: str
    mend: str

    def __str__(self) -> str:
        return f"{self.severity}: {self.site}: {self.message} [{self.rule}]; {self.mend}"


MENDS = {
    "MissingDefaultPrim": "set defaultPrim on the root layer to its top prim",
    "MissingUpAxis": "set upAxis on the root layer",
    "MissingMetersPerUnitMetadata": "set metersPerUnit on the root layer",
    "CompositionErrorTest": "mend the reference, payload or sublayer it names",
    "CompositionError": "mend the reference, payload or sublayer it names",
    "UnresolvableDependency": "put the missing file back or mend the path",
    "MissingMaterialBindingAPI": "apply MaterialBindingAPI to the prim",
    "AttributeTypeMismatch": "author the attribute with the type its schema declares",
}
"""What to do about the errors of USD's own validators; the others say it themselves."""


def validate_stage(path: str | Path) -> list[Issue]:
    """Everything wrong with the stage at ``path``: USD's validators, then motion, time and units. Empty when sound."""
    from pxr import Tf, Usd

    try:
        stage = Usd.Stage.Open(str(path))
    except Tf.ErrorException as error:
        return [Issue("error", "open", str(path), reason_of(error), "give a readable .usd, .usda, .usdc or .usdz file")]
    issues = list(_usd_issues(stage))
    for rule in OWN_RULES:
        issues.extend(rule(stage))
    return issues


def _usd_issues(stage: Any) -> Iterator[Issue]:
    from pxr import UsdValidation

    validators = UsdValidation.ValidationRegistry().GetOrLoadAllValidators()
    for error in UsdValidation.ValidationContext(validators).Validate(stage):
        if error.HasNoError():
            continue
        severe = error.GetType() == UsdValidation.ValidationErrorType.Error
        validator = error.GetValidator()
        rule = validator.GetMetadata().name if validator else str(error.GetName())
        mend = MENDS.get(str(error.GetName()), f"see the rule {rule}")
        sites = ", ".join(_site(site) for site in error.GetSites()) or stage.GetRootLayer().identifier
        yield Issue("error" if severe else "warning", rule, sites, error.GetMessage(), mend)


def _site(site: Any) -> str:
    if site.IsPrim():
        return str(site.GetPrim().GetPath())
    if site.IsProperty():
        return str(site.GetProperty().GetPath())
    layer = site.GetLayer()
    return str(layer.identifier) if layer else "stage"


def _time_metadata(stage: Any) -> Iterator[Issue]:
    """A stage that moves says when, and plays as fast as it was made."""
    layer = stage.GetRootLayer()
    if not any(attribute.GetNumTimeSamples() for attribute in _animated(stage)):
        return
    for key in ("timeCodesPerSecond", "framesPerSecond", "startTimeCode", "endTimeCode"):
        if not layer.pseudoRoot.HasInfo(key):
            yield Issue("error", "time", layer.identifier, f"{key} is not authored", f"set {key} on the root layer")
    if stage.GetTimeCodesPerSecond() != stage.GetFramesPerSecond():
        message = f"timeCodesPerSecond {stage.GetTimeCodesPerSecond():g} is not framesPerSecond "
        mend = "author both alike, so that a time code is a frame"
        yield Issue("warning", "time", layer.identifier, f"{message}{stage.GetFramesPerSecond():g}", mend)


def _sample_range(stage: Any) -> Iterator[Issue]:
    """No sample stands outside the range that plays."""
    if not stage.HasAuthoredTimeCodeRange():
        return
    start, end = stage.GetStartTimeCode(), stage.GetEndTimeCode()
    for attribute in _animated(stage):
        times = attribute.GetTimeSamples()
        if times and (times[0] < start or times[-1] > end):
            message = f"samples {times[0]:g}..{times[-1]:g} leave the stage's {start:g}..{end:g}"
            mend = "widen startTimeCode and endTimeCode or cut the samples"
            yield Issue("warning", "range", str(attribute.GetPath()), message, mend)


def _finite_values(stage: Any) -> Iterator[Issue]:
    """No transform, point or lens is NaN or infinite."""
    for attribute in _animated(stage):
        times = attribute.GetTimeSamples() or [None]
        for time in times:
            value = attribute.Get() if time is None else attribute.Get(time)
            if value is not None and not np.isfinite(_numbers(value)).all():
                at = "" if time is None else f" at time code {time:g}"
                mend = "export it again from finite motion"
                yield Issue("error", "finite", str(attribute.GetPath()), f"not a finite number{at}", mend)
                break


def _quaternion_signs(stage: Any) -> Iterator[Issue]:
    """Neighbouring quaternions lie in one hemisphere: software that lerps would spin them the long way round."""
    for attribute in _animated(stage):
        if not str(attribute.GetTypeName()).startswith("quat"):
            continue
        times = attribute.GetTimeSamples()
        if len(times) > 1:
            values = np.array([_numbers(attribute.Get(time)) for time in times])
            flips = np.flatnonzero((values[1:] * values[:-1]).sum(axis=1) < 0)
            if len(flips):
                message = f"changes sign after time code {times[flips[0]]:g}"
                mend = "negate the quaternions after it"
                yield Issue("warning", "sign", str(attribute.GetPath()), message, mend)


def _foreign_units(stage: Any) -> Iterator[Issue]:
    """A referenced layer in other units is scaled by the prim that references it; USD does not do it."""
    from pxr import Usd, UsdGeom

    ours = UsdGeom.GetStageMetersPerUnit(stage)
    for prim in stage.Traverse():
        if not prim.HasAuthoredReferences():
            continue
        for arc in Usd.PrimCompositionQuery.GetDirectReferences(prim).GetCompositionArcs():
            layer = arc.GetTargetLayer()
            if layer == stage.GetRootLayer() or not layer.pseudoRoot.HasInfo("metersPerUnit"):
                continue
            ratio = layer.pseudoRoot.GetInfo("metersPerUnit") / ours
            matrix = np.array(UsdGeom.Xformable(prim).GetLocalTransformation()) if prim.IsA(UsdGeom.Xformable) else None
            scale = 1.0 if matrix is None else abs(np.linalg.det(matrix[:3, :3])) ** (1 / 3)
            if not np.isclose(ratio, 1.0) and not np.isclose(scale, ratio, rtol=1e-3):
                message = f"references {layer.GetDisplayName()} of {ratio:g} stage units, scaled by {scale:g}"
                yield Issue("warning", "units", str(prim.GetPath()), message, f"scale the prim by {ratio:g}")


OWN_RULES: tuple[Callable[[Any], Iterator[Issue]], ...] = (
    _time_metadata,
    _sample_range,
    _finite_values,
    _quaternion_signs,
    _foreign_units,
)


def _animated(stage: Any) -> Iterator[Any]:
    """The attributes that motion and shape are made of."""
    from pxr import UsdGeom

    for prim in stage.Traverse():
        for attribute in prim.GetAuthoredAttributes():
            name = attribute.GetName()
            if name.startswith("xformOp:") or name == "points" or (prim.IsA(UsdGeom.Camera) and ":" not in name):
                yield attribute


def _numbers(value: Any) -> Any:
    """Any USD value as an array of numbers; what is not numeric is empty."""
    if hasattr(value, "imaginary"):
        return np.array([value.real, *value.imaginary], float)
    try:
        return np.asarray(value, float).ravel()
    except (TypeError, ValueError):
        return np.empty(0)
