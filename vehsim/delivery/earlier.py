"""Files of earlier deliveries: keep them beside the new files, or set them apart if they show another motion.

The decision follows from ``report.json``: what is shown (``solved.content``, `Take.content_hash`), and for each
exporter the files it wrote and the hash of its inputs (``solved.exporters``). Vehicles that an export left out
(``solved.left_out``, ``--only``) stay as they were delivered.
"""

from __future__ import annotations

import hashlib
import json
import os
import shutil
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from types import MappingProxyType
from typing import Any

Keep = Callable[[Path, Path, Sequence[str]], Mapping[Path, bytes]]
"""``keep(earlier, new, vehicles)``: files of the new delivery, with the content that also shows the kept vehicles."""

SIGN = "report.json"
"""The file that identifies a folder as a delivery."""
APART = "earlier"
"""The folder in a delivery for files that show an older version of the shot, by number."""


class Earlier:
    """The files of the delivery that ``beside``, a new one, is about to replace.

    ``keepers``: exporter -> its `Exporter.keep`.
    """

    def __init__(self, beside: Path, keepers: Mapping[str, Keep] = MappingProxyType({})) -> None:
        self._beside, self._keepers = beside, keepers
        self._changed: dict[Path, bytes] = {}
        self._report = (beside / SIGN).read_bytes() if (beside / SIGN).is_file() else b""
        self._linked: list[Path] = []
        self._seen: Any = None
        self.apart: tuple[str, list[str]] | None = None
        """the folder with the files that were set apart, and the exporters that wrote them"""

    def bring(self, target: Path) -> None:
        """Link files of ``target`` that the new delivery lacks into it, and list them in its report.

        Files of an exporter that ran again are left out; files that show another motion go to ``earlier/1``, ``2``, ...
        with their report. Files of vehicles that the new delivery leaves out stay, also in the stage. A second call
        starts over. Raises ``OSError``, also when ``target`` is replaced meanwhile.
        """
        self._undo()
        self._seen = _identity(target)
        if self._seen is None:
            return
        old, new = record(target / SIGN), record(self._beside / SIGN)
        made, remade = old["solved"].get("exporters", {}), new["solved"].get("exporters", {})
        content = old["solved"].get("content")
        agrees = content is not None and content == new["solved"].get("content")
        left = _left_out(old, new)
        own = {file for file in old["files"] if _is_of(file, left)}
        again = {file for name in remade for file in made.get(name, {}).get("files", ())} - own
        rest = _files(target) - _files(self._beside) - again
        number = 1 + max((int(name) for name in _numbers(target / APART)), default=0)
        stale = {file for file in rest if (file in old["files"] or not made) and not file.startswith(f"{APART}/")}
        stale = set() if agrees else stale - own
        for file in sorted(rest):
            self._link(target / file, f"{APART}/{number}/{file}" if file in stale else file)
        if stale:
            self._link(target / SIGN, f"{APART}/{number}/{SIGN}")
            names = [name for name in made if stale & set(made[name]["files"])]
            self.apart = f"{APART}/{number}", names
        kept = {file: digest for file, digest in old["files"].items() if file in rest - stale}
        if kept:
            others = {name: one | {"files": [f for f in one["files"] if f in kept]} for name, one in made.items()}
            exporters = {name: one for name, one in others.items() if one["files"]}
            for name, one in remade.items():
                one["files"] = sorted({*one["files"], *exporters.get(name, {"files": ()})["files"]})
            new["files"] |= kept
            for key in ("vehicles", "audit"):  # keep the report's entries about a stage that stays
                _complete(new.get(key), old.get(key))
            new["solved"]["exporters"] = exporters | remade
            if left:
                self._keep_vehicles(left, target, old, new)
            text = json.dumps(new, indent=1, sort_keys=True, allow_nan=False) + "\n"
            (self._beside / SIGN).write_text(text, encoding="utf-8")

    def _keep_vehicles(self, left: set[str], target: Path, old: Any, new: Any) -> None:
        """Make the new files of exporters, and the report, also contain the vehicles that were left out."""
        for name in new["solved"]["exporters"].keys() & self._keepers.keys():
            for path, content in self._keepers[name](target, self._beside, sorted(left)).items():
                self._changed.setdefault(path, path.read_bytes())
                path.write_bytes(content)
                new["files"][path.relative_to(self._beside).as_posix()] = hashlib.sha256(content).hexdigest()
        for key in ("vehicles", "audit"):
            new.get(key, {}).update({name: old[key][name] for name in left if name in old.get(key, {})})
        new["frames"] = [min(old["frames"][0], new["frames"][0]), max(old["frames"][1], new["frames"][1])]

    def are_of(self, folder: Path) -> bool:
        """Whether ``folder`` is the delivery whose files were linked."""
        return _identity(folder) == self._seen

    def _link(self, source: Path, name: str) -> None:
        place = self._beside / name
        place.parent.mkdir(parents=True, exist_ok=True)
        self._linked.append(place)
        try:
            os.link(source, place, follow_symlinks=False)
        except FileNotFoundError:
            raise
        except OSError:  # a file system without links
            shutil.copy2(source, place, follow_symlinks=False)

    def _undo(self) -> None:
        for place in self._linked:
            place.unlink(missing_ok=True)
        for path, content in self._changed.items():
            path.write_bytes(content)
        if self._linked and self._report:
            (self._beside / SIGN).write_bytes(self._report)
        self._linked, self._changed, self.apart = [], {}, None


def _files(folder: Path) -> set[str]:
    """The files below ``folder``, relative to it, except its report."""
    found = (path for path in folder.rglob("*") if path.is_symlink() or not path.is_dir())
    return {path.relative_to(folder).as_posix() for path in found} - {SIGN}


def record(path: Path) -> Any:
    """A report with at least the tables ``files`` and ``solved``, which may be empty."""
    with suppress(ValueError, FileNotFoundError):
        report = json.loads(path.read_text(encoding="utf-8"))
        if isinstance(report, dict) and all(isinstance(report.get(key), dict) for key in ("files", "solved")):
            return report
    return {"files": {}, "solved": {}}


def _left_out(old: Any, new: Any) -> set[str]:
    """The vehicles of an earlier delivery that a new one leaves out and that still fit into it.

    They fit if world, frame rate, form of the stage, and the assets that both deliveries have are the same.
    """

    def setting(report: Any) -> Any:
        shot = report["solved"].get("shot", {})
        return report.get("fps"), shot.get("world"), shot.get("export")

    left = set(new["solved"].get("left_out", ())) & set(old.get("vehicles", ()))
    both = {file for file in old["files"].keys() & new["files"].keys() if file.startswith("assets/")}
    fits = setting(old) == setting(new) and all(old["files"][file] == new["files"][file] for file in both)
    return left if fits else set()


def _is_of(file: str, vehicles: set[str]) -> bool:
    """Whether a delivered file belongs to one of these vehicles, or is an asset, which any of them may need."""
    folder, _, name = file.rpartition("/")
    return bool(vehicles) and (
        folder.startswith("assets") or (folder in ("", "layers") and name.split(".")[0] in vehicles)
    )


def _complete(new: Any, old: Any) -> None:
    """Add to tables, and to lists of tables, the entries that only ``old`` has, if their common entries agree."""
    if isinstance(new, dict) and isinstance(old, dict):
        for key in new.keys() & old.keys():
            _complete(new[key], old[key])
        if all(new[key] == old[key] for key in new.keys() & old.keys()):
            new.update(old)
    elif isinstance(new, list) and isinstance(old, list) and len(new) == len(old):
        for one, other in zip(new, old, strict=True):
            _complete(one, other)


def _identity(folder: Path) -> Any:
    """A value that changes when a delivery is replaced; None if there is none."""
    with suppress(FileNotFoundError, NotADirectoryError):
        stat = (folder / SIGN).stat()
        return stat.st_ino, stat.st_mtime_ns, stat.st_size
    return None


def _numbers(folder: Path) -> list[str]:
    with suppress(FileNotFoundError, NotADirectoryError):
        return [name for name in os.listdir(folder) if name.isdecimal()]
    return []
