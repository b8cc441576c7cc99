"""Contact sheets: twelve frames of a film on one page, with their numbers."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

COLUMNS, ROWS = 3, 4
THUMBNAIL = 480
GAP = 12
PAPER, INK = (24, 24, 26), (225, 222, 215)


def write_contact_sheet(pictures: Sequence[Path], path: Path) -> Path:
    """Write up to twelve of ``pictures``, including the first and the last, to ``path``, each with its file's
    number."""
    from PIL import Image

    picks = np.unique(np.linspace(0, len(pictures) - 1, COLUMNS * ROWS).round().astype(int))
    thumbnails = [_thumbnail(pictures[k]) for k in picks]
    width, height = (max(sides) for sides in zip(*(thumbnail.size for thumbnail in thumbnails), strict=True))
    caption = 26
    rows = -(-len(thumbnails) // COLUMNS)
    sheet = Image.new("RGB", (COLUMNS * (width + GAP) + GAP, rows * (height + caption + GAP) + GAP), PAPER)
    for k, (pick, thumbnail) in enumerate(zip(picks, thumbnails, strict=True)):
        x = GAP + k % COLUMNS * (width + GAP)
        y = GAP + k // COLUMNS * (height + caption + GAP)
        sheet.paste(thumbnail, (x, y))
        _write(sheet, (x + 2, y + height + 5), ".".join(pictures[pick].stem.split(".")[-2:]))
    sheet.save(path, compress_level=6)
    return path


def _thumbnail(path: Path) -> Any:
    from PIL import Image

    with Image.open(path) as image:
        width = min(THUMBNAIL, image.width)
        return image.convert("RGB").resize((width, max(1, round(width * image.height / image.width))))


def _write(sheet: Any, place: tuple[int, int], text: str) -> None:
    from PIL import ImageDraw, ImageFont

    ImageDraw.Draw(sheet).text(place, text, fill=INK, font=ImageFont.load_default(15))
