"""A vehicle pushed from outside: an environment's wrench enters the forward step to second order.

Half of a knot's impulse is given before the vehicle's own step and half after it. The wrench is asked once a knot, at
the pose the step arrived at and at a velocity predicted with the wrench before (math.md on LIE 10-11: with the last
segment's velocity drag would be first order), so a queried wrench never enters the Newton solve.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any, Protocol

import casadi as ca
import numpy as np

from vehsim.errors import InputError, SolveError
from vehsim.integrators.buffered import Buffered
from vehsim.integrators.record import build_clip, keep
from vehsim.vehicles import State
from vehsim.vehicles._base import Array
from vehsim.vehicles.mechanics import acceleration
from vehsim.vehicles.states import control_vector

if TYPE_CHECKING:
    from vehsim.clip import Clip
    from vehsim.integrators.discrete import DiscreteMechanics
    from vehsim.integrators.integrator import Integrator, Phase
    from vehsim.world.environment import Environment


FINEST = 4096
"""Pieces of a step that an environment in haste may ask for."""


class Meeting(Protocol):
    """What several vehicles do to each other."""

    next_step: float

    def wrenches(self, t: float, states: Sequence[State]) -> Sequence[Array]:
        """Wrench (d,) on each, in body axes about its body frame's origin, at public states at ``t`` s."""


class Forced:
    """A vehicle in an environment, advanced knot by knot.

    ``advance(c1)`` does a whole step. Where several vehicles push each other, all of them ``drift`` first, then each
    is ``push``ed by the wrench that their states together make. ``phase``, ``controls`` and ``wrench`` (d,) hold at
    the knot reached, ``state`` is public and predicted until the push. Made for `Integrator`s of order 2.
    """

    def __init__(
        self, integrator: Integrator, environment: Environment, start: State, controls: Array, time: float = 0.0
    ):
        if integrator.order != 2:
            raise InputError(f"order = {integrator.order!r}: what pushes from outside is second order; take order 2")
        self.integrator, self.environment, self.time, self.steps = integrator, environment, time, 0
        self._calls: dict[str, tuple[DiscreteMechanics, Buffered]] = {}
        self.controls = control_vector(integrator.vehicle, controls)
        self.phase: Phase = integrator.start(start, self.controls)
        self.anchor = integrator.anchor(start, self.phase)
        self.state = integrator.state(self.phase, self.controls, self.anchor)
        self.wrench = np.zeros(integrator.vehicle.group.dim)
        self._set_wrench(*self.ask())

    def ask(self) -> tuple[Array, Array | None]:
        """The environment's wrench (d,) and added mass (d, d) at the present state."""
        wrench = self.environment.wrench(self.time, self.state, self.controls)
        return wrench, self.environment.added_inertia(self.time, self.state)

    def advance(self, controls: Array) -> None:
        """One step to ``controls`` (c,) at its end."""
        self.drift(controls)
        self.push(*self.ask())

    def carry(self, start: Array, end: Array) -> None:
        """One step from controls ``start`` to ``end`` (c,), halved as often as the environment is in haste."""
        whole, at = self.integrator, 0
        while at < FINEST:
            pieces = piece(whole.step_size, self.environment.next_step, at)
            self.integrator = halved(whole, FINEST // pieces)
            at += pieces
            self.advance(start + at / FINEST * (end - start))
        self.integrator = whole

    def drift(self, controls: Array) -> State:
        """The step without the impulse at its end; returns the public state predicted there."""
        integrator, h = self.integrator, self.integrator.step_size
        kicked = self._kicked(self.phase)
        self.phase = integrator.advance(kicked, self.controls, np.asarray(controls, float), self.steps)
        self.controls = np.asarray(controls, float)
        self.time, self.steps = self.time + h, self.steps + 1
        self.state = self._public(self._kicked(self.phase), self.controls)
        return self.state

    def predict(self, controls: Array) -> State:
        """The public state that a step to ``controls`` (c,) would reach, without making it."""
        integrator = self.integrator
        after = integrator.advance(self._kicked(self.phase), self.controls, np.asarray(controls, float), self.steps)
        return self._public(self._kicked(after), np.asarray(controls, float))

    def push(self, wrench: Array, added: Array | None = None) -> None:
        """The impulse at the end of the step, of a wrench (d,) and an added mass (d, d)."""
        self._set_wrench(wrench, added)
        self.phase = self._kicked(self.phase)
        self.state = self._public(self.phase, self.controls)

    def start_with(self, wrench: Array, added: Array | None = None) -> None:
        """Begin with this wrench (d,) instead of the environment's own."""
        self._set_wrench(wrench, added)

    def _kicked(self, phase: Phase) -> Phase:
        (covector,) = self._call("wrench", lambda m: m.wrench_momentum)(phase.g, phase.r, self.wrench)
        return replace(phase, pi=phase.pi + self.integrator.step_size / 2 * covector)

    def _public(self, phase: Phase, controls: Array) -> State:
        """`Integrator.state`, quickly."""
        pose, twist, r, u = self._call("state", lambda m: m.root_state)(phase.g, phase.r, phase.pi, controls)
        return State(position=pose[0:3] + self.anchor, orientation=pose[3:7], twist=twist, joints=r, joint_rates=u)

    def _call(self, name: str, build: Callable[[DiscreteMechanics], ca.Function]) -> Buffered:
        """A function of the integrator's present mechanics, which may change with its chart."""
        mechanics = self.integrator.mechanics
        kept = self._calls.get(name)
        if kept is None or kept[0] is not mechanics:
            kept = self._calls[name] = (mechanics, Buffered(build(mechanics)))
        return kept[1]

    def _set_wrench(self, wrench: Array, added: Array | None) -> None:
        """``wrench``, less what it takes to accelerate the added mass under everything that acts."""
        vehicle = self.integrator.vehicle
        wrench = np.asarray(wrench, float)
        if wrench.shape != self.wrench.shape or not np.isfinite(wrench).all():
            raise SolveError(
                f"{vehicle.name}: step {self.steps}: its surroundings push with {wrench.tolist()} at "
                f"{self.state}; take a smaller step"
            )
        if added is not None:
            inertia = np.asarray(vehicle.inertia)  # type: ignore[attr-defined]
            wind = self.integrator.wind
            guess = self._kicked(self.phase)
            law = self._call("free", _free_acceleration)
            (alone,) = law(guess.g, guess.r, guess.pi, self.controls, wind)
            wrench = wrench - added @ np.linalg.solve(inertia + added, inertia @ alone + wrench)
        self.wrench = wrench


class Course:
    """One vehicle's way through an environment: asked for its controls knot by knot, written down as a clip.

    ``ask(t, state)`` gives the controls (c,), linear between knots; a knot is ``cuts`` steps of the integrator.
    """

    def __init__(
        self,
        integrator: Integrator,
        environment: Environment,
        ask: Callable[[float, State], Any],
        begin: State,
        cuts: int,
    ):
        self._ask, self._cuts, self._step = ask, cuts, integrator.step_size * cuts
        if hasattr(ask, "reset"):
            ask.reset()
        idle = np.zeros(len(integrator.vehicle.controls))
        whole = integrator.state(integrator.start(begin, idle), idle)
        self._before = self._controls(integrator.vehicle, 0, replace(whole, position=np.asarray(begin.position, float)))
        self._after = self._guess = self._before
        self.body = Forced(integrator, environment, begin, self._before)
        self._rows = [(self.body.phase, self._before, self.body.wrench)]

    def aim(self, k: int) -> None:
        """Ask for the controls at the end of step ``k``."""
        body = self.body
        blind = getattr(self._ask, "blind", False)  # what asks for no state needs no prediction
        state = body.state if blind or self._cuts > 1 else body.predict(self._guess)
        self._after = self._controls(body.integrator.vehicle, k + 1, state)

    def between(self, share: float) -> Array:
        """The controls (c,) at a share of the step."""
        return np.asarray(self._before + share * (self._after - self._before))

    def arrive(self) -> None:
        """The step is done."""
        self._before, self._guess = self._after, 2 * self._after - self._before
        self._rows.append((self.body.phase, self._after, self.body.wrench))

    def clip(self, events: Sequence[Mapping[str, Any]], fps: Any, start_frame: int) -> Clip:
        """What was done. The ledger's work holds what the environment puts in or takes out."""
        integrator = self.body.integrator
        phases, controls, wrenches = zip(*self._rows, strict=True)
        times = np.asarray(self._step * np.arange(len(phases)), float)
        g, r, pi = (np.array([getattr(p, name) for p in phases]) for name in ("g", "r", "pi"))
        header = {"wind": integrator.wind, "fps": fps, "start_frame": start_frame, "events": tuple(events)}
        clip = build_clip(
            integrator.mechanics,
            times,
            g,
            r,
            pi,
            np.array(controls),
            self.body.anchor,
            **header,  # type: ignore[arg-type]
        )
        work = clip.energy["work"] + _work(clip, np.array(wrenches))
        return replace(clip, energy={**clip.energy, "work": work})

    def _controls(self, vehicle: Any, k: int, state: State) -> Array:
        t = k * self._step
        return control_vector(vehicle, self._ask(t, state), f"controls(t = {t:.6g})")


def pushed(
    integrator: Integrator,
    environment: Environment,
    ask: Callable[[float, State], Any],
    begin: State,
    steps: int,
    cuts: int,
    fps: Any,
    start_frame: int,
    progress: Callable[[str, float], None] | None = None,
) -> Clip:
    """A clip of ``steps`` steps, each of ``cuts`` of the integrator's; ``ask(t, state)`` gives the controls (c,)."""
    course = Course(integrator, environment, ask, begin, cuts)
    for k in range(steps):
        course.aim(k)
        for j in range(cuts):
            course.body.carry(course.between(j / cuts), course.between((j + 1) / cuts))
        course.arrive()
        if progress and k % 50 == 0:
            progress("simulate", k / steps)
    if progress:
        progress("simulate", 1.0)
    return course.clip(environment.events(), fps, start_frame)


def pushed_together(
    courses: Sequence[Course], meeting: Meeting, steps: int, cuts: int, progress: Callable[[str, float], None] | None
) -> None:
    """Take several vehicles ``steps`` steps on at the same time: each feels its surroundings and the ``meeting``."""
    bodies = [course.body for course in courses]
    whole = [body.integrator for body in bodies]
    for body, wrench in zip(bodies, meeting.wrenches(0.0, [body.state for body in bodies]), strict=True):
        own, added = body.ask()
        body.start_with(own + wrench, added)
    for k in range(steps):
        for course in courses:
            course.aim(k)
        at, end = 0, cuts * FINEST
        while at < end:
            longest = min(meeting.next_step, *(body.environment.next_step for body in bodies))
            pieces = piece(whole[0].step_size, longest, at % FINEST)
            at += pieces
            for course, integrator in zip(courses, whole, strict=True):
                course.body.integrator = halved(integrator, FINEST // pieces)
                course.body.drift(course.between(at / end))
            wrenches = meeting.wrenches(bodies[0].time, [body.state for body in bodies])
            for body, wrench in zip(bodies, wrenches, strict=True):
                own, added = body.ask()
                body.push(own + wrench, added)
        for course, integrator in zip(courses, whole, strict=True):
            course.body.integrator = integrator
            course.arrive()
        if progress and k % 50 == 0:
            progress("simulate", k / steps)
    if progress:
        progress("simulate", 1.0)


def _work(clip: Clip, wrenches: Array) -> Array:
    """Work (n,) J of body wrenches (n, d) at the knots of a clip."""
    twists = clip.twists.copy()
    origin = clip.vehicle.origin
    if twists.shape[1] == 6:
        twists[:, 3:] += np.cross(twists[:, :3], origin)
    elif clip.vehicle.group.planar:
        twists[:, 1:] += twists[:, :1] * np.array([-origin[1], origin[0]])
    power = np.einsum("ni,ni->n", wrenches, twists)
    return np.concatenate([[0.0], np.cumsum(np.diff(clip.times) * (power[1:] + power[:-1]) / 2)])


def piece(step: float, longest: float, at: int) -> int:
    """The largest power of two of `FINEST` pieces of ``step`` s that takes ``longest`` s and fits ``at`` pieces in."""
    pieces = FINEST
    while pieces > 1 and (at % pieces or step * pieces / FINEST > longest * (1 + 1e-9)):
        pieces //= 2
    return pieces


def halved(integrator: Integrator, parts: int) -> Integrator:
    """The same integrator with its step in ``parts``, kept for the next time."""
    from vehsim.integrators.integrator import Integrator

    if parts == 1:
        return integrator
    kept = integrator.__dict__.setdefault("_halved", {})
    if parts not in kept:
        m = integrator.mechanics
        step = integrator.step_size / parts
        kept[parts] = Integrator(
            integrator.vehicle, step, m.map_name, integrator.order, quadrature=m.quadrature, wind=integrator.wind
        )
    return kept[parts]  # type: ignore[no-any-return]


def substeps(step: float, environment: Environment) -> int:
    """Into how many equal parts a step must be cut to keep to the environment's longest."""
    return max(1, math.ceil(step / environment.max_step - 1e-9))


def _free_acceleration(mechanics: DiscreteMechanics) -> ca.Function:
    """``(g, r, pi, c, wind) -> dxi/dt`` of a body on SE(3) left to itself."""

    def build() -> ca.Function:
        v, y = mechanics.vehicle, mechanics.symbols
        _, xi = mechanics.knot_velocity(y["r"], y["pi"], y["c0"])
        rate = acceleration(v, y["g"], y["r"], xi, y["c0"], ca.SX(y["c0"].shape[0], 1), y["wind"])
        return ca.Function("free", [y["g"], y["r"], y["pi"], y["c0"], y["wind"]], [ca.densify(rate)])

    return keep(mechanics, "free_acceleration", build)
