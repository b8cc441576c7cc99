"""Rendered pictures held against references: the regression check of a studio's own pictures.

Means over a picture cannot tell a moved vehicle from one bit of noise; counting pixels that changed visibly can.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from vehsim.errors import InputError

VISIBLE = 8
"""A pixel has changed when a channel differs by more than this, of 255: above the noise of another OpenGL."""


@dataclass(frozen=True)
class Comparison:
    """A picture and its reference: ``changed`` is the share of pixels that differ visibly, 1 when sizes differ."""

    picture: Path
    reference: Path
    changed: float
    reason: str = ""


def compare_pictures(picture: str | Path, reference: str | Path) -> Comparison:
    """Hold one picture against its reference. Raises ``InputError`` for a file that is no picture."""
    picture, reference = Path(picture), Path(reference)
    if not picture.is_file():
        return Comparison(picture, reference, 1.0, "was not rendered")
    a, b = _read(picture), _read(reference)
    if a.shape != b.shape:
        return Comparison(picture, reference, 1.0, f"is {a.shape[1]} x {a.shape[0]}, not {b.shape[1]} x {b.shape[0]}")
    return Comparison(picture, reference, float(changed_pixels(a, b).mean()))


def changed_pixels(a: NDArray[np.uint8], b: NDArray[np.uint8]) -> NDArray[np.bool_]:
    """Where two pictures (h, w, 3) differ visibly, (h, w)."""
    return np.asarray(np.abs(a.astype(int) - b.astype(int)).max(axis=2) > VISIBLE)


def compare_folders(renders: str | Path, references: str | Path) -> list[Comparison]:
    """Every PNG below ``references`` against the one of the same relative path below ``renders``.

    Raises ``InputError`` when there is nothing to compare with.
    """
    renders, references = Path(renders), Path(references)
    wanted = sorted(references.rglob("*.png")) if references.is_dir() else []
    if not wanted:
        raise InputError(f"{references}: holds no .png; give the folder of reference pictures")
    return [compare_pictures(renders / path.relative_to(references), path) for path in wanted]


def write_difference(comparison: Comparison, path: str | Path) -> Path:
    """Picture, reference, and what changed in red on grey, side by side."""
    from PIL import Image

    a, b = _read(comparison.picture), _read(comparison.reference)
    if a.shape != b.shape:
        a = np.zeros_like(b)
    grey = np.repeat(b.mean(axis=2, keepdims=True) / 2, 3, axis=2).astype(np.uint8)
    grey[changed_pixels(a, b)] = (255, 40, 40)
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(np.hstack([a, b, grey])).save(path)
    return path


def _read(path: Path) -> NDArray[np.uint8]:
    from PIL import Image

    try:
        with Image.open(path) as image:
            return np.asarray(image.convert("RGB"))
    except OSError as error:
        raise InputError(f"{path}: not a picture that can be read ({error}); render it again") from None
