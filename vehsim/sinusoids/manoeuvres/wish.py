"""What an animator can ask of the sinusoids, and the alternatives that a vehicle offers."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from vehsim.sinusoids.steering import Steering

Alternative = tuple[str, Callable[[], Steering]]
"""Label of a manoeuvre, and the function that makes it."""


@dataclass(frozen=True)
class Wish:
    """What an animator asks of the sinusoids; for what is None there are several alternatives.

    ``amplitude``: of the slow sinusoid, m driven to and fro, or rad the leg swings, its sign the side it begins on;
    ``cycles``: how often; ``phase``: rad, where it begins. ``limits``: input or state -> largest size, SI.
    """

    amplitude: float | None = None
    cycles: int | None = None
    phase: float | None = None
    limits: Mapping[str, float] = field(default_factory=dict)


def loops(amplitudes: Sequence[float], wish: Wish) -> Iterator[tuple[float, int, float, str]]:
    """Amplitude, cycles, phase and name of every member of a family of loops."""
    for a in amplitudes if wish.amplitude is None else (wish.amplitude,):
        for cycles in (1, 2, 4) if wish.cycles is None else (wish.cycles,):
            for phase in (0.0, np.pi / 2) if wish.phase is None else (wish.phase,):
                turns = f"{cycles} cycle{'s' * (cycles > 1)}"
                yield (
                    a,
                    cycles,
                    phase,
                    f"{turns}, {'ahead' if a > 0 else 'back'} first, phase {np.degrees(phase):.0f} deg",
                )
