"""What continues a clip, as arrays: the same bits and types come back, and nothing but plain data is made."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from vehsim.clip.ending import decoded, encoded
from vehsim.errors import InputError
from vehsim.vehicles import State

STATE = ("vehsim.vehicles.definition.base:State",)


def same(a: Any, b: Any) -> bool:
    """Whether both have the same types and bits, in the same order of memory."""
    if type(a) is not type(b):
        return False
    if isinstance(a, np.ndarray):
        bits = a.dtype == b.dtype and a.shape == b.shape and a.tobytes() == b.tobytes()
        return bits and a.flags.f_contiguous == b.flags.f_contiguous
    if isinstance(a, float):
        return np.float64(a).tobytes() == np.float64(b).tobytes()
    if isinstance(a, list | tuple):
        return len(a) == len(b) and all(map(same, a, b))
    if isinstance(a, dict):
        return same(list(a.items()), list(b.items()))
    return same(vars(a), vars(b)) if isinstance(a, State) else bool(a == b)


def test_plain_data_comes_back() -> None:
    rng = np.random.default_rng(3)
    value = {
        "floats": [0.1, -0.0, np.inf, np.float64(0.3), float("nan")],
        "states": tuple((k / 7, State(rng.normal(size=3), twist=rng.normal(size=6))) for k in range(50)),
        (1, "key"): [None, True, 2**60, "text \u00e9", (), [], {}],
        "arrays": [rng.normal(size=(2, 3)).T, np.array(1.5), np.zeros((0, 4)), np.arange(3), np.array([True])],
        "complex": rng.normal(size=4) + 1j * rng.normal(size=4),
        "strided": rng.normal(size=(4, 4))[:, 1:3].copy(),
        "nothing": [[], []],
    }
    arrays = encoded(value, STATE)
    assert same(decoded(arrays, STATE), value)
    assert len(arrays["structure"]) < 1500  # fifty states have one structure


def test_other_classes_are_neither_written_nor_made() -> None:
    with pytest.raises(TypeError, match="Path cannot be stored"):
        encoded({"here": Path()}, STATE)
    with pytest.raises(InputError, match="subprocess:Popen is not permitted"):
        decoded(arrays_of({"class": "subprocess:Popen", "with": {}}), STATE)
    with pytest.raises(InputError, match="is not permitted"):
        decoded(encoded(State(), STATE), ())


def arrays_of(structure: Any, numbers: Any = ()) -> dict[str, Any]:
    return {"structure": np.frombuffer(json.dumps(structure).encode(), np.uint8), "numbers": np.array(numbers, float)}


@pytest.mark.parametrize(
    "structure",
    [
        {"list": {"is": None}, "times": 10**15},
        {"list": {"array": [0], "type": "<f8", "order": "C"}, "times": 10**15},
        {"array": [10**9, 10**9, 10**9], "type": "<f8", "order": "C"},
        {"array": [-1], "type": "<f8", "order": "C"},
        {"array": [1], "type": "|O", "order": "C"},
        {"one": "eval"},
        {"is": 1},  # its number is left
        {},
        [],
        7,
    ],
)
def test_foreign_structures_are_refused(structure: Any) -> None:
    with pytest.raises(InputError, match="cannot be read"):
        decoded(arrays_of(structure, [1.0]), STATE)
