"""Costs, limits and the user's own terms, as data: each is one expression of a knot or of a segment.

A built-in cost is a law of a `SegmentView`, and a built-in limit a law of a `KnotView` or `SegmentView`; the same holds
for a user's `Cost` and `Constraint`. A law is evaluated once in CasADi symbols and differentiated from there.
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
from vehsim.constants import GRAVITY
from vehsim.errors import InputError
from vehsim.requests import Ask
from vehsim.runtime.registry import Registry
from vehsim.vehicles.definition.quantities import in_degrees

Expr = Any
"""A CasADi expression."""


@dataclass(frozen=True)
class KnotView:
    """The quantities of one instant that a law can use: CasADi columns, SI units and radians.

    ``position`` (3,) of the rig's root, world; ``velocity`` and ``acceleration`` (3,), world axes, at a knot those of
    the later segment; ``omega`` (3,) body axes; ``rotation`` (3, 3) root to world; ``joints, joint_rates`` (s,);
    ``controls`` (c,); ``push``: the generalised force of the controls over the vehicle's weight; ``rates``: the
    velocity along ``push``; ``t``: s since the first mark; ``slope`` (2,): rise per metre along the world's X and Y of
    the ground under a vehicle on wheels, otherwise 0; ``lift``: the vertical acceleration, m/s^2, that the bend of this
    ground adds to that of its slope, below zero on a crest.
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
    slope: Expr = field(default_factory=lambda: ca.DM.zeros(2))
    lift: Expr = 0.0

    @property
    def power(self) -> Expr:
        """Power of the controls over the vehicle's weight: the climb rate, m/s, that it would sustain."""
        return ca.dot(self.push, self.rates)

    def joint(self, name: str) -> Expr:
        """The value of a joint by name."""
        return self.joints[self.names.index(name)]

    def rate(self, name: str) -> Expr:
        """The rate of a joint by name."""
        return self.joint_rates[self.names.index(name)]


@dataclass(frozen=True)
class SegmentView:
    """The quantities of one segment that a law can use.

    Its two knots; ``c0, c1``: controls at both ends over their scale; ``h``: duration, s.
    """

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
class BendView:
    """The quantities of two consecutive segments that a law can use.

    ``c0, c1, c2``: controls over their scale; ``h0, h1``: durations, s.
    """

    c0: Expr
    c1: Expr
    c2: Expr
    h0: Expr
    h1: Expr


@dataclass(frozen=True)
class HazardView:
    """The quantities of one instant near terrain or obstacles.

    ``distances`` (k,) m: from the vehicle's spheres to the nearest terrain or obstacle.
    """

    distances: Expr


@dataclass(frozen=True, eq=False)
class Cost:
    """A user's cost: ``law`` takes a `SegmentView` and returns the cost of that segment, a scalar.

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
"""Default tolerance of a limit between knots, relative to its value."""


@dataclass(frozen=True, eq=False)
class Constraint:
    """A user's constraint: ``lower <= law(view) <= upper``, component by component.

    ``over``: ``"everywhere"`` enforces it at knots and, to within ``slack``, between them; ``"knots"`` only at knots.
    Both take a law of a `KnotView`; ``"segments"`` takes a law of a `SegmentView`. ``frames`` (first, last): where it
    applies, both included.
    """

    name: str
    law: Callable[[Any], Expr]
    lower: Any = -np.inf
    upper: Any = np.inf
    over: Where = "everywhere"
    frames: tuple[int, int] | None = None
    slack: float = 1e-3
    """Tolerance between knots, in the unit of the law."""
    shown: Callable[[float], str] = "{:.4g}".format
    """Format a value of the law in the user's units."""
    aim: tuple[Any, float] | None = None
    """For initial guesses: head for a point (3,) m, plus an angle to the right, rad."""
    box: Any | None = None
    """Box (2, 3) m in which it keeps the root: a mark outside is refused before anything is solved."""
    ask: Callable[[float, float], Ask] | None = None
    """The request that the audit measures for it, from a first to a last frame; None: the audit measures nothing."""
    joint: str | None = None
    """The joint whose range it is, if any: at knots it is then a bound on variables, not a row."""
    identity: Hashable = None
    """Equal for constraints with the same law and bounds; by default a constraint equals only itself."""

    @property
    def title(self) -> str:
        """Its name in messages."""
        return self.name.replace("limit ", "limits.")


Term = Cost | Constraint


def _effort(s: SegmentView) -> Expr:
    """Squared controls over their scale, integrated over time."""  # exact for controls linear between knots
    return s.h / 3 * (ca.sumsqr(s.c0) + ca.dot(s.c0, s.c1) + ca.sumsqr(s.c1))


def _off_course(k: KnotView) -> Expr:
    """Horizontal speed minus its component along the nose, m/s: zero in forward flight, twice the speed backwards."""
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
    """Duration, s."""
    return s.h


def _distance(s: SegmentView) -> Expr:
    """Length of the path, m."""
    return _norm(s.end.position - s.start.position)


def _smoothness(s: SegmentView) -> Expr:
    """Squared rates of the controls over their scale, integrated over time."""
    return ca.sumsqr(s.c1 - s.c0) / s.h


def _spin(s: SegmentView) -> Expr:
    """Squared acceleration of the joints, integrated over time."""
    return ca.sumsqr(s.end.joint_rates - s.start.joint_rates) / s.h


def _easing(b: BendView) -> Expr:
    """Squared change of the rates of the controls over their scale, per second, integrated over time."""
    return ca.sumsqr((b.c2 - b.c1) / b.h1 - (b.c1 - b.c0) / b.h0) * 2 / (b.h0 + b.h1)


def _course(s: SegmentView) -> Expr:
    """Horizontal distance moved sideways or backwards, m."""
    return _mean(_off_course, s)


def _level(s: SegmentView) -> Expr:
    """Squared vertical speed, integrated over time, m^2/s."""
    return (s.end.position[2] - s.start.position[2]) ** 2 / s.h


SLOW = 0.5
"""Vertical speed, m/s, below which `_rise` is `_level`."""
APPROACH = 0.25
"""Drop per metre over ground of the steepest usual approach, of 14 degrees."""
STEEP = 0.1
"""Weight of steeper descents: a second of hover costs a helicopter 1.5, so it then sinks vertically at 3.6 m/s. From
4.6 m/s, half of the speed that its rotor induces in hover, it might enter its own wake (vortex ring state)."""


def _rise(s: SegmentView) -> Expr:
    """Vertical distance, m, and the squared speed down beyond that of an approach, integrated over time."""
    move, slow = s.end.position - s.start.position, SLOW * s.h
    steep = positive(-move[2] - APPROACH * ca.sqrt(ca.sumsqr(move[0:2]) + slow**2), slow)
    return (2 * slow * (ca.sqrt(move[2] ** 2 + slow**2) - slow) + STEEP * steep**2) / s.h


def _turning(s: SegmentView) -> Expr:
    """Squared rate of turning about the body's Z axis, integrated over time, 1/s."""
    return _mean(lambda k: k.omega[2] ** 2, s)


def _steered(s: SegmentView) -> Expr:
    """Squared tangent of the steering angle, integrated over time; vehicles that steer wheels."""
    return _mean(lambda k: _steering(k) ** 2, s)


def _safety(place: HazardView) -> Expr:
    """Nearness to terrain and obstacles, integrated over time."""
    return ca.sum1(ca.exp(-place.distances / REACH)) / place.distances.shape[0]


def _work(s: SegmentView) -> Expr:
    """Absolute work of the controls over the vehicle's weight, m."""
    # Simpson's rule: sampled at knots only, force and velocity could alternate to make the work appear zero
    middle = ca.dot(s.start.push + s.end.push, s.start.rates + s.end.rates) / 4
    a, b, c = (ca.sqrt(power**2 + 0.04) - 0.2 for power in (s.start.power, middle, s.end.power))
    return s.h / 6 * (a + 4 * b + c)


REACH = 4.0
"""Distance over which the cost of proximity falls to 1/e, m."""


def _norm(vector: Expr) -> Expr:
    return ca.sqrt(ca.sumsqr(vector) + 1e-8)


def positive(value: Expr, edge: Expr) -> Expr:
    """The value where it is positive, rounded over ``edge`` where it is zero."""
    return (value + ca.sqrt(value**2 + edge**2)) / 2


LIGHT = 0.01
"""Share of the weight below which the load on the ground is rounded to stay above zero, where wheels leave it."""


def _grip(k: KnotView) -> Expr:
    """Force of the ground along it over that across it, of a mass that follows it."""
    level, slope, load = k.acceleration[0:2] / GRAVITY, k.slope, 1 + k.lift / GRAVITY
    rise, steep = ca.dot(slope, level), ca.sumsqr(slope)
    along = (ca.sumsqr(level) + rise**2 + 2 * rise * load) * (1 + steep) + steep * load**2
    return ca.sqrt(along + 1e-8) / positive(load, LIGHT)


COSTS: Registry[Callable[[Any], Expr]] = Registry(
    "vehsim.costs",
    {
        "effort": _effort,
        "time": _time,
        "distance": _distance,
        "smoothness": _smoothness,
        "easing": _easing,
        "spin": _spin,
        "course": _course,
        "level": _level,
        "turning": _turning,
        "energy": _work,
        "steering": _steered,
        "safety": _safety,
    },
)
"""Cost name -> its law. The first line of a law's docstring is the cost's description."""

UNTIMED: dict[str, Callable[[SegmentView], Expr]] = {"level": _rise}
"""Cost name -> the law that replaces its own after the last given frame. A climb there must not cost the less the
longer it takes."""

VIEWS: dict[str, type] = {"safety": HazardView, "easing": BendView}
"""The view that the law of a cost takes if it is not a `SegmentView`. A law of a `SegmentView` returns the integral
over the segment, a law of a `BendView` that around the knot in its middle, a law of a `HazardView` the cost per
second."""


def costs_of(view: type, weights: Mapping[str, float]) -> tuple[str, ...]:
    """Names of the costs with a weight above zero whose laws take a given view."""
    return tuple(name for name, weight in weights.items() if weight and VIEWS.get(name, SegmentView) is view)


def weight_of(cost: str) -> str:
    """The parameter name of a cost's weight."""
    return f"weight of {cost}"


PRESETS: dict[str, dict[str, float]] = {
    "energy": {"energy": 1.0, "effort": 0.1},
    "safety": {"safety": 10.0, "effort": 1.0},
}
"""Names for several weights: alone, these costs would leave the controls undetermined at rest or far from obstacles."""


@dataclass(frozen=True)
class Limit:
    """A built-in limit: an upper bound, in ``unit`` (rad for angles), on the ``law`` of a `KnotView`.

    ``meaning``: what is bounded, in a few words; ``slack``: tolerance between knots, in its unit; by default `SLACK` of
    the value; ``on_tyres``: only for vehicles that stand on tyres.
    """

    law: Callable[[Any], Expr]
    unit: str
    meaning: str
    joint: str | None = None
    slack: float | None = None
    on_tyres: bool = False

    @property
    def angular(self) -> bool:
        return self.unit.startswith("rad")

    @property
    def height(self) -> bool:
        """Whether it bounds a height, which has no natural zero: its bound may be any number."""
        return self.unit == "m"

    def scale(self, bound: float) -> float:
        """What the law is divided by, in its unit."""
        return max(abs(bound), 1.0) if self.height and bound <= 0 else bound


STEERING = "sigma"
"""The joint of all steered vehicles; its value is the tangent of the steering angle."""

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
        "grip": Limit(
            _grip,
            "g",
            "friction that tyres need, over that of their surface to dry asphalt",
            on_tyres=True,
        ),
        "g_load": Limit(
            lambda k: _norm(k.acceleration / GRAVITY + ca.DM([0, 0, 1])),
            "g",
            "acceleration that the crew feels: 1 at rest",
        ),
        "steering": Limit(
            lambda k: ca.sqrt(ca.atan(k.joint(STEERING)) ** 2 + 1e-8), "rad", "steering angle", joint=STEERING
        ),
        "steering_rate": Limit(
            lambda k: ca.sqrt((k.rate(STEERING) / (1 + k.joint(STEERING) ** 2)) ** 2 + 1e-8),
            "rad/s",
            "rate of the steering angle",
            joint=STEERING,
        ),
    },
)
"""Limit name -> the bounded quantity. The audit uses the measure of the same name."""

SMOOTHNESS = 1e-3
"""Default weight of smoothness: it makes the optimum unique and prevents chattering controls."""


def cost_weights(cost: str | Mapping[str, float], defaults: Mapping[str, float]) -> dict[str, float]:
    """Weights by cost name, from a name or a table; the table overrides ``defaults``, which are the vehicle's own."""
    table = PRESETS.get(cost, {cost: 1.0}) if isinstance(cost, str) else dict(cost)
    for name, weight in table.items():
        _known("cost", name, COSTS)
        if not (isinstance(weight, int | float) and 0 <= weight < float("inf")):
            raise InputError("not a weight", "give a number, zero or more", key=f"cost.{name}", value=weight)
    if not any(table.values()):
        raise InputError("no weight above zero", f"give a weight to one of {', '.join(COSTS)}", key="cost", value=cost)
    return {name: 0.0 for name in COSTS} | {"smoothness": SMOOTHNESS} | dict(defaults) | table


def heaviest(cost: str | Mapping[str, float]) -> float:
    """The greatest of the weights that a cost's name or table stands for; 1 where that is not known to be one."""
    table = PRESETS.get(cost, {cost: 1.0}) if isinstance(cost, str) else cost
    return max((float(w) for w in table.values() if isinstance(w, int | float) and w > 0), default=1.0)


@dataclass(frozen=True)
class Limits:
    """The limits: ``values`` by name of `LIMITS`; ``joints``, ``joint_rates`` (low, high) by joint name."""

    values: Mapping[str, float] = field(default_factory=dict)
    joints: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    joint_rates: Mapping[str, tuple[float, float]] = field(default_factory=dict)

    def get(self, name: str, default: float = float("inf")) -> float:
        return self.values.get(name, default)

    def within(self, values: Mapping[str, float]) -> Limits:
        """The same limits, with other ``values`` by name, SI."""
        return replace(self, values={**self.values, **values})

    def constraints(self) -> list[Constraint]:
        """The limits as constraints, scaled to one. At knots, joint limits are bounds of variables."""
        made: list[Constraint] = []
        for name, value in self.values.items():
            limit = LIMITS[name]
            scale = limit.scale(value)
            made.append(
                Constraint(
                    f"limit {name}", _scaled(limit.law, scale), upper=value / scale, identity=("limit", name, value),
                    slack=SLACK if limit.slack is None else limit.slack / scale,
                    shown=_in_unit(scale, limit.unit),
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
                    f"limit joints.{name}", _joint(name), low, high, over="between",
                    slack=SLACK * max(abs(end) for end in (low, high) if math.isfinite(end)),
                    joint=name, identity=("limit joints", name, low, high),
                )
            )  # fmt: skip
        return made


def _scaled(law: Callable[[Any], Expr], value: float) -> Callable[[Any], Expr]:
    return lambda view: law(view) / value


def _in_unit(value: float, unit: str) -> Callable[[float], str]:
    """Format a law's value, scaled by ``value``, in the unit of the shot file."""
    factor, shown = in_degrees(unit)
    return lambda share: f"{share * (factor * value):.4g} {shown}"


def _joint(joint: str) -> Callable[[KnotView], Expr]:
    return lambda view: view.joint(joint)


def _rate(joint: str) -> Callable[[KnotView], Expr]:
    return lambda view: view.rate(joint)


def check_limits(limits: Mapping[str, Any], joints: Sequence[str] = ()) -> Limits:
    """The limits, checked; ``joints`` and ``joint_rates`` are tables of a bound or (low, high)."""
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
        height = LIMITS[name].height
        if not (isinstance(value, int | float) and (math.isfinite(value) if height else value > 0)):
            remedy = "give a height in m" if height else "give a positive number"
            raise InputError("not a bound", remedy, key=f"limits.{name}", value=value)
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
    """The terms, checked; raises ``InputError`` for an invalid term."""
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
