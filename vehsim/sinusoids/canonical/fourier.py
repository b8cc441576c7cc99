"""SIN's Fourier algorithm for triangular systems with nonlinearities (sec. 2-4).

First, constant inputs steer the coordinates that the inputs drive; then one coordinate after another is steered by two
sinusoids at integrally related frequencies. Along a loop all rates are periodic, so the net motion of a coordinate is
the mean of its rate, the zeroth Fourier coefficient. It determines the amplitude, and shows whether the coordinates
steered before are unchanged.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import permutations, product
from typing import Any

import casadi as ca
import numpy as np

from vehsim.errors import InputError, SolveError
from vehsim.sinusoids.algebra.classification import classify
from vehsim.sinusoids.algebra.feedback import Feedback
from vehsim.sinusoids.canonical.chained import periodic_integral
from vehsim.sinusoids.laws import Law, chebyshev
from vehsim.sinusoids.steering import Stage, Steering, integrate
from vehsim.sinusoids.system import Array, DriftlessSystem

SAMPLES = 512
"""Number of points per cycle of the fastest sinusoid in the analysis of a loop."""
CLOSED = 1e-10
"""A coordinate with a net motion below this over a loop counts as unchanged."""
REACH = 0.85
"""Loops use at most this share of the distance to a bound of the domain."""


@dataclass(frozen=True)
class SinusoidPair:
    """Two sinusoids: ``p`` moves by ``a (cos phase - cos(2 pi s c + phase))``, ``q`` by ``b sin`` at ``harmonic``
    times.

    ``p, q``: states that the inputs drive; ``cycles``: c, number of periods of the slow one; ``phase``: its start, rad.
    """

    p: int
    q: int
    harmonic: int
    cycles: int = 1
    phase: float = 0.0

    def excursions(self, s: Array, a: float, b: float) -> tuple[Array, Array]:
        """Displacements of p and q, each (k,)."""
        slow, k = math.tau * self.cycles * s + self.phase, self.harmonic
        return a * (np.cos(self.phase) - np.cos(slow)), b * (np.sin(k * slow) - np.sin(k * self.phase))

    def rates(self, s: Array, a: float, b: float) -> tuple[Array, Array]:
        """Inputs of p and q, per unit of s."""
        slow, rate, k = math.tau * self.cycles * s + self.phase, math.tau * self.cycles, self.harmonic
        return a * rate * np.sin(slow), b * k * rate * np.cos(k * slow)


@dataclass(frozen=True, eq=False)
class Triangular:
    """A triangular system: ``level`` of each state (1: driven by an input of its own), ``driver`` state -> input."""

    system: DriftlessSystem
    level: tuple[int, ...]
    driver: dict[int, int]

    @property
    def order(self) -> list[int]:
        """States beyond the first level, in the order they are steered."""
        return sorted((i for i, k in enumerate(self.level) if k > 1), key=lambda i: (self.level[i], i))


def triangular(system: DriftlessSystem) -> Triangular:
    """The levels of a triangular system (SIN sec. 4). Raises ``InputError`` naming the coordinate that breaks the
    order."""
    n, m = system.n, system.m
    points = system.samples(4)
    depends = _dependence(system, points)
    level, driver = [0] * n, {}
    for j in range(m):
        rows = [i for i in range(n) if _is_unit(system, i, j, points) and i not in driver]
        if not rows:
            raise InputError(
                f"not triangular: no coordinate moves with input {system.inputs[j]} alone, at unit rate",
                "change inputs first (vehsim.sinusoids.algebra.feedback)",
                subject=system.name,
            )
        driver[rows[0]] = j
        level[rows[0]] = 1
    while 0 in level:
        ready = [i for i in range(n) if not level[i] and all(level[k] for k in _needs(depends, i))]
        if not ready:
            i = level.index(0)
            blocks = [system.states[k] for k in _needs(depends, i) if not level[k]]
            raise InputError(
                f"not triangular: {system.states[i]} depends on {', '.join(blocks)}, which cannot be steered before it",
                "change coordinates first (vehsim.sinusoids.algebra.feedback)",
                subject=system.name,
            )
        for i in ready:
            level[i] = 1 + max((level[k] for k in _needs(depends, i)), default=1)
    return Triangular(system, tuple(level), driver)


def steer_triangular(
    system: DriftlessSystem | Feedback,
    start: Any,
    goal: Any,
    *,
    amplitude: float = 1.0,
    cycles: int | None = None,
    phase: float = 0.0,
    first: Law | None = None,
) -> Steering:
    """The Fourier algorithm from ``start`` to ``goal``, states of the system itself (before any ``Feedback``).

    ``amplitude`` of the slow sinusoid, increased if the domain requires it; ``cycles``, ``phase`` [rad] select a member
    of the family of loops; default: as few cycles as the domain permits. ``first``: inputs of the first stage; default:
    constant. A state that an input changes without moving others is set to the middle of its domain for loops that
    would otherwise leave the domain: a car's wheels are straightened, and set at the end. Raises ``InputError`` for a
    system that is not triangular, ``SolveError`` naming the coordinate that no loop moves alone.
    """
    change = system if isinstance(system, Feedback) else None
    source: DriftlessSystem = system.source if isinstance(system, Feedback) else system
    t = triangular(change.target if change else system)  # type: ignore[arg-type]  # `change` is the feedback
    x0, x1 = source.check_state("start", start), source.check_state("goal", goal)
    h0, h1 = (change.to(x0), change.to(x1)) if change else (x0, x1)
    signs = (1.0, -1.0) if cycles is None else (1.0,)
    for count, sign, released in product((1, 2, 4, 8) if cycles is None else (cycles,), signs, (False, True)):
        if released and (first is not None or not _spinning(t)):
            continue
        try:
            steps = _stages(t, h0, h1, partial(_loop_stage, t, sign * amplitude, count, phase), first, released)
        except SolveError as error:
            reason = error
            continue
        steps = steps or [_constant("rest", np.zeros(source.m))]
        stages = steps if change is None else _source_stages(change, x0, steps)
        return Steering(source, x0, x1, tuple(stages)).checked()
    raise reason


def _stages(
    t: Triangular, h: Array, goal: Array, loop: Callable[..., Stage], first: Law | None, released: bool
) -> list[Stage]:
    """Stages from ``h`` to ``goal``: the driven coordinates at once, then the others one after another by loops."""
    aim, steps = goal.copy(), []
    if released:
        aim[_spinning(t)] = 0.0
        steps.append(_turned(t, "release", aim - h))
        h = h.copy()
        h[_spinning(t)] = 0.0
    more, h = _first_stages(t, h, aim, first)
    steps += more
    for i in t.order:
        if abs(aim[i] - h[i]) >= 1e-13:
            steps.append(loop(h, i, aim[i] - h[i]))
            h = _carried(t, h, steps[-1])
        h[i] = aim[i]
    return [*steps, _turned(t, "set", goal - aim)] if released else steps


def _spinning(t: Triangular) -> list[int]:
    """Driven states whose input moves nothing else at any state, and whose domain is centred on zero: a steering
    angle."""
    still = np.array([np.abs(t.system.matrix(p)).sum(axis=0) for p in t.system.samples(4)])
    domain = [t.system.domain.get(name, (0.0, 1.0)) for name in t.system.states]
    return [i for i, j in t.driver.items() if np.allclose(still[:, j], 1.0) and sum(domain[i]) == 0.0]


def _turned(t: Triangular, label: str, motion: Array) -> Stage:
    """The stage that moves the states of `_spinning` by ``motion`` (n,), and no others."""
    v = np.zeros(t.system.m)
    for state in _spinning(t):
        v[t.driver[state]] = motion[state]
    return _constant(label, v)


def steer_through(change: Feedback, start: Any, goal: Any, steer: Callable[[Array, Array], Steering]) -> Steering:
    """From ``start`` to ``goal`` of ``change.source``, by steering its target with ``steer(h0, h1)``."""
    source = change.source
    x0, x1 = source.check_state("start", start), source.check_state("goal", goal)
    steps = steer(change.to(x0), change.to(x1)).stages
    return Steering(source, x0, x1, tuple(_source_stages(change, x0, steps))).checked()


def net_motion(t: Triangular, h: Array, loop: SinusoidPair, a: float, b: float) -> Array:
    """Net motion (n,) over a loop from ``h``; NaN from the first level that does not close or leaves the domain."""
    system = t.system
    count = SAMPLES * loop.harmonic
    s = np.arange(count) / count  # one cycle: all cycles are equal as long as everything closes
    one = replace(loop, cycles=1)
    path = np.tile(h, (count, 1))
    for state, excursion in zip((loop.p, loop.q), one.excursions(s, a, b), strict=True):
        path[:, state] += excursion
    v = np.zeros((count, system.m))
    for state, rate in zip((loop.p, loop.q), one.rates(s, a, b), strict=True):
        v[:, t.driver[state]] = rate
    net = np.full(system.n, np.nan)
    net[list(t.driver)] = 0.0
    for level in range(2, max(t.level) + 1):
        rates = system.rates(path, v)
        for i in (i for i in range(system.n) if t.level[i] == level):
            net[i] = np.mean(rates[:, i])
            path[:, i] += periodic_integral(rates[:, i])
        lower = [system.domain.get(name, (-np.inf, np.inf)) for name in system.states]
        outside = any(np.any((path[:, i] < lo) | (path[:, i] > hi)) for i, (lo, hi) in enumerate(lower))
        if outside or not np.all(np.isfinite(path)):
            return np.where(np.array(t.level) > 1, np.nan, net)
        if any(abs(net[i]) > CLOSED for i in range(system.n) if t.level[i] == level):
            break
    return net * loop.cycles


def _missing(t: Triangular, h: Array, loop: SinusoidPair, i: int, wanted: float, a: float, b: float) -> float:
    """Difference between the motion of state ``i`` over a loop of amplitudes ``a, b`` and ``wanted``."""
    return float(net_motion(t, h, loop, a, b)[i]) - wanted


def _loop_stage(t: Triangular, amplitude: float, cycles: int, phase: float, h: Array, i: int, wanted: float) -> Stage:
    """The loop that moves state ``i`` by ``wanted`` without moving any state steered before it."""
    loop = _choose_loop(t, h, i, cycles, phase)
    p_bound, bound = (_room(t.system, h, k) for k in (loop.p, loop.q))
    a = float(np.sign(amplitude) or 1.0) * min(abs(amplitude), p_bound / 2)
    for _ in range(60):
        b = _amplitude(partial(_missing, t, h, loop, i, wanted, a), bound)
        if b is not None:
            law = _loop_law(t, loop, a, b)
            sizes = {t.system.states[loop.p]: abs(a), t.system.states[loop.q]: abs(b)}
            return Stage(t.system.states[i], law, cycles=loop.cycles * loop.harmonic, amplitudes=sizes)
        if abs(a) * 1.25 > p_bound / 2:
            break
        a *= 1.25
    raise SolveError(
        f"no loop moves it by {wanted:.4g} inside the domain from here",
        "take more cycles, or add an intermediate goal",
        key=t.system.states[i],
        subject=t.system.name,
    )


def _choose_loop(t: Triangular, h: Array, i: int, cycles: int, phase: float) -> SinusoidPair:
    """Inputs and harmonic that move state ``i`` alone: the bracket depth gives the harmonic, the Fourier analysis the
    inputs. Raises ``InputError`` if no bracket reaches it either."""
    tried = []
    for harmonic in range(t.level[i] - 1, t.level[i] + 2):
        for p, q in permutations(t.driver, 2):
            loop = SinusoidPair(p, q, harmonic, cycles, phase)
            net = net_motion(t, h, loop, 0.1, 0.1)
            done = [k for k in t.order if t.order.index(k) < t.order.index(i)]
            moved = [t.system.states[k] for k in done if not abs(net[k]) <= CLOSED]
            if not moved and np.isfinite(net[i]) and abs(net[i]) > 1e-12:
                return loop
            tried.append(
                f"{t.system.states[p]}/{t.system.states[q]} at 1:{harmonic} moves {', '.join(moved) or 'nothing'}"
            )
    classify(t.system, h.tolist()).require_controllable()
    raise SolveError(
        f"no pair of sinusoids moves it alone ({'; '.join(tried)})",
        "change coordinates, or another phase",
        key=t.system.states[i],
        subject=t.system.name,
    )


def _amplitude(gap: Callable[[float], float], bound: float) -> float | None:
    """The smallest |b| up to ``bound`` with ``gap(b) = 0``; None if there is none."""
    from scipy.optimize import brentq

    at_zero = gap(0.0)
    ladder = bound * np.linspace(0, 1, 25)[1:] if np.isfinite(bound) else np.geomspace(1e-3, 1e3, 40)
    for sign in (1.0, -1.0):
        before, value = 0.0, at_zero
        for b in sign * ladder:
            ahead = gap(b)
            if not np.isfinite(ahead):
                break
            if value * ahead <= 0:
                return float(brentq(gap, before, b, xtol=1e-15, rtol=1e-14))
            if abs(ahead) > abs(at_zero) and b == sign * ladder[0]:
                break  # the wrong direction
            before, value = b, ahead
    return None


def _room(system: DriftlessSystem, h: Array, i: int) -> float:
    """How far state ``i`` may move to either side."""
    lower, upper = system.domain.get(system.states[i], (-np.inf, np.inf))
    return REACH * float(min(h[i] - lower, upper - h[i]))


def _first_stages(t: Triangular, h: Array, goal: Array, law: Law | None) -> tuple[list[Stage], Array]:
    """The driven coordinates to their goals: all at once, or one after another if that would leave the chart.

    One after another: all but one to zero, that one to its goal, then the others. For example, a car straightens its
    wheels, drives, and turns them.
    """
    v = np.zeros(t.system.m)
    for state, j in t.driver.items():
        v[j] = goal[state] - h[state]
    if law is None and not np.any(v):
        return [], h
    try:
        stage = _constant("straight", v) if law is None else Stage("first", law)
        return [stage], _arrived(t, _carried(t, h, stage), goal)
    except SolveError:
        if law is not None:
            raise
    lead, *others = t.driver
    out, drive, back = (np.zeros(t.system.m) for _ in range(3))
    drive[t.driver[lead]] = v[t.driver[lead]]
    for state in others:
        out[t.driver[state]], back[t.driver[state]] = -h[state], goal[state]
    stages = [_constant(label, u) for label, u in (("release", out), ("straight", drive), ("set", back)) if np.any(u)]
    for stage in stages:
        h = _carried(t, h, stage)
    return stages, _arrived(t, h, goal)


def _constant(label: str, v: Array) -> Stage:
    return Stage(label, lambda s: np.tile(v, (len(s), 1)))


def _arrived(t: Triangular, h: Array, goal: Array) -> Array:
    """Set the driven coordinates, which are at their goals up to round-off, to exactly their goals."""
    h = h.copy()
    h[list(t.driver)] = goal[list(t.driver)]
    return h


def _loop_law(t: Triangular, loop: SinusoidPair, a: float, b: float) -> Law:
    p, q, m = t.driver[loop.p], t.driver[loop.q], t.system.m

    def law(s: Array) -> Array:
        v = np.zeros((len(s), m))
        v[:, p], v[:, q] = loop.rates(s, a, b)
        return v

    return law


def _carried(t: Triangular, h: Array, stage: Stage) -> Array:
    """The end of a stage, by integration. Raises ``SolveError`` if it leaves the chart."""
    end = integrate(t.system, stage, h, np.array([0.0, stage.duration]))[-1]
    for name, value in zip(t.system.states, end, strict=True):
        lower, upper = t.system.domain.get(name, (-np.inf, np.inf))
        if not lower <= value <= upper:
            raise SolveError(
                f"stage {stage.label!r} takes {name} to {value:.4g}, outside {lower:g} to {upper:g}: a singularity of "
                "these coordinates",
                "go by a nearer goal, or use another chart",
                subject=t.system.name,
            )
    return end


def _source_stages(change: Feedback, x0: Array, steps: Sequence[Stage]) -> list[Stage]:
    """Stages in the source's own inputs: ``u = beta(x)^-1 v`` along the motion, sampled at Chebyshev points."""
    x, stages = x0, []
    for stage in steps:

        def law(s: Array, stage: Stage = stage, x: Array = x) -> Array:
            states = integrate(change.driven, stage, x, np.concatenate([[0.0], s]))[1:]
            return change.source_inputs(states, stage.law(s))

        stages.append(replace(stage, law=chebyshev(law, stage.cycles)))
        x = integrate(change.driven, stage, x, np.array([0.0, 1.0]))[-1]
    return stages


def _needs(depends: Array, i: int) -> list[int]:
    return [int(k) for k in np.flatnonzero(depends[i].any(axis=0))]


def _dependence(system: DriftlessSystem, points: Array) -> Array:
    """(n, m, n) booleans: whether the rate of state i with input j depends on state k, from derivatives at states.

    By numbers, not by the structure of expressions: a change of coordinates leaves terms that cancel.
    """
    n, m = system.n, system.m
    function = ca.Function("dG", [system.x], [ca.densify(ca.jacobian(ca.vec(system.G), system.x))])
    values = np.array([np.asarray(function(p)) for p in points])
    size = 1 + max(float(np.abs(system.matrix(p)).max()) for p in points)
    return (np.abs(values).max(axis=0) > 1e-9 * size).reshape(n, m, n, order="F")


def _is_unit(system: DriftlessSystem, i: int, j: int, points: Array) -> bool:
    rows = np.array([system.matrix(p)[i] for p in points])
    return bool(np.allclose(rows, np.eye(system.m)[j], atol=1e-12))
