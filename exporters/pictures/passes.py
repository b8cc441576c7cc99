"""Passes in addition to a picture: for compositing, and for checks that are independent of light.

Depth is metres along the view as 32-bit TIFF, 0 for the background. Segmentation is a colour for each prim, computed
from its path, so that it does not change when other prims do; ``legend.json`` maps colours to prims. Flow and
normals are EXR (`motion_passes.py`). All have the picture's size, no anti-aliasing, and see through translucent
surfaces. This module writes and reads their files.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from vehsim.errors import InputError
from vehsim.intake.foreign import reading, refuse
from vehsim.intake.images import read_frame

SUFFIXES = {"depth": ".tif", "segmentation": ".png", "flow": ".exr", "normals": ".exr"}
"""Pass -> suffix of its files."""
LEGEND = "legend.json"


def picture_path(folder: Path, shot: str, camera: str, frame: int) -> Path:
    """The picture of a frame: its number has four digits after its sign, as OpenTimelineIO and FFmpeg name them."""
    return folder / camera / f"{shot}.{camera}.{'-' * (frame < 0)}{abs(frame):04d}.png"


def pass_path(picture: Path, kind: str) -> Path:
    """The file of a ``picture``'s pass: ``<camera>/depth/<shot>.<camera>.depth.1001.tif``."""
    name, _, frame = picture.stem.rpartition(".")
    return picture.parent / kind / f"{name}.{kind}.{frame}{SUFFIXES[kind]}"


def prim_colours(paths: Sequence[str]) -> NDArray[np.uint8]:
    """A unique colour (n, 3) for each prim path, never black."""
    taken: dict[bytes, str] = {bytes(3): ""}
    for path in paths:
        colour, salt = hashlib.sha256(path.encode()).digest()[:3], 0
        while taken.setdefault(colour, path) != path:
            salt += 1
            colour = hashlib.sha256(f"{path}#{salt}".encode()).digest()[:3]
    of_path = {path: colour for colour, path in taken.items()}
    return np.array([list(of_path[path]) for path in paths], np.uint8).reshape(-1, 3)


def write_legend(paths: Sequence[str], folder: Path) -> Path:
    """The legend: ``#rrggbb`` -> prim path."""
    colours = prim_colours(paths)
    legend = {f"#{bytes(colour).hex()}": path for colour, path in zip(colours, paths, strict=True)}
    target = folder / LEGEND
    target.write_text(json.dumps(dict(sorted(legend.items(), key=lambda item: item[1])), indent=1), encoding="utf-8")
    return target


def keep_legend(source: Path, target: Path) -> None:
    """Add the legend in the folder ``source`` to the one in ``target``, which may show prims of an earlier stage."""
    known = read_legend(target)
    legend = dict(sorted((known | read_legend(source)).items(), key=lambda item: item[1]))
    if legend != known:
        target.mkdir(parents=True, exist_ok=True)
        (target / LEGEND).write_text(json.dumps(legend, indent=1), encoding="utf-8")


def read_legend(folder: Path) -> dict[str, str]:
    """``#rrggbb`` -> prim path, of the segmentation in ``folder``; empty if there is none. Raises ``InputError``."""
    file = folder / LEGEND
    if not file.exists():
        return {}
    with reading(file, "legend", "render it again"):
        legend = json.loads(file.read_text(encoding="utf-8"))
    if not isinstance(legend, dict) or not all(isinstance(path, str) for path in legend.values()):
        raise refuse(file, "legend", "not a table of colours and prims", "render it again")
    return legend


def segmentation_of(path: Path, kind: str) -> Path:
    """The segmentation of a picture, or of its pass ``kind``."""
    if kind in SUFFIXES:  # <camera>/<kind>/<shot>.<camera>.<kind>.1001.tif
        path = path.parent.parent / path.name.replace(f".{kind}.", ".")
    return pass_path(path, "segmentation")


def read_depth(path: Path) -> NDArray[np.float32]:
    """Metres (h, w) along the view; 0: background. Raises ``InputError`` for a file that is not a depth pass."""
    depth = read_frame(path).astype(np.float32)
    if depth.ndim != 2:
        raise InputError(f"has {depth.shape[-1]} channels, depth has one", "give 32-bit metres", file=path)
    return depth
