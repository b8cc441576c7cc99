"""Types of a model's parameters, with their units and ranges.

From these annotations follow the checks of ``[physics]`` and ``[vehicle.parameters]``, their messages, and the tables
in the documentation. A package's model may use them, or write its own: ``Annotated[float, Unit("N"), Ge(0)]``.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated

from annotated_types import Ge, Gt, Le, Len
from pydantic import AfterValidator


@dataclass(frozen=True)
class Unit:
    """An SI unit, such as "kg m^2"; empty: a pure number."""

    name: str


@dataclass(frozen=True)
class With:
    """The number has an effect only if another, ``key``, is not zero: the solidity of a rotor with its radius."""

    key: str


@dataclass(frozen=True)
class Without:
    """The number has an effect only if another, ``key``, is zero: its law takes the place of this one."""

    key: str


def in_degrees(unit: str) -> tuple[float, str]:
    """The factor from an SI unit to the one that users see, and its name: degrees in place of radians."""
    return (180 / math.pi if unit.startswith("rad") else 1.0), unit.replace("rad", "deg")


def _of_a_body(moments: Sequence[float]) -> Sequence[float]:
    """Each moment is at most the sum of the other two; equal for a flat body."""
    if 2 * max(moments) > sum(moments) * (1 + 1e-6):
        raise ValueError("one moment is larger than the sum of the other two, as of no body")
    return moments


Mass = Annotated[float, Unit("kg"), Gt(0)]
Inertia = Annotated[float, Unit("kg m^2"), Gt(0)]
Length = Annotated[float, Unit("m"), Gt(0)]
Distance = Annotated[float, Unit("m"), Ge(0)]
Coordinate = Annotated[float, Unit("m")]
Area = Annotated[float, Unit("m^2"), Ge(0)]
Force = Annotated[float, Unit("N"), Gt(0)]
Pressing = Annotated[float, Unit("N"), Ge(0)]
Acceleration = Annotated[float, Unit("m/s^2")]
AngularRate = Annotated[float, Unit("rad/s")]
AddedMass = Annotated[float, Unit("kg, kg m^2"), Ge(0)]
Coefficient = Annotated[float, Unit(""), Ge(0)]
Share = Annotated[float, Unit(""), Ge(0), Le(1)]
JointDamping = Annotated[float, Unit("N m s/rad"), Ge(0)]
LinearDamping = Annotated[float, Unit("N s/m"), Ge(0)]
Stiffness = Annotated[float, Unit("N m/rad"), Ge(0)]
MomentVolume = Annotated[float, Unit("m^3")]
QuadraticDamping = Annotated[float, Unit("N s^2/m^2"), Ge(0)]

Place = Annotated[Sequence[Coordinate], Len(3, 3)]
PrincipalInertia = Annotated[Sequence[Inertia], Len(3, 3), AfterValidator(_of_a_body)]
Angle = Annotated[float, Unit("rad"), Ge(0)]
SignedAngle = Annotated[float, Unit("rad")]
Slope = Annotated[Sequence[Annotated[float, Unit("")]], Len(2, 2)]
Direction = Annotated[Sequence[Annotated[float, Unit("")]], Len(3, 3)]
InertiaMatrix = Annotated[Sequence[Annotated[Sequence[Annotated[float, Unit("kg m^2")]], Len(3, 3)]], Len(3, 3)]
