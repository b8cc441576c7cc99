"""The forward step: one integrator for every vehicle, holonomic or not."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from vehsim.clip import Clip
from vehsim.errors import InputError, SolveError
from vehsim.integrators import machine
from vehsim.integrators.discrete import DiscreteMechanics
from vehsim.integrators.fleet import Fleet, control_table
from vehsim.integrators.guards import changes_rank, check_constraints, check_mass
from vehsim.integrators.loops import Loop
from vehsim.integrators.motion import FAST_TOLERANCE, Motion, PhaseStep, PublicStep, whole_step
from vehsim.integrators.record import build_clip as build_clip
from vehsim.integrators.record import build_clips, flat, keep
from vehsim.vehicles import State, Vehicle
from vehsim.vehicles._base import Array
from vehsim.vehicles.states import control_vector, internal

TOLERANCE = 1e-9
"""Largest accepted Newton residual, relative to the momentum."""

_SUZUKI = 1 / (4 - 4 ** (1 / 3))
_YOSHIDA = (0.78451361047755726382, 0.23557321335935813368, -1.17767998417887100695)
COMPOSITIONS: dict[int, tuple[float, ...]] = {
    2: (1.0,),
    4: (_SUZUKI, _SUZUKI, 1 - 4 * _SUZUKI, _SUZUKI, _SUZUKI),
    6: (*_YOSHIDA, 1 - 2 * sum(_YOSHIDA), *_YOSHIDA[::-1]),
}
"""Order -> fractions of a step (Suzuki; Yoshida's solution A): compositions of the symmetric second-order step."""


_RETRIES = 8
_CHUNK = 1024
"""Steps between looks at whether the solve suffices."""
_WAYS = ("advance_fast", "advance_far", "advance")
"""Solves of a step, cheapest first."""


@dataclass
class Phase:
    """What an integrator carries from knot to knot: group element, joints, momentum, and Newton's warm start."""

    g: Array
    r: Array
    pi: Array
    z: Array


class Integrator:
    """Advances a vehicle by fixed steps.

    ``step`` s; ``difference_map`` "cay" or "exp"; ``order`` 2, 4 or 6; ``wind`` (3,) m/s in world axes;
    ``quadrature`` of the forces. Momentum is carried at the knots, so velocities are those *at* the knot.
    ``compiled``: by machine code, ten times as fast, built once by the system's C compiler and kept in the cache; where
    there is none, a warning, and ``compiled`` stays False.
    """

    def __init__(
        self,
        vehicle: Vehicle,
        step: float,
        difference_map: str = "cay",
        order: int = 2,
        *,
        quadrature: str = "galerkin",
        wind: Any = (0.0, 0.0, 0.0),
        compiled: bool = False,
    ):
        if not (np.isfinite(step) and step > 0):
            raise InputError(f"step = {step!r}: must be a positive number of seconds")
        if order not in COMPOSITIONS:
            raise InputError(f"order = {order!r}: unknown; choose one of {', '.join(map(str, COMPOSITIONS))}")
        self.vehicle, self.step_size, self.order = vehicle, float(step), order
        self.wind = np.asarray(wind, float)
        if self.wind.shape != (3,) or not np.all(np.isfinite(self.wind)):
            raise InputError(f"wind = {wind!r}: give three finite numbers, m/s in world axes")
        self.mechanics = mechanics_of(vehicle, difference_map, quadrature)
        self.guarded = changes_rank(self.mechanics)
        self.compiled = compiled and machine.loop(whole_step(self.mechanics, order)) is not None
        if order > 2 and not _symmetric(difference_map, vehicle):
            raise InputError(
                f"order = {order!r}: {difference_map!r} makes no symmetric step to compose; take order 2 or another map"
            )

    @cached_property
    def _quick(self) -> PhaseStep:
        return PhaseStep(self)

    @cached_property
    def _public(self) -> PublicStep:
        return PublicStep(self)

    def start(self, state: State, controls: Any) -> Phase:
        """The phase of a public state; rates that contradict the constraints are projected onto them."""
        g, r, u, xi = internal(self.vehicle, state)
        self._choose_chart(r)
        m = self.mechanics
        c = np.asarray(controls, float)
        for joint, control in self.vehicle.driven:
            u[joint] = c[control]
        pi = flat(m.knot_momentum(r, u, xi))
        return Phase(g, r, pi, flat(m.knot_velocity_guess(r, pi, c)))

    def state(self, phase: Phase, controls: Any, anchor: Any = (0.0, 0.0, 0.0)) -> State:
        """The public state of a phase. ``anchor`` (3,): the part of the position the group does not hold."""
        pose, twist, r, u = (flat(x) for x in self.mechanics.root_state(phase.g, phase.r, phase.pi, controls))
        return State(position=pose[0:3] + anchor, orientation=pose[3:7], twist=twist, joints=r, joint_rates=u)

    def anchor(self, state: State, phase: Phase) -> Array:
        """What a start position has beyond the group's own coordinates (the height of a vehicle on SE(2))."""
        pose = flat(self.mechanics.root_state(phase.g, phase.r, phase.pi, np.zeros(self.mechanics.sizes[3]))[0])
        return np.asarray(state.position, float) - pose[0:3]

    def advance(self, phase: Phase, c0: Array, c1: Array, index: int = 0) -> Phase:
        """One step; ``c0, c1`` (c,) are the controls at its ends. ``SolveError`` names step, state and residual."""
        quick = self._quick(phase, c0, c1)
        if quick is not None:
            if self.guarded:
                check_constraints(self.mechanics, np.array([phase.r, quick[1]]), index)
            return Phase(*quick)
        done = 0.0
        for fraction in COMPOSITIONS[self.order]:
            a, b = c0 + done * (c1 - c0), c0 + (done + fraction) * (c1 - c0)
            after = self._substep(phase, a, b, fraction * self.step_size, index)
            if self.guarded:
                check_constraints(self.mechanics, np.array([phase.r, after.r]), index)
            phase = after
            done += fraction
        return phase

    def _substep(self, phase: Phase, c0: Array, c1: Array, h: float, index: int) -> Phase:
        guess = phase.z
        for _ in range(_RETRIES):
            g, r, pi, z, residual = self.mechanics.advance(phase.g, phase.r, phase.pi, guess, c0, c1, h, self.wind)
            if residual <= TOLERANCE:
                return Phase(flat(g), flat(r), flat(pi), flat(z))
            guess = flat(z)
        other = self._other_chart(phase, c0, c1, h)
        if other is not None:
            return other
        check_constraints(self.mechanics, np.array([phase.r, phase.r]), index)
        raise _diverged(self.vehicle, index, phase, float(residual), h)

    def _choose_chart(self, r: Array) -> None:
        """Begin with columns to eliminate that are sound at joints ``r``, where the present choice is not."""
        vehicle = self.mechanics.vehicle
        if not self.guarded or vehicle.soundness(r) > 0.1:  # type: ignore[attr-defined]
            return
        chart = vehicle.chart_at(r)  # type: ignore[attr-defined]
        if chart is not None:
            self.mechanics = mechanics_of(chart, self.mechanics.map_name, self.mechanics.quadrature)
            for kept in ("_quick", "_public"):
                self.__dict__.pop(kept, None)

    def _other_chart(self, phase: Phase, c0: Array, c1: Array, h: float) -> Phase | None:
        """The same step with other columns of the constraints eliminated, where this choice is singular on the way."""
        m = self.mechanics
        chart = getattr(m.vehicle, "chart_at", None)
        vehicle = chart(phase.r) if chart else None
        if vehicle is None:
            return None
        other = mechanics_of(vehicle, m.map_name, m.quadrature)
        pi = other.knot_momentum(phase.r, *m.knot_velocity(phase.r, phase.pi, c0))
        z = other.knot_velocity_guess(phase.r, pi, c0)
        for _ in range(_RETRIES):
            g, r, pi1, z, residual = other.advance(phase.g, phase.r, pi, z, c0, c1, h, self.wind)
            if residual <= TOLERANCE:
                u, xi = other.knot_velocity(r, pi1, c1)
                pi1 = flat(m.knot_momentum(r, u, xi))
                return Phase(flat(g), flat(r), pi1, flat(m.knot_velocity_guess(r, pi1, c1)))
        return None

    def step(self, state: State, controls: Any, next_controls: Any = None, wrench: Any = None) -> State:
        """The state one step later. ``controls`` (c,) at its start, ``next_controls`` at its end (the same if None).

        ``wrench``: an external body wrench (d,) about the body frame's origin, or a function of the state that returns
        one; half of its impulse acts at either end, the second half at the predicted state.
        """
        if wrench is None and not self.guarded:
            after = self._public(state, controls, controls if next_controls is None else next_controls)
            if after is not None:
                return after
        c0 = control_vector(self.vehicle, controls)
        c1 = c0 if next_controls is None else control_vector(self.vehicle, next_controls, "next_controls")
        phase = self.start(state, c0)
        anchor = self.anchor(state, phase)
        if wrench is not None:
            self._kick(phase, wrench, state)
        phase = self.advance(phase, c0, c1)
        if wrench is not None:
            self._kick(phase, wrench, self.state(phase, c1, anchor))
        return self.state(phase, c1, anchor)

    def motion(self, state: State, controls: Any = None) -> Motion:
        """The vehicle in motion from a state, to be stepped in place: the fast way from Python."""
        c = np.zeros(len(self.vehicle.controls)) if controls is None else controls
        return Motion(self, state, c)

    def fleet(self, states: Sequence[State], controls: Any = None, threads: int = 1) -> Fleet:
        """Vehicles in motion side by side from ``states`` (m,), under ``controls`` (m, c) or (c,) there."""
        c = np.zeros(len(self.vehicle.controls)) if controls is None else controls
        return Fleet(self, states, c, threads)

    def _kick(self, phase: Phase, wrench: Any, state: State) -> None:
        body = np.asarray(wrench(state) if callable(wrench) else wrench, float)
        if body.shape != (self.vehicle.group.dim,) or not np.all(np.isfinite(body)):
            raise InputError(
                f"wrench = {body.tolist()!r}: give {self.vehicle.group.dim} finite numbers, torque then force"
            )
        phase.pi = phase.pi + self.step_size / 2 * flat(self.mechanics.wrench_momentum(phase.g, phase.r, body))

    def rollout(self, state: State, controls: Any, *, fps: Any = 24, start_frame: int = 1001) -> Clip:
        """A clip of ``len(controls) - 1`` steps under knot controls (n, c), linear between knots."""
        controls = np.atleast_2d(np.asarray(controls, float))
        if controls.shape[1:] != (len(self.vehicle.controls),) or not np.all(np.isfinite(controls)):
            names = ", ".join(self.vehicle.control_names) or "none"
            raise InputError(
                f"controls: shape {controls.shape}; give (n, {len(self.vehicle.controls)}) finite: {names}"
            )
        phase = self.start(state, controls[0])
        x = self.history(packed(phase), controls)
        return self._clips(x[None], controls[None], self.anchor(state, phase)[None], fps, start_frame)[0]

    def rollouts(
        self, states: Sequence[State], controls: Any, *, threads: int = 1, fps: Any = 24, start_frame: int = 1001
    ) -> list[Clip]:
        """Clips of many vehicles side by side: ``states`` (m,), ``controls`` (m, n, c), or (n, c) for all of them.

        Each is what `rollout` makes of it. ``threads`` share the vehicles out where the integrator is ``compiled``.
        """
        given = np.asarray(controls, float)
        knots = control_table(self.vehicle, given, (len(states), given.shape[-2] if given.ndim > 1 else 0))
        if self.guarded:  # each may need columns of its own eliminated
            return [self.rollout(s, c, fps=fps, start_frame=start_frame) for s, c in zip(states, knots, strict=True)]
        fleet = self.fleet(states, knots[:, 0], threads)
        return self._clips(fleet.advance(knots[:, 1:]), knots, fleet.anchors, fps, start_frame, threads)

    def _clips(
        self, x: Array, controls: Array, anchors: Array, fps: Any, start_frame: int, threads: int = 1
    ) -> list[Clip]:
        times = np.asarray(self.step_size * np.arange(x.shape[1]), float)
        options = {"compiled": self.compiled, "threads": threads, "fps": fps, "start_frame": start_frame}
        return build_clips(self.mechanics, times, x, controls, anchors, self.wind, **options)

    def steps(self, solve: str = _WAYS[0]) -> Callable[[Array, Array, Array], None]:
        """``run(x (..., n + 1, d), controls (..., n + 1, c), residual (..., n, 1))`` fills in ``x[1:]``."""
        function = whole_step(self.mechanics, self.order, solve)
        key = f"steps{self.order}{solve}{self.compiled}"
        loop = keep(self.mechanics, key, lambda: Loop(function, carries=True, compiled=self.compiled))

        def run(x: Array, controls: Array, residual: Array) -> None:
            h, wind = (
                np.broadcast_to(a, (*residual.shape[:-1], a.size)) for a in (np.array(self.step_size), self.wind)
            )
            before, after = controls[..., :-1, :], controls[..., 1:, :]
            loop([x[..., :-1, :], before, after, h, wind], [x[..., 1:, :], residual])

        return run

    def _accumulate(self, phase: Phase, controls: Array) -> tuple[Array, Array, Array]:
        """Group elements, joints and momenta at every knot."""
        g, r, pi, _ = np.split(self.history(packed(phase), controls), np.cumsum(self.mechanics.sizes[:3]), axis=1)
        return g, r, pi

    def history(self, start: Array, controls: Array) -> Array:
        """Phases (n, .) packed at every knot of ``controls`` (n, c), the loop kept out of Python."""
        m, controls = self.mechanics, np.ascontiguousarray(controls)
        x, residual = np.empty((len(controls), len(start))), np.zeros((len(controls) - 1, 1))
        x[0] = start
        for first in range(0, len(residual), _CHUNK):
            steps = slice(first, first + _CHUNK)
            block, knots, left = x[first : first + _CHUNK + 1], controls[first : first + _CHUNK + 1], residual[steps]
            for solve in _WAYS:
                self.steps(solve)(block, knots, left)
                if np.all(left <= FAST_TOLERANCE):
                    break
            if not np.all(left <= TOLERANCE):  # one by one: retries, or an error that names the step
                block[1:] = [packed(after) for after in self._loop(unpacked(m, block[0]), knots, first)]
            elif self.guarded:
                check_constraints(m, _joints(m, block), first)
        check_mass(m, _joints(m, x), self.compiled)
        return x

    def _loop(self, phase: Phase, controls: Array, first: int) -> Iterator[Phase]:
        for k in range(len(controls) - 1):
            phase = self.advance(phase, controls[k], controls[k + 1], first + k)
            yield phase


HolonomicIntegrator = NonholonomicIntegrator = Integrator


def _symmetric(name: str, vehicle: Vehicle) -> bool:
    from vehsim.lie import difference_map

    return difference_map(name, vehicle.group).symmetric


def mechanics_of(vehicle: Vehicle, map_name: str, quadrature: str) -> DiscreteMechanics:
    """One per vehicle object and scheme: expressions are built once and live as long as the vehicle."""
    kept = vehicle.__dict__.setdefault("_mechanics", {})
    key = (map_name, quadrature)
    if key not in kept:
        kept[key] = DiscreteMechanics(vehicle, map_name, quadrature)
    return kept[key]


def packed(phase: Phase) -> Array:
    return np.concatenate([phase.g, phase.r, phase.pi, phase.z])


def unpacked(mechanics: DiscreteMechanics, x: Array) -> Phase:
    return Phase(*(part.copy() for part in np.split(x, np.cumsum(mechanics.sizes[:3]))))


def _joints(mechanics: DiscreteMechanics, x: Array) -> Array:
    """Joints (n, s) of packed phases (n, .)."""
    size, s = mechanics.sizes[:2]
    return x[:, size : size + s]


def _diverged(vehicle: Vehicle, index: int, phase: Phase, residual: float, h: float) -> SolveError:
    state = ", ".join(f"{name} = {np.round(getattr(phase, name), 6).tolist()}" for name in ("g", "r", "pi"))
    return SolveError(
        f"{vehicle.name}: step {index} of {h:.6g} s did not converge: residual {residual:.3g} at {state}; "
        "take a smaller step, or check the controls and the start"
    )
