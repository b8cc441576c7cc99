"""The requests of a plan, as plain data for an audit that does not know how the plan was made."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence

import casadi as ca
import numpy as np

from vehsim.audit import PER_FRAME, Row
from vehsim.planning.problem.stage import evaluate
from vehsim.planning.problem.transcription import transcribe
from vehsim.planning.request.character import control_rates, eased
from vehsim.planning.request.landing import ROUND, SLOPE
from vehsim.planning.request.legs import closed
from vehsim.planning.request.marks import Mark
from vehsim.planning.request.request import Request
from vehsim.planning.terms import LIMITS, Constraint, KnotView
from vehsim.requests import Ask, clearance_ask, limit_asks, mark_asks
from vehsim.requests.asks import ANGLE, EXACT, gate_asks
from vehsim.vehicles import Vehicle

NEAR_BOUND = 1e-3
"""Tolerance of an actuator's rate, and of its command over the control's scale."""
BEYOND = "character."
"""Prefix of the keys of a character's requests."""
ROOM = 0.1
"""Share of a character's limit by which a motion may exceed it without a warning: these limits are soft."""
GENTLE = 0.01
"""Share of its largest rate that a control may have at the start or end of a motion that eases."""
STANDS = 5e-3
"""Tolerance of the distance from the ground of a vehicle that stands on it, m."""


def asks_of(request: Request, frames: Sequence[float]) -> list[Ask]:
    """The audit requests of a plan whose marks (`Request.given`, or `Request.marks`) are at ``frames``."""
    marks = list(request.given or request.marks)
    first, last = float(frames[0]), float(frames[-1])
    asks: list[Ask] = []
    for i, (mark, frame) in enumerate(zip(marks, frames, strict=True)):
        if not (i and marks[i - 1].hold and marks[i - 1].place == mark.place):  # a hold appears as two marks
            asks += _mark(request, mark, frame, frames[i + 1] - frame if mark.hold else 0.0)
    limits = {name: (value, LIMITS[name].unit) for name, value in request.limits.values.items()}
    planar = request.vehicle.group.planar
    relief = _relief(request)
    asks += limit_asks(first, last, limits, request.joint_ranges, request.limits.joint_rates, planar, relief)
    asks += [*_character(request, first, last), *_ease(request, closed(marks) if request.loop else marks, frames)]
    asks += _actuators(request.vehicle, first, last)
    asks += _ranges(request, first, last)
    if request.loop:
        asks += _loop(first, last, planar)
    if request.world is not None and (
        request.hazards or request.world.obstacles or request.world.walls(math.inf) is not None
    ):
        landings = [mark.position for mark in marks if mark.on_ground]
        asks.append(
            clearance_ask(
                first,
                last,
                request.clearance,
                planar=request.vehicle.group.dim != 6,
                landings=[place for place in landings if place is not None],
                slope=SLOPE,
                rounded=ROUND,
            )
        )
    return asks


def beyond_character(rows: Sequence[Row]) -> list[str]:
    """The soft limits of the character that a motion exceeds."""
    return [str(row) for row in rows if row.met is False and row.key.startswith(BEYOND)]


def _mark(request: Request, mark: Mark, frame: float, hold: float) -> Iterator[Ask]:
    """The requests of one mark at ``frame``, held for ``hold`` frames."""
    vehicle, key = request.vehicle, mark.name
    whole = mark.given_frame
    if whole is None:
        yield Ask(f"{key}.frame", "off_frame", frame, frame, upper=EXACT, unit="frames")
    elif mark.place >= 0:
        yield Ask(f"{key}.frame", "frame", int(whole), int(whole), lower=whole, upper=whole)
    planar = vehicle.group.planar
    given = np.asarray(() if mark.joints is None else mark.joints, float)
    placed = None if vehicle.group.fixed or mark.gate is not None else mark.position
    yield from mark_asks(
        key,
        frame,
        hold=round(hold),
        position=placed,
        tolerance=mark.tolerance,
        heading=None if mark.heading is None else math.radians(mark.heading),
        orientation=mark.orientation,
        velocity=mark.velocity,
        speed=mark.speed,
        joints={vehicle.joints[j]: float(given[j]) for j in np.flatnonzero(np.isfinite(given))},
        planar=planar,
    )
    if mark.gate is not None and mark.position is not None:
        gate = mark.gate
        yield from gate_asks(key, frame, mark.position, gate.axes.tolist(), gate.radius, gate.size, planar)
    if mark.on_ground and mark.position is not None:
        yield Ask(f"{key}.on_ground", "stands", frame, frame + hold, lower=-STANDS, upper=STANDS, unit="m")


def _character(request: Request, first: float, last: float) -> Iterator[Ask]:
    """The soft limits of the character, with severity `warning`."""
    traits, vehicle = request.traits, request.vehicle
    wanted = {"planar": vehicle.group.planar}
    for name, value in traits.without(request.limits).items():
        upper, unit = (1 + ROOM) * value, LIMITS[name].unit
        yield Ask(f"{BEYOND}{name}", name, first, last, wanted, None, upper, unit, "warning")
    for name, value in traits.control_rates.items():
        k = vehicle.control_names.index(name)
        unit, upper = f"{vehicle.controls[k].unit}/s", (1 + ROOM) * value
        key, which = f"{BEYOND}control_rates.{name}", {"control": k}
        yield Ask(key, "control_rate", first, last, which, None, upper, unit, "warning")


def _ease(request: Request, marks: Sequence[Mark], frames: Sequence[float]) -> Iterator[Ask]:
    """The rates of controls at the start and end of a motion that eases, with severity `warning`."""
    vehicle, rates = request.vehicle, control_rates(request.traits, request.vehicle)
    for i, comes, leaves in eased(request.traits, marks):
        for side, there in ((-1, comes), (1, leaves)):
            first, last = sorted((frames[i], frames[i] + side / PER_FRAME))
            for k, control in enumerate(vehicle.controls if there else ()):
                key, unit = f"{marks[i].name}.ease.{control.name}", f"{control.unit}/s"
                upper = GENTLE * float(rates[k])
                yield Ask(key, "control_rate", first, last, {"control": k}, None, upper, unit, "warning")


def _actuators(vehicle: Vehicle, first: float, last: float) -> Iterator[Ask]:
    """What the actuators of the controls can follow: their rates, and commands within the bounds of the controls."""
    for k, control in enumerate(vehicle.controls):
        actuator, key, which = control.actuator, f"actuators.{control.name}", {"control": k}
        if math.isfinite(actuator.rate):
            upper = (1 + NEAR_BOUND) * actuator.rate
            yield Ask(f"{key}.rate", "control_rate", first, last, which, None, upper, f"{control.unit}/s")
        if actuator.lag:
            slack, lagging = NEAR_BOUND * control.scale, {**which, "lag": actuator.lag}
            low, high = (end if math.isfinite(end) else None for end in (control.lower - slack, control.upper + slack))
            yield Ask(f"{key}.command", "command", first, last, lagging, low, high, control.unit)


def _ranges(request: Request, first: float, last: float) -> Iterator[Ask]:
    """The requests of ranges and landings over frames."""
    for term in request.constraints:
        begin, end = term.frames or (first, last)
        if term.ask is not None:
            yield term.ask(float(begin), float(end))
        elif term in request.terms and term.over == "everywhere":
            yield from _law(request, term, float(begin), float(end), first)


def _law(request: Request, term: Constraint, begin: float, end: float, first: float) -> Iterator[Ask]:
    """The requests of a user's constraint, one per component.

    There are none for a constraint of power, or of a height on the plane: the finished motion does not contain what the
    plan's values were.
    """
    vehicle = request.vehicle
    sizes = {"position": 3, "rotation": 9, "velocity": 3, "omega": 3, "acceleration": 3, "joints": len(vehicle.joints)}
    sizes |= {"joint_rates": len(vehicle.joints), "controls": len(vehicle.controls), "t": 1, "slope": 2, "lift": 1}
    given = {name: ca.SX.sym(name, size) for name, size in sizes.items()}
    hidden = {name: ca.SX.sym(name, 6) for name in ("push", "rates")}
    rotation = ca.reshape(given["rotation"], 3, 3).T
    value = evaluate(term, KnotView(**(given | hidden | {"rotation": rotation}), names=vehicle.joints))
    planar = vehicle.group.planar
    unseen = [*hidden.values(), given["position"][2]] if planar else [*hidden.values()]
    if ca.depends_on(value, ca.vertcat(*unseen)):
        return
    law = ca.Function("law", [*given.values()], [value]).serialize()
    relief = _relief(request) if ca.depends_on(value, ca.vertcat(given["slope"], given["lift"])) else None
    lower, upper = (np.broadcast_to(np.asarray(b, float).ravel(), value.shape[0]) for b in (term.lower, term.upper))
    for i, (low, high) in enumerate(zip(lower.tolist(), upper.tolist(), strict=True)):
        yield Ask(
            f"{term.title}[{i}]" if value.shape[0] > 1 else term.title,
            "law",
            begin,
            end,
            {"law": law, "component": i, "planar": planar, "start": first, "relief": relief},
            lower=low - term.slack if math.isfinite(low) else None,
            upper=high + term.slack if math.isfinite(high) else None,
        )


def _relief(request: Request) -> list[list[float]] | None:
    """The box of the relief that carries the vehicle's weight, as `Scene.followed` takes it."""
    relief = transcribe(request.weighed).relief
    return None if relief is None else relief.box.tolist()


def _loop(first: float, last: float, planar: bool) -> Iterator[Ask]:
    pose = {"planar": False}  # the ground and the water carry it to the same pose in space
    yield Ask("loop (position)", "closure", first, last, pose, upper=EXACT, unit="m")
    yield Ask("loop (attitude)", "closure_angle", first, last, pose, **ANGLE)
    yield Ask("loop (velocity)", "closure_velocity", first, last, {"planar": planar}, upper=EXACT, unit="m/s")
