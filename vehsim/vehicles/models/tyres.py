"""Tyre forces from standstill to sliding: Pacejka's magic formula with combined slip, smooth everywhere.

H. B. Pacejka, Tire and Vehicle Dynamics (2012), section 4.3 (PAC2002): pure slip by eq. 4.E9 and 4.E19, combined slip
by the cosine weights of eq. 4.E50 and 4.E58. Three things differ, so that the law holds at every speed and direction:

- A tyre is symmetric (no shifts), as the left and right tyres of an axle are together.
- Slips are speeds over ``sqrt(v_x^2 + v_0^2)``. Below ``v_0`` the tyre acts as a damper; its force at rest is zero.
- Beyond 25 degrees, where weights were not fitted, they fall below zero; their smooth positive part is used, so that no
  force ever acts along its own slip.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated

import casadi as ca
from annotated_types import Interval, Len

from vehsim.vehicles.definition.base import Expr
from vehsim.vehicles.definition.quantities import Unit

Share = Annotated[float, Unit(""), Interval(ge=0, le=1)]
Four = Annotated[tuple[float, float, float, float], Len(4, 4), Unit("")]
LONGITUDINAL: Four = (1.6411, 1.1739, 0.46403, 22.303)
LATERAL: Four = (1.3507, 1.0489, -0.0074722, 21.92)
WEIGHTS_LONGITUDINAL: Four = (13.276, 13.778, 1.2568, 0.65225)
WEIGHTS_LATERAL: Four = (7.1433, 9.1916, 1.0719, -0.27572)
"""The tyre of CommonRoad (2020), table 7, from the ADAMS handbook; see `Tyre`."""
BRAKING = 1.0
"""Speed of a rim, m/s, below which its brake's torque fades, so that it is smooth at standstill: a handbrake of 8000
N m brakes wheels to 0.3 m/s."""
SPIN = 1e-3
"""Weight of the cost of spin in plans: on their long steps, a wheel's fast decay would alternate from knot to knot."""
ROUND = 0.05
"""Width over which a weight's positive part is rounded: it changes a weight of one by 0.0006."""


@dataclass(frozen=True)
class Tyre:
    """Coefficients of a tyre, per unit of its load.

    ``longitudinal``, ``lateral``: shape C, peak friction D, curvature E and slip stiffness K. ``weights_longitudinal``,
    ``weights_lateral``: B1, B2, C and E of combined slip. ``friction``: factor of the peak friction on this surface.
    ``low_speed``: v_0, m/s.
    """

    longitudinal: Sequence[float]
    lateral: Sequence[float]
    weights_longitudinal: Sequence[float]
    weights_lateral: Sequence[float]
    friction: float
    low_speed: float

    def slip(self, velocity: Expr, rim: Expr) -> tuple[Expr, Expr]:
        """Longitudinal slip and slip angle, rad, of a wheel whose hub moves at ``velocity`` (2,) m/s in the wheel's
        axes and whose rim turns at ``rim`` m/s."""
        pace = ca.sqrt(velocity[0] ** 2 + self.low_speed**2)
        return (rim - velocity[0]) / pace, ca.atan(velocity[1] / pace)

    def force(self, slip: Expr, angle: Expr) -> Expr:
        """Force over load (2,), forward and left in the wheel's axes."""
        along = _pure(slip, self.longitudinal, self.friction) * _weight(angle, slip, self.weights_longitudinal)
        aside = _pure(angle, self.lateral, self.friction) * _weight(slip, angle, self.weights_lateral)
        return ca.vertcat(along, -aside)

    @property
    def peak(self) -> float:
        """Greatest force over load in any direction."""
        return self.friction * max(self.longitudinal[1], self.lateral[1])


def _pure(slip: Expr, coefficients: Sequence[float], friction: float) -> Expr:
    shape, peak, curvature, stiffness = coefficients
    return friction * peak * ca.sin(shape * _bent(stiffness / (shape * friction * peak) * slip, curvature))


def _weight(other: Expr, own: Expr, coefficients: Sequence[float]) -> Expr:
    """The share of a pure force that remains with slip in the ``other`` direction."""
    narrow, widening, shape, curvature = coefficients
    steepness = narrow / ca.sqrt(1 + (widening * own) ** 2)
    cosine = ca.cos(shape * _bent(steepness * other, curvature))
    return (cosine + ca.sqrt(cosine**2 + ROUND**2)) / 2


def _bent(x: Expr, curvature: float) -> Expr:
    return ca.atan(x - curvature * (x - ca.atan(x)))


def brake(torque: Expr, rim: Expr) -> Expr:
    """The torque, N m, by which a brake opposes a rim that turns at ``rim`` m/s."""
    return -torque * rim / ca.sqrt(rim**2 + BRAKING**2)
