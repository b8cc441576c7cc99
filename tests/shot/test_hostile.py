"""For any data in a shot file: a valid shot or a ``ShotError``, never another exception."""

from __future__ import annotations

import copy
import tomllib
from pathlib import Path
from typing import Any

from hypothesis import given, settings
from hypothesis import strategies as st

from vehsim import Shot
from vehsim.errors import ShotError
from vehsim.shot.schema.shot_file import schema

EXAMPLES = Path(__file__).resolve().parents[2] / "examples"
SHOTS = [tomllib.loads((EXAMPLES / name).read_text()) for name in ("car_commands.toml", "canyon_flight.toml")]
for shot in SHOTS:
    shot["world"] = {"wind": [0.0, 3.0, 0.0]}  # empty space, which is fast to check

SCALARS = st.one_of(
    st.none(),
    st.booleans(),
    st.integers(),
    st.sampled_from([10**400, -1, 0, 2**63]),
    st.floats(),
    st.text(max_size=8),
    st.sampled_from(["free", "plan", "24000/1001", "car", "canyon", "\0", "nan"]),
    st.dates(),
)
KEYS = st.sampled_from(sorted({key for table in schema()["$defs"].values() for key in table["properties"]})) | st.text()
VALUES = st.recursive(
    SCALARS, lambda inner: st.lists(inner, max_size=4) | st.dictionaries(KEYS, inner, max_size=4), max_leaves=8
)


def attempt(data: Any) -> None:
    try:
        shot = Shot.from_dict(data)
    except ShotError as error:
        assert error.problems
        assert all(problem.key and problem.message and problem.remedy for problem in error.problems)
    else:
        for problem in shot.check():
            assert str(problem)


@settings(max_examples=150)
@given(VALUES)
def test_any_data(data: Any) -> None:
    attempt(data)


@settings(max_examples=300)
@given(st.sampled_from(SHOTS), st.data())
def test_valid_shots_with_one_value_replaced(shot: dict[str, Any], draw: st.DataObject) -> None:
    data = copy.deepcopy(shot)
    table: Any = data
    while True:
        keys = list(table) if isinstance(table, dict) else list(range(len(table)))
        key = draw.draw(st.sampled_from(keys))
        if not isinstance(table[key], dict | list) or not table[key] or draw.draw(st.integers(0, 3)) == 0:
            break
        table = table[key]
    table[key] = draw.draw(VALUES)
    attempt(data)


@settings(max_examples=150)
@given(st.sampled_from(SHOTS), KEYS, VALUES, st.integers(0, 3))
def test_valid_shots_with_a_key_added(shot: dict[str, Any], key: str, value: Any, depth: int) -> None:
    data = copy.deepcopy(shot)
    tables = [data, data["shot"], data["vehicle"][0], data["vehicle"][0]["motion"]]
    tables[depth][key] = value
    attempt(data)
