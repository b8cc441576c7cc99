"""Actuators: how the controls of real machines follow what is commanded.

A control follows its command ``u`` with a first-order lag, within its largest rate: ``lag da/dt = u - a``. Everything
that moves a vehicle, its integrators and plans, knows the control ``a`` itself, the position of the actuator. In a plan
it is linear within a segment, so that the command follows from it, and lag and rate are linear constraints: no state is
added (`vehsim.planning.constraints.actuation`). A simulation gets commands, which `commands.py` turns into controls.
"""

from __future__ import annotations

import math
from dataclasses import dataclass


@dataclass(frozen=True)
class Actuator:
    """What moves a control: its largest ``rate``, in the control's unit per second, and the time constant of its
    ``lag``, s. The ``source`` of both. By default it follows its command at once."""

    rate: float = math.inf
    lag: float = 0.0
    source: str = ""

    @property
    def ideal(self) -> bool:
        """Whether it follows every command at once."""
        return not self.lag and math.isinf(self.rate)
