"""``method = "sinusoid"``: parking a car, reversing a trailer, turning a hopper over, in closed form.

This module holds the animator's table and its checks; `vehsim.sinusoids` steers vehicles.
"""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from dataclasses import replace
from itertools import pairwise, product
from typing import TYPE_CHECKING, Annotated, Any, Literal

import numpy as np
from annotated_types import Len
from pydantic import Field

from vehsim.errors import InputError, Problem, SolveError, VehsimError
from vehsim.intake.tables import table_of
from vehsim.requests.mark_frame import Timed
from vehsim.runtime.progress import Progress, silent
from vehsim.shot.checks import Context, check_names, check_order
from vehsim.shot.schema.tables import (
    MAX_FRAMES,
    Array,
    Heading,
    InSchema,
    MarkFrame,
    NotNegative,
    Number,
    Place,
    Positive,
    Table,
)
from vehsim.vehicles.definition.character import DEFAULT, STUNT, CharacterName

if TYPE_CHECKING:
    from vehsim.clip.clip import Clip
    from vehsim.requests import Ask
    from vehsim.sinusoids.manoeuvres.manoeuvres import Manoeuvre
    from vehsim.sinusoids.manoeuvres.options import SinusoidOptions
    from vehsim.sinusoids.manoeuvres.rigs import Rigged
    from vehsim.sinusoids.steering import Steering
    from vehsim.vehicles import Vehicle

LIMITS = {"speed": 1.0, "steering": np.pi / 180, "steering_rate": np.pi / 180, "hitch": np.pi / 180}
FLIGHT_LIMITS = {"leg_rate": np.pi / 180, "stretch_rate": 1.0}
"""Limit of the file -> its unit in SI, for vehicles on wheels and for hoppers."""
SLOWER = (1.1, 1.2, 1.35, 1.5, 1.75, 2.0, 2.5, 3.0)
"""Factors by which a manoeuvre may be slowed to avoid a moving obstacle."""
MEASURED = {"speed": "m/s", "steering": "rad", "steering_rate": "rad"}
"""Limits that an audit measures: their units."""
_STATES = {"steering": "phi", "leg_rate": "psi_rate", "stretch_rate": "l_rate"}


class RestMark(Timed, Table):
    """``[[vehicle.motion.mark]]`` of a sinusoid: a place to stand at rest."""

    frame: MarkFrame
    """a whole frame, or "free": as soon as the limits permit"""
    position: Place
    """the position of the rig's root, [x, y, z] in m"""
    heading: Heading = 0.0
    """the yaw of the vehicle's nose from world X in degrees, counter-clockwise"""
    pitch: Heading = 0.0
    """for hoppers, the rotation of the body about its own Y axis, in degrees, nose down; full turns count, 360 is a
    flip"""
    joints: dict[str, Number] = Field(default={})
    """a table of joint values, in the vehicle's own units; default: 0, straight wheels and trailers in line"""
    hold: Annotated[int, Field(ge=0, le=MAX_FRAMES)] = 0
    """the number of frames to stay there"""

    @property
    def tolerance(self) -> float:
        return 0.0


class SinusoidMotion(Table):
    """``method = "sinusoid"``: from rest to rest by sinusoids, one of several manoeuvres between two marks."""

    method: Literal["sinusoid"]
    """plan, simulate, sticks, integrate, sinusoid or clip"""
    mark: Annotated[list[RestMark], Array, Len(2, 100)]
    """two or more [[vehicle.motion.mark]] tables; exactly two for hoppers"""
    manoeuvre: Annotated[int, Field(ge=1, le=1000)] | None = None
    """a number from `vehsim manoeuvres`; default: the fastest clear manoeuvre"""
    amplitude: Annotated[Number, Field(ge=-1000, le=1000)] | None = None
    """the amplitude of the slow sinusoid: m that the car drives, or degrees that the leg swings; the sign selects the
    side on which it starts; default: several are tried"""
    cycles: Annotated[int, Field(ge=1, le=50)] | None = None
    """the number of loops, 1 to 50; default: several are tried"""
    phase: Heading | None = None
    """the phase at which the slow sinusoid starts, in degrees; default: several are tried"""
    clearance: Annotated[NotNegative, Field(le=1000)] = 0.1
    """the least distance of every body of the vehicle from obstacles, in m"""
    character: CharacterName = DEFAULT
    """how fast it steers and how fast its forces change by default: "calm", "normal", "brisk" or "stunt" (as fast as
    its controls permit)"""
    limits: Annotated[
        dict[str, Positive],
        InSchema(lambda own: table_of(dict.fromkeys([*LIMITS, *FLIGHT_LIMITS], own["additionalProperties"]))),
    ] = Field(default={})
    """speed in m/s, steering and hitch in degrees, steering_rate in deg/s; leg_rate in deg/s and stretch_rate in m/s"""

    def check(self, vehicle: Vehicle, context: Context) -> Iterator[Problem]:
        try:
            flies = not self._rig(vehicle).outlines and vehicle.group.dim == 6
        except InputError as error:
            yield error.problem.seen_from("method", "sinusoid", "give it another method")
            return
        yield from check_order(self.mark, context)  # type: ignore[arg-type]  # a list of marks
        known = FLIGHT_LIMITS if flies else {name: 1.0 for name in LIMITS if name != "hitch" or len(vehicle.joints) > 2}
        wrong = list(check_names("limits", self.limits, known, "limit"))
        yield from wrong
        if flies and len(self.mark) != 2:
            yield Problem(
                "mark", f"{len(self.mark)} marks", "a hop has two marks, take-off and landing", len(self.mark)
            )
        for i, mark in enumerate(self.mark):
            yield from check_names(f"mark[{i}].joints", mark.joints, vehicle.joints, "joint")
            if mark.hold and flies:
                yield Problem(f"mark[{i}].hold", "a hop ends as it lands", "remove it; give shot.end_frame", mark.hold)
            if mark.pitch and not flies:
                yield Problem(f"mark[{i}].pitch", "wheels stay on the ground", "leave it out", mark.pitch)
        if not wrong:
            yield from self._check_joints(vehicle)
        if not flies:
            yield from self._check_durations(vehicle, context)
        if flies and self.mark[0].heading != self.mark[-1].heading:
            remedy = f"give {self.mark[0].heading:g}: its leg turns it about its own Y axis only"
            yield Problem(
                f"mark[{len(self.mark) - 1}].heading", "differs from the take-off's", remedy, self.mark[-1].heading
            )
        if not flies:
            from vehsim.shot.world.obstacle_tables import check_marks

            yield from check_marks(self.mark, vehicle, context.world, self.clearance)  # type: ignore[arg-type]  # a list of marks

    def _check_joints(self, vehicle: Vehicle) -> Iterator[Problem]:
        rig = self._rig(vehicle)
        reach = rig.reach(self._sinusoid_options(rig).limits)
        for i, mark in enumerate(self.mark):
            for name, value in mark.joints.items():
                key = f"mark[{i}].joints.{name}"
                if name in vehicle.joints and name not in reach:
                    yield Problem(key, "follows from the driven path", "leave it out", value)
                elif name in reach and not reach[name][0] <= value <= reach[name][1]:
                    remedy = f"give {reach[name][0]:.4g} to {reach[name][1]:.4g}"
                    yield Problem(key, "beyond its limits", remedy, value)

    def _check_durations(self, vehicle: Vehicle, context: Context) -> Iterator[Problem]:
        """A vehicle on wheels has at least the time for the straight path; otherwise every manoeuvre is tried, to find
        possible frames. Trailers use legs that contain no sinusoids."""
        rig = self._rig(vehicle)
        speed = self._sinusoid_options(rig).limits.get("speed", rig.limits["speed"])
        short = False
        for a, b in pairwise(self.mark):
            leave, arrive = a.given_frame, b.given_frame
            if leave is None or arrive is None or arrive <= leave + a.hold:
                continue
            # the axle, not the root, is steered
            distance = float(np.linalg.norm(self._state(b, rig)[:2] - self._state(a, rig)[:2]))
            short = short or distance / speed > float((arrive - leave - a.hold) / context.fps) * (1 + 1e-6)
        if short:
            try:
                late = self._in_time(vehicle, context, silent)[3]
            except SolveError as error:
                yield error.problem.seen_from("mark", remedy="move a mark, or give it another method")
                return
            yield from (problem for problem in late if problem.key != "shot.end_frame")
        for name in ("amplitude", "cycles", "phase"):
            value = getattr(self, name)
            if value is not None and len(vehicle.joints) > 2:
                message = "not used: trailers are steered by legs without sinusoids"
                yield Problem(name, message, "leave it out", value, severity="warning")

    def offers(self, vehicle: Vehicle, context: Context) -> list[list[Manoeuvre]]:
        """Every manoeuvre between neighbouring marks. Raises ``SolveError`` if there is none."""
        from vehsim.sinusoids.manoeuvres.manoeuvres import manoeuvres

        rig, found = self._rig(vehicle), []
        for k, (a, b) in enumerate(pairwise(self._state(mark, rig) for mark in self.mark), 1):
            try:
                found.append(manoeuvres(rig, a, b, self._sinusoid_options(rig), context.world, self.manoeuvre))
            except VehsimError as error:
                raise SolveError.of(error.problem.seen_from(f"mark[{k}]")) from None
        return found

    def solve(self, vehicle: Vehicle, context: Context, progress: Progress) -> tuple[Clip, dict[str, Any]]:
        from vehsim.sinusoids.manoeuvres.manoeuvres import joined
        from vehsim.sinusoids.manoeuvres.rigs import clip_of

        rig, fps = self._rig(vehicle), float(context.fps)
        driven, parts, taken, late = self._in_time(vehicle, context, progress)
        if late:
            raise SolveError.of(*(replace(problem, subject=vehicle.name) for problem in late))
        if driven.character != self.character:
            warnings.warn(
                f"{vehicle.name}: driven as {driven.character}: the marks leave too little time for {self.character}; "
                "give later frames",
                stacklevel=2,
            )
        options = driven._sinusoid_options(rig)
        whole = joined(parts, [mark.hold / fps for mark in self.mark[1:]])
        begin = int(self.mark[0].frame) + self.mark[0].hold
        clip = clip_of(whole, vehicle, context.fps, begin, height=self.mark[0].position[2], **rig.flight)
        details = {"manoeuvres": taken, "end_error": whole.end_error, "duration": whole.duration}
        marks = [mark.model_dump(mode="json", exclude_unset=True) for mark in self.mark]
        asks = self._asks(vehicle, context, [round(steering.duration * fps) for steering in parts])
        asks_as_data = [ask.as_dict() for ask in asks]
        return clip, details | {
            "character": driven.character,
            "limits": dict(options.limits),
            "marks": marks,
            "asks": asks_as_data,
        }

    def _asks(self, vehicle: Vehicle, context: Context, driven: list[int]) -> Iterator[Ask]:
        """The asks of marks, limits and obstacles for a motion whose legs take ``driven`` frames each."""
        from vehsim.lie.quaternions import yaw_tilt
        from vehsim.requests import Ask, clearance_ask, limit_asks, mark_asks

        frame, planar = int(self.mark[0].frame), vehicle.group.planar
        first = frame
        for k, (mark, frames) in enumerate(zip(self.mark, [*driven, 0], strict=True)):
            turn = np.deg2rad([mark.heading, mark.pitch, 0.0])
            if (given := mark.given_frame) is not None:
                yield Ask(f"mark[{k}].frame", "frame", given, given, lower=frame, upper=frame)
            yield from mark_asks(
                f"mark[{k}]",
                frame,
                hold=mark.hold,
                position=mark.position,
                heading=float(turn[0]) if planar else None,
                orientation=None if planar else yaw_tilt(*turn[:, None])[0].tolist(),
                velocity=(0.0, 0.0, 0.0) if planar else None,
                joints=mark.joints,
                planar=planar,
            )
            frame += mark.hold + frames
        limits = {
            name: (value * LIMITS[name], MEASURED[name]) for name, value in self.limits.items() if name in MEASURED
        }
        yield from limit_asks(first, frame, limits, {}, {})
        if context.world.obstacles:
            yield clearance_ask(first, frame, self.clearance, planar=True)  # not from the ground, which it hops off

    def _in_time(
        self, vehicle: Vehicle, context: Context, progress: Progress
    ) -> tuple[SinusoidMotion, list[Steering], list[dict[str, Any]], list[Problem]]:
        """The motion in its character, or as a stunt where its frames leave too little time for that, and its `_legs`:
        a character makes no motion fail."""
        found = self._legs(vehicle, context, progress)
        if found[2] and self.character != STUNT:
            stunt = self.model_copy(update={"character": STUNT})
            return stunt, *stunt._legs(vehicle, context, progress)
        return self, *found

    def _legs(
        self, vehicle: Vehicle, context: Context, progress: Progress
    ) -> tuple[list[Steering], list[dict[str, Any]], list[Problem]]:
        """The steering from mark to mark, the text for the report, and the impossible frames: their key, the frame, the
        reason and a possible frame. After an impossible frame, everything starts that much later."""
        from vehsim.sinusoids.manoeuvres.manoeuvres import clearance

        rig, fps = self._rig(vehicle), float(context.fps)
        parts, taken = [], []
        late: list[Problem] = []
        frame = int(self.mark[0].frame) + self.mark[0].hold
        for k, offers in enumerate(self.offers(vehicle, context), 1):
            progress("steering", (k - 1) / (len(self.mark) - 1))
            if context.world.moving:
                offers = [replace(m, clearance=clearance(m.steering, rig, context.world, frame / fps)) for m in offers]
            mark = self.mark[k]
            try:
                chosen, steering, gap = self._leg(rig, offers, context, frame, mark.given_frame)
            except VehsimError as error:
                raise SolveError.of(replace(error.problem.seen_from(f"mark[{k}]"), subject=vehicle.name)) from None
            frame += round(steering.duration * fps)
            if mark.given_frame not in (None, frame):
                why = "too early" if int(mark.frame) < frame else "too close to a moving obstacle"
                remedy = f"use {frame}, with {chosen.label!r}"
                late.append(Problem(f"mark[{k}].frame", why, remedy, int(mark.frame)))
            frame += mark.hold
            parts.append(steering)
            taken.append({"manoeuvre": chosen.number, "label": chosen.label, "clearance": gap, "of": len(offers)})
        if late and context.last is not None and frame > context.last:
            late.append(Problem("shot.end_frame", "too early for these marks", f"use {frame}", context.last))
        return parts, taken, late

    def _leg(
        self, rig: Rigged, offers: list[Manoeuvre], context: Context, frame: int, until: int | None
    ) -> tuple[Manoeuvre, Steering, float]:
        """The manoeuvre from ``frame`` on, timed, and its clearance, m.

        It ends on frame ``until``, or as soon as possible if that is None or too early for every manoeuvre.
        """
        from vehsim.sinusoids.manoeuvres.manoeuvres import choose_manoeuvre, clearance, timed_clip

        choose_manoeuvre(offers, self.manoeuvre, self.clearance)  # raises if none is possible
        if self.manoeuvre is None:
            allowed = sorted((m for m in offers if m.clearance >= self.clearance), key=lambda m: m.steering.duration)
        else:
            allowed = [m for m in offers if m.number == self.manoeuvre]
        reasons = []

        def timed(chosen: Manoeuvre, seconds: float | None) -> tuple[Manoeuvre, Steering, float] | None:
            try:
                steering, _ = timed_clip(rig, chosen.steering, seconds, context.fps, frame, self._traits(rig)[1])
            except SolveError as error:
                reasons.append(f"{chosen.number}, {chosen.label}: {error}")
                return None
            gap = clearance(steering, rig, context.world, frame / float(context.fps))
            if gap >= self.clearance:
                return chosen, steering, gap
            reasons.append(f"{chosen.number}, {chosen.label}: {gap:.2f} m from an obstacle, not {self.clearance:g} m")
            return None

        room = -1.0 if until is None else float((until - frame) / context.fps)
        for chosen in allowed:
            if chosen.steering.duration <= room * (1 + 1e-9) and (found := timed(chosen, room)):
                return found
        for chosen in allowed:
            if found := timed(chosen, None):
                return found
        if context.world.moving:  # a moving obstacle may have left a little later
            for chosen, share in product(allowed[:3], SLOWER):
                frames = np.ceil(share * chosen.steering.duration * float(context.fps))
                if found := timed(chosen, float(frames / context.fps)):
                    return found
        raise SolveError(
            f"none of {len(allowed)} manoeuvres works here: {'; '.join(reasons[:4])}",
            "choose another (vehsim manoeuvres), reduce the clearance, or move the mark",
        )

    def _rig(self, vehicle: Vehicle) -> Rigged:
        from vehsim.sinusoids.manoeuvres.rigs import rigged

        first, last = self.mark[0], self.mark[-1]
        return rigged(
            vehicle,
            take_off=tuple(first.position),
            landing=tuple(last.position),
            heading=float(np.deg2rad(first.heading)),
        )

    def _traits(self, rig: Rigged) -> tuple[dict[str, float], dict[str, float]]:
        """The character's limits on inputs, and those on the rates of controls, SI."""
        if self.character == STUNT:
            return {}, {}
        traits, inputs = rig.vehicle.character, rig.limits
        limits = {
            name: min(trait.of(self.character), inputs[name]) for name, trait in traits.limits.items() if name in inputs
        }
        return limits, {name: trait.of(self.character) for name, trait in traits.control_rates.items()}

    def _sinusoid_options(self, rig: Rigged) -> SinusoidOptions:
        from vehsim.sinusoids.manoeuvres.options import SinusoidOptions

        hops = rig.vehicle.group.dim == 6
        units = LIMITS | FLIGHT_LIMITS
        limits = {_STATES.get(name, name): value * units[name] for name, value in self.limits.items()}
        limits = self._traits(rig)[0] | limits
        if hops and "l_rate" in limits:
            limits["l_rate"] /= rig.leg_length  # type: ignore[attr-defined]  # only the hopper flies
        amplitude = None if self.amplitude is None else self.amplitude * (np.pi / 180 if hops else 1.0)
        return SinusoidOptions(
            amplitude, self.cycles, None if self.phase is None else float(np.deg2rad(self.phase)), limits
        )

    def _state(self, mark: RestMark, rig: Rigged) -> Any:
        from vehsim.lie.quaternions import from_yaw
        from vehsim.vehicles import State

        joints = np.array([mark.joints.get(name, 0.0) for name in rig.vehicle.joints])
        x = rig.state(State(tuple(mark.position), from_yaw(np.deg2rad(mark.heading)), joints=joints))
        names = list(rig.system.states)
        if "psi" in names:
            x[names.index("theta")] += np.deg2rad(mark.pitch)
        return x
