"""Wheels, propellers and rotors in the audit of a shot: those that turn without cause are refused."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from vehsim.errors import SolveError
from vehsim.integrators import record
from vehsim.planning import trajectory
from vehsim.shot import Shot


def held(asset: str, way: float, frames: int, **world: Any) -> dict[str, Any]:
    """A vehicle that comes ``way`` m to a hold of two seconds, in so many frames."""
    rest = {"velocity": [0, 0, 0]}
    marks = [
        {"frame": 1, "position": [0, 0, 0], "heading": 0, **rest},
        {"frame": 1 + frames, "position": [way, 0, 0], **rest, "hold": 48},
    ]
    motion = {"method": "plan", "segments": 16, "mark": marks}
    vehicle = [{"name": "mover", "asset": asset, "motion": motion}]
    return {"shot": {"schema": 1, "name": "held", "start_frame": 1}, "world": world, "vehicle": vehicle}


SHOTS = {
    "car": held("car", 15.0, 144, terrain="flat"),
    "two_wheeled": held("two_wheeled", 2.0, 144, terrain="flat"),
    "truck": held("truck", 25.0, 240, terrain="flat"),
    "drift_car": held("drift_car", 15.0, 144, terrain="flat"),
    "boat": held("boat", 15.0, 216),
    "windy boat": held("boat", 15.0, 240, wind=[-2, 0, 0]),
    "helicopter": held("helicopter", 30.0, 144),
}


@pytest.mark.parametrize("name", sorted(SHOTS))
def test_wheels_and_rotors_turn_as_they_should(name: str) -> None:
    rows = Shot.from_dict(SHOTS[name]).solve().report["audit"]["mover"]
    turning = [row for row in rows if row["measure"] in ("rolling", "spinning")]
    assert turning and all(row["met"] and row["severity"] == "error" for row in turning)
    assert any("(hold)" in row["key"] for row in turning)


@pytest.mark.parametrize("name", ["car", "boat"])
def test_wheels_and_propellers_that_turn_in_a_hold_are_refused(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Polynomials through knots on both sides of a hold swing in it, as they once did."""
    rule = record._rule
    monkeypatch.setattr(record, "UNEVEN", np.inf)
    monkeypatch.setattr(record, "_rule", lambda times, still: rule(times, np.zeros_like(still)))
    monkeypatch.setattr(trajectory, "measured_along", lambda mechanics, clip: clip)
    part = "spinning.propeller" if name == "boat" else "rolling"
    with pytest.raises(SolveError, match=rf"{part} \(hold\): \d.* deg, .* allowed"):
        Shot.from_dict(SHOTS[name]).solve(cached=False)


def test_wheels_of_another_size_than_the_models_are_a_warning() -> None:
    """Its model rolls on larger wheels than the asset has: loading warns of it, and nothing else can be done here."""
    shot = held("car", 15.0, 144, terrain="flat")
    shot["vehicle"][0]["parameters"] = {"wheel_radius": 0.5}
    rows = Shot.from_dict(shot).solve().report["audit"]["mover"]
    (row,) = [row for row in rows if row["key"] == "rolling"]
    assert not row["met"] and row["severity"] == "warning" and "wheel_radius" in row["remedy"]
