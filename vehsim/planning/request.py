"""What a plan was asked for, in one place."""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from dataclasses import dataclass
from fractions import Fraction
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vehsim.errors import InputError
from vehsim.planning.legs import mark_positions
from vehsim.planning.marks import Mark
from vehsim.planning.terms import Constraint, Limits, Term
from vehsim.vehicles import Vehicle
from vehsim.world.slope import on_terrain

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Request:
    """All that a plan was asked for; ``deadline`` on `time.monotonic`'s clock, s."""

    vehicle: Vehicle
    world: Any
    marks: list[Mark]
    fps: Fraction
    segments: int
    weights: dict[str, float]
    clearance: float
    limits: Limits
    refine: bool
    max_iterations: int
    terms: tuple[Term, ...] = ()
    loop: bool = False
    solver: str = "ipopt"
    deadline: float = math.inf

    @property
    def wind(self) -> Array:
        return np.zeros(3) if self.world is None else np.asarray(self.world.wind, float)

    @property
    def late(self) -> bool:
        """Past its deadline."""
        return time.monotonic() > self.deadline

    @property
    def costs(self) -> tuple[str, ...]:
        """Names of the costs that count."""
        return tuple(name for name, weight in self.weights.items() if weight)

    @property
    def constraints(self) -> list[Constraint]:
        """Limits and constraints of one's own."""
        return [*self.limits.constraints(), *(term for term in self.terms if isinstance(term, Constraint))]

    @property
    def key(self) -> Any:
        """Equal for requests whose problems differ in parameters alone."""
        return (
            shape(self.marks),
            repr(self.limits),
            self.costs,
            self.terms,
            self.loop,
            self.solver,
            self.max_iterations,
        )

    @property
    def weighed(self) -> Vehicle:
        """The vehicle as slopes pull it."""
        return on_terrain(self.vehicle, self.world, mark_positions(self.marks))

    @property
    def terrain(self) -> bool:
        return self.world is not None and self.world.terrain is not None and self.vehicle.group.dim == 6


def check_loop(request: Request) -> None:
    """Raise ``InputError`` where a loop is asked to end elsewhere than it begins."""
    first, last = request.marks[0], request.marks[-1]
    if not request.loop:
        return
    for key in ("position", "heading", "orientation", "velocity"):
        a, b = getattr(first, key), getattr(last, key)
        if a is not None and b is not None and not np.allclose(a, b, atol=1e-9):
            raise InputError(
                f"{last.name}.{key} = {b!r}: a loop ends as it begins, with {a!r}; leave it out of the last mark"
            )


def shape(marks: Sequence[Mark]) -> tuple[Any, ...]:
    """What marks ask for, but not where: equal shapes share one built problem."""
    keys = ("position", "heading", "orientation", "velocity", "speed", "joints")
    asked = [tuple(getattr(m, key) is not None for key in keys) for m in marks]
    kinds = [(m.frame == "free", m.balanced, m.at_rest, m.speed == 0, m.tolerance, m.hold > 0) for m in marks]
    joints = [None if m.joints is None else tuple(np.isfinite(np.asarray(m.joints, float))) for m in marks]
    gates = [m.gate and m.gate.radius is None for m in marks]
    return tuple(zip(asked, kinds, joints, gates, strict=True))
