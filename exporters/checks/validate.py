"""Validate a stage with USD's validators, NVIDIA's if installed, and our own; each issue has a fix."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import astuple
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from vehsim.exporters.checks.rules import OWN_RULES
from vehsim.exporters.checks.rules import Issue as Issue
from vehsim.intake.foreign import reason_of
from vehsim.intake.reader import Answer, read_in_process

REMEDIES = {
    "MissingDefaultPrim": "set defaultPrim on the root layer to its top prim",
    "MissingUpAxis": "set upAxis on the root layer",
    "MissingMetersPerUnitMetadata": "set metersPerUnit on the root layer",
    "CompositionErrorTest": "fix the reference, payload or sublayer it names",
    "CompositionError": "fix the reference, payload or sublayer it names",
    "UnresolvableDependency": "put the missing file back or fix the path",
    "MissingMaterialBindingAPI": "apply MaterialBindingAPI to the prim",
    "AttributeTypeMismatch": "author the attribute with the type its schema declares",
}
"""Fixes for errors of USD's own validators; the others contain their fix."""


def validate_stage(path: str | Path) -> list[Issue]:
    """All issues of the stage at ``path``; a fault at many places is reported once. Empty if the stage is valid. Raises
    ``InputError`` for a file that crashes USD's validators, or exceeds the limits."""
    return [Issue(*row) for row in read_in_process(issues_of, Path(path), "STAGE")[0]]


def issues_of(path: Path) -> Answer:
    """The fields of each issue of a stage. It runs in the reader process."""
    return [astuple(issue) for issue in _issues(path)], []


def _issues(path: Path) -> list[Issue]:
    from pxr import Tf, Usd

    try:
        stage = Usd.Stage.Open(str(path))
    except Tf.ErrorException as error:
        return [Issue("error", "open", str(path), reason_of(error), "give a readable .usd, .usda, .usdc or .usdz file")]
    issues = [*_usd_issues(stage), *_nvidia_issues(stage)]
    for rule in OWN_RULES:
        try:
            issues.extend(rule(stage))
        except Tf.ErrorException as error:  # USD cannot read it at all
            issues.append(Issue("error", "read", str(path), reason_of(error), "fix what USD names, validate again"))
    return _together(issues)


def _together(issues: Iterable[Issue]) -> list[Issue]:
    """Merge issues that differ only in their place; the merged one names the first place."""
    sites: dict[tuple[str, str, str, str], list[str]] = {}
    for issue in issues:
        sites.setdefault((issue.severity, issue.rule, issue.message, issue.remedy), []).append(issue.site)
    return [
        Issue(severity, rule, places[0] + (f" and {len(places) - 1} more" if len(places) > 1 else ""), message, remedy)
        for (severity, rule, message, remedy), places in sites.items()
    ]


def _nvidia_issues(stage: Any) -> Iterator[Issue]:
    """The issues that ``usd-validation-nvidia`` finds, if it is installed."""
    if find_spec("usd_validation_nvidia") is None:
        return
    import usd_validation_nvidia

    for issue in usd_validation_nvidia.ValidationEngine().validate(stage).issues():
        if issue.rule and issue.rule.__name__ == "NormalsExistChecker" and _is_guide(stage, issue.at):
            continue  # collision hulls are never shaded
        severe = issue.severity.name in ("ERROR", "FAILURE")
        rule = f"nvidia:{issue.rule.__name__}" if issue.rule else "nvidia"
        site = issue.at.as_str() if issue.at is not None else stage.GetRootLayer().identifier
        remedy = issue.suggestion.message if issue.suggestion else "see nvidia_usd_validate --explain"
        yield Issue("error" if severe else "warning", rule, site, issue.message.strip(), remedy)


def _is_guide(stage: Any, site: Any) -> bool:
    """Whether a place that NVIDIA's validator names is a prim of purpose guide."""
    from pxr import UsdGeom

    prim = stage.GetPrimAtPath(site.path) if hasattr(site, "path") else None
    return bool(prim) and UsdGeom.Imageable(prim).ComputePurpose() == UsdGeom.Tokens.guide


def _usd_issues(stage: Any) -> Iterator[Issue]:
    from pxr import Tf, Usd

    try:
        from pxr import UsdValidation

        validators = UsdValidation.ValidationRegistry().GetOrLoadAllValidators()
    except (ImportError, Tf.ErrorException):  # a host application may contain an older USD
        message = f"USD {'.'.join(map(str, Usd.GetVersion()[1:]))} has no validators: its own rules are not checked"
        yield Issue("warning", "validators", "pxr", message, "validate with USD 25.11 or newer")
        return
    for error in UsdValidation.ValidationContext(validators).Validate(stage):
        if error.HasNoError():
            continue
        severe = error.GetType() == UsdValidation.ValidationErrorType.Error
        validator = error.GetValidator()
        rule = validator.GetMetadata().name if validator else str(error.GetName())
        remedy = REMEDIES.get(str(error.GetName()), f"see the rule {rule}")
        sites = ", ".join(_site(site) for site in error.GetSites()) or stage.GetRootLayer().identifier
        yield Issue("error" if severe else "warning", rule, sites, error.GetMessage(), remedy)


def _site(site: Any) -> str:
    if site.IsPrim():
        return str(site.GetPrim().GetPath())
    if site.IsProperty():
        return str(site.GetProperty().GetPath())
    layer = site.GetLayer()
    return str(layer.identifier) if layer else "stage"
