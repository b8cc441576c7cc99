"""The result of steering: stages of inputs, the motion that they produce, and its timing.

A driftless system can move at any speed: a stage is a law over ``s`` from 0 to 1, and a pace determines when each ``s``
is reached. Durations, limits and easing change the pace, never the path.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np

from vehsim.errors import InputError, SolveError
from vehsim.sinusoids.laws import Law, even
from vehsim.sinusoids.system import Array, DriftlessSystem

TOLERANCE = 1e-13
"""Relative accuracy of the integration of states."""
SETTLED = 1e-9
"""A change below this that does not decrease when steps are halved is round-off, which reversing trailers amplify."""
HALVINGS = 8
"""Maximum number of halvings of its steps."""
ACCURACY = 1e-6
"""Largest accepted difference between the goal and the end of the motion, in the states' own units."""


NOTHING = 1e-9
"""A stage shorter than this, s, consists of round-off only."""
CRUISE = 3315 / 2048
"""Peak rate of the paces below, relative to a mean of 1: start and stop within a quarter of the time."""


def _drive(x: Array) -> tuple[Array, Array]:
    """Path and rate ``(1 - x^4)^4`` at x in -1..1, with a mean rate of 1: forces start and end at zero, without
    rates."""
    return CRUISE * (x - 4 * x**5 / 5 + 2 * x**9 / 3 - 4 * x**13 / 13 + x**17 / 17), CRUISE * (1 - x**4) ** 4


PACES: dict[str, Callable[[Array], tuple[Array, Array]]] = {
    "steady": lambda t: (t, np.ones_like(t)),
    "start": lambda t: (1 + _drive(t - 1)[0], _drive(t - 1)[1]),
    "end": _drive,
    "both": lambda t: ((1 + _drive(2 * t - 1)[0]) / 2, _drive(2 * t - 1)[1]),
}
"""From the fraction of a stage's time (k,) to the fraction of its path and the rate: C4, at rest at its start, its end
or both."""


class TooFast(SolveError):
    """Raised for a motion that its vehicle can make in about ``needed`` s."""

    def __init__(self, message: str, needed: float):
        super().__init__(message)
        self.needed = needed


@dataclass(frozen=True, eq=False)
class Stage:
    """One stage: ``law(s)`` for s in 0..1, over ``duration`` s. ``cycles`` of its sinusoids; ``label`` for readers.

    ``pace``: a name of `PACES`: whether inputs start from and end at zero at the stage's ends.
    """

    label: str
    law: Law
    duration: float = 1.0
    cycles: int = 1
    pace: str = "steady"
    amplitudes: Mapping[str, float] = field(default_factory=dict)

    def inputs(self, times: Any) -> Array:
        """Inputs (k, m) at times (k,) s into the stage."""
        tau = np.clip(np.asarray(times, float) / self.duration, 0.0, 1.0)
        s, rate = PACES[self.pace](tau)
        return self.law(s) * (rate / self.duration)[:, None]

    def peaks(self) -> Array:
        """Largest |input| (m,) over the stage."""
        return np.abs(self.inputs(np.linspace(0, self.duration, 2000 * max(1, self.cycles) + 1))).max(axis=0)


@dataclass(frozen=True, eq=False)
class Steering:
    """Inputs that move ``system`` from ``start`` to ``goal`` (n,), stage after stage.

    ``times`` (k,) s, ``controls`` (k, m), ``states`` (k, n): samples, from integrating the inputs with an eighth-order
    method to 1e-13; ``inputs(t)`` at any time. ``end_error``: largest difference of a state from its goal at the end.
    """

    system: DriftlessSystem
    start: Array
    goal: Array
    stages: tuple[Stage, ...]
    label: str = ""
    rate: int = 24
    """Samples per second of ``times``, and at least 60 per cycle."""

    @property
    def duration(self) -> float:
        """Duration, s."""
        return float(sum(stage.duration for stage in self.stages))

    @property
    def knots(self) -> Array:
        """Times (stages + 1,) s at which stages start and end; inputs may jump there."""
        return np.concatenate([[0.0], np.cumsum([stage.duration for stage in self.stages])])

    def inputs(self, times: Any) -> Array:
        """Inputs (k, m) at times (k,) s; at the end of a stage, those of that stage."""
        times = np.atleast_1d(np.asarray(times, float))
        which = np.clip(np.searchsorted(self.knots, times, side="left") - 1, 0, len(self.stages) - 1)
        out = np.zeros((len(times), self.system.m))
        for k in np.unique(which):
            out[which == k] = self.stages[k].inputs(times[which == k] - self.knots[k])
        return out

    @cached_property
    def _motion(self) -> tuple[Array, Array, Array]:
        x, times, states, controls = self.start, [np.zeros(1)], [self.start[None]], []
        for k, stage in enumerate(self.stages):
            count = int(np.ceil(max(stage.duration * self.rate, 60 * stage.cycles)))
            t = np.linspace(0, stage.duration, count + 1)
            if k == 0:
                controls.append(stage.inputs(t[:1]))
            rows = integrate(self.system, stage, x, t)
            x = rows[-1]
            times.append(self.knots[k] + t[1:])
            states.append(rows[1:])
            controls.append(stage.inputs(t[1:]))
        return np.concatenate(times), np.concatenate(states), np.concatenate(controls)

    @property
    def times(self) -> Array:
        return self._motion[0]

    @property
    def states(self) -> Array:
        return self._motion[1]

    @property
    def controls(self) -> Array:
        return self._motion[2]

    @property
    def end_error(self) -> float:
        return float(np.abs(self.states[-1] - self.goal).max())

    @property
    def effort(self) -> float:
        """Integral of |u|^2 over time."""
        total = 0.0
        for stage in self.stages:
            t = np.linspace(0, stage.duration, 2000 * stage.cycles + 1)
            total += float(np.trapezoid(np.sum(stage.inputs(t) ** 2, axis=1), t))
        return total

    def towards(self, goal: Array) -> Steering:
        """The same motion compared with another goal, for angles that differ by full turns."""
        other = replace(self, goal=goal)
        other.__dict__["_motion"] = self._motion
        return other

    def checked(self, accuracy: float = ACCURACY) -> Steering:
        """This steering. Raises ``SolveError`` if its inputs, integrated, end farther than ``accuracy`` from the
        goal."""
        missed = np.abs(self.states[-1] - self.goal)
        if not np.all(missed <= accuracy):
            worst = int(np.nanargmax(np.where(np.isfinite(missed), missed, np.inf)))
            raise SolveError(
                f"{self.system.states[worst]} ends {missed[worst]:.2g} from its goal {self.goal[worst]:.6g}, more than "
                f"{accuracy:g}",
                "add an intermediate goal, or take smaller amplitudes",
                subject=self.system.name,
            )
        return self

    def timed(self, durations: float | Sequence[float]) -> Steering:
        """The same path with other stage durations, s: one for each stage, or a total that is distributed
        proportionally."""
        given = np.atleast_1d(np.asarray(durations, float))
        if given.size == 1 and len(self.stages) != 1:
            given = given * np.diff(self.knots) / self.duration
        if len(given) != len(self.stages) or not np.all(np.isfinite(given)) or np.any(given <= 0):
            raise InputError(
                "not times for these stages",
                f"give {len(self.stages)} times above zero, s, or their sum",
                key="durations",
                value=durations,
                subject=self.system.name,
            )
        return replace(
            self, stages=tuple(replace(s, duration=float(d)) for s, d in zip(self.stages, given, strict=True))
        )

    def eased(self, pace: str = "both") -> Steering:
        """The same path with every stage from rest to rest, or at another of the `PACES`."""
        if pace not in PACES:
            raise InputError(
                "no such pace", f"choose one of {', '.join(PACES)}", key="pace", value=pace, subject=self.system.name
            )
        return replace(self, stages=tuple(replace(stage, pace=pace) for stage in self.stages))

    def evened(self, limits: Mapping[str, float]) -> Steering:
        """The same path, with every stage as close to the ``limits`` on its inputs all along as smoothness permits."""
        bounds = np.array([limits.get(name, np.inf) for name in self.system.inputs])
        return replace(self, stages=tuple(replace(s, law=even(s.law, bounds, s.cycles)) for s in self.stages))

    def within(self, limits: Mapping[str, float]) -> Steering:
        """The same path, slowed down where an input exceeds its limit; never sped up.

        ``limits``: input -> largest |value|. The name of a state limits its excursion, which the time cannot change; if
        it is exceeded, ``InputError`` gives the excursion.
        """
        for name in limits:
            self._check_limit(name, limits[name])
        bounds = np.array([limits.get(name, np.inf) for name in self.system.inputs])
        stretch = self._together([max(1.0, float(np.max(stage.peaks() / bounds))) for stage in self.stages])
        return self.timed([stage.duration * k for stage, k in zip(self.stages, stretch, strict=True)])

    def fastest(self, limits: Mapping[str, float]) -> Steering:
        """The same path, with every stage as short as the limits on its inputs permit. Stages without limits stay
        unchanged; stages of less than a nanosecond, which are round-off, are removed.

        ``limits`` as in `within`.
        """
        for name in limits:
            self._check_limit(name, limits[name])
        bounds = np.array([limits.get(name, np.inf) for name in self.system.inputs])
        stretch = self._together([float(np.max(stage.peaks() / bounds)) for stage in self.stages])
        need = [s.duration * (k if k > 0 else 1.0) for k, s in zip(stretch, self.stages, strict=True)]
        moving = [k for k, seconds in enumerate(need) if seconds > NOTHING] or [0]
        kept = replace(self, stages=tuple(self.stages[k] for k in moving))
        return kept.timed([max(need[k], NOTHING) for k in moving])

    def _together(self, stretch: list[float]) -> list[float]:
        """Factors on the durations of stages, at least ``stretch``: equal for stages whose inputs continue from one to
        the next, so that they do not jump there."""
        stretch = list(stretch)
        ends = [stage.inputs([0.0, stage.duration]) for stage in self.stages]
        first = 0
        for k in range(1, len(stretch) + 1):
            if (
                k < len(stretch)
                and np.any(ends[k][0])
                and np.allclose(ends[k - 1][1], ends[k][0], rtol=1e-6, atol=1e-9)
            ):
                continue
            stretch[first:k] = [max(stretch[first:k])] * (k - first)
            first = k
        return stretch

    def _check_limit(self, name: str, bound: float) -> None:
        known = (*self.system.inputs, *self.system.states)
        if name not in known:
            raise InputError(
                "no such input or state",
                f"choose one of {', '.join(known)}",
                key=f"limits.{name}",
                subject=self.system.name,
            )
        if not bound > 0:
            raise InputError(
                "not a bound", "give a number above zero", key=f"limits.{name}", value=bound, subject=self.system.name
            )
        if name in self.system.states:
            reach = float(np.abs(self.states[:, self.system.states.index(name)]).max())
            if reach > bound * (1 + 1e-9):
                raise InputError(
                    f"the path reaches {reach:.4g}, and time does not change a path",
                    "take more cycles or another member of the family (vehsim.sinusoids.manoeuvres.families.family)",
                    key=f"limits.{name}",
                    value=bound,
                    subject=self.system.name,
                )


def integrate(system: DriftlessSystem, stage: Stage, x: Array, times: Array) -> Array:
    """States (k, n) at rising ``times`` (k,) s in a stage: eighth order, with steps halved until the result
    converges."""
    if stage.duration <= 0:
        raise InputError(
            f"stage {stage.label!r} takes no time",
            "give a time above zero",
            key="duration",
            value=stage.duration,
            subject=system.name,
        )
    longest, change, ends = stage.duration / (24 * max(1, stage.cycles)), np.inf, times[[0, -1]]
    coarse = _finely(system, stage, x, ends, longest)[-1]
    for _ in range(HALVINGS):
        longest /= 2
        fine = _finely(system, stage, x, ends, longest)[-1]
        before, change, coarse = change, float(np.abs(fine - coarse).max()), fine
        size = max(1.0, float(np.abs(fine).max()))
        if change <= TOLERANCE * size or (change < SETTLED * size and change > before / 4):
            break
    rows = _finely(system, stage, x, times, longest) if len(times) > 2 else np.array([x, fine])
    if not np.all(np.isfinite(rows)):
        raise SolveError(f"stage {stage.label!r} runs into a singularity", "go by a nearer goal", subject=system.name)
    return rows


def _finely(system: DriftlessSystem, stage: Stage, x: Array, times: Array, longest: float) -> Array:
    """States (k, n) at ``times`` (k,) by steps of at most ``longest`` s of Dormand and Prince's eighth-order method."""
    from scipy.integrate import DOP853

    gaps = np.diff(times)
    parts = np.maximum(1, np.ceil(gaps / longest - 1e-9)).astype(int)
    h = np.repeat(gaps / parts, parts)
    first = np.concatenate([[0], np.cumsum(parts)])
    begin = np.repeat(times[:-1], parts) + (np.arange(len(h)) - np.repeat(first[:-1], parts)) * h
    u = stage.inputs((begin[:, None] + h[:, None] * DOP853.C).ravel()).reshape(len(h), -1)
    return system.march(x, u, h)[first]
