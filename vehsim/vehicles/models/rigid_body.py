"""A free rigid body: an inertia, optional gravity, and no other forces (LIE 3.3)."""

from __future__ import annotations

from vehsim.lie import SO3xR3
from vehsim.vehicles.definition.holonomic import Holonomic
from vehsim.vehicles.definition.quantities import Acceleration, Mass, PrincipalInertia


def rigid_body(
    name: str = "rigid_body", *, mass: Mass, inertia: PrincipalInertia, gravity: Acceleration = 0.0
) -> Holonomic:
    """A body whose frame stands at its centre of mass, along its principal axes.

    ``mass`` kg; ``inertia`` (3,) principal moments, kg m^2; ``gravity`` m/s^2 along -Z: without it the body floats.
    """
    return Holonomic(name=name, group=SO3xR3, inertia=(*inertia, mass, mass, mass), gravity=gravity)
