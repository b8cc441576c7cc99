"""Requests of ``[vehicle.motion]`` in addition to marks: limits, where to look and where to stay.

These tables convert degrees to radians and themselves to terms; the planner reports errors of their combination.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Annotated, Any, Literal

from annotated_types import Len
from pydantic import AfterValidator, Discriminator, Field, Tag

from vehsim.errors import Caution, InputError, OutsideTerrain, Problem
from vehsim.intake.tables import describe
from vehsim.shot.checks import Context, check_names
from vehsim.shot.schema.tables import Array, Frame, Metre, Number, Place, Positive, Table
from vehsim.vehicles.definition.quantities import in_degrees

if TYPE_CHECKING:
    from vehsim.planning import Mark
    from vehsim.planning.terms import Constraint
    from vehsim.vehicles import Vehicle

Pair = Annotated[list[Number], Array, Len(2, 2)]
Frames = Annotated[list[Frame], Array, Len(2, 2)]
Box = Annotated[list[Metre], Array, Len(4, 4)]


def _rising(pair: list[float]) -> list[float]:
    if pair[0] > pair[1]:
        raise ValueError("the first is above the second")
    return pair


Range = Annotated[
    Annotated[Positive, Tag("one")] | Annotated[Pair, AfterValidator(_rising), Tag("two")],
    Discriminator(lambda value: "two" if isinstance(value, list | tuple) else "one"),
    Field(description="a number above zero, for both directions, or [low, high]"),
]
"""Bounds of a joint; without this, pydantic would report the errors of both forms."""


def _name_limits(schema: dict[str, Any], model: type[Table]) -> None:
    """Name every limit in the JSON schema, with its unit and meaning."""
    from vehsim.planning.terms import LIMITS

    describe(schema, model)
    number = schema["additionalProperties"]
    for name, limit in LIMITS.loadable():
        if name in model.model_fields:
            continue
        description = f"{number['description']}, in {in_degrees(limit.unit)[1]}: {limit.meaning}"
        schema["properties"][name] = {**number, "description": description}
    schema["additionalProperties"] = False


class LimitTable(Table):
    """``limits = { speed = 30, bank = 45 }``: bounds by name."""

    model_config = Table.model_config | {"extra": "allow", "json_schema_extra": _name_limits}
    __pydantic_extra__: dict[str, Annotated[Positive, Field(description="a number above zero")]]
    joints: dict[str, Range] = Field(default={})
    """a table of joints, each with a number or [low, high], in the vehicle's own units"""
    joint_rates: dict[str, Range] = Field(default={})
    """a table of joints, each with a number or [low, high], in the vehicle's own units per second"""
    ceiling: Metre | None = None
    """the greatest height of the vehicle's root, in m"""

    def given(self) -> dict[str, Any]:
        """The bounds in the file, sorted by name: their order is that of rows in the problem, and a set has none."""
        return {name: getattr(self, name) for name in sorted(self.model_fields_set)}


class LookTable(Table):
    """``[[vehicle.motion.look]]``: a body axis points at a place."""

    at: Place
    """the point to look at, [x, y, z] in m"""
    frames: Frames | None = None
    """first and last frame, [first, last]; default: the whole motion"""
    within: Annotated[Number, Field(gt=0, lt=180)] = 5.0
    """the permitted angle, in degrees"""
    axis: Literal["x", "y", "z", "-x", "-y", "-z"] = "x"
    """the body axis that looks there: "x" is the nose, "y" the left side, "-z" the belly"""
    level: bool = True
    """true to compare horizontal directions, so that the vehicle may pitch and bank; false to compare directions in
    space"""

    def term(self) -> Constraint:
        from vehsim.planning.request.ranges import look_at

        return look_at(self.at, _range(self.frames), within=self.within, axis=self.axis, level=self.level)


class StayTable(Table):
    """``[[vehicle.motion.stay]]``: between heights, and inside a rectangle."""

    frames: Frames | None = None
    """first and last frame, [first, last]; default: the whole motion"""
    above: Metre | None = None
    """the least height of the vehicle's root, in m"""
    below: Metre | None = None
    """the greatest height of the vehicle's root, in m"""
    inside: Box | None = None
    """a rectangle seen from above, [x0, y0, x1, y1] in m"""

    def term(self) -> Constraint:
        from vehsim.planning.request.ranges import stay

        return stay(_range(self.frames), above=self.above, below=self.below, within=self.inside or ())


def _range(frames: Sequence[int] | None) -> tuple[int, int] | None:
    return None if frames is None else (frames[0], frames[1])


def limits_si(limits: Mapping[str, Any]) -> dict[str, Any]:
    """Limits of a shot file in SI: angles there are in degrees, joints in the vehicle's own units."""
    from vehsim.planning.terms import LIMITS

    angular = {name for name in limits if name in LIMITS and LIMITS[name].angular}
    return {name: math.radians(value) if name in angular else value for name, value in limits.items()}


def check_limits(limits: Mapping[str, Any], vehicle: Vehicle) -> Iterator[Problem]:
    """Limits and joints exist."""
    from vehsim.planning.terms import LIMITS

    yield from check_names("limits", limits, [*LIMITS, "joints", "joint_rates"], "limit")
    for name in ("joints", "joint_rates"):
        yield from check_names(f"limits.{name}", limits.get(name, {}), vehicle.joints, "joint")


def check_request(
    vehicle: Vehicle, context: Context, marks: Sequence[Mark], options: Mapping[str, Any]
) -> Iterator[Problem]:
    """The planner's errors about marks and options together, and what bounds prove impossible."""
    from vehsim.planning.explain.feasibility import refusals
    from vehsim.planning.request.request import make_request

    request, wrong = None, list[Problem]()
    try:
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            warnings.simplefilter("ignore", OutsideTerrain)  # already reported with its place
            request = make_request(vehicle, context.world, marks, fps=context.fps, **options)
    except InputError as error:
        wrong = [problem if problem.key else problem.seen_from("mark") for problem in error.problems]
    for warning in caught:
        if not isinstance(warning.message, Caution):
            warnings.warn_explicit(warning.message, warning.category, warning.filename, warning.lineno)
        elif warning.message.problem not in wrong:  # a hold is two marks with one name
            wrong.append(warning.message.problem)
    yield from wrong
    if request is None:
        return
    for refusal in refusals(request):
        value = getattr(refusal.mark, refusal.key) if refusal.value is None else refusal.value
        key = f"{refusal.mark.name}.{refusal.key}"
        yield Problem(key, refusal.message, refusal.remedy, value, fixes=refusal.fixes)
