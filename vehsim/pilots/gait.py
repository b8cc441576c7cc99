"""The gait: a pilot that swings a vehicle's joints, as a rider twists hips and feet to drive a snakeboard.

It follows a rhythm, with feedback on the joints and the torques from the vehicle's equations; it does not control the
vehicle's path.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.polynomial import Polynomial

from vehsim.errors import InputError
from vehsim.pilots.lead import Lead
from vehsim.vehicles import State, Vehicle
from vehsim.vehicles.definition.base import Array
from vehsim.vehicles.definition.states import internal

_STIFFNESS = 15.0
"""Natural frequency of the feedback on every joint, rad/s, critically damped."""
_AMPLITUDE = 0.05
"""Relative tolerance of a joint's amplitude."""
_EASE = Polynomial([0.0, 0.0, 0.0, 0.0, 35.0, -84.0, 70.0, -20.0])
"""From 0 to 1 on [0, 1], with zero rate, acceleration and jerk at both ends: torques start without a rate."""


class Gait:
    """Swings every joint as ``amplitude`` (s,) rad times ``sin(2 pi t / period + phase)``, ``phase`` (s,) rad.

    ``period`` s; the amplitude grows from zero within ``rise`` s; with ``until`` s, it decreases to zero from then on
    in the same time. For vehicles with a torque on each joint; torques stay within the controls' bounds.
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
            raise InputError(f"{vehicle.name} does not have one torque per joint", "choose another pilot", key="gait")
        self.amplitude = _numbers("amplitude", amplitude, joints)
        self.phase = _numbers("phase", np.zeros(joints) if phase is None else phase, joints)
        self.period, self.rise = _time("period", period), _time("rise", rise)
        self.until = np.inf if until is None else _time("until", until)
        self._joints = vehicle.joints
        self._bounds = np.array([(control.lower, control.upper) for control in vehicle.controls])
        self._vehicle, self._accelerations = vehicle, _accelerations(vehicle)
        self._lead = Lead(vehicle)
        _, push = self._pushed(State(joints=np.zeros(joints)))
        if np.linalg.matrix_rank(push) < joints:
            raise InputError(
                f"the controls of {vehicle.name} do not move all its joints", "choose another pilot", key="gait"
            )
        self._inertia = np.linalg.inv(push)

    def reset(self) -> None:
        """Clear the memory of an earlier run; simulations call this at their start."""
        self._lead.reset()

    def __call__(self, t: float, state: State) -> Array:
        at, rate, change = self.swing(t)
        position = np.zeros_like(at) if state.joints is None else np.asarray(state.joints, float)
        velocity = np.zeros_like(at) if state.joint_rates is None else np.asarray(state.joint_rates, float)
        wanted = change + 2 * _STIFFNESS * (rate - velocity) + _STIFFNESS**2 * (at - position)
        free, push = self._pushed(state)
        return self._lead(t, np.clip(np.linalg.solve(push, wanted - free), *self._bounds.T))

    def _pushed(self, state: State) -> tuple[Array, Array]:
        """Accelerations (s,) of the joints without torques, and the effect of each torque (s, s)."""
        free, push = self._accelerations(*internal(self._vehicle, state))
        return np.asarray(free).ravel(), np.asarray(push)

    def targets(self, duration: float) -> list[dict[str, Any]]:
        """The amplitude of every joint within 5 %, over whole periods between rise and fall; no target in a shorter
        time."""
        begin, end = self.rise, min(duration, self.until)
        if end - begin < self.period:
            return []
        # the greatest torque for the joints' own inertia; it is inversely proportional to the square of the period
        peak = np.abs(self._inertia) @ np.abs(self.amplitude) * (2 * np.pi / self.period) ** 2
        room = np.min(np.abs(self._bounds), axis=1)
        slower = self.period * max(1.0, 1.1 * float(np.sqrt(np.max(peak / room))))
        limits = [self._vehicle.joint_limits.get(name, (-np.inf, np.inf)) for name in self._joints]
        beyond = any(abs(a) > min(-lower, upper) for a, (lower, upper) in zip(self.amplitude, limits, strict=True))
        needs = {} if slower <= self.period or beyond else {"needs_period": slower}
        return [
            {
                "key": "pilot.amplitude",
                "kind": "amplitude",
                "joint": joint,
                "amplitude": abs(float(amplitude)),
                "tolerance": _AMPLITUDE,
                "from": float(begin),
                "until": float(end),
                **needs,
            }
            for joint, amplitude in zip(self._joints, self.amplitude, strict=True)
            if amplitude
        ]

    def swing(self, t: float) -> tuple[Array, Array, Array]:
        """Desired joints (s,) at ``t``, their rates and accelerations."""
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
        """The ease and its two derivatives, ``t`` s after its start."""
        x = float(np.clip(t / self.rise, 0.0, 1.0))
        return tuple(float(_EASE.deriv(k)(x)) / self.rise**k for k in range(3))  # type: ignore[return-value]  # three, by the range


def _accelerations(vehicle: Vehicle) -> Any:
    """``(g, r, u, xi) -> (s,), (s, s)``: the joints' accelerations, which are affine in the torques."""
    import casadi as ca

    from vehsim.vehicles.definition.mechanics import acceleration, coefficients

    s = len(vehicle.joints)
    sizes = {"g": len(vehicle.group.identity), "r": s, "u": s, "xi": vehicle.group.dim, "c": s}
    g, r, u, xi, c = (ca.SX.sym(name, size) for name, size in sizes.items())
    z = coefficients(vehicle, r, u, xi)
    law = acceleration(vehicle, g, r, z, c, ca.SX.zeros(s), ca.SX.zeros(3))[-s:]
    push = ca.densify(ca.jacobian(law, c))
    free = ca.densify(ca.substitute(law, c, ca.SX.zeros(s)))
    return ca.Function("accelerations", [g, r, u, xi], [free, push])


def _numbers(key: str, values: Any, size: int) -> Array:
    try:
        array = np.asarray(values, float)
    except (TypeError, ValueError):
        array = np.full((), np.nan)
    if array.shape != (size,) or not np.isfinite(array).all():
        raise InputError("not one number per joint", f"give {size}, rad", key=key, value=values)
    return array


def _time(key: str, value: Any) -> float:
    (number,) = _numbers(key, [value], 1)
    if number <= 0:
        raise InputError("not a time", "give a positive number, s", key=key, value=value)
    return float(number)
