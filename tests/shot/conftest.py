"""A small valid shot that tests change."""

from __future__ import annotations

import copy
from collections.abc import Callable
from typing import Any

import pytest

SMALL: dict[str, Any] = {
    "shot": {"schema": 1, "name": "small"},
    "vehicle": [
        {
            "name": "car",
            "asset": "car",
            "motion": {"method": "simulate", "duration": 0.5, "commands": [{"frame": 1001, "torque": 500.0}]},
        }
    ],
}
PLANNED: dict[str, Any] = {
    "shot": {"schema": 1, "name": "planned"},
    "world": {"terrain": "canyon"},
    "vehicle": [
        {
            "name": "heli",
            "asset": "helicopter",
            "motion": {
                "method": "plan",
                "mark": [
                    {"frame": 1001, "position": [0.0, 0.0, 30.0], "heading": 0.0, "velocity": [0.0, 0.0, 0.0]},
                    {"frame": "free", "position": [180.0, 40.0, 28.0]},
                ],
            },
        }
    ],
}


@pytest.fixture
def small() -> dict[str, Any]:
    return copy.deepcopy(SMALL)


@pytest.fixture
def planned() -> dict[str, Any]:
    return copy.deepcopy(PLANNED)


@pytest.fixture
def keys_of() -> Callable[[dict[str, Any]], dict[str, str]]:
    """The problems of a shot: key -> messages and remedies."""
    from vehsim import Shot
    from vehsim.errors import ShotError

    def find(data: dict[str, Any]) -> dict[str, str]:
        try:
            problems = Shot.from_dict(data).check()
        except ShotError as error:
            problems = error.problems
        texts: dict[str, str] = {}
        for problem in problems:
            texts[problem.key] = f"{texts.get(problem.key, '')} {problem.message}; {problem.remedy}"
        return texts

    return find
