"""What a plan was asked for, in one place."""

from __future__ import annotations

import math
import time
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from fractions import Fraction
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vehsim.clip import frame_rate
from vehsim.errors import InputError
from vehsim.lie import SO3
from vehsim.planning.cover import attitude, landings
from vehsim.planning.guess import stands
from vehsim.planning.legs import knots_within, mark_positions
from vehsim.planning.marks import Mark, check_marks, end_of_hold, with_breaks
from vehsim.planning.obstacles import check_marks_clear
from vehsim.planning.ranges import descent
from vehsim.planning.solver import check_solver
from vehsim.planning.terms import Constraint, Limits, Term, check_limits, check_terms, cost_weights
from vehsim.vehicles import Vehicle
from vehsim.world import landing
from vehsim.world.slope import on_terrain

Array = NDArray[np.float64]

UNEVEN = 0.02
"""How high a part of what stands on the ground may be above it, m, before it is said."""


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
    given: Sequence[Mark] = ()
    """The marks before those at rest were turned along their legs."""

    @property
    def wind(self) -> Array:
        return np.zeros(3) if self.world is None else np.asarray(self.world.wind, float)

    @property
    def costs(self) -> tuple[str, ...]:
        """Names of the costs that count."""
        return tuple(name for name, weight in self.weights.items() if weight)

    @property
    def constraints(self) -> list[Constraint]:
        """Limits, constraints of one's own, and gentle landings."""
        own = (term for term in self.terms if isinstance(term, Constraint))
        return [*self.limits.constraints(), *own, *map(descent, landings(self.marks))]

    def aimed(self, mark: Mark) -> bool:
        """A constraint says which way to head at this mark."""
        ranges = [term.frames for term in self.constraints if term.aim is not None]
        if mark.frame == "free":
            return None in ranges
        i = [known.frame for known in self.marks].index(mark.frame)
        last = int(self.marks[end_of_hold(self.marks, i)].frame)
        return any(r is None or (r[0] <= last and mark.frame <= r[1]) for r in ranges)

    def aims(self, mark_knots: NDArray[np.intp]) -> list[tuple[int, int, Any, float]]:
        """What constraints say of headings: (first knot, last knot, point, angle)."""
        aimed = [(term, term.aim) for term in self.constraints if term.aim is not None]
        return [(*knots_within(self.marks, mark_knots, term.frames), *aim) for term, aim in aimed]

    @property
    def top_speed(self) -> float:
        """How fast it may be, m/s: its limit, or else what its vehicle can do."""
        return self.limits.get("speed", self.vehicle.top_speed)

    def speed_limit(self) -> str:
        """That speed as messages name it, and whose it is."""
        given = math.isfinite(self.limits.get("speed"))
        own = f"the top speed of the {self.vehicle.name}, {self.top_speed:g}; limits.speed can allow more"
        return f"limit {self.top_speed:g}" if given else own

    @property
    def key(self) -> Any:
        """Equal for requests whose problems differ in parameters alone."""
        return (
            shape(self.marks),
            repr(self.limits),
            tuple(mark.position for mark in landings(self.marks)),  # laws of their descents hold them
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
    def hazards(self) -> bool:
        """It flies, and there is something to hit."""
        about = self.world is not None and (self.world.terrain is not None or self.world.obstacles)
        return bool(about) and self.vehicle.group.dim == 6


def ask(
    vehicle: Vehicle,
    world: Any,
    marks: Sequence[Mark],
    *,
    fps: Any,
    segments: int,
    cost: str | Mapping[str, float] = "effort",
    clearance: float = 1.0,
    limits: Mapping[str, Any] | None = None,
    refine: bool = True,
    terms: Sequence[Term] = (),
    loop: bool = False,
    solver: str = "ipopt",
    max_iterations: int = 200,
    time_limit: float | None = None,
) -> Request:
    """What `vehsim.plan` is asked for, checked; raises ``InputError`` naming key, value and mend."""
    if not isinstance(vehicle, Vehicle):
        raise InputError(f"vehicle = {vehicle!r}: give what vehsim.load_vehicle returns")
    vehicle = vehicle.planar or vehicle
    if not (math.isfinite(clearance) and clearance >= 0):
        raise InputError(f"clearance = {clearance!r}: give a distance in metres, zero or more")
    if time_limit is not None and not time_limit > 0:
        raise InputError(f"time_limit = {time_limit!r}: give seconds, more than zero")
    kept = check_terms(terms)
    request = Request(
        vehicle=vehicle,
        world=world,
        marks=all_marks(marks, vehicle, world, kept),
        fps=frame_rate(fps),
        segments=int(segments),
        weights=cost_weights(cost, default_costs(vehicle, marks)),
        clearance=float(clearance),
        limits=check_limits(limits or {}, vehicle.joints),
        refine=refine,
        max_iterations=max_iterations,
        terms=kept,
        loop=loop,
        solver=check_solver(solver),
        deadline=math.inf if time_limit is None else time.monotonic() + time_limit,
    )
    least = 2 * (len(request.marks) - 1)
    if not least <= segments <= 4096:
        raise InputError(f"segments = {segments!r}: give at least two a leg between marks, {least}, and at most 4096")
    check_loop(request)
    check_inside(request.marks, vehicle, world)
    check_marks_clear(vehicle, world, request.marks, request.clearance)
    heights = {float(np.asarray(mark.position)[2]) for mark in request.marks if mark.position is not None}
    if vehicle.group.dim == 3 and len(heights) > 1 and (world is None or world.terrain is None):
        raise InputError(
            f"mark.position: heights {sorted(heights)} m; {vehicle.name} keeps its height, give one z to all"
        )
    return request


def default_costs(vehicle: Vehicle, marks: Sequence[Mark]) -> dict[str, float]:
    """The vehicle's own, and time where it may take as long as it likes and standing costs no effort: effort alone
    would crawl for ever."""
    patient = len(marks) > 0 and marks[-1].frame == "free" and stands(vehicle)
    return ({"time": 1.0} if patient else {}) | dict(vehicle.default_costs)


def all_marks(marks: Sequence[Mark], vehicle: Vehicle, world: Any, terms: Sequence[Term]) -> list[Mark]:
    """The marks, holds written out, put down where they shall be, and a knot where a term's frames begin or end."""
    standing = [put_down(mark, vehicle, world) for mark in check_marks(marks, vehicle.joints)]
    return with_breaks(standing, [frame for term in terms for frame in term.frames or ()])


def put_down(mark: Mark, vehicle: Vehicle, world: Any) -> Mark:
    """A mark on the ground where the vehicle touches it; warns where it stands uneven. Raises ``InputError``."""
    if not mark.on_ground:
        return mark
    assert mark.position is not None
    key = f"{mark.name}.on_ground"
    if world is None or vehicle.group.dim != 6:
        mend = "leave it out" if vehicle.group.dim != 6 else "give a terrain or obstacles to stand on"
        raise InputError(f"{key}: {vehicle.name} does not land; {mend}")
    check_inside([mark], vehicle, world)
    q = attitude(mark)
    try:
        place = landing.put_down(world, vehicle, mark.position, q)
    except InputError as error:
        raise InputError(f"{key}: {error}") from None
    below = place + landing.feet(vehicle) @ SO3.matrix(q).T
    hollow = float(np.max(below[:, 2] - landing.height_below(world, below)))
    if hollow > UNEVEN:
        message = f"{key}: it touches the ground, but stands up to {hollow:.2f} m above it elsewhere"
        warnings.warn(f"{message}; land on level ground or on a pad (an obstacle)", stacklevel=5)
    if np.any(world.wind):  # it stands level, but is not in balance
        mark = replace(mark, orientation=tuple(q.tolist()), heading=None)
    return replace(mark, position=tuple(place.tolist()))


def check_inside(marks: Sequence[Mark], vehicle: Vehicle, world: Any) -> None:
    """Raise ``InputError`` for a mark outside the terrain where it flies, since no way is sought there; warn where it
    drives: beyond the borders the ground goes on level and is not drawn."""
    terrain = None if world is None else world.terrain
    if terrain is None or vehicle.hull is not None:
        return
    for mark in marks:
        end = "" if mark.position is None else terrain.beyond(mark.position)
        if not end:
            continue
        place = [float(x) for x in mark.position or ()]
        said = f"{mark.name}.position = {place}: outside the terrain, which ends at {end}"
        if vehicle.group.dim == 6:
            raise InputError(f"{said}; move it inside")
        warnings.warn(f"{said}; beyond, the ground goes on level and is not drawn", stacklevel=4)


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
    rests = [(m.balanced, m.at_rest, m.speed == 0, m.hold > 0, m.on_ground) for m in marks]
    kinds = [(m.frame == "free", m.tolerance) for m in marks]
    joints = [None if m.joints is None else tuple(np.isfinite(np.asarray(m.joints, float))) for m in marks]
    gates = [m.gate and m.gate.radius is None for m in marks]
    return tuple(zip(asked, rests, kinds, joints, gates, strict=True))
