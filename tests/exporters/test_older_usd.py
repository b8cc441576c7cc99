"""Without USD's validators, as in some host applications, `validate_stage` runs its other checks."""

from __future__ import annotations

import math
import sys
from pathlib import Path

import pytest

from vehsim.exporters.checks.validate import Issue, issues_of


@pytest.mark.broken_stages
def test_without_usds_validators_our_own_rules_are_still_checked(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    import pxr
    from pxr import Usd, UsdGeom

    monkeypatch.setitem(sys.modules, "pxr.UsdValidation", None)
    if hasattr(pxr, "UsdValidation"):
        monkeypatch.delattr(pxr, "UsdValidation")
    path = tmp_path / "empty.usda"
    stage = Usd.Stage.CreateNew(str(path))
    UsdGeom.Xform.Define(stage, "/top").AddTranslateOp().Set((math.nan, 0.0, 0.0))
    stage.Save()
    issues = [Issue(*row) for row in issues_of(path)[0]]  # in this process, where they are missing
    assert [issue.message for issue in issues if issue.rule == "validators"]
    assert [issue for issue in issues if issue.severity == "error"], "our own rules refuse NaN"
