"""Atomic folders: write files into a hidden folder, then rename it into place.

Readers see either the old delivery or the new one, complete. This module knows files, not motion.
"""

from __future__ import annotations

import errno
import os
import re
import shutil
import time
import warnings
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path

from vehsim.delivery.earlier import SIGN, Earlier, Keep
from vehsim.errors import ExportError, InputError
from vehsim.runtime.files import machine, owner


def _in_target(error: OSError, beside: Path, target: Path) -> Path:
    """The file or folder of an error while writing to ``beside``, as a path in the target."""
    if not isinstance(error.filename, str | os.PathLike):
        return target
    path = Path(error.filename)
    return target / path.relative_to(beside) if path.is_relative_to(beside) else path


@contextmanager
def staging(target: Path) -> Iterator[Path]:
    """A hidden folder beside ``target``, on the same file system, deleted when the block ends. Raises
    ``ExportError``."""
    made = [folder for folder in (target.parent, *target.parent.parents) if not os.path.exists(folder)]
    beside = target.with_name(f".{target.name}.{owner()}.partial")
    try:
        _make(beside)
        yield beside
    except OSError as error:
        message = f"could not be written: {error.strerror or error}"
        raise ExportError(message, "fix that and export again", file=_in_target(error, beside, target)) from error
    finally:
        shutil.rmtree(beside, ignore_errors=True)
        with suppress(OSError):  # it is not empty, perhaps because of another export
            for folder in made:
                folder.rmdir()


def _make(folder: Path) -> None:
    for _ in range(10):  # another export that failed may be deleting the parent folders
        with suppress(FileNotFoundError):
            return folder.mkdir(parents=True)
    folder.mkdir(parents=True)


@contextmanager
def replacing(target: Path, overwrite: bool = True, keep: Mapping[str, Keep] | None = None) -> Iterator[Path]:
    """A hidden folder beside ``target`` that replaces it when the block ends without an error.

    An earlier delivery is replaced as a whole; a folder that is not a delivery is never touched. ``keep``: files that
    only the earlier delivery has stay (`Earlier`); if they show another motion, they are set apart with a warning.
    Raises ``InputError`` for a folder that must not be replaced, and ``ExportError`` if it cannot be written.
    """
    may_replace(target, overwrite)
    with staging(target) as beside:
        _bring_back(target)
        yield beside
        earlier = Earlier(beside, keep) if keep is not None else None
        _swap(beside, target, overwrite, earlier)
        _sync(target.parent)
    if earlier is not None and earlier.apart is not None:
        place, names = earlier.apart
        again = f"; export {', '.join(names)} again" if names else ""
        what = f"{', '.join(names) or 'files'} show an older version of the shot: moved to {target / place}"
        warnings.warn(f"{target}: {what}{again}", stacklevel=2)


VERSION = re.compile(r"v(\d{3,})")
"""The name of a version's folder."""


def versions(home: Path) -> list[Path]:
    """The versions in ``home``, oldest first."""
    found = [home / name for name in _names(home) if VERSION.fullmatch(name)]
    return sorted((path for path in found if path.is_dir()), key=lambda path: int(path.name[1:]))


def newest(target: Path) -> Path:
    """The folder of the last delivery: ``target`` itself, or the newest version in it."""
    return [target, *versions(target)][-1]


@contextmanager
def new_version(home: Path) -> Iterator[Path]:
    """A hidden folder in ``home`` that becomes its next version, ``v001``, ``v002``, ..., when the block ends without
    an error.

    No version is ever overwritten, even by exports at the same time. Raises ``InputError`` if ``home`` contains other
    files, ``ExportError`` if it cannot be written.
    """
    may_hold_versions(home)
    with staging(home / "version") as beside:
        yield beside
        settle(beside)
        for _ in range(1000):
            target = home / f"v{1 + max((int(path.name[1:]) for path in versions(home)), default=0):03d}"
            with suppress(FileExistsError):
                target.mkdir()  # reserves the number; a rename onto an empty folder then replaces it
                beside.rename(target)
                _sync(home)
                return
    raise ExportError("other exports keep taking the next version", "let one of them finish", file=home)


def may_hold_versions(home: Path) -> None:
    """Raise ``InputError`` if ``home`` is a delivery without versions, or a foreign folder."""
    others = [name for name in _names(home) if not name.startswith(".version.")]
    if os.path.isfile(home) or (others and "latest.usda" not in others and not versions(home)):
        raise InputError("contains other files than versions", "export elsewhere, or move it away", file=home)


def may_replace(target: Path, overwrite: bool = True) -> None:
    """Raise ``InputError`` if ``target`` exists and must not be replaced."""
    if not os.path.exists(target):
        return
    if not overwrite:
        raise InputError("exists", "remove it, or export elsewhere", file=target)
    if versions(target):
        raise InputError(
            "contains versions, which are never removed",
            "export with export.versions = true, or elsewhere",
            file=target,
        )
    for pause in (0.0, 0.02, 0.1):  # check again: another export may be replacing it
        time.sleep(pause)
        if not _is_foreign(target):
            return
    raise InputError(
        f"exists and was not written by vehsim (no {SIGN})", "export elsewhere, or move it away", file=target
    )


LAYER = re.compile(r"[^.]+\.(anim|thinned|curves)(\.-?\d+|\.manifest)?\.usd[ac]")
"""The name of a vehicle's layer, which may be delivered alone."""


def _is_foreign(target: Path) -> bool:
    names = _names(target)
    is_file = os.path.exists(target) and not os.path.isdir(target)
    return is_file or (bool(names) and SIGN not in names and not _are_layers(target))


def _are_layers(target: Path) -> bool:
    """Whether ``target`` contains nothing but vehicles' layers, which `Take.export` can write alone, and copies of
    assets for them."""
    if not {*_names(target)} <= {"layers", "assets"}:
        return False
    names = _names(target / "layers")
    return bool(names) and all(LAYER.fullmatch(name) for name in names)


def _names(folder: Path) -> list[str]:
    """The names in a folder, read in one call, because another export may replace it between two; empty if it does not
    exist."""
    try:
        return os.listdir(folder)
    except (FileNotFoundError, NotADirectoryError):
        return []
    except PermissionError:
        raise InputError("no permission to read it", "export elsewhere, or fix its permissions", file=folder) from None


def settle(folder: Path) -> None:
    """Flush everything below ``folder`` to the disk, so that a renamed folder is complete even after a power
    cut."""
    for path in (*folder.rglob("*"), folder):
        _sync(path)


def _sync(path: Path) -> None:
    if os.name == "nt" and path.is_dir():  # Windows cannot open folders
        return
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    except OSError as error:
        if error.errno not in (errno.EINVAL, errno.ENOTSUP, errno.EBADF):  # file systems that cannot flush folders
            raise
    finally:
        os.close(descriptor)


def _swap(beside: Path, target: Path, overwrite: bool, earlier: Earlier | None) -> None:
    """Move ``beside`` to ``target``, without locks, while others may do the same.

    A rename onto a non-empty folder fails, so no delivery is lost: the old one is moved aside first. If the second
    rename fails, or a signal arrives in between, the first is undone.
    """
    aside = target.with_name(f".{target.name}.{owner()}.replaced")  # of all tries: no try leaves a folder of its own
    for _ in range(100):
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
            with suppress(OSError):  # nothing was moved, or another export was faster
                aside.rename(target)
            if os.path.exists(target):
                _discard(aside)
            meanwhile = isinstance(error, OSError) and error.errno in (errno.ENOTEMPTY, errno.EEXIST, errno.ENOENT)
            if meanwhile and beside.exists():
                continue
            raise
        _discard(aside)
        return
    raise ExportError("other exports keep replacing it", "let one of them finish, then export again", file=target)


def _discard(aside: Path) -> None:
    """Delete a replaced delivery, under a name that no other export restores."""
    discarded = aside.with_suffix(".partial")
    with suppress(OSError):  # it was never moved aside, or another export brought it back
        aside.rename(discarded)
    shutil.rmtree(discarded, ignore_errors=True)


def _bring_back(target: Path) -> None:
    """After a crash between the two renames, restore the old delivery from its other name."""
    if os.path.exists(target):
        return
    with suppress(OSError):  # another export was faster
        hidden = [path for path, _, _, kind in _hidden(target) if kind == "replaced"]
        for aside in sorted(hidden, key=lambda path: path.stat().st_mtime)[-1:]:
            aside.rename(target)


def clean_up(target: Path) -> None:
    """Delete the hidden folders of killed exports of ``target`` on this machine, and restore deliveries that they
    moved."""
    _bring_back(target)
    for path, host, pid, _ in _hidden(target):
        if host != machine() or _alive(int(pid)):  # processes of other machines may be alive
            continue
        if path.is_dir():
            shutil.rmtree(path, ignore_errors=True)
        else:
            path.unlink(missing_ok=True)


def _hidden(target: Path) -> list[tuple[Path, str, str, str]]:
    """The hidden folders of exports of ``target``: path, machine, process and kind."""
    pattern = re.compile(rf"\.{re.escape(target.name)}\.([0-9a-f]{{8}})-(\d+)-[0-9a-f]+\.(partial|replaced)")
    found = [(name, pattern.fullmatch(name)) for name in sorted(_names(target.parent)) if name[0] == "."]
    return [(target.parent / name, match[1], match[2], match[3]) for name, match in found if match]


def _alive(pid: int) -> bool:
    if os.name == "nt":  # a signal would end the process: leave the files of others
        return True
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
    killed = re.search(r"^(?:SigPnd|ShdPnd):\s*[0-9a-f]*[13579bdf][0-9a-f]{2}$", status, re.M)  # SIGKILL is pending
    return "\nVmSize:" in status and not killed  # without memory, it only waits until its parent notices


def drop_empty_folders(folder: Path) -> None:
    for path in sorted((path for path in folder.rglob("*") if path.is_dir()), reverse=True):
        if not any(path.iterdir()):
            path.rmdir()
