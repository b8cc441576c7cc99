"""Deliveries are complete or absent: the old one stays until the new one is complete, whatever happens."""

from __future__ import annotations

import json
import os
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from fractions import Fraction
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import pytest

from vehsim import World
from vehsim.delivery import folders as delivery
from vehsim.delivery.exporters import REPORT_GROUP, Exporter
from vehsim.delivery.take import RenderSettings, Take, UsdSettings
from vehsim.errors import ExportError, InputError
from vehsim.runtime.files import owner
from vehsim.runtime.progress import Progress

NOBODY = 65534
"""A user without rights."""


@dataclass
class Entry:
    """An entry point that hands out an object."""

    name: str
    value: Any

    def load(self) -> Any:
        return self.value


def text(name: str, *files: str, needs: tuple[str, ...] = ()) -> Exporter:
    """An exporter that writes its name into files, after checking that the files it needs exist."""

    def write(take: Take, folder: Path, progress: Progress) -> Sequence[Path]:
        assert all((folder / f"{need}.txt").exists() for need in needs)
        paths = [folder / file for file in files]
        for path in paths:
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(name)
        progress(name, 1.0)
        return paths

    return Exporter(name, (".txt",), write, needs)


def failing(error: BaseException) -> Exporter:
    def write(take: Take, folder: Path, progress: Progress) -> Sequence[Path]:
        (folder / "half").write_text("written")
        raise error

    return Exporter("bad", (), write)


@pytest.fixture
def exporters(monkeypatch: pytest.MonkeyPatch) -> dict[str, Exporter]:
    """The exporters that entry points lead to; tests add their own."""
    found = {e.name: e for e in (text("a", "a.txt", "sub/deep/a.txt"), text("b", "b.txt", needs=("a",)))}

    def report(take: Take, folder: Path, files: Sequence[Path]) -> Path:
        path = folder / "report.json"
        content = {"files": {file.relative_to(folder).as_posix(): file.read_text() for file in files}}
        path.write_text(json.dumps(content | {"solved": take.report}))
        return path

    def entries(group: str) -> list[Entry]:
        return [Entry("json", report)] if group == REPORT_GROUP else [Entry(e.name, e) for e in found.values()]

    for module in ("exporters", "take"):
        monkeypatch.setattr(f"vehsim.delivery.{module}.entries", entries)
    return found


@pytest.fixture
def take() -> Take:
    return Take("shot", {}, World(), (), Fraction(24), (1001, 1010))


def files(folder: Path) -> set[str]:
    return {path.relative_to(folder).as_posix() for path in folder.rglob("*") if path.is_file()}


def listed(folder: Path) -> set[str]:
    """The files that the report lists."""
    return set(json.loads((folder / "report.json").read_text())["files"])


A, B = {"shot/a.txt", "shot/sub/deep/a.txt"}, {"shot/b.txt"}
REPORT = {"shot/report.json"}


def test_files_needed_only_by_other_exporters_are_dropped(exporters: Any, take: Take, tmp_path: Path) -> None:
    folder = take.export(tmp_path, to=("b",))
    assert folder == tmp_path / "shot"
    assert files(tmp_path) == {"shot/b.txt", "shot/report.json"}
    assert listed(folder) == {"b.txt"}
    assert not (folder / "sub").exists()


def test_needs_run_first_and_once(exporters: Any, take: Take, tmp_path: Path) -> None:
    steps: list[tuple[str, float]] = []
    started: list[str] = []
    take.export(
        tmp_path,
        to=("b", "a"),
        progress=lambda what, done: steps.append((what, done)),
        starting=lambda exporter: started.append(exporter.name),
    )
    assert steps == [("a", 0.5), ("b", 1.0)] and started == ["a", "b"]
    assert files(tmp_path) == {"shot/a.txt", "shot/sub/deep/a.txt", "shot/b.txt", "shot/report.json"}


def test_files_of_other_exporters_stay(exporters: Any, take: Take, tmp_path: Path) -> None:
    take.export(tmp_path, to=("a",))
    assert files(take.export(tmp_path, to=("b",))) == {"a.txt", "sub/deep/a.txt", "b.txt", "report.json"}
    assert listed(tmp_path / "shot") == {"a.txt", "sub/deep/a.txt", "b.txt"}
    report = json.loads((tmp_path / "shot" / "report.json").read_text())
    assert report["solved"]["exporters"].keys() == {"a", "b"}
    take.export(tmp_path, to=("a",))
    assert files(tmp_path) == A | B | REPORT


def test_files_that_an_exporter_no_longer_writes_are_removed(
    exporters: dict[str, Exporter], take: Take, tmp_path: Path
) -> None:
    """Pictures of every second frame: the others are no longer part of the delivery."""
    take.export(tmp_path, to=("a", "b"))
    exporters["a"] = text("a", "a.txt")
    take.export(tmp_path, to=("a",))
    assert files(tmp_path) == {"shot/a.txt"} | B | REPORT
    assert listed(tmp_path / "shot") == {"a.txt", "b.txt"}


@pytest.mark.parametrize("change", [{"frames": (1001, 1011)}, {"fps": Fraction(25)}, {"world": World(wind=(0, 3, 0))}])
def test_files_of_another_motion_are_set_apart_with_a_warning(
    exporters: Any, take: Take, tmp_path: Path, change: dict[str, Any]
) -> None:
    take.export(tmp_path, to=("a",))
    other = replace(take, **change)
    with pytest.warns(
        UserWarning, match=r"shot: a show an older version of the shot: moved to .*earlier/1; export a again"
    ):
        other.export(tmp_path, to=("b",))
    apart = {f"shot/earlier/1/{name}" for name in ("a.txt", "sub/deep/a.txt", "report.json")}
    assert files(tmp_path) == apart | B | REPORT
    assert listed(tmp_path / "shot") == {"b.txt"}
    assert listed(tmp_path / "shot" / "earlier" / "1") == {"a.txt", "sub/deep/a.txt"}
    with pytest.warns(UserWarning, match="b show an older version of the shot"):
        take.export(tmp_path, to=("a",))
    assert files(tmp_path) == A | apart | {"shot/earlier/2/b.txt", "shot/earlier/2/report.json"} | REPORT


def test_nothing_is_set_apart_if_all_exporters_run_again(
    exporters: Any, take: Take, tmp_path: Path, recwarn: pytest.WarningsRecorder
) -> None:
    take.export(tmp_path, to=("a", "b"))
    replace(take, frames=(1001, 1020)).export(tmp_path, to=("b", "a"))
    other = replace(take, frames=(1001, 1020), render=RenderSettings(size=(64, 36)), usd=UsdSettings(up_axis="Y"))
    other.export(tmp_path, to=("b",))
    assert files(tmp_path) == A | B | REPORT
    assert not recwarn.list


def test_users_files_in_a_delivery_stay(exporters: Any, take: Take, tmp_path: Path) -> None:
    take.export(tmp_path, to=("a",))
    (tmp_path / "shot" / "notes.txt").write_text("mine")
    replace(take, frames=(1001, 1020)).export(tmp_path, to=("a",))
    assert files(tmp_path) == A | REPORT | {"shot/notes.txt"}
    assert listed(tmp_path / "shot") == {"a.txt", "sub/deep/a.txt"}


@pytest.mark.parametrize("report", ["", "[]", '{"files": {"a.txt": "1"}, "solved": {}}'])
def test_a_delivery_without_a_content_hash_is_set_apart(
    exporters: Any, take: Take, tmp_path: Path, report: str
) -> None:
    """One of an earlier version of vehsim."""
    take.export(tmp_path, to=("a",))
    (tmp_path / "shot" / "report.json").write_text(report)
    with pytest.warns(UserWarning, match="earlier/1"):
        take.export(tmp_path, to=("b",))
    apart = {f"shot/earlier/1/{name}" for name in ("a.txt", "sub/deep/a.txt", "report.json")}
    assert files(tmp_path) == apart | B | REPORT


def test_a_concurrent_export_loses_nothing(
    exporters: Any, take: Take, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Another export delivers after ours has checked, and before it moves the old delivery aside."""
    take.export(tmp_path, to=("a",))
    exporters["c"] = text("c", "c.txt")
    settle, intruded = delivery.settle, []

    def interrupted(folder: Path) -> None:
        settle(folder)
        if not intruded:
            intruded.append(folder)
            take.export(tmp_path, to=("c",))

    monkeypatch.setattr(delivery, "settle", interrupted)
    take.export(tmp_path, to=("b",))
    assert intruded and files(tmp_path) == A | B | REPORT | {"shot/c.txt"}
    assert listed(tmp_path / "shot") == {"a.txt", "sub/deep/a.txt", "b.txt", "c.txt"}


@pytest.mark.parametrize("error", [ExportError("no"), OSError(28, "No space left on device"), KeyboardInterrupt()])
def test_a_failed_export_leaves_the_old_delivery(
    exporters: dict[str, Exporter], take: Take, tmp_path: Path, error: BaseException
) -> None:
    take.export(tmp_path, to=("a",))
    before = files(tmp_path)
    exporters["bad"] = failing(error)
    with pytest.raises(ExportError if isinstance(error, Exception) else KeyboardInterrupt):
        take.export(tmp_path, to=("a", "bad"))
    assert files(tmp_path) == before
    assert [path.name for path in tmp_path.iterdir()] == ["shot"]


def test_a_failed_first_export_leaves_nothing(exporters: dict[str, Exporter], take: Take, tmp_path: Path) -> None:
    exporters["bad"] = failing(ExportError("no"))
    with pytest.raises(ExportError):
        take.export(tmp_path / "deep" / "out", to=("bad",))
    assert list(tmp_path.iterdir()) == []


def test_an_unknown_exporter_touches_nothing(exporters: Any, take: Take, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="choose from a, b"):
        take.export(tmp_path / "out", to=("c",))
    assert list(tmp_path.iterdir()) == []


def test_foreign_folders_are_never_replaced(exporters: Any, take: Take, tmp_path: Path) -> None:
    (tmp_path / "shot").mkdir()
    (tmp_path / "shot" / "notes.txt").write_text("mine")
    with pytest.raises(InputError, match="not written by vehsim"):
        take.export(tmp_path, to=("a",))
    assert files(tmp_path) == {"shot/notes.txt"}


def test_overwrite_can_be_refused(exporters: Any, take: Take, tmp_path: Path) -> None:
    take.export(tmp_path, to=("a",))
    with pytest.raises(InputError, match="exists"):
        take.export(tmp_path, to=("b",), overwrite=False)
    assert "shot/a.txt" in files(tmp_path)


def test_a_failed_swap_puts_the_old_delivery_back(
    exporters: Any, take: Take, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    take.export(tmp_path, to=("a",))
    before, rename = files(tmp_path), Path.rename

    def fails(self: Path, target: Path) -> Path:
        if self.name.endswith(".partial"):
            raise OSError(5, "Input/output error")
        return rename(self, target)

    monkeypatch.setattr(Path, "rename", fails)
    with pytest.raises(ExportError):
        take.export(tmp_path, to=("b",))
    assert files(tmp_path) == before


@pytest.mark.parametrize("moved", [".replaced", "shot"])
def test_a_signal_between_the_renames_or_after_them_loses_nothing(
    moved: str, exporters: Any, take: Take, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Python raises it as soon as a rename returns."""
    take.export(tmp_path, to=("a",))
    before, rename, intruded = files(tmp_path), Path.rename, []

    def interrupted(self: Path, target: Path) -> Path:
        renamed = rename(self, target)
        if Path(target).name.endswith(moved) and not intruded:
            intruded.append(target)
            raise KeyboardInterrupt
        return renamed

    monkeypatch.setattr(Path, "rename", interrupted)
    with pytest.raises(KeyboardInterrupt):
        take.export(tmp_path, to=("b",))
    assert intruded and files(tmp_path) == (before if moved == ".replaced" else A | B | REPORT)


def test_a_crash_between_the_renames_loses_nothing(exporters: dict[str, Exporter], take: Take, tmp_path: Path) -> None:
    """As after a power cut: the old delivery was moved aside, and even a failing export restores it."""
    take.export(tmp_path, to=("a",))
    before = files(tmp_path)
    (tmp_path / "shot").rename(tmp_path / f".shot.{owner()}.replaced")
    exporters["bad"] = failing(ExportError("no"))
    with pytest.raises(ExportError):
        take.export(tmp_path, to=("bad",))
    assert files(tmp_path) == before


@contextmanager
def unprivileged() -> Iterator[None]:
    """Run without root's rights, to which nothing is read-only."""
    user = os.geteuid()
    os.seteuid(NOBODY if user == 0 else user)
    try:
        yield
    finally:
        os.seteuid(user)


def test_an_unwritable_folder(exporters: Any, take: Take) -> None:
    with TemporaryDirectory() as place:  # not below pytest's folder, which is closed to all others
        Path(place).chmod(0o555)
        with unprivileged(), pytest.raises(ExportError, match="could not be written"):
            take.export(Path(place), to=("a",))
        assert not os.listdir(place)


def test_exporters_that_need_each_other(exporters: dict[str, Exporter], take: Take, tmp_path: Path) -> None:
    exporters["x"], exporters["y"] = text("x", "x.txt", needs=("y",)), text("y", "y.txt", needs=("x",))
    with pytest.raises(ExportError, match="x -> y -> x"):
        take.export(tmp_path, to=("x",))
