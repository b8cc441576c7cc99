"""Everything a plan was asked for, as plain data for an audit that knows nothing of how the plan was made."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from vehsim.planning.cover import SLOPE
from vehsim.planning.marks import Mark
from vehsim.planning.request import Request
from vehsim.planning.terms import LIMITS
from vehsim.requests import Ask, limit_asks, mark_asks
from vehsim.requests.asks import ANGLE, EXACT, gate_asks

NEAR_ENOUGH = 0.01
"""How far below the clearance asked for a motion may come, m."""
STANDS = 5e-3
"""How far from the ground what stands on it may be, m."""


def asks_of(request: Request, frames: Sequence[float]) -> list[Ask]:
    """The asks of a request whose marks (`Request.given`, or its marks) stand at ``frames``."""
    marks = list(request.given or request.marks)
    first, last = float(frames[0]), float(frames[-1])
    asks: list[Ask] = []
    for i, (mark, frame) in enumerate(zip(marks, frames, strict=True)):
        if not (i and marks[i - 1].hold and marks[i - 1].place == mark.place):  # a hold is written out as two marks
            asks += _mark(request, mark, frame, frames[i + 1] - frame if mark.hold else 0.0)
    limits = {name: (value, LIMITS[name].unit) for name, value in request.limits.values.items()}
    planar = request.vehicle.group.planar
    asks += limit_asks(first, last, limits, request.limits.joints, request.limits.joint_rates, planar)
    asks += _ranges(request, first, last)
    if request.loop:
        asks += _loop(first, last, {"planar": planar})
    if request.world is not None and (request.hazards or request.world.obstacles):
        landings = [mark.position for mark in marks if mark.on_ground]
        wanted = {
            "clearance": request.clearance,
            "obstacles_only": request.vehicle.group.dim != 6,
            "landings": [list(map(float, place)) for place in landings if place is not None],
            "slope": SLOPE,
        }
        asks.append(Ask("clearance", "clearance", first, last, wanted, lower=request.clearance - NEAR_ENOUGH, unit="m"))
    return asks


def _mark(request: Request, mark: Mark, frame: float, hold: float) -> Iterator[Ask]:
    """What one mark asks at ``frame``, and for ``hold`` frames."""
    vehicle, key = request.vehicle, mark.name
    if mark.frame == "free":
        yield Ask(f"{key}.frame", "off_frame", frame, frame, upper=EXACT, unit="frames")
    elif mark.place >= 0:
        yield Ask(f"{key}.frame", "frame", int(mark.frame), int(mark.frame), lower=mark.frame, upper=mark.frame)
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


def _ranges(request: Request, first: float, last: float) -> Iterator[Ask]:
    """What looks, stays and landings ask over frames."""
    for term in request.constraints:
        if term.ask is not None:
            begin, end = term.frames or (first, last)
            yield term.ask(float(begin), float(end))


def _loop(first: float, last: float, wanted: Mapping[str, Any]) -> Iterator[Ask]:
    yield Ask("loop (position)", "closure", first, last, wanted, upper=EXACT, unit="m")
    yield Ask("loop (attitude)", "closure_angle", first, last, wanted, **ANGLE)
    yield Ask("loop (velocity)", "closure_velocity", first, last, wanted, upper=EXACT, unit="m/s")
