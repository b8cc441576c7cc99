"""``method = "sinusoid"``: a car parked, a trailer reversed, a hopper turned over by sinusoids, in closed form.

What belongs here is the table an animator writes and what is wrong with it; how vehicles are steered is
`vehsim.sinusoids`.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import numpy as np
from annotated_types import Len
from pydantic import Field

from vehsim.errors import InputError, Problem, SolveError, VehsimError
from vehsim.shot.checks import Setting, check_names, check_order
from vehsim.shot.model import (
    MAX_FRAMES,
    Array,
    Heading,
    InSchema,
    MarkFrame,
    NotNegative,
    Number,
    Point,
    Positive,
    Table,
    table_of,
)

if TYPE_CHECKING:
    from vehsim.clip import Clip
    from vehsim.shot.shot import Shot
    from vehsim.sinusoids.manoeuvres import Manoeuvre, Wish
    from vehsim.sinusoids.rigs import Rigged
    from vehsim.take import Progress
    from vehsim.vehicles import Vehicle

LIMITS = {"speed": 1.0, "steering": np.pi / 180, "steering_rate": np.pi / 180, "hitch": np.pi / 180}
FLIGHT_LIMITS = {"leg_rate": np.pi / 180, "stretch_rate": 1.0}
"""Limit of the file -> what one of its units is in SI; those of what drives, and of what hops."""
_STATES = {"steering": "phi", "leg_rate": "psi_rate", "stretch_rate": "l_rate"}


class RestMark(Table):
    """``[[vehicle.motion.mark]]`` of a sinusoid: a place to stand at rest."""

    frame: MarkFrame
    """a whole frame, or "free": as soon as the limits let it"""
    position: Point
    """where the rig's root stands, [x, y, z] in m"""
    heading: Heading = 0.0
    """the yaw of the vehicle's nose from world X in degrees, counter-clockwise"""
    pitch: Heading = 0.0
    """what hops: how far its body is turned about its own Y, in degrees, nose down; full turns count, 360 is a flip"""
    joints: dict[str, Number] = Field(default={})
    """a table of joint values, in the vehicle's own units; 0 unless given: straight wheels and trailers in line"""
    hold: Annotated[int, Field(ge=0, le=MAX_FRAMES)] = 0
    """how many frames to stay there"""

    @property
    def tolerance(self) -> float:
        return 0.0


class SinusoidMotion(Table):
    """``method = "sinusoid"``: from rest to rest by sinusoids, one manoeuvre of several between two marks."""

    method: Literal["sinusoid"]
    """plan, simulate, integrate, sinusoid or clip"""
    mark: Annotated[list[RestMark], Array, Len(2, 100)]
    """two or more [[vehicle.motion.mark]] tables; exactly two for what hops"""
    manoeuvre: Annotated[int, Field(ge=1, le=1000)] | None = None
    """a number from `vehsim manoeuvres`; the quickest that keeps clear unless given"""
    amplitude: Annotated[Number, Field(ge=-1000, le=1000)] | None = None
    """of the slow sinusoid: m driven to and fro, degrees the leg swings; its sign is the side it begins on; several are
    offered unless given"""
    cycles: Annotated[int, Field(ge=1, le=50)] | None = None
    """how many loops, 1 to 50; several are offered unless given"""
    phase: Heading | None = None
    """where in its period the slow sinusoid begins, in degrees; several are offered unless given"""
    clearance: Annotated[NotNegative, Field(le=1000)] = 0.1
    """how far every body of the vehicle stays from obstacles, in m"""
    limits: Annotated[
        dict[str, Positive],
        InSchema(lambda own: table_of(dict.fromkeys([*LIMITS, *FLIGHT_LIMITS], own["additionalProperties"]))),
    ] = Field(default={})
    """speed in m/s, steering and hitch in degrees, steering_rate in deg/s; leg_rate in deg/s and stretch_rate in m/s"""

    def check(self, vehicle: Vehicle, setting: Setting) -> Iterator[Problem]:
        try:
            flies = not self._rig(vehicle).outlines and vehicle.group.dim == 6
        except InputError as error:
            yield Problem("method", str(error), "give it another method", "sinusoid")
            return
        yield from check_order(self.mark, setting)  # type: ignore[arg-type]
        yield from check_names("limits", self.limits, FLIGHT_LIMITS if flies else LIMITS, "limit")
        if flies and len(self.mark) != 2:
            yield Problem("mark", f"{len(self.mark)} marks", "a hop has two, take-off and landing", len(self.mark))
        for i, mark in enumerate(self.mark):
            yield from check_names(f"mark[{i}].joints", mark.joints, vehicle.joints, "joint")
            if mark.pitch and not flies:
                yield Problem(f"mark[{i}].pitch", "wheels stay on the ground", "leave it out", mark.pitch)
        if flies and self.mark[0].heading != self.mark[-1].heading:
            mend = f"give {self.mark[0].heading:g}: its leg turns it about its own Y alone"
            yield Problem(
                f"mark[{len(self.mark) - 1}].heading", "differs from the take-off's", mend, self.mark[-1].heading
            )
        if not flies:
            from vehsim.shot.obstacles import check_marks

            yield from check_marks(self.mark, vehicle, setting.world, self.clearance)  # type: ignore[arg-type]

    def offers(self, vehicle: Vehicle, setting: Setting) -> list[list[Manoeuvre]]:
        """Every manoeuvre between each two marks. Raises ``SolveError`` where there is none."""
        from vehsim.sinusoids.manoeuvres import manoeuvres

        rig, found = self._rig(vehicle), []
        for k, (a, b) in enumerate(pairwise(self._state(mark, rig) for mark in self.mark), 1):
            try:
                found.append(manoeuvres(rig, a, b, self._wish(rig), setting.world, self.manoeuvre))
            except VehsimError as error:
                raise SolveError(f"mark[{k}]: {error}") from None
        return found

    def solve(self, vehicle: Vehicle, setting: Setting, progress: Progress) -> tuple[Clip, dict[str, Any]]:
        from vehsim.sinusoids.manoeuvres import choose_manoeuvre, clearance, joined, timed_clip

        rig, wish = self._rig(vehicle), self._wish(self._rig(vehicle))
        parts, taken, frame = [], [], int(self.mark[0].frame)
        frame += self.mark[0].hold
        begin = frame
        holds = [mark.hold / float(setting.fps) for mark in self.mark]
        for k, offers in enumerate(self.offers(vehicle, setting)):
            progress("steering", k / (len(self.mark) - 1))
            if setting.world.moving:
                begun = frame / float(setting.fps)
                offers = [replace(m, clearance=clearance(m.steering, rig, setting.world, begun)) for m in offers]
            until = self.mark[k + 1].frame
            seconds = None if until == "free" else float((int(until) - frame) / setting.fps)
            try:
                chosen = choose_manoeuvre(offers, self.manoeuvre, self.clearance)
                steering, _ = timed_clip(rig, chosen.steering, seconds, setting.fps, frame)
            except VehsimError as error:
                raise SolveError(f"{vehicle.name}: mark[{k + 1}]: {error}") from None
            gap = clearance(steering, rig, setting.world, frame / float(setting.fps))
            if gap < self.clearance:
                raise SolveError(
                    f"{vehicle.name}: mark[{k + 1}]: manoeuvre {chosen.number} comes to {gap:.2f} m of "
                    f"an obstacle, {self.clearance:g} m are asked for: choose another (vehsim manoeuvres) or frame"
                )
            parts.append(steering)
            taken.append({"manoeuvre": chosen.number, "label": chosen.label, "clearance": gap, "of": len(offers)})
            frame += round(steering.duration * float(setting.fps)) + self.mark[k + 1].hold
        whole = joined(parts, holds[1:])
        clip = whole.clip(vehicle, fps=setting.fps, start_frame=begin, height=self.mark[0].position[2], **rig.flight)
        said = {"manoeuvres": taken, "end_error": whole.end_error, "duration": whole.duration}
        marks = [mark.model_dump(mode="json", exclude_unset=True) for mark in self.mark]
        return clip, said | {"limits": dict(wish.limits), "marks": marks}

    def _rig(self, vehicle: Vehicle) -> Rigged:
        from vehsim.sinusoids.rigs import rigged

        first, last = self.mark[0], self.mark[-1]
        return rigged(
            vehicle,
            take_off=tuple(first.position),
            landing=tuple(last.position),
            heading=float(np.deg2rad(first.heading)),
        )

    def _wish(self, rig: Rigged) -> Wish:
        from vehsim.sinusoids.manoeuvres import Wish

        hops = rig.vehicle.group.dim == 6
        units = LIMITS | FLIGHT_LIMITS
        limits = {_STATES.get(name, name): value * units[name] for name, value in self.limits.items()}
        if hops and "l_rate" in limits:
            limits["l_rate"] /= rig.leg_length  # type: ignore[attr-defined]
        amplitude = None if self.amplitude is None else self.amplitude * (np.pi / 180 if hops else 1.0)
        return Wish(amplitude, self.cycles, None if self.phase is None else float(np.deg2rad(self.phase)), limits)

    def _state(self, mark: RestMark, rig: Rigged) -> Any:
        from vehsim.vehicles import State

        half = np.deg2rad(mark.heading) / 2
        joints = np.array([mark.joints.get(name, 0.0) for name in rig.vehicle.joints])
        x = rig.state(State(tuple(mark.position), (np.cos(half), 0.0, 0.0, np.sin(half)), joints=joints))
        names = list(rig.system.states)
        if "psi" in names:
            x[names.index("theta")] += np.deg2rad(mark.pitch)
        return x


def paint_offers(shot: Shot, folder: Path) -> Iterator[str]:
    """A line for every manoeuvre of a shot's vehicles; those that drive are painted, `<shot>.<vehicle>.<mark>.png`."""
    from vehsim.sinusoids.picture import paint

    shapes = [shape for obstacle in shot.world.obstacles for shape in obstacle.shapes_at(np.zeros(1))]
    corners = [np.asarray(getattr(shape, "outline", lambda s=shape: s)()).reshape(-1, 2) for shape in shapes]
    for table in shot.file.vehicle:
        if not isinstance(table.motion, SinusoidMotion):
            continue
        vehicle = shot.vehicle(table)
        outlines = table.motion._rig(vehicle).outlines
        for k, offers in enumerate(table.motion.offers(vehicle, shot._setting), 1):
            told = [_told(m) for m in offers]
            yield from (f"{shot.name}: {table.name}: mark[{k}]: {line}" for line in told)
            if outlines:
                path = folder / f"{shot.name}.{table.name}.{k}.png"
                painted = [replace(m.steering, label=line) for m, line in zip(offers, told, strict=True)]
                yield str(paint(painted, path, footprints=outlines, obstacles=corners))


def _told(m: Manoeuvre) -> str:
    """A manoeuvre in words, such as ``7, one sweep: 12.1 s, 0.31 m clear``."""
    room = f", {m.clearance:.2f} m clear" if m.clearance >= 0 else f", hits by {-m.clearance:.2f} m"
    return f"{m.number}, {m.label}: {m.steering.duration:.1f} s{room if np.isfinite(m.clearance) else ''}"
