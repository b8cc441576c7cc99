"""Compare rendered pictures with references: a regression check for a studio's own pictures.

Files with equal bytes are equal. Otherwise visibly different pixels are counted; means over a picture cannot
distinguish a moved vehicle from one bit of noise. `RULES` defines a change for each pass: light may vary slightly,
outline and distance may not. If there is a segmentation, each prim is also checked separately, so that small or distant
prims cannot vanish or change colour unnoticed. `report.py` shows the changes.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass
from pathlib import Path
from posixpath import commonpath
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vehsim.errors import InputError
from vehsim.exporters.pictures.passes import SUFFIXES, read_depth, read_legend, segmentation_of
from vehsim.intake.images import read_frame

VISIBLE = 8
"""A pixel has changed if a channel differs by more than this, of 255: above the noise between OpenGL
implementations."""
NEARER, FARTHER = 2e-3, 2e-4
"""Depth has changed if it differs by more than this, m, and by more than this share: above the depth buffer's steps."""
ALLOWED = 5e-4
"""Share of a picture's pixels that may change."""
SEEN, MOSTLY = 12, 0.5
"""A prim with at least this many pixels has changed if more than this share of them has, however small it is in the
picture."""


@dataclass(frozen=True)
class Rule:
    """The definition of a change: how to ``read`` a file, where two (h, w, ...) ``differ`` (h, w), and the ``allowed``
    share."""

    read: Callable[[Path], NDArray[Any]]
    differ: Callable[[NDArray[Any], NDArray[Any]], NDArray[np.bool_]]
    allowed: float


@dataclass(frozen=True)
class Comparison:
    """A picture and its reference: ``changed`` is the share of pixels that differ visibly, 1 if sizes differ.

    ``kind``: the applied entry of `RULES`; ``reason``: why pixels could not be counted; ``prims``: those that changed
    for the most part, by path or colour in the segmentation; ``missing``: those that are only in the reference.
    """

    picture: Path
    reference: Path
    changed: float
    reason: str = ""
    kind: str = "colour"
    prims: tuple[str, ...] = ()
    missing: tuple[str, ...] = ()

    @property
    def allowed(self) -> float:
        """The share of pixels that may differ."""
        return RULES[self.kind].allowed

    def fails(self, allowed: float | None = None) -> bool:
        """Whether more pixels changed than allowed; ``allowed``: the share of colour pixels; default: the rule's.

        A larger ``allowed`` than the rule's disables the per-prim check for colour.
        """
        if allowed is None or self.kind != "colour":
            return self.changed > self.allowed or bool(self.prims)
        return self.changed > allowed or (bool(self.prims) and allowed <= self.allowed)

    def __str__(self) -> str:
        counted = f"{100 * self.changed:.3g} % of its pixels changed in {self.kind}"
        return f"{self.picture}: {self.reason or counted}{self.most}"

    @property
    def most(self) -> str:
        """Text for `prims`, to append to a message."""
        changed = [prim for prim in self.prims if not f"{prim}/".startswith(tuple(f"{path}/" for path in self.missing))]
        missing = (
            f"; {_first(self.missing)} {'is' if len(self.missing) == 1 else 'are'} missing" if self.missing else ""
        )
        return missing + (f"; most of {_first(changed)}" if changed else "")


def _first(names: Sequence[str]) -> str:
    return ", ".join(names[:3]) + (f" and {len(names) - 3} more" if len(names) > 3 else "")


def compare_pictures(picture: str | Path, reference: str | Path) -> Comparison:
    """Compare one picture with its reference. Raises ``InputError`` for a file that is not a picture."""
    picture, reference = Path(picture), Path(reference)
    kind = kind_of(reference)
    if not picture.is_file():
        return Comparison(picture, reference, 1.0, "was not rendered", kind)
    if not reference.is_file():
        return Comparison(picture, reference, 1.0, "has no reference", kind)
    if picture.read_bytes() == reference.read_bytes():
        return Comparison(picture, reference, 0.0, kind=kind)
    rule = RULES[kind]
    a, b = rule.read(picture), rule.read(reference)
    if a.shape != b.shape:
        size = f"is {a.shape[1]} x {a.shape[0]}, not {b.shape[1]} x {b.shape[0]}"
        return Comparison(picture, reference, 1.0, size, kind)
    changed = rule.differ(a, b)
    prims, missing = _mostly_changed(changed, picture, reference)
    return Comparison(picture, reference, float(changed.mean()), kind=kind, prims=prims, missing=missing)


def _mostly_changed(
    changed: NDArray[np.bool_], picture: Path, reference: Path
) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """The prims most of whose pixels ``changed`` (h, w), by the segmentations before and after; and those among them
    that are only in the reference, or the prim above them if nothing below it is left."""
    found: set[str] = set()
    seen: list[set[int]] = []
    sides = [segmentation_of(path, kind_of(path)) for path in (reference, picture)]
    after = read_legend(sides[1].parent)
    names = read_legend(sides[0].parent) | after  # a prim has the same colour in both
    for segmentation in sides:
        if not segmentation.is_file() or (pixels := _read(segmentation)).shape[:2] != changed.shape:
            continue
        code = pixels.astype(np.int64) @ (1 << 16, 1 << 8, 1)
        colours, which = np.unique(code, return_inverse=True)
        area, lost = np.bincount(which.ravel()), np.bincount(which.ravel(), weights=changed.ravel())
        hit = colours[(area >= SEEN) & (lost > MOSTLY * area) & (colours > 0)]
        found |= {names.get(f"#{colour:06x}", f"#{colour:06x}") for colour in hit.tolist()}
        seen.append({*colours.tolist()})
    gone = seen[0] - seen[1] if len(seen) == 2 else set()
    vanished = {names[f"#{colour:06x}"] for colour in gone if f"#{colour:06x}" in names} & found
    missing = {_lost_with(path, names.values(), after.values()) for path in vanished}
    return tuple(sorted(found)), tuple(sorted(missing))


def _lost_with(path: str, known: Collection[str], left: Collection[str]) -> str:
    """The prim that vanished with ``path``: above it and below the root, the highest with none of the prims that are
    ``left`` below it; not an empty carrier, but the prim that contains all that is ``known`` below the carrier."""
    steps = path.split("/")
    above = ("/".join(steps[:count]) for count in range(3, len(steps)))
    highest = next((prim for prim in above if not any(f"{other}/".startswith(f"{prim}/") for other in left)), path)
    return commonpath([other for other in (path, *known) if f"{other}/".startswith(f"{highest}/")])


def kind_of(path: Path) -> str:
    """The pass of a file, by its name."""
    return next(
        (kind for kind, suffix in SUFFIXES.items() if f".{kind}." in path.name and path.suffix == suffix), "colour"
    )


def changed_pixels(a: NDArray[np.uint8], b: NDArray[np.uint8]) -> NDArray[np.bool_]:
    """Where two pictures (h, w, 3) differ visibly, (h, w)."""
    return np.asarray(np.abs(a.astype(int) - b.astype(int)).max(axis=2) > VISIBLE)


def _other_prims(a: NDArray[np.uint8], b: NDArray[np.uint8]) -> NDArray[np.bool_]:
    return np.asarray((a != b).any(axis=2))


def _other_depths(a: NDArray[np.float32], b: NDArray[np.float32]) -> NDArray[np.bool_]:
    return np.asarray(np.abs(a - b) > np.maximum(NEARER, FARTHER * np.minimum(a, b)))


def compare_folders(renders: str | Path, references: str | Path) -> list[Comparison]:
    """Compare every picture below ``references`` with the one of the same relative path below ``renders``.

    Raises ``InputError`` if there are no references.
    """
    renders, references = Path(renders), Path(references)
    wanted = pictures_below(references)
    if not wanted:
        raise InputError("holds no .png", "give the folder of reference pictures", file=references)
    return [compare_pictures(renders / path, references / path) for path in wanted]


def pictures_below(folder: Path) -> list[Path]:
    """Pictures and depths below ``folder``, relative to it, except hidden ones."""
    found = (path for pattern in ("*.png", "*.tif") for path in folder.rglob(pattern)) if folder.is_dir() else ()
    paths = (path.relative_to(folder) for path in found)
    return sorted(path for path in paths if not any(part.startswith(".") for part in path.parts))


def write_difference(comparison: Comparison, path: str | Path) -> Path:
    """Picture, reference, and the changes in red on grey, side by side."""
    from PIL import Image

    a, b = views(comparison)[:2]
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(np.hstack([a, b, difference(comparison)])).save(path)
    return path


def views(comparison: Comparison) -> tuple[NDArray[np.uint8], NDArray[np.uint8]]:
    """Picture and reference as visible images (h, w, 3) of one size; black where one is missing."""
    read = RULES[comparison.kind].read
    found = [read(path) if path.is_file() else None for path in (comparison.picture, comparison.reference)]
    size = next(image.shape[:2] for image in reversed(found) if image is not None)
    farthest = max((float(image.max()) for image in found if image is not None), default=1.0)
    shown = []
    for image in found:
        if image is None or image.shape[:2] != size:
            image = np.zeros((*size, 3), np.uint8)
        elif image.ndim == 2:  # near is bright
            bright = np.where(image > 0, 255 * (1 - 0.9 * np.log1p(image) / np.log1p(farthest)), 0)
            image = np.repeat(bright.astype(np.uint8)[..., None], 3, axis=2)
        shown.append(image)
    return shown[0], shown[1]


def difference(comparison: Comparison) -> NDArray[np.uint8]:
    """The changes in red on the greyed reference (h, w, 3); all red if pixels could not be counted."""
    grey = np.repeat(views(comparison)[1].mean(axis=2, keepdims=True) / 2, 3, axis=2).astype(np.uint8)
    rule = RULES[comparison.kind]
    if comparison.reason:
        grey[..., 0] = 255
    else:
        grey[rule.differ(rule.read(comparison.picture), rule.read(comparison.reference))] = (255, 40, 40)
    return grey


def _read(path: Path) -> NDArray[np.uint8]:
    return read_frame(path, "RGB")


RULES: dict[str, Rule] = {
    "colour": Rule(_read, changed_pixels, ALLOWED),
    "segmentation": Rule(_read, _other_prims, ALLOWED / 5),
    "depth": Rule(read_depth, _other_depths, ALLOWED / 5),
}
"""Pass -> the definition of a change."""
