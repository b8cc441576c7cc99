"""Collect the assets that a shot references below its folder, so that the folder is self-contained."""

from __future__ import annotations

import os
import shutil
import warnings
from pathlib import Path
from typing import TYPE_CHECKING

from vehsim.errors import ExportError, InputError
from vehsim.intake.usd import beyond, dependencies, references
from vehsim.runtime.cache import cache_folder

if TYPE_CHECKING:
    from vehsim.rig.rig import Rig


class Pack:
    """Copies assets to ``folder/assets/<name>/``, each source once, and records every file ``written``.

    ``keep``: vehicles' assets are not copied, but referenced by the path in their vehicle.toml. ``beyond``: files
    outside an asset's own folder that it refers to are copied with a warning instead of refused.
    """

    def __init__(self, folder: Path, keep: bool = False, beyond: bool = False) -> None:
        self.folder, self.keep, self.beyond = folder, keep, beyond
        self.written: list[Path] = []
        self._copies: dict[Path, Path] = {}

    def reference(self, rig: Rig, layer: Path) -> str:
        """The path by which ``layer`` references the asset of ``rig``.

        With ``keep``: the path in its vehicle.toml if this means the same everywhere, else the absolute path.
        """
        source = rig.source or rig.asset
        if not self.keep or source.is_relative_to(cache_folder()):  # a converted asset exists nowhere else
            homes = [] if rig.folder is None else [rig.folder]
            return self.relative(self.add(source, source.stem, *homes), layer)
        anchored = rig.folder is not None and (rig.folder / rig.named).is_file() and not Path(rig.named).is_absolute()
        return rig.named if rig.named and not anchored else source.resolve().as_posix()

    def add(self, source: Path, name: str, *homes: Path) -> Path:
        """Copy ``source`` and its dependencies in its own folder and in ``homes``; returns the copy. Warns of missing
        references. Raises ``InputError`` for dependencies elsewhere."""
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
            raise ExportError("asset not found", "restore the file or correct the vehicle's `asset` key", file=source)
        files, missing = dependencies(source)
        for path in missing:
            warnings.warn(
                f"{source}: refers to {path}, which does not exist; it is also missing in the copy", stacklevel=4
            )
        home = source.parent
        if found := beyond(files, home, *homes):
            message = f"refers to {', '.join(map(str, found))}, outside its own folder"
            if not self.beyond:
                raise InputError(message, 'put it there, or give export.outside = "copy"', file=source)
            warnings.warn(f"{source}: {message}: it is copied too", stacklevel=4)
        if all(file.is_relative_to(home) for file in files):
            for file in files:
                copy = target / file.relative_to(home)
                copy.parent.mkdir(parents=True, exist_ok=True)
                shutil.copyfile(file, copy)
                self.written.append(copy)
            if all(file.is_relative_to(target.resolve()) for file in references(target / source.name)[1]):
                return target / source.name
        return self._localize(source, target)

    def _localize(self, source: Path, target: Path) -> Path:
        """Let USD collect files that are elsewhere or have absolute paths; it rewrites the paths in the copies."""
        from pxr import UsdUtils

        shutil.rmtree(target, ignore_errors=True)
        self.written = [file for file in self.written if not file.is_relative_to(target)]
        if not UsdUtils.LocalizeAsset(str(source), str(target)):
            raise ExportError("its dependencies could not be collected", "see the messages of USD above", file=source)
        self.written.extend(sorted(file for file in target.rglob("*") if file.is_file()))
        return target / source.name
