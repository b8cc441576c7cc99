"""Manoeuvres a vehicle can choose from between two states at rest, the time each takes, and the one that is driven.

A manoeuvre has a number that stays its own whatever the others do, so that an animator can name the one liked in a
picture. Which ones there are, each vehicle says itself (`rigs.py`).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise
from typing import TYPE_CHECKING, Any

import numpy as np

from vehsim.errors import InputError, SolveError
from vehsim.sinusoids.families import bodies
from vehsim.sinusoids.steering import Stage, Steering, TooFast

if TYPE_CHECKING:
    from vehsim.clip import Clip
    from vehsim.sinusoids.rigs import Rigged
    from vehsim.world import World

TRIALS = 16
"""Times tried at most until a manoeuvre is slow enough for the vehicle's controls."""

Way = tuple[str, Callable[[], Steering]]
"""What a manoeuvre is called, and what makes it."""


@dataclass(frozen=True)
class Wish:
    """What an animator asks of the sinusoids; what is None is offered in several ways.

    ``amplitude``: of the slow sinusoid, m driven to and fro, or rad the leg swings, its sign the side it begins on;
    ``cycles``: how often; ``phase``: rad, where it begins. ``limits``: input or state -> largest size, SI.
    """

    amplitude: float | None = None
    cycles: int | None = None
    phase: float | None = None
    limits: Mapping[str, float] = field(default_factory=dict)


@dataclass(frozen=True, eq=False)
class Manoeuvre:
    """One way from start to goal: ``number`` from 1, timed as fast as the limits let it; ``clearance`` m, inf in the
    open.
    """

    number: int
    steering: Steering
    clearance: float = np.inf

    @property
    def label(self) -> str:
        return self.steering.label


def manoeuvres(
    rig: Rigged, start: Any, goal: Any, wish: Wish | None = None, world: World | None = None, only: int | None = None
) -> list[Manoeuvre]:
    """Every manoeuvre that works from ``start`` to ``goal`` (n,), states of ``rig.system``; or number ``only``.

    Clearances are to obstacles that stand; those that move are looked at when one is chosen.
    Raises ``SolveError`` with the reasons when none works, ``InputError`` where start or goal cannot be one.
    """
    wish = wish or Wish()
    x0, x1 = rig.system.check_state("start", start), rig.system.check_state("goal", goal)
    limits = {**rig.limits, **wish.limits}
    of_inputs = {name: value for name, value in limits.items() if name in rig.system.inputs}
    of_states = {name: value for name, value in limits.items() if name in rig.system.states}
    found, reasons, number = [], [], 0
    for number, (label, make) in enumerate(rig.ways(x0, x1, wish), 1):
        if only not in (None, number):
            continue
        try:
            steering = replace(make(), label=label).fastest(of_inputs).checked()
            steering.within(of_states)
        except (SolveError, InputError) as error:  # a chart too small for this one may do for another
            reasons.append(f"{number}, {label}: {error}")
            continue
        found.append(Manoeuvre(number, steering, clearance(steering, rig, world, None)))
    if only is not None and only > number:
        raise SolveError(f"manoeuvre = {only}: there are {number} between these marks; choose one, or leave it out")
    if not found:
        raise SolveError(f"{rig.vehicle.name}: none of {len(reasons)} manoeuvres works: {'; '.join(reasons[:4])}")
    return found


def choose_manoeuvre(found: Sequence[Manoeuvre], number: int | None = None, margin: float = 0.1) -> Manoeuvre:
    """The manoeuvre ``number``, or the quickest one that keeps ``margin`` m clear of everything.

    Raises ``SolveError`` naming those that work, or how near the best one comes.
    """
    if number is not None:
        for manoeuvre in found:
            if manoeuvre.number == number:
                return manoeuvre
        works = ", ".join(str(m.number) for m in found)
        raise SolveError(f"manoeuvre = {number}: does not work between these marks; choose one of {works}")
    clear = [m for m in found if m.clearance >= margin]
    if not clear:
        best = max(found, key=lambda m: m.clearance)
        raise SolveError(
            f"none of {len(found)} manoeuvres keeps {margin:g} m clear; the best, {best.number} ({best.label}), comes "
            f"to {best.clearance:.2f} m: ask for less clearance, move a mark or an obstacle, or add a mark on the way"
        )
    return min(clear, key=lambda m: m.steering.duration)


def clearance(steering: Steering, rig: Rigged, world: World | None, seconds: float | None = 0.0) -> float:
    """Least distance, m, of every body's outline to the world's obstacles, on the samples of the motion.

    ``seconds``: since frame 0, at which the steering begins, for obstacles that move; None leaves those out.
    """
    obstacles = () if world is None else world.standing if seconds is None else world.obstacles
    if not obstacles or not rig.outlines:
        return np.inf
    from vehsim.planning.obstacles import clearances
    from vehsim.world.plane import placed

    parts = [(o, k) for o in obstacles for k in range(len(getattr(o, "parts", [None])))]
    poses = bodies(steering)
    gaps = [
        clearances(parts, placed(outline, poses[:, k, :2], poses[:, k, 2]), (seconds or 0.0) + steering.times)
        for k, outline in enumerate(rig.outlines)
    ]
    return float(np.min(gaps))


def joined(steerings: Sequence[Steering], holds: Sequence[float] = ()) -> Steering:
    """Steerings one after another, each followed by so many seconds at rest. Full turns made on the way add up."""
    first = steerings[0]
    turned = sum(a.goal - b.start for a, b in pairwise(steerings))
    stages: list[Stage] = []
    for k, steering in enumerate(steerings):
        stages += steering.stages
        if k < len(holds) and holds[k] > 0:
            stages.append(rest(first.system.m, holds[k]))
    return replace(first, goal=steerings[-1].goal + turned, stages=tuple(stages)).checked()


def rest(m: int, seconds: float) -> Stage:
    """All ``m`` inputs zero."""
    return Stage("rest", lambda s: np.zeros((len(s), m)), duration=seconds)


def timed_clip(
    rig: Rigged, steering: Steering, seconds: float | None, fps: Any, start_frame: int
) -> tuple[Steering, Clip]:
    """The steering as a clip within the vehicle's own control bounds, on whole frames.

    ``seconds``: how long it takes; as fast as the bounds let it, rounded up to a frame, when None. Raises
    ``SolveError`` where it cannot be done in time, with the frames it needs.
    """
    if seconds is not None:
        try:
            return _in_time(rig, steering, seconds, fps, start_frame)
        except TooFast as error:
            enough, _ = timed_clip(rig, steering, None, fps, start_frame)
            raise SolveError(
                f"{rig.vehicle.name}: {seconds:.2f} s are too short for {steering.label or 'this'}: {error}; "
                f"{round(enough.duration * float(fps))} frames ({enough.duration:.2f} s) would do"
            ) from None
    needed, why = steering.duration, ""
    for _ in range(TRIALS):
        try:
            return _in_time(rig, steering, float(np.ceil(needed * float(fps) - 1e-9)) / float(fps), fps, start_frame)
        except TooFast as error:
            needed, why = error.needed, str(error)
    raise SolveError(f"{rig.vehicle.name}: going slower does not help: {why}; widen the bounds, or take another one")


def _in_time(rig: Rigged, steering: Steering, seconds: float, fps: Any, start_frame: int) -> tuple[Steering, Clip]:
    """The steering in ``seconds``, or `TooFast`."""
    if seconds < steering.duration * (1 - 1e-9):
        raise TooFast("beyond its limits", steering.duration)
    trial = steering.timed(seconds)
    clip = trial.clip(rig.vehicle, fps=fps, start_frame=start_frame, **rig.flight)
    beyond = _overload(clip)
    if beyond > 1 + 1e-6:
        raise TooFast("beyond its controls' bounds", seconds * beyond)
    return trial, clip


def _overload(clip: Clip) -> float:
    """By what factor the clip must be slowed for its controls to be in bounds: forces go with the rate squared."""
    vehicle, factor = clip.vehicle, 1.0
    for k, control in enumerate(vehicle.controls):
        power = 1.0 if control.name in vehicle.rate_controls else 0.5
        high, low = clip.controls[:, k].max(), clip.controls[:, k].min()
        for value, bound in ((high, control.upper), (-low, -control.lower)):
            if np.isfinite(bound) and bound > 0 and value > bound:
                factor = max(factor, float(value / bound) ** power)
    return factor


def loops(amplitudes: Sequence[float], wish: Wish) -> Iterator[tuple[float, int, float, str]]:
    """Amplitude, cycles, phase and name of every member of a family of loops."""
    for a in amplitudes if wish.amplitude is None else (wish.amplitude,):
        for cycles in (1, 2, 4) if wish.cycles is None else (wish.cycles,):
            for phase in (0.0, np.pi / 2) if wish.phase is None else (wish.phase,):
                turns = f"{cycles} cycle{'s' * (cycles > 1)}"
                yield (
                    a,
                    cycles,
                    phase,
                    f"{turns}, {'ahead' if a > 0 else 'back'} first, phase {np.degrees(phase):.0f} deg",
                )
