"""``method = "sinusoid"``: a car parked, a trailer reversed, a hopper turned over by sinusoids, in closed form.

What belongs here is the table an animator writes and what is wrong with it; how vehicles are steered is
`vehsim.sinusoids`.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from itertools import pairwise, product
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import numpy as np
from annotated_types import Len
from pydantic import Field

from vehsim.errors import InputError, Problem, SolveError, VehsimError
from vehsim.intake.tables import table_of
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
)

if TYPE_CHECKING:
    from vehsim.clip import Clip
    from vehsim.requests import Ask
    from vehsim.shot.shot import Shot
    from vehsim.sinusoids.manoeuvres import Manoeuvre, Wish
    from vehsim.sinusoids.rigs import Rigged
    from vehsim.sinusoids.steering import Steering
    from vehsim.take import Progress
    from vehsim.vehicles import Vehicle

LIMITS = {"speed": 1.0, "steering": np.pi / 180, "steering_rate": np.pi / 180, "hitch": np.pi / 180}
FLIGHT_LIMITS = {"leg_rate": np.pi / 180, "stretch_rate": 1.0}
"""Limit of the file -> what one of its units is in SI; those of what drives, and of what hops."""
SLOWER = (1.1, 1.2, 1.35, 1.5, 1.75, 2.0, 2.5, 3.0)
"""How much longer a manoeuvre may take where something that moves is in its way."""
STEERED = ("steering", "steering_rate")
"""Limits that an audit measures on the joint that steers."""
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
        known = FLIGHT_LIMITS if flies else {name: 1.0 for name in LIMITS if name != "hitch" or len(vehicle.joints) > 2}
        wrong = list(check_names("limits", self.limits, known, "limit"))
        yield from wrong
        if flies and len(self.mark) != 2:
            yield Problem("mark", f"{len(self.mark)} marks", "a hop has two, take-off and landing", len(self.mark))
        for i, mark in enumerate(self.mark):
            yield from check_names(f"mark[{i}].joints", mark.joints, vehicle.joints, "joint")
            if mark.hold and flies:
                yield Problem(
                    f"mark[{i}].hold", "a hop ends as it lands", "leave it out; give shot.end_frame", mark.hold
                )
            if mark.pitch and not flies:
                yield Problem(f"mark[{i}].pitch", "wheels stay on the ground", "leave it out", mark.pitch)
        if not wrong:
            yield from self._check_joints(vehicle)
        if not flies:
            yield from self._check_way(vehicle, setting)
        if flies and self.mark[0].heading != self.mark[-1].heading:
            mend = f"give {self.mark[0].heading:g}: its leg turns it about its own Y alone"
            yield Problem(
                f"mark[{len(self.mark) - 1}].heading", "differs from the take-off's", mend, self.mark[-1].heading
            )
        if not flies:
            from vehsim.shot.obstacles import check_marks

            yield from check_marks(self.mark, vehicle, setting.world, self.clearance)  # type: ignore[arg-type]

    def _check_joints(self, vehicle: Vehicle) -> Iterator[Problem]:
        rig = self._rig(vehicle)
        reach = rig.reach(self._wish(rig).limits)
        for i, mark in enumerate(self.mark):
            for name, value in mark.joints.items():
                key = f"mark[{i}].joints.{name}"
                if name in vehicle.joints and name not in reach:
                    yield Problem(key, "follows from the way that is driven", "leave it out", value)
                elif name in reach and not reach[name][0] <= value <= reach[name][1]:
                    mend = f"give {reach[name][0]:.4g} to {reach[name][1]:.4g}"
                    yield Problem(key, "beyond what its limits allow", mend, value)

    def _check_way(self, vehicle: Vehicle, setting: Setting) -> Iterator[Problem]:
        """What drives has the time for the straight way at least: without it, every manoeuvre is tried, to name frames
        that would do. Trailers are driven in legs that have no sinusoids.
        """
        rig = self._rig(vehicle)
        speed = self._wish(rig).limits.get("speed", rig.limits["speed"])
        short = False
        for a, b in pairwise(self.mark):
            if a.frame == "free" or b.frame == "free" or b.frame <= a.frame + a.hold:
                continue
            # the axle, not the root, is what is driven
            way = float(np.linalg.norm(self._state(b, rig)[:2] - self._state(a, rig)[:2]))
            short = short or way / speed > float((b.frame - a.frame - a.hold) / setting.fps) * (1 + 1e-6)
        if short:
            try:
                late = self._legs(vehicle, setting, lambda what, done: None)[2]
            except SolveError as error:
                yield Problem("mark", str(error), "move a mark, or give it another method")
                return
            for key, frame, why in late:
                if not key.startswith("shot."):
                    message, mend = why.split("; ", 1)
                    yield Problem(key, message, mend, frame)
        for name in ("amplitude", "cycles", "phase"):
            value = getattr(self, name)
            if value is not None and len(vehicle.joints) > 2:
                message = "not used: trailers are driven in legs without sinusoids"
                yield Problem(name, message, "leave it out", value, severity="warning")

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
        from vehsim.sinusoids.manoeuvres import joined

        rig, wish, fps = self._rig(vehicle), self._wish(self._rig(vehicle)), float(setting.fps)
        parts, taken, late = self._legs(vehicle, setting, progress)
        if late:
            raise SolveError(f"{vehicle.name}: {'; '.join(f'{key} = {frame}: {why}' for key, frame, why in late)}")
        whole = joined(parts, [mark.hold / fps for mark in self.mark[1:]])
        begin = int(self.mark[0].frame) + self.mark[0].hold
        clip = whole.clip(vehicle, fps=setting.fps, start_frame=begin, height=self.mark[0].position[2], **rig.flight)
        said = {"manoeuvres": taken, "end_error": whole.end_error, "duration": whole.duration}
        marks = [mark.model_dump(mode="json", exclude_unset=True) for mark in self.mark]
        asks = self._asks(vehicle, setting, [round(steering.duration * fps) for steering in parts])
        asks_said = [ask.as_dict() for ask in asks]
        return clip, said | {"limits": dict(wish.limits), "marks": marks, "asks": asks_said}

    def _asks(self, vehicle: Vehicle, setting: Setting, driven: list[int]) -> Iterator[Ask]:
        """What the marks, limits and obstacles ask of a motion whose legs take ``driven`` frames each."""
        from vehsim._quaternions import yaw_tilt
        from vehsim.requests import Ask, limit_asks, mark_asks

        frame, planar = int(self.mark[0].frame), vehicle.group.planar
        first = frame
        for k, (mark, frames) in enumerate(zip(self.mark, [*driven, 0], strict=True)):
            turn = np.deg2rad([mark.heading, mark.pitch, 0.0])
            if mark.frame != "free":
                yield Ask(f"mark[{k}].frame", "frame", int(mark.frame), int(mark.frame), lower=frame, upper=frame)
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
        limits = {name: (value * LIMITS[name], "rad") for name, value in self.limits.items() if name in STEERED}
        yield from limit_asks(first, frame, limits, {}, {})
        if setting.world.obstacles:
            wanted = {"clearance": self.clearance, "obstacles_only": planar, "landings": [], "slope": 0.0}
            yield Ask("clearance", "clearance", first, frame, wanted, lower=self.clearance - 0.01, unit="m")

    def _legs(
        self, vehicle: Vehicle, setting: Setting, progress: Progress
    ) -> tuple[list[Steering], list[dict[str, Any]], list[tuple[str, int, str]]]:
        """What is driven from mark to mark, what the report says of it, and the frames that cannot be kept: their key,
        the frame and why, with one that would do. Where one cannot, what follows starts that much later.
        """
        from vehsim.sinusoids.manoeuvres import clearance

        rig, fps = self._rig(vehicle), float(setting.fps)
        parts, taken, late = [], [], []
        frame = int(self.mark[0].frame) + self.mark[0].hold
        for k, offers in enumerate(self.offers(vehicle, setting), 1):
            progress("steering", (k - 1) / (len(self.mark) - 1))
            if setting.world.moving:
                offers = [replace(m, clearance=clearance(m.steering, rig, setting.world, frame / fps)) for m in offers]
            mark = self.mark[k]
            try:
                chosen, steering, gap = self._leg(rig, offers, setting, frame, mark.frame)
            except VehsimError as error:
                raise SolveError(f"{vehicle.name}: mark[{k}]: {error}") from None
            frame += round(steering.duration * fps)
            if mark.frame not in ("free", frame):
                why = "too early" if int(mark.frame) < frame else "too near to an obstacle that moves"
                late.append((f"mark[{k}].frame", int(mark.frame), f"{why}; {frame} would do, with {chosen.label!r}"))
            frame += mark.hold
            parts.append(steering)
            taken.append({"manoeuvre": chosen.number, "label": chosen.label, "clearance": gap, "of": len(offers)})
        if late and setting.last is not None and frame > setting.last:
            late.append(("shot.end_frame", setting.last, f"too early then; {frame} would do"))
        return parts, taken, late

    def _leg(
        self, rig: Rigged, offers: list[Manoeuvre], setting: Setting, frame: int, until: Any
    ) -> tuple[Manoeuvre, Steering, float]:
        """The manoeuvre that is driven from ``frame`` on, timed, and how clear it keeps, m.

        It ends on frame ``until``; as soon as it can when that is "free", or too early for every one.
        """
        from vehsim.sinusoids.manoeuvres import choose_manoeuvre, clearance, timed_clip

        choose_manoeuvre(offers, self.manoeuvre, self.clearance)  # raises where none will do
        if self.manoeuvre is None:
            allowed = sorted((m for m in offers if m.clearance >= self.clearance), key=lambda m: m.steering.duration)
        else:
            allowed = [m for m in offers if m.number == self.manoeuvre]
        reasons = []

        def timed(chosen: Manoeuvre, seconds: float | None) -> tuple[Manoeuvre, Steering, float] | None:
            try:
                steering, _ = timed_clip(rig, chosen.steering, seconds, setting.fps, frame)
            except SolveError as error:
                reasons.append(f"{chosen.number}, {chosen.label}: {error}")
                return None
            gap = clearance(steering, rig, setting.world, frame / float(setting.fps))
            if gap >= self.clearance:
                return chosen, steering, gap
            reasons.append(f"{chosen.number}, {chosen.label}: {gap:.2f} m from an obstacle, not {self.clearance:g} m")
            return None

        room = -1.0 if until == "free" else float((int(until) - frame) / setting.fps)
        for chosen in allowed:
            if chosen.steering.duration <= room * (1 + 1e-9) and (found := timed(chosen, room)):
                return found
        for chosen in allowed:
            if found := timed(chosen, None):
                return found
        if setting.world.moving:  # what is in the way now may have left a little later
            for chosen, share in product(allowed[:3], SLOWER):
                frames = np.ceil(share * chosen.steering.duration * float(setting.fps))
                if found := timed(chosen, float(frames / setting.fps)):
                    return found
        raise SolveError(
            f"none of {len(allowed)} manoeuvres works here: {'; '.join(reasons[:4])}; choose another (vehsim "
            "manoeuvres), ask for less clearance, or move the mark"
        )

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
