"""Deliveries: exporters found through entry points, run in order, their files written beside and moved into place.

Whoever reads the folder sees the old delivery or the new one, whole. What belongs here knows files and exporters,
nothing of motion.
"""

from __future__ import annotations

import errno
import hashlib
import importlib.metadata
import os
import platform
import re
import secrets
import shutil
import time
import warnings
from collections.abc import Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager, suppress
from dataclasses import replace
from functools import cache
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

from vehsim._earlier import SIGN, Earlier
from vehsim.errors import ExportError, InputError

if TYPE_CHECKING:
    from vehsim.take import Exporter, Progress, Take

GROUP = "vehsim.exporters"
"""Entry points of this group are `Exporter` objects; a studio's package can add its own."""
REPORT_GROUP = "vehsim.reports"
"""Entry points of this group are functions ``(take, folder, files) -> Path`` that say what was delivered."""


@cache
def _installed() -> Any:
    """To look through all that is installed takes 20 ms, and it stays as it is."""
    return importlib.metadata.entry_points()


def entries(group: str) -> list[importlib.metadata.EntryPoint]:
    """The entry points of a group."""
    return list(_installed().select(group=group))


def exporter_names() -> list[str]:
    return sorted({entry.name for entry in entries(GROUP)})


def find_exporter(name: str) -> Exporter:
    """The exporter called ``name``. Raises ``InputError``."""
    for entry in entries(GROUP):
        if entry.name == name:
            exporter: Exporter = entry.load()
            return exporter
    raise InputError(f"to = {name!r}: no such exporter; choose from {', '.join(exporter_names())}")


def exporter_for(path: Path) -> Exporter:
    """The exporter that writes files with ``path``'s suffix. Raises ``InputError``."""
    for name in exporter_names():
        exporter = find_exporter(name)
        if path.suffix in exporter.suffixes:
            return exporter
    raise InputError(
        f"{path}: no exporter writes {path.suffix!r} files; name one with to=: {', '.join(exporter_names())}"
    )


def in_order(names: Sequence[str]) -> list[Exporter]:
    """The exporters called ``names``, each after those it needs. Raises ``InputError``."""
    ordered: dict[str, Exporter] = {}

    def add(name: str, on_the_way: tuple[str, ...]) -> None:
        if name in on_the_way:
            raise ExportError(f"exporters need each other in a circle: {' -> '.join((*on_the_way, name))}")
        exporter = find_exporter(name)
        for needed in exporter.needs:
            add(needed, (*on_the_way, name))
        ordered.setdefault(name, exporter)

    for name in names:
        add(name, ())
    return list(ordered.values())


def check_stage_is_there(names: Sequence[str], layer_only: bool) -> None:
    """Raise ``InputError`` when exporters need the shot's stage and only the layers are to be written."""
    for exporter in in_order(names) if layer_only else ():
        if exporter.needs:
            raise InputError(
                f"to = {exporter.name!r}: made from the shot's stage, which export.layer_only leaves out; leave out one"
            )


def write_files(
    take: Take,
    folder: Path,
    names: Sequence[str],
    progress: Progress,
    instead: Mapping[str, Exporter] = MappingProxyType({}),
) -> dict[str, list[Path]]:
    """Run the exporters in ``folder``: the files that each of ``names`` wrote; files merely needed are dropped.

    ``instead``: exporters to use in the place of those found, by name.
    """
    exporters = [instead.get(exporter.name, exporter) for exporter in in_order(names)]
    written: dict[str, list[Path]] = {}
    for i, exporter in enumerate(exporters):

        def report(what: str, done: float, before: int = i) -> None:
            progress(what, (before + min(max(done, 0.0), 1.0)) / len(exporters))

        written[exporter.name] = [Path(path) for path in exporter.write(take, folder, report)]
    asked = {name: sorted(set(written[name])) for name in names}
    for path in {path for paths in written.values() for path in paths} - {p for paths in asked.values() for p in paths}:
        path.unlink(missing_ok=True)
    _drop_empty_folders(folder)
    return asked


def write_reports(take: Take, folder: Path, written: Mapping[str, Sequence[Path]]) -> None:
    """What was delivered, by every entry point of the group; the first one writes ``report.json``.

    ``written``: the files of each exporter.
    """
    inputs = take.report.get("inputs")
    made = {
        name: {"inputs": inputs, "files": [path.relative_to(folder).as_posix() for path in paths]}
        for name, paths in written.items()
    }
    take = replace(take, report={**take.report, "content": take.content_hash, "exporters": made})
    files = sorted({path for paths in written.values() for path in paths})
    for entry in entries(REPORT_GROUP):
        entry.load()(take, folder, files)


@contextmanager
def staging(target: Path) -> Iterator[Path]:
    """A hidden folder beside ``target``, on its file system, gone when the block ends. Raises ``ExportError``."""
    made = [folder for folder in (target.parent, *target.parent.parents) if not os.path.exists(folder)]
    beside = target.with_name(f".{target.name}.{owner()}.partial")
    try:
        _make(beside)
        yield beside
    except OSError as error:
        text = str(error).replace(beside.name, target.name)
        raise ExportError(f"{target}: could not be written: {text}; mend that and export again") from error
    finally:
        shutil.rmtree(beside, ignore_errors=True)
        with suppress(OSError):  # there is something in it, perhaps of another export
            for folder in made:
                folder.rmdir()


def _make(folder: Path) -> None:
    for _ in range(10):  # another export that failed may just be dropping the folders above
        with suppress(FileNotFoundError):
            return folder.mkdir(parents=True)
    folder.mkdir(parents=True)


@contextmanager
def replacing(target: Path, overwrite: bool = True, keep: bool = False) -> Iterator[Path]:
    """A hidden folder beside ``target`` that takes its place when the block ends well.

    An earlier delivery is replaced whole; a folder that is none is never touched. ``keep``: what the earlier one holds
    and the new one does not stays (`Earlier`), with a warning where it shows something else and is set apart. Raises
    ``InputError`` for what must not be replaced, and ``ExportError`` for what cannot be written.
    """
    may_replace(target, overwrite)
    with staging(target) as beside:
        _bring_back(target)
        yield beside
        earlier = Earlier(beside) if keep else None
        _swap(beside, target, overwrite, earlier)
        _sync(target.parent)
    if earlier is not None and earlier.apart is not None:
        place, names = earlier.apart
        again = f"; export {', '.join(names)} again" if names else ""
        what = f"{', '.join(names) or 'files'} show the shot as it was: moved to {target / place}"
        warnings.warn(f"{target}: {what}{again}", stacklevel=2)


def delivering(take: Take, target: Path, overwrite: bool = True) -> AbstractContextManager[Path]:
    """A hidden folder that takes its place when the block ends well: `replacing` ``target``, or its `new_version`."""
    return new_version(target) if take.usd.versions else replacing(target, overwrite, keep=True)


VERSION = re.compile(r"v(\d{3,})")
"""What the folder of a version is called."""


def versions(home: Path) -> list[Path]:
    """The versions in ``home``, oldest first."""
    found = [home / name for name in _names(home) if VERSION.fullmatch(name)]
    return sorted((path for path in found if path.is_dir()), key=lambda path: int(path.name[1:]))


def newest(target: Path) -> Path:
    """Where the last delivery stands: ``target`` itself, or the newest version in it."""
    return [target, *versions(target)][-1]


@contextmanager
def new_version(home: Path) -> Iterator[Path]:
    """A hidden folder in ``home`` that becomes its next version, ``v001``, ``v002``, ..., when the block ends well.

    No version is ever overwritten, whoever else makes one at the same time. Raises ``InputError`` when ``home`` holds
    something else, ``ExportError`` for what cannot be written.
    """
    may_hold_versions(home)
    with staging(home / "version") as beside:
        yield beside
        settle(beside)
        for _ in range(1000):
            target = home / f"v{1 + max((int(path.name[1:]) for path in versions(home)), default=0):03d}"
            with suppress(FileExistsError):
                target.mkdir()  # claims the number; a rename onto an empty folder then replaces it
                beside.rename(target)
                _sync(home)
                return
    raise ExportError(f"{home}: other exports keep taking the next version; let one of them finish")


def may_hold_versions(home: Path) -> None:
    """Raise ``InputError`` when ``home`` is a delivery without versions, or somebody else's."""
    others = [name for name in _names(home) if not name.startswith(".version.")]
    if os.path.isfile(home) or (others and "latest.usda" not in others and not versions(home)):
        raise InputError(f"{home}: holds something else than versions; export elsewhere, or move it away")


def point_at_newest(home: Path, exporters: Sequence[Exporter]) -> Path:
    """Have every exporter point at the newest version in ``home``, which is returned."""
    last = newest(home)
    for exporter in exporters:
        if exporter.latest is not None:
            exporter.latest(last, home)
    return last


def may_replace(target: Path, overwrite: bool = True) -> None:
    """Raise ``InputError`` when something stands at ``target`` that a delivery must not replace."""
    if not os.path.exists(target):
        return
    if not overwrite:
        raise InputError(f"{target}: exists; remove it, or export elsewhere")
    if versions(target):
        raise InputError(f"{target}: holds versions, which stay; export with export.versions = true, or elsewhere")
    for pause in (0.0, 0.02, 0.1):  # asked again: another export may just be replacing it
        time.sleep(pause)
        if not _is_foreign(target):
            return
    raise InputError(f"{target}: exists and was not written by vehsim (no {SIGN}); export elsewhere, or move it away")


def _is_foreign(target: Path) -> bool:
    names = _names(target)
    is_file = os.path.exists(target) and not os.path.isdir(target)
    return is_file or (bool(names) and SIGN not in names)


def _names(folder: Path) -> list[str]:
    """What stands in a folder, in one look: between two, another export may replace it. Nothing where there is none."""
    try:
        return os.listdir(folder)
    except (FileNotFoundError, NotADirectoryError):
        return []
    except PermissionError:
        raise InputError(f"{folder}: may not be read; export elsewhere, or mend its permissions") from None


def settle(folder: Path) -> None:
    """Have everything below ``folder`` on the disk, so that a rename after it cannot outlive it in a power cut."""
    for path in (*folder.rglob("*"), folder):
        _sync(path)


def _sync(path: Path) -> None:
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    except OSError as error:
        if error.errno not in (errno.EINVAL, errno.ENOTSUP, errno.EBADF):  # file systems that cannot, and need not
            raise
    finally:
        os.close(descriptor)


def _swap(beside: Path, target: Path, overwrite: bool, earlier: Earlier | None) -> None:
    """Put ``beside`` in the place of ``target``; without locks, whoever else does the same at the same time.

    A rename onto a folder that is not empty fails, so nobody's delivery is lost: it is moved aside first. Should the
    second rename fail, or a signal come between, the first is undone.
    """
    for _ in range(100):
        aside = target.with_name(f".{target.name}.{owner()}.replaced")
        try:
            may_replace(target, overwrite)
            if earlier is not None:
                earlier.bring(target)
            settle(beside)
            if os.path.exists(target):
                target.rename(aside)
                if earlier is not None and not earlier.are_of(aside):
                    raise FileExistsError(errno.EEXIST, "another export delivered meanwhile")
            beside.rename(target)
        except BaseException as error:
            with suppress(OSError):  # nothing was moved, or another export was quicker
                aside.rename(target)
            if os.path.exists(target):
                shutil.rmtree(aside, ignore_errors=True)
            came_between = isinstance(error, OSError) and error.errno in (errno.ENOTEMPTY, errno.EEXIST, errno.ENOENT)
            if came_between and beside.exists():
                continue
            raise
        shutil.rmtree(aside, ignore_errors=True)
        return
    raise ExportError(f"{target}: other exports keep replacing it; let one of them finish, then export again")


def _bring_back(target: Path) -> None:
    """After a crash between the two renames the old delivery is still there under its other name."""
    if os.path.exists(target):
        return
    with suppress(OSError):  # another export was quicker
        hidden = [path for path, _, _, kind in _hidden(target) if kind == "replaced"]
        for aside in sorted(hidden, key=lambda path: path.stat().st_mtime)[-1:]:
            aside.rename(target)


def clean_up(target: Path) -> None:
    """Drop what exports of ``target`` that were killed on this machine left beside it, and bring back what they hid."""
    _bring_back(target)
    for path, machine, pid, _ in _hidden(target):
        if machine != _machine() or _alive(int(pid)):  # those of other machines may be alive
            continue
        if path.is_dir():
            shutil.rmtree(path, ignore_errors=True)
        else:
            path.unlink(missing_ok=True)


def _hidden(target: Path) -> list[tuple[Path, str, str, str]]:
    """What exports of ``target`` hide beside it: path, machine, process and kind."""
    pattern = re.compile(rf"\.{re.escape(target.name)}\.([0-9a-f]{{8}})-(\d+)-[0-9a-f]+\.(partial|replaced)")
    found = [(name, pattern.fullmatch(name)) for name in sorted(_names(target.parent)) if name[0] == "."]
    return [(target.parent / name, match[1], match[2], match[3]) for name, match in found if match]


def owner() -> str:
    """Names a hidden folder: no other process, of this or another machine, makes the same name."""
    return f"{_machine()}-{os.getpid()}-{secrets.token_hex(4)}"


@cache
def _machine() -> str:
    """This machine, and the space in which its process ids mean something."""
    space = Path("/proc/self/ns/pid")
    name = f"{platform.node()} {space.readlink() if space.is_symlink() else ''}"
    return hashlib.sha256(name.encode()).hexdigest()[:8]


def _alive(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    except PermissionError:
        return True
    try:
        status = Path(f"/proc/{pid}/status").read_text()
    except OSError:
        return True
    killed = re.search(r"^(?:SigPnd|ShdPnd):\s*[0-9a-f]*[13579bdf][0-9a-f]{2}$", status, re.M)  # SIGKILL waits for it
    return "\nVmSize:" in status and not killed  # without memory it is only waiting for its parent to notice


def _drop_empty_folders(folder: Path) -> None:
    for path in sorted((path for path in folder.rglob("*") if path.is_dir()), reverse=True):
        if not any(path.iterdir()):
            path.rmdir()
