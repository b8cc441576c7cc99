"""Gathers the assets that a shot references below its folder, so that the folder travels."""

from __future__ import annotations

import os
import shutil
import warnings
from pathlib import Path
from typing import TYPE_CHECKING

from vehsim._cache import cache_folder
from vehsim.errors import ExportError, InputError
from vehsim.intake.usd import beyond, dependencies

if TYPE_CHECKING:
    from vehsim.vehicles._base import Rig


class Pack:
    """Copies assets to ``folder/assets/<name>/``, each source once, and remembers every file ``written``.

    ``keep``: vehicles' assets stay where they are, and are referenced by the path their vehicle.toml gives.
    ``beyond``: what assets refer to outside their own folders is copied along with a warning, and not refused.
    """

    def __init__(self, folder: Path, keep: bool = False, beyond: bool = False) -> None:
        self.folder, self.keep, self.beyond = folder, keep, beyond
        self.written: list[Path] = []
        self._copies: dict[Path, Path] = {}

    def reference(self, rig: Rig, layer: Path) -> str:
        """The path by which ``layer`` references the asset of ``rig``.

        Kept: as its vehicle.toml names it, when that means the same anywhere, and else in full.
        """
        source = rig.source or rig.asset
        if not self.keep or source.is_relative_to(cache_folder()):  # what was converted exists nowhere else
            homes = [] if rig.folder is None else [rig.folder]
            return self.relative(self.add(source, source.stem, *homes), layer)
        anchored = rig.folder is not None and (rig.folder / rig.named).is_file() and not Path(rig.named).is_absolute()
        return rig.named if rig.named and not anchored else source.resolve().as_posix()

    def add(self, source: Path, name: str, *homes: Path) -> Path:
        """Copy ``source`` and all it depends on in its own folder and in ``homes``; returns the copy. Warns of what it
        refers to and cannot be found. Raises ``InputError`` for what lies elsewhere."""
        source = Path(source).resolve()
        if source not in self._copies:
            taken = {copy.parent for copy in self._copies.values()}
            target = self.folder / "assets" / name
            while target in taken:
                target = target.with_name(f"{target.name}_")
            self._copies[source] = self._copy(source, target, homes)
        return self._copies[source]

    @staticmethod
    def relative(path: Path, anchor: Path) -> str:
        """``path`` as an asset path relative to the layer ``anchor``."""
        relative = Path(os.path.relpath(path, anchor.parent)).as_posix()
        return relative if relative.startswith(".") else f"./{relative}"

    def _copy(self, source: Path, target: Path, homes: tuple[Path, ...]) -> Path:
        if not source.is_file():
            raise ExportError(f"{source}: asset not found; give back the file or the vehicle's `asset` key")
        files, missing = dependencies(source)
        for path in missing:
            warnings.warn(f"{source}: refers to {path}, which does not exist; the copy will miss it too", stacklevel=4)
        home = source.parent
        if found := beyond(files, home, *homes):
            said = f"{source}: refers to {', '.join(map(str, found))}, outside its own folder"
            if not self.beyond:
                raise InputError(f'{said}; put it there, or give export.outside = "copy"')
            warnings.warn(f"{said}: copied along", stacklevel=4)
        if all(file.is_relative_to(home) for file in files):
            for file in files:
                copy = target / file.relative_to(home)
                copy.parent.mkdir(parents=True, exist_ok=True)
                shutil.copyfile(file, copy)
                self.written.append(copy)
            if all(file.is_relative_to(target.resolve()) for file in dependencies(target / source.name)[0]):
                return target / source.name
        return self._localize(source, target)

    def _localize(self, source: Path, target: Path) -> Path:
        """Let USD gather what lies elsewhere or is named by absolute path, rewriting the paths in the copies."""
        from pxr import UsdUtils

        shutil.rmtree(target, ignore_errors=True)
        self.written = [file for file in self.written if not file.is_relative_to(target)]
        if not UsdUtils.LocalizeAsset(str(source), str(target)):
            raise ExportError(f"{source}: its dependencies could not be gathered; see the messages of USD above")
        self.written.extend(sorted(file for file in target.rglob("*") if file.is_file()))
        return target / source.name
