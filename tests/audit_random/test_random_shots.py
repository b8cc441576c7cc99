"""Forty small random shots: a script without vehsim measures the USD of those reported as solved."""

from __future__ import annotations

import tomllib
import warnings
from pathlib import Path

import pytest

from tests.audit_random.test_verifier import ROOT, load
from vehsim.shot import Shot

shots = load(ROOT / "tools" / "audit_random" / "shots.py")
verify = load(ROOT / "tools" / "audit_random" / "verify.py")

SEEDS = (
    1, 3, 4, 5, 6, 8, 11, 12, 13, 16, 22, 23, 27, 28, 29, 30, 35, 36, 44, 94,
    100, 101, 102, 108, 110, 111, 112, 113, 114, 115, 120, 124, 128, 130, 133, 137, 138, 140, 142, 143,
)  # fmt: skip
"""Fast ones of all vehicles and methods that can be solved; `make audit-random` runs a thousand."""


@pytest.mark.parametrize("seed", SEEDS)
def test_successful_shots_are_not_refuted(seed: int, tmp_path: Path) -> None:
    path = shots.write_shot(shots.make_shot(seed), tmp_path)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        folder = Shot.load(path).solve().export(tmp_path / "out", to=("usd",))
    found = verify.verify(tomllib.loads(path.read_text(encoding="utf-8")), next(folder.glob("*.usda")), tmp_path)
    assert [row.text for row in found.rows if row.ask != "pilot"] == []
    assert found.checks.total() > 5


def test_the_same_seed_gives_the_same_shot() -> None:
    assert shots.to_toml(shots.make_shot(7).table) == shots.to_toml(shots.make_shot(7).table)
    assert len({shots.to_toml(shots.make_shot(seed).table) for seed in range(50)}) == 50
