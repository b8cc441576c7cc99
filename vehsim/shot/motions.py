"""The methods of motion: what each asks in ``[vehicle.motion]``, what is wrong with it in a world, and its solution.

A method is a model with ``check`` and ``solve``; a new one joins the union `Motion`. How motions are
computed lives in `vehsim.planning`, `vehsim.simulation` and `vehsim.pilots`.
"""

from __future__ import annotations

import warnings
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict
from typing import TYPE_CHECKING, Annotated, Any, Literal

import numpy as np
from annotated_types import Len
from pydantic import BeforeValidator, Field, PlainValidator, WithJsonSchema

from vehsim._quaternions import rotate
from vehsim.errors import InputError, Problem, SolveError
from vehsim.intake.tables import table_of
from vehsim.shot.asking import LimitTable, LookTable, StayTable, check_asked, check_limits, limits_si
from vehsim.shot.blocked import BlockingTable, blocking_of, marks_of
from vehsim.shot.checks import Setting, check_free, check_inside, check_mark, check_names, check_order, orientation_of
from vehsim.shot.integrating import IntegrateMotion
from vehsim.shot.model import (
    MAX_FRAMES,
    Array,
    InSchema,
    MarkTable,
    NotNegative,
    Number,
    Positive,
    StartTable,
    Table,
    Text,
    names_in,
    one_of,
)
from vehsim.shot.obstacles import check_marks
from vehsim.shot.piloting import PilotTable as PilotTable
from vehsim.shot.piloting import is_numeric as is_numeric
from vehsim.shot.sinusoid import SinusoidMotion

if TYPE_CHECKING:
    from vehsim.blocking import Blocking
    from vehsim.clip import Clip
    from vehsim.planning import Mark
    from vehsim.simulation import Mover
    from vehsim.take import Progress
    from vehsim.vehicles import State, Vehicle

COSTS = "vehsim.planning.terms:COSTS"
MAX_STEPS = 10_000_000
"""More integration steps than any shot needs."""


class PlanMotion(Table):
    """``method = "plan"``: the motion that hits the marks at the least cost."""

    method: Literal["plan"]
    """plan, simulate, integrate, sinusoid or clip"""
    cost: Annotated[
        str | dict[str, float],
        PlainValidator(lambda v: _cost(v)),
        WithJsonSchema({"type": "number", "minimum": 0}),
        InSchema(
            lambda weight: {"anyOf": [{"enum": names_in(COSTS)}, table_of(dict.fromkeys(names_in(COSTS), weight))]}
        ),
    ] = "effort"
    """what to keep small: "effort", "time" or another cost by name, or weights such as { effort = 1, time = 0.5 }"""
    segments: Annotated[int, Field(ge=2, le=2000)] = 64
    """how many pieces the motion is computed in, 2 to 2000: more follow faster motion"""
    clearance: Annotated[NotNegative, Field(le=1000)] = 1.0
    """how far the vehicle stays from obstacles and, when it flies, from the terrain, in m"""
    mark: Annotated[list[MarkTable], Array, Len(2, 1000)] | None = None
    """two or more [[vehicle.motion.mark]] tables"""
    marks: BlockingTable | None = None
    """instead of them, a table { usd, prim, ... }: a prim that was blocked in"""
    limits: LimitTable = LimitTable.model_validate({})
    """a table of what to stay below: speed and climb in m/s, turn_rate in deg/s, bank in degrees, ceiling in m ...;
    none unless given"""
    look: Annotated[list[LookTable], Array, Len(0, 100)] = Field(default=[])
    """[[vehicle.motion.look]] tables: where to look, and when"""
    stay: Annotated[list[StayTable], Array, Len(0, 100)] = Field(default=[])
    """[[vehicle.motion.stay]] tables: above, below or inside what, and when"""
    loop: bool = False
    """true: the motion ends as it begins, to be repeated"""
    solver: Annotated[Text, one_of("vehsim.planning.solver:SOLVERS")] = "ipopt"
    """the optimiser: "ipopt", "sqpmethod" or "fatrop\""""
    guess: Literal["sinusoid"] | None = None
    """where the search starts: "sinusoid", a manoeuvre that a car or truck can drive; the straight way, or one round
    obstacles, unless given"""
    time_limit: Annotated[Positive, Field(le=1e5)] | None = None
    """seconds after which the best motion so far is taken; results then depend on the machine"""

    def blocking(self, setting: Setting) -> Blocking | None:
        """What was blocked in, None where the marks were given one by one. Raises ``InputError``."""
        return None if self.marks is None else blocking_of(self.marks, setting.folder, setting.fps)

    def all_marks(self, setting: Setting) -> list[MarkTable]:
        """The marks, wherever they come from. Raises ``InputError``."""
        blocking = self.blocking(setting)
        if blocking is not None and self.marks is not None:
            return marks_of(self.marks, blocking, setting.fps)
        return self.mark or []

    def check(self, vehicle: Vehicle, setting: Setting) -> Iterator[Problem]:
        wrong = list(self._check_each(vehicle, setting))
        yield from wrong
        if not any(problem.severity == "error" for problem in wrong):  # each is right: do they go together?
            try:
                marks, options = [_as_mark(mark, vehicle) for mark in self.all_marks(setting)], self._options()
            except InputError as error:
                yield Problem("look" if self.look else "stay", str(error), "see docs/shot-file.md")
                return
            yield from check_asked(vehicle, setting, marks, options)

    def _check_each(self, vehicle: Vehicle, setting: Setting) -> Iterator[Problem]:
        from vehsim.planning.terms import COSTS

        if (self.mark is None) == (self.marks is None):
            mend = "give two or more [[vehicle.motion.mark]], or marks = { usd = ..., prim = ... }, not both"
            yield Problem("mark", "missing" if self.mark is None else "marks are given too", mend)
            return
        try:
            marks = self.all_marks(setting)
        except InputError as error:
            yield Problem("marks", str(error), "mend the blocking or the table that names it")
            return
        cost = {self.cost: None} if isinstance(self.cost, str) else self.cost
        yield from check_names("cost", cost, COSTS, "cost")
        yield from check_limits(self.limits.given(), vehicle)
        yield from self._check_guess(vehicle)
        yield from check_order(marks, setting)
        yield from check_marks(marks, vehicle, setting.world, self.clearance)
        for i, mark in enumerate(marks):
            key = f"mark[{i}]"
            yield from check_mark(key, mark, vehicle)
            if mark.position is not None and _planar(vehicle):
                yield from check_inside(f"{key}.position", mark.position, vehicle, setting.world)
            if mark.position is not None and not (_planar(vehicle) or mark.on_ground):  # wheels touch the ground
                slack = self.clearance - mark.tolerance
                yield from check_free(f"{key}.position", mark.position, mark, slack, vehicle, setting.world)

    def _check_guess(self, vehicle: Vehicle) -> Iterator[Problem]:
        if self.guess == "sinusoid":
            from vehsim.sinusoids.rigs import rigged

            try:
                if not _planar(vehicle):
                    raise InputError(f"{vehicle.name}: does not drive on wheels")
                rigged(vehicle)
            except InputError as error:
                yield Problem("guess", str(error), "leave guess out", self.guess)

    def _options(self) -> dict[str, Any]:
        """What `vehsim.plan` takes beside the marks."""
        return {
            "segments": self.segments,
            "cost": self.cost,
            "clearance": self.clearance,
            "limits": limits_si(self.limits.given()),
            "terms": [*(table.term() for table in self.look), *(table.term() for table in self.stay)],
            "loop": self.loop,
            "solver": self.solver,
        }

    def solve(self, vehicle: Vehicle, setting: Setting, progress: Progress) -> tuple[Clip, dict[str, Any]]:
        from vehsim.planning import plan

        wanted = self.all_marks(setting)
        marks = [_as_mark(mark, vehicle) for mark in wanted]
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", ".*: plan failed: ")  # it is raised below
            result = plan(
                vehicle,
                setting.world,
                marks=marks,
                fps=setting.fps,
                guess=self._guess(vehicle, marks, setting),
                time_limit=self.time_limit,
                progress=progress,
                **self._options(),
            )
        if not result.success:
            late = "time limit reached" in result.message
            mend = "give it a longer time_limit" if late else "loosen marks, clearance or limits"
            raise SolveError(f"{vehicle.name}: no plan was found: {result.message}; {mend}")
        # how long it took is left out: the same shot gives the same report
        names = ("success", "message", "cost", "duration", "iterations", "segments", "defect", "clearance")
        report = {name: getattr(result, name) for name in names} | {"executed": asdict(result.executed)}
        places = {mark.place: mark.position for mark in result.marks}
        said = [
            mark.model_dump(mode="json", exclude_unset=True) | {"position": list(places[i] or mark.position)}
            for i, mark in enumerate(wanted)
            if mark.position
        ]
        blocking = self.blocking(setting)
        if blocking is not None:
            clip = result.clip.resample()
            poses = clip.matrices()
            report["blocking"] = blocking.departure(clip.frames, clip.positions, poses[:, :3, :3])
            report["blocking"]["keys"] = [mark.frame for mark in wanted]
        return result.clip, report | {"marks": said, "asks": [ask.as_dict() for ask in result.asks]}

    def _guess(self, vehicle: Vehicle, marks: Sequence[Mark], setting: Setting) -> Any:
        """The path to start from, None for `vehsim.plan`'s own."""
        if self.guess is None:
            return None
        from vehsim.sinusoids.guess import first_guess

        return first_guess(vehicle, marks, setting.world, self.clearance)


class SimulateMotion(Table):
    """``method = "simulate"``: physics forward from a start, driven by commands or by a pilot."""

    method: Literal["simulate"]
    """plan, simulate, integrate, sinusoid or clip"""
    start: StartTable = StartTable()
    """the state on the shot's first frame, handle included; at the origin and at rest unless given"""
    duration: Annotated[Positive, Field(le=MAX_FRAMES)] | None = None
    """how long, in s; up to the shot's end_frame unless given"""
    step: Annotated[Number, Field(ge=1e-5, le=0.1)] = 1 / 240
    """the integration step in s, 0.00001 to 0.1; 1/240 unless given"""
    commands: (
        Annotated[list[Annotated[dict[str, Number], BeforeValidator(lambda v: _command(v))]], Array, Len(1, MAX_FRAMES)]
        | None
    ) = None
    """a list of { frame = ..., control = value, ... }: linear between them, held before and after, angles in degrees;
    no controls unless given"""
    pilot: PilotTable | None = None
    """a table { name = ..., parameters } instead of commands"""

    def check(self, vehicle: Vehicle, setting: Setting) -> Iterator[Problem]:
        if self.duration is None and setting.last is None:
            yield Problem("duration", "missing", "say how many seconds to simulate, or give shot.end_frame")
        seconds = self._duration(setting)
        if seconds * setting.fps > MAX_FRAMES or seconds / self.step > MAX_STEPS:
            yield Problem("duration", f"more than {MAX_FRAMES} frames or {MAX_STEPS} steps", "shorten it", seconds)
        if self.commands is not None and self.pilot is not None:
            yield Problem("pilot", "commands are given too", "keep one of them", self.pilot.name)
        if self.pilot is not None:
            wrong = list(self.pilot.check(vehicle))
            yield from wrong or filter(None, [self.pilot.refusal(vehicle)])
        yield from self._check_commands(vehicle)
        yield from check_names("start.joints", self.start.joints, vehicle.joints, "joint")
        yield from check_mark("start", self.start, vehicle)
        yield from check_inside("start.position", self.start.position, vehicle, setting.world)
        if not _planar(vehicle):
            yield from check_free("start.position", self.start.position, self.start, 0.0, vehicle, setting.world)

    def solve(self, vehicle: Vehicle, setting: Setting, progress: Progress) -> tuple[Clip, dict[str, Any]]:
        from vehsim.simulation import simulate

        controls = self._controls(vehicle, setting)
        clip = simulate(
            vehicle,
            setting.world,
            controls,
            start=as_state(self.start, vehicle) if self.start.model_fields_set else None,
            duration=self._duration(setting),
            step=self.step,
            fps=setting.fps,
            start_frame=setting.first,
            progress=progress,
        )
        said = {"step": self.step, "duration": clip.duration}
        return clip, said | ({} if self.pilot is None else {"targets": controls.targets(clip.duration)})

    def mover(self, vehicle: Vehicle, setting: Setting) -> tuple[Mover, float]:
        """The same for vehicles that move together, and for how long, s."""
        from vehsim.simulation import Mover

        start = as_state(self.start, vehicle) if self.start.model_fields_set else None
        return Mover(vehicle, self._controls(vehicle, setting), start), self._duration(setting)

    def _duration(self, setting: Setting) -> float:
        if self.duration is not None:
            return self.duration
        return setting.seconds(setting.last if setting.last is not None else setting.first)

    def _check_commands(self, vehicle: Vehicle) -> Iterator[Problem]:
        last = -np.inf
        for i, row in enumerate(self.commands or ()):
            names = {name: value for name, value in row.items() if name != "frame"}
            yield from check_names(f"commands[{i}]", names, vehicle.control_names, "control")
            for name, value in _to_si(names, vehicle).items():
                control = vehicle.controls[vehicle.control_names.index(name)]
                if not control.lower - 1e-9 <= value <= control.upper + 1e-9:
                    mend = f"this vehicle takes {control.lower:g} to {control.upper:g} {control.unit}".rstrip()
                    yield Problem(f"commands[{i}].{name}", "beyond the vehicle's bounds", mend, names[name])
            if row["frame"] <= last:
                yield Problem(f"commands[{i}].frame", "not after the one before it", "put them in order", row["frame"])
            last = row["frame"]

    def _controls(self, vehicle: Vehicle, setting: Setting) -> Any:
        """What `vehsim.simulate` takes: a pilot, or a function of time."""
        if self.pilot is not None:
            from vehsim.pilots import PILOTS

            return PILOTS[self.pilot.name](vehicle, **self.pilot.parameters())
        rows = self.commands or []
        curves = []
        for name in vehicle.control_names:
            knots = [(setting.seconds(row["frame"]), _to_si(row, vehicle)[name]) for row in rows if name in row]
            curves.append(np.array(knots or [(0.0, 0.0)]).T)
        return lambda t, state: np.array([np.interp(t, times, values) for times, values in curves])


class ClipMotion(Table):
    """``method = "clip"``: a motion saved before, as it is."""

    method: Literal["clip"]
    """plan, simulate, integrate, sinusoid or clip"""
    path: Text
    """a clip saved by vehsim (.npz), relative to the shot file"""

    def check(self, vehicle: Vehicle, setting: Setting) -> Iterator[Problem]:
        try:
            clip = self._load(vehicle, setting)
        except InputError as error:
            yield Problem("path", str(error), "give a file written by clip.save or the npz exporter", self.path)
            return
        if clip.fps != setting.fps:
            mend = f"set shot.fps = {str(clip.fps)!r}, or bake the clip at the shot's rate"
            yield Problem(
                "path", f"the clip runs at {clip.fps} frames per second, the shot at {setting.fps}", mend, self.path
            )

    def solve(self, vehicle: Vehicle, setting: Setting, progress: Progress) -> tuple[Clip, dict[str, Any]]:
        return self._load(vehicle, setting), {"path": self.path}

    def _load(self, vehicle: Vehicle, setting: Setting) -> Clip:
        from vehsim.clip import Clip

        path = setting.folder / self.path
        if not path.is_file():
            raise InputError("no such file")
        clip = Clip.load(path, vehicle)
        if clip.controls.shape[1] != len(vehicle.controls) or clip.joints.shape[1] != len(vehicle.joints):
            raise InputError(f"a clip of another vehicle than {vehicle.name!r}")
        return clip


Motion = Annotated[
    PlanMotion | SimulateMotion | IntegrateMotion | SinusoidMotion | ClipMotion, Field(discriminator="method")
]


def _cost(value: Any) -> Any:
    weights = list(value.values()) if isinstance(value, dict) else [1.0]
    if not isinstance(value, str | dict) or not all(np.ndim(w) == 0 and is_numeric(w) and w >= 0 for w in weights):
        raise ValueError("neither a cost's name nor a table of weights")
    if not any(weights):
        raise ValueError("no weight above zero")
    return value


def _command(value: Any) -> Any:
    if isinstance(value, dict) and "frame" not in value:
        raise ValueError("no frame")
    return value


def _as_mark(mark: MarkTable, vehicle: Vehicle) -> Mark:
    from vehsim.planning import Gate, Mark

    gate = None if mark.gate is None else Gate(**mark.gate.model_dump())
    return Mark(**(mark.model_dump() | {"gate": gate}))


def as_state(start: StartTable, vehicle: Vehicle) -> State:
    from vehsim.vehicles import State

    orientation = orientation_of(start)
    if orientation is None:
        orientation = np.array([1.0, 0.0, 0.0, 0.0])
    velocity = rotate(orientation[None] * [1, -1, -1, -1], np.array([start.velocity], float))[0]
    spin = np.deg2rad(start.spin)
    twist = np.array([spin[2], *velocity[:2]]) if _planar(vehicle) else np.concatenate([spin, velocity])
    joints = [start.joints.get(name, 0.0) for name in vehicle.joints]
    return State(position=np.array(start.position), orientation=orientation, twist=twist, joints=np.array(joints))


def _planar(vehicle: Vehicle) -> bool:
    return vehicle.group.dim == 3


def _to_si(values: Mapping[str, float], vehicle: Vehicle) -> dict[str, float]:
    """Control values of a shot file in SI: those whose unit is radians are given in degrees there."""
    units = {control.name: control.unit for control in vehicle.controls}
    return {
        name: np.deg2rad(value) if units[name].startswith("rad") else value
        for name, value in values.items()
        if name in units
    }
