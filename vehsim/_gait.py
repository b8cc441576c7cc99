"""The gait: a pilot that swings a vehicle's joints, as a rider twists hips and feet to drive a snakeboard.

What belongs here is open-loop rhythm with feedback on the joints alone; it knows nothing of where the vehicle goes.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.polynomial import Polynomial

from vehsim.errors import InputError
from vehsim.vehicles import State, Vehicle
from vehsim.vehicles._base import Array

_STIFFNESS = 15.0
"""Natural frequency of the feedback on every joint, rad/s, critically damped."""
_EASE = Polynomial([0.0, 0.0, 0.0, 10.0, -15.0, 6.0])
"""From 0 to 1 on [0, 1], at rest with no acceleration at both ends."""


class Gait:
    """Swings every joint as ``amplitude`` (s,) rad times ``sin(2 pi t / period + phase)``, ``phase`` (s,) rad.

    ``period`` s; it grows from rest over ``rise`` s and, with ``until`` s, dies away again over as long from then on.
    For vehicles with a torque on each joint; torques stay within the controls' bounds.
    """

    def __init__(
        self,
        vehicle: Vehicle,
        amplitude: Any,
        period: float,
        phase: Any = None,
        rise: float = 1.0,
        until: float | None = None,
    ):
        joints = len(vehicle.joints)
        if not joints or len(vehicle.dynamic) != joints or len(vehicle.controls) != joints:
            raise InputError(f"gait: {vehicle.name} has not one torque for each joint; choose another pilot")
        self.amplitude = _numbers("amplitude", amplitude, joints)
        self.phase = _numbers("phase", np.zeros(joints) if phase is None else phase, joints)
        self.period, self.rise = _time("period", period), _time("rise", rise)
        self.until = np.inf if until is None else _time("until", until)
        self._bounds = np.array([(control.lower, control.upper) for control in vehicle.controls])
        # at rest: linearize's last rows are the joints' accelerations
        _, push = vehicle.linearize(State(joints=np.zeros(joints)), np.zeros(joints))
        if np.linalg.matrix_rank(push[-joints:]) < joints:
            raise InputError(f"gait: {vehicle.name}: its controls do not move all its joints; choose another pilot")
        self._inertia = np.linalg.inv(push[-joints:])

    def reset(self) -> None:
        """A gait remembers nothing."""

    def __call__(self, t: float, state: State) -> Array:
        at, rate, change = self.swing(t)
        position = np.zeros_like(at) if state.joints is None else np.asarray(state.joints, float)
        velocity = np.zeros_like(at) if state.joint_rates is None else np.asarray(state.joint_rates, float)
        wanted = change + 2 * _STIFFNESS * (rate - velocity) + _STIFFNESS**2 * (at - position)
        return np.clip(self._inertia @ wanted, *self._bounds.T)

    def swing(self, t: float) -> tuple[Array, Array, Array]:
        """Joints (s,) wanted at ``t``, their rates and accelerations."""
        omega = 2 * np.pi / self.period
        angle = omega * t + self.phase
        wave = [np.sin(angle), omega * np.cos(angle), -(omega**2) * np.sin(angle)]
        grow, fade = self._eased(t), self._eased(t - self.until)
        share = [grow[0] * (1 - fade[0]), grow[1] * (1 - fade[0]) - grow[0] * fade[1]]
        share.append(grow[2] * (1 - fade[0]) - 2 * grow[1] * fade[1] - grow[0] * fade[2])
        return (
            self.amplitude * share[0] * wave[0],
            self.amplitude * (share[1] * wave[0] + share[0] * wave[1]),
            self.amplitude * (share[2] * wave[0] + 2 * share[1] * wave[1] + share[0] * wave[2]),
        )

    def _eased(self, t: float) -> tuple[float, float, float]:
        """The ease and its two derivatives, ``t`` s after it begins."""
        x = float(np.clip(t / self.rise, 0.0, 1.0))
        return tuple(float(_EASE.deriv(k)(x)) / self.rise**k for k in range(3))  # type: ignore[return-value]


def _numbers(key: str, values: Any, size: int) -> Array:
    try:
        array = np.asarray(values, float)
    except (TypeError, ValueError):
        array = np.full((), np.nan)
    if array.shape != (size,) or not np.isfinite(array).all():
        raise InputError(f"{key} = {values!r}: not one number per joint; give {size}, rad")
    return array


def _time(key: str, value: Any) -> float:
    (number,) = _numbers(key, [value], 1)
    if number <= 0:
        raise InputError(f"{key} = {value!r}: not a time; give a positive number, s")
    return float(number)
