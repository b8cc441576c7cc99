"""Seeds of random cases on the command line."""

from __future__ import annotations


def seeds_in(text: str) -> list[int]:
    """The seeds of a text such as "0-99", "7" or "3,5,8"."""
    seeds: list[int] = []
    for part in text.split(","):
        first, _, last = part.partition("-")
        seeds += range(int(first), int(last or first) + 1)
    return seeds
