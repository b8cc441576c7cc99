"""A car with any number of trailers steered between any two states: open in SIN, solved through the last axle.

The way is made of legs (`train.py`): straighten out, drive between two straight poses, bend into the goal. Legs are
chosen for gentle hitches, short ways and little reversing, which amplifies every error by e to the way over the hitch.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise, product
from math import factorial
from typing import Any

import numpy as np

from vehsim.errors import InputError, SolveError
from vehsim.sinusoids.models import trailers
from vehsim.sinusoids.steering import Law, Stage, Steering, integrate
from vehsim.sinusoids.system import Array, DriftlessSystem
from vehsim.sinusoids.train import Leg, Pose, Train, across, hermite, last_axle, straighten

TAU = 2 * np.pi
SHARPEST = 1.3
"""Hitch and steering angles of a chosen path stay below this, rad; a right angle is singular."""
AMPLIFIED = 3e4
"""How much reversing may amplify errors on a chosen way."""
CORNER = 1.75
"""The most one leg turns on the way round a bend, rad."""


@dataclass(frozen=True, eq=False)
class _Pull:
    """The car alone goes straight ahead, wheels turned straight on the way: its trailers follow and straighten."""

    law: Law
    length: float
    end: Array
    reverse: bool = False
    label: str = "pull straight"

    @property
    def span(self) -> float:
        return -self.length if self.reverse else self.length

    def back(self, label: str) -> _Pull:
        law = self.law
        return _Pull(lambda s: -law(1 - s), self.length, self.end, not self.reverse, label)


def steer_trailers(
    hitches: Sequence[float],
    start: Any,
    goal: Any,
    *,
    wheelbase: float = 1.0,
    speed: float = 1.0,
    via: Sequence[Pose] = (),
    steering: float | None = None,
    hitch: float | None = None,
) -> Steering:
    """A car with ``len(hitches)`` trailers from ``start`` to ``goal``: x, y, phi, theta0, .. (`models.trailers`).

    ``speed`` of the front wheels, m/s, where legs join; ``via``: straight poses of the last axle on the way;
    ``steering``, ``hitch``: largest angles on the way, rad. The goal's headings count up to full turns; `Steering.goal`
    says which. Raises ``InputError`` naming a hitch at a right angle, where the system is singular, and ``SolveError``
    when no choice of legs keeps every hitch away from it.
    """
    (way,) = trailer_ways(
        hitches, start, goal, wheelbase=wheelbase, speed=speed, via=via, steering=steering, hitch=hitch, count=1
    )
    return way


def trailer_ways(
    hitches: Sequence[float],
    start: Any,
    goal: Any,
    *,
    wheelbase: float = 1.0,
    speed: float = 1.0,
    via: Sequence[Pose] = (),
    steering: float | None = None,
    hitch: float | None = None,
    count: int = 6,
) -> list[Steering]:
    """Up to ``count`` ways of `steer_trailers`, the gentlest first, each with other kinds of legs than those before."""
    system = trailers(hitches, wheelbase)
    train = Train(tuple(float(d) for d in hitches), float(wheelbase))
    q0, q1 = system.check_state("start", start), system.check_state("goal", goal)
    for key, q in (("start", q0), ("goal", q1)):
        _check_bends(system.name, key, q)
    if np.array_equal(q0, q1):
        return [Steering(system, q0, q1, (Stage("rest", lambda s: np.zeros((len(s), 2))),))]
    limits = (min(SHARPEST, steering or np.inf), min(SHARPEST, hitch or np.inf))
    ways = []
    for legs in _choose(system, train, q0, q1, via, limits, count):
        way = Steering(system, q0, q1, _staged(legs, speed), label=_described(legs))
        turns = np.round((way.states[-1] - q1) / TAU) * TAU * (np.arange(system.n) >= 3)
        ways.append(way.towards(q1 + turns).checked())
    return ways


def _described(legs: Sequence[Leg | _Pull]) -> str:
    """``straighten, drive past, and back``: each kind of leg once, in order."""
    return ", ".join(dict.fromkeys(f"{leg.label}{' (reversing)' if leg.span < 0 else ''}" for leg in legs))


def _choose(
    system: DriftlessSystem,
    train: Train,
    q0: Array,
    q1: Array,
    via: Sequence[Pose],
    limits: tuple[float, float],
    count: int,
) -> list[list[Leg | _Pull]]:
    """The gentlest ways of ``count`` kinds: straighten either way, drive between straight poses, bend into the goal."""
    ways: list[tuple[float, list[Leg | _Pull]]] = []
    for out, back in product(_straightenings(system, train, q0, limits), _straightenings(system, train, q1, limits)):
        into = [leg.back("bend to the goal") for leg in reversed(back)]
        poses = [out[-1].far_end, *via, back[-1].far_end]
        for between in product(*(_crossings(train, a, b) for a, b in pairwise(poses))):
            way = [*out, *(leg for legs in between for leg in legs), *into]
            ways.append((_least(train, way), way))
    ways.sort(key=lambda option: option[0])
    found: dict[str, tuple[float, list[Leg | _Pull]]] = {}
    for least, way in ways:
        if least == np.inf or (len(found) >= count and least >= sorted(cost for cost, _ in found.values())[count - 1]):
            break
        cost = least + sum(_bending(leg, limits) for leg in way if isinstance(leg, Leg))
        kind = _described(way)
        if cost < found.get(kind, (np.inf, way))[0]:
            found[kind] = (cost, way)
    if not found:
        raise SolveError(
            f"{system.name}: no choice of legs keeps the steering below {limits[0]:.3g} and every hitch below "
            f"{limits[1]:.3g} rad without more reversing than can be steered open loop; go by a state between (`via`), "
            "with smaller hitch angles"
        )
    best = sorted(found.values(), key=lambda option: option[0])[:count]
    return [[leg for leg in way if leg.length > 1e-9] for _, way in best]


def _straightenings(system: DriftlessSystem, train: Train, q: Array, limits: tuple[float, float]) -> list[list[Any]]:
    """Ways from a state to a straight pose, the best of each kind: ahead, behind, and after a pull."""
    if np.abs(np.concatenate([[q[2]], np.diff(q[3:])])).max() < 1e-12:
        # nothing to straighten: a leg of no length marks the pose
        return [[Leg(train, last_axle(train, q), 0.0, 1e-12, hermite(np.zeros(1), np.zeros(1)), "rest")]]
    found = []
    pulls = [None, *(_pull(system, q, k * max((*train.hitches, train.wheelbase))) for k in (1.0, 2.5, 5.0))]
    for sign in (1.0, -1.0):
        options = []
        for pull in pulls if sign > 0 else pulls[:1]:
            for length in train.length * np.array([0.6, 0.8, 1.0, 1.6, 2.5]):
                leg = straighten(train, pull.end if pull else q, sign * length, "straighten")
                way: list[Leg | _Pull] = [pull, leg] if pull else [leg]
                if np.isfinite(cost := _bending(leg, limits)):
                    options.append((cost, sum(x.length for x in way), way))
        if options:  # the gentlest for its length, and the shortest, for where it is reversed
            best = min(options, key=lambda option: option[0] + option[1])
            shortest = min(options, key=lambda option: option[1])
            found += [best[2]] if best is shortest else [best[2], shortest[2]]
    return found


def _pull(system: DriftlessSystem, q: Array, length: float) -> _Pull:
    """Over ``length`` m of the front wheels the steering goes to zero, in the first half, and stays."""

    def law(s: Array) -> Array:
        turning = np.where(s < 0.5, -q[2] * 2 * (1 - np.cos(4 * np.pi * s)), 0.0)
        return np.column_stack([np.full(len(s), length), turning])

    end = integrate(system, Stage("pull", law), q, np.array([0.0, 1.0]))[-1]
    end[2] = 0.0
    return _Pull(law, length, end)


def _crossings(train: Train, a: Pose, b: Pose) -> Iterator[list[Leg]]:
    """Ways between straight poses: at once, round bends forwards, or by a turning point in line with one of them."""
    dx, dy, _ = b.within(a)
    turn = _wrapped(b.heading - a.heading)
    if np.hypot(dx, dy) < 1e-9 and abs(turn) < 1e-9:
        yield []
        return
    b = replace(b, heading=a.heading + turn)
    if abs(turn) < 2.0:
        yield from _direct(train, a, b, "drive")
        reach = abs(dy) + train.length
        for far, sign in product((reach, 2 * reach), (1.0, -1.0)):
            for turning in (a.ahead(max(0.0, sign * dx) * sign + sign * far), b.ahead(sign * far)):
                ahead, after = _direct(train, a, turning, "drive past"), _direct(train, turning, b, "and back")
                for first, second in product(ahead, after):
                    yield [*first, *second]
    radii = 1.2 * max((*train.hitches, train.wheelbase)) + train.length * np.array([0.0, 0.25, 0.7, 1.4, 2.4])
    for radius, lead in product(radii, train.length * np.array([0.0, 0.6, 1.2])):
        yield from _round_bends(train, a, b, float(radius), float(lead))


def _direct(train: Train, a: Pose, b: Pose, label: str) -> list[list[Leg]]:
    """One leg, where the chart half way between the headings allows it."""
    turn = _wrapped(b.heading - a.heading)
    leg = across(train, a, replace(b, heading=a.heading + turn), label) if abs(turn) < 2.0 else None
    return [[leg]] if leg is not None and leg.length > 0.3 * train.length else []


def _round_bends(train: Train, a: Pose, b: Pose, radius: float, lead: float) -> Iterator[list[Leg]]:
    """Forwards round circles at either end and the straight line between them (Dubins), in smooth corners.

    Corners begin and end ``lead`` m before and after their arcs: a short arc needs it, or the train swings.
    """
    start, end = a.ahead(lead), b.ahead(-lead)
    for first, last in product((1.0, -1.0), repeat=2):
        centre_a, centre_b = _beside(start, first * radius), _beside(end, last * radius)
        gap = centre_b - centre_a
        far = float(np.hypot(*gap))
        twist = 0.0 if first == last else 2 * first * radius
        if far < abs(twist) + 1e-9:
            continue
        along = float(np.arctan2(gap[1], gap[0])) + (np.arcsin(twist / far) if twist else 0.0)
        straight = float(np.sqrt(far**2 - twist**2))
        arcs = [first * (first * (along - a.heading) % TAU), last * (last * (b.heading - along) % TAU)]
        arcs = [0.0 if min(abs(arc), TAU - abs(arc)) < 1e-9 else arc for arc in arcs]
        bend = _around(start, centre_a, arcs[0])
        unbend = _around(bend[-1].ahead(straight), centre_b, arcs[1])
        room = straight - lead * sum(arc != 0 for arc in arcs)
        if room < -1e-9:
            continue
        bend = [a, *bend[1:-1], bend[-1].ahead(lead)] if arcs[0] else [a]
        last_pose = replace(b, heading=unbend[-1].heading)  # b, after as many turns as the way makes
        unbend = [unbend[0].ahead(-lead), *unbend[1:-1], last_pose] if arcs[1] else [last_pose]
        poses = [*bend, *unbend] if room > 1e-9 else [*bend, *unbend[1:]]
        if len(poses) > 1:
            yield [across(train, p, q, "round the bend") for p, q in pairwise(poses)]


def _around(start: Pose, centre: Array, arc: float) -> list[Pose]:
    """Poses along a circle through ``start``, a corner apart."""
    count = int(np.ceil(abs(arc) / CORNER - 1e-9)) if abs(arc) > 1e-9 else 0
    spoke = np.array([start.x, start.y]) - centre
    poses = [start]
    for turn in arc * np.arange(1, count + 1) / max(count, 1):
        c, s = np.cos(turn), np.sin(turn)
        x, y = centre + np.array([c * spoke[0] - s * spoke[1], s * spoke[0] + c * spoke[1]])
        poses.append(Pose(float(x), float(y), start.heading + turn))
    return poses


def _beside(pose: Pose, distance: float) -> Array:
    """The point ``distance`` m to the left."""
    return np.array([pose.x - distance * np.sin(pose.heading), pose.y + distance * np.cos(pose.heading)])


def _bending(leg: Leg, limits: tuple[float, float]) -> float:
    """What sharp angles cost, m; infinite beyond the ``limits`` of steering and hitches."""
    if leg.length < 1e-9:
        return 0.0
    if any(angle >= limit for angle, limit in zip(leg.angles, limits, strict=True)):
        return np.inf
    return leg.length * float(np.tan(max(leg.angles) * np.pi / 2 / 1.6) ** 2)


def _least(train: Train, way: Sequence[Leg | _Pull]) -> float:
    """What a way costs however gentle it is, m: its length and its reversing.

    Reversing a distance r multiplies errors by about ``e^(r/d) (r/d)^(N-1) / (N-1)!``, infinite beyond `AMPLIFIED`.
    """
    total, back = sum(leg.length for leg in way), sum(leg.length for leg in way if leg.span < 0)
    if not train.hitches:
        return total + back
    hitches, n = back / min(train.hitches), len(train.hitches)
    growth = hitches + (n - 1) * np.log(max(hitches, 1.0)) - np.log(float(factorial(n - 1)))
    return total + back * (1 + hitches) if growth < np.log(AMPLIFIED) else np.inf


def _staged(legs: Sequence[Leg | _Pull], speed: float) -> tuple[Stage, ...]:
    """Stages at ``speed`` where legs join in the same direction, and at rest where they do not."""
    stages = []
    for i, leg in enumerate(legs):
        rests: list[bool] = []
        for j in (i - 1, i + 1):
            other = legs[j] if 0 <= j < len(legs) else None
            turned = other is None or isinstance(leg, _Pull) or isinstance(other, _Pull) or leg.span * other.span < 0
            rests.append(turned)
        pace, rate = {
            (True, True): ("both", 1.5),
            (True, False): ("start", 2.0),
            (False, True): ("end", 2.0),
            (False, False): ("steady", 1.0),
        }[rests[0], rests[1]]
        end = leg.law(np.array([1.0 if rests[0] else 0.0]))
        stages.append(Stage(leg.label, leg.law, max(0.2, rate * abs(float(end[0, 0])) / speed), pace=pace))
    return tuple(stages)


def _wrapped(angle: float) -> float:
    return float((angle + np.pi) % TAU - np.pi)


def _check_bends(name: str, key: str, q: Array) -> None:
    for i, bend in enumerate(np.diff(q[3:])):
        if abs(bend) >= np.pi / 2 - 1e-3:
            raise InputError(
                f"{name}: {key}: theta{i + 1} - theta{i} = {bend:.4g} rad: hitch {i + 1} is at a right angle or "
                "beyond, where the trailer can no longer be pulled: a singular configuration; keep it below 1.57"
            )
