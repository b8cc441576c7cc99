"""How much work explaining a failed plan may take: counted, not timed, so that no machine's load changes the words."""

from __future__ import annotations

WORK = 600_000
"""Iterations times variables of one solve: about 20 s of a core in 2025."""
FEWEST = 20
"""Iterations that a problem of any size gets."""


def affordable(size: int, most: int) -> int:
    """Iterations, up to ``most``, that a problem of ``size`` variables may take."""
    return min(most, max(WORK // size, FEWEST))
