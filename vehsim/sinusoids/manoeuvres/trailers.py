"""A car with any number of trailers steered between any two states: open in SIN, solved through the last axle.

The route is made of legs (`train.py`): straighten out, drive between two straight poses, bend into the goal. Legs are
chosen for gentle hitches, short routes and little reversing, which amplifies every error by e to the distance over the
hitch.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise, product
from math import factorial
from typing import Any

import numpy as np

from vehsim.errors import InputError, SolveError
from vehsim.sinusoids.laws import Law
from vehsim.sinusoids.manoeuvres.crossings import crossings, span
from vehsim.sinusoids.manoeuvres.train import Leg, Pose, Train, across, last_axle, sharpness, straighten
from vehsim.sinusoids.models import trailers
from vehsim.sinusoids.steering import CRUISE, Stage, Steering, integrate
from vehsim.sinusoids.system import Array, DriftlessSystem

SHARPEST = 1.3
"""Hitch and steering angles of a chosen path stay below this, rad; a right angle is singular."""
AMPLIFIED = 3e3
"""Largest amplification of errors by reversing on a chosen route."""
GAIN = 4e3
"""Largest amplification of errors by a whole route, unless every alternative has more."""
FOLDED = 20.0
"""Largest ratio between the path lengths of the car and the last axle."""
FAR = 15
"""A route of this many train lengths costs twice its length, because errors of the steering grow with its square."""
SHORT = 0.3
"""On legs shorter than this many train lengths, errors of earlier legs are not corrected."""
CHUNK = 24
"""Number of routes whose angles are computed together."""


@dataclass(frozen=True, eq=False)
class _Pull:
    """Only the car moves, straight ahead while it straightens its wheels: its trailers follow and straighten."""

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
    """Steer a car with ``len(hitches)`` trailers from ``start`` to ``goal``: x, y, phi, theta0, .. (`models.trailers`).

    ``speed`` of the front wheels, m/s, where legs join; ``via``: intermediate straight poses of the last axle;
    ``steering``, ``hitch``: largest angles, rad. The goal's headings are determined up to full turns; `Steering.goal`
    gives them. Raises ``InputError`` naming a hitch at a right angle, where the system is singular, and ``SolveError``
    if no choice of legs avoids right angles.
    """
    (route,) = trailer_routes(
        hitches, start, goal, wheelbase=wheelbase, speed=speed, via=via, steering=steering, hitch=hitch, count=1
    )
    return route


def trailer_routes(
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
    """Up to ``count`` routes as of `steer_trailers`, the gentlest first, each with other kinds of legs."""
    system = trailers(hitches, wheelbase)
    train = Train(tuple(float(d) for d in hitches), float(wheelbase))
    q0, q1 = system.check_state("start", start), system.check_state("goal", goal)
    for key, q in (("start", q0), ("goal", q1)):
        _check_bends(system.name, key, q)
    if np.array_equal(q0, q1):
        return [Steering(system, q0, q1, (Stage("rest", lambda s: np.zeros((len(s), 2))),))]
    limits = (min(SHARPEST, steering or np.inf), min(SHARPEST, hitch or np.inf))
    # an error in steering alone grows to D^2 / 2 wheelbases at a goal D m away
    gain = max(GAIN, float(np.sum((q1[:2] - q0[:2]) ** 2)) / wheelbase)
    for kinds in (count, count + 6):  # gentle routes first; if all of them miss the goal or amplify errors, others
        choices = _choose(system, train, q0, q1, via, limits, kinds)
        routes, missed = _driven(system, q0, q1, choices, speed, count, gain)
        if routes and _gain(routes[0]) < gain:
            break
    if not routes:
        assert missed is not None
        raise missed
    return routes


def _driven(
    system: DriftlessSystem,
    q0: Array,
    q1: Array,
    choices: Sequence[list[Leg | _Pull]],
    speed: float,
    count: int,
    most: float,
) -> tuple[list[Steering], SolveError | None]:
    """The first ``count`` routes that end at the goal, and the error of one that does not.

    Routes that amplify errors by more than ``most`` come last.
    """
    found: list[tuple[float, Steering]] = []
    missed = None
    for legs in choices:
        try:
            route = Steering(system, q0, q1, _staged(_joined(system, q0, legs), speed), label=_described(legs))
            turns = np.round((route.states[-1] - q1) / math.tau) * math.tau * (np.arange(system.n) >= 3)
            route = route.towards(q1 + turns).checked()
            found.append((_gain(route), route))
        except SolveError as error:  # reversing amplified round-off too much
            missed = error
        if sum(gain < most for gain, _ in found) == count:
            break
    found.sort(key=lambda option: option[0] if option[0] >= most else 0.0)
    return [route for _, route in found[:count]], missed


def _gain(route: Steering) -> float:
    """The largest factor by which an error of one state at any time grows into an error of another at the end.

    It is computed from the motion linearised halfway between samples.
    """
    x, t = route.states, route.times
    h, u = np.diff(t), route.inputs((t[:-1] + t[1:]) / 2)
    slopes = h[:, None, None] * route.system.jacobians((x[:-1] + x[1:]) / 2, u)
    flow, most = np.eye(route.system.n), 1.0
    for step in (np.eye(route.system.n) + slopes + slopes @ slopes / 2)[::-1]:
        flow = flow @ step
        most = max(most, float(np.abs(flow).max()))
    return most


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
    """The gentlest routes of more than ``count`` kinds: straighten either way, drive between straight poses, bend into
    the goal.
    """
    ends = list(product(_straightenings(system, train, q0, limits), _straightenings(system, train, q1, limits)))
    outer = [[*out, *(leg.back("bend to the goal") for leg in reversed(back))] for out, back in ends]
    poses = [[out[-1].far_end, *via, back[-1].far_end] for out, back in ends]
    sharp = [_bending(route, limits) for route in outer]
    bounds = [_least(train, [leg.span for leg in route]) + _length(p) for route, p in zip(outer, poses, strict=True)]
    bounds = [a + b for a, b in zip(bounds, sharp, strict=True)]
    found: dict[str, tuple[float, list[Leg | _Pull]]] = {}

    def enough() -> float:
        costs = sorted(cost for cost, _ in found.values())
        return costs[count - 1] if len(costs) >= count else np.inf

    for k in np.argsort(bounds):
        if bounds[k] >= enough():
            break
        out, _ = ends[k]
        options = []
        for between in product(*(crossings(train, a, b) for a, b in pairwise(poses[k]))):
            steps = [step for part in between for step in part]
            spans = [leg.span for leg in outer[k]] + [span(a, b) for a, b, _ in steps]
            options.append((_least(train, spans), steps))
        options.sort(key=lambda option: option[0])
        for first in range(0, len(options), CHUNK):
            chunk = [o for o in options[first : first + CHUNK] if o[0] + sharp[k] < enough()]
            if not chunk:
                break
            routes = [[across(train, *step) for step in steps] for _, steps in chunk]
            for (least, _), legs, bend in zip(chunk, routes, _bendings(routes, limits), strict=True):
                cost = least + sharp[k] + bend
                route = [*out, *legs, *outer[k][len(out) :]]
                kind = _described(route)
                if cost < found.get(kind, (np.inf, route))[0]:
                    found[kind] = (cost, route)
    if not found:
        raise SolveError(
            f"no choice of legs keeps the steering below {limits[0]:.3g} and every hitch below {limits[1]:.3g} rad "
            "without more reversing than can be steered open loop",
            "go by a state between (`via`), with smaller hitch angles",
            subject=system.name,
        )
    best = sorted(found.values(), key=lambda option: option[0])
    return [[leg for leg in route if leg.length > 1e-9] for _, route in best]


def _straightenings(system: DriftlessSystem, train: Train, q: Array, limits: tuple[float, float]) -> list[list[Any]]:
    """Routes from a state to a straight pose, the best of each kind: ahead or behind, at once or after a pull."""
    if np.abs(np.concatenate([[q[2]], np.diff(q[3:])])).max() < 1e-12:
        # already straight: a leg of no length marks the pose
        zero = np.zeros(train.count + 2)
        return [[Leg(train, last_axle(train, q), 0.0, 1e-12, zero, zero, zero, "rest")]]
    longest = max((*train.hitches, train.wheelbase))
    pulls = [None, *(_pull(system, q, k * longest) for k in (0.5, 1.5, 4.0))]
    lengths = train.length * np.array([0.6, 0.8, 1.0, 1.6, 2.5])
    options: list[tuple[tuple[bool, bool], list[Leg | _Pull]]] = []
    for pull, sign in product(pulls, (1.0, -1.0)):
        for leg in straighten(train, pull.end if pull else q, list(sign * lengths), "straighten"):
            options.append(((pull is None, sign > 0), [pull, leg] if pull else [leg]))
    found = []
    costs = _bendings([route[-1:] for _, route in options], limits)  # type: ignore[misc]  # routes end with a leg
    for kind in product((True, False), repeat=2):
        rated = [
            (cost, sum(leg.length for leg in route), route)
            for (of, route), cost in zip(options, costs, strict=True)
            if of == kind and np.isfinite(cost)
        ]
        if rated:  # the gentlest for its length, and the shortest, for reversed use
            best = min(rated, key=lambda option: option[0] + option[1])
            shortest = min(rated, key=lambda option: option[1])
            found += [best[2]] if best is shortest else [best[2], shortest[2]]
    return found


def _pull(system: DriftlessSystem, q: Array, length: float) -> _Pull:
    """Over ``length`` m of the front wheels the steering goes to zero in the first half, and stays zero.

    It is so smooth that an integrator's step across the middle keeps its order.
    """

    def law(s: Array) -> Array:
        turning = np.where(s < 0.5, -q[2] * 256 / 35 * np.sin(2 * np.pi * s) ** 8, 0.0)
        return np.column_stack([np.full(len(s), length), turning])

    end = integrate(system, Stage("pull", law), q, np.array([0.0, 1.0]))[-1]
    end[2] = 0.0
    return _Pull(law, length, end)


def _joined(system: DriftlessSystem, q: Array, legs: Sequence[Leg | _Pull]) -> list[Leg | _Pull]:
    """The legs, each starting exactly where those before it lead, so that round-off does not accumulate.

    Short legs only pass an offset on: correcting it there takes high derivatives times negative powers of their length.
    """
    joined: list[Leg | _Pull] = []
    for k, leg in enumerate(legs):
        if k and isinstance(leg, Leg) and leg.length > SHORT * leg.train.length:
            leg = leg.begun(q)
        joined.append(leg)
        q = integrate(system, Stage(leg.label, joined[-1].law), q, np.array([0.0, 1.0]))[-1]
    return joined


def _length(poses: Sequence[Pose]) -> float:
    """The straight distance through poses, m."""
    return float(sum(np.hypot(b.x - a.x, b.y - a.y) for a, b in pairwise(poses)))


def _bending(route: Sequence[Leg | _Pull], limits: tuple[float, float]) -> float:
    """Cost of the sharp angles of a route, m; inf beyond the ``limits`` of steering and hitches."""
    return float(_bendings([[leg for leg in route if isinstance(leg, Leg)]], limits)[0])


def _bendings(routes: Sequence[Sequence[Leg]], limits: tuple[float, float]) -> Array:
    """`_bending` of many routes at once."""
    legs = [leg for route in routes for leg in route if leg.length > 1e-9]
    if not legs:
        return np.zeros(len(routes))
    steering, hitch, mean, most = sharpness(legs).T
    lengths, sharpest = np.array([leg.length for leg in legs]), np.maximum(steering, hitch)
    costs = lengths * (np.tan(sharpest * np.pi / 2 / 1.6) ** 2 + mean - 1)
    costs[(steering >= limits[0]) | (hitch >= limits[1]) | (most > FOLDED)] = np.inf
    which = np.repeat(np.arange(len(routes)), [sum(leg.length > 1e-9 for leg in route) for route in routes])
    return np.asarray(np.bincount(which, costs, len(routes)), float)


def _least(train: Train, spans: Sequence[float]) -> float:
    """Lower bound, m, on the cost of a route of legs over ``spans`` m, from its length and its reversing.

    Reversing a distance r multiplies errors by about ``e^(r/d) (r/d)^(N-1) / (N-1)!``; the cost is inf beyond
    `AMPLIFIED`.
    """
    total, back = sum(abs(x) for x in spans), -sum(x for x in spans if x < 0)
    total += total**2 / (FAR * train.length)
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
            (True, True): ("both", CRUISE),
            (True, False): ("start", CRUISE),
            (False, True): ("end", CRUISE),
            (False, False): ("steady", 1.0),
        }[rests[0], rests[1]]
        end = leg.law(np.array([1.0 if rests[0] else 0.0]))
        stages.append(Stage(leg.label, leg.law, max(0.2, rate * abs(float(end[0, 0])) / speed), pace=pace))
    return tuple(stages)


def _check_bends(name: str, key: str, q: Array) -> None:
    for i, bend in enumerate(np.diff(q[3:])):
        if abs(bend) >= np.pi / 2 - 1e-3:
            raise InputError(
                f"theta{i + 1} - theta{i} = {bend:.4g} rad: hitch {i + 1} is at a right angle or beyond, where the "
                "trailer can no longer be pulled: a singular configuration",
                "keep it below 1.57",
                key=key,
                subject=name,
            )
