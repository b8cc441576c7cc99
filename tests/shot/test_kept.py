"""Solved motion is cached by content: pictures change without solving, and inputs of the motion cause a solve."""

from __future__ import annotations

import copy
import hashlib
import os
import shutil
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import vehsim.assets
from tests.shots import driven
from vehsim import Shot
from vehsim.batch import export_batch, load_shots
from vehsim.cameras import framing
from vehsim.cli import commands as cli
from vehsim.errors import InputError, SolveError
from vehsim.shot import cache as kept

PLANNED: dict[str, Any] = {
    "shot": {"schema": 1, "name": "park"},
    "vehicle": [
        {
            "name": "car",
            "asset": "car",
            "motion": {
                "method": "plan",
                "segments": 8,
                "mark": [
                    {"frame": 1001, "position": [0.0, 0.0, 0.0], "heading": 0.0, "velocity": [0.0, 0.0, 0.0]},
                    {"frame": 1049, "position": [6.0, 0.0, 0.0], "velocity": [0.0, 0.0, 0.0]},
                ],
            },
        }
    ],
}
LENS = "[camera]\nlens_mm = 35\n"
MARK = ("vehicle", 0, "motion", "mark", 1)


@pytest.fixture(autouse=True)
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A new cache that stores motion."""
    cache = tmp_path / "cache"
    monkeypatch.setenv("VEHSIM_CACHE", str(cache))
    monkeypatch.setenv("VEHSIM_CACHE_GB", "1")
    return cache


@pytest.fixture
def solved(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """A list that gets a name for every shot whose vehicles are solved."""
    names: list[str] = []
    solve = Shot._solve_vehicles

    def counted(self: Shot, *given: Any) -> Any:
        names.append(self.name)
        return solve(self, *given)

    monkeypatch.setattr(Shot, "_solve_vehicles", counted)
    return names


def bent(*changes: tuple[tuple[str | int, ...], Any]) -> dict[str, Any]:
    """The planned shot with values changed by path."""
    data = copy.deepcopy(PLANNED)
    for path, value in changes:
        table: Any = data
        for key in path[:-1]:
            table = table.setdefault(key, {}) if isinstance(key, str) else table[key]
        table[path[-1]] = value
    return data


def entries(folder: Path) -> list[Path]:
    return sorted(folder.glob("motion-*"))


def content(folder: Path) -> dict[str, str]:
    files = [path for path in folder.rglob("*") if path.is_file()]
    return {str(path.relative_to(folder)): hashlib.sha256(path.read_bytes()).hexdigest() for path in files}


def test_changing_a_lens_needs_no_planning_but_changing_a_mark_does(monkeypatch: pytest.MonkeyPatch) -> None:
    planned: list[Any] = []
    plan = vehsim.plan
    monkeypatch.setattr("vehsim.planning.plan", lambda *given, **more: planned.append(more) or plan(*given, **more))
    steps: list[str] = []

    def progress(what: str, done: float) -> None:
        steps.append(what)

    first = Shot.from_dict(bent()).solve(progress)
    assert (len(planned), first.recalled) == (1, False) and kept.FROM_CACHE not in steps
    longer = Shot.from_dict(bent((("camera",), {"lens_mm": 85.0}))).solve(progress)
    assert (len(planned), longer.recalled) == (1, True) and kept.FROM_CACHE in steps
    assert longer.cameras[0].lens_mm != pytest.approx(first.cameras[0].lens_mm)
    assert np.array_equal(longer.clips["car"].positions, first.clips["car"].positions)
    further = Shot.from_dict(bent(((*MARK, "position"), [6.5, 0.0, 0.0]))).solve()
    assert (len(planned), further.recalled) == (2, False)
    assert further.clips["car"].positions[-1, 0] == pytest.approx(6.5, abs=0.01)


def key_of(shot: Shot) -> str | None:
    return kept.motion_key(shot.file, shot.motion_files(), shot.world.content_hash)


@pytest.mark.parametrize(
    "path, value",
    [
        (("camera",), [{"name": "a", "lens_mm": 85.0}, {"name": "b", "rig": "orbit"}]),
        (("render", "size"), [320, 180]),
        (("export", "up_axis"), "Y"),
        (("shot", "name"), "another"),
    ],
)
def test_changes_of_the_look_keep_the_key(path: tuple[str, ...], value: Any) -> None:
    assert key_of(Shot.from_dict(bent((path, value)))) == key_of(Shot.from_dict(bent()))


@pytest.mark.parametrize(
    "path, value",
    [
        ((*MARK, "frame"), 1050),
        ((*MARK, "tolerance"), 0.1),
        (("vehicle", 0, "asset"), "simple_car"),
        (("vehicle", 0, "variants"), {"livery": "red"}),
        (("vehicle", 0, "motion", "cost"), "time"),
        (("vehicle", 0, "motion", "limits"), {"speed": 9.0}),
        (("world", "wind"), [0.0, 3.0, 0.0]),
        (("world", "terrain"), "flat"),
        (("world", "obstacle"), [{"shape": "box", "centre": [3.0, 9.0, 0.0], "size": [1.0, 1.0, 1.0]}]),
        (("shot", "fps"), 25),
        (("shot", "start_frame"), 1000),
        (("shot", "end_frame"), 1060),
    ],
)
def test_changes_that_affect_motion_change_the_key(path: tuple[str, ...], value: Any) -> None:
    assert key_of(Shot.from_dict(bent((path, value)))) != key_of(Shot.from_dict(bent()))


def test_a_vehicle_file_or_the_code_changes_the_key(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    car = tmp_path / "mine"
    shutil.copytree(Path(vehsim.assets.__file__).parent / "vehicles" / "car", car)
    data = bent((("vehicle", 0, "asset"), str(car)))

    def key() -> str | None:
        return key_of(Shot.from_dict(data))

    keys = [key()]
    toml = (car / "vehicle.toml").read_text()
    (car / "vehicle.toml").write_text(toml + "# heavier\n")
    keys.append(key())
    from pxr import Sdf

    layer = Sdf.Layer.OpenAsAnonymous(str(car / "car.usdc"))
    layer.comment = "repainted"
    layer.Export(str(car / "car.usdc"))
    keys.append(key())
    monkeypatch.setattr(kept, "code", lambda: "another version")
    keys.append(key())
    assert None not in keys and len(set(keys)) == 4


def test_deliveries_have_the_same_bytes_from_the_cache_or_not(tmp_path: Path, solved: list[str]) -> None:
    data = bent((("world", "obstacle"), [{"shape": "box", "centre": [3.0, 3.0, 0.0], "size": [1.0, 1.0, 1.0]}]))
    delivered = []
    for name, cached in (("fresh", True), ("kept", True), ("without", False)):
        take = Shot.from_dict(data).solve(cached=cached)
        delivered.append(content(take.export(tmp_path / name, to=("usd", "npz", "csv"))))
    assert delivered[0] == delivered[1] == delivered[2] and "report.json" in delivered[0]
    assert len(solved) == 2


def test_contacts_and_handles_are_cached_with_the_motion(tmp_path: Path, solved: list[str]) -> None:
    motion = {"method": "simulate", "duration": 0.5}
    boats = [
        {"name": name, "asset": "boat", "motion": {**motion, "start": {"position": [x, 0, 0], "velocity": [v, 0, 0]}}}
        for name, x, v in (("one", 0.0, 6.0), ("two", 8.0, -6.0))
    ]
    data = {
        "shot": {"schema": 1, "name": "bump", "start_frame": 1001, "end_frame": 1010, "handles": 3},
        "world": {"water": {"level": 0.0}, "contact": {}},
        "vehicle": boats,
    }
    takes = [Shot.from_dict(data).solve(cached=cached) for cached in (True, True, False)]
    assert [take.recalled for take in takes] == [False, True, False] and len(solved) == 2
    one, *others = (content(take.export(tmp_path / str(i), to=("usd", "npz"))) for i, take in enumerate(takes))
    assert others == [one, one]


def test_a_damaged_entry_is_solved_again(folder: Path, solved: list[str]) -> None:
    first = Shot.from_dict(bent()).solve()
    (entry,) = entries(folder)
    content = bytearray(entry.read_bytes())
    content[len(content) // 2] ^= 1
    entry.write_bytes(content)
    with pytest.warns(UserWarning, match="damaged cache entry"):
        again = Shot.from_dict(bent()).solve()
    assert len(solved) == 2 and not again.recalled
    assert np.array_equal(again.clips["car"].controls, first.clips["car"].controls)
    assert Shot.from_dict(bent()).solve().recalled


def test_warnings_are_cached_with_the_motion(monkeypatch: pytest.MonkeyPatch) -> None:
    solve = Shot._solve_vehicles

    def warned(self: Shot, *given: Any) -> Any:
        warnings.warn("car: slides", stacklevel=1)
        return solve(self, *given)

    monkeypatch.setattr(Shot, "_solve_vehicles", warned)
    for recalled in (False, True):
        with pytest.warns(UserWarning, match="car: slides") as caught:
            assert Shot.from_dict(bent()).solve().recalled is recalled
        assert len([warning for warning in caught if "slides" in str(warning.message)]) == 1


def test_cameras_are_solved_again_only_after_what_moves_them(monkeypatch: pytest.MonkeyPatch) -> None:
    """Not after a note, but after a change of their rigs and of the motion; warnings are repeated."""
    solve, filmed = framing.solve_camera, list[str]()

    def counted(rig: Any, *given: Any) -> Any:
        filmed.append(rig.name)
        warnings.warn("too low", stacklevel=1)
        return solve(rig, *given)

    monkeypatch.setattr(framing, "solve_camera", counted)
    note, lens, later = {"frame": 1001, "text": "go"}, {"lens_mm": 50.0}, 1061
    pictures, counts = [], []
    for changes in ((), [(("note",), [note])], [(("camera",), [lens])], [((*MARK, "frame"), later)]):
        with pytest.warns(UserWarning, match="too low"):
            take = Shot.from_dict(bent(*changes)).solve()
        counts.append(len(filmed))
        pictures.append([(camera.positions.tobytes(), camera.orientations.tobytes()) for camera in take.cameras])
        assert take.cameras[0].lens_mm == (50 if lens in dict(changes).get(("camera",), ()) else 35)
    assert counts == [1, 1, 2, 3] and pictures[0] == pictures[1] and pictures[0] != pictures[3]


def test_failures_and_machine_dependent_motion_are_not_cached(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert key_of(Shot.from_dict(bent((("vehicle", 0, "motion", "time_limit"), 60.0)))) is None
    from vehsim.planning.terms import COSTS

    with monkeypatch.context() as patch:
        patch.setitem(COSTS, "calm", lambda segment: segment.h)
        assert key_of(Shot.from_dict(bent())) is None
    assert key_of(Shot.from_dict(bent())) is not None

    def fail(self: Shot, *given: Any) -> Any:
        warnings.warn("car: nearly there", stacklevel=1)
        raise SolveError("car: no plan was found")

    monkeypatch.setattr(Shot, "_solve_vehicles", fail)
    for _ in range(2):
        with pytest.warns(UserWarning, match="nearly there"), pytest.raises(SolveError):
            Shot.from_dict(bent()).solve()
    assert entries(folder) == []


def test_the_cache_is_bounded_and_keeps_recently_used_entries(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def drive(duration: float) -> bool:
        motion = {"method": "simulate", "duration": duration}
        return Shot.from_dict(bent((("vehicle", 0, "motion"), motion))).solve().recalled

    drive(0.25), drive(0.26)
    for age, entry in enumerate(entries(folder)):
        os.utime(entry, ns=(age, age))
    assert drive(0.25)  # used now
    size = sum(entry.stat().st_size for entry in entries(folder))
    monkeypatch.setenv("VEHSIM_CACHE_GB", str(1.2 * size / 1e9))
    assert not drive(0.27)
    assert [drive(0.25), drive(0.27), len(entries(folder))] == [True, True, 2]
    monkeypatch.setenv("VEHSIM_CACHE_GB", "0")
    assert not drive(0.25)
    monkeypatch.setenv("VEHSIM_CACHE_GB", "much")
    with pytest.raises(InputError, match="VEHSIM_CACHE_GB = 'much': not a number"):
        drive(0.25)


def test_export_reports_motion_from_the_cache(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "drive.toml"
    path.write_text(driven() + LENS)

    def export(*more: str) -> str:
        assert cli.run(["export", str(path), "--out", str(tmp_path / "out"), "--to", "npz", *more]) == 0
        return capsys.readouterr().out

    assert "motion from the cache" not in export()
    assert "npz of frames 1001 to 1007, motion from the cache" in export("--set", "camera.lens_mm=85")
    assert '"motion": "cache"' in export("--log", "json")
    assert "motion from the cache" not in export("--no-cache")


def test_a_batch_has_the_same_bytes_from_the_cache(tmp_path: Path) -> None:
    """With workers, a lens swept over one motion, and resuming a delivery whose motion is cached."""
    path = tmp_path / "drive.toml"
    path.write_text(driven() + LENS + '[sweep]\n"camera.lens_mm" = [20, 35, 50]\n')
    shots = load_shots(path)
    done = export_batch(shots, tmp_path / "one", ["usd"])
    assert [outcome.recalled for outcome in done] == [False, True, True]
    spread = export_batch(shots, tmp_path / "two", ["usd"], workers=2)
    assert all(outcome.recalled for outcome in spread)
    fresh = export_batch(shots, tmp_path / "three", ["usd"], cached=False)
    assert not any(outcome.recalled for outcome in fresh)
    assert content(tmp_path / "one") == content(tmp_path / "two") == content(tmp_path / "three")
    shutil.rmtree(tmp_path / "two" / shots[1].name)
    again = export_batch(shots, tmp_path / "two", ["usd"], resume=True)
    assert [outcome.state for outcome in again] == ["skipped", "done", "skipped"] and again[1].recalled
    assert content(tmp_path / "one") == content(tmp_path / "two")
