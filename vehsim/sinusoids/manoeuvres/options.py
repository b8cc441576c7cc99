"""The user's options for steering by sinusoids, and the loops that they leave to choose from."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from vehsim.sinusoids.steering import Steering

Alternative = tuple[str, Callable[[], Steering]]
"""Label of a manoeuvre, and the function that makes it."""


@dataclass(frozen=True)
class SinusoidOptions:
    """The user's options for the sinusoids; an option that is None leaves several alternatives.

    ``amplitude`` of the slow sinusoid: m driven to and fro, or rad by which the leg swings; its sign is the initial
    direction. ``cycles``: the number of its periods; ``phase``: its start, rad. ``limits``: input or state -> largest
    absolute value, SI.
    """

    amplitude: float | None = None
    cycles: int | None = None
    phase: float | None = None
    limits: Mapping[str, float] = field(default_factory=dict)


def loops(amplitudes: Sequence[float], options: SinusoidOptions) -> Iterator[tuple[float, int, float, str]]:
    """Amplitude, cycles, phase and name of every member of a family of loops."""
    for a in amplitudes if options.amplitude is None else (options.amplitude,):
        for cycles in (1, 2, 4) if options.cycles is None else (options.cycles,):
            for phase in (0.0, np.pi / 2) if options.phase is None else (options.phase,):
                turns = f"{cycles} cycle{'s' * (cycles > 1)}"
                yield (
                    a,
                    cycles,
                    phase,
                    f"{turns}, {'ahead' if a > 0 else 'back'} first, phase {np.degrees(phase):.0f} deg",
                )
