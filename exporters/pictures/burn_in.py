"""Text on pictures: captions at the bottom; shot, camera and frame burned in at the top."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

BAND, INK = (12, 14, 18), (240, 240, 236)


def captioned(picture: Any, text: str) -> Any:
    """``text`` in the middle of a darkened band along the picture's lower edge."""
    if text:
        size = max(11, picture.height // 26)
        _write(picture, picture.height - 2 * size, size, [(text, 0.5, "mm")])
    return picture


def burned_in(picture: Any, words: Sequence[str]) -> Any:
    """Three ``words`` (left, middle, right) in a darkened band along the picture's upper edge."""
    places = ((0.0, "lm"), (0.5, "mm"), (1.0, "rm"))
    size = max(11, picture.height // 32)
    _write(picture, 0, size, [(word, *place) for word, place in zip(words, places, strict=True)])
    return picture


def _write(picture: Any, top: int, size: int, words: Sequence[tuple[str, float, str]]) -> None:
    from PIL import Image, ImageDraw, ImageFont

    box = (0, top, picture.width, top + 2 * size)
    picture.paste(Image.blend(picture.crop(box), Image.new("RGB", (picture.width, 2 * size), BAND), 0.62), box[:2])
    for text, share, anchor in words:
        place = (size + round(share * (picture.width - 2 * size)), top + size)
        ImageDraw.Draw(picture).text(place, text, INK, ImageFont.load_default(size), anchor=anchor)
