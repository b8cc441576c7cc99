"""One shot file, many clips: their number, values and names."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from vehsim.batch import load_shots
from vehsim.batch.sweep import expand
from vehsim.cli import commands as cli
from vehsim.errors import ShotError


def test_every_combination_of_listed_values() -> None:
    clips = expand({"world.wind": [[0, 0, 0], [0, 3, 0]], "vehicle.car.motion.duration": [1, 2, 3]})
    assert [name for name, _ in clips] == [f"wind{i}_duration{k}" for i in range(2) for k in range(3)]
    assert clips[-1][1] == {"world.wind": [0, 3, 0], "vehicle.car.motion.duration": 3}


def test_side_by_side() -> None:
    clips = expand({"combine": "zip", "a.x": [1, 2], "b.y": {"from": 0, "to": 1, "count": 2}})
    assert [values for _, values in clips] == [{"a.x": 1, "b.y": 0.0}, {"a.x": 2, "b.y": 1.0}]


def test_even_spacing_has_both_ends() -> None:
    values = [v["a.b"] for _, v in expand({"a.b": {"from": -1, "to": 1, "count": 5}})]
    assert values == [-1, -0.5, 0, 0.5, 1]


def test_keys_with_the_same_ending_get_different_labels() -> None:
    names = [name for name, _ in expand({"mark[0].position": [1], "mark[1].position": [1], "x[2]": [1]})]
    assert names == ["mark0_position0_mark1_position0_x2_0"]


def test_values_drawn_from_a_seed_do_not_depend_on_other_swept_keys() -> None:
    """A clip's values depend only on its seed and their keys: sweeping more keys never changes existing clips."""
    alone = dict(expand({"a.x": {"uniform": [2, 3]}, "seeds": 4}))
    more = expand({"a.x": {"uniform": [2, 3]}, "a.y": {"normal": [0, 1]}, "seeds": [7, 2]})
    assert alone["seed2"]["a.x"] == more[1][1]["a.x"]
    drawn = [values["a.x"] for values in alone.values()]
    assert len(set(drawn)) == 4
    assert all(2 <= x < 3 for x in drawn)
    spread = [v["b"] for _, v in expand({"b": {"normal": [10, 2]}, "seeds": 2000})]
    mean = sum(spread) / 2000
    assert abs(mean - 10) < 0.2
    assert abs((sum((x - mean) ** 2 for x in spread) / 2000) ** 0.5 - 2) < 0.15


@pytest.mark.parametrize(
    "sweep, key",
    [
        ({}, "sweep"),
        ({"a.b": []}, "sweep.a.b"),
        ({"a.b": 3}, "sweep.a.b"),
        ({"a.b": {"from": 0, "to": 1}}, "sweep.a.b"),
        ({"a.b": {"from": 0, "to": 1, "count": 0}}, "sweep.a.b"),
        ({"a.b": {"uniform": [0, 1]}}, "sweep.seeds"),
        ({"a.b": {"uniform": [0, 1]}, "seeds": [1, 1]}, "sweep.seeds"),
        ({"a.b": [1], "seeds": 3}, "sweep.seeds"),
        ({"a.b": [1], "combine": "sum"}, "sweep.combine"),
        ({"a.b": [1], "a.c": [1, 2], "combine": "zip"}, "sweep.combine"),
        ({"a.b": {"from": 0, "to": 1, "count": 1000}, "a.c": {"from": 0, "to": 1, "count": 1000}}, "sweep"),
    ],
)
def test_invalid_sweeps_are_reported(sweep: dict[str, Any], key: str) -> None:
    with pytest.raises(ShotError) as error:
        expand(sweep)
    assert error.value.problems[0].key == key


def test_shots_are_named_after_their_values(write: Callable[..., Path]) -> None:
    shots = load_shots(write(sweep='"vehicle.car.motion.duration" = [0.25, 0.5]'), ["shot.start_frame=1"])
    assert [shot.name for shot in shots] == ["drive_duration0", "drive_duration1"]
    assert [shot.file.vehicle[0].motion.duration for shot in shots] == [0.25, 0.5]
    assert {shot.file.shot.start_frame for shot in shots} == {1}


def test_errors_in_a_sweep_name_file_and_line(write: Callable[..., Path], capsys: pytest.CaptureFixture[str]) -> None:
    path = write(sweep='"vehicle.car.motion.duration" = [0.25, -1]\n"vehicle.van.asset" = ["car"]')
    with pytest.raises(ShotError, match=r"drive\.toml"):
        load_shots(path)
    assert cli.run(["check", str(path)]) == 2
    assert "there is no 'van'" in capsys.readouterr().err


def test_a_swept_key_cannot_be_set_as_well(write: Callable[..., Path]) -> None:
    path = write(sweep='"vehicle.car.motion.duration" = [0.25, 0.5]')
    with pytest.raises(ShotError, match="both the sweep and --set give it"):
        load_shots(path, ["vehicle.car.motion.duration=3"])


def test_dry_run_lists_the_clips(
    write: Callable[..., Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = write(sweep='"vehicle.car.motion.duration" = [0.25, 0.5]')
    assert cli.run(["export", str(path), "--out", str(tmp_path / "out"), "--dry-run"]) == 0
    assert [line.partition(":")[0][-15:] for line in capsys.readouterr().out.splitlines()] == [
        "drive_duration0",
        "drive_duration1",
    ]
    assert not (tmp_path / "out").exists()


def test_a_shot_without_its_sweep_expanded_warns(write: Callable[..., Path]) -> None:
    from vehsim import Shot

    (problem,) = Shot.load(write(sweep='"vehicle.car.motion.duration" = [0.25]')).check()
    assert (problem.key, problem.severity) == ("sweep", "warning")
