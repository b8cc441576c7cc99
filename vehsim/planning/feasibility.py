"""What bounds prove impossible before anything is solved: which marks, by how much, and what would do."""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import pairwise, product
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from vehsim.planning.balance import out_of_balance
from vehsim.planning.marks import Mark, leeway
from vehsim.planning.request import Request
from vehsim.planning.terms import Constraint
from vehsim.planning.transcription import transcription
from vehsim.vehicles import Holonomic, Vehicle

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Refusal:
    """Why a mark cannot be met: its ``key``, what is wrong, and what would do."""

    mark: Mark
    key: str
    message: str
    mend: str

    def __str__(self) -> str:
        return f"{self.mark.name}.{self.key}: {self.message}; {self.mend}"


def refusals(request: Request) -> list[Refusal]:
    """Everything that the limits, and the vehicle's own strength, rule out; empty when nothing is proven."""
    found = [refusal for mark in request.marks for refusal in _alone(request, mark)]
    known = [i for i, mark in enumerate(request.marks) if mark.frame != "free"]
    for i, j in pairwise(known):
        found += _between(request, i, j)
    t = transcription(request.weighed)
    for mark, message, mend in out_of_balance(request.vehicle, t, request.marks, request.wind):
        found.append(Refusal(mark, "hold" if mark.hold else "velocity", message, mend))
    return found


def _alone(request: Request, mark: Mark) -> list[Refusal]:
    limits, found = request.limits, []
    speed = mark.speed if mark.velocity is None else float(np.linalg.norm(mark.velocity))
    top = limits.get("speed")
    if speed is not None and speed > top:
        key = "speed" if mark.velocity is None else "velocity"
        found.append(Refusal(mark, key, f"{speed:.3g} m/s, limit {top:g}", f"ask for at most {top:g} m/s, or raise it"))
    ceiling = limits.get("ceiling")
    if mark.position is not None and mark.position[2] - mark.tolerance > ceiling and request.vehicle.group.dim == 6:
        message = f"{mark.position[2]:g} m high, ceiling {ceiling:g}"
        found.append(Refusal(mark, "position", message, f"put it below {ceiling:g} m, or raise the ceiling"))
    climb = limits.get("climb")
    if mark.velocity is not None and abs(mark.velocity[2]) > climb:
        message = f"{abs(mark.velocity[2]):g} m/s up or down, limit {climb:g}"
        found.append(Refusal(mark, "velocity", message, f"ask for at most {climb:g} m/s"))
    return found + [refusal for term in request.constraints for refusal in _outside(request, mark, term)]


def _outside(request: Request, mark: Mark, term: Constraint) -> list[Refusal]:
    """A mark where a constraint does not let it be."""
    there = term.frames is None or (mark.frame != "free" and term.frames[0] <= mark.frame <= term.frames[1])
    if term.box is None or mark.position is None or not there:
        return []
    room = mark.tolerance if mark.gate is None else leeway(mark)
    shown = 3 if request.vehicle.group.dim == 6 else 2
    low, high = term.box
    place = np.asarray(mark.position, float)
    off = max(max(low[i] - place[i], place[i] - high[i]) for i in range(shown)) - room
    if off <= 1e-9:
        return []
    when = "" if term.frames is None else f" for frames {term.frames[0]} to {term.frames[1]}"
    mend = f"move it by {off:.3g} m, or loosen {term.name!r}"
    return [Refusal(mark, "position", f"{off:.3g} m outside what {term.name!r} asks{when}", mend)]


def _between(request: Request, i: int, j: int) -> list[Refusal]:
    a, b, fps, limits = request.marks[i], request.marks[j], float(request.fps), request.limits
    first, last = int(a.frame), int(b.frame)
    held = sum(mark.hold for mark in request.marks[i:j]) / fps
    seconds = (last - first) / fps - held
    frames = f"frames {first} to {last}"
    found = []
    if a.position is not None and b.position is not None and a.gate is None and b.gate is None:
        way = np.abs(np.subtract(b.position, a.position)) - a.tolerance - b.tolerance
        way = np.maximum(way, 0.0)
        way[2] *= request.vehicle.group.dim == 6
        span = max(float(np.linalg.norm(way)) - 2 * float(np.linalg.norm(request.vehicle.origin)), 0.0)
        push = min(limits.get("acceleration"), strength(request.vehicle))
        found += _too_far(request, i, j, (float(np.linalg.norm(way)), span), seconds, push)
        climb = limits.get("climb")
        if way[2] > climb * seconds:
            earliest = math.ceil(first + (way[2] / climb + held) * fps)
            message = f"{frames} needs {way[2] / seconds:.3g} m/s up or down, limit {climb:g}"
            found.append(Refusal(request.marks[j], "frame", message, f"earliest {earliest}"))
    if a.heading is not None and b.heading is not None:
        turn, rate = abs((b.heading - a.heading + 180) % 360 - 180), math.degrees(limits.get("turn_rate"))
        if turn > rate * seconds:
            earliest = math.ceil(first + (turn / rate + held) * fps)
            message = f"{frames} needs {turn / seconds:.3g} deg/s, limit {rate:.3g}"
            found.append(Refusal(request.marks[j], "frame", message, f"earliest {earliest}"))
    return found


def _too_far(request: Request, i: int, j: int, ways: tuple[float, float], seconds: float, push: float) -> list[Refusal]:
    """``ways``: how far the root has to go, and how far the centre of mass at least, whose acceleration is bounded."""
    marks, top, first = request.marks, request.limits.get("speed"), int(request.marks[i].frame)
    held, fps = sum(mark.hold for mark in marks[i:j]), float(request.fps)
    ends = (_pace(marks[i]), _pace(marks[j]))
    frames = f"frames {first} to {int(marks[j].frame)}"

    def earliest(way: float, push: float) -> str:
        seconds = _bisect(lambda t: _reach(t, top, push, *ends) - way)
        return (
            f"earliest {math.ceil(first + held + seconds * fps - 1e-6)}" if math.isfinite(seconds) else "move it nearer"
        )

    whole, centre = ways
    if whole > _reach(seconds, top, math.inf, *ends):
        message = f"{frames} needs {whole / seconds:.3g} m/s, limit {top:g}"
        return [Refusal(request.marks[j], "frame", message, earliest(whole, math.inf))]
    if centre > _reach(seconds, top, push, *ends):
        message = f"{frames} is {centre:.3g} m in {seconds:.3g} s, more than {push:.3g} m/s^2 can do"
        return [Refusal(request.marks[j], "frame", message, earliest(centre, push))]
    return []


def _pace(mark: Mark) -> float:
    """The speed a mark allows in any direction, m/s."""
    if mark.velocity is not None:
        return float(np.linalg.norm(mark.velocity))
    return math.inf if mark.speed is None else mark.speed


def _reach(seconds: float, top: float, push: float, leave: float, arrive: float) -> float:
    """The furthest that can be gone, m, at speeds up to ``top`` that change by ``push`` m/s^2 at most."""
    if seconds <= 0:
        return 0.0
    t = np.linspace(0.0, seconds, 2001)
    gain = np.zeros_like(t) if math.isinf(push) else push * t
    if math.isinf(push):
        return top * seconds if math.isfinite(top) else math.inf
    speed = np.minimum(np.minimum(leave + gain, arrive + gain[::-1]), top)
    return float(np.trapezoid(speed, t)) * (1 + 1e-6)


def _bisect(enough: object, high: float = 1e5) -> float:
    """Smallest number at which a rising function is not negative; infinite beyond ``high``."""
    assert callable(enough)
    low, top = 0.0, 1.0
    while enough(top) < 0:
        low, top = top, 2 * top
        if top > high:
            return math.inf
    for _ in range(60):
        middle = (low + top) / 2
        low, top = (middle, top) if enough(middle) < 0 else (low, middle)
    return top


def strength(vehicle: Vehicle) -> float:
    """A bound of a rigid body's acceleration, m/s^2, from those of its controls; infinite where none is known."""
    bounds = np.array([[c.lower, c.upper] for c in vehicle.controls]).reshape(-1, 2)
    simple = isinstance(vehicle, Holonomic) and vehicle.group.dim == 6 and vehicle.drag is None
    if not simple or not np.all(np.isfinite(bounds)) or len(bounds) > 10:
        return math.inf
    assert isinstance(vehicle, Holonomic)
    c = ca.SX.sym("c", len(bounds))
    wrench: Any = ca.SX.zeros(6) if vehicle.wrench is None else ca.vertcat(vehicle.wrench(c))
    if ca.depends_on(ca.jacobian(wrench, c), c):
        return math.inf
    force = ca.Function("force", [c], [wrench[3:6]])
    inertia = vehicle.inertia[3:, 3:]
    most = max(float(np.linalg.norm(np.array(force(list(corner))))) for corner in product(*bounds))
    mass = float(np.linalg.eigvalsh(inertia).min())
    weight = vehicle.gravity * (inertia[2, 2] if vehicle.mass is None else vehicle.mass)
    return (most + weight) / mass if vehicle.gravity else most / mass
