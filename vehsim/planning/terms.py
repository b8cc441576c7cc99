"""Costs, limits and terms of one's own, as data: each is one expression of a knot or of a segment.

A built-in cost is a law of a `SegmentView`, a built-in limit a law of a `KnotView` or `SegmentView`, and so are the
`Cost` and `Constraint` that users write: one protocol, evaluated once in CasADi symbols and differentiated from there.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Hashable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from difflib import get_close_matches
from typing import Any, Literal

import casadi as ca
import numpy as np

from vehsim.audit.measures import MEASURES
from vehsim.errors import InputError
from vehsim.requests import Ask
from vehsim.runtime.registry import Registry

Expr = Any
"""A CasADi expression."""
GRAVITY = 9.81
"""m/s^2: what a g-load is counted in."""


@dataclass(frozen=True)
class KnotView:
    """What a law sees of an instant, all CasADi columns, SI and radians.

    ``position`` (3,) of the rig's root, world; ``velocity`` and ``acceleration`` (3,) world, where two segments meet
    that of the later one; ``omega`` (3,) body axes; ``rotation`` (3, 3) root to world; ``joints, joint_rates`` (s,);
    ``controls`` (c,); ``push``: what the controls push with, over the vehicle's weight, and ``rates``: how fast that
    moves; ``t`` s since the first mark.
    """

    position: Expr
    velocity: Expr
    omega: Expr
    rotation: Expr
    joints: Expr
    joint_rates: Expr
    controls: Expr
    push: Expr
    rates: Expr
    t: Expr
    acceleration: Expr
    names: tuple[str, ...] = ()

    @property
    def power(self) -> Expr:
        """What the controls put in, over the vehicle's weight: m/s of climb."""
        return ca.dot(self.push, self.rates)

    def joint(self, name: str) -> Expr:
        """A joint's value by its name."""
        return self.joints[self.names.index(name)]

    def rate(self, name: str) -> Expr:
        """A joint's rate by its name."""
        return self.joint_rates[self.names.index(name)]


@dataclass(frozen=True)
class SegmentView:
    """What a law sees of a segment: the knots at its ends, ``c0, c1`` controls over their scale, ``h`` s."""

    start: KnotView
    end: KnotView
    c0: Expr
    c1: Expr
    h: Expr

    @property
    def acceleration(self) -> Expr:
        """Mean acceleration of the root (3,) m/s^2, world axes."""
        return (self.end.velocity - self.start.velocity) / self.h


@dataclass(frozen=True)
class HazardView:
    """What a law sees of an instant near what may be hit: ``distances`` (k,) m of the vehicle's spheres from it."""

    distances: Expr


@dataclass(frozen=True, eq=False)
class Cost:
    """A cost of one's own: ``law`` takes a `SegmentView` and gives the cost of that segment, a scalar.

    ``integral=True``: the law takes a `KnotView` instead and is integrated over time (trapezoidal rule).
    ``frames`` (first, last): where it applies; default: the whole motion.
    """

    name: str
    law: Callable[[Any], Expr]
    weight: float = 1.0
    integral: bool = False
    frames: tuple[int, int] | None = None


Where = Literal["everywhere", "knots", "segments", "between"]
SLACK = 0.005
"""By how much of itself a limit may be passed between knots."""


@dataclass(frozen=True, eq=False)
class Constraint:
    """A constraint of one's own: ``lower <= law(view) <= upper``, component by component.

    ``over``: ``"everywhere"``, to within ``slack``, or ``"knots"`` alone, with a law of a `KnotView`; or ``"segments"``
    with a law of a `SegmentView`. ``frames`` (first, last): only there, both included.
    """

    name: str
    law: Callable[[Any], Expr]
    lower: Any = -np.inf
    upper: Any = np.inf
    over: Where = "everywhere"
    frames: tuple[int, int] | None = None
    slack: float = 1e-3
    """How far it may be passed between knots, in the law's own unit."""
    shown: Callable[[float], str] = "{:.4g}".format
    """A value of the law in the user's units."""
    aim: tuple[Any, float] | None = None
    """For initial guesses: it heads for a point (3,) m, turned right by an angle, rad."""
    box: Any | None = None
    """Where it keeps the root, (2, 3) m: a mark outside is refused before anything is solved."""
    ask: Callable[[float, float], Ask] | None = None
    """What an audit measures in its place, from a first to a last frame; None: nothing."""
    joint: str | None = None
    """It is a range of this joint: at knots a bound of variables, and no row."""
    identity: Hashable = None
    """Equal for constraints of one law and bounds; by default a constraint equals itself alone."""

    @property
    def title(self) -> str:
        """What messages call it."""
        return self.name.replace("limit ", "limits.")


Term = Cost | Constraint


def _effort(s: SegmentView) -> Expr:
    """Squared controls over their scale, integrated over time."""  # exact for controls linear between knots
    return s.h / 3 * (ca.sumsqr(s.c0) + ca.dot(s.c0, s.c1) + ca.sumsqr(s.c1))


def _off_course(k: KnotView) -> Expr:
    """Horizontal speed less its part along the nose, m/s: zero in forward flight, twice the speed backwards."""
    across = ca.sqrt(ca.sumsqr(k.velocity[0:2]) + 0.01)
    return across - ca.dot(k.rotation[0:2, 0], k.velocity[0:2])


def _steering(k: KnotView) -> Expr:
    """Tangent of the steering angle."""
    if STEERING not in k.names:
        raise InputError("the vehicle steers no wheel", f"its joints are {list(k.names)}", key="cost", value="steering")
    return k.joint(STEERING)


def _mean(law: Callable[[KnotView], Expr], s: SegmentView) -> Expr:
    return s.h / 2 * (law(s.start) + law(s.end))


def _time(s: SegmentView) -> Expr:
    """How long it takes, s."""
    return s.h


def _distance(s: SegmentView) -> Expr:
    """Length of the path, m."""
    return _norm(s.end.position - s.start.position)


def _smoothness(s: SegmentView) -> Expr:
    """Squared rates of the controls over their scale, integrated over time."""
    return ca.sumsqr(s.c1 - s.c0) / s.h


def _course(s: SegmentView) -> Expr:
    """Distance moved other than along the nose, m."""
    return _mean(_off_course, s)


def _steered(s: SegmentView) -> Expr:
    """Squared tangent of the steering angle, integrated over time; vehicles that steer wheels."""
    return _mean(lambda k: _steering(k) ** 2, s)


def _safety(place: HazardView) -> Expr:
    """Nearness to terrain and obstacles, integrated over time."""
    return ca.sum1(ca.exp(-place.distances / REACH)) / place.distances.shape[0]


def _work(s: SegmentView) -> Expr:
    """Work the controls do, of either sign, in metres that it would lift the vehicle."""
    # Simpson's rule: knots alone would let force and speed take turns
    middle = ca.dot(s.start.push + s.end.push, s.start.rates + s.end.rates) / 4
    a, b, c = (ca.sqrt(power**2 + 0.04) - 0.2 for power in (s.start.power, middle, s.end.power))
    return s.h / 6 * (a + 4 * b + c)


REACH = 4.0
"""Distance over which the cost of being near falls to 1/e, m."""


def _norm(vector: Expr) -> Expr:
    return ca.sqrt(ca.sumsqr(vector) + 1e-8)


COSTS: Registry[Callable[[Any], Expr]] = Registry(
    "vehsim.costs",
    {
        "effort": _effort,
        "time": _time,
        "distance": _distance,
        "smoothness": _smoothness,
        "course": _course,
        "energy": _work,
        "steering": _steered,
        "safety": _safety,
    },
)
"""Cost name -> its law. The docstring of each is its one description."""

VIEWS: dict[str, type] = {"safety": HazardView}
"""What the law of a cost takes where it is not a `SegmentView`. A law of a segment is the integral over it, a law of a
`HazardView` what an instant costs a second."""


def costs_of(view: type, weights: Mapping[str, float]) -> tuple[str, ...]:
    """Names of the costs that count, of those whose laws take such a view."""
    return tuple(name for name, weight in weights.items() if weight and VIEWS.get(name, SegmentView) is view)


def weight_of(cost: str) -> str:
    """The name of the parameter that is a cost's weight."""
    return f"weight of {cost}"


PRESETS: dict[str, dict[str, float]] = {
    "energy": {"energy": 1.0, "effort": 0.1},
    "safety": {"safety": 10.0, "effort": 1.0},
}
"""Names that stand for several weights: alone these would leave the controls open where nothing is near or moves."""


@dataclass(frozen=True)
class Limit:
    """A built-in limit: the ``law`` of a `KnotView` that stays below a value in ``unit``, rad for angles.

    ``meaning``: what the value bounds, in a few words; ``slack``: by how much it may be passed between knots, in its
    unit; a share of the value by default.
    """

    law: Callable[[Any], Expr]
    unit: str
    meaning: str
    joint: str | None = None
    slack: float | None = None

    @property
    def angular(self) -> bool:
        return self.unit.startswith("rad")


STEERING = "sigma"
"""The joint of all steered vehicles: the tangent of the steering angle."""

LIMITS: Registry[Limit] = Registry(
    "vehsim.limits",
    {
        "speed": Limit(lambda k: _norm(k.velocity), "m/s", "speed in any direction"),
        "ceiling": Limit(lambda k: k.position[2], "m", "height of the root", slack=0.005),
        "climb": Limit(lambda k: ca.sqrt(k.velocity[2] ** 2 + 1e-8), "m/s", "speed up or down"),
        "turn_rate": Limit(lambda k: _norm(k.omega), "rad/s", "angular speed about any axis"),
        "bank": Limit(
            lambda k: ca.acos(0.9999999 * k.rotation[2, 2]), "rad", "angle between the body's and the world's Z"
        ),
        "acceleration": Limit(lambda k: _norm(k.acceleration), "m/s^2", "acceleration in any direction"),
        "g_load": Limit(
            lambda k: _norm(k.acceleration / GRAVITY + ca.DM([0, 0, 1])), "g", "what the crew feels: 1 at rest"
        ),
        "steering": Limit(
            lambda k: ca.sqrt(ca.atan(k.joint(STEERING)) ** 2 + 1e-8), "rad", "steering angle", joint=STEERING
        ),
        "steering_rate": Limit(
            lambda k: ca.sqrt((k.rate(STEERING) / (1 + k.joint(STEERING) ** 2)) ** 2 + 1e-8),
            "rad/s",
            "how fast the steering angle changes",
            joint=STEERING,
        ),
    },
)
"""Limit name -> the value that stays below it. The audit uses the measure of the same name."""

SMOOTHNESS = 1e-3
"""Default weight of smoothness: it keeps any optimum unique and the controls from chattering."""


def cost_weights(cost: str | Mapping[str, float], defaults: Mapping[str, float]) -> dict[str, float]:
    """Weights by cost name, from a name or a table; ``defaults`` are the vehicle's own and yield to the table."""
    table = PRESETS.get(cost, {cost: 1.0}) if isinstance(cost, str) else dict(cost)
    for name, weight in table.items():
        _known("cost", name, COSTS)
        if not (isinstance(weight, int | float) and 0 <= weight < float("inf")):
            raise InputError("not a weight", "give a number, zero or more", key=f"cost.{name}", value=weight)
    if not any(table.values()):
        raise InputError("no weight above zero", f"weigh at least one of {', '.join(COSTS)}", key="cost", value=cost)
    return {name: 0.0 for name in COSTS} | {"smoothness": SMOOTHNESS} | dict(defaults) | table


@dataclass(frozen=True)
class Limits:
    """What stays below what: ``values`` by name of `LIMITS`; ``joints``, ``joint_rates`` (low, high) by joint name."""

    values: Mapping[str, float] = field(default_factory=dict)
    joints: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    joint_rates: Mapping[str, tuple[float, float]] = field(default_factory=dict)

    def get(self, name: str, unless: float = float("inf")) -> float:
        return self.values.get(name, unless)

    def below(self, speed: float) -> Limits:
        """The same with a limit of the speed, m/s."""
        return replace(self, values={**self.values, "speed": speed})

    def constraints(self) -> list[Constraint]:
        """The limits as constraints, scaled to one. At knots, joint limits are bounds of variables."""
        made: list[Constraint] = []
        for name, value in self.values.items():
            limit = LIMITS[name]
            made.append(
                Constraint(
                    f"limit {name}", _scaled(limit.law, value), upper=1.0, identity=("limit", name, value),
                    slack=SLACK if limit.slack is None else limit.slack / value,
                    shown=_in_unit(value, limit.unit),
                )
            )  # fmt: skip
        for name, (low, high) in self.joint_rates.items():
            made.append(
                Constraint(
                    f"limit joint_rates.{name}", _rate(name), low, high, slack=SLACK * max(-low, high),
                    identity=("limit joint_rates", name, low, high),
                )
            )  # fmt: skip
        for name, (low, high) in self.joints.items():
            made.append(
                Constraint(
                    f"limit joints.{name}", _joint(name), low, high, over="between", slack=SLACK * max(-low, high),
                    joint=name, identity=("limit joints", name, low, high),
                )
            )  # fmt: skip
        return made


def _scaled(law: Callable[[Any], Expr], value: float) -> Callable[[Any], Expr]:
    return lambda view: law(view) / value


def _in_unit(value: float, unit: str) -> Callable[[float], str]:
    """A law's value, scaled by ``value``, in the unit that users give it in."""
    scale, shown = (math.degrees(value), unit.replace("rad", "deg")) if unit.startswith("rad") else (value, unit)
    return lambda share: f"{share * scale:.4g} {shown}"


def _joint(joint: str) -> Callable[[KnotView], Expr]:
    return lambda view: view.joint(joint)


def _rate(joint: str) -> Callable[[KnotView], Expr]:
    return lambda view: view.rate(joint)


def check_limits(limits: Mapping[str, Any], joints: Sequence[str] = ()) -> Limits:
    """The limits, every one known and positive; ``joints`` and ``joint_rates`` are tables of a bound or (low, high)."""
    values: dict[str, float] = {}
    ranges: dict[str, dict[str, tuple[float, float]]] = {"joints": {}, "joint_rates": {}}
    for name, value in limits.items():
        if name in ranges:
            for joint, bounds in value.items():
                _known(f"limits.{name}", joint, dict.fromkeys(joints))
                ranges[name][joint] = _range(f"limits.{name}.{joint}", bounds)
            continue
        _known("limits", name, LIMITS)
        if name not in MEASURES:
            remedy = f"register its measure as {name!r} in the entry point group vehsim.measures"
            raise InputError(
                "nothing measures this limit in the finished motion", remedy, key=f"limits.{name}", value=value
            )
        if not (isinstance(value, int | float) and value > 0):
            raise InputError("not a bound", "give a positive number", key=f"limits.{name}", value=value)
        needed = LIMITS[name].joint
        if needed is not None and needed not in joints:
            raise InputError(
                f"this vehicle has no joint {needed!r} to steer with",
                f"limit its own joints: limits.joints of {', '.join(joints) or 'none'}",
                key=f"limits.{name}",
                value=value,
            )
        values[name] = float(value)
    return Limits(values, ranges["joints"], ranges["joint_rates"])


def _range(key: str, bounds: Any) -> tuple[float, float]:
    low, high = (-bounds, bounds) if isinstance(bounds, int | float) else tuple(bounds)
    if not (np.isfinite(low) and np.isfinite(high) and low < high):
        raise InputError("not a bound", "give a number above zero, or [low, high]", key=key, value=bounds)
    return float(low), float(high)


def check_terms(terms: Sequence[Term]) -> tuple[Term, ...]:
    """The terms; ``InputError`` for what is none."""
    for i, term in enumerate(terms):
        if not isinstance(term, Cost | Constraint):
            raise InputError("not a term", "give a vehsim.planning.Cost or Constraint", key=f"terms[{i}]", value=term)
        if isinstance(term, Cost) and not (0 <= term.weight < float("inf")):
            raise InputError("not a weight", "give a number, zero or more", key=f"terms[{i}].weight", value=term.weight)
        if isinstance(term, Constraint) and term.over not in ("knots", "segments", "everywhere"):
            raise InputError(
                "unknown", "choose one of knots, segments, everywhere", key=f"terms[{i}].over", value=term.over
            )
    return tuple(terms)


def _known(kind: str, name: str, table: Mapping[str, Any]) -> None:
    if name not in table:
        close = get_close_matches(name, table, n=1)
        hint = f"did you mean {close[0]!r}?" if close else f"choose one of {', '.join(table)}"
        raise InputError("unknown", hint, key=kind, value=name)
