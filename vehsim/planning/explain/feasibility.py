"""Find marks that bounds prove impossible before solving: by how much, and what would be possible."""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vehsim.constants import GRAVITY
from vehsim.lie import SO3
from vehsim.planning.explain.balance import out_of_balance
from vehsim.planning.explain.bounds import (
    Ball,
    gripping,
    least_time,
    polyline,
    push_of,
    slips,
    thrust_ball,
    uniform,
)
from vehsim.planning.explain.earliest import first_frame
from vehsim.planning.problem.transcription import transcribe
from vehsim.planning.request.marks import Mark, heading_of, leeway
from vehsim.planning.request.request import Request, whole_percent
from vehsim.planning.terms import Constraint
from vehsim.planning.trim import upright
from vehsim.vehicles.definition.mechanics import free_size
from vehsim.vehicles.definition.standing import SEEN, creep, peak, steepest
from vehsim.vehicles.definition.surfaces import SURFACES

Array = NDArray[np.float64]

DRIFT = 2e-3
"""Farthest creep during a hold when its controls are executed, m: less than can be seen. The planned hold stands."""


@dataclass(frozen=True)
class Refusal:
    """Why a mark cannot be met: its ``key``, the message, the remedy, and keys with values that would do together."""

    mark: Mark
    key: str
    message: str
    remedy: str
    fixes: tuple[tuple[str, float], ...] = ()
    value: float | None = None
    """That of one joint; the mark has all others."""

    def __str__(self) -> str:
        given = "" if self.value is None else f" = {self.value:g}"
        return f"{self.mark.name}.{self.key}{given}: {self.message}; {self.remedy}"


def refusals(request: Request) -> list[Refusal]:
    """Everything that limits and the vehicle's own strength rule out; empty if nothing is proven."""
    found = [refusal for mark in request.marks for refusal in _alone(request, mark)]
    known = [i for i, mark in enumerate(request.marks) if mark.given_frame is not None]
    delay = 0
    for i, j in pairwise(known):
        refused, later = _between(request, i, j, delay)
        found, delay = found + refused, delay + later
    weighed = transcribe(request.weighed)
    for mark, message, remedy in out_of_balance(request.vehicle, weighed, request.marks, request.wind):
        found.append(Refusal(mark, "hold" if mark.hold else "velocity", message, remedy))
    return found


def _alone(request: Request, mark: Mark) -> list[Refusal]:
    limits, found = request.limits, []
    speed = mark.speed if mark.velocity is None else float(np.linalg.norm(mark.velocity))
    top = request.top_speed
    if speed is not None and speed > top:
        key = "speed" if mark.velocity is None else "velocity"
        message = f"{speed:.3g} m/s, {request.speed_limit()}"
        fixes = ((f"{mark.name}.speed", top),) if key == "speed" else ()
        found.append(Refusal(mark, key, message, f"use at most {top:g} m/s, or raise limits.speed", fixes))
    ceiling = limits.get("ceiling")
    if mark.position is not None and mark.position[2] - mark.tolerance > ceiling and request.vehicle.group.dim == 6:
        message = f"{mark.position[2]:g} m high, ceiling {ceiling:g}"
        found.append(Refusal(mark, "position", message, f"put it below {ceiling:g} m, or raise limits.ceiling"))
    climb = limits.get("climb")
    if mark.velocity is not None and abs(mark.velocity[2]) > climb:
        message = f"{abs(mark.velocity[2]):g} m/s up or down, limit {climb:g}"
        found.append(Refusal(mark, "velocity", message, f"use at most {climb:g} m/s"))
    found += _bent_too_far(request, mark) + _sideways(request, mark)
    found += _too_steep(request, mark) or _creeps(request, mark)
    for term in request.constraints:
        found += _outside(request, mark, term) + _looks_elsewhere(mark, term)
    return found


def _bent_too_far(request: Request, mark: Mark) -> list[Refusal]:
    """Joints outside the vehicle's own bounds or the requested limits."""
    values = () if mark.joints is None else np.asarray(mark.joints, float)
    ranges, units, found = request.joint_ranges, request.vehicle.joint_units, []
    for name, value in zip(request.vehicle.joints, values, strict=False):
        low, high = ranges.get(name, (-math.inf, math.inf))
        if not (low - 1e-9 <= value <= high + 1e-9 or math.isnan(value)):
            message = f"outside {low:g} to {high:g} {units.get(name, 'rad')}".removesuffix(" 1")
            remedy = "keep it inside, or leave it free"
            found.append(Refusal(mark, f"joints.{name}", message, remedy, value=float(value)))
    return found


def _sideways(request: Request, mark: Mark) -> list[Refusal]:
    """A velocity that the wheels do not allow at the heading."""
    vehicle = request.vehicle
    nose = heading_of(mark)
    if nose is None or mark.velocity is None or mark.at_rest or not vehicle.group.planar:
        return []
    slip = math.degrees(math.atan2(mark.velocity[1], mark.velocity[0]) - nose)
    anywhere, most = slips(vehicle)
    off = min(abs((slip - turn + 180) % 360 - 180) for turn in (0, 180))
    if anywhere or off <= most + 0.5:
        return []
    allowed = "straight ahead or back" if most < 0.5 else f"within {most:.3g} degrees of ahead or back"
    message = f"{off:.3g} degrees off its heading: the {vehicle.name} rolls {allowed}"
    return [Refusal(mark, "velocity", message, "turn the heading or the velocity")]


def _too_steep(request: Request, mark: Mark) -> list[Refusal]:
    """A place on a slope where tyres cannot hold the vehicle at rest with the grip that is allowed."""
    grip = request.limits.get("grip")
    if not mark.at_rest or not math.isfinite(grip) or (steep := request.steepness(mark)) <= grip:
        return []
    friction = SURFACES[request.vehicle.surface].friction
    there = "" if friction == 1 else f" is {grip:.3g}"
    message = f"to rest on the slope there, tyres need {steep:.3g} g; {_given_grip(request)}{there}"
    enough = math.ceil(100 * steep / friction) / 100
    raised = f", or raise limits.grip to {enough:g}" if steep < friction else ""
    return [Refusal(mark, "position", message, f"move it to gentler ground{raised}")]


def _creeps(request: Request, mark: Mark) -> list[Refusal]:
    """A hold on a slope that tyres which may slip slide or creep down, farther than can be seen."""
    if not mark.hold or request.vehicle.standing is None:
        return []
    seconds = mark.hold / float(request.fps)
    most, steep = steepest(request.vehicle, min(SEEN, DRIFT / seconds)), request.steepness(mark)
    if steep <= most:
        return []
    slope, moves = f"on a slope of {100 * steep:.3g} %, the {request.vehicle.name}", "slides down"
    if steep < peak(request.vehicle):
        moves = f"creeps by {1e3 * seconds * creep(request.vehicle, steep):.2g} mm during the hold"
    message = f"{slope} {moves}, although it brakes: its tyres on {request.vehicle.surface} grip too little"
    return [Refusal(mark, "hold", message, f"hold on a slope of at most {whole_percent(most)}")]


def _given_grip(request: Request) -> str:
    """The limit of friction as it was given, on dry asphalt, and the surface."""
    surface = request.vehicle.surface
    return f"limits.grip = {request.limits.get('grip') / SURFACES[surface].friction:.3g} on {surface}"


def _applies(term: Constraint, mark: Mark) -> bool:
    """Whether a constraint certainly applies at a mark: always, or at frames that contain the given one."""
    frame = mark.given_frame
    return term.frames is None or (frame is not None and term.frames[0] <= frame <= term.frames[1])


def _looks_elsewhere(mark: Mark, term: Constraint) -> list[Refusal]:
    """A heading that contradicts a constraint to look at a point."""
    there = _applies(term, mark)
    if term.aim is None or not there or mark.heading is None or mark.position is None or leeway(mark):
        return []
    (point, aside), within = term.aim, math.degrees(math.acos(float(np.clip(term.lower, -1, 1))))
    displacement = np.subtract(point, mark.position)
    if np.linalg.norm(displacement[:2]) < 1e-3 or not mark.balanced:
        return []
    wanted = math.degrees(math.atan2(displacement[1], displacement[0]) - aside)
    off = abs((mark.heading - wanted + 180) % 360 - 180)
    if off <= within + 0.1:
        return []
    wanted = (wanted + 180) % 360 - 180
    remedy = f"give heading = {wanted:.3g}, or leave it free"
    message = f"{off:.3g} degrees off the direction that {term.name!r} requires"
    return [Refusal(mark, "heading", message, remedy, ((f"{mark.name}.heading", round(wanted, 1)),))]


def _outside(request: Request, mark: Mark, term: Constraint) -> list[Refusal]:
    """A mark outside the box of a constraint."""
    there = _applies(term, mark)
    if term.box is None or mark.position is None or not there:
        return []
    room = mark.tolerance if mark.gate is None else leeway(mark)
    shown = 3 if request.vehicle.group.dim == 6 else 2
    low, high = (np.asarray(corner, float) for corner in term.box)
    place = np.asarray(mark.position, float)
    off, wanted = 0.0, []
    for axis, at, least, most in zip("xyz"[:shown], place, low - room, high + room, strict=False):
        off = max(off, least - at, at - most)
        if max(least - at, at - most) > 1e-9:
            wanted.append(f"{axis} to at {f'least {least:g}' if at < least else f'most {most:g}'}")
    if not wanted:
        return []
    when = "" if term.frames is None else f" for frames {term.frames[0]} to {term.frames[1]}"
    remedy = f"move {' and '.join(wanted)}, or loosen {term.name!r}"
    return [Refusal(mark, "position", f"{off:.3g} m outside what {term.name!r} allows{when}", remedy)]


def _between(request: Request, i: int, j: int, delay: int) -> tuple[list[Refusal], int]:
    """Reasons why the leg from mark ``i`` to ``j``, the next mark with a frame, takes more frames; and how many more.

    ``delay``: how many frames later mark ``i`` itself has to be.
    """
    a, b, fps, limits = request.marks[i], request.marks[j], float(request.fps), request.limits
    first, last = int(a.frame), int(b.frame)
    held = sum(mark.hold for mark in request.marks[i:j])
    seconds = (last - first - held) / fps
    frames = f"frames {first} to {last}"
    reasons: list[tuple[str, float]] = []
    placed = [mark for mark in request.marks[i : j + 1] if mark.position is not None]
    if len(placed) > 1 and placed[0] is a and placed[-1] is b:
        reasons += _too_far(request, placed, seconds)
        up = abs(float(b.position[2] - a.position[2])) - leeway(a) - leeway(b)  # type: ignore[index]  # both have positions
        climb = limits.get("climb")
        if request.vehicle.group.dim == 6 and up > climb * seconds:
            reasons.append((f"{up / seconds:.3g} m/s up or down, limit {climb:g}", up / climb))
    if a.heading is not None and b.heading is not None:
        turn, rate = abs((b.heading - a.heading + 180) % 360 - 180), math.degrees(limits.get("turn_rate"))
        if turn > rate * seconds:
            reasons.append((f"{turn / seconds:.3g} deg/s, limit {rate:.3g}", turn / rate))
    if not reasons:
        return [], 0
    least, later, fixes = max(least for _, least in reasons), 0, dict[str, float]()
    if math.isinf(least):
        remedy = "move it nearer"
    else:
        soonest = max(math.ceil(first + held + least * fps - 1e-6), last + 1)
        found = first_frame(request, i, j, soonest)
        frame = found or soonest
        later = frame - last
        world = request.world
        blocked = world is not None and bool(request.hazards or world.obstacles)
        at = last + delay + later
        for mark in request.marks[j:]:
            if mark.given_frame is not None and mark.place >= 0:
                fixes.setdefault(f"{mark.name}.frame", int(mark.given_frame) + delay + later)
        proven = frame == soonest and not delay  # a motion that was found proves nothing about earlier frames
        if found is None or blocked:
            remedy = f"not before {at}" if proven else f"use {at} or later"
        else:
            remedy = f"earliest {at}" if proven else f"use {at}"
        if any(mark.given_frame is not None and mark.place > b.place for mark in request.marks):
            remedy += f", with all later marks moved by {delay + later} frames"
    needed = ", and ".join(message for message, _ in reasons)
    return [Refusal(b, "frame", f"{frames} need {needed}", remedy, tuple(fixes.items()))], later


def _too_far(request: Request, placed: list[Mark], seconds: float) -> list[tuple[str, float]]:
    """Why the motion between the first and the last of ``placed`` takes longer than ``seconds``; each with its least
    time."""
    limits, spatial = request.limits, request.vehicle.group.dim == 6
    top, a, b = request.top_speed, placed[0], placed[-1]
    shown = 3 if spatial else 2
    room = leeway(a) + 2 * sum(leeway(mark) for mark in placed[1:-1]) + leeway(b)
    whole = max(polyline([np.asarray(mark.position, float)[:shown] for mark in placed]) - room, 0.0)
    slack = _swing(request, a, b) if len(placed) == 2 else 2 * (len(placed) - 1) * _lever(request)
    centre = max(whole - slack, 0.0)
    ends, own = (_pace(a), _pace(b)), (_own_pace(request, a), _own_pace(request, b))
    if whole > top * seconds:
        return [(f"{whole / seconds:.3g} m/s, {request.speed_limit()}", whole / top)]
    wind = tuple(float(x) for x in request.wind)
    push = push_of(request.vehicle, wind, _steepest(request))
    fastest = top + 2 * _lever(request) + _size(wind)  # the body frame may be faster than the root
    ball = thrust_ball(request.vehicle, fastest)
    acceleration = limits.get("acceleration")

    def refused(text: str, t: float) -> list[tuple[str, float]]:
        return [(f"{whole:.3g} m in {max(seconds, 0.0):.3g} s, {text}", t)]

    allowed = uniform(acceleration, acceleration)
    if whole > allowed.reach(seconds, top, *ends):
        least = least_time(lambda t: allowed.reach(t, top, *ends), whole)
        return refused(f"more than {acceleration:.3g} m/s^2 can do", least)
    if math.isfinite(limits.get("grip")):
        tyres = gripping(limits.get("grip"), transcribe(request.weighed).relief)
        if whole > tyres.reach(seconds, top, *ends):
            least = least_time(lambda t: tyres.reach(t, top, *ends), whole)
            return refused(f"more than {_given_grip(request)} can do", least)
    if centre > push.reach(seconds, math.inf, *map(_size, own)):
        least = least_time(lambda t: push.reach(t, math.inf, *map(_size, own)), centre)
        return refused(f"more than the {request.vehicle.name}'s {push.most:.3g} m/s^2 can do", least)
    if ball is None or not spatial:
        return []
    displacement = np.subtract(b.position, a.position)  # type: ignore[arg-type]  # both have positions
    room, speeds = leeway(a) + leeway(b), (_speed(a), _speed(b))
    balls: list[tuple[Ball, float, tuple[Any, Any], str]] = [
        (ball, room + slack, own, f"the {request.vehicle.name}'s thrust can do")
    ]
    if math.isfinite(limits.get("g_load")):
        loads = Ball(np.array([0.0, 0.0, -GRAVITY]), GRAVITY * limits.get("g_load"))
        balls.append((loads, room, speeds, f"a g-load of {limits.get('g_load'):g} can do"))
    for bound, around, (leave, arrive), text in balls:
        if bound.rules_out(displacement, around, seconds, leave, arrive):
            return refused(f"more than {text}", max(seconds, _least(bound, displacement, around, a, b)))
    return []


def _least(ball: Ball, displacement: Array, room: float, a: Mark, b: Mark) -> float:
    """A lower bound, s, on the time between two marks: with the largest acceleration all the time."""
    most = float(np.linalg.norm(ball.centre)) + ball.radius
    push, far = uniform(most, most), max(float(np.linalg.norm(displacement)) - room, 0.0)
    return least_time(lambda t: push.reach(t, math.inf, _pace(a), _pace(b)), far)


def _swing(request: Request, a: Mark, b: Mark) -> float:
    """How much shorter the body frame's path may be than the root's, m, because of its offset from the root."""
    here, there = _offset(request, a), _offset(request, b)
    if here is None or there is None:
        return 2 * _lever(request)
    return float(np.linalg.norm(there[0] - here[0])) + here[1] + there[1]


def _offset(request: Request, mark: Mark) -> tuple[Array, float] | None:
    """Position of the body frame relative to the root at a mark (3,) m, and its distance from there, m, where the mark
    leaves the heading free; None if the mark leaves the attitude free."""
    origin = request.vehicle.origin
    if mark.orientation is not None:
        q = np.asarray(mark.orientation, float)
        return np.asarray(SO3.matrix(q / np.linalg.norm(q)) @ origin), 0.0
    known = request.vehicle.group.planar or mark.balanced
    if not known or (mark.heading is None and not request.vehicle.group.planar and np.any(request.wind)):
        return None
    turn = upright(request.vehicle, [math.radians(mark.heading or 0.0)], request.wind)[0]
    offset = np.asarray(SO3.matrix(turn) @ origin)
    if mark.heading is not None:
        return offset, 0.0
    return np.array([0.0, 0.0, offset[2]]), float(np.hypot(*offset[:2]))


def _lever(request: Request) -> float:
    return float(np.linalg.norm(request.vehicle.origin))


def _steepest(request: Request) -> float:
    """Largest slope of the ground, m/m, if the vehicle's motion depends on slopes."""
    terrain = None if request.world is None else request.world.terrain
    if terrain is None or request.vehicle.group.dim != 3:
        return 0.0
    steps = [np.abs(np.diff(terrain.heights, axis=axis)).max(initial=0.0) for axis in (1, 0)]
    return float(math.hypot(steps[0] / terrain.cell[0], steps[1] / terrain.cell[1]))


def _pace(mark: Mark) -> float:
    """The largest speed that a mark allows, m/s."""
    return _size(_speed(mark))


def _size(speed: Any) -> float:
    return float(np.linalg.norm(speed)) if np.ndim(speed) else float(speed)


def _own_pace(request: Request, mark: Mark) -> Any:
    """The same for the body frame: a turning vehicle may have another speed there than at its root, unless it only
    rolls."""
    rolls = free_size(request.vehicle) == 1
    return _speed(mark) if mark.at_rest or not _lever(request) else _pace(mark) if rolls else math.inf


def _speed(mark: Mark) -> Any:
    """The velocity (3,) m/s of a mark, or the largest speed that it allows."""
    if mark.velocity is not None:
        return np.asarray(mark.velocity, float)
    return math.inf if mark.speed is None else float(mark.speed)
