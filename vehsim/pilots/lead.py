"""A pilot who knows the machine: commands that lead the lag of its actuators."""

from __future__ import annotations

import numpy as np

from vehsim.vehicles import Vehicle
from vehsim.vehicles.definition.base import Array
from vehsim.vehicles.definition.commands import respond

_KNOTS = 1.5
"""Number of knots within which an actuator is to arrive; with one, commands would alternate."""


class Lead:
    """The commands, within the bounds of the controls, that bring actuators to the controls that a pilot wants.

    It follows the positions of the actuators itself. What is wanted faster than a largest rate, or than the bounds of
    the commands allow, comes late.
    """

    def __init__(self, vehicle: Vehicle):
        self._actuated, self._actuators = vehicle.actuated, [control.actuator for control in vehicle.controls]
        self._lower, self._upper = (
            np.array([getattr(control, end) for control in vehicle.controls]) for end in ("lower", "upper")
        )
        self._lag, self._rate = (
            np.array([getattr(actuator, name) for actuator in self._actuators]) for name in ("lag", "rate")
        )
        self.reset()

    def reset(self) -> None:
        """Forget where the actuators are: at the first call, they are where they are wanted."""
        self._time, self._position, self._command = 0.0, np.zeros(0), np.zeros(0)

    def __call__(self, t: float, wanted: Array) -> Array:
        """Commands (c,) at ``t`` s for ``wanted`` controls (c,)."""
        if not self._actuated:
            return wanted
        if not len(self._position) or t <= self._time:
            self._time, self._position, self._command = t, wanted, wanted
            return wanted
        step = t - self._time
        now = self._moved(self._command, step)
        rate = np.clip((wanted - now) / (_KNOTS * step), -self._rate, self._rate)
        command = np.clip(np.where(self._lag > 0, now + self._lag * rate, wanted), self._lower, self._upper)
        self._time, self._position, self._command = t, self._moved(command, step), command
        return command

    def _moved(self, command: Array, step: float) -> Array:
        """Positions (c,) after a step at whose end the command is ``command``."""
        rows = zip(self._actuators, self._position.tolist(), self._command.tolist(), command.tolist(), strict=True)
        return np.array([respond(actuator, a, u, v, step) for actuator, a, u, v in rows], float)
