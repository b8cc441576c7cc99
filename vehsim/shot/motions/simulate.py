"""``method = "simulate"``: the table of a simulated motion, its checks in a world, and its solution.

`ForwardMotion` is what every simulated motion has in common; `sticks.py` is another of them.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterator, Sequence
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal

import numpy as np
from annotated_types import Len
from numpy.typing import NDArray
from pydantic import BeforeValidator, Field

from vehsim.errors import InputError, Problem
from vehsim.shot.checks import Context, check_clear, check_free, check_inside, check_mark, check_names
from vehsim.shot.motions.clip import check_clip, load_clip
from vehsim.shot.motions.pilots import PilotTable
from vehsim.shot.motions.state import as_state, is_planar, to_si
from vehsim.shot.schema.tables import MAX_FRAMES, Array, Number, Positive, StartTable, Table, Text

if TYPE_CHECKING:
    from vehsim.clip.clip import Clip
    from vehsim.runtime.progress import Progress
    from vehsim.simulation import Mover
    from vehsim.vehicles import State, Vehicle

Values = NDArray[np.float64]

FAR = 0.5
"""Distance of a boat's start from the water, m, without a warning."""
SAME = 10
"""Decimals of seconds: a row of a table and a knot are at the same time if they agree in these."""


class SimulatedStart(StartTable):
    """``[vehicle.motion.start]`` of a simulated motion."""

    afloat: bool = True
    """false: a boat starts at this z, level, and drops onto the water or rises to it; default: it rides the water,
    unless its orientation, its spin or a vertical velocity is given"""


class ForwardMotion(Table):
    """Forward simulation from a start, under controls that a subclass gives."""

    # as of `vehsim.simulate`: whether the duration never changes the motion before its end
    everywhere: ClassVar[bool] = False

    start: SimulatedStart = SimulatedStart()
    """the state on the shot's first frame, including handles; default: at rest at the origin"""
    step: Annotated[Number, Field(ge=1e-5, le=0.1)] = 1 / 240
    """the integration step in s, 0.00001 to 0.1; default: 1/240"""
    continues: Text | None = None
    """a simulated motion (.npz), relative to the shot file, that is continued from its last frame; default: none"""

    def check(self, vehicle: Vehicle, context: Context) -> Iterator[Problem]:
        from vehsim.simulation import MAX_STEPS

        seconds = self.seconds(context)
        if seconds * context.fps > MAX_FRAMES or seconds / self.step > MAX_STEPS:
            yield Problem("duration", f"more than {MAX_FRAMES} frames or {MAX_STEPS} steps", "shorten it", seconds)
        yield from self.check_controls(vehicle, context)
        if self.continues is not None:
            yield from self._check_continued(self.continues, vehicle, context)
        yield from check_names("start.joints", self.start.joints, vehicle.joints, "joint")
        yield from check_mark("start", self.start, vehicle)
        yield from check_inside("start.position", self.start.position, vehicle, context.world)
        if not is_planar(vehicle):
            yield from check_free("start.position", self.start.position, 0.0, context.world)
            yield from check_clear("start.position", self.start.position, self.start, vehicle, context.world)

    def solve(self, vehicle: Vehicle, context: Context, progress: Progress) -> tuple[Clip, dict[str, Any]]:
        from vehsim.simulation import simulate

        controls = self.controls(vehicle, context)
        clip = simulate(
            vehicle,
            context.world,
            controls,
            start=self._start(vehicle, context),
            duration=self.seconds(context),
            step=self.step,
            fps=context.fps,
            start_frame=context.first,
            everywhere=self.everywhere,
            after=self.continued(vehicle, context),
            progress=progress,
        )
        details = {"step": self.step, "duration": clip.duration}
        return clip, details | ({"targets": controls.targets(clip.duration)} if hasattr(controls, "targets") else {})

    def mover(self, vehicle: Vehicle, context: Context) -> tuple[Mover, float]:
        """The same for vehicles that move together, and the duration, s."""
        from vehsim.simulation import Mover

        start = self._start(vehicle, context)
        return Mover(vehicle, self.controls(vehicle, context), start), self.seconds(context)

    def continued(self, vehicle: Vehicle, context: Context) -> Clip | None:
        """The motion that is continued, if any."""
        return None if self.continues is None else load_clip(self.continues, vehicle, context)

    def _check_continued(self, path: str, vehicle: Vehicle, context: Context) -> Iterator[Problem]:
        from vehsim.continuation import changed_surroundings

        wrong = list(check_clip("continues", path, vehicle, context))
        yield from wrong
        if wrong:
            return
        clip = load_clip(path, vehicle, context)
        if clip.ending is None:
            remedy = 'give what --to npz wrote of a motion of method "simulate" or "sticks"'
            yield Problem("continues", "was not simulated, so it cannot be continued", remedy, path)
        elif clip.start_frame != context.first:
            message = f"starts at frame {clip.start_frame}, this motion at {context.first}"
            yield Problem("continues", message, "give the shot the start_frame and the handles of that motion", path)
        elif clip.duration > self.seconds(context) + 1e-9:
            message = f"reaches frame {clip.end_frame}, beyond the end of this motion"
            yield Problem("continues", message, "give a later end_frame, or a longer duration", path)
        else:
            try:
                changed = changed_surroundings(clip, context.world)
            except InputError as error:
                message = f"{error.message}: it was changed after its simulation, as by vehsim retouch"
                remedy = "continue what the simulation's own --to npz wrote; then retouch the longer motion"
                yield Problem("continues", message, remedy, path)
                return
            for key, (there, here) in changed.items():
                yield Problem("continues", f"had {key} = {there}, this shot has {here}", "give it the same", path)

    def _start(self, vehicle: Vehicle, context: Context) -> State | None:
        """The start; None where `vehsim.simulate` chooses it."""
        from vehsim.planning.trim import flies

        if not (self.start.model_fields_set or flies(vehicle)):
            return None
        given, water = self.start, context.world.water
        rides = given.afloat and given.orientation is None and not np.any([*given.spin, given.velocity[2]])
        if not rides or water is None or vehicle.hull is None:
            return as_state(given, vehicle, context.world.wind)
        from vehsim.world.water.buoyancy import Afloat

        heading, z = float(np.deg2rad(given.heading or 0.0)), given.position[2]
        afloat = Afloat(vehicle, context.world)
        start = afloat.riding(given.position[:2], heading, given.velocity[:2])
        keel = start.position[2] + vehicle.origin[2] + float(afloat.hull.points[:, 2].min())
        if context.world.height(given.position[:2])[0] > keel:  # aground
            return as_state(given, vehicle, context.world.wind)
        far = min(abs(z - start.position[2]), abs(z - water.level)) > FAR
        if far and "position" in given.model_fields_set:
            warnings.warn(
                f"{vehicle.name}: starts at z = {z:.2f} m and was put on the water, at {start.position[2]:.2f} m; "
                "start it there, or write afloat = false to drop it",
                stacklevel=2,
            )
        return start

    def seconds(self, context: Context) -> float:
        """The duration, s."""
        raise NotImplementedError

    def check_controls(self, vehicle: Vehicle, context: Context) -> Iterator[Problem]:
        """The problems of what gives the controls."""
        raise NotImplementedError

    def controls(self, vehicle: Vehicle, context: Context) -> Any:
        """The controls for `vehsim.simulate`."""
        raise NotImplementedError


def linear(curves: Sequence[tuple[Values, Values]]) -> Callable[[float, Any], Values]:
    """A law for `vehsim.simulate` from the times, s, and values of each control: linear between, constant beyond.

    At the time of a row it gives the row's values exactly.
    """
    rounded = [(np.round(times, SAME), values) for times, values in curves]

    def law(t: float, state: Any) -> Values:
        return np.array([np.interp(np.round(t, SAME), times, values) for times, values in rounded])

    law.blind = True  # type: ignore[attr-defined]  # read by `Forced`: it ignores the state
    return law


class SimulateMotion(ForwardMotion):
    """``method = "simulate"``: forward simulation from a start, with commands or a pilot."""

    method: Literal["simulate"]
    """plan, simulate, sticks, integrate, sinusoid or clip"""
    duration: Annotated[Positive, Field(le=MAX_FRAMES)] | None = None
    """the duration in s; default: until the shot's end_frame"""
    commands: (
        Annotated[list[Annotated[dict[str, Number], BeforeValidator(lambda v: _command(v))]], Array, Len(1, MAX_FRAMES)]
        | None
    ) = None
    """a list of { frame = ..., control = value, ... }: linear between rows, constant before and after, angles in
    degrees; default: no controls"""
    pilot: PilotTable | None = None
    """a table { name = ..., parameters }, instead of commands"""

    def check_controls(self, vehicle: Vehicle, context: Context) -> Iterator[Problem]:
        if self.duration is None and context.last is None:
            yield Problem("duration", "missing", "give the duration in seconds, or shot.end_frame")
        if self.commands is not None and self.pilot is not None:
            yield Problem("pilot", "commands are given too", "keep one of them", self.pilot.name)
        if self.pilot is not None:
            wrong = list(self.pilot.check(vehicle))
            yield from wrong or filter(None, [self.pilot.refusal(vehicle)])
        yield from self._check_commands(vehicle)

    def seconds(self, context: Context) -> float:
        if self.duration is not None:
            return self.duration
        return context.seconds(context.last if context.last is not None else context.first)

    def _check_commands(self, vehicle: Vehicle) -> Iterator[Problem]:
        last = -np.inf
        for i, row in enumerate(self.commands or ()):
            names = {name: value for name, value in row.items() if name != "frame"}
            yield from check_names(f"commands[{i}]", names, vehicle.control_names, "control")
            for name, value in to_si(names, vehicle).items():
                control = vehicle.controls[vehicle.control_names.index(name)]
                if not control.lower - 1e-9 <= value <= control.upper + 1e-9:
                    remedy = f"this vehicle takes {control.lower:g} to {control.upper:g} {control.unit}".rstrip()
                    yield Problem(f"commands[{i}].{name}", "beyond the vehicle's bounds", remedy, names[name])
            if row["frame"] <= last:
                yield Problem(f"commands[{i}].frame", "not after the one before it", "put them in order", row["frame"])
            last = row["frame"]

    def controls(self, vehicle: Vehicle, context: Context) -> Any:
        if self.pilot is not None:
            from vehsim.pilots.controllers import PILOTS

            return PILOTS[self.pilot.name](vehicle, **self.pilot.parameters())
        rows = self.commands or []
        curves: list[tuple[Values, Values]] = []
        for name in vehicle.control_names:
            knots = [(context.seconds(row["frame"]), to_si(row, vehicle)[name]) for row in rows if name in row]
            times, values = np.array(knots or [(0.0, 0.0)]).T
            curves.append((times, values))
        return linear(curves)


def _command(value: Any) -> Any:
    if isinstance(value, dict) and "frame" not in value:
        raise ValueError("no frame")
    return value
