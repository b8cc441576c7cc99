"""``method = "plan"``: the table of a planned motion, its checks in a world, and its solution."""

from __future__ import annotations

import warnings
from collections.abc import Iterator, Sequence
from dataclasses import asdict, replace
from typing import TYPE_CHECKING, Annotated, Any, Literal

import numpy as np
from annotated_types import Len
from pydantic import Field, PlainValidator, WithJsonSchema

from vehsim.errors import FailedPlan, InputError, Problem, SolveError
from vehsim.intake.tables import table_of
from vehsim.shot.checks import Context, check_free, check_inside, check_mark, check_names, check_order
from vehsim.shot.motions.blocking import BlockingTable, blocking_of, marks_of
from vehsim.shot.motions.clip import check_clip, load_clip
from vehsim.shot.motions.limits import LimitTable, LookTable, StayTable, check_limits, check_request, limits_si
from vehsim.shot.motions.pilots import is_numeric
from vehsim.shot.motions.state import is_planar
from vehsim.shot.schema.tables import (
    Array,
    InSchema,
    MarkTable,
    NotNegative,
    Positive,
    Table,
    Text,
    names_in,
    one_of,
)
from vehsim.shot.world.obstacle_tables import check_marks, clear_place
from vehsim.vehicles.definition.character import DEFAULT, CharacterName

if TYPE_CHECKING:
    from vehsim.clip.clip import Clip
    from vehsim.planning import Mark
    from vehsim.rig.blocking import Blocking
    from vehsim.runtime.progress import Progress
    from vehsim.vehicles import Vehicle

SINUSOID = "sinusoid"
"""The guess that is no file."""
COSTS = "vehsim.planning.terms:COSTS"


class PlanMotion(Table):
    """``method = "plan"``: the motion through the marks at the least cost."""

    method: Literal["plan"]
    """plan, simulate, sticks, integrate, sinusoid or clip"""
    cost: Annotated[
        str | dict[str, float],
        PlainValidator(lambda v: _cost(v)),
        WithJsonSchema({"type": "number", "minimum": 0}),
        InSchema(
            lambda weight: {"anyOf": [{"enum": names_in(COSTS)}, table_of(dict.fromkeys(names_in(COSTS), weight))]}
        ),
    ] = "effort"
    """the cost to minimise: "effort", "time" or another name, or weights such as { effort = 1, time = 0.5 }"""
    segments: Annotated[int, Field(ge=2, le=2000)] = 64
    """the number of segments of the motion, 2 to 2000; fast manoeuvres need more"""
    clearance: Annotated[NotNegative, Field(le=1000)] = 1.0
    """the least distance from obstacles and, for flying vehicles, from the terrain, in m"""
    mark: Annotated[list[MarkTable], Array, Len(2, 1000)] | None = None
    """two or more [[vehicle.motion.mark]] tables"""
    marks: BlockingTable | None = None
    """instead of mark, a table { usd, prim, ... } that names a prim animated by an artist"""
    limits: LimitTable = LimitTable.model_validate({})
    """a table of upper limits: speed and climb in m/s, turn_rate in deg/s, bank in degrees, ceiling in m ...; default:
    none"""
    character: CharacterName = DEFAULT
    """how the vehicle is driven: "calm", "normal", "brisk" or "stunt" (as hard as its model allows)"""
    look: Annotated[list[LookTable], Array, Len(0, 100)] = Field(default=[])
    """[[vehicle.motion.look]] tables: where to look, and when"""
    stay: Annotated[list[StayTable], Array, Len(0, 100)] = Field(default=[])
    """[[vehicle.motion.stay]] tables: the region to stay in, and when"""
    loop: bool = False
    """true: the motion ends as it starts, so that it can be repeated"""
    solver: Annotated[Text, one_of("vehsim.planning.problem.solver:SOLVERS")] = "ipopt"
    """the optimiser: "ipopt", "sqpmethod" or "fatrop\""""
    guess: Annotated[Text, InSchema(lambda own: {"anyOf": [{"enum": [SINUSOID]}, own]})] | None = None
    """the initial guess: "sinusoid", a manoeuvre for a car or truck, or a clip saved by vehsim (.npz), relative to the
    shot file; default: a straight path, the best of several if a nose points away from its leg or the way doubles back,
    for cars on tyres the motion without slip, or a path around obstacles"""
    time_limit: Annotated[Positive, Field(le=1e5)] | None = None
    """seconds after which the best motion so far is used; the result then depends on the machine"""

    @property
    def guess_file(self) -> str | None:
        """The path of the clip that is the initial guess."""
        return None if self.guess == SINUSOID else self.guess

    def blocking(self, context: Context) -> Blocking | None:
        """The animator's blocking, None if the marks are given one by one. Raises ``InputError``."""
        if self.marks is None or self.mark is not None:
            return None
        return blocking_of(self.marks, context.folder, context.fps)

    def all_marks(self, context: Context) -> list[MarkTable]:
        """The marks from either source. Raises ``InputError``."""
        blocking = self.blocking(context)
        if blocking is not None and self.marks is not None:
            return marks_of(self.marks, blocking, context.fps)
        return self.mark or []

    def check(self, vehicle: Vehicle, context: Context) -> Iterator[Problem]:
        wrong = list(self._check_each(vehicle, context))
        yield from wrong
        if not any(problem.severity == "error" for problem in wrong):  # each is valid: check them together
            try:
                marks, options = [as_mark(mark, vehicle) for mark in self.all_marks(context)], self.options()
            except InputError as error:
                yield error.problem.seen_from("look" if self.look else "stay", remedy="see docs/shot-file.md")
                return
            wrong = [*self._check_spans(marks)]
            yield from wrong or check_request(vehicle, context, marks, options)

    def _check_spans(self, marks: Sequence[Mark]) -> Iterator[Problem]:
        """The frames of each look and stay lie within the motion."""
        from vehsim.planning.request.marks import with_breaks

        spans = {f"look[{i}].frames": table.frames for i, table in enumerate(self.look)}
        spans |= {f"stay[{i}].frames": table.frames for i, table in enumerate(self.stay)}
        for key, frames in spans.items():
            try:
                with_breaks(marks, frames or ())
            except InputError as error:
                yield replace(error.problem, key=key)

    def _check_each(self, vehicle: Vehicle, context: Context) -> Iterator[Problem]:
        from vehsim.planning.terms import COSTS

        editing = self.marks is not None and self.marks.edit
        if (self.mark is None and self.marks is None) or (self.mark and self.marks and not editing):
            remedy = "give two or more [[vehicle.motion.mark]], or marks = { usd = ..., prim = ... }, not both"
            yield Problem("mark", "missing" if self.mark is None else "marks are given too", remedy)
            return
        try:
            marks, blocking = self.all_marks(context), self.blocking(context)
        except InputError as error:
            yield error.problem.seen_from("marks", remedy="fix the blocking or this table")
            return
        if blocking and self.marks and blocking.moves_along and "forward" not in self.marks.model_fields_set:
            message = (
                f"{blocking.prim} always moves along its own {blocking.moves_along}, across its nose {blocking.forward}"
            )
            remedy = f'give forward = "{blocking.moves_along}", or forward = "{blocking.forward}" if that is meant'
            yield Problem("marks.forward", message, remedy, severity="warning")
        cost = {self.cost: None} if isinstance(self.cost, str) else self.cost
        yield from check_names("cost", cost, COSTS, "cost")
        yield from check_limits(self.limits.given(), vehicle)
        yield from self._check_guess(vehicle, context)
        yield from check_order(marks, context)
        yield from check_marks(marks, vehicle, context.world, self.clearance)
        for i, mark in enumerate(marks):
            key = f"mark[{i}]"
            yield from check_mark(key, mark, vehicle)
            if mark.position is not None and is_planar(vehicle):
                yield from check_inside(f"{key}.position", mark.position, vehicle, context.world)
            if mark.position is not None and not (is_planar(vehicle) or mark.on_ground):  # wheels touch the ground
                place = f"{key}.position"
                for problem in check_free(place, mark.position, self.clearance, context.world):
                    yield replace(problem, fixes=clear_place(place, mark, vehicle, context.world, self.clearance))

    def _check_guess(self, vehicle: Vehicle, context: Context) -> Iterator[Problem]:
        if self.guess_file is not None:
            yield from check_clip("guess", self.guess_file, vehicle, context)
        if self.guess == SINUSOID:
            from vehsim.sinusoids.manoeuvres.rigs import rigged

            try:
                if not is_planar(vehicle):
                    raise InputError("does not drive on wheels", subject=vehicle.name)
                rigged(vehicle)
            except InputError as error:
                yield error.problem.seen_from("guess", self.guess, "remove guess")

    def options(self) -> dict[str, Any]:
        """Arguments of `vehsim.plan` in addition to the marks."""
        return {
            "segments": self.segments,
            "cost": self.cost,
            "clearance": self.clearance,
            "limits": limits_si(self.limits.given()),
            "character": self.character,
            "terms": [*(table.term() for table in self.look), *(table.term() for table in self.stay)],
            "loop": self.loop,
            "solver": self.solver,
        }

    def solve(self, vehicle: Vehicle, context: Context, progress: Progress) -> tuple[Clip, dict[str, Any]]:
        from vehsim.planning import plan

        wanted = self.all_marks(context)
        marks = [as_mark(mark, vehicle) for mark in wanted]
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", FailedPlan)  # it is raised below
            result = plan(
                vehicle,
                context.world,
                marks=marks,
                fps=context.fps,
                guess=self._guess(vehicle, marks, context),
                time_limit=self.time_limit,
                progress=progress,
                **self.options(),
            )
        if not result.success:
            error = SolveError(f"no plan was found: {result.message}", reason=result.reason, subject=vehicle.name)
            fixes: dict[str, float] = {f"{name}.frame": frame for name, frame in result.possible.items()}
            if result.possible_clearance is not None:
                fixes["clearance"] = result.possible_clearance
            error.problems = [replace(error.problem, fixes=tuple(fixes.items()))]
            raise error
        # the duration of the solve is omitted: the same shot gives the same report
        names = ("success", "message", "cost", "duration", "iterations", "segments", "defect", "clearance", "character")
        report = {name: getattr(result, name) for name in names} | {"executed": asdict(result.executed)}
        places = {mark.place: mark.position for mark in result.marks}
        marks_found = [
            mark.model_dump(mode="json", exclude_unset=True) | {"position": list(places[i] or mark.position)}
            for i, mark in enumerate(wanted)
            if mark.position
        ]
        blocking = self.blocking(context)
        if blocking is not None:
            clip = result.clip.resample()
            poses = clip.matrices()
            report["blocking"] = blocking.departure(clip.frames, clip.positions, poses[:, :3, :3])
            report["blocking"]["keys"] = [mark.frame for mark in wanted]
        return result.clip, report | {"marks": marks_found, "asks": [ask.as_dict() for ask in result.asks]}

    def _guess(self, vehicle: Vehicle, marks: Sequence[Mark], context: Context) -> Any:
        """The path or clip to start from; None: the default of `vehsim.plan`."""
        if self.guess_file is not None:
            return load_clip(self.guess_file, vehicle, context)
        if self.guess is None:
            return None
        from vehsim.sinusoids.manoeuvres.guess import initial_guess

        return initial_guess(vehicle, marks, context.world, self.clearance)


def _cost(value: Any) -> Any:
    weights = list(value.values()) if isinstance(value, dict) else [1.0]
    if not isinstance(value, str | dict) or not all(np.ndim(w) == 0 and is_numeric(w) and w >= 0 for w in weights):
        raise ValueError("neither a cost's name nor a table of weights")
    if not any(weights):
        raise ValueError("no weight above zero")
    return value


def as_mark(mark: MarkTable, vehicle: Vehicle) -> Mark:
    from vehsim.planning import Gate, Mark

    gate = None if mark.gate is None else Gate(**mark.gate.model_dump())
    return Mark(**(mark.model_dump() | {"gate": gate}))
