"""What earlier exports delivered to a folder: kept beside the new files, or set apart where it shows something else.

``report.json`` holds what decides: what is shown (``solved.content``, `Take.content_hash`), and for each exporter the
files it wrote and the hash of its inputs (``solved.exporters``).
"""

from __future__ import annotations

import json
import os
import shutil
from contextlib import suppress
from pathlib import Path
from typing import Any

SIGN = "report.json"
"""The file by which a folder is known to be a delivery."""
APART = "earlier"
"""The folder in a delivery for files that show the shot as it was, by number."""


class Earlier:
    """The files of the delivery that ``beside``, a new one, is about to replace."""

    def __init__(self, beside: Path) -> None:
        self._beside = beside
        self._report = (beside / SIGN).read_bytes() if (beside / SIGN).is_file() else b""
        self._linked: list[Path] = []
        self._seen: Any = None
        self.apart: tuple[str, list[str]] | None = None
        """the folder of what was set apart, and the exporters that made it"""

    def bring(self, target: Path) -> None:
        """Link into the new delivery what ``target`` holds and it does not, and list it in its report.

        Files of an exporter that ran again are left out; files that show something else go to ``earlier/1``, ``2``, ...
        with their report. A second call begins anew. Raises ``OSError``, also when ``target`` is replaced meanwhile.
        """
        self._undo()
        self._seen = _identity(target)
        if self._seen is None:
            return
        old, new = _record(target / SIGN), _record(self._beside / SIGN)
        made, remade = old["solved"].get("exporters", {}), new["solved"].get("exporters", {})
        content = old["solved"].get("content")
        agrees = content is not None and content == new["solved"].get("content")
        again = {file for name in remade for file in made.get(name, {}).get("files", ())}
        rest = _files(target) - _files(self._beside) - again
        number = 1 + max((int(name) for name in _numbers(target / APART)), default=0)
        stale = {file for file in rest if (file in old["files"] or not made) and not file.startswith(f"{APART}/")}
        stale = set() if agrees else stale
        for file in sorted(rest):
            self._link(target / file, f"{APART}/{number}/{file}" if file in stale else file)
        if stale:
            self._link(target / SIGN, f"{APART}/{number}/{SIGN}")
            names = [name for name in made if stale & set(made[name]["files"])]
            self.apart = f"{APART}/{number}", names
        kept = {file: digest for file, digest in old["files"].items() if file in rest - stale}
        if kept:
            others = {name: one | {"files": [f for f in one["files"] if f in kept]} for name, one in made.items()}
            exporters = {name: one for name, one in others.items() if one["files"] and name not in remade}
            new["files"] |= kept
            for key in ("vehicles", "audit"):  # what the report says of a stage that stays
                _complete(new.get(key), old.get(key))
            new["solved"]["exporters"] = exporters | remade
            text = json.dumps(new, indent=1, sort_keys=True, allow_nan=False) + "\n"
            (self._beside / SIGN).write_text(text, encoding="utf-8")

    def are_of(self, folder: Path) -> bool:
        """Is ``folder`` the delivery whose files were brought along?"""
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
        if self._linked and self._report:
            (self._beside / SIGN).write_bytes(self._report)
        self._linked, self.apart = [], None


def _files(folder: Path) -> set[str]:
    """What stands below ``folder``, relative to it, but for its report."""
    found = (path for path in folder.rglob("*") if path.is_symlink() or not path.is_dir())
    return {path.relative_to(folder).as_posix() for path in found} - {SIGN}


def _record(path: Path) -> Any:
    """A report with at least the tables ``files`` and ``solved``, empty where it has none."""
    with suppress(ValueError, FileNotFoundError):
        report = json.loads(path.read_text(encoding="utf-8"))
        if isinstance(report, dict) and all(isinstance(report.get(key), dict) for key in ("files", "solved")):
            return report
    return {"files": {}, "solved": {}}


def _complete(new: Any, old: Any) -> None:
    """Add to tables, and to lists of tables, what ``old`` has and they lack, where they agree in what both have."""
    if isinstance(new, dict) and isinstance(old, dict):
        for key in new.keys() & old.keys():
            _complete(new[key], old[key])
        if all(new[key] == old[key] for key in new.keys() & old.keys()):
            new.update(old)
    elif isinstance(new, list) and isinstance(old, list) and len(new) == len(old):
        for one, other in zip(new, old, strict=True):
            _complete(one, other)


def _identity(folder: Path) -> Any:
    """What tells a delivery from the one that replaces it; None where there is none."""
    with suppress(FileNotFoundError, NotADirectoryError):
        stat = (folder / SIGN).stat()
        return stat.st_ino, stat.st_mtime_ns, stat.st_size
    return None


def _numbers(folder: Path) -> list[str]:
    with suppress(FileNotFoundError, NotADirectoryError):
        return [name for name in os.listdir(folder) if name.isdecimal()]
    return []
