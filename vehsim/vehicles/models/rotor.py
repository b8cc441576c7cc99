"""The aerodynamics of a rotor: induced velocity, power and in-plane drag from momentum and blade-element theory."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import casadi as ca

from vehsim.constants import AIR
from vehsim.vehicles.definition.base import Expr

STILL = 0.1
"""Induced velocity of an unloaded rotor, m/s, which keeps the induced velocity smooth without thrust."""
LIFT_SLOPE = 5.7
"""Lift over angle of attack of a blade's section, per rad: the usual value."""


@dataclass(frozen=True)
class Rotor:
    """A rotor of ``radius`` m that turns at ``speed`` rad/s, at sea level.

    ``solidity``: blade area over disc area; ``profile_drag``: mean drag coefficient of the blades; ``induced_factor``:
    induced power over that of momentum theory, because the inflow is not uniform and blades have tips.
    """

    radius: float
    speed: float
    solidity: float
    profile_drag: float
    induced_factor: float

    @property
    def area(self) -> float:
        """Area of the disc, m^2."""
        return math.pi * self.radius**2

    @property
    def tip_speed(self) -> float:
        """Speed of the blade tips in hover, m/s."""
        return self.radius * self.speed

    @property
    def profile_power(self) -> float:
        """Profile power in hover, W: ``rho A (Omega R)^3 sigma c_d / 8``."""
        return AIR * self.area * self.tip_speed**3 * self.solidity * self.profile_drag / 8

    @property
    def drag(self) -> float:
        """In-plane drag of the blades over the airspeed in the plane of the disc, N s/m: H-force
        ``rho A (Omega R)^2 sigma c_d mu / 4`` (Bramwell, Helicopter Dynamics, 3.3)."""
        return 2 * self.profile_power / max(self.tip_speed, 1e-9) ** 2

    def induced(self, thrust: Expr, along: Expr, across: Expr) -> Any:
        """Induced velocity, m/s: ``v sqrt(across + (along + v)^2) = thrust / (2 rho A)`` (Glauert).

        ``along``: velocity of the disc through the air in the direction of its thrust, m/s; ``across``: the square of
        that in its plane, m^2/s^2. One Newton step from the product of both closed forms, that of level flight and that
        of axial flight over hover. The relative error is at most 0.7 % for -0.5 to 1 times the hover's value along,
        4.5 % in fast descent at -1 times it. In descent it is the branch that continues hover; the vortex ring state
        has no model.
        """
        square = ca.sqrt((thrust / (2 * AIR * self.area)) ** 2 + STILL**4)  # of the hover's induced velocity
        half = across / 2
        v = ca.sqrt(square / (half + ca.sqrt(half**2 + square**2))) * (ca.sqrt(along**2 / 4 + square) - along / 2)
        through = along + v
        size = across + through**2
        return v - (v * size - square * ca.sqrt(size)) / (size + v * through)

    def cushion(self, height: Expr, across: Expr, induced: Expr) -> Any:
        """Induced velocity ``height`` m above the ground over that far from it, at the same thrust.

        In hover it is Hayden's fit to flight tests (1976), ``1 / (0.9926 + 0.0379 (2 R / z)^2)``, which ends at 4.5
        radii; closer than half a radius, it stays that of half a radius. With speed it fades as Cheeseman and Bennett
        (1955) say: ``across`` (m^2/s^2) over the square of the ``induced`` velocity far from the ground, m/s.
        """
        ratio = 2 * self.radius / ca.fmax(height, self.radius / 2)
        saved = ca.fmax(1 - 1 / (0.9926 + 0.0379 * ratio**2), 0)
        return 1 - saved / (1 + across / (induced**2 + STILL**2))

    def power(self, thrust: Expr, along: Expr, across: Expr, height: Expr = math.inf) -> Any:
        """Power at the shaft, W: induced, climb or parasite (``thrust`` times ``along``), and profile power.

        Profile power grows with ``1 + 4.65 mu^2`` (Stepniewski). Of that, 2 ``mu^2`` is the work of the H-force, which
        the thrust does as it leans against `drag`, so that it is in the second part.
        ``height`` m above the ground: there, the induced part is smaller.
        """
        free = self.induced(thrust, along, across)
        induced = self.induced_factor * free * self.cushion(height, across, free)
        return thrust * (induced + along) + self.profile_power * (1 + 2.65 * across / self.tip_speed**2)

    def coning(self, thrust: Expr, lock_number: float) -> Any:
        """Angle at which hinged blades stand above the plane of the disc in hover, rad.

        Their lift and centrifugal force balance at ``lock_number (theta / 8 - lambda / 6)``, where the thrust is
        ``C_T = (sigma a / 2) (theta / 3 - lambda / 2)`` and the inflow ``lambda = sqrt(C_T / 2)``, for blades of one
        pitch ``theta`` (Gessow and Myers, Aerodynamics of the Helicopter, 1952).
        """
        load = ca.fmax(thrust, 0) / (AIR * self.area * self.tip_speed**2)
        return lock_number * (0.75 * load / (self.solidity * LIFT_SLOPE) + ca.sqrt(load / 2) / 48)
