"""The manoeuvres of a vehicle between two states at rest, the duration of each, and the choice of one.

A manoeuvre has a fixed number, independent of the others, so that an animator can select one seen in a picture. Each
vehicle defines its manoeuvres (`rigs.py`).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

import numpy as np

from vehsim.errors import InputError, SolveError
from vehsim.sinusoids.manoeuvres.families import bodies
from vehsim.sinusoids.manoeuvres.options import SinusoidOptions
from vehsim.sinusoids.manoeuvres.rigs import Rigged, clip_of
from vehsim.sinusoids.steering import Stage, Steering, TooFast

if TYPE_CHECKING:
    from vehsim.clip.clip import Clip
    from vehsim.world.world import World

PATIENCE = 2.0
"""How much slower a manoeuvre may become so that its controls change smoothly."""
TRIALS = 16
"""Maximum number of trials until a manoeuvre is slow enough for the vehicle's controls."""


@dataclass(frozen=True, eq=False)
class Manoeuvre:
    """One alternative from start to goal, as fast as the limits permit: its ``number``, from 1, and ``clearance`` m,
    inf without obstacles."""

    number: int
    steering: Steering
    clearance: float = np.inf

    @property
    def label(self) -> str:
        return self.steering.label


def manoeuvres(
    rig: Rigged,
    start: Any,
    goal: Any,
    options: SinusoidOptions | None = None,
    world: World | None = None,
    only: int | None = None,
) -> list[Manoeuvre]:
    """Every manoeuvre that works from ``start`` to ``goal`` (n,), states of ``rig.system``; or only the number
    ``only``.

    Clearances are to standing obstacles; moving ones are checked when a manoeuvre is chosen. Raises ``SolveError`` with
    the reasons if none works, ``InputError`` if start or goal are not possible.
    """
    options = options or SinusoidOptions()
    x0, x1 = rig.system.check_state("start", start), rig.system.check_state("goal", goal)
    limits = {**rig.limits, **options.limits}
    of_inputs = {name: value for name, value in limits.items() if name in rig.system.inputs}
    of_states = {name: value for name, value in limits.items() if name in rig.system.states}
    found, reasons, number = [], [], 0
    for number, (label, make) in enumerate(rig.alternatives(x0, x1, options), 1):
        if only not in (None, number):
            continue
        try:
            steering = replace(make(), label=label).fastest(of_inputs).checked()
            steering.within(of_states)
        except (SolveError, InputError) as error:  # a chart too small for this manoeuvre may suffice for another
            reasons.append(f"{number}, {label}: {error}")
            continue
        found.append(Manoeuvre(number, steering, clearance(steering, rig, world, None)))
    if only is not None and only > number:
        raise SolveError(
            f"there are {number} between these marks", "choose one, or leave it out", key="manoeuvre", value=only
        )
    if not found:
        raise SolveError(f"none of {len(reasons)} manoeuvres works: {'; '.join(reasons[:4])}", subject=rig.vehicle.name)
    return found


def choose_manoeuvre(found: Sequence[Manoeuvre], number: int | None = None, margin: float = 0.1) -> Manoeuvre:
    """The manoeuvre ``number``, or the fastest one that keeps ``margin`` m from all obstacles.

    Raises ``SolveError`` naming those that work, or the best clearance.
    """
    if number is not None:
        for manoeuvre in found:
            if manoeuvre.number == number:
                return manoeuvre
        works = ", ".join(str(m.number) for m in found)
        raise SolveError("does not work between these marks", f"choose one of {works}", key="manoeuvre", value=number)
    clear = [m for m in found if m.clearance >= margin]
    if not clear:
        best = max(found, key=lambda m: m.clearance)
        raise SolveError(
            f"none of {len(found)} manoeuvres keeps {margin:g} m clear; the best, {best.number} ({best.label}), comes "
            f"to {best.clearance:.2f} m",
            "reduce the clearance, move a mark or an obstacle, or add an intermediate mark",
        )
    return min(clear, key=lambda m: m.steering.duration)


def clearance(steering: Steering, rig: Rigged, world: World | None, seconds: float | None = 0.0) -> float:
    """Smallest distance, m, of every body's outline to the world's obstacles, on the samples of the motion.

    ``seconds``: start of the steering since frame 0, for moving obstacles; None ignores them.
    """
    obstacles = () if world is None else world.standing if seconds is None else world.obstacles
    if not obstacles or not rig.outlines:
        return np.inf
    from vehsim.planning.outlines import least_clearance
    from vehsim.world.obstacles.plane import placed

    parts = [(o, k) for o in obstacles for k in range(len(getattr(o, "parts", [None])))]
    poses = bodies(steering)
    return min(
        least_clearance(parts, placed(outline, poses[:, k, :2], poses[:, k, 2]), (seconds or 0.0) + steering.times)
        for k, outline in enumerate(rig.outlines)
    )


def joined(steerings: Sequence[Steering], holds: Sequence[float] = ()) -> Steering:
    """Steerings one after another, each followed by the given seconds at rest. Full turns add up."""
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
    rig: Rigged,
    steering: Steering,
    seconds: float | None,
    fps: Any,
    start_frame: int,
    rates: Mapping[str, float] = MappingProxyType({}),
) -> tuple[Steering, Clip]:
    """The steering as a clip within the vehicle's own control bounds, on whole frames.

    ``seconds``: the duration; None: as fast as the bounds permit, rounded up to a frame, and up to twice as slow so
    that controls change as fast as their actuators can and at most at ``rates``, by name, in their unit per second.
    Raises ``SolveError`` if the time is too short, with the necessary frames.
    """
    if seconds is not None:
        try:
            return _in_time(rig, steering, seconds, fps, start_frame, None)
        except TooFast as error:
            enough, _ = timed_clip(rig, steering, None, fps, start_frame)
            raise SolveError(
                f"{seconds:.2f} s are too short for {steering.label or 'this'}: {error.message}",
                f"use {round(enough.duration * float(fps))} frames ({enough.duration:.2f} s)",
                subject=rig.vehicle.name,
            ) from None
    needed, why = steering.duration, ""
    for _ in range(TRIALS):
        whole = float(np.ceil(needed * float(fps) - 1e-9)) / float(fps)
        patient = whole < PATIENCE * steering.duration
        try:
            return _in_time(rig, steering, whole, fps, start_frame, rates if patient else None)
        except TooFast as error:
            needed, why = error.needed, str(error)
            if patient:
                needed = min(needed, PATIENCE * steering.duration)
    raise SolveError(
        f"going slower does not help: {why}", "widen the bounds, or take another one", subject=rig.vehicle.name
    )


def _in_time(
    rig: Rigged, steering: Steering, seconds: float, fps: Any, start_frame: int, rates: Mapping[str, float] | None
) -> tuple[Steering, Clip]:
    """The steering in ``seconds``. Raises `TooFast`."""
    if seconds < steering.duration * (1 - 1e-9):
        raise TooFast("beyond its limits", steering.duration)
    trial = steering.timed(seconds)
    clip = clip_of(trial, rig.vehicle, fps, start_frame, **rig.flight)
    beyond = max(_overload(clip), 1.0 if rates is None else _overspeed(clip, rates))
    if beyond > 1 + 1e-6:
        raise TooFast("beyond its controls' bounds", seconds * beyond)
    return trial, clip


def _overload(clip: Clip) -> float:
    """Factor by which the clip must be slowed so that its controls are within bounds: forces scale with the squared
    rate."""
    vehicle, factor = clip.vehicle, 1.0
    for k, control in enumerate(vehicle.controls):
        power = 1.0 if control.name in vehicle.rate_controls else 0.5
        high, low = clip.controls[:, k].max(), clip.controls[:, k].min()
        for value, bound in ((high, control.upper), (-low, -control.lower)):
            if np.isfinite(bound) and bound > 0 and value > bound:
                factor = max(factor, float(value / bound) ** power)
    return factor


def _overspeed(clip: Clip, rates: Mapping[str, float]) -> float:
    """Factor by which the clip must be slowed so that its controls change at most at ``rates`` and as fast as their
    actuators can: those of forces scale with the third power of the pace."""
    vehicle, factor = clip.vehicle, 1.0
    changes = np.abs(np.diff(clip.controls, axis=0)).T / np.diff(clip.times)
    for control, change in zip(vehicle.controls, changes, strict=True):
        most = min(control.actuator.rate, rates.get(control.name, np.inf))
        factor = max(factor, float(change.max() / most) ** (1 / 2 if control.name in vehicle.rate_controls else 1 / 3))
    return factor
