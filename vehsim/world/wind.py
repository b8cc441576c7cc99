"""Gusts: wind that changes with time, along and across its mean."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vehsim.errors import InputError
from vehsim.integrators.environment import Environment
from vehsim.vehicles.definition.base import State

Array = NDArray[np.float64]

COMPONENTS = 48


@dataclass(frozen=True)
class Gusts:
    """``strength``: standard deviation along the mean wind divided by its speed (0.1 over open sea, 0.2 over land; 0.75
    of that across it); ``period`` s, the time scale of the large gusts; ``seed``: the same seed gives the same gusts.

    A sum of waves with Kaimal's spectrum, ``S(f) ~ (1 + 1.5 f period)^(-5/3)``.
    """

    strength: float = 0.15
    period: float = 8.0
    seed: int = 0

    def __post_init__(self) -> None:
        if not (0 <= self.strength <= 1 and 0.1 <= self.period <= 1000):
            remedy = "give a strength from 0 to 1, and a period from 0.1 to 1000 s"
            raise InputError("out of bounds", remedy, key="world.gusts", value=(self.strength, self.period))

    @cached_property
    def _waves(self) -> tuple[Array, Array, Array]:
        """Frequencies (n,) rad/s, amplitudes (n,) of variance one, phases (2, n)."""
        random = np.random.default_rng(self.seed)
        edges = np.geomspace(0.05, 20, COMPONENTS + 1) / self.period
        f = edges[:-1] + random.uniform(0, 1, COMPONENTS) * np.diff(edges)
        variance = (1 + 1.5 * f * self.period) ** (-5 / 3) * np.diff(edges)
        return 2 * np.pi * f, np.sqrt(2 * variance / variance.sum()), random.uniform(0, 2 * np.pi, (2, COMPONENTS))

    def at(self, wind: Array, t: float) -> Array:
        """The wind (3,) m/s at ``t`` s with the mean ``wind`` (3,)."""
        omega, amplitude, phases = self._waves
        along, across = self.strength * (np.cos(omega * t + phases) @ amplitude)
        return np.asarray((1 + along) * wind + 0.75 * across * np.array([-wind[1], wind[0], 0.0]))


class Gusty(Environment):
    """The force of gusts on one body, in addition to that of the mean wind: a difference of the vehicle's own force
    law."""

    def __init__(self, vehicle: Any, wind: Array, gusts: Gusts):
        import casadi as ca

        from vehsim.vehicles.definition.states import internal

        self.vehicle, self.mean, self.gusts, self._internal = vehicle, wind, gusts, internal
        sizes = (vehicle.group.size, 0, 0, vehicle.group.dim, len(vehicle.controls), 3)
        symbols = [ca.SX.sym(name, n) for name, n in zip(("g", "r", "u", "xi", "c", "wind"), sizes, strict=True)]
        g = symbols[0]
        on_group = ca.densify(vehicle.force(*symbols)[1])
        # a covector on the group is a body wrench, through the velocities that it is paired with
        v = ca.SX.sym("v", vehicle.group.dim)
        body = ca.jacobian(vehicle.group.velocity_from_body(g, v), v).T @ on_group
        self._force = ca.Function("force", symbols, [ca.densify(body)])

    def wrench(self, t: float, state: State, controls: Array) -> Array:
        g, r, u, xi = self._internal(self.vehicle, state)
        now, mean = (self._force(g, r, u, xi, controls, w) for w in (self.gusts.at(self.mean, t), self.mean))
        return np.ravel(np.asarray(now) - np.asarray(mean))
