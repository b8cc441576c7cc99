"""Each thing that can be wrong with a stage is found, and says how to mend it."""

from __future__ import annotations

import pytest

from vehsim.exporters.usd import write_usd
from vehsim.exporters.validate import validate_stage

pytestmark = pytest.mark.broken_stages


@pytest.fixture
def shot(tmp_path, toys, make_take):
    toys.asset(tmp_path / "cm.usda", 0.01)
    write_usd(make_take(toys.clip(toys.asset(tmp_path / "in" / "toy.usda"))), tmp_path, toys.silent)
    return tmp_path / "shot.usda"


def broken(shot, edit):
    from pxr import Usd

    stage = Usd.Stage.Open(str(shot))
    edit(stage)
    stage.GetRootLayer().Save()
    return validate_stage(shot)


def test_a_shot_we_wrote_has_no_issue_at_all(shot):
    assert [str(issue) for path in shot.parent.rglob("*.usd*") for issue in validate_stage(path)] == []


BREAKS = {
    "usdGeomValidators:StageMetadataChecker": lambda stage: stage.GetRootLayer().pseudoRoot.ClearInfo("metersPerUnit"),
    "usdValidation:StageMetadataChecker": lambda stage: stage.ClearDefaultPrim(),
    "time": lambda stage: stage.GetRootLayer().pseudoRoot.ClearInfo("timeCodesPerSecond"),
    "range": lambda stage: stage.SetEndTimeCode(1010),
    "finite": lambda stage: _camera(stage).GetAttribute("xformOp:translate").Set((float("nan"), 0, 0), 1005),
    "sign": lambda stage: (
        _camera(stage)
        .GetAttribute("xformOp:orient")
        .Set(-_camera(stage).GetAttribute("xformOp:orient").Get(1005), 1005)
    ),
    "units": lambda stage: stage.DefinePrim("/shot/env/prop", "Xform").GetReferences().AddReference("./cm.usda"),
    "usdValidation:CompositionErrorTest": lambda stage: (
        stage.OverridePrim("/shot/env").GetReferences().AddReference("./gone.usda")
    ),
}


def _camera(stage):
    return stage.GetPrimAtPath("/shot/cameras/chase")


@pytest.mark.parametrize("rule", BREAKS)
def test_what_is_broken_is_found(shot, rule):
    issues = [issue for issue in broken(shot, BREAKS[rule]) if issue.rule == rule]
    assert issues, rule
    assert issues[0].mend and issues[0].message and issues[0].site


def test_a_file_that_is_no_stage_is_one_issue(tmp_path):
    (tmp_path / "bad.usda").write_text("not usd")
    (issue,) = validate_stage(tmp_path / "bad.usda")
    assert issue.severity == "error" and "bad.usda" in issue.site
