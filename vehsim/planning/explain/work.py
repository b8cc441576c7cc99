"""Limits on the work of explaining a failed plan: counted, not timed, so that a slow machine gives the same message."""

from __future__ import annotations

WORK = 600_000
"""Iterations times variables of one solve: about 20 s of a core in 2025."""
FEWEST = 20
"""Minimum number of iterations, for a problem of any size."""


def affordable(size: int, most: int) -> int:
    """Iterations, up to ``most``, that a problem of ``size`` variables may take."""
    return min(most, max(WORK // size, FEWEST))
