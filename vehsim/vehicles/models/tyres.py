"""Tyre forces from standstill to sliding: Pacejka's magic formula with combined slip, smooth everywhere.

H. B. Pacejka, Tire and Vehicle Dynamics (2012), section 4.3 (PAC2002): pure slip by eq. 4.E9 and 4.E19, combined slip
by the cosine weights of eq. 4.E50 and 4.E58. Three things differ, so that the law holds at every speed and direction:

- A tyre is symmetric (no shifts), as the left and right tyres of an axle are together.
- Slips are speeds over ``sqrt(v_x^2 + v_0^2)``. Below ``v_0`` the tyre acts as a damper, with `Tyre.standing` for rest.
- Beyond 25 degrees, where weights were not fitted, they fall below zero; their smooth positive part is used, so that no
  force ever acts along its own slip.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Annotated

import casadi as ca
from annotated_types import Interval, Len

from vehsim.constants import GRAVITY
from vehsim.errors import InputError
from vehsim.vehicles.definition.base import Control, Expr
from vehsim.vehicles.definition.quantities import Unit
from vehsim.vehicles.definition.surfaces import SURFACES, SurfaceName

Share = Annotated[float, Unit(""), Interval(ge=0, le=1)]
Two = Annotated[tuple[float, float], Len(2, 2), Unit("")]
Four = Annotated[tuple[float, float, float, float], Len(4, 4), Unit("")]
Five = Annotated[tuple[float, float, float, float, float], Len(5, 5), Unit("")]
LONGITUDINAL: Four = (1.6411, 1.1739, 0.46403, 22.303)
LATERAL: Four = (1.3507, 1.0489, -0.0074722, 21.92)
WEIGHTS_LONGITUDINAL: Four = (13.276, 13.778, 1.2568, 0.65225)
WEIGHTS_LATERAL: Four = (7.1433, 9.1916, 1.0719, -0.27572)
"""The tyre of CommonRoad (2020), table 7, from the ADAMS handbook; see `Tyre`."""
UPRIGHT: Five = (0.0, 0.0, 0.0, 0.0, 0.0)
"""A tyre that does not feel camber."""
STRAIGHT: Two = (0.0, 0.0)
"""A tyre that longitudinal slip does not push sideways."""
PUSHED = (12.12, 1.9, -10.704)
"""V4, V5 and V6 of the push by longitudinal slip, of the same tyre."""
CONTROLS = (
    Control("drive", unit="N m"),
    Control("brake", lower=0.0, unit="N m"),
    Control("handbrake", lower=0.0, unit="N m"),
    Control("steering_rate", unit="1/s"),
)
"""The controls of a car whose tyres slip."""
SLIPS = ("1", "rad")
"""Units of longitudinal slip and slip angle."""
LEAST = 1e-4
"""Force over weight with which a car without brakes holds itself on a slope."""
BRAKING = 1.0
"""Speed of a rim, m/s, below which its brake's torque fades, so that it is smooth at standstill: a handbrake of 8000
N m brakes wheels to 0.3 m/s."""
SPIN = 1e-3
"""Weight of the cost of spin in plans: on their long steps, a wheel's fast decay would alternate from knot to knot."""
ROUNDING = 8
"""Power with which the most that friction can bear is rounded: at half of it, 0.05 % are missing."""
LEANING = 1e-3
"""Camber, rad, over which the force of a tyre that only knows to which side it leans changes its sign."""
ROUND = 0.05
"""Width over which a weight's positive part is rounded: it changes a weight of one by 0.0006."""


@dataclass(frozen=True)
class Tyre:
    """Coefficients of a tyre, per unit of its load.

    ``longitudinal``, ``lateral``: shape C, peak friction D, curvature E and slip stiffness K. ``weights_longitudinal``,
    ``weights_lateral``: B1, B2, C and E of combined slip. ``friction``: factor of the peak friction on this surface.
    ``low_speed``: v_0, m/s. ``stiffness``: factor of the slip stiffness on this surface. ``camber``: H, H', V, V' and D
    of a wheel that leans to its right by g rad (eq. 4.E20 to 4.E29): its slip angle counts H sign(g) + H' g more, it
    pushes left with V sign(g) + V' g of its load, and the peak friction changes by the factor 1 - D g^2. ``slip_push``:
    V1 and V3 of the push to the left by longitudinal slip k at the slip angle a, over the peak friction:
    (V1 + V3 g) cos(atan(V4 a)) sin(V5 atan(V6 k)) (eq. 4.E65 to 4.E66; the others are `PUSHED`).
    """

    longitudinal: Sequence[float]
    lateral: Sequence[float]
    weights_longitudinal: Sequence[float]
    weights_lateral: Sequence[float]
    friction: float
    low_speed: float
    stiffness: float = 1.0
    camber: Sequence[float] = UPRIGHT
    slip_push: Sequence[float] = STRAIGHT

    def on(self, surface: SurfaceName) -> Tyre:
        """The same tyre on another surface than dry asphalt."""
        ground = SURFACES[surface]
        return replace(self, friction=self.friction * ground.friction, stiffness=self.stiffness * ground.stiffness)

    def slip(self, velocity: Expr, rim: Expr) -> tuple[Expr, Expr]:
        """Longitudinal slip and slip angle, rad, of a wheel whose hub moves at ``velocity`` (2,) m/s in the wheel's
        axes and whose rim turns at ``rim`` m/s."""
        pace = ca.sqrt(velocity[0] ** 2 + self.low_speed**2)
        return (rim - velocity[0]) / pace, ca.atan(velocity[1] / pace)

    def force(self, slip: Expr, angle: Expr, lean: Expr = 0.0) -> Expr:
        """Force over load (2,), forward and left in the wheel's axes; ``lean``: to its right, rad.

        Surfaces are similar (TIRE section 4.2): the force is the friction times that of the tyre's own coefficients, at
        slips that differ by the stiffness over the friction.
        """
        shift_side, shift, push_side, push, wane = self.camber
        side = lean / ca.sqrt(lean**2 + LEANING**2)
        turned, thrust = angle + shift_side * side + shift * lean, push_side * side + push * lean
        slip, angle, turned = (self.stiffness / self.friction * x for x in (slip, angle, turned))
        along = _pure(slip, self.longitudinal) * _weight(angle, slip, self.weights_longitudinal)
        grip = 1 - wane * lean**2
        aside = (_pure(turned, self.lateral, grip) - thrust) * _weight(slip, angle, self.weights_lateral)
        if any(self.slip_push):
            (always, leaning), (narrowing, shape, slope) = self.slip_push, PUSHED
            most = self.lateral[1] * grip * (always + leaning * lean)
            aside -= most * ca.cos(ca.atan(narrowing * angle)) * ca.sin(shape * ca.atan(slope * slip))
        return self.friction * ca.vertcat(along, -aside)

    def standing(self, pull: Expr, brakes: Expr, speed: Expr, slide: Expr) -> Expr:
        """What standing tyres bear of a ``pull`` (2,) forward and left: all of it to the side, and along the car what
        its ``brakes`` hold; all over the load, and at most the peak friction.

        Slip and brakes alone hold nothing at rest. As in D. Karnopp, Computer simulation of stick-slip friction in
        mechanical dynamic systems (1985), friction equals the pull there. Here it fades smoothly where they take over,
        so slowly that a car which they can stop does not creep: with the ``speed`` of the car, and along it with that
        at which its wheels ``slide``; both squared, m^2/s^2.
        """
        slipping = (self.low_speed * self.peak / (self.stiffness * self.lateral[3])) ** 2
        held = pull * ca.vertcat(_share(pull[0] ** 2, brakes), 1)
        fading = ca.vertcat((1 + speed / BRAKING**2) * (1 + slide / slipping), 1 + speed / slipping)
        return held * _share(ca.sumsqr(held), self.peak) / fading

    @property
    def peak(self) -> float:
        """Greatest force over load along or across the wheel; slipping both ways, `drift_car`'s tyre gives up to 5 %
        more."""
        return self.friction * max(self.longitudinal[1], self.lateral[1])

    def check(self, mass_height: float, nearest: float, fate: str, name: str) -> None:
        """Raise ``InputError`` if the greatest force turns over a car whose wheels are ``nearest`` m from its centre of
        mass in the plane, which is ``mass_height`` m above the ground; ``fate``: what would happen."""
        if self.peak * mass_height >= nearest:
            message = f"the grip of {self.peak:.3g} would {fate} {nearest:g} m from the centre of mass"
            raise InputError(message, "lower it", key="physics.mass_height", value=mass_height, subject=name)


def _pure(slip: Expr, coefficients: Sequence[float], grip: Expr = 1.0) -> Expr:
    shape, peak, curvature, stiffness = coefficients
    most = peak * grip
    return most * ca.sin(shape * _bent(stiffness / (shape * most) * slip, curvature))


def _weight(other: Expr, own: Expr, coefficients: Sequence[float]) -> Expr:
    """The share of a pure force that remains with slip in the ``other`` direction."""
    narrow, widening, shape, curvature = coefficients
    steepness = narrow / ca.sqrt(1 + (widening * own) ** 2)
    cosine = ca.cos(shape * _bent(steepness * other, curvature))
    return (cosine + ca.sqrt(cosine**2 + ROUND**2)) / 2


def _share(squared_force: Expr, most: Expr) -> Expr:
    """How much of a force is borne, if at most ``most`` can be."""
    most = ca.sqrt(most**2 + LEAST**2)
    return most / (most**ROUNDING + squared_force ** (ROUNDING // 2)) ** (1 / ROUNDING)


def _bent(x: Expr, curvature: float) -> Expr:
    return ca.atan(x - curvature * (x - ca.atan(x)))


def brake(torque: Expr, rim: Expr) -> Expr:
    """The torque, N m, by which a brake opposes a rim that turns at ``rim`` m/s."""
    return -torque * rim / ca.sqrt(rim**2 + BRAKING**2)


def held(
    tyre: Tyre, mass: float, wheelbase: float, wheel_radius: float, spin: Expr, xi: Expr, c: Expr, pull: Expr
) -> Expr:
    """The wrench (3,) that standing tyres bear of the ``pull`` (3,) of the weight on a slope; ``spin``: by how much
    wheels turn faster than they roll (n,) rad/s; ``xi``: body twist (3,); ``c``: `CONTROLS`."""
    weight, speed = mass * GRAVITY, xi[1] ** 2 + xi[2] ** 2 + (wheelbase * xi[0]) ** 2
    brakes = (c[1] + c[2]) / wheel_radius
    slide = ca.sumsqr(spin * wheel_radius)
    return ca.vertcat(0, weight * tyre.standing(pull[1:] / weight, brakes / weight, speed, slide))


def sliding(hub: Expr, rim: Expr) -> Expr:
    """Speed of a contact over the ground, m/s, of a wheel whose hub moves at ``hub`` (2,) m/s in the wheel's axes and
    whose rim turns at ``rim`` m/s."""
    return ca.sqrt((hub[0] - rim) ** 2 + hub[1] ** 2)


def steered(sigma: Expr, aside: float = 0.0) -> tuple[Expr, Expr]:
    """Cosine and sine of the angle of a steered wheel.

    ``sigma``: tangent of the steering angle in the middle of the axle; ``aside``: how far left the wheel is, over the
    wheelbase (Ackermann).
    """
    along = 1 - aside * sigma
    length = ca.sqrt(along**2 + sigma**2)
    return along / length, sigma / length
