"""From commands to controls: what the actuators of a simulated vehicle do between its steps."""

from __future__ import annotations

import math
from collections.abc import Callable
from itertools import pairwise
from typing import Any

import numpy as np

from vehsim.vehicles.definition.actuator import Actuator
from vehsim.vehicles.definition.base import Array, Definition, State
from vehsim.vehicles.definition.states import control_vector


def respond(actuator: Actuator, position: float, before: float, after: float, step: float) -> float:
    """Position of an actuator after a ``step`` s, from ``position``, when its command changes linearly from ``before``
    to ``after``.

    The exact response of the lag, no farther than the largest rate allows: exact as long as the actuator is slower than
    its largest rate, or at it, throughout the step.
    """
    if actuator.ideal:
        return after
    way, behind = actuator.rate * step, actuator.lag * (after - before) / step
    decay = math.exp(-step / actuator.lag) if actuator.lag else 0.0
    wanted = after - behind + decay * (position - before + behind)
    return position + min(max(wanted - position, -way), way)


def follow(vehicle: Definition, commands: Array, step: float) -> Array:
    """Controls (n, c) that follow ``commands`` (n, c), every ``step`` s; at first, they are equal."""
    controls = np.array(commands, float)
    for k, control in enumerate(vehicle.controls):
        if not control.actuator.ideal:
            position, column = float(controls[0, k]), commands[:, k].tolist()
            for i, (before, after) in enumerate(pairwise(column), 1):
                position = controls[i, k] = respond(control.actuator, position, before, after, step)
    return controls


class Actuated:
    """A law of commands, ``law(t, state) -> (c,)``, followed by actuators: a law of controls.

    It is called once for every knot, in order; commands are linear between knots. At the first one, actuators are
    where their commands are. ``commands``: a row (c,) for every knot.
    """

    CARRIED = ("commands", "_controls", "_time")

    def __init__(self, vehicle: Definition, law: Callable[[float, State], Any]):
        self._vehicle, self._law = vehicle, law
        self.blind = bool(getattr(law, "blind", False))
        self.commands: list[Array] = []
        self._controls, self._time = np.zeros(0), 0.0

    def reset(self) -> None:
        self.commands = []
        if hasattr(self._law, "reset"):
            self._law.reset()

    def __call__(self, t: float, state: State) -> Array:
        command = control_vector(self._vehicle, self._law(t, state), f"controls(t = {t:.6g})")
        if not self.commands:
            self._controls = command
        else:
            moved = zip(self._vehicle.controls, self._controls, self.commands[-1], command, strict=True)
            step = t - self._time
            self._controls = np.array(
                [respond(c.actuator, float(a), float(u), float(v), step) for c, a, u, v in moved], float
            )
        self._time = t
        self.commands.append(command)
        return self._controls
