"""What ``[vehicle.motion]`` asks of a plan beside its marks: limits, where to look and where to stay.

Tables here turn degrees into radians and themselves into terms; the planner says what is wrong with them together.
"""

from __future__ import annotations

import math
import re
import warnings
from collections.abc import Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Annotated, Any, Literal

from annotated_types import Len
from pydantic import AfterValidator, Discriminator, Field, Tag

from vehsim.errors import InputError, Problem
from vehsim.intake.tables import describe
from vehsim.shot.checks import Setting, check_names
from vehsim.shot.model import Array, Frame, Metre, Number, Point, Positive, Table

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
    Field(description="a number above zero, the same both ways, or [low, high]"),
]
"""A joint's; pydantic would otherwise report what is wrong with each of the two forms."""


def _name_limits(schema: dict[str, Any], model: type[Table]) -> None:
    """Name every limit in the JSON schema, with its unit and meaning."""
    from vehsim.planning.terms import LIMITS

    describe(schema, model)
    number = schema["additionalProperties"]
    for name, limit in LIMITS.items():
        said = f"{number['description']}, in {limit.unit.replace('rad', 'deg')}: {limit.meaning}"
        schema["properties"][name] = {**number, "description": said}
    schema["additionalProperties"] = False


class LimitTable(Table):
    """``limits = { speed = 30, bank = 45 }``: bounds by name."""

    model_config = Table.model_config | {"extra": "allow", "json_schema_extra": _name_limits}
    __pydantic_extra__: dict[str, Annotated[Positive, Field(description="a number above zero")]]
    joints: dict[str, Range] = Field(default={})
    """a table of joints, each with a number or [low, high], in the vehicle's own units"""
    joint_rates: dict[str, Range] = Field(default={})
    """a table of joints, each with a number or [low, high], in the vehicle's own units a second"""

    def given(self) -> dict[str, Any]:
        """Bounds by name, as the file has them."""
        return {name: getattr(self, name) for name in self.model_fields_set}


class LookTable(Table):
    """``[[vehicle.motion.look]]``: a body axis points to a place."""

    at: Point
    """where it looks, [x, y, z] in m"""
    frames: Frames | None = None
    """first and last frame, [first, last]; the whole motion unless given"""
    within: Annotated[Number, Field(gt=0, lt=180)] = 5.0
    """how nearly, in degrees"""
    axis: Literal["x", "y", "z", "-x", "-y", "-z"] = "x"
    """what looks there: "x" is the nose, "y" the left side, "-z" the belly"""
    level: bool = True
    """true: seen from above, so that it may pitch and bank; false: in space"""

    def term(self) -> Constraint:
        from vehsim.planning.ranges import look_at

        return look_at(self.at, _range(self.frames), within=self.within, axis=self.axis, level=self.level)


class StayTable(Table):
    """``[[vehicle.motion.stay]]``: between heights, and inside a rectangle."""

    frames: Frames | None = None
    """first and last frame, [first, last]; the whole motion unless given"""
    above: Metre | None = None
    """the lowest height of the vehicle's root, in m"""
    below: Metre | None = None
    """the greatest height of the vehicle's root, in m"""
    inside: Box | None = None
    """a rectangle seen from above, [x0, y0, x1, y1] in m"""

    def term(self) -> Constraint:
        from vehsim.planning.ranges import stay

        return stay(_range(self.frames), above=self.above, below=self.below, within=self.inside or ())


def _range(frames: Sequence[int] | None) -> tuple[int, int] | None:
    return None if frames is None else (frames[0], frames[1])


def limits_si(limits: Mapping[str, Any]) -> dict[str, Any]:
    """Limits of a shot file in SI: angles there are in degrees, joints in the vehicle's own units."""
    from vehsim.planning.terms import LIMITS

    angular = {name for name, limit in LIMITS.items() if limit.angular}
    return {name: math.radians(value) if name in angular else value for name, value in limits.items()}


def check_limits(limits: Mapping[str, Any], vehicle: Vehicle) -> Iterator[Problem]:
    """Limits and joints that exist."""
    from vehsim.planning.terms import LIMITS

    yield from check_names("limits", limits, [*LIMITS, "joints", "joint_rates"], "limit")
    for name in ("joints", "joint_rates"):
        yield from check_names(f"limits.{name}", limits.get(name, {}), vehicle.joints, "joint")


def check_asked(
    vehicle: Vehicle, setting: Setting, marks: Sequence[Mark], options: Mapping[str, Any]
) -> Iterator[Problem]:
    """What the planner refuses of marks and options together, and what bounds prove impossible."""
    from vehsim.planning.feasibility import refusals
    from vehsim.planning.request import ask

    try:
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", ".*outside the terrain")  # said with its place already
            request = ask(vehicle, setting.world, marks, fps=setting.fps, **options)
    except InputError as error:
        key, _, rest = str(error).partition(": ")
        key = key.partition(" = ")[0]
        known = re.fullmatch(r"[a-z_]+(\[\d+\])?(\.\w+)*", key)
        message, _, mend = (rest if known else str(error)).rpartition("; ")
        yield Problem(key if known else "mark", message or "not possible", mend)
        return
    for refusal in refusals(request):
        value = getattr(refusal.mark, refusal.key)
        yield Problem(f"{refusal.mark.name}.{refusal.key}", refusal.message, refusal.mend, value)
