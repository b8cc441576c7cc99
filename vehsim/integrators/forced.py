"""A vehicle under external forces: an environment's wrench enters the forward step to second order.

Half of a knot's impulse acts before the vehicle's own step and half after it. The wrench is evaluated once per knot, at
the pose reached and at a velocity predicted with the previous wrench; with the velocity of the last segment, drag would
be first order. So the wrench never enters the Newton solve.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any, Protocol

import casadi as ca
import numpy as np

from vehsim.errors import InputError, SolveError
from vehsim.integrators.carried import carried, carry_on
from vehsim.integrators.discrete import DiscreteMechanics, keep
from vehsim.integrators.fast.kernel import Kernel
from vehsim.integrators.guards import warn_of_stiff_damping
from vehsim.integrators.integrator import Integrator
from vehsim.integrators.phase import Phase, packed, unpacked
from vehsim.integrators.record import build_clip
from vehsim.integrators.rest import Holding, Rest
from vehsim.vehicles import State
from vehsim.vehicles.definition.base import Array
from vehsim.vehicles.definition.mechanics import acceleration
from vehsim.vehicles.definition.states import control_vector

if TYPE_CHECKING:
    from vehsim.clip.clip import Clip
    from vehsim.integrators.environment import Environment


FINEST = 4096
"""Largest number of substeps that an environment may request."""


class Meeting(Holding, Protocol):
    """The forces of several vehicles on each other."""

    next_step: float

    def wrenches(self, t: float, states: Sequence[State]) -> Sequence[Array]:
        """Wrench (d,) on each, in body axes about its body frame's origin, at public states at ``t`` s."""


class Alone:
    """What holds a single vehicle: its environment, which also says whether it is free."""

    islands: Sequence[int] = (0,)
    free: Sequence[bool] = (True,)

    def __init__(self, environment: Environment) -> None:
        self._environment = environment
        self.asleep: Sequence[bool] = (False,)

    @property
    def settled(self) -> tuple[bool]:
        return (self._environment.settled,)

    def holds(self, changes: Sequence[Array]) -> tuple[bool]:
        return (self._environment.holds(*changes),)


class Forced:
    """A vehicle in an environment, advanced knot by knot.

    ``advance(c1)`` makes a whole step. If several vehicles act on each other, all of them ``drift`` first; then each is
    ``push``ed by the wrench that follows from all states. ``phase``, ``controls`` and ``wrench`` (d,) belong to the
    knot reached; ``state`` is public, and predicted until the push. For `Integrator`s of order 2.
    """

    CARRIED = ("time", "steps", "controls", "phase", "state", "wrench")

    def __init__(
        self, integrator: Integrator, environment: Environment, start: State, controls: Array, time: float = 0.0
    ):
        if integrator.order != 2:
            raise InputError(
                "external forces are integrated to second order only",
                "take order 2",
                key="order",
                value=integrator.order,
            )
        self.integrator, self.environment, self.time, self.steps = integrator, environment, time, 0
        self._calls: dict[str, tuple[DiscreteMechanics, Kernel]] = {}
        self.controls = control_vector(integrator.vehicle, controls)
        self.phase: Phase = integrator.start(start, self.controls)
        self.anchor = integrator.anchor(start, self.phase)
        self.state = integrator.state(self.phase, self.controls, self.anchor)
        self.wrench = np.zeros(integrator.vehicle.group.dim)
        self._set_wrench(*self.query())

    def query(self) -> tuple[Array, Array | None]:
        """The environment's wrench (d,) and added mass (d, d) at the present state."""
        wrench = self.environment.wrench(self.time, self.state, self.controls)
        return wrench, self.environment.added_inertia(self.time, self.state)

    def advance(self, controls: Array) -> None:
        """One step to ``controls`` (c,) at its end."""
        self.drift(controls)
        self.push(*self.query())

    def carry(self, start: Array, end: Array) -> None:
        """One step from controls ``start`` to ``end`` (c,), halved until it satisfies the environment's
        ``next_step``."""
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
        self.state = self.integrator.state(self._kicked(self.phase), self.controls, self.anchor)
        return self.state

    def predict(self, controls: Array) -> State:
        """Predict the public state after a step to ``controls`` (c,), without making the step."""
        integrator = self.integrator
        after = integrator.advance(self._kicked(self.phase), self.controls, np.asarray(controls, float), self.steps)
        return self.integrator.state(self._kicked(after), np.asarray(controls, float), self.anchor)

    def push(self, wrench: Array, added: Array | None = None) -> None:
        """Apply the impulse at the end of the step, of a wrench (d,) and an added mass (d, d)."""
        self._set_wrench(wrench, added)
        self.phase = self._kicked(self.phase)
        self.state = self.integrator.state(self.phase, self.controls, self.anchor)

    def start_with(self, wrench: Array, added: Array | None = None) -> None:
        """Start with this wrench (d,) instead of the environment's own."""
        self._set_wrench(wrench, added)

    @property
    def steady(self) -> bool:
        """Whether it hardly moves, touches nothing, and nothing around it changes."""
        return self.environment.steady

    def balanced(self) -> bool:
        """Whether a `steady` vehicle stays where it is."""
        phase = self.phase
        (alone,) = self._call("free", _free_acceleration)(
            phase.g, phase.r, phase.pi, self.controls, self.integrator.wind
        )
        inertia = np.asarray(self.integrator.vehicle.inertia)  # type: ignore[attr-defined]  # a rigid body has it
        return self.environment.balances(alone + np.linalg.solve(inertia, self.wrench))

    def stop(self) -> None:
        """Take away the momentum: the body stands still."""
        self.phase = replace(self.phase, pi=np.zeros_like(self.phase.pi))
        self.state = self.integrator.state(self.phase, self.controls, self.anchor)

    def wait(self, seconds: float) -> None:
        """Let time pass without moving."""
        self.time += seconds

    def _kicked(self, phase: Phase) -> Phase:
        (covector,) = self._call("wrench", lambda m: m.wrench_momentum)(phase.g, phase.r, self.wrench)
        return replace(phase, pi=phase.pi + self.integrator.step_size / 2 * covector)

    def _call(self, name: str, build: Callable[[DiscreteMechanics], ca.Function]) -> Kernel:
        """A function of the integrator's current mechanics, which may change with its chart."""
        mechanics = self.integrator.mechanics
        kept = self._calls.get(name)
        if kept is None or kept[0] is not mechanics:
            kept = self._calls[name] = (mechanics, Kernel(build(mechanics)))
        return kept[1]

    def _set_wrench(self, wrench: Array, added: Array | None) -> None:
        """``wrench`` minus the force that accelerates the added mass."""
        vehicle = self.integrator.vehicle
        wrench = np.asarray(wrench, float)
        if wrench.shape != self.wrench.shape or not np.isfinite(wrench).all():
            raise SolveError(
                f"step {self.steps}: the environment's wrench is {wrench.tolist()} at {self.state}",
                "take a smaller step",
                subject=vehicle.name,
            )
        if added is not None:
            inertia = np.asarray(vehicle.inertia)  # type: ignore[attr-defined]  # a rigid body has it
            wind = self.integrator.wind
            guess = self._kicked(self.phase)
            law = self._call("free", _free_acceleration)
            (alone,) = law(guess.g, guess.r, guess.pi, self.controls, wind)
            wrench = wrench - added @ np.linalg.solve(inertia + added, inertia @ alone + wrench)
        self.wrench = wrench


class Recording:
    """One vehicle's motion through an environment, knot by knot, recorded as a clip.

    ``law(t, state)`` gives the controls (c,), linear between knots; a knot is ``cuts`` steps of the integrator.
    """

    CARRIED = ("_before", "_after", "_guess")

    def __init__(
        self,
        integrator: Integrator,
        environment: Environment,
        law: Callable[[float, State], Any],
        begin: State,
        cuts: int,
    ):
        self._law, self._cuts, self._step = law, cuts, integrator.step_size * cuts
        self._asked: list[tuple[float, State]] = []
        if hasattr(law, "reset"):
            law.reset()
        idle = np.zeros(len(integrator.vehicle.controls))
        whole = integrator.state(integrator.start(begin, idle), idle)
        self._before = self._controls(integrator.vehicle, 0, replace(whole, position=np.asarray(begin.position, float)))
        self._after = self._guess = self._before
        self.body = Forced(integrator, environment, begin, self._before)
        self._rows = [(self.body.phase, self._before, self.body.wrench)]

    def aim(self, k: int) -> None:
        """Query the controls at the end of step ``k``."""
        body = self.body
        blind = getattr(self._law, "blind", False)  # a law that ignores the state needs no prediction
        state = body.state if blind or self._cuts > 1 else body.predict(self._guess)
        self._after = self._controls(body.integrator.vehicle, k + 1, state)

    def between(self, share: float) -> Array:
        """The controls (c,) at a share of the step."""
        return np.asarray(self._before + share * (self._after - self._before))

    def arrive(self) -> None:
        """Record the end of a step."""
        self._before, self._guess = self._after, 2 * self._after - self._before
        self._rows.append((self.body.phase, self._after, self.body.wrench))

    @property
    def steps(self) -> int:
        """The number of steps recorded."""
        return len(self._rows) - 1

    def memory(self) -> dict[str, Any]:
        """All that the motion so far leaves for the rest of it, as plain data."""
        return {
            "own": carried(self),
            "body": carried(self.body),
            "environment": self.body.environment.memory(),
            "law": carried(self._law),
            "asked": tuple(self._asked),
            "rows": [
                np.array(column) for column in zip(*((packed(p), *other) for p, *other in self._rows), strict=True)
            ],
        }

    def recall(self, memory: Mapping[str, Any]) -> None:
        """Continue from the `memory` of another recording from the same start. The law is asked again for what was
        asked before, so that a pilot knows what it would know."""
        carry_on(self, memory["own"])
        carry_on(self.body, memory["body"])
        self.body.environment.recall(memory["environment"])
        mechanics = self.body.integrator.mechanics
        self._rows = [(unpacked(mechanics, x), c, wrench) for x, c, wrench in zip(*memory["rows"], strict=True)]
        self._asked = list(memory["asked"])
        for t, state in self._asked[1:]:
            self._law(t, state)
        carry_on(self._law, memory["law"])

    def clip(self, events: Sequence[Mapping[str, Any]], fps: Any, start_frame: int) -> Clip:
        """The clip so far. The ledger's work contains the work of the environment."""
        integrator = self.body.integrator
        phases, controls, wrenches = zip(*self._rows, strict=True)
        ends = np.array([packed(phases[0]), packed(phases[-1])])
        warn_of_stiff_damping(integrator.mechanics, ends, np.array(controls), integrator.step_size, integrator.wind)
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
            **header,  # type: ignore[arg-type]  # values of one type each
        )
        work = clip.energy["work"] + _work(clip, np.array(wrenches))
        return replace(clip, energy={**clip.energy, "work": work})

    def _controls(self, vehicle: Any, k: int, state: State) -> Array:
        t = k * self._step
        if not getattr(self._law, "blind", False):
            self._asked.append((t, state))
        return control_vector(vehicle, self._law(t, state), f"controls(t = {t:.6g})")


def pushed(
    integrator: Integrator,
    environment: Environment,
    law: Callable[[float, State], Any],
    begin: State,
    steps: int,
    cuts: int,
    fps: Any,
    start_frame: int,
    progress: Callable[[str, float], None] | None = None,
    memory: Mapping[str, Any] | None = None,
) -> tuple[Clip, Mapping[str, Any]]:
    """A clip of ``steps`` steps, each of ``cuts`` of the integrator's, and its memory; ``law(t, state)`` gives the
    controls (c,). ``memory``: that of a shorter clip from the same start, which is continued."""
    recording = Recording(integrator, environment, law, begin, cuts)
    body = recording.body
    rest = Rest([body], Alone(environment), lambda _: [body.query()])
    if memory is not None:
        recording.recall(memory["recording"])
        carry_on(rest, memory["rest"])
    for k in range(recording.steps, steps):
        recording.aim(k)
        for j in range(cuts):
            ends = recording.between(j / cuts), recording.between((j + 1) / cuts)
            if rest.begin([ends], integrator.step_size).all():
                body.wait(integrator.step_size)
                rest.end()
            else:
                body.carry(*ends)
        recording.arrive()
        if progress and k % 50 == 0:
            progress("simulate", k / steps)
    if progress:
        progress("simulate", 1.0)
    clip = recording.clip(environment.events(), fps, start_frame)
    return clip, {"recording": recording.memory(), "rest": carried(rest)}


def pushed_together(
    recordings: Sequence[Recording],
    meeting: Meeting,
    steps: int,
    cuts: int,
    progress: Callable[[str, float], None] | None,
    memory: Mapping[str, Any] | None = None,
) -> Mapping[str, Any]:
    """Advance several vehicles by ``steps`` steps together: each feels its environment and the ``meeting``. Returns
    their memory; ``memory``: that of fewer steps from the same start, which are continued."""
    bodies = [recording.body for recording in recordings]
    whole = [body.integrator for body in bodies]

    every = range(len(bodies))
    latest: list[Array] = []

    def meet() -> None:
        latest[:] = meeting.wrenches(bodies[0].time, [body.state for body in bodies])

    def query(which: Sequence[int]) -> list[tuple[Array, Array | None]]:
        own = [bodies[k].query() for k in which]
        return [(wrench + latest[k], added) for k, (wrench, added) in zip(which, own, strict=True)]

    meet()
    for body, forces in zip(bodies, query(every), strict=True):
        body.start_with(*forces)
    rest = Rest(bodies, meeting, query, meet)
    if memory is not None:
        for recording, own in zip(recordings, memory["recordings"], strict=True):
            recording.recall(own)
        carry_on(meeting, memory["meeting"])
        carry_on(rest, memory["rest"])
    for k in range(recordings[0].steps, steps):
        for recording in recordings:
            recording.aim(k)
        at, end = 0, cuts * FINEST
        ends = [(recording.between(0.0), recording.between(1.0)) for recording in recordings]
        if rest.begin(ends, cuts * whole[0].step_size).all():
            for body in bodies:
                body.wait(cuts * whole[0].step_size)
            meet()
            at = end
        while at < end:
            awake = [k for k in every if not rest.asleep[k]]
            longest = min(meeting.next_step, *(bodies[k].environment.next_step for k in awake))
            pieces = piece(whole[0].step_size, longest, at % FINEST)
            at += pieces
            for k in every:
                bodies[k].integrator = halved(whole[k], FINEST // pieces)
                if k in awake:
                    bodies[k].drift(recordings[k].between(at / end))
                else:
                    bodies[k].wait(bodies[k].integrator.step_size)
            meet()
            woken = rest.wake_touched()
            for k, forces in zip(awake, query(awake), strict=True):
                bodies[k].push(*forces)
            for k, forces in zip(woken, query(woken), strict=True):
                bodies[k].start_with(*forces)
        rest.end()
        for recording, integrator in zip(recordings, whole, strict=True):
            recording.body.integrator = integrator
            recording.arrive()
        if progress and k % 50 == 0:
            progress("simulate", k / steps)
    if progress:
        progress("simulate", 1.0)
    own = [recording.memory() for recording in recordings]
    return {"recordings": own, "meeting": carried(meeting), "rest": carried(rest)}


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
    """The largest power of two of `FINEST` pieces of ``step`` s that takes at most ``longest`` s and divides ``at``
    pieces."""
    pieces = FINEST
    while pieces > 1 and (at % pieces or step * pieces / FINEST > longest * (1 + 1e-9)):
        pieces //= 2
    return pieces


def halved(integrator: Integrator, parts: int) -> Integrator:
    """The same integrator with its step divided into ``parts``; kept for later."""
    if parts == 1:
        return integrator
    kept = integrator.__dict__.setdefault("_halved", {})
    if parts not in kept:
        m = integrator.mechanics
        step = integrator.step_size / parts
        kept[parts] = Integrator(
            integrator.vehicle, step, m.map_name, integrator.order, quadrature=m.quadrature, wind=integrator.wind
        )
    return kept[parts]  # type: ignore[no-any-return]  # a cache on the integrator


def substeps(step: float, environment: Environment) -> int:
    """The number of equal parts of a step that satisfies the environment's longest step."""
    return max(1, math.ceil(step / environment.max_step - 1e-9))


def _free_acceleration(mechanics: DiscreteMechanics) -> ca.Function:
    """``(g, r, pi, c, wind) -> dxi/dt`` of a free body on SE(3)."""

    def build() -> ca.Function:
        v, y = mechanics.vehicle, mechanics.symbols
        _, xi = mechanics.knot_velocity(y["r"], y["pi"], y["c0"])
        rate = acceleration(v, y["g"], y["r"], xi, y["c0"], ca.SX(y["c0"].shape[0], 1), y["wind"])
        return ca.Function("free", [y["g"], y["r"], y["pi"], y["c0"], y["wind"]], [ca.densify(rate)])

    return keep(mechanics, "free_acceleration", build)
