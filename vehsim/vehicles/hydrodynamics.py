"""What water and wind do to a vehicle, as data and symbolic laws; `vehsim.world.buoyancy` integrates it over the hull.

Positions are in the body frame: metres from the centre of mass.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from vehsim.vehicles._base import Array, Expr


@dataclass(frozen=True, eq=False, kw_only=True)
class Hull:
    """A hull in the water (LIE 4.3.2, eq. 16, as math.md corrects it).

    ``prim``: the closed mesh that displaces water, below the rig root; or ``points`` (n, 3) m in the rig root's frame
    and ``faces`` (m, 3). The resistance of a wetted patch ``dA`` that moves with ``v`` through the water is
    ``-(damping + quadratic |v|) v dA / reference_area``, ``damping`` (3,) N s/m and ``quadratic`` (3,) N s^2/m^2 along
    the body's axes: totals of a hull immersed to its reference area, m^2 (None: as it floats at rest, upright).
    ``normal_force`` N is LIE's ``P``, which pushes inwards everywhere, lifts, and so is zero unless asked for.
    ``impact`` and ``planing``: pressure ``rho v_n (impact v_n + planing |v|) / 2`` on patches that move into the water
    with ``v_n``: slamming, and the lift of a bottom at a small angle to its way, which grows with the angle itself.
    ``added_mass`` (6,) kg m^2 and kg, of the hull at rest; less of it counts when less is immersed.

    ``propulsion(c, flow, immersion) -> (6,)`` body wrench of what pushes against the water, of controls, the body's
    twist through the water (6,) and how much (0 to 1) of each propulsor at ``propulsors`` (p, 3), ``propulsor_size`` m
    across, is immersed. ``windage(air) -> (6,)`` of the twist (6,) through the air.
    """

    prim: str = ""
    points: Any = None
    faces: Any = None
    damping: Any = (0.0, 0.0, 0.0)
    quadratic: Any = (0.0, 0.0, 0.0)
    reference_area: float | None = None
    normal_force: float = 0.0
    impact: float = 0.0
    planing: float = 0.0
    added_mass: Any = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    propulsion: Callable[[Expr, Expr, Expr], Expr] | None = None
    propulsors: Any = ()
    propulsor_size: float = 0.3
    windage: Callable[[Expr], Expr] | None = None

    @property
    def propulsor_points(self) -> Array:
        return np.asarray(self.propulsors, float).reshape(-1, 3)
