"""The effect of water and wind on a vehicle, as data and symbolic laws.

`vehsim.world.water.buoyancy` integrates them over the hull. Positions are in the body frame, in metres from the centre
of mass.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from vehsim.vehicles.definition.base import Array, Expr
from vehsim.vehicles.definition.coefficients import Coefficients
from vehsim.vehicles.definition.resistance import Running


@dataclass(frozen=True, eq=False, kw_only=True)
class Hull:
    """A hull in the water (LIE 4.3.2 and eq. 16, with the corrections in docs/derivations.md).

    ``prim``: the closed mesh that displaces water, below the rig root; or ``points`` (n, 3) m in the rig root's frame
    and ``faces`` (m, 3). A wetted patch ``dA`` that moves with ``v`` through the water has the resistance ``-(damping +
    quadratic |v|) v dA / reference_area``. ``damping`` (3,) N s/m and ``quadratic`` (3,) N s^2/m^2 along the body's
    axes are totals of a hull immersed to its reference area, m^2 (None: as it floats upright at rest). ``normal_force``
    N is LIE's ``P``: it pushes inwards everywhere and lifts the hull, and is zero by default. ``impact`` and
    ``planing`` give the pressure ``rho v_n (impact v_n + planing |v|) / 2`` on patches that move into the water with
    ``v_n``: slamming, and the lift of a bottom at a small angle to its path, which grows linearly with the angle.
    ``added_mass`` (6,) kg m^2 and kg, of the hull at rest; it decreases with the immersed volume. ``propulsion(c, flow,
    immersion) -> (6,)``: body wrench of the propulsors, from the controls, the body's twist through the water (6,), and
    the immersed share (0 to 1) of each propulsor at ``propulsors`` (p, 3), which are ``propulsor_size`` m across.
    ``windage(air) -> (6,)``: body wrench from the twist (6,) through the air. ``running``: the hull's resistance and
    attitude on calm water as functions of its speed ahead, added to ``damping`` and ``quadratic``; its lift takes the
    place of ``planing``. ``coefficients``: of a panel method, with radiation and diffraction that depend on the
    frequency; they take the place of ``added_mass``.
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
    running: Running | None = None
    coefficients: Coefficients | None = None

    @property
    def propulsor_points(self) -> Array:
        return np.asarray(self.propulsors, float).reshape(-1, 3)
